"""Large arrays that processes of one machine share: files in memory, mapped and not copied.

A value is pickled with its arrays apart, which go to a file of ``/dev/shm`` (elsewhere of the temporary
folder) and are mapped, read-only, by whoever opens it. Handing it on is handing on a path.
"""

from __future__ import annotations

import concurrent.futures
import mmap
import os
import pickle
import tempfile
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

_MEMORY = Path("/dev/shm")


class Held(NamedTuple):
    """A value whose arrays lie in a file.

    Attributes
    ----------
    path : str
    head : bytes
        All but the arrays.
    sizes : tuple of int
        Bytes of each array, end to end.
    """

    path: str
    head: bytes
    sizes: tuple[int, ...]


def shares_memory(executor: Any) -> bool:
    """Whether an executor's workers are other processes of this machine, as far as its kind tells."""
    local = isinstance(executor, concurrent.futures.ProcessPoolExecutor)
    return local or type(executor).__module__.startswith("loky")


def folder() -> tempfile.TemporaryDirectory[str]:
    """A folder for files of one run, gone when it is closed."""
    where = _MEMORY if _MEMORY.is_dir() and os.access(_MEMORY, os.W_OK) else None
    return tempfile.TemporaryDirectory(prefix="bayesmc-", dir=where, ignore_cleanup_errors=True)


def hold(value: Any, where: str) -> Held:
    """A value with its arrays in a new file of a folder."""
    buffers: list[pickle.PickleBuffer] = []
    head = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    raws = [buffer.raw() for buffer in buffers]
    handle, path = tempfile.mkstemp(dir=where)
    with os.fdopen(handle, "wb") as file:
        for raw in raws:
            file.write(raw)
    return Held(path, head, tuple(raw.nbytes for raw in raws))


def opened(held: Any) -> Any:
    """The value behind ``Held``, its arrays mapped; anything else as it is."""
    if not isinstance(held, Held):
        return held
    parts: list[memoryview] = []
    if sum(held.sizes):
        with open(held.path, "rb") as file:
            whole = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        start = 0
        for size in held.sizes:
            parts.append(whole[start : start + size])
            start += size
    else:
        parts = [memoryview(b"") for _ in held.sizes]
    return pickle.loads(held.head, buffers=parts)


def drop(held: Collection[Any], still: Collection[Any]) -> None:
    """Remove the files of what nobody holds any more."""
    used = {one.path for one in still if isinstance(one, Held)}
    for one in held:
        if isinstance(one, Held) and one.path not in used:
            Path(one.path).unlink(missing_ok=True)
