"""When two models, and the functions in them, count as the same."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbeads import Chain, Scene
from jaxbeads.constraint import Gears, PrescribedPosition
from jaxbeads.contents import Contents, Law
from jaxbeads.flow import VelocityField
from jaxbeads.force import Bending, ForceField, Weight

CHAIN = Chain(1.0, 5)
STRENGTH = 2.0
TABLE = np.array([1.0, 2.0])


def made_from(text, **names):
    """A function as another process makes it."""
    return eval(text, {"jnp": jnp, "np": np} | names)


def holding(value):
    return lambda t, x: value * x


def other_code(value):
    return lambda t, x: value + x


def named(value):
    def law(t, x):
        return value * x

    return law


def with_default(t, x, k=1.0, *, n=2):
    return k * n * x


def reading(t, x):
    return STRENGTH * TABLE[0] * x


def calling(t, x):
    return helper(x)


def helper(x):
    return 3.0 * x


class Pull:
    def __init__(self, k):
        self.k = k

    def __call__(self, t, x):
        return self.k * x

    def method(self, t, x):
        return self.k * x


def difference(before, now):
    """As from a file."""
    before, now = Contents(law=before), Contents(law=now)
    read = Contents.read(before.text(), iter(before.numbers))
    assert read.difference(before) is None
    return read.difference(now)


SAME = {
    "the same": (holding(1.0), holding(1.0)),
    "another name": (holding(1.0), named(1.0)),
    "an array": (holding(jnp.arange(3.0)), holding(jnp.arange(3.0))),
    "not a number": (holding(np.nan), holding(np.nan)),
    "nested": (holding(holding(1.0)), holding(holding(1.0))),
    "jitted": (jax.jit(holding(1.0)), jax.jit(holding(1.0))),
    "vmapped": (jax.vmap(holding(1.0)), jax.vmap(holding(1.0))),
    "partial": (functools.partial(with_default, k=2.0), functools.partial(with_default, k=2.0)),
    "an object": (Pull(1.0), Pull(1.0)),
    "a method": (Pull(1.0).method, Pull(1.0).method),
    "of a package": (jnp.sin, jnp.sin),
    "elsewhere": (
        made_from("lambda t: jnp.where(t in {1.5, 'b', 'a'}, 2.0, t)"),
        made_from("lambda t: jnp.where(t in {'a', 1.5, 'b'}, 2.0, t)"),
    ),
    "what cannot be told": (holding(object()), holding(object())),
    "a global": (made_from("lambda t: t * k", k=2.0), made_from("lambda t: t * k", k=2.0)),
}


@pytest.mark.parametrize("before, now", SAME.values(), ids=SAME)
def test_functions_that_are_the_same(before, now):
    assert difference(before, now) is None


OTHERS = {
    "a number": (holding(1.0), holding(1.5), "`law.value` was 1.0 and is 1.5"),
    "a type": (holding(1.0), holding(1), "`law.value` was 1.0 and is 1"),
    "an array": (
        holding(jnp.arange(3.0)),
        holding(jnp.ones(3)),
        r"`law.value\[0\]` was 0.0 and is 1",
    ),
    "code": (holding(1.0), other_code(1.0), "`law` was holding.* and is other_code.*lambda>"),
    "a constant": (
        made_from("lambda t: 1.0 * t"),
        made_from("lambda t: 2.0 * t"),
        "`law` was a function of other code",
    ),
    "a function in it": (
        made_from("lambda t: jnp.sin(t)"),
        made_from("lambda t: jnp.cos(t)"),
        "other code",
    ),
    "code within code": (
        made_from("lambda t: (lambda s: s + 1)(t)"),
        made_from("lambda t: (lambda s: s + 2)(t)"),
        "other code",
    ),
    "a global": (
        made_from("lambda t: k * t", k=1.0),
        made_from("lambda t: k * t", k=2.0),
        "`law.k` was 1.0 and is 2.0",
    ),
    "a default": (
        functools.partial(with_default, k=2.0),
        functools.partial(with_default, k=3.0),
        r"`law.arguments\[1\]\['k'\]` was 2.0 and is 3.0",
    ),
    "a function that it calls": (
        made_from("lambda t: f(t)", f=holding(1.0)),
        made_from("lambda t: f(t)", f=holding(2.0)),
        "`law.f.value` was 1.0 and is 2.0",
    ),
    "in a tree": (
        holding(jax.tree_util.Partial(holding(1.0))),
        holding(jax.tree_util.Partial(holding(2.0))),
        "`law.value.value` was 1.0 and is 2.0",
    ),
    "jitted": (jax.jit(holding(1.0)), jax.jit(holding(2.0)), "value` was 1.0 and is 2.0"),
    "vmapped": (jax.vmap(holding(1.0)), jax.vmap(holding(2.0)), "value` was 1.0 and is 2.0"),
    "an object": (Pull(1.0), Pull(2.0), "`law.k` was 1.0 and is 2.0"),
    "a method": (Pull(1.0).method, Pull(2.0).method, "k` was 1.0 and is 2.0"),
    "of a package": (jnp.sin, jnp.cos, "`law` was sin and is cos"),
}


@pytest.mark.parametrize("before, now, says", OTHERS.values(), ids=OTHERS)
def test_functions_that_are_not_the_same(before, now, says):
    found = difference(before, now)
    assert found is not None and re.search(says, found), found


def test_globals_defaults_and_helpers_are_read(monkeypatch):
    before = Contents(a=reading, b=calling, c=with_default)
    assert {"a.STRENGTH", "a.TABLE", "b.helper", "c.k", "c.n"} <= set(before.entries)
    monkeypatch.setitem(globals(), "STRENGTH", 2.5)
    now = Contents(a=reading, b=calling, c=with_default)
    assert before.difference(now) == "`a.STRENGTH` was 2.0 and is 2.5"
    monkeypatch.undo()
    monkeypatch.setitem(globals(), "helper", lambda x: 4.0 * x)
    now = Contents(a=reading, b=calling, c=with_default)
    assert "`b.helper` was helper and is" in before.difference(now)


def test_code_of_another_python_is_not_compared():
    law, later = Law("law", "abc", "3.11"), Law("law", "def", "3.12")
    assert law.same(later) and not law.same(Law("law", "def", "3.11"))
    assert not law.same(Law("other", "abc", "3.12"))


def test_a_function_that_holds_itself():
    def law(t):
        return law(t - 1)

    assert difference(law, law) is None


def scene(weight=(0.0, -1.0), rigidity=1.0, flow=None, **terms):
    forces = [Bending(rigidity), Weight(list(weight))]
    terms = {"constraints": [Gears()], "forces": forces} | terms
    return Scene(CHAIN, 1.0, flow=flow, **terms)


def test_scenes_are_compared_entry_by_entry():
    first = Contents(scene=scene())
    assert first.difference(Contents(scene=scene())) is None
    for other, says in (
        (scene(weight=(0.0, -2.0)), "`scene.forces[1].force[1]` was -1.0 and is -2.0"),
        (scene(weight=(0.0, -1.0, 0.0)), "`scene.forces[1].force` had shape (2,) and has (3,)"),
        (scene(constraints=[]), "`scene.constraints` was (Gears) and is ()"),
        (scene(flow=VelocityField(lambda t, x: x)), "`scene.flow` was None and is VelocityField"),
        (
            scene(forces=[Bending(1.0), ForceField(lambda t, x: x)]),
            "`scene.forces` was (Bending, Weight) and is (Bending, ForceField)",
        ),
    ):
        assert first.difference(Contents(scene=other)) == says
    held = [PrescribedPosition(bead=0), PrescribedPosition(bead=1)]
    a, b = (Contents(scene=scene(constraints=[c])) for c in held)
    assert a.difference(b) == "`scene.constraints[0].bead` was 0 and is 1"
    float32 = jax.tree.map(lambda x: x.astype(jnp.float32), scene())
    assert "was of type float64 and is of float32" in first.difference(Contents(scene=float32))
