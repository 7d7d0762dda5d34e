"""One scene over several devices and processes: who sums over which pairs.

Each device sums over all pairs of its share of the beads, the sums are handed round, and everything else
is done by all devices alike.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, PyTree

from ._checks import fail
from ._compat import by_shares

LEAST = 2**16
"""Pairs from which on they are shared out: fewer are done before the devices have met."""
_DEVICES: ContextVar[int | None] = ContextVar("devices", default=None)


@contextmanager
def shared_out(devices: int | None) -> Iterator[None]:
    """Sums over pairs that are traced within are shared out to so many devices (0: all that there are).

    It holds while a function is traced, so who enters it must be told the number by what is static.

    **Raises** `ValueError` if there are not so many.
    """
    token = _DEVICES.set(devices)
    try:
        yield
    finally:
        _DEVICES.reset(token)


def shared(sums: Callable[[Any], Sequence[Array]], to: PyTree, pairs: int) -> list[Array]:
    """Sums for some beads, each of which a device can find by itself, from all devices.

    **Arguments**: function of beads that returns an array for each sum, with a row for each bead (or
    for each block of beads, if it is one of blocks); arrays with such rows; how many pairs there are.
    """
    wanted = _DEVICES.get()
    if wanted is None or pairs < LEAST:
        return list(sums(to))
    every = jax.devices()
    if wanted > len(every):
        fail("devices", f"be at most {len(every)}, all that JAX sees", f"it is {wanted}")
    devices = every[: wanted or len(every)]
    number = len(jax.tree.leaves(to)[0])
    missing = -number % len(devices)

    def padded(x: Array) -> Array:
        return jnp.pad(x, [(0, missing)] + [(0, 0)] * (x.ndim - 1), mode="edge")

    def each(to: PyTree) -> Array:
        return jnp.stack(list(sums(to)), axis=1)

    mesh, to = Mesh(np.array(devices), ("beads",)), jax.tree.map(padded, to)
    found = by_shares(each, to, mesh, PartitionSpec("beads"))[:number]
    return list(jnp.moveaxis(found, 1, 0))
