"""Derivatives of what has no element-by-element rule: elements put back, products, calls of whole arrays."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import (
    Call,
    Expression,
    TracedArray,
    as_expression,
    call,
    pick,
    reduction,
    reshape,
)
from bayesmc.expression.functions import Repeated
from bayesmc.expression.scatter import Gathered, Places, Scattered
from bayesmc.passes.arithmetic import ZERO, add, multiply
from bayesmc.shapes import Shape


def scattered(part: Expression, positions: np.ndarray, shape: Shape) -> Expression:
    """Elements added up at flat positions of an array of zeros: what undoes a pick."""
    size, flat = math.prod(shape), positions.reshape(-1)
    counts = np.bincount(flat, minlength=size)
    if counts.max(initial=0) <= 1:  # nothing meets
        back = np.full(size, flat.size)
        back[flat] = np.arange(flat.size)
        return pick([part, reshape(ZERO, (1,))], back.reshape(shape))
    if (counts == counts[0]).all():  # a broadcast
        order = np.argsort(flat, kind="stable").reshape(*shape, counts[0])
        return reduction(np.add, pick([part], order), [len(shape)])
    order = np.argsort(flat, kind="stable")
    starts = np.cumsum(counts) - counts
    return call(
        Scattered(Places.of(order), Places.of(starts), Places.of(counts), shape),
        [reshape(part, (flat.size,))],
        shape,
        float,
    )


def gathered(part: Expression, rows: Expression, shape: Shape) -> Expression:
    """Entries added up at computed rows of a table of zeros: what undoes a gather."""
    return call(Gathered(shape, len(rows.shape)), [part, rows], shape, float)


def excluded_products(operand: Expression, axes: Sequence[int]) -> Expression:
    """For each element the product of the others along some axes."""
    return call(
        _Excluded(tuple(a - len(operand.shape) for a in axes)), [operand], operand.shape, float
    )


def call_tangent(node: Call, moved: Sequence[Expression]) -> Expression:
    """How the result of a call moves when its operands move so."""
    if isinstance(node.call, Scattered):  # sums of elements move as they do
        return call(node.call, moved, node.shape, float)
    if isinstance(node.call, Gathered):
        return call(node.call, [moved[0], node.operands[1]], node.shape, float)
    if isinstance(node.call, _Excluded):
        return _excluded_tangent(node.call, node.operands[0], moved[0])
    rule, places, values = _applied(node)
    total: Expression = ZERO
    for k, direction in zip(places, moved, strict=True):
        part = rule.forward(k, TracedArray(direction), *values)
        total = add(total, as_expression(part.expression))
    return total


def call_adjoints(node: Call, own: Expression) -> list[Expression | None]:
    """What the adjoint of a call's result adds to those of its operands."""
    rule, places, values = _applied(node)
    parts = [rule.reverse(k, TracedArray(own), *values) for k in places]
    return [p.expression for p in parts]


# ---- private ------------------------------------------------------------------------------------


def _excluded_tangent(made: _Excluded, operand: Expression, moved: Expression) -> Expression:
    """How products of all but one move: the sum over each of those of the products without both."""
    axes = tuple(a + len(operand.shape) for a in made.axes)
    if len(axes) > 1:
        raise TraceError("no second derivative of np.prod over several axes is known")
    (axis,), width = axes, operand.shape[axes[0]]
    parts = []
    for k in range(width):  # without k, and how the product of the others moves
        at = [j for j in range(width) if j != k]
        places = np.arange(operand.size).reshape(operand.shape)
        others = pick([operand], np.take(places, at, axis=axis))
        along = pick([moved], np.take(places, at, axis=axis))
        each = excluded_products(others, [axis])
        parts.append(reduction(np.add, multiply(each, along), [axis]))
    size = parts[0].size
    stacked = np.stack(
        [k * size + np.arange(size).reshape(parts[0].shape) for k in range(width)], axis
    )
    return pick(parts, stacked)


@dataclass(frozen=True)
class _Excluded:
    axes: tuple[int, ...]

    def __call__(self, x: np.ndarray) -> np.ndarray:
        last = tuple(range(-len(self.axes), 0))
        moved = np.moveaxis(x, self.axes, last)
        shape = moved.shape
        flat = moved.reshape(*shape[: len(shape) - len(last)], -1)
        ones = np.ones_like(flat[..., :1])
        before = np.cumprod(np.concatenate([ones, flat[..., :-1]], axis=-1), axis=-1)
        behind = np.concatenate([ones, flat[..., :0:-1]], axis=-1)
        after = np.cumprod(behind, axis=-1)[..., ::-1]
        return np.moveaxis((before * after).reshape(shape), last, self.axes)


@dataclass(frozen=True)
class _Rule:
    """``forward(k, direction, *operands, result)``, ``reverse(k, adjoint, *operands, result)``."""

    forward: Callable[..., Any]
    reverse: Callable[..., Any]


def _applied(node: Call) -> tuple[_Rule, list[int], list[TracedArray]]:
    """The rule of a call, the places of its operands among the arguments, and arguments and result."""
    made = node.call
    if isinstance(made, Repeated) and made.function in (np.cumsum,):
        return _cumulative(made, node), [0], [TracedArray(a) for a in (*node.operands, node)]
    plain = isinstance(made, Repeated) and not made.kwargs and made.output is None
    if plain and made.function in _RULES:
        slots = made.slots
        if not set(range(len(node.operands))) <= set(slots):
            raise TraceError(f"no derivative of {node.detail} of a list is known")
        given = [made.args[k] if s is None else node.operands[s] for k, s in enumerate(slots)]
        places = [slots.index(number) for number in range(len(node.operands))]
        return _RULES[made.function], places, [TracedArray(a) for a in (*given, node)]
    raise TraceError(f"no derivative of {node.detail} is known")


def _cumulative(made: Repeated, node: Call) -> _Rule:
    axis = made.kwargs.get("axis", made.args[1] if len(made.args) > 1 else None)
    if axis is None and len(node.shape) != 1:
        raise TraceError("no derivative of np.cumsum over all axes is known")
    along = -1 if axis is None else axis

    def back(k: int, adjoint: Any, *values: Any) -> Any:
        return np.flip(np.cumsum(np.flip(adjoint, along), axis=along), along)

    return _Rule(lambda k, direction, *values: np.cumsum(direction, axis=along), back)


def _transposed(matrix: Any) -> Any:
    return np.swapaxes(matrix, -1, -2)


def _inverse_forward(k: int, direction: Any, a: Any, inverse: Any) -> Any:
    return -np.matmul(np.matmul(inverse, direction), inverse)


def _inverse_reverse(k: int, adjoint: Any, a: Any, inverse: Any) -> Any:
    turned = _transposed(inverse)
    return -np.matmul(np.matmul(turned, adjoint), turned)


def _solve_forward(k: int, direction: Any, a: Any, b: Any, x: Any) -> Any:
    return np.linalg.solve(a, direction if k else -np.matmul(direction, x))


def _solve_reverse(k: int, adjoint: Any, a: Any, b: Any, x: Any) -> Any:
    back = np.linalg.solve(_transposed(a), adjoint)
    return back if k else -np.matmul(back, _transposed(x))


def _det_forward(k: int, direction: Any, a: Any, det: Any) -> Any:
    return det * np.sum(_transposed(np.linalg.inv(a)) * direction, axis=(-2, -1))


def _det_reverse(k: int, adjoint: Any, a: Any, det: Any) -> Any:
    return (adjoint * det)[..., None, None] * _transposed(np.linalg.inv(a))


def _lower_half(matrix: Any) -> Any:
    """The lower triangle with half its diagonal."""
    n = matrix.shape[-1]
    return matrix * (np.tril(np.ones((n, n)), -1) + 0.5 * np.eye(n))


def _cholesky_forward(k: int, direction: Any, a: Any, factor: Any) -> Any:
    inverse = np.linalg.inv(factor)
    symmetric = 0.5 * (direction + _transposed(direction))
    inner = np.matmul(np.matmul(inverse, symmetric), _transposed(inverse))
    return np.matmul(factor, _lower_half(inner))


def _cholesky_reverse(k: int, adjoint: Any, a: Any, factor: Any) -> Any:
    inverse = np.linalg.inv(factor)
    inner = _lower_half(np.matmul(_transposed(factor), adjoint))
    half = np.matmul(np.matmul(_transposed(inverse), inner), inverse)
    return 0.5 * (half + _transposed(half))


_RULES: dict[Any, _Rule] = {
    np.linalg.inv: _Rule(_inverse_forward, _inverse_reverse),
    np.linalg.solve: _Rule(_solve_forward, _solve_reverse),
    np.linalg.det: _Rule(_det_forward, _det_reverse),
    np.linalg.cholesky: _Rule(_cholesky_forward, _cholesky_reverse),
}
