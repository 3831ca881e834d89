"""Which values of a graph a kernel keeps in memory, and which it computes where they are read.

Few elements are kept in registers, one by one. An array of many is computed inside of the loop that reads
it, unless several loops do, or one reads it at places of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import (
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
from bayesmc.expression.functions import Repeated
from bayesmc.expression.scatter import Gathered, Scattered
from bayesmc.lowering.ufuncs import is_cheap, is_lowerable
from bayesmc.shapes import Shape

#: elements up to which an array is written out element by element
FEW = 8
#: elements written out, and bytes kept for one entry, beyond which nothing is compiled
_WRITTEN, _KEPT = 20_000, 1 << 26

#: rows and columns of matrices beyond which LAPACK's blocks are faster than loops
ROWS_MOST = 48

_MATRIX_FUNCTIONS = frozenset((np.linalg.cholesky, np.linalg.inv, np.linalg.det, np.linalg.solve))

#: ufuncs that reduce -> what they begin with
STARTS: dict[Any, float] = {
    np.add: 0.0, np.multiply: 1.0, np.maximum: -math.inf, np.minimum: math.inf,
    np.logical_or: 0.0, np.logical_and: 1.0, np.logaddexp: -math.inf,
}  # fmt: skip


@dataclass
class Layout:
    """What is kept where.

    Attributes
    ----------
    nodes : list of Expression
        Operands first.
    kept : set of Expression
        Whose elements lie in memory.
    walks : dict
        Pick -> how its axes move along those of what it picks from.
    """

    nodes: list[Expression]
    kept: set[Expression] = field(default_factory=set)
    walks: dict[Expression, Walk] = field(default_factory=dict)


@dataclass(frozen=True)
class Walk:
    """A pick that moves along each axis of its operand by itself.

    Attributes
    ----------
    first : tuple of int
        Where it starts.
    axes, steps : tuple of int
        For each axis of the pick the axis of the operand that moves with it, and how far.
    """

    first: Shape
    axes: Shape
    steps: Shape


def laid_out(roots: Sequence[Expression]) -> Layout:
    """The layout of a kernel.

    Raises
    ------
    TraceError
        Something has no machine code, or there is too much of it.
    """
    found = Layout(ordered(*roots))
    for node in found.nodes:
        _check(node)
    written = written_out(found.nodes)
    if written > _WRITTEN:
        raise TraceError(f"{written} elements to be written out, more than {_WRITTEN}")
    readers: dict[Expression, int] = dict.fromkeys(found.nodes, 0)
    spread: set[Expression] = set()  # read several times by one that has more elements
    for node in found.nodes:
        for operand in node.operands:
            readers[operand] += 1
            if node.size > operand.size:
                spread.add(operand)
    for root in roots:
        readers[root] += 1
    weights: dict[Expression, int] = {}
    for node in reversed(found.nodes):
        _demand(node, found)
    for node in found.nodes:
        weights[node] = _weight(node, found, weights)
        is_shared = (readers[node] > 1 and weights[node] > 2) or (
            node in spread and weights[node] > 4
        )
        if not is_few(node) and node.operands and is_shared:
            found.kept.add(node)
        if node in found.kept:
            weights[node] = 1
    kept = 8 * sum(n.size for n in found.kept)
    if kept > _KEPT:
        raise TraceError(f"{kept >> 20} MiB to be kept of each entry, more than {_KEPT >> 20}")
    return found


def written_out(nodes: Iterable[Expression]) -> int:
    """How many elements are written out: what compiling takes."""
    return sum(node.size if is_few(node) else 1 for node in nodes)


def is_few(node: Expression) -> bool:
    """Whether it is written out element by element."""
    return node.size <= FEW


def is_given(node: Expression) -> bool:
    """Whether it lies in memory from the start."""
    return isinstance(node, (Leaf, Constant))


def cumulated_axis(node: Call) -> int | None:
    """The axis of a ``np.cumsum``; None where it is something else."""
    made = node.call
    if not isinstance(made, Repeated) or made.function is not np.cumsum or made.slots[:1] != [0]:
        return None
    axis = made.kwargs.get("axis", made.args[1] if len(made.args) > 1 else None)
    is_plain = not set(made.kwargs) - {"axis"} and len(made.args) < 3
    return len(node.shape) + axis if is_plain and isinstance(axis, int) and axis < 0 else None


def linear_algebra(node: Expression) -> Any | None:
    """NumPy's function of matrices that a call is, guarded or not; None where it is none with code."""
    made = node.call if isinstance(node, Call) else None
    if not isinstance(made, Repeated) or made.kwargs or made.output is not None:
        return None
    function = getattr(made.function, "function", made.function)
    if function not in _MATRIX_FUNCTIONS or node.dtype.kind != "f":
        return None
    operands = node.operands
    is_plain = made.slots == list(range(len(operands))) and all(len(a.shape) > 1 for a in operands)
    return function if is_plain else None


def strides_of(positions: np.ndarray) -> tuple[int, Shape] | None:
    """``(first, steps along each axis)`` of positions that are evenly spaced; else None."""
    if not positions.size:
        return None
    first = int(positions.flat[0])
    steps = []
    made = np.asarray(first)
    for axis, size in enumerate(positions.shape):
        corner = (0,) * axis + (1,) + (0,) * (positions.ndim - axis - 1)
        steps.append(int(positions[corner]) - first if size > 1 else 0)
        ones = (1,) * (positions.ndim - axis - 1)
        made = made + steps[-1] * np.arange(size).reshape((size, *ones))
    return (first, tuple(steps)) if np.array_equal(made, positions) else None


# ---- private ------------------------------------------------------------------------------------


def _check(node: Expression) -> None:
    """Refuse what has no machine code."""
    if node.size == 0:
        raise TraceError("an array without elements")
    if isinstance(node, Elementwise) and not is_lowerable(node):
        raise TraceError(f"{node.detail} of numbers of type {node.dtype} has no machine code")
    if isinstance(node, Reduction) and node.ufunc not in STARTS:
        raise TraceError(f"{node.ufunc.__name__}.reduce has no machine code")
    if isinstance(node, Call) and not _is_call_with_code(node):
        raise TraceError(f"{node.detail} has no machine code")
    rows = node.operands[0].shape[-1] if linear_algebra(node) is not None else 0
    if rows > ROWS_MOST:
        raise TraceError(f"{node.detail} of {rows} rows has no machine code ({ROWS_MOST} at most)")


def _is_call_with_code(node: Call) -> bool:
    is_sum = isinstance(node.call, (Scattered, Gathered))
    return is_sum or cumulated_axis(node) is not None or linear_algebra(node) is not None


def _demand(node: Expression, layout: Layout) -> None:
    """Which operands must lie in memory, for a node to read them."""
    own = {a for a in node.operands if not is_given(a)}
    if not is_few(node):
        layout.kept |= {a for a in own if is_few(a) and a.size > 1}
    if isinstance(node, Gather) and node.table in own and node.table.size > 1:
        layout.kept.add(node.table)
    if isinstance(node, Call):
        layout.kept |= {node, *(a for a in own if a.size > 1)}
    if isinstance(node, Pick) and not is_few(node):
        walk = _walk(node) if len(node.operands) == 1 else None
        if walk is not None:
            layout.walks[node] = walk
        else:
            layout.kept |= {a for a in own if a.size > 1}
        if len(node.operands) > 1:
            layout.kept.add(node)
    if isinstance(node, Reduction) and not adds_in_place(node):
        return
    if isinstance(node, Reduction):
        layout.kept.add(node)


def adds_in_place(node: Reduction) -> bool:
    """Whether many results are summed side by side, since what lies close together is not summed."""
    (operand,) = node.operands
    last = max(k for k, n in enumerate(operand.shape) if n > 1 or k == 0)
    return node.size > 1 and not is_few(operand) and last not in node.axes


def _weight(node: Expression, layout: Layout, weights: dict[Expression, int]) -> int:
    """About how many instructions one element takes where it is read."""
    inner = sum(weights[a] for a in node.operands)
    if is_given(node) or is_few(node):
        return 1
    if isinstance(node, Elementwise):
        return inner + (1 if is_cheap(node.function) else 10)
    if isinstance(node, Reduction):
        return inner * node.operands[0].size // node.size + 1
    return inner + (3 if isinstance(node, Gather) else 0)


def _walk(node: Pick) -> Walk | None:
    (operand,) = node.operands
    even = strides_of(node.positions)
    if even is None:
        return None
    first = tuple(int(v) for v in np.unravel_index(even[0], operand.shape)) if operand.shape else ()
    low, high = list(first), list(first)
    axes, steps = [], []
    for size, stride in zip(node.shape, even[1], strict=True):
        if size == 1 or stride == 0:
            axes.append(-1)
            steps.append(0)
            continue
        for axis, length in enumerate(operand.shape):
            inner = math.prod(operand.shape[axis + 1 :])
            if length > 1 and stride % inner == 0 and abs(stride) // inner < length:
                step = stride // inner
                break
        else:
            return None
        axes.append(axis)
        steps.append(step)
        (high if step > 0 else low)[axis] += step * (size - 1)
    inside = all(v >= 0 for v in low) and all(
        v < n for v, n in zip(high, operand.shape, strict=True)
    )
    return Walk(first, tuple(axes), tuple(steps)) if inside else None
