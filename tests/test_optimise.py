"""`vary` and `optimise` on functions whose answers are known."""

from functools import cache

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
    least = 1e-7 * history.gradient_norm.max()
    assert history.gradient_norm[-1] < least <= history.gradient_norm[-2]
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


# Each of two arrays of values, the loss and two constraints in other units; every factor that the start
# shows: sizes, distances from bounds, a start of zeros by what it does to the loss.
UNITS = [(1e-12, 1.0, 1.0), (3e5, 1e6, 1e-22)]
PROBLEMS = {
    "free": ([0.3, -2.0], 4.0, None),
    "zeros": ([0.0, 0.0], 4.0, None),
    "one bound": ([0.3, 2.0], 4.0, ((0.0, -np.inf), (np.inf, 5.0))),
    "two bounds": ([0.3, 0.5], 4.0, ((-1.0, -1.0), (2.5, 5.0))),
    "on a bound": ([0.0, 2.0], 5.0, ((0.0, -np.inf), (np.inf, 5.0))),
}


def in_units(start, bounds, units, many=False, **options):
    """The same problem with loss and values times factors; values and history in the first units."""
    loss_unit, a_unit, b_unit = units

    def loss(x):
        a, b = x["a"] / a_unit, x["b"] / b_unit
        value = (a[0] - 1) ** 2 + 3 * (a[1] - a[0] * b) ** 2 + (b - 2) ** 4 + 0.1 * b + a[0] ** 4
        return loss_unit * value

    def scaled(a, b):
        return {"a": a_unit * jnp.asarray(a), "b": b_unit * jnp.asarray(b)}

    if bounds is not None:
        bounds = tuple(scaled([side[0]] * 2, side[1]) for side in bounds)
    found = quiet(loss, scaled(*start), bounds=bounds, many=many, **options)
    values = np.append(found.values["a"] / a_unit, found.values["b"] / b_unit)
    history = found.history.loss / loss_unit, found.history.gradient_norm / loss_unit
    return values, history, found.status


@cache
def in_first_units(name):
    *start, bounds = PROBLEMS[name]
    return in_units(start, bounds, (1.0, 1.0, 1.0))


@pytest.mark.parametrize("units", UNITS, ids=str)
@pytest.mark.parametrize("name", PROBLEMS)
def test_other_units_take_the_same_steps(name, units):
    *start, bounds = PROBLEMS[name]
    values, (losses, norms), status = in_first_units(name)
    assert status in ("the gradient vanishes", "the loss falls no further") and len(losses) < 90
    other, (other_losses, other_norms), ended = in_units(start, bounds, units)
    assert ended == status and len(other_losses) == len(losses)
    assert np.abs(other - values).max() < 1e-7
    # Rounding grows from step to step, and gradients fall to it.
    assert np.abs(other_losses / losses - 1).max() < 1e-4
    for one, two in ((losses, other_losses), (norms, other_norms)):
        assert np.abs(two[:6] / one[:6] - 1).max() < 1e-9


@pytest.mark.parametrize("factors", [(1e12, 1e-15), (1e-12, 1e15)], ids=str)
def test_constraints_in_other_units(factors):
    loss_unit, unit = factors

    def walk(loss_unit, unit):
        return quiet(
            lambda x: loss_unit * (x[0] + x[1]),
            jnp.array([0.3, -2.0, 0.5]),
            constraint=lambda x: jnp.stack([unit * (x @ x - 1), x[2] - 0.1]),
        )

    one, other = walk(1.0, 1.0), walk(loss_unit, unit)
    corner = -np.sqrt(0.99 / 2)
    assert np.abs(one.values - np.array([corner, corner, 0.1])).max() < 1e-6
    assert np.abs(other.values - one.values).max() < 1e-9
    assert np.abs(other.history.loss / loss_unit - one.history.loss).max() < 1e-7
    assert one.violation < 1e-6 and other.violation < 1e-6 * max(unit, 1.0)


def test_small_starts_and_bounds():
    far = 1e-22
    for unit in (1.0, far):
        for start, bounds in ((0.5, (0.0, np.inf)), (4.0, (-np.inf, 4.5)), (0.5, (0.0, 10.0))):
            low, high = (unit * b for b in bounds)
            found = quiet(lambda x, u=unit: (x / u - 3) ** 2, unit * start, bounds=(low, high))
            assert abs(found.values / unit - 3) < 1e-5 and found.status == "the gradient vanishes"
    # Next to nothing, or nothing at all, beside what the loss asks for.
    for start in (far, 0.0):
        for bounds in (None, (0.0, np.inf), (0.0, 10.0)):
            found = quiet(lambda x: (x - 3) ** 2, start, bounds=bounds)
            assert abs(found.values - 3) < 1e-5, (start, bounds)
        two = quiet(lambda x: (x["a"] - 3) ** 2 + (x["b"] - 2) ** 2, {"a": start, "b": 1.0})
        assert abs(two.values["a"] - 3) < 1e-5 and abs(two.values["b"] - 2) < 1e-5


def test_where_nothing_is_to_be_gained():
    found = quiet(lambda x: (x - 3) ** 2, 3.0)
    assert found.status == "the gradient is zero at the start" and len(found.history.loss) == 1
    assert found.values == 3.0
    # A loss that is far from zero, and a start that is as good as the optimum.
    assert abs(quiet(lambda x: 1e6 + (x - 3) ** 2, 1.0).values - 3) < 1e-4
    near = quiet(lambda x: 1 + (x - 3) ** 2 + 0.1 * (x - 3) ** 4, 3.0 + 1e-9)
    assert abs(near.values - 3) < 2e-9 and len(near.history.loss) < 10
    assert near.status in ("the gradient vanishes", "the loss falls no further")
    # No loss at the start.
    assert abs(quiet(lambda x: x**2 - x, 0.0).values - 0.5) < 1e-6


def test_many_starts_are_as_each_alone():
    starts = np.array([[-1.0, 1.0], [1e-3, 2e-3], [20.0, 4.0]])
    for unit in (1.0, 1e-12):
        many = quiet(lambda x, u=unit: u * valley(x), starts, many=True, steps=6)
        for k, start in enumerate(starts):
            alone = quiet(lambda x, u=unit: u * valley(x), start, steps=6)
            assert np.abs(many.history.loss[:, k] / alone.history.loss - 1).max() < 1e-6


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
