"""`sweep`: one scene for many values of its parameters."""

import os
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._checks import described, fail, finite, increasing, whole
from .breakdown import SimulationError
from .chunks import Measured, all_members
from .dynamics import evaluate
from .factors import at_once
from .outcome import Outcome, meaning
from .rollout import Solver, Tolerance, rollout
from .scene import Scene, check
from .simulate import simulate
from .solution import Solution
from .solver import AbstractSolver
from .state import State

if TYPE_CHECKING:
    import xarray

_PAIRS = 2**12  # of members side by side: a table of them takes 32 KiB
_OWN = ("code", "steps")  # names that every table has
_RESERVED = set(
    [
        "byte",
        "char",
        "short",
        "ushort",
        "int",
        "uint",
        "int64",
        "uint64",
        "float",
        "real",
        "double",
        "bool",
        "string",
    ]
)
_EXPLAINED = 3  # members that failed are run again alone, to say why; no more than these

Build = Callable[..., tuple[Scene, State]]
Measure = Callable[[Solution, Scene], Mapping[str, Any]]


def sweep(
    build: Build,
    axes: Mapping[str, Any],
    ts: Any,
    measure: Measure,
    *,
    paired: bool = False,
    solver: Solver | None = None,
    tolerance: Tolerance | None = None,
    substeps: int | None = None,
    chunk: int | None = None,
    folder: str | os.PathLike[str] | None = None,
    devices: Sequence[Any] | None = None,
    progress: bool = True,
) -> "xarray.Dataset":
    """Trajectories for all combinations of some parameters, measured, as a labelled table:

        def build(rigidity, weight):
            return Scene(..., forces=[Bending(rigidity), Weight([0.0, -weight])]), state

        table = sweep(build, {"rigidity": [1.0, 2.0], "weight": [0.1, 0.2, 0.3]}, ts, measure)
        table.speed.sel(weight=0.2); table.where(table.code == 0)

    Members are followed by one compiled program, `chunk` of them on each device at a time, which sees
    each value as an array: any number that does not change a shape may be an axis. An accelerator takes
    a chunk side by side; a CPU one member after the other, or a few small ones at a time if their steps
    are equal (`substeps`); more of its cores are used by more devices, see below. None changes another:
    one that fails is marked and the rest goes on. Chunks of the same size give the same numbers, bit for
    bit, on any number of devices and processes of the same kind.

    With a `folder` each chunk is written to it when it is done. The same call again reads what is there
    and runs the rest: after a kill, on other devices, or with `jax.distributed` initialised in several
    processes at once, which share the chunks and all return the whole table.

    **Arguments**

    - `build`: from a value of each axis, by name, the scene and where it starts.
    - `axes`: the values of each parameter by its name, one-dimensional. This name and those of what is
      measured are names of the table: not `code` nor `steps`, none twice, and such that a netCDF file
      can hold them.
    - `ts`: times to save at, the same for all [time].
    - `measure`: real numbers or arrays by name, from a `Solution` and the scene.
    - `paired`: the axes' values belong together, one member for each, instead of all combinations.
    - `solver`, `tolerance`, `substeps`: as for `rollout`.
    - `chunk`: members at a time on each device; memory grows with it. By default what the folder has, or
      64, or less where that leaves a device without work.
    - `folder`: where chunks are kept, made if it is not there.
    - `devices`: by default this process's (`jax.local_devices()`).
    - `progress`: show a progress bar.

    **Returns** an `xarray.Dataset`: one dimension for each axis (or `member`), what was measured (NaN
    where it failed), `steps`, and `code`: 0 where all went well, otherwise another `Outcome`, as
    4 where only what is measured is not finite, or -1 where Ctrl-C came before. `attrs["failures"]` is a
    text with a line for each member that failed: which it is, and for the first three why; alone they
    are run again by `simulate`, which names step, bead and term. `to_netcdf` writes all of it.
    **Raises** `ValueError` for input that does not fit, as a folder that holds another sweep.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> def build(weight):
    ...     forces = [jb.force.Weight(weight * jnp.array([0.0, -1.0]))]
    ...     return jb.Scene(jb.Chain(1.0, 1), 1.0, forces=forces), jb.State([[0.0, 0.0]])
    >>> def measure(solution, scene):
    ...     return {"fall": jb.objectives.distance(solution)}
    >>> axes, ts, options = {"weight": [3.0, 6.0]}, [0.0, 1.0, 2.0], {"substeps": 1, "progress": False}
    >>> table = jb.sweep(build, axes, ts, measure, **options)
    >>> print(table.fall.values.round(4), table.code.values)  # W t/(6 pi mu a)
    [0.3183 0.6366] [0 0]
    """
    points, shape, dims = _grid(axes, paired)
    for name, function in (("build", build), ("measure", measure)):
        if not callable(function):
            fail(name, "be a function", f"it is {described(function)}")
    increasing("ts", ts)
    if chunk is not None:
        whole("chunk", chunk, 1)
    if devices is not None and len(devices) == 0:
        fail("devices", "hold at least one device", "it is empty")
    ts = jnp.asarray(ts, float)
    options: dict[str, Any] = {"solver": solver, "tolerance": tolerance, "substeps": substeps}

    def member(point: dict[str, Array]) -> Measured:
        scene, state = _built(build, point)
        solution = rollout(scene, state, ts, **options)
        found = _measured(measure(solution, scene), [*dims, *axes])
        fine = [jnp.all(jnp.isfinite(x)) for x in found.values()]
        code = jnp.where(
            (solution.code == Outcome.FINE) & ~jnp.all(jnp.array(fine)),
            Outcome.NOT_MEASURED,
            solution.code,
        )
        kept = {
            n: jnp.where(code == Outcome.FINE, x.astype(float), jnp.nan) for n, x in found.items()
        }
        return Measured(kept, code, solution.steps)

    # With steps of their own members would wait for one another.
    own = solver.substeps if isinstance(solver, AbstractSolver) else None
    equal = substeps is not None or own is not None
    together = _together(build, points) if equal else 1
    kept, code, steps = all_members(member, points, chunk, folder, devices, progress, together)

    def alone(point: dict[str, Array]) -> str:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a large step: the error says so
                scene, state = _built(build, point)
                simulate(scene, state, ts, progress=False, **options)
        except (SimulationError, ValueError) as error:
            return " ".join(str(error).split())
        return "alone it runs to the end"

    import xarray

    extra = {"code": code, "steps": steps}
    coordinates = {n: ("member", x) for n, x in points.items()} if paired else dict(axes)
    variables = {
        name: (
            [*dims, *_own_dimensions(name, x[0])],
            x.reshape(*shape, *x.shape[1:]),
        )
        for name, x in (kept | extra).items()
    }
    failures = _failures(points, code, alone)
    # In one piece of text: netCDF files of the classic kind hold no lists of it.
    return xarray.Dataset(variables, coordinates, {"failures": "\n".join(failures)})


def _measured(found: Any, taken: Iterable[str]) -> dict[str, Array]:
    """What a member's `measure` returns, if the table has a place for it."""
    if not isinstance(found, Mapping):
        fail("measure", "return numbers or arrays by name", f"it returns {described(found)}")
    names = dict.fromkeys([*_OWN, *taken], "which the table has for something else")
    measured = {}
    for name, value in found.items():
        if name in names:
            fail("measure", "return names of its own", f"it returns {name!r}, {names[name]}")
        _netcdf_name("measure", "return", name)
        names[name] = "which it returns for something else"
        try:
            measured[name] = jnp.asarray(value)
        except (TypeError, ValueError):
            how = f"{name!r} is {described(value)}"
            fail("measure", "return numbers or arrays by name", how)
        if jnp.iscomplexobj(measured[name]):
            fail("measure", "return real numbers", f"{name!r} is complex")
        if measured[name].size == 0:
            fail("measure", "return at least one number by each name", f"{name!r} is empty")
    for name, value in measured.items():
        for made in _own_dimensions(name, value):
            if made in names:
                how = f"{made!r} is a dimension of {name!r} and something else"
                fail("measure", "return names of its own", how)
    return measured


def _own_dimensions(name: str, values: Any) -> list[str]:
    """Names of the dimensions of what one member measures."""
    return [f"{name}_{k}" for k in range(values.ndim)]


def _netcdf_name(argument: str, does: str, name: Any) -> None:
    """Refuse what cannot be a name in a netCDF file, of the classic kind too."""
    if not isinstance(name, str):
        fail(argument, f"{does} names that are text", f"one of them is {described(name)}")
    first, rest = name[:1], name.isprintable() and not set("/'") & set(name) and name[-1:] != " "
    begun = first == "_" or first.isalnum() or first > "\x7f"
    if not (begun and rest) or name in _RESERVED or unicodedata.normalize("NFC", name) != name:
        fail(argument, f"{does} names that a netCDF file can hold", f"one of them is {name!r}")


def _built(build: Build, point: Mapping[str, Array]) -> tuple[Scene, State]:
    made = build(**point)
    if not (isinstance(made, tuple) and len(made) == 2 and isinstance(made[0], Scene)):
        fail("build", "return a scene and a state", f"it returns {described(made)}")
    return made


def _together(build: Build, points: Mapping[str, np.ndarray]) -> int:
    """How many members with equal steps a CPU follows side by side: as many as LAPACK takes in one call,
    while their tables of pairs stay in the fast cache.
    """

    def multipliers(point: dict[str, Array]) -> tuple[Array, Array]:
        scene, state = _built(build, point)
        check(scene, state, single_precision=True)
        return evaluate(0.0, state, scene).multipliers, state.position

    point = {n: jax.ShapeDtypeStruct((), v.dtype) for n, v in points.items()}
    rows, position = jax.eval_shape(multipliers, point)
    return max(1, min(_PAIRS // len(position) ** 2, at_once(rows.size**3 // 3)))


def _grid(
    axes: Mapping[str, Any], paired: bool
) -> tuple[dict[str, np.ndarray], tuple[int, ...], list[str]]:
    """Values of all members by name; shape and names of the table's dimensions."""
    if not axes:
        fail("axes", "name at least one parameter", "it is empty")
    values = {name: np.asarray(v, float) for name, v in axes.items()}
    for name, v in values.items():
        if name in _OWN:
            fail(
                "axes",
                f"not hold {name!r}, a name that the table has for something else",
                "it does",
            )
        _netcdf_name("axes", "hold", name)
        if paired and " " in name:  # such a coordinate would come back as something measured
            fail("axes", "hold names without spaces to be paired", f"one of them is {name!r}")
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


def _failures(
    points: dict[str, np.ndarray], code: np.ndarray, alone: Callable[[dict[str, Array]], str]
) -> list[str]:
    """A sentence for each member that failed."""
    sentences = []
    for row in np.flatnonzero(code != Outcome.FINE):
        who = ", ".join(f"{name} = {v[row]:g}" for name, v in points.items())
        if code[row] == Outcome.NOT_RUN:
            why = meaning(int(code[row]))
        elif code[row] == Outcome.NOT_MEASURED:
            why = f"{meaning(int(code[row]))} (code {code[row]})"
        else:
            why = f"broke down (code {code[row]})"
            if len(sentences) < _EXPLAINED:
                point = {name: jnp.asarray(v[row]) for name, v in points.items()}
                why += f": {alone(point)}"
        sentences.append(f"{who}: {why}")
    return sentences
