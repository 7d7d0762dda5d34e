"""One problem in several systems of units, and in single precision: nothing may depend on them."""

from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import CONSTRAINTS, FLOWS, FORCES, MOBILITIES, bent, in_units, instant, jointed, name

from jaxbeads import AB3, Chain, Scene, State, dynamics, rollout, simulate
from jaxbeads.constraint import Gears, Joint, PrescribedPosition, PrescribedSpin
from jaxbeads.flow import Shear
from jaxbeads.force import Bending, JointBending, JointRepulsion, Weight
from jaxbeads.mobility import RPY, FreeDraining
from jaxbeads.observables import friction_coefficient, rigid_resistance
from jaxbeads.scenes import SCENES, Case
from jaxbeads.solver import explicit_step, substeps_for
from jaxbeads.solver.stepping import FixedSteps

# Micrometres, milliseconds and piconewtons in SI; and large units.
SYSTEMS = [(1e-6, 1e-3, 1e-12), (3e4, 7e2, 5e6)]
quiet = partial(simulate, progress=False)


def together():
    """Scenes that hold every constraint, force, flow and mobility of `cases`."""
    count = len(CONSTRAINTS)
    assert count >= max(len(FLOWS), len(MOBILITIES))
    for k, constraints in enumerate(CONSTRAINTS):
        forces = FORCES[k::count]
        flow, mobility = FLOWS[k % len(FLOWS)], MOBILITIES[k % len(MOBILITIES)]
        yield constraints, forces, flow, mobility


def agree(scene, state, units, t=0.37):
    """The motion of one instant, its residual and the step of explicit solvers."""
    length, time, _ = units
    other, moved = in_units(scene, units), in_units(state, units)
    one, residual = instant(t, state, scene)
    two, other_residual = instant(t * time, moved, other)
    size = np.abs(one.velocity).max()
    assert size > 0 and np.abs(two.velocity * (time / length) - one.velocity).max() < 1e-9 * size
    if one.spin is not None:
        size = max(size, np.abs(one.spin).max())
        assert np.abs(two.spin * time - one.spin).max() < 1e-9 * size
    assert residual < 1e-11 and other_residual < 1e-11
    step, other_step = float(explicit_step(scene)), float(explicit_step(other))
    assert other_step == step * time or abs(other_step / (step * time) - 1) < 1e-12


@pytest.mark.parametrize("units", SYSTEMS, ids=["micro", "large"])
@pytest.mark.parametrize("parts", list(together()), ids=lambda p: name(p[0]))
def test_every_term(parts, units):
    constraints, forces, flow, mobility = parts
    chain = Chain(1.0, 9)
    state = (jointed if constraints[-1].oriented else bent)(chain, 2, seed=3)
    scene = Scene(chain, 1.3, mobility, constraints, forces, flow)
    agree(scene, state, units)


@pytest.mark.parametrize("units", SYSTEMS, ids=["micro", "large"])
@pytest.mark.parametrize("radius", [1.0, [1.0, 1.2, 0.9, 1.0, 1.1, 1.0]], ids=["equal", "unequal"])
def test_space(radius, units):
    chain, weight = Chain(radius, 6), Weight([0.1, -0.4, 0.2])
    forces = [Bending(30.0, 0.1), weight]
    agree(
        Scene(chain, 1.3, constraints=[Gears()], forces=forces, flow=Shear(0.7)),
        bent(chain, 3, 1),
        units,
    )
    repulsion = JointRepulsion(0.2, 0.5)
    chain = Chain(radius, 6, 0.1)
    forces = [JointBending(30.0, 0.1, repulsion=repulsion), weight]
    scene = Scene(chain, 1.3, constraints=[Joint()], forces=forces, flow=Shear(0.7))
    agree(scene, jointed(chain, 3, 1), units)


FIBRES = [ready for ready in SCENES if ready.build.__annotations__["return"] is Case]


@pytest.mark.parametrize("ready", FIBRES, ids=lambda r: r.name)
def test_every_ready_made_scene(ready):
    case = ready.build(**({"beads": 6} if "beads" in ready.options else {}))
    noise = np.random.default_rng(0).normal(size=case.state.position.shape)
    radius = float(jnp.min(case.scene.chain.radius))
    state = State(case.state.position + 1e-3 * radius * noise, case.state.director)
    for units in SYSTEMS:
        agree(case.scene, state, units, t=0.37 * case.ts[1])
        in_time = in_units(case.scene, units)
        if np.isfinite(explicit_step(case.scene)):
            assert substeps_for(in_time, case.ts * units[1]) == substeps_for(case.scene, case.ts)


@pytest.mark.parametrize(
    "options",
    [{}, {"solver": diffrax.Tsit5()}, {"solver": AB3(substeps=10)}],
    ids=["default", "Tsit5", "AB3"],
)
def test_trajectories(options):
    chain = Chain([1.0, 1.2, 1.0, 0.9, 1.0], 5)
    forces = [Bending(20.0), Weight([0.1, -0.4])]
    scene = Scene(chain, 1.3, constraints=[Gears()], forces=forces, flow=Shear(0.3))
    state, ts = bent(chain), np.linspace(0.0, 4.0, 5)
    one = quiet(scene, state, ts, **options)
    for units in SYSTEMS:
        length, time, _ = units
        two = quiet(in_units(scene, units), in_units(state, units), ts * time, **options)
        assert int(two.steps) == int(one.steps)
        assert np.abs(two.states.position / length - one.states.position).max() < 1e-9
        assert two.residual.max() < 1e-11 and two.bond_length_error.max() < 1e-4


def test_what_is_measured():
    chain = Chain([1.0, 1.2, 1.0], 3)
    state = bent(chain, 3)
    one = rigid_resistance(state.position, chain, 1.3)
    for units in SYSTEMS:
        length, time, force = units
        other, moved = in_units(chain, units), in_units(state, units)
        viscosity = 1.3 * force * time / length**2
        two = rigid_resistance(moved.position, other, viscosity)
        scale = np.repeat([1.0, length], 3)
        two = two * length / (force * time) / np.outer(scale, scale)
        assert np.abs(two / one - 1).max() < 1e-9
        fall = Weight(np.array([0.0, 0.0, -1.0]) * force)
        scene = Scene(other, viscosity, constraints=[Gears()], forces=[fall])
        found = friction_coefficient(0.0, moved, scene, 3 * fall.force)
        assert 20 < found * length / (force * time) < 60


def test_constraints_that_depend_are_named_in_any_units():
    chain = Chain(1.0, 5)
    constraints = [Gears(), PrescribedSpin(bead=2), PrescribedSpin(bead=2)]
    scene = Scene(chain, 1.3, constraints=constraints)
    for units in [(1.0, 1.0, 1.0), *SYSTEMS]:
        how = dynamics.redundancy(0.0, in_units(bent(chain), units), in_units(scene, units))
        assert how == (
            "PrescribedSpin(bead=2) + PrescribedSpin(bead=2) are redundant: 1 of their rows depends "
            "on the others"
        )


def single(tree):
    return jax.tree.map(lambda x: x.astype(jnp.float32), tree)


def micrometres(radius, dim, rigidity=1e-27, size=1e-6, **options):
    chain = Chain(size * np.asarray(radius), 5)
    options = {
        "constraints": [Gears()],
        "forces": [Bending(rigidity)],
        "flow": Shear(1.0),
    } | options
    return Scene(chain, 1e-3, **options), bent(chain, dim)


EQUAL, UNEQUAL = 1.0, [1.0, 1.0, 1.2, 1.0, 1.0]


@pytest.mark.parametrize("radius", [EQUAL, UNEQUAL], ids=["equal", "unequal"])
@pytest.mark.parametrize("dim", [2, 3])
def test_micrometres_in_single_precision(radius, dim):
    # SI: water, a stiff and a soft fibre, constraints on spins, loads; a nanometre too.
    extra = [Gears(), PrescribedPosition(bead=0), PrescribedSpin(bead=4)]
    weight = 1e-15 * np.array([1.0, -2.0, 0.5])[:dim]
    for options in (
        {},
        {"rigidity": 1e-24, "forces": [Bending(1e-24), Weight(weight)], "constraints": extra},
        {"size": 1e-9, "rigidity": 1e-30},
    ):
        scene, state = micrometres(radius, dim, **options)
        low_scene, low_state = single((scene, state))
        exact = dynamics.motion(0.0, state, scene)
        found, residual = instant(0.0, low_state, low_scene)
        assert found.velocity.dtype == jnp.float32
        for a, b in zip(jax.tree.leaves(exact), jax.tree.leaves(found), strict=True):
            assert np.abs(b - a).max() < 1e-4 * np.abs(a).max()
        assert residual < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(
    "radius, dim, options",
    [
        (UNEQUAL, 2, {}),
        (EQUAL, 3, {"substeps": 100}),
    ],
)
def test_micrometres_in_single_precision_over_time(radius, dim, options):
    scene, state = micrometres(radius, dim)
    ts = np.linspace(0.0, 2.0, 5)
    exact = quiet(scene, state, ts, **options)
    found = quiet(*single((scene, state)), ts, single_precision=True, **options)
    # To the tolerance of default steps, 1e-4 of the length, or to rounding.
    allowed = 1e-5 if options else 2e-4
    assert np.abs(found.states.position - exact.states.position).max() < allowed * 1e-5
    assert found.residual.max() < 1e-5 and found.bond_length_error.max() < 1e-4


def test_derivatives_in_single_precision():
    def fall(scale, scene, state):
        chain = Chain(scale * scene.chain.radius, scene.chain.fibres)
        other = Scene(chain, scale * scene.viscosity, scene.mobility, (), scene.forces, scene.flow)
        moved = State(scale * state.position)
        return dynamics.motion(0.0, moved, other).velocity.sum() * 1e6

    for radius in (EQUAL, UNEQUAL):
        for mobility in (None, FreeDraining()):
            options = {} if mobility is None else {"mobility": mobility}
            weight = Weight([1e-15, 2e-15, 0.0])
            scene, state = micrometres(radius, 3, forces=[Bending(1e-24), weight], **options)
            exact = jax.grad(fall)(1.0, scene, state)
            found = jax.grad(fall)(jnp.float32(1.0), *single((scene, state)))
            assert abs(found / exact - 1) < 1e-4


def test_what_single_precision_cannot_hold():
    scene, state = micrometres(EQUAL, 2, size=1e-11)
    with pytest.raises(
        ValueError, match=r"`scene` must be in units that suit single precision .*a\^3"
    ):
        quiet(*single((scene, state)), [0.0, 1.0], single_precision=True)


# Times.


def falling(dtype=jnp.float64, **options):
    chain = Chain(1.0, 1)
    scene = Scene(chain, 1.0, forces=[Weight([0.0, -1.0])], **options)
    return jax.tree.map(lambda x: x.astype(dtype), (scene, State([[0.0, 1.0]])))


EVEN = [
    1e6 + np.linspace(0, 1e-3, 11),
    -1e6 + np.linspace(0, 1e-3, 11),
    np.linspace(0, 1, 101, dtype=np.float32),
    jnp.linspace(0, 1, 101, dtype=jnp.float32),
    np.float32(1000) + np.linspace(0, 50, 51, dtype=np.float32),
    np.arange(101, dtype=np.float32) * np.float32(0.01),
    np.linspace(0, 1, 101),
    list(range(5)),
]


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("ts", EVEN, ids=range(len(EVEN)))
def test_times_that_are_even_to_rounding(ts, dtype):
    same = {"single_precision": dtype == jnp.float32}
    if dtype == jnp.float32 and abs(float(ts[0])) == 1e6:
        with pytest.raises(
            ValueError, match="`ts` must differ by more than the rounding of float32"
        ):
            quiet(*falling(dtype), ts, substeps=1, **same)
        return
    run = quiet(*falling(dtype), ts, substeps=1, **same)
    fall = run.states.position[-1, 0, 1] - run.states.position[0, 0, 1]
    span = float(np.asarray(run.ts)[-1] - np.asarray(run.ts)[0])
    # The second step is taken for as long as the first, which it is but for the rounding of the times.
    rounding = 2 * np.spacing(np.abs(np.asarray(ts)).max()) / span
    assert abs(fall * -6 * np.pi / span - 1) < (1e-4 if dtype == jnp.float32 else 1e-10 + rounding)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_times_that_are_not_even(dtype):
    late = 1e6 if dtype == np.float64 else 0.0
    for ts in (late + np.array([0, 1, 2, 3.01]) * 1e-4, late + np.array([0.0, 1.0, 2.0, 2.999])):
        for state_type in (jnp.float64, jnp.float32):
            if late and state_type == jnp.float32:
                continue
            with pytest.raises(ValueError, match="`ts` must be evenly spaced for AB3"):
                quiet(
                    *falling(state_type),
                    ts.astype(dtype),
                    substeps=1,
                    single_precision=state_type == jnp.float32,
                )


def test_steps_that_drown_in_the_rounding_of_times():
    with pytest.raises(
        ValueError, match=r"`ts` must leave equal steps of at least 100 times the roun"
    ):
        quiet(*falling(), 1e6 + np.linspace(0, 1e-7, 5), substeps=10)


def test_late_times_keep_the_accuracy():
    # The same fall and turn, from t = 0 and from t = 1e6; steps of 1e-4 are 1e6 times the rounding.
    chain = Chain(1.0, 4)
    forces = [Bending(20.0), Weight([0.0, -3.0])]
    scene = Scene(chain, 1.0, constraints=[Gears()], forces=forces, flow=Shear(50.0))
    state, ts = bent(chain), np.linspace(0.0, 1e-2, 5)
    for options in ({"substeps": 25}, {}):
        runs = [quiet(scene, state, late + ts, **options).final.position for late in (0.0, 1e6)]
        assert np.abs(runs[1] - runs[0]).max() < 1e-7


def test_a_whole_number_of_steps_stays_whole():
    scene, _ = falling()
    for step, late, dtype in ((0.01, 0.0, np.float64), (1e-4, 1e6, np.float64), (0.01, 0.0, "f4")):
        ts = (late + step * 10 * np.arange(4)).astype(dtype)
        assert substeps_for(scene, ts, float(np.asarray(step, dtype))) in (10, 12)
        assert substeps_for(scene, ts, step) == substeps_for(scene, step * 10 * np.arange(4), step)
    assert FixedSteps(AB3(substeps=10)).substeps == 10


def products(program):
    """The precision of each matrix product of a program, those within it included."""
    for step in program.eqns:
        if step.primitive.name == "dot_general":
            yield step.params["precision"]
        for inner in jax.tree.leaves(
            step.params, is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")
        ):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                yield from products(inner)


@pytest.mark.parametrize("dim", [2, 3])
def test_products_keep_all_digits_of_single_precision(dim):
    # Accelerators round float32 to 10 bits in a product whose precision is left to them.
    scene, state = single(
        micrometres(UNEQUAL, dim, forces=[Bending(1e-24), Weight(np.eye(dim)[1])])
    )
    large = eqx.tree_at(lambda s: s.mobility, scene, RPY(dense=False))
    ts = jnp.linspace(0.0, 0.1, 3, dtype=jnp.float32)
    held = eqx.tree_at(lambda s: s.constraints, scene, (Gears(), PrescribedPosition(bead=0)))

    def end(scene, **options):
        return rollout(scene, state, ts, single_precision=True, **options).final.position

    def slope(**options):
        return lambda scene: jax.grad(lambda x: jnp.sum(end(x, **options)))(scene)

    for function, argument in [
        (lambda scene: dynamics.motion(0.0, state, scene), scene),
        (lambda scene: dynamics.motion(0.0, state, scene), large),
        (lambda scene: dynamics.constraint_matrix(0.0, state, scene), held),
        (partial(end, substeps=4), scene),
        (slope(substeps=4), held),
        (slope(), scene),
    ]:
        found = list(products(jax.make_jaxpr(function)(argument).jaxpr))
        highest = (jax.lax.Precision.HIGHEST,) * 2
        assert found and all(precision == highest for precision in found)
