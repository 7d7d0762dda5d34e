"""Frozen joints: a fibre of infinite bending rigidity."""

from typing import ClassVar

from jaxtyping import Array, Float

from ..chain import Chain
from ..geometry import bonds, cross
from ..state import Motion, State
from .base import AbstractConstraint


class FrozenJoints(AbstractConstraint):
    """Successive bonds turn at the same rate, so that the angles at the joints stay as they are.

    The limit K_b -> infinity of `Bending`, without its small time step; together with a constraint
    that keeps the bond lengths the fibre is rigid, while its beads may still roll. Planar scenes only.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.constraint import FrozenJoints
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> state = jb.straight(chain, [1.0, 0.0])
    >>> turn = jb.Motion(velocity=jnp.array([[0.0, -1.0], [0.0, 0.0], [0.0, 1.0]]))
    >>> bend = jb.Motion(velocity=jnp.array([[0.0, 1.0], [0.0, 0.0], [0.0, 1.0]]))
    >>> for moved in (turn, bend):
    ...     print(FrozenJoints().slip(jnp.zeros(()), state, moved, chain).ravel())
    [0.]
    [1.]
    """

    rotational: ClassVar[bool] = False
    turning: ClassVar[bool] = True
    planar: ClassVar[bool] = True
    internal: ClassVar[bool] = True

    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """Difference of the turning rates of the two bonds at each joint [1/time], `(joints,)`."""
        d = bonds(state.position)
        turning = cross(d, bonds(motion.velocity))[:, 0] / (d * d).sum(axis=1)
        return (turning[1:] - turning[:-1])[chain.joint_mask]
