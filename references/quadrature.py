"""Posterior cdfs by summing over a fine grid, for parameters whose moments say little.

A variance with few groups behind it has a tail so long that its mean and sd, published or ours, are
mostly chance; its quantiles are not. Both models here become one or two precisions once their Normal
unknowns are integrated out in closed form, and the rest is a sum in logs. Normals have *precisions* here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

Cdf = Callable[[Any], np.ndarray]
_PRIOR = 0.001  # precisions are Gamma(0.001, 0.001)


def line_cdfs(x: Any, y: Any) -> dict[str, Cdf]:
    """Cdfs of ``tau`` and ``sigma`` of a straight line with vague coefficients.

    With ``x`` centred, the observations' covariance is ``I / tau`` with ``1e4 n`` more along the
    ones and ``1e4 |x|^2`` more along ``x``.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    z, n = x - x.mean(), len(x)
    along_ones, along_x = y.sum() ** 2 / n, (z @ y) ** 2 / (z @ z)
    rest = y @ y - along_ones - along_x
    u = np.linspace(-30.0, 12.0, 200_001)  # log tau
    noise = np.exp(-u)
    log_density = (
        _log_prior(u)
        + _log_normal(along_ones, noise + 1e4 * n)
        + _log_normal(along_x, noise + 1e4 * (z @ z))
        - 0.5 * ((n - 2) * np.log(noise) + rest / noise)
    )
    tau = _cdf_of_exp(u, np.exp(log_density - log_density.max()))
    return {"tau": tau, "sigma": lambda s: 1.0 - tau(np.asarray(s, dtype=float) ** -2.0)}


def dyes_cdfs(y: Any) -> dict[str, Cdf]:
    """Cdf of ``sigma2.between`` in the one-way layout ``y`` (batches by samples)."""
    y = np.asarray(y, dtype=float)
    batches, samples = y.shape
    means = y.mean(axis=1)
    within = ((y - means[:, None]) ** 2).sum()
    between = ((means - means.mean()) ** 2).sum()
    centre = np.log(within / (batches * (samples - 1)))
    w = np.linspace(centre - 3.0, centre + 4.0, 301)[:, None]  # log sigma2.within
    b = np.linspace(-14.0, 40.0, 5401)  # log sigma2.between
    spread = np.exp(b) + np.exp(w) / samples  # variance of a batch mean given theta
    log_density = (
        _log_prior(-w)
        + _log_prior(-b)
        - 0.5 * (batches * (samples - 1) * w + within * np.exp(-w))
        - 0.5 * ((batches - 1) * np.log(spread) + between / spread)
        + _log_normal(batches * means.mean() ** 2, spread + 1e10 * batches)
    )
    density = np.exp(log_density - log_density.max()).sum(axis=0)
    return {"sigma2.between": _cdf_of_exp(b, density)}


def _log_prior(u: Any) -> Any:
    """Log density of the log of a Gamma(0.001, 0.001) precision, up to a constant."""
    return _PRIOR * u - _PRIOR * np.exp(u)


def _log_normal(square: float, variance: Any) -> Any:
    """Log density of a centred Normal at a point whose square is given, up to a constant."""
    return -0.5 * (np.log(variance) + square / variance)


def _cdf_of_exp(u: np.ndarray, density: np.ndarray) -> Cdf:
    """The cdf of ``exp(u)`` from the density of u on an even grid, up to a constant."""
    cumulative = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    cumulative /= cumulative[-1]
    return lambda x: np.interp(np.log(np.asarray(x, dtype=float)), u, cumulative)
