"""Magnetic rigid bodies: step-out, a helix that follows its field, energies, what joints bear."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import jaxbeads as jb
from jaxbeads.body import Ball, helix, rod, sphere
from jaxbeads.locomotion import motion, resistance
from jaxbeads.magnetism import AbstractMagneticField, HarmonicField, body_load

MOMENT, CHI = (
    np.array([0.7, -1.1, 0.4]),
    np.array([[1.0, 0.3, 0.1], [0.3, 2.0, -0.4], [0.1, -0.4, 0.6]]),
)


class Uneven(AbstractMagneticField):
    """A field whose gradient is not symmetric nor the same everywhere."""

    strength: jax.Array

    def __call__(self, t, x):
        linear = jnp.array([[0.3, -0.5, 0.2], [0.1, 0.4, 0.6], [-0.7, 0.2, 0.1]])
        return self.strength * (jnp.array([1.0, -0.5, 2.0]) + linear @ x + 0.1 * x**2 * jnp.cos(t))


def test_a_rod_steps_out():
    body, moment, strength = rod(4), 3.0, 2.0
    step_out = moment * strength / float(resistance(body)[5, 5])
    for omega in (1.2 * step_out, 3.0 * step_out):
        field = HarmonicField(omega, [strength, 0.0, 0.0], [0.0, strength, 0.0])
        magnet = jb.Assembly([body], 1.0, moment=[[moment, 0.0, 0.0]], field=field)
        slip = np.sqrt(omega**2 - step_out**2)
        # In a period of the slip the lag grows by a whole turn, from wherever it starts.
        journey = jb.travel(
            magnet, magnet.drawn, np.linspace(0, 2 * np.pi / slip, 65), tolerance=1e-9
        )
        along = jax.vmap(jb.quaternions.matrix)(journey.poses.turn[:, 0])[:, :, 0]
        angle = np.unwrap(np.arctan2(along[:, 1], along[:, 0]))
        assert abs(angle[-1] / journey.ts[-1] / (omega - slip) - 1) < 1e-6
    # Below it, the rod follows at the angle whose sine is omega over step-out.
    field = HarmonicField(0.6 * step_out, [strength, 0.0, 0.0], [0.0, strength, 0.0])
    magnet = jb.Assembly([body], 1.0, moment=[[moment, 0.0, 0.0]], field=field)
    end = jb.travel(magnet, magnet.drawn, [0.0, 40 / step_out], tolerance=1e-9)
    x, y, _ = jb.quaternions.matrix(end.final.turn[0])[:, 0]
    lag = 0.6 * step_out * float(end.ts[-1]) - np.arctan2(y, x)
    assert abs(np.sin(lag) - 0.6) < 1e-6


def locked(body, moment, strength, omega):
    """Axes in the body's frame about which it can turn with its field, and speeds along them.

    Without a force, the twist is (U, n omega) = (M_tr, M_rr) T, with constant T = m x B in its frame.
    Turning about n, B is across n and T, and T across m: one number is left of n, for |T| = |m x B|.
    """
    mobility = np.linalg.inv(resistance(body))
    drag = np.linalg.inv(mobility[3:, 3:])
    plane = np.linalg.svd((drag @ moment)[None])[2][1:]

    def off(angle, sign):
        n = np.array([np.cos(angle), np.sin(angle)]) @ plane
        torque = omega * drag @ n
        field = np.cross(n, torque)
        field = sign * strength * field / np.linalg.norm(field)
        return (np.cross(moment, field) - torque) @ torque, n

    angles, found = np.linspace(0, 2 * np.pi, 721), []
    for sign in (1, -1):
        values = np.array([off(a, sign)[0] for a in angles])
        for k in np.flatnonzero(values[1:] * values[:-1] < 0):
            root = brentq(lambda a, s=sign: off(a, s)[0], angles[k], angles[k + 1], xtol=1e-14)
            n = off(root, sign)[1]
            found.append((n, omega * n @ mobility[:3, 3:] @ drag @ n))
    return found


def test_a_helix_swims_with_its_field():
    body, moment, strength = helix(1.5, 6.0, turns=2), np.array([0.0, 2.0, 0.0]), 1.5
    omega = 0.4 * np.linalg.norm(moment) * strength / float(resistance(body)[3, 3])
    field = HarmonicField(omega, [0.0, strength, 0.0], [0.0, 0.0, strength])
    swimmer = jb.Assembly([body], 1.0, moment=moment[None], field=field)
    turn = 2 * np.pi / omega
    journey = jb.travel(swimmer, swimmer.drawn, [0.0, 60 * turn, 61 * turn], tolerance=1e-9)
    axis = np.asarray(jb.quaternions.matrix(journey.final.turn[0])).T @ [1.0, 0.0, 0.0]
    away = [np.linalg.norm(axis - n) for n, _ in locked(body, moment, strength, omega)]
    speed = locked(body, moment, strength, omega)[int(np.argmin(away))][1]
    assert min(away) < 1e-6 and abs(axis[0]) > 0.9
    way = np.asarray(journey.poses.place[2, 0] - journey.poses.place[1, 0])
    assert abs(way[0] / turn / speed - 1) < 1e-6
    assert np.abs(way[1:]).max() < 1e-6 * abs(way[0])


def energy(place, rotation, field, t=0.3):
    b = field(jnp.array(t), place)
    inside = rotation.T @ b
    return -(MOMENT @ inside) - 0.5 * inside @ CHI @ inside


def test_loads_are_those_of_the_energy():
    field, place = Uneven(jnp.array(1.3)), jnp.array([0.4, -0.2, 0.9])
    rotation = jb.quaternions.matrix(jb.quaternions.about(jnp.array([1.0, 2.0, -0.5]), 0.8))
    magnet = jnp.array(MOMENT[None]), jnp.array(CHI[None]), field
    load = body_load(jnp.array(0.3), place[None], rotation[None], *magnet)
    assert load.force is not None and load.torque is not None
    for k, unit in enumerate(np.eye(3)):
        pair = [energy(place + h * unit, rotation, field) for h in (1e-5, -1e-5)]
        assert abs(load.force[0, k] + (pair[0] - pair[1]) / 2e-5) < 1e-8
        turns = [jb.quaternions.matrix(jb.quaternions.about(unit, h)) for h in (1e-5, -1e-5)]
        pair = [energy(place, turn @ rotation, field) for turn in turns]
        assert abs(load.torque[0, k] + (pair[0] - pair[1]) / 2e-5) < 1e-8


def two(moment, susceptibility, field, **others):
    """A ball that hangs on a rod by a soft hook, at a pose of its own."""
    bodies = [rod(3, centre=[0.5, 0.0, 0.0]), sphere(1.5, [5.5, 0.0, 0.0])]
    joint = Ball(0, 1, point=[3.7, 0.0, 0.0], stiffness=0.2)
    magnets = {"moment": moment, "susceptibility": susceptibility, "field": field}
    assembly = jb.Assembly(bodies, 1.2, [joint], **magnets, **others)
    turns = [
        jb.quaternions.about(jnp.array(x), a)
        for x, a in (([1.0, 2.0, 0.0], 0.9), ([0.0, 1.0, 0.0], 0.4))
    ]
    return assembly, jb.Pose([[0.3, -0.4, 0.2]], jnp.stack(turns))


def test_bodies_move_and_joints_bear_as_under_given_loads():
    field, moments = Uneven(jnp.array(0.8)), np.stack([MOMENT, -2 * MOMENT])
    pull = {"force": np.eye(2, 3), "torque": -np.eye(2, 3)}
    magnetic, pose = two(moments, np.stack([CHI, 0 * CHI]), field, **pull)
    frames = magnetic.frames(pose)
    place = magnetic.chain.centres(magnetic.positions(frames))
    force, torque = (np.zeros((2, 3)) for _ in range(2))
    now = jnp.array(0.3)
    for k, (m, chi) in enumerate(((MOMENT, CHI), (-2 * MOMENT, 0 * CHI))):
        b, slope = field(now, place[k]), jax.jacfwd(lambda x: field(now, x))(place[k])
        r = frames.rotation[k]
        m = r @ m + r @ chi @ r.T @ b
        force[k], torque[k] = m @ slope + pull["force"][k], np.cross(m, b) + pull["torque"][k]
    given, _ = two(None, None, None, force=force, torque=torque)
    moved, expected = motion(0.3, pose, magnetic), motion(0.3, pose, given)
    for one, other in zip(jax.tree.leaves(moved), jax.tree.leaves(expected), strict=True):
        assert np.abs(one - other).max() < 1e-12
    # What the hook bears is what its turn makes it: 0.2 times 0.4.
    assert abs(np.linalg.norm(moved.joint_torque) - 0.08) < 1e-12


def test_gradients():
    weights = np.random.default_rng(0).normal(size=12)

    @jax.jit
    def measured(x):
        assembly, pose = two(
            x[0] * np.stack([MOMENT, MOMENT]), x[1] * np.stack([CHI, CHI]), Uneven(x[2])
        )
        moved = motion(x[3], pose, assembly)
        return weights @ jnp.concatenate(
            [moved.velocity.ravel(), moved.joint_torque[0], moved.spin[1]]
        )

    x = jnp.array([1.1, 0.7, 0.9, 0.3])
    forward, reverse = jax.jacfwd(measured)(x), jax.jacrev(measured)(x)
    assert np.abs(forward - reverse).max() < 1e-12 * np.abs(forward).max()
    for k, unit in enumerate(np.eye(4)):
        difference = (measured(x + 1e-5 * unit) - measured(x - 1e-5 * unit)) / 2e-5
        assert abs(forward[k] - difference) < 1e-6 * np.abs(forward).max()


BALL = sphere(1.0)
BAD = {
    "no field": (
        lambda: jb.Assembly([BALL], 1.0, moment=[[1.0, 0.0, 0.0]]),
        "`field` must be given",
    ),
    "nothing magnetic": (
        lambda: jb.Assembly([BALL], 1.0, field=[1.0, 0.0, 0.0]),
        "nothing is magnetic",
    ),
    "moments of another number": (
        lambda: jb.Assembly([BALL], 1.0, moment=[[1.0, 0.0, 0.0]] * 2, field=[1.0, 0.0, 0.0]),
        "`moment` must have shape (1, 3)",
    ),
    "a planar field": (
        lambda: jb.Assembly([BALL], 1.0, moment=[[1.0, 0.0, 0.0]], field=[1.0, 0.0]),
        "`UniformField.law` must have shape (3,)",
    ),
    "not symmetric": (
        lambda: jb.Assembly(
            [BALL], 1.0, susceptibility=np.triu(np.ones((1, 3, 3))), field=[1.0, 0.0, 0.0]
        ),
        "`susceptibility` must be symmetric, but it is off by 1",
    ),
}


@pytest.mark.parametrize("call, says", BAD.values(), ids=BAD)
def test_bad_input_is_refused(call, says):
    with pytest.raises(ValueError) as caught:
        call()
    assert str(caught.value).startswith("Argument `") and says in str(caught.value)
