"""A place for a file: taken by one run at a time, and in one piece once there is something to keep.

HDF5 locks a file that is open for writing against other processes, but empties one that it is to replace
before it looks at the lock; and within a process it lets a file be opened twice. So a new file is made
beside its place, under a name of its own, while the older one there is kept open.
"""

import errno
import itertools
import os
from pathlib import Path
from typing import NoReturn

import h5py

from ._checks import fail

written: set[tuple[int, int]] = set()
"""Device and number of the files that runs of this process write: HDF5's lock is one of processes."""
_count = itertools.count()


def reason(error: OSError) -> str:
    """What HDF5 says, without the addresses and flags that it adds."""
    if error.errno:
        return os.strerror(error.errno)
    return str(error).partition("(")[2].partition(":")[0].rstrip(")") or str(error)


def refuse_unwritable(path: str | Path, why: str) -> NoReturn:
    """Raise the sentence."""
    raise ValueError(
        f"Argument `file` must be a path that can be written, but {path} is not: {why}."
    )


def refuse_in_use(path: str | Path) -> NoReturn:
    """Raise the sentence."""
    raise ValueError(f"Argument `file` must not be in use, but another run writes to {path}.")


def in_use(error: OSError) -> bool:
    """Whether HDF5 could not open a file since somebody else has it."""
    locked = error.errno in (errno.EAGAIN, errno.EWOULDBLOCK)
    return locked or "already open" in str(error) or "unable to lock" in str(error)


def key_of(path: str | Path) -> tuple[int, int]:
    """What tells a file from others, whatever it is called."""
    about = os.stat(path)
    return about.st_dev, about.st_ino


def refuse_written_here(path: str | Path, name: str | Path) -> None:
    """Raise the sentence if a run of this process writes to the file."""
    if os.path.exists(path) and key_of(path) in written:
        refuse_in_use(name)


def _claimed(path: Path, name: str | Path) -> h5py.File | None:
    """The trajectory file of an older run that is to be replaced, locked; `None` if there is none.

    **Raises** `ValueError` if it is in use, or not to be written.
    """
    if path.is_dir():
        refuse_unwritable(name, os.strerror(errno.EISDIR))
    refuse_written_here(path, name)
    try:
        handle = h5py.File(path, "r+")
    except FileNotFoundError:
        return None
    except OSError as error:
        if in_use(error):
            refuse_in_use(name)
        if error.errno:
            refuse_unwritable(name, reason(error))
        return None  # of another kind, or damaged
    descriptor = os.fstat(handle.id.get_vfd_handle())
    # In the meantime another run may have put its own file there.
    moved = not path.exists() or (descriptor.st_dev, descriptor.st_ino) != key_of(path)
    if moved:
        handle.close()
        refuse_in_use(name)
    return handle


def replace_whole(path: Path, content: bytes) -> None:
    """Put a file in its place in one piece: an older one is there until then."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(content)
        part.replace(path)
    finally:  # which is there still if the disk is full
        part.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes) -> None:
    """As `replace_whole`, at a user's argument `path`. **Raises** `ValueError` if that cannot be."""
    try:
        replace_whole(path, content)
    except OSError as error:
        fail("path", "be a file that can be written", f"{path} is not: {error.strerror}")


class Place:
    """Where a file that is being made will be."""

    def __init__(self, name: str | Path) -> None:
        self.name, self.path = name, Path(os.path.realpath(name))
        existed = self.path.exists()
        self.claim = _claimed(self.path, name)
        self.free = not existed and self.claim is None
        self.part = self.path.with_name(f".{self.path.name}.{os.getpid()}-{next(_count)}.part")

    def take(self) -> None:
        """Put the file there."""
        try:
            if self.free:
                self._link()
            else:
                os.replace(self.part, self.path)
        except OSError as error:
            refuse_unwritable(self.name, reason(error))
        self.leave()

    def _link(self) -> None:
        try:
            os.link(self.part, self.path)  # fails if another run has been quicker
        except FileExistsError:
            refuse_in_use(self.name)
        except OSError:  # a file system without links
            os.replace(self.part, self.path)

    def leave(self) -> None:
        """Let go of the place."""
        self.part.unlink(missing_ok=True)
        if self.claim is not None:
            self.claim.close()
