"""Parzen windows: the average of Gaussian kernels about given points, as a distribution."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.base import Distribution, as_float, as_quantile
from bayesmc.distributions.categorical import Categorical
from bayesmc.distributions.mixture import invert
from bayesmc.distributions.support import Support, real, real_vector
from bayesmc.errors import ParameterError, ShapeError, UnsupportedError
from bayesmc.shapes import Shape, first_index

_AT_ONCE = 1 << 21  # distances held at a time
_LOG_2PI = float(np.log(2 * np.pi))
_RULES = ("scott", "silverman")


class KernelDensity(Distribution):
    """Kernel density estimate (Parzen window) with Gaussian kernels about ``points``.

    Points that are vectors, an array of shape ``(n, d)``, need ``vectors=True``: without it the array
    is a batch of n estimates, each of d numbers.

    Parameters
    ----------
    points : array_like, shape (..., n), or (..., n, d) with ``vectors=True``
        Where the kernels sit.
    bandwidth : "scott", "silverman" or array_like
        A rule multiplies the points' covariance by ``n_eff**(-2 / (d + 4))`` (Scott) or
        ``(n_eff * (d + 2) / 4)**(-2 / (d + 4))`` (Silverman), with ``n_eff = 1 / sum(weights**2)``.
        A number is the kernel's standard deviation, in the unit of the points; for vectors a
        ``(..., d)`` array of them, too.
    weights : array_like, shape (..., n), optional
        Nonnegative weights of the points; they are normalised. Equal by default.
    vectors : bool
        Whether the last axis of ``points`` holds the components of vectors.

    Raises
    ------
    ParameterError
        A point is not finite, weights are negative or all zero, the bandwidth is not positive, or
        a rule is asked of points that do not spread in every direction.
    ShapeError
        ``points``, ``weights`` and ``bandwidth`` do not fit each other.

    References
    ----------
    Parzen, Annals of Mathematical Statistics 33, 1962; Scott, Multivariate Density Estimation,
    1992, section 6.5; Silverman, Density Estimation, 1986, equation 4.14.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> parzen = bmc.KernelDensity([-1.0, 0.0, 3.0], bandwidth=0.5)
    >>> float(parzen.log_prob(0.0).round(4)), float(parzen.mean.round(4))
    (-1.1975, 0.6667)
    """

    def __init__(
        self,
        points: Any,
        bandwidth: Any = "scott",
        weights: Any = None,
        vectors: bool = False,
    ) -> None:
        points = as_float(points)
        points = _with_components(points, vectors)
        n, d = points.shape[-2:]
        self.event_shape = (d,) if vectors else ()
        weights = as_float(np.full(n, 1.0) if weights is None else weights)
        if weights.ndim < 1 or weights.shape[-1] != n:
            raise ShapeError(f"KernelDensity: weights of shape {weights.shape} for {n} points")
        rule = bandwidth if isinstance(bandwidth, str) else None
        if rule is not None and rule not in _RULES:
            raise ParameterError(
                f"KernelDensity: bandwidth={rule!r} is not 'scott', 'silverman' or a number"
            )
        given = _given(bandwidth, d, vectors) if rule is None else np.ones(d)
        self._set_batch(points.shape[:-2], weights.shape[:-1], given.shape[:-1])
        ok = np.isfinite(points).all(axis=(-1, -2))
        self._points = self._check("points", points, ok, _ramp(n, d), "finite")
        self.weights = self._weights(weights)
        self._choice = Categorical(self.weights)
        self._vectors = vectors
        self._factor = self._by_rule(rule) if rule is not None else self._by_hand(given)

    @property
    def points(self) -> np.ndarray:
        """Where the kernels sit, shape ``(..., n)`` or ``(..., n, d)``."""
        return self._points if self._vectors else self._points[..., 0]

    @property
    def kernel_cov(self) -> np.ndarray:
        """Covariance matrix of the kernel, shape ``(..., d, d)``; of numbers the variance, ``(...)``."""
        cov = self._factor @ np.swapaxes(self._factor, -1, -2)
        return cov if self._vectors else cov[..., 0, 0]

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        return [(self._points, 2), (self.weights, 1), (self._factor, 2)]

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        index = self._choice.sample_to(rng, shape)
        batch = self._points.shape[:-2]
        flat = self._points.reshape((-1, *self._points.shape[-2:]))
        element = np.arange(len(flat)).reshape(batch)
        centres = flat[np.broadcast_to(element, shape), index]
        noise = np.matvec(self._factor, rng.standard_normal(centres.shape))
        return centres + noise if self._vectors else (centres + noise)[..., 0]

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        x = self._as_vectors(x)
        inverse = np.linalg.inv(self._factor)
        at = np.matvec(inverse, x)
        log_scale = np.log(np.linalg.diagonal(self._factor)).sum(axis=-1)
        top: Any = -np.inf
        total: Any = 0.0
        for points, weights in self._chunks(at.shape[:-1]):
            centres = np.matvec(inverse[..., None, :, :], points)
            terms = np.log(weights) - 0.5 * _squared_distances(at, centres)
            # log-sum-exp that moves on: the peak so far and the sum relative to it
            peak = np.maximum(top, terms.max(axis=-1))
            safe = np.where(np.isfinite(peak), peak, 0.0)
            total = total * np.exp(top - safe) + np.exp(terms - safe[..., None]).sum(axis=-1)
            top = peak
        value = np.log(total) + np.where(np.isfinite(top), top, 0.0)
        value = value - log_scale - 0.5 * x.shape[-1] * _LOG_2PI
        return np.where(np.isnan(at).any(axis=-1), np.nan, value)

    @property
    def mean(self) -> np.ndarray:
        mean = (self.weights[..., None] * self._points).sum(axis=-2)
        return self._full(mean if self._vectors else mean[..., 0])

    @property
    def var(self) -> np.ndarray:
        mean = (self.weights[..., None] * self._points).sum(axis=-2, keepdims=True)
        spread = (self.weights[..., None] * (self._points - mean) ** 2).sum(axis=-2)
        var = spread + (self._factor**2).sum(axis=-1)
        return self._full(var if self._vectors else var[..., 0])

    @property
    def support(self) -> Support:
        return real_vector if self._vectors else real

    def cdf(self, x: Any) -> np.ndarray:
        self._one_number("cdf")
        x = np.asarray(x, dtype=float)
        shape = np.broadcast_shapes(x.shape, self.batch_shape)
        total = np.zeros(shape)
        scale = self._factor[..., 0, 0]
        with np.errstate(over="ignore"):
            for points, weights in self._chunks(shape):
                z = (x[..., None] - points[..., 0]) / scale[..., None]
                total += (weights * special.ndtr(z)).sum(axis=-1)
        return np.minimum(total, 1.0)

    def ppf(self, q: Any) -> np.ndarray:
        """Quantile, found between the outermost kernels' quantiles."""
        self._one_number("ppf")
        q = as_quantile(q)
        used = np.where(self.weights > 0, self.points, np.nan)
        z = self._factor[..., 0, 0] * special.ndtri(q)
        low, high = np.nanmin(used, axis=-1) + z, np.nanmax(used, axis=-1) + z
        return invert(self.cdf, self.log_prob, q, low, high)

    # ---- kernels ----------------------------------------------------------------------------

    def _weights(self, weights: np.ndarray) -> np.ndarray:
        total = np.where(np.isfinite(weights), weights, 0.0).sum(axis=-1)
        ok = (np.isfinite(weights) & (weights >= 0)).all(axis=-1) & (total > 0)
        weights = self._check("weights", weights, ok, 1.0, "nonnegative and finite, some positive")
        return weights / weights.sum(axis=-1, keepdims=True)

    def _by_rule(self, rule: str) -> np.ndarray:
        """Cholesky factor of the kernel's covariance by a rule, as ``scipy.stats.gaussian_kde``."""
        points, weights = self._points, self.weights[..., None]
        d = points.shape[-1]
        squares = (weights**2).sum(axis=(-1, -2))
        centred = points - (weights * points).sum(axis=-2, keepdims=True)
        cov = np.swapaxes(weights * centred, -1, -2) @ centred
        cov = cov / np.maximum(1 - squares, 2.0**-53)[..., None, None]
        ok = np.broadcast_to(self._spread(cov, squares), cov.shape[:-2])
        what = (
            "spread out in every direction for a rule to read the bandwidth from "
            "(or give the kernel's standard deviation: bandwidth=0.1)"
        )
        if not ok.all():
            full = np.broadcast_to(self._points, ok.shape + self._points.shape[-2:])
            self._reject("points", np.squeeze(full[first_index(~ok)]), ~ok, what)
            cov = np.where(ok[..., None, None], cov, np.eye(d))
        ess = 1 / squares
        size = ess if rule == "scott" else ess * (d + 2) / 4
        return np.linalg.cholesky(cov) * (size ** (-1 / (d + 4)))[..., None, None]

    def _spread(self, cov: np.ndarray, squares: np.ndarray) -> np.ndarray:
        """Whether a covariance is more than rounding in every direction."""
        scale = np.abs(self._points).max(axis=-2)
        size = np.linalg.diagonal(cov)
        some = (size > (1e-14 * scale) ** 2).all(axis=-1) & (squares < 1 - 1e-12)
        sd = np.sqrt(np.where(some[..., None], size, 1.0))
        correlation = cov / (sd[..., :, None] * sd[..., None, :])
        correlation = np.where(some[..., None, None], correlation, np.eye(cov.shape[-1]))
        return some & (np.linalg.eigvalsh(correlation)[..., 0] > 1e-12)

    def _by_hand(self, given: np.ndarray) -> np.ndarray:
        ok = ((given > 0) & (given < np.inf)).all(axis=-1)
        given = self._check("bandwidth", given, np.asarray(ok), 1.0, "positive and finite")
        return given[..., None] * np.eye(given.shape[-1])

    def _chunks(self, shape: Shape) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Points and weights, a few points at a time."""
        lead = np.broadcast_shapes(shape, self.batch_shape)
        step = max(1, _AT_ONCE // max(1, int(np.prod(lead))))
        for start in range(0, self._points.shape[-2], step):
            part = slice(start, start + step)
            yield self._points[..., part, :], self.weights[..., part]

    def _as_vectors(self, x: np.ndarray) -> np.ndarray:
        if not self._vectors:
            return np.asarray(x, dtype=float)[..., None]
        if x.ndim < 1 or x.shape[-1:] != self.event_shape:
            raise ShapeError(
                f"KernelDensity: x has shape {x.shape}, not (..., *{self.event_shape})"
            )
        return x

    def _full(self, value: np.ndarray) -> np.ndarray:
        return np.broadcast_to(value, self.batch_shape + self.event_shape)

    def _one_number(self, what: str) -> None:
        if self._vectors:
            raise UnsupportedError(f"KernelDensity: of vectors there is no {what}; use draws")


def _with_components(points: np.ndarray, vectors: bool) -> np.ndarray:
    need = 2 if vectors else 1
    if points.ndim < need or 0 in points.shape[points.ndim - need :]:
        wanted = "(..., n, d) with vectors=True" if vectors else "(..., n)"
        raise ShapeError(
            f"KernelDensity: points must have shape {wanted}, n at least 1; got {points.shape}"
        )
    return points if vectors else points[..., None]


def _given(bandwidth: Any, d: int, vectors: bool) -> np.ndarray:
    """Kernel standard deviations, shape ``(..., d)``."""
    array = as_float(bandwidth)
    if not vectors:
        return array[..., None]
    if array.ndim and array.shape[-1] not in (1, d):
        raise ShapeError(
            f"KernelDensity: bandwidth of shape {array.shape} for vectors of {d} components; give a "
            f"number or {d} of them"
        )
    return np.broadcast_to(array, (*array.shape[:-1], d)).copy()


def _ramp(n: int, d: int) -> np.ndarray:
    """Points of full spread, to stand in for bad ones."""
    return np.random.default_rng(0).standard_normal((n, d))


def _squared_distances(at: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Shape ``(..., n)``, component by component so that no array has both axes."""
    total: Any = 0.0
    for k in range(at.shape[-1]):
        total = total + (at[..., k, None] - centres[..., k]) ** 2
    return total
