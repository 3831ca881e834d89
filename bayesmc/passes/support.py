"""Where a distribution's mass lies, with bounds as expressions of its parameters."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.distributions import (
    Affine,
    Beta,
    Cauchy,
    Distribution,
    Exponential,
    Gamma,
    HalfCauchy,
    HalfNormal,
    InverseGamma,
    Laplace,
    LogNormal,
    Normal,
    StudentT,
    Truncated,
    Uniform,
    Weibull,
)
from bayesmc.distributions.support import Support, interval, positive, real, unit_interval
from bayesmc.expression import Constant, Family, TracedArray, as_expression
from bayesmc.expression.functions import expression_of


def moving_support(density: Family | Distribution) -> Support | None:
    """The support of a number whose bounds depend on parameters; None where this is not known here.

    Bounds are arrays where they are known, else stand-ins (``TracedArray``), which are taken for finite.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.expression import TracedArray, leaf, trace
    >>> from bayesmc.passes.support import moving_support
    >>> density = trace(lambda top: bmc.Uniform(0.0, 2 * top), [TracedArray(leaf("top", ()))])
    >>> support = moving_support(density)
    >>> support.low, support.high
    (array(0.), TracedArray(<Elementwise multiply ()>))
    """
    if isinstance(density, Distribution):
        return density.support
    parameters = density.parameters
    if density.make is Uniform:
        return interval(_bound(parameters["low"]), _bound(parameters["high"]))
    base = parameters.get("base")
    if not isinstance(base, (Family, Distribution)):
        return None
    if density.make is Truncated:
        return _truncated(base, _bound(parameters["low"]), _bound(parameters["high"]))
    if density.make is Affine:
        return _affine(base, parameters["loc"], parameters["scale"])
    return None


# ---- private ------------------------------------------------------------------------------------


def _bound(value: Any) -> Any:
    """An array where it is known, else what stands for one."""
    found = as_expression(expression_of(value))
    return np.asarray(found.value, float) if isinstance(found, Constant) else TracedArray(found)


def _base(density: Family | Distribution) -> Support | None:
    """The support of what is truncated or moved."""
    fixed = _FIXED.get(density.make) if isinstance(density, Family) else None
    return moving_support(density) if fixed is None else fixed


def _truncated(base: Family | Distribution, low: Any, high: Any) -> Support | None:
    support = _base(base)
    if support is None or support.kind not in ("real", "interval"):
        return None
    return interval(_join(np.maximum, low, support.low), _join(np.minimum, high, support.high))


def _affine(base: Family | Distribution, loc: Any, scale: Any) -> Support | None:
    support, scale = _base(base), _bound(scale)
    if support is None or support.kind == "real":
        return support
    if support.kind != "interval" or not isinstance(scale, np.ndarray):
        return None
    if not ((scale > 0).all() or (scale < 0).all()):
        return None
    ends = [_moved(end, _bound(loc), scale) for end in (support.low, support.high)]
    return interval(*(ends if (scale > 0).all() else ends[::-1]))


def _moved(end: Any, loc: Any, scale: np.ndarray) -> Any:
    if isinstance(end, (float, np.ndarray)) and np.isinf(end).all():
        return np.asarray(end * np.sign(scale))
    return loc + scale * end


def _join(choose: Any, first: Any, second: Any) -> Any:
    """The tighter of two bounds; one that is infinite all over says nothing."""
    for one, other in ((first, second), (second, first)):
        if isinstance(one, (float, np.ndarray)) and np.isinf(one).all():
            return other
    return choose(first, second)


#: families whose support is the same whatever the parameters, as bounds
_FIXED: dict[Any, Support] = {
    **dict.fromkeys((Cauchy, Laplace, Normal, StudentT), real),
    **dict.fromkeys((Exponential, Gamma, HalfCauchy, HalfNormal), positive),
    **dict.fromkeys((InverseGamma, LogNormal, Weibull), positive),
    Beta: unit_interval,
}
