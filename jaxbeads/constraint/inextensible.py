"""Inextensible: only the distances of neighbours are kept."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..chain import Chain
from ..geometry import tangents
from ..pairs import PairTensor
from ..state import Motion, State
from .base import AbstractChainConstraint, ends, regular, relative_bond_errors


class Inextensible(AbstractChainConstraint):
    """Neighbours keep their distance and nothing else,

        e . (v_i - v_{i+1}) = 0,  e from bead i to i + 1.

    The multipliers are minus the tensions of the bonds [force]. Beads need not turn: with
    `BendingEnergy` the scene has no rotation at all and a third of the unknowns of `Gears` in space.
    Without rotation a chain of beads lies in a shear flow as a line would (`Gears` for Jeffery orbits).

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.constraint import Inextensible
    >>> chain = jb.Chain(radius=1.0, fibres=2)
    >>> state = jb.straight(chain, [1.0, 0.0])
    >>> apart = jb.Motion(velocity=jnp.array([[0.0, 0.0], [0.5, 3.0]]))
    >>> print(Inextensible().slip(jnp.zeros(()), state, apart, chain))
    [-0.5]
    """

    rotational: ClassVar[bool] = False

    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """Rate at which each bond shortens [length/time], `(beads - 1,)`; 0 between fibres."""
        v, e = motion.velocity, tangents(state.position)
        slip = (e * (v[:-1] - v[1:])).sum(axis=1)
        return slip if chain.bond_mask.all() else slip * chain.bond_mask

    def assemble(
        self, t: Float[Array, ""], state: State, tensor: PairTensor, chain: Chain
    ) -> Float[Array, "rows rows"]:
        """S = e_i (D tt_ij D') e_j, D the difference of neighbours."""
        e, difference = tangents(state.position).T, ends(-1, -1)
        dim = e.shape[0]
        s = jnp.zeros((e.shape[1],) * 2, e.dtype)
        for i in range(dim):
            for j in range(dim):
                s = s + difference(tensor.tt[i][j]) * (e[i][:, None] * e[j][None, :])
        return regular(s, chain.bond_mask, tensor.tt[0][0][0, 0])

    def bond_errors(self, state: State, chain: Chain) -> Float[Array, " bonds"]:
        """Distance of neighbours over its value at rest, minus 1."""
        return relative_bond_errors(state, chain)
