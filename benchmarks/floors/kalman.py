"""A Kalman filter by a loop in NumPy: means, covariances and the increments of the log-likelihood.

:func:`plain` is what one writes first; :func:`filtered` writes out the inverse of two by two and
avoids ``np.linalg``, whose calls cost more than the arithmetic. Every step takes the recursion in
full: that covariances hang on no data, and settle, is not made use of, since the peer that the
loops are held against makes none of it either.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Linear:
    """x' = F x + N(0, Q), y = H x + N(0, R), x of slice 0 N(mean, covariance)."""

    transition: np.ndarray
    noise: np.ndarray
    sight: np.ndarray
    sight_noise: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class Filtered:
    """Means (steps, d), covariances (steps, d, d), increments of the log-likelihood (steps,)."""

    mean: np.ndarray
    covariance: np.ndarray
    increments: np.ndarray


def filtered(y: np.ndarray, model: Linear) -> Filtered:
    """Each slice given the rows up to it; ``y`` has shape (steps, 2): two numbers are measured."""
    f, q, h, r = model.transition, model.noise, model.sight, model.sight_noise
    ft, ht = f.T.copy(), h.T.copy()
    steps, d = len(y), len(f)
    means, covariances, increments = np.empty((steps, d)), np.empty((steps, d, d)), np.empty(steps)
    m, p = model.mean, model.covariance
    inverse = np.empty((2, 2))
    constant = math.log(2.0 * math.pi)
    log = math.log
    for t in range(steps):
        if t:
            m = f.dot(m)
            p = f.dot(p).dot(ft)
            p += q
        cross = p.dot(ht)
        spread = h.dot(cross)
        spread += r
        (a, b), (c, e) = spread.tolist()
        determinant = a * e - b * c
        inverse[0, 0], inverse[0, 1], inverse[1, 0], inverse[1, 1] = e, -b, -c, a
        gain = cross.dot(inverse)
        gain /= determinant
        off = y[t] - h.dot(m)
        m = m + gain.dot(off)
        p = p - gain.dot(cross.T)
        u, v = off.tolist()
        square = (u * u * e - u * v * (b + c) + v * v * a) / determinant
        increments[t] = -0.5 * (square + log(determinant)) - constant
        means[t] = m
        covariances[t] = p
    return Filtered(means, covariances, increments)


def plain(y: np.ndarray, model: Linear) -> Filtered:
    """The same as one writes it first: whole products, ``np.linalg``, any number of measurements."""
    f, q, h, r = model.transition, model.noise, model.sight, model.sight_noise
    steps, d = len(y), len(f)
    means, covariances, increments = np.empty((steps, d)), np.empty((steps, d, d)), np.empty(steps)
    m, p = model.mean, model.covariance
    for t in range(steps):
        if t:
            m, p = f @ m, f @ p @ f.T + q
        spread = h @ p @ h.T + r
        off = y[t] - h @ m
        gain = np.linalg.solve(spread, h @ p).T
        m, p = m + gain @ off, p - gain @ h @ p
        square = off @ np.linalg.solve(spread, off)
        _, log = np.linalg.slogdet(spread)
        increments[t] = -0.5 * (square + log + len(off) * math.log(2.0 * math.pi))
        means[t], covariances[t] = m, p
    return Filtered(means, covariances, increments)
