"""Free draining: every bead feels its own Stokes drag only."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..configuration import Configuration
from ..domain import AbstractDomain
from ..pairs import PairTensor
from ..state import Load, Motion, State, spins, zero_motion
from .base import MOST_DENSE, AbstractMobility, Strain


class FreeDraining(AbstractMobility):
    """No hydrodynamic interactions: v = F/(6 pi mu a), w = T/(8 pi mu a^3), C = 0.

    The cheapest model; a straight chain then has the same friction along and across.

    **Argument**: `dense`: as for `RPY`; otherwise operations grow like the number of beads as well.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> pair = jb.Configuration([[0.0, 0.0], [2.0, 0.0]], radius=1.0, viscosity=1.0)
    >>> load = jb.Load(force=jnp.array([[6 * jnp.pi, 0.0], [0.0, 0.0]]))
    >>> print(jb.mobility.FreeDraining().motion(pair, load).velocity.round(12))
    [[1. 0.]
     [0. 0.]]
    """

    interacting: ClassVar[bool] = False
    domains: ClassVar[tuple[type[AbstractDomain], ...]] = (AbstractDomain,)
    dense: bool | None = eqx.field(static=True, default=None)

    def is_dense(self, beads: int) -> bool:
        """As `dense` says."""
        return beads <= MOST_DENSE if self.dense is None else self.dense

    def motion(self, configuration: Configuration, load: Load) -> Motion:
        """Each load times the mobility of its own bead."""
        translation, rotation = _own(configuration)
        still = zero_motion(State(configuration.position), configuration.rotational)
        velocity, spin = still.velocity, still.spin
        if load.force is not None:
            velocity = velocity + translation * load.force
        if spin is not None and load.torque is not None:
            spin = spin + rotation * load.torque
        return Motion(velocity, spin)

    def tables(self, configuration: Configuration) -> PairTensor:
        """Diagonal fields."""
        own = jnp.eye(configuration.beads, dtype=configuration.position.dtype)

        def diagonal(mobility: Array, size: int) -> tuple[tuple[Array, ...], ...]:
            return tuple(tuple(own * mobility * (i == j) for j in range(size)) for i in range(size))

        translation, rotation = _own(configuration)
        dim, turns = configuration.dim, spins(configuration.dim)
        tt = diagonal(translation, dim)
        if not configuration.rotational:
            return PairTensor(tt)
        tr, rt = ((None,) * turns,) * dim, ((None,) * dim,) * turns
        return PairTensor(tt, tr, rt, diagonal(rotation, turns))

    def gradient(
        self,
        configuration: Configuration,
        load: Load,
        strain: Strain | None,
        shifts: Float[Array, "shifts beads dim"],
    ) -> None:
        """None: the mobility is the same everywhere."""
        return None


def _own(configuration: Configuration) -> tuple[Array, Array]:
    """1/(6 pi mu a) and 1/(8 pi mu a^3), one for all beads or a column."""
    radius, viscosity = configuration.radius, configuration.viscosity
    one = 1 / (radius if radius.ndim == 0 else radius[:, None])
    # First the quotient: in single precision a^3 is hardly there, its derivatives less.
    return one / (6 * np.pi) / viscosity, one * one * one / (8 * np.pi) / viscosity
