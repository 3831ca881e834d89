"""How much mass a family gives an interval, in logs, as an expression of its parameters: for ``Truncated``.

Each by the tail that is the smaller one, or the survival function, so that nothing is lost far out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy import special

from bayesmc import distributions as d

_LOG_2 = math.log(2.0)


def log_mass(make: Any, parameters: Mapping[str, Any], low: Any, high: Any) -> Any | None:
    """The logarithm of the probability of ``[low, high]``, of arrays or what stands for them.

    None where the family has no closed one here.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.passes.interval_mass import log_mass
    >>> float(np.round(log_mass(bmc.Exponential, {"rate": 2.0}, 1.0, np.inf), 12))
    -2.0
    """
    rule = _MASSES.get(make)
    return None if rule is None else rule(low, high, **parameters)


# ---- private ------------------------------------------------------------------------------------


def _normal(low: Any, high: Any, loc: Any, scale: Any) -> Any:
    # a bound that is infinite moves with nothing
    first, last = (np.where(np.isinf(b), b, (b - loc) / scale) for b in (low, high))
    # the tail that is the smaller one keeps its digits
    turned = first > 0
    near, far = np.where(turned, -last, first), np.where(turned, -first, last)
    return special.log_ndtr(far) + np.log1p(-np.exp(special.log_ndtr(near) - special.log_ndtr(far)))


def _log_normal(low: Any, high: Any, loc: Any, scale: Any) -> Any:
    return _normal(_log_or_below(low), _log_or_below(high), loc, scale)


def _log_or_below(bound: Any) -> Any:
    return np.where(bound <= 0, -np.inf, np.log(np.where(bound <= 0, 1.0, bound)))


def _half_normal(low: Any, high: Any, scale: Any) -> Any:
    return _LOG_2 + _normal(np.maximum(low, 0.0), high, 0.0, scale)


def _of_hazards(first: Any, last: Any, is_open: Any) -> Any:
    """From the cumulated hazards at both ends."""
    width = np.where(is_open, 1.0, last - first)
    return -first + np.where(is_open, 0.0, np.log(-np.expm1(-width)))


def _exponential(low: Any, high: Any, rate: Any) -> Any:
    def hazard(bound: Any) -> Any:
        return rate * np.where(np.isinf(bound), 0.0, np.maximum(bound, 0.0))

    return _of_hazards(hazard(low), hazard(high), np.isinf(high))


def _weibull(low: Any, high: Any, concentration: Any, scale: Any) -> Any:
    def hazard(bound: Any) -> Any:
        none = (bound <= 0) | np.isinf(bound)
        return np.where(none, 0.0, np.power(np.where(none, 1.0, bound) / scale, concentration))

    return _of_hazards(hazard(low), hazard(high), np.isinf(high))


def _cauchy(low: Any, high: Any, loc: Any, scale: Any) -> Any:
    below, above = np.isinf(low), np.isinf(high)
    first = np.where(below, 0.0, (np.where(below, 0.0, low) - loc) / scale)
    last = np.where(above, 0.0, (np.where(above, 0.0, high) - loc) / scale)
    inner = np.arctan2(last - first, 1.0 + first * last)
    # arctan2(1, x) is the angle that is left beyond x
    angle = np.where(above, np.arctan2(1.0, first), np.where(below, np.arctan2(1.0, -last), inner))
    return np.where(below & above, 0.0, np.log(angle / np.pi))


def _half_cauchy(low: Any, high: Any, scale: Any) -> Any:
    return _LOG_2 + _cauchy(np.maximum(low, 0.0), high, 0.0, scale)


_MASSES: Mapping[Any, Callable[..., Any]] = {
    d.Normal: _normal, d.LogNormal: _log_normal, d.HalfNormal: _half_normal,
    d.Exponential: _exponential, d.Weibull: _weibull, d.Cauchy: _cauchy,
    d.HalfCauchy: _half_cauchy,
}  # fmt: skip
