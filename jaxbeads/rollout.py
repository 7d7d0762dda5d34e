"""`rollout`: a trajectory as a pure function, through which `jit`, `vmap` and `grad` go."""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ._checks import fail, increasing, kind, known, positive, whole
from ._typing import float_array, with_all_digits
from .constraint import AbstractChainConstraint
from .dynamics import constraint_residual
from .force import AbstractForce
from .loops import linked
from .scene import Scene, check
from .solution import Solution, solver_number
from .solver import AB3, AdaptiveSteps, FixedSteps, Rosenbrock
from .solver.stepping import Carry, substeps_for
from .solver.tolerance import controller_for, default_tolerance
from .state import State

Stepper = FixedSteps | AdaptiveSteps
Tolerance = Float[Array, ""] | float
_BOND_TOLERANCE = 0.01
_LAW_TOLERANCE = 0.01
_LEAST_STEP = 100


def default_solver(scene: Scene) -> diffrax.AbstractSolver:
    """`Rosenbrock` if a force of the scene is stiff (bounds explicit steps) and its mobility is dense,
    otherwise `Tsit5`."""
    if not scene.mobility.is_dense(scene.chain.beads):
        return diffrax.Tsit5()
    stiff = any(type(f).explicit_step is not AbstractForce.explicit_step for f in scene.forces)
    return Rosenbrock() if stiff else diffrax.Tsit5()


def stepper_for(
    scene: Scene,
    ts: Float[Array, " times"],
    solver: diffrax.AbstractSolver | None,
    substeps: int | None,
    controller: diffrax.AbstractStepSizeController | None,
    tolerance: Tolerance | None,
    projected: bool | None,
    max_steps: int,
) -> Stepper:
    """The stepper that the arguments of `rollout` and `simulate` mean."""
    if solver is None:
        solver = default_solver(scene) if substeps is None else AB3()
    if not isinstance(solver, diffrax.AbstractSolver):
        fail("solver", "be a diffrax solver object, as AB3()", f"it is {solver!r}")
    if isinstance(solver, Rosenbrock) and not scene.mobility.is_dense(scene.chain.beads):
        must = "be explicit (`AB3()`, `Tsit5()`) where the mobility is not dense"
        fail("solver", must, "it is Rosenbrock (`RPY(dense=True)` makes it dense at any size)")
    solver = _both_modes(solver)
    whole("max_steps", max_steps, 1)
    _check_distinct(ts)
    if tolerance is not None:
        controller = _controller(scene, ts, solver, substeps, controller, tolerance)
    elif substeps is None and controller is None and _adaptive(solver):
        controller = controller_for(default_tolerance(ts.dtype), scene.chain)
    if controller is not None:
        if substeps is not None:
            fail("substeps", "be None when a controller chooses the steps", f"it is {substeps}")
        kind("controller", controller, diffrax.AbstractStepSizeController)
        if isinstance(solver, AB3):
            fail("controller", "be None for AB3, whose steps are equal", "one is given")
        if not _adaptive(solver):
            fail(
                "solver", "estimate its error for a controller", f"{type(solver).__name__} does not"
            )
        project = not isinstance(solver, Rosenbrock) if projected is None else projected
        return AdaptiveSteps(_with_tolerances(solver, controller), controller, max_steps, project)
    if isinstance(solver, diffrax.AbstractImplicitSolver) and _missing(solver):
        must = "be given with an implicit solver, whose root finder takes its tolerances from it"
        fail("controller", must, "it is None")
    if isinstance(solver, AB3):
        _check_even(ts)
    if substeps is None:
        if not known((ts, scene)):
            must = "be given when the scene or the times are traced"
            how = "it is None: jaxbeads.solver.substeps_for(scene, ts) finds it beforehand"
            fail("substeps", must, how)
        substeps = substeps_for(scene, ts, None)
    whole("substeps", substeps, 1)
    _check_resolved(ts, substeps)
    return FixedSteps(solver, substeps, bool(projected))


def _check_distinct(ts: Array) -> None:
    """Times that differ may be the same in the precision of the state."""
    if known(ts) and not np.all(np.diff(np.asarray(ts)) > 0):
        k = int(np.argmin(np.diff(np.asarray(ts)) > 0))
        must = f"differ by more than the rounding of {ts.dtype}, in which the state is"
        fail("ts", must, f"there entries {k} and {k + 1} are both {float(ts[k]):.9g}")


def _check_even(ts: Array) -> None:
    """Equal intervals, up to the rounding of the times."""
    if not known(ts):
        return
    times = np.asarray(ts)
    single = times.astype(np.float32)
    # Times that single precision holds may come from there.
    rounding = _spacing(single if np.all(single == times) else times)
    gaps = np.diff(times)
    if np.ptp(gaps) > 1e-6 * np.max(gaps) + 4 * rounding:
        must = "be evenly spaced for AB3, whose steps are equal"
        fail("ts", must, f"its intervals range from {gaps.min():g} to {gaps.max():g}")


def _check_resolved(ts: Array, substeps: int) -> None:
    """Equal steps are differences of times, whose rounding must be a small part of them."""
    if not known(ts):
        return
    times = np.asarray(ts)
    step, rounding = float(np.min(np.diff(times))) / substeps, _spacing(times)
    if step < _LEAST_STEP * rounding:
        last = float(np.max(np.abs(times)))
        must = f"leave equal steps of at least {_LEAST_STEP} times the rounding of the times"
        but = f"the steps are {step:.3g}, and near t = {last:g} times are rounded to {rounding:.2g}"
        fail("ts", must, f"{but} in {ts.dtype} (start nearer to t = 0, or take longer steps)")


def _spacing(times: np.ndarray) -> float:
    """Distance of neighbouring numbers at the largest time."""
    return float(np.spacing(np.max(np.abs(times))))


def _both_modes(solver: diffrax.AbstractSolver) -> diffrax.AbstractSolver:
    """Runge-Kutta stages in a loop that has derivatives in forward mode too, unless it is chosen."""
    if getattr(solver, "scan_kind", "none") is None:
        return dataclasses.replace(solver, scan_kind="bounded")
    return solver


def _adaptive(solver: diffrax.AbstractSolver) -> bool:
    """Whether it estimates its error."""
    return isinstance(solver, diffrax.AbstractAdaptiveSolver)


def _controller(
    scene: Scene,
    ts: Float[Array, " times"],
    solver: diffrax.AbstractSolver,
    substeps: int | None,
    controller: diffrax.AbstractStepSizeController | None,
    tolerance: Tolerance,
) -> diffrax.AbstractStepSizeController:
    """The controller that a tolerance means; refuses what does not go with it."""
    if substeps is not None or controller is not None:
        other = "substeps" if controller is None else "a controller"
        fail("tolerance", f"be None when {other} is given", f"it is {tolerance!r}")
    if not _adaptive(solver):
        must = "be None for a solver that does not estimate its error"
        fail("tolerance", must, f"{type(solver).__name__} does not")
    positive("tolerance", tolerance)
    least = 100 * float(jnp.finfo(ts.dtype).eps)
    if known(tolerance) and not least <= tolerance <= 0.1:
        must = f"lie between {least:.1g} (rounding) and 0.1, as a fraction of the fibre's length"
        fail("tolerance", must, f"it is {tolerance:g}")
    return controller_for(tolerance, scene.chain)


def _missing(solver: diffrax.AbstractImplicitSolver) -> list[str]:
    """Settings of the root finder that `diffrax` leaves to the controller."""
    finder = solver.root_finder
    numbers = [
        n for n in ("rtol", "atol") if not isinstance(getattr(finder, n), (float, jax.Array))
    ]
    return numbers + ([] if callable(getattr(finder, "norm", None)) else ["norm"])


def _with_tolerances(
    solver: diffrax.AbstractSolver, controller: diffrax.AbstractStepSizeController
) -> diffrax.AbstractSolver:
    if not isinstance(solver, diffrax.AbstractImplicitSolver):
        return solver
    names = _missing(solver)
    return eqx.tree_at(
        lambda s: [getattr(s.root_finder, name) for name in names],
        solver,
        [getattr(controller, name) for name in names],
    )


@with_all_digits
def advance(
    stepper: Stepper, scene: Scene, carry: Carry, ts: Float[Array | np.ndarray, " times"]
) -> tuple[Carry, State]:
    """From ts[0] to ts[-1]; returns the carry there and the states at ts[1:]."""

    def interval(carry: Carry, span: tuple[Array, Array]) -> tuple[Carry, State]:
        carry = stepper.interval(scene, carry, *span, intervals=len(ts) - 1)
        return carry, carry.state

    ts = jnp.asarray(ts)
    return lax.scan(interval, carry, (ts[:-1], ts[1:]))


def rollout(
    scene: Scene,
    state: State,
    ts: Any,
    *,
    solver: diffrax.AbstractSolver | None = None,
    tolerance: Tolerance | None = None,
    substeps: int | None = None,
    controller: diffrax.AbstractStepSizeController | None = None,
    projected: bool | None = None,
    max_steps: int = 100_000,
    single_precision: bool = False,
) -> Solution:
    """Trajectory from `state` at `ts[0]`, saved at the times `ts`.

    Pure: use it under `jax.jit`, `jax.vmap` and `jax.grad` with respect to anything numeric in
    `scene`, `state` and `ts`. It cannot raise while it runs: look at `code`, which is 0 only if all
    numbers are finite, bonds kept their lengths to 1 %, and prescribed places their laws. Steps that are
    too long show there first. Constraints that depend on one another give NaN. For files, progress,
    warnings and a check on the way, use `simulate`.

    **Arguments**

    - `scene`, `state`: the model and where it starts.
    - `ts`: increasing times [time], `(times,)`; for `AB3` evenly spaced.
    - `solver`: `Rosenbrock()`, `AB3()` or any `diffrax` solver. By default what the scene needs:
      `Rosenbrock` if a force is stiff and the mobility dense, otherwise `diffrax.Tsit5`; `AB3` if
      `substeps` is given.
    - `tolerance`: largest error of a step, as a fraction of the longest fibre's length; by default 1e-6
      (float32: 1e-4). The error over a path is of the same size where neighbouring paths converge.
    - `substeps`: equal steps between two times instead. `AB3` without it takes the paper's step (39).
    - `controller`: a `diffrax` step-size controller instead.
    - `projected`: restore bond lengths after every step; by default with adaptive steps (`Rosenbrock`
      keeps them by itself).
    - `max_steps`: bound on steps between two times (with a controller).
    - `single_precision`: confirms that float32 is meant.

    **Returns** a `Solution`. **Raises** `ValueError` for input that does not fit.
    """
    check(scene, state, single_precision=single_precision)
    increasing("ts", ts)
    state = scene.begin(state)
    ts = float_array(ts).astype(state.position.dtype)
    stepper = stepper_for(scene, ts, solver, substeps, controller, tolerance, projected, max_steps)
    return _trajectory(stepper, scene, state, ts)


@eqx.filter_jit
def _trajectory(
    stepper: Stepper, scene: Scene, state: State, ts: Float[Array, " times"]
) -> Solution:
    """The core of `rollout`: one compiled program for all scenes of one shape."""
    carry = linked(stepper.init(scene, state, ts[0], ts[1]), (stepper, scene, state, ts))
    carry, states = advance(stepper, scene, carry, ts)
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), state, states)
    errors = bond_errors(scene, lax.stop_gradient(states))
    good = jnp.all(jnp.isfinite(states.position)) & (jnp.max(errors) <= _BOND_TOLERANCE)
    code = jnp.where((carry.code == 0) & ~good, 3, carry.code)
    lost = jnp.max(law_errors(scene, stepper, *lax.stop_gradient((ts, states))), initial=0.0)
    code = jnp.where((code == 0) & (lost > _LAW_TOLERANCE), 5, code)
    method = solver_number(stepper.solver)
    return Solution(ts, states, carry.steps, code, bond_length_error=errors, method=method)


def bond_errors(scene: Scene, states: State) -> Float[Array, " times"]:
    """Largest relative bond-length error of the scene's chains at each time."""

    def one(state: State) -> Array:
        error = jnp.zeros((), state.position.dtype)
        for constraint in scene.constraints:
            if isinstance(constraint, AbstractChainConstraint):
                drift = constraint.drift(state, scene.chain)
                error = jnp.maximum(error, jnp.max(jnp.abs(drift), initial=0.0))
        return error

    return jax.vmap(one)(states)


def law_errors(
    scene: Scene, stepper: Stepper, ts: Float[Array, " times"], states: State
) -> Float[Array, " constraints"]:
    """How far each constraint with a law of places is off it at most, over how far the law leads; 0 for
    others, and within what the steps' tolerance allows."""
    start, length = (ts[0], jax.tree.map(lambda x: x[0], states)), jnp.max(scene.chain.length)
    allowed = 1e-9 * length
    if isinstance(stepper, AdaptiveSteps):
        allowed = 100 * getattr(stepper.controller, "atol", 0.0) + allowed
    errors = []
    for constraint in scene.constraints:
        found = jax.vmap(lambda t, s, c=constraint: c.off_law(t, s, start, scene.chain))(ts, states)
        if found is None:
            errors.append(jnp.zeros((), ts.dtype))
            continue
        off, led = (jnp.max(jnp.abs(x), initial=0.0) for x in found)
        errors.append(jnp.maximum(off - allowed, 0.0) / jnp.maximum(led, length * 1e-9))
    return jnp.stack(errors) if errors else jnp.zeros(0, ts.dtype)


def diagnostics(
    scene: Scene, ts: Float[Array, " times"], states: State
) -> tuple[Float[Array, " times"], Float[Array, " times"]]:
    """Constraint residual and largest relative bond-length error at each time."""

    residual = lax.map(lambda at: constraint_residual(at[0], at[1], scene), (ts, states))
    return residual, bond_errors(scene, states)
