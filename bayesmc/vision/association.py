"""Which thing a detection is of: probabilities that leave every detection to one thing, and every thing one.

Things are filtered separately, each with particles of its own. That they exclude each other enters here: what
one claims is less free for the others.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.distributions.base import as_float
from bayesmc.errors import ParameterError, ShapeError

_TURNS, _SETTLED = 200, 1e-9


def claims(ratios: Any, missed: Any = 1.0) -> np.ndarray:
    """Probability that each detection is each thing's, by belief propagation.

    A thing has one detection at most and a detection is of one thing at most, or clutter. The messages
    of loopy belief propagation on this model always settle; the marginals are approximate, and exact
    where the detections near to a thing are near to no other.

    Parameters
    ----------
    ratios : array_like, shape (things, detections)
        Density of a detection if it is the thing's, the thing being there and detected, over that of clutter.
    missed : array_like, shape (things,)
        Weight of a thing without a detection, positive.

    Returns
    -------
    ndarray, shape (things, detections)

    Raises
    ------
    ShapeError, ParameterError
        No matrix, ratios that are negative or not finite, weights that are not positive.

    References
    ----------
    Williams and Lau (2014), Approximate evaluation of marginal association probabilities with belief
    propagation, IEEE Transactions on Aerospace and Electronic Systems 50, equations 10, 11 and 13.

    Examples
    --------
    >>> from bayesmc.vision import claims
    >>> claims([[8.0, 0.0], [8.0, 1.0]]).round(2).tolist()
    [[0.62, 0.0], [0.31, 0.35]]
    """
    ratios = as_float(ratios)
    if ratios.ndim != 2:
        raise ShapeError(f"claims: ratios have shape {ratios.shape}; give (things, detections)")
    missed = np.broadcast_to(as_float(missed), ratios.shape[:1])
    if not (np.isfinite(ratios).all() and (ratios >= 0).all() and (missed > 0).all()):
        raise ParameterError(
            "claims: ratios must be finite and not negative, and missed must be positive"
        )
    weights = ratios / missed[:, None]
    back = np.ones_like(weights)
    for _ in range(_TURNS):
        sent = weights * back
        forward = weights / (1 + sent.sum(axis=1, keepdims=True) - sent)
        new = 1 / (1 + forward.sum(axis=0, keepdims=True) - forward)
        done = np.abs(new - back).max(initial=0.0) < _SETTLED
        back = new
        if done:
            break
    sent = weights * back
    return sent / (1 + sent.sum(axis=1, keepdims=True))


def left_free(claimed: Any) -> np.ndarray:
    """Probability that each detection is no other thing's, shape (things, detections), from ``claims``.

    Examples
    --------
    >>> from bayesmc.vision import left_free
    >>> left_free([[0.75, 0.0], [0.25, 0.5]]).tolist()
    [[0.75, 0.5], [0.25, 1.0]]
    """
    claimed = as_float(claimed)
    return np.clip(1 - (claimed.sum(axis=0) - claimed), 0.0, 1.0)
