"""Picks and gathers moved down to the leaf: ``(2 * mean)[label]`` as ``2 * mean[label]``.

Element-wise functions commute with a choice of elements, so afterwards all that is done to an element of
the leaf is done to the element itself.
"""

from __future__ import annotations

from collections.abc import Callable

from bayesmc.expression import (
    Elementwise,
    Expression,
    Gather,
    Leaf,
    Pick,
    broadcast,
    gather,
    ordered,
    pick,
)

Select = Callable[[Expression], Expression]


def sunk(root: Expression, name: str) -> Expression:
    """The expression with all choices of elements that concern a leaf as near to it as they can be.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, leaf, trace
    >>> from bayesmc.passes.sinking import sunk
    >>> x = TracedArray(leaf("x", (3,)))
    >>> found = trace(lambda x: np.exp(2 * x)[..., 1], [x])
    >>> found, sunk(found, "x")
    (<Pick ()>, <Elementwise exp ()>)
    """
    found: dict[Expression, Expression] = {}
    for node in ordered(root):
        operands = [found[a] for a in node.operands]
        same = all(a is b for a, b in zip(operands, node.operands, strict=True))
        made = node if same else node.with_operands(operands)
        found[node] = _sunk(made, name)
    return found[root]


# ---- private ------------------------------------------------------------------------------------


def _sunk(node: Expression, name: str) -> Expression:
    if name not in node.leaves or not isinstance(node, (Pick, Gather)):
        return node
    first = node.operands[0]
    if not isinstance(first, Elementwise) or (isinstance(node, Pick) and len(node.operands) > 1):
        return node
    if isinstance(node, Gather) and name in node.rows.leaves:
        return node

    def select(part: Expression) -> Expression:
        whole = broadcast(part, first.shape)
        if isinstance(node, Pick):
            return pick([whole], node.positions)
        assert isinstance(node, Gather)
        return gather(whole, node.rows)

    made = first.with_operands([_sunk(select(a), name) for a in first.operands])
    return broadcast(made, node.shape)


def reads(root: Expression, name: str) -> list[Expression]:
    """The expressions through which a leaf comes in: itself, or elements chosen from it.

    After ``sunk``; the leaf itself, or a pick or gather of it that reads nothing else.
    """
    found: dict[Expression, None] = {}
    chosen: dict[Expression, bool] = {}
    for node in ordered(root):
        if isinstance(node, Leaf):
            chosen[node] = node.name == name
        elif isinstance(node, Pick):
            chosen[node] = all(chosen[a] for a in node.operands)
        elif isinstance(node, Gather):
            chosen[node] = chosen[node.table] and name not in node.rows.leaves
        else:
            chosen[node] = False
        if not chosen[node]:
            found.update(dict.fromkeys(a for a in node.operands if chosen[a]))
    if chosen[root]:
        found[root] = None
    return list(found)
