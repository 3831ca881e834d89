"""Slices that are made in one call of machine code: passed one by one, and what is followed beside them.

The loop over slices in which nothing is to be said about families is machine code, too
(``lowering.lineage``); any other slice is looked at by ``tracking``, as if it had been made by itself.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import Row, Series, SeriesProblem
from bayesmc.engines.particles import genealogy
from bayesmc.engines.particles.errors import ENOUGH
from bayesmc.engines.particles.families import LONGEST, OLD, YOUNG, Drift, Families
from bayesmc.engines.particles.predictive import Replicates
from bayesmc.engines.particles.smc import Particles
from bayesmc.engines.particles.sums import Sums
from bayesmc.engines.particles.tracking import STRETCH, Tracker
from bayesmc.lowering import Made, Numbers, address_of, followed
from bayesmc.network import CompiledNode

#: columns of what is told of a slice: ``lowering.filter_slices.TOLD``
TOTAL, LOG_TOTAL, ESS, INCREMENT, RESAMPLED, UNIQUE, WORST = range(7)


class MadeSlices:
    """Slices in a row.

    Parameters
    ----------
    made : Made
    series : Series
    start : int
        The number of their first row.
    arrays : sequence of ndarray
        Log weights, weights, ancestors, and values of each node, slices first.
    names : sequence of str
        These nodes.
    seen : sequence of str
        Nodes that are seen, in full, of those whose values are held.
    numbers : Numbers or None
        Of which the moments were taken; None where families are not followed by these.
    """

    def __init__(
        self,
        made: Made,
        series: Series,
        start: int,
        arrays: Sequence[np.ndarray],
        names: Sequence[str],
        seen: Sequence[str],
        numbers: Numbers | None,
    ) -> None:
        self.made, self._series, self._start, self._arrays = made, series, start, arrays
        self.names, self._seen, self.numbers = tuple(names), seen, numbers
        self.t = series.start + start
        self.figures = made.told[1 : made.slices + 1]
        self._told = self.figures.tolist()
        self._particles: dict[int, Particles] = {}
        self.size = arrays[0].shape[1]

    def __len__(self) -> int:
        return self.made.slices

    def first(self, count: int) -> MadeSlices:
        """The first so many of them."""
        made, series = self.made._replace(slices=count), self._series
        rest = (self._arrays, self.names, self._seen, self.numbers)
        return MadeSlices(made, series, self._start, *rest)

    def row(self, k: int) -> Row:
        """What is known of the k-th slice."""
        return self._series.row(self._start + k)

    def particles(self, k: int) -> Particles:
        """Those of the k-th slice; read-only."""
        if k not in self._particles:
            total, log_total, ess, increment, resampled = self._told[k][: RESAMPLED + 1]
            log, weights, ancestors, *own = (a[k] for a in self._arrays)
            for array in own:
                array.flags.writeable = False
            chosen = ancestors[: self.size] if resampled else None
            values = dict(zip(self.names, own, strict=True))
            for name in self._seen:
                values[name] = self._values(name)[k, ...]
            self._particles[k] = Particles(
                self.t + k, values, log, weights, total, log_total, increment, ess, chosen,
                bool(resampled),
            )  # fmt: skip
        return self._particles[k]

    def figures_of(
        self, nodes: Sequence[CompiledNode], whole: Sequence[np.ndarray]
    ) -> Iterator[tuple[CompiledNode, list[np.ndarray]]]:
        """For each node its part of means, variances and errors of all numbers, slices first."""
        places, low = {}, 0
        for name, values in zip(self.names, self._arrays[3:], strict=True):
            size = math.prod(values.shape[2:])
            places[name], low = slice(low, low + size), low + size
        for node in nodes:
            if node.name in places:
                yield node, [a[:, places[node.name]] for a in whole]
                continue
            value = self._values(node.name).astype(float)
            yield node, [value, np.zeros_like(value), np.zeros_like(value)]

    def diagnosed(self) -> dict[str, np.ndarray]:
        """Figures of the filter itself: ``blocks.diagnosed``."""
        never, n = np.zeros(len(self), dtype=bool), len(self)
        return {
            "increments": self.figures[:, INCREMENT].copy(),
            "weight_ess": self.figures[:, ESS].copy(),
            "resampled": self.figures[:, RESAMPLED] > 0.0,
            "rejuvenated": never,
            "counts": np.full(n, self.size),
            "injected": np.zeros(n, dtype=int),
            "unique_ancestors": self.figures[:, UNIQUE].astype(int),
        }

    def followed(
        self, tracker: Tracker, families: Families, earlier: Particles
    ) -> tuple[Families, Sums]:
        """The families in the last slice, given those of the slice before, and the sums over all of them."""
        return _Following(self, tracker, families, earlier).run()

    # ---- private -------------------------------------------------------------------------------

    def _values(self, name: str) -> np.ndarray:
        """What was seen of a node, slices first."""
        return self._series.observed[name].value[self._start : self._start + len(self)]


class Ahead:
    """Slices that are made together, and passed one by one.

    Parameters
    ----------
    machine : SliceCode
        Makes them.
    problem : SeriesProblem
    record : Record
    """

    def __init__(self, machine: Any, problem: SeriesProblem, record: Any) -> None:
        self._machine, self._problem, self._record = machine, problem, record
        self._made: MadeSlices | None = None
        self._before: Particles | None = None
        self._first, self._is_followed = 0, False

    @property
    def is_idle(self) -> bool:
        """Whether all slices that were made have been passed."""
        return self._made is None

    def reaches(self, k: int, now: Particles | None, rng: np.random.Generator) -> bool:
        """Whether the k-th slice, which follows that of some particles, is made together with others."""
        if self._made is None:
            made = self._made = self._machine.several(self._problem, k, now, rng, self._beside)
            self._is_followed = made is not None and made.numbers is not None
            self._first, self._before = k, now
        return self._made is not None

    def passed(self, k: int, looks: Replicates | None) -> Particles | None:
        """Take in the k-th slice; its particles, or None where nobody asks for them."""
        made, j = self._made, k - self._first
        assert made is not None
        if looks is not None and looks.wanted(k):
            looks.look(k, made.particles(j - 1) if j else self._before, made.row(j))
        is_last = j == len(made) - 1
        if not self._is_followed:
            self._record.add(k, made.particles(j), made.row(j))
        elif is_last:
            self._record.add_made(made)
        if is_last:
            self._made = None
        return made.particles(j) if is_last else None

    def stop(self, steps: int) -> None:
        """Take in what was passed of so many slices."""
        made, self._made = self._made, None
        if made is not None and self._is_followed and steps > self._first:
            self._record.add_made(made.first(steps - self._first))

    def _beside(self) -> tuple[Tracker, Families] | None:
        """What is followed beside slices that are made together, if answers take no more than sums."""
        record, tracker = self._record, self._record.tracker
        nodes = [self._problem.model[n] for n in self._problem.hidden]
        if tracker is None or record.asked or record.keep or not tracker.is_summed(nodes):
            return None
        record.write()
        families = record.families
        return None if families is None or families.scouts is not None else (tracker, families)


class Store:
    """Arrays that are used again once nobody else holds them: fresh ones cost a page at a time."""

    def __init__(self) -> None:
        self._held: dict[Any, list[np.ndarray]] = {}

    def __call__(self, shape: tuple[int, ...], dtype: type = float) -> np.ndarray:
        held = self._held.setdefault((shape, dtype), [])
        count = getattr(sys, "getrefcount", None)
        for k in range(len(held)):
            if count is not None and count(held[k]) == 2:  # that of the list and of the argument
                return held[k]
        held.append(np.empty(shape, dtype))
        del held[:-_SETS]
        return held[-1]


# ---- private ------------------------------------------------------------------------------------

#: arrays of a kind that are held: those of a node, of several blocks
_SETS = 8
_ORIGINS = 2


class _Following:
    """The run over slices."""

    def __init__(
        self, slices: MadeSlices, tracker: Tracker, families: Families, earlier: Particles
    ) -> None:
        self._slices, self._tracker, self._earlier = slices, tracker, earlier
        assert slices.numbers is not None
        made, self._count, self._where = slices.made, len(slices), slices.numbers.where
        rows, numbers, groups = self._count + 1, len(self._where), families.shares.shape[1]
        self._families = families
        self._t0 = slices.t - 1
        self.bounds = np.empty((rows, _ORIGINS, groups + 1), np.int64)
        self.explained = np.empty((rows, _ORIGINS, 2))
        self.sums = np.empty((rows, _ORIGINS, 1 + numbers, groups))
        self.young, self.lost = np.zeros(rows, np.int64), np.zeros(rows, dtype=bool)
        self._sizes = self._count, slices.size, made.at.shape[1] - 3, numbers, groups
        compass = tracker.compass
        self._columns = np.flatnonzero(self._where[:, 3])
        early = (made.at, made.told, self._where, made.moments, self.bounds)
        late = (self.explained, self.sums, self.young)
        self._addresses = [[address_of(a) for a in arrays] for arrays in (early, late)]
        self._limit = math.inf if compass is None else compass.limit

    def run(self) -> tuple[Families, Sums]:
        row, families, tracker, slices = 0, self._families, self._tracker, self._slices
        while True:
            stop, families = self._on(row, families)
            if stop > self._count:
                break
            earlier = slices.particles(stop - 2) if stop > 1 else self._earlier
            now = slices.particles(stop - 1)
            drift, at = self._drift(stop), slices.row(stop - 1)
            families = tracker.followed_by(families, earlier, now, at, drift)
            row = stop
            self.lost[row] = families.lost is not None and bool(families.lost.where)
        made, last = slices.made, slice(1, self._count + 1)
        moments = made.moments[last]
        return families, Sums(
            moments[..., 0], moments[..., 1], made.told[last, TOTAL], self.sums[last, OLD],
            self.sums[last, YOUNG], self.young[last] > 0, self.lost[last],
        )  # fmt: skip

    def _on(self, row: int, families: Families) -> tuple[int, Families]:
        """The next slice that is to be looked at, and the families in the one before."""
        made, lost = self._slices.made, families.lost
        self.bounds[row], self.explained[row] = families.bounds, families.explained
        shares = np.array(families.shares, order="C")
        origins = np.array([families.settled, *families.born], dtype=float)
        even = genealogy.even_groups(self._slices.size, shares.shape[1], 0)
        roots = np.zeros(1, np.int64)
        if lost is not None:
            n = self._slices.size
            roots = np.empty(2 * n + 1, np.int64)
            roots[0], roots[1 : n + 1] = 1, np.arange(n) if lost.roots is None else lost.roots
        limits = self._limits(families)
        early, late = self._addresses
        own = [address_of(a) for a in (limits, shares, roots, origins, *even)]
        stop = followed()(row, *self._sizes, own[0], *early, own[1], *late, *own[2:])
        last = min(stop - 1, self._count)
        if last == row:
            return stop, families
        if lost is not None:
            self.lost[row + 1 : last + 1] = bool(lost.where)
            if (made.told[row + 1 : last + 1, RESAMPLED] > 0).any():
                lost = lost._replace(roots=roots[1 : self._slices.size + 1])
        if origins[2] > families.born[YOUNG]:
            born, settled = origins[1:].astype(np.int64), np.asarray(origins[0])
            families = families._replace(shares=shares, born=born, settled=settled)
        return stop, families._replace(
            bounds=self.bounds[last].copy(), explained=self.explained[last].copy(), lost=lost,
            drift=self._drift(last),
        )  # fmt: skip

    def _limits(self, families: Families) -> np.ndarray:
        n, lost = self._slices.size, families.lost
        return np.array([
            genealogy.rests(n), genealogy.FEW * n, genealogy.SEEMS, ENOUGH, genealogy.level_of(n),
            genealogy.EDGE, genealogy.LONG, genealogy.MOST, genealogy.LEFT, genealogy.STRIDE, self._t0,
 genealogy.SHORTEST, LONGEST,
            math.inf if lost is None else lost.since + STRETCH - self._t0,
        ])  # fmt: skip

    def _drift(self, row: int) -> Drift | None:
        if self._tracker.compass is None:
            return None
        made = self._slices.made
        worst = float(made.told[row, WORST])
        moves = made.moments[row, self._columns, -2:].T[:, None].copy()
        return Drift(moves, worst, worst, self._limit)
