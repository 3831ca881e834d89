"""How the elements of a term depend on the elements of one node.

* ``aligned``: the term lives in the node's plates (and perhaps more, which are summed over);
* ``lookup``: it gathers one element (``mean[label]``) by an index that may change from call to call;
* ``rows``: it gathers by indices that never change, several perhaps (pairs of sites, players of a game);
* ``whole``: anything else: every element of the term may depend on every element of the node.

The first needs no look at the function, by the shape rules; the others are found by tracing it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesmc.network import Model
from bayesmc.shapes import Shape
from bayesmc.structure.target import Target, Term
from bayesmc.structure.traced import trace_term


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
    rows : tuple of ndarray
        For ``rows``: flat elements of the node, one array over the term's flat elements for every role.
    coupled : tuple of str
        For ``whole``: plates of the node whose elements must be updated in turn.
    """

    kind: str
    plates: tuple[str, ...]
    shape: Shape
    term_plates: tuple[str, ...] = ()
    source: str | None = None
    foreign: tuple[str, ...] = ()
    rows: tuple[np.ndarray, ...] = ()
    coupled: tuple[str, ...] = ()
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
        keys: Sequence[Any] = (),
        members: np.ndarray | None = None,
    ) -> np.ndarray:
        """Sum a term's elements for every element of the node.

        Parameters
        ----------
        array : ndarray, shape (*lead, *term plates)
        keys : sequence
            The index of a lookup, as the function used it in this very call.
        members : ndarray of int, optional
            Flat elements wanted; all by default.

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
        index = self.index_of(keys, term_shape)
        index = index.reshape(*index.shape[: index.ndim - len(term_shape)], -1)
        return self._picked(segment_sum(flat, index, self.size).reshape(lead + self.shape), members)

    def index_of(self, keys: Sequence[Any], term_shape: Shape) -> np.ndarray:
        """Flat element that each element of the term looked up, shape ``(*lead, *term plates)``."""
        n = len(term_shape)
        found: Any = 0
        for plate, size in zip(self.plates, self.shape, strict=True):
            if plate in self.foreign:
                key = keys[self.foreign.index(plate)]
                at = np.asarray(getattr(key, "codes", key))
            else:
                axis = self.term_plates.index(plate)
                at = np.arange(size).reshape((size,) + (1,) * (n - 1 - axis))
            found = found * size + at
        found = np.asarray(found)
        if found.ndim < n or found.shape[found.ndim - n :] != term_shape:
            lead = found.shape[: max(found.ndim - n, 0)]
            found = np.broadcast_to(found, lead + term_shape)
        return found

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
    """A lookup or rows, if tracing proves it."""
    model = target.model
    node = model[name]
    traced = trace_term(target, (name,), term)
    if traced is None:
        return whole
    sources = traced.sources
    foreign = tuple(p for p in node.plates if p not in term.plates)
    used = {s for s in sources if s.startswith(f"{name}[")}
    if not used or any(s.endswith("[*]") for s in used) or name in sources:
        return whole
    lookup = Relation("lookup", node.plates, node.plate_shape, term.plates, source, foreign)
    if traced.keys_are_constant:
        rows = tuple(lookup.index_of(k, term.shape).ravel() for k in traced.keys)
        if all(len(r) == math.prod(term.shape) for r in rows):
            return Relation("rows", node.plates, node.plate_shape, term.plates, source, rows=rows)
    return lookup if len(used) == 1 and len(traced.keys) == 1 else whole
