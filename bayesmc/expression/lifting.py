"""Functions whose captured arrays can be indexed by stand-ins, and what they call besides NumPy.

NumPy hands a call on only where an argument stands for an array. So a captured array that is indexed by
one, a list that is made an array, and functions of SciPy that are no ufuncs are put in place of
themselves in a copy of the function.
"""

from __future__ import annotations

import contextlib
import dis
import types
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import special

from bayesmc.expression.array import TracedArray
from bayesmc.expression.functions import expression_of, of_function
from bayesmc.expression.graph import constant
from bayesmc.tracing.standin import TracedCall, is_traced

#: modules whose functions give another answer the next time
_CHANGING = frozenset(("time", "random", "datetime", "secrets", "uuid", "os"))
#: modules whose functions are left as they are
_KNOWN = frozenset(("numpy", "scipy", "bayesmc", "builtins", "math"))
#: of these, where some functions are replaced
_REPLACED = frozenset(("numpy", "scipy"))
#: of these, where functions stand that users call in theirs
_OPEN = ("bayesmc.robotics", "bayesmc.distributions")


def lifted(function: types.FunctionType) -> types.FunctionType:
    """A copy of a function, and of those that it calls, in which captured arrays are stand-ins."""
    return _lifted_function(function, {})


def tells_time_or_chance(function: Any) -> str | None:
    """What a function reads that another call finds changed, or None."""
    seen: set[int] = set()
    todo = [function]
    while todo:
        value = todo.pop()
        value = getattr(value, "__func__", value)
        value = getattr(value, "func", value)
        if not isinstance(value, types.FunctionType) or id(value) in seen:
            continue
        seen.add(id(value))
        for name, held in _captured(value):
            found = _changing(name, held, value)
            if found is not None:
                return found
            todo += _behind(held, value)
    return None


def log_sum_exp(a: Any, axis: Any = None, b: Any = None, keepdims: bool = False) -> Any:
    """``log(sum(b * exp(a)))`` in the log domain, of arrays or what stands for them."""
    top = np.max(a, axis=axis, keepdims=True)
    top = np.where(np.isfinite(top), top, 0.0)
    terms = np.exp(a - top) if b is None else b * np.exp(a - top)
    found = np.log(np.sum(terms, axis=axis, keepdims=True)) + top
    if keepdims:
        return found
    return np.sum(found, axis=axis)  # of one


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
def _names(code: types.CodeType) -> tuple[str, ...]:
    """Names that code reads, of functions inside of it, too."""
    inner = [c for c in code.co_consts if isinstance(c, types.CodeType)]
    return (*code.co_names, *(n for c in inner for n in _names(c)))


@lru_cache(maxsize=4096)
def _globals(code: types.CodeType) -> frozenset[str]:
    """Names that code looks up around it, of functions inside of it, too."""
    found = (i.argval for i in dis.get_instructions(code) if i.opname == "LOAD_GLOBAL")
    return frozenset(found).union(
        *(_globals(c) for c in code.co_consts if isinstance(c, types.CodeType))
    )


def _behind(value: Any, function: types.FunctionType) -> list[types.FunctionType]:
    """Functions of users that one calls through what it reads: itself, a module's, methods of an object."""
    if isinstance(value, (types.FunctionType, types.MethodType)):
        found = [getattr(value, "__func__", value)]
    else:
        holder = value if isinstance(value, (type, types.ModuleType)) else type(value)
        if isinstance(holder, type) and _room(holder) in _KNOWN:
            return []
        names = ("__init__", "__call__", *_names(function.__code__))
        found = [vars(kind).get(n) for kind in (holder, *getattr(holder, "__mro__", ())) for n in names]
    return [f for f in found if isinstance(f, types.FunctionType) and _is_open(f)]


def _changing(name: str, value: Any, function: types.FunctionType) -> str | None:
    if isinstance(value, types.ModuleType):
        if value.__name__ in _CHANGING:
            return f"it reads {value.__name__}, which another call finds changed"
        if value is np and "random" in _names(function.__code__):
            return "it draws random numbers"
    if isinstance(value, (np.random.Generator, np.random.RandomState)):
        return f"it draws random numbers from {name}"
    if _room(value) in _CHANGING and callable(value):
        return f"it calls {name}, which another call finds changed"
    return None


def _is_open(function: types.FunctionType) -> bool:
    """Whether a function is a user's, or one of those that users call in theirs."""
    module = str(function.__module__ or "")
    return _room(function) not in _KNOWN or module.startswith(_OPEN)


def _room(value: Any) -> str:
    module = getattr(value, "__module__", None)
    return str(module or "").split(".")[0].lstrip("_")


def _lifted_function(
    function: types.FunctionType, seen: dict[int, types.FunctionType]
) -> types.FunctionType:
    if id(function) in seen:
        return seen[id(function)]
    scope = dict(function.__globals__)
    cells = tuple(types.CellType() for _ in function.__closure__ or ())
    made = types.FunctionType(
        function.__code__, scope, function.__name__, None, cells if function.__closure__ else None
    )
    seen[id(function)] = made
    for name in set(_names(function.__code__)) & scope.keys():
        scope[name] = _lifted(scope[name], seen)
    made.__defaults__ = tuple(_lifted(v, seen) for v in function.__defaults__ or ()) or None
    kept = function.__kwdefaults__ or {}
    made.__kwdefaults__ = {k: _lifted(v, seen) for k, v in kept.items()} or None
    for new, old in zip(cells, function.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):
            new.cell_contents = _lifted(old.cell_contents, seen)
    return made


def _lifted(value: Any, seen: dict[int, types.FunctionType]) -> Any:
    if type(value) is np.ndarray and value.ndim and value.dtype in (float, np.int64, bool):
        return TracedArray(constant(value))
    if isinstance(value, types.FunctionType) and _is_open(value):
        return _lifted_function(value, seen)
    if isinstance(value, types.ModuleType) and not _is_left(value):
        return _Module(value)
    try:
        return _INSTEAD.get(value, value)
    except TypeError:  # cannot be looked up
        return value


class _Module:
    """A module with what it holds lifted when it is asked for."""

    def __init__(self, module: types.ModuleType) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return _lifted(getattr(self._module, name), {})


def _is_left(module: types.ModuleType) -> bool:
    """Whether a module's functions are called as they are."""
    return module.__name__.split(".")[0] in _KNOWN - _REPLACED and not module.__name__.startswith(_OPEN)


def _if_traced(original: Callable[..., Any], rule: Callable[..., Any]) -> Callable[..., Any]:
    def chosen(first: Any, *args: Any, **kwargs: Any) -> Any:
        if is_traced([first, *args, *kwargs.values()]):
            return rule(first, *args, **kwargs)
        return original(first, *args, **kwargs)

    return chosen


def _array(value: Any, dtype: Any = None, **kwargs: Any) -> Any:
    found = TracedArray(expression_of(value), True)
    return found if dtype is None else found.astype(dtype)


def _made(original: Callable[..., Any]) -> Callable[..., Any]:
    """A function that makes an array, which can then be indexed by, and filled with, stand-ins."""

    def made(*args: Any, **kwargs: Any) -> Any:
        found = _array(*args, **kwargs) if _is_copy(original, args) else original(*args, **kwargs)
        standard = type(found) is np.ndarray and found.dtype in (float, np.int64, bool)
        return TracedArray(constant(found), True) if standard and found.ndim else found

    return made


def _is_copy(original: Callable[..., Any], args: tuple[Any, ...]) -> bool:
    copies = original in (np.array, np.asarray, np.asanyarray)
    return copies and is_traced(list(args)) and not any(isinstance(a, TracedCall) for a in args)


def _softmax(x: Any, axis: Any = None) -> Any:
    shifted = np.exp(x - np.max(x, axis=axis, keepdims=True))
    return shifted / np.sum(shifted, axis=axis, keepdims=True)


def _log_softmax(x: Any, axis: Any = None) -> Any:
    off = x - np.max(x, axis=axis, keepdims=True)
    return off - np.log(np.sum(np.exp(off), axis=axis, keepdims=True))


_INSTEAD: dict[Any, Callable[..., Any]] = {
    original: _if_traced(original, rule)
    for original, rule in (
        (np.take, lambda *args, **kwargs: TracedArray(of_function(np.take, args, kwargs))),
        (np.float64, lambda x: _array(x, float)),
        (special.logsumexp, log_sum_exp),
        (special.softmax, _softmax),
        (special.log_softmax, _log_softmax),
    )
} | {
    original: _made(original)
    for original in (
        np.array, np.asarray, np.asanyarray, np.zeros, np.ones, np.empty, np.full, np.eye,
        np.identity, np.arange, np.linspace,
    )
}  # fmt: skip
