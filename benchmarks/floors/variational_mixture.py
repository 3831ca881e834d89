"""Variational Bayes of a Gaussian mixture by hand-written NumPy (Bishop 2006, sec. 10.2), one thread.

A sweep updates weights, means with precisions, and responsibilities, and gives the evidence bound. Both
start from the same responsibilities; the prior is Dirichlet(1), mean 0 with the weight of one observation,
Wishart(2, I).

- :class:`Plain` is the textbook: a quadratic form for every point and component by ``einsum``.
- :class:`Tuned` uses that a log density is linear in ``(1, x, y, x^2, xy, y^2)``: log densities are one
  matrix product, sufficient statistics another; components first, so that sums run along memory; in place.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import special

ALPHA, BETA, DF = 1.0, 1.0, 2.0


class Plain:
    """``points`` is (n, d), ``shares`` the responsibilities to begin with, (n, k)."""

    def __init__(self, points: np.ndarray, shares: np.ndarray) -> None:
        self.x, self.shares = points, shares

    def run(self, sweeps: int) -> float:
        """So many sweeps; gives the bound after the last."""
        for _ in range(sweeps):
            bound = self.sweep()
        return bound

    def sweep(self) -> float:
        x, r = self.x, self.shares
        d = x.shape[1]
        count = r.sum(axis=0) + 1e-300
        mean = r.T @ x / count[:, None]
        off = x[:, None, :] - mean
        scatter = np.einsum("nk,nki,nkj->kij", r, off, off)
        alpha, beta, df = ALPHA + count, BETA + count, DF + count
        location = count[:, None] * mean / beta[:, None]
        outer = mean[:, :, None] * mean[:, None, :]
        inverse = np.eye(d) + scatter + (BETA * count / beta)[:, None, None] * outer
        scale = np.linalg.inv(inverse)
        log_pi, log_det, prior = _expected(alpha, beta, df, location, inverse, scale)
        away = x[:, None, :] - location
        form = d / beta + df * np.einsum("nki,kij,nkj->nk", away, scale, away)
        logs = log_pi + 0.5 * (log_det - d * math.log(2 * math.pi) - form)
        total = special.logsumexp(logs, axis=1)
        self.shares = np.exp(logs - total[:, None])
        return float(total.sum()) + prior


class Tuned:
    """As :class:`Plain`, of two dimensions."""

    def __init__(self, points: np.ndarray, shares: np.ndarray) -> None:
        x, y = points.T
        self.features = np.array([np.ones(len(x)), x, y, x * x, x * y, y * y])
        self.turned = np.ascontiguousarray(self.features.T)
        self.shares = np.ascontiguousarray(shares.T)
        self.top, self.total = np.empty(len(x)), np.empty(len(x))

    def run(self, sweeps: int) -> float:
        for _ in range(sweeps):
            bound = self.sweep()
        return bound

    def sweep(self) -> float:
        sums = self.shares @ self.turned
        count = sums[:, 0]
        alpha, beta, df = ALPHA + count, BETA + count, DF + count
        location = sums[:, 1:3] / beta[:, None]
        second = sums[:, [3, 4, 4, 5]].reshape(-1, 2, 2)
        outer = location[:, :, None] * location[:, None, :]
        inverse = np.eye(2) + second - beta[:, None, None] * outer
        scale = np.linalg.inv(inverse)
        log_pi, log_det, prior = _expected(alpha, beta, df, location, inverse, scale)
        precision = df[:, None, None] * scale
        linear = np.matvec(precision, location)
        table = np.empty((len(count), 6))
        table[:, 0] = log_pi + 0.5 * (log_det - 2 / beta - np.vecdot(linear, location))
        table[:, 0] -= math.log(2 * math.pi)
        table[:, 1:3] = linear
        table[:, 3] = -0.5 * precision[:, 0, 0]
        table[:, 4] = -precision[:, 0, 1]
        table[:, 5] = -0.5 * precision[:, 1, 1]
        logs = np.matmul(table, self.features, out=self.shares)
        np.max(logs, axis=0, out=self.top)
        logs -= self.top
        np.exp(logs, out=logs)
        np.sum(logs, axis=0, out=self.total)
        logs /= self.total
        return float(np.log(self.total).sum() + self.top.sum()) + prior


def start(count: int, states: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Points of a mixture, and responsibilities to begin with."""
    rng = np.random.default_rng(seed)
    means = rng.normal(0.0, 1.5, (states, 2))
    points = means[rng.integers(0, states, count)] + rng.normal(0.0, 0.5, (count, 2))
    return points, rng.dirichlet(np.ones(states), count)


# ---- private ------------------------------------------------------------------------------------


def _expected(
    alpha: np.ndarray,
    beta: np.ndarray,
    df: np.ndarray,
    location: np.ndarray,
    inverse: np.ndarray,
    scale: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Expected log weights and log determinants, and minus the divergence from the prior."""
    k, d = location.shape
    log_pi = special.digamma(alpha) - special.digamma(alpha.sum())
    halves = 0.5 * (df[:, None] - np.arange(d))
    det = np.log(np.linalg.det(inverse))
    log_det = special.digamma(halves).sum(axis=1) + d * math.log(2.0) - det
    shares = special.gammaln(k * ALPHA) - k * special.gammaln(ALPHA)
    shares -= special.gammaln(alpha.sum()) - special.gammaln(alpha).sum()
    shares -= float(((alpha - ALPHA) * log_pi).sum())
    forms = np.einsum("ki,kij,kj->k", location, scale, location)
    trace = np.trace(scale, axis1=1, axis2=2)
    means = 0.5 * (d * np.log(BETA / beta) + d - BETA * (d / beta + df * forms)).sum()
    before = 0.5 * DF * d * math.log(2.0) + special.multigammaln(0.5 * DF, d)
    after = 0.5 * df * d * math.log(2.0) - 0.5 * df * det + _log_gamma(halves, d)
    scatter = (-before + after + 0.5 * (DF - df) * log_det - 0.5 * df * trace + 0.5 * df * d).sum()
    return log_pi, log_det, float(shares + means + scatter)


def _log_gamma(halves: np.ndarray, d: int) -> np.ndarray:
    return 0.25 * d * (d - 1) * math.log(math.pi) + special.gammaln(halves).sum(axis=1)
