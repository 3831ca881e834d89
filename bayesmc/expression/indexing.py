"""What an index picks, and between which whole numbers it lies, as far as its expression tells."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression.graph import (
    Constant,
    Elementwise,
    Expression,
    Gather,
    Leaf,
    Pick,
    as_expression,
    broadcast,
    cast,
    elementwise,
    gather,
    ordered,
    pick,
    reshape,
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
    >>> from bayesmc.expression.indexing import bounds
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


def indexed(value: Expression, key: Any) -> Expression:
    """``value[key]``."""
    keys = [_plain_key(k) for k in (key if isinstance(key, tuple) else (key,))]
    if not any(isinstance(k, Expression) for k in keys):
        at = np.arange(value.size).reshape(value.shape)[tuple(keys)]
        return pick([value], at)
    if not isinstance(value, Constant):
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
        at = as_expression(k)
        if at.dtype.kind != "i":
            raise TraceError("an index that is not a whole number")
        at = within(counted_from_end(at, size), size)
        rows = elementwise(np.add, elementwise(np.multiply, rows, size), at)
    rest = value.shape[len(lead) :]
    table = reshape(value, (-1, *rest)) if value.size else value
    found = gather(table, rows)
    left = tuple(keys[len(lead) :])
    if not left:
        return found
    at = np.arange(found.size).reshape(found.shape)
    return pick([found], at[(slice(None),) * len(rows.shape) + left])


def assigned(value: Expression, key: Any, new: Expression) -> Expression:
    """The array after ``value[key] = new``."""
    keys = tuple(_plain_key(k) for k in (key if isinstance(key, tuple) else (key,)))
    if any(isinstance(k, Expression) for k in keys):
        raise TraceError("an array is written to at places that vary")
    at = np.arange(value.size).reshape(value.shape)
    places = at[keys]
    given = broadcast(cast(new, value.dtype), places.shape)
    at = at.copy()
    at[keys] = value.size + np.arange(given.size).reshape(given.shape)
    return pick([value, given], at)


# ---- private ------------------------------------------------------------------------------------


def _plain_key(key: Any) -> Any:
    """A key as NumPy takes it, or the expression that it is."""
    if isinstance(key, list) and _holds_expressions(key):
        raise TraceError("an index is a list that varies")
    known = getattr(key, "expression", key)
    return known.value if isinstance(known, Constant) else known


def _holds_expressions(value: Any) -> bool:
    if isinstance(value, list):
        return any(map(_holds_expressions, value))
    return hasattr(value, "expression")


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
