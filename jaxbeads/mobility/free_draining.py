"""Free draining: every bead feels its own Stokes drag only."""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..state import Load, Motion, State, zero_motion
from .base import AbstractMobility


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


class FreeDraining(AbstractMobility):
    """No hydrodynamic interactions: v = F/(6 pi mu a), w = T/(8 pi mu a^3), C = 0.

    The cheapest model; a straight chain then has the same friction along and across.
    """

    def operator(
        self,
        position: Float[Array, "beads dim"],
        radius: Float[Array, ""] | Float[Array, " beads"],
        viscosity: Float[Array, ""],
        rotational: bool,
    ) -> _Drag:
        """Diagonal mobility."""
        a = radius if radius.ndim == 0 else radius[:, None]
        translation, rotation = 6 * np.pi * viscosity * a, 8 * np.pi * viscosity * a**3
        return _Drag(1 / translation, 1 / rotation, zero_motion(State(position), rotational))

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
