"""Small nets with vague priors whose links overflow, or leave what is allowed, and their exact answers.

Two hidden numbers each; the posterior is summed on a grid around its mode, with SciPy's densities.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize, special, stats

import bayesmc as bmc

POINTS = 20


@dataclass(frozen=True)
class Vague:
    """A net, its data, and what its two numbers are on average.

    Attributes
    ----------
    mean : dict
        Hidden node -> posterior mean.
    """

    net: bmc.BayesNet
    evidence: dict[str, Any]
    mean: dict[str, float]


def summed(
    log: Callable[[np.ndarray, np.ndarray], np.ndarray], start: tuple[float, float]
) -> tuple[float, float]:
    """Means under a log density of two numbers, from a grid of 8 standard deviations to each side.

    ``log`` takes arrays of equal shapes; ``start`` is near the mode.
    """

    def minus(x: np.ndarray) -> float:
        value = float(log(np.array(x[0]), np.array(x[1])))
        return -value if np.isfinite(value) else 1e10

    with np.errstate(all="ignore"):
        mode = optimize.minimize(minus, start, method="Nelder-Mead", options={"maxiter": 4000}).x
        curvature = np.empty((2, 2))
        step = 1e-3 * (1.0 + np.abs(mode))
        for i in range(2):
            for j in range(2):
                e, f = np.eye(2)[i] * step, np.eye(2)[j] * step
                corners = [mode + e + f, mode + e - f, mode - e + f, mode - e - f]
                a, b, c, d = (minus(x) for x in corners)
                curvature[i, j] = (a - b - c + d) / (4 * step[i] * step[j])
        root = np.linalg.cholesky(np.linalg.inv(curvature))
        u = np.linspace(-8.0, 8.0, 161)
        grid = np.stack(np.meshgrid(u, u, indexing="ij"), -1) @ root.T + mode
        logs = log(grid[..., 0], grid[..., 1])
    logs = np.where(np.isfinite(logs), logs, -np.inf)
    weights = np.exp(logs - logs.max())
    found = (grid * weights[..., None]).sum(axis=(0, 1)) / weights.sum()
    return float(found[0]), float(found[1])


def random_vague(kind: str, rng: np.random.Generator) -> Vague:
    """One of ``KINDS``, with random data and priors of random width."""
    return KINDS[kind](rng, float(10.0 ** rng.uniform(1.5, 2.5)))


# ---- private ------------------------------------------------------------------------------------


def _made(
    names: tuple[str, str], priors: Any, child: Any, y: np.ndarray, log: Any, start: Any
) -> Vague:
    net = bmc.BayesNet(plates={"i": POINTS})
    for name, prior in zip(names, priors, strict=True):
        net.add(name, prior)
    net.add("y", child, plates="i")
    return Vague(net, {"y": y}, dict(zip(names, summed(log, start), strict=True)))


def _counts(rng: np.random.Generator, width: float) -> Vague:
    z = rng.normal(size=POINTS)
    y = rng.poisson(np.exp(1.0 + 0.5 * z))

    def log(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        rate = np.exp(a[..., None] + b[..., None] * z)
        prior = stats.norm.logpdf(a, 0, width) + stats.norm.logpdf(b, 0, width)
        return prior + stats.poisson.logpmf(y, rate).sum(-1)

    prior = bmc.Normal(0.0, width)
    return _made(
        ("a", "b"), (prior, prior), lambda a, b: bmc.Poisson(np.exp(a + b * z)), y, log, (1.0, 0.5)
    )


def _lifetimes(rng: np.random.Generator, width: float) -> Vague:
    y = np.exp(3.0) * rng.weibull(1.5, size=POINTS)

    def log(b: np.ndarray, r: np.ndarray) -> np.ndarray:
        prior = stats.norm.logpdf(b, 0, width) + stats.gamma.logpdf(r, 1.0, scale=1e4)
        scale = np.exp(-b / r)[..., None]
        return prior + stats.weibull_min.logpdf(y, r[..., None], scale=scale).sum(-1)

    priors = bmc.Normal(0.0, width), bmc.Gamma(1.0, 1e-4)
    return _made(
        ("b", "r"), priors, lambda b, r: bmc.Weibull(r, np.exp(-b / r)), y, log, (-4.5, 1.5)
    )


def _shares(rng: np.random.Generator, width: float) -> Vague:
    z = rng.normal(size=POINTS)
    mean = special.expit(0.3 + 0.8 * z)
    y = np.clip(rng.beta(20 * mean, 20 * (1 - mean)), 1e-6, 1 - 1e-6)

    def log(a: np.ndarray, k: np.ndarray) -> np.ndarray:
        m = special.expit(a[..., None] + 0.8 * z)
        prior = stats.norm.logpdf(a, 0, width) + stats.gamma.logpdf(k, 1.0, scale=1e3)
        k = k[..., None]
        return prior + stats.beta.logpdf(y, m * k, (1 - m) * k).sum(-1)

    def child(a: Any, k: Any) -> Any:
        m = special.expit(a + 0.8 * z)
        return bmc.Beta(m * k, (1 - m) * k)

    priors = bmc.Normal(0.0, width), bmc.Gamma(1.0, 1e-3)
    return _made(("a", "k"), priors, child, y, log, (0.3, 20.0))


def _spread(rng: np.random.Generator, width: float) -> Vague:
    """A scale that may be negative."""
    y = rng.normal(2.0, 1.5, size=POINTS)

    def log(m: np.ndarray, s: np.ndarray) -> np.ndarray:
        prior = stats.norm.logpdf(m, 0, width) + stats.norm.logpdf(s, 0, width)
        kept = np.where(s > 0, s, np.nan)[..., None]
        return prior + stats.norm.logpdf(y, m[..., None], kept).sum(-1)

    prior = bmc.Normal(0.0, width)
    return _made(("m", "s"), (prior, prior), lambda m, s: bmc.Normal(m, s), y, log, (2.0, 1.5))


def _bounds(rng: np.random.Generator, width: float) -> Vague:
    """Probabilities that are linear, and so may leave 0 to 1."""
    z = np.linspace(-1.0, 1.0, POINTS)
    y = rng.binomial(20, 0.5 + 0.25 * z)

    def log(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        p = a[..., None] + b[..., None] * z
        prior = stats.norm.logpdf(a, 0, width) + stats.norm.logpdf(b, 0, width)
        inside = ((p >= 0) & (p <= 1)).all(-1)
        found = stats.binom.logpmf(y, 20, np.clip(p, 1e-300, 1.0)).sum(-1)
        return prior + np.where(inside, found, -np.inf)

    prior = bmc.Normal(0.0, width)
    return _made(
        ("a", "b"), (prior, prior), lambda a, b: bmc.Binomial(20, a + b * z), y, log, (0.5, 0.25)
    )


def _grades(rng: np.random.Generator, width: float) -> Vague:
    """Cutpoints that need not be in order."""
    y = np.digitize(rng.logistic(size=POINTS), [-1.0, 0.7])

    def masses(c: np.ndarray, d: np.ndarray) -> np.ndarray:
        low, high = special.expit(c), special.expit(d)
        return bmc.stack([low, high - low, 1.0 - high], axis=-1)

    def log(c: np.ndarray, d: np.ndarray) -> np.ndarray:
        prior = stats.norm.logpdf(c, 0, width) + stats.norm.logpdf(d, 0, width)
        found = np.log(masses(c, d)) @ np.bincount(y, minlength=3)
        return prior + np.where(c < d, found, -np.inf)

    prior = bmc.Normal(0.0, width)
    return _made(
        ("c", "d"), (prior, prior), lambda c, d: bmc.Categorical(masses(c, d)), y, log, (-1.0, 0.7)
    )


KINDS: dict[str, Callable[[np.random.Generator, float], Vague]] = {
    "counts": _counts,
    "lifetimes": _lifetimes,
    "shares": _shares,
    "negative scales": _spread,
    "linear probabilities": _bounds,
    "cutpoints out of order": _grades,
}
