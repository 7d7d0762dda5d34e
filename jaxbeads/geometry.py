"""Geometry of a row of beads: bonds, tangents, turning, curvature. Pure functions of positions.

`position` has shape `(..., beads, dim)`; functions act on the last two axes.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .domain import AbstractDomain, Unbounded

_UNBOUNDED = Unbounded()


def norm(vector: Float[Array, "*batch dim"]) -> Float[Array, "*batch"]:
    """Length of vectors `(..., dim)`, with derivative 0 (not NaN) at the zero vector.

    >>> import jax, jax.numpy as jnp
    >>> from jaxbeads.geometry import norm
    >>> print(norm(jnp.array([[3.0, 4.0], [0.0, 0.0]])), jax.grad(norm)(jnp.zeros(2)))
    [5. 0.] [0. 0.]
    """
    square = jnp.sum(vector * vector, axis=-1)
    zero = square == 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, square)))


def peak(x: Float[Array, "*shape"], axis: int | None = None) -> Float[Array, "*less"]:
    """The largest magnitude of numbers, 0 of none, and NaN if one of them is: XLA's maximum of
    thousands of numbers may leave NaN out on a CPU.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.geometry import peak
    >>> x = jnp.ones(20000)
    >>> print(peak(-2 * x), peak(x.at[7].set(jnp.nan)))
    2.0 nan
    """
    nothing = jnp.any(jnp.isnan(x), axis=axis)
    return jnp.where(nothing, jnp.nan, jnp.max(jnp.abs(x), axis=axis, initial=0.0))


def unit(vector: Float[Array, "*batch dim"]) -> Float[Array, "*batch dim"]:
    """Direction of vectors `(..., dim)`; the zero vector has direction zero.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.geometry import unit
    >>> print(unit(jnp.array([[3.0, 4.0], [0.0, 0.0]])))
    [[0.6 0.8]
     [0.  0. ]]
    """
    length = norm(vector)
    return vector / jnp.where(length == 0, 1.0, length)[..., None]


def cross(a: Float[Array, "*batch dim"], b: Float[Array, "*batch dim"]) -> Array:
    """a x b, shape `(..., 3)` in space and `(..., 1)` (the normal component) in the plane.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.geometry import cross
    >>> print(cross(jnp.array([1.0, 0.0]), jnp.array([0.0, 2.0])))
    [2.]
    >>> print(cross(jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 2.0, 0.0])))
    [0. 0. 2.]
    """
    if a.shape[-1] == 2:
        return (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])[..., None]
    return jnp.cross(a, b)


def normals(direction: Float[Array, "*batch dim"]) -> Float[Array, "*batch dim-1 dim"]:
    """Unit vectors normal to unit vectors `(..., dim)` and to one another, `(..., dim - 1, dim)`; which
    ones in space is arbitrary.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.geometry import normals
    >>> print(normals(jnp.array([0.6, 0.8])))
    [[-0.8  0.6]]
    >>> print(normals(jnp.array([0.0, 0.6, 0.8])).shape)
    (2, 3)
    """
    if direction.shape[-1] == 2:
        return jnp.stack([-direction[..., 1], direction[..., 0]], axis=-1)[..., None, :]
    # The axis farthest from the direction leaves the largest normal.
    axis = jnp.eye(3, dtype=direction.dtype)[jnp.argmin(jnp.abs(direction), axis=-1)]
    first = unit(jnp.cross(direction, axis))
    return jnp.stack([first, jnp.cross(direction, first)], axis=-2)


def spin_cross(spin: Array, arm: Float[Array, "*batch dim"]) -> Float[Array, "*batch dim"]:
    """w x r: velocity [length/time] at `arm` [length] from the centre of a bead that turns with `spin`
    [1/time], `(..., 1)` in the plane and `(..., 3)` in space.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.geometry import spin_cross
    >>> print(spin_cross(jnp.array([2.0]), jnp.array([1.0, 3.0])))
    [-6.  2.]
    """
    if arm.shape[-1] == 2:
        return spin * jnp.stack([-arm[..., 1], arm[..., 0]], axis=-1)
    return jnp.cross(spin, arm)


def turned(
    vector: Float[Array, "*batch 3"], start: Float[Array, "*batch 3"], end: Float[Array, "*batch 3"]
) -> Float[Array, "*batch 3"]:
    """Vectors turned by the smallest rotation from the unit vector `start` to the unit vector `end`
    (which is undefined, and here none, where they are opposite).

    >>> import jax.numpy as jnp
    >>> from jaxbeads.geometry import turned
    >>> x, y = jnp.eye(3)[0], jnp.eye(3)[1]
    >>> print(turned(x + y, x, y))  # a quarter turn about z
    [-1.  1.  0.]
    """
    axis, cosine = jnp.cross(start, end), jnp.sum(start * end, axis=-1, keepdims=True)
    once = jnp.cross(axis, vector)
    opposite = 1 + cosine < 1e-14
    return vector + once + jnp.cross(axis, once) / jnp.where(opposite, 1.0, 1 + cosine)


def best_rotation(first: Any, last: Any, numpy: Any = jnp) -> Any:
    """The rotation R, never a reflection, by which the rows of the first set, times R, lie best on those
    of the last (Kabsch). **Arguments**: vectors `(..., rows, dim)`, twice; `numpy`: the module of arrays
    that computes it. **Returns** `(..., dim, dim)`.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.geometry import best_rotation
    >>> first = jnp.array([[1.0, 0.0], [0.0, 2.0]])
    >>> last = jnp.array([[0.0, 1.0], [-2.0, 0.0]])  # a quarter turn
    >>> print(jnp.abs(first @ best_rotation(first, last) - last).max() < 1e-12)
    True
    """
    u, _, v = numpy.linalg.svd(numpy.swapaxes(first, -1, -2) @ last)
    sign = numpy.linalg.det(u @ v)[..., None, None]
    last_column = numpy.arange(u.shape[-1]) == u.shape[-1] - 1
    return (u * numpy.where(last_column, sign, 1.0)) @ v


def bonds(position: Float[Array, "*batch beads dim"]) -> Float[Array, "*batch bonds dim"]:
    """Vectors from each bead to the next, r_{i+1} - r_i, `(..., beads - 1, dim)` [length].

    >>> import jax.numpy as jnp
    >>> from jaxbeads.geometry import bonds
    >>> print(bonds(jnp.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0]])))
    [[2. 0.]
     [0. 2.]]
    """
    return position[..., 1:, :] - position[..., :-1, :]


def tangents(position: Float[Array, "*batch beads dim"]) -> Float[Array, "*batch bonds dim"]:
    """Unit vectors e_{i,i+1} from each bead to the next, `(..., beads - 1, dim)`.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.geometry import tangents
    >>> print(tangents(jnp.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0]])))
    [[1. 0.]
     [0. 1.]]
    """
    return unit(bonds(position))


def bond_lengths(position: Float[Array, "*batch beads dim"]) -> Float[Array, "*batch bonds"]:
    """Distances of neighbouring centres, `(..., beads - 1)` [length].

    >>> import jax.numpy as jnp
    >>> from jaxbeads.geometry import bond_lengths
    >>> print(bond_lengths(jnp.array([[0.0, 0.0], [2.0, 0.0], [2.0, 3.0]])))
    [2. 3.]
    """
    return norm(bonds(position))


def turning_angles(position: Float[Array, "*batch beads dim"]) -> Array:
    """Angle between successive bonds at each inner bead, shape `(..., beads - 2)` [rad].

    Signed (anticlockwise positive) in the plane, in [0, pi] in space; accurate near 0 and pi.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.geometry import turning_angles
    >>> print(turning_angles(jnp.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0]])).round(4))
    [1.5708]
    """
    e = tangents(position)
    before, after = e[..., :-1, :], e[..., 1:, :]
    sine = cross(before, after)
    sine = sine[..., 0] if e.shape[-1] == 2 else norm(sine)
    return jnp.arctan2(sine, jnp.sum(before * after, axis=-1))


def smallest_gap(
    position: np.ndarray, radii: np.ndarray, domain: AbstractDomain = _UNBOUNDED
) -> tuple[float, int, int]:
    """Smallest distance of the surfaces of two beads (negative if they overlap), and which they are. On
    the host, some beads at a time; at least two beads.

    >>> import numpy as np
    >>> from jaxbeads.geometry import smallest_gap
    >>> position = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 2.5]])
    >>> smallest_gap(position, np.ones(3))  # of the last two
    (0.5, 1, 2)
    """
    best, beads = (np.inf, 0, 1), len(position)
    rows = max(1, 2**20 // beads)
    for start in range(0, beads, rows):
        part = slice(start, start + rows)
        apart = [x[part, None] - x[None, :] for x in position.T]
        square = sum(np.asarray(d) ** 2 for d in domain.nearest(apart, 1.0))
        gap = np.sqrt(square) - radii[part, None] - radii[None, :]
        own = np.arange(len(gap))
        gap[own, start + own] = np.inf
        i, j = (int(k) for k in np.unravel_index(np.argmin(gap), gap.shape))
        if gap[i, j] < best[0]:
            best = (float(gap[i, j]), min(start + i, j), max(start + i, j))
    return best
