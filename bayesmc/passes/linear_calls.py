"""Calls of whole arrays that are linear in one of them, as products with a constant matrix."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import Call, Constant, Expression, as_expression, reshape
from bayesmc.expression.functions import Repeated
from bayesmc.expression.products import product

#: function -> the arguments in each of which it is linear
_LINEAR: dict[Any, tuple[int, ...]] = {
    **dict.fromkeys(
        (
            np.cumsum, np.trace, np.real, np.trapezoid, np.gradient, np.linalg.trace,
            np.add.accumulate, np.add.reduceat,
        ),
        (0,),
    ),
    **dict.fromkeys(
        (
            np.kron, np.tensordot, np.cross, np.linalg.vecdot, np.linalg.matmul, np.linalg.cross,
            np.linalg.tensordot,
        ),
        (0, 1),
    ),
    np.linalg.solve: (1,),
}  # fmt: skip
#: entries of a matrix up to which it is made
_ENTRIES = 1 << 22


def as_product(node: Call, operand: Expression) -> Expression:
    """The same value as a matrix times one operand of a call, all others being constant.

    Raises
    ------
    TraceError
        The call is not known to be linear in it, or something else varies.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, evaluate, leaf, trace
    >>> from bayesmc.passes.linear_calls import as_product
    >>> x = leaf("x", (3,))
    >>> sums = trace(lambda x: np.cumsum(x, axis=-1), [TracedArray(x)])
    >>> evaluate([as_product(sums, x)], {"x": np.ones(3)})
    [array([1., 2., 3.])]
    """
    made = node.call
    if not isinstance(made, Repeated) or made.output is not None or "dtype" in made.kwargs:
        raise TraceError(f"{node.detail} is not affine")
    places = [k for k in _LINEAR.get(made.function, ()) if k < len(made.args)]
    at = [made.slots[k] for k in places]
    if not any(k is not None and node.operands[k] is operand for k in at):
        raise TraceError(f"{node.detail} is not affine")
    if sum(a is operand or not isinstance(a, Constant) for a in node.operands) > 1:
        raise TraceError(f"{node.detail} is not affine")
    size = operand.size
    if size * node.size > _ENTRIES:
        raise TraceError(f"{node.detail} of {size} numbers is not affine")

    def called(array: np.ndarray) -> np.ndarray:
        shaped = array.reshape(*array.shape[:-1], *operand.shape)
        return made(*(shaped if a is operand else _value(a) for a in node.operands))

    matrix = called(np.eye(size)).reshape(size, node.size).T
    some = np.sin(np.arange(1.0, size + 1))
    if not np.allclose(called(some).reshape(-1), matrix @ some, rtol=1e-9):
        raise TraceError(f"{node.detail} treats a batch as something else")
    flat = product(np.matvec, as_expression(matrix), reshape(operand, (operand.size,)))
    return reshape(flat, node.shape)


# ---- private ------------------------------------------------------------------------------------


def _value(node: Expression) -> np.ndarray:
    assert isinstance(node, Constant)
    return node.value
