"""float64, shape checks on every function of the package, and no silent broadcasting of ranks."""

import importlib
import os
import shutil
import tempfile

# Compiling is most of the work. Workers and notebooks share what one of them has compiled, and the
# compiler does not optimise what runs but once. (Before JAX is imported.)
_OWN = "JAX_COMPILATION_CACHE_DIR" not in os.environ
if _OWN:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="jaxbeads-tests-")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "1")
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")

import equinox as eqx  # noqa: E402
import jax  # noqa: E402
import pytest  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

with install_import_hook("jaxbeads", "beartype.beartype"):
    importlib.import_module("jaxbeads.plot")


def pytest_collection_modifyitems(items):
    """Cheap tests first: those marked slow go to the end."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is not None)


def pytest_unconfigure():
    """Remove the shared programs at the end; workers find the folder set."""
    if _OWN:
        shutil.rmtree(os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)


@pytest.fixture(autouse=True, scope="module")
def forget_compiled_programs():
    """Each compiled program holds memory maps, of which a process may have 65 530."""
    yield
    eqx.clear_caches()
    jax.clear_caches()
