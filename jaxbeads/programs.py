"""What the program of a function shows: which results depend on an argument, and where it switches.

A user's function of the time may jump: `jnp.where(t > 10, ...)`, `jnp.floor(t)`, a table read by
`jnp.interp`. Nothing at two times tells what happens between them, but JAX's program of the function
names every decision that it takes. Their values at any time are the function's `switches`: where one of
them differs, the function has passed from one smooth piece to another.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._compat import Literal

# Steps that hold a program which is run once, as it stands.
_CALLS = {
    "jit",
    "pjit",
    "closed_call",
    "core_call",
    "checkpoint",
    "remat",
    "remat2",
    "custom_jvp_call",
    "custom_vjp_call",
    "custom_vjp_call_jaxpr",
    "custom_vmap_call",
}
_INNER = ("jaxpr", "call_jaxpr", "fun_jaxpr", "call")
_ROUNDED = {"floor", "ceil", "round", "sign"}


def reached(function: Callable[[Any], Any], at: Any) -> list[bool]:
    """Which of the arrays that a function returns depend on its argument at all."""
    program = jax.make_jaxpr(function)(at).jaxpr
    reached = set(program.invars)
    for step in program.eqns:
        if any(v in reached for v in step.invars if not isinstance(v, Literal)):
            reached.update(step.outvars)
    return [not isinstance(v, Literal) and v in reached for v in program.outvars]


def switches(
    function: Callable[[Array], Any], dtype: Any
) -> Callable[[Float[Array, ""]], Float[Array, " switches"]] | None:
    """What a function of the time decides by it, as a function of the time: comparisons, roundings, and
    whatever else is a whole number, one after the other. `None` if it decides nothing.

    What happens within loops is seen where it leaves them as a whole number.
    """
    program = jax.make_jaxpr(function)(jnp.zeros((), dtype))

    def values(t: Array) -> list[Array]:
        found: list[Array] = []
        _walk(program.jaxpr, program.consts, [(t, True)], found)
        return [jnp.ravel(x).astype(dtype) for x in found]

    if not jax.eval_shape(values, jnp.zeros((), dtype)):
        return None
    return lambda t: jnp.concatenate(values(t))


_Known = tuple[Any, bool]
"""A value, and whether the time has a part in it."""


def _walk(program: Any, consts: Any, arguments: list[_Known], found: list[Array]) -> list[_Known]:
    """Run a program, and collect what it decides by the time."""
    held: dict[Any, _Known] = {}
    held.update(zip(program.constvars, ((c, False) for c in consts), strict=True))
    held.update(zip(program.invars, arguments, strict=True))

    def read(v: Any) -> _Known:
        return (v.val, False) if isinstance(v, Literal) else held[v]

    for step in program.eqns:
        given = [read(v) for v in step.invars]
        values, timed = [v for v, _ in given], any(t for _, t in given)
        name = step.primitive.name
        inner = next((step.params[n] for n in _INNER if n in step.params), None)
        if name in _CALLS and inner is not None:
            closed = hasattr(inner, "jaxpr")
            body, extra = (inner.jaxpr, inner.consts) if closed else (inner, ())
            results = _walk(body, extra, given, found)
        else:
            out = step.primitive.bind(*values, **step.params)
            several = out if step.primitive.multiple_results else [out]
            results = [(x, timed) for x in several]
            if timed:
                found += _decided(name, values, several)
        held.update(zip(step.outvars, results, strict=True))
    return [read(v) for v in program.outvars]


def _decided(name: str, values: list[Any], results: list[Any]) -> list[Array]:
    """What one step decides."""
    if name in ("max", "min"):
        return [values[0] > values[1]]
    if name == "abs":
        return [jnp.sign(values[0])]
    if name == "clamp":
        low, value, high = values
        return [value > low, value < high]
    if name == "rem":
        return [jnp.trunc(values[0] / values[1])]
    if name in _ROUNDED:
        return results
    whole = (jnp.bool_, jnp.integer)
    return [x for x in results if any(jnp.issubdtype(jnp.result_type(x), k) for k in whole)]
