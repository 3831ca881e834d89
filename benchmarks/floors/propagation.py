"""Expectation propagation by a loop in NumPy over the slices, all pairs of modes at once, with precisions.

As one writes it who knows the model: messages from both sides by log, linear term and precision, two slices
as one matrix for every pair, no damping, and nothing looks whether a message is proper.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from benchmarks import models_switching as m

_LOG_2PI = math.log(2.0 * math.pi)


class Smoothed(NamedTuple):
    """Means (steps, d) and modes (steps, k) given all rows, and the log evidence."""

    mean: np.ndarray
    modes: np.ndarray
    log: float


def propagated(y: np.ndarray, sweeps: int) -> Smoothed:
    """Passes back and forth after one forth (Heskes and Zoeter 2002); ``y`` has shape (steps, 2)."""
    k, d, steps = len(m.MOVES), len(m.START_MEAN), len(y)
    alpha, beta = _messages(steps, k, d), _messages(steps, k, d)
    start = np.tile(m.START_MEAN, (k, 1)), np.tile(m.START_COVARIANCE, (k, 1, 1))
    _set(alpha, 0, _canonical(np.log(m.START), *start))
    still, told = _fixed()
    rows = y @ told.T  # linear terms
    seen = np.einsum("ti,ij,tj->t", y, np.linalg.inv(m.SIGHT_NOISE), y)
    noise = np.linalg.slogdet(m.NOISE)[1] + np.linalg.slogdet(m.SIGHT_NOISE)[1]
    constant = np.log(m.FOLLOW) - 0.5 * (noise - d * _LOG_2PI + len(told[0]) * _LOG_2PI)
    linear = np.empty((k, k, 2 * d))

    def two(t: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Log, means and covariances of the slice before and this one, for every pair."""
        precision = still[None] + np.zeros((k, 1, 1, 1))
        precision[..., :d, :d] += alpha[2][t - 1][:, None]
        precision[..., d:, d:] += beta[2][t]
        linear[..., :d] = alpha[1][t - 1][:, None]
        linear[..., d:] = beta[1][t] + rows[t - 1]
        covariance = np.linalg.inv(precision)
        mean = (covariance @ linear[..., None])[..., 0]
        log = constant - 0.5 * seen[t - 1] + alpha[0][t - 1][:, None] + beta[0][t]
        log = log + 0.5 * ((linear * mean).sum(axis=-1) - np.linalg.slogdet(precision)[1])
        return log, mean, covariance

    def forth(t: int) -> None:
        log, mean, covariance = two(t)
        new = _canonical(*_merged(log, mean[..., d:], covariance[..., d:, d:]))
        _set(alpha, t, [a - b[t] for a, b in zip(new, beta, strict=True)])

    def back(t: int) -> None:
        log, mean, covariance = two(t)
        log, mean, covariance = log.T, mean.swapaxes(0, 1), covariance.swapaxes(0, 1)
        new = _canonical(*_merged(log, mean[..., :d], covariance[..., :d, :d]))
        _set(beta, t - 1, [a - b[t - 1] for a, b in zip(new, alpha, strict=True)])

    for t in range(1, steps + 1):
        forth(t)
    for _ in range(sweeps):
        for t in range(steps, 0, -1):
            back(t)
        for t in range(1, steps + 1):
            forth(t)
    logs, means = _moments(*(a + b for a, b in zip(alpha, beta, strict=True)))
    total = np.logaddexp.reduce(logs, axis=1)
    modes = np.exp(logs - total[:, None])
    evidence = sum(np.logaddexp.reduce(two(t)[0], axis=None) for t in range(1, steps + 1))
    mean = (modes[..., None] * means).sum(axis=1)
    return Smoothed(mean[1:], modes[1:], float(evidence - total[1:-1].sum()))


# ---- private ------------------------------------------------------------------------------------


def _fixed() -> tuple[np.ndarray, np.ndarray]:
    """Precisions of two slices by mode, and what a row adds to the linear term."""
    a, q = m.MOVES, np.linalg.inv(m.NOISE)
    told = m.SIGHT.T @ np.linalg.inv(m.SIGHT_NOISE)
    turned = a.swapaxes(-1, -2)
    return np.block([[turned @ q @ a, -turned @ q], [-q @ a, q + told @ m.SIGHT]]), told


def _messages(steps: int, k: int, d: int) -> list[np.ndarray]:
    return [np.zeros((steps + 1, k)), np.zeros((steps + 1, k, d)), np.zeros((steps + 1, k, d, d))]


def _set(messages: list[np.ndarray], t: int, new: Any) -> None:
    for message, part in zip(messages, new, strict=True):
        message[t] = part


def _merged(
    log: np.ndarray, mean: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One Gaussian of those along the first axis."""
    top = log.max(axis=0)
    share = np.exp(log - top)
    total = share.sum(axis=0)
    share = share / total
    middle = (share[..., None] * mean).sum(axis=0)
    away = mean - middle
    outer = away[..., :, None] * away[..., None, :]
    return np.log(total) + top, middle, (share[..., None, None] * (covariance + outer)).sum(axis=0)


def _canonical(
    log: np.ndarray, mean: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    precision = np.linalg.inv(covariance)
    linear = (precision @ mean[..., None])[..., 0]
    size = np.linalg.slogdet(precision)[1] - mean.shape[-1] * _LOG_2PI
    return log + 0.5 * (size - (mean * linear).sum(axis=-1)), linear, precision


def _moments(
    log: np.ndarray, linear: np.ndarray, precision: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Logs of the integrals, and means."""
    mean = np.linalg.solve(precision, linear[..., None])[..., 0]
    size = mean.shape[-1] * _LOG_2PI - np.linalg.slogdet(precision)[1]
    return log + 0.5 * ((linear * mean).sum(axis=-1) + size), mean
