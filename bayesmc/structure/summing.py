"""Finite nodes summed out of a log density: labels element by element, a few others by their joint states.

Nodes that meet in a term make a component. Those without plates are listed, state by state; of plated ones
every element is summed by itself where each entry of a term reads one element of each (the labels of a
mixture, indicators of outliers), which takes as many copies of the terms as there are states. Where elements
hang together all of them are listed. What is left is a log-sum-exp of sums.

References
----------
Stan User's Guide, version 2.36, chapter "Latent Discrete Parameters".
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesmc.errors import TraceError, UnsupportedError
from bayesmc.expression import Constant, Expression, constant, elementwise, pick, reduction, reshape
from bayesmc.passes.arithmetic import ZERO, add
from bayesmc.passes.logarithms import stable
from bayesmc.passes.reads import element_read
from bayesmc.structure.free_terms import elements
from bayesmc.structure.target import Target, Term

#: copies of the terms of a component
MOST_STATES = 512


@dataclass(frozen=True, eq=False)
class Summed:
    """A component: its terms for all states.

    Attributes
    ----------
    terms : tuple of Term
    listed : tuple of dict
        For each joint state of the nodes that are listed: node -> stored value.
    labels : tuple of str
        Nodes that are summed element by element.
    states : tuple of tuple of int
        Joint states of the labels of one element.
    rest : Expression, shape (listed,)
        Sums of the terms' entries that read no label.
    table : Expression or None, shape (listed, states, elements)
        Sums of the others by the element that they read; minus infinity where other labels were seen.
    """

    terms: tuple[Term, ...]
    listed: tuple[dict[str, np.ndarray], ...]
    labels: tuple[str, ...]
    states: tuple[tuple[int, ...], ...]
    rest: Expression
    table: Expression | None

    @property
    def total(self) -> Expression:
        """The log of the sum over all states."""
        total = self.rest
        if self.table is not None:
            total = add(total, reduction(np.add, reduction(np.logaddexp, self.table, [1]), [1]))
        return reduction(np.logaddexp, total, [0])

    def mapped(self, change: Callable[[Expression], Expression]) -> Summed:
        """With its expressions changed."""
        table = None if self.table is None else change(self.table)
        return replace(self, rest=change(self.rest), table=table)

    def at(
        self, values: Mapping[str, np.ndarray], rest: np.ndarray, table: np.ndarray | None
    ) -> float:
        """The sum of the terms for stored values of its nodes, read off the values of its expressions."""
        (row,) = (
            k
            for k, state in enumerate(self.listed)
            if all(np.array_equal(values[n], v) for n, v in state.items())
        )
        total = float(rest[row])
        if table is None:
            return total
        columns = np.stack([np.ravel(values[n]) for n in self.labels], axis=-1)
        place = {state: k for k, state in enumerate(self.states)}
        at = [place[tuple(int(v) for v in column)] for column in columns]
        return total + float(table[row, at, np.arange(len(at))].sum())


def sum_out(
    target: Target, terms: Sequence[Term], names: Sequence[str], above: Mapping[str, Expression]
) -> list[Summed]:
    """The components of finite nodes.

    Parameters
    ----------
    target : Target
    terms : sequence of Term
        All that the nodes enter, and others.
    names : sequence of str
        Finite nodes of the chain.
    above : mapping
        Node -> its value, of those that move.

    Raises
    ------
    UnsupportedError
        A node is not finite, or its elements hang together and have too many joint states.
    """
    for name in names:
        node = target.model[name]
        if node.domain is None or node.event_shape or not node.is_discrete:
            raise UnsupportedError(
                f"node {name!r} has no finite set of states to sum over; give its values, or use Gibbs"
            )
    read = {t.name: _reads(t) & set(names) for t in terms}
    found = []
    for component in _components(names, read.values()):
        own = [t for t in terms if read[t.name] & set(component)]
        found.append(_Component(target, own, component, above).summed())
    return found


def components(target: Target, names: Sequence[str]) -> list[list[str]]:
    """Finite nodes of the chain that meet in terms, and so are summed out together."""
    return _components(names, [_reads(t) & set(names) for t in target.terms_of(names)])


# ---- private ------------------------------------------------------------------------------------


def _reads(term: Term) -> frozenset[str]:
    return frozenset() if term.expression is None else term.expression.leaves


def _components(names: Sequence[str], groups: Iterable[frozenset[str]]) -> list[list[str]]:
    """Names that are together in some group, in their order."""
    of = {n: {n} for n in names}
    for group in groups:
        joined = set().union(*(of[n] for n in group)) if group else set()
        for n in joined:
            of[n] = joined
    found: list[list[str]] = []
    for name in names:
        if not any(name in f for f in found):
            found.append([n for n in names if n in of[name]])
    return found


class _Component:
    """Nodes that meet in terms."""

    def __init__(
        self,
        target: Target,
        terms: Sequence[Term],
        names: Sequence[str],
        above: Mapping[str, Expression],
    ) -> None:
        self.target, self.terms, self.above = target, terms, above
        self.sizes = {n: math.prod(target.model[n].plate_shape) for n in names}
        self.cards = {n: target.model[n].domain.size for n in names}  # type: ignore[union-attr]

    def summed(self) -> Summed:
        labels = [n for n, size in self.sizes.items() if size > 1]
        places = self._aligned(labels) if labels else []
        if places is None:  # elements hang together
            labels, places = [], []
        listed = [n for n in self.sizes if n not in labels]
        states = list(itertools.product(*(range(self.cards[n]) for n in labels)))
        count = math.prod(self.cards[n] ** len(self._hidden(n)) for n in listed)
        if count * len(states) > MOST_STATES:
            self._refuse(listed or labels, count * len(states))
        rows = [self._at(row) for row in self._rows(listed)]
        if not labels:
            sums = [self._sum(row) for row in rows]
            return Summed(tuple(self.terms), tuple(rows), (), ((),), _stacked(sums), None)
        size = self.sizes[labels[0]]
        inside = self._consistent(labels, states, size)
        rest, table = [], []
        for row in rows:
            parts = [self._split(row, labels, state, places, size) for state in states]
            rest.append(parts[0][0])
            table += [part for _, part in parts]
        whole = pick(table, np.arange(len(rows) * len(states) * size).reshape(len(rows), -1, size))
        (whole,) = stable([elementwise(np.where, inside, whole, -np.inf)])
        return Summed(
            tuple(self.terms), tuple(rows), tuple(labels), tuple(states), _stacked(rest), whole
        )

    # ---- private -------------------------------------------------------------------------------

    def _refuse(self, names: Sequence[str], count: int) -> None:
        raise UnsupportedError(
            f"{_and(names)}: finite nodes whose elements hang together have {count:.3g} joint states, and at "
            f"most {MOST_STATES} are summed over; use Gibbs, or give what is summed by hand as a potential"
        )

    def _hidden(self, name: str) -> np.ndarray:
        free = self.target.free_elements(name)
        return np.arange(self.sizes[name]) if free is None else free

    def _rows(self, names: Sequence[str]) -> Iterator[dict[str, np.ndarray]]:
        """Joint states of the hidden elements of nodes."""
        ways = [itertools.product(range(self.cards[n]), repeat=len(self._hidden(n))) for n in names]
        for states in itertools.product(*ways):
            yield {n: np.array(s, int) for n, s in zip(names, states, strict=True)}

    def _at(self, row: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Stored values of nodes whose hidden elements are in these states."""
        found = {}
        for name, states in row.items():
            seen, shape = self.target.seen(name), self.target.model[name].plate_shape
            whole = np.zeros(self.sizes[name], int)
            if seen is not None:
                whole[:] = np.broadcast_to(seen.value, shape).ravel()
            whole[self._hidden(name)] = states
            found[name] = whole.reshape(shape)
        return found

    def _elements(self, term: Term, values: Mapping[str, np.ndarray]) -> Expression:
        given = {n: constant(np.asarray(v, int)) for n, v in values.items()}
        (found,) = stable([elements(self.target, term, {**self.above, **given})])
        return found

    def _sum(self, values: Mapping[str, np.ndarray]) -> Expression:
        total: Expression = ZERO
        for term in self.terms:
            total = add(total, reduction(np.add, self._elements(term, values), [0]))
        return total

    def _aligned(self, labels: Sequence[str]) -> list[np.ndarray] | None:
        """For each term the element of the labels that its entries read, -1 for none; None if several."""
        if len({self.sizes[n] for n in labels}) > 1:
            return None
        found = []
        for term in self.terms:
            assert term.expression is not None
            at = np.full(math.prod(term.shape), -1)
            for name in labels:
                shape = self.target.model[name].plate_shape
                numbers = np.arange(self.sizes[name]).reshape(shape)
                try:
                    read = element_read(term.expression, name, numbers)
                except TraceError:
                    return None
                if not isinstance(read, Constant):
                    return None
                own = np.broadcast_to(read.value, term.shape).ravel()
                if ((own >= 0) & (at >= 0) & (own != at)).any():
                    return None
                at = np.maximum(at, own)
            found.append(at if term.mask is None else at[np.flatnonzero(term.mask)])
        return found

    def _consistent(
        self, labels: Sequence[str], states: Sequence[tuple[int, ...]], size: int
    ) -> np.ndarray:
        """Which joint states of labels agree with what was seen, shape (states, elements)."""
        found = np.ones((len(states), size), bool)
        for k, name in enumerate(labels):
            seen = self.target.seen(name)
            if seen is not None:
                shape = self.target.model[name].plate_shape
                value = np.broadcast_to(seen.value, shape).ravel()
                mask = np.broadcast_to(seen.mask, shape).ravel()  # type: ignore[arg-type]
                own = np.array([state[k] for state in states])[:, None]
                found &= ~mask | (own == value)
        return found

    def _split(
        self,
        row: Mapping[str, np.ndarray],
        labels: Sequence[str],
        state: tuple[int, ...],
        places: Sequence[np.ndarray],
        size: int,
    ) -> tuple[Expression, Expression]:
        """Sums of entries that read no label, and of the others by element, with all labels in one state."""
        values = {
            n: np.full(self.target.model[n].plate_shape, k)
            for n, k in zip(labels, state, strict=True)
        }
        rest: Expression = ZERO
        table: Expression = pick([ZERO], np.zeros(size, int))
        for term, at in zip(self.terms, places, strict=True):
            whole = self._elements(term, {**row, **values})
            if (at < 0).any():
                rest = add(rest, reduction(np.add, pick([whole], np.flatnonzero(at < 0)), [0]))
            inside = np.flatnonzero(at >= 0)
            if inside.size:
                table = add(table, _added_up(pick([whole], inside), at[inside], size))
        return rest, table


def _added_up(entries: Expression, at: np.ndarray, size: int) -> Expression:
    """Sums of entries by the element that they belong to, each element's laid side by side."""
    counts = np.bincount(at, minlength=size)
    order = np.argsort(at, kind="stable")
    column = np.arange(at.size) - np.repeat(np.cumsum(counts) - counts, counts)
    places = np.full((size, counts.max()), at.size)  # where there is no entry, the zero behind them
    places[at[order], column] = order
    return reduction(np.add, pick([entries, reshape(ZERO, (1,))], places), [1])


def _stacked(numbers: Sequence[Expression]) -> Expression:
    return pick(numbers, np.arange(len(numbers)))


def _and(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names))
