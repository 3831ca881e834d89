"""The stand-in for an array: what NumPy does to it becomes an expression.

References
----------
Interception by ``__array_ufunc__`` and ``__array_function__``: NumPy enhancement proposals 13 and 18.
"""

from __future__ import annotations

import functools
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from bayesmc.errors import TraceError
from bayesmc.expression import graph
from bayesmc.expression.composed import COMPOSED, COMPOSED_OF_SEVERAL
from bayesmc.expression.functions import applied, expression_of, of_function, repeated
from bayesmc.expression.graph import Expression
from bayesmc.expression.indexing import assigned, indexed, within
from bayesmc.shapes import Shape
from bayesmc.states import label_code

#: functions of an array's shape alone
_SHAPE_FUNCTIONS = frozenset((np.shape, np.ndim, np.size, np.zeros_like, np.ones_like))
#: what was refused since tracing began: a function may swallow the error
_REFUSED: ContextVar[list[str] | None] = ContextVar("refused", default=None)


#: functions that move elements about, so that labels survive
_KEEPING = frozenset(
    (
        np.stack, np.concatenate, np.vstack, np.hstack, np.broadcast_to, np.broadcast_arrays,
        np.copy, np.reshape, np.ravel, np.transpose, np.squeeze, np.expand_dims, np.moveaxis,
        np.swapaxes, np.repeat, np.tile, np.take, np.take_along_axis, np.flip, np.roll,
        np.atleast_1d, np.atleast_2d, np.where,
    )
)  # fmt: skip


def _method(function: Callable[..., Any]) -> Any:
    """A NumPy function of an array as a method of it."""

    def method(self: Any, *args: Any, **kwargs: Any) -> Any:
        return function(self, *args, **kwargs)

    return method


class TracedArray(NDArrayOperatorsMixin):
    """Stands for one entry of an array; of a batch, functions do the same to every entry.

    Parameters
    ----------
    expression : Expression
        What it stands for.
    writable : bool
        Whether the function made it, and may write to it.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, leaf
    >>> x = TracedArray(leaf("x", (3,)))
    >>> (np.exp(x[..., 0]) + 1.0).expression
    <Elementwise add ()>
    """

    __slots__ = ("_writable", "expression")

    def __init__(self, expression: Any, writable: bool = False) -> None:
        found = expression.expression if isinstance(expression, TracedArray) else expression
        self.expression: Expression = graph.as_expression(found)
        self._writable = writable

    def __repr__(self) -> str:
        return f"TracedArray({self.expression!r})"

    # ---- what an array tells of itself ---------------------------------------------------------

    @property
    def shape(self) -> Shape:
        return self.expression.shape

    @property
    def ndim(self) -> int:
        return len(self.expression.shape)

    @property
    def size(self) -> int:
        return self.expression.size

    @property
    def dtype(self) -> np.dtype:
        return self.expression.dtype

    @property
    def T(self) -> Any:  # noqa: N802
        return np.transpose(self)

    @property
    def mT(self) -> Any:  # noqa: N802
        return np.matrix_transpose(self)

    def __len__(self) -> int:
        if not self.shape:
            raise TypeError("len() of unsized object")
        return self.shape[0]

    def __iter__(self) -> Any:
        return (self[k] for k in range(len(self)))

    # ---- what NumPy does to it -----------------------------------------------------------------

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if any(_is_foreign(x) for x in inputs):
            return NotImplemented
        (target,) = kwargs.pop("out", (None,))
        if method == "at" or (target is not None and not getattr(target, "_writable", False)):
            raise TypeError("a parent is read-only: write x = x + 1, not x += 1, and use no out=")
        inputs = _with_codes(ufunc, method, inputs)
        result = _noted(applied, ufunc, method, inputs, kwargs)
        if target is None:
            return result
        target.expression = graph.broadcast(
            graph.cast(result.expression, target.dtype), target.shape
        )
        return target

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        every = _leaves([args, list(kwargs.values())])
        if any(_is_foreign(x) for x in every):
            return NotImplemented
        if func in _SHAPE_FUNCTIONS:
            return func(*_shapes(args), **kwargs)
        if func is np.isin and isinstance(args[0], TracedStates):
            return args[0].isin(np.ravel(np.asarray(args[1], dtype=object)).tolist(), **kwargs)
        if func in COMPOSED or func in COMPOSED_OF_SEVERAL:
            found = _composed(func, args, kwargs)
            if found is not NotImplemented:
                return found
        result = _noted(of_function, func, args, kwargs)
        return _labelled(func, args, every, result)

    def __getitem__(self, key: Any) -> Any:
        return TracedArray(_noted_plain(indexed, self.expression, key))

    def __setitem__(self, key: Any, value: Any) -> None:
        if not self._writable:
            raise ValueError("assignment destination is read-only")
        self.expression = _noted_plain(lambda: assigned(self.expression, key, expression_of(value)))

    # ---- copies and other types ----------------------------------------------------------------

    @property
    def flags(self) -> SimpleNamespace:
        return SimpleNamespace(writeable=self._writable)

    def within(self, size: int) -> TracedArray:
        """The same as an index along a plate of this size; another is an error once it is looked up."""
        return TracedArray(within(self.expression, size))

    def copy(self) -> Any:
        return TracedArray(self.expression, True)

    def view(self, *kind: Any) -> Any:
        return TracedArray(self.expression)

    def astype(self, dtype: Any, *args: Any, **kwargs: Any) -> TracedArray:
        return TracedArray(_noted_plain(graph.cast, self.expression, dtype), True)

    # ---- methods of arrays that are NumPy functions --------------------------------------------

    def transpose(self, *axes: Any) -> Any:
        order = axes[0] if len(axes) == 1 and not isinstance(axes[0], int) else axes or None
        return np.transpose(self, order)

    def reshape(self, *shape: Any) -> Any:
        wanted = shape[0] if len(shape) == 1 and not isinstance(shape[0], int) else shape
        return np.reshape(self, wanted)

    def ravel(self) -> Any:
        return self.reshape(-1)

    flatten = ravel

    sum, mean, prod = (_method(f) for f in (np.sum, np.mean, np.prod))
    cumsum, cumprod = (_method(f) for f in (np.cumsum, np.cumprod))
    std, var, max, min = (_method(f) for f in (np.std, np.var, np.max, np.min))
    any, all, clip, round = (_method(f) for f in (np.any, np.all, np.clip, np.round))
    dot, take, repeat = (_method(f) for f in (np.dot, np.take, np.repeat))
    squeeze, swapaxes = (_method(f) for f in (np.squeeze, np.swapaxes))

    # ---- what would show the numbers -----------------------------------------------------------

    def _refuse(self, what: str) -> Exception:
        names = ", ".join(sorted(self.expression.leaves)) or "a constant"
        return refused(
            f"it asks for {what} of {names}, where only NumPy operations can be followed"
        )

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.array(self._known("a plain array"), dtype)

    def __complex__(self) -> complex:
        raise self._refuse("complex()")

    def __contains__(self, item: Any) -> bool:
        raise self._refuse("membership")

    def __bool__(self) -> bool:
        return bool(self._known("the truth (if, and, or, not)"))

    def __float__(self) -> float:
        return float(self._known("float()"))

    def __int__(self) -> int:
        return int(self._known("int()"))

    def __index__(self) -> int:
        return self._known("an index").__index__()

    def __hash__(self) -> int:
        raise self._refuse("the hash")

    def _known(self, what: str) -> np.ndarray:
        if isinstance(self.expression, graph.Constant):
            return self.expression.value
        raise self._refuse(what)


class TracedStates(TracedArray):
    """Stands for positions of labelled states, which compare with labels."""

    __slots__ = ("states",)

    def __init__(self, expression: Any, states: tuple[Any, ...]) -> None:
        super().__init__(expression, False)
        self.states = tuple(states)

    @property
    def codes(self) -> TracedArray:
        """The positions as numbers."""
        return TracedArray(self.expression)

    def isin(self, labels: Any, **kwargs: Any) -> Any:
        """Whether each element is one of ``labels``."""
        return np.isin(self.codes, [label_code(self.states, label) for label in labels], **kwargs)

    def __getitem__(self, key: Any) -> Any:
        return TracedStates(super().__getitem__(key), self.states)

    def copy(self) -> Any:
        return TracedStates(self.expression, self.states)


@dataclass(frozen=True, eq=False)
class TracedCall:
    """A call that was not made because an argument is a stand-in: what was called, and with what.

    Attributes
    ----------
    function : callable
    arguments : dict
        By name, in the order of the signature.
    """

    function: Callable[..., Any]
    arguments: dict[str, Any]


def is_traced(value: Any) -> bool:
    """Whether a value is a stand-in, or is a sequence that holds one."""
    if isinstance(value, (list, tuple)):
        return any(map(is_traced, value))
    return isinstance(value, (TracedArray, TracedCall))


@contextmanager
def refusals() -> Iterator[list[str]]:
    """What is refused meanwhile."""
    found: list[str] = []
    token = _REFUSED.set(found)
    try:
        yield found
    finally:
        _REFUSED.reset(token)


def refused(why: str) -> TraceError:
    """The error for what cannot be followed, which is remembered, too."""
    noted = _REFUSED.get()
    if noted is not None:
        noted.append(why)
    return TraceError(why)


def as_one_call(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method of a frozen object that broadcasts over leading axes, to be called again as it stands.

    Of stand-ins it makes one ``Call``, which has no derivative unless its result is of whole numbers;
    of arrays it is the method.

    Examples
    --------
    >>> from bayesmc.expression import TracedArray, as_one_call, leaf
    >>> class Steps:
    ...     @as_one_call
    ...     def of(self, x):
    ...         return (x > 0).astype(int) if x.any() else 0 * x.astype(int)
    >>> Steps().of(TracedArray(leaf("x", (3,)))).expression
    <Call of (3,)>
    """

    @functools.wraps(method)
    def called(self: Any, *args: Any) -> Any:
        if any(isinstance(a, TracedArray) for a in args):
            # two bound methods are equal where they are of one object
            return TracedArray(repeated(types.MethodType(method, self), args, {}))
        return method(self, *args)

    return called


# ---- private ------------------------------------------------------------------------------------


def _leaves(value: Any) -> list[Any]:
    """What lists and tuples hold, however deep."""
    if isinstance(value, (list, tuple)):
        return [leaf for v in value for leaf in _leaves(v)]
    return [value]


def _is_foreign(value: Any) -> bool:
    """Whether a value has rules of its own for NumPy, and is no plain array."""
    if isinstance(value, np.ma.MaskedArray):
        return True  # masked entries are not what was computed
    known = isinstance(value, (np.ndarray, TracedArray, np.generic))
    return not known and getattr(value, "__array_ufunc__", None) is not None


def _noted(function: Any, *args: Any) -> Any:
    """What a call makes, as stand-ins; a refusal is remembered."""
    return _wrapped(_noted_plain(function, *args))


def _noted_plain(function: Any, *args: Any) -> Any:
    try:
        return function(*args)
    except TraceError as error:
        raise refused(str(error)) from error


def _composed(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """What a function makes that is said in terms of others."""
    try:
        if func in COMPOSED_OF_SEVERAL:
            return COMPOSED_OF_SEVERAL[func](*args, **kwargs)
        first, *rest = args
        return COMPOSED[func](TracedArray(expression_of(first)), *rest, **kwargs)
    except (TypeError, ValueError) as error:
        raise refused(f"np.{func.__name__}: {error}") from error


def _wrapped(result: Any) -> Any:
    if isinstance(result, Expression):
        return TracedArray(result, True)
    if isinstance(result, (list, tuple)):
        return type(result)(_wrapped(r) for r in result)
    return result


def _shapes(value: Any) -> Any:
    """Arrays of the shapes of what stands for them."""
    if isinstance(value, TracedArray):
        return np.broadcast_to(np.zeros((), value.dtype), value.shape)
    if isinstance(value, (list, tuple)):
        return type(value)(_shapes(v) for v in value)
    return value


def _with_codes(ufunc: Any, method: str, inputs: tuple[Any, ...]) -> tuple[Any, ...]:
    """Labels as the positions that they are compared with."""
    if not any(_is_label(x) or isinstance(x, TracedStates) for x in inputs):
        return inputs
    compares = ufunc in (np.equal, np.not_equal) and method == "__call__"
    states = [x.states for x in inputs if isinstance(x, TracedStates)]
    if not compares or not states:
        if any(map(_is_label, inputs)):
            raise refused("numbers are compared with a label")
        return inputs
    if len(set(states)) > 1:  # positions over the first one's states
        first, second = inputs
        at = {s: k for k, s in enumerate(first.states)}
        table = np.array([at.get(s, -1) for s in second.states])
        return first, graph.gather(graph.constant(table), second.expression)
    return tuple(_code(x, states[0]) if _is_label(x) else x for x in inputs)


def _is_label(value: Any) -> bool:
    if isinstance(value, (str, tuple)):
        return True
    return (
        isinstance(value, (list, np.ndarray, np.generic)) and np.asarray(value).dtype.kind in "USO"
    )


def _code(value: Any, states: tuple[Any, ...]) -> Any:
    if isinstance(value, str) or (isinstance(value, tuple) and value in states):
        return label_code(states, value)
    labels = np.asarray(value, dtype=object)
    codes = [label_code(states, label) for label in labels.ravel().tolist()]
    return np.array(codes, dtype=int).reshape(labels.shape)


def _labelled(func: Any, args: Any, every: list[Any], result: Any) -> Any:
    """Labels for what moves labelled positions about."""
    if func not in _KEEPING or not any(isinstance(x, TracedStates) for x in every):
        return result
    joins = func in (np.stack, np.concatenate, np.vstack, np.hstack)
    moved = _leaves(args[0]) if joins else [args[0]]
    if func in (np.where, np.broadcast_arrays):
        moved = list(args[1:] if func is np.where else args)
    states = {x.states for x in moved if isinstance(x, TracedStates)}
    if len(states) != 1 or not all(isinstance(x, TracedStates) for x in moved):
        return result
    (labels,) = states
    if isinstance(result, (list, tuple)):
        return type(result)(TracedStates(r, labels) for r in result)
    return TracedStates(result, labels)
