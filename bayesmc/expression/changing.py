"""What a function reads that another call finds changed: clocks, chance, and what else is outside of it.

Two calls that differ show most of it; what differs rarely is found by what is called: through the names that
the code reads, into users' own functions, modules and methods.
"""

from __future__ import annotations

import contextlib
import dis
import functools
import types
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np

#: modules whose functions give another answer the next time
_CHANGING = frozenset(("time", "random", "datetime", "secrets", "uuid", "os"))
#: modules whose functions give the same answer always
KNOWN = frozenset(("numpy", "scipy", "bayesmc", "builtins", "math"))
#: of these, where functions stand that users call in theirs
OPEN = ("bayesmc.robotics", "bayesmc.distributions")
#: types of values that call nothing
_PLAIN = frozenset((bool, int, float, str, np.ndarray, np.float64, type(None)))
#: containers up to this length are looked into
_FEW = 64


def tells_time_or_chance(function: Any) -> str | None:
    """What a function reads that another call finds changed, or None.

    Examples
    --------
    >>> import time
    >>> from bayesmc.expression.changing import tells_time_or_chance
    >>> tells_time_or_chance(lambda x: x * (time.time() > 0)), tells_time_or_chance(lambda x: 2 * x)
    ('it reads time, which another call finds changed', None)
    """
    seen: set[Any] = set()
    todo: list[tuple[Any, tuple[str, ...]]] = [(function, ())]  # values, and what is read of them
    while todo:
        value, names = todo.pop()
        if not isinstance(value, types.FunctionType):
            todo += _parts(value, names, seen)
        elif id(value) not in seen and (is_open(value) or value is function):
            seen.add(id(value))
            read = names_in(value.__code__)
            for name, held in _captured(value):
                found = _changing(name, held, read)
                if found is not None:
                    return found
                if type(held) not in _PLAIN and not is_left(held):
                    todo.append((held, read))
    return None


@lru_cache(maxsize=4096)
def names_in(code: types.CodeType) -> tuple[str, ...]:
    """Names that code reads, of functions inside of it, too."""
    inner = [c for c in code.co_consts if isinstance(c, types.CodeType)]
    return (*code.co_names, *(n for c in inner for n in names_in(c)))


def is_open(function: types.FunctionType) -> bool:
    """Whether a function is a user's, or one of those that users call in theirs."""
    module = str(function.__module__ or "")
    return _room(function) not in KNOWN or module.startswith(OPEN)


def is_left(value: Any) -> bool:
    """Whether a value is a module whose functions are what they seem."""
    if not isinstance(value, types.ModuleType):
        return False
    return value.__name__.split(".")[0] in KNOWN and not value.__name__.startswith(OPEN)


# ---- private ------------------------------------------------------------------------------------


def _captured(function: types.FunctionType) -> list[tuple[str, Any]]:
    """What a function reads from around it: globals, cells, defaults."""
    names = _globals(function.__code__)
    found = [(n, function.__globals__[n]) for n in names if n in function.__globals__]
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):  # an empty cell
            found.append((name, cell.cell_contents))
    found += [("a default", v) for v in function.__defaults__ or ()]
    return found


@lru_cache(maxsize=4096)
def _globals(code: types.CodeType) -> frozenset[str]:
    """Names that code looks up around it, of functions inside of it, too."""
    found = (i.argval for i in dis.get_instructions(code) if i.opname == "LOAD_GLOBAL")
    return frozenset(found).union(
        *(_globals(c) for c in code.co_consts if isinstance(c, types.CodeType))
    )


def _parts(
    value: Any, names: tuple[str, ...], seen: set[Any]
) -> Iterator[tuple[Any, tuple[str, ...]]]:
    """What is called where a value is, or where something is read of it."""
    if isinstance(value, functools.partial):
        yield from ((v, names) for v in (value.func, *value.args, *value.keywords.values()))
    elif isinstance(value, types.MethodType):
        yield value.__func__, ()
        yield value.__self__, names_in(value.__func__.__code__) if _has_code(value) else ()
    elif isinstance(value, (list, tuple)):
        yield from ((v, names) for v in value[:_FEW] if callable(v))
    elif isinstance(value, types.ModuleType):
        held = vars(value)
        yield from ((held[n], ()) for n in names if isinstance(held.get(n), types.FunctionType))
    else:
        yield from _methods(value, names, seen)


def _methods(
    value: Any, names: tuple[str, ...], seen: set[Any]
) -> Iterator[tuple[Any, tuple[str, ...]]]:
    """Methods of a user's class that are called where something is read of an object, or of the class."""
    kind = value if isinstance(value, type) else type(value)
    if _room(kind) in KNOWN or (kind, names) in seen:
        return
    seen.add((kind, names))
    for name in ("__init__", "__call__", *names):
        for held in (vars(k).get(name) for k in kind.__mro__):
            method = getattr(held, "fget", None) or getattr(held, "__func__", held)
            method = getattr(method, "func", method)  # of a cached property
            if isinstance(method, types.FunctionType):
                yield method, ()
                yield value, names_in(method.__code__)  # through self
    own = getattr(value, "__dict__", {})
    yield from ((own[n], names) for n in names if callable(own.get(n)) and value is not kind)


def _has_code(method: types.MethodType) -> bool:
    return isinstance(method.__func__, types.FunctionType)


def _changing(name: str, value: Any, read: tuple[str, ...]) -> str | None:
    if isinstance(value, types.ModuleType):
        if value.__name__ in _CHANGING:
            return f"it reads {value.__name__}, which another call finds changed"
        if value is np and "random" in read:
            return "it draws random numbers"
    if isinstance(value, (np.random.Generator, np.random.RandomState)):
        return f"it draws random numbers from {name}"
    if _room(value) in _CHANGING and callable(value):
        return f"it calls {name}, which another call finds changed"
    return None


def _room(value: Any) -> str:
    module = getattr(value, "__module__", None)
    return str(module or "").split(".")[0].lstrip("_")
