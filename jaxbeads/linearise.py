"""The rate with its exact derivatives, for implicit solvers and root finders."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from . import carried
from ._checks import fail
from .coordinates import AbstractCoordinates
from .flow import AbstractFlow
from .flow.base import spin_and_strain, velocity_and_gradient
from .instant import (
    Solved,
    applied_load,
    derivative,
    evaluation,
    fluid_motion,
    free_motion,
    moving,
    rate,
    solved,
)
from .mobility import Product
from .pairs import PairTensor
from .programs import reached
from .saddle import (
    SaddlePoint,
    Time,
    constraint_map,
    slips,
)
from .scene import Scene
from .state import Load, Motion, State, add_loads, add_motions, spins, zero_motion


class Linearisation(NamedTuple):
    """The rate dx/dt = f(t, x) of coordinates about x = 0 at one instant, with its exact derivatives."""

    t: Float[Array, ""]
    coordinates: AbstractCoordinates
    scene: Scene
    rate: Float[Array, " numbers"]
    """f."""
    time_derivative: Float[Array, " numbers"]
    """df/dt."""
    known: Solved
    """The instant itself."""
    operator: Product
    """Its mobility."""

    def product(self, shift: Float[Array, " numbers"]) -> Float[Array, " numbers"]:
        """df/dx times a change of x, in scenes of any size: as much work as one instant whose
        multipliers are solved for with what there is.
        """
        along = jnp.zeros_like(self.t), shift
        return coordinate_derivative(self.t, self.coordinates, self.scene, self.known, along)

    def block(self, numbers: Any) -> Float[Array, "some some"]:
        """The square block of df/dx of some of the coordinates, as those of one fibre, in scenes of any
        size: one product for each of them, and nothing larger is kept.

        **Arguments**: indices of the coordinates, distinct, `(some,)`.
        """
        numbers = jnp.asarray(numbers)

        def column(number: Array) -> Array:
            return self.product(jnp.zeros_like(self.rate).at[number].set(1.0))[numbers]

        return lax.map(column, numbers).T

    def jacobian(self) -> Float[Array, "numbers numbers"]:
        """df/dx as a matrix.

        With multipliers and motion held, all columns share the factor of S that the rate needs anyway;
        the derivative of M by the positions is found for pairs (`AbstractMobility.gradient`): O(N^2)
        operations for each set of columns, and O(N^3) in matrix products only. **Raises** `ValueError`
        where the mobility is not dense.
        """
        if not self.scene.dense:
            must = "have a dense mobility for implicit solvers and steady states"
            fail("scene", must, "it has none: take `RPY(dense=True)`, or an explicit solver")
        return _jacobian(self.t, self.coordinates, self.scene, self.known, self.operator)


def coordinate_rate(
    t: Time,
    x: Float[Array, " numbers"],
    coordinates: AbstractCoordinates,
    scene: Scene,
    known: Solved | None = None,
) -> Float[Array, " numbers"]:
    """dx/dt = f(t, x); `known`: see `dynamics.rate`."""
    state = coordinates.state(x)
    return coordinates.rate(x, state, rate(t, state, scene, known))


def coordinate_derivative(
    t: Time,
    coordinates: AbstractCoordinates,
    scene: Scene,
    known: Solved,
    along: tuple[Float[Array, ""], Float[Array, " numbers"]],
) -> Float[Array, " numbers"]:
    """df at x = 0 along a time and a change of x, in a form to be differentiated once more."""
    (later, shift), x = along, coordinates.origin
    state, change = jax.jvp(coordinates.state, (x,), (shift,))
    found = evaluation(t, state, scene, known)
    moving_on = derivative(t, state, scene, found, known.solver, (later, change))

    def rate(t: Array, x: Array, moved: Motion) -> Array:
        state = coordinates.state(x)
        own = scene.own_rate(t, state)
        return coordinates.rate(x, state, moving(state, moved, scene.chain, own))

    return jax.jvp(rate, (jnp.asarray(t), x, found.motion), (later, shift, moving_on))[1]


def linearise(t: Time, coordinates: AbstractCoordinates, scene: Scene) -> Linearisation:
    """The rate of the coordinates at x = 0 with its exact derivatives.

    The saddle-point system is differentiated, not its solution: with multipliers and motion held,

        J dQdot = -(dJ Qdot + dB),   dQdot = d[M (F + J^T lambda) + V_inf + C:E] + M J^T dlambda.

    **Arguments**: time; coordinates about the state; scene. **Returns** a `Linearisation`; NaN as for
    `dynamics.evaluate`.
    """
    t, state, x = jnp.asarray(t), coordinates.start, coordinates.origin
    operator, known = scene.operator(state).kept(), solved(t, state, scene)
    moved = known.evaluation.motion

    def whole(t: Array, motion: Motion) -> Array:
        own = scene.own_rate(t, state)
        return coordinates.rate(x, state, moving(state, motion, scene.chain, own))

    system = _system(t, state, scene, known, operator)
    later = _time_derivative(t, state, scene, operator, system, moved)
    slope = jnp.zeros_like(x)
    if later is not None or state.own is not None:
        later = jax.tree.map(jnp.zeros_like, moved) if later is None else later
        slope = jax.jvp(whole, (t, moved), (jnp.ones_like(t), later))[1]
    return Linearisation(t, coordinates, scene, whole(t, moved), slope, known, operator)


def _system(
    t: Array, state: State, scene: Scene, known: Solved, operator: Product
) -> SaddlePoint | None:
    """The saddle-point system of an instant that is solved; `None` without constraints."""
    if known.solver is None:
        return None
    return SaddlePoint(operator, constraint_map(t, state, scene), known.solver)


def _jacobian(
    t: Array,
    coordinates: AbstractCoordinates,
    scene: Scene,
    known: Solved,
    operator: Product,
) -> Float[Array, "numbers numbers"]:
    """df/dx from the solution of one instant."""
    x, state, found = coordinates.origin, coordinates.start, known.evaluation
    held, system = found.motion, _system(t, state, scene, known, operator)
    units = jnp.eye(len(x), dtype=x.dtype)
    shifts = _columns(coordinates.state, x, units)
    multipliers = None if system is None else found.multipliers
    moved = _explicit_columns(t, state, shifts, scene, operator, multipliers)
    if system is not None:
        moved = _hold_columns(t, state, shifts, scene, system, held, moved)

    def turned(at: tuple[Array, State]) -> Array:
        own = scene.own_rate(t, at[1])
        return coordinates.rate(*at, moving(at[1], held, scene.chain, own))

    def still(motion: Motion) -> Array:
        return coordinates.rate(x, state, moving(state, motion, scene.chain))

    columns = jax.vmap(still)(moved) + _columns(turned, (x, state), (units, shifts))
    return columns.T


def _time_derivative(
    t: Array,
    state: State,
    scene: Scene,
    operator: Product,
    system: SaddlePoint | None,
    held: Motion,
) -> Motion | None:
    """Derivative of the motion by the time; `None` if nothing depends on it."""

    def terms(t: Array) -> tuple[Motion, Array | None]:
        slip = None if system is None else slips(t, state, scene)(held)
        return free_motion(t, state, scene, operator), slip

    if not any(reached(terms, t)):
        return None
    free, slip = jax.jvp(terms, (t,), (jnp.ones_like(t),))[1]
    if system is None or slip is None:
        return free
    slip = slip + system.constraints.linear(free)
    return add_motions(free, system.pulled(system.multipliers(slip)))


def _columns(function: Callable[[Any], Any], at: Any, shifts: Any) -> Any:
    """Derivatives of a cheap function along shifts, a leading axis."""
    _, push = jax.linearize(function, at)
    return jax.vmap(push)(shifts)


def _explicit_columns(
    t: Array,
    state: State,
    shifts: State,
    scene: Scene,
    operator: Product,
    multipliers: Array | None,
) -> Motion:
    """Derivatives of M (F + J^T lambda) + V_inf + C:E along shifts of the state, with lambda held."""

    def load(state: State) -> Load:
        applied = applied_load(t, state, scene)
        if multipliers is None:
            return applied
        return add_loads(applied, constraint_map(t, state, scene).pull(multipliers))

    still, count = zero_motion(state, scene.rotational), len(shifts.position)
    moved = jax.tree.map(lambda v: jnp.zeros((count, *v.shape), v.dtype), still)
    interactions = scene.operator(state).gradient(
        load(state),
        None if scene.flow is None else _strain(scene.flow, t, scene.chain.radius),
        shifts.position,
    )
    if interactions is not None:
        moved = add_motions(moved, interactions)
    if scene.flow is not None:
        moved = add_motions(moved, _columns(lambda s: fluid_motion(t, s, scene), state, shifts))
    # Loads that are the same everywhere, as weights, have no columns.
    parts = {name: part for name, part in vars(load(state)).items() if part is not None}
    varying = [n for n, r in zip(parts, reached(load, state), strict=True) if r]
    if varying:
        loads = _columns(lambda s: {n: getattr(load(s), n) for n in varying}, state, shifts)
        moved = add_motions(moved, jax.vmap(lambda part: operator.motion(Load(**part)))(loads))
    return moved


def _strain(flow: AbstractFlow, t: Array, radius: Array) -> Callable[[Array], Array]:
    """The ambient rate of strain at positions."""
    return lambda position: spin_and_strain(velocity_and_gradient(flow, t, position, radius)[1])[1]


def _hold_columns(
    t: Array,
    state: State,
    shifts: State,
    scene: Scene,
    system: SaddlePoint,
    held: Motion,
    moved: Motion,
) -> Motion:
    """Derivatives of the motion from those without a change of the multipliers."""
    j = system.constraints
    slip = jax.vmap(j.linear)
    turned = _columns(lambda s: slips(t, s, scene)(held), state, shifts)
    multipliers = jax.vmap(system.multipliers)(slip(moved) + turned)

    def pulled(torque: bool) -> Array:
        # M is symmetric: the motion under multipliers is what unit loads make slip.
        rows = multipliers @ slip(_unit_motions(system.operator, state, torque)).T
        return _per_bead(rows, state)

    velocity = moved.velocity + pulled(False)
    # Spins matter where they turn what the state carries.
    spin = moved.spin
    if spin is not None and carried.spun(state):
        spin = spin + pulled(True)
    return Motion(velocity, spin)


def _per_bead(rows: Array, state: State) -> Array:
    """Rows of numbers, component by component, as arrays (bead, component)."""
    return jnp.swapaxes(rows.reshape(len(rows), -1, len(state.position)), 1, 2)


def _unit_motions(operator: Product, state: State, torque: bool) -> Motion:
    """Motions under a unit force (or torque) along each component on each bead."""
    if isinstance(operator, PairTensor):
        return operator.unit_motions(torque)
    beads, dim = state.position.shape
    size = (spins(dim) if torque else dim) * beads
    units = _per_bead(jnp.eye(size, dtype=state.position.dtype), state)
    return jax.vmap(lambda u: operator.motion(Load(torque=u) if torque else Load(force=u)))(units)
