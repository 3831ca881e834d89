"""What weighted tables say together: quantiles of their mixture, covariances within them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from bayesmc.engines.marginal.tables.beliefs import Tables
from bayesmc.network import CompiledNode

#: by how much sums of probabilities may fall short of a level that they reach
_ROUNDING = 1e-12


def table_quantiles(
    tables: Tables, name: str, numbers: np.ndarray, weights: np.ndarray, levels: np.ndarray
) -> np.ndarray:
    """Quantiles of a node, shape ``(*levels.shape, *plates)``: the least number that reaches a level.

    Parameters
    ----------
    numbers : ndarray, shape (states,)
    weights : ndarray, shape (particles, *plates)
    """
    found = (tables.probabilities(name) * weights[..., None]).sum(axis=0)
    order = np.argsort(numbers)
    sums = found[..., order].cumsum(axis=-1)
    wanted = np.asarray(levels).reshape(np.shape(levels) + (1,) * sums.ndim)
    reached = sums / sums[..., -1:] >= wanted - _ROUNDING
    return numbers[order][reached.argmax(axis=-1)]


def table_covariance(
    tables: Tables,
    nodes: Sequence[CompiledNode],
    numbers: Mapping[str, np.ndarray],
    shares: np.ndarray,
) -> np.ndarray:
    """Mean of the particles' covariances of nodes one after the other; 0 for what has no table.

    Parameters
    ----------
    numbers : dict
        What the states of nodes with a table stand for.
    shares : ndarray, shape (particles,)
        Normalised weights.
    """
    counts = [math.prod(n.value_shape) for n in nodes]
    starts = np.cumsum([0, *counts])
    whole = np.zeros((starts[-1], starts[-1]))
    for group, log in zip(tables.groups, tables.logs, strict=True):
        own = [k for k, n in enumerate(nodes) if n.name in group.names]
        if not own:
            continue
        codes = np.unravel_index(np.arange(group.states), group.sizes)
        rows, places = [], []
        for k in own:
            node = nodes[k]
            axes = [j for j, (n, _) in enumerate(group.variables) if n == node.name]
            rows += [numbers[node.name][codes[j]] for j in axes]
            at = np.arange(counts[k]).reshape(node.value_shape)
            now = [*group.plates, *(p for p in node.plates if p not in group.plates)]
            order = [node.plates.index(p) for p in now]
            flat = at.transpose(order).reshape(group.elements, len(axes))
            places.append(starts[k] + flat)
        values, at = np.array(rows, dtype=float), np.concatenate(places, axis=1)
        tables_ = np.exp(log)
        mean = tables_ @ values.T
        second = np.einsum("p,pes->es", shares, tables_)
        for e in range(group.elements):
            inside = (values * second[e]) @ values.T
            inside -= np.einsum("p,pi,pj->ij", shares, mean[:, e], mean[:, e])
            whole[np.ix_(at[e], at[e])] += inside
    return whole
