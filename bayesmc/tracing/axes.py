"""Where the axes of a value go: which of them an operation leaves alone.

The answer is a span ``(low, high)`` of the value's axes: those before ``low`` keep their place from the left,
those from ``high`` on keep it from the right, each with its elements where they were; what is between is
anyone's guess. ``(g, g)`` is something inserted at ``g``; ``KEPT`` nothing but new axes in front, if any;
None all axes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from bayesmc.shapes import Shape
from bayesmc.tracing.standin import StandIn

Span = tuple[int, int] | None
#: no axis touched; the value broadcasts
KEPT = (10**9, 0)

#: functions along an axis: where the axis stands among the arguments, and its default
_ALONG: dict[Any, tuple[int, Any]] = {
    np.sum: (1, None), np.mean: (1, None), np.prod: (1, None), np.max: (1, None),
    np.min: (1, None), np.std: (1, None), np.var: (1, None), np.median: (1, None),
    np.any: (1, None), np.all: (1, None), np.average: (1, None), np.cumsum: (1, None),
    np.cumprod: (1, None), np.flip: (1, None), np.sort: (1, -1), np.diff: (2, -1),
    np.take: (2, None), np.repeat: (2, None), np.roll: (2, None), np.concatenate: (1, 0),
    np.split: (2, 0), np.array_split: (2, 0),
}  # fmt: skip
#: functions that read the elements in C order and lay them out in another shape
_RESHAPING = frozenset(
    (np.reshape, np.ravel, np.squeeze, np.expand_dims, np.atleast_1d, np.atleast_2d, np.atleast_3d)
)
#: functions element by element
_ELEMENTWISE = frozenset(
    (
        np.where,
        np.select,
        np.choose,
        np.copy,
        np.broadcast_to,
        np.clip,
        np.round,
        np.real,
        np.nan_to_num,
    )
)
_MATRIX = frozenset((np.matrix_transpose, np.linalg.matrix_transpose, np.triu, np.tril))


def operands(func: Any, args: Any) -> list[Any]:
    """The arrays that a function works on, each of which the span is about."""
    if func is np.select:
        return [*args[1], *args[2:]] if isinstance(args[1], (list, tuple)) else []
    if func is np.choose:
        return list(args[1]) if isinstance(args[1], (list, tuple)) else []
    if func is np.where:
        return list(args)
    if func is np.einsum:
        return list(args[1:])
    return list(args[0]) if isinstance(args[0], (list, tuple)) else [args[0]]


def function_span(func: Any, args: Any, kwargs: Any, value: StandIn, result: Any) -> Span:
    """The axes of one operand that a NumPy function touches."""
    n = value.ndim
    if func in _ELEMENTWISE:
        return KEPT if func is not np.where or len(args) == 3 else None
    if func in (np.stack, np.concatenate) and not isinstance(args[0], (list, tuple)):
        return None  # the first axis of one array is taken apart
    if func in _RESHAPING:
        in_order = func is not np.reshape or (len(args) == 2 and not set(kwargs) - {"shape"})
        plain = func is not np.ravel or (len(args) == 1 and not kwargs)
        return _reshaped(value.shape, np.shape(result)) if in_order and plain else None
    if func is np.stack:
        gap = _axis(args, kwargs, 1, 0)
        return (gap % (n + 1),) * 2 if isinstance(gap, int) else None
    if func in _ALONG:
        return covering(_axis(args, kwargs, *_ALONG[func]), n)
    if func is np.swapaxes and len(args) == 3:
        return covering(args[1:], n)
    if func is np.moveaxis and len(args) == 3:
        return covering((*np.atleast_1d(args[1]).tolist(), *np.atleast_1d(args[2]).tolist()), n)
    if func in _MATRIX:
        return n - 2, n
    if func is np.dot and value is args[0]:
        return n - 1, n
    return None


def covering(axis: Any, ndim: int) -> Span:
    """The span from the first to the last of some axes."""
    axes = axis if isinstance(axis, tuple) else (axis,)
    if not axes or not all(isinstance(a, (int, np.integer)) for a in axes):
        return None
    places = [int(a) % max(ndim, 1) for a in axes]
    return min(places), max(places) + 1


def index_span(key: Any, ndim: int) -> Span:
    """The axes that ``value[key]`` touches; arrays in the key bring their own axes in their place."""
    keys = list(key) if isinstance(key, tuple) else [key]
    widths = [_axes_taken(k) for k in keys]
    if None in widths:
        return None
    if not any(k is Ellipsis for k in keys):
        keys, widths = [*keys, Ellipsis], [*widths, 0]
    rest = ndim - sum(w for w in widths if w is not None)
    at, low, high = 0, ndim, 0
    for k, width in zip(keys, widths, strict=True):
        wide = rest if k is Ellipsis else width or 0
        untouched = k is Ellipsis or (isinstance(k, slice) and k == slice(None))
        if not untouched:
            low, high = min(low, at), max(high, at + wide)
        at += wide
    if _scattered(keys):
        low = 0
    return KEPT if (low, high) == (ndim, 0) else (low, high)


def function_behind(func: Any, args: Any, kwargs: Any, found: list[Any], result: Any) -> int | None:
    """Axes behind the plates in what a NumPy function makes of some values; None where plates mix."""
    first = result[0] if isinstance(result, (list, tuple)) else result
    ndim = np.ndim(first)
    found = _with_plates(found)
    if not found:
        return ndim
    worked_on = [x for x in operands(func, args) if any(x is y for y in found)]
    if len(worked_on) < len(found):
        return None  # one steers, or is hidden in a list
    after: set[int | None] = set()
    for x in worked_on:
        if func is np.einsum:
            after |= set(_after_einsum(args, x))
        else:
            after.add(behind_after(function_span(func, args, kwargs, x, first), x, ndim))
    return after.pop() if len(after) == 1 else None


def ufunc_behind(
    ufunc: Any, method: str, inputs: Any, kwargs: Any, found: list[Any], result: Any
) -> int | None:
    """Axes behind the plates in what a ufunc makes of some values; None where plates mix."""
    first = result[0] if isinstance(result, tuple) else result
    found = _with_plates(found)
    if not found:
        return np.ndim(first)
    direct = [any(x is y for y in found) for x in inputs]
    if sum(direct) < len(found):
        return None  # one is hidden in a list
    if method == "__call__":
        if {"axis", "axes", "keepdims"} & set(kwargs):
            return None
        cores, core = _cores(ufunc, inputs)
        after = {inputs[k].claims.behind - cores[k] for k, one in enumerate(direct) if one}
        return after.pop() + core if len(after) == 1 and min(after) >= 0 else None
    if len(found) > 1 or found[0] is not inputs[0]:
        return None
    if method == "outer":
        return behind_after((found[0].ndim,) * 2, found[0], np.ndim(first))
    return behind_after(covering(kwargs.get("axis", 0), found[0].ndim), found[0], np.ndim(first))


def behind_after(span: Span, value: StandIn, ndim: int) -> int | None:
    """Axes behind the plates in a result with ``ndim`` axes, of which a span was touched."""
    lead = value.ndim - value.claims.behind
    if lead == 0:
        return ndim
    if span is None:
        return None
    low, high = span
    if high == 0:
        return value.claims.behind
    return ndim - lead if low >= lead else None


# ---- private ------------------------------------------------------------------------------------


def _axes_taken(key: Any) -> int | None:
    """Axes of a value that one part of a key is about; None if it is no part that is known."""
    if key is None or key is Ellipsis:
        return 0
    if isinstance(key, slice) or type(key) is int or isinstance(key, np.integer):
        return 1
    if not isinstance(key, (np.ndarray, list)):
        return None
    array = np.asarray(key)
    if array.dtype == bool:
        return array.ndim
    return 1 if array.dtype.kind in "iu" else None


def _scattered(keys: list[Any]) -> bool:
    """Whether arrays stand apart in a key: NumPy sends their axes to the front, whole numbers' among them."""
    basic = [k is None or k is Ellipsis or isinstance(k, slice) for k in keys]
    if all(b or type(k) is int for b, k in zip(basic, keys, strict=True)):
        return False
    runs = sum(not b and (i == 0 or basic[i - 1]) for i, b in enumerate(basic))
    return runs > 1


def _with_plates(found: list[Any]) -> list[Any]:
    """Those with axes for plates: the others read one place alone, whatever is done to them."""
    return [x for x in found if x.ndim > x.claims.behind]


def _after_einsum(args: Any, value: StandIn) -> Iterator[int | None]:
    """Of ``einsum("...i,ij->...j", ...)``: the letters of an operand come from behind the plates."""
    if not isinstance(args[0], str) or "->" not in args[0]:
        yield None
        return
    ins, out = args[0].replace(" ", "").split("->")
    for part, x in zip(ins.split(","), args[1:], strict=True):
        core = len(part) - 3
        if x is value and part.startswith("...") and out.startswith("..."):
            yield value.claims.behind - core + len(out) - 3 if core <= value.claims.behind else None
        elif x is value:
            yield None


def _cores(ufunc: Any, inputs: Any) -> tuple[list[int], int]:
    """Core axes of each input of a (generalised) ufunc, and of its result."""
    if ufunc.signature is None:
        return [0] * len(inputs), 0
    if ufunc is np.matmul:
        return [min(np.ndim(x), 2) for x in inputs], sum(np.ndim(x) > 1 for x in inputs)
    ins, out = ufunc.signature.split("->")
    return [_count(part) for part in ins.split("),(")], _count(out)


def _count(group: str) -> int:
    inner = group.strip("()")
    return len(inner.split(",")) if inner else 0


def _axis(args: Any, kwargs: Any, place: int, default: Any) -> Any:
    return args[place] if len(args) > place else kwargs.get("axis", default)


def _reshaped(before: Shape, after: Shape) -> Span:
    """The span between what two shapes have in common at both ends."""
    if len(after) >= len(before) and after[len(after) - len(before) :] == before:
        if math.prod(after) == math.prod(before):
            return KEPT  # only axes in front
    low = high = 0
    while low < min(len(before), len(after)) and before[low] == after[low]:
        low += 1
    while high < min(len(before), len(after)) and before[-1 - high] == after[-1 - high]:
        high += 1
    return low, len(before) - high
