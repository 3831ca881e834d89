"""The clique tree of two slices in a row: its shapes, found once, and both passes over one slice's tables.

Sequences that are filtered separately are one more variable, which every factor has: it is in every clique
and every separator, so that they share the passes and never meet.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bayesmc.categorical import log_sum_exp
from bayesmc.engines.discrete.rows import Variable
from bayesmc.factors import calibrated as answering
from bayesmc.factors.cliquetree import CliqueTree, Placement
from bayesmc.factors.elimination import Elimination, elimination_order
from bayesmc.factors.propagation import (
    LOG,
    Collected,
    Potentials,
    Semiring,
    collect,
    distribute,
    total_log_scale,
)
from bayesmc.factors.structure import Program, SumStep, sum_steps

Scope = tuple[Variable, ...]
#: the variable that says which sequence it is
_SEQUENCE = (-1, "", 0)


@dataclass(frozen=True)
class Reading:
    """How the joint table of some variables is read off a clique: sums, then axes in order."""

    clique: int
    steps: tuple[SumStep, ...]
    shape: tuple[int, ...]
    axes: tuple[int, ...]


class Tables(NamedTuple):
    """The factors of a slice by clique: those that are always the same, and others that come with the row.

    Attributes
    ----------
    always : list of ndarray
        One full table for each clique.
    further : list of (int, ndarray)
        Clique and a table that broadcasts against its own.
    """

    always: Sequence[np.ndarray]
    further: Sequence[tuple[int, np.ndarray]]


class SliceTree:
    """A clique tree whose cliques hold given scopes.

    Parameters
    ----------
    cards : dict
        Variable -> number of states, of all variables.
    scopes : iterable of scopes
        Each will be within a clique.
    sequences : int

    Attributes
    ----------
    entries : float
        Of all tables together.
    largest : float
        Of the largest table.
    """

    def __init__(
        self, cards: Mapping[Variable, int], scopes: Iterable[Scope], sequences: int
    ) -> None:
        self.sequences = sequences
        self.lead = (_SEQUENCE,) if sequences > 1 else ()
        wanted = [s for s in dict.fromkeys(map(tuple, scopes)) if s]
        index = {v: k for k, v in enumerate(cards)}
        found = elimination_order(list(cards.values()), [[index[v] for v in s] for s in wanted])
        sizes = dict(cards)
        if self.lead:  # it leaves last, so that it is in every clique
            last = len(cards)
            sizes[_SEQUENCE] = sequences
            cliques = (*((*c, last) for c in found.cliques), (last,))
            entries = found.entries * sequences + sequences
            found = Elimination((*found.order, last), cliques, entries, found.fill)
        self._tree = tree = CliqueTree(sizes, [(*self.lead, *s) for s in wanted], found)
        self.entries, self.largest = tree.cost.total_entries, tree.cost.largest_entries
        self._place: dict[Scope, Placement] = dict(zip(wanted, tree.placements, strict=True))
        self._readings: dict[Scope, Reading | None] = {}
        self._kept: Program | None = None

    def reading(self, scope: Scope) -> Reading | None:
        """How the table of some variables is read off; None where no clique holds them all."""
        if scope not in self._readings:
            tree, wanted = self._tree, (*self.lead, *scope)
            at = [tree.index[v] for v in wanted]
            shared = set.intersection(*(set(tree.containing[v]) for v in at)) if at else {0}
            if not shared:
                self._readings[scope] = None
                return None
            k = min(shared, key=lambda c: math.prod(tree.shapes[c]))
            order = tree.cliques[k].variables
            kept = [v for v in order if v in at]
            steps = sum_steps(tree.shapes[k], [v in at for v in order])
            shape = tuple(tree.cardinalities[v] for v in kept)
            self._readings[scope] = Reading(k, steps, shape, tuple(kept.index(v) for v in at))
        return self._readings[scope]

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """Of the table of each clique."""
        return self._tree.shapes

    def placed(self, scope: Scope, table: np.ndarray) -> tuple[int, np.ndarray]:
        """The clique of a factor, and the factor as it broadcasts against the clique's table.

        ``table`` has shape (..., sequences or 1, *cards); axes in front stay.
        """
        where = self._place[scope]
        front = table.ndim - 1 - len(scope)
        own = table
        if not self.lead:
            own = table.reshape(*table.shape[:front], *table.shape[front + 1 :])
        axes = (*range(front), *(front + a for a in where.axes))
        order = self._tree.cliques[where.clique].variables
        held = {self._tree.index[v] for v in (*self.lead, *scope)}
        aligned = own.transpose(axes)
        sizes = iter(aligned.shape[front:])
        shape = (next(sizes) if v in held else 1 for v in order)
        return where.clique, aligned.reshape(*aligned.shape[:front], *shape)

    def calibrated(self, tables: Tables, semiring: Semiring) -> Calibrated | None:
        """Both passes; None where nothing is left. Raises FloatingPointError as floating point is told to."""
        full = list(tables.always)
        for k, further in tables.further:
            full[k] = semiring.multiply(full[k], further)
        cliques, every = self._tree.cliques, set(range(len(full)))
        program = self._bare
        found = collect(cliques, program, Potentials(full, semiring), every, {}, {})
        if found is None:
            return None
        ratios, _ = distribute(cliques, program, found, semiring)
        return Calibrated(self, semiring, found, ratios)

    def answers(
        self, semiring: Semiring, collected: Sequence[Collected], ratios: Sequence[np.ndarray]
    ) -> answering.Calibrated:
        """What the tables say of variables that no clique holds together."""
        context = answering.Context(self._tree, self._bare, semiring, {})
        return answering.Calibrated(context, 0.0, collected, ratios, np.zeros(0))

    @property
    def _bare(self) -> Program:
        """The tree's program without marginals of single variables: sequences are never summed over."""
        if self._kept is None:
            whole = self._tree.program()
            shapes = tuple(replace(c, outputs=()) for c in whole.cliques)
            self._kept = replace(whole, cliques=shapes)
        return self._kept


class Calibrated:
    """The tables of a slice after both passes.

    Attributes
    ----------
    semiring : Semiring
        What its tables are in.
    log_z : ndarray, shape (sequences,)
        Log of the total of the product of all factors.
    """

    def __init__(
        self,
        tree: SliceTree,
        semiring: Semiring,
        collected: Sequence[Collected],
        ratios: Sequence[np.ndarray],
    ) -> None:
        self._tree, self.semiring = tree, semiring
        self._collected, self._ratios = collected, ratios
        self._beliefs: dict[int, np.ndarray] = {}
        log_z = np.array([total_log_scale(collected)])
        if tree.sequences > 1:
            found = tree.reading(())
            assert found is not None
            shares = self._read(found)
            log_z = log_z + (shares if semiring is LOG else _log(shares))
        self.log_z = log_z

    def table(self, scope: Scope) -> np.ndarray:
        """Probabilities of variables that some clique holds, (sequences, *cards), in its semiring."""
        reading = self._tree.reading(scope)
        assert reading is not None
        found = self._read(reading)
        if self._tree.sequences == 1:
            found = found[None]
        over = tuple(range(1, found.ndim))
        if self.semiring is LOG:
            flat = found.reshape(len(found), -1)
            return found - log_sum_exp(flat, -1).reshape(-1, *(1,) * len(over))
        return found / found.sum(axis=over, keepdims=True)

    def joint(self, scope: Scope) -> np.ndarray:
        """Probabilities of any variables, (sequences, *cards)."""
        tree = self._tree
        if tree.reading(scope) is not None:
            found = self.table(scope)
        else:
            found = tree.answers(self.semiring, self._collected, self._ratios).joint(
                (*tree.lead, *scope)
            )
            found = found if tree.sequences > 1 else found[None]
            return found / found.sum(axis=tuple(range(1, found.ndim)), keepdims=True)
        with np.errstate(under="ignore"):
            return self.semiring.to_linear(found)

    def _read(self, reading: Reading) -> np.ndarray:
        k, semiring = reading.clique, self.semiring
        if k not in self._beliefs:
            self._beliefs[k] = semiring.multiply(
                self._collected[k].work, self._ratios[k][:, None]
            ).reshape(-1)
        table = self._beliefs[k]
        if reading.steps:
            table = semiring.sum_steps(table, reading.steps)
        return table.reshape(reading.shape).transpose(reading.axes)


def _log(values: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.log(values)
