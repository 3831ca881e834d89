"""Where a log density has its peaks, and how wide they are.

Quadrature sees what its nodes hit; a peak much narrower than the prior must be found first. Searches go up
from draws of the prior, configuration by configuration. What they find is not part of an answer: it says
where cells must be fine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from bayesmc.testing.oracles.hidden import HiddenPart

#: peaks whose log mass is this far below the best do not matter
_NEGLIGIBLE = 40.0
_PENALTY = 1e100
#: draws of the prior, over all configurations
_DRAWS = 4096
#: numbers that those evaluations may hold
_NUMBERS = 4_000_000
#: configurations that are searched, best first
_SEARCHED = 32

LogDensity = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Peak:
    """A mode in free numbers, its covariance by the curvature there, its log density, and the log of its
    mass (Laplace)."""

    point: np.ndarray
    cov: np.ndarray
    height: float
    log_mass: float


def find_peaks(hidden: HiddenPart, rng: np.random.Generator, starts: int) -> list[Peak]:
    """Peaks of the density of what is hidden, heaviest first; empty where all draws are impossible."""
    most = min(_DRAWS, max(256, _NUMBERS // hidden.weight))
    draws = hidden.draws(rng, max(16, most // hidden.count))
    heights = np.stack([hidden.log_density_of(c, draws[c]) for c in range(hidden.count)])
    spread = _spread(draws.reshape(-1, hidden.dimension))
    found: list[Peak] = []
    best = np.argsort(-heights.max(axis=1))[:_SEARCHED]
    each = max(2, starts // len(best))
    for c in best.tolist():
        if heights[c].max() == -np.inf:
            continue

        def log_density(free: np.ndarray, c: int = c) -> np.ndarray:
            return hidden.log_density_of(c, free)

        for start in _starts(draws[c], heights[c], spread, each):
            peak = climb(log_density, start, spread, found)
            if peak is not None:
                found.append(peak)
    top = max((p.log_mass for p in found), default=0.0)
    kept = [p for p in found if p.log_mass > top - _NEGLIGIBLE]
    return sorted(kept, key=lambda p: -p.log_mass)


def climb(
    log_density: LogDensity, start: np.ndarray, scale: np.ndarray, known: Sequence[Peak] = ()
) -> Peak | None:
    """The peak above a start; None where there is no way up, or where it is one of those known.

    The search is repeated in units of the widths that it found, since a first step as wide as the prior
    tells little about a narrow peak.
    """
    point = start
    for _ in range(3):
        point = _ascend(log_density, point, scale)
        height = float(log_density(point[None])[0])
        if not np.isfinite(height) or any(_is_at(p, point, height) for p in known):
            return None
        scale = _widths(log_density, point, scale)
    cov = _covariance(log_density, point, scale)
    _, log_det = np.linalg.slogdet(2 * np.pi * cov)
    return Peak(point, cov, height, height + 0.5 * float(log_det))


# ---- private ------------------------------------------------------------------------------------


def _spread(draws: np.ndarray) -> np.ndarray:
    """Robust widths of draws."""
    low, high = np.quantile(draws, [0.16, 0.84], axis=0)
    return np.maximum(0.5 * (high - low), 1e-6)


def _starts(
    draws: np.ndarray, heights: np.ndarray, spread: np.ndarray, count: int
) -> list[np.ndarray]:
    """The highest draw, and draws far from those taken among the higher ones, then among all."""
    order = np.argsort(-heights)
    order = order[heights[order] > -np.inf]
    taken = [draws[order[0]]]
    for k in range(1, count):
        among = draws[order[: max(20, len(order) // 20)]] if k % 2 else draws[order]
        off = np.abs(among[:, None] - np.stack(taken)) / spread
        nearest = np.minimum(off, 10.0).max(axis=-1).min(axis=1)
        taken.append(among[nearest.argmax()])
    return taken


def _ascend(log_density: LogDensity, start: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Quasi-Newton in units of ``scale``, with central differences in one call."""
    d = len(start)
    step = 1e-4
    offsets = np.concatenate([np.zeros((1, d)), step * np.eye(d), -step * np.eye(d)])

    def objective(z: np.ndarray) -> tuple[float, np.ndarray]:
        values = -log_density(start + scale * (z + offsets))
        values = np.where(np.isfinite(values), values, _PENALTY)
        gradient = (values[1 : d + 1] - values[d + 1 :]) / (2 * step)
        return float(values[0]), np.where(np.abs(gradient) < 0.1 * _PENALTY, gradient, 0.0)

    with np.errstate(all="ignore"):
        found = optimize.minimize(
            objective, np.zeros(d), jac=True, method="BFGS", options={"maxiter": 100, "gtol": 1e-3}
        )
    return np.asarray(start + scale * found.x)


def _widths(log_density: LogDensity, point: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """How far along each axis the log density falls by about a half, within a factor of four."""
    steps = scale * 4.0 ** np.arange(-22, 6)[:, None]
    widths = np.empty(len(point))
    top = log_density(point[None])[0]
    for k in range(len(point)):
        shift = np.zeros((len(steps), len(point)))
        shift[:, k] = steps[:, k]
        fall = top - np.minimum(log_density(point + shift), log_density(point - shift))
        far = np.flatnonzero(~(fall < 0.5))
        widths[k] = steps[far[0] if far.size else -1, k]
    return widths


def _covariance(log_density: LogDensity, point: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Inverse curvature, from second differences over the widths; curvatures are kept away from zero."""
    d = len(point)
    pairs = [(i, j) for i in range(d) for j in range(i + 1)]
    unit = 0.5 * np.eye(d)
    shifts = [s * unit[i] + t * unit[j] for i, j in pairs for s in (1, -1) for t in (1, -1)]
    values = log_density(point + scale * np.array(shifts)).reshape(-1, 4)
    values = np.where(np.isfinite(values), values, values[np.isfinite(values)].min(initial=0.0))
    curvature = np.zeros((d, d))
    for (i, j), (pp, pm, mp, mm) in zip(pairs, values, strict=True):
        curvature[i, j] = curvature[j, i] = -(pp - pm - mp + mm)
    found, axes = np.linalg.eigh(curvature)
    inverse = (axes / np.clip(found, 1e-3, 1e6)) @ axes.T
    return inverse * np.outer(scale, scale)


def _is_at(peak: Peak, point: np.ndarray, height: float) -> bool:
    """Whether a point is as good as a peak's own: within its width, and no higher."""
    off = point - peak.point
    return bool(off @ np.linalg.solve(peak.cov, off) < 0.25 and abs(height - peak.height) < 0.5)
