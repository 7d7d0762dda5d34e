"""Loops that are differentiated: what is kept of a step, and loops of unknown length in both modes.

The idea of `loop`: going forward, leave carries behind at even distances, which double when there is no
more room; going backward, take the transpose of one turn after the other from the carry before it,
turning again from the last one left behind. The turn itself is in the program once for each mode. What
justifies it is compiling: `benchmarks/startup.py` has the seconds of a gradient, most of which grow
with the copies of a step. A `lax.while_loop` with a reverse mode of its own would make it unnecessary.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree

from ._compat import named

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


Turn = Callable[[PyTree, PyTree], Any]
"""A function of what goes from turn to turn and of what is fixed."""

_SLOTS = 2**9
"""Carries that the backward pass of `loop` keeps at most, and about as many between two of them."""


def loop(unfinished: Turn, body: Turn, start: PyTree, fixed: PyTree, most: int) -> PyTree:
    """carry = body(carry, fixed), from `start`, while unfinished(carry, fixed), `most` times at most.

    It has first derivatives by `start` and `fixed` in either mode. Forward, tangents go along with the
    carry. Backward, one turn's transpose is taken after the other, from the carries that the loop has
    left behind: all of them up to 512 turns, beyond that every second, fourth, ..., between which turns
    are taken again. Rounding may differ between these programs: where it decides on the turns (steps
    chosen by errors not far above rounding), derivatives are as exact as that leaves them. Second
    derivatives raise an error.

    The body is traced once, whatever is asked for, and stands in the program once for the loop and once
    for its derivative; `equinox.internal.while_loop`, which does the same, has several copies of it.

    **Arguments**: two functions that close over nothing that is traced; carry; all else that they read;
    bound on the number of turns.
    """
    return _loop(start, fixed, unfinished=unfinished, body=body, most=most)


@jax.custom_jvp
def _once_differentiable(x: Array) -> Array:
    return x


@_once_differentiable.defjvp
def _refuse(*_: Any) -> Any:
    raise RuntimeError(_SECOND)


class _Turns(NamedTuple):
    """A loop, of which arrays are parted from the rest of its carry and of what is fixed."""

    unfinished: Turn
    body: Turn
    start: PyTree
    fixed: PyTree
    still: tuple[PyTree, PyTree]
    most: int

    def whole(self, carry: PyTree, fixed: PyTree) -> tuple[PyTree, PyTree]:
        """Carry and what is fixed with what is no array."""
        return eqx.combine(carry, self.still[0]), eqx.combine(fixed, self.still[1])

    def goes_on(self, count: Array, carry: PyTree) -> Any:
        """Whether there is one more turn."""
        return (count < self.most) & self.unfinished(*self.whole(carry, self.fixed))

    def turn(self, carry: PyTree, fixed: PyTree) -> PyTree:
        """The arrays of the next carry."""
        after = _traced_once(self.body, *self.whole(carry, fixed))
        return _strong(eqx.filter(after, eqx.is_array_like))

    def along(self, numbers: PyTree) -> "_Turns":
        """From other numbers, to start with and fixed."""
        start, fixed = eqx.combine(numbers, (self.start, self.fixed))
        return self._replace(start=start, fixed=fixed)

    @property
    def numbers(self) -> PyTree:
        """By which it has derivatives."""
        return eqx.filter((self.start, self.fixed), eqx.is_inexact_array)

    def run(self) -> PyTree:
        """The arrays of the last carry."""
        return lax.while_loop(
            lambda now: self.goes_on(*now),
            lambda now: (now[0] + 1, self.turn(now[1], self.fixed)),
            (jnp.zeros((), int), self.start),
        )[1]


@eqx.filter_jit
def _traced_once(body: Turn, carry: PyTree, fixed: PyTree) -> PyTree:
    return body(carry, fixed)


def _array(x: Any) -> bool:
    return isinstance(x, (jax.Array, np.ndarray))


def _strong(tree: PyTree) -> PyTree:
    """Arrays whose types no number beside them changes."""
    return jax.tree.map(lambda x: lax.convert_element_type(x, jnp.asarray(x).dtype), tree)


def _turns(start: PyTree, fixed: PyTree, unfinished: Turn, body: Turn, most: int) -> _Turns:
    start, carried = eqx.partition(start, eqx.is_array_like)
    fixed, still = eqx.partition(fixed, _array)
    return _Turns(unfinished, body, _strong(start), _strong(fixed), (carried, still), most)


class _Trail(NamedTuple):
    """The carries that a loop leaves behind, in `_SLOTS` slots: that of every turn, and when they are
    full, of every second, fourth, ..., in the slots of those that are given up."""

    turns: Any
    slots: int
    saved: PyTree

    @classmethod
    def empty(cls, turns: _Turns) -> "_Trail":
        slots = min(_power(turns.most), _SLOTS)
        saved = jax.tree.map(lambda x: jnp.zeros((slots, *x.shape), x.dtype), turns.start)
        return cls(turns, slots, saved)

    @property
    def doublings(self) -> range:
        """How often the slots can be full."""
        return range((_power(self.turns.most) // self.slots).bit_length() - 1)

    def stride(self, turn: Array) -> Array:
        """Between the turns that are kept when this one is taken."""
        return 2 ** sum(
            (jnp.asarray(turn >= self.slots * 2**k, int) for k in self.doublings), 0 * turn
        )

    def slot(self, turn: Array) -> Array:
        """Where the carry is from which a turn that is kept begins."""
        for k in reversed(self.doublings):  # the odd multiples of 2^k give way to what comes later
            full = self.slots * 2**k
            turn = jnp.where(turn >= full, turn - full + 2**k, turn)
        return turn

    def add(self, turn: Array, carry: PyTree) -> "_Trail":
        """With the carry from which a turn begins, if it is one to keep."""
        # One that is not goes nowhere: beyond the last slot.
        slot = jnp.where(turn % self.stride(turn) == 0, self.slot(turn), self.slots)
        saved = jax.tree.map(lambda s, x: s.at[slot].set(x, mode="drop"), self.saved, carry)
        return self._replace(saved=saved)

    def back(self, count: Array, slope: PyTree) -> PyTree:
        """Slopes by the numbers of the loop from those by the numbers of its last carry."""
        turns, stride = self.turns, self.stride(jnp.maximum(count - 1, 0))
        fixed, others = eqx.partition(turns.fixed, eqx.is_inexact_array)
        between = 2 ** len(self.doublings)
        block = jax.tree.map(lambda x: jnp.zeros((between, *x.shape), x.dtype), turns.start)

        def step(now: Any) -> Any:
            # `at`: the turn that is taken; it is the last one that is `left`, or on the way to it.
            left, at, slope, total, block = now
            first = (left - 1) // stride * stride
            carry = jax.tree.map(
                lambda s, b: jnp.where(at == first, s[self.slot(first)], b[at - first]),
                self.saved,
                block,
            )
            moving, resting = eqx.partition(carry, eqx.is_inexact_array)

            def turn(moving: PyTree, fixed: PyTree) -> tuple[PyTree, PyTree]:
                after = turns.turn(eqx.combine(moving, resting), eqx.combine(fixed, others))
                return eqx.filter(after, eqx.is_inexact_array), after

            _, pull, after = jax.vjp(turn, moving, fixed, has_aux=True)
            arrived, (by_carry, by_fixed) = at == left - 1, pull(slope)
            slope = jax.tree.map(lambda a, b: jnp.where(arrived, a, b), by_carry, slope)
            total = jax.tree.map(lambda a, b: a + jnp.where(arrived, b, 0), total, by_fixed)
            if between > 1:
                next_ = jnp.where(arrived, between, at + 1 - first)
                block = jax.tree.map(lambda b, x: b.at[next_].set(x, mode="drop"), block, after)
            left = left - arrived
            before = jnp.where(left - 1 >= first, left - 1, (left - 1) // stride * stride)
            return left, jnp.where(arrived, before, at + 1), slope, total, block

        begin = (
            count,
            (count - 1) // stride * stride,
            slope,
            jax.tree.map(jnp.zeros_like, fixed),
            block,
        )
        _, _, slope, total, _ = lax.while_loop(lambda now: now[0] > 0, step, begin)
        return slope, total


def _power(number: int) -> int:
    """The smallest power of two that is not less."""
    return 2 ** (number - 1).bit_length()


@eqx.filter_custom_jvp
def _loop(start: PyTree, fixed: PyTree, *, unfinished: Turn, body: Turn, most: int) -> PyTree:
    turns = _turns(start, fixed, unfinished, body, most)
    return eqx.combine(turns.run(), turns.still[0])


@_loop.def_jvp
def _loop_jvp(primals: Any, tangents: Any, **of: Any) -> Any:
    start, fixed = primals
    turns = _turns(start, fixed, of["unfinished"], of["body"], of["most"])

    def one(now: tuple[Array, PyTree, PyTree]) -> tuple[Array, PyTree, PyTree]:
        count, carry, saved = now
        trail = empty._replace(saved=saved).add(count, carry)
        return count + 1, turns.turn(carry, turns.fixed), trail.saved

    empty = _Trail.empty(turns)
    count, end, saved = lax.while_loop(
        lambda now: turns.goes_on(*now[:2]), one, (jnp.zeros((), int), turns.start, empty.saved)
    )
    trail, numbers = empty._replace(saved=saved), turns.numbers
    given = jax.tree.leaves(eqx.filter(tangents, eqx.is_inexact_array))
    # All that goes into the linear map must be linear in the tangents, also what is zero.
    zero = _zero(given)

    def zeros(x: Any) -> Any:
        return jax.tree.map(lambda x: jnp.zeros_like(x) + jnp.asarray(zero, x.dtype), x)

    shifts = jax.tree.map(
        lambda x, t: zeros(x) if t is None else t, numbers, tangents, is_leaf=lambda x: x is None
    )
    moving = eqx.filter(end, eqx.is_inexact_array)

    # A linear map with a transpose of its own: the "solution" (0, L b) of an equation for (b, 0).
    def push(_: Any, pair: Any) -> Any:
        def last(numbers: PyTree) -> PyTree:
            return eqx.filter(turns.along(numbers).run(), eqx.is_inexact_array)

        moved = jax.jvp(last, (numbers,), (pair[0],))[1]
        return jax.tree.map(jnp.zeros_like, pair[0]), moved

    def pull(_: Any, pair: Any) -> Any:
        return trail.back(count, pair[1]), jax.tree.map(jnp.zeros_like, pair[1])

    def itself(pair: Any) -> Any:
        marks = [_once_differentiable(x) for x in jax.tree.leaves(numbers)]
        one = 1 + 0 * sum(jnp.sum(mark) for mark in marks)
        return jax.tree.map(lambda x: (one * x).astype(x.dtype), pair)

    _, moved = lax.custom_linear_solve(itself, (shifts, zeros(moving)), push, pull)
    return eqx.combine(end, turns.still[0]), moved


@jax.custom_jvp
def _with_tangents(numbers: PyTree, of: PyTree) -> PyTree:
    # The same either way; in batches each member has its own, as it has tangents.
    either = sum(jnp.sum(x) for x in jax.tree.leaves(of)) > 0
    return jax.tree.map(lambda x: jnp.where(either, x, x), numbers)


@_with_tangents.defjvp
def _(primals: Any, tangents: Any) -> Any:
    zero = _zero(jax.tree.leaves(tangents[1]))
    return primals[0], jax.tree.map(lambda x: x + jnp.asarray(zero, x.dtype), tangents[0])


def _zero(tangents: list[Array]) -> Any:
    """A zero that depends on all of them."""
    return sum(jnp.sum(0 * t) for t in tangents)


def linked(carry: PyTree, inputs: PyTree) -> PyTree:
    """The carry that a loop begins with, with tangents, if only zeros, wherever inputs have any: else
    JAX traces the body's derivative again and again until it knows which numbers have one."""
    numbers, rest = eqx.partition(carry, eqx.is_inexact_array)
    return eqx.combine(_with_tangents(numbers, eqx.filter(inputs, eqx.is_inexact_array)), rest)


def equal_parts(number: int, most: int) -> int:
    """The size of equal parts of a number of things, at most `most`: parts of two sizes would be two
    programs."""
    return next(size for size in range(max(1, min(number, most)), 0, -1) if number % size == 0)
