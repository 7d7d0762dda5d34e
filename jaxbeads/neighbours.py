"""Pairs of beads that are near one another, of many: sums over them, and the foremost of them.

Fields are those of `pairs`, of functions that are 0 beyond a reach. Beads are looked at in blocks of
neighbours along fibres, and blocks whose spheres are apart are passed over.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .pairs import Field, blocks_of, pair_sums

BLOCK, NEAR, LEAST = 32, 32, 2000
"""Beads of a block; blocks that may be near to one; beads from which on blocks are made."""
_EACH = 8
"""Pairs of one bead among the foremost."""


def near_sums(
    fields: Callable[[Any, Any], Sequence[Field]],
    met: Callable[[Any, Any], Bool[Array, "to of"]],
    beads: tuple[Array, ...],
    pieces: tuple[int, ...],
    reach: Float[Array, ""],
) -> list[Array]:
    """As `pair_sums` where fields are 0 but for pairs that are met, none of them beyond a reach: of many
    beads only blocks that are near, and only where a pair is met, or all where too many are near.

    **Arguments**: function of two sets of beads, to and of, that returns fields (to, of); one that says
    of which pairs they may be other than 0; arrays with a row for each bead, the first of positions;
    beads of each fibre; reach.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.neighbours import near_sums
    >>> x = jnp.array([[0.0, 0.0], [1.0, 0.0], [9.0, 0.0]])
    >>> def close(to, of):
    ...     return abs(to[0][:, None, 0] - of[0][None, :, 0]) < 2
    >>> print(near_sums(lambda to, of: [close(to, of)], close, (x,), (3,), jnp.array(2.0))[0])
    [2. 2. 1.]
    """
    if len(beads[0]) < LEAST:
        return pair_sums(fields, beads)
    blocks = _near(beads[0], pieces, reach)

    def block(k: Array) -> list[Array]:
        to, of, real = blocks.some(k, beads)

        def sums() -> list[Array]:
            return [jnp.where(real, field, 0.0).sum(axis=1) for field in fields(to, of)]

        shapes = jax.eval_shape(sums)
        none = [jnp.zeros(x.shape, x.dtype) for x in shapes]
        return lax.cond(jnp.any(met(to, of).any(axis=0) & real), sums, lambda: none)

    def few() -> list[Array]:
        found = lax.map(jax.checkpoint(block), jnp.arange(len(blocks.rows)))
        first = np.unique(blocks.rows, return_index=True)[1]
        return [f.ravel()[first] for f in found]

    return lax.cond(blocks.fine, few, lambda: pair_sums(fields, beads))


def largest(
    field: Callable[[Any, Any], Field],
    beads: tuple[Array, ...],
    pieces: tuple[int, ...],
    reach: Float[Array, ""],
    most: int,
) -> tuple[Int[Array, " pairs"], Int[Array, " pairs"], Float[Array, " pairs"]]:
    """The pairs i < j of beads with the largest of a positive field, that is 0 beyond a reach, and the
    field there, from the largest on; where there are fewer than `most`, it is 0. Pairs are overlooked
    where a bead has more than eight, or (of many beads) too many are near.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.neighbours import largest
    >>> x = jnp.array([[0.0], [1.0], [1.5]])
    >>> def near(to, of):
    ...     return jnp.maximum(2 - abs(to[0] - of[0].T), 0.0)
    >>> print(*largest(near, (x,), (3,), jnp.array(2.0), most=2))
    [1 0] [2 1] [1.5 1. ]
    """
    number = len(beads[0])
    index, each = jnp.arange(number), min(_EACH, number)

    def row(to: tuple, of: tuple, real: Any) -> tuple[Array, Array]:
        later = to[-1][:, None] < of[-1][None]
        found = jnp.where(later & real[None], field(to[:-1], of[:-1]), 0.0)
        few = min(each, found.shape[1])
        none = jnp.zeros((len(found), few), found.dtype), jnp.zeros((len(found), few), jnp.int32)
        some = jnp.any(found > 0)  # else there is nothing to sort
        value, slot = lax.cond(some, lambda: (*lax.top_k(found, few),), lambda: none)
        return value, of[-1][slot]

    with_index = (*beads, index)
    if number < LEAST:
        value, second = row(with_index, with_index, jnp.ones(number, bool))
        first = jnp.broadcast_to(index[:, None], value.shape)
    else:
        blocks = _near(beads[0], pieces, reach)
        value, second = lax.map(
            lambda k: row(*blocks.some(k, with_index)), index[: len(blocks.rows)]
        )
        first = jnp.broadcast_to(jnp.asarray(blocks.rows)[:, :, None], value.shape)
        value = jnp.where(jnp.asarray(blocks.there)[:, :, None], value, 0.0)
    value, chosen = lax.top_k(value.ravel(), min(most, value.size))
    return first.ravel()[chosen], second.ravel()[chosen], value


class _Blocks(NamedTuple):
    """Beads in blocks, and blocks that are near."""

    rows: np.ndarray
    """Beads of each block, the last one repeated."""
    there: np.ndarray
    """Which of these are no repetition."""
    others: Int[Array, "blocks near"]
    """Blocks that are near to each."""
    real: Bool[Array, "blocks near"]
    fine: Bool[Array, ""]
    """Whether there was room for all."""

    def some(self, k: Array, beads: tuple[Array, ...]) -> tuple[Any, Any, Array]:
        """Beads of block k, those of blocks near to it, and which of the latter count."""
        rows = jnp.asarray(self.rows)
        to = tuple(b[rows[k]] for b in beads)
        of = tuple(b[rows[self.others[k]].ravel()] for b in beads)
        real = self.real[k][:, None] & jnp.asarray(self.there)[self.others[k]]
        return to, of, real.ravel()


def _near(position: Array, pieces: tuple[int, ...], reach: Array) -> _Blocks:
    rows = blocks_of(pieces, BLOCK)
    there = np.arange(rows.shape[1]) < (rows[:, -1] - rows[:, 0] + 1)[:, None]
    x, room = lax.stop_gradient(position)[rows], min(NEAR, len(rows))
    middle = jnp.mean(x, axis=1)
    wide = jnp.max(jnp.linalg.norm(x - middle[:, None], axis=2), axis=1)
    apart = jnp.linalg.norm(middle[:, None] - middle[None], axis=2)
    # What is not a number is near to all, so that it is not overlooked.
    near = ~(apart > wide[:, None] + wide[None] + lax.stop_gradient(reach))
    _, others = lax.top_k(near.astype(jnp.float32), room)
    real = jnp.take_along_axis(near, others, axis=1)
    return _Blocks(rows, there, others, real, jnp.all(jnp.sum(near, axis=1) <= room))
