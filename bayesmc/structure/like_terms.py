"""Like terms evaluated as one, sums of many terms in few calls, and like children of one node.

A parameter with a hundred children that came from one function would call it a hundred times for every value
it tries. Here the children get a group axis, as if they were one child in one more plate.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution, as_distribution
from bayesmc.errors import BayesmcError, DensityError, TraceError
from bayesmc.expression import Program
from bayesmc.shapes import Shape, broadcast_shapes
from bayesmc.structure.blanket import Blanket, Child
from bayesmc.structure.like_functions import Signature, Slots, StackedFunction, as_one
from bayesmc.structure.relation import positions
from bayesmc.structure.target import Target, Term, Values

#: terms that are worth a group
FEWEST = 4
#: the plate that stands for a group
GROUP = "\0group"


@dataclass(frozen=True, eq=False)
class StackedTerm(Term):
    """The first of some like terms whose functions differ in constants, for all of them.

    It takes values ``(*lead, group, *plates, *event)`` by the names that the first one reads.
    """

    function: StackedFunction | None = None

    def distribution(self, values: Mapping[str, np.ndarray]) -> tuple[Distribution, Shape]:
        """The distribution of all given their parents, and the batch shape of those."""
        assert self.function is not None
        made, batch = self.function(values)
        dist = as_distribution(made)
        assert dist is not None
        return dist, batch

    def log(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Log factors of every element of all, shape ``(*lead, group, *plates)``."""
        if not self.is_potential:
            return super().log(values)
        assert self.function is not None
        found, batch = self.function(values)
        log = np.asarray(found, dtype=float)
        if not (log < np.inf).all():
            raise DensityError(f"potential {self.name!r} is NaN or plus infinity")
        return np.broadcast_to(log, batch + self.shape)


class LikeTerms:
    """Terms that are alike, as one term in one more plate.

    Attributes
    ----------
    names : tuple of str
        The terms; the first stands for all.
    term : Term
        The first, for all; it reads what ``gathered`` returns.
    shape : tuple of int
        Of the log factors: the group, then the plates.
    """

    def __init__(self, term: Term, names: Sequence[str], slots: Slots) -> None:
        self.term = term
        self.names = tuple(names)
        self.slots = slots
        self.shape = (len(names), *term.shape)

    def gathered(self, values: Mapping[str, np.ndarray]) -> Values:
        """Values by the names that the first term reads, the group before the plates."""
        return self.slots.gathered(values)

    def log(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Log factors of all, shape ``(*lead, group, *plates)``."""
        return self.full(self.term.log(self.gathered(values)))

    def full(self, log: np.ndarray) -> np.ndarray:
        """Log factors with all their elements, where some would be broadcast."""
        return np.broadcast_to(log, broadcast_shapes(log.shape, self.shape))


class TermSum:
    """The sum of some terms, like ones evaluated as one.

    Parameters
    ----------
    target : Target
    terms : iterable of Term

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.like_terms import TermSum
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("rate", bmc.LogNormal(0.0, 1.0))
    >>> for t in range(8):
    ...     net.add(f"y[{t}]", lambda rate, t=t: bmc.Poisson(rate * (1 + t)))
    >>> target = target_of(pose(net, {f"y[{t}]": t for t in range(8)}))
    >>> total = TermSum(target, target.terms.values())
    >>> [g.names[0] for g in total.groups], [t.name for t in total.alone]
    (['y[0]'], ['rate'])
    >>> values = {**target.known, "rate": np.array([0.5, 2.0])}
    >>> np.allclose(total.log_density(values), target.log_density(values))
    True
    """

    def __init__(self, target: Target, terms: Iterable[Term]) -> None:
        self.target = target
        self.terms = tuple(terms)
        self.groups = tuple(like_groups(target, self.terms))
        taken = {n for g in self.groups for n in g.names}
        self.alone = tuple(t for t in self.terms if t.name not in taken)

    def log_density(self, values: Mapping[str, np.ndarray]) -> Any:
        """The sum, shape the batch."""
        try:
            total = self.target.log_density(values, self.alone)
            for group in self.groups:
                total = total + group.log(values).sum(axis=tuple(range(-len(group.shape), 0)))
        except BayesmcError:
            self.target.log_density(values, self.terms)  # names the term at fault
            raise
        return total


def like_terms(target: Target, terms: Sequence[Term]) -> LikeTerms:
    """Terms of equal signatures as one."""
    found = [target.signatures.of(t.name) for t in terms]
    signatures = [s for s in found if s is not None]
    scopes = [s.scope for s in signatures]
    sources = {name: tuple(s[i] for s in scopes) for i, name in enumerate(scopes[0])}
    slots = Slots(target, sources, len(terms))
    return LikeTerms(one_term(terms, signatures), [t.name for t in terms], slots)


def one_term(terms: Sequence[Term], signatures: Sequence[Signature]) -> Term:
    """The first of some like terms, for all of them."""
    first, mask = terms[0], None
    if any(t.mask is not None for t in terms):
        mask = np.stack([np.ones(t.shape, bool) if t.mask is None else t.mask for t in terms])
    function = as_one(signatures)
    if function is None:
        return first if mask is None else replace(first, mask=mask)
    return StackedTerm(
        first.model, first.name, first.plates, first.shape, first.parents, first.is_potential,
        mask, function,
    )  # fmt: skip


def like_groups(
    target: Target, terms: Sequence[Term], also: Callable[[Term], Hashable] | None = None
) -> list[LikeTerms]:
    """Terms that can be evaluated as one, where there are many; all others are left out.

    Parameters
    ----------
    also : callable, optional
        What else must be equal within a group.
    """
    signatures = target.signatures
    alike: dict[Hashable, list[Term]] = {}
    for term in terms:
        signature = signatures.of(term.name)
        if signature is not None:
            key = signature.key, repeated(signature.scope), None if also is None else also(term)
            alike.setdefault(key, []).append(term)
    return [like_terms(target, group) for group in alike.values() if len(group) >= FEWEST]


def repeated(scope: Sequence[str]) -> tuple[int, ...]:
    """Which places of a scope hold the same name: those of a group must do so alike."""
    return tuple(scope.index(n) for n in scope)


class GroupedBlanket(Blanket):
    """A blanket whose like children are evaluated as one; its answers are those of the single blanket."""

    def __init__(self, blanket: Blanket, groups: Sequence[tuple[LikeTerms, Child]]) -> None:
        vars(self).update(vars(blanket))
        self.groups = tuple(groups)
        taken = {n for terms, _ in groups for n in terms.names}
        self.alone = tuple(c for c in self.children if c.term.name not in taken)

    def log_density(
        self,
        values: Mapping[str, np.ndarray],
        candidate: np.ndarray,
        members: np.ndarray | None = None,
    ) -> np.ndarray:
        state = self.placed(values, candidate, members)
        total = self.own_log(state, members)
        for child in self.alone:
            total = total + self.child_log(child, state, members)
        try:
            for k in range(len(self.groups)):
                total = total + self._group_log(k, state, members)
        except BayesmcError:
            for child in self.children:  # the group knows the first child's name only
                self.child_log(child, state, members)
            raise
        return total

    def _group_log(
        self, k: int, state: Mapping[str, np.ndarray], members: np.ndarray | None
    ) -> np.ndarray:
        """The log factors of a group, summed for every element of the node."""
        terms, child = self.groups[k]
        gathered = terms.gathered(state)
        log = terms.full(terms.term.log(gathered))
        return child.relation.collect(log, terms.shape, members, gathered)


def with_like_children(blanket: Blanket) -> Blanket:
    """The blanket with like children evaluated as one; itself where too few are alike.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.like_terms import with_like_children
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("rate", bmc.LogNormal(0.0, 1.0))
    >>> for t in range(8):
    ...     net.add(f"y[{t}]", lambda rate, t=t: bmc.Poisson(rate * (1 + t)))
    >>> target = target_of(pose(net, {f"y[{t}]": t for t in range(8)}))
    >>> single = Blanket(target, "rate")
    >>> grouped = with_like_children(single)
    >>> [terms.names for terms, _ in grouped.groups]
    [('y[0]', 'y[1]', 'y[2]', 'y[3]', 'y[4]', 'y[5]', 'y[6]', 'y[7]')]
    >>> tried = np.array([[0.5], [2.0]])
    >>> np.allclose(
    ...     single.log_density(target.known, tried), grouped.log_density(target.known, tried)
    ... )
    True
    """
    found = [as_one_child(blanket, c) for c in like_children(blanket)]
    groups = [group for group in found if group is not None]
    return GroupedBlanket(blanket, groups) if groups else blanket


def like_children(blanket: Blanket) -> list[list[Child]]:
    """Children by what they are and how they depend on the node, where there are many."""
    signatures = blanket.target.signatures
    groups: dict[Hashable, list[Child]] = {}
    for child in blanket.children if len(blanket.children) >= FEWEST else ():
        signature = signatures.of(child.term.name)
        if signature is None:
            continue
        scope, relation = signature.scope, child.relation
        source = None if relation.source is None else scope.index(relation.source)
        # the node, and what follows from it, in the same places
        reached = tuple(n == blanket.name or n in blanket.path for n in scope)
        how = (relation.kind, relation.coupled, relation.term_plates)
        key = (signature.key, reached, repeated(scope), source, how, len(relation.rows))
        groups.setdefault(key, []).append(child)
    return [g for g in groups.values() if len(g) >= FEWEST]


def as_one_child(blanket: Blanket, children: Sequence[Child]) -> tuple[LikeTerms, Child] | None:
    """Like children as one, whose relation has the group as one more plate; None where they cannot be."""
    terms = like_terms(blanket.target, [c.term for c in children])
    first = children[0].relation
    rows = tuple(np.concatenate(r) for r in zip(*(c.relation.rows for c in children), strict=True))
    relation = replace(
        first, term_plates=(GROUP, *first.term_plates), rows=rows, place=None, _kept={}
    )
    term = terms.term
    if relation.kind == "lookup" and isinstance(term, StackedTerm):
        assert term.function is not None and relation.source is not None
        try:
            found = positions(blanket.target, term.function.result, relation.source, term.shape)
        except TraceError:
            return None
        if len(found) != 1:
            return None
        index = partial(term.function.found, Program([found[0]]))
        relation = replace(relation, index=index)
    return terms, Child(term, relation)
