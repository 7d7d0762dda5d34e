"""The fluid between the beads: against classical flows of spheres, quadrature, Blake's tensor."""

from functools import cache
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent, in_units, scene, spatial
from sphere_average import sphere_flow
from test_walls import blake, sphere

import jaxbeads as jb
from jaxbeads import Chain, FreeSurface, Load, NoSlipWall, Scene, State, dynamics, flow_field, pairs
from jaxbeads.actuation import TravellingWave
from jaxbeads.constraint import Gears, Inextensible
from jaxbeads.flow import LinearFlow, Shear, VelocityField
from jaxbeads.force import AbstractForce, Bending, BendingEnergy, Weight
from jaxbeads.mobility import RPY, AbstractMobility, FreeDraining
from jaxbeads.objectives import mean_over_time

MU = 1.3
GRADIENT = np.array([[0.1, 0.5, 0.2], [-0.2, -0.3, 0.4], [0.7, 0.1, 0.2]])
STRAIN = (GRADIENT + GRADIENT.T) / 2
NONE = np.zeros(3), np.zeros(3), np.zeros((3, 3))
NODES, WEIGHTS = sphere(20)
THREE = np.array([[0.0, 0.0, 0.0], [3.0, 0.5, 0.2], [-2.0, 1.0, 2.0]])
RADII = np.array([1.0, 0.7, 1.3])


class Push(AbstractForce):
    """Forces and torques as they are given."""

    force: jax.Array
    torque: jax.Array
    rotational: ClassVar[bool] = True

    def load(self, t, state, scene):
        return Load(self.force, self.torque)


def pushed(beads, seed=0, dim=3):
    rng = np.random.default_rng(seed)
    turns = 3 if dim == 3 else 1
    return Push(
        jnp.asarray(rng.normal(size=(beads, dim))), jnp.asarray(rng.normal(size=(beads, turns)))
    )


def places(number=40, size=4.0, dim=3, seed=1):
    return np.random.default_rng(seed).normal(size=(number, dim)) * size


def spheres(flow=None, domain=None, position=THREE):
    space = {} if domain is None else {"domain": domain}
    forces = [pushed(3)]
    return State(position), Scene(Chain(RADII, (1, 1, 1)), MU, forces=forces, flow=flow, **space)


def by_hand(x, position, radii, load, gradient=None):
    """Classical flows of single spheres, and a linear ambient flow."""
    gradient = NONE[2] if gradient is None else gradient
    strain, u = (gradient + gradient.T) / 2, x @ gradient.T
    forces, torques = (
        np.zeros_like(position) if f is None else f for f in (load.force, load.torque)
    )
    for r, a, force, torque in zip(position, radii, forces, torques, strict=True):
        u = u + sphere_flow(x - r, a, np.asarray(force), np.asarray(torque), NONE[2]) / MU
        u = u + sphere_flow(x - r, a, *NONE[:2], strain)
    return u


def outside(x, position, radii):
    return np.all(np.linalg.norm(x[:, None] - position, axis=2) > radii, axis=1)


def test_spheres_with_forces_torques_and_strain():
    state, scene = spheres(LinearFlow(GRADIENT))
    x = places()
    x = x[outside(x, THREE, RADII)]
    expected = by_hand(x, THREE, RADII, scene.forces[0], GRADIENT)
    assert len(x) > 30 and np.abs(flow_field(0.0, state, scene)(x) - expected).max() < 1e-13


def test_the_fluid_sticks_to_a_single_sphere():
    # The exact solution: uniform motion, rotation, shear and extension with force and torque.
    state = State([[0.3, -0.2, 0.5]])
    scene = Scene(Chain(1.2, 1), MU, forces=[pushed(1)], flow=LinearFlow(GRADIENT))
    field = flow_field(0.0, state, scene)
    moved = dynamics.motion(0.0, state, scene)

    def rigid(arm):
        return np.asarray(moved.velocity) + np.cross(moved.spin, arm)

    arm = 1.2 * (1 + 1e-13) * NODES
    assert np.abs(field(state.position + arm) - rigid(arm)).max() < 1e-11
    within = 1.15 * np.linspace(0.0, 1.0, 20)[:, None] * NODES[:20]
    assert np.abs(field(state.position + within) - rigid(within)).max() < 1e-14
    # Stokes's solution for a sphere that is held in a stream, relative to the stream at infinity.
    far = np.array([[1e9, 0.0, 0.0]])
    drag = np.asarray(scene.forces[0].force[0])
    alone = Scene(Chain(1.2, 1), MU, forces=scene.forces)
    stokeslet = (drag + np.array([drag[0], 0, 0])) / (8 * np.pi * MU * 1e9)
    assert np.abs(flow_field(0.0, state, alone)(far)[0] / stokeslet - 1).max() < 1e-8


@pytest.mark.parametrize(
    "flow",
    [
        LinearFlow(GRADIENT),
        VelocityField(
            lambda t, x: jnp.stack([x[1] ** 2 - 0.3 * x[2] ** 2, x[2] ** 2, 0.2 * x[0] ** 2])
        ),
    ],
    ids=["linear", "curved"],
)
def test_its_means_over_beads_are_their_motion(flow):
    # By Faxen's laws, where no beads overlap; `within` is left aside by a hair.
    state, scene = spheres(flow)
    moved, field = dynamics.motion(0.0, state, scene), flow_field(0.0, state, scene)
    arms = NODES[None] * (RADII * (1 + 1e-13))[:, None, None]
    u = np.asarray(field(THREE[:, None] + arms))
    assert np.abs(np.einsum("q,iqk->ik", WEIGHTS, u) - moved.velocity).max() < 1e-10
    turn = 1.5 * np.einsum("q,iqk->ik", WEIGHTS, np.cross(NODES[None], u)) / RADII[:, None]
    assert np.abs(turn - moved.spin).max() < 1e-10


@cache
def swimmer(inextensible=False):
    chain, wave = Chain(1.0, 6), TravellingWave(0.2, 0.5, 1.0)
    terms = [Inextensible()], [BendingEnergy(20.0, wave)]
    if not inextensible:
        terms = [Gears()], [Bending(20.0, wave)]
    return bent(chain), Scene(chain, MU, RPY(), *terms)


def test_a_fibre_drives_the_fluid_by_all_its_loads():
    state, scene = swimmer()
    scene = eqx.tree_at(lambda s: s.forces, scene, (*scene.forces, Weight([0.3, -1.0])))
    scene = eqx.tree_at(lambda s: s.flow, scene, Shear(0.4), is_leaf=lambda x: x is None)
    load = jb.observables.load_on_fluid(0.2, state, scene)
    load = Load(jnp.pad(load.force, ((0, 0), (0, 1))), jnp.pad(load.torque, ((0, 0), (2, 0))))
    position, gradient = np.asarray(spatial(state).position), np.zeros((3, 3))
    gradient[0, 1] = 0.4
    x = places(60, 6.0)
    x = x[outside(x, position, np.ones(6))]
    field = flow_field(0.2, state, scene)
    assert np.abs(field(x) - by_hand(x, position, np.ones(6), load, gradient)).max() < 1e-13
    # A plane through the beads, grids and single points.
    flat = jnp.asarray(x[:, :2]).at[:, 1].add(20.0)
    assert np.array_equal(field(flat), field(jnp.pad(flat, ((0, 0), (0, 1))))[:, :2])
    assert np.array_equal(field(flat.reshape(2, -1, 2)).reshape(-1, 2), field(flat))
    assert field(flat[0]).shape == (2,)


def test_a_planar_flow_that_gathers_leaves_along_the_normal():
    state = State([[0.0, 0.0], [2.5, 0.3]])
    matrix = np.array([[0.3, 0.5], [-0.1, 0.4]])
    whole = np.pad(matrix, ((0, 1), (0, 1)))
    whole[2, 2] = -0.7
    flat = Scene(Chain(1.0, (1, 1)), MU, forces=[pushed(2, dim=2)], flow=LinearFlow(matrix))
    push = Push(
        *(
            jnp.pad(x, p)
            for x, p in zip(
                (flat.forces[0].force, flat.forces[0].torque),
                (((0, 0), (0, 1)), ((0, 0), (2, 0))),
                strict=True,
            )
        )
    )
    solid = Scene(Chain(1.0, (1, 1)), MU, forces=[push], flow=LinearFlow(whole))
    x = places()
    found = flow_field(0.0, state, flat)(x) - flow_field(0.0, spatial(state), solid)(x)
    assert np.abs(found).max() < 1e-14


@pytest.mark.parametrize("inextensible", [False, True], ids=["Gears", "Inextensible"])
def test_planar_is_spatial(inextensible):
    x = places(60, 3.0)
    state, scene = swimmer(inextensible)
    bending = BendingEnergy(20.0) if inextensible else Bending(20.0)
    flat = flow_field(0.1, state, eqx.tree_at(lambda s: s.forces, scene, (bending,)))
    solid = flow_field(0.1, spatial(state), eqx.tree_at(lambda s: s.forces, scene, (bending,)))
    assert np.abs(flat(x) - solid(x)).max() < 1e-13
    assert np.abs(flat.motion.spin - solid.motion.spin).max() < 1e-13


def test_far_away_a_weight_is_a_point_force_and_a_swimmer_a_dipole():
    state, scene = swimmer()
    direction = np.array([0.6, 0.64, 0.48])
    r = np.array([1e4, 2e4])[:, None] * direction
    position = np.asarray(spatial(state).position)
    load = jb.observables.load_on_fluid(0.1, state, scene)
    force = np.pad(np.asarray(load.force), ((0, 0), (0, 1)))
    torque = np.pad(np.asarray(load.torque), ((0, 0), (2, 0)))
    assert np.abs(force.sum(0)).max() < 1e-12
    # The dipole D_jk: sum of r_j F_k, and half of the torques.
    dipole = position.T @ force
    epsilon = np.zeros((3, 3, 3))
    for i, j, k, sign in pairs.CROSS[3]:
        epsilon[i, j, k] = sign
    dipole = dipole + 0.5 * np.einsum("jki,i->jk", epsilon, torque.sum(0))
    n = direction
    # -D_jk d_j G_ik, with G = (I + nn)/(8 pi mu r)
    slope = -np.einsum("j,ik->jik", n, np.eye(3)) + np.einsum("ij,k->jik", np.eye(3), n)
    slope = slope + np.einsum("kj,i->jik", np.eye(3), n) - 3 * np.einsum("i,j,k->jik", n, n, n)
    expected = -np.einsum("jk,jik->i", dipole, slope) / (8 * np.pi * MU)
    u = np.asarray(flow_field(0.1, state, scene)(r)) * np.array([1e8, 4e8])[:, None]
    assert np.abs(2 * u[1] - u[0] - expected).max() < 1e-5 * np.abs(expected).max()
    heavy = Scene(scene.chain, MU, constraints=[Gears()], forces=[Weight([0.0, -1.0])])
    u = np.asarray(flow_field(0.1, state, heavy)(r)) * np.array([1e4, 2e4])[:, None]
    weight = np.array([0.0, -6.0, 0.0])
    assert np.abs(u - (weight + n * (n @ weight)) / (8 * np.pi * MU)).max() < 1e-3


HALF_SPACES = {
    "wall": NoSlipWall([0.0, 0.0, -4.0], [0.1, 0.2, 1.0]),
    "surface": FreeSurface([0.0, 0.0, -4.0], [0.1, 0.2, 1.0]),
}


def above(x, plane):
    height = np.asarray(plane.height(jnp.asarray(x)))
    return x - np.minimum(height, 0.0)[:, None] * 1.5 * np.asarray(plane.direction)


@pytest.mark.parametrize("name", [None, *HALF_SPACES])
def test_no_fluid_is_made(name):
    domain = HALF_SPACES.get(name)
    flow = LinearFlow(GRADIENT) if domain is None else None
    field = flow_field(0.0, *spheres(flow, domain))
    x = places(60) if domain is None else above(places(60), domain)
    x = x[outside(x, THREE, RADII)]
    slopes = jax.jit(jax.vmap(jax.jacfwd(field)))(x)
    assert np.abs(np.trace(slopes, axis1=1, axis2=2)).max() < 1e-13 < np.abs(slopes).max()


@pytest.mark.parametrize("name", HALF_SPACES)
def test_at_a_boundary(name):
    domain = HALF_SPACES[name]
    n = np.asarray(domain.direction)
    state, scene = spheres(None, domain)
    field, x = flow_field(0.0, state, scene), places()
    on = x - np.asarray(domain.height(jnp.asarray(x)))[:, None] * n
    at, near = (np.asarray(field(on + h * n)) for h in (1e-12, 1.0))
    if name == "wall":
        assert np.abs(at).max() < 1e-11 < 1e-3 < np.abs(near).max()
    else:
        slopes = np.asarray(jax.vmap(jax.jacfwd(field))(on + 1e-12 * n))
        stress = (slopes + np.swapaxes(slopes, 1, 2)) @ n
        tangential = stress - (stress @ n)[:, None] * n
        assert np.abs(at @ n).max() < 1e-11 and np.abs(tangential).max() < 1e-11
        assert np.abs(at).max() > 1e-3
    assert not np.any(field(on - 0.1 * n))
    # Its mean over beads is their velocity, as in an unbounded fluid.
    arms = NODES[None] * (RADII * (1 + 1e-13))[:, None, None]
    mean = np.einsum("q,iqk->ik", WEIGHTS, field(THREE[:, None] + arms))
    assert np.abs(mean - dynamics.motion(0.0, state, scene).velocity).max() < 1e-9


def test_the_wall_by_blakes_tensor():
    # Sources spread over the sphere: forces evenly, torques and stresslets as tractions.
    x, a = np.array([0.3, -0.2, 1.8]), 1.2
    gradient = np.array([[0.0, 0.0, 0.4], [0.0, 0.0, -0.7], [0.0, 0.0, 0.0]])  # vanishes at z = 0
    strain, push = (gradient + gradient.T) / 2, pushed(1)
    domain = NoSlipWall([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    scene = Scene(Chain(a, 1), MU, forces=[push], flow=LinearFlow(gradient), domain=domain)
    points = np.array([[2.0, 1.0, 0.7], [-1.5, 0.4, 3.0]])
    force, torque = np.asarray(push.force[0]), np.asarray(push.torque[0])
    traction = force / (4 * np.pi * a**2) + 1.5 * np.cross(torque, NODES) / (4 * np.pi * a**3)
    traction = traction - 5 * MU * NODES @ strain
    area = 4 * np.pi * a**2 / (8 * np.pi * MU)
    found = flow_field(0.0, State(x[None]), scene)(points)
    for p, u in zip(points, found, strict=True):
        tensors = np.array([blake(p, x + a * q) for q in NODES])
        expected = area * np.einsum("q,qij,qj->i", WEIGHTS, tensors, traction) + gradient @ p
        assert np.abs(u - expected).max() < 1e-7


def test_within_beads_it_is_their_motion():
    state, scene = swimmer()
    moved, field = dynamics.motion(0.1, state, scene), flow_field(0.1, state, scene)
    arm = np.array([0.3, -0.5])
    turned = np.asarray(moved.spin) * np.array([0.5, 0.3])
    assert np.abs(field(state.position + arm[None]) - moved.velocity - turned).max() < 1e-14
    assert np.abs(field.motion.velocity[:, :2] - moved.velocity).max() == 0
    # Without spins in the scene beads turn as the fluid turns them.
    chain = Chain(1.0, (1, 1))
    pair = State([[0.0, 0.0], [4.0, 0.0]])
    falling = [Weight([0.0, -1.0])]
    turning = [pushed(2, dim=2)]
    turning[0] = Push(jnp.asarray([[0.0, -1.0]] * 2), jnp.zeros((2, 1)))
    still, spun = (Scene(chain, MU, forces=f, flow=Shear(0.2)) for f in (falling, turning))
    spins = dynamics.motion(0.0, pair, spun).spin
    assert np.abs(flow_field(0.0, pair, still).motion.spin[:, 2:] - spins).max() < 1e-15


def test_gradients_and_batches():
    state, scene = swimmer()
    x = jnp.asarray([[3.0, 4.0], [-2.0, 5.0]])

    def speed(t, moved, viscosity):
        there = State(state.position + moved)
        other = eqx.tree_at(lambda s: s.viscosity, scene, viscosity)
        return jnp.sum(flow_field(t, there, other)(x) ** 2)

    at = jnp.asarray(0.3), jnp.zeros_like(state.position), jnp.asarray(MU)
    slopes = jax.jit(jax.grad(speed, argnums=(0, 1, 2)))(*at)
    along = jnp.asarray(1.0), jnp.asarray(places(6, 0.3, 2)), jnp.asarray(0.2)
    exact = sum(jnp.sum(s * d) for s, d in zip(slopes, along, strict=True))
    compiled, h = jax.jit(speed), 1e-5
    ahead, behind = (
        compiled(*(a + s * h * d for a, d in zip(at, along, strict=True))) for s in (1, -1)
    )
    assert abs((ahead - behind) / (2 * h) / exact - 1) < 1e-7
    ts = jnp.asarray([0.1, 0.3])
    fields = jax.vmap(lambda t: flow_field(t, state, scene))(ts)
    many = jax.vmap(lambda field: field(x))(fields)
    one = flow_field(0.3, state, scene)(x)
    assert np.abs(many[1] - one).max() < 1e-14 < np.abs(many[0] - one).max()


def test_points_in_blocks(monkeypatch):
    state, scene = spheres(LinearFlow(GRADIENT))
    field, x = flow_field(0.0, state, scene), places(41)
    whole = field(x)
    monkeypatch.setattr(pairs, "PAIRS", 30)
    assert np.abs(jax.jit(lambda y: field(y))(x) - whole).max() < 1e-14
    assert field(x[:0]).shape == (0, 3)


@pytest.mark.parametrize("units", [(1e-6, 1e-3, 1e-12), (3e4, 7e2, 5e6)], ids=["micro", "large"])
def test_units(units):
    chain = Chain([1.0, 1.2, 0.9, 1.0, 1.1], 5)
    state, made = bent(chain, 3, 1), scene(chain, 3)
    x = places(30, 5.0)
    one = np.asarray(flow_field(0.0, state, made)(x))
    two = flow_field(0.0, in_units(state, units), in_units(made, units))(x * units[0])
    assert np.abs(np.asarray(two) * units[1] / units[0] - one).max() < 1e-12


def test_the_mean_over_a_run():
    state, scene = swimmer()
    run = jb.rollout(scene, state, np.linspace(0.0, 2.0, 4), substeps=20)
    x = jnp.asarray([[3.0, 4.0], [-2.0, 5.0], [0.2, 0.1]])
    each = np.array(
        [
            flow_field(t, jax.tree.map(lambda s, k=k: s[k], run.states), scene)(x)
            for k, t in enumerate(run.ts)
        ]
    )
    weights = np.array([0.5, 1.0, 1.0, 0.5]) / 3
    found = jb.average_flow_field(run, scene)(x)
    assert np.abs(found - np.einsum("t,tpk->pk", weights, each)).max() < 1e-14
    # Co-moving: points count from the beads' mean position, velocities from their mean velocity.
    field = flow_field(0.3, state, scene, co_moving=True)
    centre, moved = state.position.mean(0), dynamics.motion(0.3, state, scene).velocity.mean(0)
    expected = flow_field(0.3, state, scene)(x + centre[None]) - moved[None]
    assert np.abs(field(x) - expected).max() < 1e-14
    far = jb.average_flow_field(run, scene, co_moving=True)(jnp.asarray([1e7, 0.0]))
    drift = mean_over_time(lambda t, s, c: dynamics.motion(t, s, c).velocity.mean(0), run, scene)
    assert np.abs(far + drift).max() < 1e-12


class Own(AbstractMobility):
    """One that says no more than it must."""

    def motion(self, configuration, load):
        return FreeDraining().motion(configuration, load)


def test_what_is_refused():
    state, scene = spheres()
    for mobility in (FreeDraining(), Own()):
        dry = eqx.tree_at(lambda s: s.mobility, scene, mobility)
        with pytest.raises(
            ValueError, match=r"`scene.mobility` must be one that has a fluid between"
        ):
            flow_field(0.0, state, dry)
    with pytest.raises(
        ValueError, match=r"must hold points of 3 components, but it has shape \(4, 2\)"
    ):
        flow_field(0.0, state, scene)(np.zeros((4, 2)))


def test_without_loads_there_is_the_ambient_flow():
    chain, x = Chain(1.0, (1, 1)), places(30, 5.0)
    still = Scene(chain, MU, forces=[Weight([0.0, 0.0, 0.0])])
    assert not np.any(flow_field(0.0, State(THREE[:2]), Scene(chain, MU))(x))
    assert not np.any(flow_field(0.0, State(THREE[:2]), still)(x))
    # Beads that are carried as points disturb nothing.
    carried = Scene(chain, MU, RPY(strained=False), flow=LinearFlow(GRADIENT))
    out = outside(x, THREE[:2], 1.0)
    found = flow_field(0.0, State(THREE[:2]), carried)(x)
    assert np.abs(found - x @ GRADIENT.T)[out].max() < 1e-15


def test_single_precision():
    # Micrometres, milliseconds and piconewtons in SI.
    units = 1e-6, 1e-3, 1e-12
    chain = Chain([1.0, 1.2, 0.9], 3)
    state, made = bent(chain, 3, 1), scene(chain, 3)
    x = places(30, 5.0)
    one = np.asarray(flow_field(0.0, state, made)(x)) * 1e-3

    def small(tree):
        return jax.tree.map(lambda y: y.astype(jnp.float32), tree)

    two = small((in_units(state, units), in_units(made, units)))
    found = flow_field(0.0, *two)(x * 1e-6)
    assert found.dtype == jnp.float32 and np.abs(found - one).max() < 2e-6 * np.abs(one).max()
