"""Files, restart, and runs that end before their time (gate T10)."""

import dataclasses
import importlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import diffrax
import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import SOLVERS, bent

import jaxbeads
from jaxbeads import AB3, Chain, Scene, SimulationError, load, resume, simulate, straight
from jaxbeads.constraint import Gears
from jaxbeads.flow import VelocityField
from jaxbeads.force import Bending, ForceField, Weight
from jaxbeads.progress import Bar, Forecast, Pace
from jaxbeads.solver import ESDIRK, Diffrax, FixedSteps

CHAIN = Chain(1.0, 6)
TIMES = np.linspace(0.0, 2.0, 13)


def model(force=None):
    forces = [Weight([0.2, -1.0]), Bending(4.0)] if force is None else [Bending(4.0), force]
    return Scene(CHAIN, 1.0, constraints=[Gears()], forces=forces)


ADAPTIVE = Diffrax(diffrax.Tsit5(), controller=diffrax.PIDController(rtol=0.0, atol=1e-7))
OPTIONS = [{"solver": dataclasses.replace(solver, substeps=7)} for solver, _ in SOLVERS]
OPTIONS += [{"solver": AB3(substeps=1)}, {"solver": AB3(substeps=7, projected=True)}]
OPTIONS += [{"solver": ADAPTIVE}, {}]


def bits(solution):
    return np.asarray(solution.states.position).tobytes()


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_split_run_is_the_whole_run(options, tmp_path):
    # Gate T10: chunked in any way, or stopped at a random time and continued: bit for bit.
    state, path = bent(CHAIN), tmp_path / "run.h5"
    whole = simulate(model(), state, TIMES, chunk=12, progress=False, **options)
    for chunk in (1, 3):
        assert bits(
            simulate(model(), state, TIMES, chunk=chunk, progress=False, **options)
        ) == bits(whole)
    stop = int(np.random.default_rng(len(str(options))).integers(1, 12))
    part = simulate(
        model(),
        state,
        TIMES,
        chunk=1,
        progress=False,
        file=path,
        until=lambda s: len(s.ts) > stop,
        **options,
    )
    assert len(part.ts) == stop + 1
    assert load(path).status == "unfinished"
    rest = resume(path, model(), progress=False, **options)
    assert bits(load(path)) == bits(whole)
    assert rest.states.position[0].tobytes() == part.final.position.tobytes()
    assert int(rest.steps) == int(whole.steps)
    assert load(path).status == "finished"


def test_file_holds_what_the_solution_holds(tmp_path):
    path = tmp_path / "run.h5"
    solution = simulate(model(), bent(CHAIN), TIMES, substeps=5, progress=False, file=path)
    stored = load(path)
    for a, b in zip(jax.tree.leaves(stored), jax.tree.leaves(solution), strict=True):
        assert np.array_equal(a, b)


def test_a_file_of_the_first_format_goes_on(tmp_path):
    # It lacks the number of steps since the last save time, the last entry of a checkpoint.
    path, state = tmp_path / "run.h5", bent(CHAIN)
    whole = simulate(model(), state, TIMES, progress=False)
    stop = {"until": lambda s: len(s.ts) > 5, "chunk": 1}
    simulate(model(), state, TIMES, progress=False, file=path, **stop)
    with h5py.File(path, "r+") as handle:
        handle.attrs["format"] = 1
        for checkpoint in handle["checkpoint"].values():
            del checkpoint[max(checkpoint, key=int)]
    assert bits(load(path)) == bits(whole)[: len(bits(load(path)))]
    resume(path, model(), progress=False)
    assert bits(load(path)) == bits(whole)


def test_resume_of_a_finished_run_changes_nothing(tmp_path):
    path = tmp_path / "run.h5"
    simulate(model(), bent(CHAIN), TIMES, substeps=5, progress=False, file=path)
    before = bits(load(path))
    resume(path, model(), substeps=5, progress=False)
    assert bits(load(path)) == before


def test_interrupt_leaves_a_valid_file(tmp_path):
    # Ctrl-C in the middle: the solution so far is returned, the file continues to the same end.
    path, state = tmp_path / "run.h5", bent(CHAIN)
    times = np.linspace(0, 2000.0, 2001)
    whole = simulate(model(), state, times, substeps=40, progress=False)

    def press_ctrl_c(solution):
        if len(solution.ts) == 40:
            os.kill(os.getpid(), signal.SIGINT)
        return False

    # A shell that runs this in the background has told it to ignore Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with pytest.warns(UserWarning, match="interrupted"):
        part = simulate(
            model(),
            state,
            times,
            substeps=40,
            progress=False,
            file=path,
            chunk=1,
            until=press_ctrl_c,
        )
    assert part.status == "interrupted"
    assert 40 <= len(part.ts) < 2001
    assert len(load(path).ts) == len(part.ts)
    resume(path, model(), substeps=40, progress=False)
    assert bits(load(path)) == bits(whole)


@pytest.mark.parametrize(
    "options",
    [{"substeps": 4000}, {"tolerance": 1e-9}, {"solver": ESDIRK(tolerance=1e-10)}],
    ids=str,
)
def test_a_run_goes_on_from_the_middle_of_an_interval(options, tmp_path, monkeypatch):
    # Steps in stretches of 1, then 8 (2 of few steps): the same bits, a file after each, and Ctrl-C
    # between two of them.
    module = importlib.import_module("jaxbeads.run")
    path, state, times = tmp_path / "run.h5", bent(CHAIN), [0.0, 40.0, 80.0]
    whole = simulate(model(), state, times, progress=False, **options)
    steps = int(whole.steps)
    most = 8 if steps > 100 else 2
    monkeypatch.setattr(module, "_WRITE", -1.0)
    monkeypatch.setattr(module.Pace, "taken", lambda self, *_: setattr(self, "most", most))
    assert bits(simulate(model(), state, times, progress=False, **options)) == bits(whole)
    seen = []

    def press_ctrl_c(self, t, taken):
        seen.append((t, taken))
        if t > 50.0:
            raise KeyboardInterrupt

    monkeypatch.setattr(module.Bar, "tell", press_ctrl_c)
    with pytest.warns(UserWarning, match=r"its last saved time is t = 40. `resume`"):
        part = simulate(model(), state, times, progress=False, file=path, **options)
    assert len(part.ts) == 2 and bits(load(path)) == bits(part)
    assert np.all(np.diff([t for t, _ in seen]) > 0) and 40 < seen[-1][0] < 80
    monkeypatch.undo()
    rest = resume(path, model(), progress=False, **options)
    assert bits(load(path)) == bits(whole) and int(rest.steps) == steps


def test_a_resumed_run_stops_where_the_whole_one_does(tmp_path, monkeypatch):
    # `until` is asked after the same save times, wherever the run was interrupted.
    path, state = tmp_path / "run.h5", bent(CHAIN)
    options = {"substeps": 3, "chunk": 3, "progress": False, "until": lambda s: s.ts[-1] > TIMES[4]}
    whole = simulate(model(), state, TIMES, **options)
    assert len(whole.ts) == 7

    def press_ctrl_c(self, t, taken):
        if t >= TIMES[4]:
            raise KeyboardInterrupt

    monkeypatch.setattr(Bar, "tell", press_ctrl_c)
    with pytest.warns(UserWarning, match="interrupted"):
        assert len(simulate(model(), state, TIMES, file=path, **options).ts) == 5
    monkeypatch.undo()
    resume(path, model(), **options)
    assert bits(load(path)) == bits(whole)


def test_a_bar_tells_the_time_reached(capsys):
    with Bar(1.0, 5.0, 1.0, shown=True) as bar:
        bar.tell(2.0, 30)
        bar.bar.refresh()
        half = capsys.readouterr().err
        bar.tell(5.0, 70)
    assert "compiling:   0%" in half and "t = 2 of 5, 30 steps:  25%" in half
    assert "t = 5 of 5, 70 steps: 100%" in capsys.readouterr().err


def test_a_bar_says_how_long_it_will_compile(capsys):
    # As long as what was compiled before: of the rest JAX tells only when it ends.
    with Bar(0.0, 1.0, 0.0, shown=True, compiled=lambda: 5.8) as bar:
        said = ""
        for _ in range(200):
            time.sleep(0.1)
            said += capsys.readouterr().err
            if "about" in said:
                break
        bar.tell(0.5, 3)
    assert "compiling, about 6 s:   0%" in said
    assert "t = 0.5 of 1, 3 steps:  50%" in capsys.readouterr().err


def test_a_run_tells_its_bar_what_it_compiles(monkeypatch):
    bars = []
    monkeypatch.setattr(Bar, "__enter__", lambda self: bars.append(self) or self)
    jax.clear_caches()
    simulate(model(), bent(CHAIN), [0.0, 0.1], substeps=1, progress=False)
    (bar,) = bars
    assert bar.compiled() > 0 and bar.begun


def test_a_long_run_says_beforehand_what_it_takes(monkeypatch, capsys):
    # By the time of an evaluation, or where that is too short to be timed, by that of the first steps.
    progress, said = importlib.import_module("jaxbeads.progress"), []
    monkeypatch.setattr(Bar, "say", lambda self, text: said.append((self.begun, text)))
    simulate(model(), bent(CHAIN), TIMES, substeps=2)
    assert not said
    monkeypatch.setattr(progress, "_LONG", 0.0)
    cases = {
        "12000 steps of about .* each (as the velocities), .* in all": {"substeps": 1000},
        "steps of about .* each (as 25 times the velocities), .* for 100": {"tolerance": 1e-5},
    }
    for call, begun in ((0.0, False), (1e-9, False), (0.02, True)):
        monkeypatch.setattr(progress, "_CALL", call)
        for text, options in cases.items():
            said.clear()
            simulate(model(), bent(CHAIN), TIMES, **options)
            # Steps of a controller are too few here to be timed.
            assert len(said) == (0 if begun and "tolerance" in options else 1)
            text = text.replace("(", r"\(").replace(")", r"\)")
            for now, sentence in said:
                assert now == begun and re.fullmatch(
                    f"6 beads, .* GiB of memory: {text}.*", sentence
                )
    simulate(model(), bent(CHAIN), TIMES, substeps=1000, progress=False)
    assert len(said) == 0
    capsys.readouterr()
    with Bar(0.0, 1.0, 0.0, shown=True) as bar:
        monkeypatch.undo()
        bar.say("as long as it takes")
    assert "as long as it takes\n" in capsys.readouterr().err


def test_a_forecast_is_what_steps_take():
    # Of equal steps all, of others a hundred.
    stepper = FixedSteps(AB3(substeps=30))
    equal = Forecast.of(stepper, 1000, 20, 0.2)
    assert equal.steps == 600 and abs(equal.whole - 120.0) < 1e-9 and equal.long
    assert abs(equal.after(8, 4.0).whole - 300.0) < 1e-9
    assert equal.sentence(2**28).endswith(
        "0.25 GiB of memory: 600 steps of about 0.20 s each (as the velocities), 2.0 min in all"
    )
    chosen = Forecast(1000, None, 5, 0.1)
    assert abs(chosen.whole - 50.0) < 1e-9 and not chosen.long
    assert "1000 beads: steps of about 0.50 s each (as 5 times the velocities), 50 s for 100" in (
        chosen.sentence(None)
    )


def test_a_pace_of_half_a_second():
    pace, asked = Pace(), []
    for seconds in (20.0, 8e-3, 0.128, 0.256, 2.0, 0.0):
        asked.append(pace.most)
        pace.taken(pace.most, seconds)
    assert asked == [1, 8, 128, 500, 976, 244]
    assert pace.most == 16 * 244


def test_a_term_that_fails_is_named(tmp_path):
    # The load of one bead becomes NaN at t = 1.1: step, bead and term are named, the past is kept.
    path = tmp_path / "run.h5"

    def push(t, x):
        return jnp.zeros_like(x).at[2, 0].set(jnp.where(t > 1.1, jnp.nan, 0.5))

    with pytest.raises(SimulationError, match="ForceField") as caught:
        simulate(
            model(ForceField(push)), bent(CHAIN), TIMES, substeps=10, progress=False, file=path
        )
    cause = caught.value.cause
    h = (TIMES[1] - TIMES[0]) / 10
    assert cause.step == int(np.floor(1.1 / h)) + 1
    assert abs(cause.time - cause.step * h) < 1e-9
    assert cause.term == "ForceField" and cause.bead is not None
    assert "not finite" in str(caught.value) and f"step {cause.step}" in str(caught.value)
    kept = caught.value.solution
    assert float(kept.ts[-1]) == TIMES[6] and np.all(np.isfinite(kept.states.position))
    assert bits(load(path)) == bits(kept)


def test_a_flow_that_fails_is_named():
    stream = VelocityField(lambda t, x: x * jnp.where(t > 0.5, jnp.inf, 0.1))
    broken = Scene(CHAIN, 1.0, constraints=[Gears()], forces=[Bending(4.0)], flow=stream)
    with pytest.raises(SimulationError, match="VelocityField"):
        simulate(broken, bent(CHAIN), TIMES, substeps=10, progress=False)


def test_a_step_too_large_is_named():
    # Unstable steps need not reach infinity: the bonds' lengths show them first.
    chain = Chain(1.0, 10)
    stiff = Scene(chain, 1.0, constraints=[Gears()], forces=[Weight([0.0, -1.0]), Bending(100.0)])
    state = straight(chain, [1.0, 0.0])
    with (
        pytest.warns(UserWarning, match=r"times `solver.explicit_step` \(eq. \(39\)"),
        pytest.raises(
            SimulationError,
            match=r"Bending.*10 times `solver.explicit_step`, eq\. \(39\).*substeps",
        ),
    ):
        simulate(stiff, state, np.arange(0.0, 200.0, 1.6), substeps=1, progress=False)


def test_a_controller_that_finds_no_step_is_named():
    def cliff(t, x):
        return jnp.where(t > 1.0, 1e3 * jnp.sign(jnp.sin(1e9 * t)), 0.0) * x

    with pytest.raises(SimulationError, match=r"60 steps from t = .* did not reach"):
        solver = dataclasses.replace(ADAPTIVE, max_steps=60)
        simulate(model(ForceField(cliff)), bent(CHAIN), TIMES, progress=False, solver=solver)


def test_versions_are_stored(tmp_path):
    import h5py

    path = tmp_path / "run.h5"
    simulate(model(), bent(CHAIN), TIMES, substeps=2, progress=False, file=path)
    with h5py.File(path) as handle:
        assert handle.attrs["format"] == jaxbeads.files.FORMAT
        assert jax.__version__ in handle.attrs["versions"]


@pytest.mark.parametrize("place", ["columns", "checkpoint"])
def test_an_interrupt_in_the_middle_of_a_write(place, tmp_path, monkeypatch):
    # States without their checkpoint, or half a checkpoint: the file is as it was before the write.
    path, state = tmp_path / "run.h5", bent(CHAIN)
    whole = simulate(model(), state, TIMES, substeps=5, progress=False)
    leaves, calls = jaxbeads.files._leaves, []

    def interrupted(tree):
        calls.append(1)
        if len(calls) < 6:
            return leaves(tree)
        if place == "checkpoint":
            tree = [*leaves(tree)[:1], None]
            return (leaf for leaf in tree if leaf is not None or raise_interrupt())
        raise KeyboardInterrupt

    def raise_interrupt():
        raise KeyboardInterrupt

    monkeypatch.setattr(jaxbeads.files, "_leaves", interrupted)
    with pytest.warns(UserWarning, match="interrupted"):
        simulate(model(), state, TIMES, substeps=5, progress=False, file=path, chunk=1)
    monkeypatch.undo()
    assert 1 < len(load(path).ts) < 13
    resume(path, model(), substeps=5, progress=False)
    assert bits(load(path)) == bits(whole)


# What may be another when a run goes on, and what not.


LONG = np.linspace(0.0, 120.0, 13)
PRECISE = Diffrax(diffrax.Tsit5(), tolerance=1e-10)
LONGER = dataclasses.replace(PRECISE, max_steps=10**6)


def stopped_at_its_limit(path, scene=None):
    with pytest.raises(SimulationError, match="raise `max_steps`"):
        simulate(
            scene or model(),
            bent(CHAIN),
            LONG,
            solver=dataclasses.replace(PRECISE, max_steps=3),
            progress=False,
            file=path,
        )
    return {"solver": PRECISE, "progress": False}


def test_a_run_goes_on_with_larger_limits(tmp_path):
    path = tmp_path / "run.h5"
    options = stopped_at_its_limit(path)
    done = len(load(path).ts)
    assert load(path).status == "unfinished" and 1 <= done < len(LONG)
    options["solver"] = LONGER
    rest = resume(path, model(), chunk=2, bond_tolerance=0.02, **options)
    whole = simulate(model(), bent(CHAIN), LONG, **options)
    assert bits(load(path)) == bits(whole) and int(rest.steps) == int(whole.steps)
    assert load(path).status == rest.status == "finished" and int(rest.code) == 0
    assert len(rest.ts) == len(LONG) - done + 1


def pulled(strength, law=None):
    """A scene with a law that holds a number."""
    return model(ForceField(law or (lambda t, x: strength * jnp.sin(t / 9) + 0.0 * x)))


def test_numbers_of_the_solver_and_of_laws_are_compared(tmp_path):
    path = tmp_path / "run.h5"
    options = stopped_at_its_limit(path, pulled(0.5))
    before = path.read_bytes()
    for scene, others, says in (
        (
            pulled(0.5),
            {"solver": dataclasses.replace(PRECISE, tolerance=1e-9)},
            "`solver.tolerance` was 1e-10 and is 1e-09",
        ),
        (pulled(0.6), {}, r"`scene.forces\[1\].function.strength` was 0.5 and is 0.6"),
        (pulled(0, lambda t, x: jnp.cos(t) + 0.0 * x), {}, r"function` was .* is .*<lambda>"),
        (model(), {}, r"`scene.forces` was \(Bending, ForceField\) and is \(Weight, Bending\)"),
    ):
        with pytest.raises(ValueError, match=says) as caught:
            resume(path, scene, **options | others)
        assert str(caught.value).startswith("Argument `scene` must be the scene and solver")
        assert path.read_bytes() == before
    assert len(resume(path, pulled(0.5), **options).ts) > 1


_ELSEWHERE = """
import os, sys, pathlib
import jax
jax.config.update("jax_enable_x64", True)
import test_files
what, path = sys.argv[1:]
if what == "resume":
    options = {"solver": test_files.PRECISE, "progress": False}
    test_files.resume(path, test_files.pulled(0.5), **options)
else:  # as a second program
    for run in (test_files.simulated, test_files.resumed):
        try:
            run(path)
        except ValueError as error:
            print(error)
"""


def elsewhere(what, path):
    """In another process."""
    command = [sys.executable, "-c", _ELSEWHERE, what, str(path)]
    here = Path(__file__).parent
    done = subprocess.run(command, cwd=here, text=True, capture_output=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.slow
def test_the_same_lambda_in_a_new_process(tmp_path):
    path = tmp_path / "run.h5"
    options = stopped_at_its_limit(path, pulled(0.5))
    elsewhere("resume", path)
    assert bits(load(path)) == bits(simulate(pulled(0.5), bent(CHAIN), LONG, **options))


def simulated(path, **options):
    return simulate(model(), bent(CHAIN), TIMES, substeps=5, progress=False, file=path, **options)


def resumed(path):
    return resume(path, model(), substeps=5, progress=False)


IN_USE = "Argument `file` must not be in use, but another run writes to {}."


@pytest.mark.parametrize("older", [False, True])
def test_a_file_in_use_is_left_alone(older, tmp_path):
    path, link, said, seen = tmp_path / "run.h5", tmp_path / "link.h5", [], []
    link.symlink_to(path)
    if older:
        simulated(path)

    def meddle(solution):
        if not said:
            before = path.read_bytes()
            said.extend(elsewhere("meddle", path))
            for run in (simulated, resumed):  # in the same process, by another name too
                for name in (path, link):
                    with pytest.raises(ValueError) as caught:
                        run(name)
                    said.append(str(caught.value).replace("link.h5", "run.h5"))
            assert path.read_bytes() == before
            seen.append(len(load(path).ts))
        return False

    whole = simulated(path, until=meddle, chunk=1)
    assert said == [IN_USE.format(path)] * 6 and seen == [2]
    assert bits(load(path)) == bits(whole)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link.h5", "run.h5"]
    assert bits(simulated(path)) == bits(whole)  # no longer in use


def test_a_run_that_does_not_begin_leaves_an_older_file(tmp_path):
    path = tmp_path / "run.h5"
    simulated(path)
    before = path.read_bytes()
    twice = Scene(CHAIN, 1.0, constraints=[Gears(), Gears()], forces=[Bending(4.0)])
    nowhere = model(ForceField(lambda t, x: x / 0.0))
    for scene, options, kind in (
        (twice, {}, ValueError),
        (nowhere, {}, SimulationError),
        (model(), {"bond_tolerance": -1.0}, ValueError),
        (model(), {"substeps": 0}, ValueError),
    ):
        with pytest.raises(kind):
            simulate(scene, bent(CHAIN), TIMES, progress=False, file=path, **options)
        assert path.read_bytes() == before
        assert [p.name for p in tmp_path.iterdir()] == ["run.h5"]


def test_what_is_no_trajectory_file_is_replaced(tmp_path):
    path = tmp_path / "run.h5"
    path.write_text("hello\n")
    whole = simulated(path)
    assert bits(load(path)) == bits(whole)
    assert [p.name for p in tmp_path.iterdir()] == ["run.h5"]


def test_a_place_that_is_taken_in_the_meantime(tmp_path, monkeypatch):
    # Two runs that find no file and begin at once: the second to write its first state is turned away.
    path, other = tmp_path / "run.h5", []
    take = jaxbeads.storage.Place.take

    def late(place):
        if not other:
            other.append(None)
            other[0] = simulated(path)
        take(place)

    monkeypatch.setattr(jaxbeads.storage.Place, "take", late)
    with pytest.raises(ValueError, match="must not be in use"):
        simulated(path)
    assert bits(load(path)) == bits(other[0])
    assert [p.name for p in tmp_path.iterdir()] == ["run.h5"]
