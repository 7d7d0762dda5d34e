"""`optimise`: the values at which a loss is least, by gradients."""

import io
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, PyTree

from ._checks import described, fail, finite, kind, positive, whole
from ._typing import float_array
from .optimum import INTERRUPTED, NO_FURTHER, NOT_FINITE, STEPS, VANISHES, ZERO, History, Optimum
from .storage import replace_whole
from .units import NOISE, Units, bounds_of, free, inside, own, reach, reached, shown, unbound

_ROUND = 20  # steps between two corrections of the multipliers
_WEIGHT = 100.0  # of the square of the constraint in the first of them, in units
_OWN_WEIGHT = 10.0  # the same for an optimiser that is given
_PROBES = 20  # trials of how far a start of zeros may go
_ROWS = 32  # constraints whose units are found one by one


class _Terms(eqx.Module):
    """What the merit is made of: multipliers and weight of a constraint; the units of all."""

    multipliers: Array
    weight: Array
    units: Units


class _Walk(eqx.Module):
    """Where it is: free values, the optimiser's memory, the merit's terms, and the largest gradient by
    each array of values so far.
    """

    z: PyTree
    memory: Any
    terms: _Terms
    largest: Array


class _Slope(eqx.Module):
    """Merit and its gradient by the free values, in units; loss and constraints as they are."""

    value: Array
    gradient: PyTree
    loss: Array
    constraints: Array


class _Problem(eqx.Module):
    loss: Callable[[PyTree], Any] = eqx.field(static=True)
    constraint: Callable[[PyTree], Array] | None = eqx.field(static=True)
    optimiser: optax.GradientTransformationExtraArgs = eqx.field(static=True)
    searching: bool = eqx.field(static=True)
    """Whether it is the default optimiser, which is asked in units and searches for what is lower."""
    lower: PyTree
    upper: PyTree

    def values(self, z: PyTree, units: Units) -> PyTree:
        """Values within their bounds from free ones."""
        z = jax.tree.map(jnp.divide, z, units.free)
        return jax.tree.map(inside, z, self.lower, self.upper, units.values)

    def both(self, z: PyTree, units: Units) -> tuple[Array, Array]:
        """The loss, and all that is to be zero."""
        values = self.values(z, units)
        loss, *constraints = found if isinstance(found := self.loss(values), tuple) else (found,)
        if self.constraint is not None:
            constraints.append(self.constraint(values))
        return loss, jnp.concatenate([jnp.zeros((0,)), *map(jnp.ravel, constraints)])

    def merit(self, z: PyTree, terms: _Terms) -> tuple[Array, tuple[Array, Array]]:
        """The augmented Lagrangian over the unit of the loss; loss and constraints."""
        loss, constraints = self.both(z, terms.units)
        c = constraints / terms.units.constraints
        total = loss / terms.units.loss + terms.multipliers @ c + terms.weight / 2 * (c @ c)
        return total, (loss, constraints)

    def slope(self, z: PyTree, terms: _Terms) -> _Slope:
        """Merit and gradient."""
        with_gradient = jax.value_and_grad(lambda z: self.merit(z, terms), has_aux=True)
        (value, (loss, constraints)), gradient = with_gradient(z)
        return _Slope(value, gradient, loss, constraints)

    def plain(self, start: PyTree) -> _Terms:
        """Terms that make the loss itself the merit of the values themselves."""
        ones = jax.tree.map(jnp.ones_like, start)
        one, zero = jnp.ones((), float), jnp.zeros((), float)
        size = jax.eval_shape(self.both, start, Units(ones, ones, one, one, one))[1].size
        return _Terms(jnp.zeros(size), zero, Units(ones, ones, one, jnp.ones(size), one))

    def begin(self, start: PyTree, at: _Slope, rows: list[PyTree], part: Array) -> _Walk:
        """Where the walk starts, from loss and constraints there and their gradients."""
        slopes = jax.tree.map(lambda *rows: jnp.stack(rows), *rows)
        count = at.constraints.size
        if len(rows) <= count:  # one row for all constraints
            each = [0] + [1] * count
            slopes = jax.tree.map(lambda x: x[np.array(each)] / np.sqrt(max(count, 1)), slopes)
            slopes = jax.tree.map(lambda x, g: x.at[0].set(g), slopes, rows[0])
        far = reach(start, self.lower, self.upper, at.loss, at.gradient, part)
        units = shown(start, self.lower, self.upper, at.loss, at.constraints, slopes, far)
        weight = _WEIGHT
        if not self.searching:
            units, weight = own(units, self.lower, self.upper), _OWN_WEIGHT
        z = jax.tree.map(free, start, self.lower, self.upper, units.values)
        z = jax.tree.map(jnp.multiply, z, units.free)
        largest = jnp.zeros(len(jax.tree.leaves(z)))
        terms = _Terms(jnp.zeros(count), jnp.full((), weight, float), units)
        return _Walk(z, self.fresh(z), terms, largest)

    def fresh(self, z: PyTree) -> Any:
        """The optimiser's memory before its first step, of the types that it has after it: a weak type
        would be compiled for once more.
        """
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.asarray(x).dtype), self.optimiser.init(z))

    def move(self, walk: _Walk, at: _Slope) -> tuple[_Walk, Array]:
        """One step, and whether its search has found nothing lower."""
        change, memory = self.optimiser.update(
            at.gradient,
            walk.memory,
            walk.z,
            value=at.value,
            grad=at.gradient,
            value_fn=lambda z: self.merit(z, walk.terms)[0],
        )
        fall = jnp.asarray(_dot(change, at.gradient))
        rounding = jnp.finfo(at.value.dtype).eps * jnp.abs(at.value)
        stuck = jnp.logical_and(self.searching, ~(fall < -rounding))
        z = optax.apply_updates(walk.z, change)
        # What the optimiser remembers has led nowhere: it goes on without.
        z, memory = _pick(stuck, (walk.z, self.fresh(walk.z)), (z, memory))
        largest = jnp.maximum(walk.largest, self.norms(walk, at))
        return _Walk(z, memory, walk.terms, largest), stuck

    def norms(self, walk: _Walk, at: _Slope) -> Array:
        """Norm of the gradient by each array of values."""
        z = jax.tree.map(jnp.divide, walk.z, walk.terms.units.free)
        whole = jax.tree.map(unbound, at.gradient, z, self.lower, self.upper)
        return jnp.stack([jnp.linalg.norm(jnp.ravel(g)) for g in jax.tree.leaves(whole)])

    def report(self, walk: _Walk, at: _Slope, *, tolerance: float) -> tuple[Array, ...]:
        """Loss, norm of the gradient and violation; whether the gradient has vanished."""
        norms = self.norms(walk, at)
        largest = jnp.maximum(walk.largest, norms)
        size = walk.terms.units.size / walk.terms.units.loss
        least = jnp.maximum(tolerance * largest, NOISE * jnp.maximum(size, jnp.max(largest)))
        off = jnp.max(jnp.abs(at.constraints), initial=0.0)
        done = jnp.all((norms < least) | (norms == 0))
        return at.loss, walk.terms.units.loss * jnp.linalg.norm(norms), off, done

    def correct(self, walk: _Walk) -> _Walk:
        """Multipliers of the augmented Lagrangian after a round of steps."""
        terms = walk.terms
        c = self.both(walk.z, terms.units)[1] / terms.units.constraints
        multipliers = terms.multipliers + terms.weight * c
        terms = _Terms(multipliers, 2 * terms.weight, terms.units)
        return _Walk(walk.z, self.fresh(walk.z), terms, walk.largest)


class _Program:
    """The problem's functions, compiled; of many starts side by side."""

    def __init__(self, problem: _Problem, many: bool) -> None:
        def over(function: Callable[..., Any], arguments: int) -> Callable[..., Any]:
            axes = (None, *[eqx.if_array(0)] * arguments)
            return eqx.filter_jit(eqx.filter_vmap(function, in_axes=axes) if many else function)

        self.problem, self.many = problem, many
        self.over = over
        self.slope = over(_Problem.slope, 2)
        self.move, self.correct = over(_Problem.move, 2), over(_Problem.correct, 1)
        self.values, self.both = over(_Problem.values, 2), over(_Problem.both, 2)

    def begin(self, start: PyTree) -> _Walk:
        """Where the walk starts, in the units that the start shows."""
        whole = jax.tree.map(lambda x: jnp.full_like(x, jnp.inf), self.problem.upper)
        nowhere = jax.tree.map(jnp.negative, whole)
        at_large = eqx.tree_at(lambda p: (p.lower, p.upper), self.problem, (nowhere, whole))
        terms = self.over(_Problem.plain, 1)(at_large, start)
        at = self.slope(at_large, start, terms)
        count, rows = at.constraints.shape[-1], [at.gradient]
        if not self.problem.searching:
            rows += [jax.tree.map(jnp.zeros_like, at.gradient)] * count
            return self.over(_Problem.begin, 4)(
                self.problem, start, at, rows, jnp.zeros_like(at.loss)
            )
        signs = np.where(np.random.default_rng(0).random(count) < 0.5, -1.0, 1.0)
        for weights in np.eye(count) if count <= _ROWS else [signs]:
            multipliers = jnp.broadcast_to(jnp.asarray(weights), at.constraints.shape)
            # Over an infinite unit the loss does not count.
            only = eqx.tree_at(
                lambda t: (t.multipliers, t.units.loss),
                terms,
                (multipliers, jnp.full_like(terms.units.loss, jnp.inf)),
            )
            rows.append(self.slope(at_large, start, only).gradient)
        part = self.visible(start, at, at_large, terms)
        return self.over(_Problem.begin, 4)(self.problem, start, at, rows, part)

    def visible(self, start: PyTree, at: _Slope, at_large: _Problem, terms: _Terms) -> Array:
        """The largest part of itself by which the loss falls, if somewhat less, where small values reach
        for it; 0 if there is none.
        """

        def go(problem: _Problem, start: PyTree, at: _Slope, part: Array) -> tuple[PyTree, Array]:
            far = reach(start, problem.lower, problem.upper, at.loss, at.gradient, part)
            there = reached(start, problem.lower, problem.upper, at.gradient, far)
            return there, jnp.any(jnp.stack(jax.tree.leaves(far)) > 0)

        part, found, go = jnp.ones_like(at.loss), np.zeros(at.loss.shape, bool), self.over(go, 3)
        for _ in range(_PROBES):
            there, small = go(self.problem, start, at, part)
            if np.all(found | ~small):
                break
            lower = self.slope(at_large, there, terms).loss
            found = found | np.asarray(jnp.isfinite(lower) & (lower < at.loss))
            part = jnp.where(found, part, part / 8)
        return jnp.where(found, part, 0.0)


def optimise(
    loss: Callable[[PyTree], Any],
    start: PyTree,
    *,
    optimiser: optax.GradientTransformation | None = None,
    steps: int = 100,
    bounds: tuple[Any, Any] | None = None,
    constraint: Callable[[PyTree], Any] | None = None,
    many: bool = False,
    gradient_tolerance: float = 1e-7,
    file: str | Path | None = None,
    progress: bool = True,
) -> Optimum:
    """Minimise a loss by its gradient.

    Bounds are kept by free values of which the values are smooth functions (sigmoid or softplus). A
    constraint, such as a fixed power, is met by an augmented Lagrangian, whose multipliers are
    corrected every 20 steps. Ctrl-C, or a loss that is not finite, ends it with the best values so far.

    The default optimiser sees values, loss and constraints in units that the start shows (see
    `units.shown`), so that the same problem in other units takes the same steps. An array of values has
    one unit: values of several kinds are several arrays. An optimiser that is given sees them as they
    are, because learning rates have units. Results and history are in the units of the problem.

    **Arguments**

    - `loss`: of the values, a scalar; see `vary`. Or a pair of it and of what is to be zero, a number
      or a vector, where both come from one computation. `start`: numbers or arrays, in any tree.
    - `optimiser`: of `optax`; by default `optax.lbfgs()`, which searches along each direction.
    - `steps`: the most in all. Without a constraint it ends earlier where the gradient vanishes (of
      every start): by each array it has fallen below `gradient_tolerance` times the largest so far.
    - `bounds`: `(lower, upper)`, each one number or a tree as `start`; infinite where there is none.
    - `constraint`: a function of the values, a number or a vector, that is to be zero.
    - `many`: `start` has a leading axis of starts, which are followed side by side.
    - `file`: where it stands is written there after every step; if the file exists, it goes on from it.
    - `progress`: show a progress bar.

    **Returns** an `Optimum`. **Raises** `ValueError` for a start that is outside its bounds or not
    finite, and for a file of another problem.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> best = jb.optimise(lambda x: jnp.sum((x - 3.0) ** 2), jnp.array([0.0, 1.0]), progress=False)
    >>> print(best.values.round(6))
    [3. 3.]
    """
    for name, function in (("loss", loss), ("constraint", constraint)):
        if not callable(function) and not (name == "constraint" and function is None):
            fail(name, "be a function", f"it is {described(function)}")
    whole("steps", steps, 1)
    positive("gradient_tolerance", gradient_tolerance)
    searching = optimiser is None
    optimiser = optax.lbfgs() if optimiser is None else optimiser
    kind("optimiser", optimiser, optax.GradientTransformation)
    start = jax.tree.map(float_array, start)
    for leaf in jax.tree.leaves(start):
        finite("start", leaf)
    lower, upper = bounds_of(start, bounds, many)
    extra = optax.with_extra_args_support(optimiser)
    problem = _Problem(loss, constraint, extra, searching, lower, upper)
    run = _Program(problem, many)
    walk = run.begin(start)
    constrained = walk.terms.multipliers.size > 0
    report = run.over(partial(_Problem.report, tolerance=gradient_tolerance), 2)
    rows: list[list[Any]] = []
    number = jax.tree.leaves(start)[0].shape[:1] if many else ()
    best, least, before = walk.z, jnp.full(number, jnp.inf), np.zeros(number, bool)
    if file is not None and Path(file).exists():
        (walk, best, least), rows = _read(file, (walk, best, least))
    ending, begun = STEPS, time.perf_counter() - (rows[-1][3] if rows else 0.0)
    from tqdm.auto import tqdm

    try:
        with tqdm(total=steps, initial=len(rows), disable=not progress) as bar:
            while len(rows) < steps:
                at = run.slope(problem, walk.z, walk.terms)
                value, norm, off, done = map(np.asarray, report(problem, walk, at))
                if not np.all(np.isfinite(value)) and not many:
                    ending = NOT_FINITE
                    break
                rows.append([value, norm, off, np.asarray(time.perf_counter() - begun)])
                better = (value < least) | constrained
                least = jnp.where(better, value, least)
                best = _pick(better, walk.z, best)
                vanished = not constrained and np.all(done)
                stuck = np.zeros_like(done)
                if not vanished:
                    walk, found = run.move(problem, walk, at)
                    stuck, before = np.asarray(found) & before, np.asarray(found)
                if constrained and len(rows) % _ROUND == 0:
                    walk = run.correct(problem, walk)
                if file is not None:
                    _write(file, (walk, best, least), rows)
                bar.update()
                bar.set_postfix(loss=f"{value.min():.4g}")
                if not constrained and np.all(stuck | done) and not vanished:
                    ending = NO_FURTHER
                    break
                if vanished:
                    ending = VANISHES if len(rows) > 1 else ZERO
                    break
    except KeyboardInterrupt:
        ending = INTERRUPTED
    losses, norms, off, seconds = (np.array([row[k] for row in rows]) for k in range(4))
    last, c = run.both(problem, best, walk.terms.units)
    violation = jnp.max(jnp.abs(c), axis=-1, initial=0.0)
    history = History(losses, norms, off, seconds)
    values = run.values(problem, best, walk.terms.units)
    return Optimum(values, last, violation, history, jnp.asarray(ending, jnp.int32))


def _dot(a: PyTree, b: PyTree) -> Array:
    """Inner product of two trees."""
    return jnp.asarray(sum(map(jnp.vdot, jax.tree.leaves(a), jax.tree.leaves(b))))


def _pick(better: Any, new: PyTree, old: PyTree) -> PyTree:
    """The new values of the starts that have become better."""

    def one(new: Array, old: Array) -> Array:
        return jnp.where(
            np.reshape(better, np.shape(better) + (1,) * (new.ndim - np.ndim(better))), new, old
        )

    return jax.tree.map(one, new, old)


def _write(file: str | Path, walk: Any, rows: list[list[Any]]) -> None:
    """Where it stands; a file is whole at any time."""
    parts: dict[str, Any] = {f"leaf{k}": x for k, x in enumerate(jax.tree.leaves(walk))}
    parts |= {f"row{k}": np.stack([row[k] for row in rows]) for k in range(4)}
    buffer = io.BytesIO()
    np.savez(buffer, **parts)
    replace_whole(Path(file), buffer.getvalue())


def _read(file: str | Path, like: Any) -> tuple[Any, list[list[Any]]]:
    leaves, tree = jax.tree.flatten(like)
    try:
        with np.load(file) as data:
            found = [data[f"leaf{k}"] for k in range(len(leaves))]
            columns = [data[f"row{k}"] for k in range(4)]
            whole_file = len(data.files) == len(leaves) + 4
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(
            f"Argument `file` must hold an optimisation, but {file} does not."
        ) from error
    if not whole_file or any(a.shape != np.shape(b) for a, b in zip(found, leaves, strict=True)):
        raise ValueError(f"Argument `file` must hold this optimisation, but {file} holds another.")
    walk = jax.tree.unflatten(tree, [jnp.asarray(x) for x in found])
    return walk, [list(row) for row in zip(*columns, strict=True)]
