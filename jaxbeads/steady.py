"""Steady shapes by root finding, where stepping through time would be a waste.

Why not `optimistix.Newton`: the unknowns are coordinates about the last shape, so that the chart moves
with every iteration; the linearisation comes with the residual; how the shape moves as a whole is found
with it, and directions that make no difference have to be left out.
"""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from . import carried
from ._checks import fail, known, positive, said, whole
from ._typing import with_all_digits
from .coordinates import AbstractCoordinates, coordinates
from .faults import REMEDY, not_finite, not_smooth
from .instant import Time
from .linearise import coordinate_rate, linearise
from .scene import Scene, check
from .state import State

NEUTRAL = 1e-8
"""A growth that is so much smaller than the largest derivatives is rounding."""


class SteadyState(eqx.Module):
    """A state whose shape does not change; as a whole it may move along.

    - `state`, and `velocity`, at which all of it moves [length/time], `(dim,)`.
    - `converged`: whether it was found; if not, the other numbers are NaN.
    - `jacobian`: derivatives of the rates of the shape's coordinates by them [1/time].

    >>> import jaxbeads as jb
    >>> hung = [jb.constraint.Inextensible(), *jb.constraint.hinged()]
    >>> scene = jb.Scene(
    ...     jb.Chain(radius=1.0, fibres=2), 1.0, constraints=hung, forces=[jb.force.Weight([0.0, -1.0])]
    ... )
    >>> found = jb.steady_state(scene, jb.straight(scene.chain, [0.2, -1.0]), moving=False)
    >>> print(found.converged, found.growth_rates.real.max() < 1e-9)  # stable
    True True
    """

    state: State
    velocity: Float[Array, " dim"]
    converged: Bool[Array, ""]
    jacobian: Float[Array, "numbers numbers"]

    @property
    def growth_rates(self) -> np.ndarray:
        """Rates at which small disturbances grow [1/time], complex, fastest first: the shape is stable
        if no real part is positive. A turn that makes no difference has rate 0. A host function.
        """
        values = np.linalg.eigvals(np.asarray(self.jacobian)).astype(complex)
        return values[np.argsort(-np.real(values))]

    def __str__(self) -> str:
        """What was found, in a few lines; under a transformation or of many, its structure."""
        if not known(self) or np.ndim(self.converged):
            return eqx.tree_pformat(self)
        if not self.converged:
            return "SteadyState: not converged"
        largest = float(np.max(np.real(self.growth_rates), initial=-np.inf))
        least = NEUTRAL * np.max(np.abs(self.jacobian), initial=0.0)
        how = "unstable" if largest > least else "stable"
        lines = [
            f"SteadyState: converged, {said_shape(self.state)}, {how}",
            f"velocity {said(self.velocity)}",
            f"largest growth rate {largest:.3e} (all: `growth_rates`)",
        ]
        return "\n  ".join(lines)


class Shape(eqx.Module):
    """Coordinates y of shapes about one of them: those of `chart` relative to the first place, places in
    units of the fibre's length.
    """

    chart: AbstractCoordinates
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

    def change(self, state: State, change: State) -> Array:
        """dy from a change of a state that is not far off."""
        return self.drop(self.chart.rate(self.chart.origin, state, change))

    def turns(self) -> Float[Array, "numbers turns"]:
        """dy in turns of the whole about each axis."""
        start = self.chart.start
        place = self.chart.points(start.position)[:1]
        arms = eqx.tree_at(lambda s: s.position, start, start.position - place)

        def turned(matrix: Array) -> Array:
            return self.change(start, carried.turned(arms, matrix))

        dim = start.position.shape[1]
        return jax.vmap(turned, out_axes=1)(jnp.asarray(generators(dim), start.position.dtype))


def said_shape(state: State) -> str:
    """How many beads a state has, in words."""
    beads, dim = state.position.shape
    return f"{beads} beads in {dim}-D"


def shape_about(scene: Scene, state: State, moving: bool) -> Shape:
    """Coordinates of shapes about that of a state; of all places, unless it is `moving` as a whole."""
    chart = coordinates(scene, state)
    return Shape(chart, chart.units, state.position.shape[1] if moving else 0)


def generators(dim: int) -> np.ndarray:
    """Antisymmetric matrices: the directions in which one may turn."""
    pairs = [(i, j) for i in range(dim) for j in range(i)]
    matrices = np.zeros((len(pairs), dim, dim))
    for matrix, (i, j) in zip(matrices, pairs, strict=True):
        matrix[i, j], matrix[j, i] = 1, -1
    return matrices


class Problem(eqx.Module):
    """All that decides on a root: the scene, its time or times, and the start."""

    scene: Scene
    ts: Array
    start: State


Pair = tuple[Array, Array]
"""What is to be zero, and what else is sought, two vectors."""
System = Callable[[Shape, Array, Problem], Pair]
"""Both as functions of the shape's coordinates."""
Linear = Callable[[Shape, Problem], tuple[Pair, Pair]]
"""Both at y = 0, and their Jacobians."""


_Result = TypeVar("_Result", bound=eqx.Module)


class _Turn(eqx.Module):
    """One step of Newton's method, from the shape of a state to the coordinates y about it."""

    count: Array
    size: Array
    state: State
    y: Array
    sought: Array
    jacobians: Pair


class Root(eqx.Module):
    """What `root` finds: the state, what else is sought, whether it was found; the Jacobians of the
    residual and of what else is sought, and the last state at which they were taken.
    """

    state: State
    sought: Array
    found: Array
    jacobians: Pair
    last: State


def root(
    system: System,
    linear: Linear,
    problem: Problem,
    moving: bool,
    tolerance: Array,
    max_steps: int,
    neutral: float = 1e-12,
    exact: bool = True,
) -> Root:
    """The shape at which a residual vanishes, by Newton's method.

    No bond turns by more than half a radian in a step. Singular values below `neutral` times the
    largest count as zero. Coordinates whose residual nothing changes (a held bead, a prescribed
    direction) stay as they are at the start, and so does the first place of a shape that moves as a
    whole. Derivatives by the problem follow from the implicit function theorem; where the Jacobians are
    not `exact`, but differences, the linear system is refined by products with the exact one.
    """
    frozen = lax.stop_gradient(problem)

    def kept(jacobian: Array) -> Array:
        size = jnp.max(jnp.abs(jacobian), initial=0.0)
        return jnp.max(jnp.abs(jacobian), axis=1, initial=0.0) <= neutral * size

    def inverse(jacobian: Array) -> Array:
        size, still = jnp.max(jnp.abs(jacobian), initial=0.0), kept(jacobian)
        square = jnp.where(
            still[:, None], size * jnp.eye(len(jacobian), dtype=jacobian.dtype), jacobian
        )
        # Directions that make no difference are left alone.
        least = 100 * len(jacobian) * float(jnp.finfo(jacobian.dtype).eps)
        return jnp.linalg.pinv(square, rtol=max(neutral, least)) * ~still[None, :]

    def newton(turn: _Turn) -> _Turn:
        state = shape_about(frozen.scene, turn.state, moving).state(turn.y)
        (value, sought), jacobians = linear(shape_about(frozen.scene, state, moving), frozen)
        y = -inverse(jacobians[0]) @ value
        size = jnp.max(jnp.abs(y), initial=0.0)
        y = y * jnp.minimum(1.0, 0.5 / jnp.where(size > 0, size, 1.0))
        return _Turn(turn.count + 1, size, state, y, sought + jacobians[1] @ y, jacobians)

    begun = shape_about(frozen.scene, frozen.start, moving)
    outcomes = jax.eval_shape(linear, begun, frozen)
    (_, sought), jacobians = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), outcomes)
    infinite = jnp.asarray(jnp.inf, frozen.start.position.dtype)
    turn = _Turn(jnp.zeros((), int), infinite, frozen.start, begun.origin, sought, jacobians)
    turn = lax.while_loop(
        lambda turn: (turn.count < max_steps) & (turn.size > tolerance), newton, turn
    )
    turn = lax.stop_gradient(turn)
    # The root depends on the problem: with z = (y, sought), d(residual, what is sought - sought) = 0.
    first, second = turn.jacobians
    solution = inverse(first)
    below = jnp.concatenate([second @ solution, -jnp.eye(len(sought), dtype=second.dtype)], axis=1)
    solution = jnp.concatenate([jnp.pad(solution, ((0, 0), (0, len(sought)))), below])
    shape = shape_about(frozen.scene, turn.state, moving)
    along, first_place = _along(shape, begun, problem.start, ~kept(first))
    live = eqx.tree_at(
        lambda s: (s.chart.chain, s.chart.start.position),
        shape,
        (problem.scene.chain, shape.chart.start.position + first_place),
    )
    size = len(turn.y)

    def both(z: Array) -> Array:
        value, sought = system(live, z[:size] + along, problem)
        return jnp.concatenate([value, sought - z[size:]])

    def solve(product: Callable[[Array], Array], b: Array) -> Array:
        x = solution @ b
        return x if exact else x + solution @ (b - product(x))

    guess = jnp.concatenate([turn.y, turn.sought])
    z = lax.custom_root(both, guess, lambda _, z: z, solve)
    state = live.state(z[:size] + along)
    return Root(state, z[size:], turn.size <= tolerance, turn.jacobians, turn.state)


def _along(shape: Shape, begun: Shape, start: State, free: Array) -> tuple[Array, Array]:
    """Zeros with the derivatives by the start of what it decides: coordinates y about the shape found
    (of which the residual settles all but those held and those that make no difference), and the first
    place of a shape that moves as a whole.

    **Arguments**: coordinates about the shape found and about the start; which coordinates are free.
    """
    change = jax.tree.map(lambda x: x - lax.stop_gradient(x), start)
    start = lax.stop_gradient(start)
    y = shape.change(start, change)
    # A turn of the start turns the shape found by as much, also where they are not the same shape.
    turns, turns_begun = (s.turns() * free[:, None] for s in (shape, begun))
    angles = jnp.linalg.pinv(turns_begun, rtol=1e-6) @ begun.change(start, change)
    y = y + turns @ (angles - jnp.linalg.pinv(turns, rtol=1e-6) @ y)
    place = shape.chart.points(change.position)[:1]
    return y, place if shape.fixed else 0 * place


def or_nothing(found: Array, result: _Result) -> _Result:
    """The result, or NaN."""
    return jax.tree.map(lambda x: x if x.dtype == bool else jnp.where(found, x, jnp.nan), result)


def refuse_freedom(scene: Scene, name: str, free: bool, symmetry: str) -> None:
    """Refuse a freedom of the whole that makes a difference in the scene's domain."""
    if free and symmetry not in scene.domain.symmetries:
        how = f"a {symmetry} of the whole makes a difference there"
        fail(name, f"be False in the domain {type(scene.domain).__name__}", f"it is True: {how}")


def refuse(t: float, state: State, scene: Scene, what: str, derivatives: bool = True) -> None:
    """Name the term that keeps a search from going on at a state, if there is one."""
    fault = not_finite(t, state, scene)
    if fault is None and derivatives:
        fault = not_smooth(t, state, scene)
    if fault is not None:
        remedy = f" {REMEDY}" if fault.derivative else ""
        raise RuntimeError(
            f"No {what} state was found, because a term is not finite on the way (t = {t:.6g}). Term: "
            f"{fault.term}, {fault.how}.{remedy}"
        )


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
    by the implicit function theorem: by scene and time; by the start in what it decides, as the place
    and the direction of a clamp, or the place of a shape that moves. Where turns of the shape make no
    difference, a turn of the start turns it; by anything else the derivative is that of the shape, not
    turned. Newton's method finds unstable shapes as well (look at `growth_rates`) and needs a start not
    far off, as the end of a `rollout` with a large tolerance.

    **Arguments**

    - `scene`, `state`: the model, and a guess; `t`: time at which the scene is taken.
    - `moving`: the shape may move as a whole, which makes no difference (no walls, no flow that varies
      in space); otherwise every bead must come to rest.
    - `tolerance`: of the last step, in radians and lengths of the fibre; `max_steps` that are tried.

    **Returns** a `SteadyState`. **Raises** `ValueError` for input that does not fit, `RuntimeError` if
    none is found (under `jit`, which cannot raise, `converged` is false and the numbers are NaN).

    >>> import jaxbeads as jb
    >>> hung = [jb.constraint.Inextensible(), *jb.constraint.hinged()]
    >>> scene = jb.Scene(
    ...     jb.Chain(radius=1.0, fibres=2), 1.0, constraints=hung, forces=[jb.force.Weight([0.0, -1.0])]
    ... )
    >>> found = jb.steady_state(scene, jb.straight(scene.chain, [0.2, -1.0]), moving=False)
    >>> print(jb.geometry.tangents(found.state.position).round(6) + 0.0)  # it hangs straight down
    [[ 0. -1.]]
    """
    check(scene, state)
    refuse_freedom(scene, "moving", moving, "translation")
    state = scene.begin(state)
    positive("tolerance", tolerance)
    whole("max_steps", max_steps, 1)
    problem = Problem(scene, jnp.asarray(t, state.position.dtype), state)
    found, last = _solve(problem, moving, jnp.asarray(tolerance), max_steps)
    if known((found, last, problem)) and not bool(found.converged):
        refuse(float(problem.ts), last, scene, "steady")
        raise RuntimeError(
            f"No steady state was found in {max_steps} steps from this start: give one that is nearer, "
            "as the end of a `rollout`, or loosen `tolerance`."
        )
    return found


@with_all_digits
@eqx.filter_jit
def _solve(
    problem: Problem, moving: bool, tolerance: Array, max_steps: int
) -> tuple[SteadyState, State]:
    dim = problem.start.position.shape[1]

    def system(shape: Shape, y: Array, problem: Problem) -> Pair:
        rate = coordinate_rate(problem.ts, shape.lift(y), shape.chart, problem.scene)
        return shape.drop(rate), rate[:dim]

    def linear(shape: Shape, problem: Problem) -> tuple[Pair, Pair]:
        about = linearise(problem.ts, shape.chart, problem.scene)
        columns = (about.jacobian() * shape.scale[None, :])[:, shape.fixed :]
        dropped = jax.vmap(shape.drop, 1, 1)(columns)
        return (shape.drop(about.rate), about.rate[:dim]), (dropped, columns[:dim])

    at = root(system, linear, problem, moving, tolerance, max_steps)
    found = SteadyState(at.state, at.sought, at.found, at.jacobians[0])
    return or_nothing(at.found, found), at.last
