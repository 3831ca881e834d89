"""The children of a node as families whose parameters are expressions; many like ones are one.

A thousand slices of a series that came from one function have the same expressions up to constants and
names: they are one child with the slices as one more axis in front.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import (
    Constant,
    Elementwise,
    Expression,
    Family,
    Gather,
    Leaf,
    Pick,
    Reduction,
    as_expression,
    broadcast,
    elementwise,
    expressions_of,
    mapped,
    ordered,
    pick,
    reduction,
)
from bayesmc.kernels.label_sums import LabelSums, label_sums
from bayesmc.network import Model
from bayesmc.network.expressions import Opaque, stored_leaf
from bayesmc.network.readings import with_axes
from bayesmc.passes.log_density import has_own_form, log_density
from bayesmc.passes.widening import widened
from bayesmc.shapes import Shape
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.programs import like_roots, roots_of, template_of
from bayesmc.structure.relation import with_known
from bayesmc.structure.target import Target, Term, Values

#: elements per label from which on sums by label pay
_PER_LABEL = 4
#: parameters that must be positive
_POSITIVE = frozenset(
    ("scale", "rate", "concentration", "concentration1", "concentration0", "df", "scale_diag")
)


@dataclass(frozen=True, eq=False)
class Child:
    """One child, or many like ones.

    Attributes
    ----------
    terms : tuple of Term
    family : Family
        Known values are constants in it.
    value : Expression, shape (*shape, *event)
        As the family speaks of it.
    shape : tuple of int
        Of the entries: the plates, and the terms in front where there are many.
    mask : ndarray of bool or None
        Entries that count; broadcasts to the shape.
    sums : LabelSums or None
        Its sums by label, of which the density then is.
    """

    terms: tuple[Term, ...]
    family: Family
    value: Expression
    shape: Shape
    mask: np.ndarray | None
    sums: LabelSums | None = None

    @cached_property
    def density(self) -> Expression:
        """Log densities of all entries, or of all labels.

        Raises
        ------
        TraceError
            The family has no closed form.
        """
        if self.sums is not None:
            return self.sums.expression
        if has_own_form(self.family) and any(t.expression is None for t in self.terms):
            raise TraceError("its form gives other values than its log_prob")
        return broadcast(log_density(self.family, self.value), self.shape)

    def read(self, name: str) -> list[str]:
        """The parameters in which a node occurs."""
        return [
            k
            for k, v in self.family.parameters.items()
            if any(name in e.leaves for e in expressions_of(v))
        ]

    @property
    def is_alone(self) -> bool:
        """Whether it is one child, entry by entry."""
        return self.sums is None and len(self.terms) == 1

    @property
    def word(self) -> str:
        """What the family is called."""
        return getattr(self.family.make, "__name__", str(self.family.make))


def children_of(blanket: Blanket) -> list[Child] | Term:
    """The children of a node that vary with it, or the first one that cannot be followed."""
    groups: dict[Hashable, list[Term]] = {}
    for child in blanket.children:
        term = child.term
        if term.is_potential or isinstance(term.read, Opaque):
            return term
        like = template_of(term)
        if blanket.name in like.leaves:
            key = like.key, like.leaves.index(blanket.name), term.shape, _low(term)
            groups.setdefault(key, []).append(term)
    return [c for terms in groups.values() for c in _made(blanket, terms)]


def apart(blanket: Blanket, child: Child) -> list[Child]:
    """Many like children one by one, or one entry by entry and not by label."""
    return [_alone(blanket, t) for t in child.terms]


def least_values(child: Child, name: str, model: Model) -> Iterator[Expression]:
    """The least value of each parameter that should be positive and is not known to be.

    Those that depend on the node itself are left out: there its prior's support looks after that.
    """
    for key, value in child.family.parameters.items():
        if key not in _POSITIVE or not isinstance(value, Expression) or not value.leaves:
            continue
        if name not in value.leaves and not _is_positive(value, model):
            yield reduction(np.minimum, value, range(len(value.shape)))


def refuse(child: Child, values: Values) -> None:
    """Raise where a child's parameters are out of range and did not overflow, naming it."""
    for term in child.terms:
        dist, batch = term.distribution(values)
        if dist.invalid is not None:
            term.refuse_out_of_range(dist, batch, values[term.name])


# ---- private ------------------------------------------------------------------------------------


def _low(term: Term) -> int:
    domain = term.model[term.name].domain
    return 0 if domain is None else domain.low


def _by_label(target: Target, term: Term, node: str) -> LabelSums | None:
    """The sums of a child of a node by its label, where it has one and they pay."""
    own = [p for p in term.parents if set(term.plates) & set(target.model[p].plates)]
    if len(own) != 1 or node in own:
        return None
    sums = label_sums(target, term, own[0])
    if sums is None or sums.states * _PER_LABEL > sums.statistics.shape[1]:
        return None
    return sums


def _made(blanket: Blanket, terms: Sequence[Term]) -> Iterator[Child]:
    summed = {t.name: _by_label(blanket.target, t, blanket.name) for t in terms}
    if len(terms) > 1 and not any(summed.values()):
        found = _joined(blanket, terms)
        if found is not None:
            yield found
            return
    for term in terms:
        sums = None if len(blanket.classes) > 1 else summed[term.name]
        child = _alone(blanket, term)
        yield child if sums is None else replace(child, sums=sums, mask=None)


def _alone(blanket: Blanket, term: Term) -> Child:
    roots = [with_known(blanket.target, r) for r in roots_of(term)]
    return _child((term,), _family(term, roots), roots[-1], term.shape, term.mask)


def _joined(blanket: Blanket, terms: Sequence[Term]) -> Child | None:
    """Like children as one."""
    target, first, count = blanket.target, terms[0], len(terms)
    found = like_roots(terms)
    values = {k: as_expression(v) for k, v in found.constants.items()}
    for names in zip(*found.leaves, strict=True):
        if len(set(names)) > 1:
            if blanket.name in names:
                return None
            values[names[0]] = _side_by_side(target, names)
    try:  # of parameters, plates may be fewer than the value's: the group stays in front of all
        family = with_axes(_family(first, found.roots), len(first.shape))
    except TraceError:
        return None
    *parameters, value = (
        with_known(target, widened(r, values, count))
        for r in (*expressions_of(family), found.roots[-1])
    )
    mask = None
    if any(t.mask is not None for t in terms):
        every = [True if t.mask is None else t.mask for t in terms]
        mask = np.stack([np.broadcast_to(m, first.shape) for m in every])
    family = _family(first, parameters)
    return _child(tuple(terms), family, value, (count, *first.shape), mask)


def _side_by_side(target: Target, names: Sequence[str]) -> Expression:
    leaves = [stored_leaf(target.model, target.model[n]) for n in names]
    at = np.arange(len(names) * leaves[0].size).reshape(len(names), *leaves[0].shape)
    return pick([with_known(target, node) for node in leaves], at)


def _family(term: Term, roots: Sequence[Expression]) -> Family:
    """The family of a term, of other parameters."""
    parameters = iter(roots)
    result = mapped(term.read.result, lambda _: next(parameters))  # type: ignore[union-attr]
    if not isinstance(result, Family):
        raise TraceError("it is no distribution that can be followed")
    return result


def _child(
    terms: tuple[Term, ...],
    family: Family,
    value: Expression,
    shape: Shape,
    mask: np.ndarray | None,
) -> Child:
    low = _low(terms[0])
    return Child(terms, family, elementwise(np.add, value, low) if low else value, shape, mask)


_ALWAYS = (np.exp, np.logaddexp)
_KEEPING = (np.multiply, np.divide, np.add, np.sqrt, np.square, np.power, np.reciprocal, np.maximum)


def _is_positive(root: Expression, model: Model) -> bool:
    """Whether an expression is positive wherever it is a number."""
    found: dict[Expression, bool] = {}
    for node in ordered(root):
        inner = [found[a] for a in node.operands]
        if isinstance(node, Constant):
            found[node] = bool((node.value > 0).all())
        elif isinstance(node, Leaf):
            support = model[node.name].support
            low = getattr(support, "low", None)
            found[node] = low is not None and bool(np.min(low) >= 0)
        elif isinstance(node, Elementwise):
            rest = inner[:1] if node.function is np.power else inner
            kept = node.function in _KEEPING and all(rest)
            found[node] = kept or node.function in _ALWAYS
        elif isinstance(node, Gather):
            found[node] = inner[0]
        else:
            sums = not isinstance(node, Reduction) or node.ufunc is np.add
            found[node] = isinstance(node, (Pick, Reduction)) and sums and all(inner)
    return found[root]
