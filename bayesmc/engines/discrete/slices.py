"""The slices of a template whose hidden nodes are finite: chains of joint states, and their tables.

The variables that the next slice reads are the state of a chain; everything else in a slice is summed out.
Variables that no density connects, in any slice, make chains of their own. The tables of a stretch of time
are worked out together: one transition matrix where it is the same in every slice, likelihoods by row.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.categorical import log_sum_exp
from bayesmc.dbn import PREVIOUS, TIME, Series, Slices
from bayesmc.engines.discrete.rows import NEUTRAL, Piece, Rows, Variable
from bayesmc.engines.discrete.terms import SliceReader
from bayesmc.factors.named import connected, largest, log_product, summed

#: entries of tables of many slices that are worked out together: they stay near the processor
STRETCH_ENTRIES = 1 << 18
#: entries of one table above which questions are refused
BLOCK_ENTRIES = 1 << 22


@dataclass(frozen=True, eq=False)
class Chain:
    """Variables that meet in some slice.

    Attributes
    ----------
    state : tuple of Variable
        Those that the next slice reads, seen from their own slice.
    before : tuple of Variable
        The same, seen from the next slice.
    inside : tuple of Variable
        All others.
    size : int
        Joint states.
    """

    state: tuple[Variable, ...]
    before: tuple[Variable, ...]
    inside: tuple[Variable, ...]
    size: int


@dataclass(frozen=True, eq=False)
class Block:
    """Tables of one chain in a stretch of slices, in logs; sequences that do not differ have size one.

    Attributes
    ----------
    start, stop : int
    fixed : ndarray or None, shape (sequences, states, states)
        Transitions that are the same in all of them; None in slice 0.
    moving : ndarray or None, shape (rows, sequences, states, states)
        Further factors of the transitions, by row.
    likelihood : ndarray, shape (rows, sequences, states)
    """

    start: int
    stop: int
    fixed: np.ndarray | None
    moving: np.ndarray | None
    likelihood: np.ndarray


class DiscreteSlices:
    """A template as chains over finite variables.

    Parameters
    ----------
    slices : Slices
    apart : tuple of str
        Plates that are filtered separately.
    seen : set of str
        Nodes observed in full throughout.
    static : dict
    leaves : bool
        Finite nodes that nobody reads are left to be answered for afterwards, where they are missing.
    absent : frozenset of str
        Nodes that are never observed.
    """

    def __init__(
        self,
        slices: Slices,
        apart: tuple[str, ...],
        seen: frozenset[str],
        static: Mapping[str, np.ndarray],
        leaves: bool = True,
        absent: frozenset[str] = frozenset(),
    ) -> None:
        self.slices, model = slices, slices.first
        names = variables_of(slices, seen, leaves)
        self.reader = SliceReader(slices, apart, names, static)
        self.densities = tuple(n for n in slices.dynamic if n in names or model[n].is_stochastic)
        self.terms = {(n, k): self.reader.term(n, k) for n in slices.dynamic for k in (0, 1, 2)}
        self.cards: dict[Variable, int] = {
            (lag, n, e): self.reader.card(n)
            for n in slices.dynamic
            if n in names
            for e in range(self.reader.elements(n))
            for lag in (0, 1)
        }
        self.has_second = any(self.terms[n, 2].hands_on for n in slices.dynamic)
        self.chains = self._chains()
        self._home = {v: k for k, c in enumerate(self.chains) for v in (*c.state, *c.inside)}
        self._home |= {v: k for k, c in enumerate(self.chains) for v in c.before}
        self.unseen = absent & names
        self._scopes = self._scopes_by_chain()
        self._fixed: dict[Any, Any] = {}

    # ---- what there is ----------------------------------------------------------------------

    def kind(self, t: int) -> int:
        """Which terms hold in slice ``t``."""
        return min(t, 2) if t == 0 or self.has_second else 2

    def stretches(self, start: int, stop: int, length: int) -> Iterator[tuple[int, int]]:
        """Slices cut into runs of one kind, of at most so many rows."""
        t = start
        while t < stop:
            end = t + 1 if self.kind(t) < 2 else min(stop, t + length)
            yield t, end
            t = end

    def chain_of(self, variable: Variable) -> int:
        """The position of the chain that a variable belongs to."""
        return self._home[variable]

    def scopes(self, kind: int) -> list[tuple[str, tuple[Variable, ...]]]:
        """The scopes of all densities in slices of a kind, by node."""
        found = []
        for name in self.densities:
            term = self.terms[name, kind]
            own = name in self.reader.variables
            for element in range(self.reader.elements(name)):
                scope = self.reader.scope(term, element)
                found.append((name, (*scope, (0, name, element)) if own else scope))
        return found

    @cached_property
    def widest(self) -> list[float]:
        """Entries of the largest table of a slice, of each chain."""
        return [
            largest([s for _, s in self._later(k)], (*chain.before, *chain.state), self.cards)
            for k, chain in enumerate(self.chains)
        ]

    @cached_property
    def row_entries(self) -> list[float]:
        """Entries of the tables that differ from row to row, for one row of each chain."""
        return [self._entries_of(k) for k in range(len(self.chains))]

    # ---- tables -----------------------------------------------------------------------------

    def pieces(self, rows: Rows, number: int | None) -> list[Piece]:
        """The factors of a chain in some slices, or those over no variable (``number`` None).

        What is always the same has one row.
        """
        found = {name for _, name, _ in self._scopes[number]}
        wanted = (name for name in self.densities if name in found)
        return [p for name in wanted for p in self.of_node(name, rows)]

    def of_node(self, name: str, rows: Rows) -> list[Piece]:
        """The factors of one node."""
        reader = self.reader
        term = self.terms[name, rows.kind]
        own = name in reader.variables
        if not own:
            return reader.pieces(term, rows) if name in rows.series.observed else []
        if term.clock or term.reads:
            return [*reader.pieces(term, rows), *reader.indicators(name, rows)]
        key = (name, rows.kind)
        if key not in self._fixed:
            self._fixed[key] = reader.pieces(term, rows)
        return [*self._fixed[key], *reader.indicators(name, rows)]

    def rows(self, series: Series, start: int, stop: int) -> Rows:
        """Some slices of a series, all of one kind."""
        return Rows(series, start, stop, self.kind(start))

    def block(
        self,
        number: int,
        pieces: Sequence[Piece],
        rows: Rows,
        reduce: Callable[[np.ndarray, int], np.ndarray] = log_sum_exp,
    ) -> Block:
        """The tables of one chain, with what is inside its slices summed (or maximised) out."""
        chain = self.chains[number]
        inside = {*chain.before, *chain.state, *chain.inside}
        own = [p for p in pieces if p.scope and p.scope[0] in inside]
        bound = connected(chain.inside, [p.scope for p in own])
        fixed: list[Piece] = []
        varying: list[Piece] = []
        for group in bound:
            members = [p for p in own if set(group) & set(p.scope)]
            keep = tuple(dict.fromkeys(v for p in members for v in p.scope if v not in group))
            still = not any(self._moves(p) for p in members)
            key = (number, rows.kind, group, reduce)
            if still and key in self._fixed:
                fixed.append(self._fixed[key])
                continue
            part = Piece("", keep, summed(members, keep, self.cards, reduce))
            if still:
                self._fixed[key] = part
            (fixed if still else varying).append(part)
        rest = [p for p in own if not set(chain.inside) & set(p.scope)]
        varying += [p for p in rest if self._moves(p)]
        fixed += [p for p in rest if not self._moves(p)]
        return self._assembled(number, rows, fixed, varying, reduce)

    def try_out(self, series: Series) -> None:
        """Evaluate every function once in slices of each kind, so that one that fails does so early."""
        for t in range(series.start, min(series.start + 3, series.start + series.steps)):
            rows = self.rows(series, t, t + 1)
            for name in self.densities:
                self.of_node(name, rows)

    # ---- private ----------------------------------------------------------------------------

    def _later(self, number: int) -> list[tuple[str, tuple[Variable, ...]]]:
        """Scopes of the densities of a chain in later slices, by node."""
        return [(name, scope) for kind, name, scope in self._scopes[number] if kind == 2]

    def _entries_of(self, number: int) -> float:
        chain, scopes = self.chains[number], self._later(number)
        widest = float(chain.size)
        for group in connected(chain.inside, [s for _, s in scopes]):
            part = [(n, s) for n, s in scopes if set(group) & set(s)]
            if any(self._may_move(n) for n, _ in part):
                keep = {v for _, s in part for v in s if v not in group}
                widest = max(widest, largest([s for _, s in part], keep, self.cards))
                if any(v in keep for v in chain.before):
                    widest = max(widest, float(chain.size) ** 2)
        for name, scope in scopes:
            if self._may_move(name):
                widest = max(widest, math.prod(float(self.cards[v]) for v in scope))
                if any(v in scope for v in chain.before):
                    widest = max(widest, float(chain.size) ** 2)
        return widest * self.reader.sequences

    def _assembled(
        self, number: int, rows: Rows, fixed: list[Piece], varying: list[Piece], reduce: Any
    ) -> Block:
        chain = self.chains[number]
        size, scope = chain.size, chain.state
        if rows.kind == 0:
            table = self._product([*fixed, *varying], scope)
            return Block(rows.start, rows.stop, None, None, _full(table, rows, (size,)))
        pair = (*chain.before, *scope)
        here = [p for p in varying if not set(p.scope) & set(chain.before)]
        both = [p for p in varying if set(p.scope) & set(chain.before)]
        likelihood = _full(self._product(here, scope), rows, (size,))
        # which factors are fixed depends on what is observed, and that on the row where rows come singly
        key = (number, rows.kind, reduce, frozenset(id(p) for p in fixed))
        if key not in self._fixed:
            table = self._product(fixed, pair)
            kept = tuple(fixed)  # what lives hands its id to nothing else
            self._fixed[key] = kept, table.reshape(table.shape[1], size, size)
        moving = None
        if both:
            table = self._product(both, pair)
            moving = _full(table, rows, (size, size))
        return Block(rows.start, rows.stop, self._fixed[key][1], moving, likelihood)

    def _product(self, pieces: Sequence[Piece], scope: Sequence[Variable]) -> np.ndarray:
        return log_product(pieces or [NEUTRAL], scope, self.cards)

    def _moves(self, piece: Piece) -> bool:
        """Whether a piece may differ from row to row."""
        return piece.is_evidence or self._reads(piece.node)

    def _may_move(self, name: str) -> bool:
        """Whether some piece of a node may differ from row to row."""
        return name not in self.unseen or self._reads(name)

    def _reads(self, name: str) -> bool:
        return any(t.clock or t.reads for t in (self.terms[name, k] for k in (1, 2)))

    def _scopes_by_chain(self) -> dict[int | None, list[tuple[int, str, tuple[Variable, ...]]]]:
        """Kind of slice, node and scope of the densities that hold variables of each chain, or none."""
        found: dict[int | None, list[Any]] = {k: [] for k in (None, *range(len(self.chains)))}
        for kind in (0, 1, 2):
            for name, scope in self.scopes(kind):
                found[self._home[scope[0]] if scope else None].append((kind, name, scope))
        return found

    def _chains(self) -> list[Chain]:
        """Variables grouped by the densities of all kinds of slices."""
        own = [v for v in self.cards if v[0] == 0]
        scopes = [s for kind in (0, 1, 2) for _, s in self.scopes(kind)]
        read = {v for s in scopes for v in s if v[0] == 1}
        for name in self.slices.dynamic:  # answers are wanted of nodes without a density, too
            for kind in (1, 2):
                for element in range(self.reader.elements(name)):
                    scope = self.reader.scope(self.terms[name, kind], element)
                    read |= {v for v in scope if v[0] == 1}
        flat = [[(0, *v[1:]) for v in s] for s in scopes]
        chains = []
        for members in connected(own, flat):
            state = tuple(v for v in members if (1, *v[1:]) in read)
            before = tuple((1, *v[1:]) for v in state)
            inside = tuple(v for v in members if v not in state)
            size = math.prod(self.cards[v] for v in state)
            chains.append(Chain(state, before, inside, size))
        return chains


def variables_of(slices: Slices, seen: frozenset[str], leaves: bool) -> frozenset[str]:
    """The finite nodes to sum over: hidden ones, and deterministic ones that others read."""
    first, later = slices.first, slices.later
    children: dict[str, set[str]] = {n: set() for n in slices.dynamic}
    for model in (first, later):
        for name in slices.dynamic:
            for parent in model[name].parents:
                stem = parent.removesuffix(PREVIOUS)
                if stem in children:
                    children[stem].add(name)
    found: set[str] = set()
    for name in slices.dynamic:
        a, b = first[name], later[name]
        if a.domain is None or b.domain is None or name in seen:
            continue
        if a.is_stochastic:
            if children[name] or not leaves:
                found.add(name)
        elif children[name] and a.domain.states == b.domain.states and not a.event_shape:
            if not _follows(slices, name, found):
                found.add(name)
    return frozenset(found)


# ---- private ------------------------------------------------------------------------------------


def _follows(slices: Slices, name: str, variables: set[str]) -> bool:
    """Whether a deterministic node follows from variables of its slice that the next one has, anyway."""
    for model in (slices.first, slices.later):
        todo = [name]
        while todo:
            for parent in model[todo.pop()].parents:
                if parent in slices.template.static or parent in slices.template.inputs:
                    continue
                if parent not in slices.dynamic:
                    if parent == TIME:
                        continue
                    return False
                if parent in variables:
                    if parent not in slices.interface:
                        return False
                elif model[parent].is_stochastic:
                    continue
                else:
                    todo.append(parent)
    return True


def _full(table: np.ndarray, rows: Rows, tail: tuple[int, ...]) -> np.ndarray:
    """Flattened to ``(rows, sequences, *tail)``."""
    flat = table.reshape(table.shape[0], table.shape[1], *tail)
    return np.broadcast_to(flat, (rows.count, flat.shape[1], *tail))
