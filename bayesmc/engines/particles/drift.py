"""Whether rows pull the particles the same way, slice after slice.

By how much a row moves a mean is, under the model, a martingale difference: the variance of such moves is
what the rows take from the variance of the belief, whatever the densities (the law of total variance). Moves
that add up to far more come from rows that ask for particles that are not there: a jump of the state that no
particle has made, or a model that is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.engines.particles.blocks import Block
from bayesmc.engines.particles.particles import Layout, Particles
from bayesmc.network import CompiledNode

#: weight of what has been at each further slice: about ten are looked at together; and that of the largest
#: sum, which is kept for longer, as families are
FADING, KEPT = 0.9, 0.995
#: sums of moves, in units of their spread, from which on particles seem to be missing, and are
SEEMS, IS = 2.8, 4.5
#: variance of moves below which nothing has moved
_LEAST = 0.05


class Drift(NamedTuple):
    """Moves of the means of numbers so far, in units of their spreads.

    Attributes
    ----------
    moved, variance : ndarray, shape (elements, numbers), or float
    worst : ndarray, shape (*apart,), or float
        The largest sum of moves of any number, in units of what is expected of it.
    largest : float
        That of the elements.
    limit : float
        From which on particles are missing.
    """

    moved: Any
    variance: Any
    worst: Any
    largest: float
    limit: float


_FADED = np.array([FADING, FADING**2]).reshape(2, 1, 1)

#: a slice of a block, which of its elements were not resampled (None: all), and the slice before
Carried = tuple[int, np.ndarray | None, Particles]


class Compass:
    """Follows the moves of the means of nodes.

    Parameters
    ----------
    nodes : iterable of CompiledNode
        Of which those that are plain numbers are looked at.
    layout : Layout
    """

    def __init__(self, nodes: Iterable[CompiledNode], layout: Layout) -> None:
        self.layout = layout
        self.nodes = tuple(
            n
            for n in nodes
            if n.domain is None and n.angles is None and set(layout.apart) <= set(n.plates)
        )
        elements = math.prod(layout.lead)
        self.counts = [math.prod(n.value_shape) // elements for n in self.nodes]
        every = max(sum(math.prod(n.value_shape) for n in self.nodes), 1)
        self.limit = math.sqrt(IS**2 + 2.0 * math.log(every))
        #: there is one number, without plates: figures are floats
        self.is_alone = not layout.lead and self.counts == [1]

    def after(
        self, drift: Drift | None, earlier: Particles | None, block: Block
    ) -> Sequence[Drift | None]:
        """The same after each slice of a block, whose particles have been drawn from the model itself.

        A slice whose particles were drawn anew makes a block of its own.
        """
        if block.slices[0].rejuvenated is not False:
            return [None]
        if self.is_alone and len(block.slices) == 1:
            return [self.after_one(drift, earlier, block.slices[0])]
        carried = self._carried(earlier, block)
        counts = zip(self.nodes, self.counts, strict=True)
        parts = [_moves(block, node, count, carried) for node, count in counts]
        steps = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1)
        state: Any = 0.0
        if drift is not None:
            state = np.reshape([drift.moved, drift.variance], (2, block.elements, -1))
        for k in range(steps.shape[1]):
            steps[:, k] = state = _FADED * state + steps[:, k]
        moved, variance = steps
        worst = (np.abs(moved) / np.sqrt(variance + _LEAST)).max(axis=-1)
        if drift is not None:
            worst[0] = np.maximum(worst[0], KEPT * np.reshape(drift.worst, -1))
        if len(worst) > 1:
            kept = KEPT ** np.arange(len(worst))[:, None]
            worst = np.maximum.accumulate(worst / kept) * kept
        largest = worst.max(axis=-1).tolist()
        if self.is_alone:
            rows = zip(moved.reshape(-1).tolist(), variance.reshape(-1).tolist(), strict=True)
            both = zip(rows, largest, strict=True)
            return [Drift(*row, top, top, self.limit) for row, top in both]
        figures = zip(moved, variance, worst.reshape(-1, *self.layout.lead), largest, strict=True)
        return [Drift(*own, self.limit) for own in figures]

    def after_one(
        self, drift: Drift | None, earlier: Particles | None, now: Particles
    ) -> Drift | None:
        """The same of one number in one slice, by itself: there NumPy's calls are what costs."""
        if now.rejuvenated is not False:
            return None
        moved, variance, worst = 0.0, 0.0, 0.0
        if drift is not None:
            moved, variance = FADING * drift.moved, FADING**2 * drift.variance
            worst = KEPT * drift.largest
        values, n = now.values[self.nodes[0].name].reshape(-1), len(now.weights)
        if len(values) == n:  # not the same for all particles
            prior = None if now.resampled or earlier is None else earlier
            if prior is None or len(prior.weights) != n:
                off = values - float(np.add.reduce(values)) / n
                shift, squares = float(now.weights.dot(off)) / now.total, off * off
                wide = float(np.add.reduce(squares)) / n
            else:
                off = values - float(prior.weights.dot(values)) / prior.total
                shift, squares = float(now.weights.dot(off)) / now.total, off * off
                wide = float(prior.weights.dot(squares)) / prior.total
            if wide > 0.0:
                left = float(now.weights.dot(squares)) / now.total - shift * shift
                moved += shift / math.sqrt(wide)
                variance += max(1.0 - left / wide, 0.0)
        worst = max(worst, abs(moved) / math.sqrt(variance + _LEAST))
        return Drift(moved, variance, worst, worst, self.limit)

    # ---- private -------------------------------------------------------------------------------

    def _carried(self, earlier: Particles | None, block: Block) -> list[Carried]:
        """Slices into which particles bring the weights of the slice before, and that slice."""
        found, n = [], block.particles
        for k, now in enumerate(block.slices):
            every = now.resampled if isinstance(now.resampled, bool) else now.resampled.all()
            if not every and earlier is not None and len(earlier.weights) == n:
                some = None if isinstance(now.resampled, bool) else ~now.resampled.reshape(-1)
                found.append((k, some, earlier))
            earlier = now
        return found


# ---- private ------------------------------------------------------------------------------------


def _moves(
    block: Block,
    node: CompiledNode,
    count: int,
    carried: Sequence[Carried],
) -> np.ndarray:
    """What rows do to a node's numbers: moves of means, and the variances that they take away.

    Shape ``(2, slices, elements, numbers)``.
    """
    moments = block.moments(node)
    if moments is None:  # the same for all particles
        return np.zeros((2, len(block.slices), block.elements, count))
    off, n = moments.off, block.particles
    shift, wide = np.add.reduce(off, axis=-1) / n, np.vecdot(off, off) / n
    for k, some, earlier in carried:
        weights, total = earlier.weights.reshape(n, -1).T, np.reshape(earlier.total, (-1, 1))
        part = weights[:, None] * off[k]
        own, square = np.add.reduce(part, axis=-1) / total, np.vecdot(part, off[k]) / total
        shift[k] = own if some is None else np.where(some[:, None], own, shift[k])
        wide[k] = square if some is None else np.where(some[:, None], square, wide[k])
    wide = wide - shift**2
    found = np.empty((2, *wide.shape))
    with np.errstate(divide="ignore", invalid="ignore"):
        np.divide(-shift, np.sqrt(wide), out=found[0])
        np.maximum(1.0 - moments.variance / wide, 0.0, out=found[1])
    none = ~(wide > 0.0)
    if none.any():
        found[:, none] = 0.0
    return found
