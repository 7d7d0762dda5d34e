"""A mobility as tables of what beads do to one another in pairs, component-major: every field is one
`(beads, beads)` array, so that loops run along memory. A planar scene holds 6 fields, a spatial one 15.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .state import Load, Motion

Field = Float[Array, "beads beads"]
Table = tuple[tuple[Array, ...], ...]

# (a x b)_i = sum of sign * a_j * b_k over (i, j, k, sign); in the plane b (or the result) is normal.
CROSS = {
    3: ((0, 1, 2, 1), (1, 2, 0, 1), (2, 0, 1, 1), (0, 2, 1, -1), (1, 0, 2, -1), (2, 1, 0, -1)),
    2: ((0, 1, 0, 1), (1, 0, 0, -1)),
}


class Signed(eqx.Module):
    """A field or its negative, so that antisymmetric tables hold each field once."""

    field: Field
    sign: int = eqx.field(static=True, default=1)

    def __matmul__(self, component: Array) -> Array:
        return self.sign * (self.field @ component)


SignedTable = tuple[tuple[Signed | None, ...], ...]


class PairTensor(eqx.Module):
    """Mobility of all beads as tables of fields: entry `[i][j]` maps component j to component i.

    In the coupling of translation and rotation `None` is a zero field. All but `tt` are empty in
    scenes without rotation. The whole is symmetric: `rt[k][i]` is the transpose of `tr[i][k]`.
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
        component by component, as a leading axis."""
        linear, angular = (self.tr, self.rr) if torque else (self.tt, self.rt)
        return Motion(_columns(linear), _columns(angular) if self.rr else None)


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
