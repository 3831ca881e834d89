"""Arithmetic of expressions that knows 0 and 1, so that derivatives and coefficients stay small.

A product with 0 is 0 here, whatever the other factor: these are coefficients, not values of a user's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.expression import (
    Constant,
    Elementwise,
    Expression,
    as_expression,
    broadcast,
    cast,
    elementwise,
    ordered,
)

ZERO, ONE = as_expression(0.0), as_expression(1.0)


def is_all(node: Expression, number: float) -> bool:
    """Whether an expression is this number all over."""
    return isinstance(node, Constant) and bool((node.value == number).all())


def tidy(function: Any, *operands: Any) -> Expression:
    """An element-wise function of expressions without what changes nothing."""
    args = tuple(map(as_expression, operands))
    if function is np.where:
        return _where(*args)
    if len(args) == 2:
        first, second = args
        if function is np.multiply and (is_all(first, 0) or is_all(second, 0)):
            return _filled(ZERO, args)
        if function is np.divide and is_all(first, 0):
            return _filled(ZERO, args)
        if function is np.power and is_all(second, 0):
            return _filled(ONE, args)
        neutral = _NEUTRAL.get(function)
        if neutral is not None and is_all(second, neutral):
            return _filled(first, args)
        if neutral is not None and function in (np.multiply, np.add) and is_all(first, neutral):
            return _filled(second, args)
        if function is np.subtract and is_all(first, 0):
            return elementwise(np.negative, _filled(second, args))
    return elementwise(function, *args)


def tidied(root: Expression) -> Expression:
    """An expression without what changes nothing for finite values."""
    found: dict[Expression, Expression] = {}
    for node in ordered(root):
        operands = [found[a] for a in node.operands]
        if isinstance(node, Elementwise) and node.dtype == float:
            found[node] = broadcast(tidy(node.function, *operands), node.shape)
        else:
            same = all(a is b for a, b in zip(operands, node.operands, strict=True))
            found[node] = node if same else node.with_operands(operands)
    return found[root]


def add(a: Any, b: Any) -> Expression:
    """The sum."""
    return tidy(np.add, a, b)


def subtract(a: Any, b: Any) -> Expression:
    """The difference."""
    return tidy(np.subtract, a, b)


def multiply(a: Any, b: Any) -> Expression:
    """The product."""
    return tidy(np.multiply, a, b)


def divide(a: Any, b: Any) -> Expression:
    """The quotient."""
    return tidy(np.divide, a, b)


# ---- private ------------------------------------------------------------------------------------

_NEUTRAL = {np.multiply: 1, np.divide: 1, np.add: 0, np.subtract: 0, np.power: 1}


def _where(condition: Expression, first: Expression, second: Expression) -> Expression:
    for chosen, value in ((first, True), (second, False)):
        if is_all(condition, value):
            return _filled(chosen, (condition, first, second))
    if first is second:
        return _filled(first, (condition, first, second))
    return elementwise(np.where, condition, first, second)


def _filled(node: Expression, args: tuple[Expression, ...]) -> Expression:
    """An operand, real and in the shape of the whole."""
    shape = np.broadcast_shapes(*(a.shape for a in args))
    real = node if node.dtype == float else cast(node, float)
    return broadcast(real, shape)
