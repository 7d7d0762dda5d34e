"""Factorisations under vmap: right, and never by large calls of LAPACK, which can wait for ever."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeads as jb
from jaxbeads import scenes
from jaxbeads._compat import CALLS_OF_KNOWN_COST
from jaxbeads.factors import at_once, cholesky, cholesky_solve, lu, triangular_solve
from jaxbeads.loops import equal_parts


def matrices(*shape, size=5):
    return np.random.default_rng(0).normal(size=(*shape, size, size))


def positive(*shape, size=5):
    a = matrices(*shape, size=size)
    return a @ np.swapaxes(a, -1, -2) + np.eye(size)


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


def shared_out(function, *arguments):
    """Calls of LAPACK for several matrices in the compiled program, and those of them that jaxlib shares
    out to other threads: with 200 000 operations or more, as it estimates them."""
    program = jax.jit(function).lower(*arguments).compile().as_text()
    call = r"f64\[(\d+),(\d+),(\d+)\][^=]* custom-call\(.*lapack_d(potrf|getrf|trsm)_ffi"
    several, shared = 0, []
    for line in program.splitlines():
        if found := re.search(call, line):
            members, rows, columns = map(int, found.groups()[:3])
            operations = members * rows * rows * columns // (3 if found[4] == "potrf" else 1)
            several += members > 1
            if members > 1 and operations >= 200_000:
                shared.append(line)
    return several, shared


@pytest.mark.parametrize(("solve", "made"), [(by_cholesky, positive), (by_lu, matrices)])
@pytest.mark.parametrize("size", [5, 38, 100])
def test_calls_stay_small(solve, made, size):
    a, rhs = made(40, 30, size=size), np.ones((40, 30, size))
    several, shared = shared_out(jax.vmap(jax.vmap(solve)), a, rhs)
    assert not shared
    # One matrix of 100 rows is too much already.
    assert size == 100 or (several > 0) == CALLS_OF_KNOWN_COST
    # What this would find:
    assert shared_out(jax.vmap(jnp.linalg.cholesky), a[0])[1] or size == 5


@pytest.mark.parametrize(("solve", "made"), [(by_cholesky, positive), (by_lu, matrices)])
@pytest.mark.parametrize("inner", [(0, 0), (0, None)])
def test_calls_stay_small_with_many_columns(solve, made, inner):
    """Members side by side, then right-hand sides, as in derivatives of a batch by many parameters."""
    a = made(4, size=38)
    rhs = np.random.default_rng(1).normal(size=(200, *((4,) if inner[1] == 0 else ()), 38))
    function = jax.vmap(jax.vmap(solve, inner), (None, 0))
    assert not shared_out(function, a, rhs)[1]
    columns = np.broadcast_to(rhs if inner[1] == 0 else rhs[:, None], (200, 4, 38))
    expected = np.linalg.solve(np.broadcast_to(a, (200, 4, 38, 38)), columns[..., None])
    assert np.allclose(jax.jit(function)(a, rhs), expected[..., 0], rtol=1e-9, atol=1e-9)


def test_parts():
    most = [at_once(n) for n in (38**3 // 3, 10**9, 0)]
    assert most == ([8, 1, 150_000] if CALLS_OF_KNOWN_COST else [1, 1, 1])
    assert [equal_parts(*x) for x in [(16, 10), (15, 8), (7, 4), (5, 100), (5, 0)]] == [
        8,
        5,
        1,
        5,
        1,
    ]


@pytest.mark.parametrize("solver", [jb.AB3(substeps=2), jb.Rosenbrock(substeps=2)])
def test_calls_stay_small_in_a_batch_of_runs(solver):
    case = scenes.settling(6)
    ts = jnp.linspace(0, 1e-2, 2)

    def end(scene):
        run = jb.rollout(scene, case.state, ts, solver=solver)
        return run.final.position.sum()

    end = jb.vary(end, case.scene, lambda scene: scene.viscosity)
    values = jnp.linspace(1.0, 1.2, 1000)
    several, shared = shared_out(jax.vmap(end), values)
    assert (several > 0) == CALLS_OF_KNOWN_COST
    assert not shared
    if isinstance(solver, jb.AB3):
        assert not shared_out(jax.vmap(jax.grad(end)), values)[1]
