"""Hidden continuous nodes as coordinates that get a Gaussian: as they are where they are real, else mapped.

What lies between bounds, or sums to one, is described by the free numbers of its transform; the map and its
change of volume become part of the densities that read it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions.transforms import Identity, Transform, transform_of
from bayesmc.engines.propagation.scores import NormalScores, scores_of
from bayesmc.errors import UnsupportedError
from bayesmc.expression import (
    Constant,
    Elementwise,
    Expression,
    Leaf,
    Pick,
    TracedArray,
    as_expression,
    broadcast,
    leaf,
)
from bayesmc.expression.functions import expression_of
from bayesmc.network import CompiledNode, Model, Observed
from bayesmc.passes.arithmetic import rewritten
from bayesmc.structure.reading import hidden_elements


@dataclass(frozen=True, eq=False)
class Numbers:
    """The coordinates of a node.

    Attributes
    ----------
    node : CompiledNode
    transform : Transform
    at : ndarray of int, shape (elements, d)
        Place of each free number among all coordinates; -1 of what is observed.
    seen : ndarray, shape (elements, d)
        Free numbers of what is observed.
    """

    node: CompiledNode
    transform: Transform
    at: np.ndarray
    seen: np.ndarray

    @property
    def is_plain(self) -> bool:
        """Whether coordinates are the node's own numbers."""
        return isinstance(self.transform, Identity)

    @property
    def is_score(self) -> bool:
        """Whether coordinates are normal scores, whose prior is exact."""
        return isinstance(self.transform, NormalScores)

    @property
    def leaf(self) -> Expression:
        """Its free numbers in expressions, shape ``(*plates, *own)``."""
        shape = self.node.plate_shape + self.transform.unconstrained_shape
        return leaf(self.node.name if self.is_plain else f"{self.node.name} free", shape)

    @property
    def value(self) -> Expression:
        """Its stored values, of the free numbers."""
        if self.is_plain:
            return self.leaf
        made = expression_of(self.transform.formula(TracedArray(self.leaf)))
        return broadcast(made, self.node.value_shape)

    @property
    def volume(self) -> Expression:
        """Log of the change of volume of each element."""
        made = expression_of(self.transform.log_det_formula(TracedArray(self.leaf)))
        return broadcast(made, self.node.plate_shape)

    def inside(self, root: Expression) -> Expression:
        """An expression in which comparisons of its values with the bounds of its support are decided."""
        support = self.node.support
        if self.is_plain or support is None or support.kind != "interval":
            return root
        low, high = (np.asarray(b, dtype=float) for b in (support.low, support.high))

        def decided(node: Expression, new: list[Expression]) -> Expression | None:
            if not isinstance(node, Elementwise) or len(new) != 2:
                return None
            turned = _TURNED.get(node.function)
            first, second = new
            for value, other, compare in ((first, second, node.function), (second, first, turned)):
                if not _is_choice(value, self.node.name) or not isinstance(other, Constant):
                    continue
                if compare in (np.greater, np.greater_equal) and (other.value <= low.min()).all():
                    return broadcast(as_expression(True), node.shape)
                if compare in (np.less, np.less_equal) and (other.value >= high.max()).all():
                    return broadcast(as_expression(True), node.shape)
            return None

        return rewritten([root], decided)[0]

    def whole(self, free: np.ndarray) -> np.ndarray:
        """Stored values, shape ``(draws, *plates, *event)``, of hidden coordinates ``(draws, all)``."""
        own = np.where(self.at >= 0, free[:, np.maximum(self.at, 0)], self.seen)
        shape = self.node.plate_shape + self.transform.unconstrained_shape
        return self.transform.constrain(own.reshape(len(free), *shape))

    def freed(self, values: np.ndarray) -> np.ndarray:
        """Free numbers of stored values, shape ``(draws, elements, d)``."""
        free = self.transform.unconstrain(values)
        return free.reshape(len(values), *self.at.shape)


_TURNED: dict[Any, Any] = {
    np.greater: np.less, np.greater_equal: np.less_equal,
    np.less: np.greater, np.less_equal: np.greater_equal,
}  # fmt: skip


def numbers_of(
    model: Model, nodes: Sequence[CompiledNode], observed: Mapping[str, Observed]
) -> dict[str, Numbers]:
    """Coordinates of some hidden continuous nodes, one after the other.

    Raises
    ------
    UnsupportedError
        Bounds that depend on parents, and vectors seen in part.
    """
    found: dict[str, Numbers] = {}
    start = 0
    for node in nodes:
        if node.support is None:
            raise UnsupportedError(
                f"ExpectationPropagation: the bounds of node {node.name!r} depend on its parents; declare it "
                "with fixed bounds and scale it where it is read"
            )
        if node.angles is not None:
            raise UnsupportedError(
                f"ExpectationPropagation: node {node.name!r} is an angle, which no message here describes"
            )
        seen = observed.get(node.name)
        if seen is not None and seen.parts is not None:
            raise UnsupportedError(
                f"ExpectationPropagation: vectors of node {node.name!r} are observed in part; split it into "
                "nodes of its parts"
            )
        transform = transform_of(node.support, node.event_shape)
        if not isinstance(transform, Identity):
            transform = scores_of(model, node.name) or transform
        count, d = math.prod(node.plate_shape), math.prod(transform.unconstrained_shape)
        hidden = hidden_elements(node, seen)
        at = np.full((count, d), -1)
        at[hidden] = start + np.arange(len(hidden) * d).reshape(len(hidden), d)
        start += len(hidden) * d
        known = np.zeros((count, d))
        if seen is not None:
            free = transform.unconstrain(np.broadcast_to(seen.value, node.value_shape))
            known = np.where(at < 0, free.reshape(count, d), 0.0)
        found[node.name] = Numbers(node, transform, at, known)
    return found


# ---- private ------------------------------------------------------------------------------------


def _is_choice(node: Expression, name: str) -> bool:
    """Whether an expression is elements of one leaf."""
    while isinstance(node, Pick) and len(node.operands) == 1:
        node = node.operands[0]
    return isinstance(node, Leaf) and node.name == name
