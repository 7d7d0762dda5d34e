"""Pairs of beads that touch: how they are found, and what implicit stages make of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.optimize import brentq

import jaxbeads as jb
from jaxbeads import ESDIRK, Chain, Load, Scene, Setting, State, neighbours, touching
from jaxbeads.constraint import Gears
from jaxbeads.coordinates import coordinates
from jaxbeads.force import Bending, Contact, ForceField
from jaxbeads.iterations import MOST_ACCELERATED
from jaxbeads.mobility import RPY, FreeDraining
from jaxbeads.near import Unknowns, near
from jaxbeads.neighbours import largest
from jaxbeads.rollout import stepper_for
from jaxbeads.stages import Stage, residual, solved_stage
from jaxbeads.touching import placed

TIME = jnp.asarray(0.3)
YES = jnp.asarray(True)


@pytest.mark.parametrize("blocks", [False, True])
def test_foremost_pairs(blocks, monkeypatch):
    if blocks:
        monkeypatch.setattr(neighbours, "LEAST", 10)
        monkeypatch.setattr(neighbours, "BLOCK", 8)
    x = np.random.default_rng(1).uniform(size=(90, 3)) * 6

    def field(to, of):
        apart = to[0][:, None] - of[0][None]
        return jnp.maximum(1.0 - jnp.sqrt((apart**2).sum(axis=2) + 1e-300), 0.0)

    apart = np.linalg.norm(x[:, None] - x[None], axis=2)
    i, j = np.nonzero(np.triu(apart < 1, 1))
    order = np.argsort(apart[i, j])
    first, second, found = largest(field, (jnp.asarray(x),), (50, 39, 1), jnp.asarray(1.0), 200)
    there = np.asarray(found) > 0
    assert there.sum() == len(i) > 20 and there[: len(i)].all()
    assert np.abs(1 - found[there] - apart[i, j][order]).max() < 1e-12
    assert set(zip(*map(np.asarray, (first[there], second[there])), strict=True)) == set(
        zip(i, j, strict=True)
    )
    some = largest(field, (jnp.asarray(x),), (50, 39, 1), jnp.asarray(1.0), 7)
    assert [np.asarray(a).tolist() for a in some] == [
        np.asarray(a)[:7].tolist() for a in (first, second, found)
    ]


def crossed(gap, mobility=None):
    """Two fibres of five beads, one across the other, so far from touching."""
    chain = Chain(1.0, (5, 5))
    s = np.linspace(-4, 4, 5)
    one = np.stack([s, 0 * s, 0 * s], axis=1)
    two = np.stack([0 * s, s, 2 + gap + 0 * s], axis=1)
    contact = Contact(30.0, 0.1, 0.1)
    scene = Scene(chain, 1.0, mobility or FreeDraining(), [Gears()], [Bending(5.0), contact])
    return scene, coordinates(scene, State(np.concatenate([one, two]))), contact


def test_pairs_of_contact_and_their_places():
    scene, chart, contact = crossed(0.02)
    pairs = contact.touching(chart.start, Setting(scene.chain, 1.0), 9)
    x = np.asarray(chart.start.position)
    apart = np.linalg.norm(x[:, None] - x[None], axis=2)
    there = np.asarray(pairs.there)
    first, second = (np.asarray(a)[there] for a in (pairs.first, pairs.second))
    gap = apart[first, second] - 2
    assert np.abs(np.asarray(pairs.gap(chart.start.position))[there] - gap).max() < 1e-12
    assert gap[0] == gap.min() and (np.diff(gap) > -1e-12).all() and gap.max() < 1.6
    near_ = (apart - 2 < 1.6) & (np.abs(np.subtract.outer(np.arange(10), np.arange(10))) > 1)
    assert there.sum() == min(9, np.triu(near_, 1).sum())
    # The forces are those of the load.
    force = np.zeros_like(x)
    way = np.asarray(pairs.direction)[there] * np.asarray(pairs.push(jnp.asarray(gap)))[:, None]
    np.add.at(force, first, way)
    np.add.at(force, second, -way)
    load = contact.load(TIME, chart.start, scene).force
    assert np.abs(force).max() > 1 and np.abs(force - load).max() < 1e-12
    # Each in a slot of both its fibres, as far as there is room.
    _, which, at = placed(pairs, scene.chain, 3)
    bead = scene.chain.fibre_of_bead
    for fibre in range(2):
        own = [k for k in range(len(first)) if fibre in (bead[first[k]], bead[second[k]])][:3]
        assert [k for k in which[fibre] if k < 9] == own
        assert all(at[fibre, s] in (first[k], second[k]) for s, k in enumerate(own))


def test_force_of_a_pair_by_a_beads_own_place():
    chain, contact = Chain(1.0, (1, 1)), Contact(30.0, 0.1, 0.1)
    state = State(jnp.array([[0.0, 0.3, 0.0], [1.2, -0.4, 1.3]]))
    scene = Scene(chain, 1.0, RPY(), forces=[contact])
    pairs = contact.touching(state, scene, 3)
    found = touching.by_own_place(pairs, state.position)

    def force(x, k):
        return contact.load(TIME, State(state.position.at[k].set(x)), scene).force[k]

    assert [bool(there) for there in pairs.there] == [True, False, False]
    for k in range(2):
        whole = jax.jacfwd(force)(state.position[k], k)
        assert np.abs(whole).max() > 10 and np.abs(found[0] - whole).max() < 1e-9
    assert not np.asarray(found[1:]).any()


@pytest.mark.parametrize("gap", [0.05, -0.4, -1.0])
def test_matrices_of_fibres_keep_their_sign_however_deep_a_guess_is(gap):
    scene, chart, _ = crossed(gap)
    multipliers = jb.dynamics.evaluate(TIME, chart.start, scene).multipliers
    close = near(TIME, chart.origin, jnp.asarray(3.0), chart, scene, 0 * multipliers)
    # Of D^-1 = (1 - g W')^-1, where W' takes away from what is bent or off its place.
    values = np.linalg.eigvals(np.asarray(close.inverse))
    assert np.abs(values.imag).max() < 1e-9
    assert values.real.min() > 0 and values.real.max() < 1 + 1e-9


def test_the_answer_is_exact_where_fibres_do_not_feel_one_another():
    # Under local drag, and where repulsion sets in: it has a slope, but no size that turns with it.
    scene, chart, _ = crossed(0.1 * (1 - 1e-7))
    ahead = jnp.asarray(3.0)
    rows = len(jb.dynamics.evaluate(TIME, chart.start, scene).multipliers)
    at = Unknowns(jnp.zeros_like(chart.origin), jnp.zeros(rows))
    close = near(TIME, chart.origin, ahead, chart, scene, at.multipliers)
    assert int(close.touches.pairs.there.sum()) >= 1
    stage = Stage(TIME, chart.origin, ahead)
    flat, apart = ravel_pytree(at)

    def off(z):
        return ravel_pytree(residual(stage, apart(z), chart, scene))[0]

    matrix = np.asarray(jax.jit(jax.jacfwd(off))(flat))
    used = np.abs(matrix).sum(axis=1) > 0  # there is no bond from fibre to fibre
    rng = np.random.default_rng(0)
    rhs = np.where(used, rng.normal(size=len(flat)), 0.0)
    answer = eqx.filter_jit(lambda n, off: n.answer(off, YES))
    found = np.asarray(ravel_pytree(answer(close, apart(jnp.asarray(rhs))))[0])
    assert np.abs(matrix @ found + rhs).max() < 1e-5 * np.abs(rhs).max()
    alone = eqx.tree_at(lambda n: n.touches, close, None, is_leaf=lambda x: x is None)
    lost = np.asarray(ravel_pytree(answer(alone, apart(jnp.asarray(rhs))))[0])
    assert np.abs(matrix @ lost + rhs).max() > 1e-2  # what the pair does is not little


@pytest.mark.parametrize("mobility", [FreeDraining(), RPY()])
def test_the_answer_has_its_transpose(mobility):
    scene, chart, _ = crossed(0.02, mobility)
    close = near(TIME, chart.origin, jnp.asarray(3.0), chart, scene, jnp.zeros(27))
    flow = close.touches.flow
    assert (np.abs(flow.velocity).max() > 1e-2) == isinstance(mobility, RPY)
    rng = np.random.default_rng(0)
    one, other = (
        Unknowns(jnp.asarray(rng.normal(size=len(chart.origin))), jnp.asarray(rng.normal(size=27)))
        for _ in range(2)
    )
    found, back = close.answer(one, YES), close.transposed(other, YES)
    left, right = (
        sum(float(a @ b) for a, b in zip(x, y, strict=True))
        for x, y in ((found, other), (one, back))
    )
    assert abs(left - right) < 1e-10 * abs(left) > 0


@pytest.mark.parametrize(
    "domain", [jb.Unbounded(), jb.NoSlipWall([0.0, 0.0, -3.0], [0.0, 0.0, 1.0])]
)
def test_spheres_move_one_another_as_pushes_open_them(domain):
    # Without anything that holds them; of two fibres one bead each is near to the other.
    x = jnp.array([[-9.0, 0.0, 0.0], [0.0, 0.3, 0.0], [1.5, 0.0, 1.8], [9.0, 2.0, 4.0]])
    chain, contact = Chain(1.0, (2, 2)), Contact(1.0, 0.1, 0.1)
    scene = Scene(chain, 0.7, RPY(), [], [contact], domain=domain)
    chart, ahead = coordinates(scene, State(x)), 2.0
    touches = near(TIME, chart.origin, jnp.asarray(ahead), chart, scene, jnp.zeros(0)).touches
    assert int(touches.pairs.there.sum()) == 1
    assert {int(touches.pairs.first[0]), int(touches.pairs.second[0])} == {1, 2}
    way = np.asarray(touches.pairs.direction[0])
    sign = np.array([0, 1, -1, 0]) if int(touches.pairs.first[0]) == 1 else np.array([0, -1, 1, 0])
    spheres = scene.operator(State(x)).configuration
    moved = RPY().motion(spheres, Load(jnp.asarray(sign[:, None] * way))).velocity
    apart = ahead * (sign @ np.asarray(moved)) @ way
    assert abs(touches.opened[0, 0] - apart) < 1e-12 < 0.5 * (touches.own[0, 0] - apart)
    if isinstance(domain, jb.Unbounded):  # 3a/(2r) - (a/r)^3 of one on the other
        r = np.linalg.norm(x[1] - x[2])
        expected = 2 * ahead * (1 - 1.5 / r + 1 / r**3) / (6 * np.pi * 0.7)
        assert abs(apart - expected) < 1e-12


def test_pushes_where_fibres_move_one_another_too_much():
    # What is left out makes it negative, so that no gaps are found: they are those without flows.
    scene, chart = pressed(3.0)
    near_ = near(TIME, chart.origin, jnp.asarray(200.0), chart, scene, jnp.zeros(0))
    touches = eqx.tree_at(lambda t: t.opened, near_.touches, -near_.touches.own)
    gap, push = touches.pairs.gap(chart.start.position), jnp.zeros(len(touches.pairs.first))
    rate = -0.01 * touches.parting.sum(axis=1)
    found = touches.met(rate, gap, push)
    assert float(found[0]) > 0 and np.array_equal(found, near_.touches.met(rate, gap, push))


def pressed(push):
    """Two spheres on a line, pressed together: each has what the other has not."""
    contact = Contact(1.0, 0.1, 0.1)
    field = ForceField(lambda t, x: -push * jnp.sign(x) * jnp.array([[1.0, 0.0]]))
    scene = Scene(Chain(1.0, (1, 1)), 1.0, FreeDraining(), [], [field, contact])
    return scene, coordinates(scene, State([[-1.5, 0.0], [1.5, 0.0]]))


@pytest.mark.parametrize("push", [0.3, 3.0, 300.0])
def test_a_stage_in_which_spheres_meet(push):
    # Alone they would go 3 (0.3) to 3000 radii (300) each.
    scene, chart = pressed(push)
    ahead = 6 * np.pi * 10.0
    at = Unknowns(jnp.zeros_like(chart.origin), jnp.zeros(0))
    close = near(TIME, chart.origin, jnp.asarray(ahead), chart, scene, at.multipliers)
    stage = Stage(TIME, chart.origin, jnp.asarray(ahead))
    enough = jnp.asarray(1e-12)
    found = solved_stage(stage, jnp.asarray(4 * ahead), chart, scene, close, at, enough)
    x = np.asarray(chart.state(ahead * found.unknowns.rate).position)

    def law(gap):
        return np.where(
            gap > 0.1, 0.0, np.where(gap < -0.1, np.exp(-(gap + 0.1) / 0.1), 0.5 - 5 * gap)
        )

    # The gap is 1 + 2 g (p - push)/(6 pi) where p = law(gap).
    gap = brentq(lambda s: s - 1 - 20 * (law(s) - push), -2.0, 1.0, xtol=1e-14)
    assert bool(found.fine) and gap < 0.1
    assert abs(x[1, 0] - x[0, 0] - 2 - gap) < 1e-9 and abs(x[:, 0].sum()) < 1e-9
    assert int(found.products) < 8


@pytest.mark.parametrize(("gap", "there"), [(1.2, 1), (0.02, 4)])
def test_few_pairs_are_pressed_as_many_are(gap, there, monkeypatch):
    scene, chart, _ = crossed(gap)
    close = near(TIME, chart.origin, jnp.asarray(3.0), chart, scene, jnp.zeros(27))
    touches, x = close.touches, chart.start.position
    assert int(touches.pairs.there.sum()) == there and len(touches.which[0]) == 4
    rate = -5 * touches.parting.sum(axis=1)  # towards one another
    given = rate, touches.pairs.gap(x), touches.first(x, YES)
    expected = np.asarray(touches.met(*given))
    assert np.abs(expected).max() > 1
    for few in range(1, 5):  # as many as that at the most are taken by themselves
        monkeypatch.setattr(touching, "FEW_PAIRS", few)
        assert np.abs(touches.met(*given) - expected).max() < 1e-9 * np.abs(expected).max()


def test_a_stage_whose_pushes_are_not_found_is_not_taken(monkeypatch):
    monkeypatch.setattr(touching, "_MOST", 0)
    # A push of e^2, with which Newton's method begins, is nearly enough.
    scene, chart = pressed(7.45)
    ahead = jnp.asarray(6 * np.pi * 10.0)
    at = Unknowns(jnp.zeros_like(chart.origin), jnp.zeros(0))
    close = near.__wrapped__(TIME, chart.origin, ahead, chart, scene, at.multipliers)
    stage = Stage(TIME, chart.origin, ahead)
    found = solved_stage(stage, 4 * ahead, chart, scene, close, at, jnp.asarray(1e-12))
    assert not found.fine


def begun(scene, chart):
    """A run of implicit steps: its stepper and where it is after some of them."""
    ts = jnp.array([0.0, 40.0])
    stepper = stepper_for(scene, ts, ESDIRK(tolerance=1e-6))
    carry = stepper.interval(scene, stepper.init(scene, chart.start, *ts), *ts)
    return stepper, carry, ts


def test_steps_begin_with_what_was_found_at_the_end():
    scene, chart, _ = crossed(0.05, mobility=RPY())
    stepper, carry, ts = begun(scene, chart)
    kept = carry.memory
    assert bool(kept.solver.known)
    now = jb.dynamics.rate(kept.previous, kept.state, scene)
    size = np.abs(now.position).max()
    assert np.abs(kept.solver.moving.position - now.position).max() < 1e-3 * size + 1e-9
    dense = jb.rollout(scene, chart.start, ts, solver=jb.Rosenbrock(tolerance=1e-8)).final
    assert np.abs(carry.state.position - dense.position).max() < 1e-3

    @jax.jit
    def products(known, end):
        before = eqx.tree_at(lambda a: [a.solver.known, a.next], kept, [known, kept.previous + end])
        scheme = stepper.solver.scheme
        args = None, kept.previous, before.next, kept.state, scene, before.solver
        *_, memory, _ = scheme.step(*args, jnp.asarray(False))
        return memory.products - kept.solver.products

    # There is nothing to look for at the begin of a step; and nothing after a stage that is not found.
    length = kept.next - kept.previous
    assert products(True, length) < products(False, length)
    assert MOST_ACCELERATED <= products(True, 1e6 * length) < 2 * MOST_ACCELERATED

    # Such a step is tried again, a quarter as long.
    asked = kept.previous + 1e6 * length
    longer = eqx.tree_at(lambda c: c.memory.next, carry, asked)
    after = stepper.stretch(scene, longer, ts[1], ts[1] + 1e7 * length, 1)
    assert float(after.memory.previous) == float(kept.previous)
    assert abs(after.memory.next - kept.previous - 0.25e6 * length) < 1e3 * length
    assert np.array_equal(after.memory.state.position, kept.state.position)
