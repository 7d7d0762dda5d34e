"""Preferred curvature in two planes: helical waves."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import finite, shape
from .._typing import float_array, leaf_function
from .base import AbstractCurvature

Planar = Callable[[Array, Array, Array], Array]


class TwoPlanes(AbstractCurvature):
    """kappa_0 = kappa_1(s, t) n_1 + kappa_2(s, t) n_2, curvature vectors for a fibre in space.

    Two equal waves, a quarter of a period apart, make a helical wave. The axes n keep their direction
    in space. (The model has no torsion that could hold them to the fibre; seen from a body that
    turns about its axis, a helical wave has another frequency and is otherwise the same.)

    **Arguments**

    - `first`, `second`: planar curvatures, as `TravellingWave`.
    - `axes`: n_1 and n_2, shape `(2, 3)`; by default y and z, for a fibre along x. A curvature vector
      is the normal of the plane in which the fibre bends.
    """

    first: Planar = eqx.field(converter=leaf_function)
    second: Planar = eqx.field(converter=leaf_function)
    axes: Float[Array, "2 3"] = eqx.field(converter=float_array)

    def __init__(self, first: Any, second: Any, axes: Any = ((0, 1, 0), (0, 0, 1))) -> None:
        self.first = leaf_function(first)
        self.second = leaf_function(second)
        self.axes = float_array(axes)

    def __check_init__(self) -> None:
        shape("axes", self.axes, (2, 3))
        finite("axes", self.axes)

    def __call__(
        self,
        t: Float[Array, ""],
        arclength: Float[Array, " joints"],
        length: Float[Array, " joints"],
    ) -> Float[Array, "joints 3"]:
        """Curvature vector at each joint [1/length]."""
        both = [kappa(t, arclength, length) for kappa in (self.first, self.second)]
        return jnp.stack(both, axis=1) @ self.axes
