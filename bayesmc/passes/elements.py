"""Expressions of a few elements as expressions of one each: many short vectors side by side are long ones.

NumPy works along the last axis, so a batch of vectors of three numbers is slow, and three batches of numbers
are not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np

from bayesmc.expression import (
    Constant,
    Elementwise,
    Expression,
    Leaf,
    Pick,
    Reduction,
    as_expression,
    elementwise,
    leaf,
    ordered,
)
from bayesmc.passes.arithmetic import add, multiply

#: elements of one expression, and of all together, up to which they are taken apart
FEW, MOST = 8, 400

#: with rules for 0 and 1
_TIDY: dict[Any, Any] = {np.add: add, np.multiply: multiply}


def by_element(roots: Sequence[Expression]) -> list[np.ndarray] | None:
    """The elements of each root, arrays of expressions; None where they are many, or hang together.

    Element ``k`` of a leaf, in C order, is the leaf ``element_of(name, k)``.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import elementwise, leaf
    >>> from bayesmc.passes.elements import by_element
    >>> by_element([elementwise(np.exp, leaf("x", (2,)))])
    [array([<Elementwise exp ()>, <Elementwise exp ()>], dtype=object)]
    """
    nodes = ordered(*roots)
    if sum(n.size for n in nodes) > MOST:
        return None
    found: dict[Expression, np.ndarray] = {}
    for node in nodes:
        if node.leaves and node.size > FEW**2:
            return None
        made = _elements(node, [found[a] for a in node.operands])
        if made is None:
            return None
        found[node] = made
    return [found[r] for r in roots]


def element_of(name: str, k: int) -> str:
    """The name of the leaf of one element."""
    return f"{name}\0{k}"


def columns(leaves: Sequence[Leaf], values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Values of the leaves of elements, given those of leaves, with one batch axis in front or none."""
    found: dict[str, np.ndarray] = {}
    for node in leaves:
        value = values[node.name]
        if not node.shape:
            found[element_of(node.name, 0)] = value
            continue
        flat = value.reshape(*value.shape[: value.ndim - len(node.shape)], node.size)
        apart = np.ascontiguousarray(flat.T)
        found |= {element_of(node.name, k): own for k, own in enumerate(apart)}
    return found


def together(elements: Sequence[np.ndarray], shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """A value of the shape, with the batch of its elements in front, from these in C order."""
    if not shape:
        return elements[0]
    batch = np.broadcast_shapes(*[np.shape(e) for e in elements])
    found = np.empty((*batch, len(elements)), dtype)
    for k, own in enumerate(elements):
        found[..., k] = own
    return found.reshape(*batch, *shape)


# ---- private ------------------------------------------------------------------------------------


def _elements(node: Expression, operands: list[np.ndarray]) -> np.ndarray | None:
    """The elements of a node by those of its operands; None where there is no rule."""
    if isinstance(node, Leaf):
        each = [
            leaf(element_of(node.name, k), (), node.dtype, node.states) for k in range(node.size)
        ]
        return _objects(each, node.shape)
    if isinstance(node, Constant):
        return _objects([as_expression(x) for x in node.value.reshape(-1)], node.shape)
    if isinstance(node, Elementwise):
        wide = [np.broadcast_to(a, node.shape).reshape(-1) for a in operands]
        made = _TIDY.get(node.function) or (lambda *own: elementwise(node.function, *own))
        return _objects([made(*own) for own in zip(*wide, strict=True)], node.shape)
    if isinstance(node, Pick) and len({a.dtype for a in node.operands}) == 1:
        flat = np.concatenate([a.reshape(-1) for a in operands])
        return _objects([flat[k] for k in node.positions.reshape(-1)], node.shape)
    if isinstance(node, Reduction) and node.ufunc in (np.add, np.logical_and, np.maximum):
        return _reduced(node, operands[0])
    return None


def _reduced(node: Reduction, operand: np.ndarray) -> np.ndarray | None:
    axes = [a for a in range(operand.ndim) if a not in node.axes]
    rows = operand.transpose(*axes, *node.axes).reshape(math.prod(node.shape), -1)
    if not rows.shape[1]:
        return None
    made: Any = _TIDY.get(node.ufunc) or (lambda a, b: elementwise(node.ufunc, a, b))
    return _objects([reduce(made, row) for row in rows], node.shape)


def _objects(items: Sequence[Expression], shape: tuple[int, ...]) -> np.ndarray:
    found = np.empty(len(items), dtype=object)
    found[:] = items
    return found.reshape(shape)
