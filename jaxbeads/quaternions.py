"""Rotations in space as quaternions (w, x, y, z): no direction is singular, and no axis is special.

Functions take any non-zero quaternion for the rotation that it means, so that errors of time stepping in
its length do no harm. Pure functions of arrays `(..., 4)`.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._typing import float_array
from .geometry import norm, unit

Quaternion = Float[Array, "*batch 4"]
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
"""No rotation."""


def product(second: Quaternion, first: Quaternion) -> Quaternion:
    """One rotation after another.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.quaternions import product
    >>> i, j = jnp.eye(4)[1], jnp.eye(4)[2]
    >>> print(product(i, j))  # half a turn about y and one about x are one about z
    [0. 0. 0. 1.]
    """
    (a, u), (b, v) = ((q[..., :1], q[..., 1:]) for q in (second, first))
    scalar = a * b - jnp.sum(u * v, axis=-1, keepdims=True)
    return jnp.concatenate([scalar, a * v + b * u + jnp.cross(u, v)], axis=-1)


def matrix(quaternion: Quaternion) -> Float[Array, "*batch 3 3"]:
    """The rotation as a matrix R, by which vectors fixed to a body are R x in space.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.quaternions import matrix
    >>> print(matrix(jnp.array([1.0, 0.0, 0.0, 1.0])) @ jnp.array([1.0, 0.0, 0.0]))  # about z
    [0. 1. 0.]
    """
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    square = w * w + x * x + y * y + z * z
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2) / square[..., None, None]


def about(axis: Any, angle: Any) -> Quaternion:
    """The rotation by an angle [rad] about an axis, of any length: a number and three, or many of them.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.quaternions import about, matrix
    >>> quarter = matrix(about([0.0, 0.0, 2.0], jnp.pi / 2))
    >>> print((quarter @ jnp.array([1.0, 0.0, 0.0])).round(12))
    [0. 1. 0.]
    """
    axis, half = float_array(axis), float_array(angle)[..., None] / 2
    return jnp.concatenate([jnp.cos(half), jnp.sin(half) * unit(axis)], axis=-1)


def angles(quaternion: Quaternion) -> Float[Array, "*batch 3"]:
    """The axis of a rotation times its angle, of at most half a turn [rad].

    >>> from jaxbeads.quaternions import about, angles
    >>> print(angles(about([0.0, 3.0, 0.0], 0.5)).round(12))
    [0.  0.5 0. ]
    """
    sign = jnp.where(quaternion[..., :1] < 0, -1.0, 1.0)
    scalar, vector = (sign * quaternion)[..., :1], (sign * quaternion)[..., 1:]
    sine = norm(vector)[..., None]
    small = sine < 1e-8 * jnp.abs(scalar)
    ratio = jnp.arctan2(sine, scalar) / jnp.where(small, 1.0, sine)
    return 2 * vector * jnp.where(small, 1 / jnp.where(scalar == 0, 1.0, scalar), ratio)


def rate(quaternion: Quaternion, spin: Float[Array, "*batch 3"]) -> Quaternion:
    """Its rate of change at a spin, which is given in the frame into which it turns [1/time].

    >>> import jax.numpy as jnp
    >>> from jaxbeads.quaternions import IDENTITY, rate
    >>> print(rate(jnp.array(IDENTITY), jnp.array([0.0, 0.0, 2.0])))
    [0. 0. 0. 1.]
    """
    return product(jnp.concatenate([jnp.zeros_like(spin[..., :1]), spin / 2], axis=-1), quaternion)
