"""Scenes without an N x N array: iterations against factorisations, memory, what is refused."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent, jointed, scene

import jaxbeads as jb
from jaxbeads import (
    Chain,
    Configuration,
    Load,
    Scene,
    Setting,
    dynamics,
    neighbours,
    saddle,
    tensors,
)
from jaxbeads.constraint import (
    EqualSpins,
    Gears,
    Inextensible,
    Joint,
    PrescribedLengths,
    PrescribedPosition,
    clamped,
    hinged,
)
from jaxbeads.coordinates import coordinates
from jaxbeads.force import BendingEnergy, Contact, JointBending, Weight
from jaxbeads.force.base import repulsion
from jaxbeads.geometry import smallest_gap
from jaxbeads.instant import free_motion
from jaxbeads.iterations import conjugate_gradients
from jaxbeads.linearise import linearise
from jaxbeads.mobility import RPY, FreeDraining
from jaxbeads.pairs import PAIRS, pair_sums
from jaxbeads.rollout import default_solver

TIME = jnp.asarray(0.3)


def test_conjugate_gradients():
    rng = np.random.default_rng(0)
    a = rng.normal(size=(40, 40))
    s, rhs = jnp.asarray(a @ a.T + np.eye(40)), jnp.asarray(rng.normal(size=40))
    found = conjugate_gradients(lambda x: s @ x, rhs, lambda r: r / jnp.diagonal(s))
    assert np.abs(found.solution - np.linalg.solve(s, rhs)).max() < 1e-9
    nothing = conjugate_gradients(lambda x: s @ x, 0 * rhs, lambda r: r)
    assert not nothing.solution.any() and nothing.iterations == 0
    # An exact inverse needs one step; a matrix that is not positive, or no solution at all, gives NaN.
    inverse = jnp.linalg.inv(s)
    assert conjugate_gradients(lambda x: s @ x, rhs, lambda r: inverse @ r).iterations <= 2
    flat = jnp.diag(jnp.arange(40.0))
    assert np.isnan(conjugate_gradients(lambda x: flat @ x, rhs, lambda r: r).solution).all()
    assert np.isnan(conjugate_gradients(lambda x: s @ x, rhs * np.nan, lambda r: r).solution).all()


def test_pairs_in_blocks_are_those_at_once():
    beads = int(1.5 * PAIRS**0.5)
    rng = np.random.default_rng(1)
    x = jnp.asarray(2 * rng.normal(size=(beads, 3)))  # many of them overlap
    load = Load(jnp.asarray(rng.normal(size=(beads, 3))), jnp.asarray(rng.normal(size=(beads, 3))))
    strain = jnp.asarray(np.diag([1.0, 0.5, -1.5]))
    for radius in (jnp.asarray(0.9), jnp.asarray(rng.uniform(0.5, 1.5, beads))):
        spheres = Configuration(x, radius, 1.0 * TIME)
        moved = jax.jit(tensors.rpy_motion)(spheres, load)
        whole = tensors.rpy(spheres).motion(load)
        for a, b in zip(jax.tree.leaves(moved), jax.tree.leaves(whole), strict=True):
            assert np.abs(a - b).max() < 1e-13 * np.abs(b).max()
        # The strain of the first and of the last beads alone, and of all.
        first = np.arange(beads)[:, None, None] < 100
        parts = [
            tensors.shear_disturbance(spheres, jnp.asarray(there * strain[None]))
            for there in (first, ~first)
        ]
        both = tensors.shear_disturbance(spheres, strain)
        for a, b, c in zip(*map(jax.tree.leaves, (*parts, both)), strict=True):
            assert np.abs(a + b - c).max() < 1e-12 * np.abs(c).max()


def test_derivatives_of_sums_in_blocks():
    beads = int(1.5 * PAIRS**0.5)
    rng = np.random.default_rng(2)
    x, shift = jnp.asarray(rng.normal(size=(2, beads)))

    def value(x):
        (sums,) = pair_sums(lambda to, of: [jnp.sin(to[:, None] - of[None, :]) ** 2], x)
        return jnp.sum(sums**2)

    _, push = jax.jvp(jax.jit(value), (x,), (shift,))
    exact = 2 * np.sin(x[:, None] - x[None, :]) ** 2
    rate = np.sin(2 * (x[:, None] - x[None, :])) * (shift[:, None] - shift[None, :])
    exact = exact.sum(1) @ rate.sum(1)
    assert abs(push - exact) < 1e-10 * abs(exact)
    assert abs(jax.grad(value)(x) @ shift - exact) < 1e-10 * abs(exact)


CASES = {
    "fibres": ([Gears()], 3, (30, 1, 2, 50), {}),
    "unequal": ([Gears()], 2, 80, {"radius": np.linspace(0.7, 1.4, 80)}),
    "clamped": ([Gears(), *clamped(0)], 2, 100, {}),
    "held first": ([*hinged(-1), Gears()], 3, 70, {}),
    "Joint": ([Joint()], 3, 70, {}),
    "Inextensible": ([Inextensible()], 3, 140, {}),
    "rigid": ([Gears(), EqualSpins()], 2, 80, {}),
    "lengths": ([PrescribedLengths(lambda t: 2 + jnp.sin(t + jnp.arange(39.0)))], 2, 40, {}),
    "draining": ([Gears(), *hinged(3)], 3, 100, {"mobility": FreeDraining}),
    "short": ([Gears()], 2, 3, {}),
    "alone": ([PrescribedPosition()], 2, 1, {}),
}


def made(case):
    """Scene that is dense, the same that is not, and a state."""
    constraints, dim, fibres, options = CASES[case]
    joint = any(c.oriented for c in constraints)
    chain = Chain(options.get("radius", 1.0), fibres, 0.1 if joint else 0.0)
    centre = 6.0 * np.arange(len(chain.fibres))[:, None] * np.eye(dim)[1]
    state = (jointed if joint else bent)(chain, dim, centre=centre)
    forces = [Weight(np.eye(dim)[1]), BendingEnergy(30.0)][: min(chain.beads, 2)]
    if joint:
        forces = [JointBending(30.0)]
    kind = options.get("mobility", RPY)
    model = scene(chain, dim, constraints=constraints, forces=forces, mobility=kind())
    return model, eqx.tree_at(lambda s: s.mobility, model, kind(dense=False)), state


def distance(a, b):
    """Largest difference of each array, over its largest number."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return max(float(np.abs(x - y).max() / max(np.abs(y).max(), 1e-3)) for x, y in pairs)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_iterations_find_what_a_factorisation_finds(case):
    dense, free, state = made(case)
    found = dynamics.evaluate(TIME, state, free)
    assert distance(found, dynamics.evaluate(TIME, state, dense)) < 1e-9
    assert dynamics.constraint_residual(TIME, state, free) < 1e-12


@eqx.filter_jit
def iterations(state, scene):
    operator = scene.operator(state).kept()
    system = saddle.saddle_point(TIME, state, scene, operator)
    j, free = system.constraints, free_motion(TIME, state, scene, operator)
    precondition = system.solver.precondition
    rhs = -j.slip(free)
    return conjugate_gradients(lambda x: j.compliance(operator, x), rhs, precondition).iterations


@pytest.mark.slow
def test_iterations_hardly_grow():
    counts = []
    for beads in (100, 1000):
        model = Scene(
            Chain(1.0, beads), 1.0, RPY(dense=False), [Inextensible()], [Weight([0.0, -1.0])]
        )
        counts.append(int(iterations(bent(model.chain), model)))
    assert counts[0] <= 8 and counts[1] <= 11
    drained = eqx.tree_at(lambda s: s.mobility, model, FreeDraining(dense=False))
    assert iterations(bent(model.chain), drained) <= 2  # the preconditioner is exact


@pytest.mark.slow
def test_gradients_are_those_of_the_dense_scene():
    dense, free, state = made("clamped")

    @eqx.filter_jit
    @eqx.filter_grad
    def slope(both):
        solution = jb.rollout(*both, [0.0, 0.01], substeps=2)
        return jnp.sum(solution.final.position[::7] ** 2)

    assert distance(slope((free, state)), slope((dense, state))) < 1e-9

    @eqx.filter_jit
    def rate(model):
        def velocity(viscosity):
            thick = eqx.tree_at(lambda s: s.viscosity, model, viscosity)
            return dynamics.motion(TIME, state, thick).velocity

        return jax.jvp(velocity, (TIME,), (jnp.ones(()),))[1]

    assert distance(rate(free), rate(dense)) < 1e-9


@pytest.mark.slow
def test_no_array_of_pairs():
    # In the compiled program, forward and backward, with contact and flow.
    beads = 3000
    chain = Chain(1.0, (1500, 1500))
    state = bent(chain, centre=[[0.0, 0.0], [0.0, 8.0]])
    forces = [Weight([0.0, -1.0]), BendingEnergy(30.0), Contact(1.0, 0.1, 0.1)]
    model = scene(chain, forces=forces)  # by default not dense at this size
    function = eqx.filter_grad(
        lambda both: jnp.sum(dynamics.motion(TIME, both[1], both[0]).velocity[::7] ** 2)
    )
    program = jax.jit(lambda both: function(both)).lower((model, state)).compile()
    shapes = re.findall(r"(?:f64|pred)\[([\d,]+)\]", program.as_text())
    sizes = [int(np.prod([int(n) for n in shape.split(",")])) for shape in shapes]
    assert max(sizes) < beads**2 / 5
    assert program.memory_analysis().temp_size_in_bytes < 8 * beads**2


def test_a_large_run_needs_no_matrix():
    model = scene(Chain(1.0, 1001))
    state = bent(model.chain)
    assert isinstance(default_solver(model), jb.ESDIRK)
    assert isinstance(default_solver(scene(Chain(1.0, (50, 50)))), jb.ESDIRK)
    assert isinstance(default_solver(scene(Chain(1.0, (50, 49)))), jb.Rosenbrock)
    equal = scene(Chain(1.0, (50, 50)), constraints=[Gears(), EqualSpins()])
    assert isinstance(default_solver(equal), jb.Rosenbrock)
    soft = scene(model.chain, forces=[Weight([0.0, -1.0])])
    assert default_solver(soft).name == "Tsit5"
    assert isinstance(default_solver(scene(Chain(1.0, 1000))), jb.Rosenbrock)
    with pytest.raises(ValueError, match=r"`solver` must be `ESDIRK\(\)` or explicit"):
        jb.rollout(model, state, [0.0, 1.0], solver=jb.Rosenbrock())
    with pytest.raises(ValueError, match="must have a dense mobility"):
        jb.steady_state(model, state)
    with pytest.raises(ValueError, match="at most 1000 rows beside a chain's"):
        dynamics.motion(
            TIME, state, scene(model.chain, constraints=[Gears(), EqualSpins(), *clamped()])
        )


def test_constraints_that_contradict_one_another_do_not_converge():
    pulled = [PrescribedPosition(lambda t, s=s: t * s * jnp.eye(2)[0]) for s in (1.0, -1.0)]
    model = scene(Chain(1.0, 5), constraints=[Gears(), *pulled], mobility=RPY(dense=False))
    state = bent(model.chain)
    how = r"PrescribedPosition\(bead=0\) depend on one another: iterations do not converge"
    with pytest.raises(ValueError, match=how):
        jb.simulate(model, state, [0.0, 1e-3], substeps=2, progress=False)
    once = eqx.tree_at(lambda s: s.constraints, model, model.constraints[:2])
    assert dynamics.redundancy(0.0, state, once) is None
    broken = eqx.tree_at(lambda s: s.forces[0].force, once, jnp.full(2, jnp.nan))
    assert dynamics.redundancy(0.0, state, broken) is None  # it is not the constraints


@pytest.mark.parametrize("near", [None, 20, 2], ids=["all", "near", "crowded"])
def test_contact_and_the_smallest_gap_in_blocks(near, monkeypatch):
    if near:
        monkeypatch.setattr(neighbours, "LEAST", 100)
        monkeypatch.setattr(neighbours, "NEAR", near)
    chain = Chain(1.0, (200, 200))
    state = bent(chain, 3, centre=[[0.0, 0.0, 0.0], [0.5, 1.5, 0.3]])
    x = np.asarray(state.position)
    d = x[:, None] - x[None]
    apart = np.linalg.norm(d, axis=2)
    i, fibre = np.arange(400), chain.fibre_of_bead
    other = (abs(i[:, None] - i) > 1) | (fibre[:, None] != fibre)
    push = np.where(other, np.asarray(repulsion(*map(jnp.asarray, (apart - 2, 2.5, 1.0)))), 0.0)
    expected = 5 * (push / (apart + np.eye(400)))[:, :, None] * d
    force = np.asarray(Contact(5.0, 2.5, 1.0).load(TIME, state, Setting(chain, 1.0)).force)
    assert np.abs(force).max() > 0.1
    assert np.abs(force - expected.sum(1)).max() < 1e-12 * np.abs(force).max()
    if near:
        setting = Setting(chain, 1.0)
        shift = jnp.sin(jnp.arange(3 * 400.0)).reshape(400, 3)
        contact = jax.jit(lambda x: Contact(5.0, 2.5, 1.0).load(TIME, jb.State(x), setting).force)
        slope = jax.jvp(contact, (state.position,), (shift,))[1]
        ahead, behind = (contact(state.position + h * shift) for h in (1e-6, -1e-6))
        assert np.abs(slope - (ahead - behind) / 2e-6).max() < 1e-6 * np.abs(slope).max()
        # Of each bead alone, also off a wall.
        wall = jb.NoSlipWall([0.0, 0.0, x[:, 2].min() - 0.5], [0.0, 0.1, 1.0])
        for at in (setting, Setting(chain, 1.0, domain=wall)):
            local = jax.jit(lambda s, at=at: Contact(5.0, 2.5, 1.0).local(TIME, s, at))(state)
            for bead in (0, 250, 399):
                alone = jax.jacfwd(
                    lambda y, at=at, bead=bead: (
                        Contact(5.0, 2.5, 1.0)
                        .load(TIME, jb.State(state.position.at[bead].set(y)), at)
                        .force[bead]
                    )
                )(state.position[bead])
                assert np.abs(local[bead] - alone).max() < 1e-12 * max(1.0, np.abs(alone).max())
            assert np.abs(local).max() > 1.0
        lost = state.position.at[7].set(jnp.nan)
        with (
            pytest.MonkeyPatch.context() as unchecked
        ):  # a state refuses what is not finite, a run may meet it
            unchecked.setattr(jb.state, "finite", lambda *_: None)
            assert not np.isfinite(contact(lost)).all()
        return

    apart = apart + 1e9 * np.eye(400)
    i, j = np.unravel_index(np.argmin(apart), apart.shape)
    gap, one, two = smallest_gap(x, np.ones(400))
    assert (one, two) == (min(i, j), max(i, j)) and abs(gap - apart[i, j] + 2) < 1e-12
    many = np.tile(np.arange(3000.0)[:, None], (1, 2))
    many[2999] = many[17] + 0.1
    gap, one, two = smallest_gap(many, np.full(3000, 0.01))
    assert (one, two) == (17, 2999) and abs(gap - (0.1 * 2**0.5 - 0.02)) < 1e-12


def test_products_of_the_linearisation_need_no_matrix():
    dense, free, state = made(next(iter(CASES)))

    @eqx.filter_jit
    def product(scene, shift):
        return linearise(0.3, coordinates(scene, state), scene).product(shift)

    shift = jnp.sin(jnp.arange(len(coordinates(free, state).origin)) + 0.5)
    found, expected = product(free, shift), product(dense, shift)
    assert np.abs(found - expected).max() < 1e-8 * np.abs(expected).max()
    some = np.array([1, 4, 0, len(shift) - 1])

    @eqx.filter_jit
    def parts(scene):
        about = linearise(0.3, coordinates(scene, state), scene)
        return about.block(some), about.jacobian() if scene.dense else None

    (block, _), (same, whole) = parts(free), parts(dense)
    expected = whole[some][:, some]
    assert np.abs(same - expected).max() < 1e-12 * np.abs(whole).max()
    assert np.abs(block - expected).max() < 1e-8 * np.abs(whole).max()
    with pytest.raises(ValueError, match="must have a dense mobility"):
        linearise(0.3, coordinates(free, state), free).jacobian()
