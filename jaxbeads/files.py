"""Trajectory files: HDF5, written while running, from which a run continues bit for bit.

Layout: `t` (times), `position` (times, beads, dim), `director`, `frame`, `own_0` ... where there
are, `residual`, `bond_length_error`; `ts` (all planned times); group `scene` (every number of the model
and solver); `model` (the structure that these numbers belong to, as JSON, see `contents`); groups
`checkpoint/0` and `checkpoint/1` (all that the next step depends on, written in turns); `mark` (which
of the two is whole, how many states belong to it, steps so far), written last in one piece: what lies
beyond it is the rest of an interrupted write; `seconds` (in all, and of them for compiling; not a
number unless the last run ended by itself). Attributes: `format`, `versions`, `solver`.

A file appears under its name when its first state is written, in one piece, and not before: until then
an older one of that name is as it was. While a run writes, HDF5 holds a lock; others are turned away.
"""

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import equinox as eqx
import h5py
import jax
import jax.numpy as jnp
import numpy as np

from ._checks import fail
from .carried import PARTS, values, with_values
from .contents import Contents
from .outcome import Outcome
from .rollout import Stepper
from .scene import Scene
from .solution import Solution, name_number
from .solver.stepping import Carry
from .state import State
from .storage import (
    Place,
    in_use,
    key_of,
    reason,
    refuse_in_use,
    refuse_unwritable,
    refuse_written_here,
    written,
)

FORMAT = 2
_READ = (1, 2)
"""Formats that are read. The first holds whole intervals alone, and no number of steps since."""
_COLUMNS = ("t", "position", "residual", "bond_length_error")
_OWN = "own_"
"""Name of what a force owns, before the number of the force."""
_LIMITS = ("solver.max_steps", "scene.mobility.devices")
"""What decides on no number of a run that ends well (devices: but for rounding), and may be another when
it is resumed."""


def _leaves(tree: Any) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))]


def _contents(scene: Scene, stepper: Stepper) -> Contents:
    return Contents(_LIMITS, scene=scene, solver=stepper.solver)


class DamagedFile(ValueError):
    """A file that cannot be continued, with the reason in one sentence."""


@contextmanager
def _readable(path: str | Path) -> Iterator[None]:
    """Refuse contents that are missing or cannot be read."""
    try:
        yield
    except (KeyError, OSError) as error:
        why = reason(error) if isinstance(error, OSError) else "a part of it is missing"
        raise DamagedFile(f"Argument `file` must be whole, but {path} is damaged: {why}.") from None


class TrajectoryFile:
    """One run's file, open for appending; with a `place`, it is put there with its first state."""

    def __init__(
        self, handle: h5py.File, place: Place | None = None, seconds: Any = (0.0, 0.0)
    ) -> None:
        self.handle, self.place = handle, place
        self.seconds = np.asarray(seconds)  # of the runs before
        self.key = key_of(handle.filename)
        written.add(self.key)

    def close(self) -> None:
        """Close the file."""
        self.handle.close()
        written.discard(self.key)
        if self.place is not None:
            self.place.leave()

    @classmethod
    def create(
        cls, path: str | Path, scene: Scene, stepper: Stepper, ts: Any, state: State
    ) -> "TrajectoryFile":
        """A new file; an existing one is replaced as soon as there is a state to write.

        **Raises** `ValueError` if the path cannot be written or is in use.
        """
        place = Place(path)
        try:
            handle = h5py.File(place.part, "w")
        except OSError as error:
            place.leave()
            refuse_unwritable(path, reason(error))
        file = cls(handle, place)
        try:
            file.prepare(scene, stepper, ts, state)
        except BaseException:
            file.close()
            raise
        return file

    def prepare(self, scene: Scene, stepper: Stepper, ts: Any, state: State) -> None:
        """Write what is known before the first state."""
        handle, contents = self.handle, _contents(scene, stepper)
        handle.attrs["format"] = FORMAT
        handle.attrs["solver"] = stepper.solver.name
        handle["model"] = contents.text()
        handle.attrs["versions"] = f"jax {jax.__version__}, h5py {h5py.__version__}"
        handle["ts"] = np.asarray(ts)
        for index, number in enumerate(contents.numbers):
            handle[f"scene/{index}"] = number
        columns = {"t": np.asarray(ts)[:1], "position": np.asarray(state.position)[None]}
        columns |= {name: np.asarray(part)[None] for name, part in _carried(state).items()}
        for name in ("residual", "bond_length_error"):
            columns[name] = np.zeros(1)
        for name, first in columns.items():
            handle.create_dataset(
                name,
                shape=(0, *first.shape[1:]),
                maxshape=(None, *first.shape[1:]),
                chunks=True,
                dtype=first.dtype,
            )
        handle["mark"] = np.zeros(3, np.int64)
        handle["seconds"] = np.full(2, np.nan)

    def append(self, part: Solution | None, carry: Carry) -> None:
        """Add the times of `part`, if there are any, and the checkpoint that belongs to them.

        The new checkpoint takes the place of the last but one, and counts only once the mark says so:
        an interrupt at any place leaves the file as it was before, or as it is after.
        """
        mark: Any = self.handle["mark"]
        slot, done, _ = (int(x) for x in mark[:])
        for name, column in _columns(part).items():
            data: Any = self.handle[name]
            data.resize(done + len(column), axis=0)
            data[done:] = np.asarray(column)
        group = self.handle.require_group(f"checkpoint/{1 - slot}")
        for index, leaf in enumerate(_leaves(carry)):
            group.require_dataset(str(index), leaf.shape, leaf.dtype)[...] = leaf
        self.handle.flush()
        self._set_seconds(np.nan)
        mark[:] = (1 - slot, done + (0 if part is None else len(part.ts)), int(carry.steps))
        self.handle.flush()
        if self.place is not None:
            self.place.take()
            self.place = None

    def end(self, solution: Solution) -> None:
        """Note how long the run took, which ends with this solution."""
        self._set_seconds(self.seconds + np.array([solution.wall_s, solution.compile_s], float))

    def _set_seconds(self, value: Any) -> None:
        self.handle.require_dataset("seconds", (2,), float)[...] = value


def _columns(part: Solution | None) -> dict[str, Any]:
    """What is written of each time."""
    if part is None:
        return {}
    errors = {"residual": part.residual, "bond_length_error": part.bond_length_error}
    return {"t": part.ts, "position": part.states.position, **_carried(part.states), **errors}


def _open(path: str | Path, mode: str) -> h5py.File:
    if not Path(path).exists():
        raise ValueError(f"Argument `file` must name a trajectory file, but {path} does not exist.")
    try:
        handle = h5py.File(path, mode)
    except OSError as error:
        if in_use(error):
            refuse_in_use(path)
        raise DamagedFile(
            f"Argument `file` must be a trajectory file, but {path} cannot be read: "
            f"{reason(error)}."
        ) from None
    missing = {"ts", "mark", *_COLUMNS} - set(handle)
    kind = handle.attrs.get("format")
    if missing or kind not in _READ:
        handle.close()
        why = f"lacks {', '.join(sorted(missing)) or 'its format mark'}"
        if kind not in (None, *_READ):
            why = f"is of format {kind}, of another version of jaxbeads"
        raise DamagedFile(
            f"Argument `file` must be a trajectory file of format {FORMAT}, but {path} {why}."
        )
    return handle


def load(path: str | Path) -> Solution:
    """Read a trajectory file, finished or not.

    **Raises** `ValueError` (`DamagedFile`) if it is not there or not readable.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> state, ts = jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0]
    >>> fall = jb.simulate(scene, state, ts, substeps=1, file="fall.h5", progress=False)
    >>> print(jb.load("fall.h5").states.position[:, 0, 1].round(4))
    [ 0.     -0.3183 -0.6366]
    """
    with _readable(path), _open(path, "r") as handle:
        _, done, steps = (int(x) for x in np.asarray(handle["mark"]))
        planned, stored = np.asarray(handle["ts"]), _whole_columns(handle, path, done)
        ts, position, residual, error = (jnp.asarray(stored[name]) for name in _COLUMNS)
        others = {name: jnp.asarray(x) for name, x in stored.items() if name not in _COLUMNS}
        wall, compiling = _seconds(handle)
        return Solution(
            ts,
            _states(position, others),
            jnp.asarray(steps, int),  # with a type, or it would be a weak one
            jnp.asarray(int(Outcome.FINE), int),
            residual,
            error,
            wall,
            compiling,
            Outcome.FINISHED if len(planned) == done else Outcome.UNFINISHED,
            name_number(str(handle.attrs.get("solver", ""))),
        )


def _seconds(handle: h5py.File) -> np.ndarray:
    return np.asarray(handle["seconds"]) if "seconds" in handle else np.full(2, np.nan)


def _whole_columns(handle: h5py.File, path: str | Path, done: int) -> dict[str, np.ndarray]:
    """The states that the mark vouches for."""
    own = [name for name in map(str, handle) if name.startswith(_OWN)]
    names = [*_COLUMNS, *({part.name for part in PARTS} & set(handle)), *own]
    columns = {name: np.asarray(handle[name]) for name in names}
    short = min(len(column) for column in columns.values())
    times = np.asarray(handle["ts"])[:done]
    if done == 0 or short < done or not np.array_equal(columns["t"][:done], times):
        raise DamagedFile(
            f"Argument `file` must hold whole states at its planned times, but {path} does not."
        )
    return {name: column[:done] for name, column in columns.items()}


def planned_times(path: str | Path) -> jax.Array:
    """All times of a run, those done and those to come."""
    with _readable(path), _open(path, "r") as handle:
        return jnp.asarray(np.asarray(handle["ts"]))


def _carried(states: State) -> dict[str, Any]:
    """What states carry beside the positions, by the names that it has in files."""
    named = values(states, ("own",))
    own = enumerate(states.own or ())
    return named | {f"{_OWN}{k}": numbers for k, numbers in own if numbers is not None}


def _states(position: jax.Array, others: dict[str, jax.Array]) -> State:
    """States at several times from the columns of a file."""
    own = {int(name.removeprefix(_OWN)): x for name, x in others.items() if name.startswith(_OWN)}
    blank: dict[str, Any] = {p.name: jnp.zeros((1, 3)) for p in PARTS if p.name in others}
    if own:
        given = [own.get(k) for k in range(max(own) + 1)]
        blank["own"] = tuple(None if x is None else jnp.zeros(()) for x in given)
    tree = jax.tree.structure(with_values(jnp.zeros((1, 3)), blank))
    rest = [others[part.name] for part in PARTS if part.name in others]
    return jax.tree.unflatten(tree, [position, *rest, *(own[k] for k in sorted(own))])


def compare(path: str | Path, scene: Scene, stepper: Stepper) -> None:
    """Check that a file was written with this scene and this solver, to the last number; see `contents`.

    **Raises** `ValueError` if not, which says what was another.
    """
    with _readable(path), _open(path, "r") as handle:
        written: Any = handle["model"]
        try:
            before = Contents.read(written.asstr()[()], _numbers(handle))
        except (ValueError, TypeError, AttributeError, RuntimeError):
            raise DamagedFile(
                f"Argument `file` must be whole, but the model in {path} cannot be read."
            ) from None
    now = _contents(scene, stepper)
    if _parts(before) != _parts(now):  # as where solvers did not carry their own options
        raise DamagedFile(
            "Argument `file` must be written by this version of jaxbeads to be continued, but "
            f"{path} is of another one (`load` reads it)."
        )
    different = before.difference(now)
    if different is not None:
        must = "be the scene and solver with which the file was written"
        fail("scene", must, different, "How do I save, load and resume?")


def _parts(contents: Contents) -> set[str]:
    """What a model is made of, as `scene` and `solver`."""
    return {path for path in contents.entries if path.isidentifier()}


def _numbers(handle: h5py.File) -> Iterator[np.ndarray]:
    for index in itertools.count():
        yield np.asarray(handle[f"scene/{index}"])


def reopen(path: str | Path, carry: Carry) -> tuple[TrajectoryFile, Carry]:
    """Open a file to continue its run.

    **Arguments**: the path; `carry` of the same structure as the run's. **Returns** the file and the
    carry to go on from. **Raises** `ValueError` (`DamagedFile`) if anything does not fit.
    """
    refuse_written_here(path, path)
    handle = _open(path, "r+")
    try:
        with _readable(path):
            slot, done, _ = (int(x) for x in np.asarray(handle["mark"]))
            _whole_columns(handle, path, done)
            if handle.attrs["format"] == 1:
                checkpoint: Any = handle[f"checkpoint/{slot}"]
                *others, taken = _leaves(carry)
                checkpoint.require_dataset(str(len(others)), (), taken.dtype)
                handle.attrs["format"] = FORMAT
            carry = _restore(handle, f"checkpoint/{slot}", carry, path)
            seconds = _seconds(handle)
    except BaseException:
        handle.close()
        raise
    return TrajectoryFile(handle, seconds=seconds), carry


def _restore(handle: h5py.File, group: str, like: Any, path: str | Path) -> Any:
    arrays, rest = eqx.partition(like, eqx.is_array)
    leaves, tree = jax.tree.flatten(arrays)
    stored = []
    for index, leaf in enumerate(leaves):
        name = f"{group}/{index}"
        if name not in handle:
            raise DamagedFile(f"Argument `file` must be whole, but {path} lacks {name}.")
        value = np.asarray(handle[name])
        if value.shape != leaf.shape or value.dtype != leaf.dtype:
            raise DamagedFile(
                f"Argument `file` must fit scene and solver, but {name} in {path} has shape "
                f"{value.shape} and type {value.dtype}, not {leaf.shape} and {leaf.dtype}."
            )
        stored.append(jnp.asarray(value))
    return eqx.combine(jax.tree.unflatten(tree, stored), rest)
