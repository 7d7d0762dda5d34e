"""Bead models, driven and active fibres, contact: each against another route to the same number."""

import re
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent, jointed
from dense import dense_motion, flat

import jaxbeads as jb
from jaxbeads import (
    Chain,
    Scene,
    Setting,
    State,
    dynamics,
    from_directors,
    material,
    rollout,
    simulate,
    straight,
)
from jaxbeads.actuation import FourierCurvature, HelicalBeat, PlanarBeat, TravellingWave
from jaxbeads.chain import linked, place
from jaxbeads.constraint import (
    AbstractConstraint,
    EqualSpins,
    Gears,
    Inextensible,
    Joint,
    PrescribedDirection,
    PrescribedLengths,
    PrescribedPosition,
    PrescribedSpin,
    clamped,
    hinged,
)
from jaxbeads.dimensionless import largest_joint_curvature
from jaxbeads.flow import Shear
from jaxbeads.force import (
    Bending,
    BendingEnergy,
    Contact,
    DrivingMoment,
    ElasticRod,
    Follower,
    JointBending,
    JointRepulsion,
    Spring,
    Weight,
)
from jaxbeads.force.base import repulsion
from jaxbeads.geometry import tangents, turned
from jaxbeads.mobility import RPY, FreeDraining
from jaxbeads.solver import AB3, Rosenbrock

T0 = jnp.zeros(())


# The Joint Model and other chains


UNEQUAL = np.linspace(0.8, 1.2, 8)


@pytest.mark.parametrize(
    "constraint, radius, dim",
    [
        (Joint(), 1.0, 2),
        (Joint(), 1.0, 3),
        (Joint(), UNEQUAL, 2),
        (Joint(), UNEQUAL, 3),
        (Gears(), 1.0, 2),
        (Gears(), UNEQUAL, 3),
        (Inextensible(), UNEQUAL, 2),
        (Inextensible(), 1.0, 3),
    ],
    ids=lambda x: "unequal" if isinstance(x, np.ndarray) else None,
)
def test_chains_with_gaps_match_dense_elimination(constraint, radius, dim):
    chain = Chain(radius, (5, 3), gap=0.15)
    state = jointed(chain, dim, centre=[[0.0] * dim, [7.0] * dim])
    bending = JointBending(20.0, repulsion=JointRepulsion(0.3, 0.5))
    weight = Weight(np.array([0.1, -0.4, 0.2])[:dim])
    scene = Scene(chain, 1.3, constraints=[constraint], forces=[bending, weight], flow=Shear(0.3))
    reference = dense_motion(0.0, state, scene)
    assert (
        np.abs(flat(dynamics.motion(0.0, state, scene)) - reference).max()
        < 1e-12 * np.abs(reference).max()
    )
    # S by its own assembly against S by columns.
    parts = dynamics.constraint_map(0.0, state, scene)
    operator = RPY().operator(scene.configuration(state, True)).kept()
    units = np.eye(parts.offset.shape[0])
    columns = np.stack([parts.compliance(operator, jnp.asarray(u)) for u in units], axis=1)
    live = np.abs(columns).max(axis=0) > 0
    direct = np.asarray(dynamics.constraint_matrix(0.0, state, scene))
    assert np.abs((direct - columns)[np.ix_(live, live)]).max() < 1e-15


def slow_rates(model, beads, gap=0.0):
    """Bending rates of a free straight chain times mu L^4 / K_b, slowest first."""
    chain = Chain(1.0, beads, gap)
    flat_bonds = jnp.zeros((1, 2))
    if model == "joint":
        scene = Scene(chain, 1.0, constraints=[Joint()], forces=[JointBending(1.0)])

        def turning(angle):
            p = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
            state = State(place(chain, linked(chain, p), flat_bonds), p)
            return dynamics.motion(0.0, state, scene).spin[:, 0]

        angles = jnp.zeros(beads)
    else:
        scene = Scene(chain, 1.0, constraints=[Gears()], forces=[Bending(1.0)])

        def turning(angle):
            e = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
            state = State(place(chain, e * chain.bond_length[:, None], flat_bonds))
            velocity = dynamics.motion(0.0, state, scene).velocity
            return (velocity[1:, 1] - velocity[:-1, 1]) / chain.bond_length

        angles = jnp.zeros(beads - 1)
    values = np.linalg.eigvals(np.asarray(jax.jit(jax.jacfwd(turning))(angles)))
    return np.sort(-values.real)[1:3] * float(chain.length[0]) ** 4


def test_joint_and_gears_chains_bend_alike():
    # The factor of the joint curvature (46): chains of equal length relax at the same slow rates as N
    # grows; the printed factor would double the rates.
    errors = []
    for beads in (10, 20, 40):
        gears, joint = slow_rates("gears", beads), slow_rates("joint", beads)
        errors.append(np.abs(joint / gears - 1))
    assert np.all(errors[2] < [2e-3, 1e-2])
    assert errors[0][0] / errors[1][0] > 3 and errors[1][0] / errors[2][0] > 3  # like 1/N^2


def test_rates_of_bending_by_forces_bound_the_explicit_step():
    # Long free-draining chains reach the bound, half of AB3's limit; with interactions they are slower.
    chain = Chain(1.0, 24)
    for mobility, least in ((FreeDraining(), 0.98), (RPY(), 0.3)):
        force = BendingEnergy(100.0)
        scene = Scene(chain, 1.3, mobility, [Inextensible()], [force])
        fastest = -jb.scenes.lateral_modes(scene)[0].real.min()
        part = fastest * float(jb.solver.explicit_step(scene)) * 11 / 3
        assert least < part < 1 + 1e-12
    ts = 1000 * float(jb.solver.explicit_step(scene)) * np.arange(2)
    assert int(rollout(scene, bent(chain), ts, solver=jb.AB3()).code) == 0


def test_rates_of_joint_chains_bound_the_explicit_step():
    chain = Chain(1.0, 12, 0.1)
    scene = Scene(chain, 1.0, constraints=[Joint()], forces=[JointBending(1.0)])

    def turning(angle):
        p = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
        state = State(place(chain, linked(chain, p), jnp.zeros((1, 2))), p)
        return dynamics.motion(0.0, state, scene).spin[:, 0]

    fastest = -np.linalg.eigvals(np.asarray(jax.jacfwd(turning)(jnp.zeros(12)))).real.min()
    limit = 6 / 11 / fastest  # of AB3 on the real axis
    step = float(jb.solver.explicit_step(scene))
    assert 0.35 * limit < step < 0.5 * limit


def test_joints_stay_together():
    # Eq. (2) while a curved chain straightens in shear; `project` removes what time stepping leaves.
    chain = Chain(1.0, 8, gap=0.1)
    scene = Scene(chain, 1.0, constraints=[Joint()], forces=[JointBending(30.0)], flow=Shear(0.5))
    state = jointed(chain)
    ts = np.linspace(0, 2, 5)
    free = simulate(scene, state, ts, progress=False)
    held = simulate(scene, state, ts, solver=Rosenbrock(projected=True), progress=False)
    assert 0 < float(free.bond_length_error[-1]) < 1e-4
    assert float(held.bond_length_error[-1]) < 1e-14
    assert np.abs(np.linalg.norm(held.final.director, axis=1) - 1).max() < 1e-15
    assert np.abs(np.asarray(held.final.position - free.final.position)).max() < 1e-3
    drift = Joint().bond_errors(free.final, chain)
    p, r = np.asarray(free.final.director), np.asarray(free.final.position)
    gap = np.linalg.norm(r[:-1] + 1.1 * p[:-1] - r[1:] + 1.1 * p[1:], axis=1)
    off = np.abs(np.linalg.norm(p, axis=1) - 1)
    assert np.abs(drift - np.maximum(gap / 2.2, np.maximum(off[1:], off[:-1]))).max() < 1e-15


def test_a_joint_chain_that_blows_up_is_stopped():
    # Its joints hold to rounding even then, because eq. (2) is linear; the directors' lengths tell.
    chain = Chain(1.0, 6, gap=0.1)
    scene = Scene(chain, 1.0, constraints=[Joint()], forces=[JointBending(30.0)], flow=Shear(0.5))
    step = float(jb.solver.explicit_step(scene))
    ts = np.arange(40) * 40 * step
    with (
        pytest.warns(UserWarning, match="AB3 is stable to about 2.2 times"),
        pytest.raises(jb.SimulationError, match=r"is off its length|no finite position"),
    ):
        simulate(scene, jointed(chain), ts, substeps=13, progress=False)


def test_repulsion_profile():
    # Eq. (43) by hand: roughness 0.2, decay 0.5.
    found = repulsion(jnp.array([0.3, 0.2, 0.0, -0.2, -0.7]), jnp.asarray(0.2), jnp.asarray(0.5))
    assert np.allclose(found, [0.0, 0.0, 0.5, 1.0, np.exp(1.0)], atol=1e-15)
    slope = jax.vmap(jax.grad(lambda g: repulsion(g, jnp.asarray(0.2), jnp.asarray(0.5))))(
        jnp.array([-90.0, 0.1, 90.0])
    )
    assert np.all(np.isfinite(slope)) and abs(slope[1] + 2.5) < 1e-12 and slope[2] == 0


def test_repulsion_of_neighbours_in_the_joint_model():
    # Eqs (43)-(45) by hand for three beads that turn by 0.8 rad at the second joint.
    gap, rigidity = 0.05, 7.0
    chain = Chain(1.0, 3, gap)
    angle = np.array([0.0, 0.0, 0.8])
    state = from_directors(chain, np.stack([np.cos(angle), np.sin(angle)], axis=1))
    with_it = JointBending(rigidity, repulsion=JointRepulsion(0.3, 0.5, 0.2, 0.25))
    load = with_it.load(T0, state, Setting(chain, 1.0))
    half = 1 + gap
    energy = rigidity * (np.sin(0.4) / half) ** 2
    scale = 0.3 + 0.5 * np.sqrt(rigidity * energy / (6 * half) ** 3)
    r = np.asarray(state.position)
    d = r[1:] - r[:-1]
    distance = np.linalg.norm(d, axis=1) - 2
    profile = 0.5 - distance / (2 * 0.2 * half)
    assert np.all(np.abs(distance) < 0.2 * half)  # both on the ramp
    push = scale * profile[:, None] * d / np.linalg.norm(d, axis=1)[:, None]
    expected = np.array([-push[0], push[0] - push[1], push[1]])
    assert np.abs(np.asarray(load.force) - expected).max() < 1e-14
    assert np.abs(np.sum(load.torque)) < 1e-14  # internal moments cancel
    m = rigidity * np.sin(0.4) / half  # only the second joint is bent
    assert np.abs(np.asarray(load.torque)[:, 0] - [0.0, m, -m]).max() < 1e-13


def test_largest_joint_curvature():
    # Eq. (4): at this curvature the surfaces of neighbours touch at the inside of the bend.
    radius, gap = 1.0, 0.1
    curvature = float(largest_joint_curvature(radius, gap))
    half_turn = np.arccos(radius / (radius + gap))  # (a + eps) cos(phi/2) = a
    assert abs(curvature - np.sin(half_turn)) < 1e-15
    chain = Chain(radius, 2, gap)
    angle = np.array([half_turn, -half_turn])
    state = from_directors(chain, np.stack([np.cos(angle), np.sin(angle)], axis=1))
    assert abs(np.linalg.norm(state.position[1] - state.position[0]) - 2 * radius) < 1e-14


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("link", [Gears(), Joint()])
def test_equal_spins_make_a_rigid_body(link, dim):
    chain = Chain(1.0, 6)
    state = (jointed if link.oriented else bent)(chain, dim)
    scene = Scene(
        chain,
        1.0,
        constraints=[link, EqualSpins()],
        forces=[Weight(np.eye(dim)[1])],
        flow=Shear(0.4),
    )
    moved = dynamics.motion(0.0, state, scene)
    x, v = np.asarray(state.position), np.asarray(moved.velocity)
    apart, relative = x[:, None] - x[None], v[:, None] - v[None]
    assert np.abs((apart * relative).sum(axis=2)).max() < 1e-12  # no distance changes
    assert np.ptp(np.asarray(moved.spin), axis=0).max() < 1e-13


def test_tensions_of_a_hanging_chain():
    # The multipliers of an inextensible chain at rest are its tensions: the weight below each bond.
    chain = Chain(1.0, 6)
    state = straight(chain, [0.0, -1.0])
    scene = Scene(chain, 1.0, constraints=[Inextensible(), *hinged()], forces=[Weight([0.0, -0.5])])
    found = dynamics.evaluate(0.0, state, scene)
    assert np.abs(found.motion.velocity).max() < 1e-14
    assert np.abs(np.abs(found.multipliers[:5]) - 0.5 * np.arange(5, 0, -1)).max() < 1e-13
    assert np.allclose(found.multipliers[5:], [0.0, 3.0], atol=1e-13)  # the support carries all


def test_stiff_springs_become_an_inextensible_chain():
    # Both follow eq. (1) or its limit; the difference falls like 1/k_s.
    chain = Chain(1.0, 5)
    ts = np.linspace(0, 4, 3)
    energy, weight = BendingEnergy(5.0), Weight([0.0, -0.5])
    limit = Scene(chain, 1.0, constraints=[Inextensible()], forces=[energy, weight])
    end = rollout(limit, bent(chain), ts, solver=AB3(substeps=400, projected=True)).final.position
    errors = []
    for stiffness in (50.0, 100.0):
        springs = Scene(chain, 1.0, forces=[energy, weight, Spring(stiffness)])
        run = rollout(springs, bent(chain), ts, substeps=800).final.position
        errors.append(np.abs(np.asarray(run - end)).max())
    assert errors[0] < 0.05 and 1.8 < errors[0] / errors[1] < 2.2


def test_spring_force():
    chain = Chain(1.0, 3)
    x = jnp.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.5]])
    load = Spring([2.0, 4.0]).load(T0, State(x), Setting(chain, 1.0))
    assert np.allclose(load.force, [[2.0, 0.0], [-2.0, -2.0], [0.0, 2.0]], atol=1e-14)


# Prescribed motion


def test_a_driven_base_follows_its_laws():
    # Position, direction and spin after a time, to the order of the solver.
    chain = Chain(1.0, 6)
    place_law, direction = (lambda t: jnp.stack([0.5 * jnp.sin(t), t**2])), PlanarBeat(0.4, 2.0)
    constraints = [
        Gears(),
        PrescribedPosition(place_law),
        PrescribedDirection(direction),
        PrescribedSpin(lambda t: jnp.cos(t)[None]),
    ]
    scene = Scene(chain, 1.0, constraints=constraints, forces=[Bending(20.0)])
    start = straight(chain, [1.0, 0.0], [5.0, 0.0])
    errors = []
    for substeps in (50, 100):
        end = rollout(scene, start, [0.0, 1.0], substeps=substeps).final
        assert np.abs(end.position[0] - np.array([0.5 * np.sin(1), 1.0])).max() < 1e-4
        errors.append(np.abs(tangents(end.position)[0] - direction(jnp.asarray(1.0))).max())
    assert errors[1] < 1e-5 and errors[0] / errors[1] > 6
    moved = dynamics.motion(0.3, start, scene)
    assert abs(moved.spin[0, 0] - np.cos(0.3)) < 1e-13


def test_helical_base_in_space():
    # d/dt of eq. (62) by hand, eq. (63).
    alpha, zeta, delta, t = 0.3, 1.4, 2.7, 0.8
    law = HelicalBeat(alpha, zeta, delta)
    chain = Chain(1.0, 5)
    direction = HelicalBeat(alpha, zeta)
    e = np.asarray(direction(jnp.asarray(t)))
    state = straight(chain, e)
    scene = Scene(
        chain,
        1.0,
        constraints=[
            Gears(),
            PrescribedPosition(law),
            PrescribedSpin(),
            PrescribedDirection(direction),
        ],
    )
    s, c = np.sin(zeta * t), np.cos(zeta * t)
    a, b = alpha * s, alpha * c
    rate = (
        delta
        * alpha
        * zeta
        * np.array(
            [
                -c * np.sin(a) * np.cos(b) + s * np.cos(a) * np.sin(b),
                -c * np.sin(a) * np.sin(b) - s * np.cos(a) * np.cos(b),
                c * np.cos(a),
            ]
        )
    )
    moved = dynamics.motion(t, state, scene)
    assert np.abs(moved.velocity[0] - rate).max() < 1e-13
    assert np.abs(moved.velocity[1] - rate * (delta + 2) / delta).max() < 1e-13  # eq. (64)
    assert np.abs(moved.spin[0]).max() < 1e-14
    assert np.abs(flat(moved) - dense_motion(t, state, scene)).max() < 1e-12


@pytest.mark.parametrize("end", [0, -1])
@pytest.mark.parametrize("dim", [2, 3])
def test_static_cantilever(dim, end):
    # Statics by hand: the moments m_i = F (x_tip - x_i) of a clamped chain bend its joints by
    # m_i l / K_b; in that shape nothing moves. A route without mobility and multipliers.
    chain, rigidity, force = Chain(1.0, 8), 50.0, 1e-4
    turn = force * 2 * np.arange(6, 0, -1) * 2 / rigidity
    angle = np.concatenate([[0.0], np.cumsum(turn)])
    e = np.stack([np.cos(angle), np.sin(angle), 0 * angle][:dim], axis=1)
    x = np.asarray(jb.from_tangents(chain, e))
    load = np.zeros((8, dim))
    load[7, 1] = force
    if end == -1:
        x, load = x[::-1], load[::-1]
    scene = Scene(
        chain, 1.0, constraints=[Gears(), *clamped(end)], forces=[Bending(rigidity), Weight(load)]
    )
    moved = dynamics.motion(0.0, State(x), scene)
    loose = Scene(chain, 1.0, constraints=[Gears(), *clamped(end)], forces=[Weight(load)])
    unheld = dynamics.motion(0.0, State(x), loose)
    assert np.abs(moved.velocity).max() < 1e-4 * np.abs(unheld.velocity).max()


def test_a_hinge_turns_and_a_clamp_does_not():
    chain = Chain(1.0, 5)
    state = straight(chain, [1.0, 0.0])
    for ends, turns in ((hinged(), True), (clamped(), False), (clamped(-1), False)):
        scene = Scene(
            chain, 1.0, constraints=[Gears(), *ends], forces=[Weight([0.0, -1.0]), Bending(1e4)]
        )
        velocity = np.asarray(dynamics.motion(0.0, state, scene).velocity)
        assert np.abs(velocity[-1 if ends == clamped(-1) else 0]).max() < 1e-13
        assert (np.abs(velocity[1 if turns else 3]).max() > 1e-3) or not turns
        if ends == clamped():
            assert np.abs(velocity[1]).max() < 1e-13
    spinless = Scene(
        chain,
        1.0,
        constraints=[Inextensible(), *clamped(spinless=True)],
        forces=[BendingEnergy(10.0), Weight([0.0, -1.0])],
    )
    assert not spinless.rotational
    assert np.abs(dynamics.motion(0.0, state, spinless).velocity[:2]).max() < 1e-13


def test_gradients_through_prescribed_motion():
    # S stays regular with the redundant row of (65) left out, so gradients are finite and right.
    chain = Chain(1.0, 6)

    def tip(amplitude, rigidity):
        constraints = [
            Gears(),
            PrescribedPosition(),
            PrescribedSpin(),
            PrescribedDirection(PlanarBeat(amplitude, 2.0)),
        ]
        scene = Scene(chain, 1.0, constraints=constraints, forces=[Bending(rigidity)])
        run = rollout(scene, straight(chain, [1.0, 0.0]), [0.0, 0.5, 1.0], substeps=20)
        return run.final.position[-1, 1]

    arguments = (jnp.asarray(0.4), jnp.asarray(20.0))
    value, gradient = jax.jit(jax.value_and_grad(tip, argnums=(0, 1)))(*arguments)
    tip = jax.jit(tip)
    assert abs(value) > 0.1
    for k, h in ((0, 1e-5), (1, 1e-3)):
        moved = [[x + s * h * (i == k) for i, x in enumerate(arguments)] for s in (1, -1)]
        slope = (tip(*moved[0]) - tip(*moved[1])) / (2 * h)
        assert abs(slope - gradient[k]) < 1e-6 * abs(slope)


class Overdetermined(AbstractConstraint):
    """The whole set (65): the bond's first bead at rest, its second moving along the bond at a speed."""

    rotational: ClassVar[bool] = True
    speed: jax.Array

    def slip(self, t, state, motion, chain):
        second = motion.velocity[1] - self.speed * tangents(state.position)[0]
        return jnp.concatenate([motion.velocity[0], motion.spin[0], second])


@pytest.mark.parametrize(
    "constraints, how",
    [
        ([Gears(), Overdetermined(jnp.zeros(()))], "Gears + Overdetermined are redundant"),
        ([Gears(), Overdetermined(jnp.ones(()))], "Gears + Overdetermined contradict one another"),
        (
            [Gears(), *hinged(), *hinged()],
            "PrescribedPosition(bead=0) + PrescribedPosition(bead=0) are redundant",
        ),
        ([Gears(), Inextensible()], "Gears + Inextensible are redundant"),
        (
            [Gears(), PrescribedPosition(), PrescribedPosition(lambda t: jnp.stack([t, t]))],
            "PrescribedPosition(bead=0) + PrescribedPosition(bead=0) contradict one another",
        ),
    ],
    ids=["redundant", "contradictory", "twice", "chains", "two laws"],
)
def test_dependent_constraints_are_named(constraints, how):
    chain = Chain(1.0, 5)
    state = straight(chain, [1.0, 0.0])
    scene = Scene(chain, 1.0, constraints=constraints, forces=[Bending(10.0)])
    assert str(dynamics.redundancy(0.0, state, scene)).startswith(how)
    assert np.all(np.isnan(dynamics.motion(0.0, state, scene).velocity))  # never silently wrong
    sentence = re.escape(f"must be independent at the start, but {how}")
    with pytest.raises(ValueError, match=sentence):
        simulate(scene, state, np.linspace(0, 1, 3), progress=False)


def test_independent_constraints_are_not_accused():
    chain = Chain(1.0, (20, 14))
    state = bent(chain, 3, centre=[[0.0, 0.0, 0.0], [0.0, 50.0, 0.0]])
    scene = Scene(chain, 1.0, constraints=[Gears(), *clamped(), *clamped(-1)])
    assert dynamics.redundancy(0.0, state, scene) is None
    assert np.all(np.isfinite(dynamics.motion(0.0, state, scene).velocity))


# Active fibres


WAVE = TravellingWave(0.3, 0.4, 1.5, 0.2)


@pytest.mark.parametrize(
    "wave, dim",
    [
        (WAVE, 2),
        (FourierCurvature([[0.1, 0.2], [0.3, 0.1]], [[0.0, 0.1], [0.0, -0.2]], 0.7), 2),
        (WAVE, 3),
        (lambda t, s, length: WAVE(t, s, length)[:, None] * np.array([[0.6, 0.0, 0.8]]), 3),
    ],
    ids=["travelling", "fourier", "along the binormal", "vectors"],
)
@pytest.mark.parametrize("model", ["gears", "joint"])
def test_active_fibres_exert_no_net_load(model, wave, dim):
    # Internal torques sum to zero, and so do force and torque of the whole motion's loads.
    chain = Chain(1.0, (6, 5))
    state = jointed(chain, dim, centre=[[0.0] * dim, [9.0] * dim])
    force = Bending(20.0, wave) if model == "gears" else JointBending(20.0, wave)
    link = Gears() if model == "gears" else Joint()
    torque = np.asarray(force.load(jnp.asarray(0.3), state, Setting(chain, 1.0)).torque)
    for part in (torque[:6], torque[6:]):  # in each fibre
        assert np.abs(part.sum(axis=0)).max() < 1e-12 * np.abs(torque).max()
    scene = Scene(chain, 1.0, constraints=[link], forces=[force])
    pull = np.asarray(dynamics.constraint_load(0.3, state, scene).force)
    for part in (pull[:6], pull[6:]):
        assert np.abs(part.sum(axis=0)).max() < 1e-12 * np.abs(pull).max()
    still = Scene(chain, 1.0, constraints=[link], forces=[type(force)(20.0)])
    change = (
        dynamics.motion(0.3, state, scene).velocity - dynamics.motion(0.3, state, still).velocity
    )
    assert np.abs(change).max() > 1e-3  # and it does act


def test_helical_waves_exert_no_net_load_and_drive():
    # Two fibres, the waves of the second elsewhere along it: forces and torques of each sum to zero.
    chain = Chain(1.0, (6, 5))
    state = jb.with_frames(bent(chain, 3, centre=[[0.0] * 3, [9.0] * 3]), chain)
    active = ElasticRod(20.0, 15.0, None, WAVE, TravellingWave(0.3, 0.4, 1.5, 1.8))
    load = active.load(jnp.asarray(0.3), state, Setting(chain, 1.0))
    force, torque = np.asarray(load.force), np.asarray(load.torque)
    turning = np.cross(state.position, force) + torque
    for part in (slice(0, 6), slice(6, 11)):
        assert np.abs(force[part].sum(axis=0)).max() < 1e-12 * np.abs(force).max()
        assert np.abs(turning[part].sum(axis=0)).max() < 1e-12 * np.abs(turning).max()
    # At small curvature it drives as `Bending` does along the same vectors.
    level = jb.with_frames(straight(chain, np.eye(3)[:2], [[0.0] * 3, [9.0] * 3]), chain)
    of = level.frame[1:-1], jnp.cross(material.directions(level.position, chain)[1], level.frame)

    def vectors(t, s, length):
        about = active.intrinsic_curvature, active.second_curvature
        return (
            about[0](t, s, length)[:, None] * of[0] + about[1](t, s, length)[:, None] * of[1][1:-1]
        )

    moved = [
        dynamics.motion(
            0.3, level, Scene(chain, 1.0, constraints=[Gears()], forces=[force])
        ).velocity
        for force in (active, Bending(20.0, vectors))
    ]
    assert np.abs(moved[0] - moved[1]).max() < 1e-12 * np.abs(moved[1]).max()
    assert np.abs(moved[1]).max() > 1e-3


def test_waves_by_hand():
    chain = Chain(1.0, (4, 3))
    s, length = chain.arclength, chain.length[chain.fibre_of_bead]
    assert np.allclose(s, [1, 3, 5, 7, 1, 3, 5]) and np.allclose(length, [8] * 4 + [6] * 3)
    t = jnp.asarray(0.7)
    expected = 0.3 * np.sin(0.4 * np.asarray(s) - 2 * np.pi * 1.5 * 0.7 + 0.2)
    assert np.abs(WAVE(t, s, length) - expected).max() < 1e-15
    # cos(pi s/L) sin(2 pi f t) alone, then its place in the table.
    series = FourierCurvature(np.zeros((2, 2)), [[0.0, 0.0], [0.0, 0.9]], 0.7)
    expected = 0.9 * np.cos(np.pi * np.asarray(s / length)) * np.sin(2 * np.pi * 0.7 * 0.7)
    assert np.abs(series(t, s, length) - expected).max() < 1e-15


def test_preferred_curvature_is_the_shape_at_rest():
    # A frozen wave is an intrinsic curvature: the chain relaxes to it.
    chain = Chain(1.0, 8)
    wave = TravellingWave(0.15, 0.4, 0.0, 0.9)
    scene = Scene(chain, 1.0, constraints=[Gears()], forces=[Bending(20.0, wave)])
    end = rollout(scene, straight(chain, [1.0, 0.0]), [0.0, 1200.0], substeps=1600).final.position
    wanted = wave(T0, chain.arclength[1:-1], chain.length[np.zeros(6, int)])
    assert np.abs(jb.observables.curvature(end, chain) - wanted).max() < 1e-8
    # In space about both axes of the material, not in a plane, from frames of its own.
    waves = TravellingWave(0.1, 0.4, 0.0, 0.9), TravellingWave(0.08, 0.4, 0.0, 2.0)
    rod = ElasticRod(20.0, 15.0, None, *waves)
    scene = Scene(chain, 1.0, constraints=[Gears()], forces=[rod])
    start = straight(chain, [1.0, 0.0, 0.0])
    end = rollout(scene, start, [0.0, 1200.0], solver=jb.Rosenbrock(tolerance=1e-9)).final
    wanted = [w(T0, chain.arclength[1:-1], chain.length[np.zeros(6, int)]) for w in waves]
    assert np.abs(material.curvature(end, chain) - np.stack(wanted, axis=1)).max() < 1e-8
    assert np.abs(material.twist(end, chain)).max() < 1e-8


@pytest.mark.parametrize("dim", [2, 3])
def test_driving_moments_are_those_of_a_preferred_curvature(dim):
    chain = Chain(np.linspace(0.9, 1.2, 9), (5, 4))
    state = bent(chain, dim, centre=[[0.0] * dim, [9.0] * dim])
    rigidity = 20.0

    def wave(t, s, length):
        value = WAVE(t, s, length)
        return value if dim == 2 else value[:, None] * np.array([[0.6, 0.0, 0.8]])

    def moment(t, s, length):
        return rigidity * wave(t, s, length)

    def torque(force):
        return force.load(jnp.asarray(0.4), state, Setting(chain, 1.0)).torque

    driven = torque(DrivingMoment(moment))
    difference = torque(Bending(rigidity, wave)) - torque(Bending(rigidity))
    assert np.abs(np.asarray(driven - difference)).max() < 1e-13
    assert np.abs(driven).max() > 1


def test_turned_is_the_smallest_rotation():
    rng = np.random.default_rng(3)
    a, b = (jb.geometry.unit(jnp.asarray(rng.normal(size=(50, 3)))) for _ in range(2))
    v = jnp.asarray(rng.normal(size=(50, 3)))
    assert np.abs(turned(a, a, b) - b).max() < 1e-13
    normal = jnp.cross(a, b)
    assert np.abs(turned(normal, a, b) - normal).max() < 1e-12
    assert np.abs(jb.geometry.norm(turned(v, a, b)) - jb.geometry.norm(v)).max() < 1e-12
    assert np.all(np.isfinite(turned(v, a, -a)))


def test_follower_force_turns_with_the_fibre():
    chain = Chain(1.0, 5)
    state = bent(chain)
    e = np.asarray(tangents(state.position))
    load = np.asarray(Follower(0.7).load(T0, state, Setting(chain, 1.0)).force)
    assert np.allclose(load[-1], -0.7 * e[-1]) and not load[:-1].any()
    load = np.asarray(Follower(0.7, end=0).load(T0, state, Setting(chain, 1.0)).force)
    assert np.allclose(load[0], 0.7 * e[0]) and not load[1:].any()


def test_arms_follow_their_law():
    chain = Chain(1.0, (3, 2))

    def law(t):
        return jnp.stack([5 + jnp.sin(t), 6 + jnp.cos(t), 0.0 * t, 4 + 0.5 * t])

    scene = Scene(chain, 1.0, constraints=[PrescribedLengths(law)])
    x = [[0.0, 0.0], [5.0, 0.0], [12.0, 0.0], [0.0, 9.0], [4.0, 9.0]]
    end = rollout(scene, State(jnp.array(x)), [0.0, 1.0], substeps=100).final.position
    wanted = [5 + np.sin(1), 6 + np.cos(1), 4.5]
    assert np.abs(np.asarray(jb.geometry.bond_lengths(end))[[0, 1, 3]] - wanted).max() < 1e-6


# Contact


def test_contact_forces_by_hand():
    # Beads 0-2 are one fibre folded so that 0 and 2 are close, 3 is another close to 2.
    chain = Chain(1.0, (3, 1))
    x = jnp.array([[0.0, 0.0], [1.0, 2.0], [2.1, 0.0], [4.05, 0.0]])
    force = np.asarray(Contact(2.0, 0.2, 0.1).load(T0, State(x), Setting(chain, 1.0)).force)
    near, over = 2 * (0.5 - 0.1 / 0.4), 2 * (0.5 + 0.05 / 0.4)
    assert np.allclose(force, [[-near, 0], [0, 0], [near - over, 0], [over, 0]], atol=1e-13)
    assert np.abs(force.sum(axis=0)).max() < 1e-14


def test_contact_is_finite_where_beads_coincide():
    chain = Chain(1.0, (3, 3))
    crossed = straight(chain, np.eye(2))

    def size(position):
        return jnp.sum(
            Contact(2.0, 0.2, 0.1).load(T0, State(position), Setting(chain, 1.0)).force ** 2
        )

    value, slope = jax.value_and_grad(size)(crossed.position)
    assert np.isfinite(value) and np.all(np.isfinite(slope))


@pytest.mark.parametrize("contact", [True, False])
def test_contact_keeps_fibres_apart(contact):
    # Two parallel fibres are pushed together; without contact they pass into one another.
    chain = Chain(1.0, (4, 4))
    push = np.repeat([[0.0, 1.0], [0.0, -1.0]], 4, axis=0)
    forces = [Bending(20.0), Weight(push)] + [Contact(5.0, 0.1, 0.05)] * contact
    scene = Scene(chain, 1.0, constraints=[Gears()], forces=forces)
    state = straight(chain, [1.0, 0.0], [[0.0, -2.0], [0.0, 2.0]])
    ts = np.linspace(0, 60, 31)
    x = np.asarray(rollout(scene, state, ts, substeps=75).states.position)
    smallest = np.linalg.norm(x[:, :4, None] - x[:, None, 4:], axis=3).min()
    assert (smallest > 1.95) == contact


def test_absent_terms_cost_nothing():
    chain = Chain(1.0, 6)
    state = straight(chain, [1.0, 0.0])

    def size(scene):
        lowered = eqx.filter_jit(dynamics.motion).lower(0.0, state, scene)
        return lowered.as_text().count("\n")

    plain = Scene(chain, 1.0, constraints=[Gears()], forces=[Bending(1.0)])
    touching = Scene(
        chain, 1.0, constraints=[Gears()], forces=[Bending(1.0), Contact(1.0, 0.1, 0.1)]
    )
    spinless = Scene(chain, 1.0, constraints=[Inextensible()], forces=[BendingEnergy(1.0)])
    assert size(touching) > size(plain) + 20
    assert not spinless.rotational
    operator = FreeDraining().operator(plain.configuration(state, False))
    assert operator.motion(jb.Load(force=state.position)).spin is None
