"""`vary` and `optimise` on functions whose answers are known."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from cases import bent, scene

from jaxbeads import Chain, dynamics
from jaxbeads.optimise import optimise
from jaxbeads.vary import vary


def valley(x):
    return (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2


def quiet(loss, start, **options):
    return optimise(loss, start, progress=False, **options)


def test_least_value():
    found = quiet(valley, jnp.array([-1.0, 1.0]))
    assert np.abs(found.values - 1).max() < 1e-6 and found.loss < 1e-12
    assert found.status == "the gradient vanishes"
    history = found.history
    assert len(history.loss) < 60 and history.loss[0] == 4.0 and np.all(np.diff(history.time) > 0)
    assert history.gradient_norm[-1] < 1e-6 <= history.gradient_norm[-2]
    # Any optimiser of optax; it says that it is not there yet.
    slow = quiet(valley, jnp.array([-1.0, 1.0]), optimiser=optax.adam(0.05), steps=30)
    assert slow.status == "took all 30 steps" and len(slow.history.loss) == 30
    assert abs(slow.loss - slow.history.loss.min()) < 1e-12


def test_one_program_for_all_steps():
    traced = []

    def loss(x):
        traced.append(0)
        return valley(x)

    quiet(loss, jnp.array([-1.0, 1.0]), steps=1)
    once = len(traced)
    quiet(loss, jnp.array([-1.0, 1.0]), steps=30)
    assert len(traced) == 2 * once


def test_bounds_are_kept():
    def loss(x):
        return jnp.sum((x["a"] - 2) ** 2) + (x["b"] + 1) ** 2

    start = {"a": jnp.array([0.5, -0.5]), "b": jnp.asarray(3.0)}
    bounds = {"a": -1.0, "b": 0.5}, {"a": jnp.array([1.0, 5.0]), "b": np.inf}
    found = quiet(loss, start, bounds=bounds)
    assert np.abs(np.asarray(found.values["a"]) - [1.0, 2.0]).max() < 1e-3
    assert found.values["a"][0] <= 1 and 0.5 <= found.values["b"] < 0.501
    upper = quiet(lambda x: (x - 2) ** 2, 0.0, bounds=(-np.inf, 1.0))
    assert 0.99 < upper.values <= 1
    with pytest.raises(ValueError, match="Argument `start` must lie within its bounds"):
        quiet(loss, start, bounds=(0.0, 1.0))


def test_a_constraint_is_met():
    # The lowest point of a circle, and the largest product at a given sum of squares.
    found = quiet(lambda x: x[0] + x[1], jnp.array([0.3, -2.0]), constraint=lambda x: x @ x - 1)
    assert np.abs(found.values + np.sqrt(0.5)).max() < 1e-6 and found.violation < 1e-6
    # The same from one function.
    found = quiet(lambda x: (x[0] + x[1], x @ x - 1), jnp.array([0.3, -2.0]))
    assert np.abs(found.values + np.sqrt(0.5)).max() < 1e-6 and found.violation < 1e-6
    found = quiet(
        lambda x: -jnp.prod(x), jnp.array([1.0, 2.0, 0.5]), constraint=lambda x: x @ x - 3
    )
    assert np.abs(found.values - 1).max() < 1e-6


def test_many_starts():
    starts = jnp.array([[-1.0, 1.0], [0.5, -0.5], [2.0, 2.0]])
    found = quiet(valley, starts, many=True)
    assert found.values.shape == (3, 2) and found.loss.shape == (3,)
    assert np.abs(found.values - 1).max() < 1e-5
    assert found.history.loss.shape[1] == 3
    # A start without a finite loss spoils no other.
    odd = quiet(lambda x: jnp.sum(jnp.sqrt(x) ** 4 - x), jnp.array([[-1.0], [2.0]]), many=True)
    assert abs(odd.values[1, 0] - 0.5) < 1e-5 and not np.isfinite(odd.loss[0])


def test_stop_and_go_on(tmp_path):
    start = jnp.array([-1.0, 1.0])
    whole = quiet(valley, start, steps=20)
    quiet(valley, start, steps=8, file=tmp_path / "walk")
    rest = quiet(valley, start, steps=20, file=tmp_path / "walk")
    assert np.all(rest.values == whole.values)
    assert np.all(rest.history.loss == whole.history.loss)
    with pytest.raises(ValueError, match="Argument `file` must hold this optimisation"):
        quiet(lambda x: x @ x, jnp.ones(3), file=tmp_path / "walk")
    (tmp_path / "other").write_text("no")
    with pytest.raises(ValueError, match="Argument `file` must hold an optimisation"):
        quiet(valley, start, file=tmp_path / "other")


def test_a_loss_that_is_not_finite():
    found = quiet(lambda x: jnp.where(x > 0.5, x**2, jnp.nan), 2.0, optimiser=optax.sgd(0.1))
    assert "not finite at step" in found.status
    assert found.values > 0.5 and np.isfinite(found.loss)  # the last good ones
    with pytest.raises(ValueError, match="Argument `start` must be finite"):
        quiet(valley, jnp.array([np.nan, 0.0]))
    with pytest.raises(ValueError, match="Argument `steps` must be"):
        quiet(valley, jnp.ones(2), steps=0)


def test_vary():
    chain = Chain(1.0, 4)
    model, state = scene(chain), bent(chain)

    def fall(model, t):
        return jnp.sum(dynamics.motion(t, state, model).velocity[:, 1])

    one = vary(fall, model, lambda m: m.viscosity)
    assert one.start == 1.3
    assert abs(one(2.6, 0.0) - fall(vary(lambda m: m, model, one.where)(2.6), 0.0)) == 0
    assert abs(jax.jit(one)(2.6, 0.0) / one(2.6, 0.0) - 1) < 1e-14
    best = quiet(lambda x: (one(x, 0.0) / one(2.6, 0.0) - 1) ** 2, one.start, bounds=(0.1, 10.0))
    assert abs(best.values - 2.6) < 1e-4
    assert quiet(vary(valley, jnp.ones(2), lambda x: x), jnp.zeros(2), steps=9).loss < 1
    several = vary(fall, model, lambda m: (m.viscosity, m.forces[1].rigidity))
    slopes = jax.grad(several)(several.start, 0.0)
    h = 1e-6
    for k, slope in enumerate(slopes):
        moved = [[x + s * h * (i == k) for i, x in enumerate(several.start)] for s in (1, -1)]
        difference = (several(tuple(moved[0]), 0.0) - several(tuple(moved[1]), 0.0)) / (2 * h)
        assert abs(slope - difference) < 1e-6 * abs(slope)
    assert jax.vmap(lambda k: one(k, 0.0))(jnp.array([1.0, 2.0])).shape == (2,)
    with pytest.raises(ValueError, match="Argument `where` must pick arrays of numbers"):
        vary(fall, model, lambda m: m.forces[1])
    with pytest.raises(ValueError, match="Argument `values` must have the structure"):
        one((1.0, 2.0), 0.0)
