"""Implicit stages of scenes of any size: rate and multipliers found together by iterations.

A stage asks for the rate k of the coordinates and the multipliers lambda with

    k = f(t, b + g k, lambda),   J V(t, b + g k, lambda) + B = 0,

where V = M (F + J^T lambda) + V_inf + C:E and f is its rate in the coordinates. One product with M at
the point reached so far shows how far both equations are off. The answer to that (`Near`) is exact for
fibres that do not feel one another, with M' of `windows` in place of M, and takes the derivatives of
the loads, which are all that is stiff: those of M, of J and of the flow made no difference to the number
of iterations. `iterations.accelerated` bends the way, and how long steps may be follows from how many
iterations they take (`solver/esdirk.py`). Nothing is linearised as a whole, and nothing is iterated
within an iteration. Where a mobility has coarse products, they do for most iterations: what they leave
out of the motion is smooth, carried from stage to stage and learnt anew by a product of both kinds, with
which iterations end. Derivatives are those of the two equations at the solution.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from ._typing import with_all_digits
from .carried import largest
from .coordinates import AbstractCoordinates
from .geometry import peak
from .instant import ambient_motion, applied_load, moving
from .iterations import accelerated, learning
from .mobility import Operator
from .near import Near, Unknowns
from .saddle import constraint_map
from .scene import Scene
from .state import Load, Motion, add_loads, add_motions, zero_motion

_SMALL = 1e-2
"""Weight of the multipliers, over the largest of them, beside displacements over their units."""


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
    left_out: Motion | None = None
    """What the mobility's coarse product leaves out of the motion; `None` if it has none."""


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
) -> Unknowns:
    """k - f and J V + B; one product with M."""

    def product(operator: Operator, load: Load) -> tuple[Motion, None]:
        return operator.motion(load), None

    return _residual(stage, at, chart, scene, product)[0]


def _residual(
    stage: Stage,
    at: Unknowns,
    chart: AbstractCoordinates,
    scene: Scene,
    product: Callable[[Operator, Load], tuple[Motion, Any]],
    beside: Load | None = None,
) -> tuple[Unknowns, Any]:
    """The same with any product, and what it gives beside the motion (`None` where there are no loads).
    There may be loads `beside` those of the scene.
    """
    t, x = stage.t, stage.base + stage.ahead * at.rate
    state = chart.state(x)
    load, ambient = _load(t, x, at.multipliers, chart, scene), ambient_motion(t, state, scene)
    if beside is not None:
        load = add_loads(load, beside)
    motion, more = zero_motion(state, scene.rotational), None
    if load.force is not None or load.torque is not None:
        motion, more = product(scene.operator(state), load)
    if ambient is not None:
        motion = add_motions(motion, ambient)
    rate = chart.rate(x, state, moving(state, motion, scene.chain, scene.own_rate(t, state)))
    slip = at.multipliers
    if scene.constraints:
        slip = constraint_map(t, state, scene).slip(motion)
    return Unknowns(at.rate - rate, slip), more


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
    most = peak(multipliers)
    return _Scale(h / chart.units, _SMALL / jnp.where(most > 0, most, 1.0))


def solved_stage(
    stage: Stage,
    h: Array,
    chart: AbstractCoordinates,
    scene: Scene,
    near: Near,
    guess: Unknowns,
    enough: Array,
    left_out: Motion | None = None,
) -> Found:
    """Rate and multipliers of a stage.

    **Arguments**: stage; h, the length of the step; the chart; scene; what is solved instead; a guess;
    change of the step, over the longest fibre's length, below which iterations end: of positions, of
    which bonds may turn by far more; what coarse products are thought to leave out (`None`: there are
    none).
    """
    near, guess, enough, left_out = lax.stop_gradient((near, guess, enough, left_out))
    return _stage(stage, h, chart, scene, near, guess, enough, left_out)


@eqx.filter_custom_jvp
def _stage(
    stage: Stage,
    h: Array,
    chart: AbstractCoordinates,
    scene: Scene,
    near: Near,
    guess: Unknowns,
    enough: Array,
    left_out: Motion | None,
) -> Found:
    scale, implicit = _scale(h, chart, guess.multipliers), stage.ahead != 0
    first, touches = scale.joined(guess), near.touches
    count, most, arm = len(first), jnp.ones((), first.dtype), jnp.max(scene.chain.length)
    if touches is not None:  # pushes of pairs are unknowns, too
        position = chart.state(stage.base + stage.ahead * guess.rate).position
        push = touches.first(position, implicit)
        most = peak(push)
        most = jnp.where(most > 0, most, 1.0) / _SMALL
        first = jnp.concatenate([first, push / most])

    def step(numbers: Array, product: Any) -> tuple[Array, Array, Any]:
        at, push = scale.parted(numbers[:count]), numbers[count:] * most
        x, gap, beside = stage.base + stage.ahead * at.rate, push, None
        if touches is not None:
            state = chart.state(x)
            gap = touches.pairs.gap(state.position)
            beside = Load(touches.beside(state.position, push))
        off, more = _residual(stage, at, chart, scene, product, beside)
        if touches is None:
            change, pushed = near.answer(off, implicit), push
        else:
            change, pushed = near.met(off, implicit, gap, push)
        moved = jax.jvp(chart.state, (x,), (h * change.rate,))[1]
        size = largest(moved, arm) / arm
        return jnp.concatenate([scale.joined(change), pushed / most]), size, more

    if left_out is None:
        found = accelerated(lambda numbers: step(numbers, _whole)[:2], first, enough)
    else:

        def coarse(numbers: Array, left_out: Motion) -> tuple[Array, Array]:
            def product(operator: Operator, load: Load) -> tuple[Motion, None]:
                return add_motions(_coarse(operator, load), left_out), None

            return step(numbers, product)[:2]

        def learn(numbers: Array) -> tuple[Array, Array, Motion]:
            change, size, more = step(numbers, _both)
            return change, size, left_out if more is None else more

        found = learning(coarse, learn, left_out, first, enough)
    unknowns = scale.parted(found.solution[:count])
    return Found(unknowns, found.converged, found.iterations, found.known)


def _whole(operator: Operator, load: Load) -> tuple[Motion, None]:
    return operator.product(load, exact=False), None


def _coarse(operator: Operator, load: Load) -> Motion:
    motion: Any = operator.coarse(load)
    return motion


def _both(operator: Operator, load: Load) -> tuple[Motion, Motion]:
    """The motion, and what of it the coarse product leaves out."""
    motion = operator.product(load, exact=False)
    return motion, jax.tree.map(jnp.subtract, motion, _coarse(operator, load))


@_stage.def_jvp
@with_all_digits
def _stage_jvp(primals: Any, tangents: Any) -> tuple[Found, Found]:
    """With R the two equations, dz = -(dR/dz)^-1 dR."""
    stage, h, chart, scene, near, guess, *_ = primals
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
            return change, peak(change)

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
    none = jax.tree.map(lambda _: None, found.left_out)
    return found, Found(apart(answer), no, no, none)
