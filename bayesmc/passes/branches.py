"""Branches moved up: ``log(np.where(s, p, q))`` as ``np.where(s, log(p), log(q))``.

Afterwards what is done to a leaf in one branch stands apart from what is done in the other. Branches between
few constants say what is possible.
"""

from __future__ import annotations

import itertools
import math
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
#: values by which a factor is seen to be a constraint, at most
_LEVELS = 4


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


def is_constraint(log_factor: Expression) -> bool:
    """Whether a log factor only says what is possible: it is minus infinity, or always the same number.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, leaf, trace
    >>> from bayesmc.passes.branches import is_constraint
    >>> x = TracedArray(leaf("x", (2,)))
    >>> is_constraint(trace(lambda x: np.where(x[..., 0] < x[..., 1], 0.0, -np.inf), [x]))
    True
    >>> is_constraint(trace(lambda x: np.where(x[..., 0] < 4.0, 0.0, 12.0), [x]))
    False
    """
    found = _levels(log_factor)
    return found is not None and len(found - {-math.inf}) <= 1


# ---- private ------------------------------------------------------------------------------------


def _levels(node: Expression) -> frozenset[float] | None:
    """All values that an expression can take, where these are few and can be seen."""
    if isinstance(node, Constant):
        values = np.unique(node.value)
        return frozenset(values.tolist()) if values.size <= _LEVELS else None
    if node.dtype.kind == "b":
        return frozenset((False, True))
    if isinstance(node, Gather):
        return _levels(node.operands[0])
    if not isinstance(node, Elementwise):
        return None
    skipped = 1 if node.function is np.where else 0
    levels = [_levels(operand) for operand in node.operands[skipped:]]
    if any(found is None for found in levels):
        return None
    known = [found for found in levels if found is not None]
    if skipped:
        return known[0] | known[1]
    if math.prod(map(len, known)) > _LEVELS**2:
        return None
    with np.errstate(all="ignore"):
        reached = frozenset(float(node.function(*at)) for at in itertools.product(*known))
    return reached if len(reached) <= _LEVELS else None


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
