"""Coordinates of the states near one state, in which chains keep their bond lengths exactly."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .chain import Chain, place
from .constraint import AbstractChainConstraint
from .frames import tidy
from .geometry import normals
from .scene import Scene
from .state import State


class Coordinates(eqx.Module):
    """A chart x -> state with x = 0 at its start; see `coordinates`."""

    start: State
    """The state at x = 0, its bonds at their lengths."""
    chain: Chain
    constraint: AbstractChainConstraint | None
    direction: Float[Array, "directions dim"] | None
    """Unit vectors e of the start that make its shape."""
    anchors: tuple[int | None, ...] = eqx.field(static=True)
    """The bead by which each fibre is placed; `None`: its centre."""

    @property
    def origin(self) -> Float[Array, " numbers"]:
        """x = 0."""
        return jnp.zeros(sum(self.sizes), self.start.position.dtype)

    def state(self, x: Float[Array, " numbers"]) -> State:
        """The state at x."""
        points, turn, rest, frame = self._split(x)
        director, normal = self.start.director, self.start.normal
        normal = None if normal is None else normal + frame
        if self.constraint is None or self.direction is None:
            director = None if director is None else director + rest
            return State(self.start.position + points, director, normal)
        quarter = (turn * turn).sum(axis=1, keepdims=True) / 4
        sideways = jnp.einsum("rn,rnd->rd", turn, normals(self.direction))
        direction = ((1 - quarter) * self.direction + sideways) / (1 + quarter)
        weights = self._weights
        points = weights @ self.start.position + points
        bonds = self.constraint.bonds(direction, self.chain)
        position = place(self.chain, bonds, points, weights)
        if self.constraint.oriented:
            return State(position, direction, normal)
        return State(position, None if director is None else director + rest, normal)

    def rate(
        self, x: Float[Array, " numbers"], state: State, moving: State
    ) -> Float[Array, " numbers"]:
        """dx/dt at x, where the state is `state` and its rate of change `moving`."""
        if self.constraint is None or self.direction is None:
            parts = [moving.position, moving.director, moving.normal]
            return jnp.concatenate([part.ravel() for part in parts if part is not None])
        constraint, turn = self.constraint, self._split(x)[1]
        turning = jax.jvp(lambda s: constraint.directions(s, self.chain), (state,), (moving,))[1]
        quarter = (turn * turn).sum(axis=1, keepdims=True) / 4
        along = (turning * self.direction).sum(axis=1, keepdims=True)
        sideways = jnp.einsum("rd,rnd->rn", turning, normals(self.direction))
        parts = [self._weights @ moving.position, (1 + quarter) * (sideways - turn * along / 2)]
        if moving.director is not None and not constraint.oriented:
            parts.append(moving.director)
        if moving.normal is not None:
            parts.append(moving.normal)
        return jnp.concatenate([part.ravel() for part in parts])

    @property
    def units(self) -> Float[Array, " numbers"]:
        """How large each coordinate may be: the longest fibre's length for places, otherwise 1."""
        places, *others = self.sizes
        ones = jnp.ones(places + sum(others), self.start.position.dtype)
        return ones.at[:places].set(jnp.max(self.chain.length))

    @property
    def sizes(self) -> tuple[int, ...]:
        """How many numbers are points of fibres (or all beads), turns of directions, directors and
        normals that are carried."""
        size = self.start.position.size
        normal = self.start.normal
        frame = 0 if normal is None else normal.size
        carried = self.start.director is not None
        if self.constraint is None or self.direction is None:
            return size, 0, size if carried else 0, frame
        rows, dim = self.direction.shape
        rest = size if carried and not self.constraint.oriented else 0
        return len(self.chain.fibres) * dim, rows * (dim - 1), rest, frame

    def places(self, position: Float[Array, "beads dim"]) -> Float[Array, "points dim"]:
        """The points by which beads at these positions are placed."""
        return position if self.constraint is None else self._weights @ position

    def _split(self, x: Array) -> tuple[Array, Array, Array, Array]:
        dim = self.start.position.shape[1]
        parts = jnp.split(x, np.cumsum(self.sizes)[:-1])
        points, turn, rest, frame = (
            part.reshape(-1, dim - 1 if which == 1 else dim) for which, part in enumerate(parts)
        )
        return points, turn, rest, frame

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


def coordinates(scene: Scene, state: State) -> Coordinates:
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
        if constraint.held is not None:
            bead = constraint.held % scene.chain.beads
            fibre = scene.chain.fibre_of_bead[bead]
            anchors[fibre] = bead if anchors[fibre] is None else anchors[fibre]
    chained = [c for c in scene.constraints if isinstance(c, AbstractChainConstraint)]
    if not chained:
        return Coordinates(state, scene.chain, None, None, tuple(anchors))
    direction = chained[0].directions(state, scene.chain)
    chart = Coordinates(state, scene.chain, chained[0], direction, tuple(anchors))
    return eqx.tree_at(lambda c: c.start, chart, chart.state(chart.origin))


def tidied(scene: Scene, state: State) -> State:
    """Directors and normals at length one, as time stepping keeps them to its order only. A chain
    constraint that is made of directors looks after them itself."""
    chained = (c for c in scene.constraints if isinstance(c, AbstractChainConstraint))
    return tidy(state, scene.chain, directors=not any(c.oriented for c in chained))


def project(scene: Scene, state: State) -> State:
    """Bond lengths restored by the scene's chain constraint; directions are kept, and the place of each
    fibre's centre or held bead."""
    return coordinates(scene, tidied(scene, state)).start
