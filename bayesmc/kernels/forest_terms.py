"""What terms say of the variables of a forest: log factors on single ones and on pairs, like terms as one.

All variables of a forest are put at all their states at once: a forest has two colours, and the variables of
each colour vary along an axis of their own, before the chains. A term then comes out on all states of the
one or two variables that it reads, whatever it computes from them on the way.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayesmc.errors import BayesmcError
from bayesmc.network.model import invalid_error
from bayesmc.shapes import broadcast_shapes
from bayesmc.structure.like_functions import Slots
from bayesmc.structure.like_terms import like_groups
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


def readers(
    target: Target,
    members: Mapping[str, tuple[str, ...]],
    colour: Mapping[str, int],
    candidates: Values,
) -> list[Reader]:
    """The terms around a forest, like ones together.

    Parameters
    ----------
    members : dict
        Name of a term -> the one or two variables of the forest that it reads, in the order of their colours.
    colour : dict
        Variable -> its axis.
    candidates : dict
        Variable -> all its states, along its axis.
    """
    reached = {n: frozenset([c]) for n, c in colour.items()}
    for link in target.below(colour):
        parents = target.model[link].parents
        reached[link] = frozenset().union(*(reached[p] for p in parents if p in reached))
    often: dict[tuple[str, ...], int] = {}
    turn: dict[str, int] = {}
    for name, these in members.items():  # no group reads a variable, or a pair, twice
        turn[name] = often[these] = often.get(these, 0) + 1

    def how(term: Term) -> Hashable:
        these = members[term.name]
        scope = target.signatures.of(term.name).scope  # type: ignore[union-attr]
        places = tuple(these.index(n) if n in these else None for n in scope)
        axes = tuple(reached.get(n) for n in scope)
        return turn[term.name], tuple(colour[n] for n in these), places, axes

    terms = [target.terms[n] for n in members]
    found = []
    for group in like_groups(target, terms, how):
        first = group.names[0]
        scope = group.slots.sources
        own = {n: candidates[n] for n in scope if n in candidates}
        slots = Slots(target, {n: s for n, s in scope.items() if n not in own}, len(group.names))
        fixed = {n: np.expand_dims(v, COLOURS + 1) for n, v in own.items()}
        these = tuple(members[n] for n in group.names)
        axes = tuple(colour[n] for n in members[first])
        whole = tuple(target.terms[n] for n in group.names)
        found.append(Reader(target, whole, these, axes, group.term, slots, fixed))
    taken = {t.name for reader in found for t in reader.terms}
    for term in terms:
        if term.name not in taken:
            own_axes = tuple(colour[n] for n in members[term.name])
            found.append(
                Reader(target, (term,), (members[term.name],), own_axes, term, None, {})
            )
    return found


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
