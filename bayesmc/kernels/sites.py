"""Log factors on the elements of one finite variable, read from the terms that it enters.

A *batch* holds like factors: one row per factor, each on a few elements of finite chain nodes. Everything
else is filled in. Terms that read hidden nodes in any other way cannot be read, and the caller looks for
another kernel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError
from bayesmc.kernels.conditionals import FiniteTerms
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.relation import Relation
from bayesmc.structure.tables import indexed_table
from bayesmc.structure.target import Target, Term

#: entries up to which a batch is tabulated
_ENTRIES = 1 << 24


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
