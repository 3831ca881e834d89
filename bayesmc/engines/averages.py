"""Averages of users' functions over beliefs that are densities: one number by sums, several by point sets.

Sums over even points are as good as exact for smooth functions under smooth densities (the trapezoidal rule);
where a function jumps, as an event does, the place is found and what the sum gets wrong there is
put right. Several numbers are averaged over point sets that have the mean and the covariance of the normal
law, so that quadratic functions are exact; shifted sets give the error. Beliefs and nodes are not known here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.special import ndtri

from bayesmc.errors import QueryError

#: what a function returns at points ``(count, [dimension])`` of beliefs ``(count,)``
Evaluated = Callable[[np.ndarray, np.ndarray], np.ndarray]

#: values of a function that are held at once
_HELD = 1 << 20
#: a difference between neighbours that is so many times those beside it is a jump
_JUMP = 8.0
#: jumps that are looked for at most; parts that their surroundings are cut into, so many times over
_JUMPS, _PARTS, _ROUNDS = 1 << 18, 64, 3
#: even points for a normal number, and how far they reach in standard deviations
_POINTS, _REACH = 1024, 8.5
#: shifted sets for several numbers, points in each at least and at most, and in those of all beliefs;
#: dimensions up to which they are Kronecker's
_SETS, _FEW, _MANY, _ALL, _KRONECKER = 8, 512, 1 << 14, 1 << 22, 16


def as_event(values: Any) -> np.ndarray:
    """Values of an event.

    Raises
    ------
    QueryError
        They are no booleans.
    """
    found = np.asarray(values)
    if found.dtype.kind != "b":
        raise QueryError(
            f"probability: the function returns {found.dtype} values, not booleans; use expectation"
        )
    return found


def over_line(
    evaluate: Evaluated, beliefs: int, points: np.ndarray, masses: np.ndarray
) -> np.ndarray:
    """Averages over one number, whose density is given at even points.

    Parameters
    ----------
    evaluate : callable
        Values ``(count, *shape)`` at points ``(count,)`` of beliefs ``(count,)``.
    beliefs : int
    points : ndarray, shape (J,)
    masses : ndarray, shape (J,) or (beliefs, J, *lead)
        What the points stand for; ``lead`` are the first axes of ``shape``.

    Returns
    -------
    ndarray, shape (beliefs, *shape)

    Notes
    -----
    The rule: Trefethen and Weideman (2014), The exponentially convergent trapezoidal rule, SIAM Review 56.
    """
    step = max(_HELD // len(points), 1)
    parts = []
    for low in range(0, beliefs, step):
        count = min(step, beliefs - low)
        own = masses if masses.ndim == 1 else masses[low : low + count]
        parts.append(_summed(evaluate, low, count, points, own))
    return np.concatenate(parts)


def over_normal(evaluate: Evaluated, beliefs: int) -> np.ndarray:
    """Averages over one standard normal number, shape ``(beliefs, *shape)``; see ``over_line``."""
    points = np.linspace(-_REACH, _REACH, _POINTS)
    masses = np.exp(-0.5 * points**2)
    return over_line(evaluate, beliefs, points, masses / masses.sum())


def over_normals(
    evaluate: Evaluated, beliefs: int, dimension: int
) -> tuple[np.ndarray, np.ndarray]:
    """Averages over several independent standard normal numbers, with their standard errors.

    Parameters
    ----------
    evaluate : callable
        Values ``(count, *shape)`` at points ``(count, dimension)`` of beliefs ``(count,)``.

    Returns
    -------
    mean, error : ndarray, shape (beliefs, *shape)
        The error is that of the mean over shifted point sets.

    Notes
    -----
    Point sets: Kronecker sequences with random shifts (Owen 2013, Monte Carlo theory, methods and examples,
    ch. 15 and 17), made symmetric and standardised, which makes cubic functions exact.
    """
    size = int(np.clip(_ALL // (_SETS * beliefs), _FEW, _MANY)) // 2 * 2
    sets = [_point_set(dimension, size, k) for k in range(_SETS)]
    step = max(_HELD // (size * dimension), 1)
    means, errors = [], []
    for low in range(0, beliefs, step):
        at = np.repeat(np.arange(low, min(low + step, beliefs)), size)
        count = len(at) // size
        each = []
        for points in sets:
            values = np.asarray(evaluate(at, np.tile(points, (count, 1))), dtype=float)
            each.append(values.reshape(count, size, *values.shape[1:]).mean(axis=1))
        means.append(np.mean(each, axis=0))
        errors.append(np.std(each, axis=0, ddof=1) / np.sqrt(_SETS))
    return np.concatenate(means), np.concatenate(errors)


# ---- private ------------------------------------------------------------------------------------


def _summed(
    evaluate: Evaluated, low: int, count: int, points: np.ndarray, masses: np.ndarray
) -> np.ndarray:
    """A few beliefs: the sum, and what jumps make of it."""
    size = len(points)
    at = np.repeat(np.arange(low, low + count), size)
    raw = np.asarray(evaluate(at, np.tile(points, count)))
    values = raw.astype(float).reshape(count, size, *raw.shape[1:])
    full = masses.reshape((1, size) if masses.ndim == 1 else masses.shape)
    full = full.reshape(full.shape + (1,) * (values.ndim - full.ndim))
    found = np.where(full > 0, full * values, 0.0).sum(axis=1)
    if size < 2 or not np.isfinite(values).all():
        return found
    gaps = np.abs(np.diff(values, axis=1))
    jumps = gaps > 0
    if raw.dtype.kind != "b":
        beside = np.pad(gaps, [(0, 0), (1, 1), *[(0, 0)] * (values.ndim - 2)])
        most = np.maximum(beside[:, :-2], beside[:, 2:])
        jumps = gaps > _JUMP * most + 1e-9 * np.abs(values).max(initial=0.0)
    wide = np.broadcast_to(full, values.shape)
    jumps &= wide[:, :-1] + wide[:, 1:] > 1e-14
    where = np.nonzero(jumps)
    if 0 < len(where[0]) <= _JUMPS:
        _mend(evaluate, low, points, wide, values, where, found)
    return found


def _mend(
    evaluate: Evaluated,
    low: int,
    points: np.ndarray,
    masses: np.ndarray,
    values: np.ndarray,
    where: tuple[np.ndarray, ...],
    found: np.ndarray,
) -> None:
    """Give what lies between two points to the side of the jump that it is on."""
    row, j, *rest = where
    one, other = values[(row, j, *rest)], values[(row, j + 1, *rest)]
    left, width = points[j].astype(float), points[j + 1] - points[j]
    count, inner = np.arange(len(row)), np.arange(1, _PARTS) / _PARTS
    for _ in range(_ROUNDS):
        tried = left[:, None] + inner * width[:, None]
        here = np.asarray(evaluate(np.repeat(row + low, len(inner)), tried.ravel())).astype(float)
        here = here.reshape(*tried.shape, *here.shape[1:])
        here = here[(count[:, None], np.arange(len(inner)), *(r[:, None] for r in rest))]
        far = np.abs(here - one[:, None]) > np.abs(here - other[:, None])
        passed = np.where(far.any(axis=1), far.argmax(axis=1), len(inner))
        left, width = left + passed * width / _PARTS, width / _PARTS
    step = points[j + 1] - points[j]
    border, jump = 0.5 * (points[j] + points[j + 1]), left + 0.5 * width
    share = (0.5 * (border + jump) - points[j]) / step
    first, second = masses[(row, j, *rest)], masses[(row, j + 1, *rest)]
    between = (jump - border) / step * (first + share * (second - first))
    np.add.at(found, (row, *rest), (one - other) * between)


def _point_set(dimension: int, size: int, number: int) -> np.ndarray:
    """Points of mean zero and covariance one, shape (size, dimension)."""
    rng = np.random.default_rng([20, number])
    half = size // 2
    if dimension > _KRONECKER:
        points = rng.normal(size=(half, dimension))
    else:
        ratio = 2.0
        for _ in range(60):  # the root of r^(d + 1) = r + 1
            ratio = (1 + ratio) ** (1 / (dimension + 1))
        slopes = ratio ** -np.arange(1.0, dimension + 1)
        shift = rng.random(dimension)
        uniform = np.remainder(shift + np.arange(1, half + 1)[:, None] * slopes, 1.0)
        points = ndtri(np.clip(uniform, 1e-12, 1 - 1e-12))
    points = np.concatenate([points, -points])
    if 4 * dimension > half:
        return points
    root = np.linalg.cholesky(points.T @ points / size)
    return np.linalg.solve(root, points.T).T
