"""A run as its host sees it: intervals in stretches, looked at, written, stopped.

Between two save times the device goes on alone for about half a second, a number of steps that the host
chooses by how long the last ones took (`progress.Pace`). All stretches are calls of one compiled
program, so where they begin changes no bit. What is whole is checked and written after each chunk of
save times, and after ten seconds at the latest, the middle of an interval included.
"""

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NoReturn

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from ._checks import described, fail, positive, whole
from ._compat import CompileClock, held_memory
from ._typing import with_all_digits
from .breakdown import SimulationError, locate
from .dynamics import named
from .files import TrajectoryFile
from .outcome import Outcome
from .progress import Bar, Forecast, Pace
from .rollout import Stepper, beyond, diagnostics, law_errors
from .scene import Scene
from .solution import Solution, name_number
from .solver.stepping import Carry
from .state import State

RESIDUAL_TOLERANCE = 1e-3
"""Constraint residual from which on the constraints count as violated; rounding leaves 1e-14 in float64
and 1e-6 in float32."""

LAW_TOLERANCE = 1e-3
"""How far what is prescribed may be off its law, over the law's way, before a warning."""

_WRITE = 10.0
"""Seconds after which what there is is checked and written, also within a chunk or an interval."""

# One compiled program for all scenes of one shape: everything numeric is an argument.
# XLA: and one for any number of steps, since in loops of other lengths it rounds differently.
_diagnostics = eqx.filter_jit(diagnostics)
_beyond = eqx.filter_jit(beyond)
_law_errors = eqx.filter_jit(law_errors)


@eqx.filter_jit
@with_all_digits
def _stretch(
    stepper: Stepper, scene: Scene, carry: Carry, t0: Any, t1: Any, most: Any
) -> tuple[Carry, State, Array]:
    """Some steps: the carry then, its state with an axis of times, and the time reached."""
    carry = stepper.stretch(scene, carry, t0, t1, most)
    return carry, jax.tree.map(lambda x: x[None], carry.state), stepper.reached(carry, t0, t1)


class Clock:
    """Wall time and compile time since its making."""

    def __init__(self) -> None:
        self.wall, self.compiling = time.perf_counter(), CompileClock()

    def read(self) -> tuple[float, float]:
        """Seconds of both."""
        return time.perf_counter() - self.wall, self.compiling.read()


def part_of(scene: Scene, ts: Array, each: list[State], carry: Carry) -> Solution:
    """Of states one by one, each with an axis of times, for which one program is compiled."""
    times = [jax.device_put(t[None]) for t in np.asarray(ts)]
    found = [_diagnostics(scene, t, state) for t, state in zip(times, each, strict=True)]
    return Solution(ts, _concatenate(each), carry.steps, carry.code, *_concatenate(found))


def _warn_of_laws(scene: Scene, stepper: Stepper, solution: Solution) -> None:
    errors = np.asarray(_law_errors(scene, stepper, solution.ts, solution.states))
    for constraint, error in zip(scene.constraints, errors, strict=True):
        if not error <= LAW_TOLERANCE:
            warnings.warn(
                f"{named(constraint)} is off its law by {100 * error:.3g} % of the law's way: a law is "
                "followed by its derivative, so it must not jump; where it has a kink, equal steps must "
                "be small, or be chosen by `tolerance`.",
                stacklevel=4,
            )


def _chunk_length(intervals: int, wanted: int | None) -> int:
    """Intervals in a chunk: a divisor of all, so that all are equally long."""
    most = max(1, intervals // 20) if wanted is None else wanted
    return max(n for n in range(1, min(most, intervals) + 1) if intervals % n == 0)


@dataclass(frozen=True)
class _Piece:
    """What has been computed since the last look."""

    before: Carry
    """The carry then."""
    first: int
    """Number of the interval in which that was."""
    states: list[State]
    """At the ends of the intervals that are whole, each with an axis of times."""
    now: Carry


@dataclass
class Run:
    """The host's loop over chunks of save times."""

    scene: Scene
    stepper: Stepper
    ts: Array
    bond_tolerance: float
    until: Callable[[Solution], bool] | None
    chunk: int | None
    progress: bool
    clock: Clock
    target: TrajectoryFile | None = None
    parts: list[Solution] = field(default_factory=list)
    piece: _Piece | None = None
    forecast: Forecast | None = None
    """Not yet told."""
    looked: float = 0.0

    def __post_init__(self) -> None:
        positive("bond_tolerance", self.bond_tolerance)
        if self.chunk is not None:
            whole("chunk", self.chunk, 1)
        if self.until is not None and not callable(self.until):
            fail("until", "be a function of the solution so far", f"it is {described(self.until)}")
        self.times, self.pace = np.asarray(self.ts), Pace()

    def __enter__(self) -> "Run":
        return self

    def __exit__(self, *_: object) -> None:
        if self.target is not None:
            self.target.close()

    def go(self, carry: Carry, first: Solution, done: int) -> Solution:
        """From interval number `done`, in which the carry is, to the end."""
        self.parts, ending, intervals = [first], Outcome.FINISHED, len(self.ts) - 1
        self.piece, self.looked = _Piece(carry, done, [], carry), time.perf_counter()
        length, times = _chunk_length(intervals, self.chunk), self.times
        try:
            begun, now, end = (float(times[k]) for k in (0, done, -1))
            with Bar(begun, end, now, self.progress, self.clock.compiling.read) as bar:
                self.foretell(carry, first, done, bar)
                while done < intervals:
                    # Where chunks end does not depend on where the run was resumed.
                    last = (done // length + 1) * length
                    for index in range(done, last):
                        self.interval(index, bar)
                    self.look()
                    done = last
                    if self.until is not None and self.until(self.joined(ending)):
                        ending = Outcome.STOPPED
                        break
        except KeyboardInterrupt:
            ending = Outcome.INTERRUPTED
            self.look()
            reached = float(self.parts[-1].ts[-1])
            kept = "" if self.target is None else " `resume` goes on from its last step."
            warnings.warn(
                f"The run was interrupted; its last saved time is t = {reached:g}.{kept}",
                stacklevel=3,
            )
        solution = self.ended(ending)
        _warn_of_laws(self.scene, self.stepper, solution)
        return solution

    def foretell(self, carry: Carry, first: Solution, done: int, bar: Bar) -> None:
        """Say what a long run will take: by the time of an evaluation, before the first step."""
        if not self.progress or done >= len(self.ts) - 1:
            return
        begin = time.perf_counter()
        jax.block_until_ready(_diagnostics(self.scene, first.ts[-1:], first.states))
        seconds, left = time.perf_counter() - begin, len(self.ts) - 1 - done
        self.forecast = Forecast.of(self.stepper, self.scene.chain.beads, left, seconds)
        if self.forecast.known:
            self.tell(carry, done, bar)

    def tell(self, carry: Carry, index: int, bar: Bar) -> None:
        """The forecast, if it is of a long run."""
        forecast, self.forecast = self.forecast, None
        if forecast is not None and forecast.long:
            # The run, too, finds this program compiled.
            t0, t1 = self.times[index : index + 2]
            given = self.stepper, self.scene, carry, t0, t1, np.asarray(1)
            bar.say(forecast.sentence(held_memory(_stretch, *given)))

    def stretch(self, carry: Carry, index: int) -> tuple[Carry, State, Array]:
        """Some more steps of an interval."""
        self.pace.begin()
        t0, t1 = self.times[index : index + 2]
        found = _stretch(self.stepper, self.scene, carry, t0, t1, np.asarray(self.pace.most))
        self.pace.end(int(found[0].steps) - int(carry.steps))
        return found

    def interval(self, index: int, bar: Bar) -> None:
        """What is left of an interval."""
        unfinished = True
        while unfinished and (piece := self.piece) is not None:
            carry, state, t = self.stretch(piece.now, index)
            unfinished = int(carry.taken) > 0
            states = piece.states if unfinished else [*piece.states, state]
            # In one piece: an interrupt finds it as it was before, or as it is after.
            self.piece = _Piece(piece.before, piece.first, states, carry)
            if self.forecast is not None and (each := self.pace.each) is not None:
                self.forecast = self.forecast.after(1, each)
                self.tell(carry, index, bar)
            bar.tell(float(t if unfinished else self.times[index + 1]), int(carry.steps))
            if time.perf_counter() - self.looked > _WRITE:
                self.look()

    def look(self) -> None:
        """Check and write what there is."""
        piece, self.piece = self.piece, None
        if piece is None:  # an interrupt fell into a look
            return
        first, count, part = piece.first, len(piece.states), None
        if piece.states:
            ts = jax.device_put(self.times[first + 1 : first + 1 + count])
            part = part_of(self.scene, ts, piece.states, piece.now)
            fine = np.isfinite(np.asarray(part.states.position)).all(axis=(1, 2))
            fine &= np.asarray(part.bond_length_error) <= self.bond_tolerance
            fine &= ~np.asarray(_beyond(self.scene, part.states))
            fine &= np.asarray(part.residual) <= RESIDUAL_TOLERANCE
            if not fine.all() or int(piece.now.code) != Outcome.FINE:
                self.stop(piece, int(np.argmin(fine)))
            self.parts.append(part)
        if self.target is not None:
            self.target.append(part, piece.now)
        self.piece = _Piece(piece.now, first + count, [], piece.now)
        self.looked = time.perf_counter()

    def stop(self, piece: _Piece, good: int) -> NoReturn:
        """Keep the `good` intervals of a piece that are fine, then raise the error."""
        carry = piece.before
        for index in range(piece.first, piece.first + good):
            carry, state = self.again(carry, index)
            ts = jax.device_put(self.times[index + 1 : index + 2])
            self.parts.append(part_of(self.scene, ts, [state], carry))
            if self.target is not None:
                self.target.append(self.parts[-1], carry)
        index = piece.first + good
        after, _ = self.again(carry, index)
        t0, t1 = (float(t) for t in self.times[index : index + 2])
        cause = locate(self.stepper, self.scene, carry, after, t0, t1, self.bond_tolerance)
        raise SimulationError(cause, self.ended(Outcome.BROKEN_DOWN))

    def again(self, carry: Carry, index: int) -> tuple[Carry, State]:
        """What is left of an interval, once more."""
        carry, state, _ = self.stretch(carry, index)
        while int(carry.taken) > 0:
            carry, state, _ = self.stretch(carry, index)
        return carry, state

    def joined(self, ending: Outcome) -> Solution:
        """All parts in one."""

        def column(get: Callable[[Solution], Any]) -> Any:
            return _concatenate([get(part) for part in self.parts])

        wall, compiling = self.clock.read()
        return Solution(
            column(lambda p: p.ts),
            column(lambda p: p.states),
            self.parts[-1].steps,
            self.parts[-1].code,
            column(lambda p: p.residual),
            column(lambda p: p.bond_length_error),
            wall,
            compiling,
            ending,
            name_number(self.stepper.solver.name),
        )

    def ended(self, ending: Outcome) -> Solution:
        """The solution with which the run ends; the file notes how long it took."""
        solution = self.joined(ending)
        if self.target is not None:
            self.target.end(solution)
        return solution


def _concatenate(trees: list[Any]) -> Any:
    # By numpy: JAX would compile a new program for every number of parts.
    return jax.tree.map(
        lambda *x: jax.device_put(np.concatenate([np.asarray(y) for y in x])), *trees
    )
