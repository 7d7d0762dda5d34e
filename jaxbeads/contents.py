"""What a model consists of, entry by entry, in words and numbers that two processes can compare.

An entry has a path, as `scene.forces[0].rigidity`. Arrays are compared by their numbers; everything
else that is fixed (classes, options, names) by its text. A plain function has no text of its own: it is
the same if its code is, with the numbers that it holds in its defaults, in its closure and in the
globals that it reads, whatever its name and in whichever process it was made. Functions of installed
packages, and all functions under another version of Python, are compared by their names.
"""

import contextlib
import dataclasses
import dis
import enum
import functools
import hashlib
import json
import re
import sys
import types
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np

from ._compat import Tracer

_PACKAGES = {"jax", "jaxlib", "numpy", "equinox", "diffrax", "optimistix", "lineax", "optax"}
_PACKAGES |= {__name__.partition(".")[0]}
_PYTHON = ".".join(map(str, sys.version_info[:2]))
_PLAIN = (bool, int, float, complex, str, bytes, type(None))
_MISSING = "nothing"


@dataclasses.dataclass(frozen=True)
class Law:
    """A plain function: its name, a digest of its code, and the Python that this code is for."""

    name: str
    code: str
    python: str

    def same(self, other: "Law") -> bool:
        """Whether both compute the same, as far as that can be told."""
        if self.code and other.code and self.python == other.python:
            return self.code == other.code
        return self.name == other.name


Entry = str | Law | np.ndarray


class Contents:
    """The entries of some trees, by path, in the order of their fields.

    **Arguments**: the trees by name; `but`: paths that are left out.
    """

    def __init__(self, but: Sequence[str] = (), **trees: Any) -> None:
        self.entries: dict[str, Entry] = {}
        self.traced: list[str] = []
        """Paths of numbers that are not known, as a transformation of JAX stands for them."""
        self._within: list[int] = []
        self._but = frozenset(but)
        for name, tree in trees.items():
            self._add(name, tree)

    @property
    def numbers(self) -> list[np.ndarray]:
        """All arrays in turn."""
        return [entry for entry in self.entries.values() if isinstance(entry, np.ndarray)]

    def text(self) -> str:
        """Everything but the numbers, as JSON: they are kept beside it, in turn."""

        def plain(entry: Entry) -> Any:
            if isinstance(entry, np.ndarray):
                return None
            return entry if isinstance(entry, str) else dataclasses.astuple(entry)

        return json.dumps({path: plain(entry) for path, entry in self.entries.items()})

    @classmethod
    def read(cls, text: str, numbers: Iterator[np.ndarray]) -> "Contents":
        """From `text` and the numbers. **Raises** `ValueError` or `KeyError` if they are no contents."""
        found = cls()
        for path, entry in json.loads(text).items():
            law = isinstance(entry, list)
            found.entries[path] = next(numbers) if entry is None else Law(*entry) if law else entry
        return found

    def difference(self, now: "Contents") -> str | None:
        """What has become another, in words; `None` if nothing has."""
        for path in dict.fromkeys([*self.entries, *now.entries]):
            was, is_ = self.entries.get(path, _MISSING), now.entries.get(path, _MISSING)
            if isinstance(was, np.ndarray) and isinstance(is_, np.ndarray):
                if (found := _changed_number(path, was, is_)) is not None:
                    return found
            elif isinstance(was, Law) and isinstance(is_, Law):
                if not was.same(is_):
                    other = f"{was.name} and is {is_.name}"
                    alike = "a function of other code" if was.name == is_.name else other
                    return f"`{path}` was {alike}"
            elif type(was) is not type(is_) or was != is_:
                return f"`{path}` was {_brief(was)} and is {_brief(is_)}"
        return None

    def _add(self, path: str, value: Any) -> None:
        if path in self._but:
            return
        if isinstance(value, Tracer):
            self.entries[path] = str(value)
            self.traced.append(path)
        elif eqx.is_array(value) and getattr(value.dtype, "kind", None) in tuple("biufc"):
            self.entries[path] = np.asarray(value)
        elif isinstance(value, (*_PLAIN, enum.Enum)):
            self.entries[path] = repr(value)
        elif id(value) in self._within:
            self.entries[path] = "itself"
        else:
            self._within.append(id(value))
            self._add_parts(path, value)
            self._within.pop()

    def _add_parts(self, path: str, value: Any) -> None:
        """An entry for what it is, then one for each part."""
        if isinstance(value, types.FunctionType):
            self._add_function(path, value)
        elif isinstance(value, functools.partial):  # as jax.tree_util.Partial is
            held = value.args, dict(value.keywords)
            self._add(path, value.func)
            if any(held):
                self._add(f"{path}.arguments", held)
        elif isinstance(value, types.MethodType):
            self._add(path, value.__func__)
            self._add(f"{path}.self", value.__self__)
        elif isinstance(value, type):
            self.entries[path] = f"the class {value.__qualname__}"
        elif isinstance(value, (tuple, list)):
            kinds = [type(x).__name__ for x in value]
            self.entries[path] = f"({', '.join(kinds)})"
            for index, part in enumerate(value):
                self._add(f"{path}[{index}]", part)
        elif isinstance(value, Mapping):
            self.entries[path] = f"names {', '.join(map(str, value))}"
            for name, part in value.items():
                self._add(f"{path}[{name!r}]", part)
        elif dataclasses.is_dataclass(value):
            self.entries[path] = type(value).__name__
            for field in dataclasses.fields(value):
                self._add(f"{path}.{field.name}", getattr(value, field.name, None))
        else:
            self._add_other(path, value)

    def _add_other(self, path: str, value: Any) -> None:
        name = getattr(value, "__qualname__", None)
        inner = getattr(value, "__wrapped__", None)
        if callable(value) and inner is not None:  # as by jax.jit
            self._add(path, inner)
        elif name is not None:  # built in
            self.entries[path] = str(name)
        elif callable(value) and hasattr(value, "__dict__"):  # a user's class of laws
            self.entries[path] = type(value).__name__
            self._add(f"{path}.call", type(value).__call__)
            for name, part in vars(value).items():
                self._add(f"{path}.{name}", part)
        else:
            self.entries[path] = re.sub(r" at 0x[0-9a-f]+", "", repr(value))

    def _add_function(self, path: str, function: types.FunctionType) -> None:
        code, own = function.__code__, not _installed(function)
        digest = hashlib.sha256(_code(code).encode()).hexdigest() if own else ""
        self.entries[path] = Law(function.__qualname__, digest, _PYTHON)
        held: dict[str, Any] = {}
        for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
            with contextlib.suppress(ValueError):  # not yet given a value
                held[name] = cell.cell_contents
        defaults = function.__defaults__ or ()
        last = code.co_varnames[: code.co_argcount][code.co_argcount - len(defaults) :]
        held |= dict(zip(last, defaults, strict=True)) | (function.__kwdefaults__ or {})
        if own:
            names = [n for n in _globals(code) if n in function.__globals__]
            held |= {n: function.__globals__[n] for n in names}
        for name, value in held.items():
            if _telling(value):
                self._add(f"{path}.{name}", value)


def _installed(function: Any) -> bool:
    return str(getattr(function, "__module__", "")).partition(".")[0] in _PACKAGES


def _telling(value: Any) -> bool:
    """Whether what a function reads decides on its numbers and can be looked at: modules, classes and
    functions of packages are in its code by name; of other objects nothing is known.
    """
    if isinstance(value, types.FunctionType):  # one of a package, as of jax.vmap, may hold another
        return not _installed(value) or value.__closure__ is not None
    if isinstance(value, (functools.partial, types.MethodType)):
        return True
    if isinstance(value, (tuple, list)):
        return all(map(_telling, value))
    if isinstance(value, Mapping):
        return all(map(_telling, value.values()))
    module = dataclasses.is_dataclass(value) and not isinstance(value, type)
    return module or isinstance(value, _PLAIN) or eqx.is_array(value)


def _code(code: types.CodeType) -> str:
    """What a function does, as text: not where it is written nor what it is called."""

    def text(constant: Any) -> str:
        if isinstance(constant, types.CodeType):
            return _code(constant)
        if isinstance(constant, frozenset):  # in an order of its own in each process
            return f"frozenset {sorted(map(text, constant))}"
        if isinstance(constant, tuple):
            return f"({', '.join(map(text, constant))})"
        return f"{type(constant).__name__} {constant!r}"

    constants = [text(constant) for constant in code.co_consts]
    read = [*code.co_names, *code.co_freevars]
    return repr((code.co_code, constants, read, code.co_argcount, code.co_kwonlyargcount))


def _globals(code: types.CodeType) -> Iterator[str]:
    """Names of the globals that code reads, and the functions in it."""
    for step in dis.get_instructions(code):
        if step.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            yield str(step.argval)
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _globals(constant)


def _changed_number(path: str, was: np.ndarray, now: np.ndarray) -> str | None:
    if was.shape != now.shape:
        return f"`{path}` had shape {was.shape} and has {now.shape}"
    if was.dtype != now.dtype:
        return f"`{path}` was of type {was.dtype} and is of {now.dtype}"
    exact = was.dtype.kind not in "fc"
    if np.array_equal(was, now, equal_nan=not exact):
        return None
    differ = was != now if exact else (was != now) & ~(np.isnan(was) & np.isnan(now))
    where = tuple(int(k) for k in np.argwhere(differ)[0])
    at = f"{path}[{', '.join(map(str, where))}]" if where else path
    return f"`{at}` was {was[where].item()!r} and is {now[where].item()!r}"


def _brief(entry: Entry) -> str:
    if isinstance(entry, Law):
        return f"the function {entry.name}"
    if isinstance(entry, np.ndarray):
        return str(entry.item()) if entry.ndim == 0 else f"an array of shape {entry.shape}"
    return entry if len(entry) < 100 else f"{entry[:100]}..."
