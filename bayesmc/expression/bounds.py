"""Between which whole numbers an index lies, as far as its expression tells."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.expression.graph import (
    Constant,
    Elementwise,
    Expression,
    Gather,
    Leaf,
    Pick,
    elementwise,
    ordered,
)

Bounds = tuple[int, int]

#: an index that no table has
_NOWHERE = -(2**40)


def bounds(root: Expression) -> Bounds | None:
    """The least and the largest value that an expression of whole numbers can have, or None.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import elementwise, leaf
    >>> from bayesmc.expression.bounds import bounds
    >>> bounds(elementwise(np.subtract, leaf("die", (), int, states=6), 1))
    (-1, 4)
    """
    found: dict[Expression, Bounds | None] = {}
    for node in ordered(root):
        found[node] = _bounds(node, [found[a] for a in node.operands])
    return found[root]


def within(index: Expression, size: int) -> Expression:
    """The index as it is where it is one of 0..size-1, otherwise one that is an error to look up."""
    known = bounds(index)
    if known is not None and known[0] >= 0 and known[1] < size:
        return index
    low, high = elementwise(np.less, index, 0), elementwise(np.greater_equal, index, size)
    return elementwise(np.where, elementwise(np.logical_or, low, high), _NOWHERE, index)


def counted_from_end(index: Expression, size: int) -> Expression:
    """The index with negative ones counted from the end, as NumPy does it."""
    known = bounds(index)
    if known is not None and known[0] >= 0:
        return index
    back = elementwise(np.where, elementwise(np.less, index, 0), size, 0)
    return elementwise(np.add, index, back)


# ---- private ------------------------------------------------------------------------------------


def _bounds(node: Expression, inner: list[Bounds | None]) -> Bounds | None:
    if isinstance(node, Constant):
        if node.dtype.kind not in "ib" or not node.size:
            return None
        return int(node.value.min()), int(node.value.max())
    if node.dtype.kind == "b":
        return 0, 1
    if isinstance(node, Leaf):
        return None if node.states is None else (0, max(node.states - 1, 0))
    if isinstance(node, Gather):
        return inner[0]
    if isinstance(node, Elementwise) and node.function is np.where:
        inner = inner[1:]
    if any(b is None for b in inner):
        return None
    ends: list[Any] = inner
    if isinstance(node, Pick) or (isinstance(node, Elementwise) and node.function is np.where):
        return min(b[0] for b in ends), max(b[1] for b in ends)
    if not isinstance(node, Elementwise):
        return None
    rule = _RULES.get(node.function)
    return None if rule is None or node.dtype.kind != "i" else rule(*ends)


def _product(a: Bounds, b: Bounds) -> Bounds:
    corners = [x * y for x in a for y in b]
    return min(corners), max(corners)


_RULES: dict[Any, Any] = {
    np.add: lambda a, b: (a[0] + b[0], a[1] + b[1]),
    np.subtract: lambda a, b: (a[0] - b[1], a[1] - b[0]),
    np.multiply: _product,
    np.negative: lambda a: (-a[1], -a[0]),
    np.minimum: lambda a, b: (min(a[0], b[0]), min(a[1], b[1])),
    np.maximum: lambda a, b: (max(a[0], b[0]), max(a[1], b[1])),
    np.remainder: lambda a, b: (0, b[1] - 1) if b[0] > 0 else None,
}
