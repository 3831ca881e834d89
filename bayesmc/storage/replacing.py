"""New files in the place of others: whole or not at all, whatever happens to the process or to the disk."""

from __future__ import annotations

import contextlib
import glob
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def replacing(path: Path, anew: bool = False) -> Iterator[str]:
    """The name of a new file, which takes the place of another one once all of it is on the disk.

    Where there must be none, ``anew``, it comes before or after what another process puts there, not over it.
    """
    try:
        handle, new = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".new", dir=path.parent)
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: there is no folder {path.parent}") from None
    os.close(handle)
    try:
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(new, 0o666 & ~mask)
        yield new
        with open(new, "rb") as file:
            os.fsync(file.fileno())
        (_put_first if anew else os.replace)(new, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(new)
        raise
    with contextlib.suppress(OSError):  # not every system lets folders be opened
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def clear_leftovers(path: Path) -> None:
    """Remove what processes that were killed left of files that were to take the place of this one."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*.new"):
        with contextlib.suppress(OSError):
            left.unlink()


class Patient:
    """A file that takes all that is written, and says in the end what went wrong.

    HDF5 does not survive a disk that is full: it fails again and again as it closes its file, and may take
    the process with it.
    """

    def __init__(self, path: str) -> None:
        self._file = open(path, "r+b", buffering=0)  # noqa: SIM115 - closed on the way out
        self._error: OSError | None = None
        self._size = self._at = 0

    def settle(self) -> None:
        """Raise what went wrong.

        Raises
        ------
        OSError
        """
        if self._error is not None:
            raise self._error

    def __enter__(self) -> Patient:
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        self._file.close()
        if self._error is not None and error is not self._error:
            raise self._error

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        try:
            at = self._at
            while self._error is None and at < self._at + len(view):
                self._file.seek(at)
                at += self._file.write(view[at - self._at :]) or 0
        except OSError as error:
            self._error = error
        self._at += len(view)
        self._size = max(self._size, self._at)
        return len(view)

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        self._file.seek(self._at)
        count = self._file.readinto(view) or 0
        view[count:] = bytes(len(view) - count)
        self._at += len(view)
        return len(view)

    def read(self, count: int) -> bytes:
        data = bytearray(count)
        self.readinto(data)
        return bytes(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        self._at = offset + (0, self._at, self._size)[whence]
        return self._at

    def tell(self) -> int:
        return self._at

    def truncate(self, size: int | None = None) -> int:
        size = self._at if size is None else size
        try:
            if self._error is None:
                self._file.truncate(size)
        except OSError as error:
            self._error = error
        self._size = size
        return size

    def flush(self) -> None:
        """There is nothing that waits."""


# ---- private ------------------------------------------------------------------------------------


def _put_first(new: str, path: Path) -> None:
    try:
        os.link(new, path)
    except FileExistsError:
        raise
    except OSError:  # no links on this system, or the one who came first has cleared what was left
        if path.exists():
            raise FileExistsError(str(path)) from None
        os.replace(new, path)
    else:
        os.unlink(new)
