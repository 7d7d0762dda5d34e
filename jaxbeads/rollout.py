"""`rollout`: a trajectory as a pure function, through which `jit`, `vmap` and `grad` go."""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ._checks import described, fail, increasing, known
from ._typing import float_array, with_all_digits
from .constraint import AbstractChainConstraint
from .dynamics import constraint_residual
from .loops import linked
from .mobility import AbstractMobility
from .outcome import Outcome
from .scene import Scene, check
from .solution import Solution, name_number
from .solver import AB3, ESDIRK, AbstractSolver, AdaptiveSteps, Diffrax, FixedSteps, Rosenbrock
from .solver.base import plain
from .solver.explicit import substeps_for
from .solver.stepping import Carry
from .solver.tolerance import default_tolerance
from .state import State

Stepper = FixedSteps | AdaptiveSteps
Solver = AbstractSolver | diffrax.AbstractSolver
Tolerance = Float[Array, ""] | float
_BOND_TOLERANCE = 0.01
_LAW_TOLERANCE = 0.01
_LEAST_STEP = 100
_MANY = 100
"""Beads of several fibres from which on `ESDIRK` is the default."""


def default_solver(scene: Scene) -> AbstractSolver:
    """`Tsit5` if no force of the scene is stiff; otherwise `Rosenbrock`, or `ESDIRK` where the mobility
    is not dense, and for several fibres of many beads in all.
    """
    if not any(force.stiff for force in scene.forces):
        return Diffrax(diffrax.Tsit5())
    several = len(scene.chain.fibres) > 1 and scene.chain.beads >= _MANY
    # Constraints along whole fibres beside the chain's have more rows than iterations carry.
    in_parts = not any(
        (c.internal or c.links) and not isinstance(c, AbstractChainConstraint)
        for c in scene.constraints
    )
    in_parts = in_parts and type(scene.mobility).tables is not AbstractMobility.tables
    return ESDIRK() if not scene.dense or (several and in_parts) else Rosenbrock()


def solver_for(
    scene: Scene, solver: Solver | None, tolerance: Tolerance | None, substeps: int | None
) -> AbstractSolver:
    """The solver that the arguments of `rollout` and `simulate` mean: `tolerance` and `substeps` are
    shorthands for the options of a solver that has none yet.
    """
    if isinstance(solver, AbstractSolver):
        for name, value in {"tolerance": tolerance, "substeps": substeps}.items():
            if value is not None:
                must = f"be None beside a solver, whose own option it is (`{type(solver).__name__}"
                fail(name, f"{must}(..., {name}=...)`)", f"it is {plain(value)}")
        return solver
    if isinstance(solver, diffrax.AbstractSolver):
        return Diffrax(solver, tolerance=tolerance, substeps=substeps)
    if solver is not None:
        must = "be a solver object, as AB3() or diffrax.Tsit5()"
        fail("solver", must, f"it is {described(solver)}")
    if substeps is None:
        return dataclasses.replace(default_solver(scene), tolerance=tolerance)
    if tolerance is not None:
        fail("tolerance", "be None when substeps is given", f"it is {plain(tolerance)}")
    return AB3(substeps=substeps)


def stepper_for(scene: Scene, ts: Float[Array, " times"], solver: AbstractSolver) -> Stepper:
    """The stepper of a solver in a scene: all its options have values there."""
    if solver.needs_matrix and not scene.dense:
        must = "be `ESDIRK()` or explicit (`AB3()`, `Tsit5()`) where the mobility is not dense"
        fail("solver", must, f"it is {solver.name} (`RPY(dense=True)` makes it dense at any size)")
    _check_distinct(ts)
    if solver.substeps is None and solver.estimates_error:
        return _adaptive(scene, ts, solver)
    if solver.equal_steps:
        _check_even(ts, solver.name)
    substeps = solver.substeps
    if substeps is None:
        if not known((ts, scene)):
            must = "be given when the scene or the times are traced"
            how = "it is None: jaxbeads.solver.substeps_for(scene, ts) finds it beforehand"
            fail("substeps", must, how)
        substeps = substeps_for(scene, ts, None)
    _check_resolved(ts, substeps)
    return FixedSteps(
        dataclasses.replace(solver, substeps=substeps, projected=bool(solver.projected))
    )


def _adaptive(scene: Scene, ts: Float[Array, " times"], solver: AbstractSolver) -> AdaptiveSteps:
    """Steps chosen by a controller, or by the tolerance that stands for one."""
    tolerance, controller, projected = solver.tolerance, solver.controller, solver.projected
    if controller is None:
        tolerance = default_tolerance(ts.dtype) if tolerance is None else tolerance
        least = 100 * float(jnp.finfo(ts.dtype).eps)
        # By numpy: under `jit` JAX would trace the comparison of known numbers too.
        if known(tolerance) and not least <= np.asarray(tolerance) <= 0.1:
            must = (
                f"lie between {least:.1g} (rounding) and 0.1, as a fraction of the fibre's length"
            )
            fail("tolerance", must, f"it is {plain(tolerance)}", "How do I choose a tolerance?")
        tolerance = jnp.asarray(tolerance, ts.dtype)
        controller = solver.controlled(tolerance, scene.chain)
    projected = not solver.keeps_bonds if projected is None else projected
    solver = dataclasses.replace(solver, tolerance=tolerance, projected=bool(projected))
    return AdaptiveSteps(solver.tuned(controller), controller)


def _check_distinct(ts: Array) -> None:
    """Times that differ may be the same in the precision of the state."""
    if known(ts) and not np.all(np.diff(np.asarray(ts)) > 0):
        k = int(np.argmin(np.diff(np.asarray(ts)) > 0))
        must = f"differ by more than the rounding of {ts.dtype}, in which the state is"
        fail("ts", must, f"there entries {k} and {k + 1} are both {float(ts[k]):.9g}")


def _check_even(ts: Array, name: str) -> None:
    """Equal intervals, up to the rounding of the times."""
    if not known(ts):
        return
    times = np.asarray(ts)
    single = times.astype(np.float32)
    # Times that single precision holds may come from there.
    rounding = _spacing(single if np.all(single == times) else times)
    gaps = np.diff(times)
    if np.ptp(gaps) > 1e-6 * np.max(gaps) + 4 * rounding:
        must = f"be evenly spaced for {name}, whose steps are equal"
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
    solver: Solver | None = None,
    tolerance: Tolerance | None = None,
    substeps: int | None = None,
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
    - `solver`: with its own options, as `Rosenbrock(tolerance=1e-8)`, `AB3(substeps=50)` or
      `Diffrax(diffrax.Tsit5(), projected=False)`; see `solver.AbstractSolver`. A bare `diffrax` solver
      has the usual ones. By default what the scene needs: `Rosenbrock` if a force is stiff (`ESDIRK`
      for several fibres of 100 beads in all, and above 1000 beads), otherwise `diffrax.Tsit5`.
    - `tolerance`: short for that solver's: largest error of a step, as a fraction of the longest fibre's
      length; by default 1e-6 (float32: 1e-4). The error over a path is of the same size where
      neighbouring paths converge.
    - `substeps`: short for `AB3(substeps=...)`, or for that of a bare `diffrax` solver: equal steps
      between two times instead. `AB3` without it takes the paper's step (39).
    - `single_precision`: confirms that float32 is meant.

    **Returns** a `Solution`. **Raises** `ValueError` for input that does not fit.

    >>> import jax
    >>> import jaxbeads as jb
    >>> state, ts = jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0]
    >>> def fall(weight):
    ...     scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -weight])])
    ...     return jb.rollout(scene, state, ts, substeps=1).final.position[0, 1]
    >>> print(f"{fall(6.0):.4f}, {jax.grad(fall)(6.0):.4f}")  # -W t/(6 pi mu a), and its derivative
    -0.6366, -0.1061
    """
    check(scene, state, single_precision=single_precision)
    increasing("ts", ts)
    state = scene.begin(state)
    ts = float_array(ts).astype(state.position.dtype)
    stepper = stepper_for(scene, ts, solver_for(scene, solver, tolerance, substeps))
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
    good = good & ~jnp.any(beyond(scene, states))
    code = jnp.where((carry.code == Outcome.FINE) & ~good, Outcome.BROKEN, carry.code)
    lost = jnp.max(law_errors(scene, stepper, *lax.stop_gradient((ts, states))), initial=0.0)
    code = jnp.where((code == Outcome.FINE) & (lost > _LAW_TOLERANCE), Outcome.OFF_ITS_LAW, code)
    method = name_number(stepper.solver.name)
    return Solution(ts, states, carry.steps, code, bond_length_error=errors, method=method)


def beyond(scene: Scene, states: State) -> Bool[Array, " times"]:
    """Whether a bead is beyond the boundary of the domain, at each time."""

    def one(state: State) -> Array:
        outside = scene.outside(state)
        return jnp.zeros((), bool) if outside is None else jnp.any(outside)

    return jax.vmap(one)(states)


def bond_errors(scene: Scene, states: State) -> Float[Array, " times"]:
    """Largest relative bond-length error of the scene's chains at each time."""
    return jax.vmap(lambda s: jnp.max(jnp.abs(scene.bond_errors(s)), initial=0.0))(states)


def law_errors(
    scene: Scene, stepper: Stepper, ts: Float[Array, " times"], states: State
) -> Float[Array, " constraints"]:
    """How far each constraint with a law of places is off it at most, over how far the law leads; 0 for
    others, and within what the steps' tolerance allows.
    """
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
