"""A template for factored beliefs: chains as clusters, their clique trees, and the tables of some slices."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import numpy as np

from bayesmc.dbn import Slices
from bayesmc.engines.discrete.rows import Piece, Rows
from bayesmc.engines.discrete.slices import DiscreteSlices
from bayesmc.engines.factored.clusters import Cluster, Scope, junction_tree
from bayesmc.engines.factored.tree import SliceTree
from bayesmc.factors.propagation import LINEAR, Semiring

#: logs below this are lost, or soon to be, as numbers
LEAST = -600.0


class FactoredSlices(DiscreteSlices):
    """A template as chains over finite variables, whose beliefs are products over clusters.

    Parameters
    ----------
    choose : callable
        Of this, the clusters of all that slices hand on.

    Other parameters are those of ``DiscreteSlices``.

    Attributes
    ----------
    clusters : list of list of Cluster
        Of each chain.
    """

    def __init__(
        self,
        slices: Slices,
        apart: tuple[str, ...],
        seen: frozenset[str],
        static: Mapping[str, np.ndarray],
        leaves: bool,
        absent: frozenset[str],
        choose: Callable[[DiscreteSlices], Sequence[Scope]],
    ) -> None:
        super().__init__(slices, apart, seen, static, leaves, absent)
        self.seen, self.absent = seen, absent
        self._asked: dict[tuple[int, int], list[Scope]] = {}
        self._trees: dict[tuple[int, int], SliceTree] = {}
        scopes = choose(self)
        self.clusters: list[list[Cluster]] = [
            junction_tree(scopes, chain.state, self) for chain in self.chains
        ]

    def has_density(self, name: str) -> bool:
        """Whether slices have a factor of a node: it is a variable, or it may be observed."""
        return name in self.reader.variables or name not in self.absent

    def tree(self, number: int, kind: int) -> SliceTree:
        """The clique tree of a chain in slices of a kind; later ones have the slice before in it."""
        if (number, kind) not in self._trees:
            self._trees[number, kind] = self.tree_of(number, kind, self.clusters[number])
        return self._trees[number, kind]

    def tree_of(self, number: int, kind: int, clusters: Sequence[Cluster]) -> SliceTree:
        """The same with other clusters."""
        chain = self.chains[number]
        variables = [*chain.state, *chain.inside, *(chain.before if kind else ())]
        scopes = [s for k, name, s in self._scopes[number] if k == kind and self.has_density(name)]
        scopes += [c.scope for c in clusters] + [c.before for c in clusters if kind]
        scopes += [(v,) for v in (*chain.state, *chain.inside)]  # what was seen of one
        cards = {v: self.cards[v] for v in variables}
        return SliceTree(cards, scopes, self.reader.sequences)

    def beside(self, number: int, kind: int) -> list[Scope]:
        """Variables that answers want and no cluster holds, where a clique of such a slice does.

        They are those that are summed out, and what the nodes read that are no variables.
        """
        if (number, kind) not in self._asked:
            scopes: list[Scope] = [(v,) for v in self.chains[number].inside]
            for name in self.slices.dynamic:
                if name not in self.reader.variables and name not in self.seen:
                    term = self.terms[name, kind]
                    every = range(self.reader.elements(name))
                    scopes += [self.reader.scope(term, element) for element in every]
            held = [set(c.scope) for c in self.clusters[number]]
            own = {*self.chains[number].state, *self.chains[number].inside}
            own |= set(self.chains[number].before)
            tree = self.tree(number, kind)
            self._asked[number, kind] = [
                s
                for s in dict.fromkeys(scopes)
                if s
                and own.issuperset(s)
                and not any(set(s) <= h for h in held)
                and tree.reading(s)
            ]
        return self._asked[number, kind]

    @cached_property
    def widest(self) -> list[float]:
        sequences = self.reader.sequences
        return [self.tree(k, 2).largest / sequences for k in range(len(self.chains))]

    @cached_property
    def row_entries(self) -> list[float]:
        """Entries of the factors that come with the row, of each chain."""
        found = []
        for number in range(len(self.chains)):
            moving = [s for n, s in self._later(number) if self._may_move(n)]
            found.append(sum(math.prod(float(self.cards[v]) for v in s) for s in moving))
        return [max(1.0, n) * self.reader.sequences for n in found]

    def stretch(self, number: int, pieces: Sequence[Piece], rows: Rows) -> Stretch:
        """The tables of a chain in some slices."""
        tree = self.tree(number, rows.kind)
        always = [p for p in pieces if len(p.values) == 1 and not self._moves(p)]
        held = {id(p) for p in always}
        key = (number, rows.kind, frozenset(held))
        if key not in self._fixed:
            self._fixed[key] = Always(tree, always)
        further = [p for p in pieces if id(p) not in held]
        return Stretch(tree, self._fixed[key], further, rows.count)


class Always:
    """The factors that are the same in all slices, one full table for each clique.

    Attributes
    ----------
    logs : list of ndarray
    linear : list of ndarray or None
        None where numbers would lose some.
    log_scale : float
        What both lack.
    """

    def __init__(self, tree: SliceTree, pieces: Sequence[Piece]) -> None:
        sums = [np.zeros(shape) for shape in tree.shapes]
        for piece in pieces:
            clique, table = tree.placed(piece.scope, piece.values[0])
            sums[clique] = sums[clique] + table
        tops = [float(s.max(initial=-np.inf)) for s in sums]
        tops = [t if np.isfinite(t) else 0.0 for t in tops]
        self.logs = [s - t for s, t in zip(sums, tops, strict=True)]
        self.linear = (
            None if any(_is_lost(s) for s in self.logs) else [np.exp(s) for s in self.logs]
        )
        self.log_scale = sum(tops)


class Stretch:
    """The factors of one chain in some slices.

    Attributes
    ----------
    tree : SliceTree
    log_scale : ndarray, shape (rows, sequences)
        What its tables lack.
    """

    def __init__(
        self, tree: SliceTree, always: Always, pieces: Sequence[Piece], count: int
    ) -> None:
        self.tree, self._always = tree, always
        self.log_scale = np.full((count, tree.sequences), always.log_scale)
        sums: dict[tuple[int, tuple[bool, ...]], np.ndarray] = {}  # of one clique and scope
        for piece in pieces:
            values = piece.values
            over = tuple(range(2, values.ndim))
            top = values.max(axis=over, keepdims=True) if over else values
            top = np.where(np.isfinite(top), top, 0.0)
            self.log_scale += top.reshape(top.shape[:2])
            clique, table = tree.placed(piece.scope, values - top)
            key = clique, tuple(n > 1 for n in table.shape[1:])
            sums[key] = sums[key] + table if key in sums else table
        self._logs = [(k, np.broadcast_to(t, (count, *t.shape[1:]))) for (k, _), t in sums.items()]
        with np.errstate(under="ignore"):
            self._linear = [(k, np.exp(t)) for k, t in self._logs]
        self._lost = np.zeros(count, dtype=bool)
        for _, table in self._logs:
            low = np.where(table == -np.inf, 0.0, table).reshape(count, -1)
            self._lost |= low.min(axis=1, initial=0.0) < LEAST

    def always(self, semiring: Semiring) -> Sequence[np.ndarray]:
        """The full table of each clique; raises FloatingPointError where numbers would lose some."""
        if semiring is not LINEAR:
            return self._always.logs
        if self._always.linear is None:
            raise FloatingPointError
        return self._always.linear

    def further(self, k: int, semiring: Semiring) -> list[tuple[int, np.ndarray]]:
        """What comes with the k-th row."""
        if semiring is not LINEAR:
            return [(clique, table[k]) for clique, table in self._logs]
        if self._lost[k]:
            raise FloatingPointError
        return [(clique, table[k]) for clique, table in self._linear]


# ---- private ------------------------------------------------------------------------------------


def _is_lost(logs: np.ndarray) -> bool:
    return bool(np.where(logs == -np.inf, 0.0, logs).min(initial=0.0) < LEAST)
