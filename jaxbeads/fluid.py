"""The fluid around the beads: its velocity anywhere, at one instant or on average over a run.

A planar scene's fluid is three-dimensional: everything here is computed in space.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._checks import fail, kind
from ._typing import float_array, with_all_digits
from .configuration import Configuration
from .domain import AbstractDomain, AbstractHalfSpace
from .dynamics import evaluate
from .fields import within
from .flow import AbstractFlow
from .flow.base import spin_and_strain, velocity_and_gradient
from .instant import Time
from .loads import handed_on
from .mobility import AbstractMobility
from .objectives import mean_over_time
from .scene import Scene
from .solution import Solution
from .state import Load, Motion, State


class FlowField(eqx.Module):
    """Velocity of the fluid at one instant, as a function of points (see `flow_field`). A pytree: it
    goes through `jit`, `vmap` and `grad`.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6 * jnp.pi])])
    >>> field = jb.flow_field(0.0, jb.State([[0.0, 0.0]]), scene)
    >>> print(isinstance(field, jb.FlowField), field(jnp.array([[0.0, 0.0]])).round(6))
    True [[ 0. -1.]]
    """

    t: Float[Array, ""]
    flow: AbstractFlow | None
    mobility: AbstractMobility
    configuration: Configuration
    """The beads in space."""
    load: Load
    strain_rate: Float[Array, "*beads 3 3"] | None
    motion: Motion
    """Of the beads, with spins in any scene."""
    dim: int = eqx.field(static=True)
    """That of the scene."""
    co_moving: bool = eqx.field(static=True)

    def __call__(self, points: Any) -> Array:
        """Velocity [length/time] at points [length], an array of any shape whose last axis has the
        components: those of the scene, or three. **Raises** `ValueError` for another number.
        """
        return self._at(points, True)

    def ambient(self, points: Any) -> Array:
        """Velocity of the undisturbed fluid, u_inf, at points, as above: as it is without the beads."""
        return self._at(points, False)

    def _at(self, points: Any, disturbed: bool) -> Array:
        points = float_array(points).astype(self.configuration.position.dtype)
        if points.ndim < 1 or points.shape[-1] not in (self.dim, 3):
            wanted = "2 or 3" if self.dim == 2 else "3"
            must = f"hold points of {wanted} components"
            fail("points", must, f"it has shape {points.shape}")
        flat = points.reshape(-1, points.shape[-1])
        return _velocity(self, flat, disturbed).reshape(points.shape)


@with_all_digits
@eqx.filter_jit
def _velocity(field: FlowField, points: Array, disturbed: bool) -> Array:
    size, here = points.shape[1], field.configuration
    points = _in_space(points)
    centre, drift = _mean(here.position), _mean(field.motion.velocity)
    if field.co_moving:
        points = points + centre
    clearance = here.domain.clearance(points, jnp.zeros((), points.dtype))
    beyond = jnp.zeros(len(points), bool) if clearance is None else clearance < 0
    at = jnp.where(beyond[:, None], here.position[:1], points)  # any place where there is fluid
    velocity = _ambient(field, at)
    if disturbed:
        velocity = _disturbed(field, at, velocity)
    velocity = jnp.where(beyond[:, None], 0.0, velocity)
    return (velocity - drift if field.co_moving else velocity)[:, :size]


def _disturbed(field: FlowField, points: Array, velocity: Array) -> Array:
    """With what the beads drive, and their own motion within them."""
    load, rate, here = field.load, field.strain_rate, field.configuration
    if load.force is not None or load.torque is not None or rate is not None:
        driven = field.mobility.fluid_velocity(here, load, rate, points)
        velocity = velocity if driven is None else velocity + driven
    count, moved = within(here, field.motion, points)
    inside = (count > 0)[:, None]
    return jnp.where(inside, moved / jnp.maximum(count, 1.0)[:, None], velocity)


def _mean(x: Float[Array, "beads 3"]) -> Float[Array, "1 3"]:
    return jnp.mean(x, axis=0, keepdims=True)


def _ambient(field: FlowField, points: Float[Array, "points 3"]) -> Float[Array, "points 3"]:
    """The undisturbed fluid. A planar flow is the same at any height z above its plane; if it gathers
    there, the fluid leaves along the normal at -z div u.
    """
    flow, dim = field.flow, field.dim
    if flow is None:
        return jnp.zeros_like(points)

    def one(x: Array) -> Array:
        if dim == 3:
            return flow.velocity(field.t, x)
        gradient = jax.jacfwd(lambda y: flow.velocity(field.t, y))(x[:2])
        return jnp.append(flow.velocity(field.t, x[:2]), -x[2] * jnp.trace(gradient))

    return jax.vmap(one)(points)


def _in_space(vectors: Float[Array, "*rows dim"]) -> Float[Array, "*rows 3"]:
    return jnp.pad(vectors, [(0, 0)] * (vectors.ndim - 1) + [(0, 3 - vectors.shape[-1])])


def _turning(spins: Float[Array, "beads spins"]) -> Float[Array, "beads 3"]:
    """Spins or torques in space: those of the plane are about its normal."""
    return jnp.pad(spins, ((0, 0), (3 - spins.shape[1], 0)))


def _straining(rate: Float[Array, "*beads dim dim"]) -> Float[Array, "*beads 3 3"]:
    """Rates of strain in space, without a trace."""
    if rate.shape[-1] == 3:
        return rate
    trace = jnp.trace(rate, axis1=-2, axis2=-1)
    rate = jnp.pad(rate, [(0, 0)] * (rate.ndim - 2) + [(0, 1), (0, 1)])
    return rate.at[..., 2, 2].set(-trace)


def _domain_in_space(domain: AbstractDomain) -> AbstractDomain:
    if not isinstance(domain, AbstractHalfSpace):
        return domain
    vectors = _in_space(domain.point), _in_space(domain.normal)
    return eqx.tree_at(lambda d: (d.point, d.normal), domain, vectors)


def flow_field(t: Time, state: State, scene: Scene, *, co_moving: bool = False) -> FlowField:
    """Velocity of the fluid anywhere at one instant,

        u(x) = u_inf(x) + sum over beads of what F_j, T_j and their resistance to strain drive,

    a function of points. Loads are all of the scene's forces and constraints, as the mobility has them,
    and u is the field whose means over the beads are its velocities: outside of the beads that of single
    spheres (`fields`), with their images in a half space, so that a no-slip wall is at rest. A point
    inside a bead moves with it, as a part of a rigid body. (Beads turn as the fluid turns them where
    the scene has no spins.) Beyond a wall or a free surface the velocity is 0.

    To the order of the mobility: the mean of u over the surface of a bead that overlaps no other is the
    bead's velocity, but u is not that velocity at each point of it, since beads feel the strain of the
    ambient flow alone, not that of one another.

    **Arguments**: time, state and scene; `co_moving`: whether points count from the mean of the beads'
    positions and velocities from the mean of theirs. **Returns** a `FlowField`: points of the scene's
    dimension, in a planar scene also of three components, `(..., dim)` [length], to velocities of the
    same shape [length/time]. Pure. **Raises** `ValueError` for a mobility that knows of no fluid
    (`FreeDraining`).

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6 * jnp.pi])])
    >>> field = jb.flow_field(0.0, jb.State([[0.0, 0.0]]), scene)
    >>> print(field(jnp.array([[1.0, 0.0], [5.0, 0.0]])).round(4))  # Stokes: 3a/(4r) + a^3/(4r^3)
    [[ 0.    -1.   ]
     [ 0.    -0.152]]
    """
    kind("scene", scene, Scene)
    kind("state", state, State)
    mobility, dim = scene.mobility, state.position.shape[1]
    spheres = Configuration(
        _in_space(state.position),
        scene.chain.radius,
        scene.viscosity,
        True,
        _domain_in_space(scene.domain),
    )
    if type(mobility).fluid_velocity is AbstractMobility.fluid_velocity:
        must = "be one that has a fluid between its beads, as `RPY`"
        fail("scene.mobility", must, f"{type(mobility).__name__} gives none")
    time = jnp.asarray(t, state.position.dtype)
    load, moved, rate = _solved(time, state, scene, spheres)
    return FlowField(time, scene.flow, mobility, spheres, load, rate, moved, dim, co_moving)


@with_all_digits
@eqx.filter_jit
def _solved(
    t: Array, state: State, scene: Scene, spheres: Configuration
) -> tuple[Load, Motion, Array | None]:
    """Loads, motion with spins, and the rate of strain at the beads, in space."""
    found = evaluate(t, state, scene)
    load = handed_on(t, state, scene, found)
    load = Load(
        None if load.force is None else _in_space(load.force),
        None if load.torque is None else _turning(load.torque),
    )
    velocity, spin, rate = _in_space(found.motion.velocity), jnp.zeros_like(spheres.position), None
    moves = []  # what turns beads that nobody asked to turn
    if scene.flow is not None:
        flow, radius = scene.flow, scene.chain.radius
        turn, strain = spin_and_strain(velocity_and_gradient(flow, t, state.position, radius)[1])
        spin, rate = spin + _turning(jnp.atleast_2d(turn)), _straining(strain)
        moves.append(scene.mobility.disturbance(spheres, rate))
    if found.motion.spin is not None:
        return load, Motion(velocity, _turning(found.motion.spin)), rate
    if load.force is not None or load.torque is not None:
        moves.append(scene.mobility.motion(spheres, load))
    spin = sum((m.spin for m in moves if m is not None), spin)
    return load, Motion(velocity, spin), rate


class AverageFlowField(eqx.Module):
    """Mean over a run of the velocity of the fluid, as a function of points (see
    `average_flow_field`).

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> fall = jb.rollout(scene, jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0], substeps=1)
    >>> field = jb.average_flow_field(fall, scene, co_moving=True)
    >>> print(isinstance(field, jb.AverageFlowField), field.co_moving)
    True True
    """

    solution: Solution
    scene: Scene
    co_moving: bool = eqx.field(static=True)

    def __call__(self, points: Any) -> Array:
        """Mean velocity [length/time] at points [length], as `FlowField`."""
        at = _At(float_array(points), self.co_moving)
        return mean_over_time(at, self.solution, self.scene)


class _At(eqx.Module):
    points: Array
    co_moving: bool = eqx.field(static=True)

    def __call__(self, t: Array, state: State, scene: Scene) -> Array:
        return flow_field(t, state, scene, co_moving=self.co_moving)(self.points)


def average_flow_field(
    solution: Solution, scene: Scene, *, co_moving: bool = False
) -> AverageFlowField:
    """Mean of `flow_field` over a solution's time, by the trapezoidal rule: of a periodic motion give
    whole periods with equal times (a `rollout` from a `periodic_state`, or `scenes.last_period`).

    **Arguments**: solution and scene; `co_moving`: as for `flow_field`, at each time anew; the mean
    far away is then minus the mean velocity of the beads. **Returns** a function of points as
    `flow_field` does. Each call solves all instants again: give it all points at once.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> fall = jb.rollout(scene, jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0], substeps=1)
    >>> far = jnp.array([[0.0, 1e9]])
    >>> print(jb.average_flow_field(fall, scene, co_moving=True)(far).round(4))  # minus the bead's
    [[0.     0.3183]]
    """
    return AverageFlowField(solution, scene, co_moving)
