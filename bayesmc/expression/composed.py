"""Functions of NumPy and SciPy that are said in terms of others: they work on arrays and stand-ins alike.

What cannot be said so of some arguments is ``NotImplemented``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy import special


def log_sum_exp(a: Any, axis: Any = None, b: Any = None, keepdims: bool = False) -> Any:
    """``log(sum(b * exp(a)))`` in the log domain, of arrays or what stands for them."""
    top = np.max(a, axis=axis, keepdims=True)
    top = np.where(np.isfinite(top), top, 0.0)
    terms = np.exp(a - top) if b is None else b * np.exp(a - top)
    found = np.log(np.sum(terms, axis=axis, keepdims=True)) + top
    return found if keepdims else np.sum(found, axis=axis)  # of one


# ---- private ------------------------------------------------------------------------------------


def _softmax(x: Any, axis: Any = None) -> Any:
    shifted = np.exp(x - np.max(x, axis=axis, keepdims=True))
    return shifted / np.sum(shifted, axis=axis, keepdims=True)


def _log_softmax(x: Any, axis: Any = None) -> Any:
    off = x - np.max(x, axis=axis, keepdims=True)
    return off - np.log(np.sum(np.exp(off), axis=axis, keepdims=True))


def _mean(a: Any, axis: Any = None, *, keepdims: bool = False) -> Any:
    total = np.sum(a, axis=axis, keepdims=keepdims)
    return total / (a.size // max(total.size, 1))


def _var(a: Any, axis: Any = None, *, ddof: int = 0, keepdims: bool = False) -> Any:
    off = a - _mean(a, axis, keepdims=True)
    total = np.sum(off * off, axis=axis, keepdims=keepdims)
    return total / (a.size // max(total.size, 1) - ddof)


def _average(a: Any, axis: Any = None, weights: Any = None) -> Any:
    if weights is None:
        return _mean(a, axis)
    if np.shape(weights) != a.shape:  # along one axis
        behind = (1,) * (a.ndim - 1 - axis % a.ndim)
        weights = np.broadcast_to(np.reshape(weights, np.shape(weights) + behind), a.shape)
    return np.sum(a * weights, axis=axis) / np.sum(weights, axis=axis)


def _select(conditions: Any, choices: Any, default: Any = 0) -> Any:
    found = default
    for condition, choice in reversed(list(zip(conditions, choices, strict=True))):
        found = np.where(condition, choice, found)
    return found


def _clip(a: Any, a_min: Any = None, a_max: Any = None, *, min: Any = None, max: Any = None) -> Any:
    low, high = (a_min if min is None else min), (a_max if max is None else max)
    found = a if low is None else np.maximum(a, low)
    return found if high is None else np.minimum(found, high)


def _isin(element: Any, test_elements: Any, *, invert: bool = False) -> Any:
    found = np.broadcast_to(False, element.shape)
    for value in np.ravel(test_elements):
        found = np.logical_or(found, element == value)
    return np.logical_not(found) if invert else found


def _diff(a: Any, n: int = 1, axis: int = -1, prepend: Any = None, append: Any = None) -> Any:
    if prepend is not None or append is not None:
        one = tuple(1 if k == axis % a.ndim else size for k, size in enumerate(a.shape))
        before, after = (
            [np.broadcast_to(end, one) if np.ndim(end) == 0 else end] if end is not None else []
            for end in (prepend, append)
        )
        a = np.concatenate([*before, a, *after], axis=axis)
    for _ in range(n):
        at = np.arange(a.shape[axis] - 1)
        a = np.take(a, at + 1, axis=axis) - np.take(a, at, axis=axis)
    return a


def _choose(a: Any, choices: Any) -> Any:
    at, *arrays = np.broadcast_arrays(a, *choices)
    table = np.stack(arrays)
    return np.take_along_axis(table, np.where(at < 0, len(arrays), at)[None], axis=0)[0]


def _masked(keep: Callable[..., np.ndarray]) -> Callable[..., Any]:
    return lambda m, k=0: np.where(keep(np.ones(m.shape[-2:]), k).astype(bool), m, 0)


def _diag(v: Any, k: int = 0) -> Any:
    if v.ndim == 2:
        return np.diagonal(v, k)
    if k:
        raise TypeError("off the diagonal")
    return v[:, None] * np.eye(v.size)


def _polyval(p: Any, x: Any) -> Any:
    found = 0.0
    for coefficient in p:
        found = found * x + coefficient
    return found


def _nan_to_num(
    x: Any, copy: bool = True, nan: float = 0.0, posinf: Any = None, neginf: Any = None
) -> Any:
    info = np.finfo(float)
    found = np.where(np.isnan(x), nan, x)
    found = np.where(found == np.inf, info.max if posinf is None else posinf, found)
    return np.where(found == -np.inf, info.min if neginf is None else neginf, found)


def _sinc(x: Any) -> Any:
    node = x * np.pi
    return np.where(node == 0.0, 1.0, np.sin(node) / node)


def _cumprod(a: Any, axis: Any = None) -> Any:
    """By doubling: after each round entries are products of twice as many."""
    a = a if a.dtype.kind in "fc" else a.astype(int)
    if axis is None:
        a, axis = np.reshape(a, (-1,)), 0
    size, width = a.shape[axis], 1
    one = tuple(1 if k == axis % a.ndim else n for k, n in enumerate(a.shape))
    while width < size:
        ones = np.repeat(np.ones(one, a.dtype), width, axis=axis)
        a = a * np.concatenate([ones, np.take(a, np.arange(size - width), axis=axis)], axis=axis)
        width *= 2
    return a


def _known(a: Any) -> Any:
    """The numbers of an argument; None where it stands for others."""
    node = getattr(a, "expression", None)
    return a if node is None else getattr(node, "value", None)


def _looked_up(table: np.ndarray, at: Any) -> Any:
    return np.reshape(np.take_along_axis(table, np.reshape(at, (-1,)), axis=0), at.shape)


def _interp(
    x: Any, xp: Any, fp: Any, left: Any = None, right: Any = None, period: Any = None
) -> Any:
    """By bisection among known knots; others are left to NumPy."""
    knots, heights = map(_known, (xp, fp))
    if knots is None or heights is None:
        return NotImplemented
    xs, ys = np.asarray(knots, dtype=float), np.asarray(heights, dtype=float)
    if period is not None or xs.ndim != 1 or xs.shape != ys.shape or len(xs) < 2:
        return NotImplemented
    with np.errstate(all="ignore"):
        widths = np.diff(xs)
        slopes = np.diff(ys) / widths
    if not ((widths > 0).all() and np.isfinite([*widths, *slopes, *xs, *ys]).all()):
        return NotImplemented  # NumPy makes more of what is infinite
    inside = np.minimum(np.maximum(x, xs[0]), xs[-1])
    rounds = int(np.ceil(np.log2(len(widths))))
    starts = np.full(2**rounds, np.inf)
    starts[: len(widths)] = xs[:-1]
    at: Any = np.zeros(x.shape, dtype=np.intp)
    for step in 2 ** np.arange(rounds)[::-1]:
        at = np.where(inside >= _looked_up(starts, at + step), at + step, at)
    found = _looked_up(ys, at) + _looked_up(slopes, at) * (inside - _looked_up(xs, at))
    found = np.where(x < xs[0], ys[0] if left is None else left, found)
    return np.where(x > xs[-1], ys[-1] if right is None else right, found)


#: function -> the same in terms of others, whose first argument is an array or stands for one
COMPOSED: Mapping[Any, Callable[..., Any]] = {
    np.mean: _mean, np.var: _var, np.average: _average, np.clip: _clip, np.isin: _isin,
    np.diff: _diff, np.cumprod: _cumprod, np.interp: _interp,
    np.choose: _choose, np.diag: _diag, np.nan_to_num: _nan_to_num, np.sinc: _sinc,
    np.std: lambda a, axis=None, **how: np.sqrt(_var(a, axis, **how)),
    np.ptp: lambda a, axis=None: np.max(a, axis=axis) - np.min(a, axis=axis),
    np.outer: lambda a, b: np.reshape(a, (-1, 1)) * np.reshape(b, (1, -1)),
    np.full_like: lambda a, fill_value: np.broadcast_to(fill_value, a.shape),
    np.triu: _masked(np.triu), np.tril: _masked(np.tril),
    special.logsumexp: log_sum_exp, special.softmax: _softmax, special.log_softmax: _log_softmax,
}  # fmt: skip
#: the same of sequences of arrays
COMPOSED_OF_SEVERAL: Mapping[Any, Callable[..., Any]] = {np.select: _select, np.polyval: _polyval}
