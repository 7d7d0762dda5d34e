"""`Configuration`: spheres in a viscous fluid at one instant, which is all that a mobility is told."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ._typing import float_array
from .domain import AbstractDomain, Unbounded
from .pairs import Field, Radii, pair_sums, radii_of, separations


class Configuration(eqx.Module):
    """Spheres in a viscous fluid.

    **Arguments**

    - `position`: centres, `(beads, dim)` [length].
    - `radius`: one for all or one per bead [length].
    - `viscosity`: mu [force time/length^2].
    - `rotational`: whether spins and torques take part.
    - `domain`: the space that they are in.
    - `pieces`: how many of the spheres, one after the other, are near to one another, as the beads of
      fibres are; a hint, on which no more than rounding depends.

    >>> import jaxbeads as jb
    >>> beads = jb.Configuration([[0.0, 0.0], [3.0, 0.0]], radius=[1.0, 2.0], viscosity=1.0)
    >>> print(beads.beads, beads.dim, beads.scaled.length)
    2 2 2.0
    """

    position: Float[Array, "beads dim"] = eqx.field(converter=float_array)
    radius: Float[Array, ""] | Float[Array, " beads"] = eqx.field(converter=float_array)
    viscosity: Float[Array, ""] = eqx.field(converter=float_array)
    rotational: bool = eqx.field(static=True, default=True)
    domain: AbstractDomain = Unbounded()
    pieces: tuple[int, ...] | None = eqx.field(static=True, default=None)

    @property
    def beads(self) -> int:
        """Number of spheres."""
        return self.position.shape[0]

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.position.shape[1]

    def at(self, position: Float[Array, "beads dim"]) -> "Configuration":
        """The same spheres elsewhere."""
        return eqx.tree_at(lambda c: c.position, self, position)

    def some(self, beads: Int[Array, " some"]) -> "Configuration":
        """Some of the spheres, as if there were no others."""
        radius = self.radius if self.radius.ndim == 0 else self.radius[beads]
        return Configuration(
            self.position[beads], radius, self.viscosity, self.rotational, self.domain
        )

    @property
    def scaled(self) -> "Scaled":
        """Lengths in units of the radius, or of the largest one: on that no result depends, nor does a
        derivative.
        """
        position, radius = self.position, self.radius
        if radius.ndim == 0:
            return Scaled(radius, position / radius, None, self.domain)
        length = lax.stop_gradient(jnp.max(radius))
        return Scaled(length, position / length, radius / length, self.domain)


class Scaled(NamedTuple):
    """The unit of length of a configuration, with positions and radii in it."""

    length: Array
    position: Array
    radius: Array | None
    """`None`: 1 for all."""
    domain: AbstractDomain

    def _separations(self, to: Array, of: Array) -> list[Field]:
        return list(self.domain.nearest(separations(to, of), self.length))

    def pairs(self) -> tuple[list[Field], Radii | None]:
        """Separations and radii of all pairs."""
        radii = None if self.radius is None else radii_of(self.radius, self.radius)
        return self._separations(self.position, self.position), radii

    def sums(self, fields: Callable[[list[Field], Radii | None], Sequence[Field]]) -> list[Array]:
        """Sums over j of functions of r_i - r_j and the radii, see `pair_sums`."""
        if self.radius is None:
            return pair_sums(lambda to, of: fields(self._separations(to, of), None), self.position)

        def unequal(to: tuple[Array, Array], of: tuple[Array, Array]) -> Sequence[Field]:
            return fields(self._separations(to[0], of[0]), radii_of(to[1], of[1]))

        return pair_sums(unequal, (self.position, self.radius))
