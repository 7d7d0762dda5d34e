"""What is called again with other numbers is not compiled again."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent

import jaxbeads as jb
from jaxbeads import Chain, Scene, Solution, State, objectives, observables, rollout, simulate
from jaxbeads.constraint import Gears, clamped
from jaxbeads.force import Bending, Weight
from jaxbeads.solver import Diffrax, Rosenbrock
from jaxbeads.solver.rosenbrock import Rodas

COMPILING = "/jax/core/compile/jaxpr_to_mlir_module_duration"


@pytest.fixture
def programs():
    """One entry for each program that is made."""
    made = []

    def listen(event, duration_secs, **_):
        if event == COMPILING:
            made.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    jax.jit(lambda x: x + 1)(1.0)
    assert made  # it hears
    yield made
    jax.monitoring.unregister_event_duration_listener(listen)


def made_by_each(programs, call, cases):
    """How many programs each of the calls makes."""
    counts = []
    for case in cases:
        programs.clear()
        jax.block_until_ready(call(*case))
        counts.append(len(programs))
    return counts


def law(t, arclength, length):
    return 0.05 * jnp.sin(arclength - t)


def model(number, *, held=False):
    """Scene, state and times of one shape, with numbers of their own."""
    chain = Chain(1.0 + 0.01 * number, 3)
    forces = [Bending(3.0 + number, law), Weight([0.0, -0.1 * number])]
    constraints = [Gears(), *clamped()] if held else [Gears()]
    scene = Scene(chain, 1.0 + number, constraints=constraints, forces=forces)
    return scene, bent(chain, seed=number), np.linspace(0.0, 1.0 + number, 3)


def test_a_run_traces_its_step_once(monkeypatch):
    # The first step's length, the step in the loop and simulate's two programs have it in common.
    traced, own = [], Rodas.step

    def step(*args):
        traced.append(args)
        return own(*args)

    monkeypatch.setattr(Rodas, "step", step)
    scene, state, ts = model(7)
    simulate(scene, state, ts, progress=False)
    assert len(traced) == 1


OPTIONS = {
    "default": lambda number: {},
    "AB3": lambda number: {"substeps": 3},
    "tolerance": lambda number: {"tolerance": 1e-4 / (1 + number)},
    "its own tolerance": lambda number: {"solver": Rosenbrock(tolerance=1e-4 / (1 + number))},
    "no tolerance": lambda number: {"solver": Rosenbrock(substeps=3)},
    "Tsit5": lambda number: {"solver": diffrax.Tsit5(), "tolerance": 1e-4},
    "controller": lambda number: {
        "solver": Diffrax(diffrax.Bosh3(), controller=diffrax.PIDController(rtol=0.0, atol=1e-4)),
    },
}


@pytest.mark.parametrize("name", OPTIONS)
def test_a_rollout(name, programs):
    def call(number, scene, state, ts):
        run = rollout(scene, state, ts, **OPTIONS[name](number))
        return run.final, run.code

    cases = [(number, *model(number)) for number in range(4)]
    counts = made_by_each(programs, call, cases)
    assert counts[1:] == [0, 0, 0]


def test_other_shapes_and_terms_are_other_programs():
    # Each of these has a result of its own, and is not taken for one that was compiled before.
    scene, state, ts = model(1)
    plain = rollout(scene, state, ts, substeps=3)
    finer = rollout(scene, state, ts, substeps=30)
    assert int(plain.steps) == 6 and int(finer.steps) == 60
    heavy = eqx.tree_at(lambda s: s.forces, scene, (*scene.forces, Weight([0.0, -1.0])))
    fallen = rollout(heavy, state, ts, substeps=3).final.position - plain.final.position
    assert np.all(fallen[:, 1] < 0)
    assert rollout(scene, state, ts[:2], substeps=3).ts.shape == (2,)


def test_a_gradient(programs):
    def last(viscosity, scene, state, ts):
        scene = eqx.tree_at(lambda s: s.viscosity, scene, viscosity)
        return jnp.sum(rollout(scene, state, ts, substeps=3).final.position ** 2)

    cases = [(1.0 + number, *model(number)) for number in range(3)]
    counts = made_by_each(programs, jax.grad(last), cases)
    assert counts[1:] == [0, 0]


def lift(t, state, scene):
    return state.position[:, 1].mean() * scene.viscosity


MEASURES = {
    "mean_over_time": lambda run, scene: objectives.mean_over_time(lift, run, scene),
    "mean_power": objectives.mean_power,
    "efficiency": objectives.efficiency,
    "thrust": lambda run, scene: objectives.thrust(run, scene, [1.0, 0.3]),
    "resistance": lambda run, scene: observables.rigid_resistance(
        run.final.position, scene.chain, scene.viscosity
    ),
}


@pytest.mark.parametrize("name", MEASURES)
def test_an_objective(name, programs):
    cases = []
    for number in range(3):
        scene, state, ts = model(number, held=True)
        positions = jnp.stack([state.position + k for k in np.arange(3.0)])
        states = jax.vmap(State)(positions)
        run = Solution(jnp.asarray(ts), states, jnp.asarray(0), jnp.asarray(0))
        cases.append((run, scene))
    counts = made_by_each(programs, MEASURES[name], cases)
    assert counts[1:] == [0, 0]


def test_bodies(programs):
    def call(number):
        bodies = [
            jb.body.sphere(2.0 + number, [-9.0, 0.0, 0.0]),
            jb.body.rod(2, 1.0 + 0.1 * number),
        ]
        motor = jb.body.Motor(0, 1, axis=[1.0, 0.1 * number, 0.0], rate=1.0 + number)
        assembly = jb.Assembly(bodies, 1.0 + number, [motor])
        moved = jb.locomotion.motion(0.1 * number, assembly.drawn, assembly)
        run = jb.travel(
            assembly, assembly.drawn, [0.0, 1.0 + number], tolerance=1e-4 / (1 + number)
        )
        return moved, run

    counts = made_by_each(programs, call, [(number,) for number in range(3)])
    assert counts[1:] == [0, 0]
