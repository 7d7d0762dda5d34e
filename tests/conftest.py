"""float64, shape checks on every function of the package, and no silent broadcasting of ranks."""

import importlib

import equinox as eqx
import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

with install_import_hook("jaxbeads", "beartype.beartype"):
    importlib.import_module("jaxbeads.plot")


def pytest_collection_modifyitems(items):
    """Cheap tests first: those marked slow go to the end."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is not None)


@pytest.fixture(autouse=True, scope="module")
def forget_compiled_programs():
    """Each compiled program holds memory maps, of which a process may have 65 530."""
    yield
    eqx.clear_caches()
    jax.clear_caches()
