"""Material frames: at each bead of a fibre in space a vector that is fixed to its material.

The frame of a bead is (d_1, d_2, t): t is the fibre's direction there, the mean of those of its bonds,
d_1 a unit vector normal to it, d_2 = t x d_1. As beads move it follows t by the smallest rotation and
turns about t with the bead,

    d_1' = (t x t' + (w . t) t) x d_1.

Along a fibre the smallest rotations, from t to the bond's direction e and from there to the next t,
carry a vector on without twist. No direction is singular, and the frame is a part of the state.

Frames belong to beads, as spins and curvatures do, not to bonds: a bond's mean spin, with which a bond
would turn, does not see spins that alternate from bead to bead, and twist that alternates from bond to
bond would not relax. The spins by which rolling beads counter-rotate (normal to t) turn no frame.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._checks import fail, finite, known, shape
from ._typing import float_array
from .chain import Chain
from .geometry import tangents, turned, unit
from .state import Motion, State

_NORMAL = 0.01
"""How far the length of a frame's vector may be off one, and its part along the fibre off zero."""


def directions(
    position: Float[Array, "beads 3"], chain: Chain
) -> tuple[Float[Array, "bonds 3"], Float[Array, "beads 3"]]:
    """Directions e of the bonds (zero between fibres) and t of the fibre at the beads, the mean of e
    before and after (zero for a single bead).

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> bent = jb.from_tangents(chain, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    >>> print(jb.material.directions(bent, chain)[1].round(4))
    [[1.     0.     0.    ]
     [0.7071 0.7071 0.    ]
     [0.     1.     0.    ]]
    """
    e = tangents(position)
    e = e if chain.bond_mask.all() else e * chain.bond_mask[:, None]
    return e, unit(jnp.pad(e, ((0, 1), (0, 0))) + jnp.pad(e, ((1, 0), (0, 0))))


def upright(
    frame: Float[Array, "beads 3"], position: Float[Array, "beads 3"], chain: Chain
) -> Float[Array, "beads 3"]:
    """Unit vectors normal to the fibre, from vectors nearly so. As positions change, they turn with t by
    the smallest rotation.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=2)
    >>> along_x = jb.straight(chain, [1.0, 0.0, 0.0]).position
    >>> print(jb.material.upright(jnp.array([[0.1, 2.0, 0.0]] * 2), along_x, chain))
    [[0. 1. 0.]
     [0. 1. 0.]]
    """
    t = directions(position, chain)[1]
    return unit(frame - dot(frame, t) * t)


def rate(
    frame: Float[Array, "beads 3"],
    position: Float[Array, "beads 3"],
    motion: Motion,
    chain: Chain,
) -> Float[Array, "beads 3"]:
    """d_1' in a motion of the beads [1/time].

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=2)
    >>> along_x = jb.straight(chain, [1.0, 0.0, 0.0]).position
    >>> roll = jb.Motion(jnp.zeros((2, 3)), jnp.array([[0.5, 7.0, 0.0], [0.0, 0.0, 0.0]]))
    >>> print(jb.material.rate(jnp.array([[0.0, 1.0, 0.0]] * 2), along_x, roll, chain))
    [[0.  0.  0.5]
     [0.  0.  0. ]]
    """
    if motion.spin is None:
        raise ValueError(
            "Argument `state` must hold no frames, but no term of the scene turns beads."
        )
    t, turning = jax.jvp(lambda r: directions(r, chain)[1], (position,), (motion.velocity,))
    along = jnp.sum(frame * turning, axis=1, keepdims=True)
    spin = jnp.sum(motion.spin * t, axis=1, keepdims=True)
    return spin * jnp.cross(t, frame) - along * t


def moved(
    frame: Float[Array, "beads 3"],
    before: Float[Array, "beads 3"],
    after: Float[Array, "beads 3"],
    chain: Chain,
) -> Float[Array, "beads 3"]:
    """Frames turned by the smallest rotations that lead t where beads have moved from `before` to
    `after`.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> chain, frame = jb.Chain(radius=1.0, fibres=2), jnp.array([[0.0, 1.0, 0.0]] * 2)
    >>> before, after = (jb.straight(chain, v).position for v in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    >>> print(jb.material.moved(frame, before, after, chain)[0])
    [-1.  0.  0.]
    """
    first, last = (directions(x, chain)[1] for x in (before, after))
    return turned(frame, first, last)


class Strains(NamedTuple):
    """How a rod is bent and twisted, and its frames; see `strains`.

    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> state = jb.with_frames(jb.straight(chain, [1.0, 0.0, 0.0]), chain, twist=0.2)
    >>> found = jb.material.strains(state, chain)
    >>> print(isinstance(found, jb.material.Strains), found.curvature + 0.0, found.twist.round(6))
    True [[0. 0.]] [0.2 0.2]
    """

    bond: Float[Array, "bonds 3"]
    """e; zero between fibres."""
    direction: Float[Array, "beads 3"]
    """t."""
    first: Float[Array, "beads 3"]
    """d_1."""
    second: Float[Array, "beads 3"]
    """d_2."""
    curvature: Float[Array, "joints 2"]
    """kappa_1, kappa_2, see `curvature`; 0 where fibres end."""
    twist: Float[Array, " bonds"]
    """tau, see `twist`; 0 between fibres."""


def strains(state: State, chain: Chain) -> Strains:
    """Curvatures and twist of a state with frames, of two beads or more.

    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=2)
    >>> state = jb.with_frames(jb.straight(chain, [1.0, 0.0, 0.0]), chain, normal=[0.0, 1.0, 0.0])
    >>> print(jb.material.strains(state, chain).second[0])
    [0. 0. 1.]
    """
    e, t = directions(state.position, chain)
    first = unit(_held(state) - dot(_held(state), t) * t)
    second, turn = jnp.cross(t, first), e[1:] - e[:-1]
    about = jnp.concatenate([-dot(turn, second[1:-1]), dot(turn, first[1:-1])], axis=1)
    bent = about / (0.5 * (chain.bond_length[1:] + chain.bond_length[:-1]))[:, None]
    # Both frames of a bond turned to its direction, by less than a right angle.
    begun, ended = (
        d - (dot(d, e) / (1 + dot(x, e))) * (x + e)
        for d, x in ((first[:-1], t[:-1]), (first[1:], t[1:]))
    )
    sine, cosine = dot(jnp.cross(begun, ended), e)[:, 0], dot(begun, ended)[:, 0]
    if not chain.bond_mask.all():
        bent = bent * chain.joint_mask[:, None]
        sine, cosine = (jnp.where(chain.bond_mask, x, y) for x, y in ((sine, 0.0), (cosine, 1.0)))
    return Strains(e, t, first, second, bent, jnp.arctan2(sine, cosine) / chain.bond_length)


def curvature(state: State, chain: Chain) -> Float[Array, "joints 2"]:
    """Curvatures kappa_1, kappa_2 about d_1, d_2 at the inner beads [1/length]; 0 where fibres end.

    The curvature vector t x (e' - e)/l, with l the arclength of the joint, has the length
    2 sin(phi/2)/l where the tangent turns by phi: half its square times l is the energy
    (1 - cos phi)/l of `CrossProductCurvature`.

    **Arguments**: a state with frames; the chain. **Returns** `(beads - 2, 2)`.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> bent = jb.State(jb.from_tangents(chain, [[1.0, 0.0, 0.0], [0.5, 0.75**0.5, 0.0]]))
    >>> state = jb.with_frames(bent, chain, normal=[0.0, 0.0, 1.0])
    >>> print(jb.material.curvature(state, chain).round(6) + 0.0)  # sin(30 deg)
    [[0.5 0. ]]
    """
    return strains(state, chain).curvature


def twist(state: State, chain: Chain) -> Float[Array, " bonds"]:
    """Twist of each bond [1/length]: the angle, in (-pi, pi], by which d_1 turns about the bond from its
    first bead to the second, over the bond's length; 0 between fibres.

    **Arguments**: a state with frames; the chain. **Returns** `(beads - 1,)`.

    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> state = jb.with_frames(jb.straight(chain, [0.0, 0.0, 1.0]), chain, twist=0.3)
    >>> print(jb.material.twist(state, chain).round(6))
    [0.3 0.3]
    """
    return strains(state, chain).twist


def dot(a: Float[Array, "rows 3"], b: Float[Array, "rows 3"]) -> Float[Array, "rows 1"]:
    """a . b of each row, as a column.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.material import dot
    >>> print(dot(jnp.ones((2, 3)), jnp.ones((2, 3))).ravel())
    [3. 3.]
    """
    return jnp.sum(a * b, axis=1, keepdims=True)


def _held(state: State) -> Array:
    if state.frame is None:
        fail("state", "hold material frames", "it holds none (`with_frames` makes such a state)")
    return jnp.asarray(state.frame)


def with_frames(state: State, chain: Chain, normal: Any = None, twist: Any = 0.0) -> State:
    """The state with material frames: from a first normal, carried on along each fibre without twist, or
    with one.

    **Arguments**

    - `state`: in space; frames that it holds are replaced.
    - `normal`: d_1 at the first bead of the fibres, `(3,)` or `(fibres, 3)`; what it has along the fibre
      is taken off. By default any: give one where it matters, as for anisotropic or curved rods.
    - `twist`: [1/length], one or one for each bond, `(beads - 1,)`.

    **Raises** `ValueError` for a planar state, wrong shapes, and a normal along the fibre.

    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> state = jb.with_frames(jb.straight(chain, [0.0, 0.0, 1.0]), chain, normal=[0.0, 1.0, 0.0])
    >>> print(state.frame)
    [[0. 1. 0.]
     [0. 1. 0.]
     [0. 1. 0.]]
    """
    if state.position.shape[1:] != (3,):
        must = "be one state in space for material frames"
        fail("state", must, f"its positions have shape {state.position.shape}")
    bonds, fibres, dtype = chain.beads - 1, len(chain.fibres), state.position.dtype
    twist = float_array(twist).astype(dtype)
    shape("twist", twist, (), (bonds,))
    finite("twist", twist)
    if normal is None:
        normal = _first_normals(state.position, chain)
    else:
        normal = float_array(normal).astype(dtype)
        shape("normal", normal, (3,), (fibres, 3))
        finite("normal", normal)
        normal = jnp.broadcast_to(normal, (fibres, 3))
        t = directions(state.position, chain)[1][np.array(chain.first_beads)]
        if known((normal, t)) and np.any(
            np.linalg.norm(np.cross(normal, t), axis=1) <= 1e-6 * np.linalg.norm(normal, axis=1)
        ):
            fail("normal", "lie across the fibre", "it points along it")
    along = _carried_along(state.position, chain, normal, jnp.broadcast_to(twist, (bonds,)))
    return eqx.tree_at(lambda s: s.frame, state, along, is_leaf=lambda x: x is None)


def _first_normals(position: Array, chain: Chain) -> Float[Array, "fibres 3"]:
    """Along an axis that is far from the fibre's direction at its first bead."""
    t = directions(position, chain)[1][np.array(chain.first_beads)]
    return jnp.eye(3, dtype=t.dtype)[jnp.argmin(jnp.abs(t), axis=1)]


@eqx.filter_jit
def _carried_along(
    position: Float[Array, "beads 3"],
    chain: Chain,
    normal: Float[Array, "fibres 3"],
    twist: Float[Array, " bonds"],
) -> Float[Array, "beads 3"]:
    """The normal of each fibre's first bead, carried on from bead to bead."""
    e, t = directions(position, chain)
    angle = jnp.pad(twist * chain.bond_length, (1, 0))
    first = np.isin(np.arange(chain.beads), chain.first_beads)
    start = upright(normal[chain.fibre_of_bead], position, chain)
    before, bond = (jnp.concatenate([t[:1], x]) for x in (t[:-1], e))

    def step(last: Array, row: tuple[Array, ...]) -> tuple[Array, Array]:
        first, start, before, bond, t, angle = row
        d = turned(turned(last, before, bond), bond, t)
        d = jnp.cos(angle) * d + jnp.sin(angle) * jnp.cross(t, d)
        d = jnp.where(first, start, d)
        return d, d

    rows = jnp.asarray(first), start, before, bond, t, angle
    return upright(jax.lax.scan(step, start[0], rows)[1], position, chain)


def check(state: State, chain: Chain) -> None:
    """Refuse frames that do not fit the beads.

    >>> import jaxbeads as jb
    >>> state = jb.State([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]], frame=[[0.0, 1.0, 0.0], [0.0, 3.0, 0.0]])
    >>> try:
    ...     jb.material.check(state, jb.Chain(radius=1.0, fibres=2))
    ... except ValueError as error:
    ...     print(str(error)[:62])
    Argument `state.frame` must hold unit vectors normal to the fi
    """
    if state.frame is None:
        return
    frame = state.frame
    if frame.shape != state.position.shape:
        fail("state.frame", f"have the shape {state.position.shape}", f"it has {frame.shape}")
    if not known((frame, state.position)):
        return
    with jax.ensure_compile_time_eval():  # the state is known, also where a program is being traced
        t = np.asarray(directions(state.position, chain)[1])
    lengths, along = np.linalg.norm(frame, axis=1), np.abs(np.sum(np.asarray(frame) * t, axis=1))
    off = np.maximum(np.abs(lengths - 1), along)
    if off.max() > _NORMAL:
        bead = int(np.argmax(off))
        how = f"that of bead {bead} has length {lengths[bead]:.3g} and {along[bead]:.3g} along it"
        fail("state.frame", "hold unit vectors normal to the fibre", how)


def turning(
    frame: Float[Array, "beads 3"], t: Float[Array, "beads 3"], change: Float[Array, "beads 3"]
) -> Float[Array, " beads"]:
    """How far frames turn about t where they change: d_2 . d_1'.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.material import turning
    >>> x, y, z = jnp.eye(3)[:, None, :]
    >>> print(turning(y, x, 0.5 * z))
    [0.5]
    """
    return jnp.sum(jnp.cross(t, frame) * change, axis=1)


def angled(
    frame: Float[Array, "beads 3"], t: Float[Array, "beads 3"], angle: Float[Array, " beads"]
) -> Float[Array, "beads 3"]:
    """Frames turned about t by angles [rad].

    >>> import jax.numpy as jnp
    >>> from jaxbeads.material import angled
    >>> x, y, z = jnp.eye(3)[:, None, :]
    >>> print(angled(y, x, jnp.array([jnp.pi / 2])).round(12))  # y to z
    [[0. 0. 1.]]
    """
    return jnp.cos(angle)[:, None] * frame + jnp.sin(angle)[:, None] * jnp.cross(t, frame)
