"""`optimise`: the values at which a loss is least, by gradients."""

import os
import time
from collections.abc import Callable
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

_ROUND = 20  # steps between two corrections of the multipliers


class History(eqx.Module):
    """What happened in each step: `loss`, `gradient_norm` (of the loss, by the free values),
    `violation` (largest absolute value of the constraint), `(steps,)` or `(steps, starts)`; `time` [s].
    """

    loss: np.ndarray
    gradient_norm: np.ndarray
    violation: np.ndarray
    time: np.ndarray


class Optimum(eqx.Module):
    """The result of `optimise`.

    - `values`, `loss`, `violation`: of the best step (with a constraint: the last); with `many`, a
      leading axis of starts.
    - `history`: see `History`; `status`: why it ended.
    """

    values: PyTree
    loss: Array
    violation: Array
    history: History
    status: str = eqx.field(static=True)


class _Walk(eqx.Module):
    """Where it is: free values, the optimiser's memory, multipliers and weight of a constraint."""

    z: PyTree
    memory: Any
    multipliers: Array
    weight: Array


class _Problem(eqx.Module):
    loss: Callable[[PyTree], Any] = eqx.field(static=True)
    constraint: Callable[[PyTree], Array] | None = eqx.field(static=True)
    optimiser: optax.GradientTransformationExtraArgs = eqx.field(static=True)
    lower: PyTree
    upper: PyTree

    def values(self, z: PyTree) -> PyTree:
        """Values within their bounds from free ones."""
        return jax.tree.map(_inside, z, self.lower, self.upper)

    def free(self, values: PyTree) -> PyTree:
        return jax.tree.map(_free, values, self.lower, self.upper)

    def both(self, z: PyTree) -> tuple[Array, Array]:
        """The loss, and all that is to be zero."""
        values = self.values(z)
        loss, *constraints = found if isinstance(found := self.loss(values), tuple) else (found,)
        if self.constraint is not None:
            constraints.append(self.constraint(values))
        return loss, jnp.concatenate([jnp.zeros((0,)), *map(jnp.ravel, constraints)])

    def begin(self, z: PyTree) -> _Walk:
        size = jax.eval_shape(self.both, z)[1].shape[0]
        return _Walk(z, self.fresh(z), jnp.zeros(size), jnp.asarray(10.0))

    def fresh(self, z: PyTree) -> Any:
        """The optimiser's memory before its first step, of the types that it has after it: a weak type
        would be compiled for once more."""
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.asarray(x).dtype), self.optimiser.init(z))

    def step(self, walk: _Walk) -> tuple[_Walk, tuple[Array, Array, Array]]:
        """One step, and loss, norm of the gradient and violation before it."""

        def merit(z: PyTree) -> tuple[Array, tuple[Array, Array]]:
            loss, c = self.both(z)
            total = loss + walk.multipliers @ c + walk.weight / 2 * (c @ c)
            return total, (loss, jnp.max(jnp.abs(c), initial=0.0))

        (value, (loss, off)), slope = jax.value_and_grad(merit, has_aux=True)(walk.z)
        change, memory = self.optimiser.update(
            slope, walk.memory, walk.z, value=value, grad=slope, value_fn=lambda z: merit(z)[0]
        )
        z = optax.apply_updates(walk.z, change)
        norm = jnp.sqrt(sum(jnp.sum(x**2) for x in jax.tree.leaves(slope)))
        return _Walk(z, memory, walk.multipliers, walk.weight), (loss, norm, off)

    def correct(self, walk: _Walk) -> _Walk:
        """Multipliers of the augmented Lagrangian after a round of steps."""
        multipliers = walk.multipliers + walk.weight * self.both(walk.z)[1]
        return _Walk(walk.z, self.fresh(walk.z), multipliers, 2 * walk.weight)


def _known(lower: Array, upper: Array) -> tuple[Array, Array, Array, Array]:
    """Which bounds are finite, and bounds with a finite number where there is none, for a derivative
    that is finite on either side of each choice."""
    low, high = jnp.isfinite(lower), jnp.isfinite(upper)
    return (
        low,
        high,
        jnp.where(low, lower, 0.0),
        jnp.where(high, upper, jnp.where(low, lower, 0) + 1),
    )


def _inside(z: Array, lower: Array, upper: Array) -> Array:
    low, high, lower, upper = _known(lower, upper)
    both = lower + (upper - lower) * jax.nn.sigmoid(z)
    one = jnp.where(low, lower + jax.nn.softplus(z), upper - jax.nn.softplus(-z))
    return jnp.where(low & high, both, jnp.where(low | high, one, z))


def _free(x: Array, lower: Array, upper: Array) -> Array:
    low, high, lower, upper = _known(lower, upper)
    part = jnp.clip((x - lower) / (upper - lower), 1e-6, 1 - 1e-6)

    def inverse(gap: Array) -> Array:  # of softplus
        return gap + jnp.log(-jnp.expm1(-jnp.maximum(gap, 1e-6)))

    one = jnp.where(low, inverse(x - lower), -inverse(upper - x))
    both = jnp.log(part / (1 - part))
    return jnp.where(low & high, both, jnp.where(low | high, one, x))


def optimise(
    loss: Callable[[PyTree], Any],
    start: PyTree,
    *,
    optimiser: optax.GradientTransformation | None = None,
    steps: int = 100,
    bounds: tuple[Any, Any] | None = None,
    constraint: Callable[[PyTree], Any] | None = None,
    many: bool = False,
    gradient_tolerance: float = 1e-6,
    file: str | Path | None = None,
    progress: bool = True,
) -> Optimum:
    """Minimise a loss by its gradient.

    Bounds are kept by free values of which the values are smooth functions (sigmoid or softplus). A
    constraint, such as a fixed power, is met by an augmented Lagrangian, whose multipliers are
    corrected every 20 steps. Ctrl-C, or a loss that is not finite, ends it with the best values so far.

    **Arguments**

    - `loss`: of the values, a scalar; see `vary`. Or a pair of it and of what is to be zero, a number
      or a vector, where both come from one computation. `start`: numbers or arrays, in any tree.
    - `optimiser`: of `optax`; by default `optax.lbfgs()`, which searches along each direction.
    - `steps`: the most in all. It ends earlier where the gradient's norm is below `gradient_tolerance`
      (of every start; with a constraint, after the last correction only).
    - `bounds`: `(lower, upper)`, each one number or a tree as `start`; infinite where there is none.
    - `constraint`: a function of the values, a number or a vector, that is to be zero.
    - `many`: `start` has a leading axis of starts, which are followed side by side.
    - `file`: where it stands is written there after every step; if the file exists, it goes on from it.
    - `progress`: show a progress bar.

    **Returns** an `Optimum`. **Raises** `ValueError` for a start that is outside its bounds or not
    finite, and for a file of another problem.
    """
    for name, function in (("loss", loss), ("constraint", constraint)):
        if not callable(function) and not (name == "constraint" and function is None):
            fail(name, "be a function", f"it is {described(function)}")
    whole("steps", steps, 1)
    positive("gradient_tolerance", gradient_tolerance)
    optimiser = optax.lbfgs() if optimiser is None else optimiser
    kind("optimiser", optimiser, optax.GradientTransformation)
    start = jax.tree.map(float_array, start)
    for leaf in jax.tree.leaves(start):
        finite("start", leaf)
    lower, upper = _bounds(start, bounds, many)
    problem = _Problem(loss, constraint, optax.with_extra_args_support(optimiser), lower, upper)
    over = (lambda f: eqx.filter_jit(eqx.filter_vmap(f))) if many else eqx.filter_jit
    step, correct, values = over(problem.step), over(problem.correct), over(problem.values)
    walk = over(problem.begin)(over(problem.free)(start))
    constrained = walk.multipliers.size > 0
    rows: list[list[Any]] = []
    number = jax.tree.leaves(start)[0].shape[:1] if many else ()
    best, least = walk.z, jnp.full(number, jnp.inf)
    if file is not None and Path(file).exists():
        (walk, best, least), rows = _read(file, (walk, best, least))
    status, begun = f"took all {steps} steps", time.perf_counter() - (rows[-1][3] if rows else 0.0)
    from tqdm.auto import tqdm

    try:
        with tqdm(total=steps, initial=len(rows), disable=not progress) as bar:
            while len(rows) < steps:
                after, report = step(walk)
                value, norm, off = (np.asarray(x) for x in report)
                if not np.all(np.isfinite(value)) and not many:
                    status = f"stopped: the loss is not finite at step {len(rows)}"
                    break
                rows.append([value, norm, off, np.asarray(time.perf_counter() - begun)])
                better = (value < least) | constrained
                least = jnp.where(better, value, least)
                best = _pick(better, walk.z, best)
                walk = after
                if constrained and len(rows) % _ROUND == 0:
                    walk = correct(walk)
                if file is not None:
                    _write(file, (walk, best, least), rows)
                bar.update()
                bar.set_postfix(loss=f"{value.min():.4g}")
                if not constrained and np.all(norm < gradient_tolerance):
                    status = "the gradient vanishes"
                    break
    except KeyboardInterrupt:
        status = "interrupted"
    losses, norms, off, seconds = (np.array([row[k] for row in rows]) for k in range(4))
    last, c = over(problem.both)(best)
    violation = jnp.max(jnp.abs(c), axis=-1, initial=0.0)
    history = History(losses, norms, off, seconds)
    return Optimum(values(best), last, violation, history, status)


def _pick(better: Any, new: PyTree, old: PyTree) -> PyTree:
    """The new values of the starts that have become better."""

    def one(new: Array, old: Array) -> Array:
        return jnp.where(
            np.reshape(better, np.shape(better) + (1,) * (new.ndim - np.ndim(better))), new, old
        )

    return jax.tree.map(one, new, old)


def _bounds(start: PyTree, bounds: tuple[Any, Any] | None, many: bool) -> tuple[PyTree, PyTree]:
    """Trees of lower and upper bounds as `start`, or as each of many."""
    sides = (-np.inf, np.inf) if bounds is None else bounds
    if len(sides) != 2:
        fail("bounds", "be a pair (lower, upper)", f"it holds {len(sides)} things")
    trees = []
    for side in sides:
        same = jax.tree.structure(side) == jax.tree.structure(start)
        tree = side if same else jax.tree.map(lambda _, side=side: side, start)
        trees.append(
            jax.tree.map(lambda b, x: jnp.broadcast_to(float_array(b), x.shape[many:]), tree, start)
        )
    for x, low, high in zip(*map(jax.tree.leaves, (start, *trees)), strict=True):
        x, low, high = (np.asarray(a) for a in (x, low, high))
        if not np.all((low <= x) & (x <= high)):
            fail("start", "lie within its bounds", f"{x} does not")
    return trees[0], trees[1]


def _write(file: str | Path, walk: Any, rows: list[list[Any]]) -> None:
    """Where it stands; a file is whole at any time."""
    parts: dict[str, Any] = {f"leaf{k}": x for k, x in enumerate(jax.tree.leaves(walk))}
    parts |= {f"row{k}": np.stack([row[k] for row in rows]) for k in range(4)}
    part = Path(f"{file}.part")
    with part.open("wb") as handle:
        np.savez(handle, **parts)
    os.replace(part, file)


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
