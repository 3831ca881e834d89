"""One more axis in front: an expression for each of many values of its leaves.

With like expressions (``passes.templates``) this makes one of them all, the group in front of their shape.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayesmc.expression import (
    Call,
    Elementwise,
    Expression,
    Gather,
    Leaf,
    Pick,
    Reduction,
    broadcast,
    call,
    elementwise,
    gather,
    ordered,
    pick,
    reduction,
    reshape,
)


def widened(root: Expression, values: Mapping[str, Expression], count: int) -> Expression:
    """An expression with many values of some leaves.

    Parameters
    ----------
    root : Expression
    values : mapping
        Leaf -> ``(count, *shape)``.
    count : int

    Returns
    -------
    Expression, shape (count, *shape of the root)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, as_expression, leaf, trace
    >>> from bayesmc.passes.widening import widened
    >>> x = TracedArray(leaf("x", (2,)))
    >>> found = trace(lambda x: np.sum(2 * x, axis=-1), [x])
    >>> widened(found, {"x": as_expression([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])}, 3)
    <Constant [ 6. 14. 22.] (3,)>
    """
    found: dict[Expression, Expression] = {}
    for node in ordered(root):
        if not node.leaves & set(values):
            continue
        if isinstance(node, Leaf):
            found[node] = values[node.name]
        else:
            found[node] = _wide(node, found, count)
    return found[root] if root in found else broadcast(root, (count, *root.shape))


# ---- private ------------------------------------------------------------------------------------


def _wide(node: Expression, found: Mapping[Expression, Expression], count: int) -> Expression:
    operands = [found.get(a) for a in node.operands]
    if isinstance(node, Elementwise):
        rank = len(node.shape)
        parts = [
            a if wide is None else reshape(wide, (count, *(1,) * (rank - len(a.shape)), *a.shape))
            for a, wide in zip(node.operands, operands, strict=True)
        ]
        return elementwise(node.function, *parts)
    whole = [
        broadcast(a, (count, *a.shape)) if wide is None else wide
        for a, wide in zip(node.operands, operands, strict=True)
    ]
    if isinstance(node, Pick):
        sizes = np.array([a.size for a in node.operands])
        ends = np.cumsum(sizes)
        which = np.searchsorted(ends, node.positions, side="right")
        inner = node.positions - (ends - sizes)[which]
        group = np.arange(count).reshape((count,) + (1,) * node.positions.ndim)
        return pick(whole, (count * (ends - sizes))[which] + group * sizes[which] + inner)
    if isinstance(node, Gather):
        if operands[0] is None:
            return gather(node.table, whole[1])
        table, rows = whole
        size = node.table.shape[0]
        flat = reshape(table, (count * size, *table.shape[2:]))
        first = size * np.arange(count).reshape((count,) + (1,) * len(node.rows.shape))
        return gather(flat, elementwise(np.add, rows, first))
    if isinstance(node, Reduction):
        return reduction(node.ufunc, whole[0], [a + 1 for a in node.axes])
    assert isinstance(node, Call)
    return call(node.call, whole, (count, *node.shape), node.dtype)
