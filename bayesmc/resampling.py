"""Resampling: indices of draws in proportion to their weights."""

from __future__ import annotations

import numpy as np


def systematic(weights: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
    """Sorted indices, each chosen floor or ceil of ``draws * weight`` times in expectation its weight.

    Parameters
    ----------
    weights : ndarray, shape (n,)
        Nonnegative; normalised here, so a sum off by rounding is harmless.
    draws : int
        Number of indices.

    References
    ----------
    Carpenter, Clifford and Fearnhead (1999); Douc, Cappe and Moulines (2005), sec. 2.4.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.resampling import systematic
    >>> systematic(np.array([0.5, 0.25, 0.25]), 4, np.random.default_rng(0)).tolist()
    [0, 0, 1, 2]
    """
    cumulative = np.cumsum(weights)
    # ceil(draws * C_i - u) counts the points (u + k) / draws below C_i
    edges = np.ceil(draws * (cumulative / cumulative[-1]) - rng.random())
    edges[-1] = draws
    counts = np.diff(np.clip(edges, 0, draws).astype(np.intp), prepend=0)
    return np.repeat(np.arange(len(weights)), counts)
