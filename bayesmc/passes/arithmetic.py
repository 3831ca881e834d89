"""Arithmetic of expressions that knows 0 and 1, so that derivatives and coefficients stay small.

A product with 0 is 0 here, whatever the other factor: these are coefficients, not values of a user's. Whoever
reads sums of terms with coefficients has the linear part from here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import (
    Constant,
    Elementwise,
    Expression,
    Gather,
    Pick,
    Reduction,
    as_expression,
    broadcast,
    cast,
    elementwise,
    gather,
    ordered,
    pick,
    reduction,
)
from bayesmc.expression.graph import CASTS

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


def rewritten(
    roots: Sequence[Expression],
    change: Callable[[Expression, list[Expression]], Expression | None],
) -> list[Expression]:
    """Expressions made anew, operands first.

    Parameters
    ----------
    change : callable
        From a node and its new operands to what stands in its place; None for the same operation on these.
    """
    found: dict[Expression, Expression] = {}
    for node in ordered(*roots):
        operands = [found[a] for a in node.operands]
        made = change(node, operands)
        found[node] = node.with_operands(operands) if made is None else made
    return [found[r] for r in roots]


def tidied(root: Expression) -> Expression:
    """An expression without what changes nothing for finite values."""

    def change(node: Expression, operands: list[Expression]) -> Expression | None:
        if isinstance(node, Elementwise) and node.dtype == float:
            return broadcast(tidy(node.function, *operands), node.shape)
        return None

    return rewritten([root], change)[0]


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


#: levels of an expression in which a term is looked for: recursions over time nest without end, and their
#: sums have more terms at every level
DEEPEST = 150


class TermReader:
    """Reads an expression as a sum of terms with coefficients that are free of what it is read in.

    A subclass says what is free, what a term is, and what functions make of sums, element by element.
    What is nested deeper than ``DEEPEST`` levels is refused, a `TraceError`.
    """

    #: the term of what is free
    one: ClassVar[Any]
    #: function -> method
    rules: ClassVar[Mapping[Any, Callable[[Any, Elementwise], dict[Any, Expression]]]]

    def __init__(self) -> None:
        self._found: dict[Expression, dict[Any, Expression]] = {}
        self._level = 0

    def __call__(self, node: Expression) -> dict[Any, Expression]:
        found = self._found.get(node)
        if found is None:
            if self._level >= DEEPEST:
                raise TraceError("what is made of it is nested too deep to be read")
            self._level += 1
            try:
                found = self._found[node] = self._read(node)
            finally:
                self._level -= 1
        return found

    def is_free(self, node: Expression) -> bool:
        raise NotImplementedError

    def term(self, node: Expression) -> dict[Any, Expression]:
        """What is a term by itself; all else is refused."""
        raise NotImplementedError

    def _read(self, node: Expression) -> dict[Any, Expression]:
        if self.is_free(node):
            return {self.one: node}
        if isinstance(node, Reduction) and node.ufunc is np.add:
            (operand,) = node.operands
            whole = {f: broadcast(c, operand.shape) for f, c in self(operand).items()}
            return {f: reduction(np.add, c, node.axes) for f, c in whole.items()}
        if isinstance(node, Pick):
            parts = [(self(a), a.shape) for a in node.operands]
            return {
                f: pick([broadcast(p.get(f, ZERO), shape) for p, shape in parts], node.positions)
                for f in dict.fromkeys(f for p, _ in parts for f in p)
            }
        if isinstance(node, Gather) and self.is_free(node.rows):
            whole = {f: broadcast(c, node.table.shape) for f, c in self(node.table).items()}
            return {f: gather(c, node.rows) for f, c in whole.items()}
        if isinstance(node, Elementwise):
            rule = self.rules.get(node.function)
            if rule is not None:
                return rule(self, node)
            kept = CASTS.get(node.function)
            if kept is not None and np.can_cast(node.operands[0].dtype, kept):  # no number is cut
                return self(node.operands[0])
        return self.term(node)

    def add(self, node: Elementwise) -> dict[Any, Expression]:
        first, second = map(self, node.operands)
        join = add if node.function is np.add else subtract
        return {f: join(first.get(f, ZERO), second.get(f, ZERO)) for f in {**first, **second}}

    def negative(self, node: Elementwise) -> dict[Any, Expression]:
        return {f: multiply(c, -1.0) for f, c in self(node.operands[0]).items()}
