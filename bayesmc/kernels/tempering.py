"""A mixture fitted to a density of a few numbers, all of its hills, for independent proposals.

Draws that cover the prior are moved towards the target by degrees: at each temperature they are weighted,
and a mixture of Student's t about some of them is what the next are drawn from. Hills that lie far apart keep
their shares, which chains that start in one of them cannot know.

References
----------
Cappe, Douc, Guillin, Marin and Robert (2008), Adaptive importance sampling in general mixture classes,
Statistics and Computing 18; Del Moral, Doucet and Jasra (2006), Sequential Monte Carlo samplers, JRSS B 68
(temperatures); Givens and Raftery (1996), Local adaptive importance sampling, JASA 91 (local covariances);
Ionides (2008), Truncated importance sampling, JCGS 17.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import special

from bayesmc.resampling import systematic

#: components of a mixture, and degrees of freedom of each
_COMPONENTS, _DF = 128, 4.0
#: share of the mass that lies about a component, whose spread it has: hills that weigh less look too wide
_NEAR = 0.03
#: share of all draws that come from the first, wide mixture, and its components that are kept for that
_WIDE, _KEPT = 0.05, 16
#: share of draws that a temperature leaves effective, and temperatures at most
_LEFT, _ROUNDS = 0.2, 40
#: share of the final draws that must be effective for the mixture to be of use
_USEFUL = 0.02

#: log density of vectors ``(rows, numbers)``
LogDensity = Callable[[np.ndarray], np.ndarray]


class MixtureOfT(NamedTuple):
    """A mixture of multivariate Student's t distributions.

    Attributes
    ----------
    shares : ndarray, shape (components,)
    centres : ndarray, shape (components, numbers)
    roots : ndarray, shape (components, numbers, numbers)
        Lower Cholesky factors of the scale matrices.
    whitening : ndarray, shape (components, numbers, numbers)
        Inverses of the roots.
    heights : ndarray, shape (components,)
        Log densities at the centres, shares included.
    whitened : ndarray, shape (components, numbers)
        The centres' distances from their mean, whitened.
    """

    shares: np.ndarray
    centres: np.ndarray
    roots: np.ndarray
    whitening: np.ndarray
    heights: np.ndarray
    whitened: np.ndarray

    @classmethod
    def of(cls, shares: np.ndarray, centres: np.ndarray, roots: np.ndarray) -> MixtureOfT:
        """A mixture by its shares, centres and roots."""
        d = centres.shape[1]
        constant = special.gammaln(0.5 * (_DF + d)) - special.gammaln(0.5 * _DF)
        constant -= 0.5 * d * math.log(_DF * math.pi)
        pivots = np.diagonal(roots, axis1=1, axis2=2)
        heights = np.log(shares) - np.log(pivots).sum(axis=1) + constant
        whitening = np.linalg.inv(roots)
        whitened = np.matvec(whitening, centres - centres.mean(axis=0))
        return cls(shares, centres, roots, whitening, heights, whitened)

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Independent draws, shape ``(count, numbers)``."""
        of = rng.choice(len(self.shares), count, p=self.shares)
        z = rng.standard_normal((count, self.centres.shape[1]))
        z *= np.sqrt(_DF / rng.chisquare(_DF, count))[:, None]
        return self.centres[of] + np.matvec(self.roots[of], z)

    def log_prob(self, u: np.ndarray) -> np.ndarray:
        """Log density of ``u``, shape ``(rows,)``."""
        count, d = self.centres.shape
        # one product for all components, of distances from the middle, so that no digits are lost
        z = (u - self.centres.mean(axis=0)) @ self.whitening.reshape(-1, d).T
        z = z.reshape(-1, count, d) - self.whitened
        logs = self.heights - 0.5 * (_DF + d) * np.log1p(np.vecdot(z, z) / _DF)
        top = logs.max(axis=1)
        return np.asarray(top + np.log(np.exp(logs - top[:, None]).sum(axis=1)))


def fitted_mixture(
    log_density: LogDensity, draws: np.ndarray, rng: np.random.Generator
) -> MixtureOfT | None:
    """A mixture close to a density, starting from draws that cover it; None where none comes close.

    Parameters
    ----------
    log_density : callable
        Up to a constant; minus infinity where impossible.
    draws : ndarray, shape (count, numbers)
        They cover the mass, however thinly: draws from the prior.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.tempering import fitted_mixture
    >>> rng = np.random.default_rng(0)
    >>> hills = lambda u: np.logaddexp(-50 * (u[:, 0] - 3) ** 2, np.log(3) - 50 * (u[:, 0] + 3) ** 2)
    >>> found = fitted_mixture(hills, rng.normal(0.0, 10.0, (500, 1)), rng)
    >>> float(np.round(found.shares[found.centres[:, 0] < 0].sum(), 1))
    0.8
    """
    count = len(draws)
    draws = draws[np.isfinite(draws).all(axis=1)]
    if len(draws) < 0.5 * count:
        return None
    first = current = _about(draws, np.full(len(draws), 1.0 / len(draws)), rng)
    heat = 0.0
    for _ in range(_ROUNDS):
        u = current.draw(rng, count)
        log_q = current.log_prob(u)
        from_first = log_q if current is first else first.log_prob(u)
        target = log_density(u)
        target = np.where(np.isnan(target), -np.inf, target)
        if not (target > -np.inf).any() or target.max() == np.inf:
            return None
        gain, base = target - from_first, from_first - log_q
        heat = _hotter(gain, base, heat)
        log_w = _heated(gain, base, heat)
        if not np.isfinite(log_w.max()):
            return None
        weights = np.exp(log_w - log_w.max())
        effective = weights.sum() ** 2 / (weights @ weights) / count
        # one draw far out must not be all that the next are drawn about (Ionides 2008)
        weights = np.minimum(weights, weights.mean() * math.sqrt(count))
        current = _with(_about(u, weights / weights.sum(), rng), first)
        if heat == 1.0 and effective >= 0.5 * _LEFT:
            return current
    return current if heat == 1.0 and effective >= _USEFUL else None


# ---- private ------------------------------------------------------------------------------------


def _heated(gain: np.ndarray, base: np.ndarray, power: float) -> np.ndarray:
    """Log weights at a power of the target; what it excludes has none at power 0, either."""
    possible = gain > -np.inf
    return np.where(possible, power * np.where(possible, gain, 0.0) + base, -np.inf)


def _hotter(gain: np.ndarray, base: np.ndarray, heat: float) -> float:
    """The largest power of the target, at least what it was, that leaves enough draws effective."""

    def effective(power: float) -> float:
        log = _heated(gain, base, power)
        w = np.exp(log - log.max())
        return float(w.sum() ** 2 / (w @ w)) / len(w)

    if effective(1.0) >= _LEFT:
        return 1.0
    low, high = heat, 1.0
    for _ in range(30):
        middle = 0.5 * (low + high) if low else min(0.5 * high, math.sqrt(high * 1e-12))
        if effective(middle) >= _LEFT:
            low = middle
        else:
            high = middle
    return max(low, heat)


def _with(mixture: MixtureOfT, wide: MixtureOfT) -> MixtureOfT:
    """A mixture that has some of a wide one's components, too, which bound the weights of its draws."""
    at = slice(None, None, -(-len(wide.shares) // _KEPT))
    shares = (1.0 - _WIDE) * mixture.shares, _WIDE * wide.shares[at] / wide.shares[at].sum()
    return MixtureOfT.of(
        np.concatenate(shares),
        np.concatenate([mixture.centres, wide.centres[at]]),
        np.concatenate([mixture.roots, wide.roots[at]]),
    )


def _about(u: np.ndarray, weights: np.ndarray, rng: np.random.Generator) -> MixtureOfT:
    """A mixture about weighted points, each component as wide as the mass around it."""
    chosen, times = np.unique(systematic(weights, _COMPONENTS, rng), return_counts=True)
    centres = u[chosen]
    some = weights > 1e-4 * weights.max() / len(weights)
    u, weights = u[some], weights[some] / weights[some].sum()
    d = u.shape[1]
    spread = np.sqrt(weights @ (u - weights @ u) ** 2)
    spread = np.where(spread > 0, spread, 1e-3 * (1.0 + np.abs(u[0])))
    z, c = u / spread, centres / spread
    off = z[None] - c[:, None]  # (components, points, numbers)
    squares = np.vecdot(off, off)
    order = np.argsort(squares, axis=1)
    mass = np.cumsum(weights[order], axis=1) - weights[order]
    near = np.where(mass < _NEAR, weights[order], 0.0)
    few = order.shape[1] >= d + 2
    near[:, : d + 2 if few else None] = weights[order][:, : d + 2 if few else None]
    local = np.zeros(squares.shape)
    np.put_along_axis(local, order, near, axis=1)
    local /= local.sum(axis=1, keepdims=True)
    cov = np.matmul((local[..., None] * off).swapaxes(1, 2), off)
    wide = np.trace(cov, axis1=1, axis2=2) / d
    # of a few points in many directions a covariance comes out too small
    cov = (1.0 + 0.25 * d) * cov + (0.02 * wide + 1e-12)[:, None, None] * np.eye(d)
    roots = np.linalg.cholesky(cov) * spread[:, None]
    return MixtureOfT.of(times / times.sum(), centres, roots)
