"""Truncation: a distribution of one number, conditioned on lying between two bounds.

Everything is worked out on the scale of the tail in which the interval lies, in logarithms, so that
an interval far out costs no digits. What the two tails of a family are stands in ``tails``.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.adapt import as_distribution
from bayesmc.distributions.base import Distribution, as_float, as_quantile
from bayesmc.distributions.discrete import whole_ppf
from bayesmc.distributions.inverse_cdf import InverseCdf
from bayesmc.distributions.normal import Normal
from bayesmc.distributions.support import Support, integers, interval
from bayesmc.distributions.tails import Tails, tails_of
from bayesmc.errors import ParameterError, UnsupportedError
from bayesmc.shapes import Shape, broadcast_shapes, first_index

_LOG_HALF = float(np.log(0.5))
_HALF_LOG_2PI = 0.5 * np.log(2 * np.pi)
#: refused is a mass that rounding could change by more than this fraction
_TOLERANCE = 1e-6
_FEW = 128  # integers whose probabilities are added up rather than taken from the cdf
_MANY = 1 << 20  # integers that a moment may be summed over, all batch elements together


class Truncated(Distribution):
    """``base`` conditioned on ``low <= x <= high``.

    The density is that of the base over the mass in between. Where the interval lies in a tail, the
    mass comes from that tail's logarithm: to all digits for Normal (any distance, any width), and
    for the families of this package and of SciPy with a survival function of their own. Any other
    base has ``1 - cdf`` on the right, with an error of 1e-16 in the mass: an interval whose mass
    this leaves uncertain by more than a millionth is refused.

    Parameters
    ----------
    base : Distribution or frozen scipy.stats distribution
        Of one number, with cdf and ppf, continuous or integer-valued.
    low, high : array_like
        Bounds, both included, possibly infinite; they broadcast with the batch of ``base``. Between
        bounds of integers at least one integer must lie; otherwise ``low < high``.

    Raises
    ------
    ParameterError
        ``high`` is not above ``low``, a bound is NaN, or there is no mass between them.
    UnsupportedError
        ``base`` has vectors as values, lies on a circle, or has no cdf or ppf.

    References
    ----------
    Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions I, section 13.10.1.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> tail = bmc.Truncated(bmc.Normal(0.0, 1.0), 8.0)
    >>> float(tail.mean.round(6)), float(tail.log_prob(8.0).round(6)), float(tail.log_prob(7.9))
    (8.121368, 2.094499, -inf)
    """

    base: Distribution
    low: np.ndarray
    high: np.ndarray

    def __init__(self, base: Any, low: Any = -np.inf, high: Any = np.inf) -> None:
        self.base = _usable(base)
        low, high = as_float(low), as_float(high)
        if isinstance(self.base, Truncated):
            low, high = np.maximum(low, self.base.low), np.minimum(high, self.base.high)
            self.base = self.base.base
        self.is_discrete = self.base.is_discrete  # type: ignore[misc]
        self._given = (low, high)  # as messages show them
        if self.is_discrete:
            low, high = np.ceil(low), np.floor(high)
        self._set_batch(self.base.batch_shape, low.shape, high.shape)
        self._adopt(self.base)
        self.low, self.high = self._bounds(low, high)
        support = self.base.support
        self._least = np.maximum(self.low, np.asarray(support.low, dtype=float))
        self._greatest = np.minimum(self.high, np.asarray(support.high, dtype=float))
        self._base_tails = tails_of(self.base)
        with np.errstate(all="ignore"):
            self._weigh()

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        return [*self.base.parameters(), (self.low, 0), (self.high, 0)]

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        u = rng.random(shape) + 2.0**-54  # never zero, and one only by rounding
        draws = self._quantile(u)
        return draws.astype(np.int64) if self.is_discrete else draws

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        outside = (x < self.low) | (x > self.high)
        return np.where(outside, -np.inf, self.base.log_prob(x) - self._log_mass)

    @property
    def log_mass(self) -> np.ndarray:
        """Log of the probability that the base gives the interval, in full batch shape."""
        return np.broadcast_to(self._log_mass, self.batch_shape)

    @property
    def mean(self) -> np.ndarray:
        """Mean: to rounding for Normal, by sums for integers, otherwise by quadrature (1e-8)."""
        return np.broadcast_to(self._moments[0], self.batch_shape)

    @property
    def var(self) -> np.ndarray:
        """Variance, as the mean is."""
        return np.broadcast_to(self._moments[1], self.batch_shape)

    @property
    def support(self) -> Support:
        support = self.base.support
        if self.is_discrete:
            return integers(self._least, self._greatest)
        if np.all(np.isneginf(self._least)) and np.all(np.isposinf(self._greatest)):
            return support
        return interval(
            self._least,
            self._greatest,
            support.open_low and bool(np.all(self._least > self.low)),
            support.open_high and bool(np.all(self._greatest < self.high)),
        )

    def cdf(self, x: Any) -> np.ndarray:
        x = np.asarray(x, dtype=float)
        x = np.floor(x) if self.is_discrete else x
        with np.errstate(all="ignore"):
            at = np.clip(x, self._least, self._greatest)
            left = _log_difference(self._base_tails.log_cdf(at), self._start)
            right = _log_difference(self._start, self._base_tails.log_sf(at))
            value = np.minimum(np.exp(np.where(self._upper, right, left) - self._log_mass), 1.0)
        value = np.where(x < self._least, 0.0, np.where(x >= self._greatest, 1.0, value))
        return np.where(np.isnan(x), np.nan, value)

    def ppf(self, q: Any) -> np.ndarray:
        q = as_quantile(q)
        if self.is_discrete:
            return np.where(q == 0, self._least - 1, self._quantile(q))
        return np.where(q == 0, self._least, np.where(q == 1, self._greatest, self._quantile(q)))

    def _tails(self) -> Tails:
        return Tails(self)

    # ---- bounds and mass --------------------------------------------------------------------

    def _bounds(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        low = self._check("low", low, ~np.isnan(low), -np.inf, "a number")
        high = self._check("high", high, ~np.isnan(high), np.inf, "a number")
        ok = low <= high if self.is_discrete else low < high
        if ok.all():
            return low, high
        pair = self._pair(broadcast_shapes(low.shape, high.shape))
        what = "an interval with an integer in it" if self.is_discrete else "low < high"
        self._reject("(low, high)", pair[first_index(~ok)], ~ok, what)
        return np.where(ok, low, -np.inf), np.where(ok, high, np.inf)

    def _weigh(self) -> None:
        """Find the side to work on, the log of its tail at the start, and the log mass."""
        self._measure()
        least, greatest = self._least, self._greatest
        outside = least > greatest if self.is_discrete else ~(least < greatest)
        bad = outside | ~(self._log_mass > self._doubtful)
        if not bad.any():
            return
        support = self.base.support.describe()
        doubtful = "an interval whose probability under the base can be told from rounding"
        missed = f"an interval where {type(self.base).__name__} has mass ({support})"
        for fault, what in ((outside, missed), (bad & ~outside, doubtful)):
            if fault.any():
                fault = np.broadcast_to(fault, bad.shape)
                self._reject("(low, high)", self._pair(bad.shape)[first_index(fault)], fault, what)
        self._least = np.where(bad, np.asarray(self.base.support.low, float), self._least)
        self._greatest = np.where(bad, np.asarray(self.base.support.high, float), self._greatest)
        self._measure()

    def _pair(self, shape: Shape) -> np.ndarray:
        """The bounds as they were given, side by side."""
        return np.stack([np.broadcast_to(bound, shape) for bound in self._given], axis=-1)

    def _measure(self) -> None:
        tails, before = self._base_tails, self._least - self.is_discrete
        lower = tails.log_cdf(before)
        # an interval that starts right of the median is measured from the right
        self._upper = lower > _LOG_HALF
        from_left = tails.log_cdf(self._greatest), lower
        from_right = tails.log_sf(before), tails.log_sf(self._greatest)
        more = np.where(self._upper, from_right[0], from_left[0])
        less = np.where(self._upper, from_right[1], from_left[1])
        #: log tail at the interval's lower end, on the side that is used
        self._start = np.where(self._upper, from_right[0], lower)
        self._log_mass = _log_difference(more, less)
        rounding = np.where(self._upper, tails.upper_resolution, tails.lower_resolution)
        error = np.maximum(rounding, 2.0**-53 * np.exp(more)) / _TOLERANCE
        self._doubtful = np.log(error)
        self._refine(less - more)

    def _refine(self, log_ratio: np.ndarray) -> None:
        """Where differences of tails cancel, measure the interval by itself."""
        if isinstance(self.base, Normal):
            narrow = log_ratio > _LOG_HALF
            if narrow.any():
                log_mass = self._standard()[0]
                self._log_mass = np.where(narrow, log_mass, self._log_mass)
            self._doubtful = np.full(narrow.shape, -np.inf)
        elif self.is_discrete:
            few = self._greatest - self._least < _FEW
            few = few & ((log_ratio > _LOG_HALF) | ~(self._log_mass > self._doubtful))
            if few.any():
                steps = np.arange(float(_FEW)).reshape((-1,) + (1,) * len(self.batch_shape))
                k = np.where(few, self._least, 0.0) + steps
                terms = np.where(k <= self._greatest, self.base.log_prob(k), -np.inf)
                self._log_mass = np.where(few, special.logsumexp(terms, axis=0), self._log_mass)
                self._doubtful = np.where(few, -np.inf, self._doubtful)

    # ---- quantiles --------------------------------------------------------------------------

    def _quantile(self, u: np.ndarray) -> np.ndarray:
        if self.is_discrete:
            low = self._least
            if not np.isfinite(low).all():
                low = np.where(np.isfinite(low), low, self.base.ppf(1e-18) - 1)
            return whole_ppf(self.cdf, u, low, self._greatest)
        with np.errstate(all="ignore"):
            return self._place(np.log(u), np.log1p(-u))

    def _place(self, log_u: np.ndarray, log_rest: np.ndarray) -> np.ndarray:
        """The quantile at ``u``, given ``log(u)`` and ``log(1 - u)`` (so that none is rounded)."""
        tails, mass = self._base_tails, self._log_mass
        end = _log_difference(self._start, mass)  # the upper tail at the interval's upper end
        upper = self._upper
        from_left = np.logaddexp(self._start, log_u + mass)
        from_right = np.logaddexp(np.where(upper, end, -np.inf), log_rest + mass)
        if upper.all():
            x = tails.upper(np.minimum(from_right, 0.0))
        elif not upper.any():
            x = self._from_left(np.minimum(from_left, 0.0), log_rest)
        else:
            left = self._from_left(np.minimum(np.where(upper, _LOG_HALF, from_left), 0.0), log_rest)
            right = tails.upper(np.where(upper, from_right, _LOG_HALF))
            x = np.where(upper, right, left)
        return np.clip(x, self._least, self._greatest)

    def _from_left(self, log_q: np.ndarray, log_rest: np.ndarray) -> np.ndarray:
        """Quantile of the base at ``log_q``, from the right where that lies far in its right half."""
        tails = self._base_tails
        beyond = tails.log_sf(self._greatest)
        log_sf = np.logaddexp(beyond, log_rest + self._log_mass)
        far = log_sf < np.log(0.25)
        if not far.any():
            return tails.lower(log_q)
        near = tails.lower(np.where(far, _LOG_HALF, log_q))
        return np.where(far, tails.upper(np.where(far, log_sf, _LOG_HALF)), near)

    # ---- moments ----------------------------------------------------------------------------

    @cached_property
    def _moments(self) -> tuple[np.ndarray, np.ndarray]:
        with np.errstate(all="ignore"):
            if isinstance(self.base, Normal):
                _, mean, var = self._standard()
                return self.base.loc + self.base.scale * mean, self.base.scale**2 * var
            return self._sums() if self.is_discrete else self._integrals()

    def _standard(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Log mass, mean and variance of the standard normal between the standardised bounds."""
        loc, scale = self.base.loc, self.base.scale  # type: ignore[attr-defined]
        return _standard_normal((self._least - loc) / scale, (self._greatest - loc) / scale)

    def _sums(self) -> tuple[np.ndarray, np.ndarray]:
        low = np.broadcast_to(self._quantile(np.full(self.batch_shape, 1e-17)), self.batch_shape)
        high = self._quantile(np.full(self.batch_shape, 1 - 2.0**-53))
        count = float(np.max(high - low, initial=0.0)) + 1
        if not count * max(1, low.size) <= _MANY:
            raise UnsupportedError(
                f"Truncated: a moment would be a sum over {count:g} integers; average draws instead"
            )
        k = low + np.arange(count).reshape((-1,) + (1,) * low.ndim)
        probs = np.where(k <= high, np.exp(self.log_prob(k)), 0.0)
        probs /= probs.sum(axis=0)
        mean = (probs * k).sum(axis=0)
        return mean, (probs * (k - mean) ** 2).sum(axis=0)

    def _integrals(self) -> tuple[np.ndarray, np.ndarray]:
        """Over the interval where the density is smooth there, else over quantiles, else adaptive."""
        found = self._over_interval()
        if found is not None:
            return found
        mean, var = self._over_quantiles(1)
        coarse_mean, coarse_var = self._over_quantiles(2)
        # the rule's digits double with the nodes: agreement to five means ten
        near = np.abs(mean - coarse_mean) <= 1e-5 * np.sqrt(var)
        near &= np.abs(var - coarse_var) <= 1e-5 * var
        if (near | ~np.isfinite(mean) | ~np.isfinite(var)).all():
            return mean, var
        adaptive = InverseCdf(self)  # modes apart: the quantile rises in steps
        return adaptive.mean, adaptive.var

    def _over_interval(self) -> tuple[np.ndarray, np.ndarray] | None:
        """The double exponential rule on bounded intervals, if the total mass comes out as one."""
        if not (np.isfinite(self._least) & np.isfinite(self._greatest)).all():
            return None
        lead = (-1,) + (1,) * len(self.batch_shape)
        log_u, log_rest, weights = (v.reshape(lead) for v in _DOUBLE_EXPONENTIAL)
        width = self._greatest - self._least
        # measured from the nearer end, where the density may have a power law
        part = width * np.exp(np.minimum(log_u, log_rest))
        x = np.where(log_u < log_rest, self._least + part, self._greatest - part)
        terms = np.exp(self.log_prob(x)) * weights * width
        terms = np.where(
            np.isfinite(terms), terms, 0.0
        )  # at a bound; the total tells what was lost
        totals, means, variances = [], [], []
        for every in (1, 2):
            at, mass = x[::every], every * terms[::every]
            total = mass.sum(axis=0)
            middle = (mass * at).sum(axis=0) / total
            totals.append(total)
            means.append(middle)
            variances.append((mass * (at - middle) ** 2).sum(axis=0) / total)
        good = (np.abs(totals[0] - 1) <= 1e-9) & (np.abs(totals[1] - 1) <= 1e-5)
        good &= np.abs(means[0] - means[1]) <= 1e-5 * np.sqrt(variances[0])
        good &= np.abs(variances[0] - variances[1]) <= 1e-5 * variances[0]
        return (means[0], variances[0]) if good.all() else None

    def _over_quantiles(self, every: int) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance by the double exponential rule, with each or with every other node."""
        log_u, log_rest, weights = (v[::every] for v in _DOUBLE_EXPONENTIAL)
        lead = (-1,) + (1,) * len(self.batch_shape)
        x = self._place(log_u.reshape(lead), log_rest.reshape(lead))
        weights = every * weights.reshape(lead)
        # where a quantile is rounded to infinity, its weight must be beyond rounding, too
        lost = ~np.isfinite(x)
        x = np.where(lost, 0.0, x)
        mean = _converged(weights * x, lost)
        squares = weights * (x - np.where(np.isfinite(mean), mean, 0.0)) ** 2
        return mean, np.where(np.isfinite(mean), _converged(squares, lost), np.nan)


def _usable(base: Any) -> Distribution:
    dist = as_distribution(base)
    if dist is None:
        raise ParameterError(f"Truncated: base must be a distribution; got {type(base).__name__}")
    family = type(dist).__name__
    if dist.event_shape:
        raise UnsupportedError(
            f"Truncated: {family} has values of shape {dist.event_shape}; only distributions of one "
            "number are truncated"
        )
    if dist.support.kind == "circle":
        raise UnsupportedError(
            f"Truncated: {family} lies on a circle, where an interval has no first end; write "
            "Truncated(InverseCdf(base, -np.pi, np.pi), low, high)"
        )
    try:
        dist.cdf(0.0)
        if not dist.is_discrete:
            dist.ppf(0.5)
    except UnsupportedError:
        raise UnsupportedError(
            f"Truncated: {family} has no cdf and ppf to truncate by; give it both with "
            "Truncated(InverseCdf(density), low, high)"
        ) from None
    return dist


def _log_difference(more: np.ndarray, less: np.ndarray) -> np.ndarray:
    """``log(exp(more) - exp(less))``; minus infinity where that is not positive."""
    value = more + np.log(-np.expm1(less - more))
    return np.where(more > less, value, -np.inf)


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)


def _standard_normal(low: np.ndarray, high: np.ndarray) -> tuple[Any, Any, Any]:
    """Log mass, mean and variance of the standard normal on ``[low, high]``.

    Gauss-Legendre on the part that carries the mass, measured from the end nearest the mode: all
    terms are positive, so nothing cancels, however far out or narrow the interval. What lies more
    than 40 nats below the density at that end is left out.
    """
    flip = low + high < 0  # then its upper end is the farther from the lower tail
    a, b = np.where(flip, -high, low), np.where(flip, -low, high)  # now |b| >= |a|
    start = np.maximum(a, -9.0)
    top = np.maximum(start, 0.0)  # the mode on the interval
    stop = np.minimum(b, np.sqrt(top * top + 80.0))
    # top + t with t small keeps digits that the difference of squares would lose
    reach = np.where(top > 0, 80.0 / (top + np.sqrt(top * top + 80.0)), stop - start)
    width = np.minimum(np.where(top > 0, reach, stop - start), b - start)
    lead = (-1,) + (1,) * np.ndim(width)
    t = (0.5 + 0.5 * _NODES).reshape(lead) * width
    density = np.exp(-t * (start + 0.5 * t)) * _WEIGHTS.reshape(lead)
    total = density.sum(axis=0)
    mean = (density * t).sum(axis=0) / total
    var = (density * (t - mean) ** 2).sum(axis=0) / total
    log_mass = np.log(0.5 * width * total) - 0.5 * start * start - _HALF_LOG_2PI
    return log_mass, np.where(flip, -(start + mean), start + mean), var


def _double_exponential() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log nodes of (0, 1), logs of one minus them, and weights (Takahasi and Mori, 1974)."""
    step = 1 / 16
    t = np.arange(-96, 97) * step
    at = np.pi * np.sinh(t)
    log_u, log_rest = special.log_expit(at), special.log_expit(-at)
    return log_u, log_rest, step * np.pi * np.cosh(t) * np.exp(log_u + log_rest)


_DOUBLE_EXPONENTIAL = _double_exponential()


def _converged(terms: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """The sum of the terms where they die out; infinite where they do not."""
    total, size = terms.sum(axis=0), np.abs(terms).sum(axis=0)
    # the outermost terms that could be had, at either end
    first = np.argmax(~lost, axis=0)[None]
    last = len(lost) - 1 - np.argmax(~lost[::-1], axis=0)[None]
    left, right = (
        np.abs(np.take_along_axis(terms, at, axis=0)[0]) > 1e-9 * size for at in (first, last)
    )
    total = np.where(left & right, np.nan, np.where(left, -np.inf, total))
    return np.where(right & ~left, np.inf, total)
