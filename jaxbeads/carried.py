"""What a state carries beside the positions: one class for each part, with all of its rules.

How a part changes in a motion, how the errors of time stepping are cleared from it, what its error is
as a length, whether it turns with the whole. Solvers, coordinates and steady states ask here and know
no part by name. A new part is a field of `State`, a class here and a line in
`PARTS`.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from . import material
from .chain import Chain
from .geometry import norm, peak, spin_cross
from .state import Motion, State


class AbstractPart(abc.ABC):
    """The rules of one part."""

    name: str
    """Of the field of `State`."""
    words: str
    """What it is called in a sentence."""
    vectors: bool = True
    """Whether it consists of vectors `(..., dim)` that turn with the whole."""
    spun: bool = False
    """Whether the beads' spins change it."""

    @abc.abstractmethod
    def rate(self, value: Any, state: State, motion: Motion, chain: Chain) -> Any:
        """Its rate of change in a motion of the beads, linear in the motion."""

    def tidy(self, value: Any, state: State, chain: Chain) -> Any:
        """Its value without what time stepping, exact to its order only, has added."""
        return value

    def size(self, value: Any) -> int:
        """How many numbers a change of it takes."""
        return ravel_pytree(value)[0].size

    def fibres(self, value: Any, chain: Chain) -> np.ndarray:
        """Of each of these numbers the fibre that it belongs to; -1: none."""
        return np.full(self.size(value), -1)

    def beads(self, value: Any, chain: Chain) -> np.ndarray:
        """Of each of these numbers the bead that it belongs to; -1: none."""
        return np.full(self.size(value), -1)

    def retract(
        self,
        start: State,
        numbers: Float[Array, " numbers"],
        position: Float[Array, "beads dim"],
        chain: Chain,
    ) -> Any:
        """What is near its value in a state by so much, where the beads are at other positions: their
        sum, and the value itself at 0.
        """
        flat, whole = ravel_pytree(getattr(start, self.name))
        return whole(flat + numbers)

    def numbers_rate(
        self, start: State, state: State, moving: State, chain: Chain
    ) -> Float[Array, " numbers"]:
        """Rate of the numbers of `retract` where the state to which they lead changes at a rate."""
        return ravel_pytree(getattr(moving, self.name))[0]

    def components(self, start: State, change: Any, chain: Chain) -> Float[Array, " numbers"]:
        """A small change of its value in a state as one of the numbers."""
        return ravel_pytree(change)[0]

    def off(self, error: Any, arm: Float[Array, ""]) -> Float[Array, ""]:
        """How far an error of it puts the end of an arm off [length]."""
        return arm * peak(norm(error))


class _Directors(AbstractPart):
    name, words, spun = "director", "the orientations", True

    def fibres(self, value: Any, chain: Chain) -> np.ndarray:
        """That of the bead."""
        return chain.fibre_of_bead.repeat(value.shape[1])

    def beads(self, value: Any, chain: Chain) -> np.ndarray:
        """A vector of each."""
        return np.arange(chain.beads).repeat(value.shape[1])

    def rate(self, value: Any, state: State, motion: Motion, chain: Chain) -> Array:
        """w x p."""
        if motion.spin is None:
            raise ValueError(
                "Argument `state` must hold no directors, but no term of the scene turns beads."
            )
        return spin_cross(motion.spin, value)

    def tidy(self, value: Any, state: State, chain: Chain) -> Array:
        """Of length one."""
        return value / norm(value)[:, None]


class _Frames(AbstractPart):
    """As numbers: how far each is turned about the fibre from where the smallest rotations lead it."""

    name, words, spun = "frame", "the material frames", True

    def size(self, value: Any) -> int:
        """An angle of each bead."""
        return len(value)

    def fibres(self, value: Any, chain: Chain) -> np.ndarray:
        """That of the bead."""
        return chain.fibre_of_bead

    def beads(self, value: Any, chain: Chain) -> np.ndarray:
        """An angle of each."""
        return np.arange(chain.beads)

    def rate(self, value: Any, state: State, motion: Motion, chain: Chain) -> Array:
        """With the fibre and the beads' spins about it, see `material`."""
        return material.rate(value, state.position, motion, chain)

    def tidy(self, value: Any, state: State, chain: Chain) -> Array:
        """Of length one and normal to the fibres."""
        return material.upright(value, state.position, chain)

    def retract(self, start: State, numbers: Array, position: Array, chain: Chain) -> Array:
        """Led there, and turned."""
        led = material.moved(_frame(start), start.position, position, chain)
        return material.angled(led, material.directions(position, chain)[1], numbers)

    def numbers_rate(self, start: State, state: State, moving: State, chain: Chain) -> Array:
        """How fast it turns, but for how fast the smallest rotations turn what they lead."""

        def lead(position: Array) -> Array:
            return material.moved(_frame(start), start.position, position, chain)

        t = material.directions(state.position, chain)[1]
        turning = material.turning(_frame(state), t, _frame(moving))
        led = jax.jvp(lead, (state.position,), (moving.position,))
        return turning - material.turning(led[0], t, led[1])

    def components(self, start: State, change: Any, chain: Chain) -> Array:
        """How far it turns."""
        t = material.directions(start.position, chain)[1]
        return material.turning(_frame(start), t, change)


def _frame(state: State) -> Array:
    return jnp.asarray(state.frame)


class _Own(AbstractPart):
    name, words, vectors = "own", "the terms' own numbers", False

    def rate(self, value: Any, state: State, motion: Motion, chain: Chain) -> Any:
        """None by the motion: `Scene.own_rate` adds theirs."""
        return jax.tree.map(jnp.zeros_like, value)

    def off(self, error: Any, arm: Float[Array, ""]) -> Float[Array, ""]:
        """Numbers of order one."""
        return arm * peak(ravel_pytree(error)[0])


PARTS: tuple[AbstractPart, ...] = (_Directors(), _Frames(), _Own())


def parts(state: State, besides: tuple[str, ...] = ()) -> list[AbstractPart]:
    """The parts that a state has, but for some."""
    return [p for p in PARTS if p.name not in besides and getattr(state, p.name) is not None]


def values(state: State, besides: tuple[str, ...] = ()) -> dict[str, Any]:
    """The parts' values by their names."""
    return {part.name: getattr(state, part.name) for part in parts(state, besides)}


def with_values(position: Array, given: dict[str, Any]) -> State:
    """A state of positions and of parts by their names."""
    return State(position, *(given.get(part.name) for part in PARTS))


def moving(state: State, motion: Motion, chain: Chain) -> State:
    """Rate of change of a state in a motion, linear in the motion."""
    rates = {
        part.name: part.rate(getattr(state, part.name), state, motion, chain)
        for part in parts(state)
    }
    return with_values(motion.velocity, rates)


def spun(state: State) -> bool:
    """Whether it has a part that the beads' spins change."""
    return any(part.spun for part in parts(state))


def largest(change: State, arm: Float[Array, ""]) -> Float[Array, ""]:
    """How far a small change of a state moves its worst bead, or the tip of an arm that turns with what
    it carries [length].
    """
    worst = peak(norm(change.position))
    for part in parts(change):
        worst = jnp.maximum(worst, part.off(getattr(change, part.name), arm))
    return worst


def tidied(state: State, chain: Chain, besides: tuple[str, ...] = ()) -> State:
    """The state without what time stepping has added to its parts, but for some."""
    for part in parts(state, besides):
        clean = part.tidy(getattr(state, part.name), state, chain)
        state = eqx.tree_at(lambda s, n=part.name: getattr(s, n), state, clean)
    return state


def turned(state: State, matrix: Float[Array, "dim dim"]) -> State:
    """The rate of a state that turns as a whole: vectors times an antisymmetric matrix."""
    rates = {
        part.name: value @ matrix if part.vectors else jax.tree.map(jnp.zeros_like, value)
        for part, value in ((part, getattr(state, part.name)) for part in parts(state))
    }
    return with_values(state.position @ matrix, rates)


def vectors(state: State, besides: tuple[str, ...] = ()) -> list[Float[Array, "rows dim"]]:
    """The values that turn with the whole, but for some."""
    return [getattr(state, part.name) for part in parts(state, besides) if part.vectors]
