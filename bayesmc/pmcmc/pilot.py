"""Where static nodes start, and how many particles they need: a look at the posterior beforehand.

Candidates from the prior are weighed by filters of few particles, and drawn anew where they weigh most, a few
times over. It is adaptive importance sampling with weights that are flattened until enough candidates count,
so nothing is claimed of its answer: chains start there, and have it to go by.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import scipy.special

from bayesmc.resampling import systematic

#: candidates of a round, at least; rounds, at most
CANDIDATES, _ROUNDS = 64, 8
#: share of the candidates that are to count
_COUNTING = 0.25
#: width of the noise about the candidates that are drawn again, in standard deviations of all
_WIDTH = 0.5

#: log prior density of points, and an estimate of their log likelihood
Weigh = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def located(
    points: np.ndarray, log_likelihood: np.ndarray, weigh: Weigh, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points near the mass of a posterior.

    Parameters
    ----------
    points : ndarray, shape (candidates, size)
        Draws from the prior, of free numbers.
    log_likelihood : ndarray, shape (candidates,)
        Of these, estimated; some may be ``-inf``, not all.
    weigh : callable
        From points to the log of their prior density and an estimate of their log likelihood.

    Returns
    -------
    points : ndarray, shape (candidates, size)
        Candidates of the last round.
    weights : ndarray, shape (candidates,)
        How much each is worth there; they sum to one.

    References
    ----------
    Cappé, Guillin, Marin and Robert (2004), JCGS 13, 907-929 (population Monte Carlo); Koblents and Míguez
    (2015), Statistics and Computing 25 (flattened weights).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.pmcmc.pilot import located
    >>> rng = np.random.default_rng(0)
    >>> def weigh(x):
    ...     return -0.5 * (x[:, 0] / 100) ** 2, -0.5 * ((x[:, 0] - 30) / 0.1) ** 2
    >>> start = rng.normal(0.0, 100.0, (64, 1))
    >>> points, weights = located(start, weigh(start)[1], weigh, rng)
    >>> bool(abs(weights @ points[:, 0] - 30) < 0.1)
    True
    """
    log = log_likelihood
    weights, power = _flattened(log)
    for _ in range(_ROUNDS):
        mean = weights @ points
        away = points - mean
        cov = (weights * away.T) @ away
        cov[np.diag_indices_from(cov)] += 1e-8 * (1.0 + np.diagonal(cov))
        factor = _WIDTH * np.linalg.cholesky(cov)
        noise = rng.standard_normal(points.shape) @ factor.T
        tried = points[systematic(weights, len(points), rng)] + noise
        prior, likelihood = weigh(tried)
        log = prior + likelihood - _log_mixture(tried, points, weights, factor)
        if not (log > -np.inf).any():
            break
        points, done = tried, power == 1.0
        weights, power = _flattened(log)
        if done and power == 1.0:
            break
    return points, weights


def particles_for(
    estimates: np.ndarray, particles: int, error: float, least: int, most: int
) -> int:
    """How many particles give the log likelihood some error, from estimates with ``particles`` at one point.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.pmcmc.pilot import particles_for
    >>> estimates = np.random.default_rng(0).normal(-50.0, 2.4, 1000)
    >>> 350 < particles_for(estimates, 100, 1.2, 10, 5000) < 450
    True
    """
    from scipy.stats import median_abs_deviation  # slow to import

    finite = estimates[np.isfinite(estimates)]
    if len(finite) < 2:
        return most
    spread = median_abs_deviation(finite, scale="normal")
    # its variance falls with the number of particles
    return int(np.clip(math.ceil(particles * (spread / error) ** 2), least, most))


# ---- private ------------------------------------------------------------------------------------


def _flattened(log: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights to the largest power up to one with which enough count, and that power."""
    log = np.where(np.isnan(log), -np.inf, log)
    wanted = min(_COUNTING * len(log), 0.9 * np.isfinite(log).sum())

    def at(power: float) -> np.ndarray:
        return scipy.special.softmax(np.where(log == -np.inf, -np.inf, power * log))

    if 1.0 / np.square(at(1.0)).sum() >= wanted:
        return at(1.0), 1.0
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if 1.0 / np.square(at(middle)).sum() >= wanted else (low, middle)
    return at(low), low


def _log_mixture(
    x: np.ndarray, centres: np.ndarray, weights: np.ndarray, factor: np.ndarray
) -> np.ndarray:
    """Log density of Gaussian noise about weighted centres, up to a constant."""
    from scipy.linalg import solve_triangular  # slow to import

    apart = (x[:, None] - centres[None]).reshape(-1, x.shape[1])
    scaled = solve_triangular(factor, apart.T, lower=True)
    square = np.square(scaled).sum(axis=0).reshape(len(x), len(centres))
    volume = np.log(np.diagonal(factor)).sum()
    return scipy.special.logsumexp(-0.5 * square, b=weights, axis=1) - volume
