"""A Rao-Blackwellised bootstrap filter by a loop in NumPy over the slices, all particles at once.

As one writes it who knows the model: modes drawn by inversion, a covariance for every particle, two measured
numbers through ``np.linalg``, systematic resampling where the effective number has fallen below half.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from benchmarks import models_switching as m


class Filtered(NamedTuple):
    """Means (steps, d), variances (steps, d), modes (steps, k), increments of the log-likelihood."""

    mean: np.ndarray
    variance: np.ndarray
    modes: np.ndarray
    increments: np.ndarray


def target(y: np.ndarray, particles: int, seed: int) -> Filtered:
    """Each slice given the rows up to it; ``y`` has shape (steps, 2)."""
    rng = np.random.Generator(np.random.SFC64(seed))
    a, q, h, r = m.MOVES, m.NOISE, m.SIGHT, m.SIGHT_NOISE
    k, d, p, steps, n = len(a), len(m.START_MEAN), len(h), len(y), particles
    turned, ht, bounds = a.transpose(0, 2, 1), h.T, np.cumsum(m.FOLLOW, axis=1)
    mode = (rng.random(n)[:, None] > np.cumsum(m.START)[:-1]).sum(axis=1)
    mean, cov = np.tile(m.START_MEAN, (n, 1)), np.tile(m.START_COVARIANCE, (n, 1, 1))
    log, constant = np.zeros(n), -0.5 * p * math.log(2.0 * math.pi)
    means, variances = np.empty((steps, d)), np.empty((steps, d))
    modes, increments = np.empty((steps, k)), np.empty(steps)
    weights, before = np.ones(n), math.log(n)
    for t, row in enumerate(y):
        if weights.sum() ** 2 < 0.5 * n * (weights @ weights):
            places = (rng.random() + np.arange(n)) / n * weights.sum()
            chosen = np.minimum(np.searchsorted(np.cumsum(weights), places), n - 1)
            mode, mean, cov = mode[chosen], mean[chosen], cov[chosen]
            log, before = np.zeros(n), math.log(n)
        mode = (rng.random(n)[:, None] > bounds[mode, :-1]).sum(axis=1)
        move = a[mode]
        mean = (move @ mean[..., None])[..., 0]
        cov = move @ cov @ turned[mode] + q[mode]
        off = row - mean @ ht
        cross = h @ cov
        own = cross @ ht + r
        gain = np.linalg.solve(own, cross).swapaxes(-1, -2)
        mean = mean + (gain @ off[..., None])[..., 0]
        cov = cov - gain @ cross
        square = (off * np.linalg.solve(own, off[..., None])[..., 0]).sum(axis=-1)
        log = log + constant - 0.5 * (square + np.linalg.slogdet(own)[1])
        top = log.max()
        weights = np.exp(log - top)
        total = weights.sum()
        after = top + math.log(total)
        increments[t], before = after - before, after
        share = weights / total
        means[t] = share @ mean
        away = mean - means[t]
        variances[t] = share @ (np.diagonal(cov, axis1=1, axis2=2) + away * away)
        modes[t] = np.bincount(mode, share, k)
    return Filtered(means, variances, modes, increments)
