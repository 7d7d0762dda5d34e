"""Files for ParaView, by VTK (the extra `paraview`): beads and fibres over time, the flow on a grid.

Everything is in space: planar scenes lie in the plane z = 0, and turn about z.
"""

import importlib.util
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._checks import described, fail, finite, kind, known, whole
from ._typing import with_all_digits
from .chain import Chain
from .dynamics import evaluate
from .fluid import AverageFlowField, FlowField
from .loads import handed_on
from .observables import curvature
from .scene import Scene, check
from .solution import Solution
from .state import Load, Motion, State
from .storage import write_whole

_STATES = re.compile(r"beads_\d+\.vtp")


def check_paraview() -> None:
    """Refuse to write such files where VTK is not installed. **Raises** `ValueError`, one sentence."""
    if importlib.util.find_spec("vtkmodules") is None:
        raise ValueError(
            "Files for ParaView need the package vtk, which is not installed: install the extra "
            "`paraview`."
        )


def to_paraview(solution: Solution, scene: Scene, path: str | Path) -> Path:
    """Write a trajectory for ParaView: a collection `NAME.pvd`, to be opened, and in the folder `NAME`
    beside it one file `beads_0000.vtp`, ... for each saved time.

    Each holds the beads as points, and fibres of two beads or more as lines through them. Arrays of the
    points: `radius` [length]; `bead` and `fibre`, their numbers; `velocity` [length/time] and `spin`
    [1/time] at that instant; `force` [force] and `torque` [force length], the sums of those of the
    scene's forces and constraints on each bead, which it hands on to the fluid; `director`; `frame`;
    `curvature` [1/length], signed in the plane, 0 at ends. What a scene does not have is not there.

    To see it to scale: the filter Glyph with spheres, scale array `radius`, scale factor 2, all points;
    or the filter Tube, scalars `radius`, vary radius by absolute scalar.

    **Arguments**: a solution, finished or not; its scene; where the collection will be. Older files of
    that name are replaced; while they are, no collection is there. Instants are solved again, one for
    each time. States that are not finite are left out, with a warning.
    **Returns** the path. **Raises** `ValueError` if it does not end in .pvd or cannot be written, for a
    scene that does not fit, for a batch, and where VTK is not installed.

    >>> import jaxbeads as jb
    >>> from jaxbeads.force import Weight
    >>> chain = jb.Chain(radius=1.0, fibres=1)
    >>> scene = jb.Scene(chain, viscosity=1.0, forces=[Weight([0.0, -1.0])])
    >>> run = jb.rollout(scene, jb.State([[0.0, 0.0]]), [0.0, 1.0], substeps=1)
    >>> print(jb.to_paraview(run, scene, "run.pvd"))
    run.pvd
    """
    path = _path(path, ".pvd")
    kind("solution", solution, Solution)
    kind("scene", scene, Scene)
    ts, states = _finite_states(solution)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # which the run has said
        check(scene, _at(states, 0), single_precision=True)
    check_paraview()
    folder = path.with_suffix("")
    try:
        folder.mkdir(exist_ok=True)
        path.unlink(missing_ok=True)
    except OSError as error:
        fail("path", "be a file that can be written", f"{path} is not: {error.strerror}")
    root = ElementTree.Element(
        "VTKFile", type="Collection", version="0.1", byte_order="LittleEndian"
    )
    collection = ElementTree.SubElement(root, "Collection")
    names = [f"beads_{k:0{max(4, len(str(len(ts) - 1)))}}.vtp" for k in range(len(ts))]
    for k, (t, name) in enumerate(zip(ts, names, strict=True)):
        write_whole(folder / name, _beads(t, _at(states, k), scene))
        about = {"timestep": repr(t), "part": "0", "file": f"{folder.name}/{name}"}
        ElementTree.SubElement(collection, "DataSet", about)
    for older in folder.iterdir():  # of a longer run
        if _STATES.fullmatch(older.name) and older.name not in names:
            older.unlink()
    ElementTree.indent(root)
    write_whole(path, ElementTree.tostring(root, "utf-8", xml_declaration=True))
    return path


def flow_to_paraview(
    field: FlowField | AverageFlowField, path: str | Path, bounds: Any, shape: Sequence[int]
) -> Path:
    """Write the flow on a regular grid for ParaView, as a file `NAME.vti`.

    Arrays: `velocity` of the fluid, which in a bead is the bead's and beyond a wall 0; beside an ambient
    flow also `ambient`, what it would be without the beads [length/time].

    **Arguments**

    - `field`: from `flow_field` or `average_flow_field` (without `ambient`); co-moving if the field is.
    - `path`: the file; an older one is replaced in one piece.
    - `bounds`: lowest and highest value of each coordinate, `((x, x), (y, y), (z, z))` [length]. In a
      planar scene two pairs mean the plane z = 0.
    - `shape`: number of points along each axis, both ends included.

    **Returns** the path. **Raises** `ValueError` if it does not end in .vti or cannot be written, for a
    grid that is none, and where VTK is not installed.

    >>> import jaxbeads as jb
    >>> from jaxbeads.force import Weight
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[Weight([0.0, -1.0])])
    >>> field = jb.flow_field(0.0, jb.State([[0.0, 0.0]]), scene)
    >>> print(jb.flow_to_paraview(field, "flow.vti", ((-3, 3), (-3, 3)), (5, 5)))
    flow.vti
    """
    path = _path(path, ".vti")
    if not isinstance(field, (FlowField, AverageFlowField)):
        fail("field", "be a FlowField or an AverageFlowField", f"it is {described(field)}")
    if not known(field):
        fail("field", "hold numbers", "they are traced")
    low, high, numbers = _grid(_dimensions(field), bounds, shape)
    check_paraview()
    axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, numbers, strict=True)]
    # The first coordinate runs fastest.
    points = np.stack(np.meshgrid(*axes[::-1], indexing="ij")[::-1], axis=-1).reshape(-1, 3)
    arrays, t = {"velocity": np.asarray(field(points))}, None
    if isinstance(field, FlowField):
        t = float(field.t)
        if field.flow is not None:
            arrays["ambient"] = np.asarray(field.ambient(points))
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    grid = vtkImageData()
    grid.SetDimensions(*numbers)
    grid.SetOrigin(*low)
    # One of zero would be no grid.
    steps = [
        (b - a) / (n - 1) if n > 1 else 1.0 for a, b, n in zip(low, high, numbers, strict=True)
    ]
    grid.SetSpacing(*steps)
    write_whole(path, _written(vtkXMLImageDataWriter(), grid, arrays, t))
    return path


def _path(path: str | Path, suffix: str) -> Path:
    path = Path(path)
    if path.suffix != suffix:
        fail("path", f"end in {suffix}", f"it is {path}")
    return path


def _finite_states(solution: Solution) -> tuple[list[float], State]:
    """Times and states that can be shown."""
    if not known(solution):
        fail("solution", "hold numbers", "they are traced")
    if np.ndim(solution.states.position) != 3:
        must = "be one run (take one of a batch by `jax.tree.map(lambda x: x[k], batch)`)"
        fail("solution", must, f"its positions have shape {np.shape(solution.states.position)}")
    fine = np.isfinite(np.asarray(solution.states.position)).all(axis=(1, 2))
    ts = np.asarray(solution.ts)
    if not fine.any():
        fail("solution", "hold a state that is finite", "it holds none")
    if not fine.all():
        out = f"{np.sum(~fine)} of {len(ts)} states, from t = {ts[~fine][0]:g} on,"
        warnings.warn(f"{out} are not finite and were left out.", stacklevel=3)
    states = jax.tree.map(lambda x: np.asarray(x)[fine], solution.states)
    return ts[fine].tolist(), states


def _at(states: State, k: int) -> State:
    return jax.tree.map(lambda x: jnp.asarray(x[k]), states)


def _dimensions(field: FlowField | AverageFlowField) -> int:
    if isinstance(field, FlowField):
        return field.dim
    return field.solution.states.position.shape[-1]


def _grid(
    dim: int, bounds: Any, shape: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
    """Lowest and highest corner and numbers of points of a grid in space."""
    must = f"hold a pair for each of {dim} coordinates"
    try:
        pairs = np.asarray(bounds, float)
    except (TypeError, ValueError):  # no numbers, or rows of unequal lengths
        fail("bounds", must, f"it is {described(bounds)}")
    if pairs.shape not in {(dim, 2), (3, 2)}:
        fail("bounds", must, f"it has shape {pairs.shape}")
    finite("bounds", pairs)
    if np.shape(shape) != (len(pairs),):
        must = f"hold {len(pairs)} numbers, as many as `bounds`"
        fail("shape", must, f"it has shape {np.shape(shape)}")
    for k, (number, (low, high)) in enumerate(zip(shape, pairs, strict=True)):
        whole(f"shape[{k}]", number, 1)
        if not (low < high if number > 1 else low == high):
            must = "increase, or be one value twice where there is one point"
            but = f"it is {low:g} and {high:g} for {number} point{'s' if number > 1 else ''}"
            fail(f"bounds[{k}]", must, but)
    pairs = np.pad(pairs, ((0, 3 - len(pairs)), (0, 0)))
    numbers = tuple(int(n) for n in (*shape, 1)[:3])
    return pairs[:, 0], pairs[:, 1], numbers


@with_all_digits
@eqx.filter_jit
def _instant(t: Array, state: State, scene: Scene) -> tuple[Motion, Load, Array]:
    found = evaluate(t, state, scene)
    bent = curvature(state.position, scene.chain)
    return found.motion, handed_on(t, state, scene, found), bent


def _beads(t: float, state: State, scene: Scene) -> bytes:
    """A file of the beads and fibres at one time."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkPolyData
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    chain, position = scene.chain, state.position
    moved, load, curved = _instant(jnp.asarray(t, position.dtype), state, scene)
    bent = np.zeros(chain.beads, position.dtype)
    bent[1:-1] = curved
    arrays = {
        "radius": np.asarray(chain.radii),
        "bead": np.arange(chain.beads, dtype=np.int32),
        "fibre": chain.fibre_of_bead.astype(np.int32),
        "velocity": _in_space(moved.velocity),
        "spin": _turning(moved.spin),
        "force": _in_space(load.force),
        "torque": _turning(load.torque),
        "director": _in_space(state.director),
        "frame": _in_space(state.frame),
        "curvature": bent,
    }
    points, shape = vtkPoints(), vtkPolyData()
    points.SetData(numpy_to_vtk(_in_space(position), deep=True))
    shape.SetPoints(points)
    shape.SetVerts(_cells(np.arange(chain.beads), [1] * chain.beads))
    long = [n for n in chain.fibres if n > 1]
    shape.SetLines(_cells(np.flatnonzero(_linked(chain)), long))
    return _written(vtkXMLPolyDataWriter(), shape, arrays, t)


def _linked(chain: Chain) -> np.ndarray:
    """Whether each bead has a neighbour in its fibre."""
    return np.array(chain.fibres)[chain.fibre_of_bead] > 1


def _cells(points: np.ndarray, sizes: list[int]) -> Any:
    """Cells of some sizes, from the indices of their points in turn."""
    from vtkmodules.util.numpy_support import numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonDataModel import vtkCellArray

    cells = vtkCellArray()
    ends, places = (np.asarray(x, np.int64) for x in (np.cumsum([0, *sizes]), points))
    cells.SetData(*(numpy_to_vtkIdTypeArray(x, deep=True) for x in (ends, places)))
    return cells


def _in_space(vectors: Any) -> Any:
    """Vectors with three components; `None` stays."""
    return None if vectors is None else np.pad(vectors, ((0, 0), (0, 3 - np.shape(vectors)[1])))


def _turning(spins: Any) -> Any:
    """As `_in_space`, for spins and torques: those of the plane are about its normal."""
    return None if spins is None else np.pad(spins, ((0, 0), (3 - np.shape(spins)[1], 0)))


def _written(writer: Any, data: Any, arrays: dict[str, Any], t: float | None) -> bytes:
    """What VTK writes of data with arrays at its points, and the time."""
    from vtkmodules.util.numpy_support import numpy_to_vtk

    for name, values in arrays.items():
        if values is not None:
            column = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
            column.SetName(name)
            data.GetPointData().AddArray(column)
    if t is not None:
        time = numpy_to_vtk(np.array([t]), deep=True)
        time.SetName("TimeValue")
        data.GetFieldData().AddArray(time)
    writer.SetInputData(data)
    writer.WriteToOutputStringOn()
    writer.Write()
    return writer.GetOutputString().encode()
