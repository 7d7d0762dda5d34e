"""Why a run broke down: the step, the bead and the term, in a sentence that says what to do."""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .constraint import AbstractChainConstraint
from .dynamics import ambient_motion, carried, redundancy
from .force import Contact
from .geometry import smallest_gap
from .rollout import Solution, Stepper, default_solver
from .scene import Scene, in_single
from .solver import AdaptiveSteps, FixedSteps, Rosenbrock, explicit_step
from .solver.stepping import Carry
from .state import Load, State


@dataclass(frozen=True)
class Cause:
    """Where and why: number of the step, time at its start, bead, name of the term, sentence."""

    step: int
    time: float
    bead: int | None
    term: str
    message: str


class SimulationError(RuntimeError):
    """A run that broke down. `cause` says where and why; `solution` ends with the last good state."""

    def __init__(self, cause: Cause, solution: Solution) -> None:
        super().__init__(cause.message)
        self.cause = cause
        self.solution = solution


def bond_error(scene: Scene, state: State) -> tuple[float, int]:
    """Largest relative bond-length error and the bond where it is."""
    worst, at = 0.0, 0
    for constraint in scene.constraints:
        if isinstance(constraint, AbstractChainConstraint) and scene.chain.beads > 1:
            drift = np.abs(np.asarray(constraint.drift(state, scene.chain)))
            if not drift.max() <= worst:
                worst, at = float(drift.max()), int(np.argmax(drift))
    return worst, at


def _size(load: Load) -> float:
    parts = [np.abs(np.asarray(x)) for x in (load.force, load.torque) if x is not None]
    return max((float(x.max()) for x in parts), default=0.0)


def guilty_term(t: float, state: State, scene: Scene) -> tuple[str, str]:
    """Name of the term that fails at this state, or that is largest, and how it fails."""
    largest, size = "", 0.0
    for force in scene.forces:
        name, value = type(force).__name__, _size(force.load(jnp.asarray(t), state, scene.chain))
        if not np.isfinite(value):
            return name, "its load is not finite"
        if value > size:
            largest, size = name, value
    ambient = ambient_motion(t, state, scene)
    if ambient is not None and not np.all(np.isfinite(ambient.velocity)):
        if np.all(np.isfinite(carried(t, state, scene).velocity)):
            return type(
                scene.mobility
            ).__name__, "what beads do to one another in the flow is not finite"
        return type(scene.flow).__name__, "its velocity is not finite"
    if (how := redundancy(t, state, scene)) is not None:
        return " + ".join(type(c).__name__ for c in scene.constraints), how
    return (largest, f"it has the largest load, {size:.3g}") if largest else ("time step", "")


def _smallest_gap(scene: Scene, state: State) -> str:
    radii = np.asarray(scene.chain.radii)
    if len(radii) < 2:
        return ""
    gap, i, j = smallest_gap(np.asarray(state.position), radii)
    found = f" The smallest gap is {gap:.3g} (beads {i} and {j})."
    if gap < -0.1 * radii.min() and not any(isinstance(f, Contact) for f in scene.forces):
        found += " They pass through one another: `Contact` keeps beads apart."
    return found


def explain(
    scene: Scene,
    good: State,
    t: float,
    step: int,
    bad: State | None,
    advice: str = "",
    what: str = "",
) -> Cause:
    """The cause from the last good state, at time t, and what the step from there made of it (or, if
    there is no such state, `what` happened)."""
    term, how = guilty_term(t, good, scene)
    bead, what = None, what or f"the motion is not finite{in_single(good.position.dtype)}"
    if bad is not None:
        finite = np.isfinite(np.asarray(bad.position)).all(axis=1)
        error, bond = bond_error(scene, bad)
        if not finite.all():
            bead = int(np.argmin(finite))
            what = f"bead {bead} has no finite position{in_single(bad.position.dtype)}"
        elif error > 0:
            bead = bond
            what = (
                f"the bond of beads {bond} and {bond + 1} is off its length by {100 * error:.2g} %"
            )
    message = (
        f"The run broke down at step {step} (t = {t:.6g}): {what}. Term: {term}"
        f"{', ' + how if how else ''}.{_smallest_gap(scene, good)}{advice} The last good state is the "
        "end of this error's `solution` (and of the file, if there is one)."
    )
    return Cause(step, t, bead, term, message)


def step_advice(scene: Scene, step: float, stepper: FixedSteps) -> str:
    """What the time step has to do with it."""
    limit = float(explicit_step(scene))
    if not np.isfinite(limit) or isinstance(stepper.solver, Rosenbrock):
        return f" The time step was {step:.3g}; try more `substeps`, or `tolerance` instead."
    return (
        f" The time step was {step:.3g}, {step / limit:.3g} times `solver.explicit_step`, eq. (39) for "
        "bending (AB3 is stable to about 2.2 times); use more `substeps`, or `tolerance` instead."
    )


_step = eqx.filter_jit(lambda stepper, *args: stepper.step(*args))


def _given_up(stepper: AdaptiveSteps, scene: Scene, after: Carry, t0: float, t1: float) -> Cause:
    """Why adaptive steps did not reach the end of an interval."""
    last, step = after.memory, float(after.memory.next - after.memory.previous)
    if int(after.code) == 1:
        what = (
            f"{stepper.max_steps} steps from t = {t0:.6g} did not reach the next save time, {t1:.6g} "
            f"(the last was {step:.2g})"
        )
        advice = " Loosen `tolerance`, raise `max_steps` or save more often."
        if isinstance(default_solver(scene), Rosenbrock) != isinstance(stepper.solver, Rosenbrock):
            advice += " The scene is stiff: `Rosenbrock()`, its default solver, takes longer steps."
    else:
        what = f"no step, down to {step:.2g}, meets the tolerance with finite numbers"
        advice = " Loosen `tolerance`, or look at the term named here."
        rounding = float(np.spacing(np.abs(np.asarray(last.previous))))
        if 0 <= step <= 4 * rounding and rounding > 1e-9 * (t1 - t0):
            advice += (
                f" Times near t = {t0:g} are rounded to {rounding:.2g}: start nearer to t = 0."
            )
    return explain(scene, last.state, float(last.previous), int(after.steps), None, advice, what)


def locate(
    stepper: Stepper,
    scene: Scene,
    carry: Carry,
    after: Carry,
    t0: float,
    t1: float,
    bond_tolerance: float,
) -> Cause:
    """Why the run broke down in the interval from t0 (`carry`) to t1 (`after`). Equal steps are taken
    again, one by one, to see where."""
    if not isinstance(stepper, FixedSteps):
        if int(after.code) != 0:
            return _given_up(stepper, scene, after, t0, t1)
        return explain(scene, carry.state, t0, int(after.steps), after.state)
    h = (t1 - t0) / stepper.substeps
    start, end = (jnp.asarray(t, carry.state.position.dtype) for t in (t0, t1))
    for index in range(stepper.substeps):
        new = _step(stepper, scene, carry, start, end, jnp.asarray(index))
        error, _ = bond_error(scene, new.state)
        fine = np.all(np.isfinite(new.state.position)) and error <= bond_tolerance
        if not fine:
            advice = step_advice(scene, h, stepper)
            return explain(scene, carry.state, t0 + index * h, int(carry.steps), new.state, advice)
        carry = new
    return explain(
        scene, carry.state, t1, int(carry.steps), carry.state, step_advice(scene, h, stepper)
    )
