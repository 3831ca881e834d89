"""Tracing: what a function does to some of its arguments, found by calling it once with stand-ins.

A ``Tracer`` behaves like the array it stands for and remembers whether it is still an affine function
of the traced values. Detection is sound and incomplete: every operation that is not known to keep a value
affine makes it "not affine", with the operation as the reason, and whatever would let a function look at
the numbers (``if``, ``float``, iteration, ``out=``) raises. Coefficients are not kept here: whoever needs
them calls the function itself. This room knows NumPy only, neither nodes nor distributions.

References
----------
Interception by ``__array_ufunc__`` and ``__array_function__``: NumPy enhancement proposals 13 and 18.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from bayesmc.shapes import Shape

#: ufuncs that are affine in all arguments together
_ADDITIVE = frozenset((np.add, np.subtract, np.negative, np.positive))
#: ufuncs that are affine in each argument while the other is constant
_BILINEAR = frozenset((np.multiply, np.matmul, np.matvec, np.vecmat, np.vecdot))
#: functions that are linear in their first argument (an array, or a sequence of arrays)
_LINEAR_FUNCTIONS = frozenset(
    (
        np.sum, np.mean, np.average, np.cumsum, np.diff, np.trace, np.diagonal,
        np.stack, np.concatenate, np.vstack, np.hstack, np.dstack, np.column_stack, np.broadcast_to,
        np.copy, np.reshape, np.ravel, np.transpose, np.matrix_transpose, np.squeeze, np.expand_dims,
        np.moveaxis, np.swapaxes, np.rollaxis, np.repeat, np.tile, np.take, np.take_along_axis,
        np.flip, np.roll, np.atleast_1d, np.atleast_2d, np.atleast_3d, np.triu, np.tril, np.diag,
        np.array_split, np.split, np.real,
    )
)  # fmt: skip
_BILINEAR_FUNCTIONS = frozenset((np.dot, np.inner, np.outer, np.tensordot, np.kron, np.convolve))
#: functions that hand numbers to callbacks or files
_SHOWING = frozenset(
    (np.apply_along_axis, np.apply_over_axes, np.piecewise, np.save, np.savez, np.savetxt)
)
#: functions of an array's shape alone
_SHAPE_FUNCTIONS = frozenset((np.shape, np.ndim, np.size, np.zeros_like, np.ones_like))


class Tracer(NDArrayOperatorsMixin):
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
        self._value = _locked(np.asarray(value))
        self.sources = frozenset(sources)
        self.reason = reason
        self.margin = margin

    @property
    def is_affine(self) -> bool:
        """Whether it is proved to be an affine function of its sources jointly."""
        return self.reason is None

    @property
    def example(self) -> np.ndarray:
        """The value of what it stands for at the example's values (for who traces, not for functions)."""
        return self._value

    # ---- what an array tells of itself --------------------------------------------------------

    @property
    def shape(self) -> Shape:
        return self._value.shape

    @property
    def ndim(self) -> int:
        return self._value.ndim

    @property
    def size(self) -> int:
        return self._value.size

    @property
    def dtype(self) -> np.dtype:
        return self._value.dtype

    @property
    def flags(self) -> SimpleNamespace:
        return SimpleNamespace(writeable=False)

    @property
    def T(self) -> Any:  # noqa: N802
        return np.transpose(self)

    @property
    def mT(self) -> Any:  # noqa: N802
        return np.matrix_transpose(self)

    def __repr__(self) -> str:
        state = "affine" if self.is_affine else f"not affine after {self.reason}"
        return f"Tracer({', '.join(sorted(self.sources))}; shape {self.shape}, {state})"

    # ---- what NumPy does to it ---------------------------------------------------------------

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if any(_is_foreign(x) for x in inputs):
            return NotImplemented
        if method == "at" or "out" in kwargs or isinstance(kwargs.get("where", True), Tracer):
            raise TypeError("a parent is read-only: write x = x + 1, not x += 1, and use no out=")
        values = [_bare(x) for x in inputs]
        traced = [x for x in _leaves(list(inputs)) if isinstance(x, Tracer)]
        with np.errstate(all="ignore"):
            result = getattr(ufunc, method)(*values, **kwargs)
        reason = next((t.reason for t in traced if t.reason), None)
        if reason is None and not _keeps_affine(ufunc, method, inputs, kwargs):
            reason = f"np.{ufunc.__name__}"
        wrapped = _wrapped(result, traced, reason)
        if method == "__call__" and not kwargs and ufunc in _EVENTS:
            wrapped.margin = _EVENTS[ufunc](*inputs)
        return wrapped

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if any(_is_foreign(x) for x in _leaves([args, list(kwargs.values())])):
            return NotImplemented
        if func in _SHOWING:
            raise self._refuse(f"np.{func.__name__}")
        with np.errstate(all="ignore"):
            result = func(*_bare(args), **{k: _bare(v) for k, v in kwargs.items()})
        if func in _SHAPE_FUNCTIONS:
            return result
        traced = [x for x in _leaves([args, list(kwargs.values())]) if isinstance(x, Tracer)]
        reason = next((t.reason for t in traced if t.reason), None)
        if reason is None and not _function_keeps_affine(func, args, kwargs):
            reason = f"np.{func.__name__}"
        return _wrapped(result, traced, reason)

    def __getitem__(self, key: Any) -> Any:
        keys = [x for x in _leaves(key) if isinstance(x, Tracer)]
        if keys:
            sources = self.sources.union(*(k.sources for k in keys))
            return Tracer(self._value[_bare(key)], sources, "an index")
        margin = None if self.margin is None else self.margin[key]
        return Tracer(self._value[key], self.sources, self.reason, margin)

    # ---- methods of arrays -------------------------------------------------------------------

    def transpose(self, *axes: Any) -> Any:
        order = axes[0] if len(axes) == 1 and not isinstance(axes[0], int) else axes or None
        return np.transpose(self, order)

    def reshape(self, *shape: Any) -> Any:
        wanted = shape[0] if len(shape) == 1 and not isinstance(shape[0], int) else shape
        return np.reshape(self, wanted)

    def sum(self, *args: Any, **kwargs: Any) -> Any:
        return np.sum(self, *args, **kwargs)

    def mean(self, *args: Any, **kwargs: Any) -> Any:
        return np.mean(self, *args, **kwargs)

    def cumsum(self, *args: Any, **kwargs: Any) -> Any:
        return np.cumsum(self, *args, **kwargs)

    def dot(self, other: Any) -> Any:
        return np.dot(self, other)

    def take(self, indices: Any, axis: int | None = None) -> Any:
        return np.take(self, indices, axis=axis)

    def squeeze(self, axis: Any = None) -> Any:
        return np.squeeze(self, axis=axis)

    def swapaxes(self, first: int, second: int) -> Any:
        return np.swapaxes(self, first, second)

    def ravel(self) -> Any:
        return self.reshape(-1)

    flatten = ravel

    def copy(self) -> Any:
        return Tracer(self._value, self.sources, self.reason)

    view = copy

    def astype(self, dtype: Any, *args: Any, **kwargs: Any) -> Any:
        kept = np.dtype(dtype) == np.float64
        reason = self.reason or (None if kept else f"astype({np.dtype(dtype).name})")
        return Tracer(self._value.astype(dtype), self.sources, reason)

    # ---- what would show the numbers -----------------------------------------------------------

    def _refuse(self, what: str) -> TypeError:
        names = ", ".join(sorted(self.sources))
        return TypeError(
            f"it asks for {what} of {names}, where only NumPy operations can be followed"
        )

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        raise self._refuse("a plain array")

    def __bool__(self) -> bool:
        raise self._refuse("the truth")

    def __float__(self) -> float:
        raise self._refuse("float()")

    def __int__(self) -> int:
        raise self._refuse("int()")

    def __complex__(self) -> complex:
        raise self._refuse("complex()")

    def __index__(self) -> int:
        raise self._refuse("an index")

    def __iter__(self) -> Any:
        raise self._refuse("iteration")

    def __contains__(self, item: Any) -> bool:
        raise self._refuse("membership")

    def __hash__(self) -> int:
        raise self._refuse("the hash")


@dataclass(frozen=True, eq=False)
class TracedCall:
    """A call that was not made because an argument is traced: what was called, and with what.

    Attributes
    ----------
    function : callable
    arguments : dict
        By name, in the order of the signature.
    """

    function: Callable[..., Any]
    arguments: dict[str, Any]

    @property
    def traced(self) -> dict[str, Any]:
        """The arguments that are traced, or hold something traced."""
        return {name: value for name, value in self.arguments.items() if is_traced(value)}


def is_traced(value: Any) -> bool:
    """Whether a value is traced, or is a sequence that holds something traced."""
    if isinstance(value, (list, tuple)):
        return any(is_traced(v) for v in value)
    return isinstance(value, (Tracer, TracedCall))


# ---- private ------------------------------------------------------------------------------------


def _exceeds(larger: Any, smaller: Any) -> Tracer | None:
    """The margin of ``larger > smaller``."""
    if any(isinstance(x, Tracer) and not x.is_affine for x in _leaves([larger, smaller])):
        return None
    margin = np.subtract(larger, smaller)
    return margin if margin.is_affine else None


def _both(first: Any, second: Any, otherwise: float = -np.inf) -> Tracer | None:
    """The margin of an event joined with a condition on what is not traced."""
    event, condition = (first, second) if isinstance(first, Tracer) else (second, first)
    if isinstance(condition, Tracer) or np.asarray(condition).dtype != bool:
        return None
    margin = event.margin
    if margin is None:
        return None
    kept = condition if otherwise < 0 else ~np.asarray(condition)
    return np.where(kept, margin, otherwise)  # type: ignore[return-value]


def _opposite(event: Any) -> Tracer | None:
    return None if event.margin is None else -event.margin


#: how comparisons, and conditions on them, make the margin of an event
_EVENTS: dict[Any, Callable[..., Tracer | None]] = {
    np.greater: _exceeds,
    np.greater_equal: _exceeds,
    np.less: lambda a, b: _exceeds(b, a),
    np.less_equal: lambda a, b: _exceeds(b, a),
    np.bitwise_and: _both,
    np.logical_and: _both,
    np.bitwise_or: lambda a, b: _both(a, b, np.inf),
    np.logical_or: lambda a, b: _both(a, b, np.inf),
    np.invert: _opposite,
    np.logical_not: _opposite,
}


def _keeps_affine(ufunc: Any, method: str, inputs: Any, kwargs: Any) -> bool:
    if set(kwargs) - {"axis", "axes", "keepdims", "dtype", "initial"} or _narrows(kwargs):
        return False
    if method in ("reduce", "accumulate", "reduceat"):
        return ufunc is np.add and not is_traced(inputs[1:])
    if method not in ("__call__", "outer"):
        return False
    if ufunc in _ADDITIVE:
        return method == "__call__"
    traced = [is_traced(x) for x in inputs]
    if ufunc in _BILINEAR:
        return sum(traced) == 1
    return ufunc is np.true_divide and traced == [True, False]


def _function_keeps_affine(func: Any, args: Any, kwargs: Any) -> bool:
    if any(isinstance(x, Tracer) for x in _leaves(list(kwargs.values()))) or _narrows(kwargs):
        return False
    if any(isinstance(x, (type, np.dtype)) for x in args):
        return False  # a type by place
    if func is np.where:
        return len(args) == 3 and not is_traced(args[0])
    if func is np.broadcast_arrays:
        return True
    if func is np.einsum:
        return sum(map(is_traced, args)) == 1
    if func in _BILINEAR_FUNCTIONS:
        return sum(isinstance(x, Tracer) for x in _leaves(list(args[:2]))) == 1
    rest = [x for x in _leaves(list(args[1:])) if isinstance(x, Tracer)]
    return func in _LINEAR_FUNCTIONS and not rest


def _narrows(kwargs: Any) -> bool:
    """Whether ``dtype=`` asks for numbers that round."""
    dtype = kwargs.get("dtype")
    return dtype is not None and np.dtype(dtype) != np.float64


def _wrapped(result: Any, traced: Any, reason: str | None) -> Any:
    sources = frozenset().union(*(t.sources for t in traced))
    if isinstance(result, (list, tuple)):
        return type(result)(_wrapped(r, traced, reason) for r in result)
    if reason is None and np.asarray(result).dtype not in (np.float64, np.complex128):
        reason = "numbers that round or wrap"
    return Tracer(result, sources, reason)


def _bare(value: Any) -> Any:
    """Numbers in place of what stands for them; arrays of others can be read only, not written to."""
    if isinstance(value, Tracer):
        return value._value
    if isinstance(value, np.ndarray):
        return _locked(value)
    if isinstance(value, (list, tuple)):
        return type(value)(_bare(v) for v in value)
    return value


def _locked(array: np.ndarray) -> np.ndarray:
    """A view that refuses to be written to (asking a broadcast array whether it does makes NumPy warn)."""
    view = array.view()
    view.flags.writeable = False
    return view


def _leaves(value: Any) -> list[Any]:
    if isinstance(value, (list, tuple)):
        return [leaf for v in value for leaf in _leaves(v)]
    return [value]


def _is_foreign(value: Any) -> bool:
    """Whether a value has rules of its own for NumPy, and is no plain array."""
    return (
        not isinstance(value, (np.ndarray, Tracer, np.generic))
        and getattr(value, "__array_ufunc__", None) is not None
    )
