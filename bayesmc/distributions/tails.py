"""Both tails of a distribution of one number, as logarithms and their inverses.

A family says its cdf, which is 1 to all digits far out on the right. What needs the probability of
being beyond a point there (a truncation) asks here: families with a survival function of their own
or with a symmetry keep every digit, any other has ``1 - cdf`` and says how little that resolves.
Nothing here draws or normalises.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.adapt import ScipyUnivariate
from bayesmc.distributions.base import Distribution
from bayesmc.distributions.continuous import Beta, Exponential, Gamma, StudentT, Uniform
from bayesmc.distributions.counts import Geometric, NegativeBinomial
from bayesmc.distributions.discrete import Binomial, Poisson
from bayesmc.distributions.location_scale import Cauchy, HalfCauchy, HalfNormal, Laplace
from bayesmc.distributions.normal import Normal
from bayesmc.distributions.positive import InverseGamma, LogNormal, Weibull

_LOG_2 = float(np.log(2.0))


class Tails:
    """Log probabilities at most ``x`` and above ``x``, and where these reach a given value.

    This one serves any distribution with a cdf: its upper tail is ``1 - cdf``.

    Parameters
    ----------
    dist : Distribution
        A distribution of one number; ``lower`` and ``upper`` need its ppf.

    Attributes
    ----------
    lower_resolution, upper_resolution : float
        Size of the rounding error of each tail's probability; 0 where the error is a relative one.

    References
    ----------
    Goldberg, What every computer scientist should know about floating-point arithmetic, ACM
    Computing Surveys 23, 1991, section 1.4 (cancellation).

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.distributions.tails import tails_of
    >>> float(tails_of(bmc.Normal(0.0, 1.0)).log_sf(40.0).round(3))
    -804.608
    """

    lower_resolution: float = 0.0
    upper_resolution: float = 2.0**-53

    def __init__(self, dist: Any) -> None:
        self.dist = dist

    def log_cdf(self, x: np.ndarray) -> np.ndarray:
        """Log of the probability of a value at most ``x``."""
        return np.log(self._cdf(x))

    def log_sf(self, x: np.ndarray) -> np.ndarray:
        """Log of the probability of a value above ``x``."""
        return np.log1p(-self._cdf(x))

    def lower(self, log_q: np.ndarray) -> np.ndarray:
        """Where ``log_cdf`` reaches ``log_q``."""
        return self.dist.ppf(np.exp(log_q))

    def upper(self, log_q: np.ndarray) -> np.ndarray:
        """Where ``log_sf`` comes down to ``log_q``."""
        return self.dist.ppf(-np.expm1(log_q))

    def _cdf(self, x: np.ndarray) -> np.ndarray:
        # not every family's formula is at home at infinity
        value = self.dist.cdf(np.where(np.isinf(x), 0.0, x))
        return np.where(x == np.inf, 1.0, np.where(x == -np.inf, 0.0, value))


def tails_of(dist: Distribution) -> Tails:
    """The tails of ``dist`` as exact as its family allows."""
    own = getattr(dist, "_tails", None)
    if own is not None:
        return own()
    if isinstance(dist, Normal):
        return _NormalTails(dist)
    if isinstance(dist, ScipyUnivariate):
        return _ScipyTails(dist)
    if isinstance(dist, (StudentT, Cauchy, Laplace)):
        return _SymmetricTails(dist, dist.loc)
    if isinstance(dist, Uniform):
        return _SymmetricTails(dist, 0.5 * (dist.low + dist.high))
    for family, (log_sf, upper) in _SURVIVAL.items():
        if isinstance(dist, family):
            return _SurvivalTails(dist, log_sf, upper)
    return Tails(dist)


class _NormalTails(Tails):
    upper_resolution = 0.0

    def log_cdf(self, x: np.ndarray) -> np.ndarray:
        return special.log_ndtr((x - self.dist.loc) / self.dist.scale)

    def log_sf(self, x: np.ndarray) -> np.ndarray:
        return special.log_ndtr((self.dist.loc - x) / self.dist.scale)

    def lower(self, log_q: np.ndarray) -> np.ndarray:
        return self.dist.loc + self.dist.scale * special.ndtri_exp(log_q)

    def upper(self, log_q: np.ndarray) -> np.ndarray:
        return self.dist.loc - self.dist.scale * special.ndtri_exp(log_q)


class _SymmetricTails(Tails):
    """A density that is even about its centre: one tail is the other's mirror image."""

    upper_resolution = 0.0

    def __init__(self, dist: Any, centre: np.ndarray) -> None:
        super().__init__(dist)
        self.centre = centre

    def log_sf(self, x: np.ndarray) -> np.ndarray:
        return self.log_cdf(2 * self.centre - x)

    def upper(self, log_q: np.ndarray) -> np.ndarray:
        return 2 * self.centre - self.lower(log_q)


class _SurvivalTails(Tails):
    """A family with a survival function of its own."""

    upper_resolution = 0.0

    def __init__(self, dist: Any, log_sf: Callable[..., Any], upper: Callable[..., Any]) -> None:
        super().__init__(dist)
        self._log_sf, self._upper = log_sf, upper

    def log_sf(self, x: np.ndarray) -> np.ndarray:
        below = x < np.asarray(self.dist.support.low, dtype=float)
        value = self._log_sf(self.dist, np.where(below | np.isinf(x), 1.0, x))
        return np.where(below, 0.0, np.where(x == np.inf, -np.inf, value))

    def upper(self, log_q: np.ndarray) -> np.ndarray:
        return self._upper(self.dist, log_q)


class _ScipyTails(Tails):
    """SciPy has a survival function for everything, exact where its authors made it so."""

    def __init__(self, dist: Any) -> None:
        super().__init__(dist)
        own = vars(type(dist.scipy.dist))
        self.upper_resolution = 0.0 if "_sf" in own or "_logsf" in own else Tails.upper_resolution

    def log_cdf(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(self.dist.scipy.logcdf(x))

    def log_sf(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(self.dist.scipy.logsf(x))

    def upper(self, log_q: np.ndarray) -> np.ndarray:
        return np.asarray(self.dist.scipy.isf(np.exp(log_q)))


def _log_of(survival: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    return lambda d, x: np.log(survival(d, x))


def _of_exp(inverse: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    return lambda d, log_q: inverse(d, np.exp(log_q))


def _no_inverse(dist: Any, log_q: Any) -> Any:
    """Discrete quantiles are found by bisection of the cdf instead."""
    raise NotImplementedError


def _half_cauchy_isf(d: Any, q: Any) -> Any:
    return d.scale / np.tan(0.5 * np.pi * q)


#: family -> log survival at x inside the support, and where it comes down to a log probability
_SURVIVAL: dict[type[Distribution], tuple[Callable[..., Any], Callable[..., Any]]] = {
    Exponential: (lambda d, x: -d.rate * x, lambda d, log_q: -log_q / d.rate),
    Gamma: (
        _log_of(lambda d, x: special.gammaincc(d.concentration, x * d.rate)),
        _of_exp(lambda d, q: special.gammainccinv(d.concentration, q) / d.rate),
    ),
    InverseGamma: (
        _log_of(lambda d, x: special.gammainc(d.concentration, d.scale / x)),
        _of_exp(lambda d, q: d.scale / special.gammaincinv(d.concentration, q)),
    ),
    Beta: (
        _log_of(lambda d, x: special.betaincc(d.concentration1, d.concentration0, x)),
        _of_exp(lambda d, q: special.betainccinv(d.concentration1, d.concentration0, q)),
    ),
    Weibull: (
        lambda d, x: -((x / d.scale) ** d.concentration),
        lambda d, log_q: d.scale * (-log_q) ** (1 / d.concentration),
    ),
    LogNormal: (
        lambda d, x: special.log_ndtr((d.loc - np.log(x)) / d.scale),
        lambda d, log_q: np.exp(d.loc - d.scale * special.ndtri_exp(log_q)),
    ),
    HalfNormal: (
        lambda d, x: _LOG_2 + special.log_ndtr(-x / d.scale),
        lambda d, log_q: -d.scale * special.ndtri_exp(log_q - _LOG_2),
    ),
    HalfCauchy: (
        _log_of(lambda d, x: np.arctan2(d.scale, x) * (2 / np.pi)),
        _of_exp(_half_cauchy_isf),
    ),
    Poisson: (_log_of(lambda d, x: special.pdtrc(np.floor(x), d.rate)), _no_inverse),
    Binomial: (
        _log_of(lambda d, x: special.bdtrc(np.floor(x), d.total_count, d.probs)),
        _no_inverse,
    ),
    Geometric: (lambda d, x: (np.floor(x) + 1) * np.log1p(-d.probs), _no_inverse),
    NegativeBinomial: (
        _log_of(lambda d, x: special.betainc(np.floor(x) + 1, d.total_count, d.probs)),
        _no_inverse,
    ),
}
