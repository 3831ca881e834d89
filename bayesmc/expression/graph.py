"""The expression graph: what a function computes, as few kinds of nodes.

Everything is a leaf, a constant, an element-wise function, a pick of elements at constant positions (all
of reshape, stack, slices and transposes), a gather at computed ones, a reduction, or a call of a function
that is none of these. Shapes are those of one entry, plates and event: a batch is added in front by
whoever evaluates, which is right because functions broadcast over it. Equal expressions are one object,
and what depends on no leaf is a constant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from operator import is_
from threading import Lock
from typing import Any
from weakref import WeakValueDictionary

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.shapes import Shape

#: entries up to which what depends on no leaf is computed at once
_FOLDED = 1 << 22


class Expression:
    """A value of one entry.

    Attributes
    ----------
    operands : tuple of Expression
    shape : tuple of int
    dtype : numpy.dtype
        ``float64``, ``int64`` or ``bool``.
    leaves : frozenset of str
        Names of the leaves it depends on.
    content : tuple
        What tells it from others with the same operands.
    """

    __slots__ = ("__weakref__", "content", "dtype", "leaves", "operands", "shape")

    operands: tuple[Expression, ...]
    shape: Shape
    dtype: np.dtype
    leaves: frozenset[str]
    content: tuple

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    @property
    def detail(self) -> str:
        """What it does, in a word."""
        if isinstance(self, (Pick, Gather)):
            return ""
        if isinstance(self, Constant):
            return np.array2string(self.value, threshold=4, precision=4)
        return getattr(self.content[0], "__name__", "") or str(self.content[0])

    def with_operands(self, operands: Sequence[Expression]) -> Expression:
        """The same operation on others of the same shapes; itself where they are its own."""
        return self if all(map(is_, operands, self.operands)) else self._on(operands)

    def _on(self, operands: Sequence[Expression]) -> Expression:
        raise NotImplementedError

    def __repr__(self) -> str:
        detail = self.detail
        return f"<{type(self).__name__}{' ' + detail if detail else ''} {self.shape}>"


class Leaf(Expression):
    """A value that is given: a node's, as it is stored.

    Attributes
    ----------
    name : str
    states : int or None
        It is one of the positions 0, 1, ... below this number.
    """

    __slots__ = ("name", "states")
    name: str
    states: int | None


class Constant(Expression):
    """A value that is known."""

    __slots__ = ("value",)
    value: np.ndarray


class Elementwise(Expression):
    """A function of the operands' elements, which broadcast: a ufunc, ``np.where``, or a cast."""

    __slots__ = ("function",)
    function: Callable[..., np.ndarray]

    def _on(self, operands: Sequence[Expression]) -> Expression:
        return elementwise(self.function, *operands)


class Pick(Expression):
    """Elements of the operands, laid out flat one after the other, at constant positions."""

    __slots__ = ("positions",)
    positions: np.ndarray

    def _on(self, operands: Sequence[Expression]) -> Expression:
        return pick(operands, self.positions)


class Gather(Expression):
    """Entries of a table along its first axis, at computed positions."""

    __slots__ = ()

    @property
    def table(self) -> Expression:
        return self.operands[0]

    @property
    def rows(self) -> Expression:
        return self.operands[1]

    def _on(self, operands: Sequence[Expression]) -> Expression:
        return gather(*operands)


class Reduction(Expression):
    """A ufunc's reduction along some axes, which are gone."""

    __slots__ = ("axes", "ufunc")
    ufunc: np.ufunc
    axes: tuple[int, ...]

    def _on(self, operands: Sequence[Expression]) -> Expression:
        return reduction(self.ufunc, operands[0], self.axes)


class Call(Expression):
    """A function of whole arrays that is called again as it was: ``np.linalg.solve``, ``np.interp``."""

    __slots__ = ("call",)
    call: Any

    def _on(self, operands: Sequence[Expression]) -> Expression:
        return call(self.call, operands)


def leaf(name: str, shape: Shape, dtype: Any = float, states: int | None = None) -> Leaf:
    """A value that is given; with ``states``, a position below that number.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import elementwise, leaf
    >>> x = leaf("x", (3,))
    >>> elementwise(np.exp, x), elementwise(np.exp, x) is elementwise(np.exp, x)
    (<Elementwise exp (3,)>, True)
    """
    own = {"name": name, "states": states, "leaves": frozenset((name,))}
    return _interned(Leaf, (), (name, states), shape, np.dtype(dtype), **own)


def constant(value: Any) -> Constant:
    """A known value; numbers that are neither real, whole nor true are refused."""
    array = np.asarray(value)
    dtype = _standard(array.dtype)
    array = np.array(array, dtype)  # its own, in C order
    array.flags.writeable = False
    return _interned(Constant, (), _content(array), array.shape, dtype, value=array)


def elementwise(function: Any, *operands: Any) -> Expression:
    """A ufunc, ``np.where`` or a cast of expressions or numbers, element by element."""
    args = tuple(map(as_expression, operands))
    if function in (np.positive, np.conjugate):
        return args[0]
    if function in CASTS and CASTS[function] == args[0].dtype:  # a dtype equals None, too
        return args[0]
    shape = np.broadcast_shapes(*(a.shape for a in args))
    dtype = _dtype_of(function, *(a.dtype for a in args))
    if all(isinstance(a, Constant) for a in args) and math.prod(shape) <= _FOLDED:
        with np.errstate(all="ignore"):
            return constant(function(*(a.value for a in args)))  # type: ignore[attr-defined]
    return _interned(Elementwise, args, (function,), shape, dtype, function=function)


def as_float(x: Any) -> np.ndarray:
    """Numbers as real ones."""
    return np.asarray(x).astype(float)


def as_int(x: Any) -> np.ndarray:
    """Numbers as whole ones, cut towards zero."""
    return np.asarray(x).astype(np.int64)


def as_bool(x: Any) -> np.ndarray:
    """Whether numbers differ from zero."""
    return np.asarray(x).astype(bool)


#: functions that change the type alone
CASTS: dict[Any, np.dtype] = {
    as_float: np.dtype(float),
    as_int: np.dtype(np.int64),
    as_bool: np.dtype(bool),
}


def cast(value: Any, dtype: Any) -> Expression:
    """The same numbers in another type."""
    wanted = _standard(np.dtype(dtype))
    if wanted != np.dtype(dtype) and np.dtype(dtype).kind not in "iu":
        raise TraceError(f"it asks for numbers of type {np.dtype(dtype)}")
    return elementwise(next(f for f, d in CASTS.items() if d == wanted), value)


def pick(operands: Sequence[Any], positions: Any) -> Expression:
    """Elements of the operands at flat positions, the second operand's behind the first's, and so on."""
    args = tuple(map(as_expression, operands))
    at = np.asarray(positions, np.intp)
    args, at = _used(args, at)
    if not args:  # nothing is picked
        types = {as_expression(a).dtype for a in operands}
        return constant(np.zeros(at.shape, np.result_type(*types)))
    if len(args) == 1:
        (arg,) = args
        if at.shape == arg.shape and (at.reshape(-1) == np.arange(at.size)).all():
            return arg
        if isinstance(arg, Pick):
            return pick(arg.operands, arg.positions.reshape(-1)[at])
    if all(isinstance(a, Constant) for a in args):
        flat = np.concatenate([a.value.reshape(-1) for a in args])  # type: ignore[attr-defined]
        return constant(flat[at])
    inner = [a for a in args if isinstance(a, Pick) and a.operands == args[0].operands]
    if len(inner) == len(args):  # parts of one array, put together again
        return pick(inner[0].operands, np.concatenate([a.positions.reshape(-1) for a in inner])[at])
    dtype = _standard(np.result_type(*(a.dtype for a in args)))
    at = np.array(at, order="C")
    at.flags.writeable = False
    return _interned(Pick, args, _content(at), at.shape, dtype, positions=at)


def reshape(value: Any, shape: Shape) -> Expression:
    """The same elements in another shape."""
    node = as_expression(value)
    if node.shape == shape:
        return node
    return pick([node], np.arange(node.size).reshape(shape))


def broadcast(value: Any, shape: Shape) -> Expression:
    """An expression in the shape that it broadcasts to."""
    node = as_expression(value)
    if node.shape == shape:
        return node
    return pick([node], np.broadcast_to(np.arange(node.size).reshape(node.shape), shape))


def gather(table: Any, rows: Any) -> Expression:
    """Entries of a table along its first axis: shape ``(*rows, *rest of the table)``.

    Rows below zero or beyond the table are an error when it is evaluated, or here if they are known.
    """
    values, at = as_expression(table), as_expression(rows)
    if not values.shape or at.dtype.kind not in "ib":
        raise TraceError("entries of a table are picked by whole numbers")
    if isinstance(at, Constant):
        if at.size and (at.value.min() < 0 or at.value.max() >= values.shape[0]):
            raise TraceError(f"an index is outside of 0..{values.shape[0] - 1}")
        block = values.size // values.shape[0] if values.shape[0] else 0
        first = at.value.reshape(at.shape + (1,) * (len(values.shape) - 1)) * block
        return pick([values], first + np.arange(block).reshape(values.shape[1:]))
    return _interned(Gather, (values, at), (), at.shape + values.shape[1:], values.dtype)


def reduction(ufunc: np.ufunc, operand: Any, axes: Sequence[int]) -> Expression:
    """A reduction along some axes, ``np.add`` for a sum; without axes, the operand."""
    arg = as_expression(operand)
    along = tuple(sorted({a + len(arg.shape) if a < 0 else a for a in axes}))
    if any(not 0 <= a < len(arg.shape) for a in along):
        raise TraceError(
            f"np.{ufunc.__name__}: axes {tuple(axes)} of an array of shape {arg.shape}"
        )
    if not along:
        return arg
    shape = tuple(n for k, n in enumerate(arg.shape) if k not in along)
    if isinstance(arg, Constant):
        with np.errstate(all="ignore"):
            return constant(ufunc.reduce(arg.value, axis=along))
    dtype = _standard(ufunc.reduce(np.ones(1, arg.dtype)).dtype)
    return _interned(Reduction, (arg,), (ufunc, along), shape, dtype, ufunc=ufunc, axes=along)


def call(
    function: Any, operands: Sequence[Any], shape: Shape | None = None, dtype: Any = None
) -> Expression:
    """A call that is repeated as it was.

    Parameters
    ----------
    function : callable
        Of the operands' arrays, with batch axes in front of each when it is evaluated. Equal and hashable
        where it does the same.
    operands : sequence of Expression
    shape, dtype : optional
        Of the result; without them the function is tried on ones.
    """
    args = tuple(map(as_expression, operands))
    if shape is None or dtype is None:
        known = [a.value if isinstance(a, Constant) else sample(a) for a in args]
        with np.errstate(all="ignore"):
            tried = np.asarray(function(*known))
        if all(isinstance(a, Constant) for a in args):
            return constant(tried)
        shape, dtype = tried.shape, tried.dtype
    standard = _standard(np.dtype(dtype))
    return _interned(Call, args, (function,), shape, standard, call=function)


def as_expression(value: Any) -> Expression:
    """An expression as it is, anything else as a constant."""
    return value if isinstance(value, Expression) else constant(value)


def ordered(*roots: Expression) -> list[Expression]:
    """All expressions below some, operands first."""
    found: dict[Expression, None] = {}
    todo: list[tuple[Expression, bool]] = [(r, False) for r in reversed(roots)]
    while todo:
        node, is_done = todo.pop()
        if node in found:
            continue
        if is_done:
            found[node] = None
        else:
            todo.append((node, True))
            todo += [(a, False) for a in reversed(node.operands) if a not in found]
    return list(found)


def replaced(root: Expression, values: dict[Expression, Expression]) -> Expression:
    """The expression with others in place of some that it is made of."""
    found: dict[Expression, Expression] = {}
    for node in ordered(root):
        found[node] = values.get(node) or node.with_operands([found[a] for a in node.operands])
    return found[root]


def substituted(root: Expression, values: dict[str, Expression]) -> Expression:
    """The expression with others in place of some leaves, by name."""
    if not root.leaves & set(values):
        return root
    of: dict[Expression, Expression] = {
        n: values[n.name] for n in ordered(root) if isinstance(n, Leaf) and n.name in values
    }
    return replaced(root, of)


def sample(arg: Expression) -> np.ndarray:
    """Numbers that most functions take: a matrix of them is positive definite."""
    value = np.ones(arg.shape, arg.dtype)
    if arg.dtype.kind == "f" and len(arg.shape) > 1 and arg.shape[-1] == arg.shape[-2]:
        value = value + np.eye(arg.shape[-1])
    return value


# ---- private ------------------------------------------------------------------------------------

_TABLE: WeakValueDictionary[tuple, Expression] = WeakValueDictionary()
_ONE_AT_A_TIME = Lock()


def _interned(
    kind: Any,
    operands: tuple[Expression, ...],
    what: tuple,
    shape: Shape,
    dtype: np.dtype,
    **own: Any,
) -> Any:
    """The one object for an expression: whole before another thread can meet it, and one for all threads."""
    key = (kind, operands, what, shape, dtype)
    found = _TABLE.get(key)
    if found is None:
        made = kind.__new__(kind)
        made.operands, made.shape, made.dtype = operands, shape, dtype
        made.leaves, made.content = _union(operands), what
        for name, value in own.items():
            setattr(made, name, value)
        with _ONE_AT_A_TIME:
            found = _TABLE.get(key)
            if found is None:
                found = _TABLE[key] = made
    return found


def _union(operands: tuple[Expression, ...]) -> frozenset[str]:
    found: frozenset[str] = frozenset()
    for operand in operands:
        if not operand.leaves <= found:
            found = found | operand.leaves if found else operand.leaves
    return found


def _content(array: np.ndarray) -> tuple:
    return array.shape, array.dtype.str, array.tobytes()


def _standard(dtype: np.dtype) -> np.dtype:
    """Real, whole or true: the type in which such numbers are computed."""
    for kinds, standard in (("f", float), ("iu", np.int64), ("b", bool)):
        if dtype.kind in kinds and not (dtype.kind == "u" and dtype.itemsize == 8):
            return np.dtype(standard)
    raise TraceError(f"values of type {dtype}")


@lru_cache(maxsize=4096)
def _dtype_of(function: Any, *dtypes: np.dtype) -> np.dtype:
    try:
        return _standard(np.asarray(function(*(np.zeros(0, d) for d in dtypes))).dtype)
    except TypeError as error:
        raise TraceError(str(error)) from error


def _used(
    args: tuple[Expression, ...], at: np.ndarray
) -> tuple[tuple[Expression, ...], np.ndarray]:
    """The operands that positions read, and where in these."""
    if len(args) == 1 and at.size:
        return args, at
    ends = np.cumsum([a.size for a in args])
    which = np.searchsorted(ends, at, side="right")
    read = np.unique(which)
    if len(read) == len(args):
        return args, at
    starts = ends - [a.size for a in args]
    sizes = np.array([args[k].size for k in read], dtype=np.intp)
    moved = np.zeros(len(args), np.intp)
    moved[read] = np.cumsum(sizes) - sizes
    return tuple(args[k] for k in read), at - starts[which] + moved[which] if at.size else at
