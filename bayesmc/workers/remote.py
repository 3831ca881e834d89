"""What runs in a worker: a unit of a job that it has, or asks for."""

from __future__ import annotations

import threading
import traceback
import warnings
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, NamedTuple

from bayesmc.workers.travel import known_to, packed, unpacked

#: jobs that a worker remembers
_KEPT = 4
_jobs: OrderedDict[str, tuple[Any, Mapping[str, Any]]] = OrderedDict()
_lock = threading.Lock()


class Told(NamedTuple):
    """What a worker sends back.

    Attributes
    ----------
    kind : "found", "failed" or "wanted"
        A result, an exception, or that it does not have the job.
    data : bytes
    warned : list of (type, str)
        Warnings on the way.
    """

    kind: str
    data: bytes = b""
    warned: tuple[tuple[type[Warning], str], ...] = ()


def work(job: str, data: bytes | None, unit: bytes, attempt: int = 0) -> Told:
    """A unit worked out.

    Parameters
    ----------
    job : str
        Its digest.
    data : bytes or None
        The job itself, where it is sent along.
    unit : bytes
    attempt : int
        How often the unit was lost before; schedulers that look at arguments see another task.
    """
    try:
        found = _found(job, data)
    except Exception as error:
        return _failed(error)
    if found is None:
        return Told("wanted")
    function, shared = found
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            own = unpacked(unit, known_to(shared))
            result = function(shared, own)
            told = Told("found", packed(result, known_to(shared, own)))
        except Exception as error:
            told = _failed(error)
    return told._replace(warned=tuple((w.category, str(w.message)) for w in caught))


# ---- private ------------------------------------------------------------------------------------


def _found(job: str, data: bytes | None) -> tuple[Any, Mapping[str, Any]] | None:
    with _lock:
        found = _jobs.get(job)
        if found is None and data is not None:
            found = _jobs[job] = unpacked(data)
            while len(_jobs) > _KEPT:
                _jobs.popitem(last=False)
        return found


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
