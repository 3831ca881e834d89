"""Mixtures of Gaussians merged into one each, with their roots side by side: arrays only.

Merging keeps weight, mean and covariance of a mixture, spread of the means included. A root of the covariance
is the members' roots and their distances from the mean, each by the root of its share, made triangular; no
covariance is formed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayesmc.linalg.square_root import condition_many
from bayesmc.lowering import GaussianLoops

#: share of a mean that rounding leaves where Gaussians of the same mean are merged
_ROUNDED = 8 * float(np.finfo(float).eps)


class Mixture(NamedTuple):
    """Gaussians with weights, along the first axis.

    Attributes
    ----------
    log : ndarray, shape (size, *lead)
        Logs of the weights.
    mean : ndarray, shape (size, *lead, n)
    factor : ndarray, shape (size, *lead, n, n)
        Roots of the covariances.
    """

    log: np.ndarray
    mean: np.ndarray
    factor: np.ndarray

    def first(self, count: int) -> Mixture:
        """Of the first so many numbers, whose roots have no columns behind them."""
        return Mixture(self.log, self.mean[..., :count], self.factor[..., :count, :count])


def shares(log: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums of weights over the second axis, in logs, and members' shares of them.

    Where all weights are zero, the first member stands for all.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.engines.switching.merging import shares
    >>> total, share = shares(np.array([[np.log(0.1), np.log(0.3)], [-np.inf, -np.inf]]))
    >>> np.exp(total).round(6).tolist(), share.round(6).tolist()
    ([0.4, 0.0], [[0.25, 0.75], [1.0, 0.0]])
    """
    top = np.maximum.reduce(log, axis=1)
    none = None
    if np.minimum.reduce(top, axis=None) == -np.inf:
        none = top == -np.inf
        top = np.where(none, 0.0, top)
    parts = np.exp(log - top[:, None])
    total = np.add.reduce(parts, axis=1)
    if none is None:
        return np.log(total) + top, parts / total[:, None]
    parts[:, 0] += none
    with np.errstate(divide="ignore"):
        return np.where(none, -np.inf, np.log(total) + top), parts / np.where(none, 1.0, total)[
            :, None
        ]


def without_rounding(found: Mixture) -> Mixture:
    """Deviations that are only what rounding leaves of equal means are none."""
    size = np.sqrt(np.vecdot(found.factor, found.factor))
    short = size <= _ROUNDED * np.abs(found.mean)
    if not short.any():
        return found
    return found._replace(factor=np.where(short[..., None], 0.0, found.factor))


def merged(
    log: np.ndarray, mean: np.ndarray, factor: np.ndarray, loops: GaussianLoops | None = None
) -> Mixture:
    """One Gaussian for every group.

    Parameters
    ----------
    log : ndarray, shape (groups, members, *lead)
    mean : ndarray, shape (groups, members, *lead, n)
    factor : ndarray, shape (groups, members, *lead, n, m)
        Any roots of the covariances.
    loops : GaussianLoops, optional
        Machine code, for what has no further axes.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.engines.switching.merging import merged
    >>> half = np.log([[0.5, 0.5]])
    >>> found = merged(half, np.array([[[-1.0], [1.0]]]), np.full((1, 2, 1, 1), 2.0))
    >>> found.mean.tolist(), (found.factor**2).round(6).tolist()  # 2^2 within, 1 between
    ([[0.0]], [[[5.0]]])
    """
    n, m, size, ndim = mean.shape[-1], factor.shape[-1], log.shape[1], mean.ndim
    if size == 1 and m == n:
        return Mixture(log[:, 0], mean[:, 0], factor[:, 0])
    if loops is not None and ndim == 3:
        found = loops.merged(*map(np.ascontiguousarray, (log, mean, factor)))
        if found is not None:
            return Mixture(*found)
    total, share = shares(log)
    centre = np.add.reduce(share[..., None] * mean, axis=1)
    root = np.sqrt(share)[..., None]
    columns = np.empty((*centre.shape, size, m + 1))
    behind = (0, *range(2, ndim), 1)  # members stand beside each other
    columns[..., :m] = (root[..., None] * factor).transpose(*behind, ndim)
    columns[..., m] = (root * (mean - centre[:, None])).transpose(behind)
    made = condition_many(columns.reshape(*centre.shape, size * (m + 1)), 0)
    return Mixture(total, centre, made.factor[..., :n])
