"""M F of many beads, Rotne-Prager-Yamakawa: neighbours along the chain by the formulas for all
distances, others by those of separate spheres, as matrix products.

With positions x from a bead nearby, sum_j g_ij (x_i - x_j) = x_i sum_j g_ij - sum_j g_ij x_j: a field g
is made once, and one matrix product finds all that it does to velocities and spins. Where beads overlap
that are no neighbours, their block goes back to the formulas for all distances.

In single precision, where it is asked for, are pairs that are no neighbours: blocks lie within a fibre,
and positions from one of their beads are rounded last. What neighbours do to one another, by the large
forces within a fibre, is summed in double precision.
"""

from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .coefficients import factors, separate
from .configuration import Configuration
from .domain import AbstractHalfSpace, Unbounded
from .pairs import CROSS, Radii, blocks_of, radii_of, rows_of, separations
from .shares import shared
from .state import Load, Motion, spins
from .tensors import as_motion, pushed, rpy_motion

PAIRS = 2**19
"""Pairs that are computed at a time, but for so many rows."""
ROWS = 8, 64
"""The least and the most beads that are moved at a time."""
SOURCES = 2**14
"""The most beads that move others at a time."""
NEIGHBOURS = 32
"""Beads on either side along the chain that count as neighbours."""
_SLACK = 4.0
"""Rounding by which neighbours may overlap and count as touching."""
LEAST = 8 * NEIGHBOURS
"""Beads from which on this is done."""


class Beads(NamedTuple):
    """Some of the beads, and what they bear."""

    position: Float[Array, "beads dim"]
    radius: Float[Array, " beads"] | None
    """In units of the length; `None`: all have that one."""
    load: Load


class Task(NamedTuple):
    """What is the same for all of them."""

    length: Float[Array, ""]
    rotational: bool
    dtype: np.dtype
    """Of pairs that are no neighbours."""


def _radii(to: Beads, of: Beads) -> Radii | None:
    return None if to.radius is None or of.radius is None else radii_of(to.radius, of.radius)


def all_sums(to: Beads, of: Beads, task: Task) -> list[Array]:
    """Velocities and spins times the viscosity, component by component."""
    d = separations(to.position / task.length, of.position / task.length)
    one = jnp.ones_like(task.length)
    fields = pushed(d, _radii(to, of), task.length, one, task.rotational, of.load)
    return [field @ jnp.ones(len(of.position), field.dtype) for field in fields]


def _kept(rows: list[Array]) -> list[Array]:
    """The same numbers.

    XLA: what a matrix product gives is not computed anew for each pair that reads it, as all else that
    looks cheap.
    """
    return list(jnp.eye(len(rows), dtype=rows[0].dtype) @ jnp.stack(rows))


def _times(field: Array, rows: list[Array]) -> list[Float[Array, " to"]]:
    """Sums over j of field row_j."""
    found = field @ jnp.stack(rows).T  # XLA: the transpose of this product takes twice as long
    return [found[:, c] for c in range(len(rows))]


Term = tuple[int, int, int]
"""(k, m, sign) stands for sign d_k f_m."""


def _added(terms: list[Term], d: list[Array], f: list[Array]) -> Array:
    return reduce(jnp.add, [d[k] * f[m] if s > 0 else -d[k] * f[m] for k, m, s in terms])


def separate_sums(
    to: Beads,
    of: Beads,
    task: Task,
    there: Bool[Array, "to of"] | None = None,
    slack: Array | float = 0.0,
) -> tuple[list[Array], Bool[Array, "to of"]]:
    """The same by those of separate spheres, of all pairs or some; for which of all they do not hold, by
    more than some slack.
    """
    dtype, rotational, dim = task.dtype, task.rotational, to.position.shape[1]
    centre, turns = lax.stop_gradient(to.position[0]), spins(dim)
    at = [(of.position[:, c] - centre[c]) / task.length for c in range(dim)]
    force = [] if of.load.force is None else list(of.load.force.T)
    torque = [] if of.load.torque is None or not rotational else list(of.load.torque.T)
    rows = _kept([row.astype(dtype) for row in (*at, *force, *torque)])
    y, force, torque = rows[:dim], rows[dim : dim + len(force)], rows[dim + len(force) :]
    x = _kept([((to.position[:, c] - centre[c]) / task.length).astype(dtype) for c in range(dim)])
    row, column = jnp.ones((1, len(y[0])), dtype), jnp.ones((len(x[0]), 1), dtype)
    d = [a[:, None] @ row - column @ b[None, :] for a, b in zip(x, y, strict=True)]
    k, overlap = separate(d, _radii(to, of), there, slack)

    def dyadic(field: Array, f: list[Array]) -> list[Array]:
        """Sums over j of field d (d . f_j)."""
        along = field * sum(c * row[None, :] for c, row in zip(d, f, strict=True))
        whole, *parts = _times(along, [jnp.ones_like(y[0]), *y])
        return [whole * a - part for a, part in zip(x, parts, strict=True)]

    # One product with y^3 for all that turns: T x d, F x d and the part of rr along T.
    pulls = [[(j, m, -s) for i, j, m, s in CROSS[dim] if i == c] for c in range(dim)]
    turn = [[(j, i, s) for i, j, m, s in CROSS[dim] if m == c] for c in range(turns)]
    columns = [*torque, *(_added(terms, y, torque) for terms in pulls if torque)]
    if rotational:
        columns += [*force, *(_added(terms, y, force) for terms in turn if force)]
    found = iter(_times(k.tr, columns) if columns else [])

    def crossed(terms: list[list[Term]], f: list[Array]) -> tuple[list[Array], list[Array]]:
        """Sums over j of tr f_j, and of the terms."""
        whole = [next(found) for _ in f]
        return whole, [_added(each, x, whole) - next(found) for each in terms]

    six, cross, eight = factors(task.length)
    digits = to.position.dtype
    velocity = [jnp.zeros(len(x[0]), digits) for _ in range(dim)]
    spin = [jnp.zeros(len(x[0]), digits) for _ in range(turns if rotational else 0)]

    def add(parts: list[Array], factor: Array, sums: list[Array]) -> list[Array]:
        return [p + factor * s.astype(digits) for p, s in zip(parts, sums, strict=True)]

    if force:
        velocity = add(velocity, six, _times(k.tt1, force))
        velocity = add(velocity, six, dyadic(k.tt2, force))
    if torque:
        whole, pulled = crossed(pulls, torque)
        velocity = add(velocity, cross, pulled)
        spin = add(spin, -eight / 2, whole)
        if dim == 3:
            spin = add(spin, eight, dyadic(k.rr2, torque))
    if force and rotational:
        spin = add(spin, cross, crossed(turn, force)[1])
    return velocity + spin, overlap


def plain(configuration: Configuration) -> bool:
    """Whether separations are differences of positions."""
    return isinstance(configuration.domain, (Unbounded, AbstractHalfSpace))


def neighbour_sums(rows: Int[Array, " rows"], every: Beads, task: Task) -> list[Array]:
    """Velocities and spins of a block of beads, by their numbers, times the viscosity, component by
    component, that come from their neighbours.
    """
    start, near = _neighbours(rows, every)
    places = rows, start + jnp.arange(near)
    to, of = (jax.tree.map(lambda x, at=at: x[at], every) for at in places)
    apart = places[0][:, None] != places[1][None, :]
    exact = task._replace(dtype=np.dtype(to.position.dtype))
    # Neighbours touch, but for rounding of where they are.
    furthest = jnp.max(jnp.abs(of.position)) / task.length
    slack = _SLACK * float(jnp.finfo(exact.dtype).eps) * (1 + furthest)
    found, overlap = separate_sums(to, of, exact, apart, slack)
    fine = ~jnp.any(overlap & apart)
    return lax.cond(fine, lambda: _with_own(found, to, task), lambda: all_sums(to, of, task))


def _with_own(others: list[Array], to: Beads, task: Task) -> list[Array]:
    """Sums over others, and what beads do to themselves."""
    six, _, eight = factors(task.length)
    radius = jnp.ones_like(six) if to.radius is None else to.radius
    dim, whole = to.position.shape[1], [*others]
    for x, factor, first in (
        (to.load.force, six / radius, 0),
        (to.load.torque, eight / radius**3, dim),
    ):
        if x is not None and first < len(others):
            for k in range(x.shape[1]):
                whole[first + k] = whole[first + k] + factor * x[:, k]
    return whole


def other_sums(
    rows: Int[Array, " rows"], every: Beads, of: Beads, numbers: Int[Array, " of"], task: Task
) -> list[Array]:
    """The same that come from beads that are none of their neighbours.

    **Arguments**: numbers of the beads; all beads; those that move them, and their numbers (-1: not
    there), neighbours or not.
    """
    start, near = _neighbours(rows, every)
    to = jax.tree.map(lambda x: x[rows], every)
    away = ((numbers < start) | (numbers >= start + near)) & (numbers >= 0)
    far = of._replace(load=jax.tree.map(lambda x: jnp.where(away[:, None], x, 0.0), of.load))
    found, overlap = separate_sums(to, far, task)
    fine = overlap.astype(jnp.float32) @ away.astype(jnp.float32) == 0
    return lax.cond(jnp.all(fine), lambda: found, lambda: all_sums(to, far, task))


def _neighbours(rows: Int[Array, " rows"], every: Beads) -> tuple[Int[Array, ""], int]:
    """The first of the neighbours of a block, which are in it or beside it, and how many there are."""
    beads = len(every.position)
    near = min(len(rows) + 2 * NEIGHBOURS, beads)
    return jnp.clip(rows[0] - NEIGHBOURS, 0, beads - near), near


def _in_parts(sums: Callable[[Any, Bool[Array, " of"]], list[Array]], of: Any) -> list[Array]:
    """Sums over beads that move others, so many at a time that what is between them stays in the cache.

    **Arguments**: function of some of them and of which are there; arrays with a row for each.
    """
    number = rows_of(of)
    count = -(-number // SOURCES)
    size = -(-number // count)
    missing = count * size - number

    def cut(x: Array) -> Array:
        padded = jnp.pad(x, [(0, missing)] + [(0, 0)] * (x.ndim - 1), mode="edge")
        return padded.reshape(count, size, *x.shape[1:])

    parts = jax.tree.map(cut, of), jnp.arange(count * size).reshape(count, size) < number
    if count == 1:
        return sums(*jax.tree.map(lambda x: x[0], parts))

    def more(found: list[Array], part: Any) -> tuple[list[Array], None]:
        return [a + b for a, b in zip(found, sums(*part), strict=True)], None

    shapes = jax.eval_shape(lambda: sums(*jax.tree.map(lambda x: x[0], parts)))
    return lax.scan(more, [jnp.zeros(x.shape, x.dtype) for x in shapes], parts)[0]


def beads_of(configuration: Configuration, load: Load, single: bool) -> tuple[Beads, Task]:
    """All beads, and what is the same for them."""
    scaled, position = configuration.scaled, configuration.position
    dtype = np.dtype(np.float32) if single else position.dtype
    task = Task(scaled.length, configuration.rotational, dtype)
    return Beads(position, scaled.radius, load), task


def joined(found: list[Array], rows: np.ndarray, configuration: Configuration) -> Motion:
    """The motion, from sums in blocks of beads."""
    first = np.unique(rows, return_index=True)[1]
    return as_motion([x.ravel()[first] / configuration.viscosity for x in found], configuration)


def among(configuration: Configuration, load: Load) -> Motion:
    """M F of a few beads, all of which are taken for neighbours, in a form that is not for derivatives,
    nor for many loads at once.

    **Arguments**: spheres, nowhere near the boundary of a domain; loads.
    """
    every, task = beads_of(configuration, load, False)
    rows = np.arange(configuration.beads)[None]
    found = neighbour_sums(jnp.asarray(rows[0]), every, task)
    return joined(found, rows, configuration)


def motion(configuration: Configuration, load: Load, single: bool = False) -> Motion:
    """M F, in a form that is not for derivatives: their program would take several times as long to
    compile as that of `tensors.rpy_motion`.

    **Arguments**: spheres (their images in boundaries are left out); loads; whether pairs that are no
    neighbours along the chain are in single precision.
    """
    beads = configuration.beads
    if beads < LEAST or not plain(configuration):
        return rpy_motion(configuration, load)
    pieces = configuration.pieces or (beads,)
    if min(pieces) < ROWS[0]:
        pieces, single = (beads,), False  # blocks of several pieces are too wide for that
    rows = blocks_of(pieces, int(np.clip(PAIRS // min(beads, SOURCES), *ROWS)))
    every, task = beads_of(configuration, load, single)

    def block(rows: Array) -> list[Array]:
        def others(of: tuple[Beads, Array], there: Array) -> list[Array]:
            beads, numbers = of
            return other_sums(rows, every, beads, jnp.where(there, numbers, -1), task)

        near = neighbour_sums(rows, every, task)
        apart = _in_parts(others, (every, jnp.arange(beads)))
        return [a + b for a, b in zip(near, apart, strict=True)]

    found = shared(lambda rows: lax.map(block, rows), jnp.asarray(rows), beads * beads)
    return joined(found, rows, configuration)
