"""Contact: beads that meet and are no neighbours repel each other."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import non_negative, positive, shape
from .._typing import float_array
from ..chain import Chain
from ..state import Load, State
from .base import AbstractForce, repulsion


class Contact(AbstractForce):
    """Repulsion along the line of centres between beads of different fibres, and between beads of one
    fibre that are not neighbours. Its profile over the distance of the surfaces is that of eq. (43).

    **Arguments**

    - `strength`: F_0, the force where the surfaces overlap by the roughness [force]; half of it where
      they touch.
    - `roughness`: delta_D, distance of the surfaces at which it sets in [length].
    - `decay`: d_0, length of the exponential growth beyond [length].

    **Raises** `ValueError` for a negative strength and lengths that are not positive.
    """

    rotational: ClassVar[bool] = False
    strength: Float[Array, ""] = eqx.field(converter=float_array)
    roughness: Float[Array, ""] = eqx.field(converter=float_array)
    decay: Float[Array, ""] = eqx.field(converter=float_array)

    def __check_init__(self) -> None:
        for name in ("strength", "roughness", "decay"):
            shape(name, getattr(self, name), ())
        non_negative("strength", self.strength)
        positive("roughness", self.roughness)
        positive("decay", self.decay)

    def load(self, t: Float[Array, ""], state: State, chain: Chain) -> Load:
        """Forces on the beads; they sum to zero."""
        i, fibre = np.arange(chain.beads), chain.fibre_of_bead
        near = (abs(i[:, None] - i[None, :]) <= 1) & (fibre[:, None] == fibre[None, :])
        d = [x[:, None] - x[None, :] for x in state.position.T]
        square = sum(x * x for x in d)
        skip = near | (square == 0)  # coincident beads have no line of centres
        distance = jnp.sqrt(jnp.where(skip, 1.0, square))
        gap = distance - chain.radii[:, None] - chain.radii[None, :]
        push = jnp.where(skip, 0.0, repulsion(gap, self.roughness, self.decay) / distance)
        force = jnp.stack([jnp.sum(push * x, axis=1) for x in d], axis=1)
        return Load(force=self.strength * force)
