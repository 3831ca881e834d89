"""Choices whose conditions are known: fewer functions are computed, and none of them twice.

The log density of zeros and ones is ``np.where(y == 1, log_expit(x), log_expit(-x))``, with known ``y`` one
``log_expit`` of numbers with signs.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from bayesmc.expression import Constant, Elementwise, Expression, elementwise
from bayesmc.passes.arithmetic import is_all, multiply, tidy

#: functions whose values are finite for finite numbers, so that 0 times them is 0
_FINITE = frozenset((special.log_expit, special.expit, np.tanh, np.sin, np.cos))


def chosen(condition: Expression, a: Expression, b: Expression) -> Expression | None:
    """``np.where`` of a known condition said in another way; None where there is none.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy import special
    >>> from bayesmc.expression import as_expression, elementwise, leaf
    >>> from bayesmc.passes.choices import chosen
    >>> x = leaf("x", (2,))
    >>> one, zero = (elementwise(special.log_expit, e) for e in (x, elementwise(np.negative, x)))
    >>> chosen(as_expression(np.array([True, False])), one, zero).operands[0]
    <Elementwise multiply (2,)>
    """
    if not isinstance(condition, Constant):
        return None
    if _is(b, np.where):
        other, inside, _ = b.operands
        if isinstance(other, Constant) and np.logical_or(condition.value, other.value).all():
            return chosen(condition, a, inside) or tidy(np.where, condition, a, inside)
    if isinstance(a, Elementwise) and isinstance(b, Elementwise) and len(a.operands) == 1:
        if a.function is b.function and a.operands[0].dtype == b.operands[0].dtype == float:
            inner = a.operands[0], b.operands[0]
            found = chosen(condition, *inner)
            return elementwise(a.function, found or tidy(np.where, condition, *inner))
    if _is(b, np.negative) and b.operands[0] is a:
        return multiply(a, np.where(condition.value, 1.0, -1.0))
    if _is(a, np.negative) and a.operands[0] is b:
        return multiply(b, np.where(condition.value, -1.0, 1.0))
    if is_all(a, 0.0) and _vanishes(condition, b):
        return b
    return None


# ---- private ------------------------------------------------------------------------------------


def _is(node: Expression, function: object) -> bool:
    return isinstance(node, Elementwise) and node.function is function


def _vanishes(condition: Constant, node: Expression) -> bool:
    """Whether a product is 0 wherever the condition holds, for one of its factors is known to be."""
    if not _is(node, np.multiply):
        return False
    for factor, other in (node.operands, node.operands[::-1]):
        if isinstance(factor, Constant) and isinstance(other, Elementwise):
            zero = np.where(condition.value, factor.value, 0.0) == 0.0
            return bool(zero.all()) and other.function in _FINITE
    return False
