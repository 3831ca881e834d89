"""What beliefs about finite variables say of the nodes of every slice: tables, means, queries, paths."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.engines.averages import called, naming
from bayesmc.engines.discrete.chain import most_likely
from bayesmc.engines.discrete.limits import first_gap, is_untold
from bayesmc.engines.discrete.rows import Rows, Term, Variable
from bayesmc.engines.discrete.run import Run, bad_parameters
from bayesmc.engines.discrete.slices import BLOCK_ENTRIES
from bayesmc.engines.filtering import Answers, Queries, quiet
from bayesmc.errors import BudgetError, QueryError, UnknownNodeError, UnsupportedError
from bayesmc.factors.named import choices_of
from bayesmc.network import CompiledNode
from bayesmc.network.node import nodes_read
from bayesmc.results.statistics import circular_variance
from bayesmc.shapes import padded, unravelled


class SliceAnswers:
    """Reads answers off a run.

    Parameters
    ----------
    run : Run
        Passed forward, and backward where answers given later rows are wanted.
    """

    def __init__(self, run: Run) -> None:
        self.run, self.plan = run, run.plan
        self.reader = run.plan.reader
        self.model = run.plan.slices.first

    def of(self, names: Sequence[str]) -> Answers:
        """Tables of finite nodes, means and variances of others; what cannot be told is left out."""
        found = Answers({}, {}, {})
        for name in names:
            node = self.model[name]
            if name in self.reader.variables:
                found.tables[name] = self._table(name, node)
            elif not is_untold(self.plan, self.run.series, name, self.run.steps):
                self._tell(name, node, found)
        return found

    def hands_on(self, name: str) -> bool:
        """Whether a node is part of the state of a chain."""
        is_kept = any(v[1] == name for c in self.plan.chains for v in c.state)
        return is_kept and self.run.ties_slices

    def pairs(self, name: str) -> np.ndarray:
        """Joint tables of a node and itself in the slice before, (steps - 1, *plates, states, states)."""
        node, size = self.model[name], self.reader.card(name)
        out = np.empty((self.run.steps, *node.plate_shape, size, size))
        for element in range(self.reader.elements(name)):
            scope = ((1, name, element), (0, name, element))
            for start, stop in self._stretches(scope):
                if start > 0:
                    self._place(out, start, stop, node, element, self.run.joint(scope, start, stop))
        return out[1:]

    def expectation(
        self,
        function: Callable[..., Any],
        read: Callable[[Any], np.ndarray] = np.asarray,
    ) -> np.ndarray:
        """Mean of a function of nodes of a slice, whose arguments have one leading axis, in every slice.

        ``read`` makes an array of what it returns.

        Raises
        ------
        UnknownNodeError, QueryError, UnsupportedError, BudgetError
        """
        names, kinds = self.check(function)
        parts = []
        entries = max(math.prod(map(float, self.reader.cards(t))) for t in kinds.values())
        for start, stop in self._cut(kinds[2], entries):
            rows = self.plan.rows(self.run.series, start, stop)
            parts.append(self._expectation(function, names, kinds[rows.kind], rows, read))
        return np.concatenate(parts)

    def check(self, function: Callable[..., Any]) -> tuple[tuple[str, ...], dict[int, Term]]:
        """What a query reads, in the three kinds of slices; raises ahead what ``expectation`` does."""
        names = nodes_read(function)
        for name in names:
            if name not in self.model.nodes:
                raise UnknownNodeError(
                    f"a query reads {name!r}, which is no node of a slice; there are {list(self.model.nodes)}"
                )
        kinds = {k: self.reader.question(names, k) for k in (0, 1, 2)}
        for term in kinds.values():
            self._check_question(term)
        return names, kinds

    def stretches_of(self, name: str, more: float) -> list[tuple[int, int]]:
        """Slices cut so that what is read of a node stays within bounds."""
        return self._cut(self.plan.terms[name, 2], more)

    # ---- private ----------------------------------------------------------------------------

    def _table(self, name: str, node: CompiledNode) -> np.ndarray:
        alone = self.run.alone((0, name, 0))
        if alone is not None and node.plates == self.reader.apart:
            return alone.reshape(
                self.run.steps, *node.plate_shape, -1
            )  # long series are not copied
        out = np.empty((self.run.steps, *node.plate_shape, self.reader.card(name)))
        for element in range(self.reader.elements(name)):
            scope = ((0, name, element),)
            for start, stop in self._stretches(scope):
                self._place(out, start, stop, node, element, self.run.joint(scope, start, stop))
        return out

    def _tell(self, name: str, node: CompiledNode, found: Answers) -> None:
        """Answers of a node that is no variable: averages over what it reads."""
        angles = node.angles
        size = (self.reader.card(name),) if self._is_tabular(name) else ()
        rest = len(node.event_shape) + len(size)
        first = np.empty((self.run.steps, *node.value_shape, *size))
        second = np.empty(first.shape)
        for start, stop in self._cut(self.plan.terms[name, 2], 1.0):
            rows = self.plan.rows(self.run.series, start, stop)
            term = self.plan.terms[name, rows.kind]
            try:
                parts = self.reader.over_rows(term, rows, self._moments)
            except UnsupportedError:  # a family without closed moments
                return
            for element in range(self.reader.elements(name)):
                scope = self.reader.scope(term, element)
                weights = self.run.joint(scope, start, stop)
                cards = len(self.reader.cards(term))
                if parts[2] is not None:
                    bad = self.reader.at_element(parts[2], node, cards, element, 0)
                    wrong = _averaged(weights, bad, 0) > 0
                    if wrong.any():
                        raise bad_parameters(name, start + int(wrong.any(axis=1).argmax()))
                own = self.reader.at_element(parts[0], node, cards, element, rest)
                one = _averaged(weights, own, rest)
                self._place(first, start, stop, node, element, one)
                if parts[1] is None:
                    continue
                other = self.reader.at_element(parts[1], node, cards, element, rest)
                centre = one.reshape(*one.shape[:2], *(1,) * cards, *one.shape[2:])
                off = (own - centre) ** 2
                other = other + (off if angles is None else np.where(angles, 0.0, off))
                self._place(second, start, stop, node, element, _averaged(weights, other, rest))
        self._put_seen(name, node, first, second)
        if size:
            found.tables[name] = first
        elif angles is None:
            found.means[name] = first
            found.variances[name] = second
        else:
            with np.errstate(over="ignore"):  # of numbers that are no angles
                turns = circular_variance(first, second)
            found.means[name] = np.where(angles, np.arctan2(second, first), first)
            found.variances[name] = np.where(angles, turns, second)

    def _moments(self, term: Term, rows: Rows) -> tuple[Any, ...]:
        """What is averaged of a node, and where its parameters are bad, as ones, if anywhere.

        Probabilities, or mean and variance (cosine and sine of angles).
        """
        node = self.model[term.name]
        lead = 1 + len(self.reader.cards(term)) + len(node.plates)
        ndim = lead + len(node.event_shape)
        with quiet():
            result, _ = self.reader.evaluate(term, rows)
            if not isinstance(result, Distribution):
                own = self.reader.model(term.kind, 0)[term.name]
                value = np.asarray(result)
                if self._is_tabular(term.name):
                    one_hot = value[..., None] == np.arange(self.reader.card(term.name))
                    return padded(one_hot * 1.0, lead + 1), None, None
                value = padded(np.asarray(own.decode(value), dtype=float), ndim)
                return value, np.zeros((1,) * ndim), None
            bad = None if result.invalid is None else padded(result.invalid * 1.0, lead)
            if node.domain is not None:
                return padded(np.asarray(result.probs_table), lead + 1), None, bad
            mean, var = padded(result.mean, ndim), padded(result.var, ndim)
            if node.angles is None:
                return mean, var, bad
            length = np.exp(-0.5 * var)
            cosine, sine = length * np.cos(mean), length * np.sin(mean)
            return np.where(node.angles, cosine, mean), np.where(node.angles, sine, var), bad

    def _is_tabular(self, name: str) -> bool:
        """Whether a node has the same states in all slices; computed nodes may not, and are numbers then."""
        now, later = self.model[name].domain, self.plan.slices.later[name].domain
        return now is not None and later is not None and now.states == later.states

    def _put_seen(
        self, name: str, node: CompiledNode, first: np.ndarray, second: np.ndarray
    ) -> None:
        """Elements that were seen have the value that was seen."""
        seen = self.run.series.observed.get(name)
        if seen is None or not node.is_stochastic:
            return
        value = seen.value[-self.run.steps :]
        mask = np.ones(value.shape[: 1 + len(node.plates)], dtype=bool)
        if seen.mask is not None:
            mask = seen.mask[-self.run.steps :]
        if node.domain is not None:
            first[mask] = np.eye(node.domain.size)[value[mask].astype(np.intp)]
        elif node.angles is None:
            first[mask], second[mask] = value[mask], 0.0
        else:
            here = value[mask]
            first[mask] = np.where(node.angles, np.cos(here), here)
            second[mask] = np.where(node.angles, np.sin(here), 0.0)

    def _place(
        self, out: np.ndarray, start: int, stop: int, node: CompiledNode, element: int, array: np.ndarray
    ) -> None:  # fmt: skip
        """Write an element's answers about some slices where they belong."""
        rows = out[start - self.run.first : stop - self.run.first]
        self.reader.put_element(rows, node, element, array)

    def _stretches(self, scope: Sequence[Variable]) -> list[tuple[int, int]]:
        """Slices cut so that the joint of some variables stays within bounds."""
        return self.run.stretches(self.run.entries(scope) * self.run.sequences)

    def _cut(self, term: Term, more: float) -> list[tuple[int, int]]:
        """Slices cut so that a term's tables and the joints of what it reads stay within bounds."""
        entries = max(more, math.prod(map(float, self.reader.cards(term))))
        reads = (
            (lag, name, element)
            for lag, name in (*term.alone, *term.whole)
            for element in range(self.reader.elements(name))
        )
        entries = max(entries, self.run.entries(reads))
        return self.run.stretches(entries * self.run.sequences)

    def _check_question(self, term: Term) -> None:
        entries = math.prod(map(float, self.reader.cards(term)))
        if entries > BLOCK_ENTRIES:
            raise BudgetError(
                f"a query reads nodes with {entries:.3g} joint states in a slice; ask about fewer nodes at "
                "once, or use ParticleFilter(particles)",
                int(min(8 * entries, 2**62)),
            )
        gap = first_gap(self.plan, self.run.series, term)
        if gap is not None:
            raise UnsupportedError(
                f"a query reads {gap[0]!r}, which is missing in slice {gap[1]} and has no finite set of "
                "states; use ParticleFilter(particles)"
            )

    def _expectation(
        self,
        function: Callable[..., Any],
        names: Sequence[str],
        term: Term,
        rows: Rows,
        read: Callable[[Any], np.ndarray],
    ) -> np.ndarray:
        reader = self.reader
        placed = reader.placed(term, rows)
        cards = reader.cards(term)
        lead = (rows.count, *cards)
        count = math.prod(lead)
        arguments = []
        with quiet():
            for name in names:
                node = reader.model(term.kind, 0)[name]
                value = np.broadcast_to(reader.value(placed, name, 0), (*lead, *node.value_shape))
                arguments.append(node.decode(value.reshape(count, *node.value_shape)))
            values = read(called(function, arguments))
        if (
            not values.ndim
            or len(values) != count
            or (values.shape[1 : 1 + len(reader.lead)] != reader.lead)
        ):
            apart = f", then those of plates {reader.apart}" if reader.apart else ""
            raise QueryError(
                f"a query returns shape {values.shape}; it must return one value per configuration, the axis "
                f"of {count} configurations first{apart}"
            )
        values = values.reshape(rows.count, math.prod(cards), *values.shape[1:])
        scope = reader.scope_of_keys(term)
        weights = self.run.joint(scope, rows.start, rows.stop)
        weights = weights.reshape(rows.count, *reader.lead, -1)
        weights = np.moveaxis(weights, -1, 1)
        weights = weights.reshape(weights.shape + (1,) * (values.ndim - weights.ndim))
        return np.where(weights > 0, weights * values, 0.0).sum(axis=1)


def answer_queries(answers: SliceAnswers, queries: Queries | None) -> dict[str, np.ndarray]:
    """Expectations of functions in every slice, by name."""
    found = {}
    for name, function in (queries or {}).items():
        with naming(name):
            found[name] = answers.expectation(function)
    return found


def best_path(run: Run) -> dict[Variable, np.ndarray] | None:
    """States of all variables on the most likely path, shape (steps, sequences); None where there is none."""
    plan = run.plan
    found: dict[Variable, np.ndarray] = {}
    for number, chain in enumerate(plan.chains):
        path = most_likely(run.blocks(number, np.max), run.steps, run.sequences, chain.size)
        if path is None:
            return None
        shape = tuple(plan.cards[v] for v in chain.state)
        states = unravelled(path, shape)
        own = dict(zip(chain.state, states, strict=True))
        for variable in chain.inside:
            own[variable] = np.empty((run.steps, run.sequences), dtype=np.intp)
        if chain.inside:
            _fill_inside(run, number, own)
        found |= own
    return found


# ---- private ------------------------------------------------------------------------------------


def _fill_inside(run: Run, number: int, states: Mapping[Variable, np.ndarray]) -> None:
    """The best states of the variables of a slice that no other slice reads, given those that some do."""
    plan = run.plan
    chain = plan.chains[number]
    for start, stop in run.stretches(plan.widest[number] * run.sequences):
        pieces = run.pieces(number, plan.rows(run.series, start, stop))
        border = [v for v in (*chain.before, *chain.state) if any(v in p.scope for p in pieces)]
        known = {v: _on_path(states, v, start - run.first, stop - run.first) for v in border}
        for choice in reversed(choices_of(pieces, border, plan.cards)):
            known.update(choice.look_up(known))
        for variable in chain.inside:
            states[variable][start - run.first : stop - run.first] = known[variable]


def _on_path(
    states: Mapping[Variable, np.ndarray], variable: Variable, first: int, last: int
) -> np.ndarray:
    lag, name, element = variable
    return states[0, name, element][first - lag : last - lag]


def _averaged(weights: np.ndarray, values: np.ndarray, rest: int) -> np.ndarray:
    """Mean over configurations: weights ``(rows, sequences, *cards)``, values with ``rest`` more axes."""
    full = weights.reshape(weights.shape + (1,) * rest)
    axes = tuple(range(2, weights.ndim))
    return np.where(full > 0, full * values, 0.0).sum(axis=axes)
