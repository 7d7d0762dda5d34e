"""Users' functions: laws of time, curvatures along a fibre, fields of force and of velocity.

Whatever numbers they return, in a list, a tuple, an array of any type or alone, become one
floating-point array here, and what else they are or return is refused here in one sentence.
"""

import re
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.errors import (
    ConcretizationTypeError,
    TracerArrayConversionError,
    TracerIntegerConversionError,
)
from jaxtyping import Array

from ._checks import described, fail, shape

_NUMBERS = jax.Array, np.ndarray, np.generic, int, float, complex
Shape = tuple[int, ...]


class Parts(eqx.Module):
    """A function, as a neural network, with leaves that are no numbers, as its activation: these become
    part of the structure. The leaves are those of `numbers`.
    """

    numbers: Any
    others: Any = eqx.field(static=True)

    def __call__(self, *arguments: Any) -> Any:
        """The function's value."""
        return eqx.combine(self.numbers, self.others)(*arguments)


def leaf_function(function: Any, name: str = "function") -> Any:
    """Make a plain function a pytree without leaves, so that a module that holds it can be jitted.

    Callables that are pytrees already (an `equinox.Module`, a `jax.tree_util.Partial`) stay as they
    are, with their leaves, if these are numbers (otherwise see `Parts`). **Raises** `ValueError` for
    what cannot be called, by its name.
    """
    if not callable(function):
        fail(name, "be a function", f"it is {described(function)}")
    if jax.tree.structure(function) != jax.tree.structure(0):
        numbers, others = eqx.partition(function, eqx.is_array_like)
        return Parts(numbers, others) if jax.tree.leaves(others) else function
    try:
        hash(function)
    except TypeError:
        function = function.__call__  # which is told from others by what it belongs to
    return jax.tree_util.Partial(function)


def value_of(
    name: str,
    given: str,
    function: Callable[..., Any],
    *arguments: Any,
    shapes: tuple[Shape, ...],
    dtype: Any,
) -> Array:
    """What a user's function returns, as an array.

    **Arguments**: its name and what it is called with, in words; the function and its arguments; the
    shapes that its value may have; the type of the array. **Raises** `ValueError` with the sentence.
    """
    try:
        value = function(*arguments)
    except Exception as error:
        if isinstance(error, ValueError) and str(error).startswith("Argument `"):
            raise  # of a function that this one calls
        fail(name, f"be a function that can be called with {given}", _raised(error))
    value = _array(name, value)
    shape(name, value, *shapes)
    return value.astype(dtype)


def law_of(name: str, law: Callable[..., Any], t: Array, size: Shape, dtype: Any) -> Array:
    """Value of a law of time."""
    t = jnp.asarray(t, dtype)  # a whole number has no derivative
    return value_of(name, "a time", law, t, shapes=(size,), dtype=dtype)


def rate_of(name: str, law: Callable[..., Any], t: Array, size: Shape, dtype: Any) -> Array:
    """Time derivative of a law of time."""
    t = jnp.asarray(t, dtype)
    one = jnp.ones_like(t)
    return jax.jvp(lambda t: law_of(name, law, t, size, dtype), (t,), (one,))[1]


def trial(function: Callable[..., Any], *arguments: Any) -> None:
    """Call a function for shapes alone, so that what is wrong with it is said before anything runs."""
    try:
        jax.eval_shape(function, *arguments)
    except ValueError as error:  # without the notes of tracing
        raise ValueError(str(error)) from error.__context__


def check_law(name: str, law: Callable[..., Any] | None, size: Shape, dtype: Any) -> None:
    """A function of the time with a derivative, whose value has this shape, or `None`."""
    if law is not None:
        trial(lambda t: rate_of(name, law, t, size, dtype), jnp.zeros((), dtype))


def curvature_of(
    name: str, function: Callable[..., Any], t: Array, arclength: Array, length: Array, dim: int
) -> Array:
    """A curvature along fibres, `(joints,)`, in space also vectors, `(joints, 3)`."""
    joints, dtype = len(arclength), arclength.dtype
    vectors = ((joints, 3),) if dim == 3 else ()
    given = jnp.asarray(t, dtype), arclength, length
    shapes = ((), (joints,), *vectors)
    value = value_of(name, f"{joints} joints", function, *given, shapes=shapes, dtype=dtype)
    return value if value.ndim else jnp.broadcast_to(value, (joints,))


def along(name: str, value: Any, joints: int, dim: int, dtype: Any) -> None:
    """Numbers along a fibre, or a function of time, arclength and length that returns them; as vectors
    where `dim` is 3.
    """
    if callable(value):
        t, s = jnp.zeros((), dtype), jnp.zeros(joints, dtype)
        trial(lambda t, s: curvature_of(name, value, t, s, s, dim), t, s)
    else:
        vectors = ((joints, 3),) if dim == 3 else ()
        shape(name, value, (), (joints,), *vectors)


def _raised(error: Exception) -> str:
    """Why a function cannot be called, without the words of tracing."""
    text = str(error).strip() or type(error).__name__
    if isinstance(error, TracerArrayConversionError) or "ufunc" in text:
        return "it calls numpy: use jax.numpy, as jnp.sin for np.sin"
    if isinstance(error, (ConcretizationTypeError, TracerIntegerConversionError)):
        return (
            "it needs a number before there is one: use jax.numpy for math, jnp.where for if, and "
            "jnp.asarray for float"
        )
    text = re.split(r"(?<=[.!?;])\s+(?=[A-Z])|\n", text)[0].rstrip(".!?:; ")
    text = re.sub(r"(Traced|[A-Z]\w*Tracer)<[^>]*>(with<[^>]*>)?", "an array", text)
    text = re.sub(r"\b\w*Tracer\b", "Array", text)
    text = re.sub(r" (object )?at 0x[0-9a-f]+", "", text)
    return f"it raises: {text}"


def _array(name: str, value: Any) -> Array:
    """An array of real numbers from whatever holds them."""
    for leaf in _leaves(value):
        if not isinstance(leaf, _NUMBERS):
            inside = "" if leaf is value else f"{described(value)} that holds "
            fail(name, "return numbers", f"it returns {inside}{described(leaf)}")
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError, OverflowError):
        fail(name, "return one array of numbers", f"it returns {_unfit(value)}")
    if jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer):
        return array
    fail(name, "return real numbers", f"it returns numbers of type {array.dtype}")


def _leaves(value: Any) -> list[Any]:
    if isinstance(value, (list, tuple)):
        return [leaf for part in value for leaf in _leaves(part)]
    return [value]


def _unfit(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return f"{described(value)} of parts that do not fit together"
    kind = getattr(value, "dtype", None)
    return described(value) if kind is None else f"an array of type {kind}"
