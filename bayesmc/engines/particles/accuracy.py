"""Errors of means: by how far the families of a slice differ.

Each family's part of a weighted mean is nearly independent of the others', so the sum of their squares is its
variance (``families`` says why), with a correction for what the mean owes to the family itself. Small clouds
are taken many slices at a time, since what costs there is calling NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.engines.particles.cloud import Cloud, Layout
from bayesmc.engines.particles.families import OLD, YOUNG, Families, group_sums, row_sums
from bayesmc.network import CompiledNode

#: numbers of a node that are taken together: larger arrays cost the machine a page at a time
BATCH = 14_000
#: particles above which families are taken one by one, without a copy
MANY = 30_000
#: even families below which the young origin is asked, too
ENOUGH = 8.0


class MeanErrors:
    """Errors of the means of nodes, written as the slices pass; read them by ``found``.

    Parameters
    ----------
    layout : Layout
    nodes : sequence of CompiledNode
    steps : int
    means, variances, tables : dict
        What the clouds say, time first; entries must be there when their slice is added.
    together : bool
        Whether clouds stay as they are, so that many can be taken at a time.
    """

    def __init__(
        self,
        layout: Layout,
        nodes: Sequence[CompiledNode],
        steps: int,
        answers: tuple[Mapping[str, np.ndarray], ...],
        together: bool,
    ) -> None:
        self.layout, self.nodes, self.answers = layout, nodes, answers
        most = max((int(np.prod(n.value_shape)) for n in nodes), default=1)
        few = together and not layout.apart
        self._batch = BATCH // (layout.particles * max(most, 1)) if few else 1
        self._waiting: list[tuple[int, Cloud, np.ndarray]] = []
        self._found = {n.name: np.zeros((steps, *_shape(n))) for n in nodes}

    def add(self, k: int, cloud: Cloud, families: Families) -> None:
        """Take in the cloud of the k-th slice."""
        waiting = self._waiting
        if waiting and len(waiting[0][1].weights) != len(cloud.weights):
            self._settle()
        self._waiting.append((k, cloud, families.bounds))
        if len(self._waiting) >= self._batch:
            self._settle()

    def found(self) -> dict[str, np.ndarray]:
        """Errors by node, time first, shape of the mean; of each state's probability, for labels."""
        self._settle()
        return self._found

    def _settle(self) -> None:
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        means, variances, tables = self.answers
        for node in self.nodes:
            name, rank = node.name, len(node.value_shape)
            rows = [w for w in waiting if w[1].values[name].ndim > rank]
            if not rows:
                continue
            at = [k for k, _, _ in rows]
            if node.domain is not None:
                centre: Any = (tables[name][at], None)
            else:
                centre = (means[name][at], variances[name][at])
            errors = node_errors(
                self.layout, [c for _, c, _ in rows], [b for _, _, b in rows], node, centre
            )
            self._found[name][at] = errors


def node_errors(
    layout: Layout,
    clouds: Sequence[Cloud],
    bounds: Sequence[np.ndarray],
    node: CompiledNode,
    centre: tuple[np.ndarray, np.ndarray | None],
) -> np.ndarray:
    """Errors of a node's mean, or of its states' probabilities where they have labels, slices first.

    Parameters
    ----------
    layout : Layout
    clouds : sequence of Cloud
        Of as many particles each; one, where plates are filtered separately.
    bounds : sequence of ndarray, shape (2, groups + 1, *apart)
        The families of each.
    node : CompiledNode
    centre : tuple
        Its mean and variance in each slice, or its table and None.
    """
    mean, variance = centre
    count = None
    if node.domain is None and node.angles is None and _is_large(clouds, layout):
        return np.sqrt(_of_slices(clouds[0], bounds[0], clouds[0].values[node.name], mean[0]))[None]
    value = np.stack([c.values[node.name] for c in clouds])
    if node.domain is None:
        off = value - mean[:, None]
        if node.angles is not None:
            assert variance is not None
            length = np.exp(-0.5 * variance)[:, None]
            with np.errstate(divide="ignore", invalid="ignore"):
                off = np.where(node.angles, np.sin(off) / length, off)
    elif node.domain.labels is None:
        numbers = np.asarray(node.domain.numbers, dtype=float)
        off = numbers[value] - (mean @ numbers)[:, None]
    else:
        off = (value[..., None] == np.arange(node.domain.size)) - mean[:, None]
        count = mean
    if not layout.apart:
        found = _variances(np.stack([c.weights for c in clouds]), off, np.stack(bounds, axis=-1))
        ess: Any = np.array([c.ess for c in clouds])
    else:
        found, ess = _of_plates(layout, clouds[0], bounds[0], node, off[0])
    if count is not None:
        found = np.maximum(found, _unseen(count, _beside(ess, node, layout, count.ndim)))
    return np.sqrt(found)


def value_errors(
    layout: Layout, cloud: Cloud, bounds: np.ndarray, values: np.ndarray, mean: np.ndarray
) -> np.ndarray:
    """Errors of the mean of what a function says of each particle: shape what one value has."""
    off = values - mean
    n, many = len(off), int(np.prod(layout.lead))
    rest = off.shape[1 + len(layout.lead) :]
    rows = np.moveaxis(off.reshape(n, many, *rest), 1, 0)
    found = _variances(cloud.weights.reshape(n, many).T, rows, _flat(bounds, many))
    share = found.reshape(np.shape(mean))
    if values.dtype.kind == "b":  # an event that no particle has seen may happen
        ess = np.asarray(cloud.ess, dtype=float)
        share = np.maximum(share, _unseen(mean, ess.reshape(ess.shape + (1,) * len(rest))))
    return np.sqrt(share)


# ---- private ------------------------------------------------------------------------------------


def _shape(node: CompiledNode) -> tuple[int, ...]:
    if node.domain is not None and node.domain.labels is not None:
        return (*node.plate_shape, node.domain.size)
    return node.value_shape


def _flat(bounds: np.ndarray, many: int) -> np.ndarray:
    return bounds.reshape(*bounds.shape[:2], many)


def _variances(weights: np.ndarray, off: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Variances of weighted means about which values lie off, shape ``(rows, *rest)``.

    Parameters
    ----------
    weights : ndarray, shape (rows, particles)
    off : ndarray, shape (rows, particles, *rest)
    bounds : ndarray of int, shape (2, groups + 1, rows)
    """
    total = weights.sum(axis=1)
    weighted = weights.reshape(weights.shape + (1,) * (off.ndim - 2)) * off
    found, even = _of_families(weights, weighted, bounds[OLD], total)
    few = even < ENOUGH
    if few.any():
        young, _ = _of_families(weights[few], weighted[few], bounds[YOUNG][:, few], total[few])
        found[few] = np.maximum(found[few], young)
    return found


def _of_families(
    weights: np.ndarray, weighted: np.ndarray, bounds: np.ndarray, total: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Variances by the families of one origin, and how many even ones these are worth."""
    shares = row_sums(weights, bounds) / total[:, None]
    parts = row_sums(weighted, bounds)
    tail = (1,) * (parts.ndim - 2)
    parts /= total.reshape(-1, 1, *tail)
    left = np.maximum(1.0 - shares, 1e-12)
    found = (parts**2 / left.reshape(*left.shape, *tail)).sum(axis=1)
    return found, 1.0 / (shares**2).sum(axis=1)


def _is_large(clouds: Sequence[Cloud], layout: Layout) -> bool:
    return len(clouds[0].weights) > MANY and len(clouds) == 1 and not layout.apart


def _of_slices(cloud: Cloud, bounds: np.ndarray, value: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Variance of the mean of numbers of one cloud, family by family."""
    flat, centre = value.reshape(len(value), -1), np.reshape(mean, -1)
    shape = value.shape[1:]

    def by(edges: np.ndarray) -> tuple[np.ndarray, float]:
        pairs = list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))
        shares = group_sums(cloud.weights, edges) / cloud.total
        sums = np.array([cloud.weights[a:b].dot(flat[a:b]) for a, b in pairs]) / cloud.total
        parts = sums - shares[:, None] * centre
        left = np.maximum(1.0 - shares, 1e-12)
        return (parts**2 / left[:, None]).sum(axis=0), 1.0 / (shares**2).sum()

    found, even = by(bounds[OLD])
    if even < ENOUGH:
        found = np.maximum(found, by(bounds[YOUNG])[0])
    return found.reshape(shape)


def _of_plates(
    layout: Layout, cloud: Cloud, bounds: np.ndarray, node: CompiledNode, off: np.ndarray
) -> tuple[np.ndarray, Any]:
    """Variances where plates are filtered separately, slices first, and what particles are worth."""
    many = int(np.prod(layout.lead))
    at = [1 + node.plates.index(p) for p in layout.apart if p in node.plates]
    first = range(1, 1 + len(at))
    rows = np.moveaxis(off, at, first)
    rest = rows.shape[1 + len(at) :]
    if len(at) < len(layout.apart):  # it hangs on nothing that was drawn
        return np.zeros((1, *off.shape[1:])), np.asarray(cloud.ess)
    rows = np.moveaxis(rows.reshape(len(off), many, *rest), 1, 0)
    found = _variances(cloud.weights.reshape(-1, many).T, rows, _flat(bounds, many))
    found = np.moveaxis(found.reshape(*layout.lead, *rest), range(len(at)), [a - 1 for a in at])
    return found[None], np.asarray(cloud.ess)


def _beside(ess: Any, node: CompiledNode, layout: Layout, ndim: int) -> Any:
    """What particles are worth, with the axes of a node's table."""
    if not layout.apart:
        return ess.reshape(-1, *(1,) * (ndim - 1))
    order = [p for p in node.plates if p in layout.apart]
    moved = ess.transpose([layout.apart.index(p) for p in order])
    shape = [
        n if p in layout.apart else 1 for p, n in zip(node.plates, node.plate_shape, strict=True)
    ]
    return moved.reshape(1, *shape, 1)


def _unseen(share: np.ndarray, ess: Any) -> np.ndarray:
    """Variance of a share that (nearly) no particle, or every one, has: Agresti and Coull (1998)."""
    centre = (share * ess + 2.0) / (ess + 4.0)
    rare = np.minimum(share, 1.0 - share) * ess < 1.0
    return np.where(rare, centre * (1.0 - centre) / (ess + 4.0), 0.0)
