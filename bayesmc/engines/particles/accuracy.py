"""Errors of means: by how far the families of a slice differ.

Each family's part of a weighted mean is nearly independent of the others', so the sum of their squares is its
variance (``families`` says why), with a correction for what the mean owes to the family itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.engines.particles.cloud import Cloud, Layout
from bayesmc.engines.particles.families import OLD, YOUNG, Families, row_sums
from bayesmc.network import CompiledNode
from bayesmc.results.shares import is_share, steps

#: slices that are taken together: what costs is calling NumPy
TOGETHER = 100
#: even families below which the young origin is asked, too, and those that say nothing; if the young one has
#: no more than these either, nobody knows
ENOUGH, LAST = 8.0, 3.5


class MeanErrors:
    """Errors of the means of nodes, written as the slices pass; read them by ``found``.

    Those of nodes that are one number are worked out for several slices at a time.

    Parameters
    ----------
    layout : Layout
    nodes : sequence of CompiledNode
    steps : int
    answers : tuple of dict
        Means, variances and tables, time first; entries must be there when their slice is added.
    """

    def __init__(
        self,
        layout: Layout,
        nodes: Sequence[CompiledNode],
        steps: int,
        answers: tuple[Mapping[str, np.ndarray], ...],
    ) -> None:
        self.layout, self.nodes, self.answers = layout, nodes, answers
        self._found = {n.name: np.zeros((steps, *_shape(n))) for n in nodes}
        self._plain = frozenset(
            n.name
            for n in nodes
            if n.domain is None and n.angles is None and not n.value_shape and not layout.apart
        )
        self._waiting: list[_Waiting] = []  # slices whose errors are not worked out yet
        self._room = np.zeros(layout.particles + 1)

    def add(self, k: int, cloud: Cloud, families: Families) -> None:
        """Take in the cloud of the k-th slice."""
        means, variances, tables = self.answers
        if self._plain:
            self._waiting.append(self._summed(k, cloud, families))
            if len(self._waiting) >= TOGETHER:
                self._work_out()
        if len(self._plain) == len(self.nodes):
            return
        for node in self.nodes:
            name, value = node.name, cloud.values[node.name]
            if value.ndim == len(node.value_shape) or name in self._plain:
                continue
            if node.domain is not None:
                centre: Any = (tables[name][k : k + 1], None)
            else:
                centre = (means[name][k : k + 1], variances[name][k : k + 1])
            self._found[name][k] = node_errors(self.layout, cloud, families, node, centre)

    def found(self) -> dict[str, np.ndarray]:
        """Errors by node, time first, shape of the mean; of each state's probability, for labels."""
        self._work_out()
        return self._found

    def _summed(self, k: int, cloud: Cloud, families: Families) -> _Waiting:
        """Sums over families of weights, and of nodes that are one number: of both origins if need be."""
        weights, values = cloud.weights, cloud.values
        n, add = len(weights), np.add.reduceat
        room = self._room[: n + 1]  # a family without particles may begin at the end
        room[n] = 0.0
        starts = families.bounds[:, :-1]
        room[:n] = weights
        sums = [add(room, starts[OLD])]
        few = sums[0].dot(sums[0]) * ENOUGH >= cloud.total**2
        if few:
            sums.append(add(room, starts[YOUNG]))
        parts = {}
        for name in self._plain:
            if values[name].ndim:
                np.multiply(weights, values[name], out=room[:n])
                parts[name] = [add(room, own) for own in starts[: len(sums)]]
        lost, left, scouts = families.lost is not None, {}, families.scouts
        if scouts is not None:
            for name in parts.keys() & scouts.values.keys():
                own = _left_out(scouts.share, scouts.values[name], self.answers[0][name][k])
                left[name] = float(own)
        return _Waiting(k, cloud.total, families.bounds, sums, parts, lost, left)

    def _work_out(self) -> None:
        """Errors of nodes that are one number, of all slices that wait."""
        waiting, self._waiting = self._waiting, []
        for name in self._plain if waiting else ():
            first, last = waiting[0].k, waiting[-1].k + 1
            variance, few = self._found[name][first:last], np.zeros(last - first, dtype=bool)
            for origin in (OLD, YOUNG):
                of = [w for w in waiting if name in w.parts and len(w.sums) > origin]
                if not of:
                    continue
                at = np.array([w.k for w in of]) - first
                totals = np.array([w.total for w in of])[:, None]
                edges = np.stack([w.bounds[origin] for w in of])
                some = edges[:, 1:] > edges[:, :-1]
                shares = np.where(some, np.stack([w.sums[origin] for w in of]), 0.0) / totals
                parts = np.where(some, np.stack([w.parts[name][origin] for w in of]), 0.0) / totals
                found = _by_shares(parts - shares * self.answers[0][name][first + at, None], shares)
                if origin == OLD:  # the young origin says what the old one does not
                    few[at] = (shares**2).sum(axis=1) * ENOUGH >= 1.0
                    variance[at] = np.where(few[at] & np.isinf(found), 0.0, found)
                else:
                    variance[at] = np.maximum(variance[at], np.where(few[at], found, 0.0))
            for own in (w for w in waiting if name in w.left):
                variance[own.k - first] += own.left[name]
            variance[[w.k - first for w in waiting if w.lost and name in w.parts]] = np.inf
            np.sqrt(variance, out=variance)


class _Waiting(NamedTuple):
    """What families have of a slice's weights, and of its nodes that are one number.

    The sums of families without particles are not 0.
    """

    k: int
    total: Any
    bounds: np.ndarray
    sums: list[np.ndarray]
    parts: dict[str, list[np.ndarray]]
    lost: bool
    left: dict[str, float]


def node_errors(
    layout: Layout,
    cloud: Cloud,
    families: Families,
    node: CompiledNode,
    centre: tuple[np.ndarray, np.ndarray | None],
) -> np.ndarray:
    """Errors of a node's mean, or of its states' probabilities where they have labels.

    Parameters
    ----------
    layout : Layout
    cloud : Cloud
    families : Families
    node : CompiledNode
    centre : tuple
        Its mean and variance, or its table and None, with an axis of length 1 in front.
    """
    off, count, step = deviations(node, cloud.values[node.name][None], centre)
    mean, bounds = centre[0], families.bounds
    if not layout.apart:
        found = _variances(cloud.weights[None], off, bounds[..., None])
        ess: Any = np.array([cloud.ess])
    else:
        found, ess = _of_plates(layout, cloud, bounds, node, off[0])
    if count is not None:
        own = np.ndim(found) == np.ndim(mean)  # of each state; else of the node's number
        worth = _beside(ess, node, layout, np.ndim(mean))
        found = np.maximum(found, step**2 * unseen(count, worth if own else worth[..., 0]))
        if families.scouts is not None:
            found = found + (step * families.scouts.share) ** 2
    elif (
        families.scouts is not None and node.angles is None and node.name in families.scouts.values
    ):
        found = found + _left_out(families.scouts.share, families.scouts.values[node.name], mean[0])
    if families.lost is not None:
        order = [p for p in node.plates if p in layout.apart]
        if len(order) == len(layout.apart):
            where = _along(families.lost.where, layout, node)
            tail = found.ndim - 1 - where.ndim
            found = np.where(where.reshape(where.shape + (1,) * tail), np.inf, found)
    return np.sqrt(found[0])


def deviations(
    node: CompiledNode, value: np.ndarray, centre: tuple[np.ndarray, np.ndarray | None]
) -> tuple[np.ndarray, np.ndarray | None, float]:
    """By how much values lie off a mean; the shares that stand behind it, and what a state more or less is.

    Slices and particles come first; ``centre`` as for ``node_errors``. Without states there are no shares.
    """
    mean, variance = centre
    count, step = None, 1.0
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
        count, step = mean.max(axis=-1), float(steps(node, None, False))
    else:
        off = (value[..., None] == np.arange(node.domain.size)) - mean[:, None]
        count = mean
    return off, count, step


def value_errors(
    layout: Layout,
    cloud: Cloud,
    families: Families,
    values: np.ndarray,
    mean: np.ndarray,
    there: Callable[[dict[str, np.ndarray]], np.ndarray | None] | None = None,
) -> np.ndarray:
    """Errors of the mean of what a function says of each particle: shape what one value has.

    ``there`` is the function at values of scouts, if it can be asked.
    """
    off = values - mean
    n, many = len(off), int(np.prod(layout.lead))
    rest = off.shape[1 + len(layout.lead) :]
    rows = np.moveaxis(off.reshape(n, many, *rest), 1, 0)
    found = _variances(cloud.weights.reshape(n, many).T, rows, _flat(families.bounds, many))
    share = found.reshape(np.shape(mean))
    if is_share(values):  # an event that no particle has seen may happen
        ess = np.asarray(cloud.ess, dtype=float)
        share = np.maximum(share, unseen(mean, ess.reshape(ess.shape + (1,) * len(rest))))
    if families.scouts is not None and there is not None:
        share = share + _left_out(families.scouts.share, there(families.scouts.values), mean)
    if families.lost is not None:
        where = families.lost.where
        share = np.where(where.reshape(where.shape + (1,) * len(rest)), np.inf, share)
    return np.sqrt(share)


def unseen(share: np.ndarray, ess: Any) -> np.ndarray:
    """Variance of a share that (nearly) no particle, or every one, has: Agresti and Coull (1998)."""
    centre = (share * ess + 2.0) / (ess + 4.0)
    rare = np.minimum(share, 1.0 - share) * ess < 1.0
    return np.where(rare, centre * (1.0 - centre) / (ess + 4.0), 0.0)


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
        old = np.where(np.isinf(found[few]), 0.0, found[few])
        found[few] = np.maximum(old, young)
    return found


def _of_families(
    weights: np.ndarray, weighted: np.ndarray, bounds: np.ndarray, total: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Variances by the families of one origin, and how many even ones these are worth."""
    shares = row_sums(weights, bounds) / total[:, None]
    parts = row_sums(weighted, bounds)
    tail = (1,) * (parts.ndim - 2)
    parts /= total.reshape(-1, 1, *tail)
    even = 1.0 / (shares**2).sum(axis=1)
    return _by_shares(parts, shares.reshape(*shares.shape, *tail)), even


def _by_shares(parts: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Variances by parts ``(rows, groups, *rest)`` of means, with what these owe to each family.

    They are as much larger as the square of Student's t is than that of a normal figure; infinite where too
    few families are left to say.
    """
    even = 1.0 / (shares**2).sum(axis=1)
    free = np.maximum(even - 1.0, LAST - 1.0)
    found = (parts**2 / np.maximum(1.0 - shares, 1e-12)).sum(axis=1) * (free / (free - 2.0))
    return np.where(even < LAST, np.inf, found)


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
    return _along(ess, layout, node)[None, ..., None]


def _along(figures: Any, layout: Layout, node: CompiledNode) -> np.ndarray:
    """Figures of elements that are filtered separately, along the plates of a node."""
    order = [p for p in node.plates if p in layout.apart]
    moved = np.transpose(figures, [layout.apart.index(p) for p in order])
    shape = [
        n if p in layout.apart else 1 for p, n in zip(node.plates, node.plate_shape, strict=True)
    ]
    return moved.reshape(shape if layout.apart else ())


def _left_out(share: float, values: np.ndarray | None, mean: Any) -> Any:
    """Square of what a mean owes to states that particles leave out."""
    if values is None:
        return 0.0 if share == 0.0 else np.full(np.shape(mean), np.inf)
    return (share * (values.mean(axis=0) - mean)) ** 2
