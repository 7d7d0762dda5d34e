"""The error sentences: bad input is refused before anything is traced.

Each check says "Argument `x` must ..., but ...". A value that is being traced is not known yet and
passes; shapes are always known.
"""

import dataclasses
from typing import Any, NoReturn

import equinox as eqx
import jax
import numpy as np

from ._compat import Tracer


def known(value: Any) -> bool:
    """Whether every array in `value` holds numbers now (not a tracer, not a placeholder)."""
    return all(
        isinstance(leaf, (jax.Array, np.ndarray, np.generic, int, float))
        and not isinstance(leaf, Tracer)
        for leaf in jax.tree.leaves(value)
    )


def fail(name: str, must: str, but: str, recipe: str = "") -> NoReturn:
    """Raise the sentence of this project, with the question of the recipe that says how it is done."""
    where = f' (see "{recipe}" in the recipes)' if recipe else ""
    raise ValueError(f"Argument `{name}` must {must}, but {but}{where}.")


def described(value: Any) -> str:
    """What a value of the wrong kind is, in words."""
    if isinstance(value, type):
        return f"the class {value.__name__} itself"
    return repr(value) if isinstance(value, (str, type(None))) else _one(type(value))


def _one(kind: type) -> str:
    article = "an" if kind.__name__[0] in "AEIOaeio" else "a"
    return f"{article} {kind.__name__}"


def kind(name: str, value: Any, wanted: type) -> None:
    """An instance of the class `wanted`."""
    if not isinstance(value, wanted):
        fail(name, f"be {_one(wanted)} object", f"it is {described(value)}")


def finite(name: str, value: Any) -> None:
    """All entries finite."""
    if known(value) and not np.all(np.isfinite(value)):
        where = np.argwhere(~np.isfinite(np.asarray(value)))[0].tolist()
        at = f" at index {where}" if where else ""
        fail(name, "be finite", f"it holds {np.asarray(value)[tuple(where)]}{at}")


def positive(name: str, value: Any) -> None:
    """All entries finite and > 0."""
    finite(name, value)
    if known(value) and not np.all(np.asarray(value) > 0):
        fail(name, "be positive", f"its smallest value is {np.min(value):g}")


def non_negative(name: str, value: Any) -> None:
    """All entries finite and >= 0."""
    finite(name, value)
    if known(value) and not np.all(np.asarray(value) >= 0):
        fail(name, "not be negative", f"its smallest value is {np.min(value):g}")


def non_zero(name: str, vectors: Any) -> None:
    """No vector along the last axis is zero."""
    zero = np.all(np.asarray(vectors) == 0, axis=-1) if known(vectors) else np.zeros(0, bool)
    if np.any(zero):
        where = np.argwhere(zero)[0].tolist()
        fail(name, "not be zero", f"it is zero{f' at index {where}' if where else ''}")


def shape(name: str, value: Any, *allowed: tuple[int, ...]) -> None:
    """The shape is one of `allowed`."""
    if np.shape(value) not in allowed:
        wanted = " or ".join(str(s) for s in allowed)
        fail(name, f"have shape {wanted}", f"it has shape {np.shape(value)}")


def whole(name: str, value: Any, least: int) -> None:
    """A whole number that is at least `least`."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        fail(name, "be a whole number", f"it is {value!r}")
    if value < least:
        fail(name, f"be at least {least}", f"it is {value}")


def increasing(name: str, value: Any) -> None:
    """A strictly increasing sequence of at least two finite numbers."""
    if np.ndim(value) != 1 or np.shape(value)[0] < 2:
        fail(name, "be a sequence of at least two times", f"it has shape {np.shape(value)}")
    finite(name, value)
    if known(value) and not np.all(np.diff(value) > 0):
        bad = int(np.argmin(np.diff(value) > 0))
        fail(
            name,
            "increase from entry to entry",
            f"entry {bad + 1} ({float(value[bad + 1]):g}) does not exceed entry {bad} "
            f"({float(value[bad]):g})",
        )


def index(name: str, value: int, number: int) -> None:
    """An index, from either end, of one of `number` things."""
    if not -number <= value < number:
        fail(name, f"lie between {-number} and {number - 1}", f"it is {value}")


def said(value: Any) -> str:
    """A term, or a number of one, in a few words: its class, and its numbers where they are few and
    known, as `Weight(force=[0 -1])`.
    """
    if isinstance(value, eqx.Module):
        shown = ((f.name, getattr(value, f.name, None)) for f in dataclasses.fields(value))
        parts = [f"{name}={said(part)}" for name, part in shown if part is not None]
        return type(value).__name__ + (f"({', '.join(parts)})" if parts else "")
    if isinstance(value, (tuple, list)):
        parts = [said(part) for part in value]
        return f"({', '.join(parts)})" if len(parts) < 6 else f"{len(parts)} of them"
    if eqx.is_array(value):
        if not known(value) or value.size > 4:
            return f"{value.dtype}{list(value.shape)}"
        with np.printoptions(precision=4, suppress=True):
            return f"{value.item():.6g}" if value.ndim == 0 else str(np.asarray(value))
    if callable(value):
        return getattr(value, "__name__", type(value).__name__)
    return str(value)
