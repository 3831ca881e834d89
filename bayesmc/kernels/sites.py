"""Log factors on the elements of one finite variable, and like factors on pairs as counts.

A *batch* holds like factors: one row per factor, each on a few elements of finite chain nodes. Everything
else is filled in. Terms that read hidden nodes in any other way cannot be read, and the caller looks for
another kernel.

Where factors on pairs are alike the full conditional of a site depends on its neighbours through how many
are in each state. Written as the digits of a number, every neighbour adds the weight of its state; neighbours
at a common distance are added by one shifted slice of the whole field.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError
from bayesmc.kernels.enumerate import FiniteTerms
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.relation import Relation
from bayesmc.structure.tables import indexed_table
from bayesmc.structure.target import Target, Term

#: entries up to which a batch is tabulated
_ENTRIES = 1 << 24
#: codes are bytes
_CODES = 256
#: rows of the table of full conditionals (kinds of sites times codes)
_ROWS = 1 << 20
_STATES = 8
_COLOURS = 8
#: share of the sites that must have a neighbour at a distance for it to be a shift
_COMMON = 1 / 16
#: share of the neighbours that shifts must reach
_REACHED = 3 / 4


@dataclass(frozen=True, eq=False)
class Batch:
    """Like factors, one per row.

    Attributes
    ----------
    names : tuple of str
        The variable of each entry.
    index : tuple of ndarray of int
        For each entry the flat element that each row reads, shape (rows,).
    log : ndarray, shape (*cards, rows), or (*cards, 1) where all rows are alike
    """

    names: tuple[str, ...]
    index: tuple[np.ndarray, ...]
    log: np.ndarray

    @property
    def rows(self) -> int:
        """Number of factors."""
        return len(self.index[0])


@dataclass(frozen=True, eq=False)
class Sites:
    """All log factors on the elements of one variable.

    Attributes
    ----------
    single : ndarray, shape (states, elements)
        Sum of those on one element alone.
    batches : tuple of Batch
        Those on several elements, of this variable or of others.
    """

    single: np.ndarray
    batches: tuple[Batch, ...]


def sites_of(blanket: Blanket) -> Sites | None:
    """The factors around the elements of a finite variable; None where a term is no such factor."""
    domain = blanket.node.domain
    if domain is None:
        return None
    terms = FiniteTerms(blanket.target)
    single = np.zeros((domain.size, blanket.size))
    batches: list[Batch] = []
    around = [(child.term, child.relation) for child in blanket.children]
    own = [] if blanket.own is None else [(blanket.own, None)]
    for term, relation in [*own, *around]:
        if relation is not None and relation.kind == "rows" and term.is_potential:
            read = _indexed(blanket.target, term)
        else:
            read = _aligned(blanket, terms, term, relation)
        if read is None:
            return None
        if len(read.names) > 1:
            batches.append(read)
            continue
        log = np.broadcast_to(read.log, (domain.size, read.rows))
        for k in range(domain.size):
            single[k] += np.bincount(read.index[0], log[k], blanket.size)
    return Sites(single, tuple(batches))


@dataclass(frozen=True, eq=False)
class PairCounts:
    """Codes of the states around every site, and the full conditional of each code.

    A *field* holds the weights of all states, shape ``(chains, margin + sites + margin)``, zeros in the
    margins.

    Attributes
    ----------
    weights : ndarray of uint8, shape (states,)
        What a neighbour in each state adds to a code; nothing for the first.
    log_probs : ndarray, shape (states, rows)
        Log full conditionals up to a constant.
    base : ndarray of int or None, shape (sites,)
        What is added to a code to give its row; None where codes are rows.
    start : ndarray of uint8, shape (sites,)
        Where codes begin.
    shifts : tuple of (offset, multiplier, mask or None)
        Distances at which neighbours lie, and which sites have one there.
    loose : tuple of tuple of (sites, neighbours, multiplier)
        All other neighbours, for each colour; no site stands twice in one entry.
    """

    weights: np.ndarray
    log_probs: np.ndarray
    base: np.ndarray | None
    start: np.ndarray
    shifts: tuple[tuple[int, int, np.ndarray | None], ...]
    loose: tuple[tuple[tuple[np.ndarray, np.ndarray, int], ...], ...]

    @property
    def margin(self) -> int:
        return max((abs(offset) for offset, _, _ in self.shifts), default=0)

    def inner(self, field: np.ndarray) -> np.ndarray:
        """The field without its margins, a view."""
        return field[:, self.margin : self.margin + len(self.start)]

    def codes(self, field: np.ndarray, colour: int) -> np.ndarray:
        """Code of every site, shape ``(chains, sites)``; they are right for the sites of the colour."""
        margin, count = self.margin, len(self.start)
        code = np.broadcast_to(self.start, (len(field), count)).copy()
        for offset, multiplier, mask in self.shifts:
            part = field[:, margin + offset : margin + offset + count]
            if mask is not None:
                part = part & mask
            if multiplier != 1:
                part = part * np.uint8(multiplier)
            code += part
        for sites, neighbours, multiplier in self.loose[colour]:
            code[:, sites] += field[:, margin + neighbours] * np.uint8(multiplier)
        return code


def pair_counts(name: str, sites: Sites, classes: Sequence[np.ndarray | None]) -> PairCounts | None:
    """Counts for a field of few states and like pairs, mostly at common distances; else None."""
    states, count = sites.single.shape
    if not 1 < states <= _STATES or len(classes) > _COLOURS or not sites.batches:
        return None
    if not all(b.names == (name, name) and np.isfinite(b.log).all() for b in sites.batches):
        return None
    edges = _edges(sites)
    if edges is None or not len(edges.site):
        return None
    digits = _digits(edges, states, count)
    if digits is None:
        return None
    weights, multipliers, codes = digits
    top = edges.single.max(axis=0)
    if not np.isfinite(top).all():
        return None
    kinds, kind = _distinct_rows((edges.single - top).T)
    if len(kinds) * codes > _ROWS:
        return None
    shifts, loose = _placed(edges, multipliers, count, classes)
    if sum(len(s) for part in loose for s, _, _ in part) > (1 - _REACHED) * len(edges.site):
        return None
    log = _conditionals(kinds, edges.tables, weights, multipliers, codes)
    begin = kind * codes
    if len(kinds) * codes <= _CODES:
        return PairCounts(weights, log, None, begin.astype(np.uint8), shifts, loose)
    start = np.zeros(count, dtype=np.uint8)
    return PairCounts(weights, log, begin.astype(np.intp), start, shifts, loose)


# ---- private ------------------------------------------------------------------------------------


def _indexed(target: Target, term: Term) -> Batch | None:
    """A potential over rows of an index, at all states of its hidden entries."""
    model = target.model
    potential, _ = model.potentials[term.name]
    index = potential.index
    if index is None:
        return None
    inside = set(target.chain)
    hidden = [i for i, n in enumerate(potential.scope) if n in inside or n not in target.known]
    nodes = [model[potential.scope[i]] for i in hidden]
    if not all(n.name in inside and n.domain is not None for n in nodes):
        return None
    cards = tuple(n.domain.size for n in nodes)  # type: ignore[union-attr]
    if math.prod(cards) * term.shape[0] > _ENTRIES:
        return None
    try:
        with marking_invalid(), np.errstate(all="ignore"):
            log = indexed_table(model, term.name, target.known, hidden)
    except BayesmcError:
        return None  # it fails at some states, perhaps at impossible ones
    if (log == log[..., :1]).all():
        log = log[..., :1]
    names = tuple(n.name for n in nodes)
    return Batch(names, tuple(np.asarray(index[i]) for i in hidden), log)


def _aligned(
    blanket: Blanket, terms: FiniteTerms, term: Term, relation: Relation | None
) -> Batch | None:
    """A term in the variable's own plates: one row per element."""
    table = terms.of(term)
    if table is None or (relation is not None and relation.kind != "aligned"):
        return None
    node = blanket.node
    cards = table.log.shape[: len(table.scope)]
    if table.scope == (blanket.name,):
        log = table.log if relation is None else relation.collect(table.log, term.shape)
        log = np.broadcast_to(log, cards + node.plate_shape)
    elif table.plates == node.plates and all(
        blanket.target.model[n].plates == node.plates for n in table.scope
    ):
        log = table.log
    else:
        return None
    every = np.arange(blanket.size)
    return Batch(table.scope, (every,) * len(table.scope), log.reshape(*cards, -1))


@dataclass(frozen=True, eq=False)
class _Edges:
    """Every pair seen from both its ends: ``tables[kind]`` holds the log factors of (own, other) states.

    The first row and column of each table are zero; what that leaves stands in ``single``.
    """

    site: np.ndarray
    other: np.ndarray
    kind: np.ndarray
    tables: np.ndarray
    single: np.ndarray


def _edges(sites: Sites) -> _Edges | None:
    states, count = sites.single.shape
    single = sites.single.copy()
    ends, others, tables, kinds = [], [], [], []
    known = 0
    for batch in sites.batches:
        for own in (0, 1):
            log = batch.log if own == 0 else batch.log.swapaxes(0, 1)
            log = log - log[:1]
            for k in range(1, states):
                part = np.broadcast_to(log[k, 0], batch.rows)
                single[k] += np.bincount(batch.index[own], part, count)
            rows = (log - log[:, :1]).reshape(states * states, -1).T
            distinct, kind = _distinct_rows(rows)
            if len(distinct) > _CODES:
                return None
            ends.append(batch.index[own])
            others.append(batch.index[1 - own])
            kinds.append(np.broadcast_to(kind + known, (batch.rows,)))
            tables.append(distinct)
            known += len(distinct)
    distinct, kind = _distinct_rows(np.concatenate(tables))
    of = kind[np.concatenate(kinds)]
    idle = np.asarray(~distinct.any(axis=1))  # factors that tie nothing
    keep = ~idle[of]
    renumbered = np.cumsum(~idle) - 1
    return _Edges(
        np.concatenate(ends)[keep],
        np.concatenate(others)[keep],
        renumbered[of[keep]],
        distinct[~idle].reshape(-1, states, states),
        single,
    )


def _distinct_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different rows of a matrix, and which of them each is; column by column, to sort numbers only."""
    which = np.zeros(len(rows), dtype=np.intp)
    first = np.zeros(1, dtype=np.intp)
    for column in rows.T:
        values, at = np.unique(column, return_inverse=True)
        _, first, which = np.unique(
            which * len(values) + at, return_index=True, return_inverse=True
        )
    return rows[first], which


def _digits(edges: _Edges, states: int, count: int) -> tuple[np.ndarray, list[int], int] | None:
    """Weights of the states, a multiplier for each kind of pair, and the number of codes."""
    kinds = len(edges.tables)
    most = [
        int(np.bincount(edges.site[edges.kind == t], minlength=count).max()) for t in range(kinds)
    ]
    base = 1 + max(most)
    codes = 1
    multipliers = []
    for degree in most:
        multipliers.append(codes)
        codes *= 1 + degree if states == 2 else base ** (states - 1)
        if codes > _CODES:
            return None
    weights = [0, *(base**k for k in range(states - 1))]
    return np.array(weights, dtype=np.uint8), multipliers, codes


def _conditionals(
    kinds: np.ndarray, tables: np.ndarray, weights: np.ndarray, multipliers: list[int], codes: int
) -> np.ndarray:
    """Log full conditionals, shape (states, kinds of sites * codes)."""
    states = len(weights)
    code = np.arange(codes)
    log = np.zeros((codes, states))
    bounds = [*multipliers[1:], codes]
    for table, multiplier, bound in zip(tables, multipliers, bounds, strict=True):
        digits = code % bound // multiplier
        for state in range(states - 1, 0, -1):
            number, digits = np.divmod(digits, int(weights[state]))
            log += number[:, None] * table[:, state]
    return (kinds[:, None] + log).reshape(-1, states).T


def _placed(
    edges: _Edges, multipliers: list[int], count: int, classes: Sequence[np.ndarray | None]
) -> tuple[tuple, tuple]:
    """Neighbours by common distance, and the rest."""
    offset = edges.other - edges.site
    key = edges.kind * (2 * count) + offset + count
    left = np.ones(len(key), dtype=bool)
    shifts = []
    for common in np.flatnonzero(np.bincount(key) >= _COMMON * count):
        at = np.flatnonzero(key == common)
        at = at[np.unique(edges.site[at], return_index=True)[1]]  # of a pair that stands twice, one
        left[at] = False
        kind, distance = divmod(int(common), 2 * count)
        distance -= count
        mask = np.zeros(count, dtype=np.uint8)
        mask[edges.site[at]] = 255
        reached = np.arange(count) + distance
        reads_none = (reached < 0) | (reached >= count)
        whole = bool((mask.astype(bool) | reads_none).all())
        shifts.append((distance, multipliers[kind], None if whole else mask))
    rest = np.flatnonzero(left)
    loose = tuple(_loose(edges, rest, multipliers, count, c) for c in classes)
    return tuple(shifts), loose


def _loose(
    edges: _Edges,
    rest: np.ndarray,
    multipliers: list[int],
    count: int,
    members: np.ndarray | None,
) -> tuple[tuple[np.ndarray, np.ndarray, int], ...]:
    """Remaining neighbours of some sites, in sets in which no site stands twice."""
    inside = np.ones(count, dtype=bool)
    if members is not None:
        inside[:] = False
        inside[members] = True
    found = []
    mine = rest[inside[edges.site[rest]]]
    for kind, multiplier in enumerate(multipliers):
        at = mine[edges.kind[mine] == kind]
        at = at[np.argsort(edges.site[at], kind="stable")]
        ordered = edges.site[at]
        rank = np.arange(len(at)) - np.searchsorted(ordered, ordered)
        for r in range(int(rank.max(initial=-1)) + 1):
            chosen = at[rank == r]
            found.append((edges.site[chosen], edges.other[chosen], multiplier))
    return tuple(found)
