"""Steady and periodic states by root finding: the same as by time stepping, and their derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeads as jb
from jaxbeads import (
    Chain,
    Scene,
    dynamics,
    periodic_state,
    rollout,
    scenes,
    steady_state,
    straight,
)
from jaxbeads.actuation import TravellingWave
from jaxbeads.constraint import Gears, clamped
from jaxbeads.flow import Shear
from jaxbeads.force import Bending, BendingEnergy, Spring, Weight
from jaxbeads.observables import deflection

UP = [0.0, 1.0]


def settling(number=1000.0):
    """A fibre of 12 beads, and a shape that is nearly steady."""
    case = scenes.settling(12, number)
    near = rollout(case.scene, case.state, case.ts[[0, 400]], tolerance=1e-3).final
    return case, near


def height(scene, near, rigidity):
    scene = eqx.tree_at(lambda s: s.forces[1].rigidity, scene, rigidity)
    return deflection(steady_state(scene, near, tolerance=1e-10).state.position, UP)


def test_a_settling_fibre():
    # The end of a long run is the same shape; it falls as one, and it is stable.
    case, near = settling()
    found = steady_state(case.scene, near)
    late = rollout(case.scene, case.state, case.ts[[0, -1]], tolerance=1e-8).final
    shape = np.asarray(late.position) - np.asarray(late.position).mean(axis=0)
    mine = np.asarray(found.state.position) - np.asarray(found.state.position).mean(axis=0)
    assert np.abs(shape - mine).max() < 1e-6 * 24
    moved = dynamics.motion(0.0, found.state, case.scene).velocity
    assert np.abs(moved - found.velocity[None]).max() < 1e-9
    assert np.abs(Gears().bond_errors(found.state, case.scene.chain)).max() < 1e-12
    # A disturbance of the slowest mode dies out at its rate; turning the shape is no symmetry here.
    assert np.all(found.growth_rates.real < 0)


def test_derivatives_of_a_steady_shape():
    case, near = settling()
    rigidity = case.scene.forces[1].rigidity

    def value(k):
        return height(case.scene, near, k)

    slope = jax.jit(jax.grad(value))(rigidity)
    pushed = jax.jit(lambda k: jax.jvp(value, (k,), (jnp.ones_like(k),)))  # value and derivative
    along, step = pushed(rigidity)[1], 1e-4 * rigidity
    difference = (pushed(rigidity + step)[0] - pushed(rigidity - step)[0]) / (2 * step)
    assert abs(slope - difference) < 1e-6 * abs(slope)
    assert abs(slope - along) < 1e-10 * abs(slope)


def test_a_clamped_filament_in_shear_comes_to_rest():
    chain = Chain(1.0, 6)
    scene = Scene(
        chain, 1.0, constraints=[Gears(), *clamped()], forces=[Bending(4e4)], flow=Shear(1.0)
    )
    found = steady_state(scene, straight(chain, [0.0, 1.0]), moving=False)
    assert np.abs(dynamics.motion(0.0, found.state, scene).velocity).max() < 1e-10
    assert deflection(found.state.position, [1.0, 0.0]) > 0.1
    # Bending modes die out; the held bead and the held bond may stay anywhere.
    rates = found.growth_rates.real
    assert np.sum(np.abs(rates) < 1e-9) == 3 and np.sum(rates < -1) == 4


def test_what_is_not_found_is_said():
    case = scenes.settling(12, 1000.0)
    tilted = straight(case.scene.chain, [1.0, 0.3])
    with pytest.raises(RuntimeError, match="No steady state was found in 1 steps"):
        steady_state(case.scene, tilted, max_steps=1)
    under_jit = jax.jit(lambda s: steady_state(case.scene, s, max_steps=1))(tilted)
    assert not bool(under_jit.converged)
    assert np.all(np.isnan(under_jit.state.position)) and np.all(np.isnan(under_jit.velocity))
    with pytest.raises(ValueError, match="Argument `tolerance` must be positive"):
        steady_state(case.scene, tilted, tolerance=-1.0)


def test_beads_without_a_chain():
    # Two bodies linked by springs: the coordinates are all places, relative to the first.
    chain = Chain(1.0, 4)
    forces = [Spring(20.0), BendingEnergy(30.0, 0.1), Weight([0.1, -0.4])]
    scene = Scene(chain, 1.0, forces=forces)
    start = straight(chain, [1.0, 0.2])
    found = steady_state(scene, rollout(scene, start, [0.0, 300.0], tolerance=1e-4).final)
    late = rollout(scene, found.state, [0.0, 1000.0], tolerance=1e-8).final
    apart = found.state.position - late.position
    assert np.abs(apart - apart[:1]).max() < 1e-5
    assert np.abs(apart[0] + 1000 * found.velocity).max() < 1e-4
    moved = dynamics.motion(0.0, found.state, scene).velocity
    assert np.abs(moved - found.velocity[None]).max() < 1e-9


def test_a_swimmer_by_shooting():
    # A rest curvature beside the wave makes it swim in circles. Stepping on from the state found,
    # each period repeats the one before, turned by the rotation that it names.
    chain = Chain(1.0, 6)
    wave = TravellingWave(0.15, 2 * np.pi / 12, 1.0)
    bending = Bending(2e3, lambda t, s, length: wave(t, s, length) + 0.05)
    scene = Scene(chain, 1.0, constraints=[Gears()], forces=[bending])
    found = periodic_state(scene, straight(chain, [1.0, 0.0]), 1.0)
    run = rollout(scene, found.state, np.arange(3.0), tolerance=1e-8)
    first, second = np.diff(np.asarray(run.states.position).mean(axis=1), axis=0)
    speed = np.linalg.norm(first)
    assert abs(found.turn) > 1e-3 and speed > 0.005
    assert np.abs(found.displacement - first).max() < 1e-4 * speed
    assert np.abs(found.rotation @ first - second).max() < 1e-4 * speed
    sizes = np.abs(found.multipliers)
    assert (
        abs(sizes[0] - 1) < 1e-6 and sizes[1] < 0.5
    )  # a turn makes no difference; all else dies out
    with pytest.raises(RuntimeError, match="No periodic state was found in 1 steps"):
        periodic_state(scene, straight(chain, [1.0, 0.0]), 1.0, max_steps=1)


@pytest.mark.slow
def test_derivatives_of_a_periodic_motion():
    # Implicit, against differences of whole solutions.
    case = scenes.nematode(5)
    near = periodic_state(case.scene, case.state, 1.0, substeps=20).state

    def speed(factor):
        scene = eqx.tree_at(
            lambda s: s.forces[0].intrinsic_curvature.amplitude, case.scene, factor * amplitude
        )
        return jnp.linalg.norm(periodic_state(scene, near, 1.0, substeps=20).displacement)

    amplitude = case.scene.forces[0].intrinsic_curvature.amplitude
    both = jax.jit(jax.value_and_grad(speed))
    value, slope = both(1.0)
    near_by, farther = (both(1 + h)[0] - both(1 - h)[0] for h in (1e-4, 2e-4))
    difference = (8 * near_by - farther) / 12e-4
    assert value > 0.01 and abs(slope - difference) < 1e-6 * abs(slope)


def test_a_beating_filament_by_shooting():
    case = scenes.planar_beating(6, 2.0)
    options = {"moving": False, "turning": False}
    found = periodic_state(case.scene, case.state, 2 * np.pi, **options)
    again = rollout(case.scene, found.state, [0.0, 2 * np.pi], tolerance=1e-8).final
    assert np.abs(again.position - found.state.position).max() < 1e-6
    assert np.abs(found.state.position - case.state.position).max() > 0.1
    assert np.all(found.rotation == np.eye(2))
    with pytest.raises(ValueError, match="Argument `turning` must be False"):
        periodic_state(case.scene, case.state, 2 * np.pi, moving=False)


def test_a_prescribed_direction_stays_where_it_is():
    # The law fixes only the rate of the base's direction: any mean of it has a periodic motion, and the
    # one that the start has is meant.
    case = scenes.planar_beating(5, 2.0, amplitude=0.1)
    found = periodic_state(
        case.scene, case.state, 2 * np.pi, moving=False, turning=False, substeps=40
    )
    bond = np.asarray(found.state.position[1] - found.state.position[0])
    assert abs(np.arctan2(bond[1], bond[0])) < 1e-6
    assert np.abs(found.state.position[0] - case.state.position[0]).max() < 1e-6
    assert np.abs(found.multipliers[:3] - 1).max() < 1e-3 and abs(found.multipliers[3]) < 0.9


@pytest.mark.parametrize("what", ["field", "weight", "flow"])
def test_turns_that_make_a_difference_are_refused(what):
    # They were taken for free: the way of a swimmer in a magnetic field was a quarter too short.
    case = jb.scenes.magnetic_swimmer(beads=3)
    scene, state, period = case.scene, case.state, 1.0
    if what != "field":
        chain = jb.Chain(1.0, 3)
        terms = {
            "weight": {"forces": [jb.force.Weight([0.0, -1.0])]},
            "flow": {"flow": jb.flow.Shear(1.0)},
        }
        bent = jb.State(jb.from_tangents(chain, [[1.0, 0.0], [1.0, 0.5]]))
        bending = jb.force.Bending(10.0, jb.actuation.TravellingWave(0.2, 1.0, 1.0))
        given = {"constraints": [jb.constraint.Gears()], **terms[what]}
        given["forces"] = [bending, *given.get("forces", [])]
        scene, state = jb.Scene(chain, 1.0, **given), bent
    with pytest.raises(ValueError, match="`turning` must be False where a turn of the whole"):
        periodic_state(scene, state, period, substeps=10)


def test_stiff_shapes_may_turn_but_for_what_sets_a_direction():
    # Rounding of what stiff bending does, here 1e-16 K, is no direction; a small weight is one.
    chain, wave = jb.Chain(1.0, 6), jb.actuation.TravellingWave(1e-13, 0.3, 1.0)
    bending, ts = jb.force.Bending(1e12, wave), jnp.array([0.0, 1.0])
    for forces, turns in (([bending], True), ([bending, jb.force.Weight([0.0, -0.1])], False)):
        scene = jb.Scene(chain, 1.0, constraints=[jb.constraint.Gears()], forces=forces)
        state = straight(chain, [0.6, -0.8])
        if turns:
            jb.periodic._refuse_directions(ts, state, scene)
        else:
            with pytest.raises(ValueError, match="`turning` must be False"):
                jb.periodic._refuse_directions(ts, state, scene)
