"""Drawing states from many discrete distributions at once, by inversion.

Rows of weights are distributions; each draw names its row. Nothing here knows of cliques.
"""

from __future__ import annotations

import numpy as np

_FEW_COLUMNS = 16


def draw_columns(weights: np.ndarray, rows: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """For each draw a column of its row, with probability in proportion to the row's weights.

    Parameters
    ----------
    weights : ndarray, shape (r, c)
        Non-negative; the rows in use have a positive sum, which need not be 1.
    rows : ndarray of int, shape (draws,)
    rng : numpy.random.Generator

    Returns
    -------
    ndarray of intp, shape (draws,)
        Never a column of weight zero.

    Examples
    --------
    >>> weights = np.array([[0.0, 2.0, 0.0], [0.0, 0.0, 0.5]])
    >>> draw_columns(weights, np.array([0, 1, 0]), np.random.default_rng(0))
    array([1, 2, 1])
    """
    columns = weights.shape[1]
    uniform = rng.random(len(rows))
    if columns == 1 or not len(rows):
        return np.zeros(len(rows), dtype=np.intp)
    if len(weights) > len(rows):  # far more rows than draws: add up only those in use
        used, rows = np.unique(rows, return_inverse=True)
        weights = weights[used]
    bounds = np.cumsum(weights, axis=1)
    if len(weights) == 1:
        below = _strictly_below(uniform, bounds[0, -1])
        return np.searchsorted(bounds[0], below, side="right")
    below = _strictly_below(uniform, bounds[:, -1][rows])
    if columns <= _FEW_COLUMNS:
        picked = np.zeros(len(rows), dtype=np.intp)
        for column in range(columns - 1):
            picked += bounds[:, column][rows] <= below
        return picked
    return _bisect(bounds, rows, below)


def _strictly_below(uniform: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Where in the cumulated weights each draw falls; never at the total itself.

    So trailing columns of weight zero cannot be drawn by rounding.
    """
    return np.minimum(uniform * total, np.nextafter(total, 0.0))


def _bisect(bounds: np.ndarray, rows: np.ndarray, below: np.ndarray) -> np.ndarray:
    """How many bounds of its row are at most ``below``, for each draw: all rows in step."""
    last = bounds.shape[1] - 1
    picked = np.zeros(len(rows), dtype=np.intp)
    step = 1 << (last.bit_length() - 1)
    while step:
        reached = picked + step
        inside = reached <= last
        value = bounds[rows, np.minimum(reached, last) - 1]
        picked = np.where(inside & (value <= below), reached, picked)
        step >>= 1
    return picked
