"""What ufuncs and NumPy functions make of expressions: one rule for each, calls for what has none.

Functions that move elements about are read off positions: they are applied to the numbers 0, 1, 2, ... in
the place of the elements, and what comes out says which element stands where.
"""

from __future__ import annotations

import string
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import graph
from bayesmc.expression.graph import Expression
from bayesmc.expression.indexing import counted_from_end, within

#: functions that move the elements of their first argument about (an array, or a sequence of arrays)
_MOVERS = frozenset(
    (
        np.stack, np.concatenate, np.vstack, np.hstack, np.dstack, np.column_stack, np.broadcast_to,
        np.copy, np.reshape, np.ravel, np.transpose, np.matrix_transpose, np.squeeze, np.expand_dims,
        np.moveaxis, np.swapaxes, np.rollaxis, np.repeat, np.tile, np.flip, np.flipud, np.fliplr,
        np.rot90, np.roll, np.atleast_1d, np.atleast_2d, np.atleast_3d, np.diagonal, np.split,
        np.array_split, np.linalg.diagonal, np.linalg.matrix_transpose, np.block, np.append, np.delete,
    )
)  # fmt: skip
#: of these, what takes more arrays than the first argument
_OF_TWO = frozenset((np.append,))
_REDUCERS: Mapping[Any, np.ufunc] = {
    np.sum: np.add, np.prod: np.multiply, np.max: np.maximum, np.min: np.minimum,
    np.any: np.logical_or, np.all: np.logical_and,
}  # fmt: skip
#: functions that hand numbers to callbacks or files, or draw them
_SHOWING = frozenset(
    (np.apply_along_axis, np.apply_over_axes, np.piecewise, np.save, np.savez, np.savetxt)
)


#: products of the last axes -> how many of each operand's axes take part
PRODUCTS: dict[Any, tuple[int, int]] = {
    np.matmul: (2, 2),
    np.vecdot: (1, 1),
    np.matvec: (2, 1),
    np.vecmat: (1, 2),
}


def applied(ufunc: Any, method: str, inputs: Any, kwargs: dict[str, Any]) -> Any:
    """What a ufunc makes of its inputs."""
    dtype = kwargs.pop("dtype", None)
    if method == "reduce":
        operand, *rest = inputs
        found: Any = _reduced(ufunc, operand, *(rest or (kwargs.pop("axis", 0),)), **kwargs)
    elif method == "outer":
        first, second = map(expression_of, inputs)
        wide = graph.reshape(first, first.shape + (1,) * len(second.shape))
        found = graph.elementwise(ufunc, wide, second)
    elif method != "__call__" or (ufunc.signature and ufunc not in PRODUCTS):
        return repeated(getattr(ufunc, method), inputs, kwargs)
    elif kwargs:
        raise TraceError(f"np.{ufunc.__name__} with {', '.join(kwargs)}=")
    elif ufunc in PRODUCTS:
        found = product(ufunc, *map(expression_of, inputs))
    elif ufunc is np.divmod:
        return applied(np.floor_divide, method, inputs, {}), applied(np.mod, method, inputs, {})
    elif ufunc.nout > 1:
        return repeated(ufunc, inputs, {})
    else:
        found = graph.elementwise(ufunc, *map(expression_of, inputs))
    return found if dtype is None else graph.cast(found, dtype)


def of_function(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """What a NumPy function makes of its arguments."""
    rule = _RULES.get(func)
    if rule is not None:
        try:
            return rule(*args, **kwargs)
        except TypeError as error:
            raise TraceError(f"np.{func.__name__}: {error}") from error
    if func in _REDUCERS:
        return _reduced(_REDUCERS[func], *args, **kwargs)
    if func in _MOVERS:
        return _moved(func, args, kwargs)
    if func in _SHOWING:
        raise TraceError(f"np.{func.__name__} hands the numbers on")
    return repeated(func, args, kwargs)


def expression_of(value: Any) -> Expression:
    """The expression behind an argument."""
    found = getattr(value, "expression", value)
    if isinstance(found, (list, tuple)) and _any_traced(found):
        return _moved(np.stack, ([_plainly(v) for v in found],), {})
    if isinstance(found, np.ma.MaskedArray):
        raise TraceError("a masked array")
    return graph.as_expression(found)


@dataclass(frozen=True, eq=False)
class Repeated:
    """A call to be made again, with other arrays in the place of those that varied.

    Two are equal where they call the same function in the same way.
    """

    function: Callable[..., Any]
    args: Any
    kwargs: dict[str, Any]
    output: int | None = None
    key: Hashable = field(default=None)

    def __call__(self, *arrays: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            args, kwargs = _filled(self.args, arrays), _filled(self.kwargs, arrays)
            found = self.function(*args, **kwargs)
        return np.asarray(found if self.output is None else found[self.output])

    @property
    def slots(self) -> list[int | None]:
        """For each argument by place the number of the operand that it is; None where it is known."""
        return [a.number if isinstance(a, _Slot) else None for a in self.args]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Repeated) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)

    def __str__(self) -> str:
        return getattr(self.function, "__name__", str(self.function))


def repeated(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """A call of whole arrays that is made again as it stands."""
    operands: list[Expression] = []
    held = _held(list(args), operands), _held(kwargs, operands)
    key = (function, _key(held[0]), _key(held[1]))
    probe = Repeated(function, held[0], held[1], None, key)
    arrays = [o.value if isinstance(o, graph.Constant) else graph.sample(o) for o in operands]
    try:
        with np.errstate(all="ignore"):
            found = function(*_filled(held[0], arrays), **_filled(held[1], arrays))
    except (TypeError, ValueError, IndexError, np.linalg.LinAlgError) as error:
        name = getattr(function, "__name__", str(function))
        raise TraceError(f"{name}: {error}") from error
    if not isinstance(found, (list, tuple)):
        return graph.call(probe, operands)
    return tuple(
        graph.call(Repeated(function, held[0], held[1], k, (*key, k)), operands)
        for k in range(len(found))
    )


def product(ufunc: Any, first: Expression, second: Expression) -> Expression:
    """``np.matmul``, ``np.vecdot``, ``np.matvec`` or ``np.vecmat`` of two expressions."""
    cores = list(PRODUCTS[ufunc])
    for k, node in enumerate((first, second)):
        if not node.shape:
            raise TraceError(f"np.{ufunc.__name__} of a scalar")
        if ufunc is np.matmul:
            cores[k] = min(len(node.shape), 2)
        elif len(node.shape) < cores[k]:
            raise TraceError(f"np.{ufunc.__name__} of a vector where a matrix belongs")
    left, right = {1: "j", 2: "ij"}[cores[0]], {1: "j", 2: "jk"}[cores[1]]
    lead = max(len(first.shape) - cores[0], len(second.shape) - cores[1])
    names = [c for c in string.ascii_letters if c not in "ijk"][:lead]
    own = [names[lead - (len(n.shape) - c) :] for n, c in zip((first, second), cores, strict=True)]
    out = [*names, *(c for c in left + right if c != "j")]
    return _summed([[*own[0], *left], [*own[1], *right]], [first, second], out)


def einsum(spec: Any, *operands: Any) -> Expression:
    """``np.einsum`` with a string that names every axis."""
    nodes = [graph.as_expression(getattr(x, "expression", x)) for x in operands]
    if not isinstance(spec, str):
        raise TraceError("np.einsum without a string of axes")
    given = spec.replace(" ", "").split("->")
    terms = given[0].split(",")
    ndim = max(len(n.shape) - len(t.replace("...", "")) for n, t in zip(nodes, terms, strict=True))
    free = [c for c in string.ascii_uppercase if c not in spec][: max(ndim, 0)]
    named = []
    for node, term in zip(nodes, terms, strict=True):
        count = len(node.shape) - len(term.replace("...", ""))
        if count < 0 or (count and "..." not in term):
            raise TraceError(f"np.einsum({spec!r}) of shape {node.shape}")
        before, dots, after = term.partition("...")
        named.append([*before, *(free[len(free) - count :] if dots else ()), *after])
    if len(given) > 1:
        before, dots, after = given[1].partition("...")
        out = [*before, *(free if dots else ()), *after]
    else:
        flat = [c for t in named for c in t]
        once = sorted(c for c in set(flat) if flat.count(c) == 1 and c not in free)
        out = [*(free if "..." in spec else ()), *once]
    return _summed(named, nodes, out)


# ---- private ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Slot:
    """The place of the operand with this number."""

    number: int


def _held(value: Any, operands: list[Expression]) -> Any:
    """Arguments with slots in the place of what varies."""
    found = getattr(value, "expression", value)
    if isinstance(found, Expression):
        operands.append(found)
        return _Slot(len(operands) - 1)
    if isinstance(found, (list, tuple)):
        return type(found)(_held(v, operands) for v in found)
    if isinstance(found, dict):
        return {k: _held(v, operands) for k, v in found.items()}
    return np.array(found) if isinstance(found, np.ndarray) else found


def _filled(value: Any, arrays: Any) -> Any:
    if isinstance(value, _Slot):
        return arrays[value.number]
    if isinstance(value, (list, tuple)):
        return type(value)(_filled(v, arrays) for v in value)
    if isinstance(value, dict):
        return {k: _filled(v, arrays) for k, v in value.items()}
    return value


def _key(value: Any) -> Hashable:
    if isinstance(value, (list, tuple)):
        return (type(value), *map(_key, value))
    if isinstance(value, dict):
        return tuple((k, _key(v)) for k, v in value.items())
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    try:
        hash(value)
    except TypeError:
        return object()
    return type(value), value


def _any_traced(value: Any) -> bool:
    if isinstance(value, (list, tuple)):
        return any(map(_any_traced, value))
    return isinstance(getattr(value, "expression", None), Expression)


def _plainly(value: Any) -> Any:
    """What stands for an array as its expression, a sequence of such as one."""
    if isinstance(value, (list, tuple)) and _any_traced(value):
        return expression_of(value)
    return getattr(value, "expression", value)


def _reduced(
    ufunc: np.ufunc, operand: Any, axis: Any = None, *rest: Any, **kwargs: Any
) -> Expression:
    if rest or any(kwargs.get(k) is not None for k in ("dtype", "out", "initial", "where")):
        raise TraceError(f"np.{ufunc.__name__}.reduce with more than axis= and keepdims=")
    node = expression_of(operand)
    ndim = len(node.shape)
    axes = range(ndim) if axis is None else [int(a) for a in np.atleast_1d(axis)]
    found = graph.reduction(ufunc, node, axes)
    if not ndim and ufunc in (np.logical_or, np.logical_and):
        found = graph.cast(found, bool)
    if not kwargs.get("keepdims", False):
        return found
    gone = {a % ndim for a in axes} if ndim else set()
    return graph.reshape(found, tuple(1 if k in gone else n for k, n in enumerate(node.shape)))


def _moved(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Elements moved about, told by where the numbers 0, 1, 2, ... go."""
    operands: list[Expression] = []
    offset = 0

    def placed(value: Any) -> Any:
        nonlocal offset
        if isinstance(value, (list, tuple)):
            return type(value)(placed(v) for v in value)
        node = expression_of(value)
        operands.append(node)
        offset += node.size
        return np.arange(offset - node.size, offset).reshape(node.shape)

    if not args or {"dtype", "casting", "out"} & set(kwargs):
        raise TraceError(f"np.{func.__name__} with a type of its own")
    count = 2 if func in _OF_TWO else 1
    if any(map(_any_traced, args[count:])) or any(map(_any_traced, kwargs.values())):
        raise TraceError(f"np.{func.__name__} is steered by what varies")
    at = func(*(placed(a) for a in args[:count]), *args[count:], **kwargs)
    if isinstance(at, (list, tuple)):
        return [graph.pick(operands, a) for a in at]
    return graph.pick(operands, at)


def _where(condition: Any, a: Any, b: Any) -> Expression:
    return graph.elementwise(np.where, *map(expression_of, (condition, a, b)))


def _norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:
    node = expression_of(x)
    vector = isinstance(axis, int) or (axis is None and len(node.shape) == 1)
    if ord not in (None, 2) or not vector:
        return repeated(np.linalg.norm, (x,), {"ord": ord, "axis": axis, "keepdims": keepdims})
    square = graph.elementwise(np.multiply, node, node)
    return graph.elementwise(np.sqrt, _reduced(np.add, square, axis, keepdims=keepdims))


def _take(a: Any, indices: Any, axis: Any = None, mode: str = "raise") -> Expression:
    node, at = expression_of(a), expression_of(indices)
    if mode != "raise":
        raise TraceError(f"np.take with mode={mode!r}")
    if isinstance(at, graph.Constant):
        return _moved(np.take, (node, at.value), {"axis": axis})
    ndim = len(node.shape)
    if axis is None:
        node, axis, ndim = graph.reshape(node, (node.size,)), 0, 1
    if axis % ndim:
        raise TraceError("np.take of an inner axis at computed places")
    return graph.gather(node, counted_from_end(at, node.shape[0]))


def _take_along_axis(arr: Any, indices: Any, axis: Any = -1) -> Expression:
    node, at = expression_of(arr), expression_of(indices)
    axis %= len(node.shape)
    base = np.take(np.arange(node.size).reshape(node.shape), [0], axis=axis)
    stride = int(np.prod(node.shape[axis + 1 :], dtype=int))
    steps = graph.elementwise(
        np.multiply, within(counted_from_end(at, node.shape[axis]), node.shape[axis]), stride
    )
    return graph.gather(graph.reshape(node, (node.size,)), graph.elementwise(np.add, base, steps))


def _sort(a: Any, axis: Any = -1, kind: Any = None) -> Expression:
    node = expression_of(a)
    if axis is None:
        raise TraceError("np.sort of all axes")
    order = repeated(np.argsort, (node,), {"axis": axis, "kind": kind})
    return _take_along_axis(node, order, axis)


def _dot(a: Any, b: Any) -> Expression:
    first, second = expression_of(a), expression_of(b)
    if not (first.shape and second.shape):
        return graph.elementwise(np.multiply, first, second)
    if len(second.shape) > 2:
        raise TraceError("np.dot of more than two axes")
    return product(np.matmul, first, second)


def _broadcast_arrays(*args: Any) -> tuple[Expression, ...]:
    nodes = [expression_of(a) for a in args]
    shape = np.broadcast_shapes(*(n.shape for n in nodes))
    return tuple(graph.broadcast(n, shape) for n in nodes)


def _round(a: Any, decimals: int = 0) -> Any:
    if decimals:
        return repeated(np.round, (a, decimals), {})
    node = expression_of(a)
    return node if node.dtype.kind == "i" else graph.elementwise(np.rint, node)


_RULES: Mapping[Any, Callable[..., Any]] = {
    np.where: _where, np.linalg.norm: _norm, np.take: _take, np.take_along_axis: _take_along_axis,
    np.einsum: einsum, np.dot: _dot, np.broadcast_arrays: _broadcast_arrays, np.sort: _sort,
    np.inner: lambda a, b: product(np.vecdot, expression_of(a), expression_of(b)),
    np.round: _round, np.around: _round,
}  # fmt: skip


def _summed(
    terms: Sequence[Sequence[str]], nodes: Sequence[Expression], out: Sequence[str]
) -> Expression:
    """The product of operands whose axes have names, summed over those that are not in ``out``."""
    sizes: dict[str, int] = {}
    for term, node in zip(terms, nodes, strict=True):
        for name, size in zip(term, node.shape, strict=True):
            if sizes.get(name, 1) != size and size != 1 and sizes.get(name, 1) != 1:
                raise TraceError(f"a product of axes of sizes {sizes[name]} and {size}")
            sizes[name] = max(sizes.get(name, 1), size) if size else 0
    order = [*out, *sorted(set(sizes) - set(out))]
    found: Expression | None = None
    for term, node in zip(terms, nodes, strict=True):
        part = _aligned(node, term, order)
        found = part if found is None else graph.elementwise(np.multiply, found, part)
    assert found is not None
    whole = tuple(sizes[c] for c in order)
    if found.shape != whole:
        found = graph.broadcast(found, whole)
    return graph.reduction(np.add, found, range(len(out), len(order)))


def _aligned(node: Expression, term: Sequence[str], order: Sequence[str]) -> Expression:
    """An operand with its axes in order, of size 1 where it has none; repeated ones are the diagonal."""
    at = np.arange(node.size).reshape(node.shape)
    kept = [c for c in order if c in term]
    numbers = {c: k for k, c in enumerate(order)}
    at = np.einsum(at, [numbers[c] for c in term], [numbers[c] for c in kept])
    shape = iter(at.shape)
    return graph.pick([node], at.reshape([next(shape) if c in kept else 1 for c in order]))
