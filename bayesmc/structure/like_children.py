"""Like children of one node evaluated as one: the emissions of a series, seen from the parameter they share.

A parameter with a hundred children that came from one function would call it a hundred times for every value
it tries. Here the children get a group axis, as if they were one child in one more plate.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from bayesmc.errors import BayesmcError, TraceError
from bayesmc.expression import Program
from bayesmc.structure.blanket import Blanket, Child
from bayesmc.structure.like_terms import FEWEST, LikeTerms, StackedTerm, like_terms, repeated
from bayesmc.structure.relation import positions

#: the plate that stands for a group
GROUP = "\0group"


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
    >>> from bayesmc.structure.like_children import with_like_children
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
    found = [as_one_child(blanket, c) for c in like_children(blanket, blanket.children)]
    groups = [group for group in found if group is not None]
    return GroupedBlanket(blanket, groups) if groups else blanket


def like_children(
    blanket: Blanket,
    children: Sequence[Child],
    also: Callable[[Child], Hashable] | None = None,
) -> list[list[Child]]:
    """Children by what they are and how they depend on the node, where there are many.

    Parameters
    ----------
    also : callable, optional
        What else must be equal within a group.
    """
    if len(children) < FEWEST:
        return []
    signatures = blanket.target.signatures
    groups: dict[Hashable, list[Child]] = {}
    for child in children:
        signature = signatures.of(child.term.name)
        if signature is None:
            continue
        scope, relation = signature.scope, child.relation
        source = None if relation.source is None else scope.index(relation.source)
        # the node, and what follows from it, in the same places
        reached = tuple(n == blanket.name or n in blanket.path for n in scope)
        how = (relation.kind, relation.coupled, relation.term_plates)
        more = None if also is None else also(child)
        key = (signature.key, reached, repeated(scope), source, how, len(relation.rows), more)
        groups.setdefault(key, []).append(child)
    return [g for g in groups.values() if len(g) >= FEWEST]


def as_one_child(blanket: Blanket, children: Sequence[Child]) -> tuple[LikeTerms, Child] | None:
    """Like children as one, whose relation has the group as one more plate; None where they cannot be."""
    terms = like_terms(blanket.target, [c.term for c in children])
    first = children[0].relation
    rows = tuple(np.concatenate(r) for r in zip(*(c.relation.rows for c in children), strict=True))
    relation = replace(first, term_plates=(GROUP, *first.term_plates), rows=rows, _kept={})
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
