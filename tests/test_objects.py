"""What comes out of a run, as an object: subtracted, passed on, printed, copied, sent elsewhere."""

import copy
import multiprocessing
import pickle

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent

from jaxbeads import (
    AB3,
    Chain,
    Scene,
    SimulationError,
    Solution,
    load,
    optimise,
    periodic_state,
    resume,
    rollout,
    simulate,
    steady_state,
)
from jaxbeads.actuation import TravellingWave
from jaxbeads.breakdown import Cause
from jaxbeads.constraint import Gears
from jaxbeads.files import DamagedFile
from jaxbeads.flow import OscillatingShear
from jaxbeads.force import Bending, ForceField, Weight
from jaxbeads.outcome import Outcome, meaning
from jaxbeads.solver import Diffrax, Rosenbrock

CHAIN = Chain(1.0, 4)
START = bent(CHAIN)
TIMES = np.linspace(0.0, 2.0, 5)


def model(rigidity=4.0):
    return Scene(CHAIN, 1.0, constraints=[Gears()], forces=[Bending(rigidity), Weight([0.2, -1.0])])


def run(**options):
    return simulate(model(), START, TIMES, progress=False, **options)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs of one shape, by several solvers, in whatever way they ended."""
    path = tmp_path_factory.mktemp("run") / "run.h5"
    found = {
        "default": run(file=path),
        "AB3": run(substeps=20),
        "Tsit5": run(solver=diffrax.Tsit5()),
    }
    found["loaded"] = load(path)
    resumed_path = path.with_name("other.h5")
    # It ends at the last time, yet by its own will.
    found["stopped"] = run(file=resumed_path, until=lambda s: len(s.ts) == len(TIMES))
    return found


def test_solutions_have_one_structure(runs):
    first, *others = runs.values()
    for other in others:
        assert jax.tree.structure(other) == jax.tree.structure(first)
        difference = jax.tree.map(lambda a, b: a - b, other, first)
        moved = other.states.position - first.states.position
        assert np.array_equal(difference.states.position, moved)
        assert float(difference.wall_s) == float(other.wall_s) - float(first.wall_s)
        assert difference.status == "unknown" and difference.solver is None
        assert "unknown" in repr(difference)
    assert len({float(s.wall_s) for s in runs.values()}) >= 3


@pytest.mark.parametrize("jit", [jax.jit, eqx.filter_jit])
def test_a_jitted_function_is_traced_once(runs, jit):
    traces = []

    @jit
    def last(solution):
        traces.append(repr(solution))
        return solution, solution.final.position.sum()

    for solution in runs.values():
        same, total = last(solution)
        assert float(total) == pytest.approx(float(solution.final.position.sum()))
        for name in ("status", "solver", "wall_s", "compile_s"):  # not those of the one traced
            assert getattr(same, name) == getattr(solution, name)
    (traced,) = traces
    assert traced.startswith("Solution: 5 states of 4 beads in 2-D") and "traced" in traced


def test_status_in_words(runs):
    words = {name: solution.status for name, solution in runs.items()}
    assert words.pop("stopped") == "stopped by `until`"
    assert set(words.values()) == {"finished"}
    one, zero = jnp.asarray(1), jnp.asarray(0)
    parts = runs["AB3"].ts, runs["AB3"].states
    endings = [outcome for outcome in Outcome if outcome.is_ending]
    said = [Solution(*parts, one, zero, ending=ending).status for ending in endings]
    assert Solution(*parts, one, zero).status == "finished"
    assert Solution(*parts, one, one).status == "broken down"
    assert said[2:] == ["interrupted", "unfinished", "broken down"]
    numbers = np.array(endings)
    for combined in (np.add.outer(numbers, numbers), np.subtract.outer(numbers, numbers)):
        assert not set(combined.ravel()) & set(numbers)


def test_solvers_are_named(runs):
    assert [s.solver for s in runs.values()] == [
        "Rosenbrock",
        "AB3",
        "Tsit5",
        "Rosenbrock",
        "Rosenbrock",
    ]
    for solver in (Diffrax(diffrax.Heun(), substeps=2), AB3(substeps=2)):
        pure = jax.jit(lambda s=solver: rollout(model(), START, TIMES, solver=s))()
        assert pure.solver == solver.name


def test_each_outcome_is_a_sentence():
    assert [int(o) for o in Outcome] == [-1, 0, 1, 2, 3, 4, 5, 101, 102, 103, 104, 105]
    for one in Outcome:
        assert one.sentence[0].isupper() and one.sentence.endswith(".")
        assert Outcome(int(one)) is one and pickle.loads(pickle.dumps(one)) is one
        # Compiled programs take it as the number that it is.
        assert int(jax.jit(lambda x, o=one: jnp.where(x, o, 7))(True)) == one
    assert meaning(17) == "not one of a run"


def test_a_solution_prints_itself(runs):
    for name, solution in runs.items():
        text = repr(solution)
        assert text == str(solution) and 4 <= len(text.splitlines()) <= 6
        assert f"5 states of 4 beads in 2-D, t = 0 to 2, {int(solution.steps)} steps" in text
        assert f" by {solution.solver}, {solution.status}" in text
        assert "position (5, 4, 2)" in text and "constraint residual" in text, name
        assert f"wall time {float(solution.wall_s):.2f} s, of which compiling" in text
        assert "bond-length error" in text and "Array(" not in text
        assert all(line.strip() in text for line in solution.summary().splitlines())
    pure = rollout(model(), START, TIMES, substeps=20)
    assert "by AB3, finished" in repr(pure) and "wall time" not in repr(pure)


def test_many_runs_in_one():
    many = jax.vmap(lambda k: rollout(model(k), START, TIMES, substeps=20))
    batch = many(jnp.array([1.0, 4.0, 1e5]))
    assert batch.status == "2 finished, 1 broken down" and batch.solver == "AB3"
    text = repr(batch)
    assert "3 runs of 5 states" in text and "(3, 5, 4, 2)" in text and "code 3: positions" in text
    one = jax.tree.map(lambda x: x[2], batch)
    assert one.status == "broken down"
    slope = jax.grad(lambda k: many(k[None]).states.position[0, -1, 0, 1])
    assert np.isfinite(slope(jnp.asarray(4.0)))


def test_what_is_no_trajectory_prints_too(runs):
    tree = runs["AB3"]
    for other in (
        jax.tree.map(lambda x: None, tree),
        jax.tree.map(jnp.shape, tree),
        jax.tree.map(lambda x: 0, tree),
        jax.tree.map(lambda x: x[:0] if x.ndim else x, tree),
        jax.tree.map(lambda x: 1.5 * x, tree),
        jax.eval_shape(lambda s: s, tree),
    ):
        assert repr(other).startswith("Solution")


def test_the_time_a_run_took_is_in_its_file(runs, tmp_path):
    assert float(runs["loaded"].wall_s) == float(runs["default"].wall_s) > 0
    path = tmp_path / "run.h5"
    part = run(substeps=20, file=path, chunk=1, until=lambda s: len(s.ts) > 2)
    rest = resume(path, model(), substeps=20, progress=False)
    assert float(load(path).wall_s) == pytest.approx(float(part.wall_s) + float(rest.wall_s))
    assert load(path).solver == rest.solver == "AB3"
    # A run that does not end by itself leaves nothing to say of it.
    with pytest.raises(ZeroDivisionError):
        run(substeps=20, file=path, chunk=1, until=lambda s: 1 / (3 - len(s.ts)) < 0)
    assert np.isnan(load(path).wall_s) and load(path).status == "unfinished"


@pytest.fixture(scope="module")
def failure():
    def push(t, x):
        return jnp.where(t > 0.6, jnp.nan, 0.0) * x

    broken = Scene(CHAIN, 1.0, constraints=[Gears()], forces=[ForceField(push)])
    with pytest.raises(SimulationError) as caught:
        simulate(broken, START, TIMES, substeps=5, progress=False)
    return caught.value


def same_tree(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True):
        assert np.array_equal(x, y, equal_nan=True) and x.dtype == y.dtype


WAYS = {
    "pickle": lambda x: pickle.loads(pickle.dumps(x)),
    "oldest protocol": lambda x: pickle.loads(pickle.dumps(x, protocol=2)),
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
}


class OwnError(SimulationError):
    """A user's own kind."""


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_errors_are_copied_whole(failure, way):
    own = OwnError(failure.cause, failure.solution)
    own.add_note("seen in passing")
    for error in (failure, own):
        again = way(error)
        assert type(again) is type(error) and str(again) == str(error)
        assert again.cause == error.cause and isinstance(again.cause, Cause)
        assert again.solution.status == "broken down" and len(again.solution.ts) == 2
        same_tree(again.solution, error.solution)
    assert way(own).__notes__ == ["seen in passing"]
    again = way(DamagedFile("no file"))
    assert type(again) is DamagedFile and str(again) == "no file"


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_results_are_copied_whole(runs, way):
    scene = model()
    drifting = Scene(CHAIN, 1.0, constraints=[Gears()], forces=[Bending(4.0)])
    wave = TravellingWave(amplitude=0.1, wavenumber=1.0, frequency=1.0)
    swaying = Scene(CHAIN, 1.0, constraints=[Gears()], forces=[Bending(4.0, wave)])
    for held in (
        *runs.values(),
        scene,
        START,
        CHAIN,
        AB3(substeps=3),
        OPTIMUM,
        steady_state(drifting, START),
        periodic_state(swaying, START, 1.0, substeps=20, accuracy=1e-4),
    ):
        again = way(held)
        assert type(again) is type(held)
        same_tree(again, held)
    assert way(OPTIMUM).status == OPTIMUM.status


SOLVERS = [
    Rosenbrock(tolerance=1e-5, max_steps=10),
    Diffrax(diffrax.Tsit5(), projected=False),
    Diffrax(diffrax.Heun(), substeps=3),
]


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: s.name)
def test_solvers_are_copied_whole(solver):
    for again in (pickle.loads(pickle.dumps(solver)), copy.copy(solver), copy.deepcopy(solver)):
        assert eqx.tree_equal(again, solver)


OPTIMUM = optimise(lambda x: (x - 3.0) ** 2, 0.0, progress=False)


def test_optima_have_one_structure():
    other = optimise(lambda x: (x - 3.0) ** 4, 0.0, steps=2, progress=False)
    assert OPTIMUM.status == "the gradient vanishes" and other.status == "took all 2 steps"
    assert jax.tree.structure(other) == jax.tree.structure(OPTIMUM)
    difference = jax.tree.map(lambda a, b: a.sum() - b.sum(), other, OPTIMUM)
    assert difference.ending == 101 - 102


def rethrow(error):
    raise error


@pytest.mark.slow
def test_a_pool_of_workers_hands_errors_on(failure):
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        for error in (failure, DamagedFile("no file")):
            with pytest.raises(type(error)) as caught:
                pool.apply_async(rethrow, (error,)).get(timeout=120)
            assert str(caught.value) == str(error)


def test_a_scene_prints_itself():
    wave = [Weight([0.0, -2.5]), Bending(3.0)]
    model = Scene(CHAIN, 1.5, constraints=[Gears()], forces=wave, flow=OscillatingShear(1.0, 2.0))
    text = str(model)
    rows = dict(line.split(maxsplit=1) for line in text.splitlines()[1:-1])
    assert list(rows) == ["chain", "fluid", "mobility", "constraints", "forces"]
    assert rows["chain"] == "4 beads in a fibre, radius 1, gap 0" and rows["constraints"] == "Gears"
    assert "viscosity 1.5, domain Unbounded, flow OscillatingShear(" in rows["fluid"]
    assert "Weight(force=[ 0.  -2.5]), Bending(rigidity=3" in rows["forces"]
    assert "with spins, systems are factorised" in rows["mobility"]
    assert max(map(len, text.splitlines())) < 200
    # Under a transformation, too, and its structure is what it was.
    traced = []
    jax.jit(lambda scene: traced.append(str(scene)) or scene.viscosity)(model)
    assert "viscosity float64[]" in traced[0] and repr(model).startswith("Scene(")
    assert "none" in str(Scene(Chain(1.0, (2, 3)), 1.0)) and "2 fibres" in str(
        Scene(Chain(1.0, (2, 3)), 1.0)
    )


def test_an_optimum_prints_itself():
    def loss(values):
        return jnp.sum((values["stiffness"] - 2.0) ** 2)

    found = optimise(loss, {"stiffness": jnp.ones(3)}, progress=False, steps=5)
    first, *lines = str(found).splitlines()
    assert first.startswith("Optimum: loss ") and found.status in first
    assert any("loss at first 3, gradient norm 3.46e+00 to" in line for line in lines)
    assert "  values: ['stiffness'] [2. 2. 2.]" in lines
    several = optimise(loss, {"stiffness": jnp.ones((2, 3))}, many=True, progress=False, steps=2)
    assert "(best of 2 starts)" in str(several)
    traced = []
    jax.jit(lambda x: traced.append(str(x)) or x.loss)(found)
    assert traced[0].startswith("Optimum(")


def test_a_steady_state_prints_itself():
    drifting = Scene(CHAIN, 1.0, constraints=[Gears()], forces=[Bending(4.0), Weight([0.0, -1.0])])
    found = steady_state(drifting, START)
    first, *lines = str(found).splitlines()
    assert first == "SteadyState: converged, 4 beads in 2-D, stable"
    with np.printoptions(precision=4, suppress=True):
        assert lines[0] == f"  velocity {np.asarray(found.velocity)}"
    assert f"growth rate {found.growth_rates.real.max():.3e}" in lines[1]
    grown = eqx.tree_at(lambda s: s.jacobian, found, -found.jacobian)
    assert str(grown).splitlines()[0].endswith(", unstable")
    lost = eqx.tree_at(lambda s: s.converged, found, jnp.asarray(False))
    assert str(lost) == "SteadyState: not converged"
    several = jax.tree.map(lambda x: jnp.stack([x, x]), found)
    traced = []
    jax.jit(lambda x: traced.append(str(x)) or x.velocity)(found)
    assert traced[0].startswith("SteadyState(") and str(several).startswith("SteadyState(")


def test_a_periodic_state_prints_itself():
    wave = TravellingWave(amplitude=0.1, wavenumber=1.0, frequency=1.0)
    swaying = Scene(CHAIN, 1.0, constraints=[Gears()], forces=[Bending(4.0, wave)])
    found = periodic_state(swaying, START, 1.0, substeps=20, accuracy=1e-4)
    first, *lines = str(found).splitlines()
    assert first == "PeriodicState: converged, 4 beads in 2-D, stable"
    assert lines[0].startswith("  in a period: displacement [") and "rad" in lines[0]
    assert f"multiplier {np.abs(found.multipliers).max():.6g} in size" in lines[1]
    grown = eqx.tree_at(lambda s: s.jacobian, found, -found.jacobian)
    assert str(grown).splitlines()[0].endswith(", unstable")
    lost = eqx.tree_at(lambda s: s.converged, found, jnp.asarray(False))
    assert str(lost) == "PeriodicState: not converged"
    several = jax.tree.map(lambda x: jnp.stack([x, x]), found)
    traced = []
    jax.jit(lambda x: traced.append(str(x)) or x.displacement)(found)
    assert traced[0].startswith("PeriodicState(") and str(several).startswith("PeriodicState(")


def test_the_bar_tells_the_time_and_the_steps(capsys):
    model = Scene(CHAIN, 1.0, constraints=[Gears()], forces=[Weight([0.0, -1.0]), Bending(1.0)])
    run = simulate(model, START, TIMES, substeps=3)
    said = capsys.readouterr().err
    assert "compiling:   0%" in said and f"t = 2 of 2, {int(run.steps)} steps" in said
