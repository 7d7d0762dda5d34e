"""Equal spins: neighbouring beads turn as one body."""

from typing import ClassVar

from jaxtyping import Array, Float

from ..chain import Chain
from ..state import Motion, State
from .base import AbstractConstraint


class EqualSpins(AbstractConstraint):
    """w_i = w_{i+1}: together with `Gears` or `Joint` it makes each fibre a rigid body, in the plane and
    in space. (`FrozenJoints` also freezes the shape, but lets the beads roll.)

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.constraint import EqualSpins
    >>> chain = jb.Chain(radius=1.0, fibres=2)
    >>> wheels = jb.Motion(velocity=jnp.zeros((2, 2)), spin=jnp.array([[1.0], [-1.0]]))
    >>> state = jb.straight(chain, [1.0, 0.0])
    >>> print(EqualSpins().slip(jnp.zeros(()), state, wheels, chain).ravel())
    [-2.]
    """

    rotational: ClassVar[bool] = True
    turning: ClassVar[bool] = True
    internal: ClassVar[bool] = True

    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """Difference of neighbours' spins [1/time], `(bonds, spins)` of the bonds that exist."""
        if motion.spin is None:
            raise ValueError("Argument `motion` must hold spins for EqualSpins, but it holds none.")
        return (motion.spin[1:] - motion.spin[:-1])[chain.bond_mask]
