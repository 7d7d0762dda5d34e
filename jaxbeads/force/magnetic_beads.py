"""Permanent magnetic moments that are fixed to beads."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import fail, shape
from .._typing import float_array, optional_float_array
from ..chain import Chain
from ..magnetism import (
    AbstractMagneticField,
    check_numbers,
    check_permeability,
    magnetic_field,
    moment_load,
)
from ..setting import Setting
from ..state import Load, State
from .base import AbstractForce


class MagneticBeads(AbstractForce):
    """Permanent moments m p fixed to the beads along their directors p: on each the torque m p x b, with
    b the field and that of the other moments, and the force grad (m p . b).

    States need directors (`from_directors`, or `State(position, director)`). Directors turn with their
    beads; those of a `Gears` chain may counter-rotate, so that a magnetic fibre of that kind is better a
    `MagneticFibre`.

    **Arguments**: as of `MagneticFibre`; a bead without a moment has the moment 0.

    **Raises** `ValueError` for numbers that are not finite, a negative permeability and other shapes.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import MagneticBeads
    >>> needle = jb.State([[0.0, 0.0]], director=[[1.0, 0.0]])
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=1), 1.0, forces=[MagneticBeads(4.0, [0.0, 2.0])])
    >>> print(jb.dynamics.motion(0.0, needle, scene).spin * jnp.pi)  # m B/(8 pi mu a^3)
    [[1.]]
    """

    rotational: ClassVar[bool] = True
    oriented: ClassVar[bool] = True
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
        """Moments that fit the beads and a field of the scene's dimension."""
        shape("MagneticBeads.moment", self.moment, (), (chain.beads,))
        self.field.check(dim, chain.radius.dtype)

    def load(self, t: Float[Array, ""], state: State, scene: Setting) -> Load:
        """Torques, and forces where the field has a gradient or moments interact."""
        chain = scene.chain
        if state.director is None:
            fail("state", "hold directors for MagneticBeads", "it holds none")
        moment = jnp.broadcast_to(self.moment, chain.beads)[:, None] * state.director
        given: Any = self.field, self.permeability, chain.radii, scene.domain
        return moment_load(t, state.position, moment, *given)
