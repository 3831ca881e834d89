"""Errors of means: variances by family, what is rare beside them, and where nobody can tell.

Each family's part of a weighted mean is nearly independent of the others', so the sum of their squares is its
variance (``genealogy`` says why), with a correction for what the mean owes to the family itself. Those of
trajectories are told by who shares particles (``coalescence``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bayesmc.engines.particles.blocks import Block, has_table
from bayesmc.engines.particles.families import OLD, YOUNG, Families
from bayesmc.engines.particles.genealogy import family_sums
from bayesmc.network import CompiledNode
from bayesmc.results.shares import is_share, steps

#: even families below which the young origin is asked, too, and those that say nothing; if the young one has
#: no more than these either, nobody knows
ENOUGH, LAST = 8.0, 3.5

#: what is found at values of scouts, for each slice; None where they cannot be asked
There = Sequence[np.ndarray | None]


class Variances:
    """What tells the variances of means over the particles of some slices.

    Attributes
    ----------
    worth : ndarray, shape (slices, elements)
        Equally weighted particles that those of a slice are worth.
    """

    worth: np.ndarray

    def variances(self, off: np.ndarray, weighted: np.ndarray | None = None) -> np.ndarray:
        """Variances of means from which values lie off by so much, the last axis summed over.

        ``weighted`` are these times the weights, where they are known.
        """
        raise NotImplementedError

    def missed(
        self, found: np.ndarray, means: np.ndarray | None, there: There, step: float = 0.0
    ) -> None:
        """Add to variances what no particle has met; ``step`` is what a state more or less is."""

    def at_scouts(self, node: CompiledNode) -> There:
        """Values of a node where scouts are, for each slice."""
        return [None] * len(self.worth)


class ByFamily(Variances):
    """Variances by the families of a filter.

    Parameters
    ----------
    block : Block
    families : sequence of Families
        Of each slice.
    """

    def __init__(self, block: Block, families: Sequence[Families]) -> None:
        self.block, self.families = block, families
        self.worth = block.flat([p.ess for p in block.slices])
        bounds = np.array([f.bounds for f in families]).swapaxes(0, 1)  # origins first, then slices
        rows = block.weights.shape[0] * block.weights.shape[1]
        bounds = bounds.reshape(*bounds.shape[:3], -1).swapaxes(2, 3).reshape(2, rows, -1)
        weights, total = block.weights.reshape(rows, 1, -1), block.total.reshape(rows, 1, 1)
        old = family_sums(weights, bounds[OLD]) / total
        few = 1.0 / np.vecdot(old, old)[:, 0] < ENOUGH
        self.few = slice(None) if few.all() else few if few.any() else None  # no copies of much
        self.total, self.old = total, (bounds[OLD], old)
        if self.few is not None:
            at = bounds[YOUNG][self.few]
            self.young = at, family_sums(weights[self.few], at) / total[self.few]

    def variances(self, off: np.ndarray, weighted: np.ndarray | None = None) -> np.ndarray:
        weighted = off * self.block.weights[:, :, None] if weighted is None else weighted
        weighted = weighted.reshape(-1, *off.shape[2:])
        bounds, shares = self.old
        found = by_shares(family_sums(weighted, bounds) / self.total, shares)
        if self.few is not None:
            bounds, shares = self.young
            parts = family_sums(weighted[self.few], bounds) / self.total[self.few]
            young = by_shares(parts, shares)
            was = found[self.few]
            found[self.few] = np.maximum(np.where(np.isinf(was), 0.0, was), young)
        return found.reshape(off.shape[:3])

    def missed(
        self, found: np.ndarray, means: np.ndarray | None, there: There, step: float = 0.0
    ) -> None:
        """States that particles leave out; and all, where a filter has lost sight."""
        for k, (own, values) in enumerate(zip(self.families, there, strict=True)):
            if own.scouts is not None and means is not None and own.scouts.share:
                off: Any = step or np.inf
                if values is not None and not step:
                    off = values.reshape(len(values), -1).mean(axis=0) - means[k, 0]
                found[k, 0] += (own.scouts.share * off) ** 2
            if own.lost is not None:
                found[k, own.lost.where.reshape(-1)] = np.inf

    def at_scouts(self, node: CompiledNode) -> There:
        return [None if f.scouts is None else f.scouts.values.get(node.name) for f in self.families]


def node_errors(by: Variances, block: Block, node: CompiledNode) -> np.ndarray:
    """Errors of a node's means, or of its states' probabilities where they have labels.

    Shape ``(slices, *plates, *event)``, or ``(slices, *plates, states)``.
    """
    labelled = node.domain is not None and node.domain.labels is not None
    more: tuple[int, ...] = (node.domain.size,) if labelled and node.domain is not None else ()
    if block.rows(node) is None:  # the same for all particles
        return np.zeros((len(block.slices), *node.value_shape, *more))
    if node.domain is None:
        moments = block.moments(node)
        assert moments is not None
        found = by.variances(moments.off, moments.weighted)
        by.missed(found, moments.mean if node.angles is None else None, by.at_scouts(node))
    else:
        off, shares, step = _of_states(block, node)
        found = by.variances(off)
        if not has_table(
            block.slices[0], node
        ):  # what no particle has met has its share of a table
            found = np.maximum(found, step**2 * _unseen(shares, by.worth))
        by.missed(found, shares, by.at_scouts(node), step)
    return block.unturned(np.sqrt(found), node, more)


def function_errors(
    by: Variances, block: Block, values: Sequence[np.ndarray], there: There
) -> np.ndarray:
    """Errors of means of what a function says of each particle, shape ``(slices, *apart, *rest)``.

    Parameters
    ----------
    values : sequence of ndarray, shape (particles, *apart, *rest)
    there : sequence of ndarray or None
        The function at values of scouts, if it can be asked.
    """
    rows = block.turned(values)
    mean = block.weighted(rows)
    found = by.variances(rows - mean[..., None])
    if is_share(values[0]):  # an event that no particle has seen may happen
        found = np.maximum(found, _unseen(mean, by.worth))
    by.missed(found, mean, there)
    return np.sqrt(found).reshape(len(values), *values[0].shape[1:])


def by_shares(parts: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Variances by parts ``(rows, numbers, groups)`` of means, with what these owe to each family.

    ``shares`` are those of the families, ``(rows, 1, groups)``. Variances are as much larger as the square of
    Student's t is than that of a normal figure; infinite where too few families are left to say.
    """
    even = 1.0 / np.vecdot(shares, shares)
    free = np.maximum(even - 1.0, LAST - 1.0)
    found = (parts**2 / np.maximum(1.0 - shares, 1e-12)).sum(axis=-1) * (free / (free - 2.0))
    return np.where(even < LAST, np.inf, found)


# ---- private ------------------------------------------------------------------------------------


def _of_states(block: Block, node: CompiledNode) -> tuple[np.ndarray, np.ndarray, float]:
    """By how much values lie off a mean; the shares behind it, and what a state more or less is.

    Shapes ``(slices, elements, numbers, particles)`` and without the last axis; of labels, each state is a
    number.
    """
    assert node.domain is not None
    codes, shares = block.rows(node), block.state_shares(node)
    assert codes is not None and shares is not None
    tables = block.state_rows(node)
    if node.domain.labels is None:
        numbers = np.asarray(node.domain.numbers, dtype=float)
        own = numbers[codes] if tables is None else np.tensordot(tables, numbers, (3, 0))
        off = own - (shares @ numbers)[..., None]
        return off, shares.max(axis=-1), float(steps(node, None, False))
    each = codes[:, :, :, None] == np.arange(node.domain.size)[:, None]
    off = (each if tables is None else tables) - shares[..., None]
    lanes = off.shape[2] * off.shape[3]
    return off.reshape(*off.shape[:2], lanes, -1), shares.reshape(*shares.shape[:2], lanes), 1.0


def _unseen(share: np.ndarray, worth: np.ndarray) -> np.ndarray:
    """Variance of a share that (nearly) no particle, or every one, has: Agresti and Coull (1998)."""
    ess = worth[..., None]
    centre = (share * ess + 2.0) / (ess + 4.0)
    rare = np.minimum(share, 1.0 - share) * ess < 1.0
    return np.where(rare, centre * (1.0 - centre) / (ess + 4.0), 0.0)
