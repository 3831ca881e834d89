"""Marginals of single numbers under a weighted mixture of normals and points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.special

from bayesmc.testing.oracles.conditional_gaussian import GaussianAnswer
from bayesmc.testing.oracles.enumeration import Enumerated
from bayesmc.testing.oracles.quadrature import at_most


@dataclass(frozen=True, eq=False)
class Marginal:
    """One number's posterior: weighted normals, some of them points."""

    weights: np.ndarray
    means: np.ndarray
    scales: np.ndarray


def marginals(
    answer: Enumerated | GaussianAnswer, name: str
) -> list[tuple[tuple[int, ...], Marginal]]:
    """Each number of a node."""
    shape = answer.model[name].value_shape
    if isinstance(answer, Enumerated):
        means = np.asarray(answer.values(name), dtype=float).reshape(len(answer.weights), -1)
        scales = np.zeros(means.shape)
        weights = answer.weights
    else:
        weights, means, covs = answer.mixture(name)
        scales = np.sqrt(np.maximum(np.diagonal(covs, axis1=1, axis2=2), 0.0))
    places = list(np.ndindex(shape))
    return [(at, Marginal(weights, means[:, k], scales[:, k])) for k, at in enumerate(places)]


def cdf(part: Marginal, x: np.ndarray) -> np.ndarray:
    """Probabilities of values at most ``x``."""
    points = part.scales <= 1e-12 * np.maximum(1.0, np.abs(part.means))
    total = at_most(part.means[points], part.weights[points], x)
    smooth = ~points
    z = (x[..., None] - part.means[smooth]) / part.scales[smooth]
    return np.asarray(total + scipy.special.ndtr(z) @ part.weights[smooth])


def quantile(part: Marginal, levels: np.ndarray) -> np.ndarray:
    """By bisection, to the last digits; what ends within rounding of a point is that point."""
    low = np.full(levels.shape, (part.means - 40 * part.scales).min() - 1e-9)
    high = np.full(levels.shape, (part.means + 40 * part.scales).max())
    for _ in range(120):
        middle = 0.5 * (low + high)
        below = cdf(part, middle) < levels * (1 - 1e-13)
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    points = part.means[part.scales == 0.0]
    if not points.size:
        return high
    nearest = points[np.abs(high[..., None] - points).argmin(axis=-1)]
    return np.where(
        np.abs(high - nearest) <= 1e-9 * np.maximum(1.0, np.abs(nearest)), nearest, high
    )
