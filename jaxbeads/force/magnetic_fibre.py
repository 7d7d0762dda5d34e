"""Permanent magnetic moments along a fibre."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import fail, shape
from .._typing import float_array, optional_float_array
from ..chain import Chain
from ..geometry import tangents, unit
from ..magnetism import (
    AbstractMagneticField,
    check_numbers,
    check_permeability,
    magnetic_energy,
    magnetic_field,
)
from ..setting import Setting
from ..state import State
from .base import AbstractPotential


class MagneticFibre(AbstractPotential):
    """Permanent moments m t on the beads, t the fibre's tangent at the bead: the mean direction of its
    bonds, towards the last bead. The energy of `magnetism` as one of the positions alone,

        E = -sum of m t . B(t, r) + that of all pairs of moments,

    so that what turns the moments acts as forces on the centres. It serves every chain; under `Gears`
    a fibre so turns without a torque that would make its beads counter-rotate.

    **Arguments**

    - `moment`: m [force length/field], one for all beads or one each, `(beads,)`.
    - `field`: B: a field of `jaxbeads.magnetism`, a vector `(dim,)` [field], or a function of the time
      and one point. In a planar scene it lies in the plane.
    - `permeability`: mu_0 [field length^3/moment], for dipole interactions between all beads; by default
      there are none.

    It is not `stiff`: bending of rigidity K_b over bonds of length l is faster by 4 K_b/(m B l), which
    is large in a field that bends the fibre as a whole. Implicit solvers take its derivatives with all
    others.

    **Raises** `ValueError` for numbers that are not finite, a negative permeability and other shapes. A
    fibre of one bead has no tangent: `check` refuses it.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import MagneticFibre
    >>> chain = jb.Chain(radius=1.0, fibres=2)
    >>> state, setting = jb.straight(chain, [1.0, 0.0]), jb.Setting(chain, viscosity=1.0)
    >>> print(MagneticFibre(3.0, [0.0, 2.0]).load(jnp.zeros(()), state, setting).force + 0.0)  # 2 m B/2a
    [[ 0. -6.]
     [ 0.  6.]]
    """

    rotational: ClassVar[bool] = False
    moment: Float[Array, ""] | Float[Array, " beads"] = eqx.field(converter=float_array)
    field: AbstractMagneticField = eqx.field(converter=magnetic_field)
    permeability: Float[Array, ""] | None = eqx.field(converter=optional_float_array, default=None)

    def __check_init__(self) -> None:
        check_numbers("moment", self.moment)
        check_permeability(self.permeability)

    @property
    def smooth(self) -> bool:
        """Whether the field is known to be."""
        return self.field.uniform

    def check(self, chain: Chain, dim: int) -> None:
        """Tangents, moments that fit the beads and a field of the scene's dimension."""
        if min(chain.fibres) < 2:
            must = "have fibres of two beads or more, which have tangents (see `MagneticBeads`)"
            fail("scene.chain", must, f"it has fibres of {chain.fibres} beads")
        shape("MagneticFibre.moment", self.moment, (), (chain.beads,))
        self.field.check(dim, chain.radius.dtype)

    def moments(self, state: State, chain: Chain) -> Float[Array, "beads dim"]:
        """m t."""
        e = tangents(state.position) * chain.bond_mask[:, None]
        both = jnp.pad(e, ((0, 1), (0, 0))) + jnp.pad(e, ((1, 0), (0, 0)))
        return jnp.broadcast_to(self.moment, chain.beads)[:, None] * unit(both)

    def energy(self, t: Float[Array, ""], state: State, scene: Setting) -> Float[Array, ""]:
        """Energy in the field and of all pairs [force length]."""
        chain, moment = scene.chain, self.moments(state, scene.chain)
        given: Any = self.field, self.permeability, chain.radii, scene.domain
        return magnetic_energy(t, state.position, moment, *given)
