"""Families of one positive number: LogNormal, InverseGamma, Weibull.

Densities follow SciPy's formulas operation by operation where these keep their digits. Draws that
would leave the positive finite numbers (concentrations near zero reach that far) become the
nearest one inside.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.base import Distribution, as_float, as_quantile
from bayesmc.distributions.location_scale import LocationScale
from bayesmc.distributions.support import Support, nonnegative, positive
from bayesmc.shapes import Shape

_TINY = np.finfo(float).tiny
_HUGE = np.finfo(float).max
_HALF_LOG_2PI = 0.5 * np.log(2 * np.pi)
_UNDERFLOWS = 0.05  # a Gamma variate of smaller concentration can underflow to zero


class LogNormal(LocationScale):
    """Log-normal distribution: ``exp`` of a normal number.

    Parameters
    ----------
    loc : array_like
        Mean of the logarithm; the median is ``exp(loc)``.
    scale : array_like
        Standard deviation of the logarithm, positive.

    Raises
    ------
    ParameterError
        ``loc`` not finite, or ``scale`` not positive and finite.

    References
    ----------
    Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions I, ch. 14.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dist = bmc.LogNormal(0.0, 1.0)
    >>> float(dist.log_prob(1.0).round(4)), float(dist.mean.round(4)), float(dist.ppf(0.5))
    (-0.9189, 1.6487, 1.0)
    """

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = np.asarray(rng.standard_normal(shape))
        draws *= self.scale
        draws += self.loc
        return _exp_inside(draws)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        log_x = np.asarray(np.log(x))
        z = np.asarray((log_x - self.loc) / self.scale)
        z *= z
        z *= -0.5
        z -= _HALF_LOG_2PI
        z = np.asarray(z - log_x)
        z -= np.log(self.scale)
        return np.where(x <= 0, -np.inf, z)

    @property
    def mean(self) -> np.ndarray:
        with np.errstate(over="ignore"):
            return np.exp(self.loc + 0.5 * self.scale**2)

    @property
    def var(self) -> np.ndarray:
        with np.errstate(over="ignore"):
            square = self.scale**2
            # one exponential of the sum: expm1 alone may overflow where the product does not
            return np.exp(2 * (self.loc + square)) * -np.expm1(-square)

    @property
    def support(self) -> Support:
        return positive

    def cdf(self, x: Any) -> np.ndarray:
        with np.errstate(divide="ignore", over="ignore"):
            return special.ndtr((np.log(np.maximum(x, 0.0)) - self.loc) / self.scale)

    def ppf(self, q: Any) -> np.ndarray:
        with np.errstate(over="ignore"):
            return np.exp(self.loc + self.scale * special.ndtri(as_quantile(q)))


class ShapeScale(Distribution):
    """A positive number with a shape, ``concentration``, that is stretched by ``scale``."""

    parameter_ndim = {"concentration": 0, "scale": 0}

    def __init__(self, concentration: Any, scale: Any = 1.0) -> None:
        concentration, scale = as_float(concentration), as_float(scale)
        self._set_batch(concentration.shape, scale.shape)
        self.concentration = self._positive("concentration", concentration)
        self.scale = self._positive("scale", scale)


class InverseGamma(ShapeScale):
    """Inverse gamma distribution, ``x**(-concentration - 1) exp(-scale / x)`` normalised.

    Its reciprocal is Gamma with ``rate = scale``.

    Parameters
    ----------
    concentration : array_like
        Shape, positive.
    scale : array_like
        Positive; the mean is ``scale / (concentration - 1)`` where ``concentration > 1``.

    Raises
    ------
    ParameterError
        A parameter is not positive and finite.

    References
    ----------
    Gelman et al., Bayesian Data Analysis, 3rd ed., appendix A.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dist = bmc.InverseGamma(3.0, 4.0)
    >>> float(dist.log_prob(1.0).round(4)), float(dist.mean), float(dist.var)
    (-0.5343, 2.0, 4.0)
    """

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        a = self.concentration
        if a.size and a.min() < _UNDERFLOWS:
            # log Gamma(a) = log Gamma(a + 1) + log(U) / a (Marsaglia and Tsang 2000, section 6)
            logs = np.asarray(rng.standard_exponential(shape))
            with np.errstate(over="ignore"):
                logs /= a
            logs -= np.log(rng.standard_gamma(a + 1, shape))
            logs += np.log(self.scale)
            return _exp_inside(logs)
        draws = np.asarray(rng.standard_gamma(a, shape))
        with np.errstate(divide="ignore", over="ignore", under="ignore"):
            np.divide(self.scale, draws, out=draws)
        return np.clip(draws, _TINY, _HUGE, out=draws)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        a = self.concentration
        y = np.asarray(x / self.scale)
        log_y = np.log(y)
        lost = (y < _TINY) | np.isinf(y)
        if lost.any():  # the ratio left the numbers, its logarithm need not
            log_y = np.where(lost, np.log(x) - np.log(self.scale), log_y)
        density = -(a + 1) * log_y - special.gammaln(a) - 1.0 / y - np.log(self.scale)
        # towards zero the exponential wins, however steep the power
        return np.where((x <= 0) | (y == 0), -np.inf, density)

    @property
    def mean(self) -> np.ndarray:
        """Infinite where ``concentration <= 1``."""
        a = self.concentration
        finite = np.where(a > 1, a, 2.0)
        return np.broadcast_to(np.where(a > 1, self.scale / (finite - 1), np.inf), self.batch_shape)

    @property
    def var(self) -> np.ndarray:
        """Infinite where ``concentration <= 2``."""
        a = self.concentration
        finite = np.where(a > 2, a, 3.0)
        value = (self.scale / (finite - 1)) ** 2 / (finite - 2)
        return np.broadcast_to(np.where(a > 2, value, np.inf), self.batch_shape)

    @property
    def support(self) -> Support:
        return positive

    def cdf(self, x: Any) -> np.ndarray:
        a, x = self.concentration, np.maximum(x, 0.0)
        with np.errstate(divide="ignore", over="ignore"):
            y = np.asarray(self.scale / x)
            value = special.gammaincc(a, y)
            lost = (y < _TINY) & (x < np.inf)
            if lost.any():  # here 1 - y**a / Gamma(a + 1), and y need not be a number
                log_y = np.log(self.scale) - np.log(np.maximum(x, _TINY))
                value = np.where(lost, -np.expm1(a * log_y - special.gammaln(a + 1)), value)
        return value

    def ppf(self, q: Any) -> np.ndarray:
        a, q = self.concentration, as_quantile(q)
        with np.errstate(divide="ignore", over="ignore"):
            y = np.asarray(special.gammainccinv(a, q))
            value = self.scale / y
            if (y < _TINY).any():
                log_y = (np.log1p(-q) + special.gammaln(a + 1)) / a
                value = np.where(y < _TINY, np.exp(np.log(self.scale) - log_y), value)
        return value


class Weibull(ShapeScale):
    """Weibull distribution, whose cdf is ``1 - exp(-(x / scale)**concentration)``.

    Parameters
    ----------
    concentration : array_like
        Shape, positive: hazard falls below 1, is constant at 1 and rises above.
    scale : array_like
        Positive; the value that ``1 - 1/e`` of the mass lies below.

    Raises
    ------
    ParameterError
        A parameter is not positive and finite.

    Notes
    -----
    At 0 the density is infinite where the concentration is below one.

    References
    ----------
    Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions I, ch. 21.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dist = bmc.Weibull(2.0, 3.0)
    >>> float(dist.log_prob(3.0).round(4)), float(dist.cdf(3.0).round(4))
    (-1.4055, 0.6321)
    """

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        logs = np.asarray(rng.standard_exponential(shape))
        with np.errstate(divide="ignore", over="ignore"):
            np.log(logs, out=logs)
            logs /= self.concentration
        logs += np.log(self.scale)
        return _exp_inside(logs)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        c, log_scale = self.concentration, np.log(self.scale)
        ratio, lost = self._ratio(x)
        power, y = special.xlogy(c - 1.0, ratio), np.power(ratio, c)
        if lost is not None:
            log_ratio = np.log(x) - log_scale
            power = np.where(lost, (c - 1.0) * log_ratio, power)
            y = np.where(lost, np.exp(c * log_ratio), y)
        density = np.log(c) + power - y - log_scale
        # towards infinity the exponential wins, however steep the power
        return np.where((x < 0) | np.isinf(y), -np.inf, density)

    @property
    def mean(self) -> np.ndarray:
        with np.errstate(over="ignore"):
            return self.scale * special.gamma(1 + 1 / self.concentration)

    @property
    def var(self) -> np.ndarray:
        with np.errstate(over="ignore"):
            inverse = 1 / self.concentration
            # Gamma(1 + 2/c) - Gamma(1 + 1/c)**2, which would cancel for large concentrations
            ratio = special.gammaln(1 + 2 * inverse) - 2 * special.gammaln(1 + inverse)
            return self.mean**2 * np.expm1(ratio)

    @property
    def support(self) -> Support:
        return nonnegative

    def cdf(self, x: Any) -> np.ndarray:
        with np.errstate(divide="ignore", over="ignore"):
            x = np.maximum(x, 0.0)
            ratio, lost = self._ratio(x)
            y = np.power(ratio, self.concentration)
            if lost is not None:
                log_ratio = np.log(x) - np.log(self.scale)
                y = np.where(lost, np.exp(self.concentration * log_ratio), y)
            return -np.expm1(-y)

    def ppf(self, q: Any) -> np.ndarray:
        with np.errstate(divide="ignore", over="ignore"):
            hazard = -np.log1p(-as_quantile(q))
            z = np.asarray(np.power(hazard, 1 / self.concentration))
            value = self.scale * z
            lost = (z < _TINY) | np.isinf(z)
            if lost.any():
                log_z = np.log(hazard) / self.concentration
                value = np.where(lost, np.exp(log_z + np.log(self.scale)), value)
        return value

    def _ratio(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """``x / scale``, and where it left the numbers (None: nowhere) though ``x`` did not."""
        ratio = np.asarray(x / self.scale)
        lost = (ratio < _TINY) | np.isinf(ratio)
        if not lost.any():
            return ratio, None
        return ratio, lost & (x > 0) & (x < np.inf)


def _exp_inside(logs: np.ndarray) -> np.ndarray:
    """``exp`` in place; what under- or overflows becomes the nearest positive finite number."""
    with np.errstate(over="ignore", under="ignore"):
        np.exp(logs, out=logs)
    return np.clip(logs, _TINY, _HUGE, out=logs)
