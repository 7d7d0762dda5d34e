"""Which term of a scene has no finite value, or no finite derivative, at a state."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from .carried import PARTS
from .constraint import AbstractConstraint
from .dynamics import motion, named
from .instant import Time, ambient_motion, applied_load, fluid_motion
from .scene import Scene
from .state import Motion, State, zero_motion

REMEDY = (
    "Linearly implicit steps and root finding need derivatives: write the term so that it has them "
    "(`jaxbeads.geometry.norm` has derivative 0 at 0), or take an explicit solver, as "
    "`diffrax.Tsit5()`, which needs none."
)


class Fault(NamedTuple):
    """A term, what about it is not finite, the first bead of which this is so (if it is known), and
    whether it is a derivative only.
    """

    term: str
    how: str
    bead: int | None = None
    derivative: bool = False


_Term = Callable[[Array, State], Any]
"""Arrays of a term as a function of the time and the state."""


def not_finite(t: Time, state: State, scene: Scene) -> Fault | None:
    """The first term whose value is not finite; `None` if all are. A host function."""
    time = jnp.asarray(t, state.position.dtype)
    rates = scene.own_rate(time, state) or (None,) * len(scene.forces)
    for index, (force, rate) in enumerate(zip(scene.forces, rates, strict=True)):
        bead = _first(scene.load_of(index, time, state), len(state.position))
        if bead is not None:
            return Fault(type(force).__name__, "its load is not finite", *bead)
        if _first(rate) is not None:
            return Fault(type(force).__name__, "the rate of its own numbers is not finite")
    if scene.flow is not None:
        name, beads = type(scene.flow).__name__, len(state.position)
        flow = scene.flow
        plain = jax.vmap(lambda x: flow.velocity(time, x))(state.position)
        if (bead := _first(plain, beads)) is not None:
            return Fault(name, "its velocity is not finite", *bead)
        if (bead := _first(fluid_motion(time, state, scene).velocity, beads)) is not None:
            how = "the gradient of its velocity, or the Laplacian that spheres feel, is not finite"
            return Fault(name, how, *bead)
        if (bead := _first(ambient_motion(time, state, scene), beads)) is not None:
            return Fault(name, "the gradient of its velocity is not finite", *bead)
    still = zero_motion(state, scene.rotational)
    for constraint in scene.constraints:
        if _first(constraint.slip(time, state, still, scene.chain)) is not None:
            return Fault(named(constraint), "what it prescribes is not finite")
    return None


def not_smooth(t: Time, state: State, scene: Scene) -> Fault | None:
    """The first term of which a derivative is not finite that linearisations need, where all values
    are; `None` if there is none. A host function.
    """
    time = jnp.asarray(t, state.position.dtype)
    for index, force in enumerate(scene.forces):
        load = partial(scene.load_of, index)
        if (found := _derivative(type(force).__name__, "its load", load, time, state)) is not None:
            return found
    if scene.flow is not None:
        name = type(scene.flow).__name__
        parts: dict[str, _Term] = {
            "its velocity": lambda t, s: fluid_motion(t, s, scene).velocity,
            "the gradient of its velocity": lambda t, s: ambient_motion(t, s, scene),
        }
        for what, part in parts.items():
            if (found := _derivative(name, what, part, time, state)) is not None:
                return found
    held = motion(time, state, scene)
    for constraint in scene.constraints:
        slip = partial(_slip, constraint, scene, held)
        found = _derivative(named(constraint), "what it prescribes", slip, time, state, False)
        if found is not None:
            return found
    load = applied_load(time, state, scene)
    if load.force is None and load.torque is None:
        return None

    def mobile(t: Array, s: State) -> Motion:
        return scene.operator(s).motion(load)

    return _derivative(type(scene.mobility).__name__, "its motion", mobile, time, state)


def _slip(
    constraint: AbstractConstraint, scene: Scene, held: Motion, t: Array, state: State
) -> Array:
    return constraint.slip(t, state, held, scene.chain)


_NAMES = {"position": "the positions"} | {part.name: part.words for part in PARTS}


def _derivative(
    name: str, what: str, term: _Term, t: Array, state: State, beads: bool = True
) -> Fault | None:
    """A derivative along the time or a part of the state that is not finite: one in which all its
    numbers change tells of each of them.
    """
    number = len(state.position) if beads else None

    def fault(function: Callable[[Array], Any], at: Array, by: str) -> Fault | None:
        along = jnp.cos(1 + jnp.arange(at.size, dtype=at.dtype)).reshape(at.shape)
        bead = _first(jax.jvp(function, (at,), (along,))[1], number)
        if bead is None:
            return None
        where = "" if bead[0] is None else f" at bead {bead[0]}"
        return Fault(name, f"the derivative of {what} by {by} is not finite{where}", bead[0], True)

    for part, value in vars(state).items():
        if value is not None:
            numbers, whole = ravel_pytree(value)

            def moved(x: Array, part: str = part, whole: Any = whole) -> Any:
                return term(t, eqx.tree_at(lambda s: getattr(s, part), state, whole(x)))

            if (found := fault(moved, numbers, _NAMES[part])) is not None:
                return found
    return fault(lambda t: term(t, state), t, "the time")


def _first(values: Any, beads: int | None = None) -> tuple[int | None] | None:
    """The first bead (`None` where rows are none of beads) of arrays that are not finite, if any."""
    for value in jax.tree.leaves(values):
        wrong = ~np.isfinite(np.asarray(value))
        if wrong.any():
            if beads is None or wrong.shape[:1] != (beads,):
                return (None,)
            return (int(np.argmax(wrong.reshape(beads, -1).any(axis=1))),)
    return None
