"""Coordinates of the states near one state, in which chains keep their bond lengths exactly."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import carried
from .chain import Chain, place
from .constraint import AbstractChainConstraint
from .geometry import normals
from .scene import Scene
from .state import State


class AbstractCoordinates(eqx.Module):
    """A chart x -> state with x = 0 at its start; see `coordinates`. The numbers are points (of all
    beads, or one of each fibre), turns of directions, and what the state carries beside them.
    """

    start: eqx.AbstractVar[State]
    """The state at x = 0."""
    chain: eqx.AbstractVar[Chain]

    @property
    def besides(self) -> tuple[str, ...]:
        """Names of the carried parts that follow from the rest."""
        return ()

    @property
    @abc.abstractmethod
    def sizes(self) -> tuple[int, int, int]:
        """How many numbers are points, turns of directions, and carried."""

    @property
    def fibres(self) -> np.ndarray:
        """Of each number the fibre that it belongs to; -1: none. Shape `(numbers,)`."""
        dim, chain = self.start.position.shape[1], self.chain
        kept = carried.parts(self.start, self.besides)
        others = [part.fibres(getattr(self.start, part.name), chain) for part in kept]
        at = self._bead_of_direction
        turns = np.where(at < 0, -1, chain.fibre_of_bead[at])
        return np.concatenate([self._of_points.repeat(dim), turns.repeat(dim - 1), *others])

    @property
    def beads(self) -> np.ndarray:
        """Of each number the bead that it belongs to, or the bead before its bond; -1: none. Shape
        `(numbers,)`.
        """
        dim = self.start.position.shape[1]
        kept = carried.parts(self.start, self.besides)
        others = [part.beads(getattr(self.start, part.name), self.chain) for part in kept]
        points, turns = self._bead_of_point, self._bead_of_direction
        return np.concatenate([points.repeat(dim), turns.repeat(dim - 1), *others])

    @property
    @abc.abstractmethod
    def _of_points(self) -> np.ndarray:
        """The fibre of each point."""

    @property
    @abc.abstractmethod
    def _bead_of_point(self) -> np.ndarray:
        """The bead of each point; -1: none."""

    @property
    def _bead_of_direction(self) -> np.ndarray:
        """The bead of each direction, or the bead before its bond; -1: none."""
        return np.zeros(0, int)

    @abc.abstractmethod
    def state(self, x: Float[Array, " numbers"]) -> State:
        """The state at x."""

    @abc.abstractmethod
    def rate(
        self, x: Float[Array, " numbers"], state: State, moving: State
    ) -> Float[Array, " numbers"]:
        """dx/dt at x, where the state is `state` and its rate of change `moving`."""

    @abc.abstractmethod
    def points(self, position: Float[Array, "beads dim"]) -> Float[Array, "points dim"]:
        """The points by which beads at these positions are placed."""

    @abc.abstractmethod
    def directions(self, state: State) -> Float[Array, "directions dim"]:
        """The unit vectors that make the shape of a state; none of beads alone."""

    @abc.abstractmethod
    def sideways(self, vectors: Float[Array, "directions dim"]) -> Float[Array, "directions turns"]:
        """Components of vectors normal to the directions of the start."""

    @property
    def origin(self) -> Float[Array, " numbers"]:
        """x = 0."""
        return jnp.zeros(sum(self.sizes), self.start.position.dtype)

    @property
    def units(self) -> Float[Array, " numbers"]:
        """How large each coordinate may be: the longest fibre's length for points, otherwise 1."""
        points, *others = self.sizes
        ones = jnp.ones(points + sum(others), self.start.position.dtype)
        return ones.at[:points].set(jnp.max(self.chain.length))

    def loose(self, state: State) -> list[Float[Array, "rows dim"]]:
        """Vectors of the state that turn with the whole and are numbers of their own."""
        return carried.vectors(state, self.besides)

    def loose_numbers(self, vectors: Float[Array, "rows dim"]) -> Float[Array, " numbers"]:
        """Small changes of these vectors, one below the other, as changes of numbers."""
        kept = [p for p in carried.parts(self.start, self.besides) if p.vectors]
        rows = [len(getattr(self.start, part.name)) for part in kept]
        each = zip(kept, jnp.split(vectors, np.cumsum(rows, dtype=int)), strict=False)
        numbers = [part.components(self.start, change, self.chain) for part, change in each]
        return jnp.concatenate([vectors[:0].ravel(), *numbers])

    def _split(self, x: Array) -> tuple[Array, Array, list[Array]]:
        """Points, turns, and the numbers of each carried part."""
        dim, (points, turns, _) = self.start.position.shape[1], self.sizes
        parts = jnp.split(x, np.cumsum([points, turns, *self._carried_sizes])[:-1])
        return parts[0].reshape(-1, dim), parts[1].reshape(-1, dim - 1), parts[2:]

    @property
    def _carried_sizes(self) -> list[int]:
        kept = carried.parts(self.start, self.besides)
        return [part.size(getattr(self.start, part.name)) for part in kept]

    def _carried(self, numbers: list[Array], position: Array) -> dict[str, Any]:
        """The carried parts at x, where the beads are at positions."""
        kept = carried.parts(self.start, self.besides)
        return {
            part.name: part.retract(self.start, x, position, self.chain)
            for part, x in zip(kept, numbers, strict=True)
        }

    def _joined(self, points: Array, turn: Array, state: State, moving: State) -> Array:
        others = [
            part.numbers_rate(self.start, state, moving, self.chain)
            for part in carried.parts(self.start, self.besides)
        ]
        return jnp.concatenate([points.ravel(), turn.ravel(), *others])


class BeadCoordinates(AbstractCoordinates):
    """The beads' own positions."""

    start: State
    chain: Chain

    @property
    def sizes(self) -> tuple[int, int, int]:
        """All positions, no turns."""
        return self.start.position.size, 0, sum(self._carried_sizes)

    @property
    def _of_points(self) -> np.ndarray:
        return self.chain.fibre_of_bead

    @property
    def _bead_of_point(self) -> np.ndarray:
        return np.arange(self.chain.beads)

    def state(self, x: Float[Array, " numbers"]) -> State:
        """The state at x."""
        points, _, others = self._split(x)
        position = self.start.position + points
        return carried.with_values(position, self._carried(others, position))

    def rate(
        self, x: Float[Array, " numbers"], state: State, moving: State
    ) -> Float[Array, " numbers"]:
        """The rate itself."""
        return self._joined(moving.position, self._split(x)[1], state, moving)

    def points(self, position: Float[Array, "beads dim"]) -> Float[Array, "points dim"]:
        """All of them."""
        return position

    def directions(self, state: State) -> Float[Array, "directions dim"]:
        """None."""
        return state.position[:0]

    def sideways(self, vectors: Float[Array, "directions dim"]) -> Float[Array, "directions turns"]:
        """None."""
        return vectors[:, 1:]


class ChainCoordinates(AbstractCoordinates):
    """One point of each fibre and the directions of its bonds."""

    start: State
    chain: Chain
    constraint: AbstractChainConstraint
    direction: Float[Array, "directions dim"]
    """Unit vectors e of the start that make its shape."""
    anchors: tuple[int | None, ...] = eqx.field(static=True)
    """The bead by which each fibre is placed; `None`: its centre."""

    @property
    def besides(self) -> tuple[str, ...]:
        """Directors, where they are the directions."""
        return ("director",) if self.constraint.oriented else ()

    @property
    def sizes(self) -> tuple[int, int, int]:
        """A point of each fibre, the turns of all directions."""
        rows, dim = self.direction.shape
        return len(self.chain.fibres) * dim, rows * (dim - 1), sum(self._carried_sizes)

    @property
    def _of_points(self) -> np.ndarray:
        return np.arange(len(self.chain.fibres))

    @property
    def _bead_of_point(self) -> np.ndarray:
        return np.full(len(self.chain.fibres), -1)

    @property
    def _bead_of_direction(self) -> np.ndarray:
        bead = np.arange(len(self.direction))
        return np.where(self.chain.bond_mask, bead, -1) if len(bead) < self.chain.beads else bead

    def state(self, x: Float[Array, " numbers"]) -> State:
        """The state at x."""
        points, turn, numbers = self._split(x)
        quarter = (turn * turn).sum(axis=1, keepdims=True) / 4
        sideways = jnp.einsum("rn,rnd->rd", turn, normals(self.direction))
        direction = ((1 - quarter) * self.direction + sideways) / (1 + quarter)
        weights = self._weights
        points = weights @ self.start.position + points
        bonds = self.constraint.bonds(direction, self.chain)
        position = place(self.chain, bonds, points, weights)
        others = self._carried(numbers, position)
        if self.constraint.oriented:
            others = others | {"director": direction}
        return carried.with_values(position, others)

    def rate(
        self, x: Float[Array, " numbers"], state: State, moving: State
    ) -> Float[Array, " numbers"]:
        """That of the stereographic map."""
        turn = self._split(x)[1]
        turning = jax.jvp(self.directions, (state,), (moving,))[1]
        quarter = (turn * turn).sum(axis=1, keepdims=True) / 4
        along = (turning * self.direction).sum(axis=1, keepdims=True)
        turn = (1 + quarter) * (self.sideways(turning) - turn * along / 2)
        return self._joined(self._weights @ moving.position, turn, state, moving)

    def points(self, position: Float[Array, "beads dim"]) -> Float[Array, "points dim"]:
        """One of each fibre."""
        return self._weights @ position

    def directions(self, state: State) -> Float[Array, "directions dim"]:
        """Those that the constraint keeps."""
        return self.constraint.directions(state, self.chain)

    def sideways(self, vectors: Float[Array, "directions dim"]) -> Float[Array, "directions turns"]:
        """Components of vectors normal to the directions of the start."""
        return jnp.einsum("rd,rnd->rn", vectors, normals(self.direction))

    @property
    def _weights(self) -> Float[Array, "fibres beads"]:
        """Of each bead in the point by which its fibre is placed."""
        chain = self.chain
        rows = (chain.fibre_of_bead == np.arange(len(chain.fibres))[:, None]).astype(float)
        rows /= rows.sum(axis=1, keepdims=True)
        for row, bead in zip(rows, self.anchors, strict=True):
            if bead is not None:
                row[:] = np.arange(chain.beads) == bead
        return jnp.asarray(rows, self.start.position.dtype)


def coordinates(scene: Scene, state: State) -> AbstractCoordinates:
    """Coordinates about a state in which the scene's chain constraint holds exactly.

    A chain is given by one point of each fibre and the unit vectors of its bonds (for `Joint`, of its
    beads): t = ((1 - |x|^2/4) e + x)/(1 + |x|^2/4), the stereographic map of the vectors x normal to the
    start's e. The point is a bead whose motion is prescribed, if the fibre has one (the first of
    several; the others keep their places as well as the time step is accurate), otherwise its centre.
    Besides holding bond lengths, they are the unknowns in which implicit steps go far: stiff bending
    is linear in angles, but couples to the tension where beads move on straight lines. Without a chain
    constraint the coordinates are those of the beads.
    """
    anchors: list[int | None] = [None] * len(scene.chain.fibres)
    for constraint in scene.constraints:
        held = () if constraint.anchor is None else np.atleast_1d(constraint.anchor)
        for bead in (int(k) % scene.chain.beads for k in held):
            fibre = scene.chain.fibre_of_bead[bead]
            anchors[fibre] = bead if anchors[fibre] is None else anchors[fibre]
    chained = [c for c in scene.constraints if isinstance(c, AbstractChainConstraint)]
    if not chained:
        return BeadCoordinates(state, scene.chain)
    direction = chained[0].directions(state, scene.chain)
    chart = ChainCoordinates(state, scene.chain, chained[0], direction, tuple(anchors))
    return eqx.tree_at(lambda c: c.start, chart, chart.state(chart.origin))


def tidied(scene: Scene, state: State) -> State:
    """The state without what time stepping has added to what it carries. A chain constraint that is made
    of directors looks after them itself.
    """
    chained = (c for c in scene.constraints if isinstance(c, AbstractChainConstraint))
    besides = ("director",) if any(c.oriented for c in chained) else ()
    return carried.tidied(state, scene.chain, besides)


def project(scene: Scene, state: State) -> State:
    """Bond lengths restored by the scene's chain constraint; directions are kept, and the place of each
    fibre's centre or held bead.
    """
    return coordinates(scene, tidied(scene, state)).start
