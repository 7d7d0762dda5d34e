"""Loops that are differentiated: what is kept of a step, and loops of unknown length in both modes.

The idea of `loop`: going forward, leave carries behind at even distances, which double when there is no
more room; going backward, take the transpose of one round after the other from the carry before it,
going again from the last one left behind. The round itself is in the program once for each mode. What
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


Round = Callable[[PyTree, PyTree], Any]
"""A function of what goes from round to round and of what is fixed."""

_SLOTS = 2**9
"""Carries that the backward pass of `loop` keeps at most, and about as many between two of them."""


def loop(unfinished: Round, body: Round, start: PyTree, fixed: PyTree, most: int) -> PyTree:
    """carry = body(carry, fixed), from `start`, while unfinished(carry, fixed), `most` times at most.

    It has first derivatives by `start` and `fixed` in either mode. Forward, tangents go along with the
    carry. Backward, one round's transpose is taken after the other, from the carries that the loop has
    left behind: all of them up to 512 rounds, beyond that every second, fourth, ..., and those between
    are taken again. Rounding may differ between these programs: where it decides on the rounds (steps
    chosen by errors not far above rounding), derivatives are as exact as that leaves them. Second
    derivatives raise an error.

    The body is traced once, whatever is asked for, and stands in the program once for the loop and once
    for its derivative; `equinox.internal.while_loop`, which does the same, has several copies of it.

    **Arguments**: two functions that close over nothing that is traced; carry; all else that they read;
    bound on the number of rounds.
    """
    return _loop(start, fixed, unfinished=unfinished, body=body, most=most)


@jax.custom_jvp
def _once_differentiable(x: Array) -> Array:
    return x


@_once_differentiable.defjvp
def _refuse(*_: Any) -> Any:
    raise RuntimeError(_SECOND)


class _Rounds(NamedTuple):
    """A loop, of which arrays are parted from the rest of its carry and of what is fixed."""

    unfinished: Round
    body: Round
    start: PyTree
    fixed: PyTree
    still: tuple[PyTree, PyTree]
    most: int

    def whole(self, carry: PyTree, fixed: PyTree) -> tuple[PyTree, PyTree]:
        """Carry and what is fixed with what is no array."""
        return eqx.combine(carry, self.still[0]), eqx.combine(fixed, self.still[1])

    def goes_on(self, count: Array, carry: PyTree) -> Any:
        """Whether there is one more round."""
        return (count < self.most) & self.unfinished(*self.whole(carry, self.fixed))

    def next(self, carry: PyTree, fixed: PyTree) -> PyTree:
        """The arrays of the next carry."""
        after = _traced_once(self.body, *self.whole(carry, fixed))
        return _strong(eqx.filter(after, eqx.is_array_like))

    def along(self, numbers: PyTree) -> "_Rounds":
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
            lambda now: (now[0] + 1, self.next(now[1], self.fixed)),
            (jnp.zeros((), int), self.start),
        )[1]


@eqx.filter_jit
def _traced_once(body: Round, carry: PyTree, fixed: PyTree) -> PyTree:
    return body(carry, fixed)


def _array(x: Any) -> bool:
    return isinstance(x, (jax.Array, np.ndarray))


def _strong(tree: PyTree) -> PyTree:
    """Arrays whose types no number beside them changes."""
    return jax.tree.map(lambda x: lax.convert_element_type(x, jnp.asarray(x).dtype), tree)


def _rounds(start: PyTree, fixed: PyTree, unfinished: Round, body: Round, most: int) -> _Rounds:
    start, carried = eqx.partition(start, eqx.is_array_like)
    fixed, still = eqx.partition(fixed, _array)
    return _Rounds(unfinished, body, _strong(start), _strong(fixed), (carried, still), most)


class _Trail(NamedTuple):
    """The carries that a loop leaves behind, in `_SLOTS` slots: that of every round, and when they are
    full, of every second, fourth, ..., in the slots of those that are given up.
    """

    rounds: Any
    slots: int
    saved: PyTree

    @classmethod
    def empty(cls, rounds: _Rounds) -> "_Trail":
        slots = min(_power(rounds.most), _SLOTS)
        saved = jax.tree.map(lambda x: jnp.zeros((slots, *x.shape), x.dtype), rounds.start)
        return cls(rounds, slots, saved)

    @property
    def doublings(self) -> range:
        """How often the slots can be full."""
        return range((_power(self.rounds.most) // self.slots).bit_length() - 1)

    def stride(self, number: Array) -> Array:
        """Between the rounds that are kept when this one is taken."""
        return 2 ** sum(
            (jnp.asarray(number >= self.slots * 2**k, int) for k in self.doublings), 0 * number
        )

    def slot(self, number: Array) -> Array:
        """Where the carry is from which a round that is kept begins."""
        for k in reversed(self.doublings):  # the odd multiples of 2^k give way to what comes later
            full = self.slots * 2**k
            number = jnp.where(number >= full, number - full + 2**k, number)
        return number

    def add(self, number: Array, carry: PyTree) -> "_Trail":
        """With the carry from which a round begins, if it is one to keep."""
        # One that is not goes nowhere: beyond the last slot.
        slot = jnp.where(number % self.stride(number) == 0, self.slot(number), self.slots)
        saved = jax.tree.map(lambda s, x: s.at[slot].set(x, mode="drop"), self.saved, carry)
        return self._replace(saved=saved)

    def back(self, count: Array, slope: PyTree) -> PyTree:
        """Slopes by the numbers of the loop from those by the numbers of its last carry."""
        rounds, stride = self.rounds, self.stride(jnp.maximum(count - 1, 0))
        fixed, others = eqx.partition(rounds.fixed, eqx.is_inexact_array)
        between = 2 ** len(self.doublings)
        block = jax.tree.map(lambda x: jnp.zeros((between, *x.shape), x.dtype), rounds.start)

        def step(now: Any) -> Any:
            # `at`: the round that is taken; it is the last one that is `left`, or on the way to it.
            left, at, slope, total, block = now
            first = (left - 1) // stride * stride
            carry = jax.tree.map(
                lambda s, b: jnp.where(at == first, s[self.slot(first)], b[at - first]),
                self.saved,
                block,
            )
            moving, resting = eqx.partition(carry, eqx.is_inexact_array)

            def once(moving: PyTree, fixed: PyTree) -> tuple[PyTree, PyTree]:
                after = rounds.next(eqx.combine(moving, resting), eqx.combine(fixed, others))
                return eqx.filter(after, eqx.is_inexact_array), after

            _, pull, after = jax.vjp(once, moving, fixed, has_aux=True)
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
def _loop(start: PyTree, fixed: PyTree, *, unfinished: Round, body: Round, most: int) -> PyTree:
    rounds = _rounds(start, fixed, unfinished, body, most)
    return eqx.combine(rounds.run(), rounds.still[0])


@_loop.def_jvp
def _loop_jvp(primals: Any, tangents: Any, **of: Any) -> Any:
    start, fixed = primals
    rounds = _rounds(start, fixed, of["unfinished"], of["body"], of["most"])

    def one(now: tuple[Array, PyTree, PyTree]) -> tuple[Array, PyTree, PyTree]:
        count, carry, saved = now
        trail = empty._replace(saved=saved).add(count, carry)
        return count + 1, rounds.next(carry, rounds.fixed), trail.saved

    empty = _Trail.empty(rounds)
    count, end, saved = lax.while_loop(
        lambda now: rounds.goes_on(*now[:2]), one, (jnp.zeros((), int), rounds.start, empty.saved)
    )
    trail, numbers = empty._replace(saved=saved), rounds.numbers
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
            return eqx.filter(rounds.along(numbers).run(), eqx.is_inexact_array)

        moved = jax.jvp(last, (numbers,), (pair[0],))[1]
        return jax.tree.map(jnp.zeros_like, pair[0]), moved

    def pull(_: Any, pair: Any) -> Any:
        return trail.back(count, pair[1]), jax.tree.map(jnp.zeros_like, pair[1])

    def itself(pair: Any) -> Any:
        marks = [_once_differentiable(x) for x in jax.tree.leaves(numbers)]
        one = 1 + 0 * sum(jnp.sum(mark) for mark in marks)
        return jax.tree.map(lambda x: (one * x).astype(x.dtype), pair)

    _, moved = lax.custom_linear_solve(itself, (shifts, zeros(moving)), push, pull)
    return eqx.combine(end, rounds.still[0]), moved


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
    JAX traces the body's derivative again and again until it knows which numbers have one.
    """
    numbers, rest = eqx.partition(carry, eqx.is_inexact_array)
    return eqx.combine(_with_tangents(numbers, eqx.filter(inputs, eqx.is_inexact_array)), rest)


def equal_parts(number: int, most: int) -> int:
    """The size of equal parts of a number of things, at most `most`: parts of two sizes would be two
    programs.
    """
    return next(size for size in range(max(1, min(number, most)), 0, -1) if number % size == 0)
