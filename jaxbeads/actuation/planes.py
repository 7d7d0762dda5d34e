"""Preferred curvature in two planes: helical waves."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._functions import curvature_of, leaf_function
from .base import AbstractCurvature

Planar = Callable[[Array, Array, Array], Array]


class TwoPlanes(AbstractCurvature):
    """kappa_0 = kappa_1(s, t) n_1 + kappa_2(s, t) n_2, for a fibre in space.

    n_1 is the normal that the state holds for the fibre, n_2 = a x n_1 with a its end-to-end direction;
    both turn with a, without spin about it, and are turned on to each joint by the smallest rotation
    from a to the local tangent. A curvature vector is the normal of the plane of bending. Two equal
    waves a quarter of a period apart make a helical wave. A state without a normal starts with y, turned
    by the smallest rotation from x to a (from -x, where a points that way). See `jaxbeads.frames`.

    These normals do not spin with a fibre that turns about its axis, so they see the wave at a frequency
    of their own. Waves that turn with the material are those of `force.ElasticRod`, whose two curvatures
    at rest may be functions, too.

    **Arguments**: `first`, `second`: planar curvatures, as `TravellingWave`.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.actuation import TravellingWave, TwoPlanes
    >>> one = TravellingWave(amplitude=0.1, wavenumber=1.0, frequency=1.0)
    >>> two = TravellingWave(amplitude=0.1, wavenumber=1.0, frequency=1.0, phase=jnp.pi / 2)
    >>> helix = TwoPlanes(one, two)(jnp.zeros(()), jnp.array([2.0, 4.0]), jnp.array([8.0, 8.0]))
    >>> print(jnp.linalg.norm(helix, axis=1).round(4))  # along two normals of each joint
    [0.1 0.1]
    """

    first: Planar
    second: Planar

    def __init__(self, first: Any, second: Any) -> None:
        self.first = leaf_function(first, "first")
        self.second = leaf_function(second, "second")

    def __call__(
        self,
        t: Float[Array, ""],
        arclength: Float[Array, " joints"],
        length: Float[Array, " joints"],
    ) -> Float[Array, "joints 2"]:
        """Curvature in each plane at each joint [1/length]."""
        planes = {"TwoPlanes.first": self.first, "TwoPlanes.second": self.second}
        planar = [curvature_of(n, f, t, arclength, length, 2) for n, f in planes.items()]
        return jnp.stack(planar, axis=1)
