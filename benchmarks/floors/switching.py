"""GPB2 by a loop in NumPy over the slices, all pairs of modes at once, with covariances.

As one writes it who knows the model: a stable (Joseph's) update, two measured numbers through ``np.linalg``,
Gaussians merged by sums of outer products.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from benchmarks import models_switching as m


class Filtered(NamedTuple):
    """Means (steps, d), covariances (steps, d, d), modes (steps, k), increments of the log-likelihood."""

    mean: np.ndarray
    covariance: np.ndarray
    modes: np.ndarray
    increments: np.ndarray


def gpb2(y: np.ndarray) -> Filtered:
    """Each slice given the rows up to it (Kim 1994); ``y`` has shape (steps, 2)."""
    a, q, h, r = m.MOVES, m.NOISE, m.SIGHT, m.SIGHT_NOISE
    k, d, p, steps = len(a), len(m.START_MEAN), len(h), len(y)
    turned, ht, eye = a.transpose(0, 2, 1), h.T, np.eye(d)
    mean, cov = np.tile(m.START_MEAN, (k, 1)), np.tile(m.START_COVARIANCE, (k, 1, 1))
    follow, log_weights = np.log(m.FOLLOW), np.log(m.START)
    constant = -0.5 * p * math.log(2.0 * math.pi)
    means, covariances = np.empty((steps, d)), np.empty((steps, d, d))
    modes, increments = np.empty((steps, k)), np.empty(steps)
    for t, row in enumerate(y):
        ahead = (a @ mean.T).transpose(2, 0, 1)  # (before, now, d)
        spread = a @ cov[:, None] @ turned + q
        off = row - ahead @ ht
        cross = h @ spread
        own = cross @ ht + r
        gain = np.linalg.solve(own, cross).swapaxes(-1, -2)
        ahead = ahead + (gain @ off[..., None])[..., 0]
        rest = eye - gain @ h
        spread = rest @ spread @ rest.swapaxes(-1, -2) + gain @ r @ gain.swapaxes(-1, -2)
        square = (off * np.linalg.solve(own, off[..., None])[..., 0]).sum(axis=-1)
        log = log_weights[:, None] + follow + constant - 0.5 * (square + np.linalg.slogdet(own)[1])
        top = log.max()
        pairs = np.exp(log - top)
        total, weights = pairs.sum(), pairs.sum(axis=0)
        share = pairs / weights
        mean = (share[..., None] * ahead).sum(axis=0)
        away = ahead - mean
        outer = away[..., :, None] * away[..., None, :]
        cov = (share[..., None, None] * (spread + outer)).sum(axis=0)
        weights = weights / total
        log_weights = np.log(weights)
        increments[t], modes[t] = math.log(total) + top, weights
        means[t] = weights @ mean
        away = mean - means[t]
        outer = away[:, :, None] * away[:, None, :]
        covariances[t] = (weights[:, None, None] * (cov + outer)).sum(axis=0)
    return Filtered(means, covariances, modes, increments)
