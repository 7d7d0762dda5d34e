"""`Setting`: what every term of a scene may read, beads, fluid and space."""

import equinox as eqx
from jaxtyping import Array, Float

from ._checks import kind, positive, shape
from ._typing import float_array
from .chain import Chain
from .configuration import Configuration
from .domain import AbstractDomain, Unbounded
from .state import State


class Setting(eqx.Module):
    """Beads in a fluid, without what acts on them: what a force is given beside time and state.

    **Arguments**: `chain`, the beads; `viscosity`, mu [force time/length^2]; `domain`, the space.

    **Raises** `ValueError` for a viscosity that is not positive and arguments of the wrong kind.

    >>> import jaxbeads as jb
    >>> setting = jb.Setting(jb.Chain(radius=1.0, fibres=3), viscosity=2.0)
    >>> print(setting.chain.beads, setting.viscosity, setting.domain)
    3 2.0 Unbounded()
    """

    chain: Chain
    viscosity: Float[Array, ""] = eqx.field(converter=float_array)
    domain: AbstractDomain = eqx.field(default=Unbounded(), kw_only=True)

    def __check_init__(self) -> None:
        shape("viscosity", self.viscosity, ())
        positive("viscosity", self.viscosity)
        kind("chain", self.chain, Chain)
        kind("domain", self.domain, AbstractDomain)

    def configuration(self, state: State, rotational: bool) -> Configuration:
        """The beads as spheres in the fluid, with spins or without."""
        return Configuration(
            state.position,
            self.chain.radius,
            self.viscosity,
            rotational,
            self.domain,
            self.chain.fibres,
        )
