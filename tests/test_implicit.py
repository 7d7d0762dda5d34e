"""The linearly implicit solver: exact derivatives, coordinates, accuracy, and how it fails."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import FORCES, bent, jointed, scene

import jaxbeads as jb
from jaxbeads import (
    AB3,
    Chain,
    NoSlipWall,
    Scene,
    Setting,
    SimulationError,
    State,
    dynamics,
    rollout,
    simulate,
)
from jaxbeads.actuation import PlanarBeat, TravellingWave
from jaxbeads.breakdown import explain
from jaxbeads.constraint import (
    Gears,
    Inextensible,
    Joint,
    PrescribedDirection,
    PrescribedPosition,
    PrescribedSpin,
    clamped,
)
from jaxbeads.coordinates import coordinates, project
from jaxbeads.flow import OscillatingShear, Poiseuille, Shear, VelocityField
from jaxbeads.force import (
    AbstractForce,
    Bending,
    BendingEnergy,
    Contact,
    JointBending,
    JointRepulsion,
    Spring,
    Weight,
)
from jaxbeads.linearise import coordinate_rate, linearise
from jaxbeads.mobility import FreeDraining
from jaxbeads.rollout import default_solver
from jaxbeads.solver import Rosenbrock


def swimmers():
    """Two fibres of unequal beads that nearly touch, driven by a wave, in an unsteady flow."""
    chain = Chain(np.linspace(0.8, 1.1, 7), (4, 3))
    wave = TravellingWave(0.2, 0.4, 1.5, 0.3)
    forces = [Weight([0.1, -0.4]), Bending(3.0, wave), Contact(5.0, 2.5, 1.0)]
    flow = OscillatingShear(0.7, 2.0, 0.3)
    model = Scene(chain, 1.3, constraints=[Gears()], forces=forces, flow=flow)
    return model, bent(chain, centre=[[0.0, 0.0], [0.0, 2.3]])


def joints():
    """The Joint Model in space, its repulsion at work, in a shear."""
    chain = Chain(1.0, 4, 0.1)
    elastic = JointBending(3.0, 0.02, repulsion=JointRepulsion(0.5, 0.5, 2.0, 0.5))
    forces = [Weight([0.1, -0.4, 0.2]), elastic]
    model = Scene(chain, 1.3, constraints=[Joint()], forces=forces, flow=Shear(0.3))
    return model, jointed(chain, 3)


def held():
    """A fibre whose base is held, its direction prescribed in time, in a curved flow."""
    chain = Chain(1.0, 5)
    base = PrescribedDirection(PlanarBeat(0.4, 1.3))
    constraints = [Gears(), PrescribedPosition(), PrescribedSpin(), base]
    flow = Poiseuille(1.3, 8.0)
    return Scene(chain, 1.0, constraints=constraints, forces=[Bending(4.0)], flow=flow), bent(chain)


def spun():
    """Gears in space that carry directors along, held at the last bead."""
    chain = Chain(1.0, 4)
    model = scene(chain, 3, constraints=[Gears(), *clamped(-1)])
    return model, State(bent(chain, 3).position, jnp.eye(3)[jnp.array([2, 2, 1, 0])])


def springs():
    """Beads without a constraint in a flow that varies in time and space."""
    chain = Chain(1.0, 4)
    flow = VelocityField(lambda t, x: jnp.sin(0.1 * x[::-1] + t))
    model = Scene(chain, 1.0, forces=[Spring(20.0), BendingEnergy(3.0)], flow=flow)
    return model, State(1.1 * bent(chain).position)


def draining():
    """Distances alone, in space, without hydrodynamic interactions."""
    chain = Chain(1.0, 5)
    forces = [BendingEnergy(3.0, 0.1), Weight([0.1, -0.4, 0.3])]
    free = FreeDraining()
    return Scene(chain, 1.0, constraints=[Inextensible()], forces=forces, mobility=free), bent(
        chain, 3
    )


def walled():
    """Above a tilted wall, in shear along it, near enough to touch."""
    chain = Chain([1.0, 0.8, 1.2, 1.0], 4)
    wall = NoSlipWall([0.0, 0.0], [-0.3, 1.0])
    forces = [Bending(20.0), Weight([0.1, -0.4]), Contact(5.0, 2.5, 1.0)]
    flow = jb.flow.LinearFlow(0.3 * np.outer([1.0, 0.3], [-0.3, 1.0]))
    options = {"constraints": [Gears()], "forces": forces, "flow": flow, "domain": wall}
    return Scene(chain, 1.2, **options), bent(chain, 2, centre=[0.0, 3.0])


EXAMPLES = [swimmers, joints, held, spun, springs, draining, walled]


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
