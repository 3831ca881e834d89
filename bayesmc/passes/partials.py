"""Partial derivatives of ufuncs, element by element, and where there are none.

A partial derivative is NaN at a kink, so that it shows unless the element is left out afterwards (by
``np.where``, say). At a jump there is nothing to hand on, and the rule gives up.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy import special

from bayesmc.expression import Constant, Expression
from bayesmc.passes.logarithms import log_of

Partial = Callable[..., Any]

_SQRT_PI = float(np.sqrt(np.pi))
_LOG_2, _LOG_10 = float(np.log(2.0)), float(np.log(10.0))


def partials(ufunc: Any) -> tuple[Partial, ...] | None:
    """How a ufunc's result moves with each of its arguments: functions of arguments and result; or None."""
    return _PARTIALS.get(ufunc)


# ---- private ------------------------------------------------------------------------------------


def _kinked(slope: Any, kink: Any) -> Any:
    return np.where(kink, np.nan, slope)


def _power_by_base(a: Any, b: Any, y: Any) -> Any:
    return np.where(np.equal(b, 0), 0.0, b * np.power(a, np.subtract(b, 1.0)))


def _power_by_exponent(a: Any, b: Any, y: Any) -> Any:
    return y * np.log(a)


def _wraps(a: Any, b: Any, y: Any) -> Any:
    """Where a remainder jumps."""
    return np.equal(y, 0)


def _chosen(a: Any, b: Any, y: Any) -> Any:
    """Slope by the first argument of what is chosen for being larger, or smaller, than the second."""
    return _kinked(np.equal(y, a), np.equal(a, b))


def _share(a: Any, b: Any) -> Any:
    """The first over the second, which is nothing where the first is: 0 log 0 stays 0 beside it."""
    quotient = np.true_divide(a, b)
    above, below = (getattr(e, "expression", None) for e in (a, b))
    if isinstance(above, Constant) and above.value.all():
        return quotient
    if isinstance(below, Expression) and log_of(below) is not None:
        return quotient
    return np.where(np.equal(a, 0.0), 0.0, quotient)


def _i1e_slope(x: Any, y: Any) -> Any:
    near = np.less(np.abs(x), 1e-8)
    share = np.where(near, 0.5, y / np.where(near, 1.0, x))
    return special.i0e(x) - share - np.sign(x) * y


def _both(rule: Partial) -> tuple[Partial, Partial]:
    """Partial derivatives of a function of two arguments that may be exchanged."""
    return rule, lambda a, b, y: rule(b, a, y)


#: ufunc -> partial derivatives by each argument, given the arguments and the result
_PARTIALS: Mapping[Any, tuple[Partial, ...]] = {
    np.positive: (lambda x, y: 1.0,),
    np.negative: (lambda x, y: -1.0,),
    np.conjugate: (lambda x, y: 1.0,),
    np.absolute: (lambda x, y: _kinked(np.sign(x), np.equal(x, 0)),),
    np.fabs: (lambda x, y: _kinked(np.sign(x), np.equal(x, 0)),),
    np.square: (lambda x, y: 2.0 * x,),
    np.sqrt: (lambda x, y: 0.5 / y,),
    np.cbrt: (lambda x, y: 1.0 / (3.0 * y * y),),
    np.reciprocal: (lambda x, y: -y * y,),
    np.exp: (lambda x, y: y,),
    np.exp2: (lambda x, y: _LOG_2 * y,),
    np.expm1: (lambda x, y: np.exp(x),),
    np.log: (lambda x, y: 1.0 / x,),
    np.log2: (lambda x, y: 1.0 / (_LOG_2 * x),),
    np.log10: (lambda x, y: 1.0 / (_LOG_10 * x),),
    np.log1p: (lambda x, y: 1.0 / (1.0 + x),),
    np.sin: (lambda x, y: np.cos(x),),
    np.cos: (lambda x, y: -np.sin(x),),
    np.tan: (lambda x, y: 1.0 + y * y,),
    np.arcsin: (lambda x, y: 1.0 / np.sqrt((1.0 - x) * (1.0 + x)),),
    np.arccos: (lambda x, y: -1.0 / np.sqrt((1.0 - x) * (1.0 + x)),),
    np.arctan: (lambda x, y: 1.0 / (1.0 + x * x),),
    np.sinh: (lambda x, y: np.cosh(x),),
    np.cosh: (lambda x, y: np.sinh(x),),
    np.tanh: (lambda x, y: np.cosh(x) ** -2.0,),
    np.arcsinh: (lambda x, y: 1.0 / np.hypot(1.0, x),),
    np.arccosh: (lambda x, y: 1.0 / np.sqrt((x - 1.0) * (x + 1.0)),),
    np.arctanh: (lambda x, y: 1.0 / ((1.0 - x) * (1.0 + x)),),
    np.deg2rad: (lambda x, y: np.pi / 180.0,),
    np.radians: (lambda x, y: np.pi / 180.0,),
    np.rad2deg: (lambda x, y: 180.0 / np.pi,),
    np.degrees: (lambda x, y: 180.0 / np.pi,),
    np.add: (lambda a, b, y: 1.0, lambda a, b, y: 1.0),
    np.subtract: (lambda a, b, y: 1.0, lambda a, b, y: -1.0),
    np.multiply: (lambda a, b, y: b, lambda a, b, y: a),
    np.true_divide: (lambda a, b, y: np.true_divide(1.0, b), lambda a, b, y: -y / b),
    np.power: (_power_by_base, _power_by_exponent),
    np.float_power: (_power_by_base, _power_by_exponent),
    np.maximum: _both(_chosen),
    np.minimum: _both(_chosen),
    np.fmax: _both(_chosen),
    np.fmin: _both(_chosen),
    # at the cut behind zero the result jumps by a turn, and has this slope on both sides
    np.arctan2: (
        lambda a, b, y: np.true_divide(b, np.square(np.hypot(a, b))),
        lambda a, b, y: np.true_divide(np.negative(a), np.square(np.hypot(a, b))),
    ),
    np.hypot: _both(lambda a, b, y: a / y),
    # no share where neither is possible
    np.logaddexp: _both(lambda a, b, y: np.where(np.equal(y, -np.inf), 0.0, np.exp(a - y))),
    np.logaddexp2: _both(lambda a, b, y: np.where(np.equal(y, -np.inf), 0.0, np.exp2(a - y))),
    np.remainder: (
        lambda a, b, y: _kinked(1.0, _wraps(a, b, y)),
        lambda a, b, y: _kinked(-np.floor_divide(a, b), _wraps(a, b, y)),
    ),
    np.fmod: (
        lambda a, b, y: _kinked(1.0, _wraps(a, b, y)),
        lambda a, b, y: _kinked(-np.trunc(np.true_divide(a, b)), _wraps(a, b, y)),
    ),
    special.expit: (lambda x, y: y * special.expit(-x),),
    special.logit: (lambda x, y: 1.0 / (x * (1.0 - x)),),
    special.log_expit: (lambda x, y: special.expit(-x),),
    special.erf: (lambda x, y: 2.0 / _SQRT_PI * np.exp(-x * x),),
    special.erfc: (lambda x, y: -2.0 / _SQRT_PI * np.exp(-x * x),),
    special.ndtr: (lambda x, y: np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi),),
    special.log_ndtr: (lambda x, y: np.exp(-0.5 * x * x - y) / np.sqrt(2.0 * np.pi),),
    special.gammaln: (lambda x, y: special.digamma(x),),
    special.betaln: (
        lambda a, b, y: special.digamma(a) - special.digamma(a + b),
        lambda a, b, y: special.digamma(b) - special.digamma(a + b),
    ),
    special.digamma: (lambda x, y: special.zeta(2.0, x),),
    special.i0e: (lambda x, y: special.i1e(x) - np.sign(x) * y,),
    special.i1e: (_i1e_slope,),
    special.xlogy: (lambda a, b, y: np.log(b), lambda a, b, y: _share(a, b)),
    special.xlog1py: (lambda a, b, y: np.log1p(b), lambda a, b, y: _share(a, 1.0 + b)),
}


def _equal(a: Any, b: Any, y: Any) -> Any:
    return np.equal(a, b)


def _whole(x: Any, y: Any) -> Any:
    return np.equal(x, np.floor(x))


def _zero(x: Any, y: Any) -> Any:
    return np.equal(x, 0)


def _never(x: Any, y: Any) -> Any:
    return np.zeros(np.shape(x), dtype=bool)


#: ufuncs that are constant in pieces -> where they jump
PIECES: Mapping[Any, Partial] = {
    **dict.fromkeys(
        (np.greater, np.greater_equal, np.less, np.less_equal, np.equal, np.not_equal), _equal
    ),
    **dict.fromkeys((np.floor, np.ceil, np.trunc), _whole),
    **dict.fromkeys((np.sign, np.signbit), _zero),
    **dict.fromkeys((np.isnan, np.isfinite, np.isinf), _never),
    np.rint: lambda x, y: np.equal(x - np.floor(x), 0.5),
    np.floor_divide: lambda a, b, y: np.equal(np.remainder(a, b), 0),
}
