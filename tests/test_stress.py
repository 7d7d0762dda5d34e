"""Stresslets of fibres: against closed forms, an independent solution, slender bodies, symmetries."""

import jax
import numpy as np
import pytest
from cases import bent, in_units

import jaxbeads as jb
from jaxbeads import Chain, Scene, State, straight
from jaxbeads.constraint import Gears, Inextensible, Joint
from jaxbeads.flow import Extension, LinearFlow, Poiseuille, Shear, VelocityField
from jaxbeads.force import Bending, Contact, JointBending, Weight
from jaxbeads.mobility import RPY, FreeDraining
from jaxbeads.stress import particle_stress

MU, RATE = 1.3, 0.7
GRADIENT = np.array([[0.3, 0.7, -0.2], [0.1, -0.5, 0.4], [0.6, 0.0, 0.2]])
STRAIN = (GRADIENT + GRADIENT.T) / 2
UNSTRAINED = RPY(strained=False)


@pytest.mark.parametrize("radius", [1.0, 0.4])
def test_spheres(radius):
    # Einstein: 20 pi mu a^3/3 E, exactly; weights and torques add none.
    chain = Chain(radius, [1, 1])
    state = State([[0.0, 0.0, 0.0], [3.0, 1.0, 2.0]])
    forces = [Weight([0.1, 0.2, -0.5])]
    scene = Scene(chain, MU, forces=forces, flow=LinearFlow(GRADIENT))
    exact = 20 * np.pi / 3 * MU * radius**3 * STRAIN
    assert np.abs(particle_stress(0.0, state, scene) - exact[None]).max() < 1e-14
    scene = Scene(Chain([radius, 2 * radius], [1, 1]), MU, forces=forces, flow=LinearFlow(GRADIENT))
    found = np.asarray(particle_stress(0.0, state, scene))
    assert np.abs(found - np.stack([exact, 8 * exact])).max() < 1e-13
    none = Scene(chain, MU, UNSTRAINED, forces=forces, flow=LinearFlow(GRADIENT))
    assert not np.any(particle_stress(0.0, state, none))
    still = Scene(chain, MU, forces=forces)
    assert not np.any(particle_stress(0.0, state, still))


def test_a_sphere_in_a_curved_flow():
    # Faxen: (1 + a^2/10 lap) E at the centre, in a Stokes flow: u = (y^3, x^3), of pressure 6 mu x y.
    scene = Scene(
        Chain(0.5, 1),
        MU,
        forces=[Weight([0.0, 0.0])],
        flow=VelocityField(lambda t, x: x[::-1] ** 3),
    )
    found = particle_stress(0.0, State([[0.0, 2.0]]), scene)[0]
    assert abs(found[0, 1] - 20 * np.pi / 3 * MU * 0.125 * (6 + 0.6 * 0.25)) < 1e-12
    assert abs(found[0, 0]) < 1e-14 and found[0, 1] == found[1, 0]


@pytest.mark.parametrize("dim", [2, 3])
def test_a_dumbbell(dim):
    # Each end is held against rate d/2 by F = 6 pi mu a (rate d/2)/(1 - 3a/(2d) + (a/d)^3), along x.
    apart = 20.0
    chain = Chain(1.0, 2, gap=0.5 * apart - 1.0)
    state = straight(chain, np.eye(dim)[0])

    def found(mobility):
        scene = Scene(chain, MU, mobility, [Inextensible()], flow=Extension(RATE))
        return np.asarray(particle_stress(0.0, state, scene)[0])

    pull = 6 * np.pi * MU * RATE * apart / 2
    exact = pull / (1 - 1.5 / apart + apart**-3)
    along = np.diag([2.0, -1.0, -1.0])[:dim, :dim] / 3
    assert np.abs(found(UNSTRAINED) - apart * exact * along).max() < 1e-11
    assert np.abs(found(FreeDraining()) - apart * pull * along).max() < 1e-11
    # Resistance to strain adds that of two spheres, and pulls the ends by less than (a/d)^3 of it.
    spheres = 2 * 20 * np.pi / 3 * MU * RATE * np.diag([1.0, -1.0, 0.0])[:dim, :dim]
    assert np.abs(found(RPY()) - spheres - apart * exact * along).max() < 5e-3 * apart * exact
    # It is the drag of the fluid that pulls: extension is resisted.
    assert found(RPY())[0, 0] > 0


def rod(beads, mobility):
    chain = Chain(1.0, beads)
    scene = Scene(chain, MU, mobility, [Gears()], flow=Extension(RATE))
    return float(particle_stress(0.0, straight(chain, [1.0, 0.0]), scene)[0, 0, 0])


def test_a_rod_along_extension():
    # Beads at rest in the flow, by an own matrix: sum over j of mu_ij F_j = -rate x_i.
    for beads in (3, 10):
        x = 2.0 * np.arange(beads) - (beads - 1)
        apart = np.abs(x[:, None] - x) + np.eye(beads)
        mobility = np.where(np.eye(beads) == 1, 1.0, 1.5 / apart - apart**-3) / (6 * np.pi * MU)
        force = np.linalg.solve(mobility, -RATE * x)
        assert abs(rod(beads, UNSTRAINED) / (-2 / 3 * x @ force) - 1) < 1e-12
        drag = 6 * np.pi * MU * RATE * x @ x
        assert abs(rod(beads, FreeDraining()) / (2 / 3 * drag) - 1) < 1e-12


def test_long_rods_are_slender_bodies():
    # Batchelor, J. Fluid Mech. 46 (1971) 813, of long cylinders: sum of x F = pi mu rate L^3/6 times
    # this function of e = 1/ln(L/a). A row of beads is a little thinner, which is 4 to 1.5 % here.
    errors = []
    for beads in (40, 80, 160):
        e = 1 / np.log(2 * beads)
        slender = e * (1 + 0.64 * e) / (1 - 1.5 * e) + 1.659 * e**3
        theory = np.pi * MU * RATE * (2 * beads) ** 3 / 6 * slender
        errors.append(1.5 * rod(beads, UNSTRAINED) / theory - 1)
    assert 0 < errors[2] < 0.016 and errors[2] < errors[1] < errors[0] < 0.05


def several(state, flow, weight, contact=True):
    chain = Chain([1.0, 1.2, 0.9, 1.0, 1.1, 1.0, 0.8], [4, 3])
    forces = [Bending(20.0), Weight(weight)] + [Contact(3.0, 0.1, 0.1)] * contact
    return chain, Scene(chain, MU, constraints=[Gears()], forces=forces, flow=flow)


def test_symmetries():
    chain = several(None, None, np.zeros(3))[0]
    state, weight = bent(chain, 3, seed=2), np.array([0.3, -0.5, 0.2])
    found = particle_stress(0.0, state, several(state, LinearFlow(GRADIENT), weight)[1])
    size = np.abs(found).max()
    assert found.shape == (2, 3, 3)
    assert np.abs(found - np.swapaxes(found, 1, 2)).max() < 1e-13 * size
    assert np.abs(np.trace(found, axis1=1, axis2=2)).max() < 1e-12 * size
    # Where it is makes no difference.
    moved = State(state.position + np.array([[40.0, -7.0, 3.0]]))
    other = particle_stress(0.0, moved, several(moved, LinearFlow(GRADIENT), weight)[1])
    assert np.abs(other - found).max() < 1e-11 * size
    # It turns along.
    q, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    q = q * np.linalg.det(q)
    flow = LinearFlow(q @ GRADIENT @ q.T)
    other = particle_stress(0.0, State(state.position @ q.T), several(None, flow, q @ weight)[1])
    assert np.abs(other - q @ np.asarray(found) @ q.T).max() < 1e-11 * size


def test_a_planar_scene_is_part_of_one_in_space():
    chain = several(None, None, np.zeros(3))[0]
    flat = bent(chain, 2, seed=2)
    deep = State(np.pad(flat.position, ((0, 0), (0, 1))))
    planar = several(flat, Shear(RATE), np.array([0.1, -0.4]))[1]
    spatial = several(deep, Shear(RATE), np.array([0.1, -0.4, 0.0]))[1]
    found, whole = particle_stress(0.0, flat, planar), particle_stress(0.0, deep, spatial)
    assert np.abs(found - whole[:, :2, :2]).max() < 1e-11 * np.abs(found).max()
    assert np.abs(whole[:, 2, :2]).max() < 1e-11 * np.abs(found).max()


def test_fibres_far_apart_are_as_alone():
    alone = Chain(1.0, 5)
    one = bent(alone, 3, seed=1)
    away = State(np.concatenate([one.position, one.position + np.array([[0.0, 1e6, 0.0]])]))

    def found(chain, state):
        scene = Scene(chain, MU, constraints=[Gears()], forces=[Bending(5.0)], flow=Shear(RATE))
        return np.asarray(particle_stress(0.0, state, scene))

    both = found(Chain(1.0, [5, 5]), away)
    assert np.abs(both - found(alone, one)).max() < 1e-5 * np.abs(both).max()


@pytest.mark.parametrize("units", [(1e-6, 1e-3, 1e-12), (3e4, 7e2, 5e6)], ids=["micro", "large"])
def test_units(units):
    chain = several(None, None, np.zeros(3))[0]
    state = bent(chain, 3, seed=2)
    scene = several(state, Shear(RATE), np.array([0.1, -0.4, 0.2]))[1]
    one = particle_stress(0.0, state, scene)
    two = particle_stress(0.0, in_units(state, units), in_units(scene, units))
    length, _, force = units
    assert np.abs(two / (length * force) - one).max() < 1e-9 * np.abs(one).max()


def test_other_models_and_flows():
    # Each has a stresslet, with a derivative by any number of the scene.
    chain = Chain(1.0, 4, 0.1)
    state = jb.from_directors(chain, [[1.0, 0.0], [0.9, 0.2], [0.8, 0.3], [0.9, 0.1]])

    flow = Poiseuille(0.1, 9.0)

    def shear_stress(rigidity):
        scene = Scene(chain, MU, constraints=[Joint()], forces=[JointBending(rigidity)], flow=flow)
        return particle_stress(0.0, state, scene)[0, 0, 1]

    slope, step = jax.grad(shear_stress)(2.0), 1e-3
    by_hand = (shear_stress(2.0 + step) - shear_stress(2.0 - step)) / (2 * step)
    assert abs(slope - by_hand) < 1e-6 * abs(by_hand)


def test_one_state_at_a_time():
    chain = Chain(1.0, 2)
    scene = Scene(chain, MU, constraints=[Gears()], flow=Shear(RATE))
    state = straight(chain, [1.0, 0.0])
    many = jax.tree.map(lambda x: jax.numpy.stack([x, x]), state)
    with pytest.raises(ValueError, match="must be one state"):
        particle_stress(0.0, many, scene)
    found = jax.vmap(lambda s: particle_stress(0.0, s, scene))(many)
    assert np.array_equal(found[1], particle_stress(0.0, state, scene))
