"""From one save time to the next: constant steps, or steps chosen by a controller.

A stepper holds a solver and carries everything that the next step depends on, so a run that is cut
between save times, or between steps, and continued from its carry is the same run, bit for bit.
`interval` goes through to the next save time and can be differentiated; `stretch` takes some of its
steps, so that a host can look on, stop and go on.

Steps are those of diffrax's solvers and controllers, but the loop is not `diffeqsolve`: between two
steps bonds are set to their lengths and directors to unit length, laws and places are watched, a failed
step keeps the last good state, and the derivative of the loop is that of `loops`, with one copy of the
step.
"""

from dataclasses import replace
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from .._typing import with_all_digits
from ..coordinates import project, tidied
from ..dynamics import rate
from ..geometry import norm
from ..loops import checkpointed, equal_parts, loop
from ..outcome import Outcome
from ..scene import Scene
from ..state import State
from .base import AbstractSolver
from .watch import watch

Time = Any  # a scalar: `diffrax` hands out floats and arrays


def _vector_field(t: Time, state: State, scene: Scene) -> State:
    return rate(t, state, scene)


_TERM = diffrax.ODETerm(_vector_field)


class Carry(eqx.Module):
    """What goes from step to step."""

    state: State
    """State at the last save time."""
    steps: Int[Array, ""]
    """Attempted steps so far."""
    code: Int[Array, ""]
    """An `Outcome`."""
    memory: Any
    """Of the solver and its controller."""
    taken: Int[Array, ""]
    """Attempted steps since the last save time; 0 at one."""


MOST_KEPT = 2**25
"""Bytes of factors that the backward pass keeps at most, for each evaluation in a step."""


class FixedSteps(eqx.Module):
    """Equal steps from each save time to the next.

    **Argument**: `solver`, whose `substeps` are given.

    >>> from jaxbeads.solver import AB3, FixedSteps
    >>> steps = FixedSteps(AB3(substeps=5))
    >>> print(steps.substeps, steps.projected)
    5 False
    """

    solver: AbstractSolver

    @property
    def substeps(self) -> int:
        """Steps between two save times."""
        return self.solver.substeps or 1

    @property
    def projected(self) -> bool:
        """Whether bond lengths are restored after each step."""
        return bool(self.solver.projected)

    def init(self, scene: Scene, state: State, t0: Time, t1: Time) -> Carry:
        """Carry at the first save time t0; t1 is the next."""
        end = t0 + (t1 - t0) / self.substeps
        memory = self.solver.scheme.init(_TERM, t0, end, state, scene)
        none = jnp.zeros((), int)
        return Carry(state, none, none, memory, none)

    def step(self, scene: Scene, carry: Carry, t0: Time, t1: Time, index: Any) -> Carry:
        """Step number `index` of the interval from t0 to t1."""
        h = (t1 - t0) / self.substeps
        start, end = t0 + index * h, t0 + (index + 1) * h
        jump = jnp.zeros((), bool)
        y, _, _, memory, result = self.solver.scheme.step(
            _TERM, start, end, carry.state, scene, carry.memory, jump
        )
        y = project(scene, y) if self.projected else tidied(scene, y)
        failed = result != diffrax.RESULTS.successful
        code = jnp.where(failed, Outcome.GAVE_UP, carry.code)
        return Carry(y, carry.steps + 1, code, memory, carry.taken)

    def interval(self, scene: Scene, carry: Carry, t0: Time, t1: Time, intervals: int = 1) -> Carry:
        """Carry at t1 from that at t0, one of so many intervals."""

        @checkpointed
        def body(carry: Carry, index: Any) -> tuple[Carry, None]:
            return self.step(scene, carry, t0, t1, index), None

        # The backward pass keeps the factors of all steps if they are few, otherwise the first carry of
        # each block and the factors of one.
        x = carry.state.position
        few = intervals * self.substeps * x.size**2 * x.dtype.itemsize <= MOST_KEPT

        if few:
            return lax.scan(body, carry, jnp.arange(self.substeps))[0]

        @jax.checkpoint
        def block(carry: Carry, indices: Array) -> tuple[Carry, None]:
            return lax.scan(body, carry, indices)

        indices = jnp.arange(self.substeps).reshape(
            -1, equal_parts(self.substeps, int(self.substeps**0.5))
        )
        return lax.scan(block, carry, indices)[0]

    def stretch(self, scene: Scene, carry: Carry, t0: Time, t1: Time, most: Any) -> Carry:
        """Carry after at most so many more steps of the interval from t0 to t1."""
        until = jnp.minimum(carry.taken + most, self.substeps)

        def step(index: Any, carry: Carry) -> Carry:
            return self.step(scene, carry, t0, t1, index)

        taken = jnp.where(until < self.substeps, until, 0)
        return replace(lax.fori_loop(carry.taken, until, step, carry), taken=taken)

    def reached(self, carry: Carry, t0: Time, t1: Time) -> Time:
        """Time that a carry within the interval from t0 to t1 has reached."""
        return t0 + (t1 - t0) / self.substeps * carry.taken


def _first_step(scene: Scene, state: State, t0: Time, t1: Time) -> Array:
    """A step in which no bead moves by more than a thousandth of a fibre's length, or to the next save
    time. The controller takes it from there.
    """
    t0, t1, state, scene = lax.stop_gradient((jnp.asarray(t0), t1, state, scene))
    speed = jnp.max(norm(rate(t0, state, scene).position))
    short = 1e-3 * jnp.max(scene.chain.length) / jnp.where(speed > 0, speed, 1.0)
    gap = jnp.asarray(t1 - t0)
    return jnp.where(speed > 0, jnp.minimum(short, gap), gap)


class _Adaptive(eqx.Module):
    previous: Time
    next: Time
    state: State  # at `previous`
    solver: Any
    controller: Any
    jump: Array
    dense: tuple[Time, Time, Any]  # the last accepted step and its interpolant


class AdaptiveSteps(eqx.Module):
    """Steps chosen by a `diffrax` controller; save times are interpolated, not stepped on.

    **Arguments**: `solver`; `controller`, which its tolerance means in a scene, or its own.

    >>> import diffrax
    >>> from jaxbeads.solver import AdaptiveSteps, Rosenbrock
    >>> controller = diffrax.PIDController(rtol=1e-6, atol=1e-6)
    >>> print(AdaptiveSteps(Rosenbrock(), controller).controller.rtol)
    1e-06
    """

    solver: AbstractSolver
    controller: diffrax.AbstractStepSizeController

    @property
    def max_steps(self) -> int:
        """The most steps between two save times."""
        return self.solver.max_steps

    @property
    def projected(self) -> bool:
        """Whether bond lengths are restored after each step that is kept."""
        return bool(self.solver.projected)

    @property
    def _scheme(self) -> tuple[Any, Any]:
        """The scheme, and the order of its error."""
        scheme: Any = self.solver.scheme
        return scheme, scheme.error_order(_TERM)

    def init(self, scene: Scene, state: State, t0: Time, t1: Time) -> Carry:
        """Carry at the first save time t0; t1 is the next."""
        if self.projected:
            state = project(scene, state)
        solver, order = self._scheme
        first = _first_step(scene, state, t0, t1)
        end, controller = self.controller.init(
            _TERM, t0, t1, state, first, scene, solver.func, order
        )
        memory = solver.init(_TERM, t0, end, state, scene)
        jump = jnp.zeros((), bool)
        # Traced once: the same call as that of every attempt.
        shape = eqx.filter_eval_shape(_step, solver, t0, end, state, scene, memory, jump)[2]
        dense = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shape)
        end = lax.stop_gradient(t0 + _plain(end - t0, t1 - t0))
        controller = lax.stop_gradient(jax.tree.map(jnp.asarray, controller))
        adaptive = _Adaptive(t0, end, state, memory, controller, jump, (t0, t0, dense))
        none = jnp.zeros((), int)
        return Carry(state, none, none, adaptive, none)

    def attempt(
        self, scene: Scene, code: Array, a: _Adaptive, gap: Array
    ) -> tuple[Array, _Adaptive]:
        """One step, kept or not, where save times are `gap` apart."""
        (scheme, order), t0 = self._scheme, a.previous
        watched = watch(scene, t0, a.state)
        t1, beyond, shortened, begun, jumped = a.next, None, None, t0, a.jump
        if not watched.idle:
            start, switches = watched.begin(lax.stop_gradient(t0))
            begun, jumped = t0 + (start - lax.stop_gradient(t0)), a.jump | switches
            # A step ends where a law jumps, and the next begins on the other side.
            last, beyond = watched.end(*lax.stop_gradient((t0, a.next, gap)))
            shortened = last < a.next
            t1 = jnp.where(shortened, last, a.next)
        y, error, dense, memory, result = _step(scheme, begun, t1, a.state, scene, a.solver, jumped)
        path = scheme.interpolation_cls(t0=t0, t1=t1, **dense).evaluate
        unseen = watched.unseen(t0, t1, path)
        # A step that fails or leaves the finite numbers is tried again with a smaller one.
        finite = [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves((y, error))]
        bad = (result != diffrax.RESULTS.successful) | ~jnp.stack(finite).all()
        bad = bad | watched.passed(t0, t1, y, path)
        if (outside := scene.outside(y)) is not None:
            bad = bad | jnp.any(outside)
        if unseen is not None:
            bad = bad | ~jnp.isfinite(unseen)
            error = _larger(error, unseen)
        error = jax.tree.map(lambda e: jnp.where(bad, jnp.inf, e), error)
        keep, start, end, jump, controller, verdict = self.controller.adapt_step_size(
            t0, t1, a.state, y, scene, error, order, a.controller
        )
        y = project(scene, y) if self.projected else tidied(scene, y)
        keep = jnp.asarray(keep)
        # A step that is tried again begins behind the same jump.
        jump = jnp.where(keep, jnp.asarray(jump), jumped)
        if beyond is not None and shortened is not None:
            # A step that was shortened says little about how long the next one may be.
            wanted = jnp.where(keep & shortened, a.next - t0, 0.0)
            following = jnp.maximum(end - start, wanted)
            switched = keep & (beyond > t1)
            start = jnp.where(switched, beyond, start)
            end, jump = start + following, jump | switched

        def pick(new: Any, old: Any) -> Any:
            return jax.tree.map(lambda n, o: jnp.where(keep, n, o), new, old)

        # Derivatives are those of the steps taken: their lengths come from differences not far above
        # rounding, whose derivatives are noise. A step that is not kept begins again where it did.
        start, end, controller = lax.stop_gradient(
            (start, start + _plain(end - start, gap), controller)
        )
        dense = pick((t0, t1, dense), a.dense)
        # The step has shrunk until it no longer moves the time: nothing helps.
        stuck = (end <= start) | (verdict != diffrax.RESULTS.successful)
        if self.solver.hopeless is not None:
            stuck = stuck | (result == self.solver.hopeless)
        after = _Adaptive(
            jnp.where(keep, start, t0),
            end,
            pick(y, a.state),
            pick(memory, a.solver),
            controller,
            jump,
            dense,
        )
        return jnp.where(stuck, Outcome.GAVE_UP, code), after

    def interval(self, scene: Scene, carry: Carry, t0: Time, t1: Time, intervals: int = 1) -> Carry:
        """Carry at t1 from that at t0, one of so many intervals."""
        fixed = self, scene, jnp.asarray(t0), jnp.asarray(t1)
        turn = loop(_unfinished, _attempted, _turn(carry), fixed, self.max_steps)
        count, code, a = turn
        return Carry(self._saved(scene, turn, t1), carry.steps + count, code, a, carry.taken)

    def stretch(self, scene: Scene, carry: Carry, t0: Time, t1: Time, most: Any) -> Carry:
        """Carry after at most so many more steps towards t1, the next save time after t0."""
        fixed = self, scene, jnp.asarray(t0), jnp.asarray(t1)
        first, last = _turn(carry), carry.taken + most

        def unfinished(turn: _Turn) -> Array:
            return _unfinished(turn, fixed) & (turn[0] < last)

        turn = lax.while_loop(unfinished, lambda turn: _attempted(turn, fixed), first)
        count, code, a = turn
        done = ~_unfinished(turn, fixed)
        saved = self._saved(scene, turn, t1)
        state = jax.tree.map(lambda new, old: jnp.where(done, new, old), saved, carry.state)
        steps = carry.steps + count - carry.taken
        return Carry(state, steps, code, a, jnp.where(done, 0, count))

    def reached(self, carry: Carry, t0: Time, t1: Time) -> Time:
        """Time that a carry within the interval from t0 to t1 has reached."""
        return jnp.where(carry.taken > 0, carry.memory.previous, t0)

    def _saved(self, scene: Scene, turn: "_Turn", t1: Time) -> State:
        """State at a save time that steps have reached or passed; NaN if they have not."""
        _, code, a = turn
        start, end, info = a.dense
        inside = jnp.where(
            end > start, end, start + 1
        )  # before the first step there is no interval
        y = self._scheme[0].interpolation_cls(t0=start, t1=inside, **info).evaluate(t1)
        y = project(scene, y) if self.projected else tidied(scene, y)
        return jax.tree.map(lambda y: jnp.where(code == Outcome.FINE, y, jnp.nan), y)


@with_all_digits
@eqx.filter_jit
def _step(
    solver: Any, t0: Array, t1: Array, state: State, scene: Scene, memory: Any, jump: Array
) -> Any:
    """A step of a solver, which JAX traces once for all that asks for it."""
    return solver.step(_TERM, t0, t1, state, scene, memory, jump)


def _plain(step: Any, gap: Any) -> Array:
    """A length of a step whose ratio to the gap between save times has twelve binary digits: programs of
    one run that differ in rounding, as those of its derivatives, or in other units, take the same
    steps.
    """
    ratio = jnp.asarray(step / gap)
    exponent = jnp.finfo(ratio.dtype).nexp
    return gap * lax.reduce_precision(ratio, exponent_bits=exponent, mantissa_bits=12)


def _larger(error: Any, by: Array) -> State:
    """An error of a state that is larger by a length, whichever way it points."""
    vectors = error.position
    by, length = lax.stop_gradient(by), norm(vectors)[:, None]
    still = length == 0
    longer = vectors * (1 + by / jnp.where(still, 1.0, length))
    longer = jnp.where(still, by / vectors.shape[1] ** 0.5, longer)
    return eqx.tree_at(lambda e: e.position, error, longer)


_Turn = tuple[Array, Array, _Adaptive]
_Fixed = tuple[AdaptiveSteps, Scene, Array, Array]


def _turn(carry: Carry) -> _Turn:
    """Where the loop of an interval begins, or goes on."""
    return carry.taken, carry.code, carry.memory


def _unfinished(turn: _Turn, fixed: _Fixed) -> Array:
    _, code, a = turn
    return (a.previous < fixed[3]) & (code == Outcome.FINE)


@with_all_digits
def _attempted(turn: _Turn, fixed: _Fixed) -> _Turn:
    count, code, a = turn
    stepper, scene, t0, t1 = fixed
    code, a = stepper.attempt(scene, code, a, t1 - t0)
    many = (count + 1 >= stepper.max_steps) & (a.previous < t1)
    return count + 1, jnp.where(many, Outcome.TOO_MANY_STEPS, code), a
