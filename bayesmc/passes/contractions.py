"""Sums of products as products of matrices, which reach BLAS: one call for all chains, no array of products.

A regression's mean is the sum over columns of a design times coefficients, its derivative the sum over rows
of that design times adjoints: in the graph both are a ``multiply`` below an ``add.reduce``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from bayesmc.expression import (
    Elementwise,
    Expression,
    Pick,
    Reduction,
    call,
    ordered,
    pick,
)
from bayesmc.shapes import Shape

#: products that are not worth a call of their own
_FEW = 64


def contracted(roots: Iterable[Expression]) -> list[Expression]:
    """The same expressions with sums of products as products of matrices.

    Derivatives are taken before: of what this makes none are known.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, evaluate, leaf
    >>> from bayesmc.passes.contractions import contracted
    >>> design = np.arange(200.0).reshape(100, 2)
    >>> root = np.vecdot(design, TracedArray(leaf("b", (2,)))).expression
    >>> made = contracted([root])
    >>> root, made, evaluate(made, {"b": np.ones((3, 2))})[0][:, 1]
    (<Reduction add (100,)>, [<Call matmul (100,)>], array([5., 5., 5.]))
    """
    asked = list(roots)
    found: dict[Expression, Expression] = {}
    for node in ordered(*asked):
        operands = [found[a] for a in node.operands]
        same = all(a is b for a, b in zip(operands, node.operands, strict=True))
        made = node if same else node.with_operands(operands)
        found[node] = _contraction(made) or made
    return [found[r] for r in asked]


# ---- private ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Product:
    """A product of matrices whose axes are kept flat: ``(rows, inner) @ (inner, columns)``, batch in front.

    Attributes
    ----------
    first, second : tuple of int
        Sizes of their two axes.
    shape, order : tuple of int
        Of the result: ``(*kept of the first, *kept of the second)``, and how its axes go where they belong.
    """

    first: Shape
    second: Shape
    shape: Shape
    order: Shape

    __name__ = "matmul"

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        (rows, inner), (_, columns) = self.first, self.second
        lead = a.shape[: a.ndim - 2], b.shape[: b.ndim - 2]
        if not lead[0]:  # one matrix for all: one product
            many = b if columns == 1 else np.swapaxes(b, -1, -2)
            found = np.reshape(many, (math.prod(lead[1]) * columns, inner)) @ a.T
            found = found.reshape(*lead[1], columns, rows)
            whole = np.swapaxes(found, -1, -2)
        elif not lead[1]:
            found = np.reshape(a, (math.prod(lead[0]) * rows, inner)) @ b
            whole = found.reshape(*lead[0], rows, columns)
        else:
            whole = np.matmul(a, b)
        batch = whole.shape[:-2]
        found = whole.reshape(batch + self.shape)
        count = len(batch)
        return found.transpose(*range(count), *(count + k for k in self.order))


def _contraction(node: Expression) -> Expression | None:
    """A product of matrices in place of a sum of products; None where it is none, or none that pays."""
    if not isinstance(node, Reduction) or node.ufunc is not np.add:
        return None
    (product,) = node.operands
    if not isinstance(product, Elementwise) or product.function is not np.multiply:
        return None
    if product.dtype != float or product.size < _FEW:
        return None
    shape = product.shape
    a, b = product.operands
    varies = [_varies(x, shape) for x in (a, b)]
    inner = [k for k in node.axes if varies[0][k] and varies[1][k]]
    kept = [k for k in range(len(shape)) if k not in node.axes]
    rows = [k for k in kept if varies[0][k]]
    columns = [k for k in kept if varies[1][k]]
    alone = [k for k in range(len(shape)) if k in node.axes and k not in inner and shape[k] > 1]
    if (
        not inner
        or alone
        or set(rows) & set(columns)
        or set(rows) | set(columns) < set(_long(kept, shape))
    ):
        return None
    if any(x.dtype != float for x in (a, b)):
        return None
    sizes = [math.prod(shape[k] for k in axes) for axes in (rows, inner, columns)]
    first = pick([a], _places(a, shape, [*rows, *inner]).reshape(sizes[0], sizes[1]))
    second = pick([b], _places(b, shape, [*inner, *columns]).reshape(sizes[1], sizes[2]))
    short = [k for k in kept if k not in rows and k not in columns]  # of one element
    laid = [*rows, *columns, *short]
    made = _Product(
        (sizes[0], sizes[1]),
        (sizes[1], sizes[2]),
        tuple(shape[k] for k in laid),
        tuple(laid.index(k) for k in kept),
    )
    return call(made, [first, second], node.shape, float)


def _long(axes: Sequence[int], shape: Shape) -> list[int]:
    return [k for k in axes if shape[k] > 1]


def _varies(node: Expression, shape: Shape) -> list[bool]:
    """Along which axes of the product's shape an operand differs."""
    own = (1,) * (len(shape) - len(node.shape)) + node.shape
    if isinstance(node, Pick) and len(node.operands) == 1:
        at = node.positions.reshape(own)
        return [n > 1 and bool((at != at.take([0], axis=k)).any()) for k, n in enumerate(own)]
    return [n > 1 for n in own]


def _places(node: Expression, shape: Shape, axes: Sequence[int]) -> np.ndarray:
    """Flat positions of an operand's elements along some axes of the product, at the first of all others."""
    own = (1,) * (len(shape) - len(node.shape)) + node.shape
    at = np.arange(node.size).reshape(own)
    at = at[tuple(slice(None) if k in axes else slice(0, 1) for k in range(len(shape)))]
    return at.transpose([*axes, *(k for k in range(len(shape)) if k not in axes)])
