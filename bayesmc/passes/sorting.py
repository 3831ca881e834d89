"""Orders of few numbers as comparisons, for who knows no sorting."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from bayesmc.expression import Call, Expression, elementwise, reduction, reshape
from bayesmc.expression.functions import Repeated
from bayesmc.passes.arithmetic import rewritten

#: numbers up to which each is compared with each
FEW = 8


def by_comparisons(roots: Iterable[Expression]) -> list[Expression]:
    """The same expressions, with ``np.argsort`` of few numbers by their ranks.

    Equal numbers stay in their order, and NaN goes to the end: a stable sort, which is one of those that
    ``argsort`` may give.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, evaluate, leaf
    >>> from bayesmc.passes.sorting import by_comparisons
    >>> root = np.argsort(TracedArray(leaf("x", (4,)))).expression
    >>> evaluate(by_comparisons([root]), {"x": np.array([2.0, np.nan, 2.0, -1.0])})[0]
    array([3, 0, 2, 1])
    """

    def change(node: Expression, operands: list[Expression]) -> Expression | None:
        if not isinstance(node, Call) or not _is_order(node):
            return None
        (x,) = operands
        *lead, size = x.shape
        one, other = reshape(x, (*lead, size, 1)), reshape(x, (*lead, 1, size))
        places = np.arange(size)
        first = places < places[:, None]  # of equal ones, those that stand before
        gone, theirs = (elementwise(np.isnan, v) for v in (one, other))
        tied = elementwise(np.logical_or, _both(gone, theirs), elementwise(np.equal, one, other))
        below = elementwise(
            np.logical_or,
            elementwise(np.less, other, one),
            _both(gone, elementwise(np.logical_not, theirs)),
        )
        ahead = elementwise(np.logical_or, below, _both(tied, first))
        counted = elementwise(np.where, ahead, 1, 0)
        ranks = reshape(reduction(np.add, counted, [len(lead) + 1]), (*lead, 1, size))
        here = elementwise(np.where, elementwise(np.equal, ranks, places[:, None]), places, 0)
        return reduction(np.add, here, [len(lead) + 1])

    return rewritten(list(roots), change)


# ---- private ------------------------------------------------------------------------------------


def _both(a: Expression, b: Expression | np.ndarray) -> Expression:
    return elementwise(np.logical_and, a, b)


def _is_order(node: Call) -> bool:
    """Whether it is an ``argsort`` of few real numbers along the last axis."""
    made = node.call
    if not isinstance(made, Repeated) or made.function is not np.argsort or made.slots != [0]:
        return False
    (x,) = node.operands
    if not x.shape or not 0 < x.shape[-1] <= FEW or x.dtype != float:
        return False
    axis = made.kwargs.get("axis", -1)
    return axis == -1 and set(made.kwargs) <= {"axis", "kind", "order", "stable"}
