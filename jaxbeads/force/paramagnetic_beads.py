"""Beads without moments of their own that a field magnetises."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import shape
from .._typing import float_array, optional_float_array
from ..chain import Chain
from ..magnetism import (
    AbstractMagneticField,
    check_numbers,
    check_permeability,
    dipole_energy,
    magnetic_field,
)
from ..setting import Setting
from ..state import State
from .base import AbstractPotential


class ParamagneticBeads(AbstractPotential):
    """Beads that a field magnetises, alike in all directions, m = chi B(t, r), and the dipole
    interactions of these moments:

        E = -sum of chi B^2/2 - (mu_0/4 pi) sum over pairs of m_i . G(r_i - r_j) m_j

    (see `magnetism.dipole_energy`). A chain of them turns into the field: from afar and with small turns
    it is a `ParamagneticFibre` of chi_bond = 6 zeta(3) mu_0 chi^2/(4 pi (2a)^3), zeta(3) = 1.2021. What
    moments induce in one another is left out, mu_0 chi/(4 pi (2a)^3) is to be small.

    **Arguments**

    - `susceptibility`: chi [force length/field^2], one for all beads or one each, `(beads,)`.
    - `field`, `permeability`: as of `MagneticFibre`.

    **Raises** `ValueError` for numbers that are not finite, a negative permeability and other shapes.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import ParamagneticBeads
    >>> chain = jb.Chain(radius=1.0, fibres=2)
    >>> state, setting = jb.straight(chain, [1.0, 0.0]), jb.Setting(chain, viscosity=1.0)
    >>> beads = ParamagneticBeads(1.0, [4.0, 0.0], permeability=4 * jnp.pi)
    >>> print(beads.load(jnp.zeros(()), state, setting).force + 0.0)  # 6 m^2/(2a)^4
    [[ 6.  0.]
     [-6.  0.]]
    """

    rotational: ClassVar[bool] = False
    susceptibility: Float[Array, ""] | Float[Array, " beads"] = eqx.field(converter=float_array)
    field: AbstractMagneticField = eqx.field(converter=magnetic_field)
    permeability: Float[Array, ""] | None = eqx.field(converter=optional_float_array, default=None)

    def __check_init__(self) -> None:
        check_numbers("susceptibility", self.susceptibility)
        check_permeability(self.permeability)

    @property
    def smooth(self) -> bool:
        """Whether the field is known to be."""
        return self.field.uniform

    def check(self, chain: Chain, dim: int) -> None:
        """Numbers that fit the beads and a field of the scene's dimension."""
        shape("ParamagneticBeads.susceptibility", self.susceptibility, (), (chain.beads,))
        self.field.check(dim, chain.radius.dtype)

    def energy(self, t: Float[Array, ""], state: State, scene: Setting) -> Float[Array, ""]:
        """Energy of all beads [force length]."""
        chain, r = scene.chain, state.position
        field = self.field.at(t, r)
        moment = jnp.broadcast_to(self.susceptibility, chain.beads)[:, None] * field
        energy = -0.5 * jnp.sum(moment * field)
        if self.permeability is None:
            return energy
        return energy + dipole_energy(r, moment, chain.radii, self.permeability, scene.domain)
