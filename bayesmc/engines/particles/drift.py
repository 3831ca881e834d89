"""Whether rows pull the particles the same way, slice after slice.

By how much a row moves a mean is, under the model, a martingale difference: the variance of such moves is
what the rows take from the variance of the belief, whatever the densities (the law of total variance). Moves
that add up to far more come from rows that ask for particles that are not there: a jump of the state that no
particle has made, or a model that is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from bayesmc.engines.particles.cloud import Cloud, Layout
from bayesmc.network import CompiledNode

#: weight of what has been at each further slice: about ten are looked at together; and that of the largest
#: sum, which is kept for longer, as families are
FADING, KEPT = 0.9, 0.995
#: sums of moves, in units of their spread, from which on particles seem to be missing, and are
SEEMS, IS = 2.8, 4.5
#: variance of moves below which nothing has moved
_LEAST = 0.05


class Drift(NamedTuple):
    """Moves of the means of numbers so far, in units of their spreads, shapes (numbers, many)."""

    moved: Any
    variance: Any
    worst: Any


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
            (n, len(n.value_shape))
            for n in nodes
            if n.domain is None and n.angles is None and set(layout.apart) <= set(n.plates)
        )
        count = max(sum(math.prod(n.value_shape) for n, _ in self.nodes), 1)
        one = len(self.nodes) == 1 and not self.nodes[0][1] and not layout.apart
        self.alone = self.nodes[0][0].name if one else None
        self.limit = math.sqrt(IS**2 + 2.0 * math.log(count))

    def after(self, drift: Drift | None, earlier: Cloud | None, cloud: Cloud) -> Drift | None:
        """The same after a slice, whose particles have been drawn from the model itself."""
        if cloud.rejuvenated is not False:
            return None
        if self.alone is not None:
            return self._after_one(drift, earlier, cloud)
        before = None if earlier is None or np.all(cloud.resampled) else earlier
        if before is not None and len(before.weights) != len(cloud.weights):
            before = None
        step = self._of_many([cloud.values[n.name] for n, _ in self.nodes], before, cloud)
        moved, spent, worst = drift if drift is not None else (0.0, 0.0, 0.0)
        moved, spent = FADING * moved + step[0], FADING**2 * spent + step[1]
        now = (np.abs(moved) / np.sqrt(spent + _LEAST)).max(axis=0)
        return Drift(moved, spent, np.maximum(KEPT * worst, now))

    # ---- private -------------------------------------------------------------------------------

    def _after_one(self, drift: Drift | None, earlier: Cloud | None, cloud: Cloud) -> Drift | None:
        """The same of one number per particle, in few calls of NumPy."""
        assert self.alone is not None
        values = cloud.values[self.alone]
        if values.ndim == 0:
            return drift
        same = earlier is not None and len(earlier.weights) == len(values)
        prior = earlier if same and not cloud.resampled else None
        weights, total = cloud.weights, cloud.total
        if prior is None:
            n = len(values)
            mean = float(values.sum()) / n
        else:
            mean = float(prior.weights.dot(values)) / prior.total
        off = values - mean
        move = float(weights.dot(off)) / total
        if prior is None:
            wide = float(off.dot(off)) / n
            off *= off
        else:
            off *= off
            wide = float(prior.weights.dot(off)) / prior.total
        if not wide > 0.0:
            return drift
        left = float(weights.dot(off)) / total - move * move
        moved, spent, worst = drift if drift is not None else (0.0, 0.0, 0.0)
        moved = FADING * moved + move / math.sqrt(wide)
        spent = FADING * FADING * spent + max(1.0 - left / wide, 0.0)
        return Drift(moved, spent, max(KEPT * worst, abs(moved) / math.sqrt(spent + _LEAST)))

    def _of_many(
        self, values: list[np.ndarray], before: Cloud | None, cloud: Cloud
    ) -> tuple[np.ndarray, np.ndarray]:
        many = math.prod(self.layout.lead)
        rows = []
        for (node, rank), value in zip(self.nodes, values, strict=True):
            if value.ndim == rank:  # the same for all particles
                value = np.broadcast_to(value, (len(cloud.weights), *value.shape))
            at = [1 + node.plates.index(p) for p in self.layout.apart]
            first = np.moveaxis(value, at, range(1, 1 + len(at)))
            rows.append(first.reshape(len(value), many, -1).transpose(2, 1, 0))
        numbers = np.concatenate(rows).astype(float)
        n = numbers.shape[-1]
        posterior = (cloud.weights / cloud.total).reshape(n, many).T
        if before is None:
            prior: Any = np.full((many, n), 1.0 / n)
        else:
            shares = before.weights / before.total
            prior = np.where(cloud.resampled, 1.0 / n, shares).reshape(n, many).T
        mean = np.einsum("kin,in->ki", numbers, prior)
        numbers -= mean[..., None]
        move = np.einsum("kin,in->ki", numbers, posterior)
        numbers *= numbers
        wide = np.einsum("kin,in->ki", numbers, prior)
        left = np.einsum("kin,in->ki", numbers, posterior) - move**2
        return _scaled(move, wide, left)


# ---- private ------------------------------------------------------------------------------------


def _scaled(move: np.ndarray, wide: np.ndarray, left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    some = wide > 0.0
    safe = np.where(some, wide, 1.0)
    return np.where(some, move / np.sqrt(safe), 0.0), np.where(
        some, np.maximum(1.0 - left / safe, 0.0), 0.0
    )
