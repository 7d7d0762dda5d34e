"""Weight: the same force on each bead, always."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import fail, finite, shape
from .._typing import float_array
from ..chain import Chain
from ..setting import Setting
from ..state import Load, State
from .base import AbstractForce


class Weight(AbstractForce):
    """Constant force on each bead (buoyancy subtracted).

    **Arguments**

    - `force`: force on a bead [force], shape `(dim,)` for all alike or `(beads, dim)`.

    **Raises** `ValueError` for forces that are not finite or of another shape.

    >>> import jaxbeads as jb
    >>> import numpy as np
    >>> from jaxbeads.force import Weight
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=1), 1.0, forces=[Weight([0.0, -6 * np.pi])])
    >>> print(jb.dynamics.motion(0.0, jb.State([[0.0, 0.0]]), scene).velocity.round(12))
    [[ 0. -1.]]
    """

    rotational: ClassVar[bool] = False
    smooth: ClassVar[bool] = True
    force: Float[Array, " dim"] | Float[Array, "beads dim"] = eqx.field(converter=float_array)

    def __init__(self, force: Any) -> None:
        self.force = float_array(force)

    def __check_init__(self) -> None:
        if self.force.ndim not in (1, 2) or self.force.shape[-1] not in (2, 3):
            fail("force", "have shape (dim,) or (beads, dim)", f"it has shape {self.force.shape}")
        finite("force", self.force)

    def check(self, chain: Chain, dim: int) -> None:
        """A force of the scene's dimension."""
        shape("Weight.force", self.force, (dim,), (chain.beads, dim))

    def load(self, t: Float[Array, ""], state: State, scene: Setting) -> Load:
        """The weight of each bead."""
        return Load(force=jnp.broadcast_to(self.force, state.position.shape))
