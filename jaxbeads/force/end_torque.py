"""A torque on the end of a fibre: what turns it, about a fixed axis or about itself."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import fail, finite, shape, whole
from .._typing import float_array
from ..chain import Chain
from ..geometry import bonds, norm, unit
from ..setting import Setting
from ..state import Load, State
from .base import AbstractForce


class EndTorque(AbstractForce):
    """A torque on the material frame of an end bead of a fibre in space, of the power
    M . (t x t' + (w . t) t): what it has along the fibre turns the bead, what it has across it is a
    couple of forces on the two beads of the last bond, which turns the bond (a bead alone may spin
    without it).

    **Arguments**

    - `torque`: M [force length]; a vector `(3,)` that keeps its direction, or a number, a torque about
      the fibre's own direction there, from the first bead to the last.
    - `end`: -1 for the last bead, 0 for the first.

    **Raises** `ValueError` for other shapes, numbers that are not finite, and other ends.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import EndTorque
    >>> chain = jb.Chain(radius=1.0, fibres=2)
    >>> state, setting = jb.straight(chain, [1.0, 0.0, 0.0]), jb.Setting(chain, viscosity=1.0)
    >>> load = EndTorque([0.5, 0.0, 6.0]).load(jnp.zeros(()), state, setting)
    >>> print(load.torque[1], load.force[:, 1])
    [0.5 0.  0. ] [-3.  3.]
    """

    rotational: ClassVar[bool] = True
    smooth: ClassVar[bool] = True
    torque: Float[Array, ""] | Float[Array, " 3"] = eqx.field(converter=float_array)
    end: int = eqx.field(static=True, default=-1)

    def __check_init__(self) -> None:
        shape("torque", self.torque, (), (3,))
        finite("torque", self.torque)
        whole("end", self.end, -1)
        if self.end > 0:
            fail("end", "be -1 (last bead) or 0 (first)", f"it is {self.end}")

    def check(self, chain: Chain, dim: int) -> None:
        """A bond at that bead, in space."""
        if dim != 3:
            fail("state", "be in space for EndTorque", "it is planar")
        if chain.fibres[self.end] < 2:
            must = "be the end of a fibre of two beads or more, whose last bond it turns"
            fail("EndTorque.end", must, f"fibre {self.end % len(chain.fibres)} is one bead")

    def load(self, t: Float[Array, ""], state: State, scene: Setting) -> Load:
        """Torque on that bead, forces on it and its neighbour."""
        first = 0 if self.end == 0 else scene.chain.beads - 2
        bond = bonds(state.position)[first]
        e = unit(bond)
        along = self.torque if self.torque.ndim == 0 else jnp.sum(self.torque * e)
        torque = jnp.zeros_like(state.position).at[self.end].set(along * e)
        if self.torque.ndim == 0:
            return Load(torque=torque)
        push = jnp.cross(self.torque, e) / norm(bond)
        force = jnp.zeros_like(state.position).at[first].set(-push).at[first + 1].set(push)
        return Load(force, torque)
