"""Time stepping: order, drift, gradients, one trace, and the pure and the watched run (T5, T6, T14)."""

import dataclasses
from functools import cache, partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import SOLVERS, bent, name, scene

import jaxbeads
from jaxbeads import AB3, Chain, Outcome, Scene, dynamics, rollout, simulate, straight
from jaxbeads.actuation import TravellingWave
from jaxbeads.constraint import Gears
from jaxbeads.flow import OscillatingShear
from jaxbeads.force import Bending, BendingEnergy, Weight
from jaxbeads.solver import Diffrax, Rosenbrock, explicit_step, substeps_for
from jaxbeads.solver.tolerance import Eased
from jaxbeads.state import State

CHAIN = Chain(1.0, 5)
TIMES = np.linspace(0.0, 4.0, 3)


def moving(flow=True, rigidity=4.0):
    """A scene that depends on time and is not stiff, and its start."""
    extra = {"flow": OscillatingShear(0.7, 2.0)} if flow else {}
    return Scene(
        CHAIN, 1.0, constraints=[Gears()], forces=[Weight([0.2, -1.0]), Bending(rigidity)], **extra
    ), bent(CHAIN)


@cache
def exact(**options):
    """States of `moving` at TIMES, to 1e-13."""
    model, state = moving(**options)
    return rollout(model, state, TIMES, solver=diffrax.Dopri8(), substeps=400).states.position


@pytest.mark.parametrize("solver, order", SOLVERS, ids=name)
def test_observed_order(solver, order):
    # Gate T6: four halvings, start-up included, against a solution that is 1e-13 exact. Every step is
    # an interval of `simulate`, whose program does not depend on their number.
    # (The implicit one meets a stiff fibre: in an unsteady flow terms of order 5 hide those of 4.)
    options = {"flow": False, "rigidity": 40.0} if order == 4 else {}
    model, state = moving(**options)
    first = {1: 1600, 2: 200, 3: 200, 4: 3}[order]
    errors, solver = [], dataclasses.replace(solver, substeps=1)
    for steps in (first * 2**k for k in range(5)):
        ts = np.linspace(TIMES[0], TIMES[-1], steps + 1)
        run = simulate(model, state, ts, solver=solver, chunk=100, progress=False)
        errors.append(float(jnp.abs(run.final.position - exact(**options)[-1]).max()))
    slopes = np.diff(np.log(errors)) / -np.log(2)
    assert errors[-1] > 1e-12  # else rounding is measured
    assert abs(slopes[-1] - order) < 0.1, (errors, slopes)


@pytest.mark.parametrize("solver, _", SOLVERS, ids=name)
def test_what_a_solver_declares(solver, _):
    model, state = moving()
    run = rollout(model, state, TIMES, solver=dataclasses.replace(solver, substeps=100))
    assert run.solver == solver.name
    assert bool(np.max(run.bond_length_error) < 1e-13) == solver.keeps_bonds
    by_error = partial(dataclasses.replace, solver, tolerance=1e-5)
    if solver.estimates_error:
        assert int(rollout(model, state, TIMES, solver=by_error()).code) == 0
    else:
        with pytest.raises(ValueError, match=f"estimate its error, but {solver.name} does not"):
            by_error()
    uneven = [0.0, 0.1, 0.3]
    if solver.equal_steps:
        with pytest.raises(ValueError, match=f"evenly spaced for {solver.name}"):
            rollout(model, state, uneven, solver=solver)
    else:
        assert rollout(model, state, uneven, solver=solver).ts.shape == (3,)


def test_the_implicit_solver_keeps_its_order_in_unsteady_scenes():
    # The time enters its stages and its drift; without either the order falls to 1 or 2.
    model, state = moving()
    errors = []
    for substeps in (5, 10, 20):
        run = rollout(model, state, TIMES, solver=Rosenbrock(substeps=substeps))
        errors.append(float(jnp.abs(run.final.position - exact()[-1]).max()))
    assert np.all(np.diff(np.log(errors)) / -np.log(2) > 3.9), errors
    assert errors[-1] > 1e-12


def test_projection_keeps_the_order():
    model, state = moving()
    errors = []
    for substeps in (200, 400, 800):
        run = rollout(model, state, TIMES, solver=AB3(substeps=substeps, projected=True))
        errors.append(float(jnp.abs(run.final.position - exact()[-1]).max()))
        error = np.abs(np.asarray(Gears().bond_errors(run.final, CHAIN))).max()
        assert error < 1e-14
    slopes = np.diff(np.log(errors)) / -np.log(2)
    assert abs(slopes[-1] - 3) < 0.1


@pytest.mark.slow
def test_drift_after_many_steps():
    # Gate T5: residual 1e-12 at each step; bond lengths to 1e-8 a after 1e5 AB3 steps at (39).
    # The settling fibre at B = 100; the drift grows with the displacement of a bead in a step.
    case = jaxbeads.scenes.settling(34, 100.0)
    step, start = float(explicit_step(case.scene)), case.state
    times = np.arange(51) * 2000 * step
    solution = simulate(case.scene, start, times, substeps=2000, progress=False)
    assert int(solution.steps) == 100_000
    assert np.max(solution.bond_length_error) * 2 < 1e-8
    each = simulate(case.scene, start, np.arange(2001) * step, substeps=1, progress=False)
    assert np.max(each.residual) < 1e-12
    # A softer fibre drifts more; the projection removes it.
    case = jaxbeads.scenes.settling(34, 3000.0)
    times = np.arange(11) * 1000 * float(explicit_step(case.scene))
    free = simulate(case.scene, case.state, times, substeps=1000, progress=False)
    solver = AB3(substeps=1000, projected=True)
    kept = simulate(case.scene, case.state, times, solver=solver, progress=False)
    assert np.max(free.bond_length_error) > 1e-8
    assert np.max(kept.bond_length_error) < 1e-13


def test_paper_step_and_stability_limit():
    # Eq. (39), and the claim that AB3 is stable to about 2.2 times it.
    chain = Chain(0.5, 20)
    model = Scene(chain, 2.0, constraints=[Gears()], forces=[Bending(np.linspace(1.0, 3.0, 18))])
    assert abs(float(explicit_step(model)) - 2.0 / 3.0) < 1e-15
    assert np.isinf(explicit_step(Scene(chain, 1.0)))
    model = Scene(Chain(1.0, 20), 1.0, constraints=[Gears()], forces=[Bending(1.0)])
    flat = straight(model.chain, [1.0, 0.0])

    def lateral(y):
        moved = eqx.tree_at(lambda s: s.position, flat, flat.position.at[:, 1].set(y))
        return dynamics.motion(0.0, moved, model).velocity[:, 1]

    rates = np.linalg.eigvals(jax.jit(jax.jacfwd(lateral))(jnp.zeros(20))).real
    assert abs(-rates.min() * float(explicit_step(model)) - 0.25) < 0.01
    limit = 6 / 11 / 0.25  # AB3 is stable on the real axis to 6/11
    assert 2.1 < limit < 2.3


def test_rollout_and_simulate_agree():
    model, state = moving()
    pure = jax.jit(lambda m, s: rollout(m, s, TIMES, substeps=50))(model, state)
    watched = simulate(model, state, TIMES, substeps=50, progress=False)
    assert np.abs(pure.states.position - watched.states.position).max() < 1e-13
    assert watched.status == "finished" and int(watched.steps) == 100
    assert watched.compile_s <= watched.wall_s


@pytest.mark.parametrize("solver", [diffrax.Tsit5(), diffrax.Kvaerno3()], ids=name)
def test_adaptive_steps(solver):
    # The error follows the tolerance; save times lie between steps.
    model, state = moving()
    errors, steps = [], []
    for tolerance in (1e-4, 1e-8):
        controller = diffrax.PIDController(rtol=0.0, atol=tolerance)
        by = Diffrax(solver, controller=controller)
        run = simulate(model, state, TIMES, solver=by, progress=False)
        errors.append(float(jnp.abs(run.states.position - exact()).max()))
        steps.append(int(run.steps))
        assert int(run.code) == 0
        assert errors[-1] < 100 * tolerance
    assert steps[1] > 1.5 * steps[0]


def test_steps_of_a_known_scene_are_found_within_a_program():
    model = Scene(Chain(1.0, 3), 1.0, constraints=[Gears()], forces=[Bending(16.0)])
    found = jax.jit(lambda x: x * substeps_for(model, [0.0, 10.0]))(1.0)  # safe steps of 1
    assert int(found) == substeps_for(model, [0.0, 10.0]) >= 10
    with pytest.raises(ValueError, match="`ts` must hold known numbers"):
        jax.jit(lambda t: substeps_for(model, t))(jnp.asarray([0.0, 10.0]))


def test_rollout_says_when_its_steps_are_too_long():
    # Finite, plausible numbers of an active fibre whose bonds are far off: under jit only `code` tells.
    chain = Chain(1.0, 8)
    bending = Bending(400.0, TravellingWave(0.1, 2 * np.pi / 16, 0.01))
    model = Scene(chain, 1.0, constraints=[Gears()], forces=[bending])
    state, ts = straight(chain, [1.0, 0.0]), np.linspace(0, 20, 5)
    run = jax.jit(lambda n: rollout(model, state, ts, substeps=n), static_argnums=0)
    short, long = run(substeps_for(model, ts)), run(20)
    assert int(short.code) == 0 and np.max(short.bond_length_error) < 1e-3
    assert int(long.code) == Outcome.BROKEN and np.max(long.bond_length_error) > 0.01
    assert np.all(np.isfinite(long.states.position))
    twice = Scene(chain, 1.0, constraints=[Gears(), Gears()], forces=[bending])
    assert int(rollout(twice, state, ts, substeps=1).code) == Outcome.BROKEN  # NaN, and said so


def test_vmap_equals_loop():
    model, state = moving()
    rigidities = jnp.array([1.0, 4.0, 9.0])

    def final(rigidity, solver):
        varied = eqx.tree_at(lambda m: m.forces[1].rigidity, model, rigidity)
        return rollout(varied, state, TIMES, solver=solver).final.position

    solvers = [
        AB3(substeps=40),
        Diffrax(diffrax.Tsit5(), controller=diffrax.PIDController(rtol=0.0, atol=1e-6)),
        Rosenbrock(tolerance=1e-5),
    ]
    for solver in solvers:
        one = partial(final, solver=solver)
        batch, alone = jax.jit(jax.vmap(one))(rigidities), jax.jit(one)
        for k, member in zip(rigidities, batch, strict=True):
            assert np.abs(alone(k) - member).max() < 1e-12


@pytest.mark.parametrize(
    "solver, dim", [("AB3", 2), ("AB3", 3), ("Tsit5", 2), ("adaptive", 2), ("Rosenbrock", 2)]
)
def test_gradient_of_a_trajectory(solver, dim):
    # Reverse mode against central differences, with respect to every number of scene and state.
    chain = Chain(1.0, 5)
    model, state = (
        scene(chain, dim, forces=[Weight(np.array([0.1, -0.4, 0.2])[:dim]), Bending(4.0)]),
        bent(chain, dim),
    )

    def value(model, state, tolerance):
        options = {
            "AB3": {"substeps": 20},
            "Tsit5": {"solver": diffrax.Tsit5(), "substeps": 5},
            "adaptive": {"solver": Diffrax(diffrax.Tsit5(), tolerance=tolerance, max_steps=256)},
            "Rosenbrock": {"solver": Rosenbrock(substeps=3)},
        }[solver]
        return jnp.sum(jnp.sin(rollout(model, state, TIMES, **options).states.position))

    tight = 1e-11
    value_and_grad = jax.jit(jax.value_and_grad(value, argnums=(0, 1)))
    leaves, tree = jax.tree.flatten((model, state))
    rng = np.random.default_rng(1)
    direction = [jnp.asarray(rng.normal(size=np.shape(x))) for x in leaves]

    def moved(step):
        return jax.tree.unflatten(
            tree, [x + step * d for x, d in zip(leaves, direction, strict=True)]
        )

    def reverse(tolerance):
        slopes = jax.tree.leaves(value_and_grad(model, state, tolerance)[1])
        return sum(float(jnp.vdot(a, b)) for a, b in zip(direction, slopes, strict=True))

    h = 1e-5

    def at(step):
        return float(value_and_grad(*moved(step), tight)[0])

    difference = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
    dot = reverse(tight)
    assert np.isfinite(dot)
    assert abs(difference - dot) < 1e-6 * abs(dot)
    if dim == 2:
        # And against forward mode: at a tolerance far above rounding, which else changes the steps.
        along = jax.jit(lambda s: jax.jvp(lambda step: value(*moved(step), 1e-5), (s,), (1.0,)))
        forward = along(0.0)[1]
        assert abs(forward - reverse(1e-5)) < 1e-10 * abs(forward)


def test_one_trace_for_fifty_parameter_sets():
    # Gate T14: numbers are leaves, so a new value compiles nothing.
    traces = []

    @jax.jit
    def final(model, state):
        traces.append(1)
        return rollout(model, state, TIMES, substeps=5).final.position

    results = []
    for k in range(50):
        chain = Chain(1.0 + 0.001 * k, 5)
        forces = [Weight([0.1 * k, -1.0]), Bending(1.0 + k, 0.01 * k), BendingEnergy(k)]
        model = Scene(
            chain, 1 + k, constraints=[Gears()], forces=forces, flow=OscillatingShear(k, 1.0)
        )
        results.append(np.asarray(final(model, straight(chain, [1.0, 0.0]))))
    assert len(traces) == 1
    assert len({r.tobytes() for r in results}) == 50


def test_until_stops_early():
    model, state = moving()
    run = simulate(
        model,
        state,
        np.linspace(0, 4, 9),
        substeps=10,
        progress=False,
        chunk=1,
        until=lambda s: bool(s.ts[-1] >= 1.5),
    )
    assert run.status == "stopped by `until`"
    assert abs(float(run.ts[-1]) - 1.5) < 1e-12


def test_single_precision_when_asked_for():
    # Float32 is workable for small chains; its error is stated here, against the same run in float64.
    model, state = moving()
    low = jax.tree.map(lambda x: x.astype(jnp.float32), (model, state))
    run = simulate(*low, TIMES, substeps=40, progress=False, single_precision=True)
    exact = simulate(model, state, TIMES, substeps=40, progress=False)
    assert run.states.position.dtype == jnp.float32
    assert 1e-8 < np.abs(run.states.position - exact.states.position).max() < 1e-4


@pytest.mark.parametrize("solver", [Diffrax(diffrax.Tsit5()), Rosenbrock()], ids=name)
def test_derivatives_by_the_times(solver):
    # The first step is tried several times here: the time at which it starts counts all the same.
    model, state = moving()
    solver = dataclasses.replace(solver, tolerance=1e-10)

    def value(ts):
        run = rollout(model, state, ts, solver=solver)
        return jnp.sum(jnp.sin(run.states.position))

    ts, h = jnp.array([0.3, 1.1, 2.0]), 1e-4
    reverse = jax.jit(jax.grad(value))(ts)
    pushed = jax.jit(lambda ts, along: jax.jvp(value, (ts,), (along,)))  # values and derivatives
    for k, unit in enumerate(np.eye(3)):
        (_, forward), steps = pushed(ts, unit), (h, 2 * h)
        near, far = (pushed(ts + s * unit, unit)[0] - pushed(ts - s * unit, unit)[0] for s in steps)
        difference = (8 * near - far) / (12 * h)
        assert abs(difference) > 1e-3
        assert abs(reverse[k] - difference) < 1e-6 * abs(difference)
        assert abs(reverse[k] - forward) < 1e-12 * abs(difference)


BATCHES = [{"substeps": 5}, {"solver": diffrax.Tsit5()}, {"solver": Rosenbrock()}]


@pytest.mark.parametrize("options", BATCHES, ids=str)
def test_gradients_of_a_batch(options):
    # Members differ in a parameter, not in their start: derivatives of all of them, inside and outside.
    model, state = moving(flow=False)

    def end(viscosity):
        changed = eqx.tree_at(lambda m: m.viscosity, model, viscosity)
        return rollout(changed, state, TIMES[:3], **options).final.position[0, 1]

    viscosities = jnp.array([0.8, 1.0, 1.7])
    alone = jnp.stack([jax.jit(jax.grad(end))(v) for v in viscosities])
    together = jax.jit(jax.grad(lambda v: jnp.sum(jax.vmap(end)(v))))(viscosities)
    assert np.abs(together / alone - 1).max() < 1e-10
    if "substeps" in options:
        inside = jax.jit(jax.vmap(jax.grad(end)))(viscosities)
        assert np.abs(inside / alone - 1).max() < 1e-10


def test_steps_are_eased_before_their_error_is_too_large():
    # A step is five long, its error the allowed one times `size`, and the error before was `before`.
    eased = Eased(jnp.asarray(1e-3), jnp.asarray(20.0))

    def after(size, before=1.0):
        state = State(jnp.zeros((2, 3)))
        off = state.position.at[1, 2].set(-size * 20e-3)
        error = eqx.tree_at(lambda s: s.position, state, off)
        keep, begin, end, jump, last, _ = eased.adapt_step_size(
            2.0, 7.0, state, state, None, error, 4, jnp.asarray(before)
        )
        assert not jump and float(begin) == (7.0 if keep else 2.0)
        assert float(last) == pytest.approx(max(size, 1e-6) if keep else before, rel=1e-12)
        return bool(keep), float(end - begin) / 5

    assert after(0.5, 0.25) == (True, pytest.approx(0.9 * 2**0.25 * 0.25**0.075))
    assert after(0.99)[0] and after(0.99)[1] < 0.91  # shorter, though it is kept
    assert after(0.0) == (True, pytest.approx(10.0))
    assert after(1.01) == (False, pytest.approx(0.6))
    assert after(168.0, 1e-3) == (False, pytest.approx(0.9 * 168**-0.25))
    assert after(1e9) == (False, pytest.approx(0.2))
    for none in (np.inf, np.nan):
        assert after(none) == (False, pytest.approx(0.5))
