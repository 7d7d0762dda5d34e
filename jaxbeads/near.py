"""What is solved instead of an implicit stage: fibres that do not feel one another, pairs that touch.

The answer to how far the equations of a stage are off (`stages`) is exact for fibres alone, with M' of
`windows` in place of M and the derivatives of the loads. Stiff forces between fibres are taken by pairs
of beads (`touching`).
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from . import lengthwise
from ._typing import with_all_digits
from .coordinates import AbstractCoordinates
from .factors import inverse
from .force import AbstractTouching
from .lengthwise import Lengthwise, Maps
from .saddle import Iterations, iterations
from .scene import Scene
from .state import Load, Motion, add_loads, add_motions
from .touching import Lone, Touches, by_own_place, placed, room, touches
from .windows import Fibres, Windows, parts

_COLUMNS = 64
"""Derivatives that are found side by side."""


class Unknowns(NamedTuple):
    """Of one stage."""

    rate: Float[Array, " numbers"]
    """k [coordinates/time]."""
    multipliers: Float[Array, " rows"]


class Near(eqx.Module):
    """What is solved instead of a stage: M' of one instant, S' = J M' J^T and D = 1 - g W', with

        W' = T (1 - M' J^T S'^-1 J) M' dF/dx

    fibre by fibre, where T takes motions to rates of coordinates; of long fibres see `lengthwise`.
    """

    maps: Maps
    """T, J, M' and dF/dx."""
    ahead: Float[Array, ""]
    """g."""
    system: Iterations | None
    inverse: Float[Array, "fibres size size"] | None = None
    """D^-1, in units of the coordinates."""
    touches: Touches | None = None
    """Pairs that touch, not in D."""
    long: Lengthwise | None = None

    def answer(self, off: Unknowns, implicit: Array) -> Unknowns:
        """Change of the unknowns that takes away what the equations are off; linear."""
        if self.long is not None:
            return lax.cond(implicit, lambda: self._along(off), lambda: self._explicit(off))
        touches = self.touches
        return self._answer(off, implicit, None if touches is None else touches.pushed)[0]

    def met(
        self, off: Unknowns, implicit: Array, gap: Array, push: Array
    ) -> tuple[Unknowns, Array]:
        """The same by the whole law of pairs that have gaps and pushes, and the change of these."""
        touches: Any = self.touches
        return self._answer(off, implicit, lambda alone: touches.met(alone, gap, push))

    def _answer(self, off: Unknowns, implicit: Array, meet: Any) -> tuple[Unknowns, Any]:
        pushed, rate = off.multipliers, off.rate
        if self.system is not None:
            pushed = -self.system.precondition(pushed)
            rate = rate - self._pulled(pushed)
        rate = self._held(-rate, implicit, False)
        push = None
        if self.touches is not None:
            units = self.maps.chart.units
            push = jnp.where(implicit, meet(self._parts(rate / units)), 0.0)
            rate = rate + self._whole(self.touches.moved(push)) * units
        if self.system is not None and self.inverse is not None:
            slip = self.maps.linear(self._stiff(jnp.where(implicit, rate, 0.0), push))
            pushed = pushed - self.system.precondition(slip)
        return Unknowns(rate, pushed), push

    def transposed(self, of: Unknowns, implicit: Array) -> Unknowns:
        """The transpose of `answer`, linear."""
        if self.long is not None:
            back, explicit = self._along_transposed, self._explicit_transposed
            return lax.cond(implicit, lambda: back(of), lambda: explicit(of))
        rate, slip = of
        pulled = None
        if self.system is not None and self.inverse is not None:
            none = Load(self.maps.still.velocity, self.maps.still.spin)
            load = add_loads(none, self.maps.pull(-self.system.precondition(slip)))
            pull = self.maps.motion(load)
            (back,) = jax.linear_transpose(lambda rate: self._stiff_load(rate), rate)(
                Load(pull.velocity, pull.spin)
            )
            rate = rate + jnp.where(implicit, back, 0.0)
            pulled = pull, load
        if self.touches is not None:
            units = self.maps.chart.units
            back = self.touches.pushed_back(self._parts(rate * units), pulled)
            rate = rate + jnp.where(implicit, self._whole(back) / units, 0.0)
        rate = self._held(rate, implicit, True)
        if self.system is None:
            return Unknowns(-rate, slip)
        (motion,) = jax.linear_transpose(self.maps.rate, self.maps.still)(rate)
        moved = self.maps.motion(Load(motion.velocity, motion.spin))
        slip = -self.system.precondition(slip + self.maps.linear(moved))
        return Unknowns(-rate, slip)

    def _explicit(self, off: Unknowns) -> Unknowns:
        return eqx.tree_at(_long, self, None).answer(off, jnp.asarray(False))

    def _explicit_transposed(self, of: Unknowns) -> Unknowns:
        return eqx.tree_at(_long, self, None).transposed(of, jnp.asarray(False))

    def _along(self, off: Unknowns) -> Unknowns:
        long: Any = self.long
        return Unknowns(*long.answer(self.maps, -off.rate, off.multipliers))

    def _along_transposed(self, of: Unknowns) -> Unknowns:
        return jax.linear_transpose(self._along, of)(of)[0]

    def _held(self, rate: Array, implicit: Array, transposed: bool) -> Array:
        """D^-1, or its transpose, in an implicit stage; otherwise 1."""
        if self.inverse is None:
            return rate
        numbers, units = _numbers(self.maps.chart), self.maps.chart.units
        scale = 1 / units if transposed else units
        which = "fji,fj->fi" if transposed else "fij,fj->fi"
        part = jnp.einsum(which, self.inverse, self._parts(rate / scale))
        held = (rate / scale).at[numbers].set(part, mode="drop") * scale
        return jnp.where(implicit, held, rate)

    def _parts(self, rate: Array) -> Float[Array, "fibres size"]:
        """The numbers of each fibre."""
        return rate.at[_numbers(self.maps.chart)].get(mode="fill", fill_value=0.0)

    def _whole(self, parts: Float[Array, "fibres size"]) -> Array:
        none = jnp.zeros_like(self.maps.x)
        return none.at[_numbers(self.maps.chart)].set(parts, mode="drop")

    def _pulled(self, multipliers: Array) -> Array:
        """T M' J^T lambda."""
        return self.maps.rate(self.maps.motion(self.maps.pull(multipliers), many=False))

    def _stiff_load(self, rate: Array) -> Load:
        """g dF/dx k."""
        return jax.jvp(self.maps.load, (self.maps.x,), (self.ahead * rate,))[1]

    def _stiff(self, rate: Array, push: Array | None) -> Motion:
        """g M' dF/dx k, and motion by pushes of pairs."""
        load = self._stiff_load(rate)
        if self.touches is not None and push is not None:
            force = self.touches.forces(push, len(self.maps.state.position))
            load = add_loads(load, Load(force, self.maps.still.spin))
            return add_motions(self.maps.motion(load, many=False), self.touches.flows(push))
        return self.maps.motion(load, many=False)

    def columns(self) -> Float[Array, "fibres size size"] | None:
        """W' fibre by fibre, in units of the coordinates: derivatives by the first number of each fibre
        at once, by the second of each, and so on.
        """
        maps, chart = self.maps, self.maps.chart
        numbers = _numbers(chart)
        load, push = jax.linearize(maps.load, maps.x)
        if load.force is None and load.torque is None:
            return None

        def column(number: Array) -> Array:
            shift = jnp.zeros_like(maps.x).at[number].set(chart.units[number], mode="drop")
            return self._moved(push(shift)) / chart.units

        # XLA: what is left of a last, smaller batch would be a program of its own.
        size = numbers.shape[1]
        turns = -(-size // _COLUMNS)
        batch = -(-size // turns)
        none = np.full((turns * batch - size, len(numbers)), len(chart.fibres))
        every = np.concatenate([numbers.T, none]).reshape(turns, batch, -1)
        found = lax.map(jax.vmap(column), jnp.asarray(every)).reshape(turns * batch, -1)[:size]
        found = found.at[:, numbers].get(mode="fill", fill_value=0.0)  # (column, fibre, row)
        return jnp.transpose(found, (1, 2, 0))

    def _moved(self, load: Load) -> Array:
        """Rate under a load, with what holds the constraints, by M'."""
        return self._held_rate(self.maps.motion(load))

    def _held_rate(self, motion: Motion) -> Array:
        """Rate at a motion, with what holds the constraints, by M'."""
        if self.system is not None:
            held = -self.system.precondition(self.maps.linear(motion))
            motion = add_motions(motion, self.maps.motion(self.maps.pull(held)))
        return self.maps.rate(motion)

    def with_touches(self, pairs: AbstractTouching) -> "Near":
        """With pairs of beads."""
        maps, chart = self.maps, self.maps.chart

        def push(force: Array, flow: Motion) -> tuple[Array, Array, Array]:
            back = jax.vjp(lambda x: chart.state(x).position, maps.x)[1]
            moved = maps.motion(Load(force, maps.still.spin))
            both = jax.vmap(self._held_rate)(jax.tree.map(lambda *v: jnp.stack(v), moved, flow))
            rate, driven = (self._parts(rate / chart.units) for rate in both)
            return rate, driven, self._parts(back(force)[0] * chart.units)

        def alone(rate: Array) -> Array:
            return jnp.einsum("fij,fsj->fsi", self.inverse, rate)

        operator, still = maps.scene.operator(maps.state), maps.still

        def across(to: Array, by: Array, force: Array) -> Motion:
            every = jnp.minimum(jnp.append(to, by), len(still.velocity) - 1)
            none = jax.tree.map(lambda v: jnp.zeros_like(v, shape=(len(every), v.shape[1])), still)
            load = Load(none.velocity.at[-1].set(force), none.spin)
            if not isinstance(maps.parts, Fibres):  # there it may be in M'
                return jax.tree.map(lambda v: v[:-1], none)
            return jax.tree.map(lambda v: v[:-1], operator.some(every).motion(load))

        size = _numbers(chart).shape[1]
        of, chain = Lone(push, alone, across), maps.scene.chain
        found = touches(pairs, chain, maps.state.position, of, size, self.ahead)
        return dataclasses.replace(self, touches=found)


def _long(near: Near) -> Any:
    return near.long


def _numbers(chart: AbstractCoordinates) -> np.ndarray:
    """The coordinates of each fibre, a row for each, filled up with a number that is too large."""
    fibre = chart.fibres
    rows = [np.flatnonzero(fibre == k) for k in range(len(chart.chain.fibres))]
    size = max(len(row) for row in rows)
    return np.stack([np.pad(r, (0, size - len(r)), constant_values=len(fibre)) for r in rows])


@with_all_digits
@eqx.filter_jit
def near(
    t: Array,
    x: Array,
    ahead: Array,
    chart: AbstractCoordinates,
    scene: Scene,
    guess: Array,
    implicit: bool = True,
) -> Near:
    """What is solved instead of the stages of a step.

    **Arguments**: time; coordinates about which; g; the chart; scene; multipliers there, about; whether
    it is for implicit stages: of an explicit one D is not asked for, and D^-1 is 0 here.
    """
    state = chart.state(x)
    system = iterations(t, state, scene) if scene.constraints else None
    part = parts(state, scene.operator(state), scene.chain)
    between = tuple(k for k, f in enumerate(scene.forces) if f.local(t, state, scene) is not None)
    found = Near(Maps(t, x, state, chart, scene, guess, part, between), ahead, system)
    along = isinstance(part, Windows) and _numbers(chart).shape[1] > lengthwise.MOST_NUMBERS

    def whole() -> Near:
        if along and isinstance(part, Windows):
            return dataclasses.replace(found, long=lengthwise.lengthwise(found.maps, part, ahead))
        local, pairs = _between(found.maps)
        stiff = dataclasses.replace(found, maps=dataclasses.replace(found.maps, local=local))
        columns = stiff.columns()
        if columns is None:
            return stiff
        unit = jnp.eye(columns.shape[1], dtype=columns.dtype)
        held = lax.map(lambda matrix: inverse(unit - ahead * matrix), columns)
        stiff = dataclasses.replace(stiff, inverse=held)
        return stiff if pairs is None else stiff.with_touches(pairs)

    if implicit:
        return whole()
    shapes = eqx.filter_eval_shape(whole)

    def none(shapes: Any) -> Any:
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    maps = dataclasses.replace(found.maps, local=none(shapes.maps.local))
    rest = (none(x) for x in (shapes.inverse, shapes.touches, shapes.long))
    return Near(maps, ahead, system, *rest)


def _between(maps: Maps) -> tuple[Array | None, AbstractTouching | None]:
    """Derivatives of the forces between any beads by each bead's own place, without those of the pairs
    that come beside.

    Of these none is left, not even that of their direction, p/R across it: a push p of places that are
    but guessed may be any, it drives beads off the line, and D would no longer be positive.
    """
    scene, (fibres, size) = maps.scene, _numbers(maps.chart).shape
    forces = [scene.forces[k] for k in maps.between]
    if not forces:
        return None, None
    each = [f.local(maps.t, maps.state, scene) for f in forces]
    local = jnp.sum(jnp.stack([jnp.asarray(x) for x in each]), axis=0)
    # Of the first force that has pairs; those of others are not taken as pairs.
    several = (f.touching(maps.state, scene, room(fibres, size)[0]) for f in forces)
    pairs = next((pairs for pairs in several if pairs is not None), None)
    if pairs is None:
        return local, None
    pairs = placed(pairs, scene.chain, room(fibres, size)[1])[0]
    own = -by_own_place(pairs, maps.state.position)
    return local.at[pairs.first].add(own).at[pairs.second].add(own), pairs
