"""Constraints and loads at one instant: against dense linear algebra and conservation laws."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import (
    CONSTRAINTS,
    FLOWS,
    FORCES,
    MOBILITIES,
    bent,
    in_space,
    instant,
    jointed,
    name,
    scene,
    spatial,
)
from dense import dense_motion, flat

from jaxbeads import (
    Chain,
    Configuration,
    Load,
    Scene,
    Setting,
    State,
    dynamics,
    from_tangents,
    straight,
)
from jaxbeads.constraint import (
    AbstractConstraint,
    FrozenJoints,
    Gears,
    PrescribedPosition,
    PrescribedSpin,
    clamped,
)
from jaxbeads.flow import Shear
from jaxbeads.force import (
    Bending,
    BendingEnergy,
    CrossProductCurvature,
    ForceField,
    SineRuleCurvature,
    Weight,
)
from jaxbeads.mobility import RPY, AbstractMobility

RADII = [1.0, np.linspace(0.7, 1.2, 9)]
FIBRES = [9, (4, 5), (2, 1, 3, 3)]


# Every mobility in plane and space with each radius, and with each number of fibres.
@pytest.mark.parametrize(
    "dim, radius, fibres",
    [
        (2, RADII[0], FIBRES[0]),
        (2, RADII[1], FIBRES[1]),
        (2, RADII[0], FIBRES[2]),
        (3, RADII[1], FIBRES[0]),
        (3, RADII[0], FIBRES[1]),
        (3, RADII[1], FIBRES[2]),
    ],
    ids=lambda x: "unequal" if isinstance(x, np.ndarray) else str(x),
)
@pytest.mark.parametrize("mobility", [m for m in MOBILITIES if m.is_dense(9)], ids=name)
def test_matches_the_dense_saddle_point_system(mobility, dim, radius, fibres):
    chain = Chain(radius, fibres)
    centre = 6.0 * np.arange(len(chain.fibres))[:, None] * np.eye(dim)[1]
    state = bent(chain, dim, centre=centre)
    model = scene(chain, dim, mobility=mobility)
    moved = flat(jax.jit(dynamics.motion)(0.3, state, model))
    reference = dense_motion(0.3, state, model)
    assert np.abs(moved - reference).max() < 1e-12 * np.abs(reference).max()


LAWS = CrossProductCurvature(), SineRuleCurvature()
PAIRS = [(force, FLOWS[0]) for force in FORCES if in_space(force) is not None]
PAIRS += [(BendingEnergy(30.0, 0.0, law), FLOWS[0]) for law in LAWS]
PAIRS += [(FORCES[0], flow) for flow in FLOWS[1:]]


@pytest.mark.parametrize("force, flow", PAIRS, ids=name)
def test_every_force_and_flow_in_plane_and_space(force, flow):
    # Gate of planar scenes: the same as in space, to rounding.
    chain = Chain(1.0, 7)
    state = bent(chain, seed=2)
    model = Scene(chain, 0.8, constraints=[Gears()], forces=[force], flow=flow)
    solid, deep = in_space(force), in_space(flow)
    whole = Scene(chain, 0.8, constraints=[Gears()], forces=[solid], flow=deep)
    plane, residual = instant(0.2, state, model)
    space = dynamics.motion(0.2, spatial(state), whole)
    scale = np.abs(plane.velocity).max()
    assert np.abs(plane.velocity - space.velocity[:, :2]).max() < 1e-13 * scale
    assert np.abs(plane.spin - space.spin[:, 2:]).max() < 1e-13 * np.abs(plane.spin).max()
    assert np.abs(space.velocity[:, 2]).max() < 1e-14 * scale
    assert float(residual) < 1e-14


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize("dim", [2, 3])
def test_the_chain_constraint_stands_anywhere(dim, place):
    # S, assembled and by columns, and the motion are the same in every order of the constraints.
    chain = Chain(np.linspace(0.8, 1.1, 8), (3, 5))
    state = bent(chain, dim)
    others = [PrescribedPosition(bead=0), PrescribedSpin(bead=6)]
    parts = [*others[:place], Gears(), *others[place:]]
    forces = [Weight([0.1, -1.0, 0.3][:dim]), Bending(3.0)]
    model = Scene(chain, 1.0, constraints=parts, forces=forces)
    operator = RPY().operator(model.configuration(state, True)).kept()
    j = dynamics.constraint_map(0.0, state, model)
    now, moved = jnp.zeros(()), dynamics.motion(0.0, state, model)
    sizes = [c.slip(now, state, moved, chain).size for c in parts]
    columns = np.stack([j.compliance(operator, jnp.asarray(u)) for u in np.eye(sum(sizes))], axis=1)
    direct = np.asarray(dynamics.constraint_matrix(0.0, state, model))
    # Every number of the others, and of the chain's those of bonds that there are.
    rows = [
        np.tile(chain.bond_mask, dim) if c.links else np.ones(n, bool)
        for c, n in zip(parts, sizes, strict=True)
    ]
    live = np.concatenate(rows)
    assert np.abs((direct - columns)[np.ix_(live, live)]).max() < 1e-15
    first = Scene(chain, 1.0, constraints=[Gears(), *others], forces=forces)
    here, there = (dynamics.motion(0.0, state, m) for m in (model, first))
    assert np.abs(here.velocity - there.velocity).max() < 1e-13 * np.abs(there.velocity).max()
    assert float(dynamics.constraint_residual(0.0, state, model)) < 1e-14


@pytest.mark.parametrize("fibres", [8, (3, 5)], ids=str)
@pytest.mark.parametrize("dim", [2, 3])
def test_direct_assembly_equals_assembly_by_columns(dim, fibres):
    # S built from slices of M against S built by applying M to unit multipliers.
    chain = Chain(np.linspace(0.8, 1.1, 8), fibres)
    state = bent(chain, dim)
    model = scene(chain, dim)
    operator = RPY().operator(model.configuration(state, True)).kept()
    parts = dynamics.constraint_map(0.0, state, model)
    rows = dim * 7
    columns = np.stack([parts.compliance(operator, jnp.asarray(u)) for u in np.eye(rows)], axis=1)
    direct = np.asarray(dynamics.constraint_matrix(0.0, state, model))
    live = np.tile(chain.bond_mask, dim)
    assert np.abs((direct - columns)[np.ix_(live, live)]).max() < 1e-15
    assert np.all(direct[np.ix_(live, ~live)] == 0)
    # The condition number of a free straight planar chain is known (5.6 at N = 5).
    model = Scene(Chain(1.0, 5), 1.0, constraints=[Gears()])
    values = np.linalg.eigvalsh(
        dynamics.constraint_matrix(0.0, straight(model.chain, [1.0, 0.0]), model)
    )
    assert abs(values[-1] / values[0] - 5.6) < 0.1


@pytest.mark.parametrize("dim", [2, 3])
def test_instants_side_by_side_with_a_radius_for_each_bead(dim):
    # Under `vmap` of what is jitted no rule may hold on to the numbers of a chain.
    chain = Chain(np.linspace(0.7, 1.2, 5), 5)
    model, states = scene(chain, dim), [bent(chain, dim, seed) for seed in (0, 1)]
    both = jax.tree.map(lambda *x: jnp.stack(x), *states)
    found = jax.vmap(lambda state: dynamics.motion(0.0, state, model).velocity)(both)
    alone = [dynamics.motion(0.0, state, model).velocity for state in states]
    assert np.allclose(found, jnp.stack(alone), rtol=0, atol=1e-13)


@pytest.mark.parametrize("law", [None, SineRuleCurvature()], ids=["(34)", "(33)"])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("radius", RADII, ids=["equal", "unequal"])
def test_bending_torques_and_energy_move_beads_alike(radius, dim, law):
    # Virtual work: proof of the factor 1/2 that eq. (32) lacks, and of its form for unequal radii.
    chain = Chain(radius, 9)
    state = bent(chain, dim)
    options = {} if law is None else {"discrete_curvature": law}
    rigidity = np.linspace(10, 40, 7)
    curvature = np.linspace(-0.1, 0.2, 7) if dim == 2 else 0.05
    torques = Scene(
        chain, 1.0, constraints=[Gears()], forces=[Bending(rigidity, curvature, **options)]
    )
    energy = Scene(
        chain, 1.0, constraints=[Gears()], forces=[BendingEnergy(rigidity, curvature, **options)]
    )
    a, b = (np.asarray(dynamics.motion(0.0, state, s).velocity) for s in (torques, energy))
    assert np.abs(a - b).max() < 2e-12 * np.abs(a).max()


@pytest.mark.parametrize("dim", [2, 3])
def test_constraint_and_internal_loads_balance(dim):
    # Gate T4: a free body's internal forces and torques sum to zero, 1e-12 of the largest.
    chain = Chain(1.0, (4, 6))
    state = bent(chain, dim, centre=[[0.0] * dim, [7.0] * dim])
    model = scene(chain, dim)
    bending = Bending(30.0).load(jnp.zeros(()), state, Setting(chain, 1.0))
    assert np.abs(np.sum(bending.torque, axis=0)).max() < 1e-12 * np.abs(bending.torque).max()
    for load in (
        dynamics.constraint_load(0.0, state, model),
        BendingEnergy(30.0).load(jnp.zeros(()), state, Setting(chain, 1.0)),
    ):
        force = np.asarray(load.force)
        assert np.abs(force.sum(0)).max() < 1e-12 * np.abs(force).max()
        arm = np.asarray(state.position)
        arm, push = (np.pad(x, ((0, 0), (0, 3 - dim))) for x in (arm, force))
        total = np.cross(arm, push).sum(0)
        if load.torque is not None:
            torque = np.asarray(load.torque).sum(0)
            total = total[2:] + torque if dim == 2 else total + torque
        assert np.abs(total).max() < 1e-12 * np.abs(np.cross(arm, push)).max()


class Driven(AbstractConstraint):
    """A user's constraint: the first bead's velocity and the second's spin follow a law of time."""

    rotational: ClassVar[bool] = True
    speed: jax.Array

    def slip(self, t, state, motion, chain):
        velocity = motion.velocity[0] - self.speed * jnp.sin(t)
        return jnp.concatenate([velocity, motion.spin[1] - jnp.cos(t)])


@pytest.mark.parametrize("dim", [2, 3])
def test_a_users_affine_constraint(dim):
    chain = Chain(1.0, 7)
    state = bent(chain, dim)
    model = scene(chain, dim, constraints=[Gears(), Driven(jnp.arange(1.0, dim + 1))])
    moved = dynamics.motion(0.4, state, model)
    assert np.abs(moved.velocity[0] - np.sin(0.4) * np.arange(1, dim + 1)).max() < 1e-13
    assert np.abs(moved.spin[1] - np.cos(0.4)).max() < 1e-13
    reference = dense_motion(0.4, state, model)
    assert np.abs(flat(moved) - reference).max() < 1e-11 * np.abs(reference).max()
    swapped = scene(chain, dim, constraints=[Driven(jnp.arange(1.0, dim + 1)), Gears()])
    assert np.abs(flat(dynamics.motion(0.4, state, swapped)) - flat(moved)).max() < 1e-12


class Slow(AbstractMobility):
    """A user's mobility: RPY at half speed, of which only the product with loads is known."""

    def motion(self, configuration, load):
        slow = eqx.tree_at(lambda c: c.viscosity, configuration, 2 * configuration.viscosity)
        return RPY().motion(slow, load)

    def disturbance(self, configuration, strain_rate):
        return RPY().disturbance(configuration, strain_rate)


def test_a_users_mobility_without_pair_tensor():
    chain = Chain(1.0, (4, 5))
    state = bent(chain, centre=[[0.0, 0.0], [3.0, 5.0]])
    ours = scene(chain, flow=False, mobility=Slow(), constraints=[Gears()])
    direct = scene(chain, flow=False, constraints=[Gears()])
    slow, fast = (dynamics.motion(0.0, state, s) for s in (ours, direct))
    assert np.abs(2 * slow.velocity - fast.velocity).max() < 1e-13 * np.abs(fast.velocity).max()


@pytest.mark.parametrize("constraints", CONSTRAINTS, ids=name)
def test_constraints_hold(constraints):
    chain = Chain(1.0, (5, 4))
    for dim in (2,) if any(c.planar for c in constraints) else (2, 3):
        centre = [[0.0] * dim, [0.0, 6.0, *[0.0] * (dim - 2)]]
        oriented = any(c.oriented for c in constraints)
        state = (jointed if oriented else bent)(chain, dim, centre=centre)
        model = scene(chain, dim, constraints=constraints)
        moved, residual = instant(0.3, state, model)
        assert float(residual) < 1e-13
        reference, moved = dense_motion(0.3, state, model), flat(moved)
        assert np.abs(moved - reference).max() < 1e-11 * np.abs(reference).max()


def test_fibres_far_apart_do_not_feel_one_another():
    one, two = Chain(1.0, 5), Chain(1.0, (5, 5))
    single = bent(one)
    pair = State(jnp.concatenate([single.position, single.position + np.array([[0.0, 1e7]])]))
    a = dynamics.motion(0.0, single, scene(one, flow=False)).velocity
    b = dynamics.motion(0.0, pair, scene(two, flow=False)).velocity
    assert np.abs(b[:5] - a).max() < 1e-6 * np.abs(a).max()
    near = State(jnp.concatenate([single.position, single.position + np.array([[0.0, 9.0]])]))
    c = dynamics.motion(0.0, near, scene(two, flow=False)).velocity
    assert np.abs(c[:5] - a).max() > 1e-2 * np.abs(a).max()


def test_single_beads_and_pairs_run():
    for fibres in (1, 2, (1, 1)):
        chain = Chain(1.0, fibres)
        state = State(3.0 * jnp.stack([jnp.arange(chain.beads), jnp.zeros(chain.beads)], axis=1))
        if fibres == 2:
            state = straight(chain, [1.0, 0.0])
        constraints = [Gears()] if chain.beads > 1 else []
        model = Scene(
            chain, 1.0, constraints=constraints, forces=[Weight([0.0, -1.0]), Bending(1.0)]
        )
        assert np.all(np.isfinite(dynamics.motion(0.0, state, model).velocity))


def test_the_residual_of_a_fibre_held_at_rest():
    # Its velocities are rounding, and so is the residual: neither is large beside what is held.
    chain = Chain(1.0, 6)
    scene = Scene(
        chain, 1.0, constraints=[Gears(), *clamped()], forces=[Bending(1e3), Weight([1.0, 0.0])]
    )
    state = straight(chain, [1.0, 0.0])
    assert np.abs(dynamics.motion(0.0, state, scene).velocity).max() < 1e-13
    assert float(dynamics.constraint_residual(0.0, state, scene)) < 1e-13


def singular(shape, dim):
    """Chains at the places where careless derivatives are NaN."""
    if shape == "crossed":  # two fibres; their middle beads coincide
        chain = Chain(1.0, (3, 3))
        return chain, straight(chain, np.eye(dim)[[0, 1]])
    chain = Chain(1.0, 6)
    if shape == "bent":
        return chain, bent(chain, dim)
    turn = np.where(np.arange(5) > 2, 0.95 * np.pi if shape == "folded" else 0.0, 0.0)
    e = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return chain, State(from_tangents(chain, np.pad(e, ((0, 0), (0, dim - 2)))))


def weighted_velocity(state, model, weight):
    return jnp.sum(weight * dynamics.motion(0.1, state, model).velocity)


# One compiled program for all shapes.
VALUE = jax.jit(weighted_velocity)
REVERSE = jax.jit(jax.grad(weighted_velocity, argnums=(0, 1)))
FORWARD = jax.jit(
    lambda at, along, weight: jax.jvp(lambda s, m: weighted_velocity(s, m, weight), at, along)[1]
)


@pytest.mark.parametrize("shape", ["bent", "straight", "folded", "crossed"])
@pytest.mark.parametrize("dim", [2, 3])
def test_derivatives_of_the_motion(shape, dim):
    # With respect to every parameter and position, in both modes.
    chain, state = singular(shape, dim)
    model = scene(chain, dim)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(6, dim)))
    reverse = REVERSE(state, model, weight)
    flat_reverse = np.concatenate([np.ravel(x) for x in jax.tree.leaves(reverse)])
    assert np.all(np.isfinite(flat_reverse))
    leaves, tree = jax.tree.flatten((state, model))
    rng = np.random.default_rng(1)
    direction = [jnp.asarray(rng.normal(size=np.shape(x))) for x in leaves]
    if dim == 3:  # its direction is that of the binormal, which a straight joint does not have
        at = next(i for i, x in enumerate(leaves) if x is model.forces[1].intrinsic_curvature)
        direction[at] = jnp.zeros(())
    along = jax.tree.unflatten(tree, direction)
    forward = FORWARD((state, model), along, weight)
    dot = sum(
        float(jnp.sum(a * b)) for a, b in zip(direction, jax.tree.leaves(reverse), strict=True)
    )
    assert abs(forward - dot) < 1e-10 * abs(dot)
    if shape != "crossed":  # there the mobility has a kink
        # Touching beads sit where second derivatives jump: the error is of first order in h, which
        # two steps cancel.
        h = 2e-7

        def at(step):
            moved = [x + step * d for x, d in zip(leaves, direction, strict=True)]
            return float(VALUE(*jax.tree.unflatten(tree, moved), weight))

        coarse, fine = (at(2 * h) - at(-2 * h)) / (4 * h), (at(h) - at(-h)) / (2 * h)
        assert abs(2 * fine - coarse - dot) < 1e-6 * abs(dot)


def test_a_scene_pays_only_for_what_it_models():
    chain = Chain(1.0, 8)

    def size(function, *arguments):
        return jax.jit(function).lower(*arguments).as_text().count("\n")

    state, solid = bent(chain), bent(chain, 3)
    bare = scene(chain, flow=False)

    def by_hand(state, radius, gap, viscosity, weight, rigidity, curvature):
        spheres, t = Configuration(state.position, radius, viscosity), jnp.zeros(())
        operator = RPY().operator(spheres).kept()
        held = Scene(Chain(radius, 8, gap), viscosity, constraints=[Gears()])
        weight, bending = Weight(weight), Bending(rigidity, curvature)
        torque = bending.load(t, state, held).torque
        load = Load(weight.load(t, state, held).force, torque)
        free = operator.motion(load)
        parts = dynamics.constraint_map(0.0, state, held)
        matrix = Gears().assemble(t, state, operator, held.chain).T
        factor = jax.lax.linalg.cholesky(matrix, symmetrize_input=False)
        pivot = jnp.diagonal(factor) ** 2 / jnp.diagonal(matrix)  # nor without this guard
        rhs = jnp.where(jnp.min(pivot, initial=1.0) > 3e-14, -parts.slip(free), jnp.nan)
        lam = jax.scipy.linalg.cho_solve((factor, True), rhs)
        push = operator.motion(parts.pull(lam))
        return free.velocity + push.velocity, free.spin + push.spin

    b, w = bare.forces[1], bare.forces[0]
    hand = size(
        by_hand,
        state,
        chain.radius,
        chain.gap,
        bare.viscosity,
        w.force,
        b.rigidity,
        b.intrinsic_curvature,
    )
    ours = size(dynamics.motion, 0.0, state, bare)
    assert ours <= hand + 40  # the linear solve's own wrapper; a flow adds hundreds
    assert size(dynamics.motion, 0.0, state, scene(chain)) > ours + 100
    assert size(dynamics.motion, 0.0, solid, scene(chain, 3, flow=False)) > 1.5 * ours

    def spinless(state):
        potential = BendingEnergy(30.0)
        return dynamics.motion(0.0, state, Scene(chain, 1.0, forces=[potential])).velocity

    def held(state):
        return dynamics.motion(0.0, state, bare).velocity

    text = [jax.jit(f).lower(state).as_text() for f in (spinless, held)]
    assert ["potrf" in x for x in text] == [False, True]
    assert not Scene(
        chain, 1.0, forces=[BendingEnergy(30.0), ForceField(lambda t, x: x)]
    ).rotational
    assert Scene(chain, 1.0, constraints=[FrozenJoints(), Gears()], flow=Shear(1.0)).rotational
