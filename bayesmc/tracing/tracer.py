"""The stand-in for an array: what NumPy does to it, and what it refuses to show.

What an operation leaves certain is told by the rules: ``affine``, ``margins``, and ``claims`` for the rest.

References
----------
Interception by ``__array_ufunc__`` and ``__array_function__``: NumPy enhancement proposals 13 and 18.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from typing import Any

import numpy as np

from bayesmc.tracing import claims as rules
from bayesmc.tracing.affine import function_keeps_affine, ufunc_keeps_affine
from bayesmc.tracing.arraylike import SHAPE_FUNCTIONS as _SHAPE_FUNCTIONS
from bayesmc.tracing.arraylike import ArrayLike
from bayesmc.tracing.margins import margin_of
from bayesmc.tracing.standin import Claims, bare, is_foreign, leaves, locked, stand_ins

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
    event_ndim : int
        Number of event axes, the last ones.

    Attributes
    ----------
    power : float or None
        With one source x > 0: the value is ``c * x**power`` element by element wherever it is a real number,
        with ``c`` free of x and a constant power other than 0; None where that is not certain. Which element
        of x an element is a power of is up to the function, as are sign and size of ``c``.
    is_copy : bool
        Every element of the value is an element of one of the sources, which one does not depend on them.
    whole_event : bool
        Copies, and powers but for one factor, hand on whole events: the last ``event_ndim`` axes are those
        of the source, in order. Always true of scalars.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.tracing import Tracer
    >>> x = Tracer(np.array([1.0, 2.0]), ["x"])
    >>> (2 * x[..., 0] + 1).is_affine, (x.sum() ** 2).reason
    (True, 'np.power')
    >>> (1.0 / np.sqrt(3.0 * x)).power, (x + 1.0).power, x[::-1].is_copy, np.sort(x).is_copy
    (-0.5, None, True, False)
    """

    __slots__ = ("_value", "claims", "margin", "reason", "sources")

    def __init__(
        self,
        value: Any,
        sources: Iterable[str],
        reason: str | None = None,
        margin: Tracer | None = None,
        event_ndim: int = 0,
    ) -> None:
        self._value = locked(np.asarray(value))
        self.sources = frozenset(sources)
        self.reason = reason
        self.margin = margin
        self.claims = rules.at_first(self._value, self.sources, reason, event_ndim)

    @classmethod
    def _derived(
        cls, value: Any, reason: str | None, known: tuple[frozenset[str], Claims]
    ) -> Tracer:
        """A stand-in for a result, of which the rules have told what is known."""
        made = cls.__new__(cls)
        made._value = locked(np.asarray(value))
        made.sources, made.claims = known
        made.reason = reason
        made.margin = None
        return made

    @property
    def power(self) -> float | None:
        return self.claims.power

    @property
    def is_copy(self) -> bool:
        return self.claims.is_copy

    @property
    def event_ndim(self) -> int:
        return self.claims.event_ndim

    @property
    def whole_event(self) -> bool:
        return self.claims.whole_event

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
        known = rules.after_ufunc(ufunc, method, inputs, kwargs, result, traced)
        wrapped = _wrapped(result, reason, known)
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
        return _wrapped(result, reason, rules.after_function(func, args, kwargs, result, traced))

    def __getitem__(self, key: Any) -> Any:
        keys = stand_ins(key)
        value = self._value[bare(key)]
        if keys:
            return Tracer._derived(value, "an index", rules.after_mixing([self, *keys]))
        made = Tracer._derived(value, self.reason, rules.after_index(self, key, value))
        made.margin = None if self.margin is None else self.margin[key]
        return made

    # ---- gathers along plates ------------------------------------------------------------------

    @property
    def wholes(self) -> frozenset[str]:
        """What its sources are called where they are read all over."""
        places, spread = self.claims.places, self.claims.spread
        return frozenset(places.get(s, s if s in spread else f"{s}[*]") for s in self.sources)

    def as_whole(self) -> tuple[Tracer, dict[str, str]]:
        """The value as one that may be read all over, its sources called ``x[*]``; their names by these.

        Sources that had been looked up before are called so for good and are not among the names.
        """
        sources, claims, names = rules.as_whole(self)
        return Tracer._derived(self._value, self.reason, (sources, claims)), names

    def looked_up(
        self, gathered: Tracer, names: Mapping[str, str], event_ndim: int, where: Hashable
    ) -> Tracer:
        """What was gathered from this value, with other names for sources that are read there alone.

        Parameters
        ----------
        gathered : Tracer
            Elements of this value, axes of the child's plates before ``event_ndim`` of the event.
        names : mapping
            From a source to what it is called now (``x[*]`` to ``x[0]``). As soon as elements of the child's
            plates may mix, it is called as before.
        event_ndim : int
        where : hashable
            Equal for gathers of equal elements.
        """
        known = rules.looked_up(self, gathered, names, event_ndim, where)
        return Tracer._derived(gathered._value, self.reason, known)

    def at_plates(self, event_ndim: int = 0) -> Tracer:
        """The value as a parameter whose values have ``event_ndim`` axes, the plates being those before.

        Sources that its plates do not read place by place (``x[0]``) are read all over (``x[*]``).
        """
        kept = not self.claims.places or self.claims.behind in (event_ndim, self.ndim)
        known = rules.after_cast(self, True) if kept else rules.after_mixing([self])
        return Tracer._derived(self._value, self.reason, known)

    # ---- copies and other types ----------------------------------------------------------------

    def copy(self) -> Any:
        return Tracer._derived(self._value, self.reason, rules.after_cast(self, True))

    view = copy

    def astype(self, dtype: Any, *args: Any, **kwargs: Any) -> Any:
        kept = np.dtype(dtype) == np.float64
        reason = self.reason or (None if kept else f"astype({np.dtype(dtype).name})")
        known = rules.after_cast(self, kept and self._value.dtype.kind in "fiub")
        return Tracer._derived(self._value.astype(dtype), reason, known)

    def _refuse(self, what: str) -> TypeError:
        names = ", ".join(sorted(self.sources))
        return TypeError(
            f"it asks for {what} of {names}, where only NumPy operations can be followed"
        )


# ---- private ------------------------------------------------------------------------------------


def _wrapped(result: Any, reason: str | None, known: tuple[frozenset[str], Claims]) -> Any:
    if isinstance(result, (list, tuple)):
        return type(result)(_wrapped(r, reason, known) for r in result)
    if reason is None and np.asarray(result).dtype not in (np.float64, np.complex128):
        reason = "numbers that round or wrap"
    return Tracer._derived(result, reason, known)


def _holds_traced(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and bool(stand_ins(value))
