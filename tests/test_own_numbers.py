"""Forces that own numbers: integrated, saved, restarted, differentiated with the rest of the state."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent

import jaxbeads as jb
from jaxbeads import Chain, Load, Scene, State, dynamics, rollout, simulate
from jaxbeads.constraint import Gears
from jaxbeads.force import AbstractForce, Bending, Weight
from jaxbeads.geometry import bond_lengths
from jaxbeads.mobility import FreeDraining


class Adapting(AbstractForce):
    """A force along x on the first bead that follows `goal` with a time constant: F = f a with
    da/dt = (goal(t) - a)/time."""

    rotational: ClassVar[bool] = False
    force: jax.Array = eqx.field(converter=jnp.asarray)
    time: jax.Array = eqx.field(converter=jnp.asarray)
    first: jax.Array = eqx.field(converter=jnp.asarray, default=0.0)

    def begin(self, state, scene):
        return self.first

    def own_rate(self, t, state, scene):
        return (jnp.sin(t) - state.own) / self.time

    def load(self, t, state, scene):
        return Load(jnp.zeros_like(state.position).at[0, 0].set(self.force * state.own))


class Stretched(Adapting):
    """As before, but what is followed is the length of the first bond, and there is a number for it."""

    def begin(self, state, scene):
        return jnp.array([[1.0]])

    def own_rate(self, t, state, scene):
        return (bond_lengths(state.position)[:1, None] / 2 - state.own) / self.time

    def load(self, t, state, scene):
        push = self.force * (state.own[0, 0] - 1)
        return Load(jnp.zeros_like(state.position).at[:2, 0].set(jnp.stack([push, -push])))


ONE = Chain(1.0, 1)
START = State(jnp.zeros((1, 2)))


def adapted(t, tau):
    """a(t) and its integral, from a(0) = 0."""
    w = 1 + tau**2
    a = (np.sin(t) - tau * np.cos(t) + tau * np.exp(-t / tau)) / w
    total = (1 - np.cos(t) - tau * np.sin(t) + tau**2 * (1 - np.exp(-t / tau))) / w
    return a, total


def alone(tau=0.7, force=3.0, **others):
    return Scene(ONE, 1.0, forces=[Weight([0.0, 0.0]), Adapting(force, tau)], **others)


OPTIONS = {
    "AB3": {"substeps": 400},
    "Tsit5": {"tolerance": 1e-9},
    "Rosenbrock": {"solver": jb.Rosenbrock(tolerance=1e-9)},
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_the_closed_form_of_a_force_that_adapts(options):
    tau, ts = 0.7, np.linspace(0.0, 4.0, 5)
    run = rollout(alone(tau), START, ts, **options)
    a, total = adapted(ts, tau)
    assert run.code == 0
    (none, own) = run.states.own
    assert none is None and np.abs(own - a).max() < 1e-6
    assert np.abs(run.states.position[:, 0, 0] - 3 * total / (6 * np.pi)).max() < 1e-6


def test_it_is_differentiated():
    ts = np.linspace(0.0, 2.0, 3)

    def end(tau, first):
        scene = Scene(ONE, 1.0, forces=[Adapting(3.0, tau, first)])
        return rollout(scene, START, ts, tolerance=1e-9).final.position[0, 0]

    slopes = jax.grad(end, (0, 1))(0.7, 0.0)
    h = 1e-5
    by_time = (adapted(2.0, 0.7 + h)[1] - adapted(2.0, 0.7 - h)[1]) / (2 * h) * 3 / (6 * np.pi)
    by_first = 3 * 0.7 * (1 - np.exp(-2.0 / 0.7)) / (6 * np.pi)
    assert abs(slopes[0] - by_time) < 1e-6 and abs(slopes[1] - by_first) < 1e-6


@pytest.mark.parametrize("options", [{}, {"substeps": 20}], ids=["adaptive", "equal"])
def test_it_is_saved_and_resumed(tmp_path, options):
    scene, ts, path = alone(), np.linspace(0.0, 2.0, 9), tmp_path / "run.h5"
    whole = simulate(scene, START, ts, file=path, progress=False, **options)
    read = jb.load(path)
    assert read.states.own[0] is None and np.array_equal(read.states.own[1], whole.states.own[1])
    part = tmp_path / "part.h5"
    stops = {"file": part, "chunk": 2, "progress": False, **options}
    simulate(scene, START, ts, until=lambda run: len(run.ts) > 3, **stops)
    jb.resume(part, scene, progress=False, **options)
    again = jb.load(part)
    assert jax.tree.all(jax.tree.map(np.array_equal, again.states, whole.states))
    assert "own[1] (9,)" in again.summary()


def test_exact_derivatives_of_an_implicit_step():
    """In a chain, with what is owned depending on the shape: against differences, through Rosenbrock."""
    chain = Chain(1.0, 4)
    terms = [Bending(20.0), Weight([0.1, -0.3]), Adapting(2.0, 0.5), Stretched(1.0, 0.4)]
    scene = Scene(chain, 1.0, constraints=[Gears()], forces=terms)
    start, ts = bent(chain, 2), np.linspace(0.0, 3.0, 3)
    ends = [rollout(scene, start, ts, tolerance=tol).final for tol in (1e-4, 1e-9)]
    fine = rollout(scene, start, ts, substeps=6000).final
    for end, bound in zip(ends, (2e-3, 2e-7), strict=True):
        for a, b in zip(*map(jax.tree.leaves, (end, fine)), strict=True):
            assert np.abs(a - b).max() < bound


def test_a_steady_state_settles_what_is_owned():
    # Loosely bound beads in a still fluid: the shape and the number come to rest together.
    chain = Chain(1.0, 3)
    scene = Scene(
        chain, 1.0, FreeDraining(), forces=[jb.force.Spring(5.0), Bending(4.0), Stretched(1.0, 0.4)]
    )
    start = jb.straight(chain, [1.0, 0.0])
    pulled = eqx.tree_at(lambda s: s.position, start, start.position * 1.03)
    found = jb.steady_state(scene, pulled)
    assert found.converged
    assert abs(found.state.own[2][0, 0] - 1.0) < 1e-8
    assert abs(dynamics.rate(0.0, found.state, scene).own[2]).max() < 1e-8


def test_nothing_is_owned_where_no_force_owns():
    chain = Chain(1.0, 4)
    scene = Scene(chain, 1.0, constraints=[Gears()], forces=[Bending(20.0)])
    assert scene.begin(bent(chain, 2)).own is None
    wrong = eqx.tree_at(lambda s: s.own, START, (None, jnp.zeros(3)), is_leaf=lambda x: x is None)
    with pytest.raises(ValueError, match=r"state\.own"):
        rollout(alone(), wrong, [0.0, 1.0])
