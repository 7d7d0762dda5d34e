"""Steady shapes by root finding, where stepping through time would be a waste."""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ._checks import known, positive, whole
from .coordinates import Coordinates, coordinates
from .dynamics import Time
from .linearise import coordinate_rate, linearise
from .scene import Scene, check
from .state import State


class SteadyState(eqx.Module):
    """A state whose shape does not change; as a whole it may move along.

    - `state`, and `velocity`, at which all of it moves [length/time], `(dim,)`.
    - `converged`: whether it was found; if not, the other numbers are NaN.
    - `jacobian`: derivatives of the rates of the shape's coordinates by them [1/time].
    """

    state: State
    velocity: Float[Array, " dim"]
    converged: Bool[Array, ""]
    jacobian: Float[Array, "numbers numbers"]

    @property
    def growth_rates(self) -> np.ndarray:
        """Rates at which small disturbances grow [1/time], complex, fastest first: the shape is stable
        if no real part is positive. A turn that makes no difference has rate 0. A host function."""
        values = np.linalg.eigvals(np.asarray(self.jacobian)).astype(complex)
        return values[np.argsort(-np.real(values))]


class Shape(eqx.Module):
    """Coordinates y of shapes about one of them: those of `chart` relative to the first place, places in
    units of the fibre's length."""

    chart: Coordinates
    scale: Array
    fixed: int = eqx.field(static=True)

    @property
    def origin(self) -> Float[Array, " numbers"]:
        """y = 0."""
        return self.drop(self.chart.origin)

    def state(self, y: Array) -> State:
        """The state at y."""
        return self.chart.state(self.lift(y))

    def lift(self, y: Array) -> Array:
        """The chart's coordinates x of a shape."""
        return self.scale * jnp.pad(y, (self.fixed, 0))

    def drop(self, change: Array) -> Array:
        """dy from dx."""
        if self.fixed:
            places = self.chart.sizes[0]
            common = jnp.tile(change[: self.fixed], places // self.fixed)
            change = change - jnp.pad(common, (0, len(change) - places))
        return (change / self.scale)[self.fixed :]


def shape_about(scene: Scene, state: State, moving: bool) -> Shape:
    """Coordinates of shapes about that of a state; of all places, unless it is `moving` as a whole."""
    chart = coordinates(scene, state)
    places, *others = chart.sizes
    scale = jnp.ones(places + sum(others), state.position.dtype)
    scale = scale.at[:places].set(jnp.max(scene.chain.length))
    return Shape(chart, scale, state.position.shape[1] if moving else 0)


Outcome = tuple[Array, Array]
"""What is to be zero, and what else is sought, two vectors."""
System = Callable[[Shape, Array, Scene], Outcome]
"""Both as functions of the shape's coordinates."""
Linear = Callable[[Shape, Scene], tuple[Outcome, Outcome]]
"""Both at y = 0, and their Jacobians."""


_Result = TypeVar("_Result", bound=eqx.Module)


class _Turn(eqx.Module):
    """One step of Newton's method, from the shape of a state to the coordinates y about it."""

    count: Array
    size: Array
    state: State
    y: Array
    sought: Array
    jacobians: Outcome


def root(
    system: System,
    linear: Linear,
    scene: Scene,
    start: State,
    moving: bool,
    tolerance: Array,
    max_steps: int,
    neutral: float = 1e-12,
) -> tuple[State, Array, Array, Array]:
    """The shape at which a residual vanishes, by Newton's method.

    No bond turns by more than half a radian in a step. Singular values below `neutral` times the
    largest count as zero. Coordinates whose residual nothing changes (a held bead, a prescribed
    direction) stay as they are at the start. Derivatives by the scene follow from the implicit function
    theorem. **Returns** the state, what else is sought, whether it was found, and the Jacobian of the
    residual.
    """
    frozen = lax.stop_gradient(scene)

    def inverse(jacobian: Array) -> Array:
        size = jnp.max(jnp.abs(jacobian), initial=0.0)
        kept = jnp.max(jnp.abs(jacobian), axis=1, initial=0.0) <= neutral * size
        square = jnp.where(
            kept[:, None], size * jnp.eye(len(jacobian), dtype=jacobian.dtype), jacobian
        )
        # Directions that make no difference are left alone.
        least = 100 * len(jacobian) * float(jnp.finfo(jacobian.dtype).eps)
        return jnp.linalg.pinv(square, rtol=max(neutral, least)) * ~kept[None, :]

    def newton(turn: _Turn) -> _Turn:
        state = shape_about(frozen, turn.state, moving).state(turn.y)
        (value, sought), jacobians = linear(shape_about(frozen, state, moving), frozen)
        y = -inverse(jacobians[0]) @ value
        size = jnp.max(jnp.abs(y), initial=0.0)
        y = y * jnp.minimum(1.0, 0.5 / jnp.where(size > 0, size, 1.0))
        return _Turn(turn.count + 1, size, state, y, sought + jacobians[1] @ y, jacobians)

    start = lax.stop_gradient(start)
    shape = shape_about(frozen, start, moving)
    outcomes = jax.eval_shape(linear, shape, frozen)
    (_, sought), jacobians = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), outcomes)
    infinite = jnp.asarray(jnp.inf, start.position.dtype)
    turn = _Turn(jnp.zeros((), int), infinite, start, shape.origin, sought, jacobians)
    turn = lax.while_loop(
        lambda turn: (turn.count < max_steps) & (turn.size > tolerance), newton, turn
    )
    # The root depends on the scene: with z = (y, sought), d(residual, what is sought - sought) = 0.
    first, second = turn.jacobians
    solution = inverse(first)
    below = jnp.concatenate([second @ solution, -jnp.eye(len(sought), dtype=second.dtype)], axis=1)
    solution = jnp.concatenate([jnp.pad(solution, ((0, 0), (0, len(sought)))), below])
    shape = shape_about(frozen, turn.state, moving)
    live = eqx.tree_at(lambda s: s.chart.chain, shape, scene.chain)
    size = len(turn.y)

    def both(z: Array) -> Array:
        value, sought = system(live, z[:size], scene)
        return jnp.concatenate([value, sought - z[size:]])

    guess = jnp.concatenate([turn.y, turn.sought])
    z = lax.custom_root(both, guess, lambda _, z: z, lambda _, b: solution @ b)
    return live.state(z[:size]), z[size:], turn.size <= tolerance, first


def or_nothing(found: Array, result: _Result) -> _Result:
    """The result, or NaN."""
    return jax.tree.map(lambda x: x if x.dtype == bool else jnp.where(found, x, jnp.nan), result)


def steady_state(
    scene: Scene,
    state: State,
    *,
    t: Time = 0.0,
    moving: bool = True,
    tolerance: float = 1e-8,
    max_steps: int = 50,
) -> SteadyState:
    """The steady shape near a state, by Newton's method with the exact Jacobian.

    It is a root of the rates of the bond directions and of the fibres' relative places: a settling
    fibre, a filament clamped in a flow, two fibres that fall side by side. Differentiable in both modes
    by the implicit function theorem. Newton's method finds unstable shapes as well (look at
    `growth_rates`) and needs a start not far off, as the end of a `rollout` with a large tolerance.

    **Arguments**

    - `scene`, `state`: the model, and a guess; `t`: time at which the scene is taken.
    - `moving`: the shape may move as a whole, which makes no difference (no walls, no flow that varies
      in space); otherwise every bead must come to rest.
    - `tolerance`: of the last step, in radians and lengths of the fibre; `max_steps` that are tried.

    **Returns** a `SteadyState`. **Raises** `ValueError` for input that does not fit, `RuntimeError` if
    none is found (under `jit`, which cannot raise, `converged` is false and the numbers are NaN).
    """
    check(scene, state)
    state = scene.begin(state)
    positive("tolerance", tolerance)
    whole("max_steps", max_steps, 1)
    found = _solve(scene, state, jnp.asarray(t), moving, jnp.asarray(tolerance), max_steps)
    if known(found) and not bool(found.converged):
        raise RuntimeError(
            f"No steady state was found in {max_steps} steps from this start: give one that is nearer, "
            "as the end of a `rollout`, or loosen `tolerance`."
        )
    return found


@eqx.filter_jit
def _solve(
    scene: Scene, start: State, t: Array, moving: bool, tolerance: Array, max_steps: int
) -> SteadyState:
    dim = start.position.shape[1]

    def system(shape: Shape, y: Array, scene: Scene) -> Outcome:
        rate = coordinate_rate(t, shape.lift(y), shape.chart, scene)
        return shape.drop(rate), rate[:dim]

    def linear(shape: Shape, scene: Scene) -> tuple[Outcome, Outcome]:
        about = linearise(t, shape.chart, scene)
        columns = (about.jacobian * shape.scale[None, :])[:, shape.fixed :]
        dropped = jax.vmap(shape.drop, 1, 1)(columns)
        return (shape.drop(about.rate), about.rate[:dim]), (dropped, columns[:dim])

    state, velocity, found, jacobian = root(
        system, linear, scene, start, moving, tolerance, max_steps
    )
    return or_nothing(found, SteadyState(state, velocity, found, jacobian))
