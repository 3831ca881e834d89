"""Probabilities of clusters over time, as numbers and, where these would lose some, as logs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from bayesmc.categorical import pick
from bayesmc.engines.discrete.rows import Variable
from bayesmc.engines.factored.clusters import Cluster, Scope
from bayesmc.engines.factored.slices import LEAST
from bayesmc.factors.propagation import LINEAR, LOG, Semiring


class Belief(NamedTuple):
    """Tables of the clusters of one slice, (sequences, *cards) each.

    Attributes
    ----------
    tables : list of ndarray
    logs : list of ndarray or None
        Where the tables have lost entries, or soon may.
    """

    tables: Sequence[np.ndarray]
    logs: Sequence[np.ndarray] | None = None

    def in_(self, semiring: Semiring) -> Sequence[np.ndarray]:
        """Its tables for some arithmetic; FloatingPointError where numbers have lost some."""
        if semiring is not LINEAR:
            return self.logs if self.logs is not None else [_log(t) for t in self.tables]
        if self.logs is not None:
            raise FloatingPointError
        return self.tables


def belief_of(tables: Sequence[np.ndarray], semiring: Semiring) -> Belief:
    """Tables that came out of some arithmetic."""
    if semiring is not LOG:
        return Belief(tables)
    with np.errstate(under="ignore"):
        linear = [np.exp(t) for t in tables]
    low = min((float(np.where(t == -np.inf, 0.0, t).min(initial=0.0)) for t in tables), default=0.0)
    return Belief(linear, tables if low < LEAST else None)


class Beliefs:
    """Tables of the clusters of one chain in all slices.

    Attributes
    ----------
    clusters : list of Cluster
    tables : list of ndarray, shape (steps, sequences, *cards)
    increments : ndarray, shape (steps, sequences)
        Log density of each row given those before.
    """

    def __init__(
        self,
        clusters: Sequence[Cluster],
        cards: Mapping[Variable, int],
        steps: int,
        sequences: int,
    ) -> None:
        self.clusters = clusters
        self.tables = [
            np.full((steps, sequences, *(cards[v] for v in c.scope)), np.nan) for c in clusters
        ]
        self.increments = np.full((steps, sequences), np.nan)
        self._logs: dict[int, Sequence[np.ndarray]] = {}
        self._beside: dict[Scope, np.ndarray] = {}

    def put(self, t: int, found: Belief) -> None:
        """Keep what is known of a slice."""
        for kept, table in zip(self.tables, found.tables, strict=True):
            kept[t] = table
        self._logs.pop(t, None)
        if found.logs is not None:
            self._logs[t] = found.logs

    def put_beside(self, t: int, scopes: Sequence[Scope], found: Belief) -> None:
        """Keep what was read off a slice besides."""
        for scope, table in zip(scopes, found.tables, strict=True):
            if scope not in self._beside:
                self._beside[scope] = np.full((*self.increments.shape, *table.shape[1:]), np.nan)
            self._beside[scope][t] = table

    def at(self, t: int) -> Belief:
        """What is known of a slice."""
        return Belief([table[t] for table in self.tables], self._logs.get(t))

    def logs(self, number: int, start: int, stop: int) -> np.ndarray:
        """Logs of a cluster's tables in some slices."""
        found = _log(self.tables[number][start:stop])
        for t in range(start, stop):
            if t in self._logs:
                found[t - start] = self._logs[t][number]
        return found

    def holding(self, variables: Iterable[Variable]) -> int | None:
        """The smallest cluster that has them all."""
        asked = set(variables)
        able = [k for k, c in enumerate(self.clusters) if asked <= set(c.scope)]
        return min(able, key=lambda k: self.clusters[k].size, default=None)

    def table(self, scope: Scope, start: int, stop: int) -> np.ndarray | None:
        """Probabilities of variables kept together, (rows, sequences, *cards); None where they are not."""
        number = self.holding(scope)
        if number is None:
            beside = self._beside.get(scope)
            known = beside is not None and not np.isnan(beside[start:stop]).any()
            return beside[start:stop] if beside is not None and known else None
        own, table = self.clusters[number].scope, self.tables[number][start:stop]
        out = tuple(2 + k for k, v in enumerate(own) if v not in scope)
        left = [v for v in own if v in scope]
        found = table.sum(axis=out) if out else table
        return found.transpose(0, 1, *(2 + left.index(v) for v in scope))

    def drawn(self, t: int, rng: np.random.Generator, count: int) -> dict[Variable, np.ndarray]:
        """Draws from the belief of a slice, shape (count, sequences) for each variable."""
        found: dict[Variable, np.ndarray] = {}
        for cluster, tables in zip(self.clusters, self.tables, strict=True):
            table, free = tables[t], [v for v in cluster.scope if v not in cluster.separator]
            order = [*cluster.separator, *free]
            moved = table.transpose(0, *(1 + cluster.scope.index(v) for v in order))
            sizes = moved.shape[1 + len(cluster.separator) :]
            if cluster.separator:
                every = np.arange(len(table))
                chosen = moved[(every, *(found[v] for v in cluster.separator))]
                weights = chosen.reshape(count, len(table), -1)
                flat = pick(np.moveaxis(weights, -1, 0), rng.random((count, len(table))))
            else:
                flat = pick(moved.reshape(len(table), -1).T, rng.random((count, len(table))))
            found.update(zip(free, np.unravel_index(flat, sizes), strict=True))
        return found


# ---- private ------------------------------------------------------------------------------------


def _log(values: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.log(values)
