"""Which element of a leaf's plates each entry of an expression reads, where it reads no more than one."""

from __future__ import annotations

import numpy as np

from bayesmc.expression import Elementwise, Expression, Gather, Leaf, Pick, Reduction, ordered

#: an entry reads nothing of the leaf, or more than one element
NOTHING, MANY = -1, -2


def elements(root: Expression, name: str, count: int) -> np.ndarray:
    """The element of a leaf that each entry of an expression depends on.

    Parameters
    ----------
    root : Expression
    name : str
        A leaf, whose values are those of ``count`` elements, one after the other.
    count : int

    Returns
    -------
    ndarray of int
        Of the root's shape: an element, ``NOTHING`` or ``MANY``.

    Examples
    --------
    >>> from bayesmc.expression import gather, leaf, pick
    >>> from bayesmc.passes.elements import elements
    >>> elements(pick([leaf("x", (3,))], [2, 0, 0, 1]), "x", 3)
    array([2, 0, 0, 1])
    >>> elements(gather(leaf("x", (3,)), leaf("k", (2,), int)), "x", 3)
    array([-2, -2])
    """
    found: dict[Expression, np.ndarray] = {}
    for node in ordered(root):
        if name not in node.leaves:
            found[node] = np.full(node.shape, NOTHING)
        elif isinstance(node, Leaf):
            found[node] = np.arange(node.size).reshape(node.shape) // max(node.size // count, 1)
        else:
            found[node] = _passed_on(node, [found[a] for a in node.operands])
    return found[root]


def merged(parts: np.ndarray, axes: int | tuple[int, ...] | None = None) -> np.ndarray:
    """What entries along some axes read together."""
    most = np.iinfo(np.intp).max
    low = np.min(np.where(parts == NOTHING, most, parts), axis=axes, initial=most)
    high = np.max(parts, axis=axes, initial=NOTHING)
    some = np.where((low == high) & (low >= 0), high, MANY)
    return np.where((parts == NOTHING).all(axis=axes), NOTHING, some)


# ---- private ------------------------------------------------------------------------------------


def _passed_on(node: Expression, inner: list[np.ndarray]) -> np.ndarray:
    if isinstance(node, Elementwise):
        return merged(np.stack(np.broadcast_arrays(*inner)), 0)
    if isinstance(node, Pick):
        return np.concatenate([part.reshape(-1) for part in inner])[node.positions]
    if isinstance(node, Reduction):
        return merged(inner[0], node.axes)
    if isinstance(node, Gather):
        table, rows = inner
        entry = np.broadcast_to(merged(table, 0), node.shape)
        at = np.broadcast_to(rows.reshape(rows.shape + (1,) * (table.ndim - 1)), node.shape)
        return merged(np.stack([entry, at]), 0)
    whole = merged(np.concatenate([part.reshape(-1) for part in inner]), 0)
    return np.broadcast_to(whole, node.shape)
