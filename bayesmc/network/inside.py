"""What a function can read inside an object from around it: entries of containers, attributes of objects.

A dict or an object may change in place while the name still stands for it. A shallow copy of what the
function can read of it is held against it later: the numbers, strings and small arrays in a container, and
the attributes of a plain object that the function's code names. What the function itself writes into (a
cache, a counter, a log) is left out, and entries added to a container count only where the function does
not look them up one by one, as in ``offsets[i]``.
"""

from __future__ import annotations

import dis
import functools
from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from types import (
    BuiltinFunctionType,
    CodeType,
    FunctionType,
    MemberDescriptorType,
    MethodType,
    ModuleType,
)
from typing import Any

import numpy as np

#: numbers of an array up to which it is copied
SMALL = 4096
#: entries of a container up to which it is copied: of numbers and strings, and of anything else
_PLAIN, _MIXED = 1024, 32
#: containers in objects in containers that are looked into
_DEPTH = 3
_SIMPLE = frozenset({int, float, complex, bool, str, bytes, type(None)})
#: what may be defined anew without another net being meant
_NO_OBJECTS = (FunctionType, BuiltinFunctionType, MethodType, ModuleType, type, np.ufunc)
#: methods that change a container, whose content the function then keeps for itself
_CHANGERS = frozenset(
    "append add appendleft clear discard extend insert pop popitem popleft remove reverse setdefault sort "
    "update".split()
)
_LOADS = ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_DEREF", "LOAD_FAST", "LOAD_ATTR", "LOAD_METHOD")
_MISSING = object()


@dataclass(frozen=True)
class Reads:
    """What code reads: attributes, string constants, whether by ``[]``, and the names it writes into."""

    attributes: frozenset[str] = frozenset()
    keys: frozenset[str] = frozenset()
    by_key: bool = False
    writes: frozenset[str] = frozenset()

    def __or__(self, other: Reads) -> Reads:
        if other is self:
            return self
        return Reads(
            self.attributes | other.attributes,
            self.keys | other.keys,
            self.by_key or other.by_key,
            self.writes | other.writes,
        )


@dataclass(frozen=True, eq=False)
class Inside:
    """Entries of one object as they stood at declaration, and what was read of it."""

    entries: Any
    reads: Reads

    def change(self, now: Any) -> tuple[str, Any, Any] | None:
        """The first entry that differs: its path from the name, what it was and what it is."""
        return _change(self.entries, now, self.reads, "")


def is_simple(value: Any) -> bool:
    """Whether a value is a number, a string or None, which cannot change."""
    return type(value) in _SIMPLE


def inside(name: str, value: Any, reads: Reads) -> Inside | None:
    """What can be read inside a value; None where there is nothing that may change."""
    if (
        type(value) in _SIMPLE
        or name in reads.writes
        or isinstance(value, (np.generic, np.ndarray))
    ):
        return None
    if isinstance(value, _NO_OBJECTS) or _is_ours(value):
        return None
    if not isinstance(value, (dict, list, tuple, set)):
        kind: Any = type(value)
        reads = _with_methods(kind, reads)
    entries = _freeze(value, reads, _DEPTH)
    return Inside(entries, reads) if isinstance(entries, _Entries) else None


@functools.lru_cache(maxsize=4096)
def reads_of(code: CodeType) -> Reads:
    """What code reads and writes into, functions inside it among it."""
    steps = list(dis.get_instructions(code))
    attributes: set[str] = set()
    writes: set[str] = set()
    by_key = False
    aliases: dict[str, str] = {}
    for k, step in enumerate(steps):
        before = _loaded(steps[k - 1]) if k else ()
        if step.opname in ("LOAD_ATTR", "LOAD_METHOD"):
            attributes.add(str(step.argval))
            if step.argval in _CHANGERS:
                writes.update(before)
        elif step.opname in ("STORE_ATTR", "DELETE_ATTR"):
            writes.add(str(step.argval))
        elif step.opname in ("STORE_FAST", "STORE_DEREF") and before:
            aliases[str(step.argval)] = before[-1]
        elif step.opname in ("STORE_SUBSCR", "DELETE_SUBSCR", "STORE_SLICE"):
            writes.update(_written(steps, k))
        elif step.opname == "BINARY_SUBSCR" or (step.opname == "BINARY_OP" and "[" in step.argrepr):
            by_key = True
    for _ in range(3):  # c = self.cache; c[key] = ...
        writes |= {aliases[name] for name in writes if name in aliases}
    keys = frozenset(c for c in code.co_consts if isinstance(c, str))
    found = Reads(frozenset(attributes), keys, by_key, frozenset(writes))
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            found = found | reads_of(inner)
    return found


# ---- private ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Entries:
    """Entries of a container or an object: ``kind`` is dict, list, set or object."""

    kind: str
    items: Any


class _Unseen:
    """An entry that is not looked at."""


def _loaded(step: dis.Instruction) -> tuple[str, ...]:
    if not step.opname.startswith(_LOADS):
        return ()
    return step.argval if isinstance(step.argval, tuple) else (str(step.argval),)


def _written(steps: list[dis.Instruction], at: int) -> Iterable[str]:
    """Names of the container that ``container[key] = value`` writes into; of all on its line if unsure."""
    need = 1  # the key lies on top of the container
    for k in range(at - 1, -1, -1):
        step = steps[k]
        if need <= 0:
            names = _loaded(step)
            if names:
                return names
            break
        if step.opname in ("COPY", "SWAP"):  # container[key] += value
            break
        need -= dis.stack_effect(step.opcode, step.arg, jump=False)
    line = _line(steps[at])
    return [n for s in steps for n in _loaded(s) if _line(s) == line]


def _line(step: dis.Instruction) -> int | None:
    return step.positions.lineno if step.positions else None


@functools.lru_cache(maxsize=1024)
def _with_methods(kind: Hashable, reads: Reads) -> Reads:
    """The reads of a function together with those of the methods and properties of a class it names."""
    for _ in range(3):
        before = reads
        for name in before.attributes:
            found = getattr(kind, name, None)
            if isinstance(found, property):
                found = found.fget
            elif isinstance(found, functools.cached_property):
                found = found.func
            found = getattr(found, "__func__", found)
            if isinstance(found, FunctionType):
                reads = reads | reads_of(found.__code__)
        if reads == before:
            break
    return reads


def _is_ours(value: Any) -> bool:
    return type(value).__module__.startswith(("bayesmc.", "numpy."))


def _freeze(value: Any, reads: Reads, depth: int) -> Any:
    if type(value) in _SIMPLE or isinstance(value, np.generic):
        return value
    if isinstance(value, np.ndarray):
        small = value.size <= SMALL and not value.dtype.hasobject
        return np.array(value) if small else _Unseen()
    if depth == 0:
        return _Unseen()
    if isinstance(value, dict):
        chosen = _chosen(value, reads)
        if not _fits(chosen.values()):
            return _Unseen()
        if _SIMPLE.issuperset(map(type, chosen.values())):
            return _Entries("dict", dict(chosen))
        return _Entries("dict", {k: _freeze(v, reads, depth - 1) for k, v in chosen.items()})
    if isinstance(value, (list, tuple)):
        if len(value) <= _PLAIN and _SIMPLE.issuperset(map(type, value)):
            return _Entries("list", tuple(value))
        if not _fits(value):
            return _Unseen()
        return _Entries("list", tuple(_freeze(v, reads, depth - 1) for v in value))
    if isinstance(value, set):
        plain = len(value) <= _PLAIN and _SIMPLE.issuperset(map(type, value))
        return _Entries("set", frozenset(value)) if plain else _Unseen()
    if isinstance(value, _NO_OBJECTS) or _is_ours(value):
        return _Unseen()
    items = {}
    for name in reads.attributes - reads.writes:
        now = _attribute(value, name)
        if now is not _MISSING:
            frozen = _freeze(now, reads, depth - 1)
            if not isinstance(frozen, _Unseen):
                items[name] = frozen
    return _Entries("object", items) if items else _Unseen()


def _chosen(value: dict[Any, Any], reads: Reads) -> dict[Any, Any]:
    """The entries whose keys the code names, where it looks them up by name; all of them otherwise."""
    if reads.by_key:
        named = {k: value[k] for k in reads.keys if k in value}
        if named:
            return named
    return value


def _fits(values: Any) -> bool:
    limit = _PLAIN if _SIMPLE.issuperset(map(type, values)) else _MIXED
    return len(values) <= limit


def _attribute(value: Any, name: str) -> Any:
    """An attribute that lies on an object or its class; no property is run for it."""
    own = getattr(value, "__dict__", None)
    if isinstance(own, dict) and name in own:
        return own[name]
    found = getattr(type(value), name, _MISSING)
    if isinstance(found, MemberDescriptorType):  # __slots__
        return getattr(value, name, _MISSING)
    return found


def _change(old: Any, now: Any, reads: Reads, path: str) -> tuple[str, Any, Any] | None:
    if isinstance(old, _Unseen):
        return None
    if not isinstance(old, _Entries):
        return None if _same(old, now) else (path, old, now)
    if old.kind == "object":
        for name, entry in old.items.items():
            found = _attribute(now, name)
            change = _change(entry, None if found is _MISSING else found, reads, f"{path}.{name}")
            if change:
                return change
        return None
    kinds = {"dict": dict, "list": (list, tuple), "set": set}
    if not isinstance(now, kinds[old.kind]):  # type: ignore[arg-type]
        return path, f"a {old.kind}", now
    if old.kind == "set":
        return None if old.items == now else (path, set(old.items), now)
    if len(now) != len(old.items) and not reads.by_key:
        return f"{path} (its length)", len(old.items), len(now)
    if old.kind == "dict":
        if len(now) == len(old.items) and _plainly_equal(old.items, now):
            return None
        for key, entry in old.items.items():
            change = _change(entry, now.get(key), reads, f"{path}[{key!r}]")
            if change:
                return change
        return None
    return _change_of_list(old.items, now, reads, path)


def _change_of_list(
    old: tuple[Any, ...], now: Any, reads: Reads, path: str
) -> tuple[str, Any, Any] | None:
    if len(now) < len(old):
        return f"{path} (its length)", len(old), len(now)
    if _plainly_equal(old, tuple(now[: len(old)])):
        return None
    for k, entry in enumerate(old):
        change = _change(entry, now[k], reads, f"{path}[{k}]")
        if change:
            return change
    return None


def _plainly_equal(old: Any, now: Any) -> bool:
    """Whether containers are equal at first sight; False where that cannot be told."""
    try:
        return bool(old == now)
    except Exception:  # arrays do not compare to one truth
        return False


def _same(old: Any, now: Any) -> bool:
    if old is now:
        return True
    try:
        if isinstance(old, np.ndarray) or isinstance(now, np.ndarray):
            nan = old.dtype.kind in "fc" and now.dtype.kind in "fc"
            return np.array_equal(old, now, equal_nan=nan)
        return bool(old == now) or bool(old != old and now != now)
    except Exception:  # an object's own comparison may fail as it likes
        return False
