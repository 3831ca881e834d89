"""Branches moved up: ``log(np.where(s, p, q))`` as ``np.where(s, log(p), log(q))``.

Afterwards what is done to a leaf in one branch stands apart from what is done in the other.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.expression import (
    Constant,
    Elementwise,
    Expression,
    Gather,
    Pick,
    Reduction,
    broadcast,
    elementwise,
    gather,
    pick,
)
from bayesmc.expression.graph import CASTS
from bayesmc.expression.indexing import bounds
from bayesmc.passes.arithmetic import rewritten, tidy
from bayesmc.passes.reads import same_along

#: branches in one operation, at most
_MOST = 6


def branches_up(root: Expression, name: str) -> Expression:
    """The expression with branches that concern a leaf as near to the root as they can be.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, leaf, trace
    >>> from bayesmc.passes.branches import branches_up
    >>> p, s = TracedArray(leaf("p", ())), TracedArray(leaf("s", (), bool))
    >>> found = trace(lambda p, s: np.log(np.where(s, p, 0.5)), [p, s])
    >>> found, branches_up(found, "p")
    (<Elementwise log ()>, <Elementwise where ()>)
    """
    return rewritten([root], lambda node, new: _up(node.with_operands(new), name))[0]


# ---- private ------------------------------------------------------------------------------------


def _is_branch(node: Expression, name: str) -> bool:
    if not isinstance(node, Elementwise) or node.function is not np.where:
        return False
    condition, first, second = node.operands
    return name not in condition.leaves and name in first.leaves | second.leaves


def _up(node: Expression, name: str, depth: int = 0) -> Expression:
    if name not in node.leaves:
        return node
    if _is_branch(node, name):
        return _decided(node)
    if depth > _MOST:
        return node
    for k, operand in enumerate(node.operands):
        if _is_branch(operand, name):
            return _over(node, k, name, depth)
    return node


def _over(node: Expression, k: int, name: str, depth: int) -> Expression:
    """An operation on a branch as a branch of operations."""
    branch = node.operands[k]
    condition = branch.operands[0]

    def of(part: Expression) -> Expression:
        operands = [*node.operands]
        operands[k] = broadcast(part, branch.shape)
        return _up(node.with_operands(operands), name, depth + 1)

    wide = broadcast(condition, branch.shape)
    moved: Any = None
    if isinstance(node, Elementwise):
        # the operands of a branch that is itself one stay in their places
        moved = condition
        if node.function is np.where and k == 0:
            return node
    elif isinstance(node, Pick) and len(node.operands) == 1:
        moved = pick([wide], node.positions)
    elif isinstance(node, Gather) and k == 0:
        moved = gather(wide, node.rows)
    elif isinstance(node, Reduction) and node.ufunc is np.add:
        moved = same_along(wide, node.axes)
    if moved is None:
        return node
    first, second = (of(part) for part in branch.operands[1:])
    return _decided(tidy(np.where, broadcast(moved, node.shape), first, second))


def _decided(node: Expression) -> Expression:
    """A branch, or the only part of it that can be."""
    if not isinstance(node, Elementwise) or node.function is not np.where:
        return node
    condition, first, second = node.operands
    truth = _truth(condition)
    if truth is None:
        return node
    chosen = first if truth else second
    real = chosen if chosen.dtype == node.dtype else elementwise(_cast(node), chosen)
    return broadcast(real, node.shape)


def _cast(node: Expression) -> Any:
    return next(f for f, d in CASTS.items() if d == node.dtype)


def _truth(condition: Expression) -> bool | None:
    """Whether a condition is always true, or never; None where it may be both."""
    if isinstance(condition, Constant):
        value = condition.value
        return bool(value.flat[0]) if value.size and (value == value.flat[0]).all() else None
    if isinstance(condition, Pick) and len(condition.operands) == 1:
        return _truth(condition.operands[0])
    if not isinstance(condition, Elementwise):
        return None
    if condition.function in (np.logical_and, np.bitwise_and, np.logical_or, np.bitwise_or):
        inner = [_truth(a) for a in condition.operands]
        ends = condition.function in (np.logical_or, np.bitwise_or)
        if ends in inner:
            return ends
        return None if None in inner else not ends
    if condition.function in (np.equal, np.not_equal):
        first, second = map(bounds, condition.operands)
        if first is not None and second is not None:
            if first[1] < second[0] or second[1] < first[0]:
                return condition.function is np.not_equal
    return None
