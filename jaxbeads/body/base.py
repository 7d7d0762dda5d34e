"""`Body`: beads that move as one."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import quaternions
from .._checks import fail, finite, non_zero, positive, shape
from .._typing import float_array


class Body(eqx.Module):
    """A rigid body of one bead or many, of any radii, which may overlap.

    **Arguments**

    - `position`: centres of its beads in the body's own frame, `(beads, 3)` [length]. Bodies that are to
      be joined are drawn in one frame, in which joints have their points and axes too.
    - `radius`: of its beads, one for all or `(beads,)` [length].

    **Raises** `ValueError` for shapes that do not fit, numbers that are not finite, and radii that are
    not positive.

    >>> import jaxbeads as jb
    >>> pair = jb.Body([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], radius=[2.0, 1.0])
    >>> print(pair.beads, pair.moved([1.0, 0.0, 0.0]).position[:, 0], pair.radii)
    2 [1. 4.] [2. 1.]
    """

    position: Float[Array, "beads 3"] = eqx.field(converter=float_array)
    radius: Float[Array, ""] | Float[Array, " beads"] = eqx.field(converter=float_array)

    def __check_init__(self) -> None:
        size = self.position.shape
        if len(size) != 2 or size[1] != 3 or size[0] < 1:
            fail("position", "have shape (beads, 3)", f"it has shape {size}")
        finite("position", self.position)
        shape("radius", self.radius, (), (size[0],))
        positive("radius", self.radius)

    @property
    def beads(self) -> int:
        """Number of beads."""
        return self.position.shape[0]

    @property
    def radii(self) -> Float[Array, " beads"]:
        """Radius of each bead [length]."""
        return jnp.broadcast_to(self.radius, (self.beads,))

    def moved(self, by: Any) -> "Body":
        """The same body elsewhere in its frame, moved by a vector [length]."""
        by = float_array(by)
        shape("by", by, (3,))
        finite("by", by)
        return Body(self.position + by[None], self.radius)

    def turned(self, axis: Any, angle: Any, about: Any = (0.0, 0.0, 0.0)) -> "Body":
        """The same body, turned about an axis by an angle [rad]; `about`: a point of the axis."""
        axis, angle, about = (float_array(x) for x in (axis, angle, about))
        for name, vector in {"axis": axis, "about": about}.items():
            shape(name, vector, (3,))
            finite(name, vector)
        non_zero("axis", axis)
        shape("angle", angle, ())
        rotation = quaternions.matrix(quaternions.about(axis, angle))
        return Body((self.position - about[None]) @ rotation.T + about[None], self.radius)

    def __add__(self, other: "Body") -> "Body":
        """Two bodies as one, in the frame of both."""
        return Body(
            jnp.concatenate([self.position, other.position]),
            jnp.concatenate([self.radii, other.radii]),
        )
