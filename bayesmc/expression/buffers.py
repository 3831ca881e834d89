"""Which arrays of a program are of no use any more: to be written over by the next result, or let go.

An array that nothing reads later is the place for a result of its shape. Large arrays that live on to the end
of a call cost more than what is computed with them: memory that is not at hand has to be fetched from the
system, page by page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.expression.graph import (
    Call,
    Constant,
    Elementwise,
    Expression,
    Leaf,
    Pick,
    ordered,
)

#: numbers from which on it pays
LARGE = 512


class Buffers:
    """The arrays of a program for known shapes.

    Parameters
    ----------
    roots : sequence of Expression
    values : mapping
        Node -> a value of it.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import elementwise, leaf
    >>> from bayesmc.expression.buffers import Buffers
    >>> x = leaf("x", (600,))
    >>> twice = elementwise(np.multiply, x, 2.0)
    >>> root = elementwise(np.exp, twice)
    >>> values = dict.fromkeys((x, twice, root), np.ones(600))
    >>> buffers = Buffers([root], values)
    >>> buffers.place_for(twice), buffers.place_for(root) is twice
    (None, True)
    """

    def __init__(self, roots: Sequence[Expression], values: Mapping[Expression, Any]) -> None:
        self._values = values
        self._nodes = ordered(*roots)
        #: node -> those whose array its own may be a view of
        self._owners: dict[Expression, frozenset[Expression]] = {}
        for node in self._nodes:
            viewed = node.operands if isinstance(node, (Pick, Call)) else ()
            own = frozenset((node,))
            self._owners[node] = own.union(*(self._owners[a] for a in viewed))
        #: node -> the last that reads it, or a view of it
        self._last: dict[Expression, Expression] = {}
        for node in self._nodes:
            for operand in node.operands:
                self._last.update(dict.fromkeys(self._owners[operand], node))
        self._kept = frozenset().union(*(self._owners[r] for r in roots))
        self._ending: dict[Expression, list[Expression]] = {}
        for node, last in self._last.items():
            if node not in self._kept and not isinstance(node, (Leaf, Constant)):
                self._ending.setdefault(last, []).append(node)

    def place_for(self, node: Expression) -> Expression | None:
        """The operand whose array a result may be written to."""
        if not isinstance(node, Elementwise) or not isinstance(node.function, np.ufunc):
            return None
        if node.dtype != float or not self._is_whole(node):
            return None
        shape = np.shape(self._values[node])
        for operand in node.operands:
            if (
                operand in self._ending.get(node, ())
                and isinstance(operand, Elementwise)
                and operand.dtype == float
                and np.shape(self._values[operand]) == shape
                and self._is_whole(operand)
            ):
                return operand
        return None

    def over_with(self, node: Expression) -> list[Expression]:
        """Large arrays that nothing reads after a node."""
        return [n for n in self._ending.get(node, ()) if np.size(self._values[n]) >= LARGE]

    # ---- private -------------------------------------------------------------------------------

    def _is_whole(self, node: Expression) -> bool:
        """Whether its array is a large one that lies in order."""
        value = self._values[node]
        return (
            isinstance(value, np.ndarray) and value.size >= LARGE and bool(value.flags.c_contiguous)
        )
