"""M F of many beads in long fibres: segments that are far from one another interact by a few beads.

Along a smooth fibre, what beads far away do to it, and what it does to them, are smooth functions of the
arclength. So forces and torques of a segment are handed to some of its beads, the nodes, with the
weights of polynomial interpolation; nodes move nodes of segments far away; their velocities and spins
are interpolated to the beads. With p nodes the error falls like rho^-p, rho = c + sqrt(c^2 - 1), where a
bead is c halves of a segment away from its middle. Segments that are near interact bead by bead
(`products`).

Where beads are not where interpolation puts them, since a fibre bends or kinks, velocities are off by
about that over the distance: such segments interact bead by bead up to where it is little, or with all.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from . import products
from .configuration import Configuration
from .geometry import peak
from .products import (
    NEIGHBOURS,
    Beads,
    Task,
    beads_of,
    blocks_of,
    joined,
    neighbour_sums,
    other_sums,
    separate_sums,
)
from .shares import shared
from .state import Load, Motion

BEADS = 50
"""Beads of a segment, at most."""
TOGETHER = 8
"""Segments near to one that are summed at a time."""
LEAST = 2000
"""Beads from which on this is done."""
APART = 2.5
"""Reaches of a segment between its middle and what is far."""
OFF = 3.0
"""How far beads may be from where interpolation puts them, over the error and the distance of segments.
"""
SINGLE = 1e-6
"""Error from which on single precision will do."""
COARSE = 6, 1.0, 0.1
"""Nodes, `APART` and error of coarse products."""
LEAST_COARSE = 6000
"""Beads from which on they are made: of fewer, all else takes too long for more iterations to pay."""


class _Segments(NamedTuple):
    """Segments, and beads that stand for them."""

    rows: np.ndarray
    """Numbers of the beads, the last repeated, (segments, beads)."""
    there: np.ndarray
    """Which are not repeated."""
    nodes: np.ndarray
    """Numbers of the nodes, (segments, nodes)."""
    weights: np.ndarray
    """Of nodes, for each bead, (segments, beads, nodes); 0 for what is repeated."""
    band: np.ndarray
    """Which hold neighbours of the beads of each, (segments, segments)."""


def interpolation(beads: int, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Which of some beads in a row are nodes, close to the extrema of a Chebyshev polynomial, and their
    weights for each bead in the polynomial through the nodes. If there are not enough beads, the last is
    repeated, with weight zero.
    """
    used = min(beads, nodes)
    extrema = 0.5 * (beads - 1) * (1 - np.cos(np.pi * np.arange(used) / max(used - 1, 1)))
    at = np.round(extrema).astype(int)
    for k in range(1, used):  # never the same twice
        at[k] = max(at[k], at[k - 1] + 1)
    at = np.minimum(at, beads - np.arange(used)[::-1] - 1)
    weights, s = np.zeros((beads, nodes)), np.arange(beads)[:, None]
    for k in range(used):
        others = np.delete(at, k)
        weights[:, k] = np.prod((s - others) / (at[k] - others), axis=1)
    return np.pad(at, (0, nodes - used), mode="edge"), weights


def _segments(pieces: tuple[int, ...], nodes: int) -> _Segments:
    rows = blocks_of(pieces, BEADS)
    number, beads = rows[:, -1] - rows[:, 0] + 1, sum(pieces)
    made = {n: interpolation(n, nodes) for n in {int(n) for n in number}}
    size = rows.shape[1]
    wide = size + 2 * NEIGHBOURS
    start = np.clip(rows[:, 0] - NEIGHBOURS, 0, beads - wide)
    return _Segments(
        rows,
        np.arange(size) < number[:, None],
        np.stack([row[made[n][0]] for row, n in zip(rows, number, strict=True)]),
        np.stack([np.pad(made[n][1], ((0, size - n), (0, 0))) for n in number]),
        (rows[:, -1] >= start[:, None]) & (rows[:, 0] < start[:, None] + wide),
    )


def _near(
    position: Array, segments: _Segments, distance: float, error: float
) -> Bool[Array, "segments segments"]:
    """Which segments interact bead by bead."""
    x, nodes = position[segments.rows], position[segments.nodes]
    middle = jnp.mean(nodes, axis=1)
    reach = peak(jnp.linalg.norm(x - middle[:, None], axis=2), axis=1)
    apart = jnp.linalg.norm(middle[:, None] - middle[None], axis=2)
    between = jnp.einsum("sbp,spc->sbc", segments.weights, nodes)
    off = peak(jnp.linalg.norm(x - between, axis=2) * segments.there, axis=1)
    one, other = reach[:, None], reach[None]
    enough = jnp.minimum(one, other) + distance * jnp.maximum(one, other)
    rough = jnp.maximum(off[:, None], off[None]) / (OFF * error)
    return segments.band | ~(apart >= jnp.maximum(enough, rough))  # also where there is NaN


def _sums(every: Beads, task: Task, segments: _Segments, near: Array) -> list[Array]:
    """Velocities and spins times the viscosity, in segments."""
    rows, nodes = jnp.asarray(segments.rows), jnp.asarray(segments.nodes)
    weights = jnp.asarray(segments.weights, every.position.dtype)
    number, each = nodes.shape
    turns = -(-number // TOGETHER)
    numbers = jnp.where(jnp.asarray(segments.there), rows, -1)

    def close(k: Array) -> list[Array]:
        count = jnp.sum(near[k])
        # Those that are near first.
        others = jnp.argsort(~near[k], stable=True)
        others = jnp.pad(others, (0, turns * TOGETHER - number))

        def more(turn: tuple[Array, list[Array]]) -> tuple[Array, list[Array]]:
            begin, sums = turn
            some = lax.dynamic_slice(others, (begin,), (TOGETHER,))
            real = begin + jnp.arange(TOGETHER) < count
            there = jnp.where(real[:, None], numbers[some], -1)
            of = jax.tree.map(lambda x: x[rows[some].ravel()], every)
            found = other_sums(rows[k], every, of, there.ravel(), task)
            return begin + TOGETHER, [a + b for a, b in zip(sums, found, strict=True)]

        first = jnp.zeros((), count.dtype), neighbour_sums(rows[k], every, task)
        return lax.while_loop(lambda turn: turn[0] < count, more, first)[1]

    def handed(bears: Array) -> Array:
        return jnp.einsum("sbp,sbc->spc", weights, bears[rows]).reshape(number * each, -1)

    at = every.position[nodes]
    of = Beads(at.reshape(number * each, -1), None, jax.tree.map(handed, every.load))

    # One by one: positions are rounded from a bead of the segment.
    def far(k: Array) -> list[Array]:
        apart = jnp.broadcast_to(jnp.repeat(~near[k], each), (each, number * each))
        return separate_sums(Beads(at[k], None, Load()), of, task, apart)[0]

    pairs = number * each * number * each
    moved = shared(lambda some: lax.map(far, some), jnp.arange(number), pairs)
    spread = [jnp.einsum("sbp,sp->sb", weights, v) for v in moved]
    together = shared(lambda some: lax.map(close, some), jnp.arange(number), rows.size * rows.size)
    return [a + b for a, b in zip(together, spread, strict=True)]


def motion(configuration: Configuration, load: Load, error: float) -> Motion:
    """M F with an error of the largest velocity, which pairs of beads far apart may have, in a form that
    is not for derivatives.

    Where there are not enough beads, or fibres are short, they are summed by `products`.

    **Arguments**: spheres (their images in boundaries are left out); loads; the error.
    """
    nodes = _nodes(error)
    if not _used(configuration, nodes):
        return products.motion(configuration, load, single=error >= SINGLE)
    return _motion(configuration, load, nodes, APART, error, error >= SINGLE)


def coarse(configuration: Configuration, load: Load, error: float) -> Motion | None:
    """The same to a percent or so, with few nodes and little that counts as near, if there is a `motion`
    by segments to that error. Of 10 000 beads it takes two fifths of the time. What rounding leaves is
    that of `motion`, so that iterations may go on as far.
    """
    if configuration.beads < LEAST_COARSE or not _used(configuration, _nodes(error)):
        return None
    return _motion(configuration, load, *COARSE, error >= SINGLE)


def _nodes(error: float) -> int:
    return int(np.clip(np.ceil(12 + 2 * np.log10(1e-6 / error)), 8, 24))


def _used(configuration: Configuration, nodes: int) -> bool:
    beads, pieces = configuration.beads, configuration.pieces or (configuration.beads,)
    enough = beads >= LEAST and beads > 2 * nodes * len(pieces)
    return enough and not configuration.radius.ndim and products.plain(configuration)


def _motion(
    configuration: Configuration,
    load: Load,
    nodes: int,
    apart: float,
    error: float,
    single: bool,
) -> Motion:
    segments = _segments(configuration.pieces or (configuration.beads,), nodes)
    near = _near(configuration.position, segments, apart, error)
    every, task = beads_of(configuration, load, single)
    return joined(_sums(every, task, segments, near), segments.rows, configuration)
