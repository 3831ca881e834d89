"""A Gaussian belief, corrected by a log density that need not be Gaussian: Laplace's approximation, in bulk.

Newton's method on every particle at once, in coordinates in which the belief is standard. Derivatives are
differences of the log density, so nothing is asked of it but that it can be evaluated.

References
----------
Doucet, Godsill and Andrieu (2000), On sequential Monte Carlo sampling methods for Bayesian filtering,
Statistics and Computing 10, sec. II-D-2 (local linearisation of the log density).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np

#: of a difference, in standard deviations of the belief: rounding errors of a log density of size f come to
#: some 1e-10 f in its curvature, which has to be seen beside that of the belief, which is 1
_STEP = 1e-3
#: Newton's steps, and standard deviations of the result by which the last of them may still move
_TURNS, _STILL = 15, 0.05
#: standard deviations that the first step may go, and how often one is cut where it leads down
_REACH, _CUTS = 4.0, 5
#: by which a step is cut; by as much it is tried longer first, since Newton's own crawl along an exponential
_CUT = 0.25

#: logs from which on their differences may overflow
_LARGE = 1e150

#: points, shape ``(points, *shape, numbers)``, to logs, shape ``(points, *shape)``
LogDensity = Callable[[np.ndarray], np.ndarray]


def corrected(
    log_density: LogDensity, mean: np.ndarray, root: np.ndarray, start: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mode and curvature of a Gaussian times a density, each of many.

    Where a log density curves upwards it counts as straight, so no variance comes out larger than it was.

    Parameters
    ----------
    log_density : callable
    mean, root : ndarray, shapes (*shape, numbers) and (*shape, numbers, numbers)
        Of the Gaussian; the lower Cholesky factor of its covariance.
    start : ndarray, shape (*shape, numbers), optional
        Where to begin; at the mean by default.

    Returns
    -------
    mode, cov : ndarray
        Shapes as those of ``mean`` and ``root``.
    log_integral : ndarray, shape (*shape,)
        Laplace's approximation of the log of the integral.
    """
    numbers = mean.shape[-1]

    def target(v: np.ndarray) -> np.ndarray:
        return log_density(mean + _applied(root, v))

    v = np.zeros_like(mean) if start is None else _solved(root, start - mean)
    reach = np.full(mean.shape[:-1], _REACH)
    offsets = _offsets(numbers)
    for turn in range(_TURNS):
        logs = target(v + offsets.reshape(len(offsets), *(1,) * (mean.ndim - 1), numbers))
        slope, bend = _derivatives(logs, numbers)
        precision = bend + np.eye(numbers)
        step = np.linalg.solve(precision, (slope - v)[..., None])[..., 0]
        length = np.sqrt(np.vecdot(step, _applied(precision, step)))
        level = logs[0] - 0.5 * np.vecdot(v, v)
        if not (length > _STILL).any() or turn == _TURNS - 1:
            break
        far = np.sqrt(np.vecdot(step, step))
        step *= np.minimum(1.0, reach / np.maximum(far, 1e-300))[..., None]
        v, whole = _ahead(target, v, step, level)
        reach = np.where(whole, reach / _CUT, reach)
    inverse = np.linalg.inv(precision)
    half = np.linalg.slogdet(precision)[1]
    spread = root @ inverse @ np.swapaxes(root, -1, -2)
    return mean + _applied(root, v), spread, level - 0.5 * half


# ---- private ------------------------------------------------------------------------------------


def _ahead(
    target: LogDensity, v: np.ndarray, step: np.ndarray, level: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where steps lead, each cut until it leads up, and which need not be; those that never do stay."""
    tried = np.stack([v + step / _CUT, v + step])
    found = target(tried) - 0.5 * np.vecdot(tried, tried)
    far = found[0] > np.maximum(found[1], level)
    best = np.where(far[..., None], tried[0], tried[1])
    up = far | (found[1] >= level)
    whole = up
    for k in range(1, _CUTS):
        if up.all():
            return best, whole
        new = v + _CUT**k * step
        higher = ~up & (target(new[None])[0] - 0.5 * np.vecdot(new, new) >= level)
        best = np.where(higher[..., None], new, best)
        up = up | higher
    return np.where(up[..., None], best, v), whole


def _offsets(numbers: int) -> np.ndarray:
    """Points of central differences: the middle, both sides of each number, corners of each pair."""
    unit = _STEP * np.eye(numbers)
    found = [np.zeros((1, numbers)), unit, -unit]
    for i, j in combinations(range(numbers), 2):
        found.append(np.array([unit[i] + unit[j], -unit[i] - unit[j]]))
        found.append(np.array([unit[i] - unit[j], unit[j] - unit[i]]))
    return np.concatenate(found)


def _derivatives(logs: np.ndarray, numbers: int) -> tuple[np.ndarray, np.ndarray]:
    """Slopes, and curvatures downwards; none where a log density is not finite nearby."""
    good = (np.abs(logs) < _LARGE).all(axis=0)
    logs = np.where(good, logs, 0.0)
    above, below = logs[1 : 1 + numbers], logs[1 + numbers : 1 + 2 * numbers]
    slope = np.moveaxis((above - below) / (2 * _STEP), 0, -1)
    bend = np.empty((*logs.shape[1:], numbers, numbers))
    for i in range(numbers):
        bend[..., i, i] = (2 * logs[0] - above[i] - below[i]) / _STEP**2
    corners = iter(logs[1 + 2 * numbers :].reshape(-1, 4, *logs.shape[1:]))
    for (i, j), c in zip(combinations(range(numbers), 2), corners, strict=True):
        bend[..., i, j] = bend[..., j, i] = (c[2] + c[3] - c[0] - c[1]) / (4 * _STEP**2)
    if numbers == 1:
        return slope, np.maximum(bend, 0.0)
    values, vectors = np.linalg.eigh(bend)
    return slope, (vectors * np.maximum(values, 0.0)[..., None, :]) @ np.swapaxes(vectors, -1, -2)


def _applied(a: np.ndarray, x: np.ndarray) -> np.ndarray:
    return a[..., 0] * x if a.shape[-1] == 1 else np.matvec(a, x)


def _solved(root: np.ndarray, x: np.ndarray) -> np.ndarray:
    return x / root[..., 0] if root.shape[-1] == 1 else np.linalg.solve(root, x[..., None])[..., 0]
