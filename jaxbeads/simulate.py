"""`simulate`: a trajectory for people. Chunks, progress, checks, files, restart."""

import contextlib
import re
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from ._checks import described, fail, increasing, positive, whole
from ._compat import CompileClock
from ._typing import float_array
from .breakdown import SimulationError, bond_error, explain, locate
from .contents import Contents
from .dynamics import named, redundancy
from .files import TrajectoryFile, compare, load, planned_times, reopen
from .outcome import Outcome
from .rollout import (
    Solver,
    Stepper,
    Tolerance,
    advance,
    beyond,
    diagnostics,
    law_errors,
    solver_for,
    stepper_for,
)
from .scene import Scene, check
from .solution import Solution, name_number
from .solver import FixedSteps, explicit_step
from .solver.stepping import Carry
from .state import State

RESIDUAL_TOLERANCE = 1e-3
"""Constraint residual from which on the constraints count as violated; rounding leaves 1e-14 in float64
and 1e-6 in float32."""

LAW_TOLERANCE = 1e-3
"""How far what is prescribed may be off its law, over the law's way, before a warning."""

# One compiled program for all scenes of one shape: everything numeric is an argument.
_advance = eqx.filter_jit(advance)
_init = eqx.filter_jit(lambda stepper, *args: stepper.init(*args))
_diagnostics = eqx.filter_jit(diagnostics)
_beyond = eqx.filter_jit(beyond)


class _Clock:
    """Wall time and compile time since its making."""

    def __init__(self) -> None:
        self.wall, self.compiling = time.perf_counter(), CompileClock()

    def read(self) -> tuple[float, float]:
        return time.perf_counter() - self.wall, self.compiling.read()


def _chunk_length(intervals: int, wanted: int | None) -> int:
    """Intervals in a chunk: a divisor of all, so that one compiled program serves every chunk."""
    most = max(1, intervals // 20) if wanted is None else wanted
    return max(n for n in range(1, min(most, intervals) + 1) if intervals % n == 0)


def simulate(
    scene: Scene,
    state: State,
    ts: Any,
    *,
    solver: Solver | None = None,
    tolerance: Tolerance | None = None,
    substeps: int | None = None,
    bond_tolerance: float = 0.01,
    overlap: bool = True,
    single_precision: bool = False,
    until: Callable[[Solution], bool] | None = None,
    chunk: int | None = None,
    file: str | Path | None = None,
    progress: bool = True,
) -> Solution:
    """Trajectory from `state` at `ts[0]`, saved at the times `ts`, watched from the host.

    The same numbers as `rollout`, computed in chunks. After each chunk the run is checked: positions
    must be finite and bonds must keep their lengths. Ctrl-C stops it and returns what is there. `jit`,
    `vmap` and `grad` go through `rollout` only.

    **Arguments**: as for `rollout`, and

    - `bond_tolerance`: largest relative error of a bond length before the run is stopped.
    - `overlap`: whether beads may overlap at the start.
    - `until`: a function of the solution so far; the run ends after the chunk where it is true.
    - `chunk`: save times in a chunk; shortened to a divisor of their number.
    - `file`: HDF5 file that is written while running; `resume` continues it. An older one is replaced
      once the run has begun; one that another run writes is left alone.
    - `progress`: show a progress bar.

    **Returns** a `Solution` with residual, bond-length error and timings. **Raises** `ValueError` for
    input that does not fit; `SimulationError` if the run breaks down, naming step, bead and term,
    with the solution up to the last good state in its field `solution`.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> state, ts = jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0]
    >>> fall = jb.simulate(scene, state, ts, substeps=1, progress=False)
    >>> print(fall.states.position[:, 0, 1].round(4), fall.status)
    [ 0.     -0.3183 -0.6366] finished
    """
    clock = _Clock()
    steps = {"solver": solver, "tolerance": tolerance, "bond_tolerance": bond_tolerance}
    _refuse_traced("simulate", scene=scene, state=state, ts=ts, **steps)
    check(scene, state, overlap=overlap, single_precision=single_precision)
    state = scene.begin(state)
    increasing("ts", ts)
    times = float_array(ts).astype(state.position.dtype)
    _refuse_traced("simulate", ts=times)
    stepper = stepper_for(scene, times, solver_for(scene, solver, tolerance, substeps))
    run = _Run(scene, stepper, times, bond_tolerance, until, chunk, progress)
    error, bond = bond_error(scene, state)
    if error > bond_tolerance:
        must = "hold neighbours at touching distance"
        fail("state", must, f"beads {bond} and {bond + 1} are off it by {100 * error:.3g} %")
    _warn_of_large_step(scene, stepper, times)
    if file is not None:
        run.target = TrajectoryFile.create(file, scene, stepper, times, state)
    with run:
        carry = _init(stepper, scene, state, times[0], times[1])
        first = _part(scene, times[:1], [jax.tree.map(lambda x: x[None], state)], carry)
        if not np.all(np.isfinite(np.asarray(first.residual))):
            how = redundancy(float(times[0]), state, scene)
            if how is not None:
                fail("scene.constraints", "be independent at the start", how)
        if not np.all(np.asarray(first.residual) <= RESIDUAL_TOLERANCE):
            cause = explain(scene, state, float(times[0]), 0, None)
            raise SimulationError(cause, run.joined([first], Outcome.BROKEN_DOWN, clock))
        if run.target is not None:
            run.target.append(first, carry)
        return run.go(carry, first, 0, clock)


def resume(
    file: str | Path,
    scene: Scene,
    *,
    solver: Solver | None = None,
    tolerance: Tolerance | None = None,
    substeps: int | None = None,
    bond_tolerance: float = 0.01,
    until: Callable[[Solution], bool] | None = None,
    chunk: int | None = None,
    progress: bool = True,
) -> Solution:
    """Continue the run of a file, bit for bit as if it had not been interrupted.

    Limits may be others than before: the solver's `max_steps` (a run that stopped at it goes on with a
    larger one), `bond_tolerance`, `until`, `chunk`, `progress`. Everything that decides on the numbers
    must be as it was and is compared with the file, entry by entry: terms and their classes, each number
    of the scene, the solver and its other options. A law, or any other plain function, is the same if
    its code is, with the numbers in its defaults, in its closure and in the globals that it reads: the
    same `lambda` in a new process will do. Methods of a term's class are not looked into.

    **Arguments**: the file; scene and solver with which it was written; the others as for `simulate`.
    **Returns** the solution from where the file left off (`files.load` reads the whole).
    **Raises** `ValueError` if file and arguments do not fit, naming what differs, and if another run
    writes to the file; and as `simulate`.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> state, ts, options = jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0], {"substeps": 1, "progress": False}
    >>> begun = jb.simulate(
    ...     scene, state, ts, file="fall.h5", chunk=1, until=lambda run: run.ts[-1] >= 1.0, **options
    ... )
    >>> rest = jb.resume("fall.h5", scene, **options)
    >>> print(begun.status, rest.status, rest.ts)
    stopped by `until` finished [1. 2.]
    """
    clock = _Clock()
    steps = {"solver": solver, "tolerance": tolerance, "bond_tolerance": bond_tolerance}
    _refuse_traced("resume", scene=scene, **steps)
    last = load(file)
    times = planned_times(file)
    _refuse_traced("resume", file=(last, times))  # under `jit` nothing is known
    stepper = stepper_for(scene, times, solver_for(scene, solver, tolerance, substeps))
    run = _Run(scene, stepper, times, bond_tolerance, until, chunk, progress)
    compare(file, scene, stepper)
    like = _init(stepper, scene, last.final, times[0], times[1])
    run.target, carry = reopen(file, like)
    with run:
        first = _part(scene, last.ts[-1:], [jax.tree.map(lambda x: x[-1:], last.states)], carry)
        return run.go(carry, first, len(last.ts) - 1, clock)


def _refuse_traced(by: str, **arguments: Any) -> None:
    """Refuse numbers that a transformation of JAX stands for, also in a law: the host must see them."""
    for path in Contents(**arguments).traced:
        must = f"hold numbers that are known, which `{by}` must see"
        how = f"`jax.grad`, `jit` or `vmap` traces `{path}`: use `rollout`, through which they go"
        fail(re.split(r"[.\[]", path)[0], must, how)


def _part(scene: Scene, ts: Array, each: list[State], carry: Carry) -> Solution:
    """Of states one by one, each with an axis of times, for which one program is compiled."""
    times = [jax.device_put(t[None]) for t in np.asarray(ts)]
    found = [_diagnostics(scene, t, state) for t, state in zip(times, each, strict=True)]
    return Solution(ts, _concatenate(each), carry.steps, carry.code, *_concatenate(found))


def _warn_of_large_step(scene: Scene, stepper: Stepper, ts: Array) -> None:
    stable_to = stepper.solver.stable_to
    if isinstance(stepper, FixedSteps) and stable_to is not None:
        step, limit = float(np.max(np.diff(ts))) / stepper.substeps, float(explicit_step(scene))
        if step > stable_to * limit:
            warnings.warn(
                f"The time step {step:.3g} is {step / limit:.3g} times `solver.explicit_step` (eq. (39) "
                f"for bending); {stepper.solver.name} is stable to about {stable_to:g} times.",
                stacklevel=3,
            )


_law_errors = eqx.filter_jit(law_errors)


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


@dataclass
class _Run:
    """The host's loop over chunks of save times."""

    scene: Scene
    stepper: Stepper
    ts: Array
    bond_tolerance: float
    until: Callable[[Solution], bool] | None
    chunk: int | None
    progress: bool
    target: TrajectoryFile | None = None
    bar: Any = None
    said: float = 0.0

    def __post_init__(self) -> None:
        positive("bond_tolerance", self.bond_tolerance)
        if self.chunk is not None:
            whole("chunk", self.chunk, 1)
        if self.until is not None and not callable(self.until):
            fail("until", "be a function of the solution so far", f"it is {described(self.until)}")

    def __enter__(self) -> "_Run":
        return self

    def __exit__(self, *_: object) -> None:
        if self.target is not None:
            self.target.close()

    def go(self, carry: Carry, first: Solution, done: int, clock: _Clock) -> Solution:
        """From interval number `done` to the end."""
        parts, ending, intervals = [first], Outcome.FINISHED, len(self.ts) - 1
        length = _chunk_length(intervals, self.chunk)
        from tqdm.auto import tqdm  # it warns on import in a notebook without widgets

        try:
            # Until the first interval is over, which may take longer than all others.
            bar = tqdm(None, "compiling", intervals, disable=not self.progress, initial=done)
            with bar, self.told(bar):
                while done < intervals:
                    count = min(length, intervals - done)
                    carry, part = self.advance(carry, done, count, parts, clock)
                    parts.append(part)
                    done += count
                    bar.update(count)
                    if self.until is not None and self.until(self.joined(parts, ending, clock)):
                        ending = Outcome.STOPPED
                        break
        except KeyboardInterrupt:
            ending = Outcome.INTERRUPTED
            warnings.warn(f"The run was interrupted at t = {parts[-1].ts[-1]:g}.", stacklevel=3)
        solution = self.ended(parts, ending, clock)
        _warn_of_laws(self.scene, self.stepper, solution)
        return solution

    @contextlib.contextmanager
    def told(self, bar: Any) -> Iterator[None]:
        """While it runs, its bar tells the time reached and steps taken, also within a chunk."""
        self.bar = None if bar.disable else bar
        try:
            yield
        finally:
            self.bar = None

    def tell(self, index: int, carry: Carry) -> None:
        """The time reached after an interval, at most a few times a second: it waits for the device."""
        now = time.perf_counter()
        last = index + 2 == len(self.ts)
        if self.bar is not None and (last or now - self.said > 0.3):
            t = f"t = {self.ts[index + 1]:.4g} of {self.ts[-1]:.4g}, {int(carry.steps)} steps"
            self.bar.set_description(t)
            self.said = now

    def advance(
        self, carry: Carry, done: int, count: int, parts: list[Solution], clock: _Clock
    ) -> tuple[Carry, Solution]:
        """One chunk, checked and written."""
        # XLA: one compiled program for one interval. In loops of other lengths it rounds differently: a
        # run would depend on its chunks.
        ts, after, each = np.asarray(self.ts), carry, []
        for index in range(done, done + count):
            after, state = _advance(self.stepper, self.scene, after, ts[index : index + 2])
            each.append(state)
            self.tell(index, after)
        part = _part(self.scene, jax.device_put(ts[done + 1 : done + count + 1]), each, after)
        fine = np.isfinite(np.asarray(part.states.position)).all(axis=(1, 2))
        fine &= np.asarray(part.bond_length_error) <= self.bond_tolerance
        fine &= ~np.asarray(_beyond(self.scene, part.states))
        fine &= np.asarray(part.residual) <= RESIDUAL_TOLERANCE
        if not fine.all() or int(after.code) != Outcome.FINE:
            self.stop(carry, done, int(np.argmin(fine)), parts, clock)
        if self.target is not None:
            self.target.append(part, after)
        return after, part

    def stop(
        self, carry: Carry, done: int, good: int, parts: list[Solution], clock: _Clock
    ) -> NoReturn:
        """Keep the `good` intervals of the chunk that are fine, then raise the error."""
        for index in range(done, done + good):
            span = np.asarray(self.ts)[index : index + 2]
            carry, states = _advance(self.stepper, self.scene, carry, span)
            parts.append(_part(self.scene, jax.device_put(span[1:]), [states], carry))
            if self.target is not None:
                self.target.append(parts[-1], carry)
        span = np.asarray(self.ts)[done + good : done + good + 2]
        after, _ = _advance(self.stepper, self.scene, carry, span)
        t0, t1 = (float(t) for t in span)
        cause = locate(self.stepper, self.scene, carry, after, t0, t1, self.bond_tolerance)
        raise SimulationError(cause, self.ended(parts, Outcome.BROKEN_DOWN, clock))

    def joined(self, parts: list[Solution], ending: Outcome, clock: _Clock) -> Solution:
        """All parts in one."""

        def column(get: Callable[[Solution], Any]) -> Any:
            return _concatenate([get(part) for part in parts])

        wall, compiling = clock.read()
        return Solution(
            column(lambda p: p.ts),
            column(lambda p: p.states),
            parts[-1].steps,
            parts[-1].code,
            column(lambda p: p.residual),
            column(lambda p: p.bond_length_error),
            wall,
            compiling,
            ending,
            name_number(self.stepper.solver.name),
        )

    def ended(self, parts: list[Solution], ending: Outcome, clock: _Clock) -> Solution:
        """The solution with which the run ends; the file notes how long it took."""
        solution = self.joined(parts, ending, clock)
        if self.target is not None:
            self.target.end(solution)
        return solution


def _concatenate(trees: list[Any]) -> Any:
    # By numpy: JAX would compile a new program for every number of parts.
    return jax.tree.map(
        lambda *x: jax.device_put(np.concatenate([np.asarray(y) for y in x])), *trees
    )
