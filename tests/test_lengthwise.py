"""Stages of long fibres, solved along the chain, against dense matrices of the same equations."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent

import jaxbeads as jb
from jaxbeads import ESDIRK, Chain, Scene, lengthwise, windows
from jaxbeads.constraint import Gears, clamped
from jaxbeads.coordinates import coordinates
from jaxbeads.force import Bending, BendingEnergy, ElasticRod, Spring, Weight
from jaxbeads.linearise import coordinate_rate
from jaxbeads.mobility import RPY
from jaxbeads.near import Unknowns, near
from jaxbeads.rollout import stepper_for
from jaxbeads.saddle import slips
from jaxbeads.stages import Stage, solved_stage
from jaxbeads.state import add_loads, zero_motion

TIME, AHEAD = jnp.asarray(0.3), jnp.asarray(40.0)
FAST = {"xla_backend_optimization_level": 0}


@pytest.fixture
def short(monkeypatch):
    """Fibres of a few windows count as long."""
    monkeypatch.setattr(lengthwise, "MOST_NUMBERS", 10)
    monkeypatch.setattr(windows, "MOST_WHOLE", 20)


def held():
    """In the plane, clamped at one end: rows beside the chain's, a point that belongs to no bead."""
    forces = [Weight([0.1, -1.0]), Bending(3e3)]
    return Chain(1.0, 70), 2, [Gears(), *clamped(0)], forces


def rod():
    """In space, with material frames."""
    forces = [Weight([0.1, -1.0, 0.3]), ElasticRod(3e3, 2e3, 4e3, 0.01, 0.0, 0.03)]
    return Chain(1.0, 40), 3, [Gears()], forces


def springs():
    """Coordinates of beads, two fibres and a single bead, nothing but rates."""
    return Chain(1.0, (40, 1, 36)), 2, [], [Spring(100.0), BendingEnergy(3e3)]


def made(example):
    """Scene and state."""
    chain, dim, constraints, forces = example()
    model = Scene(chain, 1.0, RPY(dense=False), constraints=constraints, forces=forces)
    centre = 8.0 * np.arange(len(chain.fibres))[:, None] * np.eye(dim)[1]
    return model, model.begin(bent(chain, dim, centre=centre))


@pytest.mark.parametrize("example", [held, rod, springs])
def test_answer_is_that_of_a_dense_matrix(example, short):
    model, state = made(example)
    chart, rng = coordinates(model, state), np.random.default_rng(0)
    x = 0.01 * jnp.asarray(rng.normal(size=len(chart.origin)))
    rows = jnp.size(slips(TIME, state, model)(zero_motion(state, True))) if model.constraints else 0
    multipliers = jnp.asarray(10 * rng.normal(size=rows))

    @partial(jax.jit, compiler_options=FAST)
    def found(rate, slip):
        close = near(TIME, x, AHEAD, chart, model, multipliers)
        assert close.long is not None
        maps = close.maps

        def equations(z):
            k, multipliers = jnp.split(z, [len(x)])
            push = jax.jvp(maps.load, (x,), (AHEAD * k,))[1]
            motion = maps.motion(add_loads(push, maps.pull(multipliers)))
            return jnp.concatenate([k - maps.rate(motion), maps.linear(motion)])

        off = Unknowns(rate, slip)
        whole = jax.jacfwd(equations)(jnp.zeros(len(x) + len(slip)))
        change, back = (f(off, jnp.asarray(True)) for f in (close.answer, close.transposed))
        return whole, jnp.concatenate(change), jnp.concatenate(back)

    rate, slip = (jnp.asarray(rng.normal(size=n)) for n in (len(x), rows))
    whole, change, back = found(rate, slip)
    off = np.concatenate([rate, slip])
    for matrix, mine in ((whole, change), (whole.T, back)):
        expected = -np.linalg.solve(matrix, off)
        assert np.abs(mine - expected)[: len(x)].max() < 1e-9 * np.abs(expected[: len(x)]).max()
        assert np.abs(mine - expected).max() < 1e-9 * np.abs(expected).max()


def test_a_stage_and_its_derivatives(short):
    chain, ahead = Chain(1.0, (30, 1, 25)), 0.5
    forces = [Weight([0.1, -1.0]), Bending(30.0)]
    model, dense = (
        Scene(chain, 1.0, RPY(dense=dense), constraints=[Gears()], forces=forces)
        for dense in (False, True)
    )
    state = bent(chain, centre=[[0.0, 0.0], [0.0, 20.0], [0.0, 60.0]])
    chart, rng = coordinates(model, state), np.random.default_rng(1)
    base, shift, pull = (jnp.asarray(rng.normal(size=len(chart.origin))) for _ in range(3))
    base, rows = 0.01 * base, jnp.zeros(2 * (chain.beads - 1))

    def stage(base):
        guess = Unknowns(0 * base, rows)
        close = near(TIME, chart.origin, jnp.asarray(ahead), chart, model, rows)
        assert close.long is not None
        at = Stage(TIME, base, jnp.asarray(ahead))
        enough = jnp.asarray(1e-11)
        found = solved_stage(at, jnp.asarray(4 * ahead), chart, model, close, guess, enough)
        return found.unknowns.rate, found

    @partial(jax.jit, compiler_options=FAST)
    def both(base):
        rate, push, found = jax.linearize(stage, base, has_aux=True)
        back = jax.linear_transpose(push, shift)(pull)[0]
        expected, jacobian = linearised(base + ahead * rate)
        return found, push(shift), back, expected, jacobian

    def linearised(x):
        rate = partial(coordinate_rate, TIME)
        return rate(x, chart, dense), jax.jacfwd(rate)(x, chart, dense)

    found, moved, back, expected, jacobian = both(base)
    assert found.fine and found.products <= 20
    assert np.abs(found.unknowns.rate - expected).max() < 1e-8 * np.abs(expected).max()
    # k = f(b + g k): dk = (1 - g W)^-1 W db.
    implicit = np.linalg.solve(np.eye(len(base)) - ahead * jacobian, jacobian)
    for mine, expected in ((moved, implicit @ shift), (back, implicit.T @ pull)):
        assert np.abs(mine - expected).max() < 1e-7 * np.abs(expected).max()


def test_steps_are_those_of_the_dense_scene(short):
    model, state = made(held)
    dense = eqx.tree_at(lambda s: s.mobility, model, RPY(dense=True))
    ts, tolerance, length = jnp.array([0.0, 400.0]), 1e-5, 140.0
    expected = jb.rollout(dense, state, ts, solver=jb.Rosenbrock(tolerance=1e-7)).final.position
    stepper = stepper_for(model, ts, ESDIRK(tolerance=tolerance))
    carry = stepper.init(model, state, ts[0], ts[1])
    carry = eqx.filter_jit(stepper.stretch)(model, carry, ts[0], ts[1], stepper.max_steps)
    assert carry.code == 0 and carry.memory.solver.products <= 5 * 12 * carry.steps
    found = carry.state.position
    assert np.abs(found - expected).max() < 30 * tolerance * length
    assert np.abs(found - state.position).max() > 0.2 * length


def test_memory_grows_like_the_number_of_beads():
    def size(beads):
        chain = Chain(1.0, beads)
        forces = [Weight([0.0, -1.0]), Bending(30.0)]
        model = Scene(chain, 1.0, RPY(dense=False), constraints=[Gears()], forces=forces)
        chart = coordinates(model, jb.straight(chain, [1.0, 0.0]))
        rows = jnp.zeros(2 * (beads - 1))
        given = TIME, chart.origin, AHEAD, chart, model, rows
        program = eqx.filter_jit(near).lower(*given).compile()
        return program.compiled.memory_analysis().temp_size_in_bytes

    few, many = size(1500), size(3000)
    assert many < 2.2 * few and many < 8 * 3000**2
