"""What terms say of the variables of a forest: log factors on single ones and on pairs, like terms as one.

All variables of a forest are put at all their states at once: a forest has two colours, and the variables of
each colour vary along an axis of their own, before the chains. A term then comes out on all states of the
one or two variables that it reads, whatever it computes from them on the way.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

import numpy as np

from bayesmc.errors import BayesmcError
from bayesmc.network.model import invalid_error
from bayesmc.shapes import broadcast_shapes
from bayesmc.structure.like_functions import Slots
from bayesmc.structure.like_links import LinkSteps
from bayesmc.structure.like_terms import LikeTerms, like_groups
from bayesmc.structure.relation import Relation
from bayesmc.structure.target import Target, Term, Values

#: axes of candidates, one for each colour
COLOURS = 2


@dataclass(frozen=True, eq=False)
class Reader:
    """Some like terms, or one, and the variables of the forest that each reads.

    Attributes
    ----------
    terms : tuple of Term
    members : tuple of tuple of str
        For each term one variable, or two in the order of their colours.
    """

    target: Target
    terms: tuple[Term, ...]
    members: tuple[tuple[str, ...], ...]
    axes: tuple[int, ...]
    one: Term
    slots: Slots | None
    fixed: Values

    def log(self, state: Mapping[str, np.ndarray], chains: int) -> tuple[np.ndarray, bool]:
        """Log factors ``(*states, chains, terms, *plates)``, and whether all have proper parameters."""
        values = state if self.slots is None else {**self.slots.gathered(state), **self.fixed}
        try:
            log, proper = _log(self.one, values)
        except BayesmcError:
            for term in self.terms:  # the first stands for all, and its name alone would be said
                _log(term, state)
            raise
        group = 0 if self.slots is None else 1
        plates = self.one.shape
        want = COLOURS + 1 + group + len(plates)
        log = log.reshape((1,) * (want - log.ndim) + log.shape)
        full = (*log.shape[: COLOURS + 1], *(log.shape[COLOURS + 1 :][:group]), *plates)
        log = self._collected(np.broadcast_to(log, full), plates)
        if not group:
            log = np.expand_dims(log, COLOURS + 1)
        log = log[tuple(slice(None) if c in self.axes else 0 for c in range(COLOURS))]
        sizes = [self.target.model[n].domain.size for n in self.members[0]]  # type: ignore[union-attr]
        tail = log.shape[len(sizes) + 2 :]
        return np.broadcast_to(log, (*sizes, chains, len(self.terms), *tail)), proper

    def _collected(self, log: np.ndarray, plates: tuple[int, ...]) -> np.ndarray:
        node = self.target.model[self.members[0][0]]
        if len(self.one.plates) != len(plates):  # rows of an index, of variables without plates
            return log.sum(axis=tuple(range(log.ndim - len(plates), log.ndim)))
        relation = Relation("aligned", node.plates, node.plate_shape, self.one.plates)
        return relation.collect(log, plates)


class Readers:
    """The terms around a forest, like ones together, and what is computed on the way to them.

    Parameters
    ----------
    members : dict
        Name of a term -> the one or two variables of the forest that it reads, in the order of their colours.
    colour : dict
        Variable -> its axis.
    candidates : dict
        Variable -> all its states, along its axis.
    """

    def __init__(
        self,
        target: Target,
        members: Mapping[str, tuple[str, ...]],
        colour: Mapping[str, int],
        candidates: Values,
    ) -> None:
        self.target = target
        self.members = members
        self.colour = colour
        self.candidates = candidates
        links = target.below(colour)
        self._axes = {n: frozenset([c]) for n, c in colour.items()}
        for link in links:
            parents = target.model[link].parents
            self._axes[link] = frozenset().union(*(self._axes.get(p, ()) for p in parents))
        self.links = LinkSteps(target, links, self._along)
        often: dict[tuple[str, ...], int] = {}
        self._turn: dict[str, int] = {}
        for name, these in members.items():  # no group reads a variable, or a pair, twice
            self._turn[name] = often[these] = often.get(these, 0) + 1
        groups = like_groups(target, [target.terms[n] for n in members], self._how)
        taken = {n for group in groups for n in group.names}
        self.all = [self._of_group(group) for group in groups]
        self.all += [self._of_term(target.terms[n]) for n in members if n not in taken]

    def placed(self, values: Mapping[str, np.ndarray]) -> Values:
        """The state with all variables at all their states."""
        state = {**values, **self.candidates}
        self.links.compute(state)
        return state

    def _along(self, name: str) -> Hashable:
        """The axes of what a term or a link reads."""
        signature = self.target.signatures.of(name)
        return signature and tuple(self._axes.get(n) for n in signature.scope)

    def _how(self, term: Term) -> Hashable:
        these = self.members[term.name]
        return self._turn[term.name], tuple(self.colour[n] for n in these), self._along(term.name)

    def _of_group(self, group: LikeTerms) -> Reader:
        scope = group.slots.sources
        own = {n: self.candidates[n] for n in scope if n in self.candidates}
        sources = {n: s for n, s in scope.items() if n not in own}
        slots = Slots(self.target, sources, len(group.names))
        fixed = {n: np.expand_dims(v, COLOURS + 1) for n, v in own.items()}
        terms = tuple(self.target.terms[n] for n in group.names)
        return self._reader(terms, group.term, slots, fixed)

    def _of_term(self, term: Term) -> Reader:
        return self._reader((term,), term, None, {})

    def _reader(
        self, terms: tuple[Term, ...], one: Term, slots: Slots | None, fixed: Values
    ) -> Reader:
        members = tuple(self.members[t.name] for t in terms)
        axes = tuple(self.colour[n] for n in members[0])
        return Reader(self.target, terms, members, axes, one, slots, fixed)


# ---- private ------------------------------------------------------------------------------------


def _log(term: Term, values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, bool]:
    """Log factors, and whether all parameters are proper.

    Where they are not the factor is one: other factors may make the state impossible, and if they do not,
    it may be drawn, and then the term says what is wrong.
    """
    if term.is_potential:
        return term.log(values), True
    dist, batch = term.distribution(values)
    if dist.invalid is None or not dist.invalid.any():
        return term.log_of(dist, batch, values[term.name]), True
    node, value = term.model[term.name], values[term.name]
    lead = broadcast_shapes(batch, value.shape[: value.ndim - len(node.value_shape)])
    log = term.model.log_density(term.name, dist, value)
    fault = None
    if dist.problem is None or not dist.problem.is_overflow:
        fault = invalid_error(node, dist, np.broadcast_to(True, lead), lead)
    log = np.where(dist.invalid, -np.inf if fault is None else 0.0, log)
    return (log if term.mask is None else np.where(term.mask, log, 0.0)), fault is None
