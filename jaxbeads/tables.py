"""Tables of a run, to be passed on: a labelled `xarray.Dataset`, or columns over time as CSV."""

import csv
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ._checks import described, fail, kind, known, shape
from .chain import Chain
from .state import State
from .storage import write_whole

if TYPE_CHECKING:
    import xarray

_TIME = "time"
_MEANINGS = {
    _TIME: ("time", "time"),
    "position": ("centre of each bead", "length"),
    "director": ("unit vector fixed to each bead", "1"),
    "frame": ("unit vector normal to the fibre and fixed to the material of each bead", "1"),
    "residual": ("constraint residual", "1"),
    "bond_length_error": ("largest relative error of a bond length", "1"),
    "steps": ("attempted steps of the solver", "1"),
    "code": ("0 where all went well, see jaxbeads.Outcome", "1"),
    "wall_s": ("wall time of the run in seconds", "time"),
    "compile_s": ("seconds of it for compiling", "time"),
    "fibre_of_bead": ("number of the fibre that each bead belongs to", "1"),
    "radius": ("radius of each bead", "length"),
    "arclength": ("arclength of each bead's centre along its fibre", "length"),
}
"""What each variable is, and its dimension: units are those of the scene."""


def labelled(
    ts: Any, states: State, values: Mapping[str, Any], chain: Chain | None, **attributes: str | None
) -> "xarray.Dataset":
    """The table of one trajectory; see `Solution.to_xarray`.

    **Arguments**: times; states; other `values` by name, at each time or of the whole run; the chain.
    """
    import xarray

    if not known((ts, states, values)):
        fail("solution", "hold numbers", "they are traced")
    if np.ndim(states.position) != 3:
        must = "be one run (take one of a batch by `jax.tree.map(lambda x: x[k], batch)`)"
        fail("solution", must, f"its positions have shape {np.shape(states.position)}")
    beads, dim = np.shape(states.position)[1:]
    dimensions: dict[str, list[str]] = {
        "position": ["bead", "component"],
        "director": ["bead", "component"],
        "frame": ["bead", "component"],
    }
    arrays = {name: getattr(states, name) for name in dimensions} | dict(values)
    variables = {
        name: _variable(name, [_TIME, *dimensions.get(name, [])], value)
        for name, value in arrays.items()
        if value is not None
    }
    for k, own in enumerate(states.own or ()):
        if own is not None:
            name = f"own_{k}"
            along = [_TIME, *(f"{name}_{axis}" for axis in range(np.ndim(own) - 1))]
            about = {"long_name": f"numbers that force {k} of the scene owns"}
            variables[name] = (along, np.asarray(own), about)
    coordinates: dict[str, Any] = {
        _TIME: _variable(_TIME, [_TIME], ts),
        "component": list("xyz"[:dim]),
    }
    if chain is not None:
        kind("chain", chain, Chain)
        if chain.beads != beads:
            fail("chain", f"have the solution's {beads} beads", f"it has {chain.beads}")
        of_beads = {
            "fibre_of_bead": chain.fibre_of_bead,
            "radius": chain.radii,
            "arclength": chain.arclength,
        }
        coordinates |= {name: _variable(name, ["bead"], x) for name, x in of_beads.items()}
    given = {name: text for name, text in attributes.items() if text is not None}
    return xarray.Dataset(variables, coordinates, given)


def _variable(name: str, dimensions: list[str], value: Any) -> tuple[list[str], Any, dict]:
    """With its meaning; a single number has no dimensions."""
    meaning, dimension = _MEANINGS[name]
    values = np.asarray(value)
    about = {"long_name": meaning, "dimension": dimension}
    return dimensions[: values.ndim], values, about


def to_csv(path: str | Path, ts: Any, columns: Mapping[str, Any]) -> Path:
    """Write what was measured over time as text, a row for each time.

    **Arguments**

    - `path`: the file; an older one is replaced in one piece.
    - `ts`: times, the first column, whose name is `time` [time].
    - `columns`: real numbers by name, `(times,)`, or arrays, `(times, ...)`: these take a column for
      each entry, named by its place, as `centre_0`, `centre_1`.

    Numbers have all their digits: what is read is what was written, bit for bit. Nothing is left out:
    what is not finite is written as `nan`, `inf` or `-inf`, no and yes as 0 and 1.
    **Returns** the path. **Raises** `ValueError` for columns that do not fit the times, for names that
    are no text or there twice, and if the file cannot be written.

    >>> import jaxbeads as jb
    >>> path = jb.to_csv("fall.csv", [0.0, 0.5], {"centre": [[0.0, 2.0], [0.0, 1.5]]})
    >>> print(path.read_text(), end="")
    time,centre_0,centre_1
    0.0,0.0,2.0
    0.5,0.0,1.5
    """
    path = Path(path)
    times = _numbers("ts", ts)
    if times.ndim != 1:
        fail("ts", "be a sequence of times", f"it has shape {times.shape}")
    if not isinstance(columns, Mapping):
        fail("columns", "hold numbers over time by name", f"it is {described(columns)}")
    table = {_TIME: times.tolist()}
    for name, value in columns.items():
        if not isinstance(name, str) or not name or not name.isprintable():
            fail("columns", "hold names that are printable text", f"one of them is {name!r}")
        for header, column in _columns(name, value, len(times)):
            if header in table:
                fail("columns", "name each column once", f"{header!r} is there twice")
            table[header] = column
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    writer.writerows(zip(*table.values(), strict=True))
    write_whole(path, text.getvalue().encode())
    return path


def _columns(name: str, value: Any, times: int) -> Iterator[tuple[str, list[float]]]:
    values = _numbers(f"columns[{name!r}]", value)
    shape(f"columns[{name!r}]", values, (times, *values.shape[1:]))
    if values.size == 0 and times:
        fail(f"columns[{name!r}]", "hold at least one number", "it is empty")
    for place in np.ndindex(values.shape[1:]):
        yield "_".join([name, *map(str, place)]), values[(slice(None), *place)].tolist()


def _numbers(name: str, value: Any) -> np.ndarray:
    """Real numbers; yes and no become 1 and 0."""
    try:
        values = np.asarray(value)
    except (TypeError, ValueError):  # traced, or with rows of unequal lengths
        fail(name, "be an array of numbers", f"it is {described(value)}")
    values = values.astype(int) if values.dtype == bool else values
    if values.dtype.kind not in "iuf":
        fail(name, "hold real numbers", f"it holds {values.dtype}")
    return values
