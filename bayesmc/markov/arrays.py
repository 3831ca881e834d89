"""Arrays of a Markov chain: elimination, paths, powers. States are positions; nothing is checked."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bayesmc.errors import ParameterError


def total_variation(p: Any, q: Any) -> np.ndarray:
    """Total variation distance of laws along the last axis, between 0 and 1.

    Half the sum of ``|p - q|``: the most by which the probability of any event differs (Levin et al.,
    proposition 4.2).

    Examples
    --------
    >>> from bayesmc.markov import total_variation
    >>> float(total_variation([0.5, 0.5], [0.75, 0.25]))
    0.25
    """
    return 0.5 * np.abs(np.asarray(p, dtype=float) - np.asarray(q, dtype=float)).sum(axis=-1)


def stationary_law(matrix: np.ndarray) -> np.ndarray:
    """Stationary law of an irreducible chain; only what is off the diagonal is read."""
    a = np.array(matrix)
    for n in range(len(a) - 1, 0, -1):
        leaving = _positive(a[n, :n].sum())
        a[:n, n] /= leaving
        a[:n, :n] += np.outer(a[:n, n], a[n, :n])
    law = np.ones(len(a))
    for n in range(1, len(a)):
        law[n] = law[:n] @ a[:n, n]
        law[: n + 1] /= law[: n + 1].max()  # a rare first state would let the others overflow
    return law / law.sum()


def absorption_times(inner: np.ndarray, out: np.ndarray) -> np.ndarray:
    """Expected steps before leaving by ``out``, from states that move among each other by ``inner``."""
    a, out, cost, leaving = np.array(inner), np.array(out), np.ones(len(out)), np.ones(len(out))
    for n in range(len(a) - 1, -1, -1):
        leaving[n] = _positive(a[n, :n].sum() + out[n])  # 1 - a[n, n], without the subtraction
        share = a[:n, n] / leaving[n]
        a[:n, :n] += np.outer(share, a[n, :n])
        out[:n] += share * out[n]
        cost[:n] += share * cost[n]
    times = np.zeros(len(a))
    for n in range(len(a)):
        times[n] = (cost[n] + a[n, :n] @ times[:n]) / leaving[n]
    return times


def period(possible: np.ndarray) -> int:
    """Greatest common divisor of all cycles, from distances to the first state."""
    level = np.full(len(possible), -1)
    level[0] = 0
    front = level == 0
    while front.any():
        here = level[front][0]
        front = possible[front].any(axis=0) & (level < 0)
        level[front] = here + 1
    i, j = np.nonzero(possible)
    return int(np.gcd.reduce(level[i] + 1 - level[j])) if len(i) else 0


def reaching(possible: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """The states with a path into ``goal``, those of it included."""
    reached, front = goal.copy(), goal
    while front.any():
        front = possible[:, front].any(axis=1) & ~reached
        reached |= front
    return reached


def squared(power: np.ndarray) -> np.ndarray:
    """The matrix of twice as many steps."""
    return rows_normalised(power @ power)


def rows_normalised(power: np.ndarray) -> np.ndarray:
    """Rows that sum to 1: their rounding errors would double with every squaring."""
    return power / power.sum(axis=1, keepdims=True)


def cumulative(row: np.ndarray) -> list[float]:
    """Cumulative probabilities for ``bisect_right``, which skips states of probability zero."""
    sums = np.cumsum(row)
    sums[np.flatnonzero(row)[-1] :] = math.inf  # whatever rounding did to the last one
    return sums.tolist()


def _positive(leaving: float) -> float:
    if not leaving > 0:
        raise ParameterError(
            "MarkovChain: products of its smallest probabilities underflow to zero, so that states "
            "seem cut off; set probabilities that do not matter to 0"
        )
    return float(leaving)
