"""Implicit steps of scenes of any size: their stages, their derivatives, and where they are hard."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import in_units
from examples import EXAMPLES, springs, swimmers

import jaxbeads as jb
from jaxbeads import ESDIRK, Chain, Scene, iterations, segments
from jaxbeads.constraint import Gears
from jaxbeads.coordinates import coordinates
from jaxbeads.force import Bending, Contact, ForceField, Weight
from jaxbeads.iterations import accelerated, learning
from jaxbeads.linearise import coordinate_rate
from jaxbeads.mobility import RPY, FreeDraining
from jaxbeads.near import Unknowns, near
from jaxbeads.solver.tolerance import LargestError
from jaxbeads.stages import Stage, _load, solved_stage
from jaxbeads.state import zero_motion

TIME = jnp.asarray(0.3)
FAST = {"xla_backend_optimization_level": 0}


def test_accelerated_iterations():
    rng = np.random.default_rng(0)
    a = np.eye(30) + 0.3 * rng.normal(size=(30, 30)) / 30**0.5
    a[0] *= 3.0  # plain iterations would diverge
    rhs = rng.normal(size=30)

    def linear(z):
        change = rhs - a @ z
        return change, jnp.abs(change).max()

    found = accelerated(linear, jnp.zeros(30), jnp.asarray(1e-10))
    assert found.converged and found.iterations < 25
    assert np.abs(found.solution - np.linalg.solve(a, rhs)).max() < 1e-9
    # cos z = z; nothing to do; and none.
    cosine = accelerated(
        lambda z: (jnp.cos(z) - z, jnp.abs(jnp.cos(z) - z)[0]), jnp.zeros(1), jnp.asarray(1e-12)
    )
    assert (
        abs(cosine.solution[0] - 0.7390851332151607) < 1e-12 and cosine.iterations < 15
    )  # plainly 70
    at_once = accelerated(lambda z: (0 * z, jnp.zeros(())), jnp.ones(3), jnp.asarray(0.0))
    assert at_once.iterations == 1 and (at_once.solution == 1).all()
    none = accelerated(lambda z: (1 + z**2, jnp.max(1 + z**2)), jnp.ones(1), jnp.asarray(1e-9))
    assert not none.converged


def test_iterations_end_by_what_is_left_and_not_by_their_change(monkeypatch):
    monkeypatch.setattr(iterations, "MOST_ACCELERATED", 200)

    # Nothing is learnt from steps before; a change is a tenth of what is left.
    def slow(z):
        return -0.1 * z, 0.1 * jnp.abs(z[0])

    monkeypatch.setattr(iterations, "DEPTH", 1)
    monkeypatch.setattr(iterations, "cholesky_solve", lambda factor, rhs: 0 * rhs)
    for enough in (1e-2, 1e-5):
        found = accelerated(slow, jnp.ones(1), jnp.asarray(enough))
        assert found.converged and 0.7 * enough < abs(found.solution[0]) <= 1.01 * enough


def test_a_number_that_is_none_is_not_passed_over():
    # XLA's maximum of thousands of numbers may leave them out.
    chain = Chain(1.0, (1,) * 4000)
    x = 5.0 * jnp.arange(12000.0).reshape(4000, 3)

    def force(t, at):
        return jnp.where(jnp.arange(4000)[:, None] == 7, jnp.nan, 1.0) * jnp.ones_like(at)

    scene = Scene(chain, 1.0, FreeDraining(), [], [ForceField(force)])
    chart = coordinates(scene, jb.State(x))
    found = solve(chart.origin, 1.0, 0.25, chart, scene)
    assert not found.fine and found.products == 1
    error = eqx.tree_at(lambda s: s.position, chart.start, x.at[7, 0].set(jnp.nan))
    assert np.isnan(LargestError(jnp.asarray(1.0))(error))
    still = jnp.zeros((20_000, 3)).at[:, 0].set(1.0)
    error = jb.State(still, director=still, own={"some": still})
    for part in (lambda s: s.director, lambda s: s.own["some"]):
        lost = eqx.tree_at(part, error, still.at[7].set(jnp.nan))
        assert np.isnan(LargestError(jnp.asarray(1.0))(lost))


@pytest.mark.parametrize("away", [0.0, 300.0])
def test_rounding_does_not_keep_iterations_from_ending(away):
    # Of positions: it turns the bonds of a bent fibre by more than a tenth of the tolerance.
    s = np.linspace(-1.5, 1.5, 40)[1:]
    x = away + np.cumsum(2 * np.stack([np.cos(s), np.sin(s)], axis=1), axis=0)
    chain = Chain(radius=1.0, fibres=len(x))
    scene = Scene(chain, 1.0, FreeDraining(), [Gears()], [Bending(100.0)])
    in_double = scene, jb.State(jnp.asarray(x))
    in_single = jax.tree.map(lambda x: x.astype(jnp.float32), in_double)
    double, single = (
        jb.rollout(*given, [0.0, 25600.0], solver=ESDIRK(tolerance=1e-4), single_precision=True)
        for given in (in_double, in_single)
    )
    assert single.code == double.code == 0 and single.steps < 2 * double.steps
    assert single.final.position.dtype == jnp.float32
    assert np.abs(single.final.position - double.final.position).max() < 5e-4 * 80
    assert np.abs(double.final.position - x).max() > 10


def solve(base, h, ahead, chart, model):
    """A stage at t = 0.3 from no guess."""
    rows = len(jb.dynamics.evaluate(TIME, chart.start, model).multipliers)
    guess = Unknowns(jnp.zeros_like(base), jnp.zeros(rows))
    close = near(TIME, chart.origin, jnp.asarray(ahead), chart, model, guess.multipliers)
    stage = Stage(TIME, base, jnp.asarray(ahead))
    return solved_stage(stage, jnp.asarray(h), chart, model, close, guess, jnp.asarray(1e-11))


def stage(example):
    """A scene, a chart of it, and a base near the chart's start."""
    model, state = example()
    chart, rng = coordinates(model, state), np.random.default_rng(1)
    return model, chart, 0.01 * jnp.asarray(rng.normal(size=len(chart.origin)))


@pytest.mark.parametrize("example", EXAMPLES)
def test_a_stage_fulfils_its_equations(example):
    model, chart, base = stage(example)

    @partial(jax.jit, compiler_options=FAST)
    def both(base):
        found = solve(base, 0.1, 0.025, chart, model)
        x = base + 0.025 * found.unknowns.rate
        return found, coordinate_rate(TIME, x, chart, model)

    found, expected = both(base)
    assert found.fine and found.products <= 20
    assert np.abs(found.unknowns.rate - expected).max() < 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("example", [swimmers, springs])
def test_derivatives_of_a_stage(example):
    model, chart, base = stage(example)
    h, ahead = 0.1, 0.025

    @partial(jax.jit, compiler_options=FAST)
    def both(base, shift, pull):
        rate, push = jax.linearize(lambda b: solve(b, h, ahead, chart, model).unknowns.rate, base)
        back = jax.linear_transpose(push, shift)(pull)[0]
        x = base + ahead * rate
        jacobian = jax.jacfwd(lambda x: coordinate_rate(TIME, x, chart, model))(x)
        return push(shift), back, jacobian

    rng = np.random.default_rng(2)
    shift, pull = (jnp.asarray(rng.normal(size=len(base))) for _ in range(2))
    moved, back, jacobian = both(base, shift, pull)
    # k = f(b + g k): dk = (1 - g W)^-1 W db.
    implicit = np.linalg.solve(np.eye(len(base)) - ahead * jacobian, jacobian)
    for mine, expected in ((moved, implicit @ shift), (back, implicit.T @ pull)):
        assert np.abs(mine - expected).max() < 1e-7 * np.abs(expected).max()


def suspension(beads=(5, 3, 4), dense=False, rigidity=30.0, weight=1.0):
    """Fibres of unequal length, not far apart, that settle."""
    chain, rng = Chain(1.0, beads), np.random.default_rng(0)
    directions = rng.normal(size=(len(beads), 3))
    places = 7.0 * np.eye(3)[: len(beads)]
    forces = [Weight(jnp.array([0.0, -1.0, 0.1]) * weight), Bending(rigidity)]
    forces.append(Contact(1.0, 0.1, 0.1))
    model = Scene(chain, 1.0, RPY(dense=dense), constraints=[Gears()], forces=forces)
    return model, jb.straight(chain, directions, places)


def test_steps_are_those_of_the_dense_scene():
    model, state = suspension()
    dense, _ = suspension(dense=True)
    ts, length = [0.0, 40.0, 100.0], 10.0
    expected = jb.rollout(dense, state, ts, solver=jb.Rosenbrock(tolerance=1e-8))
    last = np.inf
    for tolerance in (1e-4, 1e-6):
        found = jb.rollout(model, state, ts, solver=ESDIRK(tolerance=tolerance))
        off = np.abs(found.states.position - expected.states.position).max() / length
        assert found.code == 0 and found.bond_length_error.max() < 1e-13
        assert off < 30 * tolerance and off < 0.2 * last
        last = off
    few = jb.rollout(dense, state, ts, solver=jb.Rosenbrock(tolerance=1e-6)).steps
    assert found.steps < 1.5 * few


def test_gradients_of_steps_are_those_of_differences():
    chain, solver = Chain(1.0, (3, 2)), ESDIRK(substeps=3)
    state = jb.straight(chain, [[1.0, 0.3], [0.2, 1.0]], [[0.0, 0.0], [0.5, 5.0]])

    def height(x):
        forces = [Weight(x[0] * jnp.array([0.1, -1.0])), Bending(x[1])]
        model = Scene(chain, 1.0, RPY(dense=False), constraints=[Gears()], forces=forces)
        end = jb.rollout(model, state, [0.0, 60.0], solver=solver).final.position
        return jnp.sum(end[:, 1] * jnp.arange(5.0))

    x = jnp.array([1.0, 30.0])
    reverse = jax.jit(jax.grad(height), compiler_options=FAST)(x)
    forward = jax.jit(jax.jacfwd(height), compiler_options=FAST)(x)
    value = jax.jit(height, compiler_options=FAST)
    for k in range(2):
        step = 1e-4 * x[k] * jnp.eye(2)[k]
        slope = (value(x + step) - value(x - step)) / (2e-4 * x[k])
        assert abs(reverse[k] / slope - 1) < 1e-6 and abs(forward[k] / slope - 1) < 1e-6


def test_units_do_not_matter():
    model, state = suspension(beads=(5, 4))
    large = in_units(model, (1e-6, 1e-3, 1e-12))
    there = jb.State(1e-6 * state.position)
    solver, ends = ESDIRK(tolerance=1e-5), []
    for scene, start, end in ((model, state, 50.0), (large, there, 50.0e-3)):
        run = jb.rollout(scene, start, [0.0, end], solver=solver)
        ends.append((run.final.position / start.position.max(), int(run.steps)))
    assert ends[0][1] == ends[1][1] and np.abs(ends[0][0] - ends[1][0]).max() < 1e-6


def test_single_precision():
    model, state = suspension(beads=(4, 3))
    exact = jb.rollout(model, state, [0.0, 40.0], solver=ESDIRK(tolerance=1e-7)).final.position

    def single(tree):
        inexact, rest = eqx.partition(tree, eqx.is_inexact_array)
        return eqx.combine(jax.tree.map(lambda x: x.astype(jnp.float32), inexact), rest)

    for solver in (ESDIRK(tolerance=1e-4), ESDIRK(substeps=8)):
        run = jb.rollout(
            single(model), single(state), [0.0, 40.0], solver=solver, single_precision=True
        )
        assert run.code == 0 and run.final.position.dtype == jnp.float32
        assert np.abs(run.final.position - exact).max() < 2e-4 * 8.0


@pytest.mark.parametrize("beads", [(1,), (2,), (1, 1), (4, 1, 3)], ids=str)
def test_few_beads_late_and_far_away(beads):
    chain = Chain(1.0, beads)
    rng, there = np.random.default_rng(3), -50.0 + 9.0 * np.arange(len(beads))[:, None] * np.ones(3)
    state = jb.straight(chain, -np.abs(rng.normal(size=(len(beads), 3))), there)
    forces = [Weight([0.1, -1.0, 0.3]), Bending(30.0)]
    forces.append(ForceField(lambda t, x: jnp.where(t > 1e6 + 23.7, 0.5, -0.5) + 0 * x))
    model = Scene(chain, 1.0, constraints=[Gears()], forces=forces)
    ts = [1e6, 1e6 + 60.0]
    found = jb.rollout(model, state, ts, solver=ESDIRK(tolerance=1e-6))
    expected = jb.rollout(model, state, ts, solver=jb.Rosenbrock(tolerance=1e-8))
    assert found.code == 0
    assert np.abs(found.final.position - expected.final.position).max() < 1e-5 * 8.0


@pytest.fixture
def coarse(monkeypatch):
    """Coarse products of few beads; how much is near is as in large scenes."""
    monkeypatch.setattr(segments, "BEADS", 25)
    monkeypatch.setattr(segments, "LEAST", 0)
    monkeypatch.setattr(segments, "LEAST_COARSE", 0)


def crowd(far_error=1e-5, fibres=8, beads=50):
    """Fibres that settle close to one another, and a step of theirs."""
    case = jb.scenes.cloud(fibres, beads, 100.0, 0.3)
    scene = eqx.tree_at(lambda s: s.mobility, case.scene, RPY(far_error=far_error, dense=False))
    return scene, case.state, 0.004 * float(case.ts[-1])


def test_iterations_that_learn():
    # f = c - A z with A near 1, known but for a slope of 3 % and all that is constant.
    rng = np.random.default_rng(3)
    matrix = jnp.eye(40) + 0.05 * jnp.asarray(rng.normal(size=(40, 40)))
    most, dear = 0.03 * jnp.asarray(rng.normal(size=(40, 40))) / 7, []
    solution = jnp.asarray(rng.normal(size=40))

    def rest(z):
        return matrix @ solution + most @ (solution - z)

    def cheap(z, rest):
        change = rest - matrix @ z
        return change, jnp.abs(change).max()

    def learn(z):
        jax.debug.callback(lambda: dear.append(1))
        return *cheap(z, rest(z)), rest(z)

    found = learning(cheap, learn, jnp.zeros(40), jnp.zeros(40), jnp.asarray(1e-5))
    jax.effects_barrier()
    assert found.converged and np.abs(found.solution - solution).max() < 2e-5
    assert np.abs(found.known - rest(solution)).max() < 1e-5
    assert 2 <= len(dear) <= 6 and found.iterations > 2 * len(dear)


def test_coarse_products_change_no_stage(coarse):
    scene, state, h = crowd()
    chart, ahead = coordinates(scene, state), 0.25 * h
    still = zero_motion(state, True)
    rows = jb.dynamics.evaluate(TIME, state, scene).multipliers
    guess = Unknowns(jnp.zeros_like(chart.origin), rows)
    at = Stage(TIME, chart.origin, jnp.asarray(ahead))

    @partial(jax.jit, compiler_options=FAST)
    def both():
        close = near(TIME, chart.origin, at.ahead, chart, scene, guess.multipliers)
        given = at, jnp.asarray(h), chart, scene, close, guess, jnp.asarray(1e-6)
        plain, found = solved_stage(*given), solved_stage(*given, still)
        return plain, found, solved_stage(*given, found.left_out)

    plain, found, again = both()
    assert plain.fine and plain.left_out is None
    for one in (found, again):
        off = h * np.abs(one.unknowns.rate - plain.unknowns.rate) / chart.units
        assert one.fine and off.max() < 4e-6
    assert again.products < found.products
    end = chart.state(ahead * found.unknowns.rate)
    load = _load(TIME, ahead * found.unknowns.rate, found.unknowns.multipliers, chart, scene)
    operator = scene.operator(end)
    left_out = operator.product(load, exact=False).velocity - operator.coarse(load).velocity
    scale = np.abs(left_out).max()
    assert np.abs(found.left_out.velocity - left_out).max() < 1e-2 * scale


@pytest.mark.slow
def test_steps_by_coarse_products(coarse):
    scene, state, h = crowd(fibres=4)

    def end(scene, far_error):
        mobility = RPY(far_error=far_error, dense=False)
        scene = eqx.tree_at(lambda s: s.mobility, scene, mobility)
        moved = jb.rollout(scene, state, [0.0, 4 * h], solver=ESDIRK(tolerance=1e-6))
        return moved.final.position

    @partial(jax.jit, static_argnums=1, compiler_options=FAST)
    def pushed(weight, far_error):
        def of(weight):
            heavier = eqx.tree_at(lambda s: s.forces[0].force, scene, weight)
            return end(heavier, far_error)

        return jax.jvp(of, (weight,), (0.1 * weight,))

    weight = scene.forces[0].force
    x, push = pushed(weight, 1e-5)
    exact, exact_push = pushed(weight, 0.0)
    length = float(jnp.max(scene.chain.length))
    assert np.abs(x - exact).max() < 3e-5 * length
    assert np.abs(push - exact_push).max() < 1e-3 * np.abs(exact_push).max()
