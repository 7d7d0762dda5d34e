"""A sparse neighbour of S = J M J^T, factorised along the chain: the preconditioner of large scenes.

M is cut into overlapping windows of neighbouring beads, M' = sum over windows of w M w with weights w
whose squares sum to one at each bead: every term is positive, so M' is, and beads keep their own
mobility. With w = sin(pi i / 2h) over 2h beads, windows h apart, neighbours d apart keep cos(pi d / 2h)
of their interaction. S' = J M' J^T couples a bond with those of the next window only. It holds what
makes S ill conditioned, the stiff differences of neighbours; what is left is the far field of modes
longer than a window. It grows like the logarithm of their length, and iterations hardly grow in number:
one fibre of 10 000 beads takes 15 to a relative residual of 1e-12 (`benchmarks/scaling.py`). Without
them a scene of more than 1000 beads would need the whole of S, or hundreds of products with M.

Fibres of up to `MOST_WHOLE` beads are not cut: M' is all that happens within each of them (`Fibres`),
which leaves the far field of other fibres alone.

A direct factorisation of S by clusters (its far blocks are of low rank) would make all this
unnecessary.
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .chain import Chain
from .constraint import AbstractChainConstraint
from .factors import cholesky, inverse_of_triangle, symmetric
from .mobility import Operator
from .state import Load, Motion, State

HALF = 32
"""Bonds in half a window."""
MOST_WHOLE = 150
"""Beads of the longest fibre up to which fibres are windows of their own."""
_MANY = 1000
"""Beads of a scene from which on one load at a time has a form of its own."""
_STEPS = np.arange(2 * HALF + 1)
_WEIGHTS = np.where(_STEPS < 2 * HALF, np.sin(np.pi * _STEPS / (2 * HALF)), 0.0)


class Banded(eqx.Module):
    """L of S' = L L^T by groups of `HALF` bonds: its diagonal blocks, inverted, and those below."""

    inverse: Float[Array, "groups size size"]
    below: Float[Array, "groups size size"]  # from the group before
    bonds: int = eqx.field(static=True)

    def solve(self, rhs: Float[Array, " rows"]) -> Float[Array, " rows"]:
        """S'^-1 rhs."""
        groups, size, _ = self.inverse.shape
        parts = self._cut(rhs)

        def forward(before: Array, group: tuple[Array, ...]) -> tuple[Array, Array]:
            inverse, below, part = group
            found = inverse @ (part - below @ before)
            return found, found

        def backward(after: Array, group: tuple[Array, ...]) -> tuple[Array, Array]:
            inverse, below, part = group
            found = inverse.T @ (part - after)
            return below.T @ found, found

        still = jnp.zeros(size, rhs.dtype)
        _, half = lax.scan(forward, still, (self.inverse, self.below, parts))
        _, found = lax.scan(backward, still, (self.inverse, self.below, half), reverse=True)
        rows = jnp.swapaxes(found.reshape(groups, -1, HALF), 0, 1)
        return rows.reshape(len(rows), -1)[:, : self.bonds].ravel()

    def _cut(self, rhs: Array) -> Float[Array, "groups size"]:
        """Numbers (component, bond) by groups of bonds, with zeros for those that do not exist."""
        groups, size, _ = self.inverse.shape
        rows = rhs.reshape(size // HALF, self.bonds)
        padded = jnp.pad(rows, ((0, 0), (0, groups * HALF - self.bonds)))
        return jnp.swapaxes(padded.reshape(-1, groups, HALF), 0, 1).reshape(groups, size)


class Blocks(eqx.Module):
    """S'^-1 fibre by fibre."""

    inverse: Float[Array, "fibres size size"]
    fibres: tuple[int, ...] = eqx.field(static=True)

    def solve(self, rhs: Float[Array, " rows"]) -> Float[Array, " rows"]:
        """S'^-1 rhs; rows between fibres stay as they are."""
        bonds = padded(self.fibres, 1)
        rows = rhs.reshape(-1, sum(self.fibres) - 1)
        parts = rows.at[:, bonds].get(mode="fill", fill_value=0.0)
        parts = jnp.swapaxes(parts, 0, 1).reshape(len(bonds), -1)
        found = jnp.einsum("fij,fj->fi", self.inverse, parts)
        found = jnp.swapaxes(found.reshape(len(bonds), -1, bonds.shape[1]), 0, 1)
        return rows.at[:, bonds].set(found, mode="drop").ravel()


def padded(fibres: tuple[int, ...], less: int = 0) -> np.ndarray:
    """Numbers of the beads of each fibre (but for so many at its end), a row for each, filled up with a
    number that is too large.
    """
    steps, first = np.arange(max(fibres) - less), np.cumsum((0, *fibres))[:-1, None]
    return np.where(steps < np.array(fibres)[:, None] - less, first + steps, sum(fibres))


class AbstractParts(eqx.Module):
    """M' of one configuration: beads in parts, with weights."""

    state: State
    operator: Operator
    chain: Chain

    @abc.abstractmethod
    def each(self, function: Callable[[Array, Array], Any]) -> Any:
        """function(beads, weights) of each part, one after the other."""

    def motion(self, load: Load, still: Motion, many: bool = True) -> Motion:
        """M' F, in a form for many loads at once, or else for one."""
        many = many or self.chain.beads < _MANY

        def one(beads: Array, weights: Array) -> tuple[Array, Motion]:
            w = weights[:, None]
            part = jax.tree.map(lambda x: w * x[beads], load)
            operator = self.operator
            moved = operator.some(beads).motion(part) if many else operator.among(beads, part)
            return beads, jax.tree.map(lambda v: w * v, moved)

        beads, moved = self.each(one)
        return jax.tree.map(lambda v, part: v.at[beads].add(part), still, moved)

    def matrix(
        self, t: Array, constraint: AbstractChainConstraint, beads: Array, weights: Array
    ) -> Array:
        """S' of a chain constraint in one part."""
        tensor = jax.tree.map(
            lambda f: f * (weights[:, None] * weights[None, :]), self.operator.some(beads)
        )
        radius = self.chain.radius if self.chain.radius.ndim == 0 else self.chain.radius[beads]
        part = Chain(radius, len(beads), self.chain.gap)
        here = jax.tree.map(lambda x: x[beads], self.state)
        return symmetric(constraint.assemble(t, here, tensor, part))


class Fibres(AbstractParts):
    """M' within each fibre."""

    def each(self, function: Callable[[Array, Array], Any]) -> Any:
        """function(beads, weights) of each fibre, one after the other."""
        beads = padded(self.chain.fibres)
        there = beads < self.chain.beads
        weights = jnp.asarray(there, self.state.position.dtype)
        last = beads.max(axis=1, where=there, initial=0)
        beads = jnp.asarray(np.where(there, beads, last[:, None]))
        return lax.map(lambda part: function(*part), (beads, weights))

    def factor(self, t: Array, constraint: AbstractChainConstraint) -> Blocks:
        """S' of a chain constraint, factorised."""

        def inverse(beads: Array, weights: Array) -> Array:
            whole = self.matrix(t, constraint, beads, weights)
            bonds = weights[1:] > 0
            there = jnp.tile(bonds, len(whole) // len(bonds))
            whole = jnp.where(there[:, None] & there[None, :], whole, 0.0) + jnp.diag(~there * 1.0)
            factor, positive = cholesky(whole)
            half = inverse_of_triangle(jnp.where(positive, factor, jnp.nan))
            return half.T @ half

        return Blocks(self.each(inverse), self.chain.fibres)


class Windows(AbstractParts):
    """M' of windows along the chain."""

    @property
    def number(self) -> int:
        """Number of windows; window k holds beads from (k - 1) HALF."""
        return -(-max(self.chain.beads - 1, 1) // HALF) + 1

    def each(self, function: Callable[[Array, Array], Any]) -> Any:
        """function(beads, weights) of each window, one after the other."""
        return lax.map(lambda k: function(*self.window(k)), jnp.arange(self.number))

    def window(self, k: Array) -> tuple[Array, Array]:
        """Beads and weights of a window."""
        beads = (k - 1) * HALF + jnp.arange(2 * HALF + 1)
        there = (beads >= 0) & (beads < self.chain.beads)
        weights = jnp.asarray(_WEIGHTS, self.state.position.dtype) * there
        return jnp.clip(beads, 0, self.chain.beads - 1), weights

    def factor(self, t: Array, constraint: AbstractChainConstraint) -> Banded:
        """S' of a chain constraint, factorised."""
        chain = self.chain
        bonds, groups = chain.beads - 1, self.number - 1

        def block(beads: Array, weights: Array) -> Array:
            whole = self.matrix(t, constraint, beads, weights)
            # (component, first or second half, bond) twice
            cut = whole.reshape(-1, 2, HALF, len(whole) // (2 * HALF), 2, HALF)
            return cut.transpose(1, 4, 0, 2, 3, 5).reshape(2, 2, len(whole) // 2, -1)

        parts = self.each(block)
        diagonal = parts[1:, 0, 0] + parts[:-1, 1, 1]
        below = jnp.roll(parts[1:, 1, 0], 1, axis=0)
        mask = np.pad(chain.bond_mask, (0, groups * HALF - bonds)).reshape(groups, HALF)
        mask = np.tile(mask, (1, diagonal.shape[1] // HALF))
        before = np.roll(mask, 1, axis=0) & (np.arange(groups) > 0)[:, None]
        diagonal = jnp.where(mask[:, :, None] & mask[:, None, :], diagonal, 0.0)
        diagonal = jnp.where(np.eye(mask.shape[1], dtype=bool) & ~mask[:, :, None], 1.0, diagonal)
        below = jnp.where(mask[:, :, None] & before[:, None, :], below, 0.0)

        def step(inverse: Array, group: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
            own, below = group
            below = below @ inverse.T
            factor, positive = cholesky(own - below @ below.T)
            inverse = inverse_of_triangle(jnp.where(positive, factor, jnp.nan))
            return inverse, (inverse, below)

        first = jnp.eye(mask.shape[1], dtype=diagonal.dtype)
        return Banded(*lax.scan(step, first, (diagonal, below))[1], bonds)


def parts(state: State, operator: Operator, chain: Chain) -> Fibres | Windows:
    """M' of a configuration: fibre by fibre, or by windows where a fibre is longer than `MOST_WHOLE`."""
    kind = Fibres if 1 < max(chain.fibres) <= MOST_WHOLE else Windows
    return kind(state, operator, chain)
