"""`AbstractDomain`: the space that fluid and beads are in.

Pair sums ask it what separates two points, a start whether it lies inside, and a mobility says in which
domains it holds. `Unbounded`, `NoSlipWall`, `FreeSurface`; a box would be a class in this file, and its
name in the `domains` of the mobilities that serve it.
"""

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._checks import fail, finite, known, non_zero, shape
from ._typing import float_array

SYMMETRIES = frozenset({"translation", "rotation", "reflection"})
"""What may be done to fluid and beads together so that nothing else changes."""


class AbstractDomain(eqx.Module):
    """The space that fluid and beads are in. What is not said here is as in an unbounded fluid.

    >>> import numpy as np
    >>> from jaxbeads.domain import AbstractDomain
    >>> class Channel(AbstractDomain):  # the same again every ten lengths along x
    ...     def nearest(self, separation, unit):
    ...         x, *others = separation
    ...         return [x - (10.0 / unit) * (unit * x / 10.0).round(), *others]
    >>> print(Channel().nearest([np.array(9.0), np.array(3.0)], 1.0)[0])
    -1.0
    """

    symmetries: ClassVar[frozenset[str]] = SYMMETRIES
    """Those of `SYMMETRIES` that the domain has."""

    def check(self, dim: int) -> None:
        """Refuse a dimension that the domain cannot have, in one sentence."""

    def check_flow(self, name: str, velocity: Callable[[Array, Array], Array], dim: int) -> None:
        """Refuse, in one sentence, an ambient flow that the domain cannot have.

        **Arguments**: its name; the velocity as a function of a time and a point; dimensions.
        """

    @abc.abstractmethod
    def nearest(self, separation: Sequence[Any], unit: Any) -> Sequence[Any]:
        """What separates two points, or their nearest images.

        **Arguments**: components of r_i - r_j, fields of any shape (of JAX or NumPy), in units of a
        length; that length. **Returns** components in the same units.
        """

    def clearance(
        self, position: Float[Array, "beads dim"], radius: Float[Array, "*beads"]
    ) -> Float[Array, " beads"] | None:
        """Distance of each bead's surface from the boundary, negative outside [length]; `None` without a
        boundary.
        """
        return None


class Unbounded(AbstractDomain):
    """All of space.

    >>> import jaxbeads as jb
    >>> print(jb.Scene(jb.Chain(radius=1.0, fibres=3), viscosity=1.0).domain)
    Unbounded()
    """

    def nearest(self, separation: Sequence[Any], unit: Any) -> Sequence[Any]:
        """The separation itself."""
        return separation


class AbstractHalfSpace(AbstractDomain):
    """The fluid on one side of a plane.

    **Arguments**: `point`, any of the plane [length]; `normal`, of any length, into the fluid.

    **Raises** `ValueError` for a zero normal, numbers that are not finite, and other shapes than
    `(2,)` or `(3,)`.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.domain import AbstractHalfSpace, NoSlipWall
    >>> wall = NoSlipWall([0.0, 1.0], [0.0, 2.0])
    >>> print(isinstance(wall, AbstractHalfSpace), wall.direction, wall.height(jnp.array([[5.0, 4.0]])))
    True [0. 1.] [3.]
    """

    symmetries: ClassVar[frozenset[str]] = frozenset()
    point: Float[Array, " dim"] = eqx.field(converter=float_array)
    normal: Float[Array, " dim"] = eqx.field(converter=float_array)

    def __check_init__(self) -> None:
        shape("point", self.point, (2,), (3,))
        shape("normal", self.normal, self.point.shape)
        finite("point", self.point)
        finite("normal", self.normal)
        non_zero("normal", self.normal[None])

    @property
    def direction(self) -> Float[Array, " dim"]:
        """The normal at length one."""
        return self.normal / jnp.sqrt(jnp.sum(self.normal * self.normal))

    def check(self, dim: int) -> None:
        """A plane of the scene's dimensions (in the plane its normal lies in it)."""
        if self.point.shape != (dim,):
            must = f"hold a point and a normal of {dim} components"
            fail("scene.domain", must, f"they have {self.point.shape[0]}")

    def nearest(self, separation: Sequence[Any], unit: Any) -> Sequence[Any]:
        """The separation itself."""
        return separation

    def height(self, position: Float[Array, "beads dim"]) -> Float[Array, " beads"]:
        """Distance of each centre from the plane [length]."""
        return jnp.sum((position - self.point[None]) * self.direction[None], axis=1)

    def clearance(
        self, position: Float[Array, "beads dim"], radius: Float[Array, "*beads"]
    ) -> Float[Array, " beads"]:
        """The height less the radius."""
        return self.height(position) - radius


_PLACES = np.random.default_rng(0).uniform(-1.0, 1.0, (16, 3)) * np.logspace(-1, 2, 16)[:, None]


def _refuse_flow(
    plane: AbstractHalfSpace, name: str, slips: Callable[[Array, Array], Array]
) -> None:
    """Refuse a flow of which something does not vanish at some points of a plane, for some time, as it
    does not one unit of length above them.
    """
    if not known((plane.point, plane.normal)):
        return
    normal = plane.direction
    places = jnp.asarray(_PLACES[:, : len(normal)], normal.dtype)
    on = places - jnp.sum(places * normal[None], axis=1, keepdims=True) * normal[None]
    for t, x in zip(np.linspace(0.0, 7.0, len(on)), on, strict=True):
        points = plane.point + x, plane.point + x + normal
        found = [slips(jnp.asarray(t, x.dtype), point) for point in points]
        if not known(found):
            return
        at, above = (float(np.abs(np.asarray(u)).max()) for u in found)
        if at > 1e-9 * above:
            place = ", ".join(f"{c:.3g}" for c in np.asarray(points[0]))
            must = f"be one that a {type(plane).__name__} lets be"
            how = f"it slips or pushes at ({place}), t = {t:.3g}"
            fail(f"scene.flow ({name})", must, how, "How do I put it near a wall?")


class NoSlipWall(AbstractHalfSpace):
    """A plane to which the fluid sticks, as of glass: `NoSlipWall([0, 0], [0, 1])` is the fluid above
    y = 0. Ambient flows must vanish at it.

    **Arguments** and **Raises**: as for `AbstractHalfSpace`.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> wall = jb.NoSlipWall([0.0, 0.0], [0.0, 1.0])
    >>> beads = jb.Configuration([[0.0, 2.0]], radius=1.0, viscosity=1.0, domain=wall)
    >>> free = jb.Configuration([[0.0, 2.0]], radius=1.0, viscosity=1.0)
    >>> load, rpy = jb.Load(force=jnp.array([[1.0, 0.0]])), jb.mobility.RPY()
    >>> slowed = rpy.motion(beads, load).velocity[0, 0] / rpy.motion(free, load).velocity[0, 0]
    >>> print(f"{slowed:.4f}")  # 1 - (9/16) a/h + (1/8) (a/h)^3 - (1/16) (a/h)^5
    0.7324
    """

    def check_flow(self, name: str, velocity: Callable[[Array, Array], Array], dim: int) -> None:
        """Refuse a flow that does not vanish at the wall."""
        _refuse_flow(self, name, velocity)


class FreeSurface(AbstractHalfSpace):
    """A flat surface without friction, as of water under air, which nothing bends. Ambient flows must
    neither cross nor shear it.

    **Arguments** and **Raises**: as for `AbstractHalfSpace`.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> surface = jb.FreeSurface([0.0, 0.0], [0.0, -1.0])  # water below, air above
    >>> print(surface.clearance(jnp.array([[0.0, -3.0]]), jnp.array(1.0)))
    [2.]
    """

    def check_flow(self, name: str, velocity: Callable[[Array, Array], Array], dim: int) -> None:
        """Refuse a flow with a velocity across the surface, or a shear stress at it."""
        n = self.direction

        def across(t: Array, x: Array) -> Array:
            return velocity(t, x) @ n

        def stress(t: Array, x: Array) -> Array:
            gradient = jax.jacfwd(lambda x: velocity(t, x))(x)
            pull = (gradient + gradient.T) @ n
            return pull - (pull @ n) * n

        _refuse_flow(self, name, across)
        _refuse_flow(self, name, stress)
