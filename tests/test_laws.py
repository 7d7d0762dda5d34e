"""Users' functions, wherever a term takes one: what they may return, and what is said of the rest."""

import functools
import math
import re
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from cases import bent, jointed

from jaxbeads import (
    Chain,
    Scene,
    check,
    dynamics,
    rollout,
    simulate,
    steady_state,
    straight,
    with_frames,
)
from jaxbeads.constraint import (
    Gears,
    Joint,
    PrescribedDirection,
    PrescribedLengths,
    PrescribedPosition,
    PrescribedSpin,
)
from jaxbeads.flow import VelocityField
from jaxbeads.force import (
    Bending,
    BendingEnergy,
    DrivingMoment,
    ElasticRod,
    ForceField,
    JointBending,
    Potential,
    Spring,
    Weight,
)
from jaxbeads.saddle import slips
from jaxbeads.state import zero_motion

CHAIN = Chain(1.0, 5)
PLANE, SPACE = bent(CHAIN), bent(CHAIN, 3)
SWING = jnp.array([0.3, -0.2, 0.5, 0.1, -0.4])


@pytest.fixture(autouse=True)
def as_for_users(monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def model(*constraints, forces=(), flow=None, chained=True):
    chain = [Gears()] if chained else []
    forces = [Weight([0.1, -0.4]), *forces]
    return Scene(CHAIN, 1.0, constraints=[*chain, *constraints], forces=forces, flow=flow)


def on_joints(function):
    joints = JointBending(3.0, function)
    return Scene(CHAIN, 1.0, constraints=[Joint()], forces=[joints]), jointed(CHAIN)


def in_space(function):
    rod = ElasticRod(3.0, 2.0, None, lambda t, s, length: 0.1 * s, function)
    return Scene(CHAIN, 1.0, constraints=[Gears()], forces=[rod]), with_frames(SPACE, CHAIN)


def alone(size):
    """A law of time with so many components."""
    return lambda t: jnp.sin(t * (1 + SWING[:size])) + SWING[:size]


def along_fibre(t, s, length):
    return 0.2 * jnp.sin(s / length - t)


# Where: what makes scene and state of a function; the name of the function; a smooth one.
PLACES = {
    "position": (
        lambda f: (model(PrescribedPosition(f, bead=1)), PLANE),
        "PrescribedPosition.law",
        alone(2),
    ),
    "spin": (lambda f: (model(PrescribedSpin(f)), PLANE), "PrescribedSpin.law", alone(1)),
    "direction": (
        lambda f: (model(PrescribedDirection(f, bond=1)), PLANE),
        "PrescribedDirection.law",
        alone(2),
    ),
    "lengths": (
        lambda f: (model(PrescribedLengths(f), chained=False), PLANE),
        "PrescribedLengths.law",
        alone(4),
    ),
    "curvature": (
        lambda f: (model(forces=[Bending(3.0, f)]), PLANE),
        "Bending.intrinsic_curvature",
        along_fibre,
    ),
    "curvature, energy": (
        lambda f: (model(forces=[BendingEnergy(3.0, f)]), PLANE),
        "BendingEnergy.intrinsic_curvature",
        along_fibre,
    ),
    "curvature, joints": (on_joints, "JointBending.intrinsic_curvature", along_fibre),
    "moment": (
        lambda f: (model(forces=[DrivingMoment(f)]), PLANE),
        "DrivingMoment.moment",
        along_fibre,
    ),
    "rod": (in_space, "ElasticRod.second_curvature", along_fibre),
    "force": (
        lambda f: (model(forces=[ForceField(f)]), PLANE),
        "ForceField.function",
        lambda t, r: jnp.sin(0.3 * r + t),
    ),
    "energy": (
        lambda f: (model(forces=[Potential(f)]), PLANE),
        "Potential.function",
        lambda t, r: jnp.sum(jnp.sin(0.3 * r + t)),
    ),
    "flow": (
        lambda f: (model(flow=VelocityField(f)), PLANE),
        "VelocityField.function",
        lambda t, x: jnp.sin(0.2 * x[::-1] + t),
    ),
}
ALL = pytest.mark.parametrize("make, name, smooth", PLACES.values(), ids=PLACES)


def shape_of(make, smooth):
    """Of the value of a function at that place."""
    found = []

    def watched(*arguments):
        found.append(jnp.shape(smooth(*arguments)))
        return smooth(*arguments)

    check(*make(watched))
    return found[0]


def parts(value, kind):
    """An array as lists or tuples of numbers."""
    return kind(parts(row, kind) for row in value) if value.ndim else value


# What the value of a smooth function is made.
FORMS = {
    "list": lambda value: parts(value, list),
    "tuple": lambda value: parts(value, tuple),
    "list of rows": lambda value: [*value] if value.ndim else value,
    "float32": lambda value: value.astype(jnp.float32),
    "weak": lambda value: 1.0 * value,
}
# Of a constant one, from an array of whole numbers.
CONSTANTS = {
    "integers": jnp.asarray,
    "numpy integers": np.asarray,
    "numpy": lambda c: c.astype(float),
    "numpy float32": lambda c: c.astype(np.float32),
    "unsigned": lambda c: np.abs(c).astype(np.uint8),
    "Python numbers": lambda c: c.tolist(),
    "Python floats": lambda c: c.astype(float).tolist(),
    "numpy scalars": lambda c: parts(c, list),
    "tuple": lambda c: parts(c, tuple),
}


def felt(make, function, t=0.7):
    """What a function makes of the rows of the constraints, the loads and the flow."""
    scene, state = make(function)
    check(scene, state)
    t = jnp.asarray(t)
    slip = slips(t, state, scene)(zero_motion(state, True))
    return slip, dynamics.applied_load(t, state, scene), dynamics.fluid_motion(t, state, scene)


def same(one, other, tolerance=1e-13):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert a.dtype == b.dtype == jnp.float64
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance)


@ALL
def test_every_form_of_a_value_counts_alike(make, name, smooth):
    exact = felt(make, smooth)
    for form, change in FORMS.items():
        found = felt(make, lambda *x, change=change: change(smooth(*x)))
        same(found, exact, 1e-5 if form == "float32" else 1e-13)


@ALL
def test_every_form_of_a_constant_counts_alike(make, name, smooth):
    numbers = np.resize([1, 2, 0, 3, 1], shape_of(make, smooth))
    exact = felt(make, lambda *_: jnp.asarray(numbers, float))
    for change in CONSTANTS.values():
        same(felt(make, lambda *_, change=change: change(numbers)), exact)


# One law, one function along the fibre, one of the beads and one of space: whole runs, too.
RUN = "PrescribedPosition.law", "Bending.intrinsic_curvature", "ForceField", "VelocityField"


@ALL
def test_derivatives_go_through_lists(make, name, smooth):
    scene, state = make(lambda *x: parts(smooth(*x), list))

    def loss(viscosity):
        changed = eqx.tree_at(lambda s: s.viscosity, scene, viscosity)
        if not name.startswith(RUN):
            return jnp.sum(dynamics.motion(0.7, state, changed).velocity ** 2)
        return jnp.sum(
            rollout(changed, state, np.linspace(0, 0.1, 3), substeps=2).final.position ** 2
        )

    assert jax.eval_shape(jax.vmap(jax.grad(loss)), jnp.ones(2)).shape == (2,)


@ALL
def test_single_precision_stays_so(make, name, smooth):
    # Arrays of numpy are in float64 and make the value so.
    factor = np.ones(shape_of(make, smooth))
    scene, state = jax.tree.map(
        lambda x: x.astype(jnp.float32), make(lambda *x: factor * smooth(*x))
    )
    check(scene, state, single_precision=True)
    found = jax.eval_shape(dynamics.motion, jnp.asarray(0.7, jnp.float32), state, scene)
    assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {jnp.dtype("float32")}


@ALL
def test_a_whole_number_is_a_time(make, name, smooth):
    same(felt(make, smooth, 2), felt(make, smooth, 2.0))


def fails(*_):
    raise ValueError


def long_story(*_):
    raise RuntimeError("It fails. Twice, at 0x7f00, in <object object at 0x7f00>\nand more")


def branching(x):
    if jnp.sum(x) > 0:
        return x
    return -x


# What is wrong with it, given the smooth function's value; what is said.
WRONG = {
    "numpy": (
        lambda v, x: np.sin(x[0]) + v,
        "it calls numpy: use jax.numpy, as jnp.sin for np.sin",
    ),
    "numpy array": (lambda v, x: np.array([x[0], 0.0]), "it calls numpy: use jax.numpy"),
    "math": (lambda v, x: math.sin(x[0]) + v, "use jax.numpy for math"),
    "float": (lambda v, x: float(x[0]) + v, "jnp.asarray for float"),
    "if": (lambda v, x: branching(x[0]) + v, "jnp.where for if"),
    "range": (lambda v, x: sum(range(x[0])) + v, "but it"),
    "nothing": (lambda v, x: None, "must return numbers, but it returns None"),
    "word": (lambda v, x: "up", "must return numbers, but it returns 'up'"),
    "list of nothing": (lambda v, x: [v, None], "but it returns a list that holds None"),
    "dictionary": (lambda v, x: {"x": v}, "must return numbers, but it returns a dict"),
    "complex": (
        lambda v, x: v + 1j,
        "must return real numbers, but it returns numbers of type complex",
    ),
    "truth": (lambda v, x: v > 0, "must return real numbers, but it returns numbers of type bool"),
    "objects": (
        lambda v, x: np.array([object()]),
        "must return one array of numbers, but it returns a",
    ),
    "ragged": (
        lambda v, x: [jnp.ones(2), jnp.ones(3)],
        "must return one array of numbers, but it returns a list of parts that do not fit together",
    ),
    "shape": (lambda v, x: jnp.ones((7, 7)), "but it has shape (7, 7)"),
    "wordless": (fails, "but it raises: ValueError"),
    "wordy": (long_story, "but it raises: It fails."),
    "sum with a word": (lambda v, x: x[0] + "a", "but it raises: "),
}


@pytest.mark.parametrize("wrong, says", WRONG.values(), ids=WRONG)
@ALL
def test_what_is_no_law_is_refused_in_one_sentence(make, name, smooth, wrong, says):
    def function(*arguments):
        return wrong(smooth(*arguments), arguments)

    scene, state = make(function)
    refused(name, says, lambda: check(scene, state))


def refused(name, says, call, tidy=True):
    with pytest.raises(ValueError, match=re.escape(says)) as caught:
        call()
    text = str(caught.value)
    assert not getattr(caught.value, "__notes__", []) or not tidy, caught.value.__notes__
    assert text.startswith(f"Argument `{name}` must "), text
    assert re.fullmatch(r"[^\n]+, but [^\n]+[^.\s]\.", text), text
    assert not re.search(r"[.!?] [A-Z]|Traced|Tracer|0x[0-9a-f]", text), text


@ALL
@pytest.mark.parametrize("go", [rollout, simulate, dynamics.motion], ids=lambda go: go.__name__)
def test_it_is_refused_wherever_it_is_run(make, name, smooth, go):
    scene, state = make(lambda *arguments: np.cos(arguments[0]) * smooth(*arguments))
    times = [0.0, 0.1]
    arguments = (0.0, state, scene) if go is dynamics.motion else (scene, state, times)
    tidy = go is not dynamics.motion  # JAX adds a note to what is raised within `jit`
    refused(name, "it calls numpy", lambda: go(*arguments), tidy)


@ALL
def test_another_number_of_arguments_is_refused(make, name, smooth):
    for function in (lambda: 1.0, lambda a, b, c, d: a):
        scene, state = make(function)
        refused(name, "but it raises: ", lambda scene=scene, state=state: check(scene, state))


FUNCTIONLESS = {
    "law": [PrescribedPosition, PrescribedSpin, PrescribedDirection, PrescribedLengths],
    "function": [ForceField, Potential, VelocityField],
}


@pytest.mark.parametrize("given", ["up", 1.0, [1.0, 0.0], np.ones(2), jnp.ones(2), {}], ids=str)
@pytest.mark.parametrize(
    "name, term", [(name, term) for name, terms in FUNCTIONLESS.items() for term in terms]
)
def test_numbers_are_no_function(name, term, given):
    refused(name, f"Argument `{name}` must be a function", lambda: term(given))


class Beat(eqx.Module):
    """A user's law with a parameter, that returns a list."""

    rate: jax.Array

    def __call__(self, t):
        return [jnp.sin(self.rate * t), 0]


class Ramp:
    """A law that is no pytree and cannot be hashed."""

    __hash__ = None

    def __call__(self, t):
        return (t, 0)


class Network(eqx.Module):
    """A function with a leaf that is no number."""

    weights: jax.Array
    activation: Callable

    def __call__(self, t):
        return self.activation(self.weights, t)


def test_parameters_stay_leaves():
    scene = model(PrescribedPosition(Beat(jnp.asarray(2.0))))
    assert scene.constraints[1].law.rate == 2.0

    def speed(rate):
        changed = eqx.tree_at(lambda s: s.constraints[1].law.rate, scene, rate)
        return dynamics.motion(0.3, PLANE, changed).velocity[0, 0]

    value, slope = jax.value_and_grad(speed)(jnp.asarray(3.0))
    assert abs(value - 3 * math.cos(0.9)) < 1e-13
    assert abs(slope - (math.cos(0.9) - 0.9 * math.sin(0.9))) < 1e-13


@pytest.mark.parametrize(
    "law",
    [
        Ramp(),
        functools.partial(lambda speed, t: [speed * t, 0.0], 1.0),
        jax.tree_util.Partial(lambda speed, t: [speed * t, 0.0], 1.0),
        jax.jit(lambda t: [t, 0.0]),
        eqx.filter_jit(lambda t: (t, 0)),
        Network(jnp.asarray([1.0, 0.0]), jnp.multiply),
    ],
    ids=["unhashable", "partial", "Partial", "jit", "filter_jit", "network"],
)
def test_whatever_can_be_called_is_a_law(law):
    scene = model(PrescribedPosition(law))
    end = rollout(scene, PLANE, [0.0, 0.5], substeps=2).final.position
    np.testing.assert_allclose(end[0], PLANE.position[0] + jnp.array([0.5, 0.0]), atol=1e-12)
    check(scene, PLANE)


def test_the_law_of_the_issue_is_followed():
    # A list of numbers, some of which depend on time.
    scene = model(PrescribedPosition(lambda t: [jnp.sin(t), 0.0]), forces=[Bending(10.0)])
    solution = simulate(scene, PLANE, np.linspace(0, 0.4, 3), tolerance=1e-8, progress=False)
    path = np.asarray(solution.states.position[:, 0]) - np.asarray(PLANE.position[0])
    np.testing.assert_allclose(path, np.stack([np.sin(solution.ts), [0, 0, 0]], 1), atol=1e-6)


def test_a_steady_state_takes_lists():
    chain = Chain(1.0, 3)
    scene = Scene(
        chain,
        1.0,
        constraints=[Gears(), PrescribedPosition(lambda t: [0, 0])],
        forces=[Bending(10.0, lambda t, s, length: [0]), ForceField(lambda t, r: 0 * r + 1)],
    )
    found = steady_state(scene, straight(chain, [0.7, 0.72]), moving=False, t=0)
    ends = found.state.position[2] - found.state.position[0]
    np.testing.assert_allclose(ends, 4 / np.sqrt(2) * np.ones(2), atol=1e-7)


def test_fields_may_say_that_they_link_neighbours():
    pull = functools.partial(jnp.sum, axis=None)
    assert not ForceField(pull).links and not Potential(pull).links
    assert ForceField(pull, links=True).links and Potential(pull, links=True).links
    assert Spring.links and Gears.links and PrescribedLengths.links
