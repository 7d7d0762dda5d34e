"""A user's function of time and position as force or potential, without a class of its own."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from .._typing import leaf_function
from ..chain import Chain
from ..state import Load, State
from .base import AbstractForce, AbstractPotential


class ForceField(AbstractForce):
    """F = f(t, r) from a function of the time and all positions, `(beads, dim)`, that returns forces
    of the same shape. A function that is a pytree (an `equinox.Module`) keeps its parameters as
    leaves; what a plain function closes over is constant."""

    rotational: ClassVar[bool] = False
    function: Callable[[Array, Array], Array] = eqx.field(converter=leaf_function)

    def load(self, t: Float[Array, ""], state: State, chain: Chain) -> Load:
        """The function's value as forces."""
        return Load(force=self.function(t, state.position))


class Potential(AbstractPotential):
    """E = f(t, r) from a function of the time and all positions, `(beads, dim)`, that returns an
    energy; the force is minus its gradient. Leaves as in `ForceField`."""

    rotational: ClassVar[bool] = False
    function: Callable[[Array, Array], Array] = eqx.field(converter=leaf_function)

    def energy(self, t: Float[Array, ""], state: State, chain: Chain) -> Float[Array, ""]:
        """The function's value."""
        return self.function(t, state.position)
