"""The stand-in for an array: what NumPy does to it becomes an expression.

References
----------
Interception by ``__array_ufunc__`` and ``__array_function__``: NumPy enhancement proposals 13 and 18.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import SimpleNamespace
from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import graph
from bayesmc.expression.bounds import counted_from_end, within
from bayesmc.expression.functions import applied, expression_of, of_function
from bayesmc.expression.graph import Expression
from bayesmc.shapes import Shape
from bayesmc.states import label_code
from bayesmc.tracing.arraylike import SHAPE_FUNCTIONS, ArrayLike
from bayesmc.tracing.standin import is_foreign, leaves

#: what was refused since tracing began: a function may swallow the error
_REFUSED: ContextVar[list[str] | None] = ContextVar("refused", default=None)


class TracedArray(ArrayLike):
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

    def __len__(self) -> int:
        if not self.shape:
            raise TypeError("len() of unsized object")
        return self.shape[0]

    def __iter__(self) -> Any:
        return (self[k] for k in range(len(self)))

    # ---- what NumPy does to it -----------------------------------------------------------------

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if any(is_foreign(x) for x in inputs):
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
        every = leaves([args, list(kwargs.values())])
        if any(is_foreign(x) for x in every):
            return NotImplemented
        if func in SHAPE_FUNCTIONS:
            return func(*_shapes(args), **kwargs)
        if func is np.isin and isinstance(args[0], TracedStates):
            return args[0].isin(np.ravel(np.asarray(args[1], dtype=object)).tolist(), **kwargs)
        result = _noted(of_function, func, args, kwargs)
        return _labelled(func, args, every, result)

    def __getitem__(self, key: Any) -> Any:
        return TracedArray(_noted_plain(_indexed, self.expression, key))

    def __setitem__(self, key: Any, value: Any) -> None:
        if not self._writable:
            raise ValueError("assignment destination is read-only")
        self.expression = _noted_plain(_assigned, self.expression, key, value)

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

    def clip(self, *args: Any, **kwargs: Any) -> Any:
        return np.clip(self, *args, **kwargs)

    def std(self, *args: Any, **kwargs: Any) -> Any:
        return np.std(self, *args, **kwargs)

    def var(self, *args: Any, **kwargs: Any) -> Any:
        return np.var(self, *args, **kwargs)

    def max(self, *args: Any, **kwargs: Any) -> Any:
        return np.max(self, *args, **kwargs)

    def min(self, *args: Any, **kwargs: Any) -> Any:
        return np.min(self, *args, **kwargs)

    def prod(self, *args: Any, **kwargs: Any) -> Any:
        return np.prod(self, *args, **kwargs)

    def any(self, *args: Any, **kwargs: Any) -> Any:
        return np.any(self, *args, **kwargs)

    def all(self, *args: Any, **kwargs: Any) -> Any:
        return np.all(self, *args, **kwargs)

    def repeat(self, *args: Any, **kwargs: Any) -> Any:
        return np.repeat(self, *args, **kwargs)

    def round(self, *args: Any, **kwargs: Any) -> Any:
        return np.round(self, *args, **kwargs)

    # ---- what would show the numbers -----------------------------------------------------------

    def _refuse(self, what: str) -> Exception:
        names = ", ".join(sorted(self.expression.leaves)) or "a constant"
        return refused(
            f"it asks for {what} of {names}, where only NumPy operations can be followed"
        )

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.array(self._known("a plain array"), dtype)

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


# ---- private ------------------------------------------------------------------------------------

#: functions that move elements about, so that labels survive
_KEEPING = frozenset(
    (
        np.stack, np.concatenate, np.vstack, np.hstack, np.broadcast_to, np.broadcast_arrays,
        np.copy, np.reshape, np.ravel, np.transpose, np.squeeze, np.expand_dims, np.moveaxis,
        np.swapaxes, np.repeat, np.tile, np.take, np.take_along_axis, np.flip, np.roll,
        np.atleast_1d, np.atleast_2d, np.where,
    )
)  # fmt: skip


def _noted(function: Any, *args: Any) -> Any:
    """What a call makes, as stand-ins; a refusal is remembered."""
    return _wrapped(_noted_plain(function, *args))


def _noted_plain(function: Any, *args: Any) -> Any:
    try:
        return function(*args)
    except TraceError as error:
        raise refused(str(error)) from error


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
    moved = leaves(args[0]) if joins else [args[0]]
    if func in (np.where, np.broadcast_arrays):
        moved = list(args[1:] if func is np.where else args)
    states = {x.states for x in moved if isinstance(x, TracedStates)}
    if len(states) != 1 or not all(isinstance(x, TracedStates) for x in moved):
        return result
    (labels,) = states
    if isinstance(result, (list, tuple)):
        return type(result)(TracedStates(r, labels) for r in result)
    return TracedStates(result, labels)


def _indexed(value: Expression, key: Any) -> Expression:
    """``value[key]``."""
    keys = [_plain_key(k) for k in (key if isinstance(key, tuple) else (key,))]
    if not any(isinstance(k, Expression) for k in keys):
        at = np.arange(value.size).reshape(value.shape)[tuple(keys)]
        return graph.pick([value], at)
    if not isinstance(value, graph.Constant):
        raise TraceError(
            "an array that varies is indexed by one that varies: gather along a plate, or use "
            "np.take_along_axis"
        )
    computed = [n for n, k in enumerate(keys) if isinstance(k, Expression)]
    lead = keys[: computed[-1] + 1]
    if any(not isinstance(k, (Expression, int, np.integer)) for k in lead):
        raise TraceError("a computed index stands behind a slice")
    rows: Any = 0
    for n, k in enumerate(lead):
        size = value.shape[n]
        at = graph.as_expression(k)
        if at.dtype.kind != "i":
            raise TraceError("an index that is not a whole number")
        at = within(counted_from_end(at, size), size)
        rows = graph.elementwise(np.add, graph.elementwise(np.multiply, rows, size), at)
    rest = value.shape[len(lead) :]
    table = graph.reshape(value, (-1, *rest)) if value.size else value
    found = graph.gather(table, rows)
    left = tuple(keys[len(lead) :])
    if not left:
        return found
    at = np.arange(found.size).reshape(found.shape)
    return graph.pick([found], at[(slice(None),) * len(rows.shape) + left])


def _assigned(value: Expression, key: Any, new: Any) -> Expression:
    """The array after ``value[key] = new``."""
    keys = tuple(_plain_key(k) for k in (key if isinstance(key, tuple) else (key,)))
    if any(isinstance(k, Expression) for k in keys):
        raise TraceError("an array is written to at places that vary")
    at = np.arange(value.size).reshape(value.shape)
    places = at[keys]
    given = graph.broadcast(graph.cast(expression_of(new), value.dtype), places.shape)
    at = at.copy()
    at[keys] = value.size + np.arange(given.size).reshape(given.shape)
    return graph.pick([value, given], at)


def _plain_key(key: Any) -> Any:
    """A key as NumPy takes it, or the expression that it is."""
    if isinstance(key, TracedArray):
        known = key.expression
        return known.value if isinstance(known, graph.Constant) else known
    if isinstance(key, list) and any(isinstance(k, TracedArray) for k in leaves(key)):
        raise TraceError("an index is a list that varies")
    return key
