"""The members of a sweep, chunk by chunk: over devices and processes, to a folder and back.

Every device runs the same program on a chunk of its own, and no chunk knows of another. Process k of n
takes the chunks k, k + n, ...; processes meet in the folder alone.
"""

import hashlib
import io
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from ._checks import fail
from ._compat import meet, over_devices
from .loops import equal_parts
from .outcome import Outcome
from .storage import replace_whole

Points = dict[str, np.ndarray]
_RECORD = "sweep.json"


class Measured(NamedTuple):
    """What is known of members, along the first axis."""

    kept: dict[str, Any]
    """What was measured."""
    code: Any
    steps: Any


Member = Callable[[dict[str, Array]], Measured]
Every = Callable[[Any], Measured]
"""Of all members of a chunk."""


def all_members(
    member: Member,
    points: Points,
    chunk: int | None,
    folder: str | os.PathLike[str] | None,
    devices: Sequence[Any] | None,
    progress: bool,
    together: int,
) -> Measured:
    """All members' results; `Outcome.NOT_RUN` where Ctrl-C came before.

    **Arguments**: see `sweep`; how many members a CPU follows side by side, at most. **Raises**
    `ValueError` if the folder holds another sweep.
    """
    devices = list(jax.local_devices() if devices is None else devices)
    total, workers = len(next(iter(points.values()))), jax.process_count()
    if folder is None:
        if workers > 1:
            fail("folder", "be given with several processes, which meet in it", "it is None")
        store = None
    else:
        store = _Store(Path(folder))
        chunk = store.chunk if chunk is None else chunk
    if chunk is None:
        chunk = min(64, -(-total // (len(devices) * workers)))
    chunk = min(chunk, total)
    count, every = -(-total // chunk), _every(member, together)
    if store is not None:
        store.open(_program(every, points, chunk), points, chunk)
    parts = {} if store is None else store.read(count)
    mine = [i for i in range(jax.process_index(), count, workers) if i not in parts]

    from tqdm.auto import tqdm

    try:
        with tqdm(total=total, initial=min(len(parts) * chunk, total), disable=not progress) as bar:
            for index, part in _runs(every, points, chunk, mine, devices):
                if store is not None:
                    store.write(index, part)
                parts[index] = part
                bar.update(len(part.code))
        if workers > 1:
            meet("the chunks of a sweep")
    except KeyboardInterrupt:
        if not parts:
            raise
    if store is not None:
        parts = store.read(count)
    return _joined(parts, count, chunk, total)


def _runs(
    every: Every, points: Points, chunk: int, mine: Sequence[int], devices: list[Any]
) -> Iterator[tuple[int, Measured]]:
    """Chunks and their results, one for each device at a time."""
    total, devices = len(next(iter(points.values()))), devices[: max(len(mine), 1)]
    spec = PartitionSpec("chunks")
    mesh = Mesh(np.array(devices), ("chunks",))
    run = over_devices(every, mesh, spec)
    groups = [list(mine[k : k + len(devices)]) for k in range(0, len(mine), len(devices))]

    def started(group: list[int]) -> Measured:
        filled = group + [group[-1]] * (len(devices) - len(group))
        # The last chunk is filled up with the last member, so that all have the same size.
        rows = np.concatenate([np.arange(i * chunk, (i + 1) * chunk) for i in filled])
        rows = np.minimum(rows, total - 1)
        sharding = NamedSharding(mesh, spec)
        return run({n: jax.device_put(v[rows], sharding) for n, v in points.items()})

    # The next chunks are under way while those before are handed out.
    following = started(groups[0]) if groups else None
    for k, group in enumerate(groups):
        result = jax.block_until_ready(following)
        following = started(groups[k + 1]) if k + 1 < len(groups) else None
        result = jax.tree.map(np.asarray, result)
        for place, index in enumerate(group):
            begin, size = place * chunk, min(chunk, total - index * chunk)
            yield index, jax.tree.map(lambda x, b=begin, s=size: x[b : b + s], result)


def _every(member: Member, together: int) -> Every:
    """The members of a chunk: on a CPU in groups, one after the other, elsewhere all side by side."""
    several = jax.vmap(member)

    def in_turn(points: Any) -> Measured:
        size = len(next(iter(points.values())))
        group = equal_parts(size, together)
        return lax.map(member, points, batch_size=group) if group > 1 else lax.map(member, points)

    return lambda points: lax.platform_dependent(points, cpu=in_turn, default=several)


def _joined(parts: Mapping[int, Measured], count: int, chunk: int, total: int) -> Measured:
    """The members of all chunks in turn, with blanks for those that are not there."""
    some = next(iter(parts.values()))

    def blank(size: int) -> Measured:
        kept = {n: np.full((size, *x.shape[1:]), np.nan, x.dtype) for n, x in some.kept.items()}
        code = np.full(size, Outcome.NOT_RUN, some.code.dtype)
        return Measured(kept, code, np.zeros(size, some.steps.dtype))

    sizes = [min(chunk, total - i * chunk) for i in range(count)]
    every = [parts[i] if i in parts else blank(size) for i, size in enumerate(sizes)]
    return jax.tree.map(lambda *x: np.concatenate(x), *every)


def _program(every: Every, points: Points, chunk: int) -> str:
    """A digest of the compiled program's source: all that decides on the numbers but the machine."""
    given = {n: jax.ShapeDtypeStruct((chunk,), v.dtype) for n, v in points.items()}
    text = jax.jit(every).lower(given).as_text()
    return hashlib.sha256(text.encode()).hexdigest()


class _Store:
    """A folder with a record of what it holds, `sweep.json`, and a file for each chunk that is done."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.record: dict[str, Any] | None = None
        try:
            self.record = json.loads((folder / _RECORD).read_text())
        except FileNotFoundError:
            pass
        except (OSError, ValueError) as error:
            fail("folder", "hold a sweep or nothing", f"{folder / _RECORD} cannot be read: {error}")

    @property
    def chunk(self) -> int | None:
        """Members in a chunk, if the folder holds a sweep."""
        return None if self.record is None else self.record["chunk"]

    def open(self, program: str, points: Points, chunk: int) -> None:
        """Begin, or make sure that the folder holds this sweep."""
        axes = {name: values.tolist() for name, values in points.items()}
        record = {"members": axes, "chunk": chunk, "program": program}
        if self.record is None:
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                replace_whole(self.folder / _RECORD, json.dumps(record).encode())
            except OSError as error:
                fail("folder", "be one that can be written", f"{self.folder}: {error.strerror}")
        others = {
            "members": "other parameters",
            "chunk": f"chunks of {self.chunk}, not {chunk}",
            "program": "a sweep of another program (`build`, `measure`, solver, times or version)",
        }
        for name, held in others.items():
            if self.record is not None and self.record.get(name) != record[name]:
                fail("folder", "hold this sweep or nothing", f"{self.folder} holds {held}")

    def read(self, count: int) -> dict[int, Measured]:
        """The chunks that are there."""
        parts = {}
        for index in range(count):
            path = self.folder / _name(index)
            if path.exists():
                try:
                    with np.load(path) as held:
                        kept = {n[2:]: held[n] for n in held.files if n.startswith("x.")}
                        parts[index] = Measured(kept, held["code"], held["steps"])
                except (OSError, ValueError, KeyError, EOFError) as error:
                    fail("folder", "hold whole files", f"{path} is damaged ({error}): remove it")
        return parts

    def write(self, index: int, part: Measured) -> None:
        """Keep a chunk: whole, or not at all."""
        buffer = io.BytesIO()
        kept = {f"x.{name}": values for name, values in part.kept.items()}
        np.savez(buffer, code=part.code, steps=part.steps, **kept)
        replace_whole(self.folder / _name(index), buffer.getvalue())


def _name(index: int) -> str:
    return f"chunk_{index:06d}.npz"
