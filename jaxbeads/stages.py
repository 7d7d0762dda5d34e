"""Implicit stages of scenes of any size: rate and multipliers found together by iterations.

A stage asks for the rate k of the coordinates and the multipliers lambda with

    k = f(t, b + g k, lambda),   J V(t, b + g k, lambda) + B = 0,

where V = M (F + J^T lambda) + V_inf + C:E and f is its rate in the coordinates. One product with M at
the point reached so far shows how far both equations are off. The answer to that (`Near`) is exact for
fibres that do not feel one another, with M' of `windows` in place of M, and takes the derivatives of
the loads, which are all that is stiff: those of M, of J and of the flow made no difference to the number
of iterations. `iterations.accelerated` bends the way, and how long steps may be follows from how many
iterations they take (`solver/esdirk.py`). Nothing is linearised as a whole, and nothing is iterated
within an iteration. Derivatives are those of the two equations at the solution.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from . import lengthwise
from ._typing import with_all_digits
from .coordinates import AbstractCoordinates
from .factors import inverse
from .instant import ambient_motion, applied_load, moving
from .iterations import accelerated
from .lengthwise import Lengthwise, Maps
from .saddle import Iterations, constraint_map, iterations
from .scene import Scene
from .state import Load, Motion, add_loads, add_motions, zero_motion
from .windows import Windows, parts

_COLUMNS = 64
"""Derivatives that are found side by side."""
_SMALL = 1e-2
"""Weight of the multipliers, over the largest of them, beside displacements over their units."""


class Unknowns(NamedTuple):
    """Of one stage."""

    rate: Float[Array, " numbers"]
    """k [coordinates/time]."""
    multipliers: Float[Array, " rows"]


class Stage(NamedTuple):
    """Where a stage is taken."""

    t: Float[Array, ""]
    base: Float[Array, " numbers"]
    """b."""
    ahead: Float[Array, ""]
    """g [time]; 0 in an explicit stage, which asks for the multipliers alone."""


class Found(NamedTuple):
    """What iterations found."""

    unknowns: Unknowns
    fine: Bool[Array, ""]
    """Whether they converged."""
    products: Int[Array, ""]


def _load(t: Array, x: Array, multipliers: Array, chart: AbstractCoordinates, scene: Scene) -> Load:
    """F + J^T lambda."""
    state = chart.state(x)
    load = applied_load(t, state, scene)
    if not scene.constraints:
        return load
    return add_loads(load, constraint_map(t, state, scene).pull(multipliers))


def residual(
    stage: Stage,
    at: Unknowns,
    chart: AbstractCoordinates,
    scene: Scene,
    differentiable: bool = True,
) -> Unknowns:
    """k - f and J V + B; one product with M, to the error that it allows unless it is differentiable."""
    t, x = stage.t, stage.base + stage.ahead * at.rate
    state = chart.state(x)
    load, ambient = _load(t, x, at.multipliers, chart, scene), ambient_motion(t, state, scene)
    if load.force is None and load.torque is None:
        motion = zero_motion(state, scene.rotational)
    else:
        operator = scene.operator(state)
        motion = operator.motion(load) if differentiable else operator.product(load, exact=False)
    if ambient is not None:
        motion = add_motions(motion, ambient)
    rate = chart.rate(x, state, moving(state, motion, scene.chain, scene.own_rate(t, state)))
    slip = at.multipliers
    if scene.constraints:
        slip = constraint_map(t, state, scene).slip(motion)
    return Unknowns(at.rate - rate, slip)


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
    long: Lengthwise | None = None

    def answer(self, off: Unknowns, implicit: Array) -> Unknowns:
        """Change of the unknowns that takes away what the equations are off."""
        if self.long is not None:
            return lax.cond(implicit, lambda: self._along(off), lambda: self._explicit(off))
        if self.system is None:
            return Unknowns(-self._held(off.rate, implicit, False), off.multipliers)
        pushed = -self.system.precondition(off.multipliers)
        rate = -self._held(off.rate - self._pulled(pushed), implicit, False)
        if self.inverse is not None:
            slip = self.maps.linear(self._stiff(jnp.where(implicit, rate, 0.0)))
            pushed = pushed - self.system.precondition(slip)
        return Unknowns(rate, pushed)

    def transposed(self, of: Unknowns, implicit: Array) -> Unknowns:
        """The transpose of `answer`."""
        if self.long is not None:
            back, explicit = self._along_transposed, self._explicit_transposed
            return lax.cond(implicit, lambda: back(of), lambda: explicit(of))
        rate, slip = of
        if self.system is None:
            return Unknowns(-self._held(rate, implicit, True), slip)
        if self.inverse is not None:
            push = self._pull_motion(self.system.precondition(slip))
            (back,) = jax.linear_transpose(self._stiff, rate)(push)
            rate = rate - jnp.where(implicit, back, 0.0)
        rate = self._held(rate, implicit, True)
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
        chart = self.maps.chart
        numbers, units = _numbers(chart), chart.units
        scale = 1 / units if transposed else units
        part = (rate / scale).at[numbers].get(mode="fill", fill_value=0.0)
        which = "fji,fj->fi" if transposed else "fij,fj->fi"
        part = jnp.einsum(which, self.inverse, part)
        held = (rate / scale).at[numbers].set(part, mode="drop") * scale
        return jnp.where(implicit, held, rate)

    def _pull_motion(self, multipliers: Array) -> Motion:
        """J^T lambda, as a motion."""
        load = self.maps.pull(multipliers)
        return Motion(jnp.asarray(load.force), load.torque)

    def _pulled(self, multipliers: Array) -> Array:
        """T M' J^T lambda."""
        return self.maps.rate(self.maps.motion(self.maps.pull(multipliers)))

    def _stiff(self, rate: Array) -> Motion:
        """g M' dF/dx k."""
        push = jax.jvp(self.maps.load, (self.maps.x,), (self.ahead * rate,))[1]
        return self.maps.motion(push)

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
            motion = maps.motion(push(shift))
            if self.system is not None:
                held = -self.system.precondition(maps.linear(motion))
                motion = add_motions(motion, maps.motion(maps.pull(held)))
            return maps.rate(motion) / chart.units

        found = lax.map(column, jnp.asarray(numbers.T), batch_size=_COLUMNS)
        found = found.at[:, numbers].get(mode="fill", fill_value=0.0)  # (column, fibre, row)
        return jnp.transpose(found, (1, 2, 0))


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
        each = [jnp.asarray(scene.forces[k].local(t, state, scene)) for k in between]
        local = jnp.sum(jnp.stack(each), axis=0) if each else None
        stiff = dataclasses.replace(found, maps=dataclasses.replace(found.maps, local=local))
        columns = stiff.columns()
        if columns is None:
            return stiff
        unit = jnp.eye(columns.shape[1], dtype=columns.dtype)
        held = lax.map(lambda matrix: inverse(unit - ahead * matrix), columns)
        return dataclasses.replace(stiff, inverse=held)

    if implicit:
        return whole()
    shapes = eqx.filter_eval_shape(whole)
    none = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), (shapes.maps.local, shapes.inverse, shapes.long)
    )
    maps = dataclasses.replace(found.maps, local=none[0])
    return dataclasses.replace(found, maps=maps, inverse=none[1], long=none[2])


class _Scale(NamedTuple):
    """Of the unknowns: by which they are of order one together."""

    rate: Array
    multipliers: Array

    def joined(self, at: Unknowns) -> Array:
        """In one vector."""
        return jnp.concatenate([at.rate * self.rate, at.multipliers * self.multipliers])

    def parted(self, numbers: Array) -> Unknowns:
        """Out of one vector."""
        rate, multipliers = jnp.split(numbers, [len(self.rate)])
        return Unknowns(rate / self.rate, multipliers / self.multipliers)


def _scale(h: Array, chart: AbstractCoordinates, multipliers: Array) -> _Scale:
    largest = jnp.max(jnp.abs(multipliers), initial=0.0)
    return _Scale(h / chart.units, _SMALL / jnp.where(largest > 0, largest, 1.0))


def solved_stage(
    stage: Stage,
    h: Array,
    chart: AbstractCoordinates,
    scene: Scene,
    near: Near,
    guess: Unknowns,
    enough: Array,
) -> Found:
    """Rate and multipliers of a stage.

    **Arguments**: stage; h, the length of the step; the chart; scene; what is solved instead; a guess;
    change of the step, over the coordinates' units, below which iterations end.
    """
    near, guess, enough = lax.stop_gradient((near, guess, enough))
    return _stage(stage, h, chart, scene, near, guess, enough)


@eqx.filter_custom_jvp
def _stage(
    stage: Stage,
    h: Array,
    chart: AbstractCoordinates,
    scene: Scene,
    near: Near,
    guess: Unknowns,
    enough: Array,
) -> Found:
    scale, implicit = _scale(h, chart, guess.multipliers), stage.ahead != 0

    def step(numbers: Array) -> tuple[Array, Array]:
        off = residual(stage, scale.parted(numbers), chart, scene, differentiable=False)
        change = near.answer(off, implicit)
        size = jnp.max(jnp.abs(change.rate * scale.rate), initial=0.0)
        return scale.joined(change), size

    found = accelerated(step, scale.joined(guess), enough)
    return Found(scale.parted(found.solution), found.converged, found.iterations)


@_stage.def_jvp
@with_all_digits
def _stage_jvp(primals: Any, tangents: Any) -> tuple[Found, Found]:
    """With R the two equations, dz = -(dR/dz)^-1 dR."""
    stage, h, chart, scene, near, guess, _ = primals
    found = _stage(*primals)
    at = found.unknowns
    scale, implicit = _scale(h, chart, guess.multipliers), stage.ahead != 0

    def off(stage: Stage, chart: AbstractCoordinates, scene: Scene) -> Unknowns:
        return residual(stage, at, chart, scene)

    given = (tangents[0], tangents[2], tangents[3])
    moved = eqx.filter_jvp(off, (stage, chart, scene), given)[1]
    still = jax.tree.map(jnp.zeros_like, at)
    moved = eqx.combine(moved, still)

    # One vector: of two, the transpose asks that both depend on what moves.
    whole, apart = ravel_pytree(moved)

    def matvec(z: Array) -> Array:
        change = jax.jvp(lambda at: residual(stage, at, chart, scene), (at,), (apart(z),))[1]
        return ravel_pytree(change)[0]

    def solve(product: Any, rhs: Array, answer: Any, scale: _Scale) -> Array:
        def step(numbers: Array) -> tuple[Array, Array]:
            left = apart(product(ravel_pytree(scale.parted(numbers))[0]) - rhs)
            change = scale.joined(answer(left, implicit))
            return change, jnp.max(jnp.abs(change), initial=0.0)

        none = jnp.zeros_like(rhs)
        first = step(none)[1]
        least = 1e-10 if jnp.finfo(none.dtype).eps < 1e-9 else 1e-4
        found = accelerated(step, none, least * first)
        numbers = jnp.where(found.converged, found.solution, jnp.nan)
        return ravel_pytree(scale.parted(numbers))[0]

    backward = _Scale(1 / scale.rate, 1 / scale.multipliers)
    answer = lax.custom_linear_solve(
        matvec,
        -whole,
        lambda product, b: solve(product, b, near.answer, scale),
        lambda product, b: solve(product, b, near.transposed, backward),
    )
    no: Any = None
    return found, Found(apart(answer), no, no)
