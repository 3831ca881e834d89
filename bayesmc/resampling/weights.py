"""Weights made ready for resampling: checked, scaled to expected numbers of offspring, judged.

Checks cost one look at the smallest weight and one at the sum. Sums that overflow, or are so small that
dividing by them would, are taken again of weights divided by the largest.
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np

# between these a sum, its square and its reciprocal are exact to rounding
_SMALL, _LARGE = 1e-120, 1e120


def ess(weights: np.ndarray) -> Any:
    """Effective number of equally weighted particles, ``(sum w)**2 / sum w**2``.

    Parameters
    ----------
    weights : array_like, shape (n, *batch)
        Nonnegative, on any scale. ``bayesmc.diagnostics.weight_ess`` takes log weights.

    Returns
    -------
    float or ndarray, shape batch
        Between 1 and n.

    Raises
    ------
    ValueError
        If a weight is negative, infinite or NaN, or all are zero.

    References
    ----------
    Kong, Liu and Wong (1994), JASA 89(425).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.resampling import ess
    >>> ess(np.array([1.0, 1.0, 0.0, 0.0]))
    2.0
    >>> ess(np.array([[1.0, 1.0], [1.0, 0.0], [1.0, 0.0]])).round(6).tolist()
    [3.0, 1.0]
    """
    weights = _checked(weights)
    total = np.add.reduce(weights, axis=0)
    if not _is_moderate(total):
        weights = _rescaled(weights)
        total = np.add.reduce(weights, axis=0)
    # not a BLAS product, whose threads cost far more than they save
    squares = np.einsum("i...,i...->...", weights, weights)
    return total * total / squares if weights.ndim > 1 else float(total * total / squares)


def count_of(draws: int) -> int:
    """``draws`` as a plain integer; an error says so where it is none, or negative."""
    try:
        count = operator.index(draws)
    except TypeError:
        count = -1
    if count < 0:
        raise ValueError(f"resampling: draws={draws!r}; give a whole number, 0 or more")
    return count


def expected_offspring(weights: np.ndarray, draws: int) -> np.ndarray:
    """``draws * weights / sum``, a new array of shape (n, *batch)."""
    weights = _checked(weights)
    total = np.add.reduce(weights, axis=0)
    if not _is_moderate(total):
        weights = _rescaled(weights)
        total = np.add.reduce(weights, axis=0)
    return weights * (draws / total)


def cumulative_offspring(weights: np.ndarray, draws: int) -> np.ndarray:
    """Running sums of ``expected_offspring`` along axis 0; the last is ``draws`` up to rounding.

    A weight of zero repeats the entry before it exactly.
    """
    weights = _checked(weights)
    running = np.add.accumulate(weights, axis=0)
    if not _is_moderate(running[-1]):
        running = np.add.accumulate(_rescaled(weights), axis=0)
    running *= draws / running[-1]
    return running


def _checked(weights: np.ndarray) -> np.ndarray:
    """As floats, with nothing negative; what is infinite or NaN shows in the sum."""
    weights = np.asarray(weights, dtype=float)
    if weights.ndim == 0 or len(weights) == 0:
        raise ValueError(
            f"resampling: weights of shape {weights.shape}; give at least one, particles on axis 0"
        )
    if (
        weights.size and weights.item(weights.argmin()) < 0
    ):  # faster than a reduction, for few weights
        where = np.argwhere(weights < 0)[0].tolist()
        raise ValueError(
            f"resampling: the weight at {where} is negative ({weights[tuple(where)]}); "
            "weights are exp(log_weights), not log weights"
        )
    return weights


def _is_moderate(total: Any) -> bool:
    if isinstance(total, float):  # a NumPy scalar is one; its array operations cost a microsecond
        return _SMALL < total < _LARGE
    return bool(((total > _SMALL) & (total < _LARGE)).all())


def _rescaled(weights: np.ndarray) -> np.ndarray:
    """Weights divided by the largest of their batch element, or the error that there is none."""
    top = weights.max(axis=0)
    good = (top > 0) & (top < np.inf)
    if np.all(good):
        return weights / top
    where = tuple(np.argwhere(~good)[0].tolist())
    place = f" in batch element {where}" if where else ""
    fault = "all weights are zero" if top[where] == 0 else f"a weight is {top[where]}"
    raise ValueError(
        f"resampling: {fault}{place}; weights must be finite with a positive sum "
        "(from log weights, subtract their maximum before exp)"
    )
