"""Ranks of draws: what is judged by them is judged alike whatever scale it is told on."""

from __future__ import annotations

import numpy as np
import scipy.special


def normal_scores(values: np.ndarray) -> np.ndarray:
    """Values as quantiles of a standard Normal by their ranks, those of equal ones averaged.

    Parameters
    ----------
    values : ndarray, shape (scalar, ...)
        Ranked within each scalar.

    References
    ----------
    Blom (1958), Statistical Estimates and Transformed Beta-Variables; Vehtari et al. (2021), eq. 14.

    Examples
    --------
    >>> import numpy as np
    >>> normal_scores(np.array([[3.0, 1.0, 2.0]])).round(2).tolist()
    [[0.87, -0.87, 0.0]]
    """
    flat = values.reshape(len(values), -1)
    order = np.argsort(flat, axis=1)
    sorted_ = np.take_along_axis(flat, order, axis=1)
    size = flat.shape[1]
    new = np.ones(flat.shape, dtype=bool)
    np.not_equal(sorted_[:, 1:], sorted_[:, :-1], out=new[:, 1:])
    # quantiles of the ranks 1, 1.5, 2, ...: each is worked out once
    ranks = np.arange(1.0, size + 0.5, 1.0 if new.all() else 0.5)
    quantiles = scipy.special.ndtri((ranks - 0.375) / (size + 0.25))
    scores = np.empty(flat.shape)
    if new.all():
        np.put_along_axis(scores, order, quantiles[None], axis=1)
        return scores.reshape(values.shape)
    at = np.arange(size)
    first = np.maximum.accumulate(np.where(new, at, 0), axis=1)
    ends = np.ones(flat.shape, dtype=bool)
    ends[:, :-1] = new[:, 1:]
    last = np.minimum.accumulate(np.where(ends, at, size)[:, ::-1], axis=1)[:, ::-1]
    np.put_along_axis(scores, order, quantiles[first + last], axis=1)
    return scores.reshape(values.shape)
