"""Periodic motions by root finding: the limit cycle of a swimmer or of a beating filament."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from . import carried
from ._checks import fail, known, positive, said, whole
from ._typing import with_all_digits
from .geometry import best_rotation
from .instant import Time, rate
from .rollout import Solver, rollout, solver_for
from .scene import Scene, check
from .solver import AbstractSolver
from .state import State
from .steady import (
    Pair,
    Problem,
    Shape,
    generators,
    or_nothing,
    refuse,
    refuse_freedom,
    root,
    said_shape,
)

_STEPS = 200  # in a period, unless told otherwise
_NEUTRAL = 1e-6  # a multiplier of 1 is found by differences, to so much


class PeriodicState(eqx.Module):
    """A state to whose shape the motion returns after a period; the whole may have moved and turned.

    - `state`, at the start of the period.
    - `displacement`: of the mean of all beads in a period [length], `(dim,)`.
    - `rotation`: of the whole in a period: the matrix that turns the first shape into the last,
      `(dim, dim)`.
    - `converged`: whether it was found; if not, the other numbers are NaN.
    - `jacobian`: derivatives of what a period changes in the shape's coordinates by them.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> spring = jb.force.Potential(lambda t, r: 3 * jnp.pi * jnp.sum(r**2))
    >>> push = jb.force.ForceField(lambda t, r: 6 * jnp.pi * jnp.cos(2 * jnp.pi * t) * jnp.ones_like(r))
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=1), viscosity=1.0, forces=[spring, push])
    >>> held, start = {"moving": False, "turning": False}, jb.State([[0.0, 0.0]])
    >>> found = jb.periodic_state(scene, start, period=1.0, substeps=20, **held)
    >>> print(found.converged, abs(found.multipliers).round(4))  # exp(-1): stable
    True [0.3679 0.3679]
    """

    state: State
    displacement: Float[Array, " dim"]
    rotation: Float[Array, "dim dim"]
    converged: Bool[Array, ""]
    jacobian: Float[Array, "numbers numbers"]

    @property
    def multipliers(self) -> np.ndarray:
        """Floquet multipliers, by which small disturbances grow in a period, complex, largest first:
        the motion is stable if none is larger than 1. A turn that makes no difference has 1. A host
        function.
        """
        values = 1 + np.linalg.eigvals(np.asarray(self.jacobian)).astype(complex)
        return values[np.argsort(-np.abs(values))]

    @property
    def turn(self) -> float:
        """Angle of the rotation [rad], signed in the plane (anticlockwise positive). A host function."""
        r = np.asarray(self.rotation)
        if len(r) == 2:
            return float(np.arctan2(r[1, 0], r[0, 0]))
        axis = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
        return float(np.arctan2(np.linalg.norm(axis), np.trace(r) - 1))

    def __str__(self) -> str:
        """What was found, in a few lines; under a transformation or of many, its structure."""
        if not known(self) or np.ndim(self.converged):
            return eqx.tree_pformat(self)
        if not self.converged:
            return "PeriodicState: not converged"
        largest = float(np.max(np.abs(self.multipliers), initial=0.0))
        how = "unstable" if largest > 1 + _NEUTRAL else "stable"
        lines = [
            f"PeriodicState: converged, {said_shape(self.state)}, {how}",
            f"in a period: displacement {said(self.displacement)}, turn {self.turn:.6g} rad",
            f"largest multiplier {largest:.6g} in size (all: `multipliers`)",
        ]
        return "\n  ".join(lines)


def periodic_state(
    scene: Scene,
    state: State,
    period: Time,
    *,
    t: Time = 0.0,
    moving: bool = True,
    turning: bool = True,
    solver: Solver | None = None,
    substeps: int | None = None,
    accuracy: float = 1e-8,
    max_steps: int = 20,
) -> PeriodicState:
    """The periodic motion near a state of a driven scene, by Newton shooting.

    Sought is a shape to which the scene returns after one period. Each step of Newton's method follows
    that period from two displaced starts for each coordinate of the shape, all at once. No transient is
    stepped through, and none is differentiated: derivatives, in both modes, follow from the implicit
    function theorem: by scene, period and time; by the start in what it decides, as the place and the
    direction of a clamp. Of motions that differ by a shift or a turn, that one is meant whose first
    place is the start's and whose shape lies best on the start. A start within a period or two of the
    limit is near enough in most scenes.

    **Arguments**

    - `scene`, `state`: the model, and a guess; `period` of its drive [time]; `t`: when it starts.
    - `moving`: the shape may move as a whole, which makes no difference; false for a held filament.
    - `turning`: the same of turns; false where weight or a flow set a direction, or a bead is held.
    - `solver`, with equal steps in the period, as `Rosenbrock(substeps=100)`; by default the scene's own
      with 200. Take twice as many to see the error.
    - `substeps`: short for those of the scene's own solver, or of a bare `diffrax` one.
    - `accuracy`: of the last correction, in radians and lengths of the fibre.
    - `max_steps` of Newton's method that are tried.

    **Returns** a `PeriodicState`. **Raises** `ValueError` for input that does not fit, `RuntimeError` if
    none is found (under `jit`, which cannot raise, `converged` is false and the numbers are NaN).

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> spring = jb.force.Potential(lambda t, r: 3 * jnp.pi * jnp.sum(r**2))
    >>> push = jb.force.ForceField(lambda t, r: 6 * jnp.pi * jnp.cos(2 * jnp.pi * t) * jnp.ones_like(r))
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=1), viscosity=1.0, forces=[spring, push])
    >>> held, start = {"moving": False, "turning": False}, jb.State([[0.0, 0.0]])
    >>> found = jb.periodic_state(scene, start, period=1.0, substeps=20, **held)
    >>> print(found.state.position.round(4))  # where a cycle begins: 1/(1 + 4 pi^2)
    [[0.0247 0.0247]]
    """
    check(scene, state)
    refuse_freedom(scene, "moving", moving, "translation")
    refuse_freedom(scene, "turning", turning, "rotation")
    state = scene.begin(state)
    positive("period", period)
    positive("accuracy", accuracy)
    whole("max_steps", max_steps, 1)
    if turning and not moving:
        fail("turning", "be False for a shape that does not move", "it is True")
    ts = jnp.stack([jnp.asarray(t, float), jnp.asarray(t, float) + period])
    equal = _equal_steps(scene, solver, substeps)
    if turning and known((scene, state, ts)):
        _refuse_directions(ts, state, scene)
    problem = Problem(scene, ts, state)
    accurate = jnp.asarray(accuracy)
    found, last = _solve(problem, moving, turning, equal, accurate, max_steps)
    if known((found, last, problem)) and not bool(found.converged):
        _refuse(problem, last, equal)
        raise RuntimeError(
            f"No periodic state was found in {max_steps} steps from this start: give one that is "
            "nearer, as the end of a `rollout` over a few periods, or loosen `accuracy`."
        )
    return found


def _refuse_directions(ts: Array, state: State, scene: Scene) -> None:
    """Refuse turns of the whole that make a difference."""
    off = float(_difference(ts, state, scene))
    if off > 1e4 * float(jnp.finfo(state.position.dtype).eps) ** (2 / 3):
        how = "something sets a direction, as weight, a flow or a magnetic field"
        fail(
            "turning",
            f"be False where a turn of the whole makes a difference ({how})",
            "it is True",
        )


@with_all_digits
@eqx.filter_jit
def _difference(ts: Array, state: State, scene: Scene) -> Array:
    """How far the rates of a turned state are from turned rates, relative, at some times."""

    def one(t: Array, matrix: Array) -> tuple[Array, Array]:
        turning = carried.turned(state, matrix)
        found, change = jax.jvp(lambda s: rate(t, s, scene), (state,), (turning,))
        same = carried.turned(found, matrix).position
        size = jnp.max(jnp.abs(change.position)) + jnp.max(jnp.abs(same))
        # Where shapes are stiff, what a turn changes is known to the rounding of what a bend does.
        bend = jax.tree.map(lambda v: jnp.cos(jnp.arange(v.size)).reshape(v.shape) * v, turning)
        stiff = jax.jvp(lambda s: rate(t, s, scene), (state,), (bend,))[1].position
        size = size + jnp.finfo(size.dtype).eps ** 0.5 * jnp.max(jnp.abs(stiff))
        return jnp.max(jnp.abs(change.position - same)), size

    times = ts[0] + jnp.array([0.0, 0.14, 0.43, 0.81], ts.dtype) * (ts[1] - ts[0])
    matrices = jnp.asarray(generators(state.position.shape[1]), state.position.dtype)
    off, size = jax.vmap(lambda t: jax.vmap(lambda w: one(t, w))(matrices))(times)
    most = jnp.max(size)
    return jnp.max(off) / jnp.where(most > 0, most, 1.0)


def _equal_steps(scene: Scene, solver: Solver | None, substeps: int | None) -> AbstractSolver:
    """The solver that the arguments mean, with equal steps."""
    beside = substeps if isinstance(solver, AbstractSolver) else None  # which refuses them
    meant = solver_for(scene, solver, None, beside)
    if meant.tolerance is not None or meant.controller is not None:
        must = f"take equal steps in a period, as `{type(meant).__name__}(..., substeps=100)`"
        fail("solver", must, "its steps are chosen by their error")
    number = meant.substeps if substeps is None else substeps
    return dataclasses.replace(meant, substeps=_STEPS if number is None else number)


def _refuse(problem: Problem, last: State, solver: AbstractSolver) -> None:
    """Name the term that breaks a period from the last shape that was tried, if there is one."""
    ts = jnp.linspace(problem.ts[0], problem.ts[1], (solver.substeps or 1) + 1)
    run = rollout(problem.scene, last, ts, solver=dataclasses.replace(solver, substeps=1))
    fine = np.isfinite(np.asarray(run.states.position)).all(axis=(1, 2))
    if not fine.all():
        at = max(int(np.argmin(fine)) - 1, 0)
        state = jax.tree.map(lambda x: x[at], run.states)
        for t in ts[at : at + 2]:  # what fails may do so at the end of the step only
            refuse(float(t), state, problem.scene, "periodic", solver.needs_derivatives)


class _Figure(eqx.Module):
    """What makes a shape: points of which only differences count, and vectors."""

    points: Array
    vectors: Array
    loose: Array  # vectors of any length
    numbers: tuple[Array, ...]  # which do not turn

    def turned(self, matrix: Array) -> "_Figure":
        points = self.points - self.points[:1]
        return _Figure(points @ matrix, self.vectors @ matrix, self.loose @ matrix, self.numbers)

    def turning(self, matrix: Array) -> "_Figure":
        """Its change in a turn along an antisymmetric matrix."""
        numbers = jax.tree.map(jnp.zeros_like, self.numbers)
        return eqx.tree_at(lambda f: f.numbers, self.turned(matrix), numbers)

    def coordinates(self, shape: Shape, moving: bool) -> Array:
        """As changes of the shape's coordinates."""
        points = self.points - self.points[:1] if moving else self.points
        turns = shape.chart.sideways(self.vectors)
        parts = points, turns, shape.chart.loose_numbers(self.loose), *self.numbers
        return shape.drop(jnp.concatenate([part.ravel() for part in parts]))


def _figure(shape: Shape, state: State) -> _Figure:
    chart = shape.chart
    loose = jnp.concatenate([state.position[:0], *chart.loose(state)])
    points, directions = chart.points(state.position), chart.directions(state)
    return _Figure(points, directions, loose, tuple(jax.tree.leaves(state.own)))


def _rotation(first: _Figure, last: _Figure) -> Array:
    """The rotation R by which the rows of the first figure, times R, lie best on those of the last."""

    def rows(figure: _Figure) -> Array:
        points = figure.points - figure.points.mean(axis=0, keepdims=True)
        size = jnp.max(jnp.abs(points))
        points = points / jnp.where(size > 0, size, 1.0)
        return jnp.concatenate([points, figure.vectors, figure.loose])

    return best_rotation(rows(first), rows(last))


def _turned_by(first: _Figure, last: _Figure) -> Array:
    """Turns c_k by which the first figure lies best on the last (where small): last = first + sum of
    c_k (first turned by W_k).
    """

    def rows(figure: _Figure) -> Array:
        points = figure.points - figure.points.mean(axis=0, keepdims=True)
        size = jnp.max(jnp.abs(lax.stop_gradient(first.points)))
        points = points / jnp.where(size > 0, size, 1.0)
        return jnp.concatenate([points, figure.vectors, figure.loose])

    a, b = rows(first), rows(last)
    return jnp.einsum("rd,kde,re->k", a, generators(a.shape[1]).astype(a.dtype), b) / jnp.sum(a * a)


@with_all_digits
@eqx.filter_jit
def _solve(
    problem: Problem,
    moving: bool,
    turning: bool,
    solver: AbstractSolver,
    accuracy: Array,
    max_steps: int,
) -> tuple[PeriodicState, State]:
    dim = problem.start.position.shape[1]

    def system(shape: Shape, y: Array, problem: Problem) -> Pair:
        """The change of the shape in a period; displacement and rotation of the whole, and what is no
        part of the change of the shape.
        """
        state = shape.state(y)
        run = rollout(problem.scene, state, problem.ts, solver=solver)
        after = run.final
        displacement = jnp.mean(after.position - state.position, axis=0)
        first, last = _figure(shape, state), _figure(shape, after)
        if not turning:
            apart = jax.tree.map(jnp.subtract, last, first).coordinates(shape, moving)
            rotation = jnp.eye(dim).ravel()
            return apart, jnp.concatenate([displacement, rotation, jnp.zeros_like(apart)])
        back = _rotation(lax.stop_gradient(last), lax.stop_gradient(first))
        begun, now = _figure(shape, problem.start), first
        first, last = first.turned(jnp.eye(dim)), last.turned(back)
        apart = jax.tree.map(jnp.subtract, last, first).coordinates(shape, moving)
        # What is left of a turn, apart = sum of c_k (first turned by W_k), does not count.
        still, matrices = lax.stop_gradient(first), jnp.asarray(generators(dim))
        basis = jax.vmap(lambda w: still.turning(w).coordinates(shape, moving), out_axes=1)(
            matrices
        )
        left = jnp.linalg.pinv(basis) @ apart
        rotation = back @ (jnp.eye(dim) - jnp.einsum("k,kij->ij", left, matrices))
        # Of all the shapes that are turned copies the one that lies best on the start is meant.
        turn = basis @ _turned_by(begun, now)
        sought = jnp.concatenate([displacement, rotation.ravel(), turn])
        return apart - basis @ left + turn, sought

    def linear(shape: Shape, problem: Problem) -> tuple[Pair, Pair]:
        # Central differences of equal steps, which are smooth: a program of tangents takes more than
        # twice as long to compile.
        count, dtype = len(shape.origin), shape.origin.dtype
        small = float(jnp.finfo(dtype).eps) ** (1 / 3)
        units = small * jnp.eye(count, dtype=dtype)
        at = jnp.concatenate([shape.origin[None], units, -units])
        found = jax.vmap(lambda y: system(shape, y, problem))(at)
        slopes = jax.tree.map(lambda x: (x[1 : count + 1] - x[count + 1 :]).T / (2 * small), found)
        return jax.tree.map(lambda x: x[0], found), slopes

    at = root(system, linear, problem, moving, accuracy, max_steps, neutral=1e-6, exact=False)
    displacement, rotation, _ = jnp.split(at.sought, [dim, dim + dim * dim])
    jacobian = at.jacobians[0] - at.jacobians[1][dim + dim * dim :]
    rotation = rotation.reshape(dim, dim)
    result = PeriodicState(at.state, displacement, rotation, at.found, jacobian)
    return or_nothing(at.found, result), at.last
