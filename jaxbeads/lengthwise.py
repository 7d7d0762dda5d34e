"""What is solved instead of implicit stages where fibres are long: both equations, along the chain.

With M' of `windows`, rate k and multipliers lambda of

    k - T M' (g F' k + J^T lambda) = r,   -J M' (g F' k + J^T lambda) = s

are unknowns of beads and bonds, and each feels those within a window and a few beads more. F' = dF/dx
is that of the loads which a fibre carries along itself: elastic ones and those of constraints. (Contact,
and all else that depends on where beads are, is left out: one turn moves all beads behind it.)
Multipliers are not eliminated: without them every bond would feel every other. So the matrix is
block-tridiagonal in groups of bonds, and its factorisation takes time and memory that grow like the
number of beads. In `stages` they are eliminated fibre by fibre, which for the same loads is the same
answer.

What belongs to no bead (the point by which a fibre is placed, normals) moves no load here and follows
from the rest; rows of constraints beside the chain's are eliminated last, as in `saddle`.

Operations to make it ready, with s unknowns of a bead: 27 000 s^3 N, where dense matrices of n numbers
take 3 n^3 and n products with M'. Already at the length at which fibres are cut into windows that is
less; `MOST_NUMBERS` lies higher, since dense matrices leave no load out.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .coordinates import AbstractCoordinates
from .factors import inverse
from .instant import moving
from .saddle import chained_rows, constraint_map
from .scene import Scene
from .state import Load, Motion, State, add_loads, zero_motion
from .windows import HALF, AbstractParts, Windows

MOST_NUMBERS = 600
"""Coordinates of the longest fibre up to which its matrix is dense."""
_REACH = 5
"""How many beads from a bond a load may be that depends on its turn."""
_GROUP, _SPREAD = 2 * HALF, 2 * HALF + 1 + 2 * _REACH
"""Beads in a group: any window, with what is in reach, lies within two of them."""
_FIRST = 3 * HALF // 2
"""How many beads before the first one groups begin: windows start at a quarter and three quarters."""


class Maps(eqx.Module):
    """The linear maps of one instant, with M' in place of M."""

    t: Float[Array, ""]
    x: Float[Array, " numbers"]
    state: State
    """That at x."""
    chart: AbstractCoordinates
    scene: Scene
    multipliers: Float[Array, " rows"]
    parts: AbstractParts
    between: tuple[int, ...] = eqx.field(static=True, default=())
    """Forces between any beads, of which `local` alone is known."""
    local: Float[Array, "beads dim dim"] | None = None
    """Their derivatives by the bead's own place (`AbstractForce.local`)."""

    @property
    def still(self) -> Motion:
        """Beads at rest."""
        return zero_motion(self.state, self.scene.rotational)

    def rate(self, motion: Motion) -> Float[Array, " numbers"]:
        """T, which takes motions to rates of coordinates."""
        moved = moving(self.state, motion, self.scene.chain)
        return self.chart.rate(self.x, self.state, moved)

    def linear(self, motion: Motion) -> Float[Array, " rows"]:
        """J V."""
        if not self.scene.constraints:
            return self.multipliers
        return constraint_map(self.t, self.state, self.scene).linear(motion)

    def pull(self, multipliers: Float[Array, " rows"]) -> Load:
        """J^T lambda."""
        if not self.scene.constraints:
            return Load()
        return constraint_map(self.t, self.state, self.scene).pull(multipliers)

    def motion(self, load: Load, many: bool = True) -> Motion:
        """M' F, of many loads at once or of one."""
        return self.parts.motion(load, self.still, many)

    def load(self, x: Float[Array, " numbers"], carried: bool = False) -> Load:
        """F + J^T lambda at x, with lambda held; of forces those alone that a fibre carries along itself
        if `carried`.
        """
        state, scene = self.chart.state(x), self.scene
        chosen = [
            k
            for k, f in enumerate(scene.forces)
            if k not in self.between and (not carried or f.internal or f.links)
        ]
        loads = [scene.load_of(k, self.t, state) for k in chosen]
        if self.local is not None and not carried:
            way = state.position - self.state.position
            loads.append(Load(jnp.einsum("bij,bj->bi", self.local, way)))
        if scene.constraints:
            loads.append(constraint_map(self.t, state, scene).pull(self.multipliers))
        return add_loads(*loads)


def _joined(of: Load | Motion, still: Motion) -> Float[Array, "beads components"]:
    """Forces and torques, or velocities and spins, side by side."""
    parts = (of.force, of.torque) if isinstance(of, Load) else (of.velocity, of.spin)
    rest = still.velocity, still.spin
    every = [z if x is None else x for x, z in zip(parts, rest, strict=True) if z is not None]
    return jnp.concatenate(every, axis=1)


def _parted(joined: Float[Array, "beads components"], dim: int) -> tuple[Array, Array | None]:
    first, second = joined[:, :dim], joined[:, dim:]
    return first, second if second.shape[1] else None


def table(place: np.ndarray, beads: int) -> np.ndarray:
    """Which unknowns belong to each bead, or to the bond after it: a row for each, filled up with a
    number that is too large. `place` is the bead of each unknown; -1: none.
    """
    order = np.argsort(place, kind="stable")
    order = order[place[order] >= 0]
    at = place[order]
    slot = np.arange(len(at)) - np.searchsorted(at, at)
    found = np.full((beads, slot.max(initial=0) + 1), len(place))
    found[at, slot] = order
    return found


class Lengthwise(eqx.Module):
    """The two equations of a stage, factorised along the chain."""

    loads: Float[Array, "beads near slots components"]
    """g F' and J^T: load of each bead by the unknowns of those near it."""
    inverse: Float[Array, "groups size size"]
    """Of what is left of the diagonal blocks."""
    below: Float[Array, "groups size size"]  # from the group before
    above: Float[Array, "groups size size"]  # to the next, behind the inverse
    coupling: Float[Array, "others unknowns"]
    response: Float[Array, "others unknowns"]
    corner: Float[Array, "others others"]
    """Inverse of what is left of the rows that belong to no bead."""

    def answer(
        self, maps: Maps, rate: Float[Array, " numbers"], slip: Float[Array, " rows"]
    ) -> tuple[Float[Array, " numbers"], Float[Array, " rows"]]:
        """k and lambda from the right-hand sides r and s."""
        which, others, alone = _unknowns(maps)
        rhs = jnp.concatenate([rate, slip])
        found = solved((self.inverse, self.below, self.above), rhs, which)
        apart = self.corner @ (rhs[others] - self.coupling @ found)
        found = (found - apart @ self.response).at[others].add(apart)
        rate, multipliers = jnp.split(found, [len(rate)])
        if len(alone):
            beside = jnp.zeros_like(slip).at[others - len(rate)].add(apart)
            load = _applied(self.loads, _at(found, which))
            load = Load(*_parted(load, maps.state.position.shape[1]))
            motion = maps.motion(add_loads(load, maps.pull(beside)))
            rate = rate.at[alone].add((rhs[: len(rate)] + maps.rate(motion))[alone])
        return rate, multipliers


def _unknowns(maps: Maps) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of rate and multipliers in one vector: those of each bead, the rows of none, the numbers of
    none.
    """
    chain, numbers, rows = maps.scene.chain, len(maps.x), len(maps.multipliers)
    first, last = chained_rows(maps.t, maps.state, maps.scene)
    bond = np.where(chain.bond_mask, np.arange(chain.beads - 1), -1)
    place = np.concatenate([maps.chart.beads, np.full(rows, -1)])
    place[numbers + first : numbers + last] = np.tile(bond, (last - first) // len(bond))
    others = numbers + np.r_[:first, last:rows].astype(int)
    return table(place, chain.beads), others, np.flatnonzero(maps.chart.beads < 0)


def _at(unknowns: Array, which: np.ndarray) -> Float[Array, "beads slots"]:
    """The unknowns of each bead, 0 where there is none."""
    return unknowns.at[which].get(mode="fill", fill_value=0.0)


def _applied(band: Array, at: Float[Array, "beads slots"]) -> Float[Array, "beads components"]:
    """What a band makes of unknowns."""
    near = np.arange(len(at))[:, None] + np.arange(2 * _REACH + 1)
    return jnp.einsum("bnsc,bns->bc", band, jnp.pad(at, ((_REACH, _REACH), (0, 0)))[near])


def solved(
    blocks: tuple[Array, Array, Array], rhs: Float[Array, " unknowns"], which: np.ndarray
) -> Float[Array, " unknowns"]:
    """Solution by the factorised blocks; 0 of unknowns that belong to no bead."""
    groups, size, _ = blocks[0].shape
    beads, slots = which.shape
    parts = jnp.pad(_at(rhs, which), ((_FIRST, groups * _GROUP - _FIRST - beads), (0, 0)))
    parts = parts.reshape(groups, size)

    def forward(before: Array, group: tuple[Array, ...]) -> tuple[Array, Array]:
        inverse, below, part = group
        found = inverse @ (part - below @ before)
        return found, found

    def backward(after: Array, group: tuple[Array, ...]) -> tuple[Array, Array]:
        above, part = group
        found = part - above @ after
        return found, found

    still = jnp.zeros(size, rhs.dtype)
    _, half = lax.scan(forward, still, (*blocks[:2], parts))
    _, found = lax.scan(backward, still, (blocks[2], half), reverse=True)
    found = found.reshape(-1, slots)[_FIRST : _FIRST + beads]
    return jnp.zeros_like(rhs).at[which].add(found, mode="drop")


def _loads(maps: Maps, ahead: Array, which: np.ndarray) -> Array:
    """g F' and J^T near each bead. Unknowns far enough from one another are tried at once, with changing
    signs, so that what a fibre turns by in all stays small.
    """
    numbers, colours = len(maps.x), 2 * _REACH + 1
    load, push = jax.linearize(lambda x: maps.load(x, carried=True), maps.x)
    beads, slots = which.shape
    place = np.arange(beads)
    sign = np.where(place // colours % 2 == 0, 1.0, -1.0)

    def tried(colour: Array, slot: Array) -> Array:
        at = jnp.asarray(which)[:, slot]
        shift = jnp.where(place % colours == colour, sign, 0.0)
        unknowns = jnp.zeros(numbers + len(maps.multipliers), maps.x.dtype)
        unknowns = unknowns.at[at].set(jnp.asarray(shift, maps.x.dtype), mode="drop")
        rate, multipliers = jnp.split(unknowns, [numbers])
        moved = maps.pull(multipliers)
        if load.force is not None or load.torque is not None:
            moved = add_loads(moved, push(ahead * rate))
        return _joined(moved, maps.still)

    every = np.stack(np.meshgrid(np.arange(colours), np.arange(slots), indexing="ij"), -1)
    found = lax.map(lambda pair: tried(*pair), jnp.asarray(every.reshape(-1, 2)))
    found = found.reshape(colours, slots, beads, -1)
    near = place[:, None] + np.arange(-_REACH, _REACH + 1)
    there = np.where((near >= 0) & (near < beads), sign[np.clip(near, 0, beads - 1)], 0.0)
    band = found[near % colours, :, place[:, None]]  # (bead, near, slot, component)
    return band * there[:, :, None, None]


def _rows(maps: Maps, which: np.ndarray) -> Array:
    """T and J near each bead: what each component of its motion does to the rows of those near it."""
    colours = 2 * _REACH + 1
    still = _joined(maps.still, maps.still)
    beads, components = still.shape
    place = np.arange(beads)

    def tried(colour: Array, component: Array) -> Array:
        moved = still.at[:, component].set(jnp.where(place % colours == colour, 1.0, 0.0))
        motion = Motion(*_parted(moved, maps.state.position.shape[1]))
        return _at(jnp.concatenate([maps.rate(motion), maps.linear(motion)]), which)

    every = np.stack(np.meshgrid(np.arange(colours), np.arange(components), indexing="ij"), -1)
    found = lax.map(lambda pair: tried(*pair), jnp.asarray(every.reshape(-1, 2)))
    found = found.reshape(colours, components, beads, -1)
    near = place[:, None] + np.arange(-_REACH, _REACH + 1)
    there = (near >= 0) & (near < beads)
    band = found[place[:, None] % colours, :, np.clip(near, 0, beads - 1)]
    return jnp.swapaxes(band * there[:, :, None, None], 2, 3)


def _spread(band: Array, beads: Array) -> Float[Array, "beads unknowns components"]:
    """A band near the beads of a window, as a matrix."""
    rows, step = np.arange(2 * HALF + 1)[:, None], np.arange(_SPREAD)
    near = step - rows
    there = (near >= 0) & (near <= 2 * _REACH)
    found = band[beads][rows, np.clip(near, 0, 2 * _REACH)] * there[:, :, None, None]
    return found.reshape(len(rows), -1, band.shape[-1])


def _windows(maps: Maps, windows: Windows, loads: Array, rows: Array, index: Array) -> Array:
    """Part of the matrix that the two windows make which lie in a group and the next one: blocks
    (row, column) of these, (2, 2, size, size).
    """
    dim, slots = maps.state.position.shape[1], loads.shape[2]
    whole = jnp.zeros((2 * _GROUP, slots, 2 * _GROUP, slots), loads.dtype)
    for half in (0, 1):
        beads, weights = windows.window(2 * index + half)
        tables = windows.operator.some(beads)

        def moved(load: Array, tables: Any = tables) -> Array:
            motion = tables.motion(Load(*_parted(load, dim)))
            return _joined(motion, motion)

        w = weights[:, None, None]
        columns = jax.vmap(moved, in_axes=1, out_axes=1)(w * _spread(loads, beads))
        part = -jnp.einsum("bpc,bqc->pq", w * _spread(rows, beads), columns)
        at = HALF // 2 + half * HALF - _REACH
        here = slice(at, at + _SPREAD)
        whole = whole.at[here, :, here].add(part.reshape(_SPREAD, slots, _SPREAD, slots))
    blocks = whole.reshape(2, _GROUP * slots, 2, _GROUP * slots)
    return jnp.swapaxes(blocks, 1, 2)


def factorised(
    maps: Maps, windows: Windows, loads: Array, rows: Array, which: np.ndarray
) -> tuple[Array, Array, Array]:
    """The blocks of a matrix that is 1 for rates and 0 for multipliers, less T or J times M' times the
    loads: inverses, those below, and inverses times those above.
    """
    groups = -(-windows.number // 2) + 1
    beads = len(which)
    numbers, unknowns = len(maps.x), len(maps.x) + len(maps.multipliers)
    one = np.where((which >= numbers) & (which < unknowns), 0.0, 1.0)
    one = np.pad(one, ((_FIRST, groups * _GROUP - _FIRST - beads), (0, 0)), constant_values=1.0)
    one = jnp.asarray(one.reshape(groups, -1), loads.dtype)

    def step(before: tuple[Array, ...], group: tuple[Array, Array]) -> tuple[Any, Any]:
        ahead, below, corner = before
        index, one = group
        (own, above), (next_below, next_corner) = _windows(maps, windows, loads, rows, index)
        inverted = inverse(jnp.diag(one) + own + corner - below @ ahead)
        ahead = inverted @ above
        return (ahead, next_below, next_corner), (inverted, below, ahead)

    none = jnp.zeros((one.shape[1],) * 2, loads.dtype)
    return lax.scan(step, (none, none, none), (jnp.arange(groups), one))[1]


def lengthwise(maps: Maps, windows: Windows, ahead: Float[Array, ""]) -> Lengthwise:
    """The two equations of stages with g = `ahead`, factorised along the chain."""
    which, others, _ = _unknowns(maps)
    loads, rows = _loads(maps, ahead, which), _rows(maps, which)
    blocks = factorised(maps, windows, loads, rows, which)
    unknowns = len(maps.x) + len(maps.multipliers)
    at = jax.ShapeDtypeStruct(which.shape, loads.dtype)
    back = jax.linear_transpose(lambda at: _applied(loads, at), at)

    def row(index: Array) -> tuple[Array, Array, Array]:
        unit = jnp.zeros(unknowns, loads.dtype).at[index].set(1.0)[len(maps.x) :]
        motion = maps.motion(maps.pull(unit))
        column = -jnp.concatenate([maps.rate(motion), maps.linear(motion)])
        felt = -back(_joined(motion, maps.still))[0]
        coupling = jnp.zeros(unknowns, loads.dtype).at[which].set(felt, mode="drop")
        return coupling, solved(blocks, column, which), column[others]

    if not len(others):
        none = jnp.zeros((0, unknowns), loads.dtype)
        return Lengthwise(loads, *blocks, none, none, none[:, :0])
    coupling, response, corner = lax.map(row, jnp.asarray(others))
    empty = jnp.diagonal(corner) == 0
    corner = corner.T + jnp.diag(empty * 1.0) - coupling @ response.T
    return Lengthwise(loads, *blocks, coupling, response, inverse(corner))
