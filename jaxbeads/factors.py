"""Factorisations and triangular solutions, one matrix or many side by side.

On a CPU many matrices are factorised one after the other. LAPACK's batched calls share their work out to
the threads that run the program itself; as many of them at once as there are threads wait for each other
for ever (jaxlib 0.10). More cores are used by more devices, see `sweep`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jaxlib.lapack import prepare_lapack_call
from jaxtyping import Array, Bool, Float


def _one_by_one(function: custom_vmap, *stacks: Array) -> Any:
    """The function of each member: in turn on a CPU, side by side elsewhere."""
    # The map is of the function itself, so that its rule holds for a second batch too.
    return lax.platform_dependent(
        *stacks,
        cpu=lambda *stacks: lax.map(lambda member: function(*member), stacks),
        default=jax.vmap(function.fun),
    )


def diagonal(matrix: Float[Array, "n n"]) -> Float[Array, " n"]:
    """The diagonal, as a slice: `jnp.diagonal` gathers, which XLA takes for a pass over the whole."""
    return matrix.T.ravel()[:: len(matrix) + 1]


def symmetric(upper: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The whole matrix from its upper triangle."""
    return jnp.triu(upper) + jnp.triu(upper, 1).T


def _potrf(matrix: Array) -> tuple[Array, Array]:
    # What `lax.linalg.cholesky` calls, without its copy of the matrix before and its pass over the
    # factor after it: these take as long as the factorisation where XLA cuts them for two threads.
    target = prepare_lapack_call("potrf_ffi", matrix.dtype)
    result = jax.ShapeDtypeStruct(matrix.shape, matrix.dtype), jax.ShapeDtypeStruct((), jnp.int32)
    call = jax.ffi.ffi_call(target, result, vmap_method="sequential")
    factor, failed = call(matrix, uplo=np.uint8(ord("L")))
    return factor.T, failed <= 0  # negative: it takes a matrix without rows for a mistake


@custom_vmap
def cholesky(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """L of S = L L^T from the upper triangle of S, which is where LAPACK looks for it in a matrix that
    is stored by rows, and whether S is positive. Above L, and in L if it is not, there may be anything;
    NaN stays NaN. It has no derivatives."""

    def general(matrix: Array) -> tuple[Array, Array]:
        factor = lax.linalg.cholesky(matrix.T, symmetrize_input=False)
        return factor, jnp.all(jnp.isfinite(diagonal(factor)))

    return lax.platform_dependent(matrix, cpu=_potrf, default=general)


@custom_vmap
def lu(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Array]:
    """L and U in one matrix, and the order of the rows: matrix[order] = L U."""
    factor, _, order = lax.linalg.lu(matrix)
    return factor, order


@cholesky.def_vmap
def _(size: int, batched: list[bool], matrices: Array) -> tuple[Any, Any]:
    return _one_by_one(cholesky, matrices), (True, True)


@lu.def_vmap
def _(size: int, batched: list[bool], matrices: Array) -> tuple[Any, Any]:
    return _one_by_one(lu, matrices), (True, True)


def triangular_solve(
    factor: Float[Array, "n n"],
    rhs: Float[Array, " n"],
    *,
    lower: bool,
    transposed: bool = False,
    unit: bool = False,
) -> Float[Array, " n"]:
    """Solution of T x = rhs, or T^T x = rhs, with a triangle T of a matrix, with ones on its diagonal if
    `unit`."""
    options = {"lower": lower, "transpose_a": transposed, "unit_diagonal": unit}
    solve = partial(lax.linalg.triangular_solve, left_side=True, **options)
    return _columns(solve)(factor, rhs[:, None])[:, 0]


@custom_vmap
def inverse_of_triangle(factor: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """L^-1 of a lower triangle."""
    unit = jnp.eye(len(factor), dtype=factor.dtype)
    return lax.linalg.triangular_solve(factor, unit, left_side=True, lower=True)


@inverse_of_triangle.def_vmap
def _(size: int, batched: list[bool], factors: Array) -> tuple[Any, Any]:
    return _one_by_one(inverse_of_triangle, factors), True


def cholesky_solve(factor: Float[Array, "n n"], rhs: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solution of L L^T x = rhs."""

    def solve(factor: Array, rhs: Array) -> Array:
        half = lax.linalg.triangular_solve(factor, rhs, left_side=True, lower=True)
        return lax.linalg.triangular_solve(
            factor, half, left_side=True, lower=True, transpose_a=True
        )

    return _columns(solve)(factor, rhs[:, None])[:, 0]


def _columns(function: Callable[[Array, Array], Array]) -> Callable[[Array, Array], Array]:
    """A solution with many right-hand sides, the columns of a matrix."""
    solve = custom_vmap(function)

    @solve.def_vmap
    def _(size: int, batched: list[bool], factors: Array, rhs: Array) -> tuple[Array, bool]:
        if not batched[0]:  # more columns
            columns = jnp.moveaxis(rhs, 0, -1)
            found = solve(factors, columns.reshape(len(columns), -1))
            return jnp.moveaxis(found.reshape(columns.shape), -1, 0), True
        if not batched[1]:
            rhs = jnp.broadcast_to(rhs, (size, *rhs.shape))
        return _one_by_one(solve, factors, rhs), True

    return solve
