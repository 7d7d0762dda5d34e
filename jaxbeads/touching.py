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
as deep as a radius, say nothing. Of the fluid between fibres, which is left out in all else of `near`,
account is taken where it matters most: the force on the one bead of a pair moves the fibre of the other.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from .chain import Chain
from .factors import inverse, solve
from .force import AbstractTouching
from .geometry import norm, peak, unit
from .state import Motion
from .windows import padded

MOST_PAIRS, FEW_PAIRS = 512, 64
"""Pairs that are taken together; of so few less is solved."""
_PART = 4
"""Numbers of a fibre over the most pairs that it takes part in."""
_FEWEST = 4
_MOST = 30
"""Newton's iterations."""
_ENOUGH = 1e-10
"""Gaps are found to this part of the least radius, or as well as rounding allows."""
_TOGETHER = 8
"""Slots that are looked at together."""
_STILL = 1e3
"""How much farther off they may be at the end."""

_NONE: Any = {"mode": "fill", "fill_value": 0}

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


def by_own_place(
    pairs: AbstractTouching, position: Float[Array, "beads dim"]
) -> Float[Array, "pairs dim dim"]:
    """Derivative of the force on either bead of each pair by its own place [force/length]."""
    n, gap, distance = pairs.direction, pairs.gap(position), norm(pairs.apart(position))
    across = _push(pairs, gap) / jnp.where(distance > 0, distance, 1.0)
    along = n[:, :, None] * n[:, None, :]
    aside = jnp.eye(n.shape[1], dtype=n.dtype)[None] - along
    return across[:, None, None] * aside - stiffness(pairs, gap)[:, None, None] * along


def _push(pairs: AbstractTouching, gap: Pairs) -> Pairs:
    return jnp.where(pairs.there[: len(gap)], pairs.push(gap), 0.0)


class Touches(eqx.Module):
    """Pairs that touch, in the rates of fibres."""

    pairs: AbstractTouching
    which: Int[Array, "fibres slots"]
    """The pair of each fibre's slots."""
    chain: Chain
    flow: Motion
    """What a unit push of each slot's pair does to the beads of its fibre by the force on the other,
    (slots, beads, ...).
    """
    parting: Float[Array, "fibres slots size"]
    """V."""
    response: Float[Array, "fibres slots size"]
    """W."""
    opened: Float[Array, "pairs pairs"]
    """g V^T W: by how much gaps open under unit pushes."""
    own: Float[Array, "pairs pairs"]
    """The same without flows, which is positive where the other may not be."""
    small: Float[Array, "pairs pairs"]
    """(1 + g K V^T W)^-1 g K."""
    ahead: Float[Array, ""]
    enough: Float[Array, ""]
    """To which gaps are found."""

    def pushed(self, rate: Parts) -> Pairs:
        """Change of pushes where fibres alone would go at these rates; linear."""
        return -self.small @ self._along(self.parting, rate)

    def pushed_back(self, rate: Parts, pulled: tuple[Motion, Any] | None) -> Parts:
        """The transpose of `pushed`, of rates by pushes, and of what `forces` and `flows` do with
        motions and loads.
        """
        push = self._along(self.response, rate)
        if pulled is not None:
            velocity, load = pulled[0].velocity, pulled[1]
            way = velocity[self.pairs.first] - velocity[self.pairs.second]
            push = push + jnp.sum(self.pairs.direction * way, axis=1)
            given = jnp.zeros_like(push)
            (more,) = jax.linear_transpose(self.flows, given)(Motion(load.force, load.torque))
            push = push + more
        return -self._spread(self.parting, self.small.T @ push)

    def flows(self, push: Pairs) -> Motion:
        """Motion of each fibre by pushes on others."""
        each = self._each(push)[jnp.asarray(self.chain.fibre_of_bead)]
        return jax.tree.map(lambda v: jnp.einsum("sbc,bs->bc", v, each), self.flow)

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
        gone, number = gap + self.ahead * self._along(self.parting, rate), len(push)
        # Nearest pairs come first.
        last = jnp.max(jnp.where(self.pairs.there, jnp.arange(1, number + 1), 0))

        def pressed(opened: Array) -> Pairs:
            alone = gone - opened @ push
            if number <= FEW_PAIRS:
                return self._pressed(alone, opened)

            def few() -> Pairs:
                found = self._pressed(alone[:FEW_PAIRS], opened[:FEW_PAIRS, :FEW_PAIRS])
                return jnp.pad(found, (0, number - FEW_PAIRS))

            return lax.cond(last <= FEW_PAIRS, few, lambda: self._pressed(alone, opened))

        # Without flows only where there is none with them.
        def unfinished(turn: tuple[Array, Array]) -> Array:
            return (turn[0] < 2) & ~jnp.all(jnp.isfinite(turn[1]))

        def body(turn: tuple[Array, Array]) -> tuple[Array, Array]:
            return turn[0] + 1, pressed(jnp.where(turn[0] == 0, self.opened, self.own))

        first = jnp.zeros((), int), jnp.full_like(push, jnp.nan)
        return lax.while_loop(unfinished, body, first)[1] - push

    def _pressed(self, alone: Pairs, opened: Float[Array, "pairs pairs"]) -> Pairs:
        """Pushes of the first pairs, the others without any, from the gaps that there would be without,
        and by how much pushes open them; NaN where none are found.
        """
        number = len(alone)

        def off(s: Pairs) -> Pairs:
            return s - alone - opened @ _push(self.pairs, s)

        def unfinished(turn: tuple[Array, ...]) -> Array:
            _, left, count = turn
            return (peak(left) > self.enough) & (count < _MOST)

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
        found = peak(left) <= _STILL * self.enough
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

    def _each(self, push: Pairs) -> Float[Array, "fibres slots"]:
        return push.at[self.which].get(mode="fill", fill_value=0.0)

    def _spread(self, rows: Array, push: Pairs) -> Parts:
        return jnp.einsum("fsi,fs->fi", rows, self._each(push))


def _first_rows(function: Callable[..., Any], rows: Any, used: Int[Array, ""]) -> Any:
    """function(rows), some rows at a time, but zero behind those that are used."""
    number = len(jax.tree.leaves(rows)[0])
    size = min(_TOGETHER, number)

    def more(turn: tuple[Array, Any]) -> tuple[Array, Any]:
        begin, found = turn
        begin = jnp.minimum(begin, number - size)
        some = jax.tree.map(lambda x: lax.dynamic_slice_in_dim(x, begin, size), rows)
        found = jax.tree.map(
            lambda x, y: lax.dynamic_update_slice_in_dim(x, y, begin, 0), found, function(some)
        )
        return begin + size, found

    shapes = jax.eval_shape(function, rows)
    none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return lax.while_loop(lambda turn: turn[0] < used, more, (jnp.zeros_like(used), none))[1]


class Lone(NamedTuple):
    """What fibres do, one by one; each function is linear and for all of them at once."""

    push: Callable[[Float[Array, "beads dim"], Motion], tuple[Parts, Parts, Parts]]
    """Forces f and a motion -> the rates under the forces; those where beads move so by themselves; what
    times rates is f times the velocities.
    """
    alone: Callable[[Array], Array]
    """D0^-1 of a stack of rates, (fibres, any, size)."""
    across: Callable[[Array, Array, Array], Motion]
    """Motion of some beads by a force on another, as far as it is not in the rates."""


def _flows(
    pairs: AbstractTouching, chain: Chain, slot: Int[Array, "pairs 2"], slots: int, of: Lone
) -> Motion:
    """What unit pushes do to the fibre of each of their slots by the force on the other fibre."""
    bead = jnp.stack([pairs.first, pairs.second], axis=1)
    fibre, rows = jnp.asarray(chain.fibre_of_bead)[bead], jnp.asarray(padded(chain.fibres))
    # Within a fibre nothing is left out.
    apart = pairs.there & (fibre[:, 0] != fibre[:, 1])
    last = 2 * jnp.max(jnp.where(apart, jnp.arange(1, len(apart) + 1), 0))

    def more(turn: tuple[Array, Motion]) -> tuple[Array, Motion]:
        count, flow = turn
        k, own = count // 2, count % 2
        # The direction is that of the push on the first.
        to, force = rows[fibre[k, own]], pairs.direction[k]
        moved = of.across(to, bead[k, 1 - own], jnp.where(own == 0, -force, force))
        at = slot[k, own], jnp.where(apart[k], to, chain.beads)
        return count + 1, jax.tree.map(lambda x, v: x.at[at].set(v, mode="drop"), flow, moved)

    def still(v: Any) -> Array:
        return jnp.zeros((slots, chain.beads, v.shape[1]), v.dtype)

    one = jax.eval_shape(of.across, rows[0], bead[0, 0], pairs.direction[0])
    return lax.while_loop(
        lambda turn: turn[0] < last, more, (jnp.zeros_like(last), jax.tree.map(still, one))
    )[1]


def touches(
    pairs: AbstractTouching,
    chain: Chain,
    position: Float[Array, "beads dim"],
    of: Lone,
    size: int,
    ahead: Float[Array, ""],
) -> Touches:
    """Pairs that touch.

    **Arguments**: pairs; the chain, and where its beads are; what fibres do, and how many numbers each
    has; g.
    """
    number, fibres = len(pairs.first), len(chain.fibres)
    pairs, which, at = placed(pairs, chain, room(fibres, size)[1])
    direction = pairs.direction.at[which].get(**_NONE)
    second = at == pairs.second.at[which].get(mode="fill", fill_value=-1)
    direction = jnp.where(second[:, :, None], -direction, direction)
    slots = jnp.arange(which.shape[1])
    slot = jnp.zeros((number, 2), int).at[which, second.astype(int)].set(slots, mode="drop")
    used = jnp.max(jnp.where(which < number, slots + 1, 0))

    flow = _flows(pairs, chain, slot, len(slots), of)

    def column(bead: Array, way: Array, flow: Motion) -> tuple[Parts, Parts, Parts]:
        return of.push(jnp.zeros_like(position).at[bead].set(way, mode="drop"), flow)

    columns = at.T, jnp.swapaxes(direction, 0, 1), flow
    found = _first_rows(lambda rows: jax.vmap(column)(*rows), columns, used)
    rate, driven, parting = (jnp.swapaxes(x, 0, 1) for x in found)
    response = of.alone(rate + driven)

    def opened(response: Array) -> Array:
        between = ahead * jnp.einsum("fsi,fti->fst", parting, response)
        none = jnp.zeros((number, number), position.dtype)
        return none.at[which[:, :, None], which[:, None, :]].add(between, mode="drop")

    whole, own = opened(response), opened(of.alone(rate))
    stiff = stiffness(pairs, pairs.gap(position))
    small = inverse(jnp.eye(number, dtype=position.dtype) + stiff[:, None] * whole)
    small = small * (ahead * stiff)[None, :]
    enough = max(_ENOUGH, 100 * float(jnp.finfo(position.dtype).eps)) * jnp.min(chain.radii)
    return Touches(pairs, which, chain, flow, parting, response, whole, own, small, ahead, enough)
