"""Rotne-Prager-Yamakawa: the beads' far-field interactions, regular at any distance."""

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from .. import tensors
from ..configuration import Configuration
from ..pairs import PairTensor
from ..state import Load, Motion
from .base import MOST_DENSE, AbstractMobility, Strain


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

    tabulated: ClassVar[bool] = True
    strained: bool = eqx.field(static=True, default=True)
    dense: bool | None = eqx.field(static=True, default=None)

    def is_dense(self, beads: int) -> bool:
        """As `dense` says."""
        return beads <= MOST_DENSE if self.dense is None else self.dense

    def motion(self, configuration: Configuration, load: Load) -> Motion:
        """M F, pair by pair."""
        return tensors.rpy_motion(configuration, load)

    def disturbance(
        self, configuration: Configuration, strain_rate: Float[Array, "*beads dim dim"]
    ) -> Motion | None:
        """C : E."""
        return tensors.shear_disturbance(configuration, strain_rate) if self.strained else None

    def tables(self, configuration: Configuration) -> PairTensor:
        """All pair tensors as `(beads, beads)` fields."""
        return tensors.rpy(configuration)

    def gradient(
        self,
        configuration: Configuration,
        load: Load,
        strain: Strain | None,
        shifts: Float[Array, "shifts beads dim"],
    ) -> Motion | None:
        """Derivatives of M F + C:E, found for pairs."""
        strain = strain if self.strained else None
        if load.force is None and load.torque is None and strain is None:
            return None
        return tensors.rpy_gradient(configuration, load, strain, shifts)
