"""Objectives against trajectories and forces that are known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent

from jaxbeads import (
    Chain,
    NoSlipWall,
    Outcome,
    Scene,
    Solution,
    State,
    objectives,
    rollout,
    straight,
)
from jaxbeads.constraint import Gears, hinged
from jaxbeads.force import Bending, Weight

CHAIN = Chain(1.0, 3)


def trajectory(ts, position):
    states = jax.vmap(State)(jnp.asarray(position))
    return Solution(jnp.asarray(ts), states, jnp.asarray(0), jnp.asarray(0))


def moved_by(ts, path):
    first = np.asarray(bent(CHAIN).position)
    return trajectory(ts, first + np.asarray(path)[:, None])


def test_distances_and_speed():
    ts = np.linspace(1.0, 3.0, 9)
    path = np.stack([0.3 * (ts - 1) + np.sin(np.pi * ts), -0.4 * (ts - 1)], axis=1)
    run = moved_by(ts, path)
    scene = Scene(CHAIN, 1.0)
    assert np.allclose(objectives.displacement(run), [0.6, -0.8], atol=1e-14)
    assert abs(objectives.distance(run) - 1.0) < 1e-14
    # Two periods of f = 1 in which a fibre of length 6 moves by 1.
    assert abs(objectives.swimming_speed(run, scene, 1.0) - 1 / 12) < 1e-14
    still = moved_by(ts, 0 * path)
    slope = jax.grad(lambda x: objectives.distance(trajectory(ts, x)))(still.states.position)
    assert np.all(np.asarray(slope) == 0)  # finite where nothing moves


def test_means_over_time():
    scene = Scene(CHAIN, 1.0)
    ts = np.linspace(0.0, 1.0, 9)
    run = moved_by(ts, np.zeros((9, 2)))
    wave = objectives.mean_over_time(
        lambda t, *_: (jnp.sin(2 * np.pi * t) ** 2, jnp.ones(2) * t), run, scene
    )
    assert abs(wave[0] - 0.5) < 1e-14 and np.allclose(wave[1], 0.5, atol=1e-14)
    uneven = moved_by(ts**2, np.zeros((9, 2)))
    assert abs(objectives.mean_over_time(lambda t, *_: t, uneven, scene) - 0.5) < 1e-14


def test_what_holds_a_hanging_fibre_carries_its_weight():
    chain = Chain(1.0, 5)
    scene = Scene(
        chain, 1.0, constraints=[Gears(), *hinged(0)], forces=[Weight([0.0, -2.0]), Bending(10.0)]
    )
    hanging = straight(chain, [0.0, -1.0])
    run = rollout(scene, hanging, np.linspace(0, 1, 3))
    assert abs(objectives.thrust(run, scene, [0.0, -3.0]) - 10.0) < 1e-10
    assert abs(objectives.thrust(run, scene, [1.0, 0.0])) < 1e-10
    # Nothing moves and nothing holds anything else: no power.
    assert abs(objectives.mean_power(run, scene)) < 1e-10


def test_a_towed_rod_has_the_efficiency_of_its_motion():
    # A straight rod pulled along its axis dissipates what towing it takes: efficiency 1.
    chain = Chain(1.0, 6)
    scene = Scene(chain, 2.0, constraints=[Gears()], forces=[Weight([0.5, 0.0]), Bending(10.0)])
    run = rollout(scene, straight(chain, [1.0, 0.0]), np.linspace(0, 4, 5))
    assert abs(objectives.efficiency(run, scene) - 1) < 1e-3
    exact = 3.0 * float(objectives.distance(run)) / 4.0  # force times velocity
    assert abs(objectives.mean_power(run, scene) / exact - 1) < 1e-8


def test_shape_error():
    ts = np.arange(2.0)
    run = moved_by(ts, np.zeros((2, 2)))
    data = np.asarray(run.states.position)
    assert objectives.shape_error(run, data) == 0
    assert np.all(np.isfinite(jax.grad(lambda d: objectives.shape_error(run, d))(data)))
    away = data + np.array([0.3, -0.4])
    assert abs(objectives.shape_error(run, away) - 0.5) < 1e-14
    assert objectives.shape_error(run, away, moved=True) < 1e-14


def test_what_is_refused():
    run, scene = moved_by(np.arange(2.0), np.zeros((2, 2))), Scene(CHAIN, 1.0)
    with pytest.raises(ValueError, match="`frequency` must be positive"):
        objectives.swimming_speed(run, scene, 0.0)
    with pytest.raises(ValueError, match="`direction` must not be zero"):
        objectives.thrust(run, scene, [0.0, 0.0])
    with pytest.raises(ValueError, match="`direction` must have shape"):
        objectives.thrust(run, scene, [1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="`data` must have shape"):
        objectives.shape_error(run, np.zeros((3, 2)))


def test_a_run_that_broke_down_has_no_value():
    # Its numbers may be finite, with bonds off their lengths, and a larger speed than a good run's.
    chain = Chain(1.0, 4)
    model = Scene(chain, 1.0, constraints=[Gears()], forces=[Bending(1.0), Weight([0.0, -1.0])])
    run = rollout(model, bent(chain), [0.0, 10.0, 20.0], substeps=10)
    assert run.code == 0 and np.isfinite(objectives.distance(run))
    broken = eqx.tree_at(lambda r: r.code, run, jnp.asarray(int(Outcome.BROKEN)))
    data = run.states.position
    for value in (
        objectives.distance(broken),
        objectives.mean_power(broken, model),
        objectives.shape_error(broken, data),
    ):
        assert np.isnan(value)
    assert objectives.shape_error(run, data) == 0


def test_pumping_efficiency_of_several():
    # Each pumps as one alone; pushed side by side they move faster, which takes more power.
    wall, push = NoSlipWall([0.0, 0.0], [0.0, 1.0]), Weight([1.0, 0.0])

    def efficiency(fibres, apart):
        chain = Chain(1.0, fibres)
        x = np.stack([apart * np.arange(chain.beads), np.full(chain.beads, 3.0)], axis=1)
        scene = Scene(chain, 2.0, forces=[push], domain=wall)
        run = rollout(scene, State(x), np.linspace(0.0, 1.0, 3), substeps=1)
        return objectives.pumping_efficiency(run, scene, [1.0, 0.0])

    alone = efficiency((1,), 0.0)
    np.testing.assert_allclose(efficiency((1, 1, 1), 1e4), alone, rtol=1e-9)
    assert efficiency((1, 1, 1), 3.0) < 0.9 * alone
    with pytest.raises(ValueError, match=r"`scene.chain` must have fibres of one number of beads"):
        efficiency((1, 2), 1e4)
