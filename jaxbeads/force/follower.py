"""Follower force: a push along the fibre that turns with it."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import fail, finite, shape, whole
from .._typing import float_array
from ..chain import Chain
from ..geometry import tangents
from ..setting import Setting
from ..state import Load, State
from .base import AbstractForce


class Follower(AbstractForce):
    """F = -P e on one bead, with e the direction of the bond at that bead, from the first bead to the
    last: P > 0 compresses a fibre that is held at its other end. (For the first bead, F = +P e.)

    **Arguments**

    - `force`: P [force].
    - `end`: -1 for the last bead, 0 for the first.

    **Raises** `ValueError` for a force that is not one finite number and for other ends. A fibre of one
    bead has no direction: `check` refuses it.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import Follower
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> state, setting = jb.straight(chain, [1.0, 0.0]), jb.Setting(chain, viscosity=1.0)
    >>> print(Follower(2.0).load(jnp.zeros(()), state, setting).force[-1] + 0.0)
    [-2.  0.]
    """

    rotational: ClassVar[bool] = False
    smooth: ClassVar[bool] = True
    force: Float[Array, ""] = eqx.field(converter=float_array)
    end: int = eqx.field(static=True, default=-1)

    def __check_init__(self) -> None:
        shape("force", self.force, ())
        finite("force", self.force)
        whole("end", self.end, -1)
        if self.end > 0:
            raise ValueError(
                f"Argument `end` must be -1 (last bead) or 0 (first), but it is {self.end}."
            )

    def check(self, chain: Chain, dim: int) -> None:
        """A bond at that bead."""
        if chain.fibres[self.end] < 2:
            fibre, bead = self.end % len(chain.fibres), self.end % chain.beads
            must = "be the end of a fibre of two beads or more, along whose last bond it pushes"
            fail("Follower.end", must, f"bead {bead} is all of fibre {fibre}")

    def load(self, t: Float[Array, ""], state: State, scene: Setting) -> Load:
        """The force on that bead."""
        sign = 1.0 if self.end == 0 else -1.0
        push = sign * self.force * tangents(state.position)[self.end]
        return Load(force=jnp.zeros_like(state.position).at[self.end].set(push))
