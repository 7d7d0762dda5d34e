"""Plain JAX in place of what `_compat` finds no more in the dependencies: slower, with the same results.

Loops of unknown length with derivatives, and Gaussian elimination, for one matrix and for any number of
them under `vmap`.
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

Turn = Callable[[PyTree, PyTree], Any]
"""A function of carry and fixed arguments."""


def while_loop(
    unfinished: Turn, body: Turn, start: PyTree, fixed: PyTree, most: int, kind: str
) -> PyTree:
    """carry = body(carry, fixed), from `start`, while unfinished(carry, fixed), `most` times at most.

    `kind`: `lax`, which has derivatives in forward mode, or `checkpointed`, in reverse: about the root
    of `most` carries are kept, and every turn is taken again from the one before it.
    """
    arrays, still = eqx.partition((start, fixed), eqx.is_array_like)
    numbers, others = eqx.partition(jax.tree.map(jnp.asarray, arrays), eqx.is_inexact_array)

    def go(carry: PyTree, fixed: PyTree) -> Any:
        return unfinished(eqx.combine(carry, still[0]), eqx.combine(fixed, still[1]))

    def turn(carry: PyTree, fixed: PyTree) -> PyTree:
        after = body(eqx.combine(carry, still[0]), eqx.combine(fixed, still[1]))
        return jax.tree.map(jnp.asarray, eqx.filter(after, eqx.is_array_like))

    if kind == "lax":
        begin, held = eqx.combine(numbers, others)
        end = _turns(go, turn, begin, held, most)[1]
    else:
        end = _reversible(go, turn, most)(numbers, others)
    return eqx.combine(end, still[0])


def _turns(go: Turn, turn: Turn, start: PyTree, fixed: PyTree, most: Any) -> tuple[Any, PyTree]:
    """Number of turns, and the last carry."""
    return lax.while_loop(
        lambda now: (now[0] < most) & go(now[1], fixed),
        lambda now: (now[0] + 1, turn(now[1], fixed)),
        (jnp.zeros((), int), start),
    )


def _reversible(go: Turn, turn: Turn, most: int) -> Callable[[PyTree, PyTree], PyTree]:
    """The last carry from what has derivatives and what has none."""
    slots = math.isqrt(most) + 2

    @jax.custom_vjp
    def run(numbers: PyTree, others: PyTree) -> PyTree:
        start, fixed = eqx.combine(numbers, others)
        return _turns(go, turn, start, fixed, most)[1]

    def forward(numbers: PyTree, others: PyTree) -> tuple[PyTree, Any]:
        start, fixed = eqx.combine(numbers, others)
        count, end = _turns(go, turn, start, fixed, most)
        return end, (numbers, others, count)

    def backward(kept: Any, slope: PyTree) -> tuple[PyTree, None]:
        numbers, others, count = kept
        start, fixed = eqx.combine(numbers, others)
        block = jnp.maximum(jnp.ceil(jnp.sqrt(count * 1.0)).astype(count.dtype), 1)

        def always(*_: Any) -> Any:
            return True

        def save(now: Any) -> Any:
            done, carry, saved = now
            saved = jax.tree.map(lambda s, x: s.at[done // block].set(x), saved, carry)
            more = jnp.minimum(block, count - done)
            return done + more, _turns(always, turn, carry, fixed, more)[1], saved

        empty = jax.tree.map(lambda x: jnp.zeros((slots, *x.shape), x.dtype), start)
        saved = lax.while_loop(lambda now: now[0] < count, save, (0 * count, start, empty))[2]

        def back(now: Any) -> Any:
            left, slope, total = now
            slot = (left - 1) // block
            carry = jax.tree.map(lambda s: s[slot], saved)
            carry = _turns(always, turn, carry, fixed, left - 1 - slot * block)[1]
            moving, resting = eqx.partition(carry, eqx.is_inexact_array)

            def after(moving: PyTree, held: PyTree) -> PyTree:
                end = turn(eqx.combine(moving, resting), eqx.combine(held, others[1]))
                return eqx.filter(end, eqx.is_inexact_array)

            slope, more = jax.vjp(after, moving, numbers[1])[1](slope)
            return left - 1, slope, jax.tree.map(jnp.add, total, more)

        # Of the slopes by the last carry those by numbers.
        slope = jax.tree.map(
            lambda x, s: None if x is None else s, numbers[0], slope, is_leaf=lambda x: x is None
        )
        total = jax.tree.map(jnp.zeros_like, numbers[1])
        _, slope, total = lax.while_loop(lambda now: now[0] > 0, back, (count, slope, total))
        return (slope, total), None

    run.defvjp(forward, backward)
    return run


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
