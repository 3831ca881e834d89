"""Values of expressions: the graph as NumPy calls on arrays with batch axes in front."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided

from bayesmc.expression.buffers import Buffers
from bayesmc.expression.composed import log_sum_exp
from bayesmc.expression.graph import (
    Call,
    Constant,
    Elementwise,
    Expression,
    Gather,
    Leaf,
    Pick,
    Reduction,
    ordered,
)
from bayesmc.shapes import Shape

Step = Callable[..., np.ndarray]
#: uses of one set of shapes before code is made for it, and how many such sets
_USES, _SHAPES = 4, 16


#: numbers up to which positions are written out with the batch
FEW = 1 << 12
#: powers that have a function of their own, which ``x ** 2`` of an array takes, too
POWERS: dict[float, Callable[..., np.ndarray]] = {
    2.0: np.square,
    0.5: np.sqrt,
    -1.0: np.reciprocal,
}


def evaluate(roots: Sequence[Expression], values: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Values of expressions.

    Parameters
    ----------
    roots : sequence of Expression
    values : mapping
        Leaf -> its value, shape ``(*batch, *shape)``; batch shapes may differ but broadcast.

    Returns
    -------
    list of ndarray
        Of shapes ``(*batch, *shape)``, each with the batch of the leaves that it depends on.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import elementwise, evaluate, leaf
    >>> x = leaf("x", (2,))
    >>> evaluate([elementwise(np.multiply, x, [1.0, 10.0])], {"x": np.array([[1.0, 2.0], [3.0, 4.0]])})
    [array([[ 1., 20.],
           [ 3., 40.]])]
    """
    return Program(roots)(values)


class Program:
    """Expressions made ready to be evaluated often.

    Parameters
    ----------
    roots : sequence of Expression
    """

    def __init__(self, roots: Sequence[Expression]) -> None:
        self._roots = tuple(roots)
        self._nodes = ordered(*roots)
        at = {node: k for k, node in enumerate(self._nodes)}
        self._leaves = [(at[n], n.name) for n in self._nodes if isinstance(n, Leaf)]
        self._constants = [(at[n], n.value) for n in self._nodes if isinstance(n, Constant)]
        self._steps = [
            (at[n], _step(n), tuple(at[a] for a in n.operands)) for n in self._nodes if n.operands
        ]
        self._at = [at[r] for r in roots]
        #: by the shapes of leaves, how often they came or the code for them
        self._made: dict[tuple[Any, ...], Any] = {}

    def __call__(self, values: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        key = tuple([getattr(values[name], "shape", None) for _, name in self._leaves])
        made = self._made.get(key, 0)
        if made == 0 and len(self._made) >= _SHAPES:
            made = _USES + 1
        with np.errstate(all="ignore"):
            if callable(made):
                return made(values)
            slots = self._evaluated(values)
            if made < _USES:
                self._made[key] = made + 1
            elif made == _USES and None not in key:
                steps = {self._nodes[k]: step for k, step, _ in self._steps}
                known = dict(zip(self._nodes, slots, strict=True))
                self._made[key] = shaped(self._roots, steps, known, self._whatever)
        return [slots[k] for k in self._at]

    def _whatever(self, values: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Values of the roots, whatever the shapes."""
        slots = self._evaluated(values)
        return [slots[k] for k in self._at]

    def _evaluated(self, values: Mapping[str, np.ndarray]) -> list[Any]:
        """Values of all nodes."""
        slots: list[Any] = [None] * len(self._nodes)
        for k, value in self._constants:
            slots[k] = value
        for k, name in self._leaves:
            slots[k] = values[name]
        for k, step, operands in self._steps:
            slots[k] = step(*[slots[a] for a in operands])
        return slots


def power_of(node: Expression) -> Callable[..., np.ndarray] | None:
    """The function that is a power with this known exponent, if there is one."""
    if not isinstance(node, Elementwise) or node.function is not np.power:
        return None
    base, exponent = node.operands
    if isinstance(exponent, Constant) and not exponent.shape and base.dtype.kind == "f":
        return POWERS.get(float(exponent.value))
    return None


def shaped(
    roots: Sequence[Expression],
    steps: Mapping[Expression, Callable[..., np.ndarray]],
    values: Mapping[Expression, Any],
    otherwise: Callable[[Mapping[str, np.ndarray]], list[np.ndarray]],
) -> Callable[[Mapping[str, np.ndarray]], list[np.ndarray]]:
    """A function of values that have the shapes of some values.

    Parameters
    ----------
    roots : sequence of Expression
    steps : mapping
        Node -> what evaluates it whatever the shapes.
    values : mapping
        Node -> a value of it.
    otherwise : callable
        Does the same where a call gives another shape than it did.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import Program, elementwise, leaf
    >>> x = leaf("x", (2,))
    >>> program = Program([elementwise(np.multiply, x, [1.0, 10.0])])
    >>> [program({"x": np.array([1.0, 2.0]) + i})[0].tolist() for i in range(9)][-1]  # from the fifth on
    [9.0, 100.0]
    """
    scope: dict[str, Any] = {"concatenate": np.concatenate, "otherwise": otherwise}
    names: dict[Expression, str] = {}
    lines, buffers = [], Buffers(roots, values)
    pooled, shapes = buffers.pool()
    if pooled:  # taken out while they are in use, so that calls at a time have their own
        scope["free"], scope["new"] = [], lambda: [np.empty(shape) for shape in shapes]
        # in one step: another thread may take the last one between a look and a pop
        lines += ["try: pool = free.pop()", "except IndexError: pool = new()"]
    for k, node in enumerate(ordered(*roots)):
        names[node] = f"t{k}"
        if isinstance(node, Leaf):
            scope[f"n{k}"] = node.name
            lines.append(f"t{k} = values[n{k}]")
        elif isinstance(node, Constant):
            scope[f"t{k}"] = node.value
        else:
            right = _written(node, k, names, steps, values, scope)
            place = buffers.place_for(node)
            if place is not None and right.endswith(")"):
                right = f"{right[:-1]}, out={names[place]})"
            elif node in pooled and right.endswith(")"):
                right = f"{right[:-1]}, out=pool[{pooled[node]}])"
            lines.append(f"t{k} = {right}")
            if isinstance(node, Call):
                scope[f"s{k}"] = np.shape(values[node])
                lines.append(f"if t{k}.shape != s{k}: return otherwise(values)")
            lines += [f"{names[over]} = None" for over in buffers.over_with(node)]
    if pooled:
        lines.append("free.append(pool)")
    lines.append(f"return [{', '.join(names[r] for r in roots)}]")
    exec("def function(values):\n    " + "\n    ".join(lines), scope)  # noqa: S102 - names are our own
    return scope["function"]


# ---- private ------------------------------------------------------------------------------------


def _step(node: Expression) -> Step:
    if isinstance(node, Elementwise):
        return _elementwise(node)
    if isinstance(node, Pick):
        return _pick(node)
    if isinstance(node, Gather):
        return _gather(node)
    if isinstance(node, Reduction):
        axes = tuple(a - len(node.operands[0].shape) for a in node.axes)
        reduce = _reducing(node.ufunc)
        return lambda value: reduce(value, axis=axes)
    assert isinstance(node, Call)
    return node.call


def _reducing(ufunc: np.ufunc) -> Callable[..., np.ndarray]:
    return log_sum_exp if ufunc is np.logaddexp else ufunc.reduce


def _elementwise(node: Elementwise) -> Step:
    power = power_of(node)
    if power is not None:
        return lambda x, _: power(x)
    ndim = len(node.shape)
    pads = [ndim - len(a.shape) if a.leaves else 0 for a in node.operands]
    function = node.function
    if not any(pads):
        return function
    shapes = [(1,) * pad + a.shape for pad, a in zip(pads, node.operands, strict=True)]
    ranks = [len(a.shape) for a in node.operands]

    def step(*values: np.ndarray) -> np.ndarray:
        return function(
            *(
                v.reshape(v.shape[: v.ndim - rank] + shape) if pad and v.ndim > rank else v
                for v, pad, rank, shape in zip(values, pads, ranks, shapes, strict=True)
            )
        )

    return step


def _pick(node: Pick) -> Step:
    take = _taken(node.positions)
    if len(node.operands) == 1:
        return _picked_of_one(node, take)
    ranks = [len(a.shape) for a in node.operands]
    sizes = [a.size for a in node.operands]
    dtype = node.dtype

    alike = len({a.shape for a in node.operands}) == 1

    def several(*values: np.ndarray) -> np.ndarray:
        first = values[0].shape
        if alike and first and all(v.shape == first for v in values):
            return take(_side_by_side(values, ranks[0], dtype))
        batches = [v.shape[: v.ndim - rank] for v, rank in zip(values, ranks, strict=True)]
        batch = np.broadcast_shapes(*set(batches))
        parts = [
            v.reshape((*own, size))
            if own == batch
            else np.broadcast_to(v.reshape((*own, size)), (*batch, size))
            for v, own, size in zip(values, batches, sizes, strict=True)
        ]
        return take(np.concatenate(parts, axis=-1, dtype=dtype))

    return several


def _picked_of_one(node: Pick, take: Step) -> Step:
    (operand,) = node.operands
    rank, size, shape = len(operand.shape), operand.size, node.shape
    order = np.arange(size)
    if size == node.size and np.array_equal(node.positions.ravel(), order):
        return lambda value: value.reshape(value.shape[: value.ndim - rank] + shape)
    if rank > 1 and np.array_equal(node.positions, order.reshape(operand.shape).swapaxes(-1, -2)):
        return lambda value: value.swapaxes(-1, -2)
    return lambda value: take(value.reshape((*value.shape[: value.ndim - rank], size)))


def _side_by_side(values: Sequence[np.ndarray], rank: int, dtype: Any) -> np.ndarray:
    """Many arrays of one shape, flat one after the other behind their batch."""
    shape = values[0].shape
    whole = np.concatenate(values, axis=0, dtype=dtype).reshape(len(values), *shape)
    lead = len(shape) - rank
    return np.moveaxis(whole, 0, lead).reshape((*shape[:lead], -1))


def _taken(positions: np.ndarray) -> Step:
    """Elements of the last axis at positions: a view where many are evenly spaced.

    Few are copied, as code for known shapes does: sums to the last bit depend on how numbers lie.
    """
    view, count = _viewed(positions), positions.size

    def taken(flat: np.ndarray) -> np.ndarray:
        if view is None or math.prod(flat.shape[:-1]) * count <= FEW:
            return np.take(flat, positions, axis=-1)
        return view(flat)

    return taken


def _viewed(positions: np.ndarray) -> Step | None:
    shape = positions.shape
    even = _strides(positions)
    if even is None:
        return None
    offset, strides = even
    count = positions.size
    run = _run(shape, strides)
    if run is not None:
        whole = slice(offset, offset + count * run, run)
        if run < 0:
            stop = offset + count * run
            whole = slice(offset, stop if stop >= 0 else None, run)
        return lambda flat: flat[..., whole].reshape(flat.shape[:-1] + shape)

    def view(flat: np.ndarray) -> np.ndarray:
        step = flat.strides[-1]
        return as_strided(
            flat[..., offset:],
            flat.shape[:-1] + shape,
            flat.strides[:-1] + tuple(s * step for s in strides),
            writeable=False,
        )

    return view


def _strides(positions: np.ndarray) -> tuple[int, Shape] | None:
    """``(first, steps along each axis)`` where positions are evenly spaced, else None."""
    if not positions.size:
        return None
    first = int(positions.flat[0])
    steps = []
    made = np.asarray(first)
    for axis, size in enumerate(positions.shape):
        second = (
            positions[(0,) * axis + (1,) + (0,) * (positions.ndim - axis - 1)]
            if size > 1
            else first
        )
        steps.append(int(second) - first)
        along = np.arange(size).reshape((size,) + (1,) * (positions.ndim - axis - 1))
        made = made + steps[-1] * along
    return (first, tuple(steps)) if np.array_equal(made, positions) else None


def _run(shape: Shape, strides: Shape) -> int | None:
    """The step of positions that count on through all axes, in C order; None where they do not."""
    run, count = None, 1
    for size, stride in zip(reversed(shape), reversed(strides), strict=True):
        if size == 1:
            continue
        if run is None:
            run = stride
        elif stride != run * count:
            return None
        count *= size
    if run is None:
        return 1
    return run if run else None


def _gather(node: Gather) -> Step:
    table, rows = node.operands
    size, block = table.shape[0], table.shape[1:]
    rank, row_rank = len(table.shape), len(rows.shape)
    axis = -1 - len(block)

    def step(values: np.ndarray, at: np.ndarray) -> np.ndarray:
        if at.size and not (at.min() >= 0 and at.max() < size):
            raise IndexError(f"an index is outside of 0..{size - 1}")
        if values.ndim == rank:
            return np.take(values, at, axis=0)
        own = at.shape[: at.ndim - row_rank]
        batch = np.broadcast_shapes(values.shape[: values.ndim - rank], own)
        wide = np.broadcast_to(values, (*batch, size, *block)).reshape((-1, *block))
        lead = np.arange(math.prod(batch)).reshape(batch + (1,) * row_rank) * size
        whole = at.reshape(own + at.shape[at.ndim - row_rank :])
        return np.take(wide, lead + whole, axis=axis)

    return step


def _written(
    node: Expression,
    k: int,
    names: Mapping[Expression, str],
    steps: Mapping[Expression, Callable[..., np.ndarray]],
    values: Mapping[Expression, Any],
    scope: dict[str, Any],
) -> str:
    """The right side of a node; what it names goes into the scope."""
    given = [names[a] for a in node.operands]
    power = power_of(node)
    if power is not None:
        scope[f"f{k}"] = power
        return f"f{k}({given[0]})"
    if isinstance(node, Elementwise):
        scope[f"f{k}"] = node.function
        for j, a in enumerate(node.operands):
            batch = np.shape(values[a])[: np.ndim(values[a]) - len(a.shape)]
            if batch and len(a.shape) < len(node.shape):
                ones = (1,) * (len(node.shape) - len(a.shape))
                given[j] += f".reshape({(*batch, *ones, *a.shape)})"
        return f"f{k}({', '.join(given)})"
    if isinstance(node, Reduction):
        scope[f"f{k}"] = _reducing(node.ufunc)
        axes = tuple(a - len(node.operands[0].shape) for a in node.axes)
        return f"f{k}({given[0]}, {axes})"
    if isinstance(node, Pick) and np.size(values[node]) <= FEW:
        return _picked(node, k, given, values, scope)
    scope[f"f{k}"] = steps[node]
    return f"f{k}({', '.join(given)})"


def _picked(
    node: Pick,
    k: int,
    given: list[str],
    values: Mapping[Expression, Any],
    scope: dict[str, Any],
) -> str:
    shapes = [np.shape(values[a]) for a in node.operands]
    whole: Shape = np.shape(values[node])
    batch = whole[: len(whole) - len(node.shape)]
    start, rows = 0, []
    for a, shape in zip(node.operands, shapes, strict=True):
        own = shape[: len(shape) - len(a.shape)]
        size = math.prod(shape)
        at = start + np.arange(size).reshape((*own, a.size))
        rows.append(np.broadcast_to(at, (*batch, a.size)))
        start += size
    places = np.concatenate(rows, axis=-1)[..., node.positions]
    scope[f"p{k}"] = places
    if len(given) > 1:
        scope[f"d{k}"] = node.dtype
        return f"concatenate(({', '.join(given)}), None, dtype=d{k}).take(p{k})"
    order, (shape,) = np.arange(start), shapes
    if start == places.size and np.array_equal(places.ravel(), order):
        return given[0] if shape == whole else f"{given[0]}.reshape({whole})"
    if len(node.operands[0].shape) > 1 and np.array_equal(
        places, order.reshape(shape).swapaxes(-1, -2)
    ):
        return f"{given[0]}.swapaxes(-1, -2)"
    return f"{given[0]}.take(p{k})"
