"""Steady shapes by root finding, where stepping through time would be a waste."""

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


class _Shape(eqx.Module):
    """Coordinates relative to the first place, places in units of the fibre's length."""

    chart: Coordinates
    scale: Array
    fixed: int = eqx.field(static=True)

    def lift(self, y: Array) -> Array:
        """The coordinates x of a shape."""
        return self.scale * jnp.pad(y, (self.fixed, 0))

    def drop(self, rate: Array) -> Array:
        """dy/dt from dx/dt."""
        if self.fixed:
            places = self.chart.sizes[0]
            common = jnp.tile(rate[: self.fixed], places // self.fixed)
            rate = rate - jnp.pad(common, (0, len(rate) - places))
        return (rate / self.scale)[self.fixed :]


def _shape(scene: Scene, state: State, moving: bool) -> _Shape:
    chart = coordinates(scene, state)
    places, *others = chart.sizes
    scale = jnp.ones(places + sum(others), state.position.dtype)
    scale = scale.at[:places].set(jnp.max(scene.chain.length))
    return _Shape(chart, scale, state.position.shape[1] if moving else 0)


def _linear(t: Time, shape: _Shape, scene: Scene) -> tuple[Array, Array]:
    """dy/dt and its Jacobian at y = 0."""
    about = linearise(t, shape.chart, scene)
    columns = jax.vmap(shape.drop, 1, 1)(about.jacobian * shape.scale[None, :])
    return shape.drop(about.rate), columns[:, shape.fixed :]


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
    frozen = lax.stop_gradient(scene)

    def inverse(jacobian: Array) -> Array:
        # Directions that make no difference are left alone.
        return jnp.linalg.pinv(jacobian, rtol=10 * len(jacobian) * jnp.finfo(jacobian.dtype).eps)

    def unfinished(loop: tuple[Array, Array, State]) -> Array:
        count, size, _ = loop
        return (count < max_steps) & (size > tolerance)

    def newton(loop: tuple[Array, Array, State]) -> tuple[Array, Array, State]:
        count, _, state = loop
        shape = _shape(frozen, state, moving)
        rate, jacobian = _linear(t, shape, frozen)
        step = -inverse(jacobian) @ rate
        size = jnp.max(jnp.abs(step), initial=0.0)
        # No bond turns by more than half a radian at once.
        step = step * jnp.minimum(1.0, 0.5 / jnp.where(size > 0, size, 1.0))
        return count + 1, size, shape.chart.state(shape.lift(step))

    first = jnp.zeros((), int), jnp.asarray(jnp.inf, start.position.dtype), lax.stop_gradient(start)
    _, size, state = lax.while_loop(unfinished, newton, first)
    # The root depends on the scene: d(rate) = 0 about it.
    shape = _shape(frozen, state, moving)
    _, jacobian = _linear(t, shape, frozen)
    solution = inverse(jacobian)
    live = eqx.tree_at(lambda s: s.chart.chain, shape, scene.chain)

    def rate(y: Array) -> Array:
        return live.drop(coordinate_rate(t, live.lift(y), live.chart, scene))

    y = lax.custom_root(rate, jnp.zeros(len(jacobian)), lambda _, y: y, lambda _, b: solution @ b)
    state = live.chart.state(live.lift(y))
    x_rate = coordinate_rate(t, live.lift(y), live.chart, scene)
    velocity = x_rate[: state.position.shape[1]]
    result = SteadyState(state, velocity, size <= tolerance, jacobian)
    return jax.tree.map(
        lambda x: x if x.dtype == bool else jnp.where(result.converged, x, jnp.nan), result
    )
