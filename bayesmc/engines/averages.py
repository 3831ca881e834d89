"""Averages of users' functions over beliefs that are densities: one number by sums, several by point sets.

Sums over even points are as good as exact for smooth functions under smooth densities (the trapezoidal rule);
where a function jumps, as an event does, the place is found and what the sum gets wrong there is
put right. An event that no point saw, or every point, is looked for on finer points, and known no better than
what lies between two of those. Several numbers are averaged over point sets that have the mean and the
covariance of the normal law, so that quadratic functions are exact; shifted sets give the error. Beliefs and
nodes are not known here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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
#: parts that gaps between points are cut into where an event was seen at no point, or at all
_FINER = 4
#: even points for a normal number, and how far they reach in standard deviations
_POINTS, _REACH = 1024, 8.5
#: shifted sets for several numbers, points in each at least and at most, and in those of all beliefs;
#: dimensions up to which they are Kronecker's
_SETS, _FEW, _MANY, _ALL, _KRONECKER = 8, 512, 1 << 14, 1 << 22, 16


#: what functions raise that are written for single numbers
_OF_ONE_NUMBER = (TypeError, ValueError, AttributeError, IndexError)


@contextmanager
def naming(query: str) -> Iterator[None]:
    """Errors about what a function of ``queries=`` returns say which one it is."""
    try:
        yield
    except QueryError as error:
        error.args = (f"queries={{{query!r}: ...}}: {error}", *error.args[1:])
        raise


def called(function: Callable[..., Any], arguments: Sequence[Any]) -> Any:
    """What a user's function returns for arrays of values.

    Raises
    ------
    QueryError
        It fails, as one written for single numbers does.
    """
    try:
        return function(*arguments)
    except _OF_ONE_NUMBER as error:
        if type(error) not in _OF_ONE_NUMBER:  # an error of the user's own
            raise
        shapes = ", ".join(str(np.shape(a)) for a in arguments)
        raise QueryError(
            f"the function fails on arrays of shape {shapes} ({type(error).__name__}: {error}); it gets many "
            "values at once, so write it with NumPy (& for and, np.where for if, np.maximum for max)"
        ) from error


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
) -> tuple[np.ndarray, np.ndarray]:
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
    mean, error : ndarray, shape (beliefs, *shape)
        The error is zero, but for events (values 0 and 1) that were seen at no point or at every point: there
        it is the largest probability between neighbouring points.

    Notes
    -----
    The rule: Trefethen and Weideman (2014), The exponentially convergent trapezoidal rule, SIAM Review 56.
    """
    step = max(_HELD // len(points), 1)
    parts = []
    for low in range(0, beliefs, step):
        rows = np.arange(low, min(low + step, beliefs))
        own = masses[None] if masses.ndim == 1 else masses[rows]
        parts.append(_looked(evaluate, rows, points, own))
    means, errors = zip(*parts, strict=True)
    return np.concatenate(means), np.concatenate(errors)


def over_normal(evaluate: Evaluated, beliefs: int) -> tuple[np.ndarray, np.ndarray]:
    """Averages over one standard normal number and their errors; see ``over_line``."""
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
        The error is that of the mean over shifted point sets; of an event that was seen at no point, or at
        every point, the share that one point stands for.

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
        each, plain = [], []
        for points in sets:
            values = np.asarray(evaluate(at, np.tile(points, (count, 1))), dtype=float)
            values = values.reshape(count, size, *values.shape[1:])
            each.append(values.mean(axis=1))
            plain.append(_unseen(values))
        mean = np.mean(each, axis=0)
        # a mean of 0 or 1 in every set is that of an event, and no function that varies has it
        same = ((mean == 0) | (mean == 1)) & (np.ptp(each, axis=0) == 0)
        least = np.where(same & np.logical_and.reduce(plain), 1 / (size * _SETS), 0.0)
        means.append(mean)
        errors.append(np.maximum(np.std(each, axis=0, ddof=1) / np.sqrt(_SETS), least))
    return np.concatenate(means), np.concatenate(errors)


# ---- private ------------------------------------------------------------------------------------


def _looked(
    evaluate: Evaluated, rows: np.ndarray, points: np.ndarray, masses: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A few beliefs: sums, on finer points where an event was not seen, and their errors."""
    found, unseen = _summed(evaluate, rows, points, masses)
    error = np.zeros(found.shape)
    again = np.flatnonzero(unseen.reshape(len(rows), -1).any(axis=1))
    if not len(again) or len(points) < 2:
        return found, error
    part = np.arange(_FINER) / _FINER
    finer = np.append((points[:-1, None] + part * np.diff(points)[:, None]).ravel(), points[-1])
    own = np.moveaxis(masses if len(masses) == 1 else masses[again], 1, -1)
    between = own[..., :-1, None] + part * np.diff(own)[..., None]
    between = np.concatenate([between.reshape(*own.shape[:-1], -1), own[..., -1:]], axis=-1)
    total = between.sum(axis=-1, keepdims=True)
    share = np.divide(own.sum(axis=-1, keepdims=True), total, out=0 * total, where=total > 0)
    between = np.moveaxis(between * share, -1, 1)
    better, still = _summed(evaluate, rows[again], finer, between)
    largest = between.max(axis=1)
    largest = largest.reshape(largest.shape + (1,) * (found.ndim - largest.ndim))
    was = unseen[again]
    found[again] = np.where(was & ~still, better, found[again])
    error[again] = np.where(was & still, largest, 0.0)
    return found, error


def _unseen(values: np.ndarray) -> np.ndarray:
    """Where values ``(count, points, ...)`` are 0 at all points, or 1 at all."""
    return (values == 0).all(axis=1) | (values == 1).all(axis=1)


def _summed(
    evaluate: Evaluated, rows: np.ndarray, points: np.ndarray, masses: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A few beliefs: the sum, and what jumps make of it; and where values are those of an event unseen."""
    size, count = len(points), len(rows)
    raw = np.asarray(evaluate(np.repeat(rows, size), np.tile(points, count)))
    values = raw.astype(float).reshape(count, size, *raw.shape[1:])
    full = masses.reshape(masses.shape + (1,) * (values.ndim - masses.ndim))
    found = np.where(full > 0, full * values, 0.0).sum(axis=1)
    if size < 2 or not np.isfinite(values).all():
        return found, _unseen(values)
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
        _mend(evaluate, rows, points, wide, values, where, found)
    return found, _unseen(values)


def _mend(
    evaluate: Evaluated,
    rows: np.ndarray,
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
        here = np.asarray(evaluate(np.repeat(rows[row], len(inner)), tried.ravel())).astype(float)
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
