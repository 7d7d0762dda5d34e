"""Rotne-Prager-Yamakawa: the beads' far-field interactions, regular at any distance."""

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from .. import images, mirror, tensors
from ..configuration import Configuration
from ..domain import AbstractDomain, FreeSurface, NoSlipWall, Unbounded
from ..pairs import PairTensor
from ..state import Load, Motion, add_motions
from .base import MOST_DENSE, AbstractMobility, Strain


class RPY(AbstractMobility):
    """Rotne-Prager-Yamakawa mobility in an unbounded fluid or a half space, for translation alone or
    with rotation (as the scene's other terms need), with the shear-disturbance tensor C.

    Exact to order (a/R)^3 for separate beads and positive definite in every configuration,
    overlapping included; no lubrication. Formulas and sources: `jaxbeads.tensors`; of a no-slip wall
    `jaxbeads.images`, of a free surface `jaxbeads.mirror`.

    **Arguments**

    - `strained`: whether beads resist the strain of the ambient flow (C); without it they are carried
      as points, which many bead models assume.
    - `dense`: whether the mobility is kept as tables of `(beads, beads)` and the multipliers are found
      by a factorisation. Otherwise pairs are summed anew for each product, multipliers are iterated
      (to 1e-12), and memory grows like the number of beads; `Rosenbrock` and steady states need the
      tables. By default up to 1000 beads.
    """

    tabulated: ClassVar[bool] = True
    domains: ClassVar[tuple[type[AbstractDomain], ...]] = (Unbounded, NoSlipWall, FreeSurface)
    strained: bool = eqx.field(static=True, default=True)
    dense: bool | None = eqx.field(static=True, default=None)

    def is_dense(self, beads: int) -> bool:
        """As `dense` says."""
        return beads <= MOST_DENSE if self.dense is None else self.dense

    def motion(self, configuration: Configuration, load: Load) -> Motion:
        """M F, pair by pair."""
        if isinstance(configuration.domain, NoSlipWall):
            wall = images.wall(configuration)
            load = wall.slowed(load)
            free = tensors.rpy_motion(wall.configuration, load)
            return wall.slowed(add_motions(free, wall.motion(load)))
        motion = tensors.rpy_motion(configuration, load)
        if isinstance(configuration.domain, FreeSurface):
            motion = add_motions(motion, mirror.motion(configuration, load))
        return motion

    def disturbance(
        self, configuration: Configuration, strain_rate: Float[Array, "*beads dim dim"]
    ) -> Motion | None:
        """C : E."""
        if not self.strained:
            return None
        if isinstance(configuration.domain, NoSlipWall):
            wall = images.wall(configuration)
            free = tensors.shear_disturbance(wall.configuration, strain_rate)
            return wall.slowed(add_motions(free, wall.disturbance(strain_rate)))
        carried = tensors.shear_disturbance(configuration, strain_rate)
        if isinstance(configuration.domain, FreeSurface):
            carried = add_motions(carried, mirror.disturbance(configuration, strain_rate))
        return carried

    def tables(self, configuration: Configuration) -> PairTensor:
        """All pair tensors as `(beads, beads)` fields."""
        if isinstance(configuration.domain, NoSlipWall):
            wall = images.wall(configuration)
            return wall.slowed_tables(images.added(tensors.rpy(wall.configuration), wall.tables()))
        tables = tensors.rpy(configuration)
        if isinstance(configuration.domain, FreeSurface):
            tables = images.added(tables, mirror.tables(configuration))
        return tables

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
        if not isinstance(configuration.domain, Unbounded):
            return super().gradient(configuration, load, strain, shifts)
        return tensors.rpy_gradient(configuration, load, strain, shifts)
