"""Forward derivatives: a stand-in that carries a value and how it moves in some directions.

References
----------
Griewank and Walther (2008), Evaluating Derivatives, 2nd ed., sec. 3.1 (tangents, the forward mode).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bayesmc.tracing.arraylike import SHAPE_FUNCTIONS, ArrayLike
from bayesmc.tracing.standin import bare, is_foreign, is_traced, leaves, locked
from bayesmc.tracing.tangents import Moving, NoTangent, of_function, of_ufunc


class Dual(ArrayLike, Moving):
    """An array and its tangent: what a function makes of it has the function's derivatives.

    Every NumPy operation either has an exact rule or raises ``NoTangent``, as it does at jumps; at kinks
    (``np.abs`` at 0) tangents are NaN. Comparisons give plain booleans. What would show the numbers
    (``float``, iteration, ``np.asarray``) raises, so nothing passes by without its tangent.

    Parameters
    ----------
    value : array_like, shape S
    tangent : array_like, shape (*S, directions)
        Derivatives of every element along some directions.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.tracing import Dual
    >>> x = Dual([2.0, 3.0], np.eye(2))
    >>> y = np.where(x[0] > 1, x[0] ** 2 * x[1], 0.0)
    >>> y.value.tolist(), y.tangent.tolist()
    (12.0, [12.0, 4.0])
    """

    __slots__ = ("_value", "tangent")

    def __init__(self, value: Any, tangent: Any) -> None:
        value, tangent = np.asarray(value, dtype=float), np.asarray(tangent, dtype=float)
        if tangent.shape[:-1] != value.shape:
            tangent = np.broadcast_to(tangent, (*value.shape, tangent.shape[-1]))
        self._value, self.tangent = locked(value), tangent

    @property
    def value(self) -> np.ndarray:
        """The plain array (for who differentiates, not for functions)."""
        return self._value

    def __repr__(self) -> str:
        return f"Dual(shape {self.shape}, {self.tangent.shape[-1]} directions)"

    # ---- what NumPy does to it ---------------------------------------------------------------

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if any(is_foreign(x) for x in inputs):
            return NotImplemented
        if method == "at" or "out" in kwargs:
            raise NoTangent("a call that writes into an array")
        with np.errstate(all="ignore"):
            return _wrapped(*of_ufunc(ufunc, method, inputs, kwargs))

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if any(is_foreign(x) for x in leaves([args, list(kwargs.values())])):
            return NotImplemented
        if func in SHAPE_FUNCTIONS:
            return func(*bare(args), **kwargs)
        if func in _WRITTEN_OUT:
            return _WRITTEN_OUT[func](*args, **kwargs)
        with np.errstate(all="ignore"):
            return _wrapped(*of_function(func, args, kwargs))

    def __getitem__(self, key: Any) -> Any:
        keys = key if isinstance(key, tuple) else (key,)
        if is_traced(list(keys)):
            raise NoTangent("an index that moves")
        value = self._value[key]
        behind = (*keys, slice(None)) if any(k is Ellipsis for k in keys) else key
        tangent = self.tangent[behind]
        if tangent.shape != (*value.shape, self.tangent.shape[-1]):
            raise NoTangent(f"an index {key!r}")
        return Dual(value, tangent)

    # ---- copies and other types ----------------------------------------------------------------

    def copy(self) -> Any:
        return self

    view = copy

    def astype(self, dtype: Any, *args: Any, **kwargs: Any) -> Any:
        kind = np.dtype(dtype).kind
        if np.dtype(dtype) == np.float64:
            return self
        if kind in "iu":
            return np.trunc(self).astype(dtype)
        raise NoTangent(f"astype({np.dtype(dtype).name})")

    def _refuse(self, what: str) -> NoTangent:
        return NoTangent(f"{what}, where only NumPy operations can be followed")


# ---- private ------------------------------------------------------------------------------------


def _wrapped(result: Any, tangent: Any) -> Any:
    """A result with its tangent; plain without one."""
    if tangent is None:
        return result
    if isinstance(result, (list, tuple)):
        return type(result)(_wrapped(r, t) for r, t in zip(result, tangent, strict=True))
    if np.asarray(result).dtype != np.float64:
        raise NoTangent(f"numbers of type {np.asarray(result).dtype}")
    return Dual(result, tangent)


def _clip(a: Any, a_min: Any = None, a_max: Any = None, **kwargs: Any) -> Any:
    low, high = kwargs.pop("min", a_min), kwargs.pop("max", a_max)
    if kwargs:
        raise NoTangent(f"np.clip with {sorted(kwargs)}")
    found = a if low is None else np.maximum(a, low)
    return found if high is None else np.minimum(found, high)


def _norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:  # noqa: A002
    one = isinstance(axis, (int, np.integer)) or (axis is None and np.ndim(x) == 1)
    if not isinstance(x, Dual) or not (one and ord in (None, 2) or axis is None and ord is None):
        raise NoTangent("np.linalg.norm of matrices, or of another order than 2")
    return np.sqrt(np.sum(np.square(x), axis=axis, keepdims=keepdims))


def _polyval(p: Any, x: Any) -> Any:
    found: Any = 0.0
    for coefficient in np.asarray(p):
        found = found * x + coefficient
    return found


#: functions written out in operations that have rules
_WRITTEN_OUT: dict[Any, Callable[..., Any]] = {
    np.clip: _clip, np.linalg.norm: _norm, np.polyval: _polyval,
}  # fmt: skip
