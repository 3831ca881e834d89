"""Gibbs sampling of a Gaussian mixture (K=3, D=2) by hand-written NumPy: one chain, one thread.

Dirichlet weights, independent Normal means and inverse-Wishart covariances, labels sampled; the
priors are those of ``benchmarks.models_gibbs``. Both samplers use that a log-density is linear in
``(x^2, xy, y^2, x, y, 1)``: log-densities are one matrix product, sufficient statistics another.

- :class:`Plain` works on whole arrays: three densities, a cumulative sum, a one-hot matrix.
- :class:`Tuned` goes through chunks that stay in cache, relative to the first component, in place.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from benchmarks.models_gibbs import MIXTURE_PRIOR as PRIOR
from benchmarks.models_gibbs import MIXTURE_START

CHUNK = 4096
_HIGHEST = 300.0  # logits are cut here: the sum of two exponentials must not overflow


class Plain:
    """Whole arrays, new in every sweep; ``points`` is (n, 2)."""

    def __init__(self, points: np.ndarray, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.features = _features(points)
        self.means = [*MIXTURE_START]
        self.rows = [(self.features.sum(axis=0) / 3.0).tolist()] * 3

    def run(self, sweeps: int) -> np.ndarray:
        """So many sweeps; gives the means, (sweeps, 3, 2)."""
        kept = []
        for _ in range(sweeps):
            self.means, linear = _parameters(self.rng, self.means, self.rows)
            logits = self.features @ np.transpose(linear)
            weights = np.exp(logits - logits.max(axis=1, keepdims=True))
            sums = np.cumsum(weights, axis=1)
            passed = self.rng.random(len(sums))[:, None] * sums[:, -1:] >= sums[:, :-1]
            one_hot = passed.sum(axis=1)[:, None] == np.arange(3)
            self.rows = (one_hot.T.astype(float) @ self.features).tolist()
            kept.append(self.means)
        return np.array(kept)


class Tuned:
    """Chunks in cache, buffers kept; as :class:`Plain`."""

    def __init__(self, points: np.ndarray, seed: int) -> None:
        self.rng = np.random.Generator(np.random.SFC64(seed))
        features = np.ascontiguousarray(_features(points).T)
        self.total = features.sum(axis=1).tolist()
        self.means = [*MIXTURE_START]
        self.rows = [[total / 3.0 for total in self.total]] * 3
        # Chunks as equal as can be: a short one at the end would cost as many calls as a long one.
        chunks = -(-len(points) // CHUNK)
        self.chunks = [np.ascontiguousarray(f) for f in np.array_split(features, chunks, axis=1)]
        sizes = {f.shape[1] for f in self.chunks}
        self.buffers = {n: [np.empty(s) for s in ((2, n), (2, n), n, n)] for n in sizes}

    def run(self, sweeps: int) -> np.ndarray:
        """So many sweeps; gives the means, (sweeps, 3, 2)."""
        kept = []
        for _ in range(sweeps):
            self.means, (a, b, c) = _parameters(self.rng, self.means, self.rows)
            linear = [
                [y - x for x, y in zip(a, b, strict=True)],
                [z - x for x, z in zip(a, c, strict=True)],
            ]
            first, second = self._labels(np.array(linear)).tolist()
            self.rows = [
                [t - x for t, x in zip(self.total, first, strict=True)],
                [x - y for x, y in zip(first, second, strict=True)],
                second,
            ]
            kept.append(self.means)
        return np.array(kept)

    def _labels(self, linear: np.ndarray) -> np.ndarray:
        """Sum of the features of the points whose label is at least 1, and at least 2."""
        beyond = 0.0
        for features in self.chunks:
            ratios, passed, uniform, sums = self.buffers[features.shape[1]]
            np.dot(linear, features, out=ratios)
            np.minimum(ratios, _HIGHEST, out=ratios)
            np.exp(ratios, out=ratios)
            one, two = ratios
            one += 1.0
            self.rng.random(out=uniform)
            uniform *= np.add(one, two, out=sums)
            np.greater_equal(uniform, 1.0, out=passed[0])
            np.greater_equal(uniform, one, out=passed[1])
            beyond = np.dot(passed, features.T) + beyond
        return beyond


def _features(points: np.ndarray) -> np.ndarray:
    x, y = points.T
    return np.stack([x * x, x * y, y * y, x, y, np.ones(len(x))], axis=1)


def _parameters(
    rng: np.random.Generator, means: Sequence[tuple[float, float]], rows: list[list[float]]
) -> tuple[list[tuple[float, float]], list[tuple[float, ...]]]:
    """Draw weights, covariances and means; the log-densities' coefficients, six by component.

    ``rows`` are the sums of the features by component. Six numbers at a time are faster as
    Python's floats than as arrays.
    """
    normals = rng.standard_normal(9).tolist()
    shapes = [PRIOR.concentration + row[5] for row in rows]
    shapes += [0.5 * (PRIOR.df + row[5] - i) for row in rows for i in (0, 1)]
    gammas = rng.standard_gamma(shapes).tolist()  # weights, then half of chi-squares
    chis = gammas[3:]
    drawn, linear = [], []
    for k, (row, mean) in enumerate(zip(rows, means, strict=True)):
        z = normals[3 * k : 3 * k + 3]
        precision = _precision(row, mean, 2.0 * chis[2 * k], 2.0 * chis[2 * k + 1], z[0])
        mean = _mean(row, precision, z[1], z[2])
        drawn.append(mean)
        linear.append(_linear(math.log(gammas[k]), mean, precision))
    return drawn, linear


def _precision(
    row: list[float], mean: tuple[float, float], chi0: float, chi1: float, z: float
) -> tuple[float, float, float]:
    """Wishart draw by Bartlett's decomposition: the elements (xx, xy, yy)."""
    xx, xy, yy, x, y, n = row
    m0, m1 = mean
    a = PRIOR.scatter + xx - 2.0 * m0 * x + n * m0 * m0
    b = xy - m0 * y - m1 * x + n * m0 * m1
    c = PRIOR.scatter + yy - 2.0 * m1 * y + n * m1 * m1
    determinant = a * c - b * b
    l00 = math.sqrt(c / determinant)
    l10 = -b / determinant / l00
    l11 = 1.0 / math.sqrt(c)  # the factor's determinant is one over the scatter's
    u00, u11 = l00 * math.sqrt(chi0), l11 * math.sqrt(chi1)
    u10 = l10 * math.sqrt(chi0) + l11 * z
    return u00 * u00, u00 * u10, u10 * u10 + u11 * u11


def _mean(
    row: list[float], precision: tuple[float, float, float], z0: float, z1: float
) -> tuple[float, float]:
    *_, x, y, n = row
    p00, p01, p11 = precision
    prior = 1.0 / PRIOR.variance
    q00, q01, q11 = prior + n * p00, n * p01, prior + n * p11
    h0, h1 = p00 * x + p01 * y, p01 * x + p11 * y
    determinant = q00 * q11 - q01 * q01
    r00 = math.sqrt(q00)
    r10 = q01 / r00
    y1 = z1 / math.sqrt(q11 - r10 * r10)
    y0 = (z0 - r10 * y1) / r00
    return (
        (q11 * h0 - q01 * h1) / determinant + y0,
        (q00 * h1 - q01 * h0) / determinant + y1,
    )


def _linear(
    log_weight: float, mean: tuple[float, float], precision: tuple[float, float, float]
) -> tuple[float, ...]:
    m0, m1 = mean
    p00, p01, p11 = precision
    h0, h1 = p00 * m0 + p01 * m1, p01 * m0 + p11 * m1
    constant = log_weight + 0.5 * math.log(p00 * p11 - p01 * p01) - 0.5 * (m0 * h0 + m1 * h1)
    return -0.5 * p00, -p01, -0.5 * p11, h0, h1, constant
