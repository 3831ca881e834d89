"""What a filter has lost sight of, and when it has found its way back.

Where a slice rests on next to no particles, or its families show that particles are missing, means are as
wrong as the evidence, and so are those of later slices: whoever is lost in one of two modes stays there, and
nothing that is left says so. So the errors of means are infinite from there on, until what is random in the
transition could have carried particles over all that they stood on before the loss.

How far that is, is measured: by what the descendants of one particle differ by after a few slices. Nodes that
stay where they are (parameters, a rare switch) are never found again.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from bayesmc.engines.particles.particles import Layout, Particles
from bayesmc.network import CompiledNode

#: slices from one measurement to the next: a few, since lags and speeds pass noise on later
STRETCH = 4
#: variance of what is random since, over that of the particles when they were lost, that leads back
BACK = 4.0


class Lost(NamedTuple):
    """Particles of a slice that could not be trusted, and what has happened since.

    Attributes
    ----------
    where : ndarray of bool, shape (*apart,)
        Elements that are lost.
    wide : tuple of ndarray, shapes (many, numbers)
        Variances of the numbers of each node then; of finite nodes, 1.
    gone : tuple of ndarray, shapes (many, numbers)
        Variances of what was random since.
    since : int
        Slice of the last measurement.
    roots : ndarray of int or None, shape (particles, *apart)
        Whom each particle descends from there; None where everybody has itself.
    """

    where: np.ndarray
    wide: tuple[np.ndarray, ...]
    gone: tuple[np.ndarray, ...]
    since: int
    roots: np.ndarray | None = None


class Sight:
    """Follows what a filter has lost.

    Parameters
    ----------
    nodes : sequence of CompiledNode
        Those that the next slice reads.
    layout : Layout
    """

    def __init__(self, nodes: Any, layout: Layout) -> None:
        self.nodes: tuple[CompiledNode, ...] = tuple(nodes)
        self.layout = layout

    def after(
        self, lost: Lost | None, where: Any, now: Particles, here: bool = False
    ) -> Lost | None:
        """What is lost after a slice in which some elements ``where`` were, shape (*apart).

        ``here`` says that what was lost before is that of this slice already.
        """
        if lost is not None and not here:
            lost = self._followed(lost, now)
        if where is False or not np.asarray(where).any():
            return lost
        fresh = np.broadcast_to(np.asarray(where, dtype=bool), self.layout.lead)
        wide = tuple(self._spread(node, now) for node in self.nodes)
        if lost is None:
            return Lost(fresh, wide, tuple(np.zeros_like(w) for w in wide), now.t)
        rows, still = fresh.reshape(-1, 1), lost.where.reshape(-1, 1)
        both = [(w, np.maximum(w, old), old) for w, old in zip(wide, lost.wide, strict=True)]
        wide = tuple(np.where(rows, np.where(still, more, w), old) for w, more, old in both)
        gone = tuple(np.where(rows, 0.0, g) for g in lost.gone)
        return lost._replace(where=lost.where | fresh, wide=wide, gone=gone)

    def _followed(self, lost: Lost, now: Particles) -> Lost | None:
        """The same one slice later; None where all is found."""
        if now.rejuvenated is not False:
            lost = lost._replace(where=lost.where & ~np.asarray(now.rejuvenated))
        roots = lost.roots
        if now.ancestors is not None:
            chosen = now.ancestors
            if roots is None or chosen.ndim == 1:
                roots = chosen if roots is None else roots.take(chosen)
            else:
                roots = np.take_along_axis(roots, chosen, axis=0)
        if now.t < lost.since + STRETCH or roots is None:
            return lost._replace(roots=roots)
        moved = (self._spread(node, now, roots) for node in self.nodes)
        gone = tuple(g + m for g, m in zip(lost.gone, moved, strict=True))
        where = lost.where.copy().reshape(-1)
        back = np.ones_like(where)
        for wide, own in zip(lost.wide, gone, strict=True):
            back &= (own >= BACK * wide).all(axis=1)
        where &= ~back
        if not where.any():
            return None
        return Lost(where.reshape(lost.where.shape), lost.wide, gone, now.t)

    def _spread(
        self, node: CompiledNode, now: Particles, roots: np.ndarray | None = None
    ) -> np.ndarray:
        """Variances of a node's numbers, shape (many, numbers); with roots, within what descends from each.

        The particles count alike: those that a row has left without weight were there, too.
        """
        many = int(np.prod(self.layout.lead))
        value, labels = now.values[node.name], node.domain is not None
        if value.ndim == len(node.value_shape):
            return np.zeros((many, 1))
        at = [1 + node.plates.index(p) for p in self.layout.apart if p in node.plates]
        if len(at) < len(self.layout.apart):
            return np.zeros((many, 1))
        n = len(value)
        rows = np.moveaxis(value, at, range(1, 1 + len(at))).reshape(n, many, -1).astype(float)
        if roots is None:
            return np.ones(rows.shape[1:]) if labels else rows.var(axis=0)
        found = np.empty(rows.shape[1:])
        for k, own in enumerate(roots.reshape(n, many).T):
            found[k] = _within(rows[:, k], own, labels)
        return found


# ---- private ------------------------------------------------------------------------------------


def _within(rows: np.ndarray, roots: np.ndarray, labels: bool) -> np.ndarray:
    """Variances of values ``(particles, numbers)`` among those with one root; roots are sorted.

    Of labels, the share that differ from the neighbour.
    """
    same = roots[1:] == roots[:-1]
    free = int(np.count_nonzero(same))
    if free == 0:
        return np.zeros(rows.shape[1])
    if labels:
        return ((rows[1:] != rows[:-1]) & same[:, None]).sum(axis=0) / free
    starts = np.concatenate([[0], np.flatnonzero(~same) + 1])
    counts = np.diff(np.append(starts, len(roots)))
    means = np.add.reduceat(rows, starts, axis=0) / counts[:, None]
    off = rows - means.repeat(counts, axis=0)
    return (off * off).sum(axis=0) / free
