"""What runs in a worker: a unit of a job that it has, or asks for."""

from __future__ import annotations

import threading
import traceback
import warnings
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from bayesmc.workers.travel import known_to, named, packed, unpacked

#: parts of jobs that a worker remembers, and bytes that they may have come in
_KEPT, _BYTES = 16, 256 << 20
_parts: OrderedDict[str, tuple[Any, int]] = OrderedDict()
_lock = threading.Lock()


class Told(NamedTuple):
    """What a worker sends back.

    Attributes
    ----------
    kind : "found", "failed" or "wanted"
        A result, an exception, or that it does not have the job.
    data : bytes
    wanted : tuple of str
        Digests of the parts that it does not have.
    warned : list of (type, str)
        Warnings on the way.
    """

    kind: str
    data: bytes = b""
    wanted: tuple[str, ...] = ()
    warned: tuple[tuple[type[Warning], str], ...] = ()


def work(digests: Sequence[str], sent: Mapping[str, bytes], unit: bytes, attempt: int = 0) -> Told:
    """A unit worked out.

    Parameters
    ----------
    digests : sequence of str
        Of the parts of its job.
    sent : dict of bytes
        Those parts that are sent along.
    unit : bytes
    attempt : int
        How often the unit was lost before; schedulers that look at arguments see another task.
    """
    try:
        found = _found(digests, sent)
    except Exception as error:
        return _failed(error)
    if isinstance(found, Told):
        return found
    function, shared = found
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            own, seeds = unpacked(unit, known_to(shared))
            shared = {**shared, **seeds}
            result = function(shared, own)
            told = Told("found", packed(result, known_to(shared, own)))
        except Exception as error:
            told = _failed(error)
    return told._replace(warned=tuple((w.category, str(w.message)) for w in caught))


# ---- private ------------------------------------------------------------------------------------


def _found(digests: Sequence[str], sent: Mapping[str, bytes]) -> Any:
    """A job's function with what its units share; or what is wanted of it.

    Parts are kept with all that was derived from them, the last used longest: a question that is asked again
    is traced and compiled once. What is kept is known by the digest of all that travelled.
    """
    *before, job = digests
    with _lock:
        if job not in _parts:
            missing = tuple(d for d in digests if d not in _parts and d not in sent)
            if missing:
                return Told("wanted", wanted=missing)
            known: dict[str, Any] = {}
            for digest in before:
                if digest not in _parts:
                    _keep(digest, unpacked(sent[digest]), len(sent[digest]))
                known |= named(digest, _parts[digest][0])
            _keep(job, unpacked(sent[job], known), len(sent[job]))
        for digest in digests:
            if digest in _parts:
                _parts.move_to_end(digest)
        found = _parts[job][0]
        _forget(len(digests))
        return found


def _keep(digest: str, part: Any, size: int) -> None:
    _parts[digest] = part, size


def _forget(needed: int) -> None:
    """Let go of the parts that were not used for longest; never of those of the job at hand."""
    while len(_parts) > needed and (
        len(_parts) > _KEPT or sum(size for _, size in _parts.values()) > _BYTES
    ):
        _parts.popitem(last=False)


def _failed(error: BaseException) -> Told:
    """An exception with where it was raised, which pickles leave out."""
    where = "".join(traceback.format_exception(error))
    if isinstance(error, ModuleNotFoundError) and error.name:
        root = error.name.partition(".")[0]
        error = ModuleNotFoundError(
            f"a worker cannot import {error.name!r}, where functions of the question stand; install it "
            f"there, or call cloudpickle.register_pickle_by_value({root}) before",
            name=error.name,
        )
    try:
        data = packed((error, where))
        unpacked(data)
    except Exception:
        data = packed((RuntimeError(f"{type(error).__name__}: {error}"), where))
    return Told("failed", data)
