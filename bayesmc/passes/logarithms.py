"""Expressions with exponentials and their logarithms taken together, so that neither over- nor underflows.

What maps give of free numbers is a chain of ``exp`` and ``expit``; densities take logarithms, quotients and
roots of it. Together they are sums: ``log(exp(u) / 2)`` is ``u - log 2``, ``log(1 - expit(u))`` is
``log_expit(-u)``. Values change by rounding only, or where one of their parts is no finite number.

References
----------
Mächler (2012), Accurately computing log(1 - exp(-|a|)), Rmpfr package vignette.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from scipy import special

from bayesmc.expression import (
    Constant,
    Elementwise,
    Expression,
    Gather,
    Pick,
    broadcast,
    elementwise,
    gather,
    pick,
)
from bayesmc.passes.arithmetic import add, is_all, multiply, rewritten, subtract, tidy
from bayesmc.passes.choices import chosen


def stable(roots: Iterable[Expression]) -> list[Expression]:
    """The same expressions with exponentials and logarithms taken together.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy import special
    >>> from bayesmc.expression import elementwise, evaluate, leaf
    >>> from bayesmc.passes.logarithms import stable
    >>> u = leaf("u", ())
    >>> one_less = elementwise(np.subtract, 1.0, elementwise(special.expit, u))
    >>> root = elementwise(np.log, one_less)
    >>> [float(evaluate([r], {"u": np.array(800.0)})[0]) for r in (root, *stable([root]))]
    [-inf, -800.0]
    """

    def change(node: Expression, operands: list[Expression]) -> Expression | None:
        if isinstance(node, Elementwise) and node.dtype == float:
            return broadcast(_made(node.function, operands), node.shape)
        return None

    return rewritten(list(roots), change)


def log_of(node: Expression) -> Expression | None:
    """The logarithm of what is positive whatever its leaves are; None where that is not seen."""
    if isinstance(node, Constant):
        return elementwise(np.log, node) if _is_positive(node) else None
    if isinstance(node, Pick):
        logs = [log_of(a) for a in node.operands[:_FEW]]
        if len(node.operands) > _FEW or any(log is None for log in logs):
            return None
        return pick(logs, node.positions)
    if isinstance(node, Gather):
        table = log_of(node.table)
        return None if table is None else gather(table, node.rows)
    rule = _LOGS.get(node.function) if isinstance(node, Elementwise) else None
    return None if rule is None else rule(*node.operands)


# ---- private ------------------------------------------------------------------------------------

#: operands of a pick that are looked at
_FEW = 16
#: functions whose value at ``-x`` is one less that at ``x``, and their logarithms
_SIGMOIDS: Mapping[Any, Any] = {special.expit: special.log_expit, special.ndtr: special.log_ndtr}


def _is_positive(node: Expression) -> bool:
    return isinstance(node, Constant) and node.dtype.kind in "fi" and bool((node.value > 0).all())


def _is(node: Expression, function: Any) -> bool:
    return isinstance(node, Elementwise) and node.function is function


def _made(function: Any, operands: list[Expression]) -> Expression:
    """A function of operands that are stable themselves; of what is repeated, it is taken once."""
    first = operands[0]
    if len(operands) == 1 and isinstance(first, Pick) and len(first.operands) == 1:
        if first.size >= first.operands[0].size:
            return pick([_made(function, list(first.operands))], first.positions)
    rule = _RULES.get(function)
    found = None if rule is None else rule(*operands)
    return tidy(function, *operands) if found is None else found


def _negative(node: Expression) -> Expression:
    if _is(node, np.negative):
        return node.operands[0]
    return elementwise(np.negative, node)


def _negated(node: Expression) -> Expression | None:
    """What an expression is the negative of."""
    if _is(node, np.negative):
        return node.operands[0]
    if _is(node, np.multiply):
        for one, other in (node.operands, node.operands[::-1]):
            if is_all(one, -1.0):
                return other
    return None


def _log(x: Expression) -> Expression | None:
    whole = log_of(x)
    if whole is not None:
        return whole
    if _is(x, np.multiply) or _is(x, np.divide):  # one factor is positive: the sign is the other's
        first, second = (log_of(a) for a in x.operands)
        if first is not None or second is not None:
            parts = [
                elementwise(np.log, a) if log is None else log
                for a, log in zip(x.operands, (first, second), strict=True)
            ]
            return (add if _is(x, np.multiply) else subtract)(*parts)
    return None


def _log1p(x: Expression) -> Expression | None:
    if _is(x, np.exp):
        return _softplus(x.operands[0])
    inner = _negated(x)
    for sigmoid, log in _SIGMOIDS.items():
        if inner is not None and _is(inner, sigmoid):
            return elementwise(log, _negative(inner.operands[0]))
    return None


def _softplus(x: Expression) -> Expression:
    """``log(1 + exp(x))``."""
    return _negative(elementwise(special.log_expit, _negative(x)))


def _xlogy(a: Expression, y: Expression) -> Expression | None:
    log = log_of(y)
    return None if log is None else multiply(a, log)


def _xlog1py(a: Expression, y: Expression) -> Expression | None:
    log = _log1p(y)
    return None if log is None else multiply(a, log)


def _subtract(a: Expression, b: Expression) -> Expression | None:
    for sigmoid in _SIGMOIDS:
        if is_all(a, 1.0) and _is(b, sigmoid):
            return elementwise(sigmoid, _negative(b.operands[0]))
    return None


def _divide(a: Expression, b: Expression) -> Expression | None:
    if _is(b, np.exp):
        return multiply(a, elementwise(np.exp, _negative(b.operands[0])))
    if isinstance(b, Pick) and len(b.operands) == 1 and _is(b.operands[0], np.exp):
        inner = elementwise(np.exp, _negative(b.operands[0].operands[0]))
        return multiply(a, pick([inner], b.positions))
    return None


def _power(a: Expression, b: Expression) -> Expression | None:
    log = log_of(a) if not isinstance(a, Constant) else None
    if log is None or not (_is(a, np.exp) or not isinstance(b, Constant)):
        return None
    return elementwise(np.exp, multiply(b, log))


def _exp(x: Expression) -> Expression | None:
    for sigmoid, log in _SIGMOIDS.items():
        if _is(x, log):
            return elementwise(sigmoid, x.operands[0])
    return None


def _of_exp(change: Callable[[Expression], Expression]) -> Callable[[Expression], Any]:
    """A function of an exponential is one of another exponent."""

    def rule(x: Expression) -> Expression | None:
        return elementwise(np.exp, change(x.operands[0])) if _is(x, np.exp) else None

    return rule


def _both(join: Callable[[Expression, Expression], Expression]) -> Callable[..., Any]:
    def rule(a: Expression, b: Expression) -> Expression | None:
        first, second = log_of(a), log_of(b)
        return None if first is None or second is None else join(first, second)

    return rule


def _scaled(factor: float) -> Callable[[Expression], Any]:
    def rule(a: Expression) -> Expression | None:
        log = log_of(a)
        return None if log is None else multiply(factor, log)

    return rule


def _log_of_power(a: Expression, b: Expression) -> Expression | None:
    log = log_of(a)
    return None if log is None else multiply(b, log)


def _log_of_sum(a: Expression, b: Expression) -> Expression | None:
    for one, other in ((a, b), (b, a)):
        if is_all(one, 1.0) and _is(other, np.exp):
            return _softplus(other.operands[0])
    return None


#: function -> the logarithm of its value, or None
_LOGS: Mapping[Any, Callable[..., Expression | None]] = {
    np.exp: lambda x: x,
    special.expit: lambda x: elementwise(special.log_expit, x),
    special.ndtr: lambda x: elementwise(special.log_ndtr, x),
    np.multiply: _both(add),
    np.divide: _both(subtract),
    np.sqrt: _scaled(0.5),
    np.square: _scaled(2.0),
    np.reciprocal: _scaled(-1.0),
    np.power: _log_of_power,
    np.add: _log_of_sum,
}

#: function -> another way to say it, or None
_RULES: Mapping[Any, Callable[..., Expression | None]] = {
    np.log: _log,
    np.log1p: _log1p,
    special.xlogy: _xlogy,
    special.xlog1py: _xlog1py,
    special.logit: lambda x: x.operands[0] if _is(x, special.expit) else None,
    np.subtract: _subtract,
    np.divide: _divide,
    np.power: _power,
    np.exp: _exp,
    np.square: _of_exp(lambda x: multiply(2.0, x)),
    np.sqrt: _of_exp(lambda x: multiply(0.5, x)),
    np.reciprocal: _of_exp(_negative),
    np.negative: lambda x: x.operands[0] if _is(x, np.negative) else None,
    np.where: chosen,
}
