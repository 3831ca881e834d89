"""Random correlation matrices."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.base import Distribution, as_float
from bayesmc.distributions.parameters import as_size
from bayesmc.distributions.support import Support, correlation
from bayesmc.errors import ShapeError
from bayesmc.gaussian import try_cholesky
from bayesmc.shapes import Shape


class LKJ(Distribution):
    """Correlation matrices, with density proportional to ``det(R) ** (concentration - 1)``.

    With concentration 1 all correlation matrices are alike; the larger it is, the nearer to no correlation.
    A covariance is ``sd[..., :, None] * R * sd[..., None, :]``, with a prior of its own for each standard
    deviation.

    Parameters
    ----------
    size : int
        Rows, at least 1.
    concentration : array_like, shape (...)
        Positive.

    Raises
    ------
    ParameterError
        ``size`` is no positive whole number, or ``concentration`` not positive and finite.

    Notes
    -----
    ``log_prob`` is the density of the entries below the diagonal; it is minus infinity at what is no
    correlation matrix (a diagonal off from 1 by more than 1e-6, a correlation that the others rule out).

    References
    ----------
    Lewandowski, Kurowicka and Joe (2009), Generating random correlation matrices based on vines and extended
    onion method, J. Multivariate Analysis 100, eq. 15-17; draws by the onion method, section 3.2.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> prior = bmc.LKJ(3, 2.0)
    >>> prior.sample(rng=1).round(2).tolist()
    [[1.0, 0.51, 0.64], [0.51, 1.0, 0.38], [0.64, 0.38, 1.0]]
    >>> float(bmc.LKJ(2, 1.0).log_prob([[1.0, 0.3], [0.3, 1.0]]).round(4))  # uniform on (-1, 1)
    -0.6931
    """

    parameter_ndim = {"concentration": 0}

    def __init__(self, size: int, concentration: Any = 1.0) -> None:
        self.size = as_size("LKJ", size)
        concentration = as_float(concentration)
        self._set_batch(concentration.shape)
        self.event_shape = (self.size, self.size)
        self.concentration = self._positive("concentration", concentration)

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        return [(np.asarray(self.size), 0), (self.concentration, 0)]

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        d, eta = self.size, self.concentration
        lower = np.zeros((*shape, d, d))
        lower[..., 0, 0] = 1.0
        for i in range(1, d):  # the next row: its length within those above it, and a direction
            length = rng.beta(0.5 * i, eta + 0.5 * (d - 1 - i), shape)
            way = rng.normal(size=(*shape, i))
            way /= np.sqrt(np.square(way).sum(axis=-1, keepdims=True))
            lower[..., i, :i] = np.sqrt(length)[..., None] * way
            lower[..., i, i] = np.sqrt(1.0 - length)
        found = lower @ np.swapaxes(lower, -1, -2)
        found[..., np.arange(d), np.arange(d)] = 1.0
        return 0.5 * (found + np.swapaxes(found, -1, -2))

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        d = self.size
        if x.shape[-2:] != self.event_shape:
            raise ShapeError(f"LKJ: x has shape {x.shape}, not (..., {d}, {d})")
        root, bad = try_cholesky(x)
        log_det = 2.0 * np.log(np.linalg.diagonal(root)).sum(axis=-1)
        density = (self.concentration - 1.0) * log_det - log_volume(d, self.concentration)
        off = (np.abs(np.linalg.diagonal(x) - 1.0) > 1e-6).any(axis=-1)
        outside = off if bad is None else off | bad
        unknown = np.isnan(x).any(axis=(-2, -1))
        return np.where(unknown, np.nan, np.where(outside, -np.inf, density))

    @property
    def mean(self) -> np.ndarray:
        return np.broadcast_to(np.eye(self.size), self.batch_shape + self.event_shape)

    @property
    def var(self) -> np.ndarray:
        """Variance of each entry: ``1 / (2 concentration + d - 1)`` off the diagonal."""
        each = 1.0 / (2.0 * self.concentration + self.size - 1.0)
        return each[..., None, None] * (1.0 - np.eye(self.size))

    @property
    def support(self) -> Support:
        return correlation


def log_volume(size: int, concentration: Any) -> Any:
    """The logarithm of the integral of ``det(R) ** (concentration - 1)``, of an array or a stand-in."""
    total: Any = 0.0 * concentration
    for k in range(1, size):
        half = concentration + 0.5 * (size - 1 - k)
        power = 2.0 * concentration - 2.0 + size - k
        total = total + (size - k) * (power * math.log(2.0) + special.betaln(half, half))
    return total
