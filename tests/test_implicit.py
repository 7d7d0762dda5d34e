"""The linearly implicit solver: exact derivatives, coordinates, accuracy, and how it fails."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import FORCES, bent
from examples import EXAMPLES, held, spun

import jaxbeads as jb
from jaxbeads import (
    AB3,
    Chain,
    Scene,
    Setting,
    SimulationError,
    State,
    dynamics,
    rollout,
    simulate,
)
from jaxbeads.actuation import TravellingWave
from jaxbeads.breakdown import explain
from jaxbeads.constraint import (
    Gears,
)
from jaxbeads.coordinates import coordinates, project
from jaxbeads.force import (
    AbstractForce,
    Bending,
    BendingEnergy,
    Contact,
    JointBending,
    Spring,
    Weight,
)
from jaxbeads.linearise import coordinate_rate, linearise
from jaxbeads.rollout import default_solver
from jaxbeads.solver import Rosenbrock


@pytest.mark.parametrize("example", EXAMPLES)
def test_linearisation_and_coordinates(example):
    model, state = example()
    chart, t = coordinates(model, state), jnp.asarray(0.3)

    @partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})  # faster to compile
    def both(t, x, displaced):
        def f(t, x):
            return coordinate_rate(t, x, chart, model)

        brute = f(t, x), jax.jacfwd(f, 0)(t, x), jax.jacfwd(f, 1)(t, x)
        # Away from the start: dx/dt moves the state as the beads move.
        there = chart.state(displaced)
        moved = jax.jvp(chart.state, (displaced,), (f(t, displaced),))[1]
        about = linearise(t, chart, model)
        mine = about.rate, about.time_derivative, about.jacobian(), about.product(displaced)
        return mine, brute, there, moved, dynamics.rate(t, there, model)

    x = chart.origin
    displaced = 0.3 * jnp.sin(jnp.arange(len(x)) + 0.5)
    found, brute, there, moved, rate = both(t, x, displaced)
    for mine, reference in zip(found, (*brute, brute[2] @ displaced), strict=True):
        assert np.abs(mine - reference).max() <= 1e-12 * max(1.0, np.abs(reference).max())
    assert np.abs(brute[2]).max() > 1e-3
    for mine, reference in zip(jax.tree.leaves(moved), jax.tree.leaves(rate), strict=True):
        assert np.abs(mine - reference).max() < 1e-12
    # The start is that of the chart; bonds keep their lengths anywhere in it.
    start = chart.state(x)
    for mine, given in zip(jax.tree.leaves(start), jax.tree.leaves(state), strict=True):
        assert np.abs(mine - given).max() < 1e-14
    if model.constraints:
        assert (
            np.abs(np.asarray(model.constraints[0].bond_errors(there, model.chain))).max() < 1e-15
        )


def test_coordinates_place_a_fibre_by_its_held_bead():
    model, state = held()
    off = State(state.position * 1.001)
    restored = project(model, off)
    assert np.all(restored.position[0] == off.position[0])
    assert np.abs(np.asarray(Gears().bond_errors(restored, model.chain))).max() < 1e-15
    free = Scene(model.chain, 1.0, constraints=[Gears()])
    centre = project(free, off).position.mean(axis=0)
    assert np.abs(centre - off.position.mean(axis=0)).max() < 1e-14
    # A bead of a fibre given by its number from the end.
    tail, state = spun()
    off = State(state.position * 1.001, state.director)
    assert np.abs(project(tail, off).position[-1] - off.position[-1]).max() < 1e-14


def test_states_between_steps_are_of_order_three_at_least():
    # One step over h, then the state in its middle, against two steps of half the length and more.
    model, state = held()
    step = jax.jit(lambda h: solved(model, state, h))
    errors = [step(h) for h in (0.2, 0.1, 0.05)]
    slopes = np.diff(np.log(errors)) / -np.log(2)
    assert np.all(slopes > 3.7), (errors, slopes)  # a cubic leaves h^4 in one step
    assert errors[-1] > 1e-12


def solved(model, state, h):
    solver, t = Rosenbrock().scheme, jnp.asarray(0.3)

    def step(t0, t1, state):
        return solver.step(None, t0, t1, state, model, None, False)

    end, _, dense, _, _ = step(t, t + h, state)
    between = solver.interpolation_cls(t0=t, t1=t + h, **dense)

    def small(state, k):
        return step(t + k * h / 16, t + (k + 1) * h / 16, state)[0], None

    exact = jax.lax.scan(small, state, jnp.arange(8))[0]
    assert np.shape(between.evaluate(t + h).position) == np.shape(end.position)
    return jnp.abs(between.evaluate(t + h / 2).position - exact.position).max()


def test_tolerance_means_a_fraction_of_the_length():
    # A stiff, driven fibre; the run with 1e-9 stands for the exact solution. Bonds hold at any step.
    chain = Chain(0.5, 8)
    bending = Bending(100.0, TravellingWave(0.4, 2 * np.pi / 8, 0.2))
    model = Scene(chain, 1.0, constraints=[Gears()], forces=[bending, Weight([0.3, -1.0])])
    state, ts = bent(chain), np.linspace(0.0, 20.0, 21)
    run = jax.jit(lambda tolerance: rollout(model, state, ts, tolerance=tolerance))
    exact, steps = run(1e-9), []
    for tolerance in (1e-2, 1e-4, 1e-6):
        solution = run(tolerance)
        assert int(solution.code) == 0
        error = np.linalg.norm(solution.states.position - exact.states.position, axis=2).max()
        assert error < 10 * tolerance * 8.0, (tolerance, error)
        assert np.max(solution.bond_length_error[1:]) < 1e-14
        steps.append(int(solution.steps))
    assert steps[0] < steps[1] < steps[2] < int(exact.steps)
    # Its accuracy, not the fastest bending rate, bounds the step.
    assert steps[1] < 20.0 / float(jb.solver.explicit_step(model)) / 10
    # In other units, and in the explicit scheme: the same.
    limit = rollout(model, state, ts, solver=AB3(substeps=4000))
    assert np.abs(limit.final.position - exact.final.position).max() < 1e-5


def test_stiffness_costs_no_steps():
    # A bent fibre straightens within a fast time; a million of them are reached in few steps more.
    chain = Chain(1.0, 4)
    fast = Scene(chain, 1.0, constraints=[Gears()], forces=[Bending(1e6)])
    run = jax.jit(lambda end: rollout(fast, bent(chain), end * np.linspace(0, 1, 3)))
    short, long = run(1e-4), run(100.0)
    bonds = np.diff(long.final.position, axis=0) / 2
    assert np.abs(bonds - bonds[0]).max() < 1e-9
    assert int(long.steps) < int(short.steps) + 30


def test_its_scheme_is_a_diffrax_solver():
    chain = Chain(1.0, 4)
    model, state = Scene(chain, 1.0, constraints=[Gears()], forces=[Bending(3.0)]), bent(chain)
    term = diffrax.ODETerm(lambda t, y, scene: dynamics.rate(t, y, scene))
    controller = diffrax.PIDController(rtol=0.0, atol=1e-7)
    found = diffrax.diffeqsolve(
        term, Rosenbrock().scheme, 0.0, 1.0, 0.01, state, model, stepsize_controller=controller
    ).ys.position[-1]
    own = rollout(model, state, [0.0, 1.0], tolerance=1e-8).final.position
    assert np.abs(found - own).max() < 1e-6


def test_the_default_solver_fits_the_scene():
    chain = Chain(1.0, 4)
    stiff = [Bending(1.0), BendingEnergy(1.0), Spring(1.0), JointBending(1.0)]
    for force in stiff:
        assert isinstance(default_solver(Scene(chain, 1.0, forces=[force])), Rosenbrock)
    for forces in ([], [Weight([0.0, -1.0])], [Contact(1.0, 0.1, 0.1)]):
        assert default_solver(Scene(chain, 1.0, forces=forces)).name == "Tsit5"


def kinds(kind):
    for other in kind.__subclasses__():
        yield other
        yield from kinds(other)


def test_a_force_that_bounds_explicit_steps_is_declared_stiff():
    own = [k for k in kinds(AbstractForce) if k.__module__.startswith("jaxbeads.")]
    assert {k.__name__ for k in own} > {"Bending", "Weight"}
    for kind in own:
        assert kind.stiff == (kind.explicit_step is not AbstractForce.explicit_step), kind
    chain = Chain(1.0, 9)
    for force in FORCES:
        assert force.stiff == bool(np.isfinite(force.explicit_step(Setting(chain, 1.0))))


def test_a_step_that_fails_is_made_smaller():
    # A force that is not a number beyond a line: steps across it are tried again, then the run stops
    # and says where.
    def wall(t, x):
        return jnp.where(x[:, 1:] < -3.0, jnp.nan, 0.0) * x

    chain = Chain(1.0, 4)
    forces = [Weight([0.0, -1.0]), Bending(4.0), jb.force.ForceField(wall)]
    model = Scene(chain, 1.0, constraints=[Gears()], forces=forces)
    with pytest.raises(SimulationError, match=r"no step, down to .* finite numbers") as caught:
        simulate(model, bent(chain), np.linspace(0.0, 400.0, 5), progress=False)
    assert "Loosen `tolerance`" in str(caught.value)
    assert caught.value.cause.time > 0


def test_beads_that_pass_through_one_another_are_named():
    # A hairpin whose arms overlap: the message names the beads, and the remedy unless it is there.
    chain = Chain(1.0, 5)
    turn = np.array([0.0, 0.3, 2.8, 3.1])
    state = State(jb.from_tangents(chain, np.stack([np.cos(turn), np.sin(turn)], axis=1)))
    bare = Scene(chain, 1.0, constraints=[Gears()], forces=[Bending(1.0)])
    held = Scene(chain, 1.0, constraints=[Gears()], forces=[Bending(1.0), Contact(1.0, 0.1, 0.1)])
    told = explain(bare, state, 0.0, 0, None).message
    assert "The smallest gap is -" in told and "`Contact` keeps beads apart" in told
    assert "`Contact` keeps beads apart" not in explain(held, state, 0.0, 0, None).message
    assert "pass through" not in explain(bare, bent(chain), 0.0, 0, None).message
