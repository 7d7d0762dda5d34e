"""What a force is, and a force that follows from an energy."""

import abc

import equinox as eqx
import jax
from jaxtyping import Array, Float

from ..chain import Chain
from ..state import Load, State


class AbstractForce(eqx.Module):
    """Loads on the beads as a function of time and configuration."""

    rotational: eqx.AbstractClassVar[bool]
    """Whether the load holds torques."""

    @abc.abstractmethod
    def load(self, t: Float[Array, ""], state: State, chain: Chain) -> Load:
        """Forces and torques on the beads."""


class AbstractPotential(AbstractForce):
    """A force that is minus the gradient of an energy. `energy` is all that it has to say."""

    rotational: eqx.AbstractClassVar[bool]

    @abc.abstractmethod
    def energy(self, t: Float[Array, ""], state: State, chain: Chain) -> Float[Array, ""]:
        """Energy of the configuration [force length]."""

    def load(self, t: Float[Array, ""], state: State, chain: Chain) -> Load:
        """F = -dE/dr."""

        def energy(position: Array) -> Array:
            return self.energy(t, State(position, state.director), chain)

        return Load(force=-jax.grad(energy)(state.position))
