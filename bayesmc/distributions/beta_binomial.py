"""Successes among trials whose probability varies from case to case."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.base import Distribution, as_float, as_quantile, as_whole
from bayesmc.distributions.discrete import trials_of
from bayesmc.distributions.support import Support, integers
from bayesmc.shapes import Shape


class BetaBinomial(Distribution):
    """Successes among ``total_count`` trials, whose probability is drawn from a `Beta` for all of them.

    A binomial that is spread more widely than one probability allows. With mean probability ``p`` and
    ``theta`` cases' worth of agreement about it, the concentrations are ``p * theta`` and
    ``(1 - p) * theta``.

    Parameters
    ----------
    total_count : array_like of int
        Number of trials, nonnegative.
    concentration1, concentration0 : array_like
        Of the Beta: positive.

    Raises
    ------
    ParameterError
        ``total_count`` not a nonnegative whole number, or a concentration not positive and finite.

    References
    ----------
    Johnson, Kemp and Kotz, Univariate Discrete Distributions, 3rd ed., section 6.2.2.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> spread = bmc.BetaBinomial(10, 2.0, 2.0)
    >>> float(spread.mean), float(spread.var), float(bmc.Binomial(10, 0.5).var)
    (5.0, 7.0, 2.5)
    """

    is_discrete = True
    parameter_ndim = {"total_count": 0, "concentration1": 0, "concentration0": 0}

    def __init__(self, total_count: Any, concentration1: Any, concentration0: Any) -> None:
        count, whole = as_whole(total_count)
        one, zero = as_float(concentration1), as_float(concentration0)
        self._set_batch(count.shape, one.shape, zero.shape)
        self.concentration1 = self._positive("concentration1", one)
        self.concentration0 = self._positive("concentration0", zero)
        self.total_count = trials_of(self, total_count, count, whole)

    @staticmethod
    def log_density(x: Any, total_count: Any, concentration1: Any, concentration0: Any) -> Any:
        """Of the two beta functions, and the number of ways as one more."""
        inside = (x >= 0) & (x <= total_count) & (np.floor(x) == x)
        k = np.where(inside, x, 0.0)
        rest = total_count - k
        ways = -np.log(total_count + 1.0) - special.betaln(rest + 1.0, k + 1.0)
        chance = special.betaln(k + concentration1, rest + concentration0)
        found = ways + chance - special.betaln(concentration1, concentration0)
        return np.where(inside, found, -np.inf)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        probs = rng.beta(self.concentration1, self.concentration0, shape)
        return np.asarray(rng.binomial(self.total_count, probs))

    @property
    def mean(self) -> np.ndarray:
        total = self.concentration1 + self.concentration0
        return np.asarray(self.total_count * (self.concentration1 / total))

    @property
    def var(self) -> np.ndarray:
        total, n = self.concentration1 + self.concentration0, self.total_count
        share = self.concentration1 / total
        return np.asarray(n * share * (1.0 - share) * ((total + n) / (total + 1.0)))

    @property
    def support(self) -> Support:
        return integers(0, self.total_count)

    def cdf(self, x: Any) -> np.ndarray:
        x = np.asarray(x, dtype=float)
        return np.where(np.isnan(x), np.nan, self._scipy.cdf(x))

    def ppf(self, q: Any) -> np.ndarray:
        q = as_quantile(q)
        found = np.maximum(self._scipy.ppf(q), 0.0)
        return np.where(np.isnan(q), np.nan, found)

    @property
    def _scipy(self) -> Any:
        from scipy import stats

        return stats.betabinom(self.total_count, self.concentration1, self.concentration0)
