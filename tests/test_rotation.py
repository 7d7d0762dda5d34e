"""Gate T18: what starts turned, shifted or mirrored moves turned, shifted or mirrored, whichever way it
points: every force, flow, constraint, drive and scene in space."""

import cases
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent, jointed, name

from jaxbeads import (
    Chain,
    Load,
    Motion,
    Scene,
    State,
    dynamics,
    material,
    rollout,
    scenes,
    straight,
    with_frames,
)
from jaxbeads.actuation import HelicalBeat, TravellingWave
from jaxbeads.constraint import (
    EqualSpins,
    Gears,
    Inextensible,
    Joint,
    PrescribedDirection,
    PrescribedLengths,
    PrescribedPosition,
    PrescribedRoll,
    PrescribedSpin,
)
from jaxbeads.flow import Poiseuille, VelocityField
from jaxbeads.force import (
    AbstractForce,
    Bending,
    Contact,
    ElasticRod,
    EndTorque,
    JointBending,
    JointRepulsion,
    MagneticBeads,
    Weight,
)


def rotation(axis, angle):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


TURNS = {
    "any": rotation([1, 2, -3], 1.1),
    "x to -x": rotation([0, 0, 1], np.pi),
    "x nearly to -x": rotation([0, 0.6, 0.8], np.pi - 1e-7),
    "x to z": rotation([0, 1, 0], -np.pi / 2),
    "about x": rotation([1, 0, 0], 2.0),
}
MIRROR = np.diag([1.0, 1.0, -1.0])
SHIFT = np.array([3.0, -40.0, 7.0])


def turned(thing, q):
    return cases.turned(thing, cases.Turn(jnp.asarray(q), jnp.asarray(SHIFT)))


CHAIN = Chain(1.0, 7)
LAW = HelicalBeat(0.3, 1.7)
WAVES = ElasticRod(
    30.0,
    20.0,
    intrinsic_curvature=TravellingWave(0.2, 0.4, 1.5, 0.3),
    second_curvature=TravellingWave(0.1, 0.4, 1.5, 1.3),
)
MODELS = {
    f"force {index} {name(force)}": Scene(
        CHAIN,
        0.8,
        constraints=[] if force.links else [Gears()],
        forces=[force],
    )
    for index, force in enumerate(cases.forces(3))
}
MODELS |= {
    f"flow {name(flow)}": Scene(CHAIN, 0.8, constraints=[Gears()], flow=flow)
    for flow in cases.flows(3)
}
MODELS |= {
    f"constraint {type(c).__name__}": Scene(
        CHAIN, 0.8, constraints=[Gears(), c], forces=[Weight([0.1, -0.4, 0.2])]
    )
    for c in [
        EqualSpins(),
        PrescribedPosition(LAW, bead=2),
        PrescribedSpin(LAW, bead=-1),
        PrescribedRoll(lambda t: jnp.stack([jnp.sin(t), 1.3]), bead=(0, 3), across=True),
        PrescribedDirection(LAW, bond=1),
    ]
}
MODELS |= {
    "distances": Scene(CHAIN, 0.8, constraints=[Inextensible()], forces=[Weight([0.1, -0.4, 0.2])]),
    "lengths": Scene(
        CHAIN,
        0.8,
        constraints=[PrescribedLengths(lambda t: 2 + 0.1 * jnp.sin(t + jnp.arange(6.0)))],
    ),
    "joints": Scene(
        Chain(1.0, 7, gap=0.1),
        0.8,
        constraints=[Joint()],
        forces=[JointBending(3.0, 0.02, repulsion=JointRepulsion(0.5, 0.5, 2.0, 0.5))],
    ),
    "moments along directors": Scene(
        Chain(1.0, 7, gap=0.1),
        0.8,
        constraints=[Joint()],
        forces=[MagneticBeads(np.linspace(-0.5, 1.0, 7), cases.turning_field(3), permeability=5.0)],
    ),
    "bending along vectors": Scene(
        CHAIN,
        0.8,
        constraints=[Gears()],
        forces=[Bending(30.0, np.random.default_rng(1).normal(size=(5, 3)) / 20)],
    ),
    "waves about two axes": Scene(CHAIN, 0.8, constraints=[Gears()], forces=[WAVES]),
    "unequal beads and fibres": Scene(
        Chain(np.linspace(0.7, 1.3, 7), (3, 4)),
        0.8,
        constraints=[Gears()],
        forces=[WAVES, Contact(5.0, 2.5, 1.0)],
    ),
}


def start(model):
    chain = model.chain
    if model.oriented:
        return jointed(chain, 3)
    if any(force.links for force in model.forces):
        return State(1.1 * bent(chain, 3).position)
    centre = 4.0 * np.arange(len(chain.fibres))[:, None] * np.array([[0.3, 0.2, 1.0]])
    return bent(chain, 3, centre=centre)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_the_motion_turns_with_the_state(model):
    state = model.begin(start(model))
    still = jax.jit(lambda s: dynamics.rate(0.3, s, model))(state)
    other = jax.jit(lambda q, s: dynamics.rate(0.3, turned(s, q), turned(model, q)))
    # Waves about two axes, twist and torques are left-handed in a mirror.
    mirrored = not any(force.needs_frames for force in model.forces)
    mirrored = mirrored and not any(isinstance(f, EndTorque) for f in model.forces)
    mirrored = mirrored and not any(isinstance(c, PrescribedRoll) for c in model.constraints)
    had = model.mobility.symmetries
    assert {"translation", "rotation"} <= had
    turns = TURNS | ({"mirror": MIRROR} if mirrored and "reflection" in had else {})
    for turn, q in turns.items():
        found = other(q, state)
        for a, b in zip(jax.tree.leaves(still), jax.tree.leaves(found), strict=True):
            assert np.abs(a @ q.T - b).max() < 1e-11 * np.abs(a).max(), turn


def paths():
    """Scenes that are run, and how: a helical wave, a joint's directors, a law and a flow."""
    two, many = {"tolerance": 1e-4}, {"substeps": 100}
    yield "waves about two axes", MODELS["waves about two axes"], two
    yield "waves about two axes, equal steps", MODELS["waves about two axes"], many
    yield "joints", MODELS["joints"], many
    yield "law", MODELS["constraint PrescribedDirection"], two
    yield "flow", Scene(CHAIN, 0.8, constraints=[Gears()], flow=Poiseuille(5.0, 9.0)), two


@pytest.mark.parametrize("path", list(paths()), ids=lambda path: path[0])
def test_trajectories_turn_with_their_start(path):
    _, model, options = path
    state, ts = model.begin(start(model)), np.linspace(0.0, 1.0, 3)
    plain = jax.jit(lambda s: rollout(model, s, ts, **options).states)(state)
    other = jax.jit(lambda q, s: rollout(turned(model, q), turned(s, q), ts, **options).states)
    assert np.abs(plain.position[-1] - plain.position[0]).max() > 0.003
    for turn in ("any", "x nearly to -x"):
        q = TURNS[turn]
        found = other(q, state)
        for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(found), strict=True):
            moved = SHIFT if a is plain.position else 0.0
            off = np.abs(np.asarray(a) @ q.T + moved - b).max()
            assert off < 1e-9 * float(model.chain.length.max()), turn


@pytest.mark.parametrize("build", [scenes.spiral, scenes.helical_beating], ids=lambda f: f.__name__)
def test_ready_made_scenes_in_space_turn_with_their_start(build):
    case = build(6)
    model, ts = case.scene, np.linspace(0.0, 1.0, 3)
    # The first start is bent.
    state = model.begin(bent(model.chain, 3) if build is scenes.spiral else case.state)
    q = TURNS["x nearly to -x"]
    plain = rollout(model, state, ts, substeps=400).states
    other = rollout(turned(model, q), turned(state, q), ts, substeps=400).states
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(other), strict=True):
        moved = SHIFT if a is plain.position else 0.0
        off = np.abs(np.asarray(a) @ q.T + moved - b).max()
        assert off < 1e-9 * float(model.chain.length[0])


def test_a_spiral_swims_alike_in_all_directions():
    # From straight, without frames of its own: also along -x and nearly so.
    case = scenes.spiral(8, 15.0)
    length = float(case.scene.chain.length[0])

    @jax.jit
    def swum(state):
        run = rollout(case.scene, state, np.array([0.0, 1.0]), tolerance=1e-6)
        return jnp.linalg.norm(jnp.mean(run.final.position - state.position, axis=0)), run.code

    along = [(1, 0, 0), (0, 0, 1), (-0.99, 0.14, 0), (-1, 0, 0), (-1, 1e-9, 0), (0, -1, 1e-12)]
    found = [swum(straight(case.scene.chain, np.array(d, float))) for d in along]
    assert all(int(code) == 0 for _, code in found)
    ways = np.array([float(way) for way, _ in found]) / length
    assert ways[0] > 1e-4 and np.abs(ways - ways[0]).max() < 1e-9 * ways[0]


def test_frames_turn_without_spin():
    # A rod led once around a cone of 60 degrees, whose beads do not spin about it, comes back turned
    # by the solid angle, 2 pi (1 - cos 60) = pi: parallel transport on the sphere.
    def direction(t):
        c, s = np.cos(np.pi / 3), np.sin(np.pi / 3)
        return jnp.stack([c + 0 * t, s * jnp.cos(t), s * jnp.sin(t)])

    chain = Chain(1.0, 4)
    state = with_frames(straight(chain, np.asarray(direction(0.0))), chain)

    # By the rate alone, whatever moves the rod: each position is known.
    def rate(t, frame):
        beads = 2 * jnp.arange(4.0)[:, None]
        place, velocity = jax.jvp(lambda t: beads * direction(t)[None], (t,), (1.0,))
        return material.rate(frame, place, Motion(velocity, 0 * place), chain)

    n, steps = state.frame, 2000
    h = 2 * np.pi / steps

    def step(n, k):
        t = k * h
        a = rate(t, n)
        b = rate(t + h / 2, n + h / 2 * a)
        c = rate(t + h / 2, n + h / 2 * b)
        d = rate(t + h, n + h * c)
        return n + h / 6 * (a + 2 * b + 2 * c + d), None

    end, _ = jax.lax.scan(step, n, jnp.arange(steps * 1.0))
    assert np.abs(jnp.sum(end * n, axis=1) - np.cos(np.pi)).max() < 1e-9
    assert np.abs(jnp.linalg.norm(end, axis=1) - 1).max() < 1e-11  # of the Runge-Kutta steps here


def test_directors_of_other_terms_stay_unit_vectors():
    # A user's force that reads directors, under Gears, with every solver.
    class Push(AbstractForce):
        oriented = True
        rotational = True

        def load(self, t, state, scene):
            return Load(force=state.director, torque=0.3 * jnp.ones_like(state.director))

    chain = Chain(1.0, 4)
    model = Scene(chain, 1.0, constraints=[Gears()], forces=[Push(), Bending(5.0)])
    state = State(bent(chain, 3).position, jnp.tile(jnp.array([[0.0, 0.6, 0.8]]), (4, 1)))
    ts = np.linspace(0.0, 40.0, 3)
    for options in ({}, {"substeps": 200}, {"solver": diffrax.Tsit5(), "tolerance": 1e-3}):
        run = rollout(model, state, ts, **options)
        lengths = np.linalg.norm(run.states.director, axis=-1)
        assert np.abs(run.states.director[-1] - state.director).max() > 0.1
        assert np.abs(lengths - 1).max() < 1e-14


def test_spheres_feel_a_curved_flow_as_its_mean_over_their_surface():
    # Faxen's laws against quadrature: a Stokes flow (a point force at a distance) and a parabola, beads
    # of several radii; the spin is half the curl, the strain that of the mean over the surface.
    force = jnp.array([0.3, -0.2, 0.5])

    def stokeslet(t, x):
        r = x - jnp.array([5.0, 1.0, -2.0])
        d = jnp.linalg.norm(r)
        return force / d + jnp.dot(force, r) * r / d**3

    nodes, weights = np.polynomial.legendre.leggauss(12)
    angles = 2 * np.pi * np.arange(24) / 24
    s = np.sqrt(1 - nodes**2)
    n = np.stack(
        [np.outer(s, np.cos(angles)), np.outer(s, np.sin(angles)), np.outer(nodes, np.ones(24))], -1
    ).reshape(-1, 3)
    w = np.repeat(weights / 2, 24) / 24
    for flow in (VelocityField(stokeslet), Poiseuille(1.3, 4.0)):
        for radius in (0.5, 1.0):
            centre = jnp.array([0.4, 0.9, -0.3])
            model = Scene(Chain(radius, 1), 1.0, constraints=[PrescribedSpin()], flow=flow)
            fluid = dynamics.fluid_motion(0.0, State(centre[None]), model)
            u = np.stack([flow.velocity(jnp.zeros(()), centre + radius * x) for x in n])
            mean = w @ u
            turning = 1.5 / radius * w @ np.cross(n, u)
            assert np.abs(fluid.velocity[0] - mean).max() < 1e-10
            assert np.abs(fluid.spin[0] - turning).max() < 1e-10
