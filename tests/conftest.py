"""float64, shape checks on every function of the package, and no silent broadcasting of ranks."""

import jax
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

with install_import_hook("jaxbeads", "beartype.beartype"):
    import jaxbeads
    import jaxbeads.plot  # noqa: F401


def pytest_collection_modifyitems(items):
    """Cheap tests first: those marked slow go to the end."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is not None)
