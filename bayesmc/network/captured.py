"""Names that a function reads from around it, as they stood when it was declared.

A closure or a global is looked up when a function is called, not when it is declared: in a loop every
function gets the last value. What was read at declaration is noted here and compared when a question is
asked, so that a net whose meaning has changed says so; so is what it reads inside a dict or an object, the
one of a bound method and those of defaults included (``inside``). Functions, classes and modules may be
defined anew without being noticed.
"""

from __future__ import annotations

import copy
import dis
import functools
import keyword
import operator
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from bayesmc.errors import ModelError
from bayesmc.network.inside import SMALL, Inside, Reads, inside, is_simple, reads_of

#: functions called by functions called by ... that are looked into
_DEPTH = 3
#: what may be defined anew without another net being meant
_IGNORED = (FunctionType, BuiltinFunctionType, MethodType, ModuleType, type, np.ufunc)


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
    inside : Inside or None
        What can be read inside the value, as it stood at declaration.
    """

    name: str
    value: Any
    function: Any
    cell: int | tuple[str, Any] | None
    inside: Inside | None = None

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

    def __getstate__(self) -> dict[str, Any]:
        """Elsewhere a function may find other objects of the same meaning: only plain values travel."""
        value = self.value if _is_plain(self.value) else _Anything()
        return {**self.__dict__, "value": value}


def captured(function: Any) -> tuple[Captured, ...]:
    """What a function reads from around it, and what Python functions of its module read that it calls."""
    found: dict[tuple[int, str], Captured] = {}
    _collect(function, _DEPTH, found)
    names = [c for key, c in found.items() if key[1]]
    if not names:
        return ()
    followed = [reads_of(c.function.__code__) for key, c in found.items() if not key[1]]
    reads = functools.reduce(operator.or_, followed)
    with_inside = [c if is_simple(c.value) else _with_inside(c, reads) for c in names]
    return tuple(c for c in with_inside if c is not None)


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
            if now is not seen.value and not _alike(seen.value, now):
                raise ModelError(_words(what, declaration, seen, now))
            change = seen.inside.change(now) if seen.inside is not None else None
            if change is not None:
                raise ModelError(_words_inside(what, declaration, seen, *change))


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
        if old.value is not seen.value and not _alike(old.value, seen.value):
            return (
                f"{seen.name!r}, which was {_peek(old.value)} then and is {_peek(seen.value)} now"
            )
    return None


# ---- private ------------------------------------------------------------------------------------


class _Anything:
    """What everything is equal to."""

    def __eq__(self, other: object) -> bool:
        return True

    __hash__ = object.__hash__


def _place(seen: Captured) -> tuple[str, str, str]:
    return seen.function.__module__, seen.function.__qualname__, seen.name


def _collect(function: Any, depth: int, found: dict[tuple[int, str], Captured]) -> None:
    plain = _plain_function(function)
    if plain is None or (id(plain), "") in found:  # functions may call each other
        return
    found[id(plain), ""] = Captured("", None, plain, None)
    for name, value, holder, place in _bound(function, plain):
        if not is_simple(value):
            found[id(holder), str(place)] = Captured(name, _kept(value), holder, place)
    for name, value, cell in _around(plain):
        key = (id(plain), name)
        if key in found:
            continue
        if isinstance(value, _IGNORED) or isinstance(value, functools.partial):
            inner = _plain_function(value)
            if inner is not None and depth and inner.__globals__ is plain.__globals__:
                _collect(value, depth - 1, found)
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


def _with_inside(seen: Captured, reads: Reads) -> Captured | None:
    """With what can be read inside it; None for what is bound and cannot change."""
    entries = inside(seen.name, seen.value, reads)
    if isinstance(seen.cell, tuple) and entries is None and not isinstance(seen.value, np.ndarray):
        return None
    return seen if entries is None else replace(seen, inside=entries)


def _around(function: FunctionType) -> Iterator[tuple[str, Any, int | None]]:
    """Names that a function reads from around it and does not set itself: value, and place in its closure."""
    code = function.__code__
    reads, sets = _names(code)
    for k, (name, cell) in enumerate(
        zip(code.co_freevars, function.__closure__ or (), strict=True)
    ):
        if name not in sets:
            try:
                yield name, cell.cell_contents, k
            except ValueError:  # not set yet
                continue
    names = function.__globals__
    for name in reads - sets:
        if name in names:
            yield name, names[name], None


@functools.lru_cache(maxsize=4096)
def _names(code: CodeType) -> tuple[frozenset[str], frozenset[str]]:
    """Globals that code reads, and names around it that it sets, functions inside it among it."""
    reads, sets = set(), set()
    for step in dis.get_instructions(code):
        if step.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            reads.add(str(step.argval))
        elif step.opname in ("STORE_GLOBAL", "STORE_DEREF", "DELETE_GLOBAL"):
            sets.add(str(step.argval))
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            more, others = _names(inner)
            reads |= more
            sets |= others
    return frozenset(reads), frozenset(sets)


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


def _alike(old: Any, new: Any) -> bool:
    """Whether two values mean the same; of objects that cannot tell, whether they hold the same."""
    if old is new or isinstance(old, _Anything) or isinstance(new, _IGNORED):
        return True
    if isinstance(old, np.ndarray) or isinstance(new, np.ndarray):
        return (
            isinstance(new, np.ndarray)
            and isinstance(old, np.ndarray)
            and old.shape == new.shape
            and _equal_arrays(old, new)
        )
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        return old.keys() == new.keys() and all(_alike(old[k], new[k]) for k in old)
    if isinstance(old, (list, tuple)) and isinstance(new, (list, tuple)):
        return len(old) == len(new) and all(map(_alike, old, new))
    try:
        if bool(old == new) or (old != old and new != new):
            return True
    except Exception:  # an object's own comparison may fail as it likes
        return False
    plain = type(old).__eq__ is object.__eq__ and type(old) is type(new)
    return plain and hasattr(old, "__dict__") and _alike(vars(old), vars(new))


def _equal_arrays(old: np.ndarray, new: np.ndarray) -> bool:
    if old.dtype.kind in "fc" and new.dtype.kind in "fc":
        return np.array_equal(old, new, equal_nan=True)
    return np.array_equal(old, new)


def _words(what: str, declaration: Any, seen: Captured, now: Any) -> str:
    name = seen.name
    fix = f"give the function an argument {name}={name}, which keeps the value"
    if what == "node":
        fix += " (arguments with defaults are no parents)"
    return (
        f"{what} {declaration.name!r}: its function reads {name!r} from around it, which was "
        f"{_peek(seen.value)} when it was declared and is {_peek(now)} now; {fix}, or declare the {what} anew"
    )


def _peek(value: Any) -> str:
    try:
        text = " ".join(repr(value).split())
    except Exception:
        text = f"a {type(value).__name__}"
    return text if len(text) <= 60 else text[:57] + "..."


def _words_inside(
    what: str, declaration: Any, seen: Captured, path: str, old: Any, now: Any
) -> str:
    entry = f"{seen.name}{path}"
    place = seen.cell[0] if isinstance(seen.cell, tuple) else None
    if place in ("__self__", ""):
        fix = "give every function an object of its own (copy.copy keeps its values)"
    elif place is not None:
        fix = f"bind a copy, as {seen.name}=copy.deepcopy({seen.name}) does"
    else:
        fix = f"give the function an argument {_argument(seen.name, entry, now)}, which keeps the value"
        if what == "node":
            fix += " (arguments with defaults are no parents)"
    return (
        f"{what} {declaration.name!r}: its function reads {entry}, which was {_peek(old)} when it was "
        f"declared and is {_peek(now)} now; {fix}, or declare the {what} anew"
    )


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
