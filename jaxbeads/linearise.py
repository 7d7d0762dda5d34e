"""The rate with its exact derivatives, for implicit solvers and root finders."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import Literal
from jaxtyping import Array, Float

from .dynamics import (
    SaddlePoint,
    Time,
    applied_load,
    constraint_map,
    free_motion,
    mobility_operator,
    moving,
    saddle_point,
    slips,
)
from .flow.base import spin_and_strain, velocity_and_gradient
from .mobility import MobilityOperator
from .scene import Scene
from .state import (
    Load,
    Motion,
    State,
    add_loads,
    add_motions,
    ravel,
    spins,
    unravel,
    zero_motion,
)
from .tensors import PairTensor


class Linearisation(NamedTuple):
    """The right-hand side f(t, Q) about one instant, raveled as `state.ravel` does."""

    rate: Float[Array, " numbers"]
    """f."""
    drift: Float[Array, " numbers"]
    """df/dt, configuration held."""
    jacobian: Float[Array, "numbers numbers"]
    """df/dQ."""


def linearise(t: Time, state: State, scene: Scene) -> Linearisation:
    """The rate with its exact derivatives, for implicit solvers.

    The saddle-point system is differentiated, not its solution: with multipliers and motion held,

        J dQdot = -(dJ Qdot + dB),   dQdot = d[M (F + J^T lambda) + V_inf + C:E] + M J^T dlambda,

    so all columns share the factor of S that the rate needs anyway. The derivative of M by the positions
    is found for pairs (`AbstractMobility.gradient`): the whole costs O(N^2) operations for the
    derivatives and O(N^3) in matrix products.
    """
    t = jnp.asarray(t)
    operator = mobility_operator(state, scene)
    system = saddle_point(t, state, scene, operator) if scene.constraints else None
    free, later = jax.jvp(
        lambda t: free_motion(t, state, scene, operator), (t,), (jnp.ones_like(t),)
    )
    if system is None:
        held, multipliers = free, None
    else:
        j = system.constraints
        held, multipliers = system.hold(free, j.slip(free))
        late = jax.jvp(lambda t: slips(t, state, scene)(held), (t,), (jnp.ones_like(t),))[1]
        later = system.hold(later, j.slip(later) - j.offset + late).motion
    moved = _explicit_columns(t, state, scene, operator, multipliers)
    if system is not None:
        moved = _hold_columns(t, state, scene, system, held, moved)
    columns = jax.vmap(lambda m: ravel(moving(m, state)))(moved)
    if state.director is not None:
        columns = columns + _columns(lambda s: ravel(moving(held, s)), state)
    return Linearisation(ravel(moving(held, state)), ravel(moving(later, state)), columns.T)


def _columns(function: Callable[[State], Any], state: State) -> Any:
    """Derivatives of a cheap function by each number of the state, as a leading axis."""
    numbers = ravel(state)
    _, push = jax.linearize(lambda x: function(unravel(x, state)), numbers)
    return jax.vmap(push)(jnp.eye(len(numbers), dtype=numbers.dtype))


def _explicit_columns(
    t: Array, state: State, scene: Scene, operator: MobilityOperator, multipliers: Array | None
) -> Motion:
    """Derivatives of M (F + J^T lambda) + V_inf + C:E with lambda held."""

    def load(state: State) -> Load:
        applied = applied_load(t, state, scene)
        if multipliers is None:
            return applied
        return add_loads(applied, constraint_map(t, state, scene).pull(multipliers))

    def flow(position: Array) -> tuple[Array, Array]:
        return velocity_and_gradient(scene.flow, t, position)

    def strain(position: Array) -> Array:
        return spin_and_strain(flow(position)[1])[1]

    position, rotational = state.position, scene.rotational
    moved = scene.mobility.gradient(
        position,
        scene.chain.radius,
        scene.viscosity,
        rotational,
        load(state),
        None if scene.flow is None else strain,
    )
    if scene.flow is not None:
        # What carries a bead depends on its own place only: one derivative by each direction.
        def carried(position: Array) -> Motion:
            velocity, gradient = flow(position)
            spin = jnp.broadcast_to(spin_and_strain(gradient)[0], (len(position), spins(dim)))
            return Motion(velocity, spin if rotational else None)

        dim = position.shape[1]
        shifts = jnp.broadcast_to(jnp.eye(dim)[:, None], (dim, *position.shape))
        slopes = jax.vmap(lambda d: jax.jvp(carried, (position,), (d,))[1])(shifts)
        each = jnp.eye(len(position), dtype=position.dtype)[:, :, None]
        slopes = jax.tree.map(
            lambda s: (each * s[:, None]).reshape(-1, *s.shape[1:]), slopes
        )
        moved = slopes if moved is None else add_motions(moved, slopes)
    count, still = ravel(state).shape[0], zero_motion(state, rotational)
    if moved is None:
        moved = jax.tree.map(lambda x: jnp.zeros((count, *x.shape), x.dtype), still)
    else:  # nothing of it depends on directors
        moved = jax.tree.map(
            lambda x: jnp.pad(x, ((0, count - len(x)), (0, 0), (0, 0))), moved
        )
    loads = _columns(lambda s: _varying(load, s), state)
    if loads.force is None and loads.torque is None:
        return moved
    return add_motions(moved, jax.vmap(operator.motion)(loads))


def _varying(load: Callable[[State], Load], state: State) -> Load:
    """The load without the part (forces, torques) that does not depend on the state at all."""
    traced = jax.make_jaxpr(lambda x: load(unravel(x, state)))(ravel(state))
    reached = set(traced.jaxpr.invars)
    for step in traced.jaxpr.eqns:
        if any(v in reached for v in step.invars if not isinstance(v, Literal)):
            reached.update(step.outvars)
    parts = {n: x for n, x in vars(load(state)).items() if x is not None}
    outcome = zip(parts.items(), traced.jaxpr.outvars, strict=True)
    return Load(**{n: x for (n, x), variable in outcome if variable in reached})


def _hold_columns(
    t: Array, state: State, scene: Scene, system: SaddlePoint, held: Motion, moved: Motion
) -> Motion:
    """Derivatives of the motion from those without a change of the multipliers."""
    j = system.constraints
    slip = jax.vmap(lambda m: j.slip(m) - j.offset)
    turned = _columns(lambda s: slips(t, s, scene)(held), state)
    multipliers = jax.vmap(system.multipliers)(slip(moved) + turned)

    def pulled(torque: bool) -> Array:
        # M is symmetric: the motion under multipliers is what unit loads make slip.
        return _per_bead(multipliers @ slip(_unit_motions(system.operator, state, torque)).T, state)

    velocity = moved.velocity + pulled(False)
    # Spins matter where they turn directors.
    spin = moved.spin if state.director is None else moved.spin + pulled(True)
    return Motion(velocity, spin)


def _per_bead(rows: Array, state: State) -> Array:
    """Rows of numbers, component by component, as arrays (bead, component)."""
    return jnp.swapaxes(rows.reshape(len(rows), -1, len(state.position)), 1, 2)


def _unit_motions(operator: MobilityOperator, state: State, torque: bool) -> Motion:
    """Motions under a unit force (or torque) along each component on each bead."""
    if isinstance(operator, PairTensor):
        return operator.unit_motions(torque)
    beads, dim = state.position.shape
    units = _per_bead(jnp.eye((spins(dim) if torque else dim) * beads), state)
    return jax.vmap(lambda u: operator.motion(Load(torque=u) if torque else Load(force=u)))(units)
