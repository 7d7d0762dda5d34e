"""Factorisations and triangular solutions, one matrix or many side by side.

Every function takes stacks of matrices, `(..., n, n)`, and is one call of LAPACK on a CPU; `vmap` makes
stacks of it as long as `at_once` allows.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from . import plain
from ._compat import CALLS_OF_KNOWN_COST, HAS_RULES, custom_vmap, working_potrf
from .loops import equal_parts

_OPERATIONS = 150_000 if CALLS_OF_KNOWN_COST else 0
Operations = Callable[..., int]
"""Those of one member, from all members' stacks."""


def at_once(operations: int) -> int:
    """How many members, of as many operations each, may go into one call of LAPACK.

    Calls with more than 200 000 operations in all (jaxlib 0.10) share their work out to the threads that
    run the program itself; as many of them at once as there are threads wait for each other for ever.
    Smaller ones are done where they are called, one matrix after the other. More cores are used by more
    devices, see `sweep`. Where nothing is known of them (`CALLS_OF_KNOWN_COST`): one matrix in a call.
    """
    return max(1, _OPERATIONS // max(operations, 1))


def _calls(function: Any, operations: Operations, *stacks: Array) -> Any:
    """A function of members, the first axis: on a CPU as many in a call as may be, elsewhere all."""
    members = len(stacks[0])
    group = equal_parts(members, at_once(operations(*stacks)))
    # The function itself is called, so that its rule holds for one more batch too.
    if group == members:
        return function(*stacks)

    def in_turn(*stacks: Array) -> Any:
        cut = [x.reshape(members // group, group, *x.shape[1:]) for x in stacks]
        found = lax.map(lambda stack: function(*stack), cut)
        return jax.tree.map(lambda x: x.reshape(members, *x.shape[2:]), found)

    return lax.platform_dependent(*stacks, cpu=in_turn, default=function.fun)


def _stacks(function: Any, operations: Operations) -> Callable[..., Any]:
    """The rule of a function for members: they and the stack that there is make one stack."""

    def rule(size: int, batched: list[bool], *several: Array) -> tuple[Any, Any]:
        several = tuple(
            x if b else jnp.broadcast_to(x, (size, *x.shape))
            for x, b in zip(several, batched, strict=True)
        )
        axes = several[0].shape[:-2]
        found = _calls(function, operations, *(x.reshape(-1, *x.shape[-2:]) for x in several))
        found = jax.tree.map(lambda x: x.reshape(*axes, *x.shape[1:]), found)
        return found, jax.tree.map(lambda _: True, found)

    return rule


def diagonal(matrix: Float[Array, "n n"]) -> Float[Array, " n"]:
    """The diagonal."""
    # XLA: a slice, since `jnp.diagonal` gathers, which it takes for a pass over the whole.
    return matrix.T.ravel()[:: len(matrix) + 1]


def symmetric(upper: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The whole matrix from its upper triangle."""
    return jnp.triu(upper) + jnp.triu(upper, 1).T


def _safe(lapack: Callable[..., Any], plain: Callable[..., Any]) -> Callable[..., Any]:
    """The function that calls LAPACK; on CPUs the one in plain arithmetic where no rule keeps calls
    small.
    """
    if HAS_RULES:
        return lapack

    def each(*stacks: Array) -> Any:
        function = plain
        for _ in range(stacks[0].ndim - 2):
            function = jax.vmap(function)
        return function(*stacks)

    return lambda *stacks: lax.platform_dependent(*stacks, cpu=each, default=lapack)


@custom_vmap
def cholesky(
    matrix: Float[Array, "*stack n n"],
) -> tuple[Float[Array, "*stack n n"], Bool[Array, "*stack"]]:
    """L of S = L L^T from the upper triangle of S, which is where LAPACK looks for it in a matrix that
    is stored by rows, and whether S is positive. Above L, and in L if it is not, there may be anything;
    NaN stays NaN. It has no derivatives.
    """

    def general(matrix: Array) -> tuple[Array, Array]:
        lower = jnp.swapaxes(matrix, -1, -2)
        factor = lax.linalg.cholesky(lower, symmetrize_input=False)
        pivots = jnp.diagonal(factor, axis1=-2, axis2=-1)
        return factor, jnp.all(jnp.isfinite(pivots), axis=-1)

    potrf = working_potrf() if HAS_RULES else None
    if potrf is None:
        return _safe(general, plain.cholesky)(matrix)
    return lax.platform_dependent(matrix, cpu=potrf, default=general)


cholesky.def_vmap(_stacks(cholesky, lambda matrix: matrix.shape[-1] ** 3 // 3))


@custom_vmap
def lu(matrix: Float[Array, "*stack n n"]) -> tuple[Float[Array, "*stack n n"], Array]:
    """L and U in one matrix, and the order of the rows: matrix[order] = L U."""

    def lapack(matrix: Array) -> tuple[Array, Array]:
        factor, _, order = lax.linalg.lu(matrix)
        return factor, order

    return _safe(lapack, plain.lu)(matrix)


lu.def_vmap(_stacks(lu, lambda matrix: matrix.shape[-1] ** 3))


def _triangular_solve(**options: bool) -> Callable[[Array, Array], Array]:
    return _safe(
        partial(lax.linalg.triangular_solve, left_side=True, **options),
        partial(plain.triangular_solve, **options),
    )


def triangular_solve(
    factor: Float[Array, "n n"],
    rhs: Float[Array, " n"],
    *,
    lower: bool,
    transposed: bool = False,
    unit: bool = False,
) -> Float[Array, " n"]:
    """Solution of T x = rhs, or T^T x = rhs, with a triangle T of a matrix, with ones on its diagonal if
    `unit`.
    """
    options = {"lower": lower, "transpose_a": transposed, "unit_diagonal": unit}
    solve = _triangular_solve(**options)
    return _columns(solve)(factor, rhs[:, None])[:, 0]


@custom_vmap
def inverse_of_triangle(factor: Float[Array, "*stack n n"]) -> Float[Array, "*stack n n"]:
    """L^-1 of a lower triangle."""
    unit = jnp.broadcast_to(jnp.eye(factor.shape[-1], dtype=factor.dtype), factor.shape)
    return _triangular_solve(lower=True)(factor, unit)


inverse_of_triangle.def_vmap(_stacks(inverse_of_triangle, lambda factor: factor.shape[-1] ** 3))


def inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a matrix whose rows and columns may have units of their own."""
    column = 1 / jnp.max(jnp.abs(matrix), axis=0, keepdims=True)
    row = 1 / jnp.max(jnp.abs(matrix * column), axis=1, keepdims=True)
    solve = _by_lu(row * matrix * column)
    unit = jnp.eye(len(matrix), dtype=matrix.dtype)
    return column.T * jax.vmap(solve, in_axes=1, out_axes=1)(unit) * row.T


def solve(matrix: Float[Array, "n n"], rhs: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solution of A x = rhs."""
    return _by_lu(matrix)(rhs)


def _by_lu(matrix: Float[Array, "n n"]) -> Callable[[Array], Array]:
    factor, order = lu(matrix)

    def solve(rhs: Array) -> Array:
        below = triangular_solve(factor, rhs[order], lower=True, unit=True)
        return triangular_solve(factor, below, lower=False)

    return solve


def cholesky_solve(factor: Float[Array, "n n"], rhs: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solution of L L^T x = rhs."""

    def solve(factor: Array, rhs: Array) -> Array:
        half = _triangular_solve(lower=True)(factor, rhs)
        return _triangular_solve(lower=True, transpose_a=True)(factor, half)

    return _columns(solve)(factor, rhs[:, None])[:, 0]


def _columns(function: Callable[[Array, Array], Array]) -> Callable[[Array, Array], Array]:
    """A solution with many right-hand sides, the columns of a matrix."""
    solve = custom_vmap(function)

    def operations(factor: Array, rhs: Array) -> int:
        return factor.shape[-1] * rhs.shape[-2] * rhs.shape[-1]

    side_by_side = _stacks(solve, operations)

    @solve.def_vmap
    def _(size: int, batched: list[bool], factor: Array, rhs: Array) -> tuple[Array, bool]:
        if batched[0]:
            return side_by_side(size, batched, factor, rhs)
        columns = jnp.moveaxis(rhs, 0, -1)  # the same factors, more columns
        joined = columns.reshape(*columns.shape[:-2], -1)
        stacked = factor.ndim > 2
        found = _calls(solve, operations, factor, joined) if stacked else solve(factor, joined)
        return jnp.moveaxis(found.reshape(columns.shape), -1, 0), True

    return solve
