"""Sums of a child's elements for every element of a node, with the event's axes last."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.shapes import Shape
from bayesmc.structure.relation import Relation, segment_sum


@dataclass(frozen=True, eq=False)
class Collector:
    """How a child's elements are summed in one evaluation.

    Attributes
    ----------
    shape : tuple of int
        Sizes of the child's plates.
    keys : sequence
        The index of a lookup, as the function used it.
    members : ndarray of int or None
        Flat elements of the node that are wanted.
    """

    relation: Relation
    shape: Shape
    keys: Sequence[Any]
    members: np.ndarray | None

    def sum(self, array: np.ndarray, event_ndim: int = 0) -> np.ndarray:
        """Sums of ``(lead, *child plates, *event)``: ``(lead, *plates, *event)`` or of the members.

        Plates along which the array does not vary may have size 1.
        """
        if event_ndim:
            lead = range(event_ndim)
            array = np.moveaxis(array, range(-event_ndim, 0), lead)
        if self.relation.kind == "lookup":
            found = self._looked_up(array)
        else:
            if self.relation.kind == "aligned":
                array = array * self._missing(array)
            found = self.relation.collect(array, self.shape, self.keys, self.members)
        return np.moveaxis(found, range(event_ndim), range(-event_ndim, 0)) if event_ndim else found

    def outer(self, rows: np.ndarray) -> np.ndarray:
        """Sums of outer products of ``(lead, *child plates, m, d)``: ``(lead, *plates, d, d)``."""
        if self.relation.kind == "aligned":
            return self._products(rows)
        d = rows.shape[-1]
        i, j = np.tril_indices(d)
        flat = self.sum((rows[..., i] * rows[..., j]).sum(axis=-2), 1)
        full = np.empty((*flat.shape[:-1], d, d))
        full[..., i, j] = full[..., j, i] = flat
        return full

    def tally(self, codes: np.ndarray, states: int, mask: np.ndarray | None) -> np.ndarray:
        """How often each code came, ``(lead, *plates, states)``, from codes ``(lead, *child plates)``."""
        size = self.relation.size
        cell = np.broadcast_to(codes, (len(codes), *self.shape))
        if size > 1:
            cell = self.elements * states + cell
        lead = len(cell)
        cell = cell.reshape(lead, -1)
        if mask is not None:
            cell = cell[:, mask.ravel()]
        if cell.dtype.kind == "f":
            cell = cell.astype(np.intp)
        if lead > 1:
            cell = cell + (np.arange(lead) * (size * states))[:, None]
        counts = np.bincount(cell.ravel(), minlength=lead * size * states)
        counts = counts.reshape(lead, size, states).astype(float)
        if self.members is not None:
            return counts[:, self.members]
        return counts.reshape(lead, *self.relation.shape, states)

    # ---- private -------------------------------------------------------------------------------

    def _missing(self, array: np.ndarray) -> int:
        """How many elements each entry stands for, along the plates that are summed."""
        at = array.ndim - len(self.shape)
        count = 1
        for i, (plate, size) in enumerate(zip(self.relation.term_plates, self.shape, strict=True)):
            if plate not in self.relation.plates and array.shape[at + i] != size:
                count *= size
        return count

    def _products(self, rows: np.ndarray) -> np.ndarray:
        relation = self.relation
        plates, n = relation.term_plates, len(self.shape)
        lead = rows.ndim - n - 2
        kept = [plates.index(p) for p in relation.plates]
        summed = [i for i, p in enumerate(plates) if p not in relation.plates]
        copies = 1
        for i in summed:
            if rows.shape[lead + i] != self.shape[i]:
                copies *= self.shape[i]
        order = [*range(lead), *(lead + i for i in (*kept, *summed)), lead + n, lead + n + 1]
        moved = rows.transpose(order)
        shape = moved.shape[: lead + len(kept)]
        flat = moved.reshape(
            (*shape, math.prod(moved.shape[lead + len(kept) : -1]), rows.shape[-1])
        )
        products = np.matrix_transpose(flat) @ flat
        if copies != 1:
            products = products * copies
        if self.members is None:
            return products
        full = np.broadcast_to(products, (*shape[:lead], *relation.shape, *products.shape[-2:]))
        full = full.reshape((*shape[:lead], relation.size, *products.shape[-2:]))
        return full[..., self.members, :, :]

    def _looked_up(self, array: np.ndarray) -> np.ndarray:
        """Sums by an index that may differ between chains where the array does not."""
        n, index = len(self.shape), self.elements
        lead = array.shape[: array.ndim - n]
        lead = (*lead[:-1], max(lead[-1], len(index)))
        full = np.broadcast_to(array, lead + self.shape).reshape((*lead, -1))
        relation = self.relation
        summed = segment_sum(full, index.reshape((len(index), -1)), relation.size)
        if self.members is not None:
            return summed[..., self.members]
        return summed.reshape(lead + relation.shape)

    @cached_property
    def elements(self) -> np.ndarray:
        """The node's flat element behind each element of the child, shape ``(lead, *child plates)``."""
        relation = self.relation
        if relation.kind == "lookup":
            found = relation.index_of(self.keys, self.shape)
        elif relation.kind == "rows":
            found = relation.rows[0].reshape(self.shape)
        else:
            found = np.zeros((), dtype=np.intp)
            for plate, size in zip(relation.plates, relation.shape, strict=True):
                axis = relation.term_plates.index(plate)
                steps = np.arange(size).reshape((size,) + (1,) * (len(self.shape) - 1 - axis))
                found = found * size + steps
        found = np.asarray(found)
        ndim = 1 + len(self.shape)
        found = found.reshape((1,) * (ndim - found.ndim) + found.shape)
        return np.broadcast_to(found, (len(found), *self.shape))
