"""Like children of a conjugate node as one partner: what slices of a series say of a parameter they share.

A thousand children that came from one function are called once, with the group as one more plate, and their
elements are summed as those of any plate are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.errors import BayesmcError
from bayesmc.kernels.conjugate_children import Partner
from bayesmc.kernels.conjugate_kinds import Kind
from bayesmc.kernels.conjugate_labels import ByLabel
from bayesmc.kernels.conjugate_matching import Match
from bayesmc.shapes import Shape
from bayesmc.structure.blanket import Blanket, Child
from bayesmc.structure.like_children import as_one_child, like_children
from bayesmc.structure.like_functions import Slots
from bayesmc.structure.like_terms import LikeTerms
from bayesmc.structure.target import Term, Values

#: elements of one child from which on arrays, not calls, take the time
_LARGE = 512


class LikePartner(Partner):
    """Like children, as one with the group before its plates.

    Parameters
    ----------
    matches : sequence of Match
        Of the children; their pairs are equal.
    like : LikeTerms
        The children as one term.
    child : Child
        The same, with how it depends on the node.
    """

    def __init__(
        self,
        blanket: Blanket,
        matches: Sequence[Match],
        kind: Kind,
        like: LikeTerms,
        child: Child,
    ) -> None:
        self.children = tuple(m.child for m in matches)
        self._like = like
        own = like.term.name
        sources = like.slots.sources
        above = {name: these for name, these in sources.items() if name != own}
        self._parents = Slots(blanket.target, above, len(self.children))
        self._own = Slots(blanket.target, {own: sources[own]}, len(self.children))
        first = matches[0]
        super().__init__(blanket, replace(first, child=child), kind)

    # ---- the children as such -----------------------------------------------------------------

    @property
    def terms(self) -> tuple[Term, ...]:
        return tuple(c.term for c in self.children)

    @property
    def shape(self) -> Shape:
        return self._like.shape

    def _valid(self, state: Values) -> tuple[Distribution, tuple[Any, ...]]:
        try:
            return super()._valid(state)
        except BayesmcError:
            for child in self.children:  # the group knows the first one's name only
                dist, batch, _ = self.blanket.distribution(child, state)
                child.term.refuse_out_of_range(dist, batch, state[child.term.name])
            raise

    def _distribution(self, state: Values) -> tuple[Distribution, Shape, tuple[Any, ...]]:
        gathered = self._parents.gathered(state)
        if self.relation.kind == "lookup":
            return self.blanket.distribution_looked_up(self.child, gathered)
        return (*self.term.distribution(gathered), ())

    def _value(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        return self._own.gathered(values)[self.term.name]

    def _find_way(self) -> ByLabel | None:
        return None  # sums by label are those of one child


def partners_of(blanket: Blanket, kind: Kind, matches: Sequence[Match]) -> list[Partner]:
    """The children of a node by the pairs that they make, many like ones as one.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.conjugate import conjugate_kernel
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("rate", bmc.Gamma(2.0, 1.0))
    >>> for t in range(100):
    ...     net.add(f"y[{t}]", lambda rate, t=t: bmc.Poisson(rate * (1 + t)))
    >>> target = target_of(pose(net, {f"y[{t}]": t for t in range(100)}))
    >>> [len(p.terms) for p in conjugate_kernel(Blanket(target, "rate")).partners]
    [100]
    """
    made = {id(m): m for m in matches}
    by_child = {id(m.child): m for m in matches}

    def how(child: Child) -> Any:
        match = by_child[id(child)]
        return id(match.pair), match.power, match.is_copy, match.unless_picked is None

    small = [m.child for m in matches if math.prod(m.child.term.shape) < _LARGE]
    groups: dict[int, Partner] = {}
    for children in like_children(blanket, small, how):
        group = [by_child[id(c)] for c in children]
        partner = _as_one(blanket, group, kind)
        if partner is not None:
            groups[id(group[0])] = partner
            for match in group[1:]:
                del made[id(match)]
    return [groups.get(k) or Partner(blanket, m, kind) for k, m in made.items()]


# ---- private ------------------------------------------------------------------------------------


def _as_one(blanket: Blanket, matches: Sequence[Match], kind: Kind) -> LikePartner | None:
    """Like children as one partner; None where it is not known what each of them looks up."""
    one = as_one_child(blanket, [m.child for m in matches])
    return None if one is None else LikePartner(blanket, matches, kind, *one)
