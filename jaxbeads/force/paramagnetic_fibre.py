"""Fibres that a field magnetises more easily along than across."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import shape
from .._typing import float_array
from ..chain import Chain
from ..geometry import tangents
from ..magnetism import AbstractMagneticField, check_numbers, magnetic_field
from ..setting import Setting
from ..state import State
from .base import AbstractPotential


class ParamagneticFibre(AbstractPotential):
    """Bonds that a field magnetises more easily along than across,

        E = -sum over bonds of chi (e . B)^2/2,

    e the bond's direction and B the field at its middle: on each bond the torque chi (e . B) e x B (as
    of a chain of superparamagnetic beads, Dreyfus et al., Nature 437 (2005) 862), as equal and opposite
    forces on its two beads, and the force of -dE/dr where the field has a gradient. It serves every
    chain.

    **Arguments**

    - `susceptibility`: chi [force length/field^2], one for all bonds or one each, `(beads - 1,)`; per
      length of a fibre of touching beads it is chi/(2a).
    - `field`: as of `MagneticFibre`.

    It is not `stiff`, as there, with chi B^2 for m B.

    **Raises** `ValueError` for numbers that are not finite and other shapes.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import ParamagneticFibre
    >>> chain = jb.Chain(radius=1.0, fibres=2)
    >>> state, setting = jb.straight(chain, [1.0, 0.0]), jb.Setting(chain, viscosity=1.0)
    >>> tilted = ParamagneticFibre(2.0, [3.0, 1.0])  # chi B_x B_y/2a
    >>> print(tilted.load(jnp.zeros(()), state, setting).force + 0.0)
    [[ 0. -3.]
     [ 0.  3.]]
    """

    rotational: ClassVar[bool] = False
    susceptibility: Float[Array, ""] | Float[Array, " bonds"] = eqx.field(converter=float_array)
    field: AbstractMagneticField = eqx.field(converter=magnetic_field)

    def __check_init__(self) -> None:
        check_numbers("susceptibility", self.susceptibility)

    @property
    def smooth(self) -> bool:
        """Whether the field is known to be."""
        return self.field.uniform

    def check(self, chain: Chain, dim: int) -> None:
        """Numbers that fit the bonds and a field of the scene's dimension."""
        bonds = max(chain.beads - 1, 0)
        shape("ParamagneticFibre.susceptibility", self.susceptibility, (), (bonds,))
        self.field.check(dim, chain.radius.dtype)

    def energy(self, t: Float[Array, ""], state: State, scene: Setting) -> Float[Array, ""]:
        """Energy of all bonds [force length]."""
        r = state.position
        along = jnp.sum(tangents(r) * self.field.at(t, 0.5 * (r[1:] + r[:-1])), axis=1)
        return -0.5 * jnp.sum(self.susceptibility * scene.chain.bond_mask * along**2)
