"""Discrete families of one number: Bernoulli, Binomial, Poisson, DiscreteUniform.

Log probabilities follow SciPy's formulas operation by operation and are minus infinity at anything
that is not a whole number of the support.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.base import Distribution, as_float, as_quantile, as_whole
from bayesmc.distributions.support import Support, integers
from bayesmc.errors import ParameterError
from bayesmc.shapes import Shape

_BINARY = integers(0, 1)
_COUNTS = integers(0)
_LARGEST = 2.0**62  # draws are int64; what lies further out stops here


class _Odds(Distribution):
    """What Bernoulli and Binomial share: a probability, or its log odds."""

    logits: np.ndarray | None = None

    def _set_probs(self, probs: Any, logits: Any, *others: Shape) -> None:
        if (probs is None) == (logits is None):
            raise ParameterError(f"{type(self).__name__}: give exactly one of probs and logits")
        value = as_float(probs if logits is None else logits)
        self._set_batch(value.shape, *others)
        if logits is None:
            self.probs = self._unit("probs", value)
        else:
            self.logits = self._check("logits", value, ~np.isnan(value), 0.0, "a number")
            self.probs = special.expit(self.logits)

    def _log_one(self) -> np.ndarray:
        """``log P(1)``, its tail kept where logits were given."""
        return np.log(self.probs) if self.logits is None else special.log_expit(self.logits)

    def _log_zero(self) -> np.ndarray:
        """``log P(0)``, likewise."""
        return np.log1p(-self.probs) if self.logits is None else special.log_expit(-self.logits)


class Bernoulli(_Odds):
    """Bernoulli distribution: 1 with probability ``probs``, otherwise 0.

    Give exactly one of ``probs`` and ``logits``.

    Parameters
    ----------
    probs : array_like
        Probability of 1.
    logits : array_like
        Log odds of 1; infinities are certainties.

    Raises
    ------
    ParameterError
        ``probs`` not between 0 and 1, or ``logits`` NaN.

    References
    ----------
    Johnson, Kemp and Kotz, Univariate Discrete Distributions, 3rd ed., section 3.2.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> bmc.Bernoulli([0.5, 0.9]).log_prob(1).round(4).tolist()
    [-0.6931, -0.1054]
    """

    is_discrete = True
    parameter_ndim = {"probs": 0}

    def __init__(self, probs: Any = None, *, logits: Any = None) -> None:
        self._set_probs(probs, logits)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        return np.asarray(np.less(rng.random(shape), self.probs)).astype(np.int64)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        if x.ndim == 0:  # one observed value for the whole batch needs no selection
            one = self._log_one if x == 1 else self._log_zero
            return np.array(one() if x in (0, 1) else np.full(self.batch_shape, -np.inf))
        return np.where(x == 1, self._log_one(), np.where(x == 0, self._log_zero(), -np.inf))

    @property
    def mean(self) -> np.ndarray:
        return self.probs

    @property
    def var(self) -> np.ndarray:
        return self.probs * (1 - self.probs)

    @property
    def support(self) -> Support:
        return _BINARY

    @property
    def probs_table(self) -> np.ndarray:
        return np.stack([1 - self.probs, self.probs], axis=-1)

    def cdf(self, x: Any) -> np.ndarray:
        x = np.asarray(x, dtype=float)
        below = np.where(x >= 1, 1.0, np.where(x >= 0, 1 - self.probs, 0.0))
        return np.where(np.isnan(x), np.nan, below)

    def ppf(self, q: Any) -> np.ndarray:
        q = as_quantile(q)
        return np.where(np.isnan(q), np.nan, (q > 1 - self.probs) * 1.0)


class Binomial(_Odds):
    """Binomial distribution: successes among ``total_count`` trials.

    Give exactly one of ``probs`` and ``logits``.

    Parameters
    ----------
    total_count : array_like of int
        Number of trials, nonnegative.
    probs : array_like
        Probability of success.
    logits : array_like
        Log odds of success.

    Raises
    ------
    ParameterError
        ``total_count`` not a nonnegative whole number, ``probs`` not between 0 and 1, or ``logits``
        NaN.

    References
    ----------
    Johnson, Kemp and Kotz, Univariate Discrete Distributions, 3rd ed., ch. 3.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> float(bmc.Binomial(10, 0.5).log_prob(5).round(3))
    -1.402
    """

    is_discrete = True
    parameter_ndim = {"total_count": 0, "probs": 0}

    def __init__(self, total_count: Any, probs: Any = None, *, logits: Any = None) -> None:
        count, whole = as_whole(total_count)
        self._set_probs(probs, logits, count.shape)
        self.total_count = trials_of(self, total_count, count, whole)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        return np.asarray(rng.binomial(self.total_count, self.probs, shape))

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        n = self.total_count
        inside = (x >= 0) & (x <= n) & (x == np.floor(x))
        k = np.where(inside, x, 0.0)
        ways = special.gammaln(n + 1) - (special.gammaln(k + 1) + special.gammaln(n - k + 1))
        if self.logits is None:
            value = ways + special.xlogy(k, self.probs) + special.xlog1py(n - k, -self.probs)
        else:
            one, zero = self._log_one(), self._log_zero()
            value = ways + np.where(k > 0, k * one, 0.0) + np.where(k < n, (n - k) * zero, 0.0)
        return np.where(inside, value, -np.inf)

    @property
    def mean(self) -> np.ndarray:
        return np.asarray(self.total_count * self.probs)

    @property
    def var(self) -> np.ndarray:
        return self.total_count * self.probs * (1 - self.probs)

    @property
    def support(self) -> Support:
        return integers(0, self.total_count)

    def cdf(self, x: Any) -> np.ndarray:
        x, n = np.asarray(x, dtype=float), self.total_count
        k = np.clip(np.floor(x), 0, np.maximum(n - 1, 0))
        # P(X <= k) = 1 - I_p(k + 1, n - k)
        value = special.betaincc(k + 1, np.maximum(n - k, 1), self.probs)
        return np.where(np.isnan(x), np.nan, np.where(x < 0, 0.0, np.where(x >= n, 1.0, value)))

    def ppf(self, q: Any) -> np.ndarray:
        return whole_ppf(self.cdf, q, np.zeros(self.batch_shape), self.total_count)


class Poisson(Distribution):
    """Poisson distribution.

    Parameters
    ----------
    rate : array_like
        Mean, nonnegative and finite; at 0 the value is 0 for certain.

    Raises
    ------
    ParameterError
        ``rate`` is negative or not finite.

    References
    ----------
    Johnson, Kemp and Kotz, Univariate Discrete Distributions, 3rd ed., ch. 4.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> float(bmc.Poisson(3.0).log_prob(2).round(4))
    -1.4959
    """

    is_discrete = True
    parameter_ndim = {"rate": 0}

    def __init__(self, rate: Any) -> None:
        rate = as_float(rate)
        self._set_batch(rate.shape)
        ok = (rate >= 0) & (rate < np.inf)
        self.rate = self._check("rate", rate, ok, 1.0, "nonnegative and finite")

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        return np.asarray(rng.poisson(np.minimum(self.rate, _LARGEST), shape))

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        inside = (x >= 0) & (x == np.floor(x)) & (x < np.inf)
        k = np.where(inside, x, 0.0)
        # one positive count needs no guard against 0 * log(0), and NumPy's log is the faster one
        power = k * np.log(self.rate) if k.ndim == 0 and k > 0 else special.xlogy(k, self.rate)
        value = power - special.gammaln(k + 1) - self.rate
        if inside.ndim == 0 and inside:
            return np.asarray(value)
        return np.where(inside, value, -np.inf)

    @property
    def mean(self) -> np.ndarray:
        return self.rate

    @property
    def var(self) -> np.ndarray:
        return self.rate

    @property
    def support(self) -> Support:
        return _COUNTS

    def cdf(self, x: Any) -> np.ndarray:
        x = np.asarray(x, dtype=float)
        value = special.pdtr(np.maximum(np.floor(x), 0.0), self.rate)
        return np.where(x < 0, 0.0, np.where(x == np.inf, 1.0, value))

    def ppf(self, q: Any) -> np.ndarray:
        return whole_ppf(self.cdf, q, np.zeros(self.batch_shape), np.inf)


class DiscreteUniform(Distribution):
    """Uniform distribution on the integers from ``low`` to ``high``, both included.

    Parameters
    ----------
    low, high : array_like of int
        Bounds, ``low <= high``.

    Raises
    ------
    ParameterError
        A bound is not a whole number, or ``high`` is below ``low``.

    References
    ----------
    Johnson, Kemp and Kotz, Univariate Discrete Distributions, 3rd ed., section 6.10.1.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> die = bmc.DiscreteUniform(1, 6)
    >>> float(die.mean), die.support.size
    (3.5, 6)
    """

    is_discrete = True
    parameter_ndim = {"low": 0, "high": 0}

    def __init__(self, low: Any, high: Any) -> None:
        self.low, low_ok = as_whole(low)
        self.high, high_ok = as_whole(high)
        self._set_batch(self.low.shape, self.high.shape)
        if not low_ok.all():
            self._check("low", np.asarray(low), low_ok, 0, "a whole number")
        if not high_ok.all():
            self._check("high", np.asarray(high), high_ok, 0, "a whole number")
        ordered = self.low <= self.high
        if not ordered.all():
            if (high_ok & low_ok & ~ordered).any():
                shown = np.broadcast_to(self.high, self.batch_shape)
                self._check("high", shown, ordered | ~high_ok | ~low_ok, 0, "at least low")
            self.high = np.where(ordered, self.high, self.low)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        return np.asarray(rng.integers(self.low, self.high, shape, endpoint=True))

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        inside = (x >= self.low) & (x <= self.high) & (x == np.floor(x))
        return np.where(inside, -np.log(self._count()), -np.inf)

    @property
    def mean(self) -> np.ndarray:
        return self.low + 0.5 * (self._count() - 1)

    @property
    def var(self) -> np.ndarray:
        n = self._count()
        return (n * n - 1) / 12

    @property
    def support(self) -> Support:
        return integers(self.low, self.high)

    def cdf(self, x: Any) -> np.ndarray:
        return np.clip((np.floor(np.asarray(x, dtype=float)) - self.low + 1) / self._count(), 0, 1)

    def ppf(self, q: Any) -> np.ndarray:
        return whole_ppf(self.cdf, q, self.low, self.high)

    def _count(self) -> np.ndarray:
        return np.asarray(self.high, dtype=float) - self.low + 1


def whole_ppf(cdf: Callable[[np.ndarray], np.ndarray], q: Any, low: Any, high: Any) -> np.ndarray:
    """The smallest whole number from ``low`` to ``high`` whose ``cdf`` reaches ``q``, by bisection.

    ``cdf`` acts element by element. As in SciPy, ``q = 0`` gives ``low - 1``.
    """
    q = as_quantile(q)
    q, low, high = np.broadcast_arrays(q, np.asarray(low, float), np.asarray(high, float))
    below = low - 1.0  # its cdf is always short of q
    step = np.ones(q.shape)
    enough = np.where(np.isfinite(high), high, low)
    unbounded = ~np.isfinite(high) & (q > 0) & (q < 1)
    while (short := unbounded & (cdf(enough) < q)).any():
        below = np.where(short, enough, below)
        enough = np.where(short, enough + step, enough)
        step = step * 2
    while (wide := enough - below > 1).any():
        middle = np.floor(0.5 * (below + enough))
        reached = cdf(middle) >= q
        enough = np.where(wide & reached, middle, enough)
        below = np.where(wide & ~reached, middle, below)
    answer = np.where(q == 1, high, np.where(q > 0, enough, low - 1.0))
    return np.where(np.isnan(q), np.nan, answer)


def trials_of(dist: Distribution, given: Any, count: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Numbers of trials; those that are none are marked or raised, and count as 0 (``as_whole``)."""
    ok = whole & (count >= 0)
    if ok.all():
        return count
    dist._check("total_count", np.asarray(given), ok, 0, "a nonnegative whole number")
    return np.where(ok, count, 0)
