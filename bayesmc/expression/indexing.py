"""What an index picks, and between which whole numbers it lies, as far as its expression tells."""

from __future__ import annotations

import math
from itertools import takewhile
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
    """``value[key]`` as NumPy has it, whole numbers that vary among the keys included.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import evaluate, leaf
    >>> from bayesmc.expression.indexing import indexed
    >>> found = indexed(leaf("x", (1, 3)), (..., 0, leaf("year", (4,), int)))
    >>> evaluate([found], {"x": np.array([[5.0, 6.0, 7.0]]), "year": np.array([2, 0, 0, -1])})
    [array([7., 5., 5., 7.])]
    """
    keys = [_plain_key(k) for k in (key if isinstance(key, tuple) else (key,))]
    if not any(isinstance(k, Expression) for k in keys):
        at = np.arange(value.size).reshape(value.shape)[tuple(keys)]
        return pick([value], at)
    return _looked_up(value, keys)


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


def _looked_up(value: Expression, keys: list[Any]) -> Expression:
    """``value[keys]`` where some keys vary: one gather along the axes that these stand at."""
    keys = [k if _is_basic(k) else as_expression(k) for k in keys]
    if any(isinstance(k, Expression) and k.dtype.kind != "i" for k in keys):
        raise TraceError("an index that is not a whole number")
    numbers = [n for n, k in enumerate(keys) if _is_number(k)]
    are_apart = numbers != list(range(numbers[0], numbers[-1] + 1))
    keys = _expanded(keys, len(value.shape))
    at = np.arange(value.size).reshape(value.shape)
    at = at[tuple(slice(None) if isinstance(k, Expression) else k for k in keys)]
    left = [k for k in keys if isinstance(k, Expression) or not _is_number(k)]
    along = [n for n, k in enumerate(left) if isinstance(k, Expression)]
    rest = [n for n in range(at.ndim) if n not in along]
    rows: Expression | None = None
    for n in along:
        size = at.shape[n]
        one = within(counted_from_end(left[n], size), size)
        rows = (
            one if rows is None else elementwise(np.add, elementwise(np.multiply, rows, size), one)
        )
    lead = math.prod(at.shape[n] for n in along)
    at = at.transpose(along + rest).reshape(lead, *(at.shape[n] for n in rest))
    found = gather(pick([value], at), rows)
    before = list(takewhile(lambda k: not _is_number(k), keys))
    ahead = 0 if are_apart else len(before)  # NumPy puts what numbers that stand apart pick first
    if not ahead:
        return found
    ndim = len(found.shape) - len(rest)
    order = np.arange(found.size).reshape(found.shape)
    return pick([found], np.moveaxis(order, range(ndim), range(ahead, ahead + ndim)))


def _is_basic(key: Any) -> bool:
    """Whether a key picks by itself, whatever the others are."""
    if isinstance(key, (bool, np.bool_)):
        return False
    return key is None or key is Ellipsis or isinstance(key, (slice, int, np.integer))


def _is_number(key: Any) -> bool:
    """Whether a key is no slice, new axis or ellipsis."""
    return key is not None and key is not Ellipsis and not isinstance(key, slice)


def _expanded(keys: list[Any], ndim: int) -> list[Any]:
    """Keys with one for every axis."""
    gaps = [n for n, k in enumerate(keys) if k is Ellipsis]
    missing = ndim - sum(k is not None and k is not Ellipsis for k in keys)
    if len(gaps) > 1 or missing < 0:
        raise TraceError(f"an index of {len(keys)} parts into an array of {ndim} axes")
    at = gaps[0] if gaps else len(keys)
    return [*keys[:at], *[slice(None)] * missing, *keys[at + len(gaps) :]]


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
