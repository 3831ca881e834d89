"""Continuous families of one number: StudentT, Uniform, Beta, Gamma, Exponential.

Densities follow SciPy's formulas operation by operation, so that the two agree to rounding even
where large terms cancel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.base import Distribution, as_float, as_quantile
from bayesmc.distributions.support import Support, interval, nonnegative, real, unit_interval
from bayesmc.shapes import Shape

_TINY = np.finfo(float).tiny
_BELOW_ONE = np.nextafter(1.0, 0.0)
_UNDERFLOWS = 0.05  # a Gamma or Beta variate of smaller concentration can underflow to zero


#: times ``sqrt(df)`` from where on a Student t is its power law to the last digit; SciPy errs farther out
_FAR = 1e9
#: what the bounds of a uniform distribution must be
_BOUNDED = "finite (for a flat prior take a wide Normal, such as Normal(0, 100))"
_HALF_LOG_PI = 0.5 * float(np.log(np.pi))


class StudentT(Distribution):
    """Student's t distribution with location and scale.

    Parameters
    ----------
    df : array_like
        Degrees of freedom, positive and finite.
    loc : array_like
        Centre (the mean when ``df > 1``).
    scale : array_like
        Scale, positive; the variance is ``scale**2 * df / (df - 2)`` when ``df > 2``.

    Raises
    ------
    ParameterError
        ``df`` or ``scale`` not positive and finite, or ``loc`` not finite.

    References
    ----------
    Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions II, ch. 28.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> float(bmc.StudentT(3.0, 0.0, 1.0).log_prob(0.0).round(4))
    -1.0009
    """

    parameter_ndim = {"df": 0, "loc": 0, "scale": 0}

    def __init__(self, df: Any, loc: Any = 0.0, scale: Any = 1.0) -> None:
        df, loc, scale = as_float(df), as_float(loc), as_float(scale)
        self._set_batch(df.shape, loc.shape, scale.shape)
        self.df = self._positive("df", df)
        self.loc = self._finite("loc", loc)
        self.scale = self._positive("scale", scale)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = np.asarray(rng.standard_t(self.df, shape))
        draws *= self.scale
        draws += self.loc
        return draws

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        df, z = self.df, (x - self.loc) / self.scale
        ratio = z * z / df
        # log1p costs twice a log, and its digits only count once (df + 1) / 2 magnifies them
        tail = np.log1p(ratio) if df.ndim or df > 100 else np.log(1.0 + ratio)
        if np.isinf(tail).any():  # z * z overflowed; heavy tails do reach that far
            tail = np.where(np.isinf(tail), 2 * np.log(np.abs(z)) - np.log(df), tail)
        constant = np.log(special.poch(0.5 * df, 0.5)) - 0.5 * (np.log(df) + np.log(np.pi))
        return constant - (df + 1) / 2 * tail - np.log(self.scale)

    @property
    def mean(self) -> np.ndarray:
        """``loc`` where ``df > 1``; infinite otherwise, as in SciPy, for the integral diverges."""
        return np.broadcast_to(np.where(self.df > 1, self.loc, np.inf), self.batch_shape)

    @property
    def var(self) -> np.ndarray:
        """Infinite for ``1 < df <= 2``, NaN for ``df <= 1``."""
        df = np.where(self.df > 2, self.df, 3.0)
        standard = np.where(self.df > 2, df / (df - 2), np.where(self.df > 1, np.inf, np.nan))
        return np.broadcast_to(self.scale**2 * standard, self.batch_shape)

    @property
    def support(self) -> Support:
        return real

    def cdf(self, x: Any) -> np.ndarray:
        with np.errstate(over="ignore"):
            z = (np.asarray(x) - self.loc) / self.scale
            below = special.stdtr(self.df, z)
        far = (np.abs(z) > _FAR * np.sqrt(self.df)) & np.isfinite(z)
        if not far.any():
            return below
        with np.errstate(over="ignore"):  # where it is not needed
            tail = np.exp(self._log_tail - self.df * np.log(np.where(far, np.abs(z), 1.0)))
        return np.where(far, np.where(z < 0, tail, 1.0 - tail), below)[()]

    def ppf(self, q: Any) -> np.ndarray:
        q = as_quantile(q)
        z = special.stdtrit(self.df, q)
        far = (np.abs(z) > _FAR * np.sqrt(self.df)) & (q > 0) & (q < 1)
        if far.any():
            with np.errstate(over="ignore"):  # beyond the largest double it is infinite
                tail = np.where(far, np.minimum(q, 1.0 - q), 0.5)
                size = np.exp((self._log_tail - np.log(tail)) / self.df)
            z = np.where(far, np.copysign(size, q - 0.5), z)
        z = np.where((q <= 0) | (q >= 1), np.copysign(np.inf, q - 0.5), z)[()]  # SciPy: +inf at 0
        return self.loc + self.scale * z

    @property
    def _log_tail(self) -> np.ndarray:
        """log K of the tail ``K |z|**-df``."""
        df = self.df
        return (
            np.log(special.poch(0.5 * df, 0.5)) + 0.5 * df * np.log(df) - np.log(df) - _HALF_LOG_PI
        )


class Uniform(Distribution):
    """Uniform distribution on the interval from ``low`` to ``high``, both ends included.

    Parameters
    ----------
    low, high : array_like
        Finite bounds, ``low < high``.

    Raises
    ------
    ParameterError
        A bound is not finite, or ``high`` is not above ``low``.

    References
    ----------
    Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions II, ch. 26.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> bmc.Uniform(0.0, 2.0).cdf([0.5, 3.0]).tolist()
    [0.25, 1.0]
    """

    parameter_ndim = {"low": 0, "high": 0}

    def __init__(self, low: Any = 0.0, high: Any = 1.0) -> None:
        low, high = as_float(low), as_float(high)
        self._set_batch(low.shape, high.shape)
        self.low = self._finite("low", low, _BOUNDED)
        with np.errstate(over="ignore", invalid="ignore"):
            width = high - self.low
            ok = (width > 0) & (width < np.inf)
        self.high = high
        if not ok.all():
            high = np.broadcast_to(high, self.batch_shape)
            above = np.asarray(self.low + np.maximum(1.0, np.abs(self.low)))
            self.high = self._check(
                "high",
                high,
                ok,
                above,
                _BOUNDED if np.isinf(high).any() else "finite and above low",
            )

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = np.asarray(rng.random(shape))
        draws *= self.high - self.low
        draws += self.low
        return np.minimum(draws, self.high, out=draws)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        outside = (x < self.low) | (x > self.high)
        # x - x is zero inside and NaN for NaN
        return np.where(outside, -np.inf, (x - x) - np.log(self.high - self.low))

    @property
    def mean(self) -> np.ndarray:
        return np.broadcast_to(self.low + 0.5 * (self.high - self.low), self.batch_shape)

    @property
    def var(self) -> np.ndarray:
        return np.broadcast_to((self.high - self.low) ** 2 / 12, self.batch_shape)

    @property
    def support(self) -> Support:
        return interval(self.low, self.high)

    def cdf(self, x: Any) -> np.ndarray:
        x = np.clip(np.asarray(x, dtype=float), self.low, self.high)
        return (x - self.low) / (self.high - self.low)

    def ppf(self, q: Any) -> np.ndarray:
        return self.low + (self.high - self.low) * as_quantile(q)


class Beta(Distribution):
    """Beta distribution, ``x**(concentration1 - 1) * (1 - x)**(concentration0 - 1)`` normalised.

    Parameters
    ----------
    concentration1, concentration0 : array_like
        Positive; often written a and b: prior counts of ones and of zeros.

    Raises
    ------
    ParameterError
        A concentration is not positive and finite.

    Notes
    -----
    At 0 and 1 the density is infinite where the concentration is below one. Draws that would
    round to such a point are moved to the nearest number inside.

    References
    ----------
    Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions II, ch. 25.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> float(bmc.Beta(2.0, 2.0).log_prob(0.5).round(4)), float(bmc.Beta(3.0, 1.0).mean)
    (0.4055, 0.75)
    """

    parameter_ndim = {"concentration1": 0, "concentration0": 0}

    def __init__(self, concentration1: Any, concentration0: Any) -> None:
        a, b = as_float(concentration1), as_float(concentration0)
        self._set_batch(a.shape, b.shape)
        self.concentration1 = self._positive("concentration1", a)
        self.concentration0 = self._positive("concentration0", b)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = np.asarray(rng.beta(self.concentration1, self.concentration0, shape))
        if _least(self.concentration1) < _UNDERFLOWS or _least(self.concentration0) < 1:
            np.clip(draws, _TINY, _BELOW_ONE, out=draws)
        return draws

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        a, b = self.concentration1, self.concentration0
        density = special.xlog1py(b - 1.0, -x) + special.xlogy(a - 1.0, x)
        return np.where((x < 0) | (x > 1), -np.inf, density - special.betaln(a, b))

    @property
    def mean(self) -> np.ndarray:
        a, b = self.concentration1, self.concentration0
        return np.broadcast_to(a / (a + b), self.batch_shape)

    @property
    def var(self) -> np.ndarray:
        a, b = self.concentration1, self.concentration0
        share = a / (a + b)
        return np.broadcast_to(share * (b / (a + b)) / (a + b + 1), self.batch_shape)

    @property
    def support(self) -> Support:
        return unit_interval

    def cdf(self, x: Any) -> np.ndarray:
        x = np.clip(np.asarray(x, dtype=float), 0.0, 1.0)
        return special.betainc(self.concentration1, self.concentration0, x)

    def ppf(self, q: Any) -> np.ndarray:
        return special.betaincinv(self.concentration1, self.concentration0, as_quantile(q))


class Gamma(Distribution):
    """Gamma distribution with density proportional to ``x**(concentration - 1) exp(-rate x)``.

    Parameters
    ----------
    concentration : array_like
        Shape, positive.
    rate : array_like
        Inverse scale, positive: the mean is ``concentration / rate``.

    Raises
    ------
    ParameterError
        A parameter is not positive and finite.

    Notes
    -----
    At 0 the density is infinite where the concentration is below one. Draws that would underflow
    to 0 become the smallest normal number.

    References
    ----------
    Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions I, ch. 17.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> float(bmc.Gamma(2.0, 1.0).log_prob(1.0).round(4)), float(bmc.Gamma(3.0, 2.0).mean)
    (-1.0, 1.5)
    """

    parameter_ndim = {"concentration": 0, "rate": 0}

    def __init__(self, concentration: Any, rate: Any = 1.0) -> None:
        concentration, rate = as_float(concentration), as_float(rate)
        self._set_batch(concentration.shape, rate.shape)
        self.concentration = self._positive("concentration", concentration)
        self.rate = self._positive("rate", rate)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = np.asarray(rng.standard_gamma(self.concentration, shape))
        draws /= self.rate
        if _least(self.concentration) < _UNDERFLOWS:
            np.maximum(draws, _TINY, out=draws)
        return draws

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        a, scale = self.concentration, 1.0 / self.rate
        y = x / scale
        density = special.xlogy(a - 1.0, y) - y - special.gammaln(a) - np.log(scale)
        return np.where((x < 0) | (y == np.inf), -np.inf, density)

    @property
    def mean(self) -> np.ndarray:
        return np.broadcast_to(self.concentration / self.rate, self.batch_shape)

    @property
    def var(self) -> np.ndarray:
        return np.broadcast_to(self.concentration / self.rate**2, self.batch_shape)

    @property
    def support(self) -> Support:
        return nonnegative

    def cdf(self, x: Any) -> np.ndarray:
        with np.errstate(over="ignore"):
            return special.gammainc(self.concentration, np.maximum(x, 0.0) * self.rate)

    def ppf(self, q: Any) -> np.ndarray:
        return special.gammaincinv(self.concentration, as_quantile(q)) / self.rate


class Exponential(Distribution):
    """Exponential distribution with density ``rate exp(-rate x)`` on ``x >= 0``.

    Parameters
    ----------
    rate : array_like
        Positive; the mean is ``1 / rate``.

    Raises
    ------
    ParameterError
        ``rate`` is not positive and finite.

    References
    ----------
    Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions I, ch. 19.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> float(bmc.Exponential(2.0).log_prob(0.0).round(4)), float(bmc.Exponential(2.0).mean)
    (0.6931, 0.5)
    """

    parameter_ndim = {"rate": 0}

    def __init__(self, rate: Any = 1.0) -> None:
        rate = as_float(rate)
        self._set_batch(rate.shape)
        self.rate = self._positive("rate", rate)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = np.asarray(rng.standard_exponential(shape))
        draws /= self.rate
        return draws

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        scale = 1.0 / self.rate
        return np.where(x < 0, -np.inf, -(x / scale) - np.log(scale))

    @property
    def mean(self) -> np.ndarray:
        return 1.0 / self.rate

    @property
    def var(self) -> np.ndarray:
        return 1.0 / self.rate**2

    @property
    def support(self) -> Support:
        return nonnegative

    def cdf(self, x: Any) -> np.ndarray:
        with np.errstate(over="ignore"):
            return -special.expm1(-np.maximum(x, 0.0) * self.rate)

    def ppf(self, q: Any) -> np.ndarray:
        with np.errstate(divide="ignore"):
            return -np.log1p(-as_quantile(q)) / self.rate


def _least(value: np.ndarray) -> float:
    return float(value.min()) if value.size else np.inf
