"""A series passed through the clique trees of its slices, the belief projected on clusters after each.

Forwards, the clusters' probabilities of the slice before times the slice's densities are calibrated, and the
clusters' own read off: the product of these over the separators' is the nearest one to what the slice says
(in the sense of KL divergence from it). Backwards, a slice is calibrated once more with what the rows after
it say of its clusters, smoothed over filtered.

References
----------
Boyen and Koller (1998), Tractable inference for complex stochastic processes, UAI, sec. 4; Boyen and Koller
(1998), Approximate learning of dynamic models, NIPS, sec. 3 (smoothing).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import Series
from bayesmc.engines.discrete.rows import Piece, Rows, Variable
from bayesmc.engines.discrete.run import Run
from bayesmc.engines.discrete.slices import BLOCK_ENTRIES
from bayesmc.engines.factored.beliefs import Belief, Beliefs, belief_of
from bayesmc.engines.factored.clusters import Cluster, Scope
from bayesmc.engines.factored.slices import FactoredSlices
from bayesmc.engines.factored.tree import Calibrated, Tables
from bayesmc.errors import BudgetError
from bayesmc.factors.named import largest
from bayesmc.factors.propagation import LINEAR, LOG, Semiring


class FactoredRun(Run):
    """Beliefs about the clusters of every chain; what it is asked is what a ``Run`` is."""

    plan: FactoredSlices

    def __init__(
        self,
        plan: FactoredSlices,
        series: Series,
        first: int = 0,
        before: Any = None,
    ) -> None:
        super().__init__(plan, series, first, before)
        self._forwards: list[Beliefs] = []
        self._answers: list[Beliefs] = []
        self._later: list[Beliefs] = []

    # ---- passing ----------------------------------------------------------------------------

    def backward(self, lag: int | None) -> None:
        found = [self._backward(number, lag) for number in range(len(self.plan.chains))]
        self._answers = [answers for answers, _ in found]
        self._later = [later for _, later in found]

    def _passed(self, number: int) -> np.ndarray:
        beliefs = self._empty(number)
        self._forwards.append(beliefs)
        self._answers = self._forwards
        now = [c.scope for c in self._clusters(number)]
        last = self._at(number, -1)
        for t, stretch, k in self._slices(number, False):
            beside = self._beside(number, t)
            beliefs.increments[t], found = self._read(number, stretch, k, last, None, [now, beside])
            if found is None:
                break
            last = found[0]
            beliefs.put(t, last)
            beliefs.put_beside(t, beside, found[1])
        return beliefs.increments

    def _backward(self, number: int, lag: int | None) -> tuple[Beliefs, Beliefs]:
        """Answers about every slice, and what is known of its clusters, given rows after it."""
        clusters, forwards = self._clusters(number), self._forwards[number]
        now, before = [c.scope for c in clusters], [c.before for c in clusters]
        answers, later = self._empty(number), self._empty(number)
        answers.increments = later.increments = forwards.increments
        for t in range(self.steps):
            later.put(t, forwards.at(t))
        for _ in range(0 if lag is None else min(lag, self.steps - 1)):
            for t, stretch, k in self._slices(number, False):
                if t:
                    (found,) = self._again(number, stretch, k, t, later, [before])
                    later.put(t - 1, found)
        for t, stretch, k in self._slices(number, True):
            beside = self._beside(number, t)
            wanted = [now, beside, before] if lag is None and t else [now, beside]
            found, aside, *earlier = self._again(number, stretch, k, t, later, wanted)
            answers.put(t, found)
            answers.put_beside(t, beside, aside)
            if earlier:
                later.put(t - 1, earlier[0])
        return answers, later

    # ---- reading ----------------------------------------------------------------------------

    def last(self) -> Any:
        end = self.steps
        return [
            {c.scope: b.logs(k, end - 1, end)[0] for k, c in enumerate(b.clusters)}
            for b in self._forwards
        ]

    def alone(self, variable: Variable) -> np.ndarray | None:
        beliefs = self._answers[self.plan.chain_of(variable)]
        number = beliefs.holding([variable])
        if number is None or beliefs.clusters[number].scope != (variable,):
            return None
        return beliefs.tables[number]

    def entries(self, variables: Iterable[Variable]) -> float:
        asked = tuple(dict.fromkeys(variables))
        found = 1.0
        for number in {self.plan.chain_of(v) for v in asked}:
            own = tuple(v for v in asked if self.plan.chain_of(v) == number)
            clusters = self.plan.clusters[number]
            sizes = [c.size for c in clusters if set(own) <= set(c.scope)]
            if own in self.plan.beside(number, 2):
                sizes = [math.prod(self.plan.cards[v] for v in own)]
            if sizes:
                found = max(found, float(min(sizes)))
                continue
            scopes = [s for _, s in self.plan._later(number)]
            scopes += [c.scope for c in clusters] + [c.before for c in clusters]
            found = max(found, largest(scopes, own, self.plan.cards))
        return found

    def drawn(self, at: int, rng: np.random.Generator, count: int) -> dict[Variable, np.ndarray]:
        found: dict[Variable, np.ndarray] = {}
        for beliefs in self._forwards:
            found |= beliefs.drawn(at, rng, count)
        return found

    def calibrated(self, number: int, t: int) -> Calibrated:
        """The tables of one slice of a chain, not the first, before they are projected."""
        rows = self.plan.rows(self.series, t, t + 1)
        stretch = self._stretch(number, rows)
        before = self._at(number, t - self.first - 1)
        with np.errstate(all="ignore"):
            return self._calibrated(stretch, 0, self._clusters(number), before, None, LOG)

    # ---- private ----------------------------------------------------------------------------

    def _clusters(self, number: int) -> Sequence[Cluster]:
        return self.plan.clusters[number]

    def _beside(self, number: int, t: int) -> Sequence[Scope]:
        """What is read off a slice besides its clusters, for answers."""
        return self.plan.beside(number, self.plan.kind(t + self.first))

    def _stretch(self, number: int, rows: Rows) -> Any:
        """What the slices are calibrated with."""
        return self.plan.stretch(number, self.pieces(number, rows), rows)

    def _at(self, number: int, t: int) -> Belief | None:
        """The filtered belief about a slice, counted from the first; before it, what was given."""
        if t >= 0:
            return self._forwards[number].at(t)
        if self.before is None:
            return None
        return belief_of([self._given(number, c) for c in self._clusters(number)], LOG)

    def _given(self, number: int, cluster: Cluster) -> np.ndarray:
        """Logs of a cluster's table in the slice before the first."""
        before: Any = self.before
        return before[number][cluster.scope]

    def _increments(self, number: int) -> np.ndarray:
        return self._forwards[number].increments

    def _empty(self, number: int) -> Beliefs:
        return Beliefs(self._clusters(number), self.plan.cards, self.steps, self.sequences)

    def _slices(self, number: int, backwards: bool) -> Iterator[tuple[int, Any, int]]:
        """Slices from the first or the last, with the tables that each is part of, and where there."""
        cuts = self._stretches(number)
        for start, stop in reversed(cuts) if backwards else cuts:
            rows = self.plan.rows(self.series, start, stop)
            stretch = self._stretch(number, rows)
            places = range(stop - start)
            for k in reversed(places) if backwards else places:
                yield start + k - self.first, stretch, k

    def _again(
        self,
        number: int,
        stretch: Any,
        k: int,
        t: int,
        later: Beliefs,
        wanted: Sequence[Sequence[Scope]],
    ) -> Sequence[Belief]:
        """Beliefs of a slice with what later rows say of its clusters."""
        after = later.at(t), self._forwards[number].at(t)
        _, found = self._read(number, stretch, k, self._at(number, t - 1), after, wanted)
        assert found is not None  # the pass forwards has been through
        return found

    def _read(
        self,
        number: int,
        stretch: Any,
        k: int,
        before: Belief | None,
        after: tuple[Belief, Belief] | None,
        wanted: Sequence[Sequence[Scope]],
    ) -> tuple[np.ndarray | float, Sequence[Belief] | None]:
        """Log density of a row, and the tables of scopes; none where it is impossible.

        As numbers where these do, and in logs where one that is not zero would leave their range.
        """
        clusters = self._clusters(number)
        for semiring in (LINEAR, LOG):
            try:
                with np.errstate(all="ignore"), _strict(semiring):
                    found = self._calibrated(stretch, k, clusters, before, after, semiring)
                    if found is None:
                        return -np.inf, None
                    log_z = found.log_z + stretch.log_scale[k]
                    if not (log_z > -np.inf).all():
                        return log_z, None
                    return log_z, [
                        belief_of([found.table(s) for s in scopes], semiring) for scopes in wanted
                    ]
            except FloatingPointError:
                continue
        raise AssertionError("logs do not leave the range of numbers")

    def _marginal(self, number: int, scope: Scope, start: int, stop: int) -> np.ndarray:
        found = self._answers[number].table(scope, start - self.first, stop - self.first)
        if found is not None:
            return found
        entries = self.entries(scope)
        if entries > BLOCK_ENTRIES:
            names = ", ".join(dict.fromkeys(v[1] for v in scope))
            raise BudgetError(
                f"what is asked of {names} together, which no cluster holds, takes a table of {entries:.3g} "
                "entries; ask about fewer nodes at once, or put them into one cluster",
                int(min(8 * entries, 2**62)),
            )
        return self._eliminated(number, scope, start, stop)

    def _around(self, number: int, start: int, stop: int) -> list[Piece]:
        """What clusters of the slices before, and the rows after, say of some slices."""
        first, last = start - self.first, stop - self.first
        forwards, found = self._forwards[number], []
        for k, cluster in enumerate(self.plan.clusters[number]):
            if start > 0:
                table = forwards.logs(k, max(first - 1, 0), last - 1)
                if first == 0:
                    table = np.concatenate([self._given(number, cluster)[None], table])
                table = cluster.conditional(table, LOG)
                found.append(Piece("", cluster.before, table))
            if self._later:
                after = cluster.conditional(self._later[number].logs(k, first, last), LOG)
                now = cluster.conditional(forwards.logs(k, first, last), LOG)
                found.append(Piece("", cluster.scope, LOG.ratio(after, now)))
        return found

    def _calibrated(
        self,
        stretch: Any,
        k: int,
        clusters: Sequence[Cluster],
        before: Belief | None,
        after: tuple[Belief, Belief] | None,
        semiring: Semiring,
    ) -> Any:
        """A slice with what is known of the clusters before it, and from later rows of its own.

        ``after`` are beliefs with and without these rows. None where nothing is possible.
        """
        tree, further = stretch.tree, stretch.further(k, semiring)
        if before is not None:
            for cluster, table in zip(clusters, before.in_(semiring), strict=True):
                further.append(tree.placed(cluster.before, cluster.conditional(table, semiring)))
        if after is not None:
            both = (belief.in_(semiring) for belief in after)
            for cluster, *tables in zip(clusters, *both, strict=True):
                later, now = (cluster.conditional(t, semiring) for t in tables)
                further.append(tree.placed(cluster.scope, semiring.ratio(later, now)))
        return tree.calibrated(Tables(stretch.always(semiring), further), semiring)


# ---- private ------------------------------------------------------------------------------------


def _strict(semiring: Semiring) -> np.errstate:
    """Has what leaves the range of numbers raise FloatingPointError."""
    return np.errstate(under="raise", over="raise") if semiring is LINEAR else np.errstate()
