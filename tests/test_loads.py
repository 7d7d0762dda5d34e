"""Loads on held ends, by constraints, along fibres and by the fluid: against cases known by hand."""

import dataclasses
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent, in_units, jointed, spatial

import jaxbeads as jb
from jaxbeads import Chain, Scene, State, dynamics, observables, straight
from jaxbeads.actuation import TravellingWave
from jaxbeads.constraint import (
    EqualSpins,
    FrozenJoints,
    Gears,
    Inextensible,
    Joint,
    PrescribedPosition,
    PrescribedSpin,
    clamped,
    hinged,
)
from jaxbeads.flow import Shear
from jaxbeads.force import (
    Bending,
    BendingEnergy,
    DrivingMoment,
    JointBending,
    Potential,
    SineRuleCurvature,
    Spring,
    Weight,
)
from jaxbeads.mobility import FreeDraining
from jaxbeads.scenes import planar_beating

MU, W = 1.3, 0.7
CHAIN = Chain([1.0, 1.2, 0.9, 1.0, 1.1, 1.0], 6)


def hanging(dim=2, constraint=None, **options):
    """A fibre that hangs at rest from its first bead, along gravity."""
    down = -np.eye(dim)[1]
    terms = {"constraints": [constraint or Gears(), *hinged()], "forces": [Weight(W * down)]}
    return straight(CHAIN, down, np.ones(dim)), Scene(CHAIN, MU, **terms, **options)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("constraint", [Gears(), Inextensible()], ids=lambda c: type(c).__name__)
def test_a_fibre_that_hangs_at_rest(constraint, dim):
    state, scene = hanging(dim, constraint)
    up, below = np.eye(dim)[1], W * np.arange(5, 0, -1)
    assert np.abs(observables.tension(0.0, state, scene) - below).max() < 1e-13
    force, moment = observables.stress_resultants(0.0, state, scene)
    assert np.abs(force + below[:, None] * up).max() < 1e-13 and np.abs(moment).max() < 1e-13
    assert np.abs(observables.shear_force(0.0, state, scene)).max() < 1e-13
    held, torque = observables.holding_load(0.0, state, scene)
    assert np.abs(held - 6 * W * up).max() < 1e-13 and np.abs(torque).max() < 1e-13
    drag = observables.drag(0.0, state, scene)
    assert np.abs(drag.force).max() < 1e-13
    loads = observables.constraint_loads(0.0, state, scene)
    assert list(loads) == [type(constraint).__name__, "PrescribedPosition(bead=0)"]
    holder = np.asarray(loads["PrescribedPosition(bead=0)"].force)
    assert np.abs(holder[0] - 6 * W * up).max() < 1e-13 and not np.any(holder[1:])


def test_a_rope_that_is_dragged():
    # Free draining, towed along itself at a speed: each bond pulls all the drag behind it.
    chain, speed = Chain(1.0, 5), 0.3
    tow = PrescribedPosition(lambda t: jnp.stack([-speed * t, 0.0 * t]))
    scene = Scene(chain, MU, FreeDraining(), [Gears(), tow])
    state, gamma = straight(chain, [1.0, 0.0]), 6 * np.pi * MU * speed
    assert (
        np.abs(observables.tension(0.0, state, scene) / gamma - np.arange(4, 0, -1)).max() < 1e-12
    )
    held, _ = observables.holding_load(0.0, state, scene)
    assert np.abs(held / gamma - np.array([-5, 0])).max() < 1e-12
    drag = observables.drag(0.0, state, scene)
    assert np.abs(drag.force / gamma - np.array([[1, 0]])).max() < 1e-12  # against the motion


@pytest.mark.parametrize("rigid", [EqualSpins(), FrozenJoints()], ids=lambda c: type(c).__name__)
def test_a_beam_that_is_clamped(rigid):
    # A rigid rod that its first bead holds against weights across it, at rest: statics of beams.
    chain = Chain(1.0, 6)
    by_bond = isinstance(rigid, FrozenJoints)
    held = clamped(spinless=True) if by_bond else (*hinged(), PrescribedSpin())
    constraints = [Gears(), rigid, *held]
    scene = Scene(chain, MU, constraints=constraints, forces=[Weight([0.0, -W])])
    state = straight(chain, [1.0, 0.0])
    assert dynamics.redundancy(0.0, state, scene) is None
    force, torque = observables.holding_load(0.0, state, scene)
    x = 2.0 * np.arange(6)
    assert (
        np.abs(force - np.array([0, 6 * W])).max() < 1e-12 and abs(torque[0] - W * x.sum()) < 1e-11
    )
    assert np.abs(observables.tension(0.0, state, scene)).max() < 1e-12
    # A clamp that holds the first bond exerts its couple within it.
    first = 1 if by_bond else 0
    shear = np.asarray(observables.shear_force(0.0, state, scene))[first:]
    by_hand = np.stack([np.zeros(5), -W * np.arange(5, 0, -1)], axis=1)[first:]
    assert np.abs(shear - by_hand).max() < 1e-12
    moment = np.asarray(observables.bending_moment(0.0, state, scene))[first:, 0]
    by_hand = [-W * sum(x[j] - (x[k] + 1) for j in range(k + 1, 6)) for k in range(5)][first:]
    assert np.abs(moment - by_hand).max() < 1e-11


def circle(chain, turn, dim=2):
    angle = turn * np.arange(chain.beads - 1)
    flat = State(jb.from_tangents(chain, np.stack([np.cos(angle), np.sin(angle)], 1)))
    return flat if dim == 2 else spatial(flat)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("model", ["Gears", "Joint", "Inextensible"])
def test_the_moment_of_a_circle(model, dim):
    turn, rigidity = 0.2, 30.0
    chain = Chain(1.0, 8, 0.1 if model == "Joint" else 0.0)
    span = float(chain.bond_length[0])
    if model == "Joint":
        angle = turn * np.arange(8)
        p = np.stack([np.cos(angle), np.sin(angle), 0 * angle][:dim], axis=1)
        state = jb.from_directors(chain, p)
        forces = [JointBending(rigidity)]
        kappa = 2 * np.sin(turn / 2) / span
    else:
        state, kappa = circle(chain, turn, dim), np.sin(turn) / span
        forces = [Bending(rigidity) if model == "Gears" else BendingEnergy(rigidity)]
    constraint = {"Gears": Gears(), "Joint": Joint(), "Inextensible": Inextensible()}[model]
    scene = Scene(chain, MU, constraints=[constraint], forces=forces)
    moment = np.asarray(observables.bending_moment(0.0, state, scene))
    assert not np.any(moment[:, :-1])
    moment = moment[:, -1] / (rigidity * kappa)
    inner = moment[1:-1]
    if model == "Joint":
        assert np.abs(moment - 1).max() < 1e-12
    elif model == "Gears":  # half of the end bonds
        assert np.abs(inner - 1).max() < 1e-12 and np.abs(moment[[0, -1]] - 0.5).max() < 1e-12
    else:
        assert np.abs(inner - 1).max() < 0.05


@cache
def beating():
    case = planar_beating(6, 2.0)
    run = jb.rollout(case.scene, case.state, case.ts[:41], tolerance=1e-5)
    return case.scene, run


def test_thrust_is_minus_the_force_on_the_clamp():
    scene, run = beating()

    def held(t, state, scene):
        return observables.holding_load(t, state, scene)[0]

    mean = jb.objectives.mean_over_time(held, run, scene)
    for direction in ([-1.0, 0.0], [0.0, 1.0]):
        thrust = jb.objectives.thrust(run, scene, jnp.asarray(direction))
        assert abs(thrust + mean @ jnp.asarray(direction)) < 1e-12 * np.abs(mean).max()
    # All drag on the filament and the holder's load balance, force and torque.
    state = run.final
    force, torque = observables.holding_load(run.ts[-1], state, scene)
    drag = observables.drag(run.ts[-1], state, scene)
    whole, turn = observables.net_load(drag, state, state.position[0])
    assert np.abs(whole + force).max() < 1e-11 * np.abs(force).max()
    assert np.abs(turn + torque).max() < 1e-11 * np.abs(torque).max()


@pytest.mark.parametrize("dim", [2, 3])
def test_a_free_swimmer_has_no_load_in_all(dim):
    chain = Chain(1.0, 7)
    forces = [Bending(20.0, TravellingWave(0.2, 0.5, 1.0)), DrivingMoment(0.3)]
    scene = Scene(chain, MU, constraints=[Gears()], forces=forces)
    state = bent(chain, dim)
    load = observables.load_on_fluid(0.2, state, scene)
    size = np.abs(load.force).max()
    for part in (load, observables.constraint_loads(0.2, state, scene)["Gears"]):
        force, torque = observables.net_load(part, state, np.ones(dim))
        assert np.abs(force).max() < 1e-13 * size
        if part is load:
            assert np.abs(torque).max() < 1e-12 * size
    total = dynamics.constraint_load(0.2, state, scene)
    assert (
        np.abs(observables.constraint_loads(0.2, state, scene)["Gears"].torque - total.torque).max()
        == 0
    )
    drag = observables.drag(0.2, state, scene)
    moved = dynamics.motion(0.2, state, scene)
    lost = -jnp.sum(drag.force * moved.velocity) - jnp.sum(drag.torque * moved.spin)
    assert abs(lost / observables.power(0.2, state, scene) - 1) < 1e-13
    # Cut anywhere, what the parts exert on one another balances drag on one of them.
    force, moment = observables.stress_resultants(0.2, state, scene)
    before = np.cumsum(drag.force, axis=0)[:-1]
    assert np.abs(force + before).max() < 1e-12 * size
    contact = state.position[2] + (state.position[3] - state.position[2]) / 2
    part = jb.Load(
        drag.force * (np.arange(7) < 3)[:, None], drag.torque * (np.arange(7) < 3)[:, None]
    )
    turned = observables.net_load(part, state, contact)[1]
    assert np.abs(moment[2] + turned).max() < 1e-12 * size


def test_fibres_are_cut_each_for_itself():
    one, two = Chain(1.0, 4), Chain(1.0, (4, 4))
    terms = {"forces": [Weight([0.0, -W]), Bending(30.0)]}
    held = [*hinged(0), *hinged(4)]
    state = straight(two, [0.0, -1.0], [[0.0, 0.0], [1e4, 3e4]])
    scene = Scene(two, MU, FreeDraining(), [Gears(), *held], **terms)
    found = observables.tension(0.0, state, scene)
    expected = observables.tension(
        0.0,
        straight(one, [0.0, -1.0]),
        Scene(one, MU, FreeDraining(), [Gears(), *hinged()], **terms),
    )
    assert np.abs(found - jnp.concatenate([expected, jnp.zeros(1), expected])).max() < 1e-12
    force, _ = observables.holding_load(0.0, state, scene, 4)
    assert np.abs(force - np.array([0, 4 * W])).max() < 1e-12


@pytest.mark.parametrize("law", [None, SineRuleCurvature()], ids=["cross", "sine"])
def test_elastic_energy_is_what_is_dissipated(law):
    # A bent fibre that relaxes: the work on the fluid is what its energy loses.
    chain, state = Chain(1.0, 6), bent(Chain(1.0, 6))
    bending = Bending(30.0, 0.02) if law is None else Bending(30.0, 0.02, law)
    scene = Scene(chain, MU, constraints=[Gears()], forces=[bending])

    def energy(x):
        return observables.elastic_energy(0.0, State(x), scene)

    moved = dynamics.motion(0.0, state, scene).velocity
    _, rate = jax.jvp(energy, (state.position,), (moved,))
    assert abs(rate / observables.power(0.0, state, scene) + 1) < 1e-12
    other = BendingEnergy(30.0, 0.02) if law is None else BendingEnergy(30.0, 0.02, law)
    other = Scene(chain, MU, constraints=[Inextensible()], forces=[other])
    assert abs(observables.elastic_energy(0.0, state, other) / energy(state.position) - 1) < 1e-13


def test_energies_known_by_hand():
    chain = Chain(1.0, 5)
    stretched = State(straight(chain, [1.0, 0.0]).position * 1.1)
    forces = [Spring(3.0), Weight([0.0, -1.0]), Potential(lambda t, x: jnp.sum(x**2)), Bending(9.0)]
    scene = Scene(chain, MU, forces=forces)
    assert abs(observables.elastic_energy(0.0, stretched, scene) - 4 * 0.5 * 3.0 * 0.2**2) < 1e-12
    tension = observables.tension(0.0, stretched, scene)
    assert np.abs(tension - 3.0 * 0.2).max() < 1e-12
    own = Potential(lambda t, x: 2.5 + 0 * jnp.sum(x), links=True)
    assert observables.elastic_energy(0.0, stretched, Scene(chain, MU, forces=[own])) == 2.5
    arc = circle(chain, 0.2)
    scene = Scene(chain, MU, constraints=[Gears()], forces=[Bending(9.0), DrivingMoment(0.1)])
    expected = 3 * 9.0 / 2 * (1 - np.cos(0.2))
    assert abs(observables.elastic_energy(0.0, arc, scene) - expected) < 1e-12
    vectors = [Bending(9.0, jnp.zeros((3, 3)))]
    jointed_scene = Scene(chain, MU, constraints=[Joint()], forces=[JointBending(9.0)])
    with pytest.raises(
        ValueError, match=r"`scene.forces` must have energies, but JointBending has"
    ):
        observables.elastic_energy(0.0, jointed(chain), jointed_scene)
    with pytest.raises(
        ValueError, match=r"`Bending.intrinsic_curvature` must be one number for each"
    ):
        observables.elastic_energy(0.0, spatial(arc), Scene(chain, MU, forces=vectors))


def test_who_holds_nothing_is_refused():
    state, scene = hanging()
    with pytest.raises(ValueError, match="`bead` must be one that a constraint of the scene holds"):
        observables.holding_load(0.0, state, scene, -1)
    with pytest.raises(ValueError, match="`bead` must lie between -6 and 5, but it is 6"):
        observables.holding_load(0.0, state, scene, 6)


def test_constraints_of_one_name_are_told_apart():
    chain = Chain(1.0, 3)
    other = dataclasses.replace(PrescribedPosition(bead=0), bead=2)
    scene = Scene(chain, MU, constraints=[PrescribedPosition(), PrescribedPosition(), other])
    state = straight(chain, [1.0, 0.0])
    names = [f"PrescribedPosition(bead={k})" for k in (0, "0", 2)]
    names[1] += " 2"
    assert list(observables.constraint_loads(0.0, state, scene)) == names


def test_small_scenes():
    one = Scene(Chain(1.0, 1), MU, forces=[Weight([0.0, -1.0])])
    state = State([[0.0, 0.0]])
    assert observables.tension(0.0, state, one).shape == (0,)
    assert observables.bending_moment(0.0, state, one).shape == (0, 1)
    assert np.array_equal(observables.drag(0.0, state, one).force, [[0.0, 1.0]])
    held = Scene(Chain(1.0, 1), MU, constraints=hinged(), forces=[Weight([0.0, -1.0])])
    assert np.abs(observables.holding_load(0.0, state, held)[0] - np.array([0, 1.0])).max() < 1e-15


@pytest.mark.parametrize("units", [(1e-6, 1e-3, 1e-12), (3e4, 7e2, 5e6)], ids=["micro", "large"])
def test_units_and_transforms(units):
    scene = Scene(
        CHAIN,
        MU,
        constraints=[Gears(), *clamped()],
        forces=[Bending(30.0, 0.1), Weight([0.1, -W])],
        flow=Shear(0.3),
    )
    state = bent(CHAIN)

    @eqx.filter_jit
    def numbers(state, scene):
        return (
            observables.tension(0.0, state, scene),
            observables.bending_moment(0.0, state, scene),
            observables.holding_load(0.0, state, scene),
            observables.drag(0.0, state, scene).force,
            observables.elastic_energy(0.0, state, scene),
        )

    length, _, force = units
    one, two = numbers(state, scene), numbers(in_units(state, units), in_units(scene, units))
    scales = (force, force * length, (force, force * length), force, force * length)
    for a, b, unit in zip(*map(jax.tree.leaves, (one, two, scales)), strict=True):
        assert np.abs(b / unit - a).max() < 1e-9 * np.abs(a).max()
    if units[0] > 1:
        return

    def tension(x):
        return jnp.sum(observables.tension(0.0, State(x), scene) ** 2)

    along, h = np.random.default_rng(0).normal(size=state.position.shape), 1e-5
    compiled = jax.jit(tension)
    exact = jnp.sum(jax.jit(jax.grad(tension))(state.position) * along)
    ahead, behind = (compiled(state.position + s * h * along) for s in (1, -1))
    assert abs((ahead - behind) / (2 * h) / exact - 1) < 1e-5
