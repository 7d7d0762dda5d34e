"""Rotne-Prager-Yamakawa: the beads' far-field interactions, regular at any distance."""

from collections.abc import Callable

import equinox as eqx
from jaxtyping import Array, Float

from .. import tensors
from ..pairs import PairTensor
from ..state import Load, Motion
from .base import AbstractMobility


class RPY(AbstractMobility):
    """Rotne-Prager-Yamakawa mobility in an unbounded fluid, for translation alone or with rotation
    (as the scene's other terms need), with the shear-disturbance tensor C.

    Exact to order (a/R)^3 for separate beads and positive definite in every configuration,
    overlapping included; no lubrication. Formulas and sources: `jaxbeads.tensors`.

    **Argument**: `strained`: whether beads resist the strain of the ambient flow (C); without it they
    are carried as points, which many bead models assume.
    """

    strained: bool = eqx.field(static=True, default=True)

    def operator(
        self,
        position: Float[Array, "beads dim"],
        radius: Float[Array, ""] | Float[Array, " beads"],
        viscosity: Float[Array, ""],
        rotational: bool,
    ) -> PairTensor:
        """All pair tensors as `(beads, beads)` fields."""
        return tensors.rpy(position, radius, viscosity, rotational)

    def shear_disturbance(
        self,
        position: Float[Array, "beads dim"],
        radius: Float[Array, ""] | Float[Array, " beads"],
        strain_rate: Float[Array, "*beads dim dim"],
        rotational: bool,
    ) -> Motion | None:
        """C : E."""
        if not self.strained:
            return None
        return tensors.shear_disturbance(position, radius, strain_rate, rotational)

    def motion(
        self,
        position: Float[Array, "beads dim"],
        radius: Float[Array, ""] | Float[Array, " beads"],
        viscosity: Float[Array, ""],
        rotational: bool,
        load: Load,
    ) -> Motion:
        """M F, pair by pair."""
        return tensors.rpy_motion(position, radius, viscosity, rotational, load)

    def gradient(
        self,
        position: Float[Array, "beads dim"],
        radius: Float[Array, ""] | Float[Array, " beads"],
        viscosity: Float[Array, ""],
        rotational: bool,
        load: Load,
        strain: Callable[[Array], Array] | None,
        shifts: Float[Array, "shifts beads dim"],
    ) -> Motion | None:
        """Derivatives of M F + C:E, found for pairs."""
        strain = strain if self.strained else None
        if load.force is None and load.torque is None and strain is None:
            return None
        return tensors.rpy_gradient(position, radius, viscosity, rotational, load, strain, shifts)
