"""How jobs and results travel between processes: as bytes, functions included.

Elsewhere pickles leave functions out, so that a file never holds code; to a worker of one's own they are sent
along (cloudpickle). What both sides have already, the posed problem above all, is named and not sent back.
"""

from __future__ import annotations

import hashlib
import io
import pickle
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.errors import UnsupportedError, WorkerError, missing_extra
from bayesmc.network import FactorGraph, Model, Problem
from bayesmc.network.captured import Captured

#: what a problem derived and cannot be derived anew from its net and its evidence
_LASTING = ("series",)
#: rooms whose objects know best what of them travels: machine code does not
_OWN_WAY = ("bayesmc.lowering", "bayesmc.structure", "bayesmc.expression")


def packed(what: Any, known: Mapping[str, Any] | None = None) -> bytes:
    """Anything as bytes; objects that are ``known`` at the other end go by name.

    Raises
    ------
    MissingExtraError
        cloudpickle is not installed.
    """
    try:
        import cloudpickle
    except ImportError:
        raise missing_extra("cloudpickle", "workers") from None
    names = {id(value): name for name, value in (known or {}).items()}

    class Packer(cloudpickle.Pickler):
        def persistent_id(self, value: Any) -> str | None:
            return names.get(id(value))

        def reducer_override(self, value: Any) -> Any:
            state = _whole_state(value)
            if state is None:
                return super().reducer_override(value)
            return _bare, (type(value),), state, None, None, _restored

    held = io.BytesIO()
    Packer(held, protocol=pickle.HIGHEST_PROTOCOL).dump(what)
    return held.getvalue()


def unpacked(data: bytes, known: Mapping[str, Any] | None = None) -> Any:
    """What ``packed`` made of it; only for bytes of this program and its workers, never for files."""
    reader = pickle.Unpickler(io.BytesIO(data))
    reader.persistent_load = (known or {}).__getitem__  # type: ignore[method-assign]
    return reader.load()


class Job(NamedTuple):
    """A function with what all its units share, in parts that workers keep by their digests.

    Attributes
    ----------
    parts : dict of bytes
        Digest -> what it is of: compiled nets first, which outlive the question, then the question itself.
    seeds : dict
        Random seeds among what is shared; they go along with each unit, so that the question asked again
        with another seed is the same job.
    """

    parts: Mapping[str, bytes]
    seeds: Mapping[str, np.random.SeedSequence]

    @property
    def digests(self) -> tuple[str, ...]:
        """Of the parts; the last one is of the question, and tells that all are the same."""
        return tuple(self.parts)


def pack_job(function: Any, shared: Mapping[str, Any]) -> Job:
    """A function with what all its units share, or an error that names what does not travel.

    Raises
    ------
    WorkerError
    """
    seeds = {n: v for n, v in shared.items() if isinstance(v, np.random.SeedSequence)}
    lasting = {n: v for n, v in shared.items() if n not in seeds}
    parts: dict[str, bytes] = {}
    known: dict[str, Any] = {}
    try:
        for compiled in _compiled(lasting):
            data = packed(compiled)
            digest = hashlib.sha256(data).hexdigest()
            parts[digest] = data
            known |= named(digest, compiled)
        data = packed((function, lasting), known)
        parts[hashlib.sha256(data).hexdigest()] = data
    except Exception as error:
        culprit = next(_culprits(shared), None)
        told = f"{culprit}, which does not travel" if culprit else "the question does not travel"
        raise WorkerError(
            f"executor=: {told} to another process ({type(error).__name__}: {error}); make it inside the "
            "function or hand in its numbers, or give a ThreadPoolExecutor, whose workers share memory"
        ) from error
    return Job(parts, seeds)


def named(digest: str, compiled: tuple[Any, ...]) -> dict[str, Any]:
    """The names under which a job speaks of a part with a compiled net."""
    return {f"{digest} {k}": one for k, one in enumerate(compiled)}


def known_to(shared: Mapping[str, Any], unit: Any = None) -> dict[str, Any]:
    """Objects that a result may name, since both ends have them: name -> object."""
    found: dict[str, Any] = {}
    for name, value in _items(shared, unit):
        found[name] = value
        if isinstance(value, Problem):
            found |= {f"{name}.model": value.model, f"{name}.net": value.net}
        elif isinstance(value, SeriesProblem):
            slices = value.slices
            found |= {f"{name}.dbn": value.dbn, f"{name}.slices": slices}
            found |= {f"{name}.first": slices.first, f"{name}.later": slices.later}
    unlike = (int, float, str, bytes, bool, tuple, list, dict, type(None))
    return {n: v for n, v in found.items() if not isinstance(v, unlike)}


# ---- private ------------------------------------------------------------------------------------


def _compiled(shared: Mapping[str, Any]) -> Iterator[tuple[Any, ...]]:
    """What of a question was there before it was asked: compiled nets, with what they were declared as."""
    for value in shared.values():
        if isinstance(value, Problem):
            yield value.model, value.net
        elif isinstance(value, SeriesProblem):
            yield value.slices, value.slices.first, value.slices.later, value.dbn


def _items(shared: Mapping[str, Any], unit: Any) -> Iterator[tuple[str, Any]]:
    for name, value in shared.items():
        yield f"shared {name}", value
    parts = unit if isinstance(unit, (tuple, list)) else (unit,)
    for k, part in enumerate(parts):
        if isinstance(part, (tuple, list)):
            yield from ((f"unit {k} {j}", own) for j, own in enumerate(part))
        else:
            yield f"unit {k}", part


def _whole_state(value: Any) -> dict[str, Any] | None:
    """All that an object of ours holds, functions too, where its own pickles leave some out."""
    kind = type(value)
    if not kind.__module__.startswith("bayesmc.") or kind.__module__.startswith(_OWN_WAY):
        return None
    if isinstance(value, type) or not hasattr(value, "__dict__"):
        return None
    if isinstance(value, (Model, Problem, SeriesProblem)):
        lasting = {n: v for n, v in value.cache.items() if n in _LASTING}
        return {**value.__dict__, "cache": lasting}
    own = kind.__getstate__ is not object.__getstate__
    if not own or hasattr(kind, "__setstate__") or isinstance(value, Captured):
        return None
    return dict(value.__dict__)


def _bare(kind: type) -> Any:
    return object.__new__(kind)


def _restored(value: Any, state: Mapping[str, Any]) -> None:
    value.__dict__.update(state)


def _culprits(shared: Mapping[str, Any]) -> Iterator[str]:
    """What of a question does not travel, in words: functions of nodes first, and what they read."""
    for value in shared.values():
        for name, function in _functions(value):
            if not _travels(function):
                yield f"the function of node {name!r}" + _read_by(function)
    for name, value in shared.items():
        if isinstance(value, (list, tuple)):
            yield from (f"{name} number {k}" for k, v in enumerate(value) if not _travels(v))
        elif not _travels(value):
            yield f"{name} ({type(value).__name__})"


def _functions(value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, (list, tuple)):
        for one in value:
            yield from _functions(one)
        return
    models = []
    if isinstance(value, Problem):
        models = [value.model]
        if isinstance(value.net, FactorGraph):
            yield from ((n, p.function) for n, (p, _) in value.model.potentials.items())
    elif isinstance(value, SeriesProblem):
        models = [value.slices.first, value.slices.later]
    for model in models:
        yield from ((n, c.declaration.function) for n, c in model.nodes.items())


def _read_by(function: Any) -> str:
    """The name that a function reads from around it and that does not travel, in words."""
    cells = getattr(function, "__closure__", None) or ()
    code = getattr(function, "__code__", None)
    around: dict[str, Any] = {}
    if code is not None:
        outside = getattr(function, "__globals__", {})
        around = {n: outside[n] for n in code.co_names if n in outside}
        for name, cell in zip(code.co_freevars, cells, strict=True):
            try:
                around[name] = cell.cell_contents
            except ValueError:
                continue
    for name, value in around.items():
        if not _travels(value):
            return f" reads {name!r}, a {type(value).__name__}"
    return ""


def _travels(value: Any) -> bool:
    try:
        packed(value)
    except UnsupportedError:
        raise
    except Exception:
        return False
    return True
