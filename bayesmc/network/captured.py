"""Names that a function reads from around it, as they stood when it was declared.

A closure or a global is looked up when a function is called, not when it is declared: in a loop every
function gets the last value. What was read at declaration is noted here and compared when a question is
asked, so that a net whose meaning has changed says so; so is what it reads inside a dict or an object, the
one of a bound method and those of defaults included (``sameness``). Functions, classes and modules may be
defined anew without being noticed.
"""

from __future__ import annotations

import copy
import dis
import functools
import keyword
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType
from typing import Any

import numpy as np

from bayesmc.errors import ModelError
from bayesmc.network.sameness import (
    DEFINED,
    SMALL,
    Entries,
    Reads,
    alike,
    changed,
    entries_of,
    is_simple,
)

#: functions called by functions called by ... that are looked into
_DEPTH = 3
#: methods that change a container, whose content the function then keeps for itself
_CHANGERS = frozenset(
    "append add appendleft clear discard extend insert pop popitem popleft remove reverse setdefault sort "
    "update".split()
)
_LOADS = ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_DEREF", "LOAD_FAST", "LOAD_ATTR", "LOAD_METHOD")


@dataclass(frozen=True, eq=False)
class Captured:
    """One name that a function reads from around it.

    Attributes
    ----------
    name : str
    value : object
        As it stood at declaration; a copy of a small array.
    function : callable
        Where it is looked up: the declared function, or one that it calls.
    cell : int, tuple or None
        Its place in the function's closure; None for a global; for what is bound to the function, as
        ``self`` and defaults are, the attribute of the function and the place in it.
    entries : Entries or None
        What can be read inside the value, as it stood at declaration.
    reads : Reads
        What is read there.
    """

    name: str
    value: Any
    function: Any
    cell: int | tuple[str, Any] | None
    entries: Entries | None = None
    reads: Reads = Reads()

    @property
    def now(self) -> Any:
        """What the name stands for now; ``value`` where it is gone."""
        if self.cell is None:
            return self.function.__globals__.get(self.name, self.value)
        if isinstance(self.cell, tuple):
            return _bound_now(self.function, *self.cell)
        try:
            return (self.function.__closure__ or ())[self.cell].cell_contents
        except (ValueError, IndexError):
            return self.value

    def change(self, now: Any) -> tuple[str, Any, Any] | None:
        """How what the name stands for now differs: the path of the entry, what it was and what it is."""
        if self.entries is not None:
            return changed(self.entries, now, self.reads)
        return None if alike(self.value, now) else ("", self.value, now)

    def __getstate__(self) -> dict[str, Any]:
        """Elsewhere a function may find other objects of the same meaning: only plain values travel."""
        value = self.value if _is_plain(self.value) else _Anything()
        return {**self.__dict__, "value": value}


def captured(function: Any) -> tuple[Captured, ...]:
    """What a function reads from around it, and what Python functions of its module read that it calls."""
    found: dict[tuple[int, str], Captured] = {}
    followed: dict[int, FunctionType] = {}
    _collect(function, _DEPTH, found, followed)
    if not found:
        return ()
    reads = functools.reduce(Reads.union, (reads_of(f.__code__) for f in followed.values()))
    looked_into = (_looked_into(c, reads) for c in found.values())
    return tuple(c for c in looked_into if c is not None)


def check_captured(declarations: Iterable[Any], what: str = "node") -> None:
    """Refuse declarations whose function reads a name that has another value by now.

    Raises
    ------
    ModelError
    """
    done = set()  # slices of an unrolled template share what they read
    for declaration in declarations:
        if not declaration.captured or id(declaration.captured) in done:
            continue
        done.add(id(declaration.captured))
        for seen in declaration.captured:
            now = seen.now
            change = seen.change(now)
            if change is not None:
                raise ModelError(_words(what, declaration, seen, now, *change))


def redeclared(was: Iterable[Captured], now: Iterable[Captured]) -> str | None:
    """A name that stood for another value when a function was first declared than when it was anew, in words.

    Two declarations by the same lines read the same names, and what these stand for by now says nothing of
    what they stood for in between.
    """
    before: dict[tuple[str, str, str], list[Captured]] = {}
    for seen in was:
        before.setdefault(_place(seen), []).append(seen)
    for seen in now:
        known = before.get(_place(seen))
        old = known.pop(0) if known else seen
        if not alike(old.value, seen.value):
            return (
                f"{seen.name!r}, which was {_peek(old.value)} then and is {_peek(seen.value)} now"
            )
    return None


@functools.lru_cache(maxsize=4096)
def reads_of(code: CodeType) -> Reads:
    """What code reads and writes into, functions inside it among it."""
    steps = list(dis.get_instructions(code))
    around: set[str] = set()
    sets: set[str] = set()
    attributes: set[str] = set()
    writes: set[str] = set()
    by_key = False
    aliases: dict[str, str] = {}
    for k, step in enumerate(steps):
        before = _loaded(steps[k - 1]) if k else ()
        name, kind = str(step.argval), step.opname
        if kind in ("LOAD_GLOBAL", "LOAD_NAME"):
            around.add(name)
        elif kind in ("LOAD_ATTR", "LOAD_METHOD"):
            attributes.add(name)
            if name in _CHANGERS:
                writes.update(before)
        elif kind in ("STORE_ATTR", "DELETE_ATTR"):
            writes.add(name)
        elif kind in ("STORE_SUBSCR", "DELETE_SUBSCR", "STORE_SLICE"):
            writes.update(_written(steps, k))
        elif kind == "BINARY_SUBSCR" or (kind == "BINARY_OP" and "[" in step.argrepr):
            by_key = True
        if kind in ("STORE_GLOBAL", "STORE_DEREF", "DELETE_GLOBAL"):
            sets.add(name)
        if kind in ("STORE_FAST", "STORE_DEREF") and before:
            aliases[name] = before[-1]
    for _ in range(3):  # c = self.cache; c[key] = ...
        writes |= {aliases[name] for name in writes if name in aliases}
    keys = (c for c in code.co_consts if isinstance(c, str))
    names = map(frozenset, (around, attributes, keys, sets, writes))
    read, attribute, key, set_, written = names
    found = Reads(read, attribute, key, by_key, set_, written)
    inner = (reads_of(c) for c in code.co_consts if isinstance(c, CodeType))
    return functools.reduce(Reads.union, inner, found)


# ---- private ------------------------------------------------------------------------------------


class _Anything:
    """What everything is equal to."""

    def __eq__(self, other: object) -> bool:
        return True

    __hash__ = object.__hash__


def _place(seen: Captured) -> tuple[str, str, str]:
    return seen.function.__module__, seen.function.__qualname__, seen.name


def _collect(
    function: Any,
    depth: int,
    found: dict[tuple[int, str], Captured],
    followed: dict[int, FunctionType],
) -> None:
    plain = _plain_function(function)
    if plain is None or id(plain) in followed:  # functions may call each other
        return
    followed[id(plain)] = plain
    for name, value, holder, place in _bound(function, plain):
        if not is_simple(value):
            found[id(holder), str(place)] = Captured(name, _kept(value), holder, place)
    for name, value, cell in _around(plain):
        key = (id(plain), name)
        if key in found:
            continue
        if isinstance(value, (functools.partial, *DEFINED)):
            inner = _plain_function(value)
            if inner is not None and depth and inner.__globals__ is plain.__globals__:
                _collect(value, depth - 1, found, followed)
            continue
        found[key] = Captured(name, _kept(value), plain, cell)


def _plain_function(function: Any) -> FunctionType | None:
    """The Python function behind a partial, a method, a decorated function or an object that is called."""
    for _ in range(8):
        if isinstance(function, FunctionType):
            inner = getattr(function, "__wrapped__", None)
            if inner is None:
                return function
            function = inner
        elif isinstance(function, functools.partial):
            function = function.func
        elif isinstance(function, MethodType):
            function = function.__func__
        elif not isinstance(function, type):
            function = getattr(type(function), "__call__", None)  # noqa: B004
        else:
            return None
    return None


def _bound(function: Any, plain: FunctionType) -> Iterator[tuple[str, Any, Any, tuple[str, Any]]]:
    """What is bound to a function: ``self``, arguments of partials, defaults: name, value, holder, place."""
    names = plain.__code__.co_varnames[: plain.__code__.co_argcount]
    first = names[0] if names else "self"
    while isinstance(function, functools.partial):
        for k, value in enumerate(function.args):
            yield (names[k] if k < len(names) else f"args[{k}]"), value, function, ("args", k)
        for name, value in function.keywords.items():
            yield name, value, function, ("keywords", name)
        function = function.func
    if isinstance(function, MethodType):
        yield first, function.__self__, function, ("__self__", None)
    elif not isinstance(function, (FunctionType, BuiltinFunctionType, type)):
        yield first, function, function, ("", None)
    defaults = plain.__defaults__ or ()
    for k, value in enumerate(defaults):
        yield names[len(names) - len(defaults) + k], value, plain, ("__defaults__", k)
    for name, value in (plain.__kwdefaults__ or {}).items():
        yield name, value, plain, ("__kwdefaults__", name)


def _bound_now(holder: Any, attribute: str, place: Any) -> Any:
    value = getattr(holder, attribute) if attribute else holder
    return value if place is None else value[place]


def _looked_into(seen: Captured, reads: Reads) -> Captured | None:
    """With what can be read inside it; None for what is bound and cannot change."""
    if is_simple(seen.value):
        return seen
    entries = None
    if seen.name not in reads.writes:
        kind: Any = type(seen.value)
        if not issubclass(kind, (dict, list, tuple, set)):
            reads = _with_methods(kind, reads)
        entries = entries_of(seen.value, reads)
    if isinstance(seen.cell, tuple) and entries is None and not isinstance(seen.value, np.ndarray):
        return None
    return seen if entries is None else replace(seen, entries=entries, reads=reads)


@functools.lru_cache(maxsize=1024)
def _with_methods(kind: Any, reads: Reads) -> Reads:
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
                reads = reads.union(reads_of(found.__code__))
        if reads == before:
            break
    return reads


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


def _around(function: FunctionType) -> Iterator[tuple[str, Any, int | None]]:
    """Names that a function reads from around it and does not set itself: value, and place in its closure."""
    code = function.__code__
    reads = reads_of(code)
    for k, (name, cell) in enumerate(
        zip(code.co_freevars, function.__closure__ or (), strict=True)
    ):
        if name not in reads.sets:
            try:
                yield name, cell.cell_contents, k
            except ValueError:  # not set yet
                continue
    names = function.__globals__
    for name in reads.globals - reads.sets:
        if name in names:
            yield name, names[name], None


def _kept(value: Any) -> Any:
    """What is held against later: small arrays may be written over, so a copy of them is."""
    if isinstance(value, np.ndarray) and value.size <= SMALL and not value.dtype.hasobject:
        return copy.copy(value)
    return value


def _is_plain(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_plain, value))
    if isinstance(value, np.ndarray):
        return not value.dtype.hasobject
    return value is None or isinstance(value, (int, float, complex, str, bytes, np.generic))


def _words(
    what: str, declaration: Any, seen: Captured, now: Any, path: str, old: Any, new: Any
) -> str:
    name, place = seen.name, seen.cell[0] if isinstance(seen.cell, tuple) else None
    entry = f"{name}{path}"
    is_inside = seen.entries is not None and (
        now is seen.value or isinstance(seen.value, _Anything)
    )
    argument = _argument(name, entry, new) if is_inside else f"{name}={name}"
    fix = f"give the function an argument {argument}, which keeps the value"
    if what == "node":
        fix += " (arguments with defaults are no parents)"
    if is_inside and place in ("__self__", ""):
        fix = "give every function an object of its own (copy.copy keeps its values)"
    elif is_inside and place is not None:
        fix = f"bind a copy, as {name}=copy.deepcopy({name}) does"
    reads = entry if is_inside else f"{name!r} from around it"
    was, is_ = (old, new) if is_inside else (seen.value, now)
    return (
        f"{what} {declaration.name!r}: its function reads {reads}, which was {_peek(was)} when it was "
        f"declared and is {_peek(is_)} now; {fix}, or declare the {what} anew"
    )


def _peek(value: Any) -> str:
    try:
        text = " ".join(repr(value).split())
    except Exception:
        text = f"a {type(value).__name__}"
    return text if len(text) <= 60 else text[:57] + "..."


def _argument(name: str, entry: str, now: Any) -> str:
    """An argument whose default holds an entry, or a copy of the whole where an entry has no name."""
    last = re.split(r"[.\[\]']+", entry.rstrip("]'"))[-1]
    if (
        "(its length)" in entry
        or not last.isidentifier()
        or keyword.iskeyword(last)
        or last == name
    ):
        return f"{name}=copy.deepcopy({name})"
    return f"{last}={entry}" + (".copy()" if isinstance(now, np.ndarray) else "")
