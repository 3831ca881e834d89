"""How the elements of a term depend on the elements of one node.

* ``aligned``: the term lives in the node's plates (and perhaps more, which are summed over);
* ``lookup``: it gathers one element (``mean[label]``) by an index that may change from call to call;
* ``rows``: it gathers by indices that never change, several perhaps (pairs of sites, players of a game);
* ``whole``: anything else: every element of the term may depend on every element of the node.

The first needs no look at the function, by the shape rules; lookups and rows are those that its expression
makes, and what cannot be followed is whole.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import (
    Constant,
    Expression,
    Leaf,
    Program,
    as_expression,
    broadcast,
    elementwise,
    ordered,
    substituted,
)
from bayesmc.network import Model
from bayesmc.network.expressions import Opaque, density
from bayesmc.network.readings import by_element
from bayesmc.passes.reads import elements_read
from bayesmc.shapes import Shape
from bayesmc.structure.target import Target, Term


@dataclass(frozen=True, eq=False)
class Relation:
    """How a term's elements depend on a node's.

    Attributes
    ----------
    kind : str
        ``aligned``, ``lookup``, ``rows`` or ``whole``.
    plates, term_plates : tuple of str
        Of the node and of the term.
    shape : tuple of int
        Sizes of the node's plates.
    source : str or None
        For a lookup, the parent of the term through which the node arrives (it has the node's plates).
    index : callable or None
        For a lookup: from stored values to the flat element that each element of the term reads, shape
        ``(*lead, *term plates)``.
    rows : tuple of ndarray
        For ``rows``: flat elements of the node, one array over the term's flat elements for every role.
    coupled : tuple of str
        For ``whole``: plates of the node whose elements must be updated in turn.
    place : Expression or None
        For a lookup, ``index`` as an expression of stored values.
    """

    kind: str
    plates: tuple[str, ...]
    shape: Shape
    term_plates: tuple[str, ...] = ()
    source: str | None = None
    index: Callable[[Mapping[str, np.ndarray]], np.ndarray] | None = None
    rows: tuple[np.ndarray, ...] = ()
    coupled: tuple[str, ...] = ()
    place: Expression | None = None
    _kept: dict[Any, Any] = field(default_factory=dict, repr=False)

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    @property
    def edges(self) -> np.ndarray:
        """Pairs of elements that meet in one row, shape (pairs, 2)."""
        pairs = [
            np.stack([a, b], axis=1)[a != b]
            for i, a in enumerate(self.rows)
            for b in self.rows[i + 1 :]
        ]
        return np.concatenate([np.empty((0, 2), dtype=np.intp), *pairs])

    def collect(
        self,
        array: np.ndarray,
        term_shape: Shape,
        members: np.ndarray | None = None,
        state: Mapping[str, np.ndarray] | None = None,
    ) -> np.ndarray:
        """Sum a term's elements for every element of the node.

        Parameters
        ----------
        array : ndarray, shape (*lead, *term plates)
        members : ndarray of int, optional
            Flat elements wanted; all by default.
        state : dict, optional
            Stored values, which a lookup needs.

        Returns
        -------
        ndarray, shape (*lead, *plates), or (*lead, members)
        """
        lead = array.shape[: array.ndim - len(term_shape)]
        if self.kind == "aligned":
            return self._picked(self._summed(array, len(lead)), members)
        array = np.broadcast_to(array, lead + term_shape)
        if self.kind == "whole":
            return self._by_plates(array, len(lead), members)
        flat = array.reshape(*lead, -1)
        if self.kind == "rows":
            return self._by_rows(flat, members)
        assert self.index is not None and state is not None
        index = self.index(state)
        index = index.reshape(*index.shape[: index.ndim - len(term_shape)], -1)
        return self._picked(segment_sum(flat, index, self.size).reshape(lead + self.shape), members)

    # ---- private -------------------------------------------------------------------------------

    def _summed(self, array: np.ndarray, lead: int) -> np.ndarray:
        """Sum over the term's own plates, the node's in their order."""
        extra = tuple(lead + i for i, p in enumerate(self.term_plates) if p not in self.plates)
        if extra:
            array = array.sum(axis=extra)
        kept = [p for p in self.term_plates if p in self.plates]
        if kept != list(self.plates):
            order = [lead + kept.index(p) for p in self.plates]
            array = array.transpose(*range(lead), *order)
        return array

    def _picked(self, array: np.ndarray, members: np.ndarray | None) -> np.ndarray:
        if members is None:
            return array
        lead = array.shape[: array.ndim - len(self.shape)]
        full = np.broadcast_to(array, lead + self.shape)
        return full.reshape(*lead, -1)[..., members]

    def _by_plates(self, array: np.ndarray, lead: int, members: np.ndarray | None) -> np.ndarray:
        """Sum over everything but the plates that are not coupled: members differ in those alone."""
        kept = tuple(p for p in self.plates if p not in self.coupled)
        extra = tuple(lead + i for i, p in enumerate(self.term_plates) if p not in kept)
        summed = array.sum(axis=extra)
        own = [p for p in self.term_plates if p in kept]
        summed = summed.transpose(*range(lead), *(lead + own.index(p) for p in kept))
        at = np.unravel_index(np.arange(self.size) if members is None else members, self.shape)
        picked = tuple(at[self.plates.index(p)] for p in kept)
        if not picked:
            count = self.size if members is None else len(members)
            return np.broadcast_to(summed[..., None], (*summed.shape, count))
        return summed[(Ellipsis, *picked)]

    def _by_rows(self, flat: np.ndarray, members: np.ndarray | None) -> np.ndarray:
        """Sum the rows that touch each element; of a class no two meet."""
        key = None if members is None else members.tobytes()
        found = self._kept.get(key)
        if found is None:
            chosen = np.arange(self.size) if members is None else members
            place = np.full(self.size, -1)
            place[chosen] = np.arange(len(chosen))
            owner = np.max([place[r] for r in self.rows], axis=0)
            touched = np.flatnonzero(owner >= 0)
            found = self._kept[key] = touched, owner[touched], len(chosen)
        touched, owner, count = found
        summed = segment_sum(flat[..., touched], owner, count)
        return summed if members is not None else summed.reshape(*flat.shape[:-1], *self.shape)


def segment_sum(values: np.ndarray, index: np.ndarray, count: int) -> np.ndarray:
    """Sums of ``values (*lead, n)`` by ``index``, which broadcasts to them, shape ``(*lead, count)``."""
    lead = values.shape[:-1]
    total = math.prod(lead)
    if total == 0 or values.shape[-1] == 0:
        return np.zeros((*lead, count))
    if index.size != values.shape[-1]:
        index = np.broadcast_to(index, values.shape).reshape(total, -1)
    else:
        index = index.reshape(1, -1)
    offsets = (np.arange(total) * count)[:, None]
    summed = np.bincount((index + offsets).ravel(), weights=values.ravel(), minlength=total * count)
    return summed.reshape(*lead, count)


def relation_of(target: Target, name: str, term: Term) -> Relation:
    """How a term's elements depend on those of a chain node."""
    model = target.model
    node = model[name]
    if not node.plates:
        return Relation("aligned", (), (), _plates_of(model, term))
    indexed = _indexed(target, name, term)
    if indexed is not None:
        return indexed
    carriers = _carriers(target, name)
    entering = [p for p in dict.fromkeys(term.parents) if p in carriers]
    if all(carriers[p] and set(node.plates) <= set(term.plates) for p in entering):
        return Relation("aligned", node.plates, node.plate_shape, term.plates)
    coupled = tuple(p for p in node.plates if p not in term.plates)
    if not all(carriers[p] for p in entering):
        coupled = node.plates
    whole = Relation("whole", node.plates, node.plate_shape, term.plates, coupled=coupled)
    if len(entering) != 1 or model[entering[0]].plates != node.plates or not carriers[entering[0]]:
        return whole
    return _looked_up(target, name, term, entering[0], whole)


# ---- private ------------------------------------------------------------------------------------


def _plates_of(model: Model, term: Term) -> tuple[str, ...]:
    """Names of a term's plates; rows of an index have one of their own."""
    return term.plates if len(term.plates) == len(term.shape) else ("index",) * len(term.shape)


def _carriers(target: Target, name: str) -> dict[str, bool]:
    """Nodes through which a node's value reaches terms, and whether element by element."""
    plates = set(target.model[name].plates)
    found = {name: True}
    for link in target.below((name,)):
        node = target.model[link]
        above = [p for p in node.parents if p in found]
        found[link] = all(found[p] for p in above) and plates <= set(node.plates)
    return found


def _indexed(target: Target, name: str, term: Term) -> Relation | None:
    """The relation to a potential over rows of an index."""
    if not term.is_potential:
        return None
    potential, _ = target.model.potentials[term.name]
    index = getattr(potential, "index", None)
    if index is None:
        return None
    node = target.model[name]
    if name in potential.scope and not (set(target.below((name,))) & set(potential.scope)):
        rows = tuple(
            np.asarray(at)
            for parent, at in zip(potential.scope, index, strict=True)
            if parent == name
        )
        return Relation("rows", node.plates, node.plate_shape, ("index",), rows=rows)
    return Relation("whole", node.plates, node.plate_shape, ("index",), coupled=node.plates)


def _looked_up(target: Target, name: str, term: Term, source: str, whole: Relation) -> Relation:
    """A lookup or rows, if that is what the term's expression says."""
    node = target.model[name]
    if node.domain is not None:
        return whole
    links = frozenset(p for p in term.parents if target.model[p].kind == "deterministic")
    read = density(target.model, term.name, links)
    if isinstance(read, Opaque):
        return whole
    try:
        found = positions(target, read.result, source, term.shape)
    except TraceError:
        return whole
    fixed = [with_known(target, at) for at in found]
    if fixed and all(isinstance(at, Constant) for at in fixed):
        roles = np.stack([np.ravel(at.value) for at in fixed])  # type: ignore[attr-defined]
        # where one role reads nothing it stands with another; what reads nothing at all may be anyone's
        rows = tuple(np.maximum(np.where(roles < 0, roles.max(axis=0), roles), 0))
        return Relation("rows", node.plates, node.plate_shape, term.plates, source, rows=rows)
    if len(found) != 1:
        return whole
    index = partial(looked_up, Program([found[0]]))
    return Relation(
        "lookup", node.plates, node.plate_shape, term.plates, source, index, place=fixed[0]
    )


def positions(target: Target, result: Any, source: str, shape: Shape) -> tuple[Expression, ...]:
    """The flat elements of a node that each element of a term reads, one expression for each way.

    Parameters
    ----------
    result : Family, Distribution or Expression
        What the term's function computes.
    source : str
    shape : tuple of int
        Of the term.

    Raises
    ------
    TraceError
        An element may read several in one way.
    """
    node = target.model[source]
    count = math.prod(node.plate_shape)
    numbers = np.repeat(np.arange(count), math.prod(node.event_shape)).reshape(node.value_shape)
    found: dict[Expression, None] = {}
    for root in by_element(result):
        for at in elements_read(root, source, numbers) if source in root.leaves else ():
            lacks = any(isinstance(n, Constant) and (n.value < 0).any() for n in ordered(at))
            if lacks and not isinstance(at, Constant):
                # a factor that reads no element is a constant, whoever gets it
                at = elementwise(np.maximum, at, 0)
            found[broadcast(at, shape)] = None
    return tuple(found)


def with_known(target: Target, expression: Expression) -> Expression:
    """An expression with constants in the place of what is known."""
    values = {}
    for node in ordered(expression):
        if isinstance(node, Leaf) and target.is_known(node.name):
            value = np.asarray(target.known[node.name])
            if value.shape == node.shape:
                values[node.name] = as_expression(value)
    return substituted(expression, values) if values else expression


def looked_up(program: Program, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """What a program of one expression finds."""
    (found,) = program(values)
    return found
