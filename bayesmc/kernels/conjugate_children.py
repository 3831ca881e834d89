"""The children of a node as families whose parameters are expressions; many like ones are one.

A thousand slices of a series that came from one function have the same expressions up to constants and
names: they are one child with the slices as one more axis in front.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import (
    Expression,
    Family,
    Leaf,
    as_expression,
    broadcast,
    elementwise,
    expressions_of,
    ordered,
    pick,
)
from bayesmc.kernels.conjugate_labels import by_label
from bayesmc.kernels.label_sums import LabelSums
from bayesmc.network.expressions import Opaque, stored_leaf
from bayesmc.network.readings import frame
from bayesmc.passes.log_density import has_own_form, log_density
from bayesmc.passes.templates import stacked_rows, template
from bayesmc.passes.widening import widened
from bayesmc.shapes import Shape
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.relation import with_known
from bayesmc.structure.target import Target, Term


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
        if blanket.name in term.read.leaves:
            groups.setdefault(_key(blanket, term), []).append(term)
    return [c for terms in groups.values() for c in _made(blanket, terms)]


def apart(blanket: Blanket, child: Child) -> list[Child]:
    """Many like children one by one, or one entry by entry and not by label; nothing of others."""
    if child.sums is None and len(child.terms) == 1:
        return []
    return [_alone(blanket, t) for t in child.terms]


# ---- private ------------------------------------------------------------------------------------


def _roots(term: Term) -> tuple[Expression, ...]:
    """A term's parameters, and its value as it is stored."""
    own = stored_leaf(term.model, term.model[term.name])
    return (*expressions_of(term.read.result), own)  # type: ignore[union-attr]


def _key(blanket: Blanket, term: Term) -> Hashable:
    """Equal for like children."""
    known = term.model.cache.setdefault("templates of terms", {})
    if term.name not in known:
        known[term.name] = template(*_roots(term))
    found = known[term.name]
    low = _low(term)
    return frame(term.read.result), found.key, found.leaves.index(blanket.name), term.shape, low  # type: ignore[union-attr]


def _low(term: Term) -> int:
    domain = term.model[term.name].domain
    return 0 if domain is None else domain.low


def _made(blanket: Blanket, terms: Sequence[Term]) -> Iterator[Child]:
    summed = {t.name: by_label(blanket.target, t, blanket.name) for t in terms}
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
    roots = [with_known(blanket.target, r) for r in _roots(term)]
    return _child((term,), roots, term.shape, term.mask)


def _joined(blanket: Blanket, terms: Sequence[Term]) -> Child | None:
    """Like children as one."""
    found = stacked_rows([_roots(t) for t in terms])
    if found is None:
        return None
    leaves = {n.name: n for n in ordered(*found.roots) if isinstance(n, Leaf)}
    values = {k: as_expression(v) for k, v in found.constants.items()}
    for names in zip(*found.leaves, strict=True):
        if len(set(names)) > 1:
            if blanket.name in names:
                return None
            values[names[0]] = _side_by_side(blanket.target, leaves[names[0]], names)
    count = len(terms)
    roots = [with_known(blanket.target, widened(r, values, count)) for r in found.roots]
    mask = None
    if any(t.mask is not None for t in terms):
        shape = terms[0].shape
        mask = np.stack([np.broadcast_to(True if t.mask is None else t.mask, shape) for t in terms])
    # of parameters, plates and event may be fewer than the value's: the group stays in front of all
    rank = len(terms[0].shape)
    roots = [
        _in_front(r, o, rank, len(v)) for r, o, v in _with_events(terms[0], roots, found.roots)
    ]
    return _child(tuple(terms), roots, (count, *terms[0].shape), mask)


def _with_events(
    term: Term, wide: Sequence[Expression], roots: Sequence[Expression]
) -> Iterator[tuple[Expression, Expression, Shape]]:
    """Expressions with the event axes that each has."""
    result: Any = term.read.result  # type: ignore[union-attr]
    ndims = list(_event_ndims(result))
    event = len(term.model[term.name].event_shape)
    for w, r, n in zip(wide, roots, [*ndims, event], strict=True):
        yield w, r, (1,) * n


def _event_ndims(result: Any, make: Any = None, name: str = "") -> Iterator[int]:
    """Axes that one value of each parameter has."""
    if isinstance(result, Expression):
        known = getattr(make, "parameter_ndim", {})
        others = {"scale_tril": 2, "scale_diag": 1, "logits": known.get("probs", 0)}
        yield known.get(name, others.get(name, 0))
    elif isinstance(result, Family):
        for key, value in result.parameters.items():
            yield from _event_ndims(value, result.make, key)
    elif isinstance(result, (list, tuple)):
        for value in result:
            yield from _event_ndims(value, make, name)


def _in_front(wide: Expression, root: Expression, rank: int, event: int) -> Expression:
    """An expression with the group in front of all plates, those that it lacks of size one."""
    missing = rank + event - len(root.shape)
    if missing <= 0:
        return wide
    shape = (wide.shape[0], *(1,) * missing, *wide.shape[1:])
    at = np.arange(wide.size).reshape(shape)
    return pick([wide], at)


def _side_by_side(target: Target, first: Leaf, names: Sequence[str]) -> Expression:
    from_names: list[Expression] = []
    for name in names:
        node = stored_leaf(target.model, target.model[name])
        from_names.append(with_known(target, node))
    at = np.arange(len(names) * first.size).reshape(len(names), *first.shape)
    return pick(from_names, at)


def _child(
    terms: tuple[Term, ...], roots: Sequence[Expression], shape: Shape, mask: np.ndarray | None
) -> Child:
    *parameters, value = roots
    low = _low(terms[0])
    if low:
        value = elementwise(np.add, value, low)
    result: Any = terms[0].read.result  # type: ignore[union-attr]
    if not isinstance(result, Family):
        raise TraceError("it is no distribution that can be followed")
    return Child(terms, _with_parts(result, iter(parameters)), value, shape, mask)


def _with_parts(traced: Any, parts: Iterator[Expression]) -> Any:
    """What was traced, with other expressions."""
    if isinstance(traced, Expression):
        return next(parts)
    if isinstance(traced, Family):
        return Family(traced.make, {k: _with_parts(v, parts) for k, v in traced.parameters.items()})
    if isinstance(traced, (list, tuple)):
        return type(traced)(_with_parts(v, parts) for v in traced)
    return traced
