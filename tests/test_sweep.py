"""Sweeps: labels, the same numbers as one after the other, and members that fail."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray
from cases import bent

from jaxbeads import Chain, Scene, rollout, sweep
from jaxbeads.constraint import Gears
from jaxbeads.force import Bending, ForceField, Weight
from jaxbeads.observables import end_to_end_distance

CHAIN = Chain(1.0, 5)
STATE = bent(CHAIN)
TS = np.linspace(0.0, 4.0, 5)


def build(rigidity, weight):
    forces = [Bending(rigidity), Weight(jnp.stack([0.0 * weight, -weight]))]
    return Scene(CHAIN, 1.0, constraints=[Gears()], forces=forces), STATE


def measure(solution, scene):
    position = solution.states.position
    return {"span": end_to_end_distance(position[-1]), "path": position.mean(axis=1)}


def quiet(build, axes, **options):
    return sweep(build, axes, TS, measure, progress=False, **options)


AXES = {"rigidity": [1.0, 5.0, 20.0], "weight": [0.1, 0.5]}


@pytest.fixture(scope="module")
def table():
    return quiet(build, AXES, chunk=4)


def test_labels_and_numbers(table):
    assert dict(table.sizes) == {"rigidity": 3, "weight": 2, "path_0": 5, "path_1": 2}
    assert np.all(table.code == 0) and table.attrs["failures"] == ""
    assert np.all(table.steps > 0)
    one = jax.jit(lambda rigidity, weight: rollout(*build(rigidity, weight), TS).states.position)
    for rigidity in AXES["rigidity"]:
        member = table.sel(rigidity=rigidity, weight=0.5)
        position = one(rigidity, 0.5)
        assert abs(member.span - end_to_end_distance(position[-1])) < 1e-9
        assert np.abs(member.path - position.mean(axis=1)).max() < 1e-9


def test_paired_axes():
    axes = {"rigidity": [1.0, 20.0], "weight": [0.5, 0.1]}
    pairs = quiet(build, axes, paired=True, substeps=20)
    table = quiet(build, axes, substeps=20)
    assert dict(pairs.sizes)["member"] == 2
    for k in (0, 1):
        one = table.sel(rigidity=axes["rigidity"][k], weight=axes["weight"][k])
        assert abs(pairs.span[k] - one.span) < 1e-12
        assert pairs.weight[k] == axes["weight"][k]


def test_a_member_that_fails_changes_no_other():
    # Equal steps, far too long for the one stiff fibre, which breaks down; the same program and chunk.
    axes = {"rigidity": [1.0, 5.0, 20.0, 10.0], "weight": [0.5]}
    fine = quiet(build, axes, substeps=20)
    bad = quiet(build, {**axes, "rigidity": [1.0, 5.0, 1e6, 10.0]}, substeps=20)
    assert list(bad.code.values.ravel() != 0) == [False, False, True, False]
    assert np.isnan(bad.span[2, 0]) and np.isnan(bad.path[2]).all()
    for k in (0, 1, 3):
        assert np.array_equal(bad.path[k], fine.path[k]) and bad.span[k, 0] == fine.span[k, 0]
    (sentence,) = bad.attrs["failures"].splitlines()
    assert sentence.startswith("rigidity = 1e+06, weight = 0.5: broke down (code")
    assert "step" in sentence and "bead" in sentence and "Bending" in sentence


def test_members_that_fail_with_adaptive_steps():
    # A force that is not finite beyond a height: only the heavy fibre comes there.
    def wall(weight):
        force = ForceField(lambda t, x: jnp.where(x[..., 1:] > -6.0, 0.0 * x, jnp.nan))
        scene, state = build(jnp.asarray(5.0), weight)
        return Scene(CHAIN, 1.0, constraints=[Gears()], forces=[*scene.forces, force]), state

    options = {"solver": diffrax.Tsit5(), "progress": False}
    found = sweep(wall, {"weight": [0.1, 50.0]}, TS, measure, **options)
    alone = sweep(wall, {"weight": [0.1, 0.1]}, TS, measure, **options)
    assert found.code[0] == 0 and found.code[1] != 0
    assert np.array_equal(found.path[0], alone.path[0])
    assert "weight = 50: broke down" in found.attrs["failures"]


def test_a_measure_that_is_not_finite():
    def odd(solution, scene):
        return {"odd": jnp.log(scene.forces[0].rigidity - 2.0)}

    found = sweep(
        build, {"rigidity": [1.0, 5.0], "weight": [0.5]}, TS, odd, progress=False, substeps=20
    )
    assert list(found.code.values.ravel()) == [4, 0]
    sentence = "rigidity = 1, weight = 0.5: what is measured is not finite (code 4)"
    assert found.attrs["failures"] == sentence


@pytest.mark.parametrize(
    "axes, options, sentence",
    [
        ({}, {}, "`axes` must name at least one parameter"),
        ({"rigidity": [[1.0]], "weight": [1.0]}, {}, "must be a sequence of numbers"),
        ({"rigidity": [1.0, np.nan], "weight": [1.0]}, {}, "must be finite"),
        ({"rigidity": [1.0, 2.0], "weight": [1.0]}, {"paired": True}, "must be equally long"),
        (AXES, {"chunk": 0}, "`chunk` must be at least 1"),
    ],
)
def test_what_is_refused(axes, options, sentence):
    with pytest.raises(ValueError, match=sentence):
        quiet(build, axes, **options)


def test_functions_are_refused_by_name():
    with pytest.raises(ValueError, match="`build` must return a scene and a state"):
        quiet(lambda rigidity, weight: rigidity, AXES)


def cheap(weight):
    """A scene that compiles fast."""
    return Scene(CHAIN, 1.0, forces=[Weight(jnp.stack([0.0 * weight, -weight]))]), STATE


def place(solution, scene):
    return {"place": solution.states.position[-1].mean(axis=0)}


def swept(folder, build=cheap, measure=place, weights=(1.0, 2.0, 3.0, 4.0, 5.0), **options):
    """Five members in chunks of two."""
    options = {"substeps": 2, "chunk": 2, "progress": False} | options
    return sweep(build, {"weight": list(weights)}, TS, measure, folder=folder, **options)


def test_chunks_are_kept_and_the_rest_is_run(tmp_path):
    table = swept(tmp_path / "sweep")
    assert table.identical(swept(None))
    files = sorted(path.name for path in (tmp_path / "sweep").iterdir())
    assert files == [f"chunk_{k:06d}.npz" for k in range(3)] + ["sweep.json"]
    # What is there is read, what is not is run; the size of chunks is the folder's.
    kept = tmp_path / "sweep" / files[0]
    with np.load(kept) as held:
        changed = {**held, "x.place": held["x.place"] + 1.0}
    np.savez(kept, **changed)
    (tmp_path / "sweep" / files[1]).unlink()
    again = swept(tmp_path / "sweep", chunk=None)
    assert np.array_equal(again.place[2:], table.place[2:])
    assert np.array_equal(again.place[:2], table.place[:2] + 1.0)


def test_an_interrupted_sweep_goes_on(tmp_path, monkeypatch):
    from jaxbeads import chunks

    written, write = [], chunks._Store.write

    def interrupted(store, index, part):
        if len(written) == 2:
            raise KeyboardInterrupt
        written.append(index)
        write(store, index, part)

    monkeypatch.setattr(chunks._Store, "write", interrupted)
    table = swept(tmp_path)
    assert list(table.code) == [0, 0, 0, 0, -1]
    assert table.attrs["failures"] == "weight = 5: not run: interrupted"
    monkeypatch.undo()
    assert swept(tmp_path).identical(swept(None))


def test_a_folder_of_another_sweep_is_refused(tmp_path):
    swept(tmp_path)
    for options, sentence in (
        ({"weights": (1.0, 2.0, 3.0, 4.0, 6.0)}, "holds other parameters"),
        ({"chunk": 3}, "holds chunks of 2, not 3"),
        ({"substeps": 3}, "holds a sweep of another program"),
        ({"measure": lambda s, _: {"place": s.states.position[-1, 0]}}, "another program"),
    ):
        with pytest.raises(
            ValueError, match=f"`folder` must hold this sweep or nothing.*{sentence}"
        ):
            swept(tmp_path, **options)
    (tmp_path / "chunk_000001.npz").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"chunk_000001\.npz is damaged"):
        swept(tmp_path)
    (tmp_path / "sweep.json").write_text("{")
    with pytest.raises(ValueError, match=r"sweep\.json cannot be read"):
        swept(tmp_path)
    with pytest.raises(ValueError, match="`devices` must hold at least one"):
        swept(None, devices=[])


_ELSEWHERE = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
if len(sys.argv) > 3:
    jax.distributed.initialize(sys.argv[3], 2, int(sys.argv[4]))
import test_sweep
own = dict(weights=range(1, 8), solver=test_sweep.TSIT5, substeps=None)
equal = dict(weights=range(1, 8), chunk=4)
folder = sys.argv[2]
found = test_sweep.swept(folder or None, test_sweep.held, **own)
others = test_sweep.swept(folder + "/equal" if folder else None, test_sweep.held, **equal)
print({"own": found.to_dict()["data_vars"], "equal": others.to_dict()["data_vars"]})
"""
TSIT5 = diffrax.Tsit5()


def held(weight):
    """A fibre without stiffness."""
    forces = [Weight(jnp.stack([0.0 * weight, -weight]))]
    return Scene(CHAIN, 1.0, constraints=[Gears()], forces=forces), STATE


def start(*arguments):
    """In another process a sweep of four chunks by steps of their own, one of two by equal ones."""
    command = [sys.executable, "-c", _ELSEWHERE, *map(str, arguments)]
    # As users have it: the code generator of the other tests cuts loops by the threads of a device.
    flags = os.environ | {"XLA_FLAGS": "--xla_backend_optimization_level=0"}
    here = Path(__file__).parent
    return subprocess.Popen(command, cwd=here, env=flags, text=True, stdout=subprocess.PIPE)


def ended(*processes):
    texts = [process.communicate(timeout=300)[0] for process in processes]
    assert not any(process.returncode for process in processes)
    return [next(line for line in t.splitlines() if line.startswith("{")) for t in texts]


@pytest.mark.slow
def test_devices_and_processes_give_the_same_bits(tmp_path):
    (one,) = ended(start(1, tmp_path / "one"))
    two, four = ended(start(2, ""), start(4, tmp_path / "four"))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        meeting = f"127.0.0.1:{free.getsockname()[1]}"
    folder = tmp_path / "processes"
    pair = ended(start(1, folder, meeting, 0), start(1, folder, meeting, 1))
    assert two == one and four == one and pair == [one, one]
    assert "nan" not in one


@pytest.mark.slow
def test_a_killed_sweep_goes_on(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    (table,) = ended(start(1, whole))
    process = start(1, killed)
    while process.poll() is None and not list(killed.glob("*.npz")):
        time.sleep(0.01)
    process.kill()
    process.communicate()
    before = {path.name: path.stat().st_mtime_ns for path in killed.glob("*.npz")}
    assert ended(start(2, killed)) == [table]
    after = {path.name: path.stat().st_mtime_ns for path in killed.glob("*.npz")}
    assert len(after) == 4 and {name: after[name] for name in before} == before


def measured(**found):
    return lambda solution, scene: found


NAMES = {
    "code": (measured(code=1.0), "'code', which the table has for something else"),
    "steps": (measured(steps=1.0), "'steps', which the table has for something else"),
    "an axis": (measured(weight=1.0), "'weight', which the table has for something else"),
    "a dimension": (measured(a=jnp.ones(2), a_0=1.0), "'a_0' is a dimension of 'a' and something"),
    "no mapping": (lambda solution, scene: [1.0], "by name, but it returns a list"),
    "nothing": (lambda solution, scene: None, "by name, but it returns None"),
    "a number": (lambda solution, scene: jnp.ones(()), "by name, but it returns a"),
    "text": (measured(name="fibre"), "by name, but 'name' is 'fibre'"),
    "complex": (measured(rate=1j), "real numbers, but 'rate' is complex"),
    "empty": (measured(bend=jnp.ones((2, 0))), "at least one number .* but 'bend' is empty"),
    "no text": (lambda solution, scene: {1: 1.0}, "names that are text, but one of them is a"),
    "a path": (measured(**{"a/b": 1.0}), "a netCDF file can hold, but one of them is 'a/b'"),
    "no name": (measured(**{"": 1.0}), "a netCDF file can hold, but one of them is ''"),
    "a space": (measured(**{"a ": 1.0}), "a netCDF file can hold, but one of them is 'a '"),
    "a type": (measured(real=1.0), "a netCDF file can hold, but one of them is 'real'"),
}


@pytest.fixture
def unrun(monkeypatch):
    """Nothing may be compiled."""

    def never(*_, **__):
        raise AssertionError("not refused in time")

    monkeypatch.setattr("jaxbeads.chunks.jax.block_until_ready", never)


@pytest.mark.parametrize("measure, says", NAMES.values(), ids=NAMES)
def test_names_of_the_table_are_its_own(measure, says, unrun, tmp_path):
    for folder in (None, tmp_path / "sweep"):
        with pytest.raises(ValueError, match=f"^Argument `measure` must return .*{says}"):
            swept(folder, measure=measure)


def test_names_of_axes(unrun):
    def anything(**values):
        return cheap(next(iter(values.values())))

    two = {"a": [1.0, 2.0], "member": [1.0, 2.0]}
    taken = measured(member=1.0)
    for axes, options, found, says in (
        ({"code": [1.0]}, {}, place, "`axes` must not hold 'code'"),
        ({"steps": [1.0]}, {"paired": True}, place, "`axes` must not hold 'steps'"),
        ({"a/b": [1.0]}, {}, place, "`axes` must hold names that a netCDF file can hold"),
        ({"a b": [1.0]}, {"paired": True}, place, "`axes` must hold names without spaces"),
        ({"a": [1.0]}, {"paired": True}, taken, "`measure` must return names of its own"),
        ({"place_0": [1.0]}, {}, place, "'place_0' is a dimension of 'place' and something else"),
    ):
        with pytest.raises(ValueError, match=says):
            sweep(anything, axes, TS, found, substeps=2, progress=False, **options)
    monkey = {"substeps": 2, "progress": False}
    with pytest.raises(AssertionError, match="in time"):  # these are fine
        sweep(anything, two, TS, place, **monkey)
    with pytest.raises(AssertionError, match="in time"):
        sweep(anything, {"a": [1.0]}, TS, taken, **monkey)


WRITERS = [None, *sorted(set(xarray.backends.list_engines()) & {"scipy", "netcdf4", "h5netcdf"})]


@pytest.mark.parametrize("engine", WRITERS)
@pytest.mark.parametrize("failing", [0, 1, 3, 5])
@pytest.mark.parametrize("paired", [False, True])
def test_tables_are_written_and_read_back(engine, failing, paired, tmp_path):
    # By the writer that comes with the package, and by those that others may have.
    def found(solution, scene):
        weight = -scene.forces[0].force[1]
        number = jnp.where(weight <= failing, jnp.nan, weight)
        return {
            "number": number,
            "count": solution.steps,
            "grösse der Spitze [µm²]": solution.states.position[-1],
            "2nd": number > 2,
            "_tensor": number * jnp.ones((2, 1, 3)),
        }

    table = swept(None, measure=found, paired=paired)
    assert len(table.attrs["failures"].splitlines()) == failing
    assert (table.code.values == 4).sum() == failing
    table.to_netcdf(tmp_path / "table.nc", engine=engine)
    with xarray.open_dataset(tmp_path / "table.nc", engine=engine) as held:
        again = held.load()
    assert again.identical(table)
    assert again.attrs["failures"] == table.attrs["failures"]
    assert np.issubdtype(again.code.dtype, np.integer)


def test_a_table_with_sentences_of_simulate(tmp_path):
    table = quiet(build, {"rigidity": [5.0, 1e6], "weight": [0.5]}, substeps=20)
    (sentence,) = table.attrs["failures"].splitlines()
    assert "Bending" in sentence and "solver.explicit_step" in sentence
    table.to_netcdf(tmp_path / "table.nc", engine="scipy")
    with xarray.open_dataset(tmp_path / "table.nc", engine="scipy") as held:
        assert held.load().identical(table)
