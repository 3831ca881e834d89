"""What weighted Gaussians say together: quantiles of their mixture, covariances within them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bayesmc.distributions import Mixture, Normal
from bayesmc.engines.marginal.elements.beliefs import ElementBeliefs
from bayesmc.engines.marginal.gaussians import Gaussians
from bayesmc.network import CompiledNode

#: standard deviation that stands for none, relative to the number
_POINT = 1e-13


def mixture_quantiles(
    inner: Gaussians | ElementBeliefs, node: CompiledNode, weights: np.ndarray, levels: np.ndarray
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
    return found.reshape((*levels.shape, *found.shape[1:]))


def covariance_within(
    inner: Gaussians | ElementBeliefs, nodes: Sequence[CompiledNode], shares: np.ndarray
) -> np.ndarray:
    """Mean of the particles' covariances of nodes one after the other; 0 for what they know.

    ``shares`` are normalised weights, shape ``(particles,)``.
    """
    if isinstance(inner, ElementBeliefs):
        return inner.covariance(nodes, shares)
    layout = inner.layout
    elements = math.prod(layout.lead)
    rows = inner.factors.reshape(-1, elements, *inner.factors.shape[-2:])
    if inner.which is not None:
        shares = np.bincount(inner.which, shares, len(rows))
    parts: list[np.ndarray] = []
    at: list[np.ndarray] = []
    low = 0
    for node in nodes:
        size = math.prod(node.value_shape)
        if inner.has(node.name):
            own = rows[:, :, layout.rows[node.name]].transpose(2, 1, 3, 0)
            places = layout.packed(node, np.arange(size).reshape(node.value_shape))
            parts.append(own)
            at.append(low + places.reshape(elements, -1).T)
        low += size
    whole = np.zeros((low, low))
    if not parts:
        return whole
    columns = np.concatenate(parts) * np.sqrt(shares)
    places = np.concatenate(at)
    for e in range(elements):
        own = columns[:, e].reshape(len(columns), -1)
        whole[np.ix_(places[:, e], places[:, e])] = own @ own.T
    return whole
