"""Functions whose captured arrays can be indexed by stand-ins.

NumPy hands a call on only where an argument stands for an array. So a captured array that is indexed by
one, a list that is made an array, and functions of SciPy that are no ufuncs are put in place of
themselves in a copy of the function.
"""

from __future__ import annotations

import contextlib
import types
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import special

from bayesmc.expression.array import TracedArray, TracedCall, is_traced
from bayesmc.expression.changing import is_left, is_open, names_in
from bayesmc.expression.composed import COMPOSED
from bayesmc.expression.functions import expression_of, of_function
from bayesmc.expression.graph import constant

#: modules of which some functions are replaced
_REPLACED = frozenset(("numpy", "scipy"))


def lifted(function: types.FunctionType) -> types.FunctionType:
    """A copy of a function, and of those that it calls, in which captured arrays are stand-ins."""
    return _lifted_function(function, {})


# ---- private ------------------------------------------------------------------------------------


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
    for name in set(names_in(function.__code__)) & scope.keys():
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
    if isinstance(value, types.FunctionType) and is_open(value):
        return _lifted_function(value, seen)
    if isinstance(value, types.ModuleType) and (
        not is_left(value) or value.__name__.split(".")[0] in _REPLACED
    ):
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


_INSTEAD: dict[Any, Callable[..., Any]] = {
    original: _if_traced(original, rule)
    for original, rule in (
        (np.take, lambda *args, **kwargs: TracedArray(of_function(np.take, args, kwargs))),
        (np.float64, lambda x: _array(x, float)),
        *((f, COMPOSED[f]) for f in (special.logsumexp, special.softmax, special.log_softmax)),
    )
} | {
    original: _made(original)
    for original in (
        np.array, np.asarray, np.asanyarray, np.zeros, np.ones, np.empty, np.full, np.eye,
        np.identity, np.arange, np.linspace,
    )
}  # fmt: skip
