"""Comparisons that contradict each other: evidence that no values of the numbers can have.

Every factor says where its own direction may lie; whether some numbers satisfy all of them is a linear
programme. Messages alone would go on narrowing the belief without end.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from bayesmc.engines.propagation.batch import Batch
from bayesmc.engines.propagation.beliefs import Beliefs
from bayesmc.engines.propagation.kernels import Density

#: room to every bound, in widths of a row (or 1), below which there is none
_ROOM = 1e-9
#: batches that are left out by turns to find which contradict each other, at most
_TRIED = 24
#: a belief that is narrower than it was by this factor has been squeezed
_SQUEEZED = 1e-4


class Bounds(NamedTuple):
    """Where the directions of a batch's factors may lie, shape (count,) each; infinite where anywhere."""

    batch: Batch
    low: np.ndarray
    high: np.ndarray


def bounds_of(batch: Batch) -> Bounds | None:
    """Of factors of one number that are zero outside of an interval; None of others."""
    kernel = batch.kernel
    if batch.k != 1 or batch.cards or not isinstance(kernel, Density):
        return None
    found = kernel.interval(batch.everyone if batch.index is None else batch.index)
    return None if found is None else Bounds(batch, *found)


def spreads(bounds: Sequence[Bounds], beliefs: Beliefs) -> list[np.ndarray]:
    """Standard deviations of the directions that have bounds."""
    found = []
    for bound in bounds:
        batch = bound.batch
        _, var = batch._projected(beliefs.blocks[batch.block], batch.everyone)
        found.append(np.sqrt(var[:, 0, 0]))
    return found


def deviations(beliefs: Beliefs) -> np.ndarray:
    """Standard deviations of all coordinates."""
    found = np.full(len(beliefs.size), np.nan)
    for size in np.unique(beliefs.size):
        mine = np.flatnonzero(beliefs.size == size)
        var = beliefs.blocks[size].cov.diagonal(0, -2, -1)
        found[mine] = np.sqrt(var[beliefs.component[mine], beliefs.place[mine]])
    return found


def are_squeezed(before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> bool:
    """Whether some direction has next to no room left."""
    pairs = zip(before, after, strict=True)
    return any(bool((~(new > _SQUEEZED * old)).any()) for old, new in pairs)


def contradictory(bounds: Sequence[Bounds]) -> list[str]:
    """Nodes whose bounds no numbers satisfy together, as few as are found; empty where some do."""
    if not bounds or _fits(bounds):
        return []
    left = list(bounds)
    if len(left) <= _TRIED:
        for one in bounds:
            others = [b for b in left if b is not one]
            if others and not _fits(others):
                left = others
    return list(dict.fromkeys(b.batch.name for b in left))


# ---- private ------------------------------------------------------------------------------------


def _fits(bounds: Sequence[Bounds]) -> bool:
    """Whether there are numbers with some room to all bounds."""
    places: dict[tuple[int, int, int], int] = {}
    rows, columns, entries, sides = [], [], [], []
    count = 0
    for batch, low, high in bounds:
        for k in range(batch.count):
            at = [
                places.setdefault((batch.block, int(batch.component[k]), int(c)), len(places))
                for c in batch.columns[k]
            ]
            own = batch.weights[k, 0]
            room = min(float(high[k] - low[k]), float(np.linalg.norm(own)))
            for sign, side in ((1.0, high[k]), (-1.0, -low[k])):
                if np.isfinite(side):  # sign w x + room t <= side
                    rows += [count] * (len(at) + 1)
                    columns += [*at, -1]
                    entries += [*(sign * own), room]
                    sides.append(side)
                    count += 1
    if not count:
        return True
    last = len(places)
    columns = [last if c < 0 else c for c in columns]
    matrix = scipy.sparse.csr_array((entries, (rows, columns)), shape=(count, last + 1))
    cost = np.zeros(last + 1)
    cost[-1] = -1.0
    limits = [(None, None)] * last + [(None, 1.0)]
    found = scipy.optimize.linprog(cost, matrix, np.array(sides), bounds=limits, method="highs")
    return not found.success or bool(found.x[-1] > _ROOM)
