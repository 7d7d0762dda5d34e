"""`simulate`: a trajectory for people, with progress, checks, files and restart (`run` has its loop)."""

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from ._checks import fail, increasing
from ._typing import float_array
from .breakdown import SimulationError, bond_error, explain
from .contents import Contents
from .dynamics import redundancy
from .files import TrajectoryFile, compare, load, planned_times, reopen
from .outcome import Outcome
from .rollout import Solver, Stepper, Tolerance, solver_for, stepper_for
from .run import RESIDUAL_TOLERANCE, Clock, Run, part_of
from .scene import Scene, check
from .solution import Solution
from .solver import FixedSteps, explicit_step
from .state import State

_init = eqx.filter_jit(lambda stepper, *args: stepper.init(*args))


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

    The same numbers as `rollout`, computed in chunks. After each chunk, and every ten seconds, the run
    is checked: positions must be finite and bonds must keep their lengths. Ctrl-C stops it, also between
    two save times, and returns what is there; a file of it goes on from the last step. `jit`, `vmap`
    and `grad` go through `rollout` only.

    **Arguments**: as for `rollout`, and

    - `bond_tolerance`: largest relative error of a bond length before the run is stopped.
    - `overlap`: whether beads may overlap at the start.
    - `until`: a function of the solution so far; the run ends after the chunk where it is true.
    - `chunk`: save times in a chunk; shortened to a divisor of their number.
    - `file`: HDF5 file that is written while running; `resume` continues it. An older one is replaced
      once the run has begun; one that another run writes is left alone.
    - `progress`: show a bar with the time reached and the steps taken, and say beforehand what a run of
      more than about a minute will take: memory, steps, seconds.

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
    clock = Clock()
    steps = {"solver": solver, "tolerance": tolerance, "bond_tolerance": bond_tolerance}
    _refuse_traced("simulate", scene=scene, state=state, ts=ts, **steps)
    check(scene, state, overlap=overlap, single_precision=single_precision)
    _refuse_processes(scene)
    state = scene.begin(state)
    increasing("ts", ts)
    times = float_array(ts).astype(state.position.dtype)
    _refuse_traced("simulate", ts=times)
    stepper = stepper_for(scene, times, solver_for(scene, solver, tolerance, substeps))
    run = Run(scene, stepper, times, bond_tolerance, until, chunk, progress, clock)
    error, bond = bond_error(scene, state)
    if error > bond_tolerance:
        must = "hold neighbours at touching distance"
        fail("state", must, f"beads {bond} and {bond + 1} are off it by {100 * error:.3g} %")
    _warn_of_large_step(scene, stepper, times)
    if file is not None:
        run.target = TrajectoryFile.create(file, scene, stepper, times, state)
    with run:
        carry = _init(stepper, scene, state, times[0], times[1])
        first = part_of(scene, times[:1], [jax.tree.map(lambda x: x[None], state)], carry)
        if not np.all(np.isfinite(np.asarray(first.residual))):
            how = redundancy(float(times[0]), state, scene)
            if how is not None:
                must = "be independent at the start"
                fail("scene.constraints", must, how, "How do I hold an end?")
        if not np.all(np.asarray(first.residual) <= RESIDUAL_TOLERANCE):
            cause = explain(scene, state, float(times[0]), 0, None)
            run.parts = [first]
            raise SimulationError(cause, run.joined(Outcome.BROKEN_DOWN))
        if run.target is not None:
            run.target.append(first, carry)
        return run.go(carry, first, 0)


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
    clock = Clock()
    steps = {"solver": solver, "tolerance": tolerance, "bond_tolerance": bond_tolerance}
    _refuse_traced("resume", scene=scene, **steps)
    _refuse_processes(scene)
    last = load(file)
    times = planned_times(file)
    _refuse_traced("resume", file=(last, times))  # under `jit` nothing is known
    stepper = stepper_for(scene, times, solver_for(scene, solver, tolerance, substeps))
    run = Run(scene, stepper, times, bond_tolerance, until, chunk, progress, clock)
    compare(file, scene, stepper)
    like = _init(stepper, scene, last.final, times[0], times[1])
    run.target, carry = reopen(file, like)
    with run:
        first = part_of(scene, last.ts[-1:], [jax.tree.map(lambda x: x[-1:], last.states)], carry)
        return run.go(carry, first, len(last.ts) - 1)


def _refuse_traced(by: str, **arguments: Any) -> None:
    """Refuse numbers that a transformation of JAX stands for, also in a law: the host must see them."""
    for path in Contents(**arguments).traced:
        must = f"hold numbers that are known, which `{by}` must see"
        how = f"`jax.grad`, `jit` or `vmap` traces `{path}`: use `rollout`, through which they go"
        fail(re.split(r"[.\[]", path)[0], must, how, "How do I differentiate a result?")


def _refuse_processes(scene: Scene) -> None:
    """Refuse devices of several processes: how far each goes on alone is chosen by its own clock."""
    if getattr(scene.mobility, "devices", None) is not None and jax.process_count() > 1:
        must = "use devices of one process alone in `simulate`, which goes by its clock"
        fail("scene.mobility", must, f"there are {jax.process_count()}: use `rollout`")


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
