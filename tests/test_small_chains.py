"""Chains of one bead and of two, and fibres of these among longer ones: no joint, no load, no limit."""

import jax.numpy as jnp
import numpy as np
import pytest
from cases import FLOWS, MOBILITIES, name

from jaxbeads import (
    AB3,
    Chain,
    Scene,
    Setting,
    State,
    check,
    dynamics,
    objectives,
    observables,
    plot,
    rollout,
    simulate,
    steady_state,
    straight,
)
from jaxbeads.actuation import FourierCurvature, TravellingWave
from jaxbeads.constraint import (
    EqualSpins,
    FrozenJoints,
    Gears,
    Inextensible,
    Joint,
    PrescribedLengths,
    PrescribedPosition,
    PrescribedSpin,
)
from jaxbeads.flow import Shear
from jaxbeads.force import (
    Bending,
    BendingEnergy,
    Contact,
    DrivingMoment,
    Follower,
    ForceField,
    JointBending,
    JointRepulsion,
    ParamagneticBeads,
    ParamagneticFibre,
    Potential,
    Spring,
    Weight,
)
from jaxbeads.mobility import FreeDraining

CASES = [(1, 2), (1, 3), (2, 2), ((1, 1), 2), ((1, 3), 2), ((3, 1, 2), 2), ((3, 1, 2), 3)]
SMALL = pytest.mark.parametrize("fibres, dim", CASES, ids=str)
FEW = pytest.mark.parametrize("fibres, dim", [(1, 2), (2, 3), ((3, 1, 2), 2)], ids=str)
T0, VISCOSITY = jnp.zeros(()), jnp.ones(())
WAVE = TravellingWave(0.2, 0.4, 1.5, 0.3)
SERIES = FourierCurvature([[0.1, 0.2]], [[0.0, 0.1]], 0.7)


def beside(fibres, dim, directors=False):
    """Straight fibres side by side."""
    chain = Chain(1.0, fibres)
    count, axes = len(chain.fibres), np.eye(dim)
    state = straight(chain, axes[0], 8.0 * np.arange(count)[:, None] * axes[1])
    if directors:
        state = State(state.position, jnp.broadcast_to(jnp.asarray(axes[0]), state.position.shape))
    return chain, state


def at_joints(chain):
    joints = max(chain.beads - 2, 0)
    return [
        Bending(np.zeros(joints)),
        Bending(np.full(joints, 3.0), np.full(joints, 0.1)),
        Bending(3.0, 0.1),
        Bending(3.0, WAVE),
        BendingEnergy(np.full(joints, 3.0)),
        BendingEnergy(3.0, SERIES),
        DrivingMoment(np.zeros(joints)),
        DrivingMoment(WAVE),
    ]


def anywhere(chain, dim):
    bonds = chain.beads - 1
    return [
        Spring(np.full(bonds, 2.0)),
        Contact(5.0, 0.1, 0.1),
        Weight(np.eye(dim)[1]),
        ForceField(lambda t, r: 0.1 * r),
        Potential(lambda t, r: jnp.sum(r**2)),
        ParamagneticFibre(np.full(bonds, 0.8), np.eye(dim)[1]),
        ParamagneticBeads(0.8, np.eye(dim)[1], permeability=5.0),
    ]


def linked(chain):
    bonds = chain.beads - 1
    return [
        JointBending(np.full(bonds, 3.0), repulsion=JointRepulsion(1.0)),
        JointBending(3.0, WAVE),
        JointBending(np.zeros(bonds), np.zeros(bonds)),
    ]


def every(load):
    return [x for x in (load.force, load.torque) if x is not None]


@SMALL
def test_forces_act_where_there_is_something_to_act_on(fibres, dim):
    chain, state = beside(fibres, dim)
    scene = Setting(chain, VISCOSITY)
    there_are_joints = any(n > 2 for n in chain.fibres)
    for k, force in enumerate([*at_joints(chain), *anywhere(chain, dim)]):
        Scene(chain, 1.0, constraints=[Gears()], forces=[force])
        force.check(chain, dim)
        loads, step = every(force.load(T0, state, scene)), force.explicit_step(scene)
        assert all(x.shape[0] == chain.beads and np.all(np.isfinite(x)) for x in loads)
        assert step > 0
        if k < len(at_joints(chain)) and not there_are_joints:
            assert not any(np.any(x) for x in loads) and np.isinf(step)
    chain, state = beside(fibres, dim, directors=True)
    for force in linked(chain):
        force.check(chain, dim)
        loads, step = every(force.load(T0, state, scene)), force.explicit_step(scene)
        assert all(x.shape[0] == chain.beads and np.all(np.isfinite(x)) for x in loads)
        if all(n == 1 for n in chain.fibres):
            assert not any(np.any(x) for x in loads) and np.isinf(step)


@SMALL
def test_limits_are_those_of_joints_and_bonds_that_exist(fibres, dim):
    # What is given for a place between two fibres has no effect on the step.
    chain, _ = beside(fibres, dim)
    setting = Setting(chain, VISCOSITY)
    rigid = np.where(chain.joint_mask, 3.0, 1e9)
    stiff = np.where(chain.bond_mask, 2.0, 1e9)
    for kind, numbers, one in (
        (Bending, rigid, 3.0),
        (BendingEnergy, rigid, 3.0),
        (JointBending, stiff, 2.0),
        (Spring, stiff, 2.0),
    ):
        each = kind(numbers).explicit_step(setting)
        assert each == kind(one).explicit_step(setting)


def constraints(chain, dim):
    bonds = chain.beads - 1
    together = [
        [Gears()],
        [Inextensible()],
        [Gears(), EqualSpins()],
        [EqualSpins()],
        [PrescribedPosition(lambda t: jnp.zeros(dim)), PrescribedSpin(bead=-1)],
        [PrescribedLengths(lambda t: 2 + 0.1 * jnp.sin(t + jnp.arange(bonds)))],
        [Gears(), PrescribedPosition()],
    ]
    return together + ([[Gears(), FrozenJoints()], [FrozenJoints()]] if dim == 2 else [])


@FEW
def test_constraints_hold_what_there_is_to_hold(fibres, dim):
    chain, state = beside(fibres, dim)
    for terms in constraints(chain, dim):
        scene = Scene(chain, 1.0, constraints=terms, forces=[Weight(np.eye(dim)[1])])
        check(scene, state)
        if dim == 2 and len(terms) == 1:
            assert dynamics.redundancy(0.0, state, scene) is None
        assert dynamics.constraint_residual(0.0, state, scene) < 1e-12
        assert np.max(np.abs(scene.bond_errors(state)), initial=0.0) < 1e-14


@pytest.mark.parametrize("fibres", [1, (1, 1)], ids=str)
@pytest.mark.parametrize("mobility", MOBILITIES, ids=name)
def test_single_beads_fall_by_stokes_law(fibres, mobility):
    chain, state = beside(fibres, 2)
    far = State(1e9 * state.position)
    scene = Scene(chain, 1.0, mobility, [Gears()], [Weight([0.0, -6 * np.pi]), Bending(1.0)])
    velocity = dynamics.motion(0.0, far, scene).velocity
    np.testing.assert_allclose(velocity, np.tile([0.0, -1.0], (chain.beads, 1)), atol=1e-8)


@pytest.mark.parametrize("flow", FLOWS, ids=name)
def test_flows_carry_single_beads(flow):
    scene = Scene(Chain(1.0, 1), 1.0, constraints=[Gears()], flow=flow)
    assert np.all(np.isfinite(dynamics.motion(0.3, State([[0.4, 0.7]]), scene).velocity))


# The solver by default, adaptive; that without stiff forces; equal steps.
RUNS = {"stiff": (True, {}), "soft": (False, {}), "equal": (True, {"substeps": 10})}


@pytest.mark.parametrize(
    "fibres, dim, how",
    [
        (1, 2, "stiff"),
        (2, 3, "stiff"),
        ((3, 1, 2), 2, "stiff"),
        (2, 3, "soft"),
        (1, 2, "equal"),
    ],
    ids=str,
)
def test_they_run(fibres, dim, how):
    (stiff, options), (chain, state) = RUNS[how], beside(fibres, dim)
    joints = max(chain.beads - 2, 0)
    terms = [Weight(-6 * np.pi * np.eye(dim)[1]), *[Bending(np.zeros(joints))] * stiff]
    scene = Scene(chain, 1.0, FreeDraining(), [Gears()], terms)
    solution = simulate(scene, state, np.linspace(0, 0.2, 3), progress=False, **options)
    fallen = np.asarray(state.position) - 0.2 * np.eye(dim)[1]
    # A fibre falls like its beads, which feel nothing of one another.
    np.testing.assert_allclose(solution.final.position, fallen, atol=1e-9)
    assert solution.bond_length_error.max() < 1e-12


@pytest.mark.parametrize("fibres", [1, 2], ids=str)
def test_a_step_for_joints_that_are_not_there(fibres):
    chain, state = beside(fibres, 2)
    scene = Scene(chain, 1.0, constraints=[Gears()], forces=[Bending(1e9), Weight([0.0, -1.0])])
    with pytest.raises(ValueError, match="`substeps` must be given, but it is None"):
        rollout(scene, state, [0.0, 0.1], solver=AB3())


@pytest.mark.parametrize("fibres", [1, 2], ids=str)
def test_steady_states_of_them(fibres):
    chain, state = beside(fibres, 2)
    terms = [Weight([0.0, -1.0]), Bending(np.zeros(0))]
    found = steady_state(Scene(chain, 1.0, constraints=[Gears()], forces=terms), state)
    expected = observables.settling_velocity(
        0.0, state, Scene(chain, 1.0, constraints=[Gears()], forces=terms)
    )
    np.testing.assert_allclose(found.velocity, expected, atol=1e-12)


@SMALL
def test_what_is_measured_on_them(fibres, dim):
    chain, state = beside(fibres, dim)
    scene = Scene(
        chain, 1.0, FreeDraining(), [Gears()], [Weight(-6 * np.pi * np.eye(dim)[1])], Shear(0.0)
    )
    solution = rollout(scene, state, np.linspace(0, 0.1, 3), substeps=1)
    path, up = solution.states.position, np.eye(dim)[1]
    joints = max(chain.beads - 2, 0)
    assert observables.curvature(path, chain).shape == (3, joints)
    assert np.all(np.isinf(observables.minimal_radius_of_curvature(path, chain)))
    spans = 2.0 * (np.array(chain.fibres) - 1)
    np.testing.assert_allclose(
        observables.end_to_end_distance(path, chain), np.tile(spans, (3, 1)), atol=1e-12
    )
    assert observables.end_to_end_distance(path).shape == (3,)
    np.testing.assert_allclose(observables.tilt(path, up, chain), 0 * path[:, : len(spans), 0])
    np.testing.assert_allclose(observables.orientation(path, chain), 0 * spans + np.zeros((3, 1)))
    across = 8.0 * (len(spans) - 1)
    np.testing.assert_allclose(observables.deflection(path, up), across, atol=1e-12)
    assert observables.bond_length_error(path, chain).shape == (3, chain.beads - 1)
    np.testing.assert_allclose(observables.settling_velocity(0.0, state, scene), -up, atol=1e-12)
    power = 6 * np.pi * chain.beads
    assert abs(observables.power(0.0, state, scene) - power) < 1e-9
    assert abs(objectives.mean_power(solution, scene) - power) < 1e-9
    assert abs(objectives.distance(solution) - 0.1) < 1e-12
    assert objectives.shape_error(solution, path) == 0
    if len(spans) == 1:
        drag = 6 * np.pi * chain.beads  # power 1 tows at this speed squared over the drag
        assert abs(observables.swimming_efficiency(1.0, 1.0, scene) - drag) < 1e-9
    else:
        with pytest.raises(ValueError, match=r"`scene.chain` must be one fibre, but it"):
            observables.swimming_efficiency(1.0, 1.0, scene)
    assert plot.shapes(solution, chain).axes
    if chain.fibres[0] < 3:
        with pytest.raises(ValueError, match="`chain` must have at least three beads in its first"):
            plot.kymograph(solution, chain)
    else:
        assert plot.kymograph(solution, chain).axes


def test_each_fibre_is_measured_by_itself():
    chain = Chain(1.0, (3, 2))
    state = straight(chain, [[1.0, 0.0], [0.0, 1.0]], [[0.0, 0.0], [50.0, 0.0]])
    r = state.position
    np.testing.assert_allclose(observables.end_to_end_distance(r, chain), [4.0, 2.0])
    np.testing.assert_allclose(observables.tilt(r, [0.0, 2.0], chain), [0.0, 2.0])
    np.testing.assert_allclose(observables.orientation(r, chain), [0.0, np.pi / 2], atol=1e-12)
    assert observables.end_to_end_distance(r) > 50  # of all beads, taken as one


def test_joints_repel_by_the_rigidity_of_their_own_fibre():
    # F_0 = C_2 sqrt(K_b E_b / L^3), eqs (43)-(45), is a fibre's own.
    force = JointBending(5.0, 0.3, repulsion=JointRepulsion(0.0, 0.5, 1.0, 0.5))
    alone, one = beside(3, 2, directors=True)
    expected = force.load(T0, one, Setting(alone, 1.0))
    chain, both = beside((3, 3), 2, directors=True)
    numbers = np.array([5.0, 5.0, 7e6, 2e5, 1e5])
    mixed = JointBending(numbers, 0.3, repulsion=JointRepulsion(0.0, 0.5, 1.0, 0.5))
    found = mixed.load(T0, both, Setting(chain, 1.0))
    assert np.abs(expected.force).max() > 1e-3
    np.testing.assert_allclose(found.force[:3], expected.force, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(found.torque[:3], expected.torque, rtol=1e-12)


def test_a_bead_alone_is_carried_by_its_joint_scene():
    chain, state = beside(1, 2, directors=True)
    scene = Scene(
        chain,
        1.0,
        constraints=[Joint()],
        forces=[JointBending(np.zeros(0)), Weight([0.0, -6 * np.pi])],
    )
    solution = simulate(scene, state, np.linspace(0, 0.2, 3), progress=False)
    np.testing.assert_allclose(solution.final.position, [[0.0, -0.2]], atol=1e-12)


def test_a_follower_needs_a_bond():
    for fibres, end in ((1, 0), (1, -1), ((5, 1), -1), ((1, 5), 0), ((1, 1), -1)):
        chain, state = beside(fibres, 2)
        scene = Scene(chain, 1.0, constraints=[Gears()], forces=[Follower(1.0, end=end)])
        with pytest.raises(ValueError, match=r"`Follower.end` must be the end of a fibre of two"):
            simulate(scene, state, [0.0, 0.1], progress=False)
    for fibres, end in (((5, 1), 0), ((1, 5), -1), (2, 0)):
        chain, state = beside(fibres, 2)
        check(Scene(chain, 1.0, constraints=[Gears()], forces=[Follower(1.0, end=end)]), state)
