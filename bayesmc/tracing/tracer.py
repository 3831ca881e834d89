"""The stand-in for an array: what NumPy does to it, and what it refuses to show.

What an operation leaves certain is told by the rules: ``affine`` and ``margins``.

References
----------
Interception by ``__array_ufunc__`` and ``__array_function__``: NumPy enhancement proposals 13 and 18.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from bayesmc.tracing.affine import function_keeps_affine, ufunc_keeps_affine
from bayesmc.tracing.arraylike import SHAPE_FUNCTIONS as _SHAPE_FUNCTIONS
from bayesmc.tracing.arraylike import ArrayLike
from bayesmc.tracing.margins import margin_of
from bayesmc.tracing.standin import StandIn, bare, is_foreign, leaves, locked, stand_ins

#: functions that hand numbers to callbacks or files
_SHOWING = frozenset(
    (np.apply_along_axis, np.apply_over_axes, np.piecewise, np.save, np.savez, np.savetxt)
)


class Tracer(ArrayLike):
    """Stands for an array that varies with some traced values.

    Parameters
    ----------
    value : ndarray
        An example of what it stands for; gives shape and type, and is never shown to a function.
    sources : iterable of str
        Names of the traced values it varies with.
    reason : str, optional
        The operation after which it is no longer known to be affine in them; None while it is.
    margin : Tracer, optional
        Of an event: the affine value that is positive where the event is true.
    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.tracing import Tracer
    >>> x = Tracer(np.array([1.0, 2.0]), ["x"])
    >>> (2 * x[..., 0] + 1).is_affine, (x.sum() ** 2).reason
    (True, 'np.power')
    """

    __slots__ = ("_value", "margin", "reason", "sources")

    def __init__(
        self,
        value: Any,
        sources: Iterable[str],
        reason: str | None = None,
        margin: Tracer | None = None,
    ) -> None:
        self._value = locked(np.asarray(value))
        self.sources = frozenset(sources)
        self.reason = reason
        self.margin = margin

    @property
    def example(self) -> np.ndarray:
        """The value of what it stands for at the example's values (for who traces, not for functions)."""
        return self._value

    def __repr__(self) -> str:
        state = "affine" if self.is_affine else f"not affine after {self.reason}"
        return f"Tracer({', '.join(sorted(self.sources))}; shape {self.shape}, {state})"

    # ---- what NumPy does to it ---------------------------------------------------------------

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if any(is_foreign(x) for x in inputs):
            return NotImplemented
        if method == "at" or "out" in kwargs or isinstance(kwargs.get("where", True), Tracer):
            raise TypeError("a parent is read-only: write x = x + 1, not x += 1, and use no out=")
        values = [bare(x) for x in inputs]
        traced = stand_ins(list(inputs))
        with np.errstate(all="ignore"):
            result = getattr(ufunc, method)(*values, **kwargs)
        reason = next((t.reason for t in traced if t.reason), None)
        if reason is None and not ufunc_keeps_affine(ufunc, method, inputs, kwargs):
            reason = f"np.{ufunc.__name__}"
        wrapped = _wrapped(result, reason, _sources(traced))
        if method == "__call__" and not kwargs and not isinstance(wrapped, tuple):
            wrapped.margin = margin_of(ufunc, inputs)
        return wrapped

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if any(is_foreign(x) for x in leaves([args, list(kwargs.values())])):
            return NotImplemented
        if func in _SHOWING:
            raise self._refuse(f"np.{func.__name__}")
        if func is np.broadcast_arrays and not kwargs and not any(map(_holds_traced, args)):
            shape = np.broadcast_shapes(*map(np.shape, args))
            return tuple(np.broadcast_to(x, shape) for x in args)
        with np.errstate(all="ignore"):
            result = func(*bare(args), **{k: bare(v) for k, v in kwargs.items()})
        if func in _SHAPE_FUNCTIONS:
            return result
        traced = stand_ins([args, list(kwargs.values())])
        reason = next((t.reason for t in traced if t.reason), None)
        if reason is None and not function_keeps_affine(func, args, kwargs):
            reason = f"np.{func.__name__}"
        return _wrapped(result, reason, _sources(traced))

    def __getitem__(self, key: Any) -> Any:
        keys = stand_ins(key)
        value = self._value[bare(key)]
        if keys:
            return Tracer(value, _sources([self, *keys]), "an index")
        return Tracer(
            value, self.sources, self.reason, None if self.margin is None else self.margin[key]
        )

    # ---- copies and other types ----------------------------------------------------------------

    def copy(self) -> Any:
        return Tracer(self._value, self.sources, self.reason)

    view = copy

    def astype(self, dtype: Any, *args: Any, **kwargs: Any) -> Any:
        kept = np.dtype(dtype) == np.float64
        reason = self.reason or (None if kept else f"astype({np.dtype(dtype).name})")
        return Tracer(self._value.astype(dtype), self.sources, reason)

    def _refuse(self, what: str) -> TypeError:
        names = ", ".join(sorted(self.sources))
        return TypeError(
            f"it asks for {what} of {names}, where only NumPy operations can be followed"
        )


# ---- private ------------------------------------------------------------------------------------


def _sources(traced: Iterable[StandIn]) -> frozenset[str]:
    return frozenset().union(*(t.sources for t in traced))


def _wrapped(result: Any, reason: str | None, sources: frozenset[str]) -> Any:
    if isinstance(result, (list, tuple)):
        return type(result)(_wrapped(r, reason, sources) for r in result)
    if reason is None and np.asarray(result).dtype not in (np.float64, np.complex128):
        reason = "numbers that round or wrap"
    return Tracer(result, sources, reason)


def _holds_traced(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and bool(stand_ins(value))
