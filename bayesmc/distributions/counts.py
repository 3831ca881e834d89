"""Families of counts: Geometric, NegativeBinomial, and the vectors of Multinomial.

Log probabilities are minus infinity at anything that is not a whole number of the support. Where
counts are large, factorials would cancel; Loader's deviances keep the digits there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.base import Distribution, as_float, as_quantile, as_whole
from bayesmc.distributions.categorical import Categorical
from bayesmc.distributions.deviance import by_size, deviance, stirling_rest
from bayesmc.distributions.discrete import _Odds, trials_of, whole_ppf
from bayesmc.distributions.support import Support, integers
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.shapes import Shape

_COUNTS = integers(0)
_VECTORS = Support("counts")
_HUGE = np.finfo(float).max
_LARGEST = 2.0**62  # draws are int64; what lies further out stops here
_MANY = 1e4  # from here on log factorials lose digits that deviances keep
_RARE = 1e-6  # a last category rarer than this must not be left what rounding spares


class Geometric(_Odds):
    """Geometric distribution: failures before the first success, from 0.

    Give exactly one of ``probs`` and ``logits``.

    Parameters
    ----------
    probs : array_like
        Probability of success in each trial, above 0; with 1 the value is 0 for certain.
    logits : array_like
        Log odds of success, above minus infinity.

    Raises
    ------
    ParameterError
        ``probs`` not between 0 and 1 or 0 itself, or ``logits`` NaN or minus infinity.

    Notes
    -----
    SciPy's ``geom`` counts the success, too: its values are one larger. Draws are int64 and stop
    at 2**62.

    References
    ----------
    Johnson, Kemp and Kotz, Univariate Discrete Distributions, 3rd ed., section 5.2.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dist = bmc.Geometric(0.25)
    >>> float(dist.log_prob(0).round(4)), float(dist.mean), float(dist.cdf(1).round(4))
    (-1.3863, 3.0, 0.4375)
    """

    is_discrete = True
    parameter_ndim = {"probs": 0}

    def __init__(self, probs: Any = None, *, logits: Any = None) -> None:
        self._set_probs(probs, logits)
        if self.logits is None:
            need = "above 0, for with 0 no success ever comes"
            self.probs = self._check("probs", self.probs, self.probs > 0, 0.5, need)
        else:
            need = "above minus infinity, for there no success ever comes"
            self.logits = self._check("logits", self.logits, self.logits > -np.inf, 0.0, need)
            self.probs = special.expit(self.logits)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        # the whole part of an exponential number: P(E / rate >= k) = exp(-k rate) = (1 - p)^k
        draws = np.asarray(rng.standard_exponential(shape))
        with np.errstate(divide="ignore", over="ignore"):
            draws /= -self._log_zero()
        return np.minimum(draws, _LARGEST, out=draws).astype(np.int64)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        inside, k = _counts(x)
        value = _times(k, self._log_zero()) + self._log_one()
        return value if inside is None else np.where(inside, value, -np.inf)

    @property
    def mean(self) -> np.ndarray:
        return _odds_against(self)

    @property
    def var(self) -> np.ndarray:
        odds = _odds_against(self)
        with np.errstate(over="ignore"):
            return odds * (1 + odds)

    @property
    def support(self) -> Support:
        return _COUNTS

    def cdf(self, x: Any) -> np.ndarray:
        x = np.asarray(x, dtype=float)
        k = np.where(x >= 0, np.floor(x), 0.0)
        with np.errstate(divide="ignore"):
            value = -np.expm1((k + 1) * self._log_zero())
        return np.where(np.isnan(x), np.nan, np.where(x < 0, 0.0, value))

    def ppf(self, q: Any) -> np.ndarray:
        q = as_quantile(q)
        with np.errstate(divide="ignore", invalid="ignore"):
            k = np.ceil(np.log1p(-q) / self._log_zero() - 1)
        k = np.where((q > 0) & (q < 1), np.maximum(k, 0.0), 0.0)
        k = np.where((k > 0) & (self.cdf(k - 1) >= q), k - 1, k)  # the division was rounded
        k = np.where(self.cdf(k) < q, k + 1, k)
        at_ends = np.where(q == 0, -1.0, np.where(q == 1, np.inf, k))
        return np.where(np.isnan(q), np.nan, at_ends)


class NegativeBinomial(_Odds):
    """Negative binomial distribution: successes before the ``total_count``-th failure.

    Its mean is ``total_count * probs / (1 - probs)``. Give exactly one of ``probs`` and ``logits``.

    Parameters
    ----------
    total_count : array_like
        Number of failures, any positive number: a Poisson whose rate is
        ``Gamma(total_count, (1 - probs) / probs)``.
    probs : array_like
        Probability of success in each trial, below 1; with 0 the value is 0 for certain.
    logits : array_like
        Log odds of success, below infinity: the mean is ``total_count * exp(logits)``.

    Raises
    ------
    ParameterError
        ``total_count`` not positive and finite; ``probs`` not between 0 and 1 or 1 itself;
        ``logits`` NaN or infinity.

    Notes
    -----
    SciPy's ``nbinom(n, p)`` counts failures before the n-th success, so that its ``p`` is
    ``1 - probs``. Draws are int64 and stop at 2**62.

    References
    ----------
    Johnson, Kemp and Kotz, Univariate Discrete Distributions, 3rd ed., ch. 5. Large counts: Loader,
    Fast and accurate computation of binomial probabilities, 2000.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dist = bmc.NegativeBinomial(2.0, 0.75)
    >>> float(dist.log_prob(0).round(4)), float(dist.mean), float(dist.var)
    (-2.7726, 6.0, 24.0)
    """

    is_discrete = True
    parameter_ndim = {"total_count": 0, "probs": 0}

    def __init__(self, total_count: Any, probs: Any = None, *, logits: Any = None) -> None:
        total_count = as_float(total_count)
        self._set_probs(probs, logits, total_count.shape)
        self.total_count = self._positive("total_count", total_count)
        if self.logits is None:
            need = "below 1, for with 1 no failure ever comes"
            self.probs = self._check("probs", self.probs, self.probs < 1, 0.5, need)
        else:
            need = "below infinity, for there no failure ever comes"
            self.logits = self._check("logits", self.logits, self.logits < np.inf, 0.0, need)
            self.probs = special.expit(self.logits)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        rates = np.asarray(rng.standard_gamma(self.total_count, shape))
        with np.errstate(over="ignore"):
            rates *= np.minimum(_odds_for(self), _HUGE)  # finite, for a rate may be zero
        return np.asarray(rng.poisson(np.minimum(rates, _LARGEST, out=rates)))

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        inside, k = _counts(x)
        value = by_size(
            self.total_count + k > _MANY, self._from_factorials, self._from_deviances, k
        )
        return value if inside is None else np.where(inside, value, -np.inf)

    def _from_factorials(self, k: np.ndarray) -> np.ndarray:
        n = self.total_count
        ways = special.gammaln(n + k) - special.gammaln(k + 1) - special.gammaln(n)
        return ways + n * self._log_zero() + _times(k, self._log_one())

    def _from_deviances(self, k: np.ndarray) -> np.ndarray:
        """``n / (n + k)`` times the binomial probability of k among n + k."""
        n, one, zero = self.total_count, self._log_one(), self._log_zero()
        total = n + k
        log_total = np.log(total)
        value = np.log(n) - log_total + stirling_rest(total)
        value = value - stirling_rest(n) - stirling_rest(k)
        value = value - deviance(n, total * self._probs_zero(), log_total + zero)
        return value - deviance(k, total * self.probs, log_total + one)

    @property
    def mean(self) -> np.ndarray:
        with np.errstate(over="ignore"):
            return self.total_count * _odds_for(self)

    @property
    def var(self) -> np.ndarray:
        with np.errstate(over="ignore"):
            return self.total_count * _odds_for(self) * (1 + _odds_for(self))

    @property
    def support(self) -> Support:
        return _COUNTS

    def cdf(self, x: Any) -> np.ndarray:
        x = np.asarray(x, dtype=float)
        k = np.where((x >= 0) & (x < np.inf), np.floor(x), 0.0)
        # P(X <= k) = 1 - I_p(k + 1, n) = I_{1-p}(n, k + 1); the smaller of p and 1 - p is exact
        value = np.where(
            self.probs > 0.5,
            special.betainc(self.total_count, k + 1, self._probs_zero()),
            special.betaincc(k + 1, self.total_count, self.probs),
        )
        value = np.where(x < 0, 0.0, np.where(x == np.inf, 1.0, value))
        return np.where(np.isnan(x), np.nan, value)

    def ppf(self, q: Any) -> np.ndarray:
        return whole_ppf(self.cdf, q, np.zeros(self.batch_shape), np.inf)

    def _probs_zero(self) -> np.ndarray:
        return 1 - self.probs if self.logits is None else special.expit(-self.logits)


class Multinomial(Distribution):
    """Multinomial distribution: how often each of K categories came in ``total_count`` trials.

    Give exactly one of ``probs`` and ``logits``.

    Parameters
    ----------
    total_count : array_like of int
        Number of trials, nonnegative.
    probs : array_like, shape (..., K)
        Probabilities; a row off one by at most 1e-6 is renormalised.
    logits : array_like, shape (..., K)
        Unnormalised log probabilities; minus infinity is probability zero.

    Raises
    ------
    ParameterError
        ``total_count`` not a nonnegative whole number; a row of ``probs`` has a negative or NaN
        entry or does not sum to one.
    ShapeError
        ``probs`` or ``logits`` has no last axis of categories.

    Notes
    -----
    ``log_prob`` is minus infinity where counts are negative, not whole, or do not sum to
    ``total_count``.

    References
    ----------
    Murphy, Probabilistic Machine Learning: Advanced Topics, 2023, section 2.2.1.4. Large counts:
    Loader, Fast and accurate computation of binomial probabilities, 2000.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dist = bmc.Multinomial(3, [0.5, 0.25, 0.25])
    >>> float(dist.log_prob([2, 1, 0]).round(4)), dist.mean.tolist()
    (-1.674, [1.5, 0.75, 0.75])
    """

    is_discrete = True
    parameter_ndim = {"total_count": 0, "probs": 1}

    def __init__(self, total_count: Any, probs: Any = None, *, logits: Any = None) -> None:
        count, whole = as_whole(total_count)
        if (probs is None) == (logits is None):
            raise ParameterError("Multinomial: give exactly one of probs and logits")
        shape = np.shape(probs if logits is None else logits)
        if not shape or not shape[-1]:
            raise ShapeError(
                f"Multinomial: {'probs' if logits is None else 'logits'} must have shape (..., K) "
                f"with K at least 1; got {shape}"
            )
        self._choice = _Choice(probs, logits=logits)
        self.probs = self._choice.probs
        self.event_shape = self.probs.shape[-1:]
        self._set_batch(count.shape, self._choice.batch_shape)
        self._adopt(self._choice)
        self.total_count = trials_of(self, total_count, count, whole)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        probs = self.probs
        if not (probs[..., -1] < _RARE).any():
            return np.asarray(rng.multinomial(self.total_count, probs, shape))
        # The sampler leaves the last category what the others did not take, be it by rounding:
        # the likeliest one stands there instead.
        likeliest = probs.argmax(axis=-1)[..., None]
        order = np.broadcast_to(np.arange(probs.shape[-1]), probs.shape).copy()
        np.put_along_axis(order, likeliest, probs.shape[-1] - 1, axis=-1)
        order[..., -1:] = likeliest  # swaps two, so that it undoes itself
        swapped = np.take_along_axis(probs, order, axis=-1)
        draws = np.asarray(rng.multinomial(self.total_count, swapped, shape))
        return np.take_along_axis(draws, np.broadcast_to(order, draws.shape), axis=-1)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        if x.shape[-1:] != self.event_shape:
            size = self.event_shape[0]
            raise ShapeError(f"Multinomial: x has shape {x.shape}, not (..., {size})")
        inside, k = _counts(x)
        fits = x.sum(axis=-1) == self.total_count
        fits = fits if inside is None else fits & inside.all(axis=-1)
        k = np.where(fits[..., None], k, 0.0)
        value = by_size(self.total_count > _MANY, self._from_factorials, self._from_deviances, k)
        return np.where(fits, value, -np.inf)

    def _from_factorials(self, k: np.ndarray) -> np.ndarray:
        ways = special.gammaln(self.total_count + 1.0) - special.gammaln(k + 1).sum(axis=-1)
        return ways + _times(k, self._log_probs()).sum(axis=-1)

    def _from_deviances(self, k: np.ndarray) -> np.ndarray:
        n = np.maximum(self.total_count, 1.0)[..., None]
        deviances = deviance(k, n * self.probs, np.log(n) + self._log_probs())
        return stirling_rest(n[..., 0]) - (stirling_rest(k) + deviances).sum(axis=-1)

    @property
    def mean(self) -> np.ndarray:
        return self.total_count[..., None] * self.probs

    @property
    def var(self) -> np.ndarray:
        return self.mean * (1 - self.probs)

    @property
    def cov(self) -> np.ndarray:
        """Covariance of the counts, shape ``batch_shape + (K, K)``; each row sums to zero."""
        across = -self.mean[..., :, None] * self.probs[..., None, :]
        return np.where(np.eye(self.probs.shape[-1], dtype=bool), self.var[..., None], across)

    @property
    def support(self) -> Support:
        return _VECTORS

    def _log_probs(self) -> np.ndarray:
        """Log probabilities of the categories, ``(..., K)``; logits keep their tails."""
        size, batch = self.probs.shape[-1], self.probs.ndim - 1
        return np.moveaxis(
            self._choice.log_prob(np.arange(size).reshape((-1,) + (1,) * batch)), 0, -1
        )


class _Choice(Categorical):
    """The category of one trial, whose faults are the multinomial's."""

    _family = "Multinomial"


def _odds_for(dist: _Odds) -> np.ndarray:
    with np.errstate(over="ignore"):
        return dist.probs / (1 - dist.probs) if dist.logits is None else np.exp(dist.logits)


def _odds_against(dist: _Odds) -> np.ndarray:
    with np.errstate(over="ignore"):
        return (1 - dist.probs) / dist.probs if dist.logits is None else np.exp(-dist.logits)


def _counts(x: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
    """Where values are counts (None: everywhere), and these as floats, 0 elsewhere."""
    if x.dtype.kind in "iub":
        inside = np.asarray(x >= 0)
    else:
        inside = np.asarray((x >= 0) & (x == np.floor(x)) & (x < np.inf))
    if inside.all():
        return None, np.asarray(x, dtype=float)
    return inside, np.where(inside, x, 0.0)


def _times(count: np.ndarray, log_prob: np.ndarray) -> np.ndarray:
    """``count * log_prob``, where nothing times anything is nothing."""
    value = count * log_prob
    return value if np.isfinite(log_prob).all() else np.where(count > 0, value, 0.0)
