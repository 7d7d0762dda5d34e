"""float64, shape checks on every function of the package, and no silent broadcasting of ranks."""

import gc
import importlib
import os
import shutil
import subprocess
import sys
import tempfile

import equinox as eqx
import jax
import pytest
from jaxtyping import install_import_hook

# Compiling is most of the work. Workers, modules and notebooks share what one of them has compiled (they
# inherit the environment), down to single operations. The compiler does not optimise what runs but once,
# and is not told from which lines of Python a program comes.
_CACHE = "JAX_COMPILATION_CACHE_DIR"
_OWN = _CACHE not in os.environ
if _OWN:
    os.environ[_CACHE] = tempfile.mkdtemp(prefix="jaxbeads-tests-")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
if "XLA_FLAGS" not in os.environ:
    # Without optimisation, fusions compile in a third of the time by the older code generator, and two
    # workers on two cores gain nothing by modules split for more threads. Not every jaxlib knows
    # these settings, and one that does not stops the process.
    flags = (
        "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
        " --xla_cpu_parallel_codegen_split_count=1"
    )
    known = [sys.executable, "-c", "import jax; jax.devices()"]
    trial = subprocess.run(known, env=os.environ | {"XLA_FLAGS": flags}, capture_output=True)
    os.environ["XLA_FLAGS"] = flags if trial.returncode == 0 else flags.split()[0]

gc.set_threshold(100_000, 20, 100)  # programs in the making are many small objects, and no garbage
jax.config.update("jax_compilation_cache_dir", os.environ[_CACHE])
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

with install_import_hook("jaxbeads", "beartype.beartype"):
    importlib.import_module("jaxbeads.plot")


def pytest_collection_modifyitems(items):
    """Cheap tests first: those marked slow go to the end, notebooks before the others, so that none of
    the longest is left to one worker at last."""

    def rank(item):
        slow = item.get_closest_marker("slow") is not None
        return slow, slow and item.path.stem != "test_notebooks"

    items.sort(key=rank)


def pytest_unconfigure():
    """Remove the shared programs at the end; workers find the folder set."""
    if _OWN:
        shutil.rmtree(os.environ[_CACHE], ignore_errors=True)


@pytest.fixture(autouse=True, scope="module")
def forget_compiled_programs():
    """Each compiled program holds memory maps, of which a process may have 65 530."""
    yield
    eqx.clear_caches()
    jax.clear_caches()
    gc.collect()
