"""Spring: neighbours held together by springs instead of constraints."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import fail, non_negative, shape
from .._typing import float_array
from ..chain import Chain
from ..geometry import bond_lengths
from ..setting import Setting
from ..state import State
from .base import AbstractPotential
from .curvature import stiffest


class Spring(AbstractPotential):
    """Linear springs along the bonds, E = sum of k_s (|r_{i+1} - r_i| - l)^2 / 2 with l the bond length
    of the chain: the Spring Model, eq. (1).

    Lengths are kept approximately and beads do not turn with the fibre, so the model misses what
    depends on thickness, as the tumbling of a fibre that lies along a shear flow.

    **Arguments**: `stiffness` k_s [force/length], one for all bonds or one each, `(beads - 1,)`.

    **Raises** `ValueError` for a negative stiffness or another shape.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import Spring
    >>> setting = jb.Setting(jb.Chain(radius=1.0, fibres=2), viscosity=1.0)
    >>> stretched = jb.State([[0.0, 0.0], [2.5, 0.0]])  # by 0.5
    >>> print(Spring(4.0).load(jnp.zeros(()), stretched, setting).force + 0.0)
    [[ 2.  0.]
     [-2.  0.]]
    """

    rotational: ClassVar[bool] = False
    smooth: ClassVar[bool] = True
    links: ClassVar[bool] = True
    stiff: ClassVar[bool] = True
    stiffness: Array = eqx.field(converter=float_array)

    def __check_init__(self) -> None:
        if self.stiffness.ndim > 1:
            must = "be one number or one for each bond"
            fail("stiffness", must, f"it has shape {self.stiffness.shape}")
        non_negative("stiffness", self.stiffness)

    def check(self, chain: Chain, dim: int) -> None:
        """One stiffness for each bond."""
        shape("Spring.stiffness", self.stiffness, (), (max(chain.beads - 1, 0),))

    def energy(self, t: Float[Array, ""], state: State, scene: Setting) -> Float[Array, ""]:
        """Energy of all springs [force length]."""
        chain = scene.chain
        stretch = bond_lengths(state.position) - chain.bond_length
        return 0.5 * jnp.sum(self.stiffness * chain.bond_mask * stretch**2)

    def explicit_step(self, scene: Setting) -> Float[Array, ""]:
        """6 pi mu a / (16 k_s): the fastest rate is 4 k_s / (6 pi mu a)."""
        most = stiffest(self.stiffness, scene.chain.bond_mask)
        drag = 6 * np.pi * scene.viscosity * jnp.min(scene.chain.radius)
        return jnp.where(most == 0, jnp.inf, drag / (16 * jnp.where(most == 0, 1.0, most)))
