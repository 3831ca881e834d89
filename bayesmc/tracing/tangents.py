"""Tangents of results: how what moves the arguments of a NumPy call moves what comes of it.

Every rule answers with the plain result and its tangent, the directions on a last axis of their own. A
rule is exact or raises ``NoTangent``; nothing is approximated here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bayesmc.tracing.affine import function_keeps_affine
from bayesmc.tracing.partials import jumps, partials
from bayesmc.tracing.standin import StandIn, bare, is_traced, stand_ins

#: generalised ufuncs that are linear in each argument
_PRODUCTS = frozenset((np.matmul, np.matvec, np.vecmat, np.vecdot))
#: functions that are linear in each of their arrays
_MULTILINEAR = frozenset(
    (
        np.dot, np.inner, np.outer, np.tensordot, np.kron, np.convolve, np.einsum, np.cross,
        np.linalg.matmul, np.linalg.vecdot, np.linalg.outer, np.linalg.tensordot, np.linalg.cross,
    )
)  # fmt: skip
#: options that choose axes and change nothing else
_AXES = frozenset({"axis", "axes", "axisa", "axisb", "axisc", "keepdims", "optimize"})

Moved = tuple[Any, Any]


class Moving(StandIn):
    """A stand-in with a tangent, shape ``(*shape, directions)``."""

    __slots__ = ()

    tangent: np.ndarray


class NoTangent(Exception):
    """A call whose derivative is not known.

    Parameters
    ----------
    reason : str
    always : bool
        Whether the call itself has no rule; otherwise it has, and no derivative at these numbers.
    """

    def __init__(self, reason: str, always: bool = True) -> None:
        super().__init__(reason)
        self.always = always


def of_ufunc(ufunc: Any, method: str, inputs: Any, kwargs: Any) -> Moved:
    """Result and tangent of a ufunc; the tangent is None where the result is constant in pieces."""
    name = f"np.{ufunc.__name__}"
    if any(isinstance(x, (list, tuple)) and is_traced(x) for x in inputs):
        raise NoTangent(f"{name} of a list")
    values = [bare(x) if isinstance(x, Moving) else np.asarray(x) for x in inputs]
    if method == "reduce" and ufunc is np.add and len(inputs) == 1:
        return of_function(np.sum, inputs, {"axis": 0, **kwargs})
    if method != "__call__" or set(kwargs) - (_AXES if ufunc in _PRODUCTS else set()):
        raise NoTangent(f"{name} with {method}, {sorted(kwargs)}")
    if ufunc in _PRODUCTS:
        return _product(ufunc, inputs, kwargs)
    result = ufunc(*values)
    jump = jumps(ufunc, values, result)
    if jump is not None:
        if np.any(jump & _apart(ufunc, inputs)):
            raise NoTangent(f"{name} at a jump", False)
        return result, None
    rules = partials(ufunc)
    if rules is None:
        raise NoTangent(name)
    found: Any = 0.0
    for rule, x in zip(rules, inputs, strict=True):
        if isinstance(x, Moving):
            slope = np.asarray(rule(*values, result))
            found = found + slope[..., None] * x.tangent
    return result, found


def of_function(func: Any, args: Any, kwargs: Any) -> Moved:
    """Result and tangent of a NumPy function; of one that returns several arrays, tuples of them."""
    if func in _OWN_RULES:
        try:
            return _OWN_RULES[func](*args, **kwargs)
        except TypeError as error:
            raise NoTangent(f"np.{func.__name__} with options that its rule lacks") from error
    if stand_ins(list(kwargs.values())):
        raise NoTangent(f"np.{func.__name__} of keyword arguments")
    if func in _MULTILINEAR:
        return _product(func, args, kwargs)
    if function_keeps_affine(func, args, kwargs):
        return _affine(func, args, kwargs)
    raise NoTangent(f"np.{func.__name__}")


# ---- private: rules by linearity ------------------------------------------------------------------


def _affine(func: Any, args: Any, kwargs: Any) -> Moved:
    """A function that is affine in all that moves together: what it makes of a step, less that of none."""
    result = func(*bare(args), **kwargs)
    still = func(*_put(args, lambda x: np.zeros(x.shape)), **kwargs)
    steps = [func(*_step(args, k), **kwargs) for k in range(_width(args))]
    if isinstance(result, (list, tuple)):
        return result, [
            _stacked([np.subtract(step[n], still[n]) for step in steps]) for n in range(len(result))
        ]
    return result, _stacked([np.subtract(step, still) for step in steps])


def _product(func: Any, args: Any, kwargs: Any) -> Moved:
    """A function that is linear in each of its arrays: the product rule."""
    if set(kwargs) - _AXES:
        raise NoTangent(f"np.{func.__name__} with {sorted(kwargs)}")
    if any(isinstance(x, (list, tuple)) and is_traced(x) for x in args):
        raise NoTangent(f"np.{func.__name__} of a list")
    plain = bare(list(args))
    moving = [n for n, x in enumerate(args) if isinstance(x, Moving)]
    steps = []
    for k in range(_width(args)):
        step: Any = 0.0
        for n in moving:
            step = step + func(*plain[:n], args[n].tangent[..., k], *plain[n + 1 :], **kwargs)
        steps.append(step)
    return func(*plain, **kwargs), _stacked(steps)


# ---- private: rules of single functions -----------------------------------------------------------


def _where(condition: Any, *choices: Any) -> Moved:
    if is_traced(condition) or len(choices) != 2:
        raise NoTangent("np.where of a condition on numbers")
    condition = np.asarray(condition)
    a, b = (_tangent(x, _width(choices)) for x in choices)
    result = np.where(condition, *(bare(x) for x in choices))
    return result, np.where(condition[..., None], a, b)


def _stack(arrays: Any, axis: int = 0) -> Moved:
    return _laid(np.stack, arrays, axis)


def _concatenate(arrays: Any, axis: int = 0) -> Moved:
    return _laid(np.concatenate, arrays, axis)


def _laid(func: Any, arrays: Any, axis: Any) -> Moved:
    """Arrays put beside each other along one axis."""
    if not isinstance(arrays, (list, tuple)) or not isinstance(axis, (int, np.integer)):
        raise NoTangent(f"np.{func.__name__} of what is no list, or without an axis")
    plain, width = [np.asarray(bare(x)) for x in arrays], _width(arrays)
    result = func(plain, axis=axis)
    parts = [
        np.broadcast_to(_tangent(x, width), (*value.shape, width))
        for x, value in zip(arrays, plain, strict=True)
    ]
    return result, func(parts, axis=axis if axis >= 0 else result.ndim + axis)


def _sum(a: Any, axis: Any = None, *, keepdims: Any = False) -> Moved:
    if not isinstance(a, Moving):
        raise NoTangent("np.sum of a list")
    axes = tuple(range(a.ndim)) if axis is None else np.atleast_1d(axis) % max(a.ndim, 1)
    result = np.sum(bare(a), axis=axis, keepdims=keepdims)
    tangent = np.sum(a.tangent, axis=tuple(map(int, axes)), keepdims=keepdims)
    return result, tangent


def _broadcast_to(array: Any, shape: Any) -> Moved:
    return np.broadcast_to(bare(array), shape), _tangent(array, _width([array]))


def _broadcast_arrays(*arrays: Any) -> Moved:
    width = _width(arrays)
    result = np.broadcast_arrays(*(bare(x) for x in arrays))
    return result, [_tangent(x, width) if isinstance(x, Moving) else None for x in arrays]


def _sinc(x: Any) -> Moved:
    value = np.asarray(bare(x))
    y = np.sinc(value)
    return y, ((np.cos(np.pi * value) - y) / value)[..., None] * x.tangent


def _interp(x: Any, xp: Any, fp: Any, left: Any = None, right: Any = None) -> Moved:
    """Piecewise linear, constant outside."""
    if not isinstance(x, Moving) or is_traced([xp, fp, left, right]):
        raise NoTangent("np.interp of moving points")
    value, xp, fp = bare(x), np.asarray(xp, dtype=float), np.asarray(fp, dtype=float)
    slopes = np.concatenate([[0.0], np.diff(fp) / np.diff(xp), [0.0]])
    slope = slopes[np.searchsorted(xp, value)]
    slope = np.where(np.isin(value, xp), np.nan, slope)
    return np.interp(value, xp, fp, left, right), slope[..., None] * x.tangent


#: functions with a rule of their own; what has more options than a rule takes is not followed
_OWN_RULES: dict[Any, Callable[..., Moved]] = {
    np.where: _where, np.stack: _stack, np.concatenate: _concatenate, np.sum: _sum,
    np.broadcast_to: _broadcast_to, np.broadcast_arrays: _broadcast_arrays, np.sinc: _sinc,
    np.interp: _interp,
}  # fmt: skip


# ---- private: helpers -----------------------------------------------------------------------------


def _width(values: Any) -> int:
    """How many directions there are."""
    found = next(x for x in stand_ins(list(values)) if isinstance(x, Moving))
    return found.tangent.shape[-1]


def _tangent(value: Any, width: int) -> np.ndarray:
    """A value's tangent, zero where it does not move."""
    if isinstance(value, Moving):
        return value.tangent
    if is_traced(value):
        raise NoTangent("a list among arrays")
    return np.zeros((*np.shape(value), width))


def _put(value: Any, pick: Callable[[Any], Any]) -> Any:
    """Arguments with plain arrays in place of what moves."""
    if isinstance(value, Moving):
        return pick(value)
    if isinstance(value, (list, tuple)):
        return type(value)(_put(v, pick) for v in value)
    return bare(value)


def _step(args: Any, k: int) -> Any:
    """Arguments that are the k-th direction of what moves."""
    return _put(args, lambda x: x.tangent[..., k])


def _apart(ufunc: Any, inputs: Any) -> np.ndarray:
    """Where arguments move, those that are compared with each other not together."""
    tangents = [_tangent(x, _width(inputs)) for x in inputs]
    if len(tangents) == 2 and ufunc is not np.floor_divide:
        tangents = [tangents[0] - tangents[1]]
    return np.asarray(sum((t != 0).any(axis=-1) for t in tangents) > 0)


def _stacked(steps: list[Any]) -> np.ndarray:
    return np.stack([np.asarray(s) for s in steps], axis=-1)
