"""Files, restart, and runs that end before their time (gate T10)."""

import os
import signal

import diffrax
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

CHAIN = Chain(1.0, 6)
TIMES = np.linspace(0.0, 2.0, 13)


def model(force=None):
    forces = [Weight([0.2, -1.0]), Bending(4.0)] if force is None else [Bending(4.0), force]
    return Scene(CHAIN, 1.0, constraints=[Gears()], forces=forces)


ADAPTIVE = {
    "solver": diffrax.Tsit5(),
    "controller": diffrax.PIDController(rtol=0.0, atol=1e-7),
}
OPTIONS = [{"solver": solver, "substeps": 7} for solver, _ in SOLVERS]
OPTIONS += [{"solver": AB3(), "substeps": 1}, {"substeps": 7, "projected": True}, ADAPTIVE, {}]


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
        simulate(
            model(ForceField(cliff)), bent(CHAIN), TIMES, progress=False, max_steps=60, **ADAPTIVE
        )


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
