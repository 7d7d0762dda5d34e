"""The shell: every scene, its results as JSON, its files, and its exit codes."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import jaxbeads
from jaxbeads import plot
from jaxbeads.__main__ import main
from jaxbeads.scenes import MODELS, SCENES

RUN = {"status", "wall_s", "compile_s", "steps", "constraint_residual", "bond_length_error"}
BY_NAME = {ready.name: ready for ready in SCENES}


def python_options(words):
    values = {}
    for k, word in enumerate(words):
        name = word.removeprefix("--").replace("-", "_")
        if word.startswith("--"):
            flag = k + 1 == len(words) or words[k + 1].startswith("--")
            values[name] = True if flag else words[k + 1]
    for name, value in values.items():
        if name == "model":
            values[name] = MODELS[value]
        elif isinstance(value, str):
            values[name] = json.loads(value)
    return values


@pytest.fixture
def shell(capsys):
    """Run a command that must succeed: the printed lines, and the JSON object in the last one."""

    def run(words):
        assert main([*words.split(), "--json"]) == 0
        lines = capsys.readouterr().out.splitlines()
        return lines, json.loads(lines[-1])

    return run


def test_without_arguments_scenes_are_listed(capsys):
    assert main([]) == 0
    _, *lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [ready.name for ready in SCENES]
    assert all(ready.summary in line for ready, line in zip(SCENES, lines, strict=True))


@pytest.mark.parametrize("ready", SCENES, ids=lambda ready: ready.name)
def test_results_as_json(ready, shell):
    lines, results = shell(f"{ready.name} {ready.quick}")
    assert set(results) == set(ready.results) | RUN
    assert results.pop("status") in ("finished", "stopped by `until`")
    assert all(np.all(np.isfinite(value)) for value in results.values())
    assert results["steps"] > 0 and results["wall_s"] > 0 and results["compile_s"] >= 0
    assert results["constraint_residual"] < 1e-12 and results["bond_length_error"] < 0.01
    for name in ready.results:  # for people, too
        (line,) = (line for line in lines[:-1] if line.split()[0] == name)
        shown, value = line.split()[1:], results[name]
        if isinstance(value, bool):
            assert shown == ["yes" if value else "no"]
        else:
            assert np.allclose(np.array(shown, float), value, rtol=1e-5)
    # The same run from Python.
    case = ready.build(**python_options(ready.quick.split()))
    expected = ready.observables(case, case.simulate(progress=False))
    assert expected == {name: results[name] for name in ready.results}


def test_settling_of_a_stiff_fibre(shell):
    # A stiff fibre falls as a rigid one. Not so for an even number of beads: they counter-rotate.
    _, results = shell("settling " + BY_NAME["settling"].quick)
    assert abs(results["friction_ratio"] - 1) < 1e-3
    assert 1e-5 < results["deflection"] < 1e-3


def test_solvers_agree(shell):
    periods = [
        shell(f"jeffery --beads 4 --solver {name}")[1]["period"] for name in ("ab3", "Tsit5")
    ]
    assert abs(periods[0] / periods[1] - 1) < 1e-4
    assert periods[0] != periods[1]  # they were two solvers


def test_out_writes_pictures_movie_and_trajectory(shell, tmp_path):
    folder = tmp_path / "new" / "folder"
    pytest.importorskip("vtkmodules")
    lines, results = shell(f"jeffery --beads 4 --out {folder} --paraview")
    kinds = [".gif", ".h5", ".pvd", "_observable.csv", "_observable.png", "_shapes.png"]
    if plot.can_encode():
        kinds.insert(2, ".mp4")
    names = [f"jeffery{kind}" for kind in kinds]
    assert sorted(path.name for path in folder.iterdir()) == ["jeffery", *names]
    assert all(any(f"wrote {folder / name}" in line for line in lines) for name in names)
    solution = jaxbeads.load(folder / "jeffery.h5")
    assert solution.status == "finished" and int(solution.steps) == results["steps"]
    assert solution.states.position.shape == (len(solution.ts), 4, 2)
    assert len(list((folder / "jeffery").glob("*.vtp"))) == len(solution.ts)
    header, *rows = (folder / "jeffery_observable.csv").read_text().splitlines()
    assert header == "time,orientation [rad]"
    angles = np.unwrap(jaxbeads.observables.orientation(solution.states.position))
    assert np.array_equal([float(row.split(",")[1]) for row in rows], angles)
    for name in names:
        if name.endswith((".png", ".gif")):
            with Image.open(folder / name) as picture:
                picture.load()
                assert min(picture.size) > 100
                assert name.endswith("png") or picture.n_frames == 90


def test_paraview_needs_a_folder(capsys):
    assert main(["jeffery", "--beads", "4", "--paraview"]) == 1
    assert capsys.readouterr().err == (
        "Argument `--paraview` must go with `--out`, but that is not given.\n"
    )


def test_quiet_prints_the_results_alone(capsys):
    assert main(["jeffery", "--beads", "4", "--quiet", "--no-cache"]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    names = [line.split()[0] for line in printed.out.splitlines()]
    assert names == list(BY_NAME["jeffery"].results)


def test_out_draws_curvature_where_there_is_some(shell, tmp_path):
    shell(f"relaxation --beads 5 --mode 2 --out {tmp_path}")
    with Image.open(tmp_path / "relaxation_curvature.png") as picture:
        picture.load()


def test_unknown_solver_is_one_sentence(capsys):
    assert main(["jeffery", "--beads", "4", "--solver", "magic"]) == 1
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.count("\n") == 1
    assert printed.err.startswith("Argument `--solver` must be Rosenbrock, ESDIRK, AB3 or the name")
    assert printed.err.endswith("but it is 'magic'.\n")


@pytest.mark.parametrize("words", ["nothing", "jeffery --beads few", "jeffery --sheep 4"])
def test_words_that_mean_nothing(words, capsys):
    with pytest.raises(SystemExit) as stop:
        main(words.split())
    assert stop.value.code == 2
    assert words.split()[-2 if "--sheep" in words else -1] in capsys.readouterr().err


def test_as_a_module():
    def run(*words):
        command = [sys.executable, "-m", "jaxbeads", *words]
        root = Path(jaxbeads.__file__).parents[1]
        return subprocess.run(command, cwd=root, capture_output=True, text=True)

    listed = run()
    assert listed.returncode == 0 and not listed.stderr
    assert all(f"  {ready.name} " in listed.stdout for ready in SCENES)
    refused = run("shear", "--beads", "2")
    assert refused.returncode == 1 and not refused.stdout
    assert refused.stderr == "Argument `beads` must be at least 3, but it is 2.\n"


# A shell that runs this in the background has told it to ignore Ctrl-C.
_SHELL = """
import runpy, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
runpy.run_module("jaxbeads", run_name="__main__")
"""
LONG = "settling --beads 31 --elasto-gravitational 1000 --tolerance 1e-9 --json"


def started(words, **pipes):
    command = [sys.executable, "-c", _SHELL, *words.split()]
    root = Path(jaxbeads.__file__).parents[1]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | pipes
    return subprocess.Popen(command, cwd=root, text=True, **pipes)


@pytest.mark.slow
def test_ctrl_c_is_no_success(tmp_path):
    with started(f"{LONG} --out {tmp_path}") as process:
        # Its bar of progress is there: it is running.
        assert "0%" in "".join(process.stderr.readline(1) for _ in range(30))
        process.send_signal(signal.SIGINT)
        printed, said = process.communicate(timeout=300)
    assert process.returncode == 130
    results = json.loads(printed.splitlines()[-1])
    assert results["status"] == "interrupted" and set(results) == RUN
    assert (
        "interrupted" in printed.splitlines()[0]
        and "was interrupted; its last saved time is t =" in said
    )
    assert "Traceback" not in said
    assert [path.name for path in tmp_path.iterdir()] == ["settling.h5"]
    assert jaxbeads.load(tmp_path / "settling.h5").status == "unfinished"


def test_ctrl_c_outside_a_run(monkeypatch, capsys):
    def pressed(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxbeads.scenes.case.simulate", pressed)
    assert main(["jeffery", "--beads", "4", "--json"]) == 130
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err == "Interrupted.\n"


@pytest.mark.slow
@pytest.mark.parametrize("words", ["", "--help", "jeffery --beads 4 --json"])
@pytest.mark.parametrize("both", [False, True])
def test_nobody_reads_on(words, both):
    # As `| head` and `2>&1 | head` do.
    process = started(words, **({"stderr": subprocess.STDOUT} if both else {}))
    with process:
        process.stdout.close()
        said = "" if both else process.stderr.read()
        code = process.wait(timeout=300)
    # Without a buffer `argparse` itself passes over it.
    assert code == 141 or (code == 0 and words == "--help")
    assert not any(word in said for word in ("Traceback", "BrokenPipe", "Exception ignored"))
