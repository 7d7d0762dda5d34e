"""`Assembly`: rigid bodies and joints in a viscous fluid; `Pose`: where they are."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import quaternions
from ._checks import fail, finite, kind, shape
from ._functions import check_law, law_of, leaf_function
from ._typing import float_array, optional_float_array
from .body import AbstractJoint, Body
from .chain import Chain
from .domain import AbstractDomain, Unbounded
from .flow import AbstractFlow
from .force import AbstractForce
from .magnetism import AbstractMagneticField, check_magnets, optional_magnetic_field
from .mobility import RPY, AbstractMobility
from .scene import Scene
from .state import State

_DIM = 3


class Pose(eqx.Module):
    """Where bodies of an assembly are, in as few numbers as their joints leave: joints hold exactly.

    **Arguments**

    - `place`: of each body that no joint holds, in their order, the origin of its frame, `(free, 3)`
      [length].
    - `turn`: the rotation of each body since it was drawn, `(bodies, 4)`: quaternions (w, x, y, z) of
      any length; of a joint's child against its parent, in the parent's frame, else in space.

    >>> import jaxbeads as jb
    >>> pose = jb.Assembly([jb.body.sphere(1.0)], viscosity=1.0).drawn
    >>> print(pose.place, pose.turn)
    [[0. 0. 0.]] [[1. 0. 0. 0.]]
    """

    place: Float[Array, "free 3"] = eqx.field(converter=float_array)
    turn: Float[Array, "bodies 4"] = eqx.field(converter=float_array)


class Frames(NamedTuple):
    """The frames of all bodies in space."""

    origin: Float[Array, "bodies 3"]
    rotation: Float[Array, "bodies 3 3"]

    def point(self, body: int | None, x: Array) -> Array:
        """A point of a body's frame in space; space has its own."""
        return x if body is None else self.origin[body] + self.rotation[body] @ x

    def vector(self, body: int | None, x: Array) -> Array:
        """A vector of a body's frame in space."""
        return x if body is None else self.rotation[body] @ x


class Twists(NamedTuple):
    """How all bodies move."""

    velocity: Float[Array, "bodies 3"]
    """Of the origins of their frames [length/time]."""
    spin: Float[Array, "bodies 3"]
    """[1/time]"""


def _tuple(terms: Any) -> Any:
    return tuple(terms) if isinstance(terms, Iterable) else terms


def _load(value: Any) -> Any:
    if value is None or not callable(value):
        return None if value is None else float_array(value)
    return leaf_function(value)


class Assembly(eqx.Module):
    """Rigid bodies in a viscous fluid, each free, or joined to another one or to space.

    With M the mobility of all beads and K from motions of bodies to those of beads, a body resists by
    K^T M^-1 K: it takes six numbers, less what joints take away, however many beads it has. M is
    kept and factorised as one matrix, of 6 rows for each bead. Every number in it is a leaf.

    **Arguments**

    - `bodies`: drawn in one frame.
    - `viscosity`: mu [force time/length^2].
    - `joints`: each body is the child of one at most, and free in space if of none.
    - `mobility`: of the beads, `RPY()` by default.
    - `forces`: on beads, as of a scene (`Weight`, `ForceField`, `Contact`, ...), if they need nothing
      but positions. Each body's beads are taken for a fibre.
    - `flow`: ambient flow, or `None`.
    - `force`, `torque`: on each body, `(bodies, 3)` in space [force, force length], or a function of the
      time that returns them. Forces act at the mean of the beads' centres.
    - `domain`: the space that fluid and bodies are in; unbounded by default.
    - `moment`, `susceptibility`: of each body, in its frame as drawn, the moment m, `(bodies, 3)` [force
      length/field], and chi, by which a field magnetises it, symmetric, `(bodies, 3, 3)`; `field`: B of
      `jaxbeads.magnetism`, at the means of their beads: torques m' x B, forces grad (m' . B), m' = m +
      chi B. Bodies do not feel one another's moments.

    **Raises** `ValueError` for joints that make a loop or hold a body twice, and for terms that do not
    fit.

    >>> import jaxbeads as jb
    >>> head = jb.body.sphere(6.0, centre=[-7.0, 0.0, 0.0])
    >>> tail = jb.body.helix(radius=3.0, pitch=14.0, turns=3)
    >>> motor = jb.body.Motor(0, 1, axis=[1.0, 0.0, 0.0], rate=1.0)
    >>> bacterium = jb.Assembly([head, tail], viscosity=1.0, joints=[motor])
    >>> print(bacterium.beads, bacterium.free, bacterium.unknowns)
    36 (0,) 6
    """

    bodies: tuple[Body, ...] = eqx.field(converter=_tuple)
    viscosity: Float[Array, ""] = eqx.field(converter=float_array)
    joints: tuple[AbstractJoint, ...] = eqx.field(converter=_tuple, default=())
    mobility: AbstractMobility = RPY()
    forces: tuple[AbstractForce, ...] = eqx.field(converter=_tuple, default=())
    flow: AbstractFlow | None = None
    force: Any = eqx.field(converter=_load, default=None)
    torque: Any = eqx.field(converter=_load, default=None)
    domain: AbstractDomain = eqx.field(default=Unbounded(), kw_only=True)
    moment: Array | None = eqx.field(converter=optional_float_array, default=None, kw_only=True)
    susceptibility: Array | None = eqx.field(
        converter=optional_float_array, default=None, kw_only=True
    )
    field: AbstractMagneticField | None = eqx.field(
        converter=optional_magnetic_field, default=None, kw_only=True
    )

    def __check_init__(self) -> None:
        for name, wanted in {"bodies": Body, "joints": AbstractJoint}.items():
            terms = getattr(self, name)
            if not isinstance(terms, tuple) or not (terms or name == "joints"):
                fail(name, f"be a list of {wanted.__name__} objects", f"it is {terms!r}")
            for term in terms:
                kind(name, term, wanted)
        for joint in self.joints:
            for name, body in {"parent": joint.parent, "child": joint.child}.items():
                if body is not None and body >= len(self.bodies):
                    must = f"be one of the {len(self.bodies)} bodies"
                    fail(f"{type(joint).__name__}.{name}", must, f"it is {body}")
        children = [joint.child for joint in self.joints]
        twice = {child for child in children if children.count(child) > 1}
        if twice:
            fail("joints", "hold no body twice", f"they do hold body {min(twice)} so")
        if len(self.order) < len(self.bodies):
            left = min(set(range(len(self.bodies))) - set(self.order))
            fail("joints", "make no loop", f"body {left} hangs on itself")
        for name in ("force", "torque"):
            value = getattr(self, name)
            if callable(value):
                check_law(name, value, (len(self.bodies), 3), self.viscosity.dtype)
            elif value is not None:
                shape(name, value, (len(self.bodies), 3))
                finite(name, value)
        check_magnets(len(self.bodies), self.moment, self.susceptibility, self.field)
        self._check_terms()

    def _check_terms(self) -> None:
        scene = self.scene
        for force in self.forces:
            name = f"be made of terms that read positions alone, not of {type(force).__name__}"
            if force.oriented or force.framed(scene.chain):
                fail("forces", name, "it needs directors or normals")
            if force.begin(State(self.positions(self.frames(self.drawn))), scene) is not None:
                fail("forces", name, "it owns numbers that change in time")
            force.check(scene.chain, _DIM)
        scene.domain.check(_DIM)
        if scene.flow is not None:
            scene.flow.check(_DIM)
            scene.domain.check_flow(type(scene.flow).__name__, scene.flow.velocity, _DIM)
        scene.mobility.check(scene, scene.flow, _DIM)

    @property
    def beads(self) -> int:
        """Number of beads of all bodies."""
        return sum(body.beads for body in self.bodies)

    @property
    def body_of_bead(self) -> np.ndarray:
        """Index of the body of each bead, `(beads,)`."""
        return np.repeat(np.arange(len(self.bodies)), [body.beads for body in self.bodies])

    @property
    def chain(self) -> Chain:
        """All beads, each body's as a fibre, for pictures and files."""
        radius = self.bodies[0].radius
        if len(self.bodies) > 1:
            radius = jnp.concatenate([body.radii for body in self.bodies])
        return Chain(radius, [body.beads for body in self.bodies])

    @property
    def scene(self) -> Scene:
        """The beads and what acts on them as a scene, in which nothing holds them together."""
        return Scene(
            self.chain,
            self.viscosity,
            self.mobility,
            forces=self.forces,
            flow=self.flow,
            domain=self.domain,
        )

    @property
    def free(self) -> tuple[int, ...]:
        """Bodies that no joint holds."""
        held = {joint.child for joint in self.joints}
        return tuple(k for k in range(len(self.bodies)) if k not in held)

    @property
    def unknowns(self) -> int:
        """Velocities and spins that are not prescribed, 6 for a free body."""
        return 6 * len(self.free) + sum(joint.freedoms for joint in self.joints)

    @property
    def order(self) -> tuple[int, ...]:
        """The bodies, parents before children."""
        found = list(self.free)
        waiting = list(self.joints)
        while ready := [j for j in waiting if j.parent is None or j.parent in found]:
            found += [joint.child for joint in ready]
            waiting = [joint for joint in waiting if joint.child not in found]
        return tuple(found)

    def joint_of(self, body: int) -> AbstractJoint | None:
        """The joint that holds a body; `None` if it is free."""
        return next((joint for joint in self.joints if joint.child == body), None)

    @property
    def drawn(self) -> Pose:
        """The bodies where they were drawn."""
        dtype = jnp.result_type(self.viscosity, *(body.position for body in self.bodies))
        turn = jnp.tile(jnp.asarray(quaternions.IDENTITY, dtype), (len(self.bodies), 1))
        return Pose(jnp.zeros((len(self.free), 3), dtype), turn)

    def frames(self, pose: Pose) -> Frames:
        """Where the bodies are."""
        origin: dict[int, Array] = {}
        rotation: dict[int, Array] = {}
        for body in self.order:
            own = quaternions.matrix(pose.turn[body])
            joint = self.joint_of(body)
            if joint is None:
                rotation[body], origin[body] = own, pose.place[self.free.index(body)]
                continue
            place, turned = joint.point, own
            if joint.parent is not None:
                held = rotation[joint.parent]
                place, turned = origin[joint.parent] + held @ joint.point, held @ own
            rotation[body], origin[body] = turned, place - turned @ joint.point
        every = range(len(self.bodies))
        return Frames(
            jnp.stack([origin[k] for k in every]), jnp.stack([rotation[k] for k in every])
        )

    def positions(self, frames: Frames) -> Float[Array, "beads 3"]:
        """Centres of all beads in space [length]."""
        places = zip(self.bodies, *frames, strict=True)
        return jnp.concatenate([x[None] + body.position @ r.T for body, x, r in places])

    def state(self, pose: Pose) -> State:
        """The beads of all bodies, as the state of `scene`.

        **Raises** `ValueError` for a pose of other bodies.
        """
        self.check_pose(pose)
        return State(self.positions(self.frames(pose)))

    def check_pose(self, pose: Pose) -> None:
        """Refuse a pose of other bodies, in one sentence."""
        kind("pose", pose, Pose)
        shape("pose.place", pose.place, (len(self.free), 3))
        shape("pose.turn", pose.turn, (len(self.bodies), 4))
        finite("pose", pose.place)

    def twists(self, t: Array, pose: Pose, frames: Frames, unknown: Array) -> Twists:
        """Motions of bodies, affine in what is not prescribed: of a free body velocity and spin, of a
        joint its freedoms, in the order of the bodies.
        """
        velocity: dict[int, Array] = {}
        spin: dict[int, Array] = {}
        for body, own in zip(self.order, self._shares(unknown), strict=True):
            joint = self.joint_of(body)
            if joint is None:
                velocity[body], spin[body] = own[:3], own[3:]
                continue
            parent, at = joint.parent, frames.point(joint.parent, joint.point)
            turning = frames.vector(parent, joint.spin(t, pose.turn[body], own))
            moving = jnp.zeros_like(at)
            if parent is not None:
                moving = velocity[parent] + jnp.cross(spin[parent], at - frames.origin[parent])
                turning = turning + spin[parent]
            spin[body] = turning
            velocity[body] = moving + jnp.cross(turning, frames.origin[body] - at)
        every = range(len(self.bodies))
        return Twists(jnp.stack([velocity[k] for k in every]), jnp.stack([spin[k] for k in every]))

    def _shares(self, unknown: Array) -> list[Array]:
        """What of it is each body's, in their order."""
        joints = [self.joint_of(body) for body in self.order]
        sizes = [6 if joint is None else joint.freedoms for joint in joints]
        return jnp.split(unknown, np.cumsum(sizes)[:-1])

    def rate(self, t: Array, pose: Pose, unknown: Array) -> Pose:
        """Rate of change of a pose."""
        place, turn = [], {}
        for body, own in zip(self.order, self._shares(unknown), strict=True):
            joint = self.joint_of(body)
            if joint is None:
                place.append(own[:3])
                spin = own[3:]
            else:
                spin = joint.spin(t, pose.turn[body], own)
            turn[body] = quaternions.rate(pose.turn[body], spin)
        none = jnp.zeros((0, 3), pose.turn.dtype)
        turns = jnp.stack([turn[k] for k in range(len(self.bodies))])
        return Pose(jnp.stack(place) if place else none, turns)

    def given(self, name: str, t: Array, dtype: Any) -> Array | None:
        """Forces or torques on bodies at a time; `None` if there are none."""
        value = getattr(self, name)
        if value is None or not callable(value):
            return value
        return law_of(name, value, t, (len(self.bodies), 3), dtype)
