"""The one way in which numbers become leaves, and keep their digits."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp

P = ParamSpec("P")
R = TypeVar("R")


def float_array(value: Any) -> jax.Array:
    """Turn a number, a list or an array into a floating-point JAX array.

    A Python float as a field would be a compile-time constant: every new value would compile
    again, and it would have no gradient.
    """
    if isinstance(value, (int, float)):
        return jnp.asarray(value, dtype=float)  # with a dtype, or its type would be a weak one
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError):
        message = f"A number or an array of numbers is needed, but {value!r} was given."
        raise ValueError(message) from None
    return array if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(float)


def optional_float_array(value: Any) -> jax.Array | None:
    """As `float_array`, but `None` stays `None`."""
    return None if value is None else float_array(value)


def with_all_digits(function: Callable[P, R]) -> Callable[P, R]:
    """A function whose matrix products have the precision of their numbers on every device. Without it
    accelerators round float32 to 10 bits in them.

    It goes around `filter_jit`, not into it: JAX traces once for each precision that is set outside.
    """

    @functools.wraps(function)
    def precise(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.default_matmul_precision("float32"):
            return function(*args, **kwargs)

    return precise
