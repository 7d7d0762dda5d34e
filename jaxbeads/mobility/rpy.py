"""Rotne-Prager-Yamakawa: the beads' far-field interactions, regular at any distance."""

from jaxtyping import Array, Float

from .. import tensors
from ..state import Motion
from .base import AbstractMobility


class RPY(AbstractMobility):
    """Rotne-Prager-Yamakawa mobility in an unbounded fluid, for translation alone or with rotation
    (as the scene's other terms need), with the shear-disturbance tensor C.

    Exact to order (a/R)^3 for separate beads and positive definite in every configuration,
    overlapping included; no lubrication. Formulas and sources: `jaxbeads.tensors`.
    """

    def operator(
        self,
        position: Float[Array, "beads dim"],
        radius: Float[Array, ""] | Float[Array, " beads"],
        viscosity: Float[Array, ""],
        rotational: bool,
    ) -> tensors.PairTensor:
        """All pair tensors as `(beads, beads)` fields."""
        return tensors.rpy(position, radius, viscosity, rotational)

    def shear_disturbance(
        self,
        position: Float[Array, "beads dim"],
        radius: Float[Array, ""] | Float[Array, " beads"],
        strain_rate: Float[Array, "*beads dim dim"],
        rotational: bool,
    ) -> Motion:
        """C : E."""
        return tensors.shear_disturbance(position, radius, strain_rate, rotational)
