"""What a mobility is."""

import abc
from collections.abc import Callable
from typing import ClassVar, Protocol, runtime_checkable

import equinox as eqx
import jax
from jaxtyping import Array, Float, Int

from ..pairs import PairTensor
from ..state import Load, Motion, add_motions

MOST_DENSE = 1000
"""Beads up to which a mobility is dense unless it is told otherwise."""


@runtime_checkable
class MobilityOperator(Protocol):
    """The mobility M of one configuration, applied to loads.

    A `pairs.PairTensor` is one; so is any object with this method. The fast assembly of the
    constraint matrix needs a `PairTensor`, iterations a `MatrixFree`; everything else works with any
    operator.
    """

    def motion(self, load: Load) -> Motion:
        """M F: linear in the load and symmetric."""
        ...


@runtime_checkable
class MatrixFree(MobilityOperator, Protocol):
    """A mobility that is nowhere kept as a whole. The multipliers are found by iterations, see
    `windows`, and no array grows faster than the number of beads."""

    def among(self, beads: Int[Array, " some"]) -> PairTensor:
        """The mobility of some beads, as tables."""
        ...


class AbstractMobility(eqx.Module):
    """Linear relation of loads and motion in Stokes flow, for any configuration of beads.

    Qdot = M(Q) F + V_inf + C(Q) : E, eq. (13) of Delmotte, Climent & Plouraboué (2015).
    """

    interacting: ClassVar[bool] = True
    """Whether beads move one another, so that two of one size in one place move as one."""

    def is_dense(self, beads: int) -> bool:
        """Whether the multipliers of so many beads are found by a factorisation; otherwise `operator`
        is `MatrixFree`."""
        return True

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

    def motion(
        self,
        position: Float[Array, "beads dim"],
        radius: Float[Array, ""] | Float[Array, " beads"],
        viscosity: Float[Array, ""],
        rotational: bool,
        load: Load,
    ) -> Motion:
        """M F for one load, in the form that is differentiated."""
        return self.operator(position, radius, viscosity, rotational).motion(load)

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
        """Derivatives of M F + C:E along shifts of the positions, with F held, for implicit solvers.

        One shift after the other, vectorised, unless a mobility knows better.

        **Arguments**: as above; `strain`: the ambient rate of strain as a function of the positions,
        or `None`. **Returns** motions with a leading axis of shifts; `None` if nothing depends on the
        positions.
        """

        def moved(x: Array) -> Motion:
            motion = self.operator(x, radius, viscosity, rotational).motion(load)
            if strain is None:
                return motion
            disturbance = self.shear_disturbance(x, radius, strain(x), rotational)
            return motion if disturbance is None else add_motions(motion, disturbance)

        _, push = jax.linearize(moved, position)
        return jax.vmap(push)(shifts)
