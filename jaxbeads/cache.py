"""Compiled programs kept on disk."""

import os
from pathlib import Path

import jax

from ._checks import fail
from ._compat import forget_cache


def enable_cache(folder: str | os.PathLike[str] | None = None) -> Path:
    """Keep compiled programs on disk, so that the next process that runs the same scene starts at once.

    It turns on JAX's persistent compilation cache for the whole process, also for programs that are not
    of this package. Programs depend on shapes, models and solver, not on the numbers in a scene, and on
    versions and machine: what does not fit is compiled anew. Nothing is ever removed from the folder.

    **Argument**: where programs are kept; by default where JAX keeps them if it is told already
    (`JAX_COMPILATION_CACHE_DIR`), otherwise `jaxbeads` in the user's cache folder (`XDG_CACHE_HOME` or
    `~/.cache`). **Returns** the folder. **Raises** `ValueError` if it cannot be made.

    >>> import jaxbeads as jb
    >>> print(jb.enable_cache("programs").name)
    programs
    """
    if folder is None:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        told: str | None = getattr(jax.config, "jax_compilation_cache_dir", None)
        folder = told or Path(base) / "jaxbeads"
    path = Path(folder).expanduser().absolute()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        fail("folder", "be one that can be made", f"{path} cannot: {error.strerror}")
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    forget_cache()  # it may have been asked for before, in vain
    return path
