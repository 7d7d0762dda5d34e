"""Free draining: every bead feels its own Stokes drag only."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..pairs import PairTensor
from ..state import Load, Motion, State, zero_motion
from .base import MOST_DENSE, AbstractMobility


class _Drag(eqx.Module):
    translation: Array
    rotation: Array
    rest: Motion

    def motion(self, load: Load) -> Motion:
        """Each load times the mobility of its own bead."""
        velocity, spin = self.rest.velocity, self.rest.spin
        if load.force is not None:
            velocity = velocity + self.translation * load.force
        if spin is not None and load.torque is not None:
            spin = spin + self.rotation * load.torque
        return Motion(velocity, spin)


class _FreeDrag(_Drag):
    """The same, for iterations."""

    def among(self, beads: Int[Array, " some"]) -> PairTensor:
        """The mobility of some beads, as tables."""
        own, none = jnp.eye(len(beads), dtype=self.rest.velocity.dtype), None

        def diagonal(mobility: Array, size: int) -> tuple[tuple[Array, ...], ...]:
            field = own * (mobility if mobility.ndim == 0 else mobility[beads])
            return tuple(tuple(field * (i == j) for j in range(size)) for i in range(size))

        dim, spin = self.rest.velocity.shape[1], self.rest.spin
        tt = diagonal(self.translation, dim)
        if spin is None:
            return PairTensor(tt)
        turns = spin.shape[1]
        tr, rt = ((none,) * turns,) * dim, ((none,) * dim,) * turns
        return PairTensor(tt, tr, rt, diagonal(self.rotation, turns))


class FreeDraining(AbstractMobility):
    """No hydrodynamic interactions: v = F/(6 pi mu a), w = T/(8 pi mu a^3), C = 0.

    The cheapest model; a straight chain then has the same friction along and across.

    **Argument**: `dense`: as for `RPY`; otherwise operations grow like the number of beads as well.
    """

    interacting: ClassVar[bool] = False
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
    ) -> _Drag:
        """Diagonal mobility."""
        a = radius if radius.ndim == 0 else radius[:, None]
        one = 1 / a  # first: in single precision a^3 is hardly there, its derivatives less
        translation, rotation = one / (6 * np.pi), one * one * one / (8 * np.pi)
        drag = _Drag if self.is_dense(len(position)) else _FreeDrag
        still = zero_motion(State(position), rotational)
        return drag(translation / viscosity, rotation / viscosity, still)

    def shear_disturbance(
        self,
        position: Float[Array, "beads dim"],
        radius: Float[Array, ""] | Float[Array, " beads"],
        strain_rate: Float[Array, "*beads dim dim"],
        rotational: bool,
    ) -> None:
        """None: a bead does not see the others' stresslets."""
        return None

    def gradient(
        self,
        position: Float[Array, "beads dim"],
        radius: Float[Array, ""] | Float[Array, " beads"],
        viscosity: Float[Array, ""],
        rotational: bool,
        load: Load,
        strain: Callable[[Array], Array] | None,
        shifts: Float[Array, "shifts beads dim"],
    ) -> None:
        """None: the mobility is the same everywhere."""
        return None
