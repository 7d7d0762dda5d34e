"""Plain JAX in place of what `_compat` finds no more in the dependencies: slower, with the same results.

Gaussian elimination, for one matrix and for any number of them under `vmap`.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int


def _repeated(n: int, body: Callable[[Any, Any], Any], start: Any) -> Any:
    """`lax.fori_loop`; of what has no rows no row is asked for."""
    return lax.fori_loop(0, n, body, start) if n else start


def cholesky(upper: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """L of S = L L^T from the upper triangle of S, and whether S is positive."""
    n = len(upper)
    rows = jnp.arange(n)

    def column(j: Array, lower: Array) -> Array:
        below = upper[j] - lower @ lower[j]
        found = jnp.where(rows >= j, below / jnp.sqrt(below[j]), 0.0)
        return lower.at[:, j].set(found)

    lower = _repeated(n, column, jnp.zeros_like(upper))
    return lower, jnp.all(jnp.isfinite(lower))


def lu(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Int[Array, " n"]]:
    """L and U in one matrix, and the order of the rows: matrix[order] = L U."""
    n = len(matrix)
    rows = jnp.arange(n)

    def column(k: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        factor, order = now
        pivot = jnp.argmax(jnp.where(rows >= k, jnp.abs(factor[:, k]), -1.0))
        swap = jnp.where(rows == k, pivot, jnp.where(rows == pivot, k, rows))
        factor, order = factor[swap], order[swap]
        weight = jnp.where(rows > k, factor[:, k] / factor[k, k], 0.0)
        factor = factor - weight[:, None] * jnp.where(rows > k, factor[k], 0.0)[None, :]
        return factor.at[:, k].set(jnp.where(rows > k, weight, factor[:, k])), order

    return _repeated(n, column, (matrix, rows.astype(jnp.int32)))


def triangular_solve(
    factor: Float[Array, "n n"],
    rhs: Float[Array, "n columns"],
    *,
    lower: bool,
    transpose_a: bool = False,
    unit_diagonal: bool = False,
) -> Float[Array, "n columns"]:
    """Solution of T x = rhs, or T^T x = rhs, with a triangle T of a matrix."""
    n = len(factor)
    triangle = jnp.tril(factor) if lower else jnp.triu(factor)
    if transpose_a:
        triangle, lower = triangle.T, not lower

    def row(k: Array, x: Array) -> Array:
        k = k if lower else n - 1 - k
        # What is not found yet counts as zero.
        rest = rhs[k] - triangle[k] @ x
        return x.at[k].set(rest if unit_diagonal else rest / triangle[k, k])

    return _repeated(n, row, jnp.zeros_like(rhs))
