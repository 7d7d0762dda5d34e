"""Results to be passed on: what ParaView, xarray and readers of CSV find is what the solution holds."""

import csv
import re
import sys
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
import xarray
from cases import bent, jointed

import jaxbeads as jb
from jaxbeads import Chain, NoSlipWall, Scene, Solution, State, dynamics
from jaxbeads.constraint import Gears, Joint
from jaxbeads.flow import Shear
from jaxbeads.force import Bending, Weight

TIMES = np.array([0.0, 0.1, 1.0 / 3.0])
UNEQUAL = np.array([1.0, 0.8, 0.6, 0.9, 1.1, 1.0, 0.5])


@pytest.fixture
def unchecked(monkeypatch):
    """Users have no shape checks; the sentences are tested as they see them."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def moved(state, ts=TIMES, code=0):
    """A solution in which a state is carried along x."""
    along = jnp.eye(state.position.shape[1])[:1]
    states = [State(state.position + t * along, state.director) for t in ts]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *states)
    return Solution(jnp.asarray(ts), stacked, jnp.asarray(7), jnp.asarray(code))


def planar():
    chain = Chain(UNEQUAL, (4, 2, 1))
    centre = np.array([[0.0, 0.0], [0.0, 8.0], [9.0, 0.0]])
    forces = [Weight([0.1, -0.4]), Bending(3.0)]
    scene = Scene(chain, 1.3, constraints=[Gears()], forces=forces)
    return scene, moved(bent(chain, 2, centre=centre))


def spatial():
    chain = Chain(1.0, (3, 2), gap=0.1)
    centre = np.array([[0.0, 0.0, 0.0], [0.0, 8.0, 0.0]])
    forces = [Weight([0.1, -0.4, 0.3])]
    return Scene(chain, 1.3, constraints=[Joint()], forces=forces), moved(
        jointed(chain, 3, centre=centre)
    )


def single():
    scene = Scene(Chain(2.0, 1), 1.3, forces=[Weight([0.0, 0.0, -5.0])])
    return scene, moved(State([[1.0, 2.0, 3.0]]))


def arrays_of(data):
    """Arrays of a VTK data set by name, and its time."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    found = data.GetPointData()
    names = [found.GetArrayName(k) for k in range(found.GetNumberOfArrays())]
    time = data.GetFieldData().GetArray("TimeValue")
    values = {name: vtk_to_numpy(found.GetArray(name)) for name in names}
    return values, time and time.GetValue(0)


def opened(path):
    """What VTK's own reader finds in a file."""
    io = pytest.importorskip("vtkmodules.vtkIOXML")
    kind = {".vtp": io.vtkXMLPolyDataReader, ".vti": io.vtkXMLImageDataReader}[path.suffix]
    reader = kind()
    reader.SetFileName(str(path))
    reader.Update()
    return reader.GetOutput()


def collection(path):
    """Times and files of a collection."""
    sets = ElementTree.parse(path).getroot().findall("Collection/DataSet")
    return [(float(s.attrib["timestep"]), path.parent / s.attrib["file"]) for s in sets]


@pytest.mark.parametrize("case", [planar, spatial, single])
def test_paraview_shows_the_solution(case, tmp_path):
    pytest.importorskip("vtkmodules")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    scene, solution = case()
    assert jb.to_paraview(solution, scene, tmp_path / "run.pvd") == tmp_path / "run.pvd"
    steps, chain = collection(tmp_path / "run.pvd"), scene.chain
    assert [t for t, _ in steps] == TIMES.tolist()
    assert sorted(path for _, path in steps) == sorted((tmp_path / "run").iterdir())
    for k, (t, path) in enumerate(steps):
        data = opened(path)
        arrays, time = arrays_of(data)
        position = np.asarray(solution.states.position[k])
        points = vtk_to_numpy(data.GetPoints().GetData())
        dim = position.shape[1]
        assert time == t and np.array_equal(points[:, :dim], position)
        assert not points[:, dim:].any()
        assert np.array_equal(arrays["radius"], chain.radii)
        assert arrays["bead"].tolist() == list(range(chain.beads))
        assert arrays["fibre"].tolist() == chain.fibre_of_bead.tolist()
        lines = [data.GetCell(chain.beads + c) for c in range(data.GetNumberOfLines())]
        through = [[c.GetPointId(i) for i in range(c.GetNumberOfPoints())] for c in lines]
        fibres = np.split(np.arange(chain.beads), np.cumsum(chain.fibres)[:-1])
        assert through == [f.tolist() for f in fibres if len(f) > 1]
        assert data.GetNumberOfVerts() == chain.beads
        # Forces within the chain cancel, what is left is the weight.
        weight = np.zeros(3)
        weight[:dim] = chain.beads * np.asarray(scene.forces[0].force)
        assert np.allclose(arrays["force"].sum(axis=0), weight, rtol=0, atol=1e-12)
        state = jax.tree.map(lambda x, k=k: x[k], solution.states)
        motion = dynamics.motion(t, state, scene)
        assert np.allclose(arrays["velocity"][:, :dim], motion.velocity, rtol=0, atol=1e-13)
        if motion.spin is None:
            assert "spin" not in arrays and "torque" not in arrays
        else:
            turns = motion.spin.shape[1]
            assert np.allclose(arrays["spin"][:, 3 - turns :], motion.spin, rtol=0, atol=1e-13)
            assert not arrays["spin"][:, : 3 - turns].any()
        assert ("director" in arrays) == (state.director is not None)
        if state.director is not None:
            assert np.array_equal(arrays["director"], state.director)
    if case is single:  # Stokes
        assert np.allclose(arrays["velocity"], [[0, 0, -5 / (6 * np.pi * 1.3 * 2)]], rtol=1e-13)


def test_paraview_sees_sizes_and_curvature(tmp_path):
    # Beads on an arc, shown by the filters that ParaView has: the tube is as wide as the beads.
    pytest.importorskip("vtkmodules")
    from vtkmodules.vtkFiltersCore import vtkGlyph3D, vtkTubeFilter
    from vtkmodules.vtkFiltersSources import vtkSphereSource

    chain, turn = Chain(0.5, 5), 0.2
    angle = turn * np.arange(4)
    state = State(jb.from_tangents(chain, np.stack([np.cos(angle), np.sin(angle)], axis=1)))
    scene = Scene(chain, 1.0, forces=[Weight([0.0, -1.0])])
    jb.to_paraview(moved(state, TIMES[:1]), scene, tmp_path / "arc.pvd")
    data = opened(tmp_path / "arc" / "beads_0000.vtp")
    expected = [0.0, *[np.sin(turn)] * 3, 0.0]  # |e x e'| / l
    assert np.allclose(arrays_of(data)[0]["curvature"], expected, rtol=0, atol=1e-13)
    data.GetPointData().SetActiveScalars("radius")
    tube = vtkTubeFilter()
    tube.SetInputData(data)
    tube.SetVaryRadiusToVaryRadiusByAbsoluteScalar()
    tube.SetNumberOfSides(16)
    tube.Update()
    ball = vtkSphereSource()  # of radius 0.5
    ball.SetThetaResolution(16)
    ball.SetPhiResolution(17)
    glyph = vtkGlyph3D()
    glyph.SetInputData(data)
    glyph.SetSourceConnection(ball.GetOutputPort())
    glyph.SetScaleModeToScaleByScalar()
    glyph.SetScaleFactor(2.0)
    glyph.Update()
    for shown in (tube.GetOutput(), glyph.GetOutput()):
        assert np.allclose(shown.GetBounds()[4:], [-0.5, 0.5], atol=1e-6)
    low, high = np.asarray(state.position).min(axis=0) - 0.5, np.asarray(state.position).max(axis=0)
    bounds = glyph.GetOutput().GetBounds()
    assert np.allclose(bounds[:4], [low[0], high[0] + 0.5, low[1], high[1] + 0.5], atol=0.02)


def test_paraview_replaces_what_was_there(tmp_path):
    pytest.importorskip("vtkmodules")
    scene, solution = single()
    path = tmp_path / "a & b.pvd"
    jb.to_paraview(solution, scene, path)
    kept = tmp_path / "a & b" / "beads_of_mine.vtp"
    kept.write_text("kept")
    jb.to_paraview(jax.tree.map(lambda x: x[:2] if x.ndim else x, solution), scene, path)
    steps = collection(path)
    assert len(steps) == 2 and all(opened(p).GetNumberOfPoints() == 1 for _, p in steps)
    names = sorted(p.name for p in kept.parent.iterdir())
    assert names == ["beads_0000.vtp", "beads_0001.vtp", kept.name]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a & b", "a & b.pvd"]


def test_paraview_of_a_run_that_broke_down_in_single_precision(tmp_path):
    pytest.importorskip("vtkmodules")
    scene, solution = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), single())
    states = jax.tree.map(lambda x: x.at[2].set(jnp.nan), solution.states)
    broken = Solution(solution.ts, states, jnp.asarray(7), jnp.asarray(1))
    with pytest.warns(UserWarning, match=r"1 of 3 states, from t = 0.333333 on, are not finite"):
        jb.to_paraview(broken, scene, tmp_path / "run.pvd")
    steps = collection(tmp_path / "run.pvd")
    assert [np.float32(t) for t, _ in steps] == solution.ts[:2].tolist()
    arrays, _ = arrays_of(opened(steps[1][1]))
    assert arrays["velocity"].dtype == np.float32


def test_paraview_refuses(tmp_path, monkeypatch, unchecked):
    scene, solution = single()
    other, _ = spatial()
    nothing = jax.tree.map(lambda x: x * jnp.nan if x.ndim == 3 else x, solution)
    several = jax.tree.map(lambda x: x[None], solution)
    (tmp_path / "taken").write_text("a file")
    pytest.importorskip("vtkmodules")
    for what, of, name, says in [
        (solution, scene, "run.vtp", r"`path` must end in \.pvd"),
        (solution, scene, "no/run.pvd", "`path` must be a file that can be written"),
        (solution, scene, "taken.pvd", "`path` must be a file that can be written"),
        (solution.states, scene, "run.pvd", "`solution` must be a Solution object"),
        (solution, scene.chain, "run.pvd", "`scene` must be a Scene object"),
        (solution, other, "run.pvd", "`state` must hold the chain's 5 beads, but it holds 1"),
        (nothing, scene, "run.pvd", "`solution` must hold a state that is finite"),
        (several, scene, "run.pvd", "`solution` must be one run"),
    ]:
        with pytest.raises(ValueError, match=says):
            jb.to_paraview(what, of, tmp_path / name)
    monkeypatch.setitem(sys.modules, "vtkmodules", None)
    with pytest.raises(ValueError, match="need the package vtk, which is not installed: install"):
        jb.to_paraview(solution, scene, tmp_path / "run.pvd")
    assert [p.name for p in tmp_path.iterdir()] == ["taken"]


def test_flow_on_a_grid(tmp_path):
    # In a shear along a wall: what VTK finds at a node is the velocity there.
    pytest.importorskip("vtkmodules")
    scene = Scene(
        Chain(1.0, 1),
        1.0,
        forces=[Weight([0.0, -1.0])],
        flow=Shear(0.5),
        domain=NoSlipWall([0.0, 0.0], [0.0, 1.0]),
    )
    field = jb.flow_field(0.25, State([[0.0, 3.0]]), scene)
    bounds, shape = [(-4.0, 4.0), (0.0, 6.0), (-1.0, 2.0)], (5, 7, 4)
    path = jb.flow_to_paraview(field, tmp_path / "flow.vti", bounds, shape)
    data = opened(path)
    arrays, time = arrays_of(data)
    assert time == 0.25 and data.GetDimensions() == shape
    assert np.allclose(data.GetBounds(), np.ravel(bounds))
    nodes = np.array([data.GetPoint(i) for i in range(data.GetNumberOfPoints())])
    assert np.allclose(arrays["velocity"], field(nodes), rtol=0, atol=1e-13)
    shear = 0.5 * nodes[:, 1:2] * np.eye(3)[0]
    assert np.allclose(arrays["ambient"], shear, rtol=0, atol=1e-13)
    at_wall = nodes[:, 1] == 0
    assert at_wall.any() and np.abs(arrays["velocity"][at_wall]).max() < 1e-13
    in_bead = np.linalg.norm(nodes - [0, 3, 0], axis=1) == 0
    assert np.abs(arrays["velocity"] - shear)[in_bead].max() > 0.01  # it falls
    # Two coordinates of a planar scene: the plane z = 0.
    path = jb.flow_to_paraview(field, tmp_path / "flow.vti", bounds[:2], (20, 7))
    data = opened(path)
    assert data.GetDimensions() == (20, 7, 1) and data.GetBounds()[4:] == (0.0, 0.0)
    nodes = np.array([data.GetPoint(i) for i in range(data.GetNumberOfPoints())])
    assert np.allclose(arrays_of(data)[0]["velocity"], field(nodes), rtol=0, atol=1e-13)


GRIDS = {
    "too few": ([(0, 1), (0, 1)], (2, 2), "`bounds` must hold a pair for each of 3 coord"),
    "shape": ([(0, 1)] * 3, (2, 2), "`shape` must hold 3 numbers"),
    "half": ([(0, 1)] * 3, (2, 2, 2.5), r"`shape\[2\]` must be a whole number"),
    "none": ([(0, 1)] * 3, (2, 0, 2), r"`shape\[1\]` must be at least 1"),
    "backwards": ([(0, 1), (1, 0), (0, 1)], (2, 2, 2), r"`bounds\[1\]` must increase"),
    "thick": ([(0, 1)] * 3, (2, 2, 1), "twice where there is one point, but it is 0 and 1 for 1"),
    "a number": ([(0, 1)] * 3, 8, r"`shape` must hold 3 numbers.*, but it has shape \(\)"),
    "uneven": ([(0, 1), (0,)], (2, 2), "`bounds` must hold a pair .*, but it is a list"),
    "nan": ([(0, np.nan)] * 3, (2, 2, 2), "`bounds` must be finite"),
}


@pytest.mark.parametrize("bounds, shape, says", GRIDS.values(), ids=GRIDS)
def test_a_grid_that_is_none(bounds, shape, says, tmp_path, unchecked):
    scene, solution = single()
    field = jb.average_flow_field(solution, scene)
    with pytest.raises(ValueError, match=says):
        jb.flow_to_paraview(field, tmp_path / "flow.vti", bounds, shape)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("case", [planar, spatial, single])
def test_table_goes_through_netcdf(case, tmp_path):
    scene, solution = case()
    table = solution.to_xarray(scene.chain)
    dim = solution.states.position.shape[2]
    assert table.position.dims == ("time", "bead", "component")
    assert np.array_equal(table.position, solution.states.position)
    last = table.position.isel(time=-1).sel(component="xyz"[dim - 1])
    assert np.array_equal(last, solution.final.position[:, -1])
    assert np.array_equal(table.time, TIMES) and int(table.steps) == 7 and int(table.code) == 0
    assert np.array_equal(table.radius, scene.chain.radii) and table.radius.dims == ("bead",)
    mean = table.position.groupby("fibre_of_bead").mean()
    assert np.allclose(mean[0], jax.vmap(scene.chain.centres)(solution.states.position)[0])
    assert ("director" in table) == (solution.states.director is not None)
    assert table.attrs["status"] == "finished" and table.position.attrs["dimension"] == "length"
    assert all(v.attrs["long_name"] for name, v in table.variables.items() if name != "component")
    table.to_netcdf(tmp_path / "run.nc")
    with xarray.open_dataset(tmp_path / "run.nc") as stored:
        xarray.testing.assert_identical(stored.load(), table)


def test_table_of_all_that_a_run_has(tmp_path, unchecked):
    # Frames, numbers that forces own, what is not finite; single precision stays single.
    frame = jnp.asarray([[[0.0, 1.0, 0.0]] * 2] * 3, jnp.float32)
    position = jnp.asarray(np.arange(18.0).reshape(3, 2, 3), jnp.float32).at[2].set(jnp.nan)
    blank = State(np.zeros((2, 3)), None, np.eye(3)[:2], (None, jnp.zeros(4)))
    own = jnp.arange(12.0).reshape(3, 4)
    states = jax.tree.unflatten(jax.tree.structure(blank), [position, frame, own])
    error = jnp.array([0.0, 1e-9, jnp.nan])
    numbers = jnp.asarray(7), jnp.asarray(2)
    solution = Solution(jnp.arange(3.0), states, *numbers, error, error, 1.5, 0.5)
    table = solution.to_xarray()
    assert table.frame.dims == ("time", "bead", "component")
    assert table.own_1.dims == ("time", "own_1_0") and "own_0" not in table
    assert table.position.dtype == np.float32 and "radius" not in table.coords
    assert table.attrs["status"] == "broken down" and float(table.wall_s) == 1.5
    table.to_netcdf(tmp_path / "run.nc")
    with xarray.open_dataset(tmp_path / "run.nc") as stored:
        xarray.testing.assert_identical(stored.load(), table)
        assert stored.position.dtype == np.float32
    with pytest.raises(ValueError, match="`chain` must have the solution's 2 beads, but it has 3"):
        solution.to_xarray(Chain(1.0, 3))
    with pytest.raises(ValueError, match="`chain` must be a Chain object, but it is a Scene"):
        solution.to_xarray(Scene(Chain(1.0, 2), 1.0))
    with pytest.raises(ValueError, match="`solution` must be one run"):
        jax.tree.map(lambda x: x[None], solution).to_xarray()
    with pytest.raises(ValueError, match="`solution` must hold numbers, but they are traced"):
        jax.eval_shape(lambda s: s.to_xarray().time.values, solution)


def rows(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.reader(file))


def test_csv_is_exact(tmp_path):
    rng = np.random.default_rng(0)
    ts, path = rng.uniform(size=5).cumsum(), tmp_path / "run.csv"
    columns = {
        "deflection A/L, of all": jnp.asarray(
            rng.normal(size=5) * 10.0 ** np.arange(-300, 300, 120)
        ),
        'the "centre"': rng.normal(size=(5, 2)),
        "single": np.array([0.1, np.nan, np.inf, -np.inf, 1e-40], np.float32),
        "é": [True, False, True, False, False],
        "count": np.array([2**62 + 1, 0, 1, 2, 3]),
        "tensor": rng.normal(size=(5, 2, 1)),
    }
    path.write_text("older")
    assert jb.to_csv(path, ts, columns) == path
    header, *lines = rows(path)
    assert header == [
        "time",
        "deflection A/L, of all",
        'the "centre"_0',
        'the "centre"_1',
        "single",
        "é",
        "count",
        "tensor_0_0",
        "tensor_1_0",
    ]
    found = dict(zip(header, zip(*lines, strict=True), strict=True))
    read = {name: np.array(column, float) for name, column in found.items()}
    assert np.array_equal(read["time"], ts)
    assert np.array_equal(read["deflection A/L, of all"], columns["deflection A/L, of all"])
    assert np.array_equal(read['the "centre"_1'], columns['the "centre"'][:, 1])
    assert np.array_equal(read["tensor_1_0"], columns["tensor"][:, 1, 0])
    assert np.array_equal(read["single"].astype(np.float32), columns["single"], equal_nan=True)
    assert found["é"] == ("1", "0", "1", "0", "0") and int(found["count"][0]) == 2**62 + 1
    # One time, and no columns.
    assert rows(jb.to_csv(path, [0.5], {})) == [["time"], ["0.5"]]


REFUSED = {
    "length": (
        {"a": [1.0, 2.0]},
        r"`columns\['a'\]` must have shape \(3,\), but it has shape \(2,",
    ),
    "number": ({"a": 1.0}, r"`columns\['a'\]` must have shape \(3,\)"),
    "text": ({"a": ["x", "y", "z"]}, "must hold real numbers"),
    "complex": ({"a": np.zeros(3, complex)}, "must hold real numbers, but it holds complex128"),
    "ragged": ({"a": [[1.0], [1.0, 2.0], [1.0]]}, "must be an array of numbers, but it is a list"),
    "empty": ({"a": np.zeros((3, 0))}, "must hold at least one number"),
    "time": ({"time": np.zeros(3)}, "name each column once, but 'time' is there twice"),
    "twice": ({"a": np.zeros((3, 2)), "a_1": np.zeros(3)}, "but 'a_1' is there twice"),
    "name": ({1: np.zeros(3)}, "hold names that are printable text, but one of them is 1"),
    "line": ({"a\nb": np.zeros(3)}, "hold names that are printable text"),
    "array": (np.zeros((3, 2)), "`columns` must hold numbers over time by name"),
}


@pytest.mark.parametrize("columns, says", REFUSED.values(), ids=REFUSED)
def test_csv_refuses(columns, says, tmp_path, unchecked):
    path = tmp_path / "run.csv"
    path.write_text("older")
    with pytest.raises(ValueError, match=says):
        jb.to_csv(path, TIMES, columns)
    assert path.read_text() == "older" and len(list(tmp_path.iterdir())) == 1


def test_csv_that_cannot_be_written(tmp_path):
    for path in (tmp_path / "no" / "run.csv", tmp_path):
        with pytest.raises(ValueError, match=re.escape(f"be written, but {path} is not: ")):
            jb.to_csv(path, TIMES, {})
    assert not list(tmp_path.iterdir())
