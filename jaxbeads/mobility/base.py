"""What a mobility is."""

import abc
from typing import Protocol, runtime_checkable

import equinox as eqx
from jaxtyping import Array, Float

from ..state import Load, Motion


@runtime_checkable
class MobilityOperator(Protocol):
    """The mobility M of one configuration, applied to loads.

    A `tensors.PairTensor` is one; so is any object with this method. The fast assembly of the
    constraint matrix needs a `PairTensor`; everything else works with any operator.
    """

    def motion(self, load: Load) -> Motion:
        """M F: linear in the load and symmetric."""
        ...


class AbstractMobility(eqx.Module):
    """Linear relation of loads and motion in Stokes flow, for any configuration of beads.

    Qdot = M(Q) F + V_inf + C(Q) : E, eq. (13) of Delmotte, Climent & Plouraboué (2015).
    """

    @abc.abstractmethod
    def operator(
        self,
        position: Float[Array, "beads dim"],
        radius: Float[Array, ""] | Float[Array, " beads"],
        viscosity: Float[Array, ""],
        rotational: bool,
    ) -> MobilityOperator:
        """M at this configuration; without spins and torques unless `rotational`."""

    @abc.abstractmethod
    def shear_disturbance(
        self,
        position: Float[Array, "beads dim"],
        radius: Float[Array, ""] | Float[Array, " beads"],
        strain_rate: Float[Array, "*beads dim dim"],
        rotational: bool,
    ) -> Motion | None:
        """C : E for the ambient rate of strain at the beads [1/time]; `None` if there is none."""
