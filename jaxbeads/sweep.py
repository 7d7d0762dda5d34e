"""`sweep`: one scene for many values of its parameters, side by side."""

import warnings
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._checks import described, fail, finite, increasing, whole
from .breakdown import SimulationError
from .rollout import Solution, Tolerance, rollout
from .scene import Scene
from .simulate import simulate
from .state import State

if TYPE_CHECKING:
    import xarray

_EXPLAINED = 3  # members that failed are run again alone, to say why; no more than these
_NOT_RUN = -1

Build = Callable[..., tuple[Scene, State]]
Measure = Callable[[Solution, Scene], Mapping[str, Any]]


def sweep(
    build: Build,
    axes: Mapping[str, Any],
    ts: Any,
    measure: Measure,
    *,
    paired: bool = False,
    solver: diffrax.AbstractSolver | None = None,
    tolerance: Tolerance | None = None,
    substeps: int | None = None,
    projected: bool | None = None,
    max_steps: int = 100_000,
    chunk: int = 64,
    progress: bool = True,
) -> "xarray.Dataset":
    """Trajectories for all combinations of some parameters, measured, as a labelled table:

        def build(rigidity, weight):
            return Scene(..., forces=[Bending(rigidity), Weight([0.0, -weight])]), state

        table = sweep(build, {"rigidity": [1.0, 2.0], "weight": [0.1, 0.2, 0.3]}, ts, measure)
        table.speed.sel(weight=0.2); table.where(table.code == 0)

    Members are followed side by side by one compiled program, `chunk` of them at a time, which sees
    each value as an array: any number that does not change a shape may be an axis. Each member chooses
    its own steps, and none changes another: one that fails is marked and the rest goes on.

    **Arguments**

    - `build`: from a value of each axis, by name, the scene and where it starts.
    - `axes`: the values of each parameter by its name, one-dimensional.
    - `ts`: times to save at, the same for all [time].
    - `measure`: numbers or arrays by name, from a `Solution` and the scene.
    - `paired`: the axes' values belong together, one member for each, instead of all combinations.
    - `solver`, `tolerance`, `substeps`, `projected`, `max_steps`: as for `rollout`.
    - `chunk`: members at a time; memory grows with it.
    - `progress`: show a progress bar.

    **Returns** an `xarray.Dataset`: one dimension for each axis (or `member`), what was measured (NaN
    where it failed), `steps`, and `code`: 0 where all went well, otherwise as in a `Solution`, 4 where
    only what is measured is not finite, -1 where Ctrl-C came before. `attrs["failures"]` says for each
    member that failed which it is, and for the first three why: alone they are run again by `simulate`,
    which names step, bead and term. **Raises** `ValueError` for input that does not fit.
    """
    points, shape, dims = _grid(axes, paired)
    for name, function in (("build", build), ("measure", measure)):
        if not callable(function):
            fail(name, "be a function", f"it is {described(function)}")
    increasing("ts", ts)
    whole("chunk", chunk, 1)
    ts = jnp.asarray(ts, float)
    options: dict[str, Any] = {
        "solver": solver,
        "tolerance": tolerance,
        "substeps": substeps,
        "projected": projected,
        "max_steps": max_steps,
    }

    def member(point: dict[str, Array]) -> tuple[dict[str, Array], Array, Array]:
        scene, state = _built(build, point)
        solution = rollout(scene, state, ts, **options)
        found = {name: jnp.asarray(value) for name, value in measure(solution, scene).items()}
        fine = [jnp.all(jnp.isfinite(x)) for x in found.values()]
        code = jnp.where((solution.code == 0) & ~jnp.all(jnp.array(fine)), 4, solution.code)
        kept = {n: jnp.where(code == 0, x.astype(float), jnp.nan) for n, x in found.items()}
        return kept, code, solution.steps

    kept, code, steps = _all(eqx.filter_jit(jax.vmap(member)), points, chunk, progress)

    def alone(point: dict[str, Array]) -> str:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a large step: the error says so
                scene, state = _built(build, point)
                simulate(scene, state, ts, progress=False, **options)
        except (SimulationError, ValueError) as error:
            return str(error)
        return "alone it runs to the end"

    import xarray

    extra = {"code": code, "steps": steps}
    coordinates = {n: ("member", x) for n, x in points.items()} if paired else dict(axes)
    variables = {
        name: (
            [*dims, *(f"{name}_{k}" for k in range(x.ndim - 1))],
            x.reshape(*shape, *x.shape[1:]),
        )
        for name, x in (kept | extra).items()
    }
    failures = _failures(points, code, alone)
    return xarray.Dataset(variables, coordinates, {"failures": failures})


def _built(build: Build, point: Mapping[str, Array]) -> tuple[Scene, State]:
    made = build(**point)
    if not (isinstance(made, tuple) and len(made) == 2 and isinstance(made[0], Scene)):
        fail("build", "return a scene and a state", f"it returns {described(made)}")
    return made


def _grid(
    axes: Mapping[str, Any], paired: bool
) -> tuple[dict[str, np.ndarray], tuple[int, ...], list[str]]:
    """Values of all members by name; shape and names of the table's dimensions."""
    if not axes:
        fail("axes", "name at least one parameter", "it is empty")
    values = {name: np.asarray(v, float) for name, v in axes.items()}
    for name, v in values.items():
        if v.ndim != 1 or len(v) == 0:
            fail(f"axes[{name!r}]", "be a sequence of numbers", f"it has shape {v.shape}")
        finite(f"axes[{name!r}]", v)
    if paired:
        lengths = {len(v) for v in values.values()}
        if len(lengths) > 1:
            fail("axes", "be equally long to be paired", f"their lengths are {sorted(lengths)}")
        return values, (lengths.pop(),), ["member"]
    grids = np.meshgrid(*values.values(), indexing="ij")
    return dict(zip(values, map(np.ravel, grids), strict=True)), grids[0].shape, list(values)


def _all(
    run: Callable[[dict[str, Array]], Any],
    points: dict[str, np.ndarray],
    chunk: int,
    progress: bool,
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """All members, chunk by chunk; the last chunk is filled up with its last member."""
    total = len(next(iter(points.values())))
    size, parts = min(chunk, total), []
    from tqdm.auto import tqdm

    try:
        with tqdm(total=total, disable=not progress) as bar:
            for first in range(0, total, size):
                rows = np.minimum(np.arange(first, first + size), total - 1)
                part = run({n: jnp.asarray(v[rows]) for n, v in points.items()})
                number = min(size, total - first)
                parts.append(jax.tree.map(lambda x, n=number: np.asarray(x)[:n], part))
                bar.update(number)
    except KeyboardInterrupt:
        if not parts:
            raise
    kept, code, steps = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    left = total - len(code)

    def filled(x: np.ndarray, value: float | int) -> np.ndarray:
        return np.concatenate([x, np.full((left, *x.shape[1:]), value, x.dtype)])

    kept = {name: filled(x, np.nan) for name, x in kept.items()}
    return kept, filled(code, _NOT_RUN), filled(steps, 0)


def _failures(
    points: dict[str, np.ndarray], code: np.ndarray, alone: Callable[[dict[str, Array]], str]
) -> list[str]:
    """A sentence for each member that failed."""
    sentences = []
    for row in np.flatnonzero(code != 0):
        who = ", ".join(f"{name} = {v[row]:g}" for name, v in points.items())
        if code[row] == _NOT_RUN:
            why = "not run: interrupted"
        elif code[row] == 4:
            why = "what is measured is not finite (code 4)"
        else:
            why = f"broke down (code {code[row]})"
            if len(sentences) < _EXPLAINED:
                point = {name: jnp.asarray(v[row]) for name, v in points.items()}
                why += f": {alone(point)}"
        sentences.append(f"{who}: {why}")
    return sentences
