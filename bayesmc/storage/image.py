"""Images: NetCDF files that are written whole and put in place at once.

NetCDF is HDF5 with names for axes: ``xarray.open_datatree(path)`` and ArviZ read it. Ours has one group
besides (``bayesmc``), which holds what was saved as packed bytes, and says how far the blocks behind it
reach. Those numbers change as blocks come; everything else in an image has a checksum.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayesmc.errors import DamagedFileError, FileFormatError, missing_extra
from bayesmc.storage.replacing import Patient, replacing

#: of the layout of files; one that is newer is refused
VERSION = 2
#: the group that is ours, what is packed in it, and where blocks end
GROUP, PACKED, END = "bayesmc", "packed", "end"


class Lazy(NamedTuple):
    """An array that is written piece by piece.

    Attributes
    ----------
    shape : tuple of int
    dtype : dtype
    pieces : callable
        Pairs of an index and the array that belongs there.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    pieces: Callable[[], Iterator[tuple[Any, np.ndarray]]]


class Variable(NamedTuple):
    """A named array of a group."""

    dims: tuple[str, ...]
    data: Any
    attributes: Mapping[str, Any] = {}


@dataclass(frozen=True)
class Group:
    """Variables, and the labels of their axes."""

    variables: Mapping[str, Variable]
    coordinates: Mapping[str, Sequence[Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class Image:
    """What stands in an image.

    Attributes
    ----------
    packed : bytes
    attributes : dict
        Of our group.
    size : int
        Bytes of the file up to its first block.
    end : int
        And up to the end of its last one.
    end_at : int
        Where that number stands in the file.
    """

    packed: bytes
    attributes: Mapping[str, Any]
    size: int
    end: int
    end_at: int


def write_image(
    path: str | Path,
    groups: Mapping[str, Group],
    packed: Sequence[Any],
    attributes: Mapping[str, Any],
    anew: bool = False,
) -> None:
    """Write a file whole, and put it in the place of any that is there: readers see the one or the other.

    Parameters
    ----------
    path : path
    groups : dict
        Name -> ``Group``.
    packed : sequence of bytes
        Parts of what ``storage.packed`` made.
    attributes : dict
        Of our group: numbers and text.
    anew : bool
        Where none is there, only: of two processes that write, one comes first.

    Raises
    ------
    MissingExtraError
        Without h5netcdf (the extra ``netcdf``).
    FileExistsError
        One is there that should not be.
    OSError
        The disk is full, or may not be written; what was there is left as it is.
    """
    path = Path(path)
    h5py, h5netcdf = libraries()
    with replacing(path, anew) as new, Patient(new) as raw_file:
        with h5netcdf.File(raw_file, "w") as file:
            for name, group in groups.items():
                _write_group(h5py, file.create_group(name), group)
            ours = file.create_group(GROUP)
            size = sum(len(part) for part in packed)
            ours.dimensions = {"byte": size, "reach": 3}
            ours.attrs.update({"format": VERSION, **attributes})
            held = ours.create_variable(PACKED, ("byte",), np.uint8)._h5ds
            at = 0
            for part in packed:
                piece = np.frombuffer(part, np.uint8)
                if len(piece):
                    held[at : at + len(piece)] = piece
                at += len(piece)
            end = ours.create_variable(END, ("reach",), np.int64)._h5ds
            end[...] = 0
            where = int(end.id.get_offset())
        raw_file.settle()
        with open(new, "r+b", buffering=0) as raw:
            size = os.fstat(raw.fileno()).st_size
            set_end(raw.fileno(), where, size)
            set_end(raw.fileno(), where + 8, size)
            set_end(raw.fileno(), where + 16, _checksum(new, size, where))


def open_image(path: str | Path) -> Image:
    """Read an image; blocks behind it are not looked at.

    Raises
    ------
    FileNotFoundError
    MissingExtraError
    DamagedFileError
        It is cut off, or its bytes have changed.
    FileFormatError
        It is no file of ours, or of a version to come.
    """
    h5py, _ = libraries()
    with _opened(h5py, path) as file, _whole(path):
        if GROUP not in file or PACKED not in file[GROUP]:
            raise FileFormatError(
                f"{path}: a file of this kind, but not one that bayesmc wrote; open it with xarray or ArviZ"
            )
        ours = file[GROUP]
        attributes = {k: _plain(v) for k, v in ours.attrs.items() if not k.startswith("_")}
        if attributes.get("format", 0) > VERSION:
            raise FileFormatError(
                f"{path}: written by a later bayesmc (format {attributes['format']}, this one reads up to "
                f"{VERSION}); read it with that version"
            )
        held = ours[END]
        size, end, *checksum = (int(n) for n in held[...])
        where = int(held.id.get_offset())
        if checksum and checksum[0] != _checksum(path, size, where):
            raise _changed(path, f"the first {size} bytes are not those that were written")
        return Image(ours[PACKED][...].tobytes(), attributes, size, end, where + 8)


def is_ours(path: str | Path) -> bool:
    """Whether a file is one that bayesmc wrote, as far as it can be read."""
    try:
        open_image(path)
    except (OSError, FileFormatError):
        return False
    return True


class Stored:
    """Arrays of an image by name, read whole or left in the file.

    Parameters
    ----------
    path : path
    mapped : bool
        Leave them in the file: pages are read when they are looked at.
    """

    def __init__(self, path: str | Path, mapped: bool = False) -> None:
        self.path, self.mapped = path, mapped

    def __call__(self, name: str) -> np.ndarray:
        h5py, _ = libraries()
        with _opened(h5py, self.path) as file:
            if name not in file:
                raise FileFormatError(f"{self.path}: {name} is missing; the file is damaged")
            held = file[name]
            offset = held.id.get_offset()
            if not self.mapped or offset is None or not held.size:
                found = held[...]
                found.flags.writeable = False
                return found
            shape, dtype = held.shape, held.dtype
        return np.memmap(self.path, dtype, "r", offset, shape)


def libraries() -> tuple[Any, Any]:
    """h5py and h5netcdf.

    Raises
    ------
    MissingExtraError
    """
    try:
        import h5netcdf
        import h5py
    except ImportError as error:
        raise missing_extra((error.name or "h5netcdf").partition(".")[0], "netcdf") from None
    return h5py, h5netcdf


def set_end(handle: int, where: int, end: int) -> None:
    """Say how far a file reaches: eight bytes, which are there whole or not at all."""
    os.lseek(handle, where, os.SEEK_SET)
    os.write(handle, int(end).to_bytes(8, "little"))


# ---- private ------------------------------------------------------------------------------------


@contextmanager
def _opened(h5py: Any, path: str | Path) -> Iterator[Any]:
    if not Path(path).exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    try:
        file = _open_unlocked(h5py, path)
    except OSError as error:
        raise _unreadable(path, error) from error
    with file:
        yield file


@contextmanager
def _whole(path: str | Path) -> Iterator[None]:
    """Where bytes have changed HDF5 fails as it happens to."""
    try:
        yield
    except (DamagedFileError, FileFormatError):
        raise
    except Exception as error:
        raise _changed(path, f"what HDF5 reads in it makes no sense ({error})") from error


def _changed(path: str | Path, why: str) -> DamagedFileError:
    return DamagedFileError(
        f"{path}: {why}; nothing of it can be trusted; move it away and call again", 0
    )


def _checksum(path: str | Path, size: int, where: int) -> int:
    """Of so many bytes, but for the three numbers that stand there."""
    found, at = 0, 0
    with open(path, "rb") as file:
        while at < size:
            piece = bytearray(file.read(min(size - at, 1 << 24)))
            if not piece:
                return -1  # it is cut off, or that is not its size
            low, high = max(where - at, 0), max(where + 24 - at, 0)
            piece[low:high] = bytes(len(piece[low:high]))
            found, at = zlib.crc32(piece, found), at + len(piece)
    return found


def _open_unlocked(h5py: Any, path: str | Path) -> Any:
    """Open a file for reading, where it may be locked or cannot be."""
    try:
        return h5py.File(path, "r")
    except OSError as error:
        if "lock" not in str(error):
            raise
        return h5py.File(path, "r", locking=False)


def _unreadable(path: str | Path, error: OSError) -> Exception:
    size = Path(path).stat().st_size
    with open(path, "rb") as file:
        first = file.read(8)
    if first == b"\x89HDF\r\n\x1a\n" or not size:
        return DamagedFileError(
            f"{path}: the file is cut off, or damaged, before its first block ({size} bytes are there; "
            f"{error}): nothing of it can be gone on with; move it away and call again",
            0,
        )
    return FileFormatError(f"{path}: this is no NetCDF-4 file ({error})")


def _write_group(h5py: Any, group: Any, given: Group) -> None:
    sizes: dict[str, int] = {}
    for variable in given.variables.values():
        shape = variable.data.shape if hasattr(variable.data, "shape") else np.shape(variable.data)
        sizes.update(zip(variable.dims, shape, strict=True))
    group.dimensions = sizes
    for name, labels in given.coordinates.items():
        if name in sizes:
            values = np.asarray(labels)
            if values.dtype.kind not in "iuf":
                values = np.array([str(v) for v in labels], dtype=object)
            _write(h5py, group, name, Variable((name,), values))
    for name, variable in given.variables.items():
        _write(h5py, group, name, variable)


def _write(h5py: Any, group: Any, name: str, variable: Variable) -> None:
    data = variable.data
    lazy = data if isinstance(data, Lazy) else None
    array = None if lazy is not None else np.asarray(data)
    dtype: Any = lazy.dtype if lazy is not None else array.dtype  # type: ignore[union-attr]
    if dtype.kind in "OU":
        array, dtype = np.asarray(array, dtype=object), h5py.string_dtype()
    if dtype.kind == "b":
        dtype = np.dtype(np.int8)
    made = group.create_variable(name.replace("/", "∕"), variable.dims, dtype)
    for key, value in variable.attributes.items():
        made.attrs[key] = value
    held = made._h5ds
    for at, piece in [(..., array)] if lazy is None else lazy.pieces():
        if held.size:
            held[at] = piece


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
