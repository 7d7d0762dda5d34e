"""Trajectory files: HDF5, written while running, from which a run continues bit for bit.

Layout: `t` (times), `position` (times, beads, dim), `director` where there is one, `residual`,
`bond_length_error`; `ts` (all planned times); group `scene` (every number of the model and solver);
group `checkpoint` (all that the next step depends on). Attributes: `format`, `versions`, `model`.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import equinox as eqx
import h5py
import jax
import jax.numpy as jnp
import numpy as np

from .rollout import Solution, Stepper
from .scene import Scene
from .solver.stepping import Carry
from .state import State

FORMAT = 1
_COLUMNS = ("t", "position", "residual", "bond_length_error")


def _leaves(tree: Any) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))]


def _model(scene: Scene, stepper: Stepper) -> str:
    """The structure of scene and solver without the numbers, as text."""
    blank = jax.tree.map(lambda x: 0 if eqx.is_array(x) else x, (scene, stepper))
    return repr(blank)


class DamagedFile(ValueError):
    """A file that cannot be continued, with the reason in one sentence."""


def _reason(error: OSError) -> str:
    """What HDF5 says, without the addresses and flags that it adds."""
    if error.errno:
        return os.strerror(error.errno)
    return str(error).partition("(")[2].partition(":")[0].rstrip(")") or str(error)


@contextmanager
def _readable(path: str | Path) -> Iterator[None]:
    """Refuse contents that are missing or cannot be read."""
    try:
        yield
    except (KeyError, OSError) as error:
        reason = _reason(error) if isinstance(error, OSError) else "a part of it is missing"
        raise DamagedFile(
            f"Argument `file` must be whole, but {path} is damaged: {reason}."
        ) from None


class TrajectoryFile:
    """One run's file, open for appending."""

    def __init__(self, handle: h5py.File) -> None:
        self.handle = handle

    def close(self) -> None:
        """Close the file."""
        self.handle.close()

    @classmethod
    def create(
        cls, path: str | Path, scene: Scene, stepper: Stepper, ts: Any, state: State
    ) -> "TrajectoryFile":
        """A new file; an existing one is replaced.

        **Raises** `ValueError` if the path cannot be written.
        """
        try:
            handle = h5py.File(path, "w")
        except OSError as error:
            raise ValueError(
                f"Argument `file` must be a path that can be written, but {path} is not: "
                f"{_reason(error)}."
            ) from None
        handle.attrs["format"] = FORMAT
        handle.attrs["model"] = _model(scene, stepper)
        handle.attrs["versions"] = f"jax {jax.__version__}, h5py {h5py.__version__}"
        handle["ts"] = np.asarray(ts)
        for index, leaf in enumerate(_leaves((scene, stepper))):
            handle[f"scene/{index}"] = leaf
        columns = {"t": np.asarray(ts)[:1], "position": np.asarray(state.position)[None]}
        if state.director is not None:
            columns["director"] = np.asarray(state.director)[None]
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
        return cls(handle)

    def append(self, part: Solution, carry: Carry) -> None:
        """Add the times of `part` and replace the checkpoint."""
        columns = {
            "t": part.ts,
            "position": part.states.position,
            "director": part.states.director,
            "residual": part.residual,
            "bond_length_error": part.bond_length_error,
        }
        for name, values in columns.items():
            if values is not None:
                data: Any = self.handle[name]
                data.resize(data.shape[0] + len(values), axis=0)
                data[-len(values) :] = np.asarray(values)
        if "checkpoint" in self.handle:
            del self.handle["checkpoint"]
        for index, leaf in enumerate(_leaves(carry)):
            self.handle[f"checkpoint/{index}"] = leaf
        self.handle.attrs["steps"] = int(carry.steps)
        self.handle.flush()


def _open(path: str | Path, mode: str) -> h5py.File:
    if not Path(path).exists():
        raise ValueError(f"Argument `file` must name a trajectory file, but {path} does not exist.")
    try:
        handle = h5py.File(path, mode)
    except OSError as error:
        raise DamagedFile(
            f"Argument `file` must be a trajectory file, but {path} cannot be read: "
            f"{_reason(error)}."
        ) from None
    missing = {"ts", *_COLUMNS} - set(handle)
    if missing or handle.attrs.get("format") != FORMAT:
        handle.close()
        raise DamagedFile(
            f"Argument `file` must be a trajectory file of format {FORMAT}, but {path} lacks "
            f"{', '.join(sorted(missing)) or 'its format mark'}."
        )
    return handle


def load(path: str | Path) -> Solution:
    """Read a trajectory file, finished or not.

    **Raises** `ValueError` (`DamagedFile`) if it is not there or not readable.
    """
    with _readable(path), _open(path, "r") as handle:

        def column(name: str) -> jax.Array | None:
            return jnp.asarray(np.asarray(handle[name])) if name in handle else None

        ts, position = column("t"), column("position")
        if ts is None or position is None or len(ts) == 0:
            raise DamagedFile(f"Argument `file` must hold a trajectory, but {path} holds no state.")
        planned = np.asarray(handle["ts"])
        status = "finished" if len(planned) == len(ts) else "unfinished"
        return Solution(
            ts,
            batch_state(position, column("director")),
            jnp.asarray(int(handle.attrs["steps"])),  # pyright: ignore[reportArgumentType]
            jnp.zeros((), int),
            column("residual"),
            column("bond_length_error"),
            status=status,
        )


def planned_times(path: str | Path) -> jax.Array:
    """All times of a run, those done and those to come."""
    with _readable(path), _open(path, "r") as handle:
        return jnp.asarray(np.asarray(handle["ts"]))


def batch_state(position: jax.Array, director: jax.Array | None) -> State:
    """A `State` with leading axes."""
    blank = jnp.zeros((1, 2))
    tree = jax.tree.structure(State(blank, None if director is None else blank))
    return jax.tree.unflatten(tree, [x for x in (position, director) if x is not None])


def compare(path: str | Path, scene: Scene, stepper: Stepper) -> None:
    """Check that a file was written with this scene and this solver, to the last number.

    **Raises** `ValueError` if not.
    """
    with _readable(path), _open(path, "r") as handle:
        if handle.attrs.get("model") != _model(scene, stepper):
            must = "the scene and solver with which the file was written"
            raise ValueError(f"Argument `scene` must be {must}, but its terms differ.")
        _restore(handle, "scene", (scene, stepper), path, same=True)


def reopen(path: str | Path, carry: Carry) -> tuple[TrajectoryFile, Carry]:
    """Open a file to continue its run.

    **Arguments**: the path; `carry` of the same structure as the run's. **Returns** the file and the
    carry to go on from. **Raises** `ValueError` (`DamagedFile`) if anything does not fit.
    """
    handle = _open(path, "r+")
    try:
        with _readable(path):
            carry = _restore(handle, "checkpoint", carry, path, same=False)
            ts, done = np.asarray(handle["ts"]), np.asarray(handle["t"])
            lengths = {len(np.asarray(handle[name])) for name in _COLUMNS}
        if len(lengths) != 1 or not np.array_equal(done, ts[: len(done)]) or len(done) == 0:
            raise DamagedFile(
                f"Argument `file` must hold whole states at its planned times, but {path} does not."
            )
    except BaseException:
        handle.close()
        raise
    return TrajectoryFile(handle), carry


def _restore(handle: h5py.File, group: str, like: Any, path: str | Path, same: bool) -> Any:
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
        if same and not np.array_equal(value, leaf, equal_nan=True):
            raise ValueError(
                "Argument `scene` must be the scene with which the file was written, but one of its "
                f"numbers is {np.ravel(leaf)[:3]} and was {np.ravel(value)[:3]}."
            )
        stored.append(jnp.asarray(value))
    return eqx.combine(jax.tree.unflatten(tree, stored), rest)
