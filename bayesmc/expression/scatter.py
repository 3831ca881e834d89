"""Sums of elements at places: what undoes picks and gathers, as calls of the graph."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bayesmc.shapes import Shape


@dataclass(frozen=True)
class Places:
    """Whole numbers that compare and hash by what they are."""

    data: bytes

    @classmethod
    def of(cls, array: np.ndarray) -> Places:
        return cls(np.ascontiguousarray(array, np.intp).tobytes())

    @property
    def array(self) -> np.ndarray:
        return np.frombuffer(self.data, np.intp)


@dataclass(frozen=True)
class Scattered:
    """Elements added up in an array of zeros.

    Attributes
    ----------
    order : Places
        The elements in the order of where they go.
    starts, counts : Places
        For each place where in that order its elements begin, and how many they are.
    shape : tuple of int
    """

    order: Places
    starts: Places
    counts: Places
    shape: Shape

    def __call__(self, part: np.ndarray) -> np.ndarray:
        some = self.counts.array > 0
        sums = np.add.reduceat(part[..., self.order.array], self.starts.array[some], axis=-1)
        found = np.zeros((*part.shape[:-1], some.size))
        found[..., some] = sums
        return found.reshape(*part.shape[:-1], *self.shape)


@dataclass(frozen=True)
class Gathered:
    """Entries added up at computed rows of a table of zeros: of the entries and the rows.

    Attributes
    ----------
    shape : tuple of int
        Of the table.
    row_ndim : int
    """

    shape: Shape
    row_ndim: int

    def __call__(self, part: np.ndarray, rows: np.ndarray) -> np.ndarray:
        block = self.shape[1:]
        own = part.shape[: part.ndim - self.row_ndim - len(block)]
        batch = np.broadcast_shapes(own, rows.shape[: rows.ndim - self.row_ndim])
        places = rows.shape[rows.ndim - self.row_ndim :]
        part = np.broadcast_to(part, (*batch, *places, *block))
        at = np.broadcast_to(rows, (*batch, *places))
        many, size = math.prod(batch), self.shape[0]
        flat = (at.reshape(many, -1) + size * np.arange(many)[:, None]).reshape(-1)
        columns = part.reshape(flat.size, -1)
        found = np.empty((many * size, columns.shape[1]))
        for k in range(columns.shape[1]):
            found[:, k] = np.bincount(flat, columns[:, k], many * size)
        return found.reshape(*batch, *self.shape)
