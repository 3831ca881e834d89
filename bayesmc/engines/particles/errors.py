"""Errors of means: by how far the families of a slice differ.

Each family's part of a weighted mean is nearly independent of the others', so the sum of their squares is its
variance (``genealogy`` says why), with a correction for what the mean owes to the family itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bayesmc.engines.particles.blocks import Block
from bayesmc.engines.particles.genealogy import OLD, YOUNG, Families, family_sums
from bayesmc.network import CompiledNode
from bayesmc.results.shares import is_share, steps

#: even families below which the young origin is asked, too, and those that say nothing; if the young one has
#: no more than these either, nobody knows
ENOUGH, LAST = 8.0, 3.5


def node_errors(block: Block, families: Sequence[Families], node: CompiledNode) -> np.ndarray:
    """Errors of a node's means, or of its states' probabilities where they have labels.

    Shape ``(slices, *plates, *event)``, or ``(slices, *plates, states)``.
    """
    labelled = node.domain is not None and node.domain.labels is not None
    more: tuple[int, ...] = (node.domain.size,) if labelled and node.domain is not None else ()
    if block.rows(node) is None:
        return np.zeros((len(block.slices), *node.value_shape, *more))
    off, shares, step = deviations(block, node)
    moments = None if node.domain is not None else block.moments(node)
    weighted = off * block.weights[:, :, None] if moments is None else moments.weighted
    found = _variances(block, families, weighted)
    if shares is not None:
        worth = block.flat([p.ess for p in block.slices])[..., None]
        found = np.maximum(found, step**2 * unseen(shares, worth))
    for k, own in enumerate(families):
        if own.scouts is None:
            continue
        if shares is not None:
            found[k] += (step * own.scouts.share) ** 2
        elif node.angles is None and node.name in own.scouts.values:
            there = own.scouts.values[node.name]
            assert moments is not None
            found[k, 0] += _left_out(
                own.scouts.share, there.reshape(len(there), -1), moments.mean[k, 0]
            )
    return block.unturned(np.sqrt(_lost(block, families, found)), node, more)


def deviations(block: Block, node: CompiledNode) -> tuple[np.ndarray, np.ndarray | None, float]:
    """By how much values lie off a mean; the shares that stand behind it, and what a state more or less is.

    Shapes ``(slices, elements, numbers, particles)`` and without the last axis; of labels, each state is a
    number. Without states there are no shares.
    """
    if node.domain is None:
        moments = block.moments(node)
        assert moments is not None
        return moments.off, None, 1.0
    codes, shares = block.rows(node), block.state_shares(node)
    assert codes is not None and shares is not None
    if node.domain.labels is None:
        numbers = np.asarray(node.domain.numbers, dtype=float)
        off = numbers[codes] - (shares @ numbers)[..., None]
        return off, shares.max(axis=-1), float(steps(node, None, False))
    hits = codes[:, :, :, None] == np.arange(node.domain.size)[:, None]
    off = hits - shares[..., None]
    lanes = off.shape[2] * off.shape[3]
    return off.reshape(*off.shape[:2], lanes, -1), shares.reshape(*shares.shape[:2], lanes), 1.0


def function_errors(
    block: Block,
    families: Sequence[Families],
    values: Sequence[np.ndarray],
    elsewhere: Sequence[np.ndarray | None],
) -> np.ndarray:
    """Errors of means of what a function says of each particle, shape ``(slices, *apart, *rest)``.

    Parameters
    ----------
    values : sequence of ndarray, shape (particles, *apart, *rest)
    elsewhere : sequence of ndarray or None
        The function at values of scouts, if it can be asked.
    """
    rows = block.turned(values)
    mean = block.weighted(rows)
    weighted = (rows - mean[..., None]) * block.weights[:, :, None]
    found = _variances(block, families, weighted)
    if is_share(values[0]):  # an event that no particle has seen may happen
        worth = block.flat([p.ess for p in block.slices])[..., None]
        found = np.maximum(found, unseen(mean, worth))
    for k, (own, there) in enumerate(zip(families, elsewhere, strict=True)):
        if own.scouts is not None:
            flat = None if there is None else there.reshape(len(there), -1)
            found[k, 0] += _left_out(own.scouts.share, flat, mean[k, 0])
    return np.sqrt(_lost(block, families, found)).reshape(len(values), *values[0].shape[1:])


def unseen(share: np.ndarray, ess: Any) -> np.ndarray:
    """Variance of a share that (nearly) no particle, or every one, has: Agresti and Coull (1998)."""
    centre = (share * ess + 2.0) / (ess + 4.0)
    rare = np.minimum(share, 1.0 - share) * ess < 1.0
    return np.where(rare, centre * (1.0 - centre) / (ess + 4.0), 0.0)


# ---- private ------------------------------------------------------------------------------------


def _variances(block: Block, families: Sequence[Families], weighted: np.ndarray) -> np.ndarray:
    """Variances ``(slices, elements, numbers)`` of means, by weights times what values lie off them."""
    rows, (numbers, n) = weighted.shape[0] * weighted.shape[1], weighted.shape[2:]
    bounds = np.array([f.bounds for f in families]).swapaxes(0, 1)  # origins first, then slices
    bounds = bounds.reshape(*bounds.shape[:3], -1).swapaxes(2, 3).reshape(2, rows, -1)
    weighted, weights = weighted.reshape(rows, numbers, n), block.weights.reshape(rows, 1, n)
    total = block.total.reshape(rows, 1, 1)
    found, even = _of_origin(weighted, weights, total, bounds[OLD])
    few = even < ENOUGH
    if few.any():
        at: Any = slice(None) if few.all() else few  # no copies of what is large
        young, _ = _of_origin(weighted[at], weights[at], total[at], bounds[YOUNG][at])
        found[at] = np.maximum(np.where(np.isinf(found[at]), 0.0, found[at]), young)
    return found.reshape(len(block.slices), -1, numbers)


def _of_origin(
    weighted: np.ndarray, weights: np.ndarray, total: np.ndarray, bounds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Variances by the families of one origin, and how many even ones these are worth, rows first."""
    shares = family_sums(weights, bounds) / total
    parts = family_sums(weighted, bounds) / total
    return _by_shares(parts, shares), 1.0 / np.vecdot(shares, shares)[:, 0]


def _by_shares(parts: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Variances by parts ``(rows, numbers, groups)`` of means, with what these owe to each family.

    They are as much larger as the square of Student's t is than that of a normal figure; infinite where too
    few families are left to say.
    """
    even = 1.0 / np.vecdot(shares, shares)
    free = np.maximum(even - 1.0, LAST - 1.0)
    found = (parts**2 / np.maximum(1.0 - shares, 1e-12)).sum(axis=-1) * (free / (free - 2.0))
    return np.where(even < LAST, np.inf, found)


def _lost(block: Block, families: Sequence[Families], found: np.ndarray) -> np.ndarray:
    """Infinite where a filter has lost sight."""
    for k, own in enumerate(families):
        if own.lost is not None:
            found[k, own.lost.where.reshape(-1)] = np.inf
    return found


def _left_out(share: float, values: np.ndarray | None, mean: np.ndarray) -> Any:
    """Square of what a mean owes to states that particles leave out."""
    if values is None:
        return 0.0 if share == 0.0 else np.full(np.shape(mean), np.inf)
    return (share * (values.mean(axis=0) - mean)) ** 2
