"""Factorisations under vmap: right, and never by LAPACK's batched calls, which can wait for ever."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeads as jb
from jaxbeads import scenes
from jaxbeads.factors import cholesky, cholesky_solve, lu, triangular_solve


def matrices(*shape):
    return np.random.default_rng(0).normal(size=(*shape, 5, 5))


def positive(*shape):
    a = matrices(*shape)
    return a @ np.swapaxes(a, -1, -2) + np.eye(5)


def by_cholesky(matrix, rhs):
    return cholesky_solve(cholesky(matrix)[0], rhs)


def by_lu(matrix, rhs):
    factor, order = lu(matrix)
    half = triangular_solve(factor, rhs[order], lower=True, unit=True)
    return triangular_solve(factor, half, lower=False)


@pytest.mark.parametrize(("solve", "made"), [(by_cholesky, positive), (by_lu, matrices)])
@pytest.mark.parametrize("axes", [(0, 0), (0, None), (None, 0)])
def test_members_are_those_of_numpy(solve, made, axes):
    rhs = np.random.default_rng(1).normal(size=(3, 4, 5))
    a = made(3, 4) if axes[0] == 0 else made()
    b = rhs if axes[1] == 0 else rhs[0, 0]
    found = jax.jit(jax.vmap(jax.vmap(solve, axes), axes))(a, b)
    expected = np.linalg.solve(
        a, b[..., None] if b.ndim > 1 else np.broadcast_to(b, (3, 4, 5))[..., None]
    )
    assert np.allclose(found, expected[..., 0], rtol=1e-10)


def test_cholesky_tells_what_is_not_positive():
    matrix = -jnp.asarray(positive())
    assert not jax.jit(cholesky)(matrix)[1]
    found = jax.jit(jax.vmap(cholesky))(jnp.stack([-matrix, matrix]))[1]
    assert np.array_equal(found, [True, False])
    assert np.isnan(cholesky(jnp.nan * matrix)[0][-1, -1])
    assert cholesky(jnp.zeros((0, 0)))[1]


def test_cholesky_reads_the_upper_triangle():
    whole = positive()
    upper = np.where(np.tri(5, k=-1), 7.0, whole)
    factor, _ = cholesky(jnp.asarray(upper))
    assert np.allclose(np.tril(factor), np.linalg.cholesky(whole), rtol=1e-13)
    single, _ = cholesky(jnp.asarray(upper, jnp.float32))
    assert single.dtype == jnp.float32
    assert np.allclose(np.tril(single), np.linalg.cholesky(whole), rtol=1e-5)


def batched_calls(function, *arguments):
    """Calls of LAPACK with more than a matrix in the compiled program."""
    program = jax.jit(function).lower(*arguments).compile().as_text()
    calls = [line for line in program.splitlines() if "lapack_" in line]
    assert calls
    return [line for line in calls if re.search(r"f64\[\d+,\d+,\d+", line)]


@pytest.mark.parametrize("solver", [jb.AB3(), jb.Rosenbrock()])
def test_no_batched_call_in_a_batch_of_runs(solver):
    case = scenes.settling(6)
    ts = jnp.linspace(0, 1e-2, 2)

    def end(scene):
        run = jb.rollout(scene, case.state, ts, solver=solver, substeps=2)
        return run.final.position.sum()

    end = jb.vary(end, case.scene, lambda scene: scene.viscosity)
    several = jnp.array([1.0, 1.1, 1.2])
    assert not batched_calls(jax.vmap(end), several)
    if isinstance(solver, jb.AB3):
        assert not batched_calls(jax.vmap(jax.grad(end)), several)
    # What the tests above would find:
    assert batched_calls(jax.vmap(jnp.linalg.cholesky), jnp.asarray(positive(3)))
