"""How the bodies of an `Assembly` move at one instant, and what they bear.

With f the loads of all beads on the fluid, M their mobility, K the map from what is not prescribed (u)
to the motions of beads, q_p the motion that is prescribed, and q_inf what the ambient flow does to free
beads,

    M f = K u + q_p - q_inf,   K^T f = K^T F + w,

with F the beads' forces and w the torques of joints and bodies. Eliminated by one Cholesky factor of M,
this is (K^T M^-1 K) u = ..., of as many rows as there are unknowns. Its derivatives are those of these
equations at their solution, so that products with M, pair by pair, are differentiated, and no factor.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ._checks import kind, positive, shape
from ._typing import float_array, with_all_digits
from .assembly import Assembly, Frames, Pose, Twists
from .body import Body
from .configuration import Configuration
from .factors import cholesky, cholesky_solve
from .flow.base import spin_and_strain, velocity_and_gradient
from .magnetism import body_load
from .mobility import RPY, AbstractMobility, Operator
from .state import Load, State, add_loads

__all__ = ["BodyMotion", "motion", "rate", "resistance"]

_RPY = RPY()


class BodyMotion(eqx.Module):
    """What one instant yields, all of it in space.

    - `velocity`: of the origin of each body's frame, `(bodies, 3)` [length/time]; `spin` [1/time].
    - `load`: force and torque of each bead on the fluid, `(beads, 3)` each [force, force length].
    - `joint_force`, `joint_torque`: of each joint on its child, `(joints, 3)`, the torque about the
      joint's point; its parent bears the opposite ones. Along a motor's axis it is the motor's torque.
    - `rate`: rate of change of the pose [length/time, 1/time].
    - `residual`: the largest force or torque that nothing balances along a motion that is not
      prescribed, over the sum of what all beads contribute to it: rounding.

    >>> import jaxbeads as jb
    >>> ball, socket = jb.body.sphere(1.0), jb.body.Weld(None, 0)
    >>> held = jb.Assembly([ball], 1.0, joints=[socket], force=[[1.0, 0.0, 0.0]])
    >>> print(jb.locomotion.motion(0.0, held.drawn, held).joint_force)  # the socket bears it
    [[-1.  0.  0.]]
    """

    velocity: Float[Array, "bodies 3"]
    spin: Float[Array, "bodies 3"]
    load: Load
    joint_force: Float[Array, "joints 3"]
    joint_torque: Float[Array, "joints 3"]
    rate: Pose
    residual: Float[Array, ""]


class _Vectors(NamedTuple):
    """Motions and loads of beads as vectors, component by component. Spins are multiplied by a length,
    torques divided by it, so that pivots do not depend on the unit of length.
    """

    length: Array

    def of_motion(self, velocity: Array, spin: Array) -> Array:
        return jnp.concatenate([velocity.T.ravel(), self.length * spin.T.ravel()])

    def of_load(self, force: Array, torque: Array) -> Array:
        return jnp.concatenate([force.T.ravel(), torque.T.ravel() / self.length])

    def load(self, vector: Array) -> Load:
        force, torque = vector.reshape(2, 3, -1)
        return Load(force.T, self.length * torque.T)

    def product(self, operator: Operator, vector: Array) -> Array:
        """M f."""
        moved = operator.motion(self.load(vector))
        still = jnp.zeros_like(moved.velocity)
        return self.of_motion(moved.velocity, still if moved.spin is None else moved.spin)

    def matrix(self, operator: Operator) -> Array:
        """M."""
        tables = operator.mobility.tables(operator.configuration)
        size = 6 * operator.configuration.beads
        if tables is None:
            units = jnp.eye(size, dtype=self.length.dtype)
            return jax.vmap(lambda unit: self.product(operator, unit))(units)
        scale = jnp.where(jnp.arange(size) < size // 2, 1.0, self.length)
        return scale[:, None] * tables.matrix() * scale[None, :]


def _rigid(arm: Array, velocity: Array, spin: Array) -> tuple[Array, Array]:
    """Motion of beads at arms from the origins of their bodies."""
    return velocity + jnp.cross(spin, arm), spin


class _Factor(NamedTuple):
    """M, factorised, without derivatives."""

    lower: Array
    regular: Array

    @classmethod
    def of(cls, matrix: Array) -> "_Factor":
        return cls(*cholesky(lax.stop_gradient(matrix)))

    def solve(self, rhs: Array) -> Array:
        """M^-1 of a vector, or of the columns of a matrix; NaN where M is not positive."""

        def solve(x: Array) -> Array:
            return cholesky_solve(self.lower, jnp.where(self.regular, x, jnp.nan))

        return solve(rhs) if rhs.ndim == 1 else jax.vmap(solve, 1, 1)(rhs)


def _small(matrix: Array, rhs: Array) -> Array:
    """Solution of a few equations with a symmetric positive matrix."""
    return _Factor.of(matrix).solve(rhs) if len(rhs) else rhs


class _System(NamedTuple):
    """An instant, ready to be solved."""

    vectors: _Vectors
    operator: Operator
    carried: Array
    """K."""

    def equations(self, both: Array) -> Array:
        """M f - K u and -K^T f, of f and u in one vector: symmetric."""
        f, u = jnp.split(both, [len(self.carried)])
        moved = self.vectors.product(self.operator, f) - self.carried @ u
        return jnp.concatenate([moved, -(self.carried.T @ f)])

    def solve(self, moved: Array, pulled: Array) -> tuple[Array, Array]:
        """f and u, whose M f - K u is `moved` and whose K^T f is `pulled`."""
        vectors, operator, k = lax.stop_gradient(self)
        factor = _Factor.of(vectors.matrix(operator))
        columns = factor.solve(k)

        def eliminated(_: Any, rhs: Array) -> Array:
            moved, pulled = jnp.split(rhs, [len(k)])
            f = factor.solve(moved)
            u = _small(k.T @ columns, -pulled - k.T @ f)
            return jnp.concatenate([f + columns @ u, u])

        rhs = jnp.concatenate([moved, -pulled])
        both = lax.custom_linear_solve(self.equations, rhs, eliminated, symmetric=True)
        f, u = jnp.split(both, [len(k)])
        return f, u


def _ambient(
    t: Array, position: Array, assembly: Assembly, operator: Operator
) -> tuple[Array, Array]:
    """Velocities and spins of beads that bear nothing."""
    if assembly.flow is None:
        return jnp.zeros_like(position), jnp.zeros_like(position)
    velocity, gradient = velocity_and_gradient(
        assembly.flow, t, position, operator.configuration.radius
    )
    spin, strain = spin_and_strain(gradient)
    spin = jnp.broadcast_to(spin, velocity.shape)
    disturbed = operator.disturbance(strain)
    if disturbed is None or disturbed.spin is None:
        return velocity, spin
    return velocity + disturbed.velocity, spin + disturbed.spin


def motion(t: Any, pose: Pose, assembly: Assembly) -> BodyMotion:
    """How all bodies move, what their beads do to the fluid, and what their joints bear.

    **Arguments**: time; where the bodies are; the assembly. **Returns** a `BodyMotion`. **Raises**
    `ValueError` for a pose of other bodies.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> falling = jb.Assembly([jb.body.rod(2)], viscosity=1.0, force=[[0.0, 0.0, -6 * jnp.pi]])
    >>> print(jb.locomotion.motion(0.0, falling.drawn, falling).velocity.round(6))  # -1/1.435356
    [[ 0.        0.       -0.696691]]
    """
    assembly.check_pose(pose)
    return _motion(float_array(t), pose, assembly)


@with_all_digits
@eqx.filter_jit
def _motion(t: Array, pose: Pose, assembly: Assembly) -> BodyMotion:
    frames = assembly.frames(pose)
    f, u, vectors, outer, residual = _solved(t, pose, assembly, frames)
    twists = assembly.twists(t, pose, frames, u)
    load = vectors.load(f)
    force, torque = _borne(assembly, frames, load, outer)
    return BodyMotion(*twists, load, force, torque, assembly.rate(t, pose, u), residual)


def rate(t: Any, pose: Pose, assembly: Assembly) -> Pose:
    """Rate of change of a pose [length/time, 1/time], which is what `travel` integrates.

    >>> import jaxbeads as jb
    >>> motor = jb.body.Motor(None, 0, axis=[0.0, 0.0, 1.0], rate=2.0)
    >>> spun = jb.Assembly([jb.body.rod(3)], 1.0, joints=[motor])
    >>> print(jb.locomotion.rate(0.0, spun.drawn, spun).turn)  # half of the spin
    [[0. 0. 0. 1.]]
    """
    assembly.check_pose(pose)
    return turning(float_array(t), pose, assembly)


def turning(t: Array, pose: Pose, assembly: Assembly) -> Pose:
    """As `rate`, without checks. Where all motion is prescribed, nothing is solved."""
    if assembly.unknowns == 0:
        return assembly.rate(t, pose, jnp.zeros(0, pose.turn.dtype))
    return _motion(t, pose, assembly).rate


class _Outer(NamedTuple):
    """Loads from outside on beads, and on bodies at the means of their beads."""

    beads: Load
    force: Array | None
    torque: Array | None


def _outer(t: Array, assembly: Assembly, position: Array, frames: Frames) -> _Outer:
    scene, state = assembly.scene, State(position)
    loads = [force.load(t, state, scene) for force in assembly.forces]
    given = (assembly.given(name, t, position.dtype) for name in ("force", "torque"))
    magnets = assembly.moment, assembly.susceptibility, assembly.field
    pulled = body_load(t, assembly.chain.centres(position), frames.rotation, *magnets)
    on_bodies = add_loads(Load(*given), pulled)
    return _Outer(add_loads(*loads), on_bodies.force, on_bodies.torque)


def given(t: Array, pose: Pose, assembly: Assembly) -> Any:
    """All that is given at a time: motions and torques of joints, loads from outside, the flow."""
    frames = assembly.frames(pose)
    position = assembly.positions(frames)
    none = jnp.zeros(assembly.unknowns, position.dtype)
    flow = assembly.flow
    return (
        assembly.twists(t, pose, frames, none),
        assembly.joint_torques(t, pose, frames),
        _outer(t, assembly, position, frames),
        None if flow is None else jax.vmap(lambda x: flow.velocity(t, x))(position),
    )


def _solved(
    t: Array, pose: Pose, assembly: Assembly, frames: Frames
) -> tuple[Array, Array, _Vectors, _Outer, Array]:
    """f, u, how f is a load, the loads from outside, and the residual."""
    position = assembly.positions(frames)
    scene = assembly.scene
    configuration = scene.configuration(State(position), True)
    operator = assembly.mobility.operator(configuration)
    length = lax.stop_gradient(jnp.max(configuration.radius))
    vectors, dtype = _Vectors(length), position.dtype
    arm = position - frames.origin[assembly.body_of_bead]
    outer = _outer(t, assembly, position, frames)

    def moved(unknown: Array) -> tuple[Array, Twists]:
        """Of beads and bodies; spins and rates of turning are multiplied by the length."""
        twists = assembly.twists(t, pose, frames, unknown / units)
        velocity, spin = (x[assembly.body_of_bead] for x in twists)
        return vectors.of_motion(*_rigid(arm, velocity, spin)), twists

    units = _units(assembly, length)
    zero = jnp.zeros(assembly.unknowns, dtype)
    (prescribed, _), push = jax.linearize(moved, zero)
    k, turned = jax.vmap(push, out_axes=(1, 0))(jnp.eye(assembly.unknowns, dtype=dtype))
    prescribed = prescribed - vectors.of_motion(*_ambient(t, position, assembly, operator))
    still = jnp.zeros_like(position)
    force, torque = (still if x is None else x for x in (outer.beads.force, outer.beads.torque))
    pulled = k.T @ vectors.of_load(force, torque)
    pulled = pulled + _powers(t, pose, assembly, frames, turned, outer, position)
    f, u = _System(vectors, operator, k).solve(prescribed, pulled)
    off = jnp.abs(k.T @ f - pulled) / jnp.maximum(jnp.abs(k.T) @ jnp.abs(f), jnp.finfo(dtype).tiny)
    return f, u / units, vectors, outer, lax.stop_gradient(jnp.max(off, initial=0.0))


def _units(assembly: Assembly, length: Array) -> Array:
    """By what each unknown is multiplied to be a velocity."""
    spins: list[bool] = []
    for body in assembly.order:
        joint = assembly.joint_of(body)
        spins += [False] * 3 + [True] * 3 if joint is None else [True] * joint.freedoms
    return jnp.where(np.array(spins, bool), length, 1.0)


def _powers(
    t: Array,
    pose: Pose,
    assembly: Assembly,
    frames: Frames,
    turned: Twists,
    outer: _Outer,
    position: Array,
) -> Array:
    """Power of what acts on bodies and in joints, for each unknown at 1."""
    power = jnp.zeros(assembly.unknowns, position.dtype)
    middle = assembly.chain.centres(position) - frames.origin
    if outer.force is not None:
        there = turned.velocity + jnp.cross(turned.spin, middle[None])
        power = power + jnp.sum(there * outer.force[None], axis=(1, 2))
    if outer.torque is not None:
        power = power + jnp.sum(turned.spin * outer.torque[None], axis=(1, 2))
    if assembly.joints:
        bodies = len(assembly.bodies)
        spin = jnp.pad(turned.spin, ((0, 0), (0, 1), (0, 0)))  # that of space, too
        spin = spin[:, :bodies] - spin[:, assembly.parents]
        torque = assembly.joint_torques(t, pose, frames)
        power = power + jnp.sum(spin * torque[None], axis=(1, 2))
    return power


def _borne(assembly: Assembly, frames: Frames, load: Load, outer: _Outer) -> tuple[Array, Array]:
    """Force and torque of each joint on its child: what all that hangs on it needs for its motion."""
    position = assembly.positions(frames)
    if not assembly.joints:
        none = jnp.zeros((0, 3), position.dtype)
        return none, none
    needed = [load.force, load.torque]
    given = [outer.beads.force, outer.beads.torque]
    force, torque = (
        x if y is None else x - y for x, y in zip(needed, given, strict=True) if x is not None
    )
    child = np.array([joint.child for joint in assembly.joints])
    hanging = assembly.above[:, child].T
    at = assembly.joint_places(frames)[child]

    def summed(of: np.ndarray, place: Array, force: Array, torque: Array) -> tuple[Array, Array]:
        """Of some, the force and its torque about each joint."""
        weights, arm = jnp.asarray(of, position.dtype), place[None] - at[:, None]
        twist = torque[None] + jnp.cross(arm, force[None])
        return weights @ force, jnp.einsum("jk,jkd->jd", weights, twist)

    push, twist = summed(hanging[:, assembly.body_of_bead], position, force, torque)
    if outer.force is None and outer.torque is None:
        return push, twist
    still = jnp.zeros_like(frames.origin)
    outside = (still if x is None else x for x in (outer.force, outer.torque))
    less = summed(hanging, assembly.chain.centres(position), *outside)
    return push - less[0], twist - less[1]


def resistance(
    body: Body, viscosity: Any = 1.0, mobility: AbstractMobility = _RPY, about: Any = None
) -> Float[Array, "6 6"]:
    """Resistance K^T M^-1 K of a body, which maps (velocity, spin) to (force, torque).

    **Arguments**: body; mu; mobility; the point whose velocity is meant and about which torques are, in
    the body's frame, by default its origin. **Returns** a matrix in units of [force time/length], with a
    length more for each spin and each torque. It has derivatives by all numbers in both modes.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> print((jb.locomotion.resistance(jb.body.sphere(2.0))[0, 0] / jnp.pi).round(6))  # 6 mu R
    12.0
    """
    kind("body", body, Body)
    about = float_array(jnp.zeros(3) if about is None else about)
    shape("about", about, (3,))
    viscosity = float_array(viscosity)
    shape("viscosity", viscosity, ())
    positive("viscosity", viscosity)
    return _resistance(body, viscosity, mobility, about)


@with_all_digits
@eqx.filter_jit
def _resistance(body: Body, viscosity: Array, mobility: AbstractMobility, about: Array) -> Array:
    operator = mobility.operator(Configuration(body.position, body.radius, viscosity, True))
    vectors = _Vectors(lax.stop_gradient(jnp.max(body.radius)))
    arm = body.position - about[None]

    def column(unit: Array) -> Array:
        spin = jnp.broadcast_to(unit[3:], arm.shape)
        return vectors.of_motion(*_rigid(arm, unit[None, :3], spin))

    k = jax.vmap(column, out_axes=1)(jnp.eye(6, dtype=arm.dtype))
    factor = _Factor.of(vectors.matrix(operator))

    def product(columns: Array) -> Array:
        return jax.vmap(lambda f: vectors.product(operator, f), 1, 1)(columns)

    def solve(_: Any, rhs: Array) -> Array:
        return factor.solve(rhs)

    return k.T @ lax.custom_linear_solve(product, k, solve, symmetric=True)
