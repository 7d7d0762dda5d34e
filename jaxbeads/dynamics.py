"""The one place where mobility, constraints, forces and flow meet.

Solves, for one instant, the saddle-point system of Delmotte, Climent & Plouraboué (2015), eqs (5),
(11)-(17): Qdot = M (F + J^T lambda) + V_inf + C:E with J Qdot + B = 0.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .chain import Chain
from .coincidence import coincidence
from .constraint import AbstractConstraint
from .factors import symmetric
from .flow import AbstractFlow
from .flow.base import spin_and_strain, velocity_and_gradient
from .frames import normal_rate
from .geometry import spin_cross
from .loops import keep
from .mobility import MatrixFree, MobilityOperator
from .saddle import (
    Evaluation,
    Time,
    constraint_map,
    matrix,
    mobility_operator,
    saddle_point,
    slips,
)
from .scene import Scene, in_single
from .state import Load, Motion, State, add_loads, add_motions, zero_motion


def applied_load(t: Time, state: State, scene: Scene) -> Load:
    """Sum of the forces' loads, without those of the constraints."""
    return add_loads(*(force.load(jnp.asarray(t), state, scene.chain) for force in scene.forces))


def _fluid(flow: AbstractFlow, t: Time, state: State, scene: Scene) -> tuple[Motion, Array]:
    """Motion of the fluid, as the beads feel it, and its rate of strain."""
    velocity, gradient = velocity_and_gradient(
        flow, jnp.asarray(t), state.position, scene.chain.radius
    )
    spin, strain = spin_and_strain(gradient)
    still = zero_motion(state, scene.rotational).spin
    turned = None if still is None else jnp.broadcast_to(spin, still.shape)
    return Motion(velocity, turned), strain


def carried(t: Time, state: State, scene: Scene) -> Motion:
    """V_inf, the motion of the fluid as the beads feel it."""
    if scene.flow is None:
        return zero_motion(state, scene.rotational)
    return _fluid(scene.flow, t, state, scene)[0]


def ambient_motion(t: Time, state: State, scene: Scene) -> Motion | None:
    """V_inf + C : E, the motion of beads without load; `None` without a flow."""
    if scene.flow is None:
        return None
    fluid, strain = _fluid(scene.flow, t, state, scene)
    position, radius = state.position, scene.chain.radius
    disturbance = scene.mobility.shear_disturbance(position, radius, strain, scene.rotational)
    return fluid if disturbance is None else add_motions(fluid, disturbance)


def free_motion(t: Time, state: State, scene: Scene, operator: MobilityOperator) -> Motion:
    load, ambient = applied_load(t, state, scene), ambient_motion(t, state, scene)
    if load.force is None and load.torque is None:
        return zero_motion(state, scene.rotational) if ambient is None else ambient
    free = operator.motion(load)
    return free if ambient is None else add_motions(free, ambient)


def evaluate(t: Time, state: State, scene: Scene) -> Evaluation:
    """Motion and multipliers at one instant.

    S is factorised once. Derivatives go through the linear system (implicit function), never through
    the factorisation: they reuse the factor and differentiate J M J^T lambda for fixed lambda.

    **Arguments**: time; `State`; `Scene`. **Returns** an `Evaluation`; its numbers are NaN if S is
    singular to rounding (redundant or contradictory constraints, see `redundancy`).
    """
    return _evaluate(jnp.asarray(t), state, scene)


@eqx.filter_jit
def _evaluate(t: Time, state: State, scene: Scene) -> Evaluation:
    return _instant(t, state, scene)


@eqx.filter_custom_jvp
def _instant(t: Time, state: State, scene: Scene) -> Evaluation:
    return _free_and_held(t, state, scene)[1]


@_instant.def_jvp
def _instant_jvp(primals: Any, tangents: Any) -> tuple[Evaluation, Evaluation]:
    """With multipliers and motion held, dQdot = d[M (F + J^T lambda) + V_inf + C:E] + M J^T dlambda and
    J dQdot = -(dJ Qdot + dB): derivatives in either mode take the factor that there is."""
    t, state, scene = primals
    operator = mobility_operator(state, scene)
    system = saddle_point(t, state, scene, operator) if scene.constraints else None
    free = free_motion(t, state, scene, operator)
    evaluation = Evaluation(free, _none(state)) if system is None else system.hold(free)
    if system is not None:
        solver, evaluation = keep((system.solver, evaluation))
        system = system._replace(solver=solver)
    moved, multipliers = evaluation

    def held(t: Array, state: State, scene: Scene) -> tuple[Motion, Array]:
        load = applied_load(t, state, scene)
        if not scene.constraints:
            return _pushed(t, state, scene, load), _none(state)
        load = add_loads(load, constraint_map(t, state, scene).pull(multipliers))
        return _pushed(t, state, scene, load), slips(t, state, scene)(moved)

    still = zero_motion(state, scene.rotational), jnp.zeros_like(multipliers)
    motion, slip = eqx.combine(eqx.filter_jvp(held, primals, tangents)[1], still)
    if system is None:
        return evaluation, Evaluation(motion, slip)
    change = system.multipliers(slip + system.constraints.linear(motion))
    # Not by the operator, whose tables the backward pass would have to make again.
    pulled = _mobile(state, scene, system.constraints.pull(change))
    return evaluation, Evaluation(add_motions(motion, pulled), change)


def _none(state: State) -> Array:
    return jnp.zeros((0,), state.position.dtype)


def _pushed(t: Array, state: State, scene: Scene, load: Load) -> Motion:
    """M F + V_inf + C:E, in a form to be differentiated."""
    ambient = ambient_motion(t, state, scene)
    if load.force is None and load.torque is None:
        return zero_motion(state, scene.rotational) if ambient is None else ambient
    motion = _mobile(state, scene, load)
    return motion if ambient is None else add_motions(motion, ambient)


def _mobile(state: State, scene: Scene, load: Load) -> Motion:
    """M F, in a form to be differentiated."""
    radius, viscosity = scene.chain.radius, scene.viscosity
    return scene.mobility.motion(state.position, radius, viscosity, scene.rotational, load)


def _free_and_held(t: Time, state: State, scene: Scene) -> tuple[Motion, Evaluation]:
    """The motion without constraints, and with them."""
    operator = mobility_operator(state, scene)
    free = free_motion(t, state, scene, operator)
    if not scene.constraints:
        return free, Evaluation(free, _none(state))
    return free, saddle_point(t, state, scene, operator).hold(free)


def motion(t: Time, state: State, scene: Scene) -> Motion:
    """Velocities and spins of all beads at one instant."""
    return evaluate(t, state, scene).motion


def multipliers(t: Time, state: State, scene: Scene) -> Array:
    """Lagrange multipliers lambda of all constraints, raveled one after the other [force]."""
    return evaluate(t, state, scene).multipliers


def constraint_load(t: Time, state: State, scene: Scene) -> Load:
    """Forces and torques of the constraints, J^T lambda, eq. (11)."""
    return constraint_map(t, state, scene).pull(multipliers(t, state, scene))


def constraint_matrix(t: Time, state: State, scene: Scene) -> Float[Array, "rows rows"]:
    """S = J M J^T in full (only needed to look at it: condition, rank)."""
    return _full_matrix(jnp.asarray(t), state, scene)


@eqx.filter_jit
def _full_matrix(t: Time, state: State, scene: Scene) -> Array:
    operator = mobility_operator(state, scene)
    if isinstance(operator, MatrixFree):
        operator = operator.among(jnp.arange(scene.chain.beads))
    return symmetric(matrix(t, state, scene, operator))


@eqx.filter_jit
def _answer(t: Time, state: State, scene: Scene) -> Array:
    """Multipliers that stop some motion of the beads, whatever their loads; NaN if nothing can."""
    system = saddle_point(t, state, scene, mobility_operator(state, scene))
    still = zero_motion(state, scene.rotational)
    moved = jax.tree.map(lambda v: jnp.cos(jnp.arange(v.size)).reshape(v.shape), still)
    return system.multipliers(system.constraints.slip(moved))


def named(constraint: AbstractConstraint) -> str:
    """Its name, with the bead or bond that it is about."""
    about = (f"{x}={getattr(constraint, x)}" for x in ("bead", "bond") if hasattr(constraint, x))
    where = ", ".join(about)
    return type(constraint).__name__ + (f"({where})" if where else "")


def redundancy(t: Time, state: State, scene: Scene) -> str | None:
    """Whether the constraints depend on one another at this instant, and which of them.

    Looks at the null vectors of S, each of them a combination of rows that demands nothing new. If the
    velocities that these rows prescribe do not agree either, no motion meets them. Where the constraints
    are independent (J has no null vector) and S is singular all the same, it is since beads in one place
    move as one; then it says which.

    Where the mobility is not dense there are too many for eigenvalues: then iterations that do not
    converge tell that some depend on one another, but not which.

    **Returns** a sentence, or `None` if the constraints are independent. A host function.
    """
    if not scene.constraints:
        return None
    if not scene.mobility.is_dense(scene.chain.beads):
        if np.all(np.isfinite(_answer(jnp.asarray(t), state, scene))):
            return None
        if (how := _together(state, scene)) is not None:
            return how
        names = " + ".join(map(named, scene.constraints))
        return f"{names} depend on one another: iterations do not converge"
    matrix = np.asarray(constraint_matrix(t, state, scene))
    if matrix.size == 0:  # as one bead under `Gears`
        return None
    if not np.all(np.isfinite(matrix)):
        return f"the matrix J M J^T is not finite{in_single(matrix.dtype)}"
    scale = np.sqrt(np.abs(np.diagonal(matrix)))
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    null = vectors[:, values < 10 * len(values) * np.finfo(matrix.dtype).eps * values[-1]]
    if null.shape[1] == 0:
        return None
    time = jnp.asarray(t)
    if (how := _together(state, scene)) is not None and _pushes(time, state, scene, null):
        return how
    still = zero_motion(state, scene.rotational)
    sizes = [np.size(c.slip(time, state, still, scene.chain)) for c in scene.constraints]
    parts = np.split(np.abs(null).max(axis=1), np.cumsum(sizes)[:-1])
    names = [
        named(c)
        for c, part in zip(scene.constraints, parts, strict=True)
        if part.max(initial=0.0) > 1e-6 * np.abs(null).max()
    ]
    offset = np.asarray(slips(time, state, scene)(still)) / scale
    size = np.abs(null).T @ np.abs(offset)
    least = max(1e-8, 100 * float(np.finfo(matrix.dtype).eps))
    clash = np.any(np.abs(null.T @ offset) > least * size)
    verb = "depends" if null.shape[1] == 1 else "depend"
    how = "contradict one another" if clash else "are redundant"
    return f"{' + '.join(names)} {how}: {null.shape[1]} of their rows {verb} on the others"


def _together(state: State, scene: Scene) -> str | None:
    """Beads in one place, in words, if the mobility moves them as one."""
    if not scene.mobility.interacting:
        return None
    return coincidence(state, scene.chain, oriented=scene.oriented)


def _pushes(t: Array, state: State, scene: Scene, null: np.ndarray) -> bool:
    """Whether some multipliers, one in each column, add up to loads: not if rows are dependent."""
    pull, count = constraint_map(t, state, scene).pull, len(null)

    def squares(multipliers: np.ndarray) -> np.ndarray:
        """Sum of the squares of forces, and of torques over radii, for each column."""
        loads = jax.vmap(pull, in_axes=1)(jnp.asarray(multipliers))
        sums = np.zeros(multipliers.shape[1])
        if loads.force is not None:
            sums += np.sum(np.square(loads.force), axis=(1, 2))
        if loads.torque is not None:
            arm = np.asarray(scene.chain.radii)[None, :, None]
            sums += np.sum(np.square(np.asarray(loads.torque) / arm), axis=(1, 2))
        return sums

    alone = squares(np.eye(count, dtype=null.dtype)) @ null**2
    return bool(np.any(squares(null) > 1e-8 * alone))


def constraint_residual(t: Time, state: State, scene: Scene) -> Float[Array, ""]:
    """Norm of J Qdot + B over the number of rows and the scale of the velocities, eq. (49).

    Zero up to rounding when the multipliers do their work. The scale is the largest velocity that beads
    or their surfaces have, or would have without constraints: a fibre at rest may be held against large
    forces. Rates of turning count times the largest radius.
    """
    if not scene.constraints:
        return jnp.zeros((), state.position.dtype)
    return _residual(jnp.asarray(t), state, scene)


@eqx.filter_jit
def _residual(t: Time, state: State, scene: Scene) -> Array:
    free, (moved, _) = _free_and_held(t, state, scene)
    radius = jnp.max(scene.chain.radius)
    both = jax.tree.leaves(((moved.velocity, free.velocity), (moved.spin, free.spin)))
    sizes = [jnp.max(jnp.abs(x)) for x in both]
    scale = jnp.max(jnp.stack([*sizes[:2], *(radius * x for x in sizes[2:])]))
    scale = jnp.where(scale == 0, 1.0, scale)
    rows = [
        jnp.ravel(c.slip(jnp.asarray(t), state, moved, scene.chain))
        / scale
        * (radius if c.turning else 1.0)
        for c in scene.constraints
    ]
    slip = jnp.concatenate(rows)
    return jnp.linalg.norm(slip) / max(slip.shape[0], 1)


def rate(t: Time, state: State, scene: Scene) -> State:
    """Time derivative of the state: the right-hand side that the solvers integrate, eqs (38), (48)."""
    return moving(motion(t, state, scene), state, scene.chain)


def moving(moved: Motion, state: State, chain: Chain) -> State:
    """Rate of change of the state in a motion."""
    turning = normal_rate(state, moved.velocity, chain)
    if state.director is None:
        return State(moved.velocity, None, turning)
    if moved.spin is None:
        raise ValueError(
            "Argument `state` must hold no directors, but no term of the scene turns beads."
        )
    return State(moved.velocity, spin_cross(moved.spin, state.director), turning)
