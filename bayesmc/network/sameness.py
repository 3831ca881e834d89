"""Whether two functions, or two values, say the same, as far as can be told without calling them.

A net that is declared anew by the same lines has other function objects. They are the same where their code,
constants, defaults, and what they close over or read from their module are. Unknown is allowed, wrong is not.
"""

from __future__ import annotations

import functools
import types
from collections.abc import Mapping
from typing import Any

import numpy as np

#: objects within objects that are looked into
_DEPTH = 12
_PLAIN = (
    int,
    float,
    complex,
    str,
    bytes,
    bool,
    type(None),
    range,
    slice,
    type(Ellipsis),
    np.generic,
)


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
    return _same(a, b, {}, _DEPTH)


# ---- private ------------------------------------------------------------------------------------

_Met = dict[tuple[int, int], tuple[Any, Any]]


def _same(a: Any, b: Any, met: _Met, depth: int) -> bool | None:
    if a is b:
        return True
    if type(a) is not type(b):
        return False
    if isinstance(a, _PLAIN):
        return bool(a == b) or (a != a and b != b)
    if (id(a), id(b)) in met:
        return True  # under comparison further out
    if depth == 0:
        return None
    met[id(a), id(b)] = a, b
    if isinstance(a, np.ndarray):
        return _same_array(a, b, met, depth)
    if isinstance(a, types.CodeType):
        return _same_code(a, b, met, depth)
    if isinstance(a, types.FunctionType):
        return _same_function(a, b, met, depth)
    if isinstance(a, types.MethodType):
        return _all(
            _same(x, y, met, depth - 1) for x, y in zip(_method(a), _method(b), strict=True)
        )
    if isinstance(a, functools.partial):
        parts = ((p.func, p.args, p.keywords) for p in (a, b))
        return _all(_same(x, y, met, depth - 1) for x, y in zip(*parts, strict=True))
    if isinstance(a, (tuple, list)):
        if len(a) != len(b):
            return False
        return _all(_same(x, y, met, depth - 1) for x, y in zip(a, b, strict=True))
    if isinstance(a, Mapping):
        if a.keys() != b.keys():
            return False
        return _all(_same(a[k], b[k], met, depth - 1) for k in a)
    if isinstance(a, (set, frozenset)):
        return True if a == b else None
    if isinstance(a, type) or isinstance(
        a, (types.ModuleType, types.BuiltinFunctionType, np.ufunc)
    ):
        return False
    return _same_object(a, b, met, depth)


def _same_array(a: np.ndarray, b: np.ndarray, met: _Met, depth: int) -> bool | None:
    if a.shape != b.shape or a.dtype != b.dtype:
        return False
    if a.dtype == object:
        return _all(_same(x, y, met, depth - 1) for x, y in zip(a.flat, b.flat, strict=True))
    nan = a.dtype.kind in "fc"
    equal = np.array_equal(a, b, equal_nan=nan)
    if isinstance(a, np.ma.MaskedArray):
        equal = equal and np.array_equal(np.ma.getmaskarray(a), np.ma.getmaskarray(b))
    return bool(equal)


def _same_code(a: types.CodeType, b: types.CodeType, met: _Met, depth: int) -> bool | None:
    plain = ("co_code", "co_names", "co_varnames", "co_freevars", "co_cellvars", "co_argcount",
             "co_kwonlyargcount", "co_flags")  # fmt: skip
    if any(getattr(a, what) != getattr(b, what) for what in plain):
        return False
    return _same(a.co_consts, b.co_consts, met, depth)


def _same_function(
    a: types.FunctionType, b: types.FunctionType, met: _Met, depth: int
) -> bool | None:
    parts = [_same(a.__code__, b.__code__, met, depth)]
    if parts[0] is False:
        return False
    parts.append(_same(_cells(a), _cells(b), met, depth - 1))
    for what in ("__defaults__", "__kwdefaults__"):
        parts.append(_same(getattr(a, what), getattr(b, what), met, depth - 1))
    if a.__globals__ is not b.__globals__:
        for name in _named(a.__code__):
            here, there = a.__globals__, b.__globals__
            if (name in here) != (name in there):
                return False
            if name in here:
                parts.append(_same(here[name], there[name], met, depth - 1))
    return _all(parts)


def _same_object(a: Any, b: Any, met: _Met, depth: int) -> bool | None:
    """Two objects of one class, by their attributes; None where these do not settle it."""
    if isinstance(a, (np.random.Generator, np.random.RandomState)):
        return None
    inside = [vars(x) if hasattr(x, "__dict__") else {} for x in (a, b)]
    slots = {s for c in type(a).__mro__ for s in _slots(c)} - {"__dict__", "__weakref__"}
    if not inside[0] and not inside[1] and not slots:
        return None
    both = [
        {**i, **{s: getattr(x, s, None) for s in slots}}
        for i, x in zip(inside, (a, b), strict=True)
    ]
    found = _same(both[0], both[1], met, depth - 1)
    return found if found else None  # what is kept for later use may differ


def _slots(kind: type) -> tuple[str, ...]:
    slots = kind.__dict__.get("__slots__", ())
    return (slots,) if isinstance(slots, str) else tuple(slots)


def _cells(function: types.FunctionType) -> tuple[Any, ...]:
    return tuple(_content(cell) for cell in function.__closure__ or ())


def _content(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not yet filled
        return None


def _named(code: types.CodeType) -> set[str]:
    """Names that code, and code within it, may read from its module."""
    found = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            found |= _named(constant)
    return found


def _method(method: types.MethodType) -> tuple[Any, Any]:
    return method.__func__, method.__self__


def _all(parts: Any) -> bool | None:
    """False if any is, else None if any is, else True."""
    found = list(parts)
    if any(part is False for part in found):
        return False
    return None if any(part is None for part in found) else True
