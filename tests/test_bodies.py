"""Rigid bodies and motors at one instant, against exact resistances, listed numbers and other routes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeads as jb
from jaxbeads.body import Ball, Hinge, Motor, Weld, ellipsoid, helix, rod, shell, sphere
from jaxbeads.locomotion import motion, resistance

X = [1.0, 0.0, 0.0]


def turning(seed):
    """Some axis and angle."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=3), rng.uniform(0.5, 3.0)


def bacterium(axis=None, angle=0.0, **options):
    """Of section 8 of physics.md, or turned in space."""
    head, tail, direction = sphere(6.0, [-7.0, 0.0, 0.0]), helix(3.0, 14.0, turns=3), jnp.array(X)
    if axis is not None:
        head, tail = (body.turned(axis, angle) for body in (head, tail))
        direction = jb.quaternions.matrix(jb.quaternions.about(axis, angle)) @ direction
    return jb.Assembly([head, tail], 1.0, [Motor(0, 1, axis=direction)], **options)


# RPY and, beside it, the experiment of Rodenborn et al., PNAS 110 (2013) E338: drag/(mu U R),
# thrust/(mu Omega R^2), torque/(mu Omega R^3) of a helix with L/R = 20.63, a/R = 0.063.
HELICES = [
    (2.226, 490, (51.52, 5.840, 127.4), (52.06, 6.264, 131.93)),
    (3.677, 324, (45.45, 8.822, 93.7), (46.96, 9.598, 100.80)),
    (6.509, 227, (37.39, 9.904, 72.9), (39.41, 11.034, 81.93)),
    (9.811, 194, (32.57, 8.731, 64.9), (35.29, 9.569, 72.69)),
    (15.241, 177, (29.14, 6.593, 58.9), (34.12, 7.845, 68.07)),
]


@pytest.mark.parametrize(
    "wavelength, beads, listed, measured",
    [pytest.param(*row, marks=[pytest.mark.slow] if row[1] > 300 else []) for row in HELICES],
)
def test_rigid_helix(wavelength, beads, listed, measured):
    tail = helix(1.0, wavelength, turns=20.63 / wavelength, thickness=0.063)
    assert tail.beads == beads
    matrix = resistance(tail)
    found = matrix[0, 0], -matrix[0, 3], matrix[3, 3]
    for value, reference, experiment in zip(found, listed, measured, strict=True):
        # Half a unit of the last digit that is listed.
        digit = 10.0 ** -(len(f"{reference:g}".partition(".")[2]) if reference != 5.84 else 3)
        assert abs(value - reference) <= 0.501 * digit
        # A touching chain has the drag of a thinner rod: it lies low, by 1 to 16 %.
        assert 0.84 < value / experiment < 0.995


@pytest.mark.parametrize(
    "beads, along, across, around",
    [
        (2, 16 / 13, 1.435356, 3.707317),
        (10, 2.864486, 3.994842, 167.347576),
        (34, 6.492127, 9.940419, 4124.654136),
    ],
)
def test_touching_rod(beads, along, across, around):
    matrix = resistance(rod(beads, 0.5, direction=[0.3, -0.2, 0.9]), 2.0)
    u = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
    n = np.cross(u, [0.0, 1.0, 0.0])
    n /= np.linalg.norm(n)
    drag, turn = matrix[:3, :3] / (6 * np.pi), matrix[3:, 3:] / (8 * np.pi * 2.0 * 0.5**3)
    assert abs(u @ drag @ u - along) < 0.6e-6 and abs(n @ drag @ n - across) < 0.6e-6
    assert abs(n @ turn @ n - around) < 0.6e-6


def test_one_bead_is_a_sphere_and_a_shell_tends_to_one():
    one = resistance(sphere(2.0, [0.0, 0.0, 5.0]), 0.7, about=[0.0, 0.0, 5.0])
    drag, turn = 6 * np.pi * 0.7 * 2.0, 8 * np.pi * 0.7 * 2.0**3
    assert np.allclose(one, np.diag([drag] * 3 + [turn] * 3), rtol=1e-12, atol=1e-12)
    drags = []
    for beads in (50, 100, 200):
        matrix = resistance(shell(2.0, beads), 0.7)
        drags.append(matrix[:3, :3].trace() / (3 * drag) - 1)
        assert (
            abs(drags[-1]) < 0.1 * beads**-0.5 * 2
            and abs(matrix[3:, 3:].trace() / (3 * turn) - 1) < 2e-3
        )
    assert abs(drags[0]) > abs(drags[1]) > abs(drags[2])


def perrin(p):
    """Friction of a prolate spheroid with half axes (p, 1, 1), mu = 1: along, across, about its axis,
    about another (Kim & Karrila, Microhydrodynamics, table 3.4)."""
    e = np.sqrt(1 - p**-2)
    log = np.log((1 + e) / (1 - e))
    along = 8 / 3 * e**3 / (-2 * e + (1 + e**2) * log)
    across = 16 / 3 * e**3 / (2 * e + (3 * e**2 - 1) * log)
    about = 4 / 3 * e**3 * (1 - e**2) / (2 * e - (1 - e**2) * log)
    over = 4 / 3 * e**3 * (2 - e**2) / (-2 * e + (1 + e**2) * log)
    return np.array([6 * along * p, 6 * across * p, 8 * about * p**3, 8 * over * p**3]) * np.pi


@pytest.mark.parametrize("slender, within", [(2.0, 0.005), (5.0, 0.022)])
def test_ellipsoids(slender, within):
    exact = perrin(slender)
    errors = []
    for beads in (50, 200):
        axis = np.array([0.6, 0.0, 0.8])
        matrix = resistance(ellipsoid([slender, 1.0, 1.0], beads, direction=axis))
        drag, turn = matrix[:3, :3], matrix[3:, 3:]
        along, about = axis @ drag @ axis, axis @ turn @ axis
        across, over = (np.trace(drag) - along) / 2, (np.trace(turn) - about) / 2
        errors.append(np.array([along, across, about, over]) / exact - 1)
    # The layer is as thick as a bead, so errors fall like beads^(-1/2).
    assert np.abs(errors[0]).max() < within and np.abs(errors[1]).max() < 0.5 * within


def check_free(assembly, pose, moved, scale):
    """T4: the fluid feels no net force and torque."""
    position = assembly.positions(assembly.frames(pose))
    force = moved.load.force.sum(axis=0)
    torque = (moved.load.torque + jnp.cross(position, moved.load.force)).sum(axis=0)
    assert np.abs(force).max() < 1e-12 * scale and np.abs(torque).max() < 1e-12 * scale


def test_bacterium_at_an_instant():
    assembly = bacterium()
    assert assembly.bodies[1].beads == 35 and assembly.unknowns == 6
    moved = motion(0.0, assembly.drawn, assembly)
    assert np.abs(moved.velocity[0] - np.array([0.170124, 0.049841, -0.012900])).max() < 0.6e-6
    assert np.abs(moved.spin[0] - np.array([-0.380658, 0.001255, -0.008694])).max() < 0.6e-6
    assert abs(moved.joint_torque[0, 0] - 2221.793) < 0.6e-3
    assert np.abs(moved.spin[1] - moved.spin[0] - np.array(X)).max() < 1e-14
    tail = moved.spin[1]
    speed = moved.velocity[0] @ tail / np.linalg.norm(tail)
    assert abs(speed - 0.170390) < 1e-5 * speed
    assert abs(speed / (14 / (2 * np.pi)) - 0.076471) < 1e-5 * 0.076471
    check_free(assembly, assembly.drawn, moved, 2221.8)


def test_bacterium_turned_and_moved():
    one, (axis, angle) = bacterium(), turning(3)
    moved = motion(0.0, one.drawn, one)
    rotation = jb.quaternions.matrix(jb.quaternions.about(axis, angle))
    drawn = bacterium(axis, angle)
    other = motion(0.0, drawn.drawn, drawn)
    # Or drawn as before, in another pose.
    turned = jb.quaternions.about(axis, angle)
    pose = jb.Pose([[3.0, -40.0, 5.0]], jnp.stack([2 * turned, one.drawn.turn[1]]))
    posed = motion(0.0, pose, one)
    for found in (other, posed):
        for name in ("velocity", "spin", "joint_force", "joint_torque"):
            before, after = getattr(moved, name), getattr(found, name)
            assert np.abs(after - before @ rotation.T).max() < 1e-11 * np.abs(before).max()


def lone(body, flow):
    """How a free body moves in a flow."""
    assembly = jb.Assembly([body], 1.0, flow=flow)
    return motion(0.0, assembly.drawn, assembly)


def test_bodies_in_flows():
    shear = jb.flow.Shear(2.0)
    ball = lone(sphere(1.0, [0.0, 3.0, 0.0]), shear)
    assert np.allclose(ball.spin, [[0.0, 0.0, -1.0]], atol=1e-14)
    assert np.allclose(ball.velocity, [[3.0, 0.0, 0.0]], atol=1e-13)  # of the origin, as it turns
    # [derived] section 5: period of a rigid rod of touching beads with RPY + C, by Jeffery's equation.
    for beads, period in ((5, 29.971), (10, 52.942), (20, 96.978)):
        along, across = (
            lone(rod(beads, 1.0, direction=d), jb.flow.Shear(1.0)).spin[0, 2]
            for d in (X, [0.0, 1.0, 0.0])
        )
        assert abs(2 * np.pi / np.sqrt(along * across) - period) < 0.6e-3


def test_a_weld_makes_two_bodies_one():
    first, second, pull = rod(3), rod(2, 0.7, [1.0, 4.0, 2.0], [0.0, 1.0, 1.0]), [0.1, -0.2, 0.3]
    turn = [1.0, 0.5, -0.3]
    joined = jb.Assembly(
        [first, second],
        1.3,
        [Weld(0, 1, [5.0, 1.0, 0.0])],
        force=[pull, [0.0] * 3],
        torque=[turn, [0.0] * 3],
    )
    whole = jb.Assembly(
        [first + second],
        1.3,
        forces=[jb.force.Weight(np.repeat([np.array(pull) / 3, [0.0] * 3], [3, 2], axis=0))],
        torque=[turn],
    )
    one, other = motion(0.0, joined.drawn, joined), motion(0.0, whole.drawn, whole)
    assert np.allclose(one.velocity, np.tile(other.velocity, (2, 1)), atol=1e-14)
    assert np.allclose(one.load.force, other.load.force, atol=1e-13)
    # The joint bears the drag of what hangs on it.
    assert np.allclose(one.joint_force[0], one.load.force[3:].sum(axis=0), atol=1e-14)
    # And the matrix of one body, by another route.
    matrix = resistance(first + second, 1.3)
    wrench = matrix @ np.concatenate([other.velocity[0], other.spin[0]])
    middle = np.asarray(first.position).mean(axis=0)
    assert np.allclose(wrench, [*pull, *(turn + np.cross(middle, pull))], atol=1e-12)


def test_motors_and_torques_are_inverse():
    swimmer = bacterium()
    told = motion(0.0, swimmer.drawn, swimmer)
    driven = jb.Assembly(swimmer.bodies, 1.0, [Hinge(0, 1, axis=X, drive=told.joint_torque[0, 0])])
    found = motion(0.0, driven.drawn, driven)
    assert np.allclose(found.spin, told.spin, atol=1e-12)
    assert np.allclose(found.velocity, told.velocity, atol=1e-12)
    assert abs(found.joint_torque[0, 0] / told.joint_torque[0, 0] - 1) < 1e-12
    check_free(driven, driven.drawn, found, 2221.8)
    # A law of time, and time.
    timed = jb.Assembly(swimmer.bodies, 1.0, [Motor(0, 1, axis=X, rate=lambda t: 3 * t)])
    assert np.allclose(motion(0.5, timed.drawn, timed).spin, 1.5 * told.spin, atol=1e-12)


def test_balls_bear_no_torque_and_hooks_theirs():
    bodies = [rod(3, 1.0, [-4.0, 0.0, 0.0]), rod(4, 1.0, [5.0, 0.0, 0.0])]
    push = [[0.0, 1.0, 0.0], [0.0, 0.0, 0.5]]
    for stiffness in (0.0, 7.0):
        pair = jb.Assembly(bodies, 1.0, [Ball(0, 1, [-0.5, 0.0, 0.0], stiffness)], force=push)
        turn = jb.quaternions.about([0.0, 1.0, 1.0], 0.3)
        pose = jb.Pose(pair.drawn.place, jnp.stack([pair.drawn.turn[0], turn]))
        moved = motion(0.0, pose, pair)
        expected = -stiffness * 0.3 * np.array([0.0, 1.0, 1.0]) / 2**0.5
        assert np.allclose(moved.joint_torque[0], expected, atol=1e-12)
        # Both ends of the joint move as one.
        frames = pair.frames(pose)
        at = frames.point(0, pair.joints[0].point)
        ends = moved.velocity + jnp.cross(moved.spin, at[None] - frames.origin)
        assert np.abs(ends[0] - ends[1]).max() < 1e-14
        # The power that goes in is what the fluid takes.
        relative = moved.spin[1] - moved.spin[0]
        position, body = pair.positions(frames), pair.body_of_bead
        velocity = moved.velocity[body] + jnp.cross(
            moved.spin[body], position - frames.origin[body]
        )
        lost = jnp.sum(velocity * moved.load.force) + jnp.sum(moved.spin[body] * moved.load.torque)
        middle = pair.chain.centres(position)
        speed = moved.velocity + jnp.cross(moved.spin, middle - frames.origin)
        assert abs(jnp.sum(speed * jnp.array(push)) + expected @ relative - lost) < 1e-13


def test_held_bodies():
    held = jb.Assembly(
        [rod(4, 1.0, [1.0, 2.0, 3.0])],
        1.0,
        [Weld(None, 0)],
        flow=jb.flow.LinearFlow(np.diag([0.0, 1.0, -1.0])),
    )
    moved = motion(0.0, held.drawn, held)
    assert held.unknowns == 0 and not np.any(moved.velocity) and not np.any(moved.spin)
    assert np.allclose(moved.joint_force[0], moved.load.force.sum(axis=0))
    assert moved.joint_force[0, 1] < -1  # against the flow
    # Driven about an axis through its end.
    spun = jb.Assembly(
        [rod(4, 1.0, [4.0, 0.0, 0.0])], 1.0, [Motor(None, 0, axis=[0.0, 0.0, 1.0], rate=2.0)]
    )
    moved = motion(0.0, spun.drawn, spun)
    matrix = resistance(rod(4, 1.0, [4.0, 0.0, 0.0]))
    assert abs(moved.joint_torque[0, 2] - 2 * matrix[5, 5]) < 1e-11


class Untabled(jb.mobility.RPY):
    def tables(self, configuration):
        return None


def test_a_wall_and_other_mobilities():
    # [derived] section 6: a tilted rod of 10 touching beads under weight, its lowest bead at h = 2.
    wall = jb.NoSlipWall([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    tilted = np.array([np.sin(np.pi / 6), 0.0, np.cos(np.pi / 6)])
    free = jb.Assembly(
        [rod(10, 1.0, np.array([0.0, 0.0, 2.0]) + 9 * tilted, tilted)],
        1.0,
        domain=wall,
        force=[[0.0, 0.0, -1.0]],
    )
    moved = motion(0.0, free.drawn, free)
    start = jnp.array([[0.0, 0.0, 2.0]])
    middle = moved.velocity + jnp.cross(moved.spin, start + 9 * tilted[None])
    assert np.abs(middle[0] - np.array([-0.0016547, 0.0, -0.0099315])).max() < 1e-7
    assert abs(moved.spin[0, 1] - 0.00023316) < 1e-8
    # Without tables, load by load.
    alone = resistance(rod(3), 1.0, Untabled())
    assert np.abs(alone - resistance(rod(3))).max() < 1e-10
    apart = resistance(rod(3), 1.0, jb.mobility.FreeDraining())
    assert abs(apart[0, 0] - 18 * np.pi) < 1e-12


# Of what depends on everything: radius of the head, those of the helix, viscosity, motor, poses.
def measured(numbers):
    head, radius, pitch, thick, viscosity, rate, pull, angle, place = numbers
    bodies = [
        sphere(head, jnp.stack([-head - 1, place, 0.0])),
        helix(radius, pitch, beads=7, thickness=thick),
    ]
    assembly = jb.Assembly(
        bodies,
        viscosity,
        [Motor(0, 1, axis=X, rate=rate)],
        force=jnp.full((2, 3), pull),
        flow=jb.flow.Shear(0.3),
    )
    turn = jnp.stack(
        [
            jb.quaternions.about([1.0, 2.0, 0.5], angle),
            jb.quaternions.about(X, 2 * angle),
        ]
    )
    moved = motion(0.0, jb.Pose(jnp.array([[place, 0.0, 1.0]]), turn), assembly)
    return jnp.concatenate([moved.velocity.ravel(), moved.spin[0], moved.joint_torque[0] / 100])


def test_gradients_of_an_instant():
    x = jnp.array([3.0, 1.5, 7.0, 0.9, 1.2, 0.8, 0.5, 0.7, 0.3])
    forward, reverse = jax.jit(jax.jacfwd(measured))(x), jax.jit(jax.jacrev(measured))(x)
    value = jax.jit(measured)
    assert np.abs(forward - reverse).max() < 1e-11 * np.abs(forward).max()
    step = 1e-4
    for k, unit in enumerate(np.eye(len(x))):
        # Fourth order.
        one, two = ((value(x + h * unit) - value(x - h * unit)) / (2 * h) for h in (step, 2 * step))
        difference = (4 * one - two) / 3
        assert np.abs(forward[:, k] - difference).max() < 1e-6 * max(1.0, np.abs(difference).max())


def test_gradients_of_a_resistance():
    def torque(numbers):
        radius, pitch, thick, viscosity = numbers
        return resistance(helix(radius, pitch, beads=9, thickness=thick), viscosity)[3, 3]

    x = jnp.array([1.5, 7.0, 0.9, 1.3])
    slope, torque = jax.grad(torque)(x), jax.jit(torque)
    assert np.allclose(slope, jax.jacfwd(torque)(x), rtol=1e-11)
    for k, unit in enumerate(np.eye(4)):
        difference = (torque(x + 1e-5 * unit) - torque(x - 1e-5 * unit)) / 2e-5
        assert abs(slope[k] - difference) < 1e-6 * abs(difference)
    # The resistance is linear in mu, and of the dimension of a volume.
    assert abs(slope[3] * x[3] / torque(x) - 1) < 1e-12
    assert abs(slope[:3] @ x[:3] / torque(x) - 3) < 1e-10


@pytest.mark.parametrize("length, time, force", [(1e-6, 1e-3, 1e-12), (3e4, 7e2, 5e6)])
def test_units(length, time, force):
    viscosity = force * time / length**2

    def swimmer(a, mu, spin, pull):
        bodies = [sphere(6 * a, [-7 * a, 0.0, 0.0]), helix(3 * a, 14 * a, turns=1, thickness=a)]
        return jb.Assembly(
            bodies, mu, [Motor(0, 1, axis=X, rate=spin)], force=[[0.0, pull, 0.0], [0.0] * 3]
        )

    one, other = swimmer(1.0, 1.0, 1.0, 2.0), swimmer(length, viscosity, 1 / time, 2 * force)
    moved, found = motion(0.0, one.drawn, one), motion(0.0, other.drawn, other)
    assert np.abs(found.velocity * time / length - moved.velocity).max() < 1e-11
    assert np.abs(found.spin * time - moved.spin).max() < 1e-11
    assert np.abs(found.joint_torque / (force * length) - moved.joint_torque).max() < 1e-8


BALL = sphere(1.0)
BAD = {
    "points in the plane": (
        lambda: jb.Body([[0.0, 0.0]], 1.0),
        "`position` must have shape (beads, 3), but it has shape (1, 2)",
    ),
    "no radius": (lambda: jb.Body([[0.0, 0.0, 0.0]], 0.0), "`radius` must be positive"),
    "turns and beads": (lambda: helix(1.0, 2.0), "`turns` must be given, or `beads`"),
    "a flat helix": (lambda: helix(1.0, 0.0, turns=1), "`pitch` must not be zero"),
    "few beads of a shell": (lambda: shell(1.0, 3), "`beads` must be at least 4, but it is 3"),
    "no file": (lambda: jb.body.read_points("none.txt"), "`path` must be a file of text"),
    "an axis of zero": (lambda: Motor(0, 1, axis=[0.0, 0.0, 0.0]), "`axis` must not be zero"),
    "a soft hook": (lambda: Ball(0, 1, stiffness=-1.0), "`stiffness` must not be negative"),
    "a joint to itself": (lambda: Weld(1, 1), "`child` must be another body than `parent`"),
    "no body": (lambda: jb.Assembly([], 1.0), "`bodies` must be a list of Body objects"),
    "a chain": (
        lambda: jb.Assembly([jb.Chain(1.0, 1)], 1.0),
        "`bodies` must be a Body object, but it is a Chain",
    ),
    "a body that is not there": (
        lambda: jb.Assembly([BALL], 1.0, [Weld(0, 1)]),
        "`Weld.child` must be one of the 1 bodies, but it is 1",
    ),
    "held twice": (
        lambda: jb.Assembly([BALL, BALL], 1.0, [Weld(0, 1), Weld(None, 1)]),
        "`joints` must hold no body twice",
    ),
    "a loop": (
        lambda: jb.Assembly([BALL, BALL], 1.0, [Weld(0, 1), Weld(1, 0)]),
        "`joints` must make no loop",
    ),
    "forces of another number": (
        lambda: jb.Assembly([BALL], 1.0, force=[[1.0, 0.0, 0.0]] * 2),
        "`force` must have shape (1, 3)",
    ),
    "no viscosity": (lambda: jb.Assembly([BALL], 0.0), "`viscosity` must be positive"),
    "a pose of others": (
        lambda: motion(0.0, jb.Pose(jnp.zeros((2, 3)), jnp.ones((1, 4))), jb.Assembly([BALL], 1.0)),
        "`pose.place` must have shape (1, 3)",
    ),
    "directors": (
        lambda: jb.Assembly([BALL], 1.0, forces=[jb.force.JointBending(1.0)]),
        "`forces` must be made of terms that read positions alone, not of JointBending",
    ),
}


@pytest.mark.parametrize("call, says", BAD.values(), ids=BAD)
def test_bad_input_is_refused(call, says):
    with pytest.raises(ValueError) as caught:
        call()
    assert str(caught.value).startswith("Argument `") and says in str(caught.value)


def test_files_of_points(tmp_path):
    path = tmp_path / "body.txt"
    path.write_text("0, 0, 0, 1\n# a comment\n\n3\t0 0 2.5  # and one more\n")
    body = jb.body.read_points(path)
    assert np.array_equal(body.position, [[0, 0, 0], [3, 0, 0]]) and np.array_equal(
        body.radius, [1, 2.5]
    )
    path.write_text("0 0 0\n1 2\n")
    with pytest.raises(ValueError, match=r"row 2 of .* holds 2"):
        jb.body.read_points(path, radius=1.0)


def test_a_left_handed_helix_is_a_mirror_image():
    right, left = (resistance(helix(1.0, p, turns=2, thickness=0.2)) for p in (3.0, -3.0))
    mirror = np.diag([1.0, 1.0, -1.0, -1.0, -1.0, 1.0])
    assert np.allclose(left, mirror @ right @ mirror, atol=1e-12) and right[0, 3] < 0 < left[0, 3]


def test_single_precision():
    def single(tree):
        return jax.tree.map(lambda x: x.astype(jnp.float32), tree)

    assembly = bacterium()
    expected = motion(0.0, assembly.drawn, assembly)
    found = motion(jnp.float32(0.0), single(assembly.drawn), single(assembly))
    assert {x.dtype for x in jax.tree.leaves(found)} == {jnp.dtype(jnp.float32)}
    assert np.abs(found.velocity - expected.velocity).max() < 1e-4
    assert np.abs(found.joint_torque - expected.joint_torque).max() < 0.3


def ball_jointed(root, **options):
    """A chain of the Joint Model in space, and the same as bodies that hang on one of them."""
    rng, beads = np.random.default_rng(0), 7
    chain = jb.Chain(1.0, beads)
    directors = np.cumsum(0.3 * rng.normal(size=(beads, 3)), axis=0) + np.array(X)
    state = jb.from_directors(chain, directors)
    ahead = state.position + state.director
    joints = [Ball(*((i + 1, i) if i < root else (i, i + 1)), ahead[i]) for i in range(beads - 1)]
    bodies = [jb.Body(x[None], 1.0) for x in state.position]
    scene = jb.Scene(chain, 1.0, constraints=[jb.constraint.Joint()], **options)
    return scene, state, jb.Assembly(bodies, 1.0, joints, **options)


@pytest.mark.parametrize("root", [0, 3, 6])
def test_bodies_with_joints_move_as_a_chain_of_the_joint_model(root):
    flow = jb.flow.LinearFlow([[0.1, 0.5, 0.0], [0.0, -0.1, 0.2], [0.3, 0.0, 0.0]])
    weight = jb.force.Weight([0.2, -1.0, 0.3])
    scene, state, assembly = ball_jointed(root, forces=[weight], flow=flow)
    expected = jb.dynamics.motion(0.0, state, scene)
    moved = motion(0.0, assembly.drawn, assembly)
    frames = assembly.frames(assembly.drawn)
    velocity = moved.velocity + jnp.cross(moved.spin, state.position - frames.origin)
    assert assembly.order[0] == root
    assert np.abs(velocity - expected.velocity).max() < 1e-12
    assert np.abs(moved.spin - expected.spin).max() < 1e-12


def test_a_hook_that_resists_twist_otherwise_follows_its_energy():
    axis = np.array([0.6, 0.0, 0.8])
    hook = Ball(0, 1, (0.0, 0.0, 0.0), 2.0, 5.0, 3 * axis)

    def energy(turn):
        r = jb.quaternions.angles(turn)
        return (2.0 * (r @ r) + 3.0 * (r @ axis) ** 2) / 2

    turn = 1.7 * jb.quaternions.about(*turning(5))
    torque = hook.torque(jnp.zeros(()), turn)
    for unit, component in zip(np.eye(3), torque, strict=True):
        ahead, behind = (
            energy(jb.quaternions.product(jb.quaternions.about(unit, x), turn))
            for x in (1e-5, -1e-5)
        )
        assert abs(component + (ahead - behind) / 2e-5) < 1e-8
    alike = Ball(0, 1, (0.0, 0.0, 0.0), 2.0, 2.0, axis), Ball(0, 1, (0.0, 0.0, 0.0), 2.0)
    one, other = (hook.torque(jnp.zeros(()), turn) for hook in alike)
    assert np.abs(one - other).max() < 1e-12


def test_fibres_that_cannot_be_are_refused():
    for arguments, sentence in (
        ((sphere(1.0), 1.0), "Argument `shape` must hold two beads at least, but it holds one."),
        ((rod(4), [1.0, 2.0]), "Argument `rigidity` must have shape () or (3,)"),
        ((rod(4), 1.0, -1.0), "Argument `twist_rigidity` must"),
        (
            (rod(2) + rod(1, 1.0, [1.0, 0.0, 0.0]), 1.0),
            "Argument `shape` must hold no two neighbours",
        ),
    ):
        with pytest.raises(ValueError) as error:
            jb.body.fibre(*arguments)
        assert str(error.value).startswith(sentence)
    with pytest.raises(ValueError, match="Argument `twist_stiffness` must"):
        Ball(0, 1, stiffness=1.0, twist_stiffness=-1.0)
