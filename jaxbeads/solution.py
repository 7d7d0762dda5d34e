"""`Solution`: a trajectory, and what it says of itself."""

import dataclasses
import zlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ._checks import known
from ._typing import optional_float_array
from .chain import Chain
from .outcome import Outcome, meaning
from .solver import AbstractSolver
from .state import State
from .tables import labelled

if TYPE_CHECKING:
    import xarray

_SOLVERS = diffrax.AbstractSolver, AbstractSolver
_WORDS = {int(outcome): outcome.word for outcome in Outcome if outcome.is_ending}


def _small_number(value: Any) -> Array | None:
    return None if value is None else jnp.asarray(value, jnp.int32)


def name_number(name: str) -> int:
    """The number that stands for a solver's name in a `Solution`, the same in every process."""
    return zlib.crc32(name.encode()) & 0x7FFFFFFF


def _solver_names(*kinds: type) -> Iterator[str]:
    for kind in kinds:
        yield kind.__name__
        yield from _solver_names(*kind.__subclasses__())


class Solution(eqx.Module):
    """A trajectory.

    - `ts`: times, `(times,)`; `states`: `State` with a leading axis of times.
    - `steps`: attempted steps; `code`: 0 when all went well (see `Outcome`).
    - `residual`: constraint residual at each time, see `dynamics.constraint_residual`;
      `bond_length_error`: largest relative error of a bond at each time. The first is `None` from
      `rollout`.
    - `wall_s`, `compile_s`: seconds in all, and of them for compiling (`simulate` only; from a file that
      was not closed, not a number).
    - `poses`: of bodies, where they are at each time (`Journey`); `None` of fibres.
    - `status`: "finished", "stopped by `until`", "interrupted", "unfinished" or "broken down", see
      `Outcome`; `solver`: the name of the solver.

    All of it is in leaves, also how a run ended (`ending`) and by which solver (`method`), as numbers:
    solutions of one shape have one structure, however long they took and whatever became of them. Their
    differences by `jax.tree.map` are solutions again, and a jitted function is traced for one of them.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> fall = jb.rollout(scene, jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0], substeps=1)
    >>> print(fall.states.position.shape, fall.steps, fall.code, fall.status, fall.solver)
    (3, 1, 2) 2 0 finished AB3
    >>> print(fall.final.position.round(4))
    [[ 0.     -0.6366]]
    """

    ts: Float[Array, " times"]
    states: State
    steps: Int[Array, ""]
    code: Int[Array, ""]
    residual: Float[Array, " times"] | None = None
    bond_length_error: Float[Array, " times"] | None = None
    wall_s: Float[Array, ""] | None = eqx.field(converter=optional_float_array, default=None)
    compile_s: Float[Array, ""] | None = eqx.field(converter=optional_float_array, default=None)
    ending: Int[Array, ""] | None = eqx.field(converter=_small_number, default=None)
    method: Int[Array, ""] | None = eqx.field(converter=_small_number, default=None)
    poses: Any = None

    @property
    def final(self) -> State:
        """State at the last time."""
        return jax.tree.map(lambda x: x[-1], self.states)

    @property
    def status(self) -> str:
        """How it ended, in words; "traced" under a transformation, where that is not known yet. Of many
        runs, how many ended in which way. A host function.
        """
        if not known((self.code, self.ending)):
            return "traced"
        ending = Outcome.FINISHED if self.ending is None else self.ending
        pairs = np.broadcast_arrays(np.asarray(self.code), np.asarray(ending))
        words = [
            Outcome.BROKEN_DOWN.word if code != Outcome.FINE else _WORDS.get(int(end), "unknown")
            for code, end in zip(*map(np.ravel, pairs), strict=True)
        ]
        if len(set(words)) == 1:
            return words[0]
        return ", ".join(f"{words.count(word)} {word}" for word in dict.fromkeys(words))

    @property
    def solver(self) -> str | None:
        """Name of the solver; `None` where it is not known, as while it is traced. A host
        function.
        """
        if self.method is None or not known(self.method):
            return None
        names = {name_number(name): name for name in _solver_names(*_SOLVERS)}
        found = [names.get(int(number)) for number in np.unique(np.asarray(self.method))]
        return ", ".join(name or "?" for name in found) if any(found) else None

    def to_xarray(self, chain: Chain | None = None) -> "xarray.Dataset":
        """All of it as a labelled table, as `table.position.sel(time=2.0, component="x")`; with
        `table.to_netcdf("run.nc")` a file that other programs read. A host function.

        **Argument** `chain`: gives each bead its fibre, radius and arclength as coordinates.
        **Returns** an `xarray.Dataset`: `position` (time, bead, component), `director`, `frame`
        and what forces own (`own_0`, ...) where there are, `residual`, `bond_length_error`, `steps`,
        `code` and seconds. Attributes of each variable say what it is (`long_name`) and its
        `dimension`, in units of the scene; those of the table have `status` and `solver`. **Raises**
        `ValueError` for a batch, for numbers that are traced, and for a chain of other beads.
        """
        values = {
            "residual": self.residual,
            "bond_length_error": self.bond_length_error,
            "steps": self.steps,
            "code": self.code,
            "wall_s": self.wall_s,
            "compile_s": self.compile_s,
        }
        about = {"status": self.status, "solver": self.solver}
        return labelled(self.ts, self.states, values, chain, **about)

    def summary(self) -> str:
        """What was done, in a few lines. A host function, which under a transformation, where numbers
        are not known yet, says so.
        """
        *batch, times, beads, dim = self.states.position.shape
        runs = f"{' x '.join(map(str, batch))} runs of " if batch else ""
        what = f"{runs}{times} states of {beads} beads in {dim}-D"
        shapes = ", ".join(f"{name} {shape}" for name, shape in _shapes(self.states))
        if not known(self):
            return f"{what}, whose numbers are traced\n{shapes}"
        by = "" if self.solver is None else f" by {self.solver}"
        first, last = (_text(self.ts[..., k], "g") for k in (0, -1))
        steps = f"{_text(self.steps, '')} steps{by}"
        lines = [f"{what}, t = {first} to {last}, {steps}, {self.status}", shapes]
        if self.wall_s is not None and self.compile_s is not None:
            wall, compiling = _text(self.wall_s, ".2f"), _text(self.compile_s, ".2f")
            lines.append(f"wall time {wall} s, of which compiling {compiling} s")
        errors = {
            "constraint residual": self.residual,
            "bond-length error": self.bond_length_error,
        }
        given = [f"{n} {_text(x, '.1e', np.max)}" for n, x in errors.items() if x is not None]
        if given:
            lines.append(", ".join(given))
        codes = [int(c) for c in np.unique(np.asarray(self.code)) if c != Outcome.FINE]
        lines += [f"code {c}: {meaning(c)}" for c in codes]
        lines += self._next()
        return "\n".join(lines)

    def _next(self) -> list[str]:
        """What to look at next, where something is not as it should be."""
        if self.status in (Outcome.INTERRUPTED.word, Outcome.UNFINISHED.word):
            return ["`resume` continues it, if it was given a file"]
        if self.status == Outcome.BROKEN_DOWN.word:
            return [
                "`simulate` says which step, bead and term broke down; `final` is the last state"
            ]
        return []

    def __repr__(self) -> str:
        shape = getattr(getattr(self.states, "position", None), "shape", ())
        if len(shape) < 3 or 0 in shape:
            return eqx.tree_pformat(self)  # a tree of something else, as of axes
        return "Solution: " + "\n  ".join(self.summary().splitlines())


def _shapes(states: State) -> Iterator[tuple[str, tuple[int, ...]]]:
    for field in dataclasses.fields(states):
        value = getattr(states, field.name)
        several = enumerate(value) if isinstance(value, tuple) else ((None, value),)
        for index, part in several:
            if part is not None:
                yield field.name if index is None else f"{field.name}[{index}]", np.shape(part)


def _text(value: Any, form: str, of: Callable[[Any], Any] | None = None) -> str:
    """A number, or the range of many."""
    every = np.asarray(value)
    low, high = (every.min(), every.max()) if of is None else (of(every), of(every))
    one, other = (format(x.item(), form) for x in (low, high))
    return one if one == other else f"{one} to {other}"
