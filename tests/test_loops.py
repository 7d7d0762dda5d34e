"""The loop of unknown length: its derivatives in both modes, alone and in batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbeads.loops import loop


def powers(x, factor, most=50):
    """x times the power of `factor` that first brings the count, which grows by the factor, to 2."""

    def unfinished(carry, fixed):
        return carry[0] < 2.0

    def body(carry, fixed):
        return carry[0] + fixed[0], carry[1] * fixed[0], carry[2] + 1

    start = jnp.zeros(()), x, jnp.zeros((), int)
    return loop(unfinished, body, start, (factor,), most)


def test_values():
    # 0.3 is added seven times; the bound on the number of turns holds.
    _, x, turns = powers(jnp.array([1.0, 2.0]), jnp.asarray(0.3))
    assert int(turns) == 7 and np.abs(x - np.array([1.0, 2.0]) * 0.3**7).max() < 1e-18
    assert int(powers(jnp.ones(2), jnp.asarray(0.3), most=4)[2]) == 4


def test_derivatives_in_both_modes():
    x, factor = jnp.array([1.0, 2.0]), jnp.asarray(0.3)

    def total(x, factor):
        return jnp.sum(powers(x, factor)[1] ** 2)

    power = 0.3**7
    exact = 2 * power**2 * x, 14 * power**2 / 0.3 * jnp.sum(x**2)
    backward = jax.jit(jax.grad(total, (0, 1)))(x, factor)
    forward = jax.jit(jax.jacfwd(total, (0, 1)))(x, factor)
    for found in (backward, forward):
        assert all(np.allclose(a, b, rtol=1e-13) for a, b in zip(found, exact, strict=True))
    # In batches, whose members take 7, 4 and 3 turns.
    factors = jnp.array([0.3, 0.5, 0.9])
    turns = np.array([7, 4, 3])
    slopes = 2 * turns * np.asarray(factors) ** (2 * turns - 1) * 5
    for mode in (jax.grad, jax.jacfwd):
        batch = jax.vmap(mode(total, 1), (None, 0))(x, factors)
        assert np.allclose(batch, slopes, rtol=1e-13)


def test_second_derivatives_are_refused():
    with pytest.raises(RuntimeError, match="Second derivatives through adaptive steps"):
        jax.hessian(lambda x: jnp.sum(powers(x, jnp.asarray(0.3))[1] ** 2))(jnp.ones(2))


@pytest.mark.parametrize("turns", [1, 64, 511, 512, 513, 1024, 1025, 3000, 4095, 4096])
def test_derivatives_of_any_number_of_turns(turns):
    # A logistic map, whose derivatives need every carry: beyond 512 turns not all of them are kept.
    def body(carry, fixed):
        return carry[0] + 1, fixed * carry[1] * (1 - carry[1])

    def last(x, rate):
        start = jnp.zeros((), int), x
        return loop(lambda carry, _: carry[0] < turns, body, start, rate, 4096)[1]

    # Where it neither settles nor runs apart: derivatives are of the size of one.
    x, rate = jnp.asarray(0.3), jnp.asarray(3.0)
    y, slopes = x, np.array([1.0, 0.0])
    for _ in range(turns):
        slopes = rate * (1 - 2 * y) * slopes + np.array([0.0, y * (1 - y)])
        y = float(rate * y * (1 - y))
    found = jax.jit(jax.grad(last, (0, 1)))(x, rate)
    assert np.allclose(found, slopes, rtol=1e-10, atol=1e-300)
    assert np.allclose(jax.jit(jax.jacfwd(last, (0, 1)))(x, rate), slopes, rtol=1e-10, atol=1e-300)
