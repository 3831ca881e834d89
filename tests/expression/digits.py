"""Values of expressions to 50 digits, in decimal numbers, for one entry: what derivatives are held against.

Shares nothing with the library but the graph itself; as slow as it is plain.

References
----------
Abramowitz and Stegun (1964), Handbook of Mathematical Functions, 4.3.65 (sine), 4.4.42 (arc tangent), 6.1.40
(Stirling's series).
"""

from __future__ import annotations

from collections.abc import Mapping
from decimal import ROUND_HALF_EVEN, Decimal, localcontext
from fractions import Fraction
from functools import cache
from math import comb
from typing import Any

import numpy as np
from scipy import special

from bayesmc.expression import (
    Call,
    Constant,
    Elementwise,
    Expression,
    Gather,
    Leaf,
    Pick,
    Reduction,
    ordered,
)
from bayesmc.expression.functions import Repeated
from bayesmc.expression.graph import as_bool, as_float, as_int

#: digits that are kept, some more than are promised
DIGITS = 60
#: terms of Stirling's series, and what its argument is shifted by: 1e-60 off
_TERMS, _SHIFT = 30, 40
_ONE = Decimal(1)


def in_digits(root: Expression, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """The value of an expression, an array of ``Decimal``.

    Parameters
    ----------
    root : Expression
    values : mapping
        Leaf -> numbers, floats or ``Decimal``, of the leaf's shape.
    """
    with localcontext() as context:
        context.prec = DIGITS
        found: dict[Expression, np.ndarray] = {}
        for node in ordered(root):
            found[node] = _value(node, [found[a] for a in node.operands], values)
        return found[root]


def decimals(values: Any) -> np.ndarray:
    """Real numbers as they are; whole numbers and truths are left."""
    array = np.asarray(values)
    return np.frompyfunc(Decimal, 1, 1)(array) if array.dtype.kind == "f" else array.astype(object)


# ---- private ------------------------------------------------------------------------------------


def _value(node: Expression, given: list[Any], values: Mapping[str, np.ndarray]) -> Any:
    if isinstance(node, Leaf):
        return np.asarray(decimals(values[node.name]), object)
    if isinstance(node, Constant):
        return np.asarray(decimals(node.value), object)
    if isinstance(node, Elementwise):
        return np.asarray(_FUNCTIONS[node.function](*given), object)
    if isinstance(node, Pick):
        return np.concatenate([np.ravel(v) for v in given])[node.positions]
    if isinstance(node, Gather):
        return given[0][given[1].astype(int)]
    if isinstance(node, Reduction):
        found = given[0]
        for axis in reversed(node.axes):
            found = np.asarray(_FUNCTIONS[node.ufunc].reduce(found, axis=axis), object)
        return found
    assert isinstance(node, Call) and isinstance(node.call, Repeated)
    if node.call.function is np.linalg.solve:
        slots = zip(node.call.args, node.call.slots, strict=True)
        a, b = (decimals(arg) if slot is None else given[slot] for arg, slot in slots)
        found = np.empty(b.shape, object)
        for entry in np.ndindex(b.shape[:-2]):
            found[entry] = _solved(a, b[entry])
        return found
    return np.asarray(node.call(*given), object)  # np.cumsum, np.argsort take objects


def _solved(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Gauss-Jordan elimination of a well-conditioned matrix."""
    size = len(a)
    rows = np.concatenate([a, b], axis=-1)
    for k in range(size):
        rows[k] = rows[k] / rows[k, k]
        for j in set(range(size)) - {k}:
            rows[j] = rows[j] - rows[j, k] * rows[k]
    return rows[:, size:]


@cache
def _pi() -> Decimal:
    return 16 * _arctan_series(_ONE / 5) - 4 * _arctan_series(_ONE / 239)


def _arctan_series(x: Decimal) -> Decimal:
    total = term = x
    k = 1
    while abs(term) > Decimal(10) ** -(DIGITS + 5):
        term = -term * x * x
        k += 2
        total += term / k
    return total


def _arctan(x: Decimal) -> Decimal:
    for _ in range(4):
        x = x / (1 + (1 + x * x).sqrt())
    return 16 * _arctan_series(x)


def _arctan2(y: Decimal, x: Decimal) -> Decimal:
    if x > 0:
        return _arctan(y / x)
    around = _pi() if y >= 0 else -_pi()
    return around + _arctan(y / x) if x else around / 2


def _sin(x: Decimal) -> Decimal:
    x = x - 2 * _pi() * (x / (2 * _pi())).to_integral_value()
    total = term = x
    k = 1
    while abs(term) > Decimal(10) ** -(DIGITS + 5):
        term = -term * x * x / ((k + 1) * (k + 2))
        k += 2
        total += term
    return total


def _tanh(x: Decimal) -> Decimal:
    return 1 - 2 / ((2 * x).exp() + 1)


def _cbrt(x: Decimal) -> Decimal:
    return (abs(x).ln() / 3).exp().copy_sign(x) if x else x


def _logaddexp(a: Decimal, b: Decimal) -> Decimal:
    return max(a, b) + (1 + (-abs(a - b)).exp()).ln()


@cache
def _bernoulli(n: int) -> Fraction:
    if not n:
        return Fraction(1)
    return -sum(comb(n + 1, k) * _bernoulli(k) for k in range(n)) / Fraction(n + 1)


@cache
def _stirling() -> list[Decimal]:
    found = []
    for k in range(1, _TERMS):
        b = _bernoulli(2 * k) / (2 * k * (2 * k - 1))
        found.append(Decimal(b.numerator) / Decimal(b.denominator))
    return found


def _gammaln(x: Decimal) -> Decimal:
    product = _ONE
    for k in range(_SHIFT):
        product *= x + k
    z = x + _SHIFT
    total = (z - Decimal("0.5")) * z.ln() - z + (2 * _pi()).ln() / 2 - product.ln()
    return total + sum(b / z ** (2 * k + 1) for k, b in enumerate(_stirling()))


def _rint(x: Decimal) -> Decimal:
    return x.to_integral_value(rounding=ROUND_HALF_EVEN)


_FUNCTIONS: dict[Any, Any] = {
    function: np.frompyfunc(rule, count, 1)
    for function, rule, count in (
        (np.absolute, abs, 1), (np.add, lambda a, b: a + b, 2), (np.arctan, _arctan, 1),
        (np.arctan2, _arctan2, 2), (np.cbrt, _cbrt, 1),
        (np.cos, lambda x: _sin(x + _pi() / 2), 1), (np.divide, lambda a, b: a / b, 2),
        (np.equal, lambda a, b: a == b, 2), (np.exp, lambda x: x.exp(), 1),
        (special.expit, lambda x: 1 / (1 + (-x).exp()), 1), (special.gammaln, _gammaln, 1),
        (np.greater, lambda a, b: a > b, 2), (np.greater_equal, lambda a, b: a >= b, 2),
        (np.hypot, lambda a, b: (a * a + b * b).sqrt(), 2), (np.isfinite, lambda x: True, 1),
        (np.isnan, lambda x: False, 1), (np.less, lambda a, b: a < b, 2),
        (np.less_equal, lambda a, b: a <= b, 2), (np.log, lambda x: x.ln(), 1),
        (np.log1p, lambda x: (1 + x).ln(), 1), (np.logaddexp, _logaddexp, 2),
        (np.logical_or, lambda a, b: a or b, 2), (np.logical_and, lambda a, b: a and b, 2),
        (np.logical_not, lambda a: not a, 1), (np.maximum, max, 2), (np.minimum, min, 2),
        (np.multiply, lambda a, b: a * b, 2), (np.negative, lambda x: -x, 1),
        (np.power, lambda a, b: a**b, 2), (np.rint, _rint, 1), (np.sin, _sin, 1),
        (np.sqrt, lambda x: x.sqrt(), 1), (np.square, lambda x: x * x, 1),
        (np.subtract, lambda a, b: a - b, 2), (np.tanh, _tanh, 1),
        (np.where, lambda c, a, b: a if c else b, 3), (as_float, Decimal, 1), (as_int, int, 1),
        (as_bool, bool, 1),
    )
}  # fmt: skip
