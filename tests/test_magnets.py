"""Magnets: moments, fields and dipole interactions against textbook formulas, quadrature, differences
and closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent, jointed, turning_field

import jaxbeads as jb
from jaxbeads import Chain, Scene, Setting, State, dynamics, observables, rollout, scenes, straight
from jaxbeads.constraint import EqualSpins, Gears, Inextensible, Joint
from jaxbeads.force import (
    Bending,
    BendingEnergy,
    JointBending,
    MagneticBeads,
    MagneticFibre,
    ParamagneticBeads,
    ParamagneticFibre,
    Spring,
)
from jaxbeads.magnetism import HarmonicField, UniformField, dipole_energy
from jaxbeads.mobility import FreeDraining
from jaxbeads.solver import ESDIRK, Rosenbrock

T0, MU0 = jnp.zeros(()), 5.0
NO_FIELD = {2: np.zeros(2), 3: np.zeros(3)}


def apart(beads, dim, seed=0):
    """Beads of unequal radii that do not overlap, with directors."""
    rng = np.random.default_rng(seed)
    position = 4.0 * np.stack([np.arange(beads) % 3, np.arange(beads) // 3], axis=1)
    position = np.pad(position, ((0, 0), (0, dim - 2))) + rng.uniform(-0.5, 0.5, (beads, dim))
    director = rng.normal(size=(beads, dim))
    director /= np.linalg.norm(director, axis=1, keepdims=True)
    chain = Chain(rng.uniform(0.8, 1.2, beads), [1] * beads)
    return Setting(chain, 1.3), State(position, director), rng.uniform(0.5, 2.0, beads)


def textbook(position, moment, permeability):
    """Forces and torques of point dipoles, pair by pair, in space."""
    force, torque = np.zeros_like(position), np.zeros_like(position)
    for i in range(len(position)):
        for j in range(len(position)):
            if i == j:
                continue
            r = position[i] - position[j]
            d = np.linalg.norm(r)
            e, m, n = r / d, moment[i], moment[j]
            c = permeability / (4 * np.pi)
            both = (m @ e) * n + (n @ e) * m + (m @ n) * e - 5 * (m @ e) * (n @ e) * e
            force[i] += 3 * c / d**4 * both
            torque[i] += np.cross(m, c / d**3 * (3 * e * (n @ e) - n))
    return force, torque


@pytest.mark.parametrize("dim", [2, 3])
def test_dipoles_are_those_of_textbooks(dim):
    setting, state, moment = apart(7, dim)
    load = MagneticBeads(moment, NO_FIELD[dim], MU0).load(T0, state, setting)
    pad = ((0, 0), (0, 3 - dim))
    position = np.pad(state.position, pad)
    force, torque = textbook(position, moment[:, None] * np.pad(state.director, pad), MU0)
    assert np.abs(load.force - force[:, :dim]).max() < 1e-14 * np.abs(force).max()
    other = load.torque - (torque[:, 2:] if dim == 2 else torque)
    assert np.abs(other).max() < 1e-14 * np.abs(torque).max()


@pytest.mark.parametrize("dim", [2, 3])
def test_fields_with_gradients_push(dim):
    # Force and torque of each bead by differences of its energy: B may depend on place and time.
    setting, state, moment = apart(4, dim, 1)

    def field(t, x):
        return jnp.sin(0.3 * x[::-1] + t) * (1 + x[0] ** 2 / 9)

    load = MagneticBeads(moment, field).load(jnp.asarray(0.4), state, setting)
    for k in range(4):
        p, r = np.asarray(state.director[k]), np.asarray(state.position[k])
        m = moment[k] * p

        def energy(x, m=m):
            return -float(m @ field(0.4, jnp.asarray(x)))

        h = 1e-5
        slope = [(energy(r + h * e) - energy(r - h * e)) / (2 * h) for e in np.eye(dim)]
        assert np.abs(load.force[k] + np.array(slope)).max() < 1e-9
        b = np.asarray(field(0.4, jnp.asarray(r)))
        turn = np.cross(np.pad(m, (0, 3 - dim)), np.pad(b, (0, 3 - dim)))
        assert np.abs(load.torque[k] - (turn[2:] if dim == 2 else turn)).max() < 1e-14


def poles(x):
    """psi a of two uniformly filled spheres of radius a at the distance x a: the mean over one of the
    potential of the other, (3 - s^2)/2 within and 1/s without, shell by shell."""

    def within(s):  # integrals of s times the potential
        return 0.75 * s**2 - s**4 / 8

    def upto(s):
        return np.where(s < 1, within(s), within(1.0) + s - 1)

    nodes, weights = np.polynomial.legendre.leggauss(8)
    split = abs(1 - x) if abs(1 - x) < 1 else 0.5
    total = 0.0
    for low, high in ((0.0, split), (split, 1.0)):
        shell = low + (high - low) * (nodes + 1) / 2
        mean = (upto(x + shell) - upto(np.abs(x - shell))) / (2 * x * shell)
        total += (high - low) / 2 * np.sum(weights * 3 * shell**2 * mean)
    return total


@pytest.mark.parametrize("x", [0.3, 0.9, 1.6, 1.95, 2.4])
def test_spheres_that_overlap(x):
    # Second differences of the potential by quadrature; the radius is 1.5.
    a, h = 1.5, 1e-3
    along = (poles(x + h) - 2 * poles(x) + poles(x - h)) / h**2
    across = (poles(x + h) - poles(x - h)) / (2 * h) / x
    position, radii = a * x * jnp.array([[0.0, 0.0], [1.0, 0.0]]), jnp.full(2, a)
    for axis, curved in zip(np.eye(2), (along, across), strict=True):
        found = dipole_energy(position, jnp.tile(jnp.asarray(axis), (2, 1)), radii, 4 * np.pi)
        assert abs(found + curved / a**3) < 2e-6


def test_touching_and_coincident_beads():
    # The force is continuous at contact; at the same place it is none, and all derivatives are finite.
    moment, radii = jnp.array([[1.0, 0.5], [0.3, -1.0]]), jnp.ones(2)

    def energy(x):
        return dipole_energy(jnp.stack([jnp.zeros(2), x]), moment, radii, MU0)

    slope = jax.jit(jax.grad(energy))
    here, there = (slope(jnp.array([2.0 + h, 0.0])) for h in (-1e-12, 1e-12))
    assert np.abs(here - there).max() < 1e-10
    at = slope(jnp.array([2.0, 0.0]))  # on the switch itself
    assert np.abs(here - at).max() < 1e-10
    assert not np.any(slope(jnp.zeros(2)))
    assert np.all(np.isfinite(jax.hessian(energy)(jnp.zeros(2))))
    assert abs(energy(jnp.zeros(2)) - MU0 / (4 * np.pi) * (0.3 - 0.5)) < 1e-15  # m.m'/a^3


MAGNETS = {
    "fibre": lambda dim: MagneticFibre(0.6, NO_FIELD[dim], MU0),
    "beads": lambda dim: MagneticBeads(np.linspace(-0.5, 1.0, 8), NO_FIELD[dim], MU0),
    "fibre in a field": lambda dim: MagneticFibre(0.6, turning_field(dim), MU0),
    "beads in a field": lambda dim: MagneticBeads(0.6, turning_field(dim), MU0),
    "paramagnetic fibre": lambda dim: ParamagneticFibre(0.8, turning_field(dim)),
    "paramagnetic beads": lambda dim: ParamagneticBeads(0.9, turning_field(dim), MU0),
}


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("magnet", MAGNETS)
def test_no_force_in_all_and_the_torque_of_the_field_alone(magnet, dim):
    # Gate T4: interactions sum to no force and no torque; a uniform field exerts m x B on the whole.
    force, t = MAGNETS[magnet](dim), jnp.asarray(0.3)
    chain = Chain(np.linspace(0.9, 1.2, 8), (5, 3), gap=0.1)
    state = jointed(chain, dim, centre=3.0 * np.arange(2)[:, None] * np.eye(dim)[1])
    load = force.load(t, state, Setting(chain, 1.0))
    net, torque = observables.net_load(load, state, np.zeros(dim))
    b = np.pad(force.field.at(t, state.position), ((0, 0), (0, 3 - dim)))
    if isinstance(force, MagneticFibre):
        moment = force.moments(state, chain)
    elif isinstance(force, MagneticBeads):
        moment = jnp.broadcast_to(force.moment, 8)[:, None] * state.director
    elif isinstance(force, ParamagneticFibre):
        e = jb.geometry.tangents(state.position) * chain.bond_mask[:, None]
        moment = 0.8 * jnp.pad(e * (e @ b[0, :dim])[:, None], ((0, 1), (0, 0)))
    else:  # they lie along the field, which turns their interactions
        moment = None
    largest = max(np.abs(x).max() for x in load.__dict__.values() if x is not None)
    assert np.abs(net).max() < 1e-12 * largest
    if moment is not None:
        given = np.cross(np.pad(moment, ((0, 0), (0, 3 - dim))), b).sum(axis=0)
        given = given[2:] if dim == 2 else given
        assert np.abs(torque - given).max() < 1e-12 * max(largest, np.abs(given).max())


@pytest.mark.parametrize("beads", [2, 9])
def test_a_chain_of_paramagnetic_beads_turns_into_the_field(beads):
    # Straight at an angle: the torque is that of (mu_0/4 pi) chi^2 B^2 (3/2) sin 2 theta 2/(2 a n)^3 for
    # each pair n apart; of long chains that of bonds with 6 zeta(3) mu_0 chi^2/(4 pi (2a)^3).
    chain, chi, theta, b = Chain(0.7, beads), 0.9, 0.4, 1.7
    state, setting = straight(chain, [np.cos(theta), np.sin(theta)]), Setting(chain, 1.0)

    def torque(force):
        return float(observables.net_load(force.load(T0, state, setting), state, [0.0, 0.0])[1][0])

    found = torque(ParamagneticBeads(chi, [b, 0.0], MU0))
    n = np.arange(1, beads)
    pairs = np.sum((beads - n) / (1.4 * n) ** 3)
    exact = -MU0 / (4 * np.pi) * (chi * b) ** 2 * 3 * np.sin(2 * theta) * pairs
    assert abs(found / exact - 1) < 1e-13
    zeta = 1.2020569
    bonds = torque(ParamagneticFibre(6 * zeta * MU0 * chi**2 / (4 * np.pi * 1.4**3), [b, 0.0]))
    assert abs(bonds / exact - 1) < 0.5 / beads


def test_moments_and_bonds_in_closed_form():
    # A straight fibre: torques m B sin and chi B^2 sin cos on each bead and bond.
    chain, theta, t = Chain(1.0, 4), 0.7, jnp.asarray(0.9)
    state, setting = straight(chain, [1.0, 0.0]), Setting(chain, 1.0)
    field = UniformField(lambda t: jnp.stack([jnp.cos(t - 0.2), jnp.sin(t - 0.2)]))
    for force, each in (
        (MagneticFibre(1.3, field), 4 * 1.3 * np.sin(theta)),
        (ParamagneticFibre(1.3, field), 3 * 1.3 * np.sin(theta) * np.cos(theta)),
    ):
        torque = observables.net_load(force.load(t, state, setting), state, [0.0, 0.0])[1]
        assert abs(float(torque[0]) - each) < 1e-14


def test_many_beads_by_blocks():
    # Above some hundred beads pairs are summed block by block: the same numbers, no N x N memory.
    rng = np.random.default_rng(3)
    position, moment = rng.uniform(-40, 40, (400, 3)), rng.normal(size=(400, 3))
    position = position[np.argsort(position[:, 0])]
    distance = np.linalg.norm(position[:, None] - position[None], axis=2) + 9 * np.eye(400)
    position = position[distance.min(axis=1) > 2]
    count = len(position)
    chain = Chain(1.0, [1] * count)
    director = moment[:count] / np.linalg.norm(moment[:count], axis=1, keepdims=True)
    force = MagneticBeads(1.0, np.zeros(3), MU0)
    load = force.load(T0, State(position, director), Setting(chain, 1.0))
    exact, torque = textbook(position, director, MU0)
    assert np.abs(load.force - exact).max() < 1e-13 * np.abs(exact).max()
    assert np.abs(load.torque - torque).max() < 1e-13 * np.abs(torque).max()

    def peak(beads):
        shape = jax.ShapeDtypeStruct((beads, 3), jnp.float64)
        each = jax.ShapeDtypeStruct((beads,), jnp.float64)
        slope = jax.jit(jax.grad(lambda r, m, a: dipole_energy(r, m, a, MU0)))
        compiled = slope.lower(shape, shape, each).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    assert peak(8000) < 4.5 * peak(2000)


def sphere(field, **options):
    return Scene(Chain(1.0, 1), 1 / (8 * np.pi), forces=[MagneticBeads(1.0, field)], **options)


@pytest.mark.parametrize("frequency", [0.3, 0.9, 1.1, 1.5, 3.0])
def test_a_sphere_steps_out(frequency):
    # theta' = sin(omega t - theta) with m B/(8 pi mu a^3) = 1: it follows below, and above it turns by
    # omega - sqrt(omega^2 - 1) on average over periods of the slip.
    field = HarmonicField(frequency, [1.0, 0.0], [0.0, 1.0])
    slip = np.sqrt(abs(frequency**2 - 1))
    ts = np.linspace(0, 30 / slip if frequency < 1 else 4 * np.pi / slip, 101)
    start = State([[0.0, 0.0]], [[1.0, 0.0]])
    director = np.asarray(rollout(sphere(field), start, ts, tolerance=1e-9).states.director)
    angle = np.unwrap(np.arctan2(director[:, 0, 1], director[:, 0, 0]))
    if frequency < 1:
        lag = frequency * ts[-1] - angle[-1]
        assert abs(lag - np.arcsin(frequency)) < 1e-7
    else:
        assert abs(angle[-1] / ts[-1] - (frequency - slip)) < 1e-7


def test_a_field_that_is_switched_on_and_off():
    # Jumps are found at any width: theta' = -sin(theta) while it is on, tan(theta/2) falls like exp(-t).
    def law(t):
        on = (t > 1.003) & (t < 1.034)
        return jnp.where(on, 10.0, 0.0) * jnp.array([1.0, 0.0])

    start = State([[0.0, 0.0]], [[0.0, 1.0]])
    end = rollout(sphere(UniformField(law)), start, [0.0, 50.0], tolerance=1e-9)
    end = end.final.director[0]
    assert abs(np.arctan2(end[1], end[0]) - 2 * np.arctan(np.exp(-0.31))) < 1e-7


def models(dim):
    """A magnetic chain of each kind."""
    chain, wide = Chain(1.0, 4), Chain(1.0, 4, gap=0.1)
    field, still = turning_field(dim), Setting(chain, 1.0)
    fibre, bonds = MagneticFibre(0.6, field, MU0), ParamagneticFibre(0.8, field)
    beads = MagneticBeads(np.array([0.5, 0.0, 0.3, -0.2]), field, MU0)
    yield "Gears", Scene(chain, 1.0, constraints=[Gears()], forces=[Bending(4.0), fibre, bonds])
    induced = ParamagneticBeads(0.9, field, MU0)
    held = [Inextensible()]
    yield (
        "Inextensible",
        Scene(
            chain, still.viscosity, constraints=held, forces=[BendingEnergy(4.0), fibre, induced]
        ),
    )
    yield "Spring", Scene(chain, 1.0, forces=[Spring(20.0), BendingEnergy(4.0), fibre, bonds])
    yield "Joint", Scene(wide, 1.0, constraints=[Joint()], forces=[JointBending(4.0), beads])


@pytest.mark.parametrize(
    "dim, kind",
    [
        (2, "Gears"),
        (2, "Joint"),
        pytest.param(3, "Inextensible", marks=pytest.mark.slow),
        pytest.param(3, "Spring", marks=pytest.mark.slow),
    ],
)
def test_derivatives_of_a_run_in_both_modes(dim, kind):
    # By every number of the magnets, against differences.
    scene = dict(models(dim))[kind]
    state = (jointed if kind == "Joint" else bent)(scene.chain, dim)
    weight = np.random.default_rng(2).normal(size=state.position.shape)
    where = eqx.tree_at(
        lambda s: s.forces, jax.tree.map(lambda _: False, scene), replace_fn=lambda f: f
    )
    magnets = MagneticFibre, MagneticBeads, ParamagneticFibre, ParamagneticBeads
    own = [isinstance(f, magnets) for f in scene.forces]
    forces = tuple(
        jax.tree.map(lambda _, k=k: k, f) for f, k in zip(scene.forces, own, strict=True)
    )
    where = eqx.tree_at(lambda s: s.forces, where, forces)
    moving, rest = eqx.partition(scene, where)
    leaves, tree = jax.tree.flatten(moving)
    flat, whole = jax.flatten_util.ravel_pytree(leaves)

    def value(x):
        model = eqx.combine(jax.tree.unflatten(tree, whole(x)), rest)
        final = rollout(model, state, [0.0, 0.5, 1.0], substeps=10).final
        return jnp.sum(weight * final.position)

    backward = jax.jit(jax.grad(value))(flat)
    forward = jax.jit(jax.jacfwd(value))(flat)
    assert np.abs(backward - forward).max() < 1e-12 * np.abs(forward).max()
    h, of = 1e-5, jax.jit(value)
    for k, e in enumerate(np.eye(len(flat))):
        slope = (of(flat + h * e) - of(flat - h * e)) / (2 * h)
        assert abs(forward[k] - slope) < 1e-8 * np.abs(forward).max() + 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("dim, kind", [(3, "Gears"), (2, "Inextensible"), (3, "Joint")])
def test_every_solver_takes_them(dim, kind):
    scene = dict(models(dim))[kind]
    state, ts = (jointed if kind == "Joint" else bent)(scene.chain, dim), [0.0, 2.0]
    exact = rollout(scene, state, ts, solver=jb.AB3(substeps=2000)).final.position
    for solver in (Rosenbrock(tolerance=1e-8), ESDIRK(tolerance=1e-8)):
        found = rollout(scene, state, ts, solver=solver).final.position
        assert np.abs(found - exact).max() < 1e-5


def test_rigid_magnetic_rod_turns_as_a_body():
    # Torque over the friction of the rigid rod, whether its beads may roll or not.
    chain = Chain(1.0, 6)
    rod = [Gears(), EqualSpins()]
    scene = Scene(chain, 1.0, constraints=rod, forces=[MagneticFibre(0.7, [0.0, 2.0])])
    state = straight(chain, [1.0, 0.0])
    spin = dynamics.motion(0.0, state, scene).spin
    friction = observables.rigid_resistance(state.position, chain)[2, 2]
    assert np.abs(spin * friction / (6 * 0.7 * 2.0) - 1).max() < 1e-12


def test_moments_need_tangents():
    # A fibre of one bead among others has none: it is refused, and bears no load.
    chain = Chain(1.0, (1, 3))
    state = straight(chain, [1.0, 0.0], [[0.0, 0.0], [0.0, 8.0]])
    force = MagneticFibre(0.8, [0.0, 2.0])
    load = np.asarray(force.load(T0, state, Setting(chain, 1.0)).force)
    assert not load[0].any() and load[1:].any()
    with pytest.raises(ValueError, match="must have fibres of two beads or more"):
        jb.check(Scene(chain, 1.0, constraints=[Gears()], forces=[force]), state)


BY_NAME = {ready.name: ready for ready in scenes.SCENES}


@pytest.mark.parametrize("frequency", [0.2, 0.95, 1.05, 1.5, 4.0])
def test_step_out_of_a_rod(frequency):
    # The mean rate of turning over that of the field: 1, and 1 - sqrt(1 - (omega_so/omega)^2) above.
    case = scenes.magnetic_rod(4, frequency)
    run = case.simulate(progress=False)
    found = BY_NAME["magnetic-rod"].observables(case, run)["mean_rotation"]
    law = 1.0 if frequency < 1 else 1 - np.sqrt(1 - 1 / frequency**2)
    assert abs(found - law) < 1e-6
    position = np.asarray(run.states.position)
    assert np.abs(position.mean(axis=1)).max() < 1e-6  # it stays where it is


@pytest.mark.parametrize("beads", [2, 5, 10])
def test_step_out_frequency_is_that_of_the_rigid_rod(beads):
    # The friction of touching rods, over 8 pi mu a^3, computed elsewhere: 3.707317 (2), 167.347576 (10).
    case = scenes.magnetic_rod(beads, 0.5)
    (force,) = case.scene.forces
    friction = {2: 3.707317, 10: 167.347576}.get(beads)
    if friction is not None:
        assert abs(float(force.moment) * beads / (8 * np.pi) - friction) < 0.6e-6
    spin = dynamics.motion(np.pi, case.state, case.scene).spin  # the field is across
    assert np.abs(spin - 1).max() < 1e-12


def swum(case, **options):
    run = case.simulate(progress=False, **options)
    assert run.status == "stopped by `until`"
    return BY_NAME["magnetic-swimmer"].observables(case, run)


def test_a_magnetic_tail_swims_as_the_square_of_the_field():
    fine = {"tolerance": 1e-9}
    weak, strong = (swum(scenes.magnetic_swimmer(5, 2.0, b), **fine) for b in (0.05, 0.1))
    assert abs(strong["speed"] / weak["speed"] - 4) < 0.1  # the next term is of the fourth order
    assert strong["direction"] > 0.999  # the free end goes first


def test_a_magnetic_tail_swims_best_in_between():
    # Slow beats come and go on one way, of fast ones little is left.
    slow, best, fast = (
        swum(scenes.magnetic_swimmer(5, sp, 0.5))["speed"] for sp in (1.0, 2.0, 4.0)
    )
    assert best > 2 * slow and best > 10 * fast and slow > 0


def test_a_tail_without_a_head_does_not_swim():
    # It is its own image in a point, and stays so.
    bare = swum(scenes.magnetic_swimmer(6, 2.0, 0.5, head=0.0))
    assert bare["speed"] < 1e-9


def test_no_magnetic_swimming_without_interactions():
    # No force in all: beads that do not feel one another leave the mean of a r where it is.
    case = scenes.magnetic_swimmer(5, 2.0, 0.5)
    scene = eqx.tree_at(lambda s: s.mobility, case.scene, FreeDraining())
    run = case._replace(scene=scene, ts=case.ts[:81], until=None).simulate(progress=False)
    position, radii = np.asarray(run.states.position), np.asarray(scene.chain.radii)
    moved = dynamics.motion(0.37, State(position[-1]), scene).velocity
    assert np.abs(radii @ moved).max() < 1e-12 * np.abs(moved).max()
    mean = np.einsum("tbd,b->td", position, radii) / radii.sum()
    assert np.abs(mean - mean[0]).max() < case.tolerance * float(scene.chain.length[0])
    assert np.abs(position[-1] - position[0]).max() > 1e-2  # it bends
