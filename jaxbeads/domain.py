"""`AbstractDomain`: the space that fluid and beads are in.

Pair sums ask it what separates two points, a start whether it lies inside, and a mobility says in which
domains it holds. `Unbounded` is all there is yet; a wall or a box is a class in this file, and its name
in the `domains` of the mobilities that serve it.
"""

import abc
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array, Float

SYMMETRIES = frozenset({"translation", "rotation", "reflection"})
"""What may be done to fluid and beads together so that nothing else changes."""


class AbstractDomain(eqx.Module):
    """The space that fluid and beads are in. What is not said here is as in an unbounded fluid."""

    symmetries: ClassVar[frozenset[str]] = SYMMETRIES
    """Those of `SYMMETRIES` that the domain has."""

    def check(self, dim: int) -> None:
        """Refuse a dimension that the domain cannot have, in one sentence."""

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
        boundary."""
        return None


class Unbounded(AbstractDomain):
    """All of space."""

    def nearest(self, separation: Sequence[Any], unit: Any) -> Sequence[Any]:
        """The separation itself."""
        return separation
