"""Gears: neighbouring beads roll on one another without slipping."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..chain import Chain
from ..geometry import tangents
from ..pairs import CROSS, PairTensor
from ..state import Motion, State
from .base import (
    AbstractChainConstraint,
    Difference,
    empty,
    ends,
    kept,
    put_block,
    regular,
    relative_bond_errors,
)


class Gears(AbstractChainConstraint):
    """No slip at the contact of neighbouring beads,

        v_i + a_i w_i x e - (v_{i+1} - a_{i+1} w_{i+1} x e) = 0,  e from bead i to i + 1,

    eqs (18)-(21) of Delmotte, Climent & Plouraboué (2015). It keeps the distances of neighbours, turns
    each bond with the mean spin of its beads and leaves bending free. In a chain with a gap a_i is
    the bead's reach, radius plus gap. `slip` has shape `(dim, beads - 1)`; rows between two fibres are
    zero.

    A straight chain also admits the spins w_i = (-1)^i c ("counter-rotation"), which only torques
    or an odd number of beads excite.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.constraint import Gears
    >>> chain = jb.Chain(radius=1.0, fibres=2)
    >>> wheels = jb.Motion(velocity=jnp.zeros((2, 2)), spin=jnp.array([[1.0], [-1.0]]))
    >>> state = jb.straight(chain, [1.0, 0.0])
    >>> print(abs(Gears().slip(jnp.zeros(()), state, wheels, chain)).max())  # they roll on one another
    0.0
    """

    rotational: ClassVar[bool] = True

    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """Velocity difference of the two surfaces at each contact [length/time]."""
        if motion.spin is None:
            raise ValueError("Argument `motion` must hold spins for Gears, but it holds none.")
        v, w, e = motion.velocity.T, motion.spin.T, tangents(state.position).T
        dim, surface = e.shape[0], chain.reach[None, :] * w
        rows = list(v[:, :-1] - v[:, 1:])
        for i, j, k, sign in CROSS[dim]:  # w x e = -(e x w)
            rows[i] = rows[i] - sign * e[j] * (surface[k, :-1] + surface[k, 1:])
        slip = jnp.stack(rows)
        return slip if chain.bond_mask.all() else slip * chain.bond_mask[None, :]

    def assemble(
        self, t: Float[Array, ""], state: State, tensor: PairTensor, chain: Chain
    ) -> Float[Array, "rows rows"]:
        """S block by block: differences and sums of neighbouring rows and columns of M.

        With D = difference of neighbours, A = sum of neighbours' surface velocities and
        u[i,k] = -[e x]_ik: S_ij = D tt_ij D' + D tr_ik A' u_jk + u_ik A rt_kj D' + u_ik A rr_kl A' u_jl.
        Rows between two fibres become a multiple of the identity, so that S stays regular.
        """
        e = tangents(state.position).T
        dim, bonds = e.shape
        lever: list[dict[int, Array]] = [{} for _ in range(dim)]
        for i, j, k, sign in CROSS[dim]:
            lever[i][k] = -sign * e[j]
        if chain.radius.ndim == 0:  # the radius of the surface velocities goes into the lever
            reach = chain.radius + chain.gap
            lever = [{k: reach * u for k, u in row.items()} for row in lever]
            dd, da, ad, spins = ends(-1, -1), ends(-1, 1), ends(1, -1), tensor.rr
        else:
            a = chain.reach
            dd = ends(-1, -1)
            da = _weighted(ends(-1, 1), None, a)
            ad = _weighted(ends(1, -1), a, None)
            spins = [[a[:, None] * f * a[None, :] for f in row] for row in tensor.rr]
        scale = tensor.tt[0][0][0, 0]  # the mobility of a bead
        keep = kept(ends(1, 1), 1 + 0 * scale)
        sums = [[keep(f) for f in row] for row in spins]
        mask = chain.bond_mask
        s = empty(dim * bonds, e.dtype)
        for i in range(dim):
            for j in range(i, dim):
                block = dd(tensor.tt[i][j])
                for k, u in lever[j].items():
                    if (tr := tensor.tr[i][k]) is not None:
                        block = block + tr.sign * da(tr.field) * u[None, :]
                for k, u in lever[i].items():
                    if (rt := tensor.rt[k][j]) is not None:
                        block = block + rt.sign * ad(rt.field) * u[:, None]
                    for m, w in lever[j].items():
                        block = block + sums[k][m] * (u[:, None] * w[None, :])
                block = regular(block, mask, scale if i == j else None)
                s = put_block(s, block, i * bonds, j * bonds)
        return s

    def bond_errors(self, state: State, chain: Chain) -> Float[Array, " bonds"]:
        """Distance of neighbours over its value at rest, minus 1."""
        return relative_bond_errors(state, chain)


def _weighted(difference: Difference, row: Array | None, column: Array | None) -> Difference:
    """As `difference`, of a field whose rows and columns are multiplied by the beads' radii first."""

    def apply(f: Array) -> Array:
        if row is not None:
            f = f * row[:, None]
        if column is not None:
            f = f * column[None, :]
        return difference(f)

    return apply
