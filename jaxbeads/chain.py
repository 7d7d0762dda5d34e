"""`Chain`: which beads there are and which are neighbours; initial shapes."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._checks import fail, finite, index, known, non_negative, non_zero, positive, shape, whole
from ._typing import float_array
from .geometry import unit
from .state import State


class Chain(eqx.Module):
    """Beads in a row, cut into one or several fibres.

    Every row of neighbours is stored, also where one fibre ends and the next begins; masks say which
    bonds and joints exist. So one fibre and many, of equal or unequal lengths, run the same slices.

    **Arguments**

    - `radius`: bead radius a [length], one for all or one per bead.
    - `fibres`: number of beads of the fibre, or a sequence with the number of each fibre.
    - `gap`: distance eps_g of each bead's surface from the link to its neighbour [length]; 0 for beads
      that touch. Neighbours are 2 (a + eps_g) apart.

    **Raises** `ValueError` for a radius that is not positive or does not fit the number of beads, and
    for a negative gap.

    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=[3, 2])
    >>> print(chain.beads, chain.length, chain.bond_length, chain.bond_mask)
    5 [6. 4.] [2. 2. 2. 2.] [ True  True False  True]
    """

    radius: Float[Array, ""] | Float[Array, " beads"] = eqx.field(converter=float_array)
    gap: Float[Array, ""] = eqx.field(converter=float_array)
    fibres: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, radius: Any, fibres: int | Sequence[int], gap: Any = 0.0) -> None:
        self.radius = float_array(radius)
        self.gap = float_array(gap)
        several = isinstance(fibres, (Sequence, np.ndarray))
        numbers = tuple(fibres) if several else (fibres,)
        if not numbers:
            fail("fibres", "name at least one fibre", "it is empty")
        for number in numbers:
            whole("fibres", number, 1)
        self.fibres = tuple(int(n) for n in numbers)

    def __check_init__(self) -> None:
        shape("radius", self.radius, (), (self.beads,))
        positive("radius", self.radius)
        shape("gap", self.gap, ())
        non_negative("gap", self.gap)

    @property
    def beads(self) -> int:
        """Number of beads of all fibres."""
        return sum(self.fibres)

    @property
    def fibre_of_bead(self) -> np.ndarray:
        """Index of the fibre of each bead, shape `(beads,)`."""
        return np.repeat(np.arange(len(self.fibres)), self.fibres)

    @property
    def first_beads(self) -> tuple[int, ...]:
        """Index of the first bead of each fibre."""
        return tuple(int(n) for n in np.cumsum((0, *self.fibres))[:-1])

    @property
    def last_beads(self) -> tuple[int, ...]:
        """Index of the last bead of each fibre, counted from the last of all as -1 (and so that of the
        bond before it).
        """
        return tuple(int(n) - self.beads - 1 for n in np.cumsum(self.fibres))

    @property
    def bond_mask(self) -> np.ndarray:
        """Whether beads i and i + 1 are neighbours in one fibre, shape `(beads - 1,)`."""
        fibre = self.fibre_of_bead
        return fibre[1:] == fibre[:-1]

    @property
    def joint_mask(self) -> np.ndarray:
        """Whether beads i - 1, i, i + 1 belong to one fibre, shape `(beads - 2,)`."""
        return self.bond_mask[1:] & self.bond_mask[:-1]

    @property
    def radii(self) -> Float[Array, " beads"]:
        """Radius of each bead [length]."""
        return jnp.broadcast_to(self.radius, (self.beads,))

    @property
    def reach(self) -> Float[Array, " beads"]:
        """Distance a_i + eps_g of each bead's centre from the links to its neighbours [length]."""
        return jnp.broadcast_to(self.radius + self.gap, (self.beads,))

    @property
    def bond_length(self) -> Float[Array, " bonds"]:
        """Distance a_i + a_{i+1} + 2 eps_g of neighbours in a straight fibre [length]."""
        return self.reach[:-1] + self.reach[1:]

    @property
    def length(self) -> Float[Array, " fibres"]:
        """Contour length of each fibre, the sum of 2 (a_i + eps_g), so 2 a N if beads touch [length]."""
        ends = np.cumsum((0, *self.fibres))
        return jnp.stack([2 * self.reach[i:j].sum() for i, j in pairwise(ends)])

    @property
    def arclength(self) -> Float[Array, " beads"]:
        """Arclength of each bead's centre from the first end of its fibre [length]."""
        ends = np.cumsum((0, *self.fibres))
        parts = (self.reach[i:j] for i, j in pairwise(ends))
        return jnp.concatenate([jnp.cumsum(2 * part) - part for part in parts])

    def centres(self, position: Float[Array, "beads dim"]) -> Float[Array, "fibres dim"]:
        """Mean position of each fibre's beads."""
        member = self.fibre_of_bead == np.arange(len(self.fibres))[:, None]
        weights = jnp.asarray(member / member.sum(1, keepdims=True), position.dtype)
        return weights @ position


def check_bond(name: str, bond: int, chain: Chain) -> None:
    """Refuse the index of a bond that the chain does not have, as one from a fibre to the next."""
    if not chain.bond_mask.any():
        fail(name, "be a bond of the chain", f"it is {bond} and none of its fibres has two beads")
    index(name, bond, len(chain.bond_mask))
    if not chain.bond_mask[bond]:
        first, last = bond % len(chain.bond_mask), bond % len(chain.bond_mask) + 1
        one, other = chain.fibre_of_bead[[first, last]]
        must = f"be a bond within a fibre, {_spans(np.flatnonzero(chain.bond_mask))}"
        fail(
            name,
            must,
            f"bond {bond} leads from fibre {one} (bead {first}) to {other} (bead {last})",
        )


def _spans(numbers: np.ndarray) -> str:
    """Increasing whole numbers in words, as "0 to 3 or 5"."""
    parts = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    words = [f"{p[0]} to {p[-1]}" if len(p) > 1 else f"{p[0]}" for p in parts]
    if len(words) > 6:
        words = [*words[:3], "...", words[-1]]
    return f"{', '.join(words[:-1])} or {words[-1]}" if len(words) > 1 else words[0]


def from_tangents(chain: Chain, tangents: Any, centre: Any = None) -> Float[Array, "beads dim"]:
    """Positions of beads at the chain's bond lengths, from the directions of their bonds.

    **Arguments**

    - `tangents`: directions from bead i to i + 1, shape `(beads - 1, dim)`; normalised here; those
      between two fibres are not used.
    - `centre`: mean position of the beads [length], shape `(dim,)` or one for each fibre,
      `(fibres, dim)`; the origin by default.

    **Returns** positions, shape `(beads, dim)`. **Raises** `ValueError` for shapes that do not fit
    and for a zero tangent.

    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> print(jb.from_tangents(chain, [[1.0, 0.0], [0.0, 1.0]], centre=[0.0, 0.0]).round(4))
    [[-1.3333 -0.6667]
     [ 0.6667 -0.6667]
     [ 0.6667  1.3333]]
    """
    tangents = float_array(tangents)
    if (
        tangents.ndim != 2
        or tangents.shape[0] != chain.beads - 1
        or tangents.shape[1] not in (2, 3)
    ):
        fail(
            "tangents", f"have shape ({chain.beads - 1}, 2 or 3)", f"it has shape {tangents.shape}"
        )
    finite("tangents", tangents)
    if known(tangents):
        non_zero("tangents", np.where(chain.bond_mask[:, None], tangents, 1.0))
    dim = tangents.shape[1]
    centre = jnp.zeros(dim) if centre is None else float_array(centre)
    shape("centre", centre, (dim,), (len(chain.fibres), dim))
    finite("centre", centre)
    return _along(chain, tangents, centre)


@eqx.filter_jit
def _along(chain: Chain, tangents: Array, centre: Array) -> Array:
    bonds = unit(tangents) * chain.bond_length[:, None]
    return place(chain, bonds, jnp.broadcast_to(centre, (len(chain.fibres), tangents.shape[1])))


def from_directors(chain: Chain, directors: Any, centre: Any = None) -> State:
    """State of a chain of the Joint Model: each bead's director points along the fibre, and its links
    are at the distance a_i + eps_g before and behind its centre, eq. (2).

    **Arguments**

    - `directors`: p_i, shape `(beads, dim)`; normalised here.
    - `centre`: as in `from_tangents`.

    **Returns** positions and directors. **Raises** `ValueError` for shapes that do not fit and for a
    zero director.

    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=2, gap=0.1)
    >>> state = jb.from_directors(chain, [[1.0, 0.0], [0.0, 1.0]])
    >>> print(state.position, state.director)
    [[-0.55 -0.55]
     [ 0.55  0.55]] [[1. 0.]
     [0. 1.]]
    """
    directors = float_array(directors)
    shape("directors", directors, (chain.beads, 2), (chain.beads, 3))
    finite("directors", directors)
    non_zero("directors", directors)
    dim = directors.shape[1]
    centre = jnp.zeros(dim) if centre is None else float_array(centre)
    shape("centre", centre, (dim,), (len(chain.fibres), dim))
    finite("centre", centre)
    return _oriented(chain, directors, centre)


@eqx.filter_jit
def _oriented(chain: Chain, directors: Array, centre: Array) -> State:
    p = unit(directors)
    points = jnp.broadcast_to(centre, (len(chain.fibres), p.shape[1]))
    return State(place(chain, linked(chain, p), points), p)


def linked(chain: Chain, director: Float[Array, "beads dim"]) -> Float[Array, "bonds dim"]:
    """Vectors between neighbouring centres whose links coincide, l_i p_i + l_{i+1} p_{i+1}."""
    arm = director * chain.reach[:, None]
    return arm[:-1] + arm[1:]


def place(
    chain: Chain,
    bonds: Float[Array, "bonds dim"],
    points: Float[Array, "fibres dim"],
    weights: Float[Array, "fibres beads"] | None = None,
) -> Float[Array, "beads dim"]:
    """Positions from the vectors between neighbours (those between fibres are not used) and one
    point for each fibre, without checks: its centre, or the weighted mean of its beads.
    """
    step = bonds * chain.bond_mask[:, None]
    position = jnp.pad(jnp.cumsum(step, axis=0), ((1, 0), (0, 0)))
    present = chain.centres(position) if weights is None else weights @ position
    return position + (points - present)[chain.fibre_of_bead]


def straight(chain: Chain, direction: Any, centre: Any = None) -> State:
    """Straight fibres.

    **Arguments**

    - `direction`: from the first bead to the last, shape `(dim,)` or one for each fibre,
      `(fibres, dim)`. Its number of components, 2 or 3, makes the scene planar or spatial.
    - `centre`: as in `from_tangents`.

    **Raises** `ValueError` for a zero direction or shapes that do not fit.

    >>> import jaxbeads as jb
    >>> print(jb.straight(jb.Chain(radius=1.0, fibres=3), direction=[0.0, 5.0]).position)
    [[ 0. -2.]
     [ 0.  0.]
     [ 0.  2.]]
    """
    direction = float_array(direction)
    fibres = len(chain.fibres)
    shape("direction", direction, (2,), (3,), (fibres, 2), (fibres, 3))
    finite("direction", direction)
    non_zero("direction", direction)
    return State(from_tangents(chain, _of_bonds(chain, direction), centre))


@eqx.filter_jit
def _of_bonds(chain: Chain, direction: Array) -> Array:
    """Of each bond, from those of the fibres or one for all."""
    fibres = jnp.broadcast_to(direction, (len(chain.fibres), direction.shape[-1]))
    return fibres[chain.fibre_of_bead[:-1]]
