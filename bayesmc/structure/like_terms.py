"""Like terms evaluated as one, and sums of many terms in few calls."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution, as_distribution
from bayesmc.errors import BayesmcError, DensityError
from bayesmc.shapes import Shape, broadcast_shapes
from bayesmc.structure.like_functions import Signature, Slots, StackedFunction, as_one
from bayesmc.structure.target import Target, Term, Values

#: terms that are worth a group
FEWEST = 4


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
