"""The frame of a fibre in space: its end-to-end direction, and a normal that turns with it without spin.

No rule can attach a normal to every direction of a straight fibre without a place where it fails, nor
without one that spins about the fibre as it turns. So the normal is a part of the state: it is carried
along by the smallest rotation from each instant to the next. Whichever way a fibre points and turns, it
moves alike.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .chain import Chain
from .geometry import turned, unit
from .state import State


def axes(position: Float[Array, "beads dim"], chain: Chain) -> Float[Array, "fibres dim"]:
    """Direction of each fibre, from its first bead to its last; zero for a single bead."""
    last = np.cumsum(chain.fibres) - 1
    first = last - np.array(chain.fibres) + 1
    return unit(position[last] - position[first])


def _upright(normal: Array, axis: Array) -> Array:
    """Unit vectors normal to the axes, from vectors nearly so."""
    along = jnp.sum(normal * axis, axis=-1, keepdims=True)
    return unit(normal - along * axis)


def normals(state: State, chain: Chain) -> Float[Array, "fibres 3"]:
    """The normal of each fibre in space. Where the state holds none: y, turned by the smallest rotation
    from x to the fibre's direction.
    """
    axis = axes(state.position, chain)
    if state.normal is not None:
        return _upright(state.normal, axis)
    x, y = jnp.eye(3, dtype=axis.dtype)[:2]
    first, second = (jnp.broadcast_to(v, axis.shape) for v in (x, y))
    # From the opposite of x the smallest rotation is not defined; half a turn about y leads near it.
    behind = axis[:, :1] < 0
    near = turned(second, jnp.where(behind, -first, first), axis)
    return _upright(near, axis)


def normal_rate(
    normal: Float[Array, "fibres dim"],
    position: Float[Array, "beads dim"],
    velocity: Float[Array, "beads dim"],
    chain: Chain,
) -> Float[Array, "fibres dim"]:
    """dn/dt = (a x da/dt) x n = -(n . da/dt) a of normals n [1/time]."""
    axis, turning = jax.jvp(lambda r: axes(r, chain), (position,), (velocity,))
    return -jnp.sum(normal * turning, axis=-1, keepdims=True) * axis


def upright(
    normal: Float[Array, "fibres 3"], position: Float[Array, "beads 3"], chain: Chain
) -> Float[Array, "fibres 3"]:
    """Normals at length one and normal to their fibres."""
    return _upright(normal, axes(position, chain))


def framed(state: State, chain: Chain) -> State:
    """The state with normals of its fibres, if it holds none."""
    if state.normal is not None:
        return state
    normal = normals(state, chain)
    return eqx.tree_at(lambda s: s.normal, state, normal, is_leaf=lambda x: x is None)
