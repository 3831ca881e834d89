"""Numbers in order, and ordered categories between cutpoints."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.adapt import as_distribution
from bayesmc.distributions.base import Distribution, as_float
from bayesmc.distributions.parameters import as_size
from bayesmc.distributions.support import Support, increasing, integers
from bayesmc.distributions.tails import tails_of
from bayesmc.errors import ParameterError, ShapeError, UnsupportedError
from bayesmc.shapes import Shape


class Ordered(Distribution):
    """Independent draws of one distribution, sorted: a vector whose components increase.

    A prior of cutpoints, of the means of a mixture's components, of change points. Its density is
    ``size!`` times the product of the base's densities where the components increase, else zero.

    Parameters
    ----------
    base : Distribution or frozen scipy.stats distribution
        Continuous, of one number.
    size : int
        How many draws, at least 1.

    Raises
    ------
    ParameterError
        ``base`` is no distribution, or ``size`` no positive whole number.
    UnsupportedError
        The base is discrete, has vectors as values, lies on a circle, or has bounds that differ within its
        batch.

    References
    ----------
    David and Nagaraja, Order Statistics, 3rd ed., 2003, section 2.2.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> cutpoints = bmc.Ordered(bmc.Normal(0.0, 1.5), 3)
    >>> cutpoints.sample(rng=1).round(2).tolist()
    [0.5, 0.52, 1.23]
    >>> [float(v) for v in cutpoints.log_prob([[-1.0, 0.0, 2.0], [0.0, -1.0, 2.0]]).round(3)]
    [-3.293, -inf]
    """

    def __init__(self, base: Any, size: int) -> None:
        self.base = _usable(base)
        self.size = as_size("Ordered", size)
        self._set_batch(self.base.batch_shape)
        self._adopt(self.base)
        self.event_shape = (self.size,)

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        return [*self.base.parameters(), (np.asarray(self.size), 0)]

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = self.base.sample_to(rng, (self.size, *shape))
        return np.sort(np.moveaxis(draws, 0, -1), axis=-1)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        if x.shape[-1:] != self.event_shape:
            raise ShapeError(f"Ordered: x has shape {x.shape}, not (..., {self.size})")
        lead = (1,) * (len(self.batch_shape) - x.ndim + 1)  # the base's batch stands in front
        each = np.asarray(self.base.log_prob(np.moveaxis(x.reshape(*lead, *x.shape), -1, 0)))
        found = special.gammaln(self.size + 1.0) + each.sum(axis=0)
        return np.where((x[..., 1:] < x[..., :-1]).any(axis=-1), -np.inf, found)

    @property
    def mean(self) -> np.ndarray:
        """Mean of each component, by quadrature (1e-8)."""
        return self._moments[0]

    @property
    def var(self) -> np.ndarray:
        """Variance of each component, as the mean is."""
        return self._moments[1]

    @cached_property
    def _moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the base's quantiles, weighted as the order statistics of uniform numbers are.

        The trapezoidal rule in standard normal scores: all tails fall off there.
        """
        if not np.isfinite(self.base.var).all():
            raise UnsupportedError(
                "Ordered: the base has no finite variance, and the outer components need not have moments"
            )
        tails, (z, step) = tails_of(self.base), np.linspace(-36.0, 36.0, 2881, retstep=True)
        z = z.reshape(-1, *(1,) * len(self.batch_shape))
        with np.errstate(all="ignore"):
            low, high = special.log_ndtr(z), special.log_ndtr(-z)
            at = np.where(z < 0, tails.lower(low), tails.upper(high))[..., None]
        k = np.arange(1, self.size + 1)
        logs = (k - 1) * low[..., None] + (self.size - k) * high[..., None]
        logs = logs - special.betaln(k, self.size - k + 1) - 0.5 * np.square(z)[..., None]
        weights = np.exp(logs) * (step / np.sqrt(2 * np.pi))
        lost = np.where(np.isfinite(at), 0.0, weights).sum(axis=0)
        if (lost > 1e-12).any():  # quantiles of other families end where their cdf is 1 to rounding
            raise UnsupportedError(
                f"Ordered: no quantiles of {type(self.base).__name__} are known far out; average draws"
            )
        at = np.where(np.isfinite(at), at, 0.0)
        mean = (weights * at).sum(axis=0)
        return mean, (weights * np.square(at - mean)).sum(axis=0)

    @property
    def support(self) -> Support:
        inner = self.base.support
        return increasing(inner.low, inner.high)


class OrderedLogistic(Distribution):
    """Ordered categories 0..K, by where a logistic variable with mean ``loc`` falls among K cutpoints.

    ``P(x <= k) = 1 / (1 + exp(loc - cutpoints[k]))``: the proportional-odds model.

    Parameters
    ----------
    loc : array_like
        The linear predictor: the larger, the higher the category.
    cutpoints : array_like, shape (..., K)
        In increasing order, on the same scale.

    Raises
    ------
    ParameterError
        ``loc`` is not finite, or cutpoints are not finite or not in order.
    ShapeError
        ``cutpoints`` is a number, or empty.

    References
    ----------
    McCullagh (1980), Regression models for ordinal data, J. Royal Statistical Society B 42, eq. 2.1.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> answer = bmc.OrderedLogistic([0.0, 2.0], [-1.0, 1.0])
    >>> answer.probs.round(3).tolist()
    [[0.269, 0.462, 0.269], [0.047, 0.222, 0.731]]
    """

    is_discrete = True
    parameter_ndim = {"loc": 0, "cutpoints": 1}

    def __init__(self, loc: Any, cutpoints: Any) -> None:
        loc, cutpoints = as_float(loc), as_float(cutpoints)
        if cutpoints.ndim < 1 or cutpoints.shape[-1] < 1:
            raise ShapeError(
                f"OrderedLogistic: cutpoints must have shape (..., K); got {cutpoints.shape}"
            )
        self._set_batch(loc.shape, cutpoints.shape[:-1])
        self.loc = self._finite("loc", loc)
        with np.errstate(invalid="ignore"):
            rising = (cutpoints[..., 1:] >= cutpoints[..., :-1]).all(axis=-1)
        ok = np.isfinite(cutpoints).all(axis=-1) & rising
        safe = np.arange(cutpoints.shape[-1], dtype=float)
        self.cutpoints = self._check("cutpoints", cutpoints, ok, safe, "finite and in order")

    @staticmethod
    def log_density(x: Any, loc: Any, cutpoints: Any) -> Any:
        """Of the interval alone in which the value lies: two logistic functions, however many categories."""
        if isinstance(cutpoints, (list, tuple)):
            cutpoints = np.asarray(cutpoints)
        size = cutpoints.shape[-1]
        inside = (x >= 0) & (x <= size)
        at = np.where(inside, x, 0).astype(int)
        ends = np.zeros((*cutpoints.shape[:-1], 1))
        padded = np.concatenate([ends - np.inf, cutpoints, ends + np.inf], axis=-1)
        shape = np.broadcast_shapes(at.shape, padded.shape[:-1])
        wide = np.broadcast_to(padded, (*shape, size + 2))
        rows = np.broadcast_to(at, shape)[..., None]
        low = np.take_along_axis(wide, rows, axis=-1)[..., 0] - loc
        high = np.take_along_axis(wide, rows + 1, axis=-1)[..., 0] - loc
        # of the difference of two logistic functions, without cancellation in either tail
        logs = special.log_expit(high) + special.log_expit(-low) + np.log1p(-np.exp(low - high))
        return np.where(inside & (np.floor(x) == x), logs, -np.inf)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        latent = self.loc + rng.logistic(size=shape)
        return (latent[..., None] > self.cutpoints).sum(axis=-1)

    @property
    def probs(self) -> np.ndarray:
        """Probabilities of the categories, shape ``(*batch, K + 1)``."""
        return np.asarray(self.probs_table)

    @property
    def mean(self) -> np.ndarray:
        return self.probs @ np.arange(self.cutpoints.shape[-1] + 1.0)

    @property
    def var(self) -> np.ndarray:
        values = np.arange(self.cutpoints.shape[-1] + 1.0)
        return (self.probs * np.square(values - self.mean[..., None])).sum(axis=-1)

    @property
    def support(self) -> Support:
        return integers(0, self.cutpoints.shape[-1])

    def cdf(self, x: Any) -> np.ndarray:
        x = np.asarray(x, dtype=float)
        size = self.cutpoints.shape[-1]
        at = np.clip(np.floor(np.nan_to_num(x, nan=-1.0)), -1, size).astype(int)
        below = special.expit(self.cutpoints - self.loc[..., None])
        shape = np.broadcast_shapes(at.shape, self.batch_shape)
        wide = np.broadcast_to(below, (*shape, size))
        rows = np.broadcast_to(np.clip(at, 0, size - 1), shape)[..., None]
        found = np.take_along_axis(wide, rows, axis=-1)[..., 0]
        found = np.where(at < 0, 0.0, np.where(at >= size, 1.0, found))
        return np.where(np.isnan(x), np.nan, found)

    def ppf(self, q: Any) -> np.ndarray:
        q = np.asarray(q, dtype=float)
        below = special.expit(self.cutpoints - self.loc[..., None])
        found = (q[..., None] > below).sum(axis=-1).astype(float)
        return np.where((q >= 0) & (q <= 1), found, np.nan)


def _usable(base: Any) -> Distribution:
    dist = as_distribution(base)
    if dist is None:
        raise ParameterError(f"Ordered: base must be a distribution; got {type(base).__name__}")
    family, support = type(dist).__name__, dist.support
    if dist.is_discrete:
        raise UnsupportedError(f"Ordered: {family} is discrete, and its draws may be equal")
    if dist.event_shape:
        raise UnsupportedError(f"Ordered: {family} has vectors as values, which have no order")
    if support.kind not in ("real", "interval"):
        raise UnsupportedError(f"Ordered: {support.describe()} of {family} have no order")
    if not support.is_single:
        raise moving_order()
    return dist


def moving_order() -> UnsupportedError:
    """Why numbers in order have no bounds of their own for each element of a batch."""
    return UnsupportedError(
        "Ordered: the bounds of its base differ within a batch or depend on parents; sort numbers "
        "between 0 and 1, Ordered(Uniform(0, 1), size), and stretch them in a function"
    )
