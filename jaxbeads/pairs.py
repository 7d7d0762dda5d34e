"""What beads do to one another in pairs: summed as it is computed, or kept as tables.

Everything is component-major: a field is one `(to, of)` array of beads, so that loops run along memory.
As tables the mobility of a planar scene is 6 fields, that of a spatial one 15.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from .shares import shared
from .state import Load, Motion

Field = Float[Array, "to of"]
Table = tuple[tuple[Array, ...], ...]
Radii = Array | tuple[Array, Array]
"""One radius for all beads, or those of the beads along rows (a column) and along columns (a row)."""

PAIRS = 2**17
"""Pairs that `pair_sums` computes at a time: their fields stay in the cache."""

# (a x b)_i = sum of sign * a_j * b_k over (i, j, k, sign); in the plane b (or the result) is normal.
CROSS = {
    3: ((0, 1, 2, 1), (1, 2, 0, 1), (2, 0, 1, 1), (0, 2, 1, -1), (1, 0, 2, -1), (2, 1, 0, -1)),
    2: ((0, 1, 0, 1), (1, 0, 0, -1)),
}


def separations(
    to: Float[Array, "to dim"], of: Float[Array, "of dim"]
) -> list[Float[Array, "to of"]]:
    """r_i - r_j, one field `(to, of)` for each component, from positions `(to, dim)` and `(of, dim)`.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.pairs import separations
    >>> x, y = separations(jnp.array([[1.0, 0.0], [4.0, 2.0]]), jnp.array([[1.0, 0.0]]))
    >>> print(x[:, 0], y[:, 0])
    [0. 3.] [0. 2.]
    """
    # XLA: products, not broadcasts. Their derivatives in reverse are products with ones, which it does
    # not merge with what makes the fields (it would make them once for each bead).
    row, column = jnp.ones((1, len(of)), of.dtype), jnp.ones((len(to), 1), to.dtype)
    return [x[:, None] @ row - column @ y[None, :] for x, y in zip(to.T, of.T, strict=True)]


def radii_of(to: Float[Array, "*to"], of: Float[Array, "*of"]) -> Radii:
    """The radii of pairs: one for all beads, or those of two sets as a column and a row.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.pairs import radii_of
    >>> to, of = radii_of(jnp.array([1.0, 2.0]), jnp.array([1.0, 2.0, 3.0]))
    >>> print(to.shape, of.shape, radii_of(jnp.array(1.0), jnp.array(1.0)))
    (2, 1) (1, 3) 1.0
    """
    return to if to.ndim == 0 else (to[:, None], of[None, :])


def pair_sums(
    fields: Callable[[Any, Any], Sequence[Field]], beads: PyTree, to: PyTree = None
) -> list[Array]:
    """Sums over all beads j of functions of the pairs (i, j), for all i of the beads, or of `to`.

    Some beads i at a time, with all j, in a loop that keeps nothing: memory grows like the number of
    beads, also in derivatives, which compute each block anew.

    **Arguments**: function of two sets of beads, to and of, that returns fields (to, of); arrays with a
    row for each bead, of which it gets some. **Returns** an array of numbers for each field.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.pairs import pair_sums
    >>> heights = jnp.array([0.0, 1.0, 3.0])
    >>> (above,) = pair_sums(lambda to, of: [to[:, None] - of[None, :]], heights)
    >>> print(above)  # by how much each is above all others
    [-4. -1.  5.]
    """
    to = beads if to is None else to
    others = rows_of(beads)
    # XLA: a product with ones sums faster than `sum`.
    ones = jnp.ones(others, jax.tree.leaves(beads)[0].dtype)
    return in_blocks(lambda to: [field @ ones for field in fields(to, beads)], to, others, PAIRS)


def rows_of(beads: PyTree) -> int:
    """Of how many beads there are numbers.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.pairs import rows_of
    >>> print(rows_of((jnp.ones((4, 3)), jnp.ones(4))))
    4
    """
    return len(jax.tree.leaves(beads)[0])


def in_blocks(
    sums: Callable[[Any], Sequence[Array]], to: PyTree, others: int, pairs: int
) -> list[Array]:
    """Sums over so many other beads, some beads at a time so that there are about so many pairs: a loop
    that keeps nothing. Several devices share the beads (`shares`).

    >>> import jax.numpy as jnp
    >>> from jaxbeads.pairs import in_blocks
    >>> heights = jnp.array([0.0, 1.0, 3.0])  # two pairs at a time: bead after bead
    >>> def above(to):
    ...     return [(to[:, None] > heights[None]).sum(1)]
    >>> print(in_blocks(above, heights, others=3, pairs=2)[0])
    [0 1 2]
    """
    return shared(lambda to: _in_turn(sums, to, others, pairs), to, rows_of(to) * others)


def _in_turn(
    sums: Callable[[Any], Sequence[Array]], to: PyTree, others: int, pairs: int
) -> list[Array]:
    number = rows_of(to)
    count = -(-(number * others) // pairs)
    if count <= 1:
        return list(sums(to))
    rows = -(-number // count)
    count = -(-number // rows)

    def cut(x: Array) -> Array:
        padded = jnp.pad(x, [(0, count * rows - number)] + [(0, 0)] * (x.ndim - 1), mode="edge")
        return padded.reshape(count, rows, *x.shape[1:])

    found = lax.map(jax.checkpoint(lambda to: list(sums(to))), jax.tree.map(cut, to))
    return [x.ravel()[:number] for x in found]


def blocks_of(pieces: tuple[int, ...], most: int) -> np.ndarray:
    """Numbers of the beads in blocks of at most so many within each piece, one after the other; the last
    of a block repeated where it has fewer than others.

    >>> from jaxbeads.pairs import blocks_of
    >>> print(blocks_of((5, 2), 3))
    [[0 1 2]
     [3 4 4]
     [5 6 6]]
    """
    blocks, first = [], 0
    for size in pieces:
        rows = -(-size // -(-size // most))
        for start in range(first, first + size, rows):
            block = np.arange(start, min(start + rows, first + size))
            blocks.append(np.pad(block, (0, most - len(block)), mode="edge"))
        first += size
    rows = max(block[-1] - block[0] + 1 for block in blocks)
    return np.stack(blocks)[:, :rows]


class Signed(eqx.Module):
    """A field or its negative, so that antisymmetric tables hold each field once.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.pairs import Signed
    >>> print(Signed(jnp.array([[0.0, 1.0], [2.0, 0.0]]), -1) @ jnp.array([1.0, 1.0]))
    [-1. -2.]
    """

    field: Field
    sign: int = eqx.field(static=True, default=1)

    def __matmul__(self, component: Array) -> Array:
        return self.sign * (self.field @ component)


SignedTable = tuple[tuple[Signed | None, ...], ...]


class PairTensor(eqx.Module):
    """Mobility of all beads as tables of fields: entry `[i][j]` maps component j to component i.

    In the coupling of translation and rotation `None` is a zero field. All but `tt` are empty in
    scenes without rotation. The whole is symmetric: `rt[k][i]` is the transpose of `tr[i][k]`.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> beads = jb.Configuration([[0.0, 0.0], [3.0, 0.0]], radius=1.0, viscosity=1.0)
    >>> table = jb.tensors.rpy(beads)
    >>> moved = table.motion(jb.Load(force=jnp.array([[0.0, -1.0], [0.0, -1.0]])))
    >>> print(moved.velocity.round(4), moved.spin.round(4))
    [[ 0.     -0.0673]
     [ 0.     -0.0673]] [[-0.0044]
     [ 0.0044]]
    """

    tt: Table
    tr: SignedTable = ()
    rt: SignedTable = ()
    rr: Table = ()

    def motion(self, load: Load) -> Motion:
        """Velocities and spins under `load`, M F (no ambient flow)."""
        force = None if load.force is None else load.force.T
        torque = None if load.torque is None else load.torque.T
        velocity = _products(self.tt, force, self.tr, torque)
        if not self.rr:
            return Motion(velocity)
        return Motion(velocity, _products(self.rt, force, self.rr, torque))

    def unit_motions(self, torque: bool) -> Motion:
        """Motions under a unit force (or torque) along each component on each bead: the columns of M,
        component by component, as a leading axis.
        """
        linear, angular = (self.tr, self.rr) if torque else (self.tt, self.rt)
        return Motion(_columns(linear), _columns(angular) if self.rr else None)

    def matrix(self) -> Float[Array, "motions loads"]:
        """One matrix: velocities, then spins, of all beads, component by component."""

        def dense(entry: Signed | Array | None) -> Array:
            if isinstance(entry, Signed):
                return entry.sign * entry.field
            return jnp.zeros_like(self.tt[0][0]) if entry is None else entry

        rows = [*map(list, self.tt), *map(list, self.rt)]
        for row, more in zip(rows, (*self.tr, *self.rr), strict=True):
            row.extend(more)
        return jnp.block([[dense(entry) for entry in row] for row in rows])


def _columns(table: Table | SignedTable) -> Float[Array, "loads beads components"]:
    """Fields (from bead, to bead) of each component that loads, with all components that move."""

    def column(entry: Signed | Array | None, other: Array) -> Array:
        if isinstance(entry, Signed):
            return (entry.sign * entry.field).T
        return jnp.zeros_like(other) if entry is None else entry.T

    some = next(f for row in table for f in row if f is not None)
    other = some.field if isinstance(some, Signed) else some
    loads = range(len(table[0]))
    return jnp.concatenate(
        [jnp.stack([column(row[j], other) for row in table], axis=2) for j in loads]
    )


def _products(
    left: Table | SignedTable, a: Array | None, right: Table | SignedTable, b: Array | None
) -> Array:
    pairs = [(table, x) for table, x in ((left, a), (right, b)) if x is not None and table]
    if not pairs:
        raise ValueError("Argument `load` must hold forces or torques, but it holds neither.")
    rows = []
    for i in range(len(pairs[0][0])):
        terms = [
            entry @ component
            for table, vector in pairs
            for entry, component in zip(table[i], vector, strict=True)
            if entry is not None
        ]
        rows.append(sum(terms[1:], start=terms[0]))
    return jnp.stack(rows, axis=1)


def added(one: PairTensor, other: PairTensor) -> PairTensor:
    """The sum of two mobilities as tables.

    >>> import jaxbeads as jb
    >>> from jaxbeads.pairs import added
    >>> beads = jb.Configuration([[0.0, 0.0], [3.0, 0.0]], radius=1.0, viscosity=1.0)
    >>> table = jb.tensors.rpy(beads)
    >>> print((added(table, table).tt[0][0] / table.tt[0][0]).round(12))
    [[2. 2.]
     [2. 2.]]
    """

    def signed(a: Signed | None, b: Signed | None) -> Signed | None:
        there = [x.sign * x.field for x in (a, b) if x is not None]
        return Signed(reduce(jnp.add, there)) if there else None

    def tables(a: tuple, b: tuple, join: Callable) -> tuple:
        return tuple(
            tuple(join(x, y) for x, y in zip(p, q, strict=True)) for p, q in zip(a, b, strict=True)
        )

    return PairTensor(
        tables(one.tt, other.tt, jnp.add),
        tables(one.tr, other.tr, signed),
        tables(one.rt, other.rt, signed),
        tables(one.rr, other.rr, jnp.add),
    )
