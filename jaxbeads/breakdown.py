"""Why a run broke down: the step, the bead and the term, in a sentence that says what to do."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .dynamics import redundancy
from .faults import REMEDY, Fault, not_finite, not_smooth
from .force import Contact
from .geometry import smallest_gap
from .outcome import Outcome
from .rollout import Stepper, default_solver
from .scene import Scene, in_single
from .solution import Solution
from .solver import AB3, AdaptiveSteps, FixedSteps, explicit_step
from .solver.stepping import Carry
from .state import Load, State

_RECIPE = "How do I find out why it stopped?"


@dataclass(frozen=True)
class Cause:
    """Where and why: number of the step, time at its start, bead, name of the term, sentence."""

    step: int
    time: float
    bead: int | None
    term: str
    message: str


class SimulationError(RuntimeError):
    """A run that broke down. `cause` says where and why: `step`, `time`, `bead`, `term` and `message`;
    `solution` ends with the last good state.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> push = jb.force.ForceField(lambda t, r: jnp.log(1.5 - t) * jnp.ones_like(r))
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[push])
    >>> try:
    ...     jb.simulate(scene, jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0], substeps=1, progress=False)
    ... except jb.SimulationError as error:
    ...     print(error.cause.term, error.solution.ts)
    ForceField [0. 1.]
    """

    def __init__(self, cause: Cause, solution: Solution) -> None:
        super().__init__(cause.message)
        self.cause = cause
        self.solution = solution

    def __reduce__(self) -> tuple[Any, ...]:
        # By its arguments, not by its text: copies, and other processes, make it anew from them.
        return type(self), (self.cause, self.solution), self.__dict__


@eqx.filter_jit
def _bond_errors(scene: Scene, state: State) -> Array:
    return scene.bond_errors(state)


def bond_error(scene: Scene, state: State) -> tuple[float, int]:
    """Largest relative bond-length error and the bond where it is."""
    if scene.chain.beads < 2:
        return 0.0, 0
    errors = np.abs(np.asarray(_bond_errors(scene, state)))
    at = int(np.argmax(errors))
    return float(errors[at]), at


def _size(load: Load) -> float:
    parts = [np.abs(np.asarray(x)) for x in (load.force, load.torque) if x is not None]
    return max((float(x.max()) for x in parts), default=0.0)


def guilty_term(t: float, state: State, scene: Scene, derivatives: bool = False) -> Fault:
    """The term that fails at this state, or whose load is largest, and how it fails; `derivatives`:
    whether they are needed.
    """
    if (fault := not_finite(t, state, scene)) is not None:
        return fault
    if (how := redundancy(t, state, scene)) is not None:
        return Fault(" + ".join(type(c).__name__ for c in scene.constraints), how)
    if derivatives and (fault := not_smooth(t, state, scene)) is not None:
        return fault
    sizes = {}
    for index, force in enumerate(scene.forces):
        load = _size(scene.load_of(index, t, state))
        sizes[type(force).__name__] = max(load, sizes.get(type(force).__name__, 0.0))
    largest = max(sizes, key=lambda name: sizes[name], default="")
    if not largest or sizes[largest] == 0:
        return Fault("time step", "")
    return Fault(largest, f"it has the largest load, {sizes[largest]:.3g}")


def _smallest_gap(scene: Scene, state: State) -> str:
    radii = np.asarray(scene.chain.radii)
    if len(radii) < 2:
        return ""
    gap, i, j = smallest_gap(np.asarray(state.position), radii, scene.domain)
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
    derivatives: bool = False,
) -> Cause:
    """The cause from the last good state, at time t, and what the step from there made of it (or, if
    there is no such state, `what` happened); `derivatives`: whether the step needed them.
    """
    what = what or f"the motion is not finite{in_single(good.position.dtype)}"
    term, how, bead, derivative = guilty_term(t, good, scene, derivatives)
    if derivative:
        what, advice = "the linear equations of a step are not finite", f" {REMEDY}"
    elif bad is not None:
        finite = np.isfinite(np.asarray(bad.position)).all(axis=1)
        error, bond = bond_error(scene, bad)
        if not finite.all():
            bead = int(np.argmin(finite)) if bead is None else bead
            what = f"bead {int(np.argmin(finite))} has no finite position{in_single(bad.position.dtype)}"
        elif (outside := scene.outside(bad)) is not None and np.any(np.asarray(outside)):
            bead = int(np.argmax(np.asarray(outside)))
            what = (
                f"bead {bead} is beyond the {type(scene.domain).__name__} (`Contact` keeps it off)"
            )
        elif error > 0:
            bead = bond
            what = (
                f"the bond of beads {bond} and {bond + 1} is off its length by {100 * error:.2g} %"
            )
    message = (
        f"The run broke down at step {step} (t = {t:.6g}): {what}. Term: {term}"
        f"{', ' + how if how else ''}.{_smallest_gap(scene, good)}{advice} The last good state is the "
        "end of this error's `solution` (and of the file, if there is one); see "
        f'"{_RECIPE}" in the recipes.'
    )
    return Cause(step, t, bead, term, message)


def step_advice(scene: Scene, step: float, stepper: FixedSteps) -> str:
    """What the time step has to do with it."""
    limit = float(explicit_step(scene))
    if not np.isfinite(limit) or stepper.solver.implicit:
        return f" The time step was {step:.3g}; try more `substeps`, or `tolerance` instead."
    return (
        f" The time step was {step:.3g}, {step / limit:.3g} times `solver.explicit_step`, eq. (39) for "
        f"bending (AB3 is stable to about {AB3.stable_to:g} times); use more `substeps`, or `tolerance` "
        "instead."
    )


_step = eqx.filter_jit(lambda stepper, *args: stepper.step(*args))


def _given_up(stepper: AdaptiveSteps, scene: Scene, after: Carry, t0: float, t1: float) -> Cause:
    """Why adaptive steps did not reach the end of an interval."""
    last, step = after.memory, float(after.memory.next - after.memory.previous)
    if int(after.code) == Outcome.TOO_MANY_STEPS:
        what = (
            f"{stepper.max_steps} steps from t = {t0:.6g} did not reach the next save time, {t1:.6g} "
            f"(the last was {step:.2g})"
        )
        advice = " Loosen `tolerance`, raise `max_steps` or save more often."
        default = default_solver(scene)
        if default.implicit and not stepper.solver.implicit:
            advice += (
                f" The scene is stiff: `{default.name}()`, its default solver, takes longer steps."
            )
    else:
        what = f"no step, down to {step:.2g}, meets the tolerance with finite numbers"
        advice = " Loosen `tolerance`, or look at the term named here."
        rounding = float(np.spacing(np.abs(np.asarray(last.previous))))
        if 0 <= step <= 4 * rounding and rounding > 1e-9 * (t1 - t0):
            advice += (
                f" Times near t = {t0:g} are rounded to {rounding:.2g}: start nearer to t = 0."
            )
    time, steps, implicit = float(last.previous), int(after.steps), stepper.solver.needs_derivatives
    return explain(scene, last.state, time, steps, None, advice, what, implicit)


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
    again, one by one, to see where.
    """
    if not isinstance(stepper, FixedSteps):
        if int(after.code) != Outcome.FINE:
            return _given_up(stepper, scene, after, t0, t1)
        return explain(scene, carry.state, t0, int(after.steps), after.state)
    h, implicit = (t1 - t0) / stepper.substeps, stepper.solver.needs_derivatives
    start, end = (jnp.asarray(t, carry.state.position.dtype) for t in (t0, t1))
    for index in range(int(carry.taken), stepper.substeps):
        new = _step(stepper, scene, carry, start, end, jnp.asarray(index))
        error, _ = bond_error(scene, new.state)
        outside = scene.outside(new.state)
        inside = outside is None or not np.any(np.asarray(outside))
        fine = inside and np.all(np.isfinite(new.state.position)) and error <= bond_tolerance
        if not fine:
            advice = step_advice(scene, h, stepper)
            good, at = carry.state, t0 + index * h
            return explain(
                scene, good, at, int(carry.steps), new.state, advice, derivatives=implicit
            )
        carry = new
    return explain(
        scene, carry.state, t1, int(carry.steps), carry.state, step_advice(scene, h, stepper)
    )
