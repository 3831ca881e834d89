"""Like terms evaluated as one, and sums of many terms in few calls."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError
from bayesmc.network import Model
from bayesmc.shapes import broadcast_shapes
from bayesmc.structure.like_functions import (
    LikeFunctions,
    Slots,
    close,
)
from bayesmc.structure.target import Target, Term, Values

#: terms that are worth a group
FEWEST = 4


class LikeTerms:
    """Terms that are alike, as one term in one more plate.

    Attributes
    ----------
    names : tuple of str
        The terms; the first stands for all.
    term : Term
        The first, in ``model``; it reads what ``gathered`` returns.
    shape : tuple of int
        Of the log factors: the group, then the plates.
    """

    def __init__(self, term: Term, names: Sequence[str], slots: Slots) -> None:
        self.term = term
        self.names = tuple(names)
        self.slots = slots
        self.shape = (len(names), *term.shape)

    @property
    def model(self) -> Model:
        return self.term.model

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


def like_terms(target: Target, terms: Sequence[Term], states: Values) -> LikeTerms | None:
    """Terms of equal signatures as one; None where their numbers do not broadcast."""
    signatures = target.signatures
    found = [signatures.of(t.name) for t in terms]
    alike = LikeFunctions(tuple(t.name for t in terms), tuple(s for s in found if s is not None))
    scopes = [s.scope for s in alike.signatures]
    sources = {name: tuple(s[i] for s in scopes) for i, name in enumerate(scopes[0])}
    slots = Slots(target, sources, len(terms))
    term = replace(terms[0], mask=alike.mask(target))
    if alike.varying:
        model = alike.as_one(target, target.model, slots.gathered(states), states)
        if model is None:
            return None
        term = replace(term, model=model)
    return LikeTerms(term, alike.names, slots)


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
    many = [g for g in alike.values() if len(g) >= FEWEST]
    states = target.states if many else None
    if states is None:
        return []
    found = []
    for group in many:
        made = like_terms(target, group, states)
        if made is not None and _agrees(made, group, states):
            found.append(made)
    return found


def repeated(scope: Sequence[str]) -> tuple[int, ...]:
    """Which places of a scope hold the same name: those of a group must do so alike."""
    return tuple(scope.index(n) for n in scope)


# ---- private ------------------------------------------------------------------------------------


def _agrees(made: LikeTerms, terms: Sequence[Term], states: Values) -> bool:
    """Whether terms as one say of some states what they say one by one."""
    try:
        with marking_invalid(), np.errstate(all="ignore"):
            together = made.log(states)
            alone = [t.log(states) for t in terms]
    except BayesmcError:  # at some state, perhaps one that is impossible
        return False
    axis = together.ndim - len(made.shape)
    rows = np.moveaxis(together, axis, 0)
    return all(
        close(row, np.broadcast_to(a, row.shape)) for row, a in zip(rows, alone, strict=True)
    )
