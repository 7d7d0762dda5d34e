"""Half spaces: no-slip walls and free surfaces against Blake's tensor, quadrature, derived numbers."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent
from dense import dense_motion, flat

import jaxbeads as jb
from jaxbeads import (
    Chain,
    Configuration,
    FreeSurface,
    Load,
    NoSlipWall,
    Scene,
    State,
    dynamics,
    reflection,
)
from jaxbeads.constraint import EqualSpins, Gears, clamped
from jaxbeads.flow import Extension, OscillatingShear, Poiseuille, Shear
from jaxbeads.force import AbstractForce, Bending, Contact, Weight
from jaxbeads.mobility import RPY, FreeDraining
from jaxbeads.observables import rigid_resistance

FLOOR = NoSlipWall([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
SURFACE = FreeSurface([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
OPEN, ASIDE = (FreeSurface([0.0, 0.0], n) for n in ([0.0, 1.0], [1.0, 0.0]))
BELOW = NoSlipWall([0.0, 0.0], [0.0, 1.0])  # in the plane
SIX = 6 * np.pi


def matrix(mobility, configuration):
    """(6N, 6N) or (3N, 3N): forces of all, then torques of all."""
    beads, dim = configuration.beads, configuration.dim
    turns = 3 if dim == 3 else 1

    @jax.jit
    def columns(units):
        def one(unit):
            cut = beads * dim
            load = Load(unit[:cut].reshape(beads, dim), unit[cut:].reshape(beads, turns))
            moved = mobility.motion(configuration, load)
            return jnp.concatenate([moved.velocity.ravel(), moved.spin.ravel()])

        return jax.vmap(one, out_axes=1)(units)

    return np.asarray(columns(jnp.eye(beads * (dim + turns))))


def blake(x, y):
    """Blake's tensor, G(x - y) with its image, without 8 pi mu; the wall is z = 0."""
    r, h = x - y, y[2]
    image = x - y * np.array([1.0, 1.0, -1.0])

    def stokeslet(r):
        n = np.linalg.norm(r)
        return np.eye(3) / n + np.outer(r, r) / n**3

    n, sign = np.linalg.norm(image), np.array([1.0, 1.0, -1.0])
    dipole = sign * (np.eye(3) / n**3 - 3 * np.outer(image, image) / n**5)
    e = np.array([0.0, 0.0, 1.0])
    doublet = image[2] * dipole + sign * (np.outer(image, e) - np.outer(e, image)) / n**3
    return stokeslet(r) - stokeslet(image) + 2 * h * h * dipole - 2 * h * doublet


def sphere(nodes=10):
    """Directions and weights of a mean over a sphere."""
    c, w = np.polynomial.legendre.leggauss(nodes)
    angles = 2 * np.pi * (np.arange(2 * nodes) + 0.5) / (2 * nodes)
    s = np.sqrt(1 - c**2)
    parts = s[:, None] * np.cos(angles), s[:, None] * np.sin(angles), c[:, None] + 0 * angles
    return np.stack(parts, -1).reshape(-1, 3), np.repeat(w, 2 * nodes) / (4 * nodes)


def test_unequal_spheres_by_quadrature_of_blakes_tensor():
    # Means of Blake's tensor over both surfaces: forces, and torques as tangential forces.
    x, a = np.array([[0.3, -0.2, 1.4], [2.9, 2.7, 2.6]]), np.array([0.8, 1.3])
    (n, w), mu = sphere(), 0.7
    found = matrix(RPY(), Configuration(x, a, mu, True, FLOOR))
    tensor = np.array([[blake(x[0] + a[0] * p, x[1] + a[1] * q) for q in n] for p in n])
    tensor /= 8 * np.pi * mu
    tt = np.einsum("p,q,pqij->ij", w, w, tensor)
    assert np.abs(found[:3, 3:6] - tt).max() < 1e-9
    # spin of the first = 3/(2 a) mean of n x u; u by a torque T: 3/(2 a) T x n spread evenly
    cross = np.cross(np.eye(3)[None, :, :], n[:, None, :])  # (q, k): e_k x n_q
    by_torque = np.einsum("q,pqij,qkj->pik", w, tensor, cross) * 1.5 / a[1]
    tr = np.einsum("p,pik->ik", w, by_torque)
    assert np.abs(found[:3, 9:] - tr).max() < 1e-9
    turned = np.cross(n[:, None, :], np.moveaxis(by_torque, 2, 1))  # (p, k): n x u of e_k
    rr = np.einsum("p,pki->ik", w, turned) * 1.5 / a[0]
    assert np.abs(found[6:9, 9:] - rr).max() < 1e-9
    assert np.abs(found - found.T).max() < 1e-15


def test_the_strain_of_a_sphere_is_felt_through_the_wall():
    """C by the reciprocal theorem of differences: the image of a stresslet is the derivative of Blake's
    tensor by its source, symmetric, times S = (20/3) pi mu a^3 E and the mean over the source."""
    x, a = np.array([[0.3, -0.2, 1.4], [2.9, 2.7, 2.6]]), np.array([0.8, 1.3])
    strain = np.array([[0.3, 0.2, -0.1], [0.2, -0.5, 0.4], [-0.1, 0.4, 0.2]])
    (n, w), mu = sphere(), 1.0
    # Force-free surface tractions of a rigid sphere in strain: 5 mu E n, of which flow is made.
    traction = 5 * mu * n @ strain
    area = 4 * np.pi * a[1] ** 2
    targets = x[0] + a[0] * n
    flow = np.array(
        [
            sum(
                wq * area * blake(p, x[1] + a[1] * q) @ f
                for q, wq, f in zip(n, w, -traction, strict=True)
            )
            for p in targets
        ]
    ) / (8 * np.pi * mu)
    only = np.zeros((2, 3, 3))
    only[1] = strain
    found = RPY().disturbance(Configuration(x, a, mu, True, FLOOR), jnp.asarray(only))
    assert np.abs(found.velocity[0] - w @ flow).max() < 1e-8
    assert np.abs(found.spin[0] - w @ np.cross(n, flow) * 1.5 / a[0]).max() < 1e-8


def test_closed_forms_are_lorentz_reflections():
    """The flow of a mirrored force or torque and its pressure, differentiated by the machine."""
    rng = np.random.default_rng(1)
    r, n = [jnp.asarray(x) for x in rng.normal(size=(3, 5)) + 2], np.array([0.6, 0.0, 0.8])
    normal, load = [jnp.asarray(x) for x in n], np.array([0.3, -0.7, 0.5])
    source, radius, z = jnp.asarray(0.7), jnp.asarray(1.3), jnp.asarray(1.9)
    height = sum(x * y for x, y in zip(n, r, strict=True))
    pairs = reflection.pairs(r, height, normal, z, radius, source)
    mirrored = load - 2 * n * (n @ load)

    def dot(r, f):
        return sum(x * y for x, y in zip(r, f, strict=True))

    def forced(r):
        i2, s = 1 / dot(r, r), dot(r, mirrored)
        i1, share = jnp.sqrt(i2), source**2 / 3
        flow, along = i1 * (1 + share * i2), s * i1 * i2 * (1 - 3 * share * i2)
        return [flow * f + along * x for f, x in zip(mirrored, r, strict=True)]

    def pressure(r):
        return 2 * dot(r, mirrored) / dot(r, r) ** 1.5

    def twisted(r):
        turn = jnp.cross(-mirrored, jnp.stack(r, axis=-1)) / dot(r, r)[..., None] ** 1.5
        return [turn[..., k] for k in range(3)]

    for found, velocity, push in (
        (pairs.by_force(list(jnp.asarray(load))), forced, pressure),
        (pairs.by_torque(list(jnp.asarray(load))), twisted, lambda r: 0 * r[0]),
    ):
        flow = reflection.derived(velocity, push, r, normal)
        for mine, other in zip(found, reflection.reflected(flow, z, radius, normal), strict=True):
            assert np.abs(np.stack(mine) - np.stack(other)).max() < 1e-13


class Loaded(AbstractForce):
    """A force and a torque on the first bead."""

    rotational: ClassVar[bool] = True
    force: jax.Array = eqx.field(converter=jnp.asarray)
    torque: jax.Array = eqx.field(converter=jnp.asarray)

    def load(self, t, state, scene):
        return Load(self.force[None], self.torque[None])


HEIGHTS = [10.07, 3.762, 2.352, 1.543, 1.128]
ALONG = [1.059027188448, 1.172686273692, 1.299430506845, 1.510728948960, 1.823210898674]
TOWARDS = [1.125149901511, 1.408089582609, 1.790908278774, 2.546384448782, 3.538788895232]


def drag(position, radius=1.0, domain=FLOOR):
    spheres = Configuration(position, radius, 1.0, True, domain)
    return np.linalg.inv(matrix(RPY(), spheres))


@pytest.mark.parametrize(
    ("height", "along", "towards"), list(zip(HEIGHTS, ALONG, TOWARDS, strict=True))
)
def test_drag_of_a_sphere_near_a_wall(height, along, towards):
    # Of a sphere that does not turn, over 6 pi mu a; numbers of an independent code.
    resistance = drag([[0.0, 0.0, height]])
    assert abs(resistance[0, 0] / SIX - along) < 1e-11
    assert abs(resistance[2, 2] / SIX - towards) < 1e-11


ROD = {  # along, across, towards over 6 pi mu a; spin about the axis over 8 pi mu a^3
    1.5: (6.6567046653926, 10.2847366063515, 25.3417670536132, 9.4606231384816),
    2.0: (5.4457064207826, 8.7008106644814, 18.3661457028047, 8.6933324585490),
    5.0: (3.8049265254976, 5.9535930929390, 8.7853739223208, 8.0391552848215),
    20.0: (3.1023069700474, 4.4793110444256, 5.0505881508433, 7.9544161993839),
}


@pytest.mark.parametrize("height", ROD)
def test_resistance_of_a_rod_above_a_wall(height):
    x = np.zeros((10, 3))
    x[:, 0], x[:, 2] = 2 * np.arange(10) - 9, height
    resistance = drag(x)
    body = np.zeros((60, 6))
    for i in range(10):
        body[3 * i : 3 * i + 3, :3] = np.eye(3)
        body[30 + 3 * i : 33 + 3 * i, 3:] = np.eye(3)
        for k in range(3):
            body[3 * i : 3 * i + 3, 3 + k] = np.cross(np.eye(3)[k], x[i] - [0.0, 0.0, height])
    total = body.T @ resistance @ body
    along, across, towards, spin = ROD[height]
    found = total[0, 0] / SIX, total[1, 1] / SIX, total[2, 2] / SIX, total[3, 3] / (8 * np.pi)
    for a, b in zip(found, (along, across, towards, spin), strict=True):
        assert abs(a - b) < 1e-12 * b


@jax.jit
def force_of_a_rod(height, direction):
    """On rods of 60 and 120 beads along x that move without turning; per length, of the 60 more."""
    total = []
    for beads in (60, 120):
        x = jnp.stack([2.0 * jnp.arange(beads), jnp.zeros(beads), jnp.full(beads, height)], axis=1)
        configuration = Configuration(x, jnp.asarray(1.0), jnp.asarray(1.0), True, FLOOR)

        def moved(load, configuration=configuration):
            found = RPY().motion(configuration, Load(*load))
            return found.velocity, found.spin

        wanted = jnp.broadcast_to(direction, (beads, 3)), jnp.zeros((beads, 3))
        (force, _), _ = jax.scipy.sparse.linalg.cg(moved, wanted, tol=1e-10)
        total.append(jnp.sum(force @ direction))
    return (total[1] - total[0]) / 120


def test_a_long_rod_has_the_friction_of_a_cylinder():
    """Per length 2 pi/arcosh(h/b) along, 4 pi/arcosh(h/b) across, 4 pi/(arcosh(h/b) - sqrt(1 - b^2/h^2))
    towards the wall (Jeffrey & Onishi, Q. J. Mech. Appl. Math. 34 (1981) 129). Touching beads are as a
    cylinder of a radius b, one along and one across, which the friction at h = 12 tells."""
    along, across, towards = np.eye(3)
    far = 12.0
    thin = far / np.cosh(2 * np.pi / force_of_a_rod(far, along))
    thick = far / np.cosh(4 * np.pi / force_of_a_rod(far, across))
    assert 0.7 < thick < thin < 0.9
    for height, allowed in ((far, 2e-4), (6.0, 5e-3), (3.0, 4e-2)):
        wide = np.arccosh(height / thick)
        laws = (
            2 * np.pi / np.arccosh(height / thin),
            4 * np.pi / wide,
            4 * np.pi / (wide - np.sqrt(1 - (thick / height) ** 2)),
        )
        for direction, law in zip((along, across, towards), laws, strict=True):
            assert abs(force_of_a_rod(height, direction) / law - 1) < allowed


def test_a_tilted_rod_falls_towards_a_wall():
    tilt = np.pi / 6
    e = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    x = np.array([0.0, 0.0, 2.0]) + 2 * np.arange(10)[:, None] * e
    scene = Scene(
        Chain(1.0, 10),
        1.0,
        constraints=[Gears(), EqualSpins()],
        forces=[Weight([0.0, 0.0, -0.1])],
        domain=FLOOR,
    )
    moved = dynamics.motion(0.0, State(jnp.asarray(x)), scene)
    mean = moved.velocity.mean(axis=0)
    there = np.array([-1.6547006718053e-03, 0.0, -9.9314598442001e-03])
    assert np.abs(mean - there).max() < 1e-14
    assert abs(moved.spin[0, 1] - 2.3316248389879e-04) < 1e-14


def test_the_wall_may_be_anywhere():
    """Point and normal turned and shifted with everything else; a plane scene is its spatial twin."""
    rng = np.random.default_rng(2)
    x = rng.uniform(-2, 2, (4, 3)) + np.array([0.0, 0.0, 3.0])
    a = np.array([1.0, 0.7, 0.5, 1.2])
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    shift = np.array([5.0, -3.0, 2.0])
    there = NoSlipWall(shift, 3.0 * turn @ [0.0, 0.0, 1.0])
    here = matrix(RPY(), Configuration(x, a, 1.3, True, FLOOR))
    moved = matrix(RPY(), Configuration(x @ turn.T + shift, a, 1.3, True, there))
    whole = np.kron(np.eye(8), turn)
    assert np.abs(moved - whole @ here @ whole.T).max() < 1e-15
    plane = x[:, [0, 2]]
    flat_wall = BELOW
    spatial = np.stack([plane[:, 0], plane[:, 1], np.zeros(4)], axis=1)
    up = NoSlipWall([0.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    two = matrix(RPY(), Configuration(plane, a, 1.3, True, flat_wall))
    three = matrix(RPY(), Configuration(spatial, a, 1.3, True, up))
    keep = [3 * i + k for i in range(4) for k in (0, 1)] + [12 + 3 * i + 2 for i in range(4)]
    assert np.abs(two - three[np.ix_(keep, keep)]).max() < 1e-16


@pytest.mark.parametrize("radius", [1.0, None], ids=["equal", "unequal"])
@pytest.mark.parametrize("domain", [FLOOR, SURFACE], ids=["wall", "free"])
def test_it_is_positive_wherever_beads_may_get(domain, radius):
    """Beads that overlap one another and the wall, deep or just; tables and products are the same."""
    rng = np.random.default_rng(3)
    for _ in range(12):
        x = rng.uniform(-2, 2, (6, 3))
        x[:, 2] = rng.uniform(0.02, 3.0, 6)
        x[1, 2], x[2] = 0.05, x[3]  # nearly on the wall; two in one place
        a = 1.0 if radius is not None else rng.uniform(0.3, 1.5, 6)
        spheres = Configuration(x, a, 1.0, True, domain)
        m = matrix(RPY(), spheres)
        scale = np.sqrt(np.diag(m))
        assert np.abs(m - m.T).max() < 1e-14 * m.max()
        values = np.linalg.eigvalsh(m / scale / scale[:, None])
        assert values[0] > -1e-14 and np.sum(values < 1e-12) <= 6  # two in one place move as one
        tables = RPY().tables(spheres)
        load = Load(*(jnp.asarray(y) for y in rng.normal(size=(2, 6, 3))))
        for one, two in zip(
            jax.tree.leaves(tables.motion(load)),
            jax.tree.leaves(RPY().motion(spheres, load)),
            strict=True,
        ):
            assert np.abs(one - two).max() < 1e-13


def test_no_fluid_slips_at_a_wall_or_passes_a_free_surface():
    # A tiny sphere is the fluid.
    x = np.array([[0.2, 0.1, 1.5], [2.0, -1.0, 2.0], [0.7, 0.9, 0.0], [-3.0, 2.0, 0.0]])
    a = np.array([1.0, 0.5, 1e-6, 1e-6])
    rng = np.random.default_rng(4)
    force, torque = rng.normal(size=(2, 4, 3)) * np.array([1.0, 1.0, 0.0, 0.0])[:, None]
    load, strain = Load(jnp.asarray(force), jnp.asarray(torque)), np.zeros((4, 3, 3))
    strain[0] = np.diag([1.0, -0.3, -0.7])
    lifted = x + np.array([0.0, 0.0, 1e-6]) * (a < 1e-3)[:, None]
    for domain in (FLOOR, SURFACE):
        spheres = Configuration(lifted, a, 1.0, True, domain)
        for moved in (RPY().motion(spheres, load), RPY().disturbance(spheres, jnp.asarray(strain))):
            assert np.abs(moved.velocity[:2]).max() > 1e-2
            parts = 3 if isinstance(domain, NoSlipWall) else 1
            assert np.abs(moved.velocity[2:, 3 - parts :]).max() < 1e-5
            if parts == 1:
                assert np.abs(moved.velocity[2:, :2]).max() > 1e-3


def walled(dim=2, dense=True, **terms):
    """A bent fibre above a tilted wall, clamped, pushed and sheared."""
    chain = Chain(1.0, 6)
    centre = [0.0, 4.0] if dim == 2 else [0.0, 4.0, 0.3]
    normal = [-0.3, 1.0] if dim == 2 else [-0.3, 1.0, 0.2]
    terms = {
        "constraints": [Gears()],
        "forces": [Bending(20.0), Weight(np.eye(dim)[1] * -0.3), Contact(2.0, 0.5, 0.4)],
        **terms,
    }
    domain = NoSlipWall([0.0] * dim, normal)
    return Scene(chain, 1.2, RPY(dense=dense), **terms, domain=domain), bent(
        chain, dim, centre=centre
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_an_instant_above_a_wall(dim):
    scene, state = walled(dim, constraints=[Gears(), *clamped()])
    reference = dense_motion(0.0, state, scene)
    assert np.abs(flat(dynamics.motion(0.0, state, scene)) - reference).max() < 1e-12
    free, _ = walled(dim, dense=False, constraints=[Gears(), *clamped()])
    assert np.abs(flat(dynamics.motion(0.0, state, free)) - reference).max() < 1e-9


def test_runs_above_a_wall_by_all_solvers():
    scene, state = walled()
    ts = np.linspace(0.0, 160.0, 5)
    reference = jb.rollout(scene, state, ts, tolerance=1e-9)
    assert reference.code == 0
    gap = scene.domain.clearance(reference.final.position, scene.chain.radius)
    assert 0 < gap.min() < 0.6 < gap.max()  # it has come down
    for options in ({"substeps": 4000}, {"tolerance": 1e-6}):
        run = jb.rollout(scene, state, ts, **options)
        assert np.abs(run.states.position - reference.states.position).max() < 1e-4


def test_gradients_above_a_wall():
    scene, state = walled()

    @jax.jit
    def end(rigidity, height):
        moved = State(state.position + height * jnp.array([[0.0, 1.0]]))
        forces = [Bending(rigidity), *scene.forces[1:]]
        run = Scene(scene.chain, 1.2, constraints=[Gears()], forces=forces, domain=scene.domain)
        return jb.rollout(run, moved, [0.0, 3.0], substeps=100).final.position[0, 1]

    slopes = jax.grad(end, (0, 1))(20.0, 0.0)
    h = 1e-4
    for k, slope in enumerate(slopes):
        ends = [end(20.0 + s * h * (k == 0), s * h * (k == 1)) for s in (1.0, -1.0)]
        assert abs(slope - (ends[0] - ends[1]) / (2 * h)) < 1e-7


def test_a_bead_comes_to_rest_on_the_wall():
    chain = Chain(1.0, 1)
    contact = Contact(10.0, 0.1, 0.1)
    scene = Scene(chain, 1.0, forces=[Weight([0.0, -1.0]), contact], domain=BELOW)
    for start in (3.0, 30.0):
        run = jb.rollout(scene, State(jnp.array([[0.0, start]])), np.linspace(0, 400 * start, 3))
        assert run.code == 0
        # F_0 (1/2 - gap/(2 delta)) = 1
        assert abs(run.final.position[0, 1] - 1 - 0.1 * (1 - 2 * 1.0 / 10.0)) < 1e-5


def test_nothing_falls_through_a_wall_without_contact():
    scene = Scene(Chain(1.0, 1), 1.0, forces=[Weight([0.0, -1.0])], domain=BELOW)
    run = jb.rollout(scene, State(jnp.array([[0.0, 3.0]])), np.linspace(0.0, 3000.0, 5))
    assert run.code == 0 and 0 < run.final.position[0, 1] < 0.1
    long = jb.rollout(scene, State(jnp.array([[0.0, 3.0]])), [0.0, 3000.0], substeps=1)
    assert long.code == jb.Outcome.BROKEN  # a step through the wall
    with pytest.raises(jb.SimulationError, match="bead 0 is beyond the NoSlipWall"):
        jb.simulate(
            scene, State(jnp.array([[0.0, 3.0]])), [0.0, 3000.0], substeps=1, progress=False
        )


def test_a_sphere_is_carried_along_a_wall_by_shear():
    # Far from the wall with the fluid; torque-free spin at the fluid's.
    wall = BELOW
    scene = Scene(Chain(1.0, 1), 1.0, constraints=[Gears()], flow=Shear(0.5), domain=wall)
    far = dynamics.motion(0.0, State(jnp.array([[0.0, 200.0]])), scene)
    assert abs(far.velocity[0, 0] / 100.0 - 1) < 1e-4 and abs(far.spin[0, 0] + 0.25) < 1e-4
    near = dynamics.motion(0.0, State(jnp.array([[0.0, 1.5]])), scene)
    assert 0.9 < near.velocity[0, 0] / 0.75 < 0.999  # it lags behind the fluid near the wall


WRONG = {
    "flow that slips": (
        {"flow": Shear(1.0), "domain": NoSlipWall([0.0, 1.0], [0.0, 1.0])},
        "NoSlipWall lets be",
    ),
    "flow through it": (
        {"flow": Extension(1.0), "domain": BELOW},
        "NoSlipWall lets be",
    ),
    "shear at a surface": ({"flow": Shear(1.0), "domain": OPEN}, "FreeSurface lets be"),
    "flow through a surface": (
        {"flow": Poiseuille(1.0, 5.0), "domain": ASIDE},
        "FreeSurface lets be",
    ),
    "behind it": ({"domain": NoSlipWall([0.0, 9.0], [0.0, 1.0])}, "outside"),
    "dimensions": ({"domain": FLOOR}, "components"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_is_refused(case):
    options, words = WRONG[case]
    chain = Chain(1.0, 4)
    scene = Scene(chain, 1.0, constraints=[Gears()], **options)
    with pytest.raises(ValueError, match=words):
        jb.check(scene, bent(chain, 2, centre=[0.0, 5.0]))


def test_flows_along_a_wall_are_taken():
    chain, wall = Chain(1.0, 4), BELOW
    for flow, domain in (
        (Shear(0.7), wall),
        (OscillatingShear(0.7, 2.0, 0.3), wall),
        (Extension(0.4), OPEN),
        (Poiseuille(1.0, 5.0), OPEN),
        (Poiseuille(1.0, 5.0), NoSlipWall([0.0, -5.0], [0.0, 1.0])),
    ):
        jb.check(Scene(chain, 1.0, flow=flow, domain=domain), bent(chain, 2, centre=[0.0, 5.0]))


def test_a_plane_has_a_direction():
    with pytest.raises(ValueError, match="normal"):
        NoSlipWall([0.0, 0.0], [0.0, 0.0])
    with pytest.raises(ValueError, match="normal"):
        NoSlipWall([0.0, 0.0], [0.0, 0.0, 1.0])
    scene = Scene(Chain(1.0, 2), 1.0, FreeDraining(), domain=BELOW)
    assert rigid_resistance(np.array([[0.0, 2.0], [2.0, 2.0]]), scene.chain, 1.0).shape == (3, 3)


@pytest.mark.parametrize("turned", [0.0, 1.1])
def test_pumped_volume_is_the_flux_through_a_plane(turned):
    # Of the flow that a force and a torque drive, at tiny spheres all over the plane.
    force, torque, mu = np.array([0.7, 0.2, -0.4]), np.array([0.3, 0.9, -0.2]), 0.7
    c, s = np.cos(turned), np.sin(turned)
    d, across = np.array([c, s, 0.0]), np.array([-s, c, 0.0])
    nodes, w = np.polynomial.legendre.leggauss(160)
    y, wy = np.tan(np.pi / 2 * nodes), w * np.pi / 2 / np.cos(np.pi / 2 * nodes) ** 2
    half = np.pi / 4 * (nodes + 1)
    z, wz = np.tan(half), w * np.pi / 4 / np.cos(half) ** 2
    source = np.array([0.0, 0.0, 1.3])
    y, z, weight = (x.ravel() for x in (*np.meshgrid(y, z, indexing="ij"), np.outer(wy, wz)))
    points = 1.5 * d + y[:, None] * across + z[:, None] * np.array([0.0, 0.0, 1.0])
    load = Load(*(jnp.asarray(np.stack([x, 0 * x])) for x in (force, torque)))

    @jax.jit
    @jax.vmap
    def velocity(point):
        spheres = Configuration(jnp.stack([source, point]), jnp.array([1.0, 1e-6]), mu, True, FLOOR)
        return RPY().motion(spheres, load).velocity[1]

    flux = weight @ (np.asarray(velocity(jnp.asarray(points))) @ d)
    scene = Scene(
        Chain(1.0, 1), mu, constraints=[Gears()], forces=[Loaded(force, torque)], domain=FLOOR
    )
    found = jb.observables.pumping_rate(0.0, State(jnp.asarray(source[None])), scene, 3.0 * d)
    assert abs(found - flux) < 3e-4 * abs(flux)
    with pytest.raises(ValueError, match="NoSlipWall"):
        free = Scene(Chain(1.0, 1), mu, forces=[Weight([0.0, 0.0, 1.0])])
        jb.observables.pumping_rate(0.0, State(jnp.asarray(source[None])), free, d)


def test_the_wall_takes_up_the_whole_force():
    """Traction of Blake's flow on the wall: mu du/dz along it; across it minus the pressure, whose slope
    along it is mu d2u/dz2, so that the integral of -p over circles is that of pi r^2 dp/dr."""
    nodes, w = np.polynomial.legendre.leggauss(60)
    half = np.pi / 4 * (nodes + 1)
    rho, weight = np.tan(half), w * np.pi / 4 / np.cos(half) ** 2
    source, h = np.array([0.0, 0.0, 1.3]), 1e-3
    along = np.zeros(2)
    towards = 0.0
    for r, dr in zip(rho, weight, strict=True):
        near = [blake(np.array([r, 0.0, k * h]), source) for k in (1, 2, 3)]
        slope = (18 * near[0] - 9 * near[1] + 2 * near[2]) / (6 * h)
        bend = (-5 * near[0] + 4 * near[1] - near[2]) / h**2
        # At the angle f from the force du_x/dz is slope_xx cos^2 f + slope_yy sin^2 f.
        along += dr * np.pi * r * np.array([slope[0, 0] + slope[1, 1], slope[2, 2]])
        towards += dr * np.pi * r**2 * bend[0, 2]
    assert abs(along[0] / (8 * np.pi) - 1) < 1e-4 and abs(along[1]) < 1e-4
    assert abs(towards / (8 * np.pi) - 1) < 1e-4
    force, torque = np.array([0.7, 0.2, -0.4]), np.array([0.3, 0.9, -0.2])
    scene = Scene(
        Chain(1.0, 1), 0.7, constraints=[Gears()], forces=[Loaded(force, torque)], domain=FLOOR
    )
    found = jb.observables.wall_force(0.0, State(jnp.array([[0.3, 0.1, 1.3]])), scene)
    assert np.abs(found - force).max() < 1e-15
    with pytest.raises(ValueError, match="NoSlipWall"):
        free = Scene(Chain(1.0, 1), 1.0, forces=[Weight([0.0, 0.0, 1.0])])
        jb.observables.wall_force(0.0, State(jnp.array([[0.3, 0.1, 1.3]])), free)


def test_pumping_in_the_plane_is_that_in_space():
    scene, state = walled(2)
    flat_rate = jb.observables.pumping_rate(0.0, state, scene, [1.0, 0.3])
    normal = NoSlipWall([0.0] * 3, [-0.3, 1.0, 0.0])
    forces = [Bending(20.0), Weight([0.0, -0.3, 0.0]), Contact(2.0, 0.5, 0.4)]
    spatial = Scene(scene.chain, 1.2, constraints=[Gears()], forces=forces, domain=normal)
    lifted = State(jnp.pad(state.position, ((0, 0), (0, 1))))
    rate = jb.observables.pumping_rate(0.0, lifted, spatial, [1.0, 0.3, 0.0])
    assert abs(rate - flat_rate) < 1e-12 * abs(rate)


@pytest.mark.parametrize("domain", [NoSlipWall, FreeSurface])
def test_units_and_single_precision(domain):
    # Micrometres in water, in float64 to rounding and in float32 to its.
    rng = np.random.default_rng(5)
    x, a = rng.uniform(-2, 2, (4, 3)) + np.array([0.0, 0.0, 3.0]), np.array([1.0, 0.7, 0.5, 1.2])
    x[0, 2] = 0.6  # overlaps the wall
    force, torque = rng.normal(size=(2, 4, 3))
    strain = np.diag([1.0, -0.4, -0.6])
    length, mu = 1e-6, 1e-3

    def moved(scale, viscosity, dtype):
        cast = jax.tree.map(lambda y: jnp.asarray(y, dtype), (x * scale, a * scale, viscosity))
        wall = domain(jnp.zeros(3, dtype), jnp.asarray([0.0, 0.0, 1.0], dtype))
        spheres = Configuration(*cast, True, wall)
        load = Load(
            jnp.asarray(force * scale * scale * viscosity, dtype),
            jnp.asarray(torque * scale**3 * viscosity, dtype),
        )
        both = RPY().motion(spheres, load), RPY().disturbance(spheres, jnp.asarray(strain, dtype))
        return [np.asarray(m.velocity) / scale for m in both] + [np.asarray(m.spin) for m in both]

    plain, small = moved(1.0, 1.0, jnp.float64), moved(length, mu, jnp.float64)
    single = moved(length, mu, jnp.float32)
    for one, two, three in zip(plain, small, single, strict=True):
        assert np.abs(one - two).max() < 1e-12 * np.abs(one).max()
        assert three.dtype == np.float32
        assert np.abs(one - three).max() < 2e-5 * np.abs(one).max()


@pytest.mark.parametrize("platform", ["cuda", "tpu"])
def test_it_lowers_for_accelerators(platform):
    scene, state = walled()
    run = jax.jit(lambda state: jb.rollout(scene, state, [0.0, 1.0], substeps=4).final.position)
    assert jax.export.export(run, platforms=[platform])(state).platforms == (platform,)


def test_members_of_a_batch_have_walls_of_their_own():
    scene, state = walled()
    heights = jnp.array([0.0, -1.0, -2.0])

    @jax.jit
    def velocity(height):
        wall = NoSlipWall(jnp.stack([0.0 * height, height]), scene.domain.normal)
        there = eqx.tree_at(lambda s: s.domain, scene, wall)
        return dynamics.motion(0.0, state, there).velocity

    together = jax.vmap(velocity)(heights)
    for height, found in zip(heights, together, strict=True):
        assert np.abs(found - velocity(height)).max() < 1e-14


def test_steady_and_periodic_shapes_stand_still_above_a_wall():
    scene, state = walled(
        constraints=[Gears(), *clamped()], forces=[Bending(20.0), Weight([0.0, -0.05])]
    )
    with pytest.raises(ValueError, match=r"moving.*a translation of the whole"):
        jb.steady_state(scene, state)
    with pytest.raises(ValueError, match=r"moving.*a translation of the whole"):
        jb.periodic_state(scene, state, 1.0)
    with pytest.raises(ValueError, match="turning"):
        jb.periodic_state(scene, state, 1.0, moving=False)
    found = jb.steady_state(scene, state, moving=False)
    moved = dynamics.motion(0.0, found.state, scene)
    assert found.converged and np.abs(moved.velocity).max() < 1e-10
    terms = {"constraints": scene.constraints, "forces": scene.forces}
    free = jb.steady_state(Scene(scene.chain, 1.2, **terms), state, moving=False)
    assert np.abs(free.state.position - found.state.position).max() < 1e-6  # at rest nothing flows


def test_a_wall_of_a_users_own_kind_is_a_wall():
    class Glass(NoSlipWall):
        pass

    x, up = [[0.0, 0.0, 1.5]], [0.0, 0.0, 1.0]
    found = matrix(RPY(), Configuration(x, 1.0, 1.0, True, Glass([0.0] * 3, up)))
    assert np.array_equal(found, matrix(RPY(), Configuration(x, 1.0, 1.0, True, FLOOR)))
