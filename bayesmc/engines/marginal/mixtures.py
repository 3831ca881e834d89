"""What weighted Gaussians say together: quantiles of their mixture, covariances within them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayesmc.distributions import Mixture, Normal
from bayesmc.engines.marginal.gaussians import Gaussians
from bayesmc.network import CompiledNode

#: standard deviation that stands for none, relative to the number
_POINT = 1e-13


def mixture_quantiles(
    inner: Gaussians, node: CompiledNode, weights: np.ndarray, levels: np.ndarray
) -> np.ndarray:
    """Quantiles of a node, shape ``(*levels.shape, *plates, *event)``.

    Parameters
    ----------
    weights : ndarray, shape (particles, *plates, *event)
    """
    mean, var = inner.mean_of(node), inner.variance_of(node)
    mean, var = np.broadcast_arrays(mean, var)
    scale = np.maximum(np.sqrt(var), _POINT * (np.abs(mean) + 1e-300))
    weights, mean, scale = (np.moveaxis(a, 0, -1) for a in (weights, mean, scale))
    mixture = Mixture(weights / weights.sum(axis=-1, keepdims=True), Normal(mean, scale))
    found = np.stack([mixture.ppf(level) for level in levels.reshape(-1)])
    return found.reshape(*levels.shape, *found.shape[1:])


def covariance_within(inner: Gaussians, sizes: Mapping[str, int], shares: np.ndarray) -> np.ndarray:
    """Mean of the particles' covariances of nodes one after the other; 0 for what they know.

    Parameters
    ----------
    sizes : dict
        Node -> how many numbers it has.
    shares : ndarray, shape (particles,)
        Normalised weights.
    """
    m = inner.factors.shape[-1]
    parts = [
        inner.factors[:, inner.layout.rows[name]]
        if name in inner.layout.rows
        else np.zeros((len(inner.factors), size, m))
        for name, size in sizes.items()
    ]
    rows = np.concatenate(parts, axis=1)
    if inner.which is not None:
        shares = np.bincount(inner.which, shares, len(rows))
    columns = (rows * np.sqrt(shares)[:, None, None]).transpose(1, 0, 2).reshape(rows.shape[1], -1)
    return columns @ columns.T
