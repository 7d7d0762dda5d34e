"""Gradients of whole runs and of instants: both modes, differences, second derivatives (gate T8)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent, jointed, scene

from jaxbeads import Chain, State, dynamics, rollout, straight
from jaxbeads.actuation import TravellingWave
from jaxbeads.constraint import Gears, Inextensible, Joint
from jaxbeads.force import Bending, BendingEnergy, JointBending, Spring, Weight
from jaxbeads.mobility import RPY, FreeDraining
from jaxbeads.solver import stepping

TIMES = np.linspace(0.0, 4.0, 3)


def test_second_derivatives_of_the_motion():
    # The rule for first derivatives is differentiated again, in both orders of the modes.
    chain = Chain(1.0, 4)
    model, state = scene(chain), bent(chain)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(4, 2)))
    shape = state.position.shape

    def value(x):
        moved = State(state.position + x.reshape(shape))
        return jnp.sum(weight * dynamics.motion(0.3, moved, model).velocity)

    x, h = 0.01 * jnp.arange(8.0), 1e-5  # no bead touches another
    slope = jax.jit(jax.grad(value))
    rows = [(slope(x + h * e) - slope(x - h * e)) / (2 * h) for e in np.eye(8)]
    for hessian in (jax.jacfwd(jax.grad(value)), jax.jacrev(jax.grad(value))):
        found = np.asarray(jax.jit(hessian)(x))
        assert np.abs(found - found.T).max() < 1e-12 * np.abs(found).max()
        assert np.abs(found - rows).max() < 1e-7 * np.abs(found).max()


MODELS = {
    "Gears": ([Gears()], lambda dim: Bending(4.0), bent),
    "Inextensible": ([Inextensible()], lambda dim: BendingEnergy(4.0), bent),
    "Springs": ([], lambda dim: Spring(20.0), bent),
    "Joint": ([Joint()], lambda dim: JointBending(4.0), jointed),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "model, dim, mobility",
    [
        ("Gears", 2, FreeDraining()),
        ("Inextensible", 2, RPY()),
        ("Inextensible", 3, FreeDraining()),
        ("Springs", 3, RPY()),
        ("Joint", 2, RPY()),
        ("Joint", 3, FreeDraining()),
    ],
    ids=lambda x: x if isinstance(x, (str, int)) else type(x).__name__,
)
def test_gradients_of_all_models_in_both_modes(model, dim, mobility):
    constraints, force, start = MODELS[model]
    chain = Chain(1.0, 4, gap=0.1) if model == "Joint" else Chain(1.0, 4)
    forces = [Weight(np.array([0.1, -0.4, 0.2])[:dim]), force(dim)]
    held = scene(chain, dim, mobility=mobility, constraints=constraints, forces=forces)
    check_both_modes(held, start(chain, dim), substeps=10)


@pytest.mark.slow
@pytest.mark.parametrize("amplitude", [0.0, 0.3])
def test_gradients_over_a_thousand_steps_from_straight(amplitude):
    # The straight chain, the start of the time and a wave without amplitude are singular places.
    chain = Chain(1.0, 5)
    wave = TravellingWave(amplitude * np.ones(3), 0.5, 0.4)
    active = scene(chain, flow=False, forces=[Bending(3.0, wave)])
    check_both_modes(active, straight(chain, [1.0, 0.0]), substeps=500)


@pytest.mark.slow
def test_memory_of_the_backward_pass(monkeypatch):
    # Gate T9: what is kept of all steps is bounded; without it, ten times the steps need at most four
    # times the memory. The gradient is the same.
    chain = Chain(1.0, 4)
    state = bent(chain)

    def program(steps):
        def last(model):
            return jnp.sum(rollout(model, state, TIMES[:2], substeps=steps).final.position)

        return jax.jit(jax.grad(last)).lower(scene(chain)).compile()

    def needed(program):
        return program.memory_analysis().temp_size_in_bytes

    whole = program(1_000)
    assert needed(whole) > 1_000 * 6**2 * 8  # factors of all steps: 6 rows of constraints
    monkeypatch.setattr(stepping, "MOST_KEPT", 0)
    jax.clear_caches()  # a rollout is traced once for a shape
    blocks, longer = program(1_000), program(10_000)
    assert needed(blocks) < needed(whole) / 4 and needed(longer) < 4 * needed(blocks)
    pairs = zip(*(jax.tree.leaves(p(scene(chain))) for p in (whole, blocks)), strict=True)
    assert all(np.abs(a - b).max() <= 1e-12 * np.abs(a).max() for a, b in pairs)


def check_both_modes(model, state, substeps):
    """Reverse, forward and differences of a trajectory, by every number of scene and state."""
    leaves, tree = jax.tree.flatten((model, state))
    rng = np.random.default_rng(1)
    along = [jnp.asarray(rng.normal(size=np.shape(x))) * (0.1 + np.abs(x)) for x in leaves]

    def value(leaves):
        model, state = jax.tree.unflatten(tree, leaves)
        run = rollout(model, state, TIMES[:3], substeps=substeps)
        return jnp.sum(jnp.sin(run.states.position))

    slopes = jax.jit(jax.grad(value))(leaves)
    assert all(np.all(np.isfinite(x)) for x in slopes)
    slope = sum(float(jnp.vdot(a, b)) for a, b in zip(slopes, along, strict=True))
    pushed, h = jax.jit(lambda x: jax.jvp(value, (x,), (along,))), 1e-5  # value and derivative
    assert abs(pushed(leaves)[1] - slope) < 1e-10 * abs(slope)
    shifts = {
        k: pushed([x + k * h * d for x, d in zip(leaves, along, strict=True)])[0]
        for k in range(-2, 3)
    }
    difference = (8 * (shifts[1] - shifts[-1]) - (shifts[2] - shifts[-2])) / (12 * h)
    assert abs(difference - slope) < 1e-6 * abs(slope)
