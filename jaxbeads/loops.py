"""Loops that are differentiated: what is kept of a step, and loops of unknown length in both modes."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, PyTree

from ._compat import named, while_loop

_SECOND = (
    "Second derivatives through adaptive steps: give the number of steps (`substeps`) instead."
)


_KEPT = "kept"


def keep(values: PyTree) -> PyTree:
    """The values, which the backward pass of a `checkpointed` step shall not compute again."""
    return named(values, _KEPT)


def checkpointed(step: Callable[..., Any]) -> Callable[..., Any]:
    """A step of which the backward pass keeps its arguments and what is named by `keep`."""
    return jax.checkpoint(step, policy=jax.checkpoint_policies.save_only_these_names(_KEPT))


def loop(
    unfinished: Callable[[PyTree, PyTree], Any],
    body: Callable[[PyTree, PyTree], PyTree],
    start: PyTree,
    fixed: PyTree,
    most: int,
) -> PyTree:
    """carry = body(carry, fixed), from `start`, while unfinished(carry, fixed), `most` times at most.

    It has first derivatives by `start` and `fixed` in either mode. Forward, tangents go along with the
    carry. Backward, nothing of the loop is kept but its start: it is run again, with checkpoints whose
    number grows like the root of `most`. Rounding may differ between these programs: where it decides
    on the turns (steps chosen by errors not far above rounding), derivatives are as exact as that leaves
    them. Second derivatives raise an error.
    """
    return _loop(start, fixed, unfinished=unfinished, body=body, most=most)


@jax.custom_jvp
def _once_differentiable(x: Array) -> Array:
    return x


@_once_differentiable.defjvp
def _refuse(*_: Any) -> Any:
    raise RuntimeError(_SECOND)


@eqx.filter_custom_jvp
def _loop(start: PyTree, fixed: PyTree, *, unfinished: Any, body: Any, most: int) -> PyTree:
    return while_loop(unfinished, body, start, fixed, most, "lax")


@_loop.def_jvp
def _loop_jvp(primals: Any, tangents: Any, *, unfinished: Any, body: Any, most: int) -> Any:
    numbers, rest = eqx.partition(primals, eqx.is_inexact_array)
    given = jax.tree.leaves(eqx.filter(tangents, eqx.is_inexact_array))
    # All that goes into the linear map must be linear in the tangents, also what is zero.
    zero = sum(jnp.sum(0 * t) for t in given)

    def zeros(x: Any) -> Any:
        return jax.tree.map(lambda x: jnp.zeros_like(x) + jnp.asarray(zero, x.dtype), x)

    shifts = jax.tree.map(
        lambda x, t: zeros(x) if t is None else t, numbers, tangents, is_leaf=lambda x: x is None
    )

    def end(numbers: PyTree, kind: Any) -> PyTree:
        """The numbers in the last carry."""
        start, fixed = eqx.combine(numbers, rest)
        last = while_loop(unfinished, body, start, fixed, most, kind)
        return eqx.filter(last, eqx.is_inexact_array)

    result = _loop(*primals, unfinished=unfinished, body=body, most=most)
    nothing = zeros(eqx.filter(result, eqx.is_inexact_array))

    # A linear map with a transpose of its own: the "solution" (0, L b) of an equation for (b, 0).
    def push(_: Any, pair: Any) -> Any:
        moved = jax.jvp(lambda x: end(x, "lax"), (numbers,), (pair[0],))[1]
        return jax.tree.map(jnp.zeros_like, pair[0]), moved

    def pull(_: Any, pair: Any) -> Any:
        (moved,) = jax.vjp(lambda x: end(x, "checkpointed"), numbers)[1](pair[1])
        return moved, jax.tree.map(jnp.zeros_like, pair[1])

    def itself(pair: Any) -> Any:
        marks = [_once_differentiable(x) for x in jax.tree.leaves(numbers)]
        one = 1 + 0 * sum(jnp.sum(mark) for mark in marks)
        return jax.tree.map(lambda x: (one * x).astype(x.dtype), pair)

    _, moved = lax.custom_linear_solve(itself, (shifts, nothing), push, pull)
    return result, moved


def equal_parts(number: int, most: int) -> int:
    """The size of equal parts of a number of things, at most `most`: parts of two sizes would be two
    programs."""
    return next(size for size in range(max(1, min(number, most)), 0, -1) if number % size == 0)
