"""`Assembly`: rigid bodies and joints in a viscous fluid; `Pose`: where they are."""

import dataclasses
from collections.abc import Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
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
            if force.oriented or force.needs_frames:
                fail("forces", name, "it needs directors or frames")
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
        space, own = len(self.bodies), quaternions.matrix(pose.turn)
        place = jnp.zeros_like(own[:, 0]).at[np.array(self.free, int)].set(pose.place)
        order, dtype = np.array(self.order), own.dtype

        def body(frames: Frames, row: tuple[Array, ...]) -> tuple[Frames, None]:
            index, parent, point, place, own = row
            held, rotation = frames.rotation[parent], frames.rotation[parent] @ own
            origin = frames.origin[parent] + held @ point - rotation @ point + place
            where = frames.origin.at[index].set(origin)
            return Frames(where, frames.rotation.at[index].set(rotation)), None

        # Space comes last. A loop, so that a body stands in the program once.
        unmoved = jnp.tile(jnp.eye(3, dtype=dtype), (space + 1, 1, 1))
        start = Frames(jnp.zeros((space + 1, 3), dtype), unmoved)
        rows = (order, self.parents[order], self._points[order], place[order], own[order])
        found, _ = lax.scan(body, start, jax.tree.map(jnp.asarray, rows))
        return Frames(found.origin[:space], found.rotation[:space])

    def positions(self, frames: Frames) -> Float[Array, "beads 3"]:
        """Centres of all beads in space [length]."""
        drawn = jnp.concatenate([body.position for body in self.bodies])
        origin, rotation = (x[self.body_of_bead] for x in frames)
        return origin + jnp.einsum("bij,bj->bi", rotation, drawn)

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
        moving, spin = self._own(t, pose, unknown)
        spin = self.in_space(frames, spin)
        # From the origin of each tree: far away nothing is lost.
        at = self.joint_places(frames)
        first = self.above[:, np.array(self.order)].argmax(axis=1)
        root = at[np.array(self.order)[first]]
        above = jnp.asarray(self.above, spin.dtype)
        whole = above @ spin
        arm = jnp.cross(whole, frames.origin - root) - above @ jnp.cross(spin, at - root)
        return Twists(above @ moving + arm, whole)

    def _own(self, t: Array, pose: Pose, unknown: Array) -> tuple[Array, Array]:
        """Of each body the velocity of its origin, if it is free, and its spin against what it hangs on,
        in the frame of that.
        """
        moving = spin = jnp.zeros((len(self.bodies), 3), pose.turn.dtype)
        free, place = np.array(self.free, int), self._place
        if len(free):
            own = unknown[np.stack([place[k] + np.arange(6) for k in free])]
            moving, spin = moving.at[free].set(own[:, :3]), spin.at[free].set(own[:, 3:])
        for joints, child in self._alike:
            own = unknown[np.stack([place[k] + np.arange(joints.freedoms) for k in child])]
            turning = jax.vmap(lambda joint, turn, own: joint.spin(t, turn, own))
            spin = spin.at[child].set(turning(joints, pose.turn[child], own))
        return moving, spin

    def joint_torques(self, t: Array, pose: Pose, frames: Frames) -> Float[Array, "bodies 3"]:
        """Torque in space of each body's joint on it [force length]; 0 of a free body."""
        torque = jnp.zeros((len(self.bodies), 3), pose.turn.dtype)
        for joints, child in self._alike:
            each = jax.vmap(lambda joint, turn: joint.torque(t, turn))(joints, pose.turn[child])
            torque = torque.at[child].set(each)
        return self.in_space(frames, torque)

    def in_space(self, frames: Frames, vectors: Float[Array, "bodies 3"]) -> Array:
        """Vectors in the frames of what each body hangs on, in space."""
        space = jnp.eye(3, dtype=vectors.dtype)[None]
        held = jnp.concatenate([frames.rotation, space])[self.parents]
        return jnp.einsum("bij,bj->bi", held, vectors)

    def joint_places(self, frames: Frames) -> Float[Array, "bodies 3"]:
        """The point in space about which each body turns: that of its joint, or its origin."""
        return frames.origin + jnp.einsum("bij,bj->bi", frames.rotation, self._points)

    @property
    def parents(self) -> np.ndarray:
        """What each body hangs on, `(bodies,)`: a body, or their number, which is for space."""
        joints = [self.joint_of(k) for k in range(len(self.bodies))]
        held = (None if joint is None else joint.parent for joint in joints)
        return np.array([len(self.bodies) if parent is None else parent for parent in held])

    @property
    def _points(self) -> Float[Array, "bodies 3"]:
        """The point of each body's joint, in its frame; its origin if it is free."""
        points = jnp.zeros((len(self.bodies), 3), self.viscosity.dtype)
        if not self.joints:
            return points
        child = np.array([joint.child for joint in self.joints])
        return points.at[child].set(jnp.stack([joint.point for joint in self.joints]))

    @property
    def above(self) -> np.ndarray:
        """Whether a body is another, or hangs on it, `(bodies, bodies)`."""
        found, parents = np.eye(len(self.bodies), dtype=bool), self.parents
        for body in self.order:
            if parents[body] < len(self.bodies):
                found[body] |= found[parents[body]]
        return found

    @property
    def _place(self) -> np.ndarray:
        """Of each body the place of the first of its unknowns."""
        joints = [self.joint_of(body) for body in self.order]
        sizes = [6 if joint is None else joint.freedoms for joint in joints]
        place = np.zeros(len(self.bodies), int)
        place[np.array(self.order)] = np.cumsum([0, *sizes[:-1]])
        return place

    @property
    def _alike(self) -> list[tuple[Any, np.ndarray]]:
        """Joints of one kind side by side, so that they stand in a program once, and their children."""
        groups: dict[Any, list[tuple[AbstractJoint, int]]] = {}
        for joint in self.joints:
            unplaced = dataclasses.replace(joint, parent=None, child=0)
            leaves, tree = jax.tree.flatten(unplaced)
            key = tree, tuple((jnp.shape(x), jnp.result_type(x)) for x in leaves)
            groups.setdefault(key, []).append((unplaced, joint.child))
        return [
            (jax.tree.map(lambda *x: jnp.stack(x), *joints), np.array(children))
            for joints, children in (zip(*group, strict=True) for group in groups.values())
        ]

    def rate(self, t: Array, pose: Pose, unknown: Array) -> Pose:
        """Rate of change of a pose."""
        moving, spin = self._own(t, pose, unknown)
        return Pose(moving[np.array(self.free, int)], quaternions.rate(pose.turn, spin))

    def given(self, name: str, t: Array, dtype: Any) -> Array | None:
        """Forces or torques on bodies at a time; `None` if there are none."""
        value = getattr(self, name)
        if value is None or not callable(value):
            return value
        return law_of(name, value, t, (len(self.bodies), 3), dtype)
