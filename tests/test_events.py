"""Gate T20: what acts for a short time, at a short distance, or all at once, is not passed over."""

from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import scene
from hypothesis import example, given, settings
from hypothesis import strategies as st
from jax.tree_util import Partial

import jaxbeads as jb
from jaxbeads import Chain, Outcome, Rosenbrock, Scene, State, rollout, simulate
from jaxbeads.constraint import (
    Gears,
    PrescribedDirection,
    PrescribedLengths,
    PrescribedPosition,
    PrescribedSpin,
)
from jaxbeads.flow import VelocityField
from jaxbeads.force import Contact, ForceField, Weight
from jaxbeads.mobility import FreeDraining
from jaxbeads.programs import switches
from jaxbeads.rollout import stepper_for
from jaxbeads.solver import Diffrax
from jaxbeads.solver.watch import watch

ONE = Chain(1.0, 1)
X = jnp.array([1.0, 0.0])
SOLVERS = [diffrax.Tsit5(), Rosenbrock()]
# A slow machine is no failure.
several = partial(settings, max_examples=15, deadline=None, derandomize=True)


def ids(solver):
    return type(solver).__name__


# What acts holds its numbers as leaves: one compiled program serves all examples.


def _pulse(start, width, t, x):
    """A force of 6 pi, by which a bead moves at speed 1, for some time; or a flow of 1."""
    size = 6 * jnp.pi if x.ndim == 2 else 1.0
    on = jnp.where((t > start) & (t < start + width), size, 0.0)
    return on * (X[None, :] if x.ndim == 2 else X)


def _strong(strength, t, x):
    return strength * _pulse(10.0, 2.0, t, x)


def _smooth(centre, width, t, x):
    return 6 * jnp.pi * jnp.exp(-(((t - centre) / width) ** 2)) * X[None, :]


def _there(place, width, t, x):
    """A push along y where x is near a place."""
    return 6 * jnp.pi * jnp.exp(-(((x[:, :1] - place) / width) ** 2)) * X[None, ::-1]


def moved(ts, solver, force=None, flow=None):
    """What a bead has gone in x, and the code."""
    forces = [] if force is None else [ForceField(force)]
    flow = None if flow is None else VelocityField(flow)
    model = Scene(ONE, 1.0, forces=forces, flow=flow)
    run = rollout(model, State([[0.0, 0.0]]), ts, solver=solver)
    return run.final.position[0, 0], run.code


@pytest.mark.parametrize("saves", [2, 101])
@pytest.mark.parametrize("solver", SOLVERS, ids=ids)
def test_a_pulse_of_any_width_is_met(solver, saves):
    # A force of 6 pi, or a flow of 1, from `start` for `width`: the bead goes as far as it lasts.
    ts = np.linspace(0.0, 100.0, saves)

    @jax.jit
    def run(start, width):
        pulse = Partial(_pulse, start, width)
        return moved(ts, solver, force=pulse), moved(ts, solver, flow=pulse)

    @several()
    @given(start=st.floats(0.01, 99.0), log=st.floats(-6.0, 1.5))
    @example(start=1.0, log=0.0)  # at save times, where a step from rest ends by chance
    @example(start=0.0, log=0.0)
    def check(start, log):
        width = 10.0**log
        right = min(start + width, 100.0) - start
        for way, code in run(start, width):
            assert int(code) == 0
            assert abs(float(way) - right) < 1e-9

    check()


@pytest.mark.parametrize("solver", SOLVERS, ids=ids)
def test_a_smooth_pulse_between_save_times_is_met(solver):
    ts = np.linspace(0.0, 100.0, 101)

    @jax.jit
    def run(centre, width):
        return moved(ts, solver, force=Partial(_smooth, centre, width))

    @several()
    @given(centre=st.floats(20.0, 80.0), width=st.floats(0.3, 3.0))
    def check(centre, width):
        way, code = run(centre, width)
        assert int(code) == 0
        assert abs(float(way) - width * np.pi**0.5) < 2e-4  # a hundred steps at 1e-6 of 2

    check()


@pytest.mark.parametrize("solver", SOLVERS, ids=ids)
def test_a_force_at_a_place_is_met(solver):
    # Carried along x at speed 1 past a place, as wide as a bead or wider, where it is pushed along y.
    ts = np.array([0.0, 200.0])

    @jax.jit
    def run(place, width):
        push = ForceField(Partial(_there, place, width))
        model = Scene(ONE, 1.0, forces=[push, Weight([6 * jnp.pi, 0.0])])
        found = rollout(model, State([[0.0, 0.0]]), ts, solver=solver)
        return found.final.position[0, 1], found.code

    @several()
    @given(place=st.floats(30.0, 170.0), width=st.floats(1.0, 4.0))
    def check(place, width):
        way, code = run(place, width)
        assert int(code) == 0
        assert abs(float(way) - width * np.pi**0.5) < 2e-4

    check()


@pytest.mark.parametrize("saves", [2, 301])
@pytest.mark.parametrize("solver", SOLVERS, ids=ids)
def test_a_bead_comes_to_rest_on_another(solver, saves):
    # From any height: the ramp of Contact bears the weight at a distance of the surfaces of 0.08.
    chain = Chain(1.0, (1, 1))
    forces = [Weight([[0.0, -1.0], [0.0, 0.0]]), Contact(10.0, 0.1, 0.1)]
    model = Scene(chain, 1.0, FreeDraining(), [PrescribedPosition(bead=1)], forces)

    @jax.jit
    def run(height, sideways):
        start = State(jnp.stack([jnp.stack([sideways, height]), jnp.zeros(2)]))
        ts = jnp.linspace(0.0, 1.5 * 6 * np.pi * height, saves)
        found = rollout(model, start, ts, solver=solver)
        return found.final.position[0], found.code

    # Explicit steps of a bead at rest are bound by the stiffness of the contact.
    most = 400.0 if isinstance(solver, Rosenbrock) else 30.0

    @several(max_examples=5)
    @given(height=st.floats(3.0, most))
    def check(height):
        place, code = run(height, 0.0)
        assert int(code) == 0
        assert abs(float(place[1]) - 2.08) < 1e-4 and float(place[0]) == 0
        # It glances off one that it does not meet head-on.
        place, code = run(height, 0.5)
        assert int(code) == 0
        assert float(place[0]) > 1.5 and float(jnp.linalg.norm(place)) > 1.9

    check()


def test_fibres_do_not_pass_through_one_another():
    # A stiff fibre falls across another that is held, with nothing to slow it down on the way.
    chain = Chain(1.0, (5, 5))
    start = jb.straight(chain, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[0.0, 0.0, 90.0], [0.0] * 3])
    weight = jnp.zeros((10, 3)).at[:5, 2].set(-1.0)
    held = [PrescribedPosition(bead=5), PrescribedDirection(bond=5), PrescribedSpin(bead=5)]
    forces = [Weight(weight), Contact(20.0, 0.1, 0.1), jb.force.Bending(1e3)]
    model = Scene(chain, 1.0, FreeDraining(), [Gears(), *held], forces)
    run = rollout(model, start, np.array([0.0, 1800.0]))
    assert int(run.code) == 0
    gap, *_ = jb.geometry.smallest_gap(np.asarray(run.final.position), np.ones(10))
    assert gap > -0.1
    assert float(run.final.position[2, 2]) > 1.9  # by free fall it would be at -5


LAWS = {
    "kink": (lambda t: jnp.maximum(t - 0.7, 0.0), 1.3),
    "table": (
        lambda t: jnp.interp(t, jnp.array([0.0, 0.3, 1.1, 2.0]), jnp.array([0, 1, -1, 2.0])),
        2,
    ),
    "step up and down": (lambda t: jnp.where((t > 0.5) & (t < 0.6), t - 0.5, 0.0), 0.0),
    "saw": (lambda t: jnp.abs(jnp.mod(t, 0.5) - 0.25), 0.0),
}


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
@pytest.mark.parametrize("solver", SOLVERS, ids=ids)
def test_a_law_is_followed_from_piece_to_piece(law, solver):
    function, end = law
    model = Scene(ONE, 1.0, constraints=[PrescribedPosition(lambda t: function(t) * X)])
    run = rollout(model, State([[0.5, 0.0]]), np.array([0.0, 2.0]), solver=solver)
    jumps = function is LAWS["step up and down"][0]
    if jumps:  # by 0.1 at t = 0.6: nobody follows, and the run says so
        assert int(run.code) == Outcome.OFF_ITS_LAW
        return
    assert int(run.code) == 0
    assert abs(float(run.final.position[0, 0]) - 0.5 - end) < 1e-12


def test_a_step_that_is_tried_again_knows_of_the_jump_before_it():
    # Else a method that begins with its last rate would take the one from before the jump.
    model = Scene(Chain(1.0, 2), 1.0, FreeDraining(), forces=[jb.force.Spring(1e3)])
    ts = jnp.array([0.0, 100.0])
    stepper = stepper_for(model, ts, Diffrax(diffrax.Tsit5(), tolerance=1e-6))
    begun = stepper.init(model, State([[0.0, 0.0], [2.5, 0.0]]), *ts)
    for end, again in ((50.0, True), (1e-6, False)):
        before = eqx.tree_at(
            lambda a: [a.next, a.jump], begun.memory, [ts[0] + end, jnp.asarray(True)]
        )
        _, after = stepper.attempt(model, begun.code, before, ts[1])
        assert bool(after.previous == 0) == again and bool(after.jump) == again


def step(t):
    return jnp.where(t < 1.0, 0.0, 1.0)


JUMPS = {
    "position": (ONE, PrescribedPosition(lambda t: step(t) * X), [[0.0, 0.0]]),
    "direction": (
        Chain(1.0, 2),
        PrescribedDirection(lambda t: jnp.stack([jnp.cos(step(t)), jnp.sin(step(t))])),
        [[0.0, 0.0], [2.0, 0.0]],
    ),
    "lengths": (
        Chain(1.0, 2),
        PrescribedLengths(lambda t: (2 + step(t))[None]),
        [[0.0, 0.0], [2.0, 0.0]],
    ),
}


@pytest.mark.parametrize("options", [{}, {"solver": jb.AB3(substeps=10)}], ids=str)
@pytest.mark.parametrize("case", JUMPS.values(), ids=JUMPS)
def test_a_law_that_jumps_is_named(case, options):
    chain, constraint, position = case
    model, ts = Scene(chain, 1.0, constraints=[constraint]), np.linspace(0.0, 2.0, 5)
    assert int(rollout(model, State(position), ts, **options).code) == Outcome.OFF_ITS_LAW
    name = type(constraint).__name__
    with pytest.warns(
        UserWarning, match=rf"{name}.* is off its law by 1\d\d %|{name}.*must not jump"
    ):
        simulate(model, State(position), ts, progress=False, **options)


def test_a_kink_is_named_where_equal_steps_take_it_badly():
    law = PrescribedPosition(lambda t: jnp.where(t < 1.0, 0.0, t - 1.0) * X)
    model, ts = Scene(ONE, 1.0, constraints=[law]), np.linspace(0.0, 2.0, 5)
    start = State([[0.0, 0.0]])
    with pytest.warns(UserWarning, match=r"PrescribedPosition\(bead=0\) is off its law by 2.5 %"):
        run = simulate(model, start, ts, substeps=10, progress=False)
    assert abs(float(run.final.position[0, 0]) - 1.025) < 1e-12
    smooth = PrescribedPosition(lambda t: jnp.sin(t) * X)
    run = simulate(Scene(ONE, 1.0, constraints=[smooth]), start, ts, substeps=10, progress=False)
    assert abs(float(run.final.position[0, 0]) - np.sin(2.0)) < 1e-3  # and nothing is said


def test_a_scene_that_is_smooth_and_steady_is_not_watched():
    model = scene(Chain(1.0, 6))
    found = watch(model, jnp.asarray(0.0), jb.straight(model.chain, [1.0, 0.0]))
    assert found.timed is None and found.placed is None
    end = found.end(jnp.asarray(0.0), jnp.asarray(7.0), jnp.asarray(1.0))
    assert [float(t) for t in end] == [7.0, 7.0]


def test_steps_to_a_switch_end_before_it_and_begin_after_it():
    # At any time of the clock, also one with coarse rounding.
    for start in (0.0, 1e6):

        def push(t, x, start=start):
            return jnp.where(t >= start + 3.0, 1.0, 0.0) * jnp.ones_like(x)

        model = Scene(ONE, 1.0, forces=[ForceField(push)])
        found = watch(model, jnp.asarray(start), State([[0.0, 0.0]]))
        before, after = (
            float(t) for t in found.end(*map(jnp.asarray, (start, start + 10.0, 10.0)))
        )
        assert before == np.nextafter(start + 3.0, 0.0)
        assert after == start + 3.0 + 2 * np.spacing(start + 3.0)


DECISIONS = {
    "comparison": (lambda t: jnp.where(t > 1.0, 1.0, 0.0), True),
    "floor": (lambda t: jnp.floor(t / 1.0), True),
    "choice": (lambda t: jax.lax.cond(t > 1.0, lambda: 1.0, lambda: 2.0), True),
    "table": (lambda t: jnp.array([1.0, 2.0, 3.0])[t.astype(int)], True),
    "within a function": (jax.jit(lambda t: jax.nn.relu(t - 1.0)), True),
    "smooth": (lambda t: jnp.exp(-t) * jnp.sin(t), False),
    "of something else": (lambda t: t * jnp.where(jnp.arange(3) > 1, 1.0, 0.0), False),
}


@pytest.mark.parametrize("case", DECISIONS.values(), ids=DECISIONS)
def test_what_a_function_decides_by_its_argument(case):
    function, decides = case
    found = switches(function, jnp.zeros(()).dtype)
    assert (found is not None) == decides
    if found is not None:
        low, same, high = (np.asarray(found(jnp.asarray(t))) for t in (0.5, 0.9, 1.5))
        assert np.array_equal(low, same) and not np.array_equal(low, high)


def test_gradients_pass_through_watched_steps():
    # Both modes, through a pulse whose strength is differentiated: the way is proportional to it.
    ts = np.array([0.0, 20.0, 100.0])

    def way(strength):
        return moved(ts, None, force=Partial(_strong, strength))[0]

    right = 2.0
    assert abs(float(jax.jit(jax.grad(way))(3.0)) - right) < 1e-12
    assert abs(float(jax.jit(jax.jacfwd(way))(3.0)) - right) < 1e-12
