"""Rotne-Prager-Yamakawa: the beads' far-field interactions, regular at any distance."""

from collections.abc import Callable

import equinox as eqx
from jaxtyping import Array, Float, Int

from .. import tensors
from ..pairs import PairTensor
from ..state import Load, Motion
from .base import MOST_DENSE, AbstractMobility


class PairSums(eqx.Module):
    """M of one configuration, of which nothing is kept: every product sums over all pairs again."""

    position: Float[Array, "beads dim"]
    radius: Float[Array, "*beads"]
    viscosity: Float[Array, ""]
    rotational: bool = eqx.field(static=True)

    def motion(self, load: Load) -> Motion:
        """M F."""
        return tensors.rpy_motion(self.position, self.radius, self.viscosity, self.rotational, load)

    def among(self, beads: Int[Array, " some"]) -> PairTensor:
        """The mobility of some beads, as tables."""
        radius = self.radius if self.radius.ndim == 0 else self.radius[beads]
        return tensors.rpy(self.position[beads], radius, self.viscosity, self.rotational)


class RPY(AbstractMobility):
    """Rotne-Prager-Yamakawa mobility in an unbounded fluid, for translation alone or with rotation
    (as the scene's other terms need), with the shear-disturbance tensor C.

    Exact to order (a/R)^3 for separate beads and positive definite in every configuration,
    overlapping included; no lubrication. Formulas and sources: `jaxbeads.tensors`.

    **Arguments**

    - `strained`: whether beads resist the strain of the ambient flow (C); without it they are carried
      as points, which many bead models assume.
    - `dense`: whether the mobility is kept as tables of `(beads, beads)` and the multipliers are found
      by a factorisation. Otherwise pairs are summed anew for each product, multipliers are iterated
      (to 1e-12), and memory grows like the number of beads; `Rosenbrock` and steady states need the
      tables. By default up to 1000 beads.
    """

    strained: bool = eqx.field(static=True, default=True)
    dense: bool | None = eqx.field(static=True, default=None)

    def is_dense(self, beads: int) -> bool:
        """As `dense` says."""
        return beads <= MOST_DENSE if self.dense is None else self.dense

    def operator(
        self,
        position: Float[Array, "beads dim"],
        radius: Float[Array, ""] | Float[Array, " beads"],
        viscosity: Float[Array, ""],
        rotational: bool,
    ) -> PairTensor | PairSums:
        """All pair tensors as `(beads, beads)` fields, or their sums."""
        if not self.is_dense(len(position)):
            return PairSums(position, radius, viscosity, rotational)
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
