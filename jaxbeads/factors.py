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
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float


def _one_by_one(function: Callable[..., Any], *stacks: Array) -> Any:
    """The function of each member: in turn on a CPU, side by side elsewhere."""
    # Both are of the function itself, so that its rule holds for a second batch too.
    return lax.platform_dependent(
        *stacks,
        cpu=lambda *stacks: lax.map(lambda member: function(*member), stacks),
        default=jax.vmap(function.fun if isinstance(function, custom_vmap) else function),
    )


@custom_vmap
def cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """L of S = L L^T from the lower triangle of S; NaN where S is not positive."""
    return lax.linalg.cholesky(matrix, symmetrize_input=False)


@custom_vmap
def lu(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Array]:
    """L and U in one matrix, and the order of the rows: matrix[order] = L U."""
    factor, _, order = lax.linalg.lu(matrix)
    return factor, order


@cholesky.def_vmap
def _(size: int, batched: list[bool], matrices: Array) -> tuple[Any, Any]:
    return _one_by_one(cholesky, matrices), True


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
    return _solve(lower, transposed, unit)(factor, rhs[:, None])[:, 0]


def cholesky_solve(factor: Float[Array, "n n"], rhs: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solution of L L^T x = rhs."""
    half = triangular_solve(factor, rhs, lower=True)
    return triangular_solve(factor, half, lower=True, transposed=True)


def _solve(lower: bool, transposed: bool, unit: bool) -> Callable[[Array, Array], Array]:
    """Of many right-hand sides, the columns of a matrix."""
    options = dict(left_side=True, lower=lower, transpose_a=transposed, unit_diagonal=unit)
    solve = custom_vmap(partial(lax.linalg.triangular_solve, **options))

    @solve.def_vmap
    def _(size: int, batched: list[bool], factors: Array, rhs: Array) -> tuple[Array, bool]:
        if not batched[0]:  # more columns
            columns = jnp.moveaxis(rhs, 0, -1)
            return jnp.moveaxis(
                solve(factors, columns.reshape(len(columns), -1)).reshape(columns.shape), -1, 0
            ), True
        if not batched[1]:
            rhs = jnp.broadcast_to(rhs, (size, *rhs.shape))
        return _one_by_one(solve, factors, rhs), True

    return solve
