"""Pairs of beads that touch, in what is solved instead of implicit stages.

There fibres are taken one by one (`near`), with a matrix D0 for the rates of each. Repulsion grows
within a small part of a radius, and a step may go as far as a radius: what pairs do to one another is
stiff, and not linear. So of pairs that may touch, of which v_c takes rates to the rate at which they
part, and u_c is the rate of the coordinates under unit forces that push them apart, forces p and gaps s
are found together: with s0 the gaps that fibres alone would have, without any push,

    p = push(s),   s = s0 + g V^T W p,   W = D0^-1 U

by Newton's method on a matrix of pairs by pairs. Derivatives go by the linear form

    D^-1 = D0^-1 - W (1 + g K V^T W)^-1 g K V^T D0^-1,   K = -dp/ds

(Woodbury). In a stage pushes are unknowns of their own: those of gaps at which iterations try their way,
as deep as a radius, say nothing. Fluid between fibres is left out, as in all of `near`.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from .chain import Chain
from .factors import inverse, solve
from .force import AbstractTouching
from .geometry import unit

MOST_PAIRS, FEW_PAIRS = 512, 64
"""Pairs that are taken together; of so few less is solved."""
_PART = 4
"""Numbers of a fibre over the most pairs that it takes part in."""
_FEWEST = 4
_MOST = 30
"""Newton's iterations."""
_ENOUGH = 1e-10
"""Gaps are found to this part of the least radius, or as well as rounding allows."""
_STILL = 1e3
"""How much farther off they may be at the end."""

Parts = Float[Array, "fibres size"]
Pairs = Float[Array, " pairs"]


def room(fibres: int, size: int) -> tuple[int, int]:
    """Of how many pairs, and of how many in each fibre, account is taken, where fibres have `size`
    numbers each.
    """
    slots = max(_FEWEST, size // _PART)
    return min(MOST_PAIRS, fibres * slots // 2), slots


def placed(
    pairs: AbstractTouching, chain: Chain, slots: int
) -> tuple[AbstractTouching, Int[Array, "fibres slots"], Int[Array, "fibres slots"]]:
    """Pairs, without those for which a fibre has no room in its slots; and of each slot the pair and the
    bead (numbers that are too large: none).
    """
    fibres, number = len(chain.fibres), len(pairs.first)
    bead = jnp.stack([pairs.first, pairs.second], axis=1).ravel()
    fibre = jnp.where(jnp.repeat(pairs.there, 2), jnp.asarray(chain.fibre_of_bead)[bead], fibres)
    order = jnp.argsort(fibre, stable=True)
    begin = jnp.searchsorted(fibre[order], jnp.arange(fibres + 1))
    slot = jnp.zeros_like(bead).at[order].set(jnp.arange(2 * number) - begin[fibre[order]])
    fits = ((slot < slots) & (fibre < fibres)).reshape(-1, 2).all(axis=1)
    row = jnp.where(jnp.repeat(fits, 2), fibre, fibres)
    none = jnp.full((fibres, slots), number)
    which = none.at[row, slot].set(jnp.repeat(jnp.arange(number), 2), mode="drop")
    at = jnp.full((fibres, slots), chain.beads).at[row, slot].set(bead, mode="drop")
    return eqx.tree_at(lambda p: p.there, pairs, fits), which, at


def stiffness(pairs: AbstractTouching, gap: Pairs) -> Pairs:
    """-dp/ds of the first pairs, if they are there."""
    return -jax.jvp(lambda s: _push(pairs, s), (gap,), (jnp.ones_like(gap),))[1]


def _push(pairs: AbstractTouching, gap: Pairs) -> Pairs:
    return jnp.where(pairs.there[: len(gap)], pairs.push(gap), 0.0)


class Touches(eqx.Module):
    """Pairs that touch, in the rates of fibres."""

    pairs: AbstractTouching
    which: Int[Array, "fibres slots"]
    """The pair of each fibre's slots."""
    parting: Float[Array, "fibres slots size"]
    """V."""
    response: Float[Array, "fibres slots size"]
    """W."""
    opened: Float[Array, "pairs pairs"]
    """g V^T W: by how much gaps open under unit pushes."""
    small: Float[Array, "pairs pairs"]
    """(1 + g K V^T W)^-1 g K."""
    ahead: Float[Array, ""]
    enough: Float[Array, ""]
    """To which gaps are found."""

    def pushed(self, rate: Parts) -> Pairs:
        """Change of pushes where fibres alone would go at these rates; linear."""
        return -self.small @ self._along(self.parting, rate)

    def pushed_back(self, rate: Parts, velocity: Float[Array, "beads dim"] | None) -> Parts:
        """The transpose of `pushed`, of rates by pushes and of velocities by their forces."""
        push = self._along(self.response, rate)
        if velocity is not None:
            way = velocity[self.pairs.first] - velocity[self.pairs.second]
            push = push + jnp.sum(self.pairs.direction * way, axis=1)
        return -self._spread(self.parting, self.small.T @ push)

    def first(self, position: Float[Array, "beads dim"], implicit: Array) -> Pairs:
        """Pushes to begin with; of an explicit stage those that there are."""
        gap = self.pairs.gap(position)
        return _push(self.pairs, jnp.where(implicit, jnp.maximum(gap, self.pairs.deep), gap))

    def beside(self, position: Float[Array, "beads dim"], push: Pairs) -> Float[Array, "beads dim"]:
        """What forces on the beads are more where pairs push so, and not as their gaps say."""
        more = push - _push(self.pairs, self.pairs.gap(position))
        return self._on_beads(more[:, None] * unit(self.pairs.apart(position)), len(position))

    def met(self, rate: Parts, gap: Pairs, push: Pairs) -> Pairs:
        """Change of pushes, which need not be those of the gaps, where fibres alone would go at these
        rates; NaN where none is found.
        """
        alone = gap + self.ahead * self._along(self.parting, rate) - self.opened @ push
        number = len(push)
        if number <= FEW_PAIRS:
            return self._pressed(alone) - push
        # Nearest pairs come first.
        last = jnp.max(jnp.where(self.pairs.there, jnp.arange(1, number + 1), 0))

        def few() -> Pairs:
            return jnp.pad(self._pressed(alone[:FEW_PAIRS]), (0, number - FEW_PAIRS))

        return lax.cond(last <= FEW_PAIRS, few, lambda: self._pressed(alone)) - push

    def _pressed(self, alone: Pairs) -> Pairs:
        """Pushes of the first pairs, the others without any, from the gaps that there would be without;
        NaN where none are found.
        """
        number = len(alone)
        opened = self.opened[:number, :number]

        def off(s: Pairs) -> Pairs:
            return s - alone - opened @ _push(self.pairs, s)

        def unfinished(turn: tuple[Array, ...]) -> Array:
            _, left, count = turn
            return (jnp.max(jnp.abs(left), initial=0.0) > self.enough) & (count < _MOST)

        def newton(turn: tuple[Array, ...]) -> tuple[Array, ...]:
            s, left, count = turn
            stiff = stiffness(self.pairs, s)
            matrix = jnp.eye(number, dtype=s.dtype) + opened * stiff[None, :]
            # From where a push is too small its tangent leads far too deep.
            s = s + jnp.maximum(-solve(matrix, left), -0.5 * jnp.abs(self.pairs.deep))
            return s, off(s), count + 1

        first = jnp.maximum(alone, self.pairs.deep)
        turn = first, off(first), jnp.zeros((), int)
        s, left, _ = lax.while_loop(unfinished, newton, turn)
        found = jnp.max(jnp.abs(left), initial=0.0) <= _STILL * self.enough
        return jnp.where(found, _push(self.pairs, s), jnp.nan)

    def moved(self, push: Pairs) -> Parts:
        """W p."""
        return self._spread(self.response, push)

    def forces(self, push: Pairs, beads: int) -> Float[Array, "beads dim"]:
        """Those of pushes on the beads."""
        return self._on_beads(push[:, None] * self.pairs.direction, beads)

    def _on_beads(self, force: Float[Array, "pairs dim"], beads: int) -> Float[Array, "beads dim"]:
        none = jnp.zeros((beads, force.shape[1]), force.dtype)
        return none.at[self.pairs.first].add(force).at[self.pairs.second].add(-force)

    def _along(self, rows: Array, rate: Parts) -> Pairs:
        found = jnp.einsum("fsi,fi->fs", rows, rate)
        return jnp.zeros(len(self.small), rate.dtype).at[self.which].add(found, mode="drop")

    def _spread(self, rows: Array, push: Pairs) -> Parts:
        each = push.at[self.which].get(mode="fill", fill_value=0.0)
        return jnp.einsum("fsi,fs->fi", rows, each)


def touches(
    pairs: AbstractTouching,
    chain: Chain,
    position: Float[Array, "beads dim"],
    pushed: Callable[[Float[Array, "beads dim"]], tuple[Parts, Parts]],
    alone: Callable[[Array], Array],
    ahead: Float[Array, ""],
) -> Touches:
    """Pairs that touch.

    **Arguments**: pairs; the chain, and where its beads are; f -> the rates under forces f, u, and v,
    whose product with rates is f times the velocities; D0^-1 of a stack of rates; g.
    """
    size = jax.eval_shape(pushed, position)[0].shape[1]
    pairs, which, at = placed(pairs, chain, room(len(chain.fibres), size)[1])
    direction = pairs.direction.at[which].get(mode="fill", fill_value=0.0)
    second = at == pairs.second.at[which].get(mode="fill", fill_value=-1)
    direction = jnp.where(second[:, :, None], -direction, direction)
    none = jnp.zeros_like(position)

    def slot(column: tuple[Array, Array]) -> tuple[Parts, Parts]:
        bead, way = column
        return pushed(none.at[bead].set(way, mode="drop"))

    rate, parting = lax.map(slot, (at.T, jnp.swapaxes(direction, 0, 1)), batch_size=64)
    parting, response = jnp.swapaxes(parting, 0, 1), alone(jnp.swapaxes(rate, 0, 1))
    between = jnp.einsum("fsi,fti->fst", parting, response)
    number = len(pairs.first)
    opened = jnp.zeros((number, number), position.dtype)
    opened = opened.at[which[:, :, None], which[:, None, :]].add(ahead * between, mode="drop")
    stiff = stiffness(pairs, pairs.gap(position))
    small = inverse(jnp.eye(number, dtype=position.dtype) + stiff[:, None] * opened)
    small = small * (ahead * stiff)[None, :]
    enough = max(_ENOUGH, 100 * float(jnp.finfo(position.dtype).eps)) * jnp.min(chain.radii)
    return Touches(pairs, which, parting, response, opened, small, ahead, enough)
