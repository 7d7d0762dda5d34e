"""Cilia, a settling fibre and a worm at a no-slip wall.

A wall far away is none; the other references are symmetries, other solvers and known trends."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbeads import Scene, objectives, observables, scenes, straight
from jaxbeads.actuation import TwoStrokes
from jaxbeads.scenes import SCENES

BY_NAME = {ready.name: ready for ready in SCENES}


def measured(name, case, **options):
    run = case.simulate(progress=False, **options)
    return BY_NAME[name].observables(case, run), run


def without_wall(case):
    """The same scene in an unbounded fluid."""
    scene = case.scene
    free = Scene(scene.chain, scene.viscosity, scene.mobility, scene.constraints, scene.forces)
    return case._replace(scene=free)


def test_two_strokes():
    beat = TwoStrokes(1.2, 2.0, 0.3)
    s, length = jnp.linspace(0.0, 5.0, 201), jnp.full(201, 5.0)
    t = jnp.linspace(0.0, 0.5, 401)[:-1]
    angle = np.asarray(jax.vmap(lambda t: beat.angle(t, s, length))(t))
    bent = np.asarray(jax.vmap(lambda t: beat(t, s, length))(t))
    middle = np.gradient(angle, float(s[1]), axis=1)
    assert np.abs(middle - bent)[:, 2:-2].max() < 3e-3 * np.abs(bent).max()
    assert np.abs(beat(t[3] + 0.5, s, length) - bent[3]).max() < 1e-12 * np.abs(bent).max()
    # At theta = 0 all is straight and swings clockwise; a point swings back at theta = 2 h.
    at = -0.3 / (4 * np.pi)

    def still(t, part):
        return np.asarray(beat.angle(jnp.asarray(t), part * length, length))

    assert np.abs(still(at, s / length)).max() < 1e-15
    rate = (still(at + 1e-5, s / length) - still(at, s / length))[-100:]
    assert rate.max() < 0 and np.ptp(rate) < 0.1 * np.abs(rate).max()
    for part in (0.5, 1.0):
        back = at + (np.pi + np.pi * (part - 0.5)) / (4 * np.pi)
        before, now, after = (still(back + x, part)[0] for x in (-1e-3, 0.0, 1e-3))
        assert before < -1e-3 and abs(now) < 1e-14 and after > 1e-3


@pytest.mark.parametrize(
    "options, words",
    [
        ({"delay": 1.0}, "`delay` must be less than the period"),
        ({"effective": 0.0}, "`effective` must be positive"),
        ({"phase": np.ones((2, 2))}, "`phase` must be one number or one for each joint"),
    ],
)
def test_strokes_that_cannot_be(options, words):
    with pytest.raises(ValueError, match=words):
        TwoStrokes(1.0, 1.0, **options)


@pytest.fixture(scope="module")
def small():
    case = scenes.cilium(10)
    return case, *measured("cilium", case)


def test_a_cilium_pumps_along_its_effective_stroke(small):
    case, found, run = small
    period = scenes.last_period(run)
    length = float(case.scene.chain.length[0])
    position = np.asarray(run.states.position)
    assert found["pumped"] > 0.05 and 0.3 < found["reversal"] < 0.7
    assert position[:, :, 1].min() > 1.0  # the wall is at 0, the radius 1
    rate = float(objectives.mean_pumping_rate(period, case.scene, [3.0, 0.0]))
    assert abs(rate / length**3 / found["pumped"] - 1) < 1e-6  # as periodic as that
    power = float(objectives.mean_power(period, case.scene))
    expected = (found["pumped"] * length**3) ** 2 / (length**3 * power)
    assert abs(found["efficiency"] / expected - 1) < 1e-9


def test_the_mirror_image_pumps_the_other_way(small):
    _, found, run = small
    mirrored, other = measured("cilium", scenes.cilium(10, swing=-1.2))
    flipped = np.asarray(other.states.position) * np.array([-1.0, 1.0])
    assert np.abs(flipped - run.states.position).max() < 1e-9
    assert abs(mirrored["pumped"] + found["pumped"]) < 1e-9
    assert abs(mirrored["efficiency"] / found["efficiency"] - 1) < 1e-8


@pytest.mark.slow
def test_pumping_by_other_steps(small):
    case, found, _ = small
    fine, _ = measured("cilium", case, tolerance=1e-8)
    other, _ = measured("cilium", case, solver=diffrax.Tsit5(), tolerance=1e-7)
    for name in found:
        assert abs(fine[name] / found[name] - 1) < 3e-4, name
        assert abs(other[name] / fine[name] - 1) < 3e-4, name


@pytest.mark.slow
def test_pumping_is_that_of_the_drag_whatever_the_number_of_beads():
    # The volume falls with the drag of a thinner cilium; over gamma/(mu L) 0.0518 and 0.0527 are left.
    found = []
    for beads in (10, 20):
        case = scenes.cilium(beads)
        chain = case.scene.chain
        flat = straight(chain, [1.0, 0.0]).position
        drag = float(observables.rigid_resistance(flat, chain)[1, 1] / chain.length[0])
        found.append(measured("cilium", case)[0]["pumped"] / drag)
    assert abs(found[1] - 0.0527) < 5e-5 and abs(found[1] / found[0] - 1) < 0.02


@pytest.mark.slow
def test_rows_of_cilia():
    # Far apart they do not feel one another; antiplectic rows pump more than symplectic ones (Osterman &
    # Vilfan, PNAS 108 (2011) 15727).
    def pumped(*options):
        case = scenes.cilia_row(2, 10, *options)
        return measured("cilia-row", case, tolerance=1e-5)[0]["pumped"]

    assert abs(pumped(30.0, 0.0) - 1) < 2e-3
    assert pumped(1.0, 0.1) > 1.0 > 0.8 > pumped(1.0, -0.1)


@pytest.mark.slow
def test_cilia_that_meet_do_not_overlap():
    case = scenes.cilia_row(2, 10, 0.8, 0.25)
    x = np.asarray(case.simulate(progress=False, tolerance=1e-5).states.position)
    apart = np.linalg.norm(x[:, :10, None] - x[:, None, 10:], axis=3)
    assert 1.9 < apart.min() < 2.2  # they do touch


def test_a_rod_glances_off_as_it_came():
    # Stokes flow runs backwards as well: the path of a rigid rod is the same up and down, mirrored.
    case = scenes.settling_wall(5, 1e-2, 0.5, 0.3)
    found, run = measured("settling-wall", case, tolerance=1e-8)
    x = np.asarray(run.states.position)
    away, ends = x[:, :, 0].mean(axis=1) / 10, x[:, -1] - x[:, 0]
    angle = np.arctan2(ends[:, 0], -ends[:, 1])  # from the vertical, lower end away from the wall
    nearest = int(np.argmin(away))
    assert 0 < nearest < len(away) - 1 and away[-1] > 0.5
    assert away[1] < away[0]  # at first it comes nearer, along its axis
    back = np.interp(away[0], away[nearest:], angle[nearest:])
    assert abs(angle[0] + 0.3) < 1e-12 and abs(back - 0.3) < 1e-3
    assert np.all(np.diff(angle) > 0) and abs(found["tilt"] - (angle[-1] + 0.3)) < 1e-9
    assert abs(found["drift"] - (away[-1] - away[0])) < 1e-12
    assert abs(found["closest"] - (x[:, :, 0].min() - 1)) < 1e-12


@pytest.mark.slow
def test_a_fibre_far_from_a_wall_settles_as_without():
    case = scenes.settling_wall(5, 100.0, 300.0, 0.3)
    near, _ = measured("settling-wall", case)
    free, _ = measured("settling-wall", without_wall(case))
    for name in ("drift", "tilt"):
        assert abs(near[name] / free[name] - 1) < 2e-3, name
    assert near["tilt"] < -0.2  # a flexible fibre turns broadside


@pytest.mark.slow
def test_fibres_that_meet_the_wall_do_not_pass_it():
    found, run = measured("settling-wall", scenes.settling_wall(9, 100.0, 0.3, 0.4))
    assert 0 < found["closest"] < 0.1  # the reach of contact
    assert run.status == "finished"


@pytest.mark.slow
def test_a_worm_far_from_a_wall_swims_as_without():
    far, _ = measured("nematode-wall", scenes.nematode_wall(9, 200.0))
    alone, _ = measured("nematode", scenes.nematode(9))
    assert abs(far["speed"] / alone["speed"] - 1) < 2e-3
    assert abs(far["turn"]) < 1e-3 and abs(far["height"] - 200.0) < 0.1


@pytest.mark.slow
def test_a_worm_turns_away_from_the_wall_and_is_faster_along_it():
    found, _ = measured("nematode-wall", scenes.nematode_wall(9, 0.4))
    far, _ = measured("nematode-wall", scenes.nematode_wall(9, 200.0))
    assert found["turn"] > 0.02 and found["height"] > 0.4
    assert found["speed"] > far["speed"]


@pytest.mark.parametrize(
    "build, words",
    [
        (lambda: scenes.settling_wall(5, 1.0, 0.05), "`height` must be at least 0.218, where"),
        (lambda: scenes.nematode_wall(5, 0.2, 0.5), "`height` must be at least 0.292, where"),
        (lambda: scenes.cilia_row(0), "`cilia` must be at least 1"),
        (lambda: scenes.cilia_row(2, 5, -1.0), "`spacing` must be positive"),
        (lambda: scenes.cilium(5, 0.0), "`sperm_number` must be positive"),
    ],
)
def test_starts_that_cannot_be(build, words):
    with pytest.raises(ValueError, match=words):
        build()
