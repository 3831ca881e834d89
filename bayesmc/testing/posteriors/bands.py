"""Are numbers between 0 and 1 uniform? By their empirical distribution function, with exact levels.

The function is compared with the diagonal at evenly spaced points; how far it may stray from it at all points
at once is found by a recursion over the points, not by a limit. It knows nothing of posteriors.

References
----------
Säilynoja, Bürkner and Vehtari (2022), Graphical test for discrete uniformity and its applications in
goodness-of-fit evaluation and multiple sample comparison, Statistics and Computing 32, sec. 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.special

#: p-values below this are reported as this
_SMALLEST = 1e-12
#: parts into which the interval is cut, at most
_PARTS = 100


@dataclass(frozen=True)
class Uniformity:
    """What `ecdf_uniformity` found.

    Attributes
    ----------
    p_value : float
        Of an empirical distribution function that strays at least as far, exact.
    point : float
        Where it strays farthest.
    share : float
        Share of the numbers up to there; it should be ``point``.
    """

    p_value: float
    point: float
    share: float

    @property
    def excess(self) -> float:
        """Share less what it should be."""
        return self.share - self.point


def ecdf_uniformity(values: Any) -> Uniformity:
    """Test that independent numbers are uniform between 0 and 1.

    At each of the points ``k / K``, with ``K`` the smaller of 100 and the number of values, the count of
    the values up to it is binomial, which gives a two-sided p-value there. The smallest of them is the
    statistic; its own law is exact, and so is the false-alarm rate (at most the level, and a little less,
    as counts are whole).

    Parameters
    ----------
    values : array_like
        Shape ``(n,)``, at least two.

    Returns
    -------
    Uniformity

    Raises
    ------
    ValueError
        Not one row of numbers between 0 and 1.

    References
    ----------
    Säilynoja, Bürkner and Vehtari (2022), sec. 2.2.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.testing.posteriors.bands import ecdf_uniformity
    >>> even = (np.arange(50) + 0.5) / 50
    >>> bool(ecdf_uniformity(even).p_value > 0.9), bool(ecdf_uniformity(even**2).p_value < 0.01)
    (True, True)
    """
    values = np.asarray(values, dtype=float)
    if values.ndim != 1 or len(values) < 2 or not ((values >= 0) & (values <= 1)).all():
        raise ValueError(
            f"ecdf_uniformity: values of shape {values.shape}; give one row of at least two numbers "
            "between 0 and 1"
        )
    points = ecdf_points(len(values))
    counts = np.searchsorted(np.sort(values), points, side="right")
    local = _local_p_values(len(values))[np.arange(len(points)), counts]
    at = int(np.argmin(local))
    share = float(counts[at] / len(values))
    return Uniformity(_chance_of(len(values), float(local[at])), float(points[at]), share)


def ecdf_points(count: int) -> np.ndarray:
    """Points at which the distribution functions of so many values are compared, shape ``(K - 1,)``."""
    parts = min(count, _PARTS)
    return np.arange(1, parts) / parts


@lru_cache(maxsize=64)
def ecdf_band(count: int, alpha: float) -> tuple[np.ndarray, np.ndarray]:
    """Shares between which all uniform values stay at all `ecdf_points`, but for a chance of ``alpha``.

    Parameters
    ----------
    count : int
        Number of values.
    alpha : float
        Chance of leaving the band anywhere, an upper bound.

    Returns
    -------
    low, high : ndarray, shape (K - 1,)
        The test of `ecdf_uniformity` rejects at level ``alpha`` exactly where the band is left.

    Examples
    --------
    >>> from bayesmc.testing.posteriors.bands import ecdf_band
    >>> low, high = ecdf_band(100, 0.05)
    >>> float(low[49]), float(high[49])
    (0.36, 0.64)
    """
    local = _local_p_values(count)
    levels = np.unique(local)
    # the chance grows with the level: the largest level that is still rare enough
    first, last = 0, len(levels) - 1
    while first < last:
        middle = (first + last + 1) // 2
        if _chance_of(count, float(levels[middle])) <= alpha:
            first = middle
        else:
            last = middle - 1
    rare = _chance_of(count, float(levels[first])) <= alpha
    inside = local > levels[first] if rare else np.ones(local.shape, dtype=bool)
    low = inside.argmax(axis=1) / count
    high = (count - inside[:, ::-1].argmax(axis=1)) / count
    low.flags.writeable = high.flags.writeable = False
    return low, high


# ---- private ------------------------------------------------------------------------------------


@lru_cache(maxsize=32)
def _local_p_values(count: int) -> np.ndarray:
    """Two-sided binomial p-value of every count at every point, shape ``(K - 1, count + 1)``."""
    below = np.arange(count + 1)
    points = ecdf_points(count)[:, None]
    up_to = scipy.special.bdtr(below, count, points)
    # P(at least k) = P(at most n - k of the others): no cancellation
    at_least = scipy.special.bdtr(count - below, count, 1.0 - points)
    local = np.minimum(1.0, 2.0 * np.minimum(up_to, at_least))
    # Counts that mirror each other are equally rare, up to rounding, which must not tell them apart.
    local = np.maximum(local, local[::-1, ::-1])
    local.flags.writeable = False
    return local


@lru_cache(maxsize=4096)
def _chance_of(count: int, level: float) -> float:
    """Chance that somewhere the local p-value of uniform values is at most ``level``.

    Given their sum, counts of uniform values in equal cells are those of a Poisson process. Its paths that
    have stayed inside are carried from point to point; what leaves at a point is counted there, times the
    chance to end at the right sum: a sum of positive terms, without cancellation.
    """
    local = _local_p_values(count)
    inside = local > level * (1.0 + 1e-9)
    points, rate = ecdf_points(count), count / (len(local) + 1)
    numbers = np.arange(count + 1)
    step = _poisson(numbers, rate)
    total = _poisson(np.array([count]), float(count))[0]
    paths, first, left = np.ones(1), 0, 0.0
    for k, point in enumerate(points):
        reached = np.convolve(paths, step)[: count + 1 - first]
        ends = _poisson(count - numbers[first:], count * (1.0 - point))
        stay = inside[k, first:]
        left += float((reached * ends)[~stay].sum())
        if not stay.any():
            break
        low, high = int(stay.argmax()), len(stay) - int(stay[::-1].argmax())
        paths, first = reached[low:high], first + low
    return float(min(max(left / total, _SMALLEST), 1.0))


def _poisson(numbers: np.ndarray, mean: float) -> np.ndarray:
    return np.exp(numbers * np.log(mean) - mean - scipy.special.gammaln(numbers + 1.0))
