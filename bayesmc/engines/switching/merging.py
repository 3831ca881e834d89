"""Mixtures of Gaussians merged into one each, with their roots side by side: arrays only.

Merging keeps weight, mean and covariance of a mixture, spread of the means included. A root of the covariance
is the members' roots and their distances from the mean, each by the root of its share, made triangular; no
covariance is formed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayesmc.categorical import log_sum_exp
from bayesmc.linalg.square_root import condition


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
    >>> total, share = shares(np.log([[0.1, 0.3], [0.0, 0.0]]))
    >>> np.exp(total).round(6).tolist(), share.round(6).tolist()
    ([0.4, 0.0], [[0.25, 0.75], [1.0, 0.0]])
    """
    total = log_sum_exp(np.moveaxis(log, 1, 0), axis=0)
    with np.errstate(invalid="ignore"):
        share = np.exp(log - total[:, None])
    none = total == -np.inf
    if none.any():
        share = np.where(none[:, None], 0.0, share)
        share[:, 0] = np.where(none, 1.0, share[:, 0])
    return total, share


def merged(log: np.ndarray, mean: np.ndarray, factor: np.ndarray) -> Mixture:
    """One Gaussian for every group.

    Parameters
    ----------
    log : ndarray, shape (groups, members, *lead)
    mean : ndarray, shape (groups, members, *lead, n)
    factor : ndarray, shape (groups, members, *lead, n, m)
        Any roots of the covariances.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.engines.switching.merging import merged
    >>> half = np.log([[0.5, 0.5]])
    >>> found = merged(half, np.array([[[-1.0], [1.0]]]), np.full((1, 2, 1, 1), 2.0))
    >>> found.mean.tolist(), (found.factor**2).round(6).tolist()  # 2^2 within, 1 between
    ([[0.0]], [[[5.0]]])
    """
    total, share = shares(log)
    if log.shape[1] == 1 and factor.shape[-1] == factor.shape[-2]:
        return Mixture(total, mean[:, 0], factor[:, 0])
    centre = (share[..., None] * mean).sum(axis=1)
    n, m, size = mean.shape[-1], factor.shape[-1], log.shape[1]
    root = np.sqrt(share)
    columns = np.empty((*centre.shape, size, m + 1))
    columns[..., :m] = np.moveaxis(root[..., None, None] * factor, 1, -2)
    columns[..., m] = np.moveaxis(root[..., None] * (mean - centre[:, None]), 1, -1)
    found = condition(columns.reshape(*centre.shape, size * (m + 1)), 0)
    return Mixture(total, centre, found.factor[..., :n])
