"""Joint: neighbouring beads are linked by a ball-and-socket joint ahead of their surfaces."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..chain import Chain, linked
from ..geometry import bonds, norm, spin_cross, unit
from ..pairs import CROSS, PairTensor
from ..state import Motion, State
from .base import AbstractChainConstraint, empty, ends, put_block, regular


class Joint(AbstractChainConstraint):
    """The Joint Model: neighbours share the joint at l_i = a_i + eps_g along their directors p,

        v_i + l_i w_i x p_i - (v_{i+1} - l_{i+1} w_{i+1} x p_{i+1}) = 0,

    the time derivative of r_i + l_i p_i = r_{i+1} - l_{i+1} p_{i+1}, eqs (2), (3) and (40) of Delmotte,
    Climent & Plouraboué (2015). States need directors along the fibre (`from_directors`). The gap
    eps_g of the chain lets it bend up to a curvature before beads overlap
    (`dimensionless.largest_joint_curvature`). Pair it with `JointBending`. `slip` has shape
    `(dim, beads - 1)`; rows between two fibres are zero.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.constraint import Joint
    >>> chain = jb.Chain(radius=1.0, fibres=2, gap=0.1)
    >>> state = jb.from_directors(chain, [[1.0, 0.0], [1.0, 0.0]])
    >>> still = jb.Motion(velocity=jnp.zeros((2, 2)), spin=jnp.array([[1.0], [0.0]]))
    >>> print(Joint().slip(jnp.zeros(()), state, still, chain).ravel())  # l w at the joint, across
    [0.  1.1]
    """

    rotational: ClassVar[bool] = True
    oriented: ClassVar[bool] = True

    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """Velocity difference of the two beads at each joint [length/time]."""
        if motion.spin is None or state.director is None:
            raise ValueError(
                "Argument `state` must hold directors and `motion` spins for Joint, but they do not."
            )
        v = motion.velocity
        turn = spin_cross(motion.spin, state.director * chain.reach[:, None])
        slip = (v[:-1] - v[1:] + turn[:-1] + turn[1:]).T
        return slip if chain.bond_mask.all() else slip * chain.bond_mask[None, :]

    def assemble(
        self, t: Float[Array, ""], state: State, tensor: PairTensor, chain: Chain
    ) -> Float[Array, "rows rows"]:
        """S block by block, as for `Gears`, with the levers u[i,k] = -l [p x]_ik of the beads."""
        if state.director is None:
            raise ValueError("Argument `state` must hold directors for Joint, but it holds none.")
        p = (state.director * chain.reach[:, None]).T
        dim, bonds = p.shape[0], p.shape[1] - 1
        lever: list[dict[int, Array]] = [{} for _ in range(dim)]
        for i, j, k, sign in CROSS[dim]:
            lever[i][k] = -sign * p[j]
        dd, da, ad, aa = ends(-1, -1), ends(-1, 1), ends(1, -1), ends(1, 1)
        mask, scale = chain.bond_mask, tensor.tt[0][0][0, 0]
        s = empty(dim * bonds, p.dtype)
        for i in range(dim):
            for j in range(i, dim):
                block = dd(tensor.tt[i][j])
                for k, u in lever[j].items():
                    if (entry := tensor.tr[i][k]) is not None:
                        block = block + entry.sign * da(entry.field * u[None, :])
                for k, u in lever[i].items():
                    if (entry := tensor.rt[k][j]) is not None:
                        block = block + entry.sign * ad(entry.field * u[:, None])
                    for m, w in lever[j].items():
                        block = block + aa(u[:, None] * tensor.rr[k][m] * w[None, :])
                block = regular(block, mask, scale if i == j else None)
                s = put_block(s, block, i * bonds, j * bonds)
        return s

    def bond_errors(self, state: State, chain: Chain) -> Float[Array, " bonds"]:
        """Distance of the two beads' joints over the bond length, or the error of their directors'
        lengths if that is larger: time stepping keeps eq. (2), which is linear, even where it fails.
        """
        if state.director is None:
            raise ValueError("Argument `state` must hold directors for Joint, but it holds none.")
        apart = norm(bonds(state.position) - linked(chain, state.director))
        off = jnp.abs(norm(state.director) - 1)
        worst = jnp.maximum(apart / chain.bond_length, jnp.maximum(off[:-1], off[1:]))
        return worst * chain.bond_mask

    def directions(self, state: State, chain: Chain) -> Float[Array, "directions dim"]:
        """The directors, at length one."""
        if state.director is None:
            raise ValueError("Argument `state` must hold directors for Joint, but it holds none.")
        return unit(state.director)

    def bonds(
        self, direction: Float[Array, "directions dim"], chain: Chain
    ) -> Float[Array, "bonds dim"]:
        """Vectors between neighbours whose joints coincide."""
        return linked(chain, direction)
