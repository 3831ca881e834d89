"""Families of one number moved by a location or stretched by a scale, and the halves of two.

Laplace and Cauchy on the real line, HalfNormal and HalfCauchy on the nonnegative numbers; Normal
and StudentT have rooms of their own.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.base import Distribution, as_float, as_quantile
from bayesmc.distributions.support import Support, nonnegative, real
from bayesmc.shapes import Shape

_LOG_2 = np.log(2.0)
_LOG_PI = np.log(np.pi)
_HALF_LOG_HALF_PI = 0.5 * np.log(np.pi / 2)


class LocationScale(Distribution):
    """A number moved by ``loc`` and stretched by ``scale``, and functions of one."""

    parameter_ndim = {"loc": 0, "scale": 0}

    def __init__(self, loc: Any = 0.0, scale: Any = 1.0) -> None:
        loc, scale = as_float(loc), as_float(scale)
        self._set_batch(loc.shape, scale.shape)
        self.loc = self._finite("loc", loc)
        self.scale = self._positive("scale", scale)

    @property
    def support(self) -> Support:
        return real


class Laplace(LocationScale):
    """Laplace (double exponential) distribution, ``exp(-|x - loc| / scale) / (2 scale)``.

    ``infer(..., engine=bmc.Laplace())`` is another thing of the same name: `LaplaceApproximation`.

    Parameters
    ----------
    loc : array_like
        Mean and median.
    scale : array_like
        Mean distance from ``loc``, positive; the variance is ``2 scale**2``.

    Raises
    ------
    ParameterError
        ``loc`` not finite, or ``scale`` not positive and finite.

    References
    ----------
    Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions II, ch. 24.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> float(bmc.Laplace(0.0, 2.0).log_prob(2.0).round(4)), float(bmc.Laplace(0.0, 2.0).var)
    (-2.3863, 8.0)
    """

    #: whether it was made of no parameters at all, as where the method of that name is meant
    is_bare: bool = False

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        found = super().__new__(cls, *args, **kwargs)
        if isinstance(found, Laplace):  # of traced parameters it is none
            found.is_bare = not (args or kwargs)
        return found

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = np.asarray(rng.laplace(size=shape))
        draws *= self.scale
        draws += self.loc
        return draws

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        value = np.asarray((x - self.loc) / self.scale)
        np.abs(value, out=value)
        np.negative(value, out=value)
        value -= _LOG_2
        return value - np.log(self.scale)

    @property
    def mean(self) -> np.ndarray:
        return np.broadcast_to(self.loc, self.batch_shape)

    @property
    def var(self) -> np.ndarray:
        return np.broadcast_to(2 * self.scale**2, self.batch_shape)

    def cdf(self, x: Any) -> np.ndarray:
        with np.errstate(over="ignore"):
            z = (np.asarray(x) - self.loc) / self.scale
        tail = 0.5 * np.exp(-np.abs(z))
        return np.where(z > 0, 1.0 - tail, tail)

    def ppf(self, q: Any) -> np.ndarray:
        q = as_quantile(q)
        with np.errstate(divide="ignore"):
            # 2 (1 - q) is exact above one half, where it is used
            z = np.where(q > 0.5, -np.log(2 * (1 - q)), np.log(2 * q))
        return self.loc + self.scale * z


class Cauchy(LocationScale):
    """Cauchy distribution, ``1 / (1 + ((x - loc) / scale)**2)`` normalised.

    Parameters
    ----------
    loc : array_like
        Median; there is no mean.
    scale : array_like
        Half the distance between the quartiles, positive.

    Raises
    ------
    ParameterError
        ``loc`` not finite, or ``scale`` not positive and finite.

    References
    ----------
    Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions I, ch. 16.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dist = bmc.Cauchy(1.0, 2.0)
    >>> float(dist.log_prob(3.0).round(4)), float(dist.ppf(0.75).round(6))
    (-2.531, 3.0)
    """

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = np.asarray(rng.standard_cauchy(shape))
        draws *= self.scale
        draws += self.loc
        return draws

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        value = _minus_log1p_square((x - self.loc) / self.scale)
        value -= _LOG_PI
        return value - np.log(self.scale)

    @property
    def mean(self) -> np.ndarray:
        """NaN: the integral does not exist."""
        return np.full(self.batch_shape, np.nan)

    @property
    def var(self) -> np.ndarray:
        """NaN, for there is no mean."""
        return np.full(self.batch_shape, np.nan)

    def cdf(self, x: Any) -> np.ndarray:
        with np.errstate(over="ignore"):
            z = (np.asarray(x) - self.loc) / self.scale
        return np.arctan2(1.0, -z) / np.pi  # keeps the digits of the left tail, as atan + 1/2 not

    def ppf(self, q: Any) -> np.ndarray:
        q = as_quantile(q)
        centre = np.tan(np.pi * (q - 0.5))
        with np.errstate(divide="ignore"):
            tail = 1.0 / np.tan(np.pi * np.minimum(q, 1 - q))
        z = np.where(np.abs(q - 0.5) < 0.25, centre, np.where(q < 0.5, -tail, tail))
        return self.loc + self.scale * z


class _Half(Distribution):
    """The absolute value of a distribution symmetric about zero, with its scale as the only parameter."""

    parameter_ndim = {"scale": 0}

    def __init__(self, scale: Any = 1.0) -> None:
        scale = as_float(scale)
        self._set_batch(scale.shape)
        self.scale = self._positive("scale", scale)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = self._whole(rng, shape)
        np.abs(draws, out=draws)
        draws *= self.scale
        return draws

    def _whole(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        """Draws of the whole distribution at scale one."""
        raise NotImplementedError

    @property
    def support(self) -> Support:
        return nonnegative


class HalfNormal(_Half):
    """Half-normal distribution: the absolute value of a normal one of mean zero.

    Parameters
    ----------
    scale : array_like
        Standard deviation of that normal, positive.

    Raises
    ------
    ParameterError
        ``scale`` is not positive and finite.

    References
    ----------
    Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions I, section 13.10.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> float(bmc.HalfNormal(2.0).log_prob(0.0).round(4)), float(bmc.HalfNormal(2.0).mean.round(4))
    (-0.9189, 1.5958)
    """

    def _whole(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        return np.asarray(rng.standard_normal(shape))

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        z = np.asarray(x / self.scale)
        z *= z
        z *= -0.5
        z -= _HALF_LOG_HALF_PI
        return np.where(x < 0, -np.inf, z - np.log(self.scale))

    @property
    def mean(self) -> np.ndarray:
        return self.scale * np.sqrt(2 / np.pi)

    @property
    def var(self) -> np.ndarray:
        return self.scale**2 * (1 - 2 / np.pi)

    def cdf(self, x: Any) -> np.ndarray:
        with np.errstate(over="ignore"):
            return special.erf(np.maximum(x, 0.0) / self.scale / np.sqrt(2.0))

    def ppf(self, q: Any) -> np.ndarray:
        return self.scale * (np.sqrt(2.0) * special.erfinv(as_quantile(q)))


class HalfCauchy(_Half):
    """Half-Cauchy distribution: the absolute value of a Cauchy one centred at zero.

    Parameters
    ----------
    scale : array_like
        Median, positive.

    Raises
    ------
    ParameterError
        ``scale`` is not positive and finite.

    References
    ----------
    Gelman, Prior distributions for variance parameters in hierarchical models, Bayesian Analysis
    1(3), 2006, section 3.2.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> float(bmc.HalfCauchy(5.0).log_prob(5.0).round(4)), float(bmc.HalfCauchy(5.0).cdf(5.0))
    (-2.7542, 0.5)
    """

    def _whole(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        return np.asarray(rng.standard_cauchy(shape))

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        value = _minus_log1p_square(x / self.scale)
        value += _LOG_2 - _LOG_PI
        return np.where(x < 0, -np.inf, value - np.log(self.scale))

    @property
    def mean(self) -> np.ndarray:
        """Infinite: the integral diverges."""
        return np.full(self.batch_shape, np.inf)

    @property
    def var(self) -> np.ndarray:
        """Infinite, as in SciPy."""
        return np.full(self.batch_shape, np.inf)

    def cdf(self, x: Any) -> np.ndarray:
        with np.errstate(over="ignore"):
            return 2 / np.pi * np.arctan(np.maximum(x, 0.0) / self.scale)

    def ppf(self, q: Any) -> np.ndarray:
        q = as_quantile(q)
        with np.errstate(divide="ignore"):
            far = 1.0 / np.tan(np.pi / 2 * (1 - q))  # near one the tangent of q itself loses digits
        return self.scale * np.where(q < 0.5, np.tan(np.pi / 2 * q), far)


def _minus_log1p_square(z: Any) -> np.ndarray:
    """``-log(1 + z**2)``, also where the square overflows; a new array."""
    value = np.asarray(z * z)
    far = np.isinf(value)
    value = np.log1p(value, out=value)
    if far.any():
        value = np.where(far, 2 * np.log(np.abs(z)), value)
    return np.negative(value, out=value)
