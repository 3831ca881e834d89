"""Draws of a prior moved towards its middle: where vague priors still make sense.

A vague prior puts most of its draws where functions over- or underflow. Functions are tried, and chains are
started, nearer and nearer to its mean or median.
"""

from __future__ import annotations

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.support import is_half_line
from bayesmc.errors import UnsupportedError
from bayesmc.shapes import Shape

#: the most that draws of a half line go from the middle
_FROM_ZERO = 0.9
#: supports that hold every point between two of theirs
_CONVEX = ("real", "interval", "simplex", "real vector", "positive definite", "product")


def nearer(
    dist: Distribution, draws: np.ndarray, spread: float, shape: Shape, event_ndim: int
) -> np.ndarray:
    """Draws moved towards the middle of a distribution, where the support holds what lies between.

    Parameters
    ----------
    draws : ndarray, shape ``shape``
    spread : float
        How much of their distance to the middle is left, 0 to 1.
    event_ndim : int
        Number of the last axes that are one value's.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network.nearer import nearer
    >>> nearer(bmc.Normal(1.0, 100.0), np.array([-99.0, 201.0]), 0.01, (2,), 0).tolist()
    [0.0, 3.0]
    """
    if dist.support.kind not in _CONVEX:
        return draws
    half_line = dist.support.kind == "interval" and is_half_line(dist.support)
    if half_line:  # a vague scale is drawn at 1e-200 as likely as not, and a chain never comes back
        spread = min(spread, _FROM_ZERO)
    if spread == 1.0:
        return draws
    middle = _middle(dist, shape, half_line)
    axes = tuple(range(len(shape) - event_ndim, len(shape)))
    fine = np.isfinite(middle).all(axis=axes, keepdims=True)
    moved = middle + max(spread, 1e-9) * (np.where(np.isfinite(draws), draws, middle) - middle)
    return np.where(fine, moved, draws)


# ---- private ------------------------------------------------------------------------------------


def _middle(dist: Distribution, shape: Shape, half_line: bool) -> np.ndarray:
    """The prior mean, else the median, else one above a half line's end; NaN where nothing is known."""
    found = np.full(shape, dist.support.low + 1.0 if half_line else np.nan)
    for question in (lambda: dist.ppf(0.5), lambda: dist.mean):
        try:
            answer = np.broadcast_to(question(), shape)
        except (UnsupportedError, ValueError):
            continue
        sane = np.isfinite(answer)
        if half_line:
            sane &= (answer < 1e10) & (answer > 1e-10)
        found = np.where(sane, answer, found)
    return found
