"""What is private or experimental in the dependencies: in one place, there, and not indispensable."""

import ast
import functools
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from survivors import PARTS, results

import jaxbeads
from jaxbeads import _compat, factors
from jaxbeads.__main__ import _number
from jaxbeads.loops import checkpointed, keep

PACKAGE = Path(jaxbeads.__file__).parent
VERSION = jax.__version_info__

# --- One place ---

PRIVATE = re.compile(
    r"jaxlib|jax\.(_src|core|experimental|extend|interpreters|custom_batching|ad_checkpoint|monitoring"
    r"|shard_map|ffi|lib|__version_info__)|(equinox|eqx)\.(internal|_)|diffrax\._|(lineax|optimistix)"
    r"|(jax\.)?lax\.optimization_barrier"
)


def used(path):
    """Dotted names of other packages that a file imports or reads."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Attribute):
            yield ast.unparse(node)


def test_nothing_private_is_used_elsewhere():
    files = [p for p in PACKAGE.rglob("*.py") if p.name != "_compat.py"]
    found = {f"{p.relative_to(PACKAGE)}: {n}" for p in files for n in used(p) if PRIVATE.match(n)}
    assert not found, f"Private or experimental things belong in `_compat.py`: {sorted(found)}"
    assert any(PRIVATE.match(name) for name in used(PACKAGE / "_compat.py"))


def test_tricks_are_marked_and_listed():
    files = [p for p in PACKAGE.rglob("*.py") if p.name != "_compat.py"]
    marked = {str(p.relative_to(PACKAGE)) for p in files if "XLA: " in p.read_text()}
    assert marked == set(_compat.TRICKS), "`_compat.TRICKS` lists the files with a comment `XLA:`."


# --- Canaries ---


@pytest.mark.parametrize("name", _compat.BORROWED)
def test_it_is_there(name):
    there, reason, instead = _compat.BORROWED[name]
    assert there, f"{name} is gone, by which {reason}; now instead: {instead}."


def test_lapack_is_called_as_before():
    assert _compat.working_potrf() is not None, (
        "jaxlib's call `potrf_ffi` is not what it was; `lax.linalg.cholesky` takes its place."
    )


def test_calls_of_unknown_cost_hold_one_matrix():
    known = VERSION < (0, 9, 1) or (0, 10) <= VERSION < (0, 11)
    assert (factors.at_once(1000) > 1) == known, (
        "How jaxlib shares calls of LAPACK out to threads was measured for other versions."
    )


def test_compiling_is_reported():
    clock = _compat.CompileClock()
    jax.jit(lambda x: jnp.sin(x) * 3.25)(jnp.ones(7))
    silent = set(_compat.COMPILING) - set(_compat.CompileClock._heard or ())
    assert not silent, f"JAX does not report any more: {sorted(silent)}; `compile_s` lacks them."
    assert clock.read() > 0


def test_what_is_traced_for_another_thing_counts_once(monkeypatch):
    clock, (event, *_) = _compat.CompileClock(), _compat.COMPILING
    for now, seconds in ((1e9 + 1.0, 0.25), (1e9 + 1.5, 0.25), (1e9 + 2.0, 1.25), (1e9 + 3.0, 0.5)):
        monkeypatch.setattr(_compat.time, "perf_counter", lambda now=now: now)
        _compat.CompileClock._hear(event, seconds)
    assert abs(clock.read() - 1.75) < 1e-6
    del _compat.CompileClock._stretches[-2:]


def test_named_values_are_kept():
    @checkpointed
    def step(x):
        return x * keep((jnp.exp(lax.stop_gradient(x)), None))[0]

    program = str(jax.make_jaxpr(jax.grad(step))(1.0))
    found = len(re.findall(r"= exp2? ", program))
    assert found == 1, f"What `keep` names is computed {found} times: the backward pass is slower."


@pytest.mark.parametrize("transform", [jax.jit, jax.vmap, jax.grad, jax.make_jaxpr])
def test_placeholders_and_literals_are_known(transform):
    seen = []

    def function(x):
        seen.append(x)
        return (x * 2.0).sum()

    transform(function)(jnp.ones(3))
    for kind in (_compat.Tracer, _compat._AnyPlaceholder):
        assert isinstance(seen[0], kind) and not isinstance(jnp.ones(3), kind)
        assert not any(isinstance(x, kind) for x in (np.ones(3), 1.0, None))
    step = jax.make_jaxpr(lambda x: x * 2.0)(1.0).jaxpr.eqns[0]
    for kind in (_compat.Literal, _compat._AnyLiteral):
        assert [isinstance(v, kind) for v in step.invars] == [False, True]


def test_a_solver_of_diffrax_is_driven_by_hand():
    term, solver = diffrax.ODETerm(lambda t, y, args: -y), diffrax.Tsit5()
    y, one = jnp.ones(2), jnp.ones(())
    controller = diffrax.PIDController(rtol=1e-6, atol=1e-6)
    order = solver.error_order(term)
    end, memory = controller.init(term, 0 * one, one, y, 0.1 * one, None, solver.func, order)
    state = solver.init(term, 0 * one, end, y, None)
    y1, error, dense, _, result = solver.step(
        term, 0 * one, end, y, None, state, jnp.zeros((), bool)
    )
    keep, *_ = controller.adapt_step_size(0 * one, end, y, y1, None, error, order, memory)
    inside = solver.interpolation_cls(t0=0 * one, t1=end, **dense).evaluate(end / 2)
    assert bool(keep) and bool(result == diffrax.RESULTS.successful)
    assert np.allclose(y1, np.exp(-0.1), atol=1e-9) and np.allclose(
        inside, np.exp(-0.05), atol=1e-6
    )


# --- Tricks: counted in programs that the compiler makes without the tests' own flags ---

COUNTS = r"""
import json, re
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxbeads as jb
from jaxbeads import coefficients, tensors
from jaxbeads.constraint import base
from jaxbeads.factors import diagonal
from jaxbeads.pairs import separations

def count(words, function, *arguments):
    text = jax.jit(function).lower(*arguments).compile().as_text()
    return len(re.findall(rf"= \S+ (?:{words})\(", text))

chain = jb.Chain(1.0, 34)
forces = [jb.force.Bending(100.0), jb.force.Weight([0.0, -1.0])]
scene = jb.Scene(chain, 1.0, constraints=[jb.constraint.Gears()], forces=forces)
state = jb.straight(chain, [1.0, 0.0])

def work():
    def rate(state, scene):
        return jb.dynamics.rate(0.0, state, scene)
    return count("multiply", rate, state, scene)

def without(vector, radii, length, viscosity):
    six, cross, eight = coefficients.factors(length)
    k = coefficients.coefficients(vector, radii)
    units = [six, six, cross, cross, eight, eight]
    return coefficients.Scalars(*(x * unit * viscosity for x, unit in zip(k, units)))

found = {"quotients": work()}
tensors.kept_coefficients = without
jax.clear_caches()
found["no quotients"] = work()

def filled(begin):
    def fill(a, b):
        return base.put_block(base.put_block(begin(64, float), a, 0, 0), b, 8, 8)
    return count("pad", fill, np.ones((8, 8)), np.ones((8, 8)))

found["hidden"] = filled(base.empty)
found["seen"] = filled(lambda n, dtype: jnp.zeros((n, n), dtype))

def pairs(position):
    return sum(jnp.sum(jnp.cos(x)) for x in separations(position, position))

found["products"] = count("dot", jax.grad(pairs), state.position)
found["slice"] = count("gather", lambda m: diagonal(m @ m), np.ones((9, 9)))
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def counts():
    flags = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    done = subprocess.run(
        [sys.executable, "-c", COUNTS], env=flags, check=True, capture_output=True, text=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def test_a_quotient_is_computed_once(counts):
    assert counts["quotients"] < 0.75 * counts["no quotients"], (
        "XLA computes quotients again wherever they are read, or products no more: `_coefficients` in "
        f"coefficients.py need not end in divisions ({counts})."
    )


@pytest.mark.skipif(VERSION < (0, 10), reason="earlier XLA looks through the barrier")
def test_hidden_zeros_are_not_padded(counts):
    assert counts["hidden"] == 0, (
        f"XLA pads the first block in spite of `_compat.hidden` ({counts})."
    )
    assert counts["seen"] > 0, "XLA does not pad zeros any more: `_compat.hidden` is not needed."


def test_products_with_ones_stay_products(counts):
    assert counts["products"] > 0, (
        "XLA turns products with ones into sums: see `pairs.separations`."
    )


@pytest.mark.skipif(VERSION < (0, 10), reason="earlier XLA makes a gather of slices as well")
def test_the_diagonal_is_a_slice(counts):
    assert counts["slice"] == 0, "XLA gathers in `factors.diagonal`, which was to be a slice."


# --- Without it: slower, never wrong, and never on import ---

LOSSES = {
    "everything": (list(_compat.BORROWED), list(PARTS)),
    "LAPACK": (["jaxlib.lapack.prepare_lapack_call"], ["factors"]),
    "LAPACK is another": (["jaxlib.lapack.prepare_lapack_call=wrong"], ["factors"]),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Results of a part where all is there."""
    folder, cache = tmp_path_factory.mktemp("whole"), jax.config.jax_compilation_cache_dir
    yield functools.cache(lambda part: results([part], folder)[part])
    jax.config.update("jax_compilation_cache_dir", cache)


@pytest.mark.parametrize("loss", LOSSES)
def test_results_survive(loss, whole, tmp_path):
    gone, parts = LOSSES[loss]
    program = Path(__file__).with_name("survivors.py")
    command = [sys.executable, str(program), ",".join(parts), str(tmp_path), *gone]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert set(found) == set(parts)
    for part in parts:
        expected = whole(part)
        if part == "watched":  # the last two: whether the time is known
            known = loss != "everything"
            assert found[part][1:] == [[float(known)], [float(not known)]]
            assert expected[1:] == [[1.0], [0.0]]
            expected, found[part] = expected[:1], found[part][:1]
        assert len(found[part]) == len(expected) > 0
        for ours, theirs in zip(found[part], expected, strict=True):
            assert np.all(np.isfinite(theirs)), part
            assert np.allclose(ours, theirs, rtol=1e-9, atol=1e-12), part


def test_a_time_that_is_not_known_is_none_in_json():
    assert [_number(x) for x in (jnp.nan, jnp.asarray(0.5))] == [None, 0.5]


def test_version():
    assert re.match(r"\d+\.\d+", jaxbeads.__version__)
    assert (PACKAGE / "py.typed").exists()
    program = (
        "import importlib.metadata as m\n"
        "known = m.version\n"
        "def version(name):\n"
        "    if name == 'jaxbeads': raise m.PackageNotFoundError(name)\n"
        "    return known(name)\n"
        "m.version = version\n"
        "import jaxbeads; print(jaxbeads.__version__)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    )
    assert done.stdout.strip() == "0+unknown"
