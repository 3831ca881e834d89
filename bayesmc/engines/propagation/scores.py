"""Normal scores: a number between bounds as a function of a standard normal one, so that its prior is exact.

With ``x = F^-1(Phi(z))`` the prior of z is the standard normal whatever the cdf F of x is: nothing has to be
approximated of it, and cavities of what reads x have an integral. Tails are taken from the side where they
are small.

References
----------
Nataf (1962), Determination des distributions de probabilites dont les marges sont donnees; Liu and Der
Kiureghian (1986), Multivariate distribution models with prescribed marginals and covariances.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import special

from bayesmc import distributions as d
from bayesmc.distributions import Distribution
from bayesmc.distributions.far_quantiles import beta_lower, gamma_lower, gamma_upper
from bayesmc.distributions.tails import tails_of
from bayesmc.distributions.transforms import Transform
from bayesmc.expression import Constant, Expression, Family, TracedArray, elementwise
from bayesmc.network import Model
from bayesmc.network.expressions import Followed, density

_LOG_2PI = float(np.log(2.0 * np.pi))
#: scores up to which curves are splines, how far their knots are apart, and where splines end in time
_REACH, _STEP, _MARGIN = 40.0, 0.05, 1.0
#: by how much splines may be off between knots, of numbers of this size
_ROUNDING = 1e-11
#: a score that stands for any farther out
_FARTHEST = 38.0


@dataclass(frozen=True, eq=False)
class NormalScores(Transform):
    """The map of a distribution of single numbers with the same parameters everywhere."""

    prior: Distribution
    inverse: Callable[[np.ndarray], np.ndarray]

    @classmethod
    def of(cls, prior: Distribution) -> NormalScores:
        """Of a distribution of one number with known parameters."""
        numbers = [float(getattr(prior, k)) for k in type(prior).parameter_ndim]
        return cls((), prior, _INVERSES[type(prior)](*numbers))

    def __reduce__(self) -> Any:
        return NormalScores.of, (self.prior,)

    def formula(self, u: Any) -> Any:
        if isinstance(u, TracedArray):
            return TracedArray(elementwise(self.inverse, u.expression))
        return self.inverse(u)

    def _unconstrain(self, x: np.ndarray) -> np.ndarray:
        tails = tails_of(self.prior)
        with np.errstate(all="ignore"):
            below, above = tails.log_cdf(x), tails.log_sf(x)
            right = special.ndtri_exp(np.minimum(above, 0.0))
            z = np.where(below < above, special.ndtri_exp(np.minimum(below, 0.0)), -right)
            # a tail whose probability is no number: the score only has to be far out
            return np.where(np.isfinite(z), z, np.clip(z, -_FARTHEST, _FARTHEST))

    def log_det_formula(self, u: Any) -> Any:
        """``log |dx/dz|``, of arrays."""
        return -0.5 * (u * u + _LOG_2PI) - self.prior.log_prob(self.inverse(u))


def scores_of(model: Model, name: str) -> NormalScores | None:
    """The map of a node whose prior has constant parameters, the same for all elements; None of others.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.propagation.scores import scores_of
    >>> from bayesmc.network import pose
    >>> net = bmc.BayesNet()
    >>> net.add("rate", bmc.Gamma(2.0, 3.0))
    >>> scores = scores_of(pose(net, {}).model, "rate")
    >>> bool(np.isclose(bmc.Gamma(2.0, 3.0).cdf(scores.constrain(0.0)), 0.5))
    True
    """
    found = density(model, name)
    if not isinstance(found, Followed) or model[name].event_shape:
        return None
    prior = found.result
    if isinstance(prior, Family):
        values = {k: v.value if isinstance(v, Constant) else v for k, v in prior.parameters.items()}
        if any(isinstance(v, Expression) for v in values.values()):
            return None
        values = {k: v for k, v in values.items() if v is not None}
        prior = prior.make(**{k: _single(v) for k, v in values.items()})
    if type(prior) not in _INVERSES:
        return None
    numbers = [_single(getattr(prior, k)) for k in type(prior).parameter_ndim]
    if any(np.ndim(n) for n in numbers):
        return None
    return NormalScores.of(type(prior)(*(float(n) for n in numbers)))


# ---- private ------------------------------------------------------------------------------------


def _single(value: Any) -> Any:
    """A number that is the same all over, as one."""
    array = np.asarray(value)
    if array.size and (array == array.reshape(-1)[0]).all():
        return array.reshape(-1)[0]
    return array


class Curve:
    """A smooth rising function of a normal score, by splines of degree 7 within a reach, else as it is.

    Inverses of gamma and beta laws take half a microsecond a number, of which lattices ask for millions.

    Parameters
    ----------
    exact : callable
        Of an array.
    """

    def __init__(self, exact: Callable[[np.ndarray], np.ndarray]) -> None:
        self.exact = exact
        self.pieces: Callable[[np.ndarray], np.ndarray] | None = None
        knots = np.arange(-_REACH, _REACH + 0.5 * _STEP, _STEP)
        values = exact(knots)
        if not np.isfinite(values).all():
            return
        from scipy import interpolate  # takes long to load

        spline = interpolate.make_interp_spline(knots, values, k=7)
        pieces = interpolate.PPoly.from_spline(spline)
        between = knots[(np.abs(knots) < _REACH - _MARGIN)] + 0.5 * _STEP
        wanted = exact(between)
        if (np.abs(pieces(between) - wanted) <= _ROUNDING * (1.0 + np.abs(wanted))).all():
            self.pieces = pieces

    def __call__(self, z: np.ndarray) -> np.ndarray:
        z = np.asarray(z, dtype=float)
        if self.pieces is None:  # it turns more sharply than splines follow
            return self.exact(z)
        found = np.asarray(self.pieces(z))
        far = np.abs(z) > _REACH - _MARGIN
        if far.any():
            found[far] = self.exact(z[far])
        return found


@lru_cache(maxsize=64)
def _log_gamma(concentration: float) -> Curve:
    def exact(z: np.ndarray) -> np.ndarray:
        low = gamma_lower(concentration, special.log_ndtr(z))
        high = gamma_upper(concentration, special.log_ndtr(-np.asarray(z)))
        return np.where(low < np.log(concentration), low, high)

    return Curve(exact)


@lru_cache(maxsize=64)
def _logit_beta(a: float, b: float) -> Curve:
    def exact(z: np.ndarray) -> np.ndarray:
        one = beta_lower(a, b, special.log_ndtr(z))
        other = beta_lower(b, a, special.log_ndtr(-np.asarray(z)))
        with np.errstate(all="ignore"):
            low, high = one - np.log1p(-np.exp(one)), np.log1p(-np.exp(other)) - other
        return np.where(one < np.log(0.5), low, high)

    return Curve(exact)


def _gamma(concentration: float, rate: float) -> Callable[[np.ndarray], np.ndarray]:
    curve = _log_gamma(concentration)
    return lambda z: np.exp(curve(z)) / rate


def _beta(a: float, b: float) -> Callable[[np.ndarray], np.ndarray]:
    curve = _logit_beta(a, b)
    return lambda z: special.expit(curve(z))


def _inverse_gamma(concentration: float, scale: float) -> Callable[[np.ndarray], np.ndarray]:
    curve = _log_gamma(concentration)
    return lambda z: scale * np.exp(-curve(-np.asarray(z)))


def _half_cauchy(scale: float) -> Callable[[np.ndarray], np.ndarray]:
    def inverse(z: np.ndarray) -> np.ndarray:
        low = np.tan(0.5 * np.pi * special.ndtr(np.minimum(z, 0.0)))
        small = special.log_ndtr(-np.maximum(z, 0.0)) + np.log(0.5 * np.pi)
        # of small angles the tangent is the angle
        high = np.where(small < -20.0, np.exp(-small), 1.0 / np.tan(np.exp(small)))
        return scale * np.where(z <= 0, low, high)

    return inverse


def _half_normal(scale: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda z: -scale * special.ndtri_exp(special.log_ndtr(-z) - np.log(2.0))


#: family -> from its parameters the map, rising
_INVERSES: dict[type, Callable[..., Callable[[np.ndarray], np.ndarray]]] = {
    d.Uniform: lambda low, high: lambda z: low + (high - low) * special.ndtr(z),
    d.Exponential: lambda rate: lambda z: -special.log_ndtr(-z) / rate,
    d.Gamma: _gamma,
    d.InverseGamma: _inverse_gamma,
    d.Beta: _beta,
    d.HalfNormal: _half_normal,
    d.HalfCauchy: _half_cauchy,
    d.LogNormal: lambda loc, scale: lambda z: np.exp(loc + scale * z),
    d.Weibull: lambda k, scale: lambda z: scale * (-special.log_ndtr(-z)) ** (1.0 / k),
}
