"""The factored frontier: node by node, each from the probabilities of its parents one by one.

A node is added to the frontier with its density given parents that are independent, and its own
probabilities are all that is kept. What is seen is multiplied into the product of its parents' probabilities
as soon as these are there, and again each parent's own are kept. Backwards, each node tells its parents what
was seen of it and after it, the other parents being as they were. It is one iteration of loopy belief
propagation on the unrolled template.

References
----------
Murphy and Weiss (2001), The factored frontier algorithm for approximate inference in DBNs, UAI.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.categorical import log_sum_exp
from bayesmc.engines.discrete.rows import Piece, Rows, Variable
from bayesmc.engines.factored.beliefs import Belief
from bayesmc.engines.factored.clusters import Cluster, Scope
from bayesmc.engines.factored.run import FactoredRun
from bayesmc.engines.factored.slices import LEAST
from bayesmc.factors.named import Named, aligned
from bayesmc.factors.propagation import LINEAR, LOG, Semiring


class FrontierRun(FactoredRun):
    """Beliefs about single variables of every slice."""

    ties_slices = False

    def _clusters(self, number: int) -> Sequence[Cluster]:
        chain, cards = self.plan.chains[number], self.plan.cards
        return [Cluster((v,), (), cards[v]) for v in (*chain.state, *chain.inside)]

    def _beside(self, number: int, t: int) -> Sequence[Scope]:
        return ()

    def _stretch(self, number: int, rows: Rows) -> Densities:
        return Densities(_in_order(self.pieces(number, rows)), rows.count, self.sequences)

    def _calibrated(
        self,
        stretch: Any,
        k: int,
        clusters: Sequence[Cluster],
        before: Belief | None,
        after: tuple[Belief, Belief] | None,
        semiring: Semiring,
    ) -> Frontier:
        known = {}
        if before is not None:
            scopes = (c.before[0] for c in clusters)
            known = dict(zip(scopes, before.in_(semiring), strict=True))
        found = Frontier(stretch.row(k, semiring), known, self.sequences, semiring)
        if after is not None:
            scopes = (c.scope[0] for c in clusters)
            found.go_back(dict(zip(scopes, after[0].in_(semiring), strict=True)))
        return found

    def entries(self, variables: Any) -> float:
        return math.prod(float(self.plan.cards[v]) for v in set(variables))

    def _marginal(self, number: int, scope: Scope, start: int, stop: int) -> np.ndarray:
        """The product of what is kept of each variable; of the slice before, of what is known there."""
        found = np.ones((1,) * (2 + len(scope)))
        first, last = start - self.first, stop - self.first
        for v in scope:
            if v[0] == 0:
                table = self._answers[number].table((v,), first, last)
            else:
                table = self._earlier(number, v, first, last)
            assert table is not None
            found = found * aligned(Named((v,), table), scope)
        return found

    def _earlier(self, number: int, variable: Variable, first: int, last: int) -> np.ndarray:
        """What is known of a variable of the slices before."""
        own = (0, *variable[1:])
        table = self._answers[number].table((own,), max(first - 1, 0), last - 1)
        assert table is not None
        if first == 0:
            before = self._given(number, Cluster((own,), (), self.plan.cards[own]))
            table = np.concatenate([np.exp(before)[None], table])
        return table

    def _culprit_of(self, number: int, t: int, sequence: int) -> str | None:
        rows = self.plan.rows(self.series, t, t + 1)
        before = self._at(number, t - 1) if t else None
        with np.errstate(all="ignore"):
            clusters = self._clusters(number)
            found = self._calibrated(self._stretch(number, rows), 0, clusters, before, None, LOG)
        return next((n for n, total in found.totals if total[sequence] == -np.inf), None)


class Densities:
    """The factors of one chain in some slices, node by node.

    Attributes
    ----------
    log_scale : ndarray, shape (rows, sequences)
        What their tables lack.
    """

    def __init__(self, pieces: Sequence[Piece], count: int, sequences: int) -> None:
        self.log_scale = np.zeros((count, sequences))
        self._pieces, self._lost = pieces, np.zeros(count, dtype=bool)
        self._logs: list[np.ndarray] = []
        for piece in pieces:
            values = piece.values
            if piece.is_evidence:
                top = values.max(axis=tuple(range(2, values.ndim)), keepdims=True)
                top = np.where(np.isfinite(top), top, 0.0)
                self.log_scale += top.reshape(top.shape[:2])
                values = values - top
            low = np.where(values == -np.inf, 0.0, values).reshape(len(values), -1)
            self._lost |= low.min(axis=1, initial=0.0) < LEAST
            self._logs.append(values)

    @cached_property
    def _linear(self) -> list[np.ndarray]:
        with np.errstate(under="ignore"):
            return [np.exp(t) for t in self._logs]

    def row(self, k: int, semiring: Semiring) -> list[tuple[Piece, np.ndarray]]:
        """Those of the k-th slice; FloatingPointError where numbers would lose some."""
        if semiring is LINEAR and self._lost[k]:
            raise FloatingPointError
        tables = self._linear if semiring is LINEAR else self._logs
        return [
            (piece, table[k if len(table) > 1 else 0])
            for piece, table in zip(self._pieces, tables, strict=True)
        ]


class Frontier:
    """Probabilities of the variables of a slice and of the slice before, each by itself.

    Parameters
    ----------
    factors : list of (Piece, ndarray)
        In the order in which nodes are added; tables have shape (sequences or 1, *cards).
    before : dict
        Variable -> its probabilities in the slice before, (sequences, states).

    Attributes
    ----------
    log_z : ndarray, shape (sequences,)
        Log density of what was seen.
    totals : list of (str, ndarray)
        The same by node.
    """

    def __init__(
        self,
        factors: Sequence[tuple[Piece, np.ndarray]],
        before: dict[Variable, np.ndarray],
        sequences: int,
        semiring: Semiring,
    ) -> None:
        self.semiring, self._factors, self._before = semiring, factors, before
        self._shape = sequences
        self._margins = dict(before)
        self._predicted: dict[Variable, np.ndarray] = {}
        self._messages: list[tuple[Variable, np.ndarray]] = []
        self.totals: list[tuple[str, np.ndarray]] = []
        self.log_z = np.zeros(sequences)
        for piece, table in factors:
            if piece.is_evidence:
                self._absorb(piece, table)
            else:
                own = piece.scope[-1]
                found, _ = self._normalised(self._summed(piece.scope, table, own))
                self._margins[own] = self._predicted[own] = found

    def table(self, scope: Scope) -> np.ndarray:
        """Probabilities of one variable, (sequences, states)."""
        return self._margins[scope[0]]

    def go_back(self, later: dict[Variable, np.ndarray]) -> None:
        """Take in what is known of the slice from later rows, and tell the slice before."""
        for piece, table in self._factors:
            if piece.is_evidence:
                continue
            *parents, own = piece.scope
            says = self.semiring.ratio(later[own], self._predicted[own])
            for parent in parents:
                given = {**self._before, own: says}
                self._messages.append((parent, self._summed(piece.scope, table, parent, given)))
        self._margins = {**self._before, **later}
        for variable, message in self._messages:
            product = self.semiring.multiply(self._margins[variable], message)
            self._margins[variable], _ = self._normalised(product)

    # ---- private ----------------------------------------------------------------------------

    def _absorb(self, piece: Piece, table: np.ndarray) -> None:
        """Multiply what was seen into the product of the variables that it depends on."""
        after = {}
        for v in piece.scope:
            message = self._summed(piece.scope, table, v)
            if v[0] == 1:
                self._messages.append((v, message))
            product = self.semiring.multiply(self._margins[v], message)
            after[v], total = self._normalised(product)
        self._margins |= after
        self.totals.append((piece.node, total))
        self.log_z = self.log_z + total

    def _summed(
        self,
        scope: Scope,
        table: np.ndarray,
        keep: Variable,
        margins: dict[Variable, np.ndarray] | None = None,
    ) -> np.ndarray:
        """A factor times the probabilities of all variables but one, these summed out."""
        given = self._margins if margins is None else margins
        for axis in range(len(scope), 0, -1):
            v = scope[axis - 1]
            if v != keep:
                other = given[v]
                shape = (len(other), *(1,) * (axis - 1), -1, *(1,) * (table.ndim - 1 - axis))
                product = self.semiring.multiply(table, other.reshape(shape))
                table = self._sum(product, axis)
        return table

    def _sum(self, table: np.ndarray, axis: int) -> np.ndarray:
        return log_sum_exp(table, axis) if self.semiring is LOG else np.add.reduce(table, axis)

    def _normalised(self, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Probabilities, and the log of what they added up to, (sequences,)."""
        total = self._sum(table, -1)
        if self.semiring is LOG:
            found = table - np.where(total == -np.inf, 0.0, total)[:, None]
            return self._full(found), np.broadcast_to(total, self._shape)
        found = table / np.where(total > 0.0, total, 1.0)[:, None]
        return self._full(found), np.broadcast_to(np.log(total), self._shape)

    def _full(self, table: np.ndarray) -> np.ndarray:
        return np.broadcast_to(table, (self._shape, *table.shape[1:]))


# ---- private ------------------------------------------------------------------------------------


def _in_order(pieces: Sequence[Piece]) -> list[Piece]:
    """Nodes as they are declared, what is seen as soon as all that it depends on is there."""
    left = [p for p in pieces if p.is_evidence]
    there: set[Variable] = set()
    found: list[Piece] = []
    for piece in (None, *(p for p in pieces if not p.is_evidence)):
        if piece is not None:
            found.append(piece)
            there.add(piece.scope[-1])
        ready = [p for p in left if all(v[0] == 1 or v in there for v in p.scope)]
        found += ready
        left = [p for p in left if p not in ready]
    return found
