"""Known factors and summands taken out of products, quotients and sums: each is multiplied or added once.

A normal log density is ``-0.5 * ((x - m) / s) ** 2 - log(s) - 0.9189``, element by element; its sum needs one
factor and one summand. Every expression is read as ``scale * base + offset`` with known scale and offset, and
what can be is left for later. Values change by rounding only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayesmc.expression import (
    Constant,
    Elementwise,
    Expression,
    Pick,
    Reduction,
    broadcast,
    elementwise,
    ordered,
    pick,
    reduction,
    reshape,
)
from bayesmc.shapes import Shape


def rescaled(roots: Iterable[Expression]) -> list[Expression]:
    """The same expressions with known factors and summands put together.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, evaluate, leaf, ordered, trace
    >>> from bayesmc.passes.scaling import rescaled
    >>> root = trace(lambda x: (-0.5 * np.square(x / 2.0) - 3.0).sum(), [TracedArray(leaf("x", (3,)))])
    >>> (made,) = rescaled([root])
    >>> len(ordered(root)), len(ordered(made)), evaluate([made], {"x": np.ones(3)})
    (9, 7, [np.float64(-9.375)])
    """
    asked = list(roots)
    found: dict[Expression, _Scaled] = {}
    for node in ordered(*asked):
        found[node] = _read(node, [found[a] for a in node.operands])
    return [found[r].whole for r in asked]


# ---- private ------------------------------------------------------------------------------------

ONE, ZERO = np.float64(1.0), np.float64(0.0)


@dataclass(frozen=True, eq=False)
class _Scaled:
    """``scale * base + offset``, of a shape that all three broadcast to."""

    base: Expression
    shape: Shape
    scale: np.ndarray | np.float64 = ONE
    offset: np.ndarray | np.float64 = ZERO

    def __post_init__(self) -> None:
        for name in ("scale", "offset"):
            value = getattr(self, name)
            if np.ndim(value) and (value == value.flat[0]).all():
                object.__setattr__(self, name, np.float64(value.flat[0]))

    @property
    def factored(self) -> Expression:
        """Without the offset."""
        if np.all(self.scale == 1.0):
            return self.base
        if np.all(self.scale == -1.0):
            return elementwise(np.negative, self.base)
        return elementwise(np.multiply, self.base, self.scale)

    @property
    def whole(self) -> Expression:
        if np.all(self.offset == 0.0):
            return broadcast(self.factored, self.shape)
        if np.all(self.scale == -1.0):
            return broadcast(elementwise(np.subtract, self.offset, self.base), self.shape)
        return broadcast(elementwise(np.add, self.factored, self.offset), self.shape)

    @property
    def product(self) -> _Scaled:
        """With the offset put in."""
        if np.all(self.offset == 0.0):
            return self
        return _Scaled(self.whole, self.shape)


def _read(node: Expression, operands: list[_Scaled]) -> _Scaled:
    rule: Callable[..., _Scaled | None] | None = None
    if node.dtype == float:
        if isinstance(node, Elementwise):
            rule = _RULES.get(node.function)
        elif isinstance(node, Reduction) and node.ufunc is np.add:
            rule = _summed
        elif isinstance(node, Pick) and len(operands) == 1:
            rule = _picked
    if rule is not None and all(o.base.dtype == float or _is_number(o) for o in operands):
        found = rule(node, *operands)
        if found is not None:
            return found
    parts = [o.whole for o in operands]
    same = all(a is b for a, b in zip(parts, node.operands, strict=True))
    return _Scaled(node if same else node.with_operands(parts), node.shape)


def _is_number(operand: _Scaled) -> bool:
    return isinstance(operand.base, Constant) and operand.base.dtype.kind in "fi"


def _summand(operand: _Scaled) -> np.ndarray | None:
    """A known number that may be moved: a finite one."""
    if not isinstance(operand.base, Constant):
        return None
    value = operand.base.value * operand.scale + operand.offset
    return value if bool(np.isfinite(value).all()) else None


def _factor(operand: _Scaled) -> np.ndarray | None:
    """A known number that is nowhere 0, too."""
    value = _summand(operand)
    return value if value is not None and bool((value != 0).all()) else None


def _multiply(node: Expression, a: _Scaled, b: _Scaled) -> _Scaled | None:
    for one, other in ((a, b), (b, a)):
        factor = _factor(one)
        if factor is not None and not isinstance(other.base, Constant):
            return _Scaled(other.base, node.shape, other.scale * factor, other.offset * factor)
    a, b = a.product, b.product
    made = elementwise(np.multiply, a.base, b.base)
    return _Scaled(made, node.shape, a.scale * b.scale)


def _divide(node: Expression, a: _Scaled, b: _Scaled) -> _Scaled | None:
    divisor = _factor(b)
    if divisor is not None:
        return _Scaled(a.base, node.shape, a.scale / divisor, a.offset / divisor)
    b, factor = b.product, _factor(a)
    if factor is not None:
        return _Scaled(elementwise(np.divide, 1.0, b.base), node.shape, factor / b.scale)
    a = a.product
    return _Scaled(elementwise(np.divide, a.base, b.base), node.shape, a.scale / b.scale)


def _add(node: Expression, a: _Scaled, b: _Scaled) -> _Scaled | None:
    for one, other in ((a, b), (b, a)):
        if isinstance(one.base, Constant):
            summand = _summand(one)
            if summand is None:
                return None
            return _Scaled(other.base, node.shape, other.scale, other.offset + summand)
    offset = a.offset + b.offset
    same = np.array_equal(a.scale, b.scale)
    opposite = not same and np.array_equal(a.scale, -b.scale)
    if (same or opposite) and not np.ndim(a.scale):
        made = elementwise(np.add if same else np.subtract, a.base, b.base)
        return _Scaled(made, node.shape, a.scale, offset)
    made = elementwise(np.add, a.factored, b.factored)
    return _Scaled(made, node.shape, ONE, offset)


def _negative(node: Expression, a: _Scaled) -> _Scaled:
    return _Scaled(a.base, node.shape, -a.scale, -a.offset)


def _subtract(node: Expression, a: _Scaled, b: _Scaled) -> _Scaled | None:
    return _add(node, a, _Scaled(b.base, b.shape, -b.scale, -b.offset))


def _square(node: Expression, a: _Scaled) -> _Scaled | None:
    a = a.product
    return _Scaled(elementwise(np.square, a.base), node.shape, a.scale * a.scale)


def _power(node: Expression, a: _Scaled, b: _Scaled) -> _Scaled | None:
    exponent = _summand(b)
    is_two = exponent is not None and not np.ndim(exponent) and exponent == 2.0
    return _square(node, a) if is_two else None


def _summed(node: Expression, a: _Scaled) -> _Scaled | None:
    assert isinstance(node, Reduction)
    offset = np.add.reduce(np.broadcast_to(a.offset, a.shape), axis=node.axes)
    if np.ndim(a.scale) or a.base.shape != a.shape:
        base = broadcast(a.factored, a.shape)
        return _Scaled(_sum(base, node.axes), node.shape, ONE, offset)
    return _Scaled(_sum(a.base, node.axes), node.shape, a.scale, offset)


def _sum(node: Expression, axes: Sequence[int]) -> Expression:
    """A sum; what is the same along all axes is multiplied instead."""
    kept = tuple(n for k, n in enumerate(node.shape) if k not in axes)
    if math.prod(kept) == node.size:
        return reshape(node, kept)
    if isinstance(node, Elementwise) and node.function in (np.add, np.subtract):
        narrow = [_along(a, node.shape, axes) for a in node.operands]
        if any(narrow):
            parts = [
                elementwise(np.multiply, reshape(a, _without(a, node.shape, axes)), float(n))
                if n
                else _sum(broadcast(a, node.shape), axes)
                for a, n in zip(node.operands, narrow, strict=True)
            ]
            return elementwise(node.function, *parts)
    if isinstance(node, Elementwise) and node.function is np.multiply:
        for one, other in (node.operands, node.operands[::-1]):
            if isinstance(one, Constant) and not one.shape and other.shape == node.shape:
                return elementwise(np.multiply, _sum(other, axes), one)
    return reduction(np.add, node, axes)


def _along(operand: Expression, shape: Shape, axes: Sequence[int]) -> int:
    """How often an operand occurs in a sum where it is the same along all axes, otherwise 0."""
    own = (1,) * (len(shape) - len(operand.shape)) + operand.shape
    same = all(own[k] == 1 for k in axes) and all(
        own[k] == n for k, n in enumerate(shape) if k not in axes
    )
    return math.prod(shape[k] for k in axes) if same else 0


def _without(operand: Expression, shape: Shape, axes: Sequence[int]) -> Shape:
    return tuple(n for k, n in enumerate(shape) if k not in axes)


def _picked(node: Expression, a: _Scaled) -> _Scaled | None:
    assert isinstance(node, Pick)
    if a.base.shape != a.shape:
        return None
    parts = [
        p if not np.ndim(p) else np.broadcast_to(p, a.shape).reshape(-1)[node.positions]
        for p in (a.scale, a.offset)
    ]
    return _Scaled(pick([a.base], node.positions), node.shape, *parts)


_RULES: Mapping[object, Callable[..., _Scaled | None]] = {
    np.multiply: _multiply,
    np.divide: _divide,
    np.add: _add,
    np.subtract: _subtract,
    np.negative: _negative,
    np.square: _square,
    np.power: _power,
}
