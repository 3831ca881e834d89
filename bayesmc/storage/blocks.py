"""Blocks of a run, appended behind an image: what is there stays there, whatever happens to the process.

A block is a head (a mark, a number, a length, two checksums) and packed bytes, on the disk before the image
says that the file reaches so far. What lies behind that was on its way when the process ended, and is no
block; where the file ends before, it was cut off, and the blocks that are whole are known by their
checksums.
"""

from __future__ import annotations

import errno
import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from bayesmc.errors import CheckpointError, DamagedFileError
from bayesmc.storage.image import open_image, set_end
from bayesmc.storage.replacing import replacing

try:
    import fcntl
except ImportError:  # not on this system
    fcntl = None  # type: ignore[assignment]

_MARK = b"bmcBLOCK"
#: mark, kind, number, length, checksum of what follows, checksum of the head
_HEAD = struct.Struct("<8s8sQQII")
SIZE = 64
#: what blocks hold: rows that are kept, the state to go on from, which the next one makes void
ROWS, STATE = b"rows\0\0\0\0", b"state\0\0\0"
#: bytes of void states from which on a file is written anew without them, and so many times all others
_VOID, _SHARE = 32 << 20, 2


class Block(NamedTuple):
    """Where a block lies."""

    kind: bytes
    at: int
    length: int

    @property
    def end(self) -> int:
        """The byte after its last one."""
        return self.at + SIZE + self.length


class Blocks:
    """The blocks of a file.

    Parameters
    ----------
    path : path
        Of an image that is there.
    repair : bool
        Take the blocks that are whole of a file that is damaged.
    alone : bool
        Let no other process add blocks, as long as this object lives or until it is closed.
    named : path, optional
        What the user gave as ``checkpoint=``, if not this path.

    Raises
    ------
    DamagedFileError
        The file is cut off, or a block is not what was written; ``blocks`` says how many are whole.
    """

    def __init__(
        self,
        path: str | Path,
        repair: bool = False,
        alone: bool = False,
        named: Any = None,
    ) -> None:
        self.path = Path(path)
        self._named = str(path if named is None else named)
        self._lock = Lock(self.path) if alone else None
        self.image = open_image(path)
        self._end = self.image.end
        self.blocks = self._found(repair)

    @property
    def count(self) -> int:
        """Times that something was saved."""
        return sum(b.kind == STATE for b in self.blocks)

    def rows(self) -> Iterator[bytes]:
        """What blocks of rows hold, first to last."""
        for block in self.blocks:
            if block.kind == ROWS:
                yield self.read(block)

    @property
    def state(self) -> bytes | None:
        """What the last block of a state holds."""
        last = [b for b in self.blocks if b.kind == STATE]
        return self.read(last[-1]) if last else None

    def read(self, block: Block) -> bytes:
        """What a block holds."""
        with open(self.path, "rb") as file:
            file.seek(block.at + SIZE)
            return file.read(block.length)

    def close(self) -> None:
        """Let other processes add blocks."""
        self._lock = None

    def append(self, rows: Sequence[Any] | None, state: Sequence[Any]) -> None:
        """Add rows and the state that follows them: both are there from then on, or neither.

        Raises
        ------
        CheckpointError
            The disk is full, or may not be written; the blocks before stay.
        """
        added: list[Block] = []
        try:
            handle = os.open(self.path, os.O_RDWR | getattr(os, "O_BINARY", 0))
            try:
                end = self._end
                for kind, parts in ((ROWS, rows), (STATE, state)):
                    if parts is not None:
                        number = len(self.blocks) + len(added)
                        added.append(_append(handle, _next(end), kind, number, parts))
                        end = added[-1].end
                os.fsync(handle)
                set_end(handle, self.image.end_at, end)
                os.fsync(handle)
                os.ftruncate(handle, end)
            except OSError:
                os.ftruncate(handle, self._end)  # room for others
                raise
            finally:
                os.close(handle)
        except OSError as error:
            raise refused(self.path, error) from error
        self._end = end
        self.blocks += added
        self._tidy()

    # ---- private -------------------------------------------------------------------------------

    def _found(self, repair: bool) -> list[Block]:
        """All blocks up to the end that the image knows of."""
        found: list[Block] = []
        at, size = _next(self.image.size), self.path.stat().st_size
        why = ""
        with open(self.path, "rb") as file:
            while at < self._end:
                block = _read(file, at, len(found), min(size, self._end))
                if block is None:
                    why = f"it is cut off: {size} of {self._end} bytes are there"
                    why = (
                        why
                        if size < self._end
                        else f"bytes behind {at} are not those that were written"
                    )
                    break
                found.append(block)
                at = _next(block.end)
        if not why:
            return found
        while found and found[-1].kind != STATE:  # rows without a state are no place to go on from
            found.pop()
        count = sum(b.kind == STATE for b in found)
        if not repair:
            raise DamagedFileError(f"{self.path}: {why}. {self._remedy(count)}", count)
        self._end = found[-1].end if found else self.image.size
        return found

    def _remedy(self, count: int) -> str:
        """How to go on where so many blocks are whole."""
        if not count:
            return "None of its blocks is whole; move it away and call again"
        whole = "One of its blocks is whole" if count == 1 else f"{count} of its blocks are whole"
        again = f"bmc.CheckpointFile({self._named!r}, repair=True)"
        return f"{whole}; to go on from the last of them, give checkpoint={again}"

    def _tidy(self) -> None:
        """Write the file anew where most of it is states that are void."""
        states = [b.length for b in self.blocks if b.kind == STATE]
        void = sum(states[:-1])
        if void <= _VOID or void < _SHARE * (self._end - void):
            return
        kept = [b for b in self.blocks if b.kind == ROWS] + [self.blocks[-1]]
        moved, end = [], self.image.size
        try:
            with (
                replacing(self.path) as new,
                open(self.path, "rb") as old,
                open(new, "r+b") as file,
            ):
                _copy(old, 0, file, 0, self.image.size)
                for number, block in enumerate(kept):
                    old.seek(block.at)
                    head = list(_HEAD.unpack(old.read(_HEAD.size)))
                    moved.append(Block(block.kind, _next(end), block.length))
                    file.seek(moved[-1].at)
                    file.write(_head(head[1], number, head[3], head[4]))
                    _copy(old, block.at + SIZE, file, moved[-1].at + SIZE, block.length)
                    end = moved[-1].end
                file.flush()
                set_end(file.fileno(), self.image.end_at, end)
        except OSError:  # there is no room for both: the file stays as it is
            return
        self.blocks, self._end = moved, end
        if self._lock is not None:
            self._lock = Lock(self.path)


class Lock:
    """Keeps other processes from adding to a file as long as it lives; readers are not kept out.

    Raises
    ------
    CheckpointError
        Another one does.
    """

    def __init__(self, path: Path) -> None:
        self._handle = os.open(path, os.O_RDWR)
        if not hasattr(fcntl, "F_OFD_SETLK"):  # there is none on this system
            return
        whole = struct.pack("hhqqi4x", fcntl.F_WRLCK, 0, 0, 0, 0)
        try:
            fcntl.fcntl(self._handle, fcntl.F_OFD_SETLK, whole)
        except BlockingIOError:
            raise CheckpointError(
                f"{path}: another process is running this, and saves itself there; wait for it, or give "
                "another path"
            ) from None
        except OSError:  # a file system without locks
            pass

    def __del__(self) -> None:
        if hasattr(self, "_handle"):
            os.close(self._handle)


def refused(path: Path, error: OSError) -> CheckpointError:
    """What is said of a path that cannot be written, or of a disk that takes no more."""
    if path.is_dir():
        return CheckpointError(
            f"{path}: that is a folder; give the path of a file, such as {str(path / 'run.nc')!r}"
        )
    if not path.parent.is_dir():
        return CheckpointError(
            f"{path}: there is no folder {path.parent}; make it, or give another path"
        )
    if isinstance(error, (PermissionError, FileNotFoundError)) or error.errno == errno.EROFS:
        return CheckpointError(
            f"{path}: it may not be written ({error.strerror or error}); give a path in a folder where you "
            "may write"
        )
    return CheckpointError(
        f"{path}: {error.strerror or error}; what was saved before is whole, and the same call goes on from "
        "there once there is room"
    )


# ---- private ------------------------------------------------------------------------------------


def _next(end: int) -> int:
    """Where a block behind that byte begins."""
    return end + -end % SIZE


def _head(kind: bytes, number: int, length: int, checksum: int) -> bytes:
    plain = _HEAD.pack(_MARK, kind, number, length, checksum, 0)
    return _HEAD.pack(_MARK, kind, number, length, checksum, zlib.crc32(plain)).ljust(SIZE, b"\0")


def _append(handle: int, at: int, kind: bytes, number: int, parts: Sequence[Any]) -> Block:
    length, checksum = 0, 0
    for part in parts:
        length, checksum = length + len(part), zlib.crc32(part, checksum)
    _write_all(handle, _head(kind, number, length, checksum), at)
    place = at + SIZE
    for part in parts:
        _write_all(handle, part, place)
        place += len(part)
    return Block(kind, at, length)


def _write_all(handle: int, data: Any, at: int) -> None:
    view = memoryview(data).cast("B") if len(data) else memoryview(b"")
    os.lseek(handle, at, os.SEEK_SET)
    while len(view):
        view = view[os.write(handle, view[: 1 << 30]) :]


def _read(file: Any, at: int, number: int, limit: int) -> Block | None:
    """The block at a place, if it is whole."""
    if at + SIZE > limit:
        return None
    file.seek(at)
    head = file.read(SIZE)
    mark, kind, own, length, checksum, _ = _HEAD.unpack(head[: _HEAD.size])
    if mark != _MARK or own != number or head != _head(kind, own, length, checksum):
        return None
    if at + SIZE + length > limit:
        return None
    found, left = 0, length
    while left:
        piece = file.read(min(left, 1 << 24))
        if not piece:
            return None
        found, left = zlib.crc32(piece, found), left - len(piece)
    return Block(kind, at, length) if found == checksum else None


def _copy(old: Any, source: int, new: Any, target: int, length: int) -> None:
    old.seek(source)
    new.seek(target)
    while length:
        piece = old.read(min(length, 1 << 24))
        new.write(piece)
        length -= len(piece)
