"""Log densities of families as expressions of value and parameters.

Closed forms in NumPy, one for each family; what ``Distribution.log_prob`` computes in tuned code is the same
to rounding, which the tests hold. Outside the support they are minus infinity. A user's family brings its
form along (``Distribution.log_density``), which is held against its ``log_prob`` where it is used.

References
----------
Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions; Gelman et al., Bayesian Data Analysis,
3rd ed., appendix A.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from scipy import special

from bayesmc import distributions as d
from bayesmc.errors import TraceError
from bayesmc.expression import Constant, Expression, Family, TracedArray, as_expression, trace
from bayesmc.expression.composed import log_sum_exp
from bayesmc.expression.graph import cast
from bayesmc.passes.interval_mass import log_mass
from bayesmc.passes.joints import VECTORS, is_joint, places
from bayesmc.passes.matrix_density import correlations, wishart

_LOG_2PI = math.log(2 * math.pi)


def log_density(family: Family, value: Expression) -> Expression:
    """The log density of a family at a value, summed over the event.

    Parameters
    ----------
    family : Family
    value : Expression, shape (*batch, *event)
        As the distribution speaks of it: support values, not positions of states.

    Returns
    -------
    Expression, shape (*batch)
        What the parameters' and the value's shapes broadcast to.

    Raises
    ------
    TraceError
        There is no closed form of this family here.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.expression import TracedArray, evaluate, leaf, trace
    >>> from bayesmc.passes.log_density import log_density
    >>> family = trace(lambda m: bmc.Normal(m, 2.0), [TracedArray(leaf("m", ()))])
    >>> density = log_density(family, leaf("y", ()))
    >>> [float(v) for v in evaluate([density], {"m": 1.0, "y": 1.0})], bmc.Normal(1.0, 2.0).log_prob(1.0)
    ([-1.612085713764618], np.float64(-1.612085713764618))
    """
    found = _log_density(family, TracedArray(value))
    return found.expression


def family_of(dist: d.Distribution) -> Family:
    """A distribution that is known as a family with constant parameters.

    Raises
    ------
    TraceError
        Its constructor's arguments are not kept under their names.
    """
    if isinstance(dist, d.MvNormal):
        kept = {"loc": dist.loc, "cov": None, "scale_tril": dist.scale_tril, "scale_diag": None}
        return Family(d.MvNormal, {k: _constant(v) for k, v in kept.items()})
    if isinstance(dist, d.Categorical):
        return Family(d.Categorical, {"probs": as_expression(dist.probs), "logits": None})
    if isinstance(dist, (d.Affine, d.Truncated, d.Ordered)):
        names = [
            k
            for k in inspect.signature(type(dist).__init__).parameters
            if k not in ("self", "base")
        ]
        kept = {k: _constant(getattr(dist, k)) for k in names}
        return Family(type(dist), {"base": family_of(dist.base), **kept})
    if isinstance(dist, d.Joint):
        return Family(d.Joint, {"parts": tuple(map(family_of, dist.parts))})
    if isinstance(dist, d.Mixture):
        parts = dist.components
        several = isinstance(parts, (list, tuple))
        made = [family_of(c) for c in parts] if several else family_of(parts)
        return Family(d.Mixture, {"weights": as_expression(dist.weights), "components": made})
    if isinstance(dist, d.KernelDensity):  # a normal about every point
        return _kernels(dist)
    # of __init__: Python before 3.11.3 may take a class's signature from __new__
    names = list(inspect.signature(type(dist).__init__).parameters)[1:]
    known = type(dist) in _FORMS or type(dist).log_density is not None
    if not known or not all(hasattr(dist, n) for n in names):
        raise TraceError(f"no closed log density of {type(dist).__name__} is known to derivatives")
    parameters = {n: _constant(getattr(dist, n)) for n in names}
    if parameters.get("logits") is not None:
        parameters["probs"] = None
    return Family(type(dist), parameters)


def has_own_form(family: Family) -> bool:
    """Whether a family brings its form along, which nobody has checked."""
    return family.make not in _FORMS and getattr(family.make, "log_density", None) is not None


# ---- private ------------------------------------------------------------------------------------


def _kernels(dist: d.KernelDensity) -> Family:
    points, cov = as_expression(dist.points), dist.kernel_cov[..., None]
    if dist.event_shape:
        tril = as_expression(np.linalg.cholesky(dist.kernel_cov)[..., None, :, :])
        parameters = {"loc": points, "cov": None, "scale_tril": tril, "scale_diag": None}
        parts = Family(d.MvNormal, parameters)
    else:
        parts = Family(d.Normal, {"loc": points, "scale": as_expression(np.sqrt(cov))})
    return Family(d.Mixture, {"weights": as_expression(dist.weights), "components": parts})


def _log_density(family: Family, x: Any) -> Any:
    form = _FORMS.get(family.make)
    if form is not None:
        return form(x, **{k: _stand_in(v) for k, v in family.parameters.items()})
    if has_own_form(family):
        return _own_form(family, x)
    if is_joint(family):
        return _joint(x, family)
    name = getattr(family.make, "__name__", str(family.make))
    raise TraceError(f"no closed log density of {name} is known to derivatives")


def _own_form(family: Family, x: Any) -> Any:
    """The form that a family brings along, read like any function of a user's."""
    make: Any = family.make
    names = [n for n in make.parameter_ndim if family.parameters.get(n) is not None]
    form = make.log_density
    found = trace(
        lambda value, *parameters: form(value, **dict(zip(names, parameters, strict=True))),
        [x, *(_stand_in(family.parameters[n]) for n in names)],
    )
    if not isinstance(found, Expression):
        raise TraceError(f"{make.__name__}.log_density returns no array")
    return TracedArray(found)


def _stand_in(value: Any) -> Any:
    if isinstance(value, Expression):  # a condition, as a probability, is a number
        return TracedArray(cast(value, float) if value.dtype.kind == "b" else value)
    if isinstance(value, (list, tuple)):
        return type(value)(_stand_in(v) for v in value)
    return value


def _constant(value: Any) -> Any:
    return None if value is None else as_expression(value)


def _inside(condition: Any, density: Any) -> Any:
    return np.where(condition, density, -np.inf)


def _normal(x: Any, loc: Any, scale: Any) -> Any:
    return -0.5 * np.square((x - loc) / scale) - 0.5 * _LOG_2PI - np.log(scale)


def _mv_normal(x: Any, loc: Any, cov: Any, scale_tril: Any, scale_diag: Any) -> Any:
    off = x - loc
    size = off.shape[-1]
    if scale_diag is not None:
        scales = scale_diag
        z = off / scale_diag
    else:
        factor = np.linalg.cholesky(cov) if scale_tril is None else scale_tril
        scales = np.linalg.diagonal(factor)
        # of few factors and many values, few inverses; of a triangle, that is back substitution
        z = np.matvec(np.linalg.inv(factor), off)
    log_det = np.sum(np.log(scales), axis=-1)
    return -0.5 * (size * _LOG_2PI + np.sum(z * z, axis=-1)) - log_det


def _student_t(x: Any, df: Any, loc: Any, scale: Any) -> Any:
    z = (x - loc) / scale
    # a difference of gammaln has no digits left where df is large
    constant = -special.betaln(0.5 * df, 0.5) - 0.5 * np.log(df)
    return constant - 0.5 * (df + 1) * np.log1p(z * z / df) - np.log(scale)


def _laplace(x: Any, loc: Any, scale: Any) -> Any:
    return -np.abs(x - loc) / scale - math.log(2) - np.log(scale)


def _cauchy(x: Any, loc: Any, scale: Any) -> Any:
    return -np.log1p(np.square((x - loc) / scale)) - math.log(math.pi) - np.log(scale)


def _half_normal(x: Any, scale: Any) -> Any:
    return _inside(x >= 0, math.log(2) + _normal(x, 0.0, scale))


def _half_cauchy(x: Any, scale: Any) -> Any:
    return _inside(x >= 0, math.log(2) + _cauchy(x, 0.0, scale))


def _log_normal(x: Any, loc: Any, scale: Any) -> Any:
    log_x = np.log(x)
    return _inside(x > 0, _normal(log_x, loc, scale) - log_x)


def _uniform(x: Any, low: Any, high: Any) -> Any:
    return _inside((x >= low) & (x <= high), 0.0 * x - np.log(high - low))


def _beta(x: Any, concentration1: Any, concentration0: Any) -> Any:
    a, b = concentration1, concentration0
    norm = special.gammaln(a) + special.gammaln(b) - special.gammaln(a + b)
    density = special.xlogy(a - 1.0, x) + special.xlog1py(b - 1.0, -x) - norm
    return _inside((x >= 0) & (x <= 1), density)


def _gamma(x: Any, concentration: Any, rate: Any) -> Any:
    a = concentration
    density = special.xlogy(a - 1.0, x) + a * np.log(rate) - rate * x - special.gammaln(a)
    return _inside(x >= 0, density)


def _inverse_gamma(x: Any, concentration: Any, scale: Any) -> Any:
    a = concentration
    density = a * np.log(scale) - (a + 1.0) * np.log(x) - scale / x - special.gammaln(a)
    return _inside(x > 0, density)


def _exponential(x: Any, rate: Any) -> Any:
    return _inside(x >= 0, np.log(rate) - rate * x)


def _weibull(x: Any, concentration: Any, scale: Any) -> Any:
    k, y = concentration, x / scale
    density = np.log(k) - np.log(scale) + special.xlogy(k - 1.0, y) - np.power(y, k)
    return _inside(x >= 0, density)


def _von_mises(x: Any, loc: Any, concentration: Any) -> Any:
    k = concentration
    density = k * (np.cos(x - loc) - 1.0) - _LOG_2PI - np.log(special.i0e(k))
    return _inside(np.isfinite(x), density)


def _dirichlet(x: Any, concentration: Any) -> Any:
    a = concentration
    norm = np.sum(special.gammaln(a), axis=-1) - special.gammaln(np.sum(a, axis=-1))
    density = np.sum(special.xlogy(a - 1.0, x), axis=-1) - norm
    return _inside(np.all(x >= 0, axis=-1), density)


def _log_odds(probs: Any, logits: Any) -> tuple[Any, Any]:
    """``log p``, ``log (1 - p)``."""
    if logits is None:
        return np.log(probs), np.log1p(-probs)
    return special.log_expit(logits), special.log_expit(-logits)


def _times(count: Any, log_p: Any) -> Any:
    """``count * log_p``, 0 where the count is."""
    return np.where(count == 0, 0.0, count * log_p)


def _log_factorial(x: Any) -> Any:
    return special.gammaln(x + 1.0)


def _whole(x: Any) -> Any:
    return (x >= 0) & (x == np.floor(x))


def _bernoulli(x: Any, probs: Any, logits: Any) -> Any:
    one, zero = _log_odds(probs, logits)
    return np.where(x == 1, one, np.where(x == 0, zero, -np.inf))


def _binomial(x: Any, total_count: Any, probs: Any, logits: Any) -> Any:
    one, zero = _log_odds(probs, logits)
    rest = total_count - x
    ways = _log_factorial(total_count) - _log_factorial(x) - _log_factorial(rest)
    return _inside(_whole(x) & (rest >= 0), ways + _times(x, one) + _times(rest, zero))


def _poisson(x: Any, rate: Any) -> Any:
    return _inside(_whole(x), special.xlogy(x, rate) - rate - _log_factorial(x))


def _geometric(x: Any, probs: Any, logits: Any) -> Any:
    one, zero = _log_odds(probs, logits)
    return _inside(_whole(x), one + _times(x, zero))


def _negative_binomial(x: Any, total_count: Any, probs: Any, logits: Any) -> Any:
    n, (one, zero) = total_count, _log_odds(probs, logits)
    ways = special.gammaln(n + x) - _log_factorial(x) - special.gammaln(n)
    return _inside(_whole(x), ways + n * zero + _times(x, one))


def _discrete_uniform(x: Any, low: Any, high: Any) -> Any:
    return _inside((x >= low) & (x <= high) & (x == np.floor(x)), -np.log(1.0 * high - low + 1.0))


def _log_probs(probs: Any, logits: Any) -> Any:
    if logits is None:
        return np.log(probs) - np.log(np.sum(probs, axis=-1, keepdims=True))
    return logits - log_sum_exp(logits, axis=-1, keepdims=True)


def _categorical(x: Any, probs: Any, logits: Any) -> Any:
    logs = _log_probs(probs, logits)
    inside = (x >= 0) & (x < logs.shape[-1])
    at = np.where(inside, x, 0)
    shape = np.broadcast_shapes(at.shape, logs.shape[:-1])
    wide = np.broadcast_to(logs, (*shape, logs.shape[-1]))
    picked = np.take_along_axis(wide, np.broadcast_to(at, shape)[..., None], axis=-1)[..., 0]
    return _inside(inside, picked)


def _multinomial(x: Any, total_count: Any, probs: Any, logits: Any) -> Any:
    ways = _log_factorial(total_count) - np.sum(_log_factorial(x), axis=-1)
    density = ways + np.sum(_times(x, _log_probs(probs, logits)), axis=-1)
    fits = np.all(_whole(x), axis=-1) & (np.sum(x, axis=-1) == total_count)
    return _inside(fits, density)


def _wrapped_normal(x: Any, loc: Any, scale: Any) -> Any:
    turn = 2 * math.pi
    off = x - loc
    off = off - turn * np.rint(off / turn)
    narrow, wide = np.minimum(scale, _FOURIER), np.maximum(scale, _FOURIER)
    turns = [_normal(off + turn * k, 0.0, narrow) for k in range(-3, 4)]
    sums = [np.exp(-0.5 * np.square(n * wide)) * np.cos(n * off) for n in range(1, 8)]
    series = np.log1p(2.0 * sum(sums)) - _LOG_2PI
    near = log_sum_exp(np.stack(np.broadcast_arrays(*turns), axis=-1), axis=-1)
    return _inside(np.isfinite(x), np.where(scale < _FOURIER, near, series) + 0.0 * np.log(scale))


def _part(part: Any) -> Family:
    """A component or base as a family."""
    if isinstance(part, d.Distribution):
        return family_of(part)
    if not isinstance(part, Family):
        raise TraceError(f"no closed log density of {type(part).__name__} is known to derivatives")
    return part


def _mixture(x: Any, weights: Any, components: Any) -> Any:
    logs = _log_probs(np.asarray(weights) if isinstance(weights, list) else weights, None)
    if isinstance(components, (list, tuple)):
        each = [_log_density(_part(c), x) for c in components]
        parts = np.stack(np.broadcast_arrays(*each), axis=-1)
    elif _part(components).make in _MATRICES:
        raise TraceError("no closed log density of a mixture of matrices is known to derivatives")
    else:
        is_vector = _part(components).make in VECTORS
        parts = _log_density(_part(components), x[..., None, :] if is_vector else x[..., None])
    return log_sum_exp(logs + parts, axis=-1)


def _joint(x: Any, family: Family) -> Any:
    total = 0.0
    for part, at in places(family, _part):
        total = total + _log_density(part, x[..., at])
    return total


def _affine(x: Any, base: Any, loc: Any, scale: Any) -> Any:
    return _log_density(_part(base), (x - loc) / scale) - np.log(np.abs(scale))


def _truncated(x: Any, base: Any, low: Any, high: Any) -> Any:
    family = _part(base)
    known = [v for v in family.parameters.values() if v is not None]
    bounds = [as_expression(getattr(b, "expression", b)) for b in (low, high)]
    if all(isinstance(v, Constant) for v in (*known, *bounds)):  # by the family itself
        made = family.make(**{k: getattr(v, "value", v) for k, v in family.parameters.items()})
        mass: Any = d.Truncated(made, *(b.value for b in bounds)).log_mass  # type: ignore[attr-defined]
    else:
        stand_ins = {k: _stand_in(v) for k, v in family.parameters.items()}
        mass = log_mass(family.make, stand_ins, low, high)
    if mass is None:
        name = getattr(family.make, "__name__", str(family.make))
        raise TraceError(f"no closed mass of {name} between bounds is known to derivatives")
    return _inside((x >= low) & (x <= high), _log_density(family, x) - mass)


def _ordered(x: Any, base: Any, size: Any) -> Any:
    family, count = _part(base), x.shape[-1]
    each = [_log_density(family, x[..., k]) for k in range(count)]
    total = sum(each, start=math.lgamma(count + 1.0))
    if count == 1:
        return total
    return _inside(np.all(x[..., 1:] >= x[..., :-1], axis=-1), total)


#: scale from which on a Fourier series has few terms
_FOURIER = 1.25
_MATRICES = frozenset((d.Wishart, d.InverseWishart))

_FORMS: Mapping[Any, Callable[..., Any]] = {
    d.Normal: _normal, d.MvNormal: _mv_normal, d.StudentT: _student_t, d.Laplace: _laplace,
    d.Cauchy: _cauchy, d.HalfNormal: _half_normal, d.HalfCauchy: _half_cauchy,
    d.LogNormal: _log_normal, d.Uniform: _uniform, d.Beta: _beta, d.Gamma: _gamma,
    d.InverseGamma: _inverse_gamma, d.Exponential: _exponential, d.Weibull: _weibull,
    d.VonMises: _von_mises, d.Dirichlet: _dirichlet, d.Bernoulli: _bernoulli,
    d.Binomial: _binomial, d.Poisson: _poisson, d.Geometric: _geometric,
    d.NegativeBinomial: _negative_binomial, d.DiscreteUniform: _discrete_uniform,
    d.Categorical: _categorical, d.Multinomial: _multinomial, d.Mixture: _mixture,
    d.Affine: _affine, d.Truncated: _truncated, d.Ordered: _ordered, d.LKJ: correlations,
    d.WrappedNormal: _wrapped_normal,
    d.Wishart: partial(wishart, is_inverse=False),
    d.InverseWishart: partial(wishart, is_inverse=True),
}  # fmt: skip
