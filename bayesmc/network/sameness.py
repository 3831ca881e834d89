"""Whether two functions, or two values, say the same, as far as can be told without calling them.

A net that is declared anew by the same lines has other function objects. They are the same where their code,
constants, defaults, and what they close over or read from their module are. Unknown is allowed, wrong is not.

A value that may change in place is held against what was kept of it: a shallow copy of what a function can
read, the numbers, strings and small arrays in a container, and the attributes of a plain object that the
function's code names. What the function itself writes into (a cache, a counter, a log) is left out, and
entries added to a container count only where it does not look them up one by one, as in ``offsets[i]``.
"""

from __future__ import annotations

import functools
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bayesmc.expression.trace import names_in

#: objects within objects that are compared, and that are looked into
_COMPARED, _DEPTH = 20, 3
#: numbers of an array up to which it is copied
SMALL = 4096
#: entries of a container up to which it is copied: of numbers and strings, and of anything else
_PLAIN, _MIXED = 1024, 32
_SIMPLE = frozenset({int, float, complex, bool, str, bytes, type(None)})
_ATOMS: tuple[Any, ...] = (*_SIMPLE, range, slice, type(Ellipsis), np.generic)
#: what may be defined anew without another net being meant
DEFINED = (
    types.FunctionType, types.BuiltinFunctionType, types.MethodType, types.ModuleType, type, np.ufunc,
)  # fmt: skip
_MISSING = object()


class Reads(NamedTuple):
    """What code reads: globals and attributes, string constants, whether it looks anything up by ``[]``.

    Of names it says which it sets around itself, and into which of them it writes.
    """

    globals: frozenset[str] = frozenset()
    attributes: frozenset[str] = frozenset()
    keys: frozenset[str] = frozenset()
    by_key: bool = False
    sets: frozenset[str] = frozenset()
    writes: frozenset[str] = frozenset()

    def union(self, other: Reads) -> Reads:
        """Of both."""
        if other is self:
            return self
        pairs: Any = zip(self, other, strict=True)
        return Reads(*(a | b for a, b in pairs))


def same(a: Any, b: Any) -> bool | None:
    """Whether two values are the same; None where that cannot be told.

    Functions are compared by code, defaults, closures and the globals that they name, arrays by their
    elements, other objects by their attributes.

    Examples
    --------
    >>> from bayesmc.network.sameness import same
    >>> def of(scale):
    ...     return lambda x: scale * x
    >>> same(of(2.0), of(2.0)), same(of(2.0), of(3.0)), same(of(2.0), lambda x: 2.0 * x)
    (True, False, False)
    """
    return _same(a, b, {}, _COMPARED)


def alike(old: Any, now: Any) -> bool:
    """Whether a name may stand for either of two values, as far as can be told."""
    return old is now or isinstance(now, DEFINED) or _equal(old, now) or same(old, now) is True


def is_simple(value: Any) -> bool:
    """Whether a value is a number, a string or None, which cannot change."""
    return type(value) in _SIMPLE


@dataclass(frozen=True, eq=False)
class Entries:
    """Entries of a container or an object, as they stood: ``kind`` is dict, list, set or object."""

    kind: str
    items: Any


def kept(value: Any, reads: Reads, depth: int = _DEPTH) -> Any:
    """What is held against a value later: a copy, its ``Entries``, or that it is not looked at."""
    if type(value) in _SIMPLE or isinstance(value, np.generic):
        return value
    if isinstance(value, np.ndarray):
        return np.array(value) if value.size <= SMALL and not value.dtype.hasobject else _MISSING
    if depth == 0:
        return _MISSING
    if isinstance(value, (dict, list, tuple, set)):
        return _kept_container(value, reads, depth)
    if value is _MISSING or isinstance(value, DEFINED) or _is_ours(value):
        return _MISSING
    names = reads.attributes - reads.writes
    items = {name: kept(_attribute(value, name), reads, depth - 1) for name in names}
    items = {name: entry for name, entry in items.items() if entry is not _MISSING}
    return Entries("object", items) if items else _MISSING


def entries_of(value: Any, reads: Reads) -> Entries | None:
    """What can be read inside a value; None where there is nothing that may change in place."""
    if isinstance(value, (np.ndarray, *DEFINED)) or _is_ours(value):
        return None
    found = kept(value, reads)
    return found if isinstance(found, Entries) else None


def changed(old: Any, now: Any, reads: Reads, path: str = "") -> tuple[str, Any, Any] | None:
    """The first entry that differs from what was kept: its path from the name, what it was and what it is."""
    if old is _MISSING or old is now:
        return None
    if not isinstance(old, Entries):
        return None if _equal(old, now) else (path, old, now)
    items = old.items
    kinds: dict[str, Any] = {"dict": dict, "list": (list, tuple), "set": set, "object": object}
    if not isinstance(now, kinds[old.kind]):
        return path, f"a {old.kind}", now
    if old.kind == "set":
        return None if items == now else (path, set(items), now)
    if old.kind != "object":
        short = len(now) < len(items) and old.kind == "list"
        if short or (len(now) != len(items) and not reads.by_key):
            return f"{path} (its length)", len(items), len(now)
        if _equal(items, now if old.kind == "dict" else tuple(now[: len(items)])):
            return None
    for step, entry, current in _entries_now(old, now):
        found = changed(entry, current, reads, path + step)
        if found:
            return found
    return None


# ---- private ------------------------------------------------------------------------------------

_Met = dict[tuple[int, int], tuple[Any, Any]]


def _same(a: Any, b: Any, met: _Met, depth: int) -> bool | None:
    if a is b:
        return True
    if type(a) is not type(b):
        return False
    if isinstance(a, _ATOMS):
        return bool(a == b) or bool(a != a and b != b)
    if (id(a), id(b)) in met:
        return True  # under comparison further out
    if depth == 0:
        return None
    met[id(a), id(b)] = a, b
    if isinstance(a, (set, frozenset)):
        return True if a == b else None
    if isinstance(a, np.ndarray):
        if a.dtype != object:
            return a.dtype == b.dtype and _equal_arrays(a, b)
        if a.dtype != b.dtype or a.shape != b.shape:
            return False
    if isinstance(a, Mapping):
        if a.keys() != b.keys():
            return False
        pairs = [(a[k], b[k]) for k in a]
    else:
        one, other = parts_of(a), parts_of(b)
        if one is None or other is None:
            return False if isinstance(a, DEFINED) else None
        if len(one) != len(other):
            return False
        pairs = list(zip(one, other, strict=True))
    found = [_same(x, y, met, depth - 1) for x, y in pairs]
    if False in found:
        return False if isinstance(a, _WHOLE) else None  # what is kept for later use may differ
    return None if None in found else True


#: what its parts settle
_WHOLE = (
    list, tuple, Mapping, np.ndarray, functools.partial, types.FunctionType, types.MethodType, types.CodeType,
)  # fmt: skip
_OF_CODE = ("co_code", "co_names", "co_varnames", "co_freevars", "co_cellvars", "co_argcount",
            "co_kwonlyargcount", "co_flags", "co_consts")  # fmt: skip


def parts_of(value: Any) -> list[Any] | None:
    """What a value is made of; None of one that cannot be looked into."""
    if isinstance(value, np.ndarray):
        return list(value.flat)
    if isinstance(value, (list, tuple)):
        return list(value)
    if isinstance(value, types.CodeType):
        return [getattr(value, name) for name in _OF_CODE]
    if isinstance(value, types.FunctionType):
        here = value.__globals__
        around = {n: here[n] for n in names_in(value.__code__) if n in here}
        cells = [_content(cell) for cell in value.__closure__ or ()]
        return [value.__code__, value.__defaults__, value.__kwdefaults__, cells, around]
    if isinstance(value, types.MethodType):
        return [value.__func__, value.__self__]
    if isinstance(value, functools.partial):
        return [value.func, value.args, value.keywords]
    if isinstance(value, (np.random.Generator, np.random.RandomState, *DEFINED)):
        return None
    slots = {s for c in type(value).__mro__ for s in _slots(c)} - {"__dict__", "__weakref__"}
    own = {**getattr(value, "__dict__", {}), **{s: getattr(value, s, None) for s in slots}}
    return [own] if own else None


def _slots(kind: type) -> tuple[str, ...]:
    slots = kind.__dict__.get("__slots__", ())
    return (slots,) if isinstance(slots, str) else tuple(slots)


def _content(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not yet filled
        return None


def _equal(old: Any, now: Any) -> bool:
    """Whether two values are equal, as far as they tell themselves; NaN is NaN."""
    try:
        if isinstance(old, np.ndarray) or isinstance(now, np.ndarray):
            return isinstance(now, type(old)) and _equal_arrays(old, now)
        return bool(old == now) or bool(old != old and now != now)
    except (
        Exception
    ):  # an object's own comparison may fail as it likes, and arrays in containers do
        return False


def _equal_arrays(a: np.ndarray, b: np.ndarray) -> bool:
    nan = a.dtype.kind in "fc" and b.dtype.kind in "fc"
    if isinstance(a, np.ma.MaskedArray):
        if not np.array_equal(np.ma.getmaskarray(a), np.ma.getmaskarray(b)):
            return False
    return np.array_equal(a, b, equal_nan=nan)


def _is_ours(value: Any) -> bool:
    return type(value).__module__.startswith(("bayesmc.", "numpy."))


def _kept_container(value: Any, reads: Reads, depth: int) -> Any:
    if isinstance(value, dict):
        named = {k: value[k] for k in reads.keys if k in value} if reads.by_key else {}
        value = named or value  # those that the code names, where it looks them up by name
    inside = value.values() if isinstance(value, dict) else value
    plain = _SIMPLE.issuperset(map(type, inside))
    if len(value) > (_PLAIN if plain else _MIXED) or (isinstance(value, set) and not plain):
        return _MISSING
    if isinstance(value, set):
        return Entries("set", frozenset(value))
    entries = inside if plain else [kept(v, reads, depth - 1) for v in inside]
    if isinstance(value, dict):
        return Entries("dict", dict(zip(value, entries, strict=True)))
    return Entries("list", tuple(entries))


def _entries_now(old: Entries, now: Any) -> Iterator[tuple[str, Any, Any]]:
    """Entries that were kept, and what stands in their place: step of the path, entry, current."""
    if old.kind == "list":
        for k, entry in enumerate(old.items):
            yield f"[{k}]", entry, now[k]
        return
    for key, entry in old.items.items():
        if old.kind == "dict":
            yield f"[{key!r}]", entry, now.get(key)
            continue
        found = _attribute(now, key)
        yield f".{key}", entry, None if found is _MISSING else found


def _attribute(value: Any, name: str) -> Any:
    """An attribute that lies on an object or its class; no property is run for it."""
    own = getattr(value, "__dict__", None)
    if isinstance(own, dict) and name in own:
        return own[name]
    found = getattr(type(value), name, _MISSING)
    if isinstance(found, types.MemberDescriptorType):  # __slots__
        return getattr(value, name, _MISSING)
    return found
