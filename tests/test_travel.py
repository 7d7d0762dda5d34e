"""Assemblies in time: exact paths, joints that hold, derivatives, restarts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeads as jb
from jaxbeads.body import Ball, Hinge, Motor, Weld, fibre, helix, rod, sphere
from jaxbeads.locomotion import motion

X = [1.0, 0.0, 0.0]


def swimmer(viscosity=1.0, rate=1.0, pitch=7.0, **options):
    """A small one: eight beads."""
    bodies = [sphere(2.0, [-3.0, 0.0, 0.0]), helix(1.5, pitch, beads=7, thickness=0.8)]
    return jb.Assembly(bodies, viscosity, [Motor(0, 1, axis=X, rate=rate)], **options)


def turned(axis, angle):
    """An assembly's drawn pose, all of it turned."""
    first = jb.quaternions.about(axis, angle)
    return jb.Pose([[1.0, -2.0, 3.0]], jnp.stack([first, jnp.array(jb.quaternions.IDENTITY)]))


@pytest.mark.parametrize("start", [None, ([1.0, -2.0, 0.5], 2.5)], ids=["drawn", "turned"])
def test_the_path_of_a_bacterium_is_a_helix(start):
    # Nothing changes in the frame of the tail: V = U . Omega/|Omega| [derived], section 8: 0.170390.
    bodies = [sphere(6.0, [-7.0, 0.0, 0.0]), helix(3.0, 14.0, turns=3)]
    assembly = jb.Assembly(bodies, 1.0, [Motor(0, 1, axis=X)])
    pose = assembly.drawn if start is None else turned(*start)
    moved = motion(0.0, pose, assembly)
    omega = np.linalg.norm(moved.spin[1])
    along = np.asarray(moved.spin[1]) / omega
    ts = 2 * np.pi / omega * np.arange(0, 31, 5)
    journey = jb.travel(assembly, pose, ts)
    assert journey.code == 0 and journey.steps < 800
    # Whole turns of the tail in space: what is left of them is the way along its axis.
    way = np.diff(np.asarray(journey.poses.place[:, 0]), axis=0)
    speeds = way @ along / np.diff(ts)
    assert np.abs(speeds - 0.170390).max() < 1e-5 * 0.170390
    assert np.abs(way - (way @ along)[:, None] * along).max() < 1e-4
    assert abs(speeds.mean() / (14 / (2 * np.pi)) - 0.076471) < 1e-5 * 0.076471
    # The head's spin in space and the motor's about the axis are constant.
    rotation = jax.vmap(jb.quaternions.matrix)(journey.poses.turn[:, 1])
    assert np.abs(rotation[:, :, 0] - np.array([X])).max() < 1e-13  # the axis is held
    for k in (1, 6):
        later = motion(ts[k], jax.tree.map(lambda x, k=k: x[k], journey.poses), assembly)
        power, first = (m.joint_torque[0] @ (m.spin[1] - m.spin[0]) for m in (later, moved))
        assert abs(power - first) < 1e-8 * first
        spins = (np.linalg.norm(m.spin, axis=1) for m in (later, moved))
        assert np.abs(np.subtract(*spins)).max() < 1e-9


def test_an_ellipse_in_shear_turns_by_jefferys_equation():
    # The angle of a rigid rod follows tan = (a/b) tan(a b t/(a^2 + b^2)...), so half a period closes it.
    assembly = jb.Assembly([rod(5)], 1.0, flow=jb.flow.Shear(1.0))
    journey = jb.travel(assembly, assembly.drawn, [0.0, 29.971 / 2], tolerance=1e-8)
    assert np.abs(np.abs(jb.quaternions.matrix(journey.final.turn[0])) - np.eye(3)).max() < 1e-3


def test_joints_hold():
    bodies = [rod(2, 1.0, [-3.0, 0.0, 0.0]), rod(2), rod(2, 1.0, [3.0, 0.0, 0.0])]
    joints = [Ball(0, 1, [-1.5, 0.0, 0.0]), Hinge(1, 2, [1.5, 0.0, 0.0], [0.0, 1.0, 1.0])]
    pull = [[0.0, 3.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -2.0]]
    assembly = jb.Assembly(bodies, 1.0, joints, force=pull)
    journey = jb.travel(assembly, assembly.drawn, np.linspace(0.0, 60.0, 4))
    axis = jnp.array([0.0, 1.0, 1.0]) / 2**0.5
    assert journey.code == 0
    for k in range(4):
        frames = assembly.frames(jax.tree.map(lambda x, k=k: x[k], journey.poses))
        for joint in joints:
            ends = [frames.point(body, joint.point) for body in (joint.parent, joint.child)]
            assert np.abs(ends[0] - ends[1]).max() < 1e-12
        one, other = (frames.vector(body, axis) for body in (1, 2))
        assert np.abs(one - other).max() < 1e-12
    assert np.linalg.norm(jb.quaternions.angles(journey.final.turn[1])) > 0.3  # they did turn


def test_a_hook_relaxes_exactly():
    # Two far spheres on a hook about their own centres: angle' = -2 k angle/(8 pi mu a^3).
    bodies = [sphere(1.0), sphere(1.0, [1e5, 0.0, 0.0])]
    assembly = jb.Assembly(bodies, 1.0, [Weld(None, 0), Ball(None, 1, [1e5, 0.0, 0.0], 4 * np.pi)])
    turn = jnp.stack(
        [jnp.array(jb.quaternions.IDENTITY), jb.quaternions.about([1.0, 2.0, 2.0], 3.0)]
    )
    journey = jb.travel(assembly, jb.Pose(jnp.zeros((0, 3)), turn), [0.0, 1.0, 2.0], tolerance=1e-9)
    found = jax.vmap(jb.quaternions.angles)(journey.poses.turn[:, 1])
    expected = 3.0 * np.exp(-np.array([0.0, 0.5, 1.0]))[:, None] * np.array([[1.0, 2.0, 2.0]]) / 3
    assert np.abs(found - expected).max() < 1e-7


def test_going_on_is_the_same_path():
    assembly, ts = swimmer(), np.linspace(0.0, 12.0, 5)
    whole = jb.travel(assembly, assembly.drawn, ts)
    first = jb.travel(assembly, assembly.drawn, ts[:3])
    rest = jb.travel(assembly, first.final, ts[2:], step=first.step)
    assert np.array_equal(rest.final.place, whole.final.place)
    assert np.array_equal(rest.final.turn, whole.final.turn)
    assert first.steps + rest.steps == whole.steps


def test_bodies_as_beads_of_a_solution():
    assembly = swimmer()
    journey = jb.travel(assembly, assembly.drawn, np.linspace(0.0, 3.0, 4))
    solution = journey.solution(assembly)
    assert solution.states.position.shape == (4, 8, 3) and solution.solver == "Tsit5"
    last = assembly.state(journey.final).position
    assert np.abs(solution.final.position - last).max() < 1e-14
    # Nothing bends.
    tails = np.asarray(solution.states.position)[:, 1:]
    apart = np.linalg.norm(tails[:, :, None] - tails[:, None, :], axis=3)
    assert np.abs(apart - apart[0]).max() < 1e-13


def end(numbers):
    viscosity, rate, pitch, pull, angle, time = numbers
    force = jnp.zeros((2, 3)).at[0, 0].set(pull)
    assembly = swimmer(viscosity, rate, pitch, force=force)
    pose = jb.Pose([[0.0, 0.0, 0.0]], turned([1.0, 2.0, 0.0], angle).turn)
    ts = time * jnp.array([0.0, 0.5, 1.0])
    final = jb.travel(assembly, pose, ts, tolerance=1e-11).final
    return jnp.concatenate([final.place[0], final.turn[0]])


@pytest.mark.slow
def test_gradients_of_a_path():
    x = jnp.array([1.2, 0.9, 7.0, 2.0, 0.4, 4.0])
    value = jax.jit(end)
    forward, reverse = jax.jit(jax.jacfwd(end))(x), jax.jit(jax.jacrev(end))(x)
    assert np.abs(forward - reverse).max() < 1e-9 * np.abs(forward).max()
    for k, unit in enumerate(np.eye(len(x))):
        one, two = ((value(x + h * unit) - value(x - h * unit)) / (2 * h) for h in (1e-3, 2e-3))
        difference = (4 * one - two) / 3
        assert np.abs(forward[:, k] - difference).max() < 1e-6 * max(1.0, np.abs(difference).max())


def test_many_paths_at_once():
    def place(rate):
        assembly = swimmer(rate=rate)
        return jb.travel(assembly, assembly.drawn, [0.0, 1.0]).final.place[0]

    rates = jnp.array([0.5, 1.0])
    assert np.allclose(jax.vmap(place)(rates), [place(rate) for rate in rates], atol=1e-9)


def test_what_goes_wrong_has_a_code():
    assembly = swimmer()
    short = jb.travel(assembly, assembly.drawn, [0.0, 100.0], max_steps=3)
    assert short.code == jb.Outcome.TOO_MANY_STEPS and np.all(np.isnan(short.final.place))
    wall = jb.NoSlipWall([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    ball = jb.Assembly([sphere(1.0, [0.0, 0.0, 1.2])], 1.0, force=[[0.0, 0.0, -1e3]], domain=wall)
    through = jb.travel(ball, ball.drawn, [0.0, 100.0])
    # Images keep the mobility positive, and so the bead above the wall.
    assert through.code == jb.Outcome.FINE
    assert 0 < ball.positions(ball.frames(through.final))[0, 2] < 1.2


def flexible(beads=5, rigidity=20.0, twist_rigidity=10.0, held=False, **options):
    """A fibre of unequal beads, free or clamped."""
    parts = fibre(rod(beads), rigidity, twist_rigidity)
    joints = [Weld(None, 0), *parts.joints] if held else parts.joints
    return jb.Assembly(parts.bodies, 1.0, joints, **options)


FLOW = jb.flow.LinearFlow([[0.1, 0.5, 0.0], [0.0, -0.1, 0.2], [0.3, 0.0, 0.0]])


def test_implicit_steps_go_the_same_way():
    assembly, ts = flexible(flow=FLOW), [0.0, 1.0, 2.0]
    exact = jb.travel(assembly, assembly.drawn, ts, tolerance=1e-10)
    places = jax.vmap(lambda pose: assembly.positions(assembly.frames(pose)))
    errors, steps = [], []
    for tolerance in (1e-5, 1e-6, 1e-7):
        journey = jb.travel(assembly, assembly.drawn, ts, tolerance=tolerance, implicit=True)
        assert journey.code == 0 and journey.solution(assembly).solver == "Rosenbrock"
        errors.append(np.abs(places(journey.poses) - places(exact.poses)).max())
        steps.append(int(journey.steps))
    assert errors[0] < 1e-5 and errors[1] < 1e-6 and errors[2] < 1e-7
    assert steps[2] < 4 * steps[0]  # of fourth order: 3.2


@pytest.mark.parametrize("axis, rigidity", [([1.0, 0.0, 0.0], 3.0), ([0.0, 0.6, 0.8], 20.0)])
def test_a_stiff_fibre_bends_and_twists_as_it_must(axis, rigidity):
    # Each joint bears the torque M: the angle of the end is (N - 1) M l/K, exactly.
    beads, stiff = 6, 1e4
    torque = 0.04 * stiff * jnp.zeros((beads, 3)).at[-1].set(jnp.array(axis))
    assembly = flexible(beads, 20.0 * stiff, 3.0 * stiff, True, torque=torque)
    journey = jb.travel(assembly, assembly.drawn, [0.0, 1e6], tolerance=1e-4, implicit=True)
    assert journey.code == 0 and journey.steps < 60
    end = jb.quaternions.angles(journey.final.turn)
    each = 0.04 * 2 / rigidity * np.array(axis)
    assert np.abs(np.asarray(end)[1:] - each).max() < 1e-9 and np.abs(end[0]).max() < 1e-15
    # An explicit step is bound by the fastest twist, some 4 (K_t/l)/(8 pi mu a^3).
    short = jb.travel(assembly, assembly.drawn, [0.0, 1e6], tolerance=1e-4, max_steps=2000)
    assert short.code == jb.Outcome.TOO_MANY_STEPS


def test_going_on_implicitly_is_the_same_path():
    assembly, ts = flexible(flow=FLOW), np.linspace(0.0, 2.0, 5)
    whole = jb.travel(assembly, assembly.drawn, ts, implicit=True)
    first = jb.travel(assembly, assembly.drawn, ts[:3], implicit=True)
    rest = jb.travel(assembly, first.final, ts[2:], step=first.step, implicit=True)
    assert np.array_equal(rest.final.place, whole.final.place)
    assert np.array_equal(rest.final.turn, whole.final.turn)


def bent_end(numbers):
    rigidity, twist_rigidity, rate, pull = numbers
    tail = fibre(helix(1.5, 7.0, beads=4, thickness=0.8), rigidity, twist_rigidity, first=1)
    law = jax.tree_util.Partial(lambda rate, t: rate * (1 + 0.3 * jnp.sin(t)), rate)
    motor = Motor(0, 1, axis=X, rate=law)
    bodies = [sphere(2.0, [-3.0, 0.0, 0.0]), *tail.bodies]
    force = jnp.zeros((5, 3)).at[0, 0].set(pull)
    assembly = jb.Assembly(bodies, 1.0, [motor, *tail.joints], force=force)
    journey = jb.travel(assembly, assembly.drawn, [0.0, 1.5], tolerance=1e-8, implicit=True)
    return assembly.positions(assembly.frames(journey.final))[-1]


@pytest.mark.slow
def test_gradients_of_an_implicit_path():
    x = jnp.array([300.0, 200.0, 1.0, 2.0])
    value = jax.jit(bent_end)
    forward, reverse = jax.jit(jax.jacfwd(bent_end))(x), jax.jit(jax.jacrev(bent_end))(x)
    assert np.abs(forward - reverse).max() < 1e-9 * np.abs(forward).max()
    for k, unit in enumerate(np.eye(len(x)) * np.asarray(x)):
        one, two = ((value(x + h * unit) - value(x - h * unit)) / (2 * h) for h in (2e-3, 4e-3))
        difference = (4 * one - two) / 3
        found = forward[:, k] * x[k]
        assert np.abs(found - difference).max() < 1e-6 * max(1.0, np.abs(difference).max())


def test_many_implicit_paths_at_once():
    def end(rigidity):
        assembly = flexible(4, rigidity, flow=FLOW)
        journey = jb.travel(assembly, assembly.drawn, [0.0, 1.0], implicit=True)
        return assembly.positions(assembly.frames(journey.final))[-1]

    rigidities = jnp.array([5.0, 50.0])
    assert np.allclose(jax.vmap(end)(rigidities), [end(k) for k in rigidities], atol=1e-9)


def test_implicit_steps_in_single_precision():
    def single(tree):
        return jax.tree.map(lambda x: x.astype(jnp.float32), tree)

    assembly, ts = flexible(4, flow=FLOW), jnp.array([0.0, 1.0])
    exact = jb.travel(assembly, assembly.drawn, ts, tolerance=1e-4, implicit=True)
    start = single(assembly), single(assembly.drawn), ts.astype(jnp.float32)
    found = jb.travel(*start, tolerance=1e-4, implicit=True)
    assert found.code == 0 and found.final.turn.dtype == jnp.float32
    assert np.abs(found.final.turn - exact.final.turn).max() < 1e-3


@pytest.mark.parametrize("implicit", [False, True])
@pytest.mark.parametrize("begin", [0.0, 1e6])
def test_laws_that_jump_are_met(implicit, begin):
    # A pulse a hundred times as short as the run, and a jump: turns of a held body are their integrals.
    def pulse(t):
        return jnp.where((t > begin + 0.5) & (t < begin + 0.502), 300.0, 0.0)

    def jump(t):
        return jnp.where(t < begin + 0.4321, 1.0, -2.0)

    torque = 8 * np.pi * jnp.array([[0.0, 0.0, 1.0]])
    for given, expected in ((pulse, 0.6), (jump, 0.4321 - 2 * 0.5679)):
        turned = jb.Assembly([rod(2)], 1.0, [Motor(None, 0, axis=[0.0, 0.0, 1.0], rate=given)])
        pushed = jb.Assembly([sphere(1.0)], 1.0, torque=lambda t, given=given: given(t) * torque)
        for assembly in (turned, pushed):
            ts = begin + np.array([0.0, 1.0])
            journey = jb.travel(assembly, assembly.drawn, ts, implicit=implicit)
            angle = jb.quaternions.angles(journey.final.turn)[0, 2]
            assert journey.code == 0 and abs(angle - expected) < 1e-5
