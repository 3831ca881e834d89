"""How a parent's value reaches its child: the shape rules of the contract, once.

A parent arrives as ``(*batch, *[size if shared else 1 for the child's plates], *event)``; plates the
child lacks stay behind as foreign axes of a ``PlateArray``. Discrete parents are decoded on the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bayesmc.network.labels import Domain
from bayesmc.plates import PlateArray
from bayesmc.shapes import Shape, read_only


class Aligner:
    """Turns the stored value of one parent into the argument that one child's function receives.

    Parameters
    ----------
    child : tuple of str
        The child's plates.
    plates : tuple of str
        The parent's plates.
    event_ndim : int
        The parent's event axes.
    domain : Domain or None
        Of a finite discrete parent, whose positions are decoded to user values.
    positions : bool
        Pass the positions themselves (tables want them).
    """

    __slots__ = ("_axes", "_insert", "_plain", "domain", "event_ndim", "foreign", "own", "trailing")

    def __init__(
        self,
        child: Sequence[str],
        plates: Sequence[str],
        event_ndim: int,
        domain: Domain | None,
        positions: bool = False,
    ) -> None:
        shared = [p for p in child if p in plates]
        self.foreign = tuple(p for p in plates if p not in child)
        self.trailing = len(plates) + event_ndim
        self.event_ndim = event_ndim
        self.own = len(child)
        self.domain = None if positions else domain
        order = [plates.index(p) for p in (*shared, *self.foreign)]
        tail = [*order, *range(len(plates), self.trailing)]
        self._axes = None if tail == list(range(self.trailing)) else tuple(tail)
        inserted = tuple(slice(None) if p in plates else None for p in child)
        rest = (slice(None),) * (len(self.foreign) + event_ndim)
        self._insert = (Ellipsis, *inserted, *rest) if None in inserted else None
        self._plain = self._axes is None and self._insert is None

    def batch_shape(self, value: np.ndarray) -> Shape:
        """Shape of the batch axes of a stored value."""
        return value.shape[: value.ndim - self.trailing]

    def __call__(self, value: np.ndarray) -> Any:
        """The read-only argument (a ``PlateArray`` when plates are foreign)."""
        if self.domain is not None:
            value = self.domain.decode(value)
        value = read_only(value) if self._plain else self.place(value)
        if self.foreign:
            return PlateArray(value, self.foreign, self.own, self.event_ndim)
        return value

    def place(self, value: np.ndarray) -> np.ndarray:
        """The value with its axes where the child wants them, read-only and not decoded."""
        if self._plain:
            return value
        if self._axes is not None:
            lead = value.ndim - self.trailing
            value = value.transpose(*range(lead), *(lead + a for a in self._axes))
        if self._insert is not None:
            value = value[self._insert]
        return read_only(value)


class RowAligner(Aligner):
    """Turns the stored value of one variable into the argument of a potential over rows of an index.

    The argument has shape ``(*batch, rows, *event)``: row r holds element ``flat[r]`` of the variable.

    Parameters
    ----------
    plates : tuple of str
        The variable's plates.
    flat : ndarray of int, shape (rows,)
        Positions among the elements of the plates, in C order.
    count : int
        Number of those elements.
    """

    __slots__ = ("_all", "count", "flat")

    def __init__(
        self,
        plates: Sequence[str],
        event_ndim: int,
        domain: Domain | None,
        flat: np.ndarray,
        count: int,
        positions: bool = False,
    ) -> None:
        super().__init__(plates, plates, event_ndim, domain, positions)
        self.own = 1
        self.flat, self.count = flat, count
        self._all = len(flat) == count and bool((flat == np.arange(count)).all())

    def __call__(self, value: np.ndarray) -> Any:
        return self.argument(self.place(value))

    def place(self, value: np.ndarray) -> np.ndarray:
        """The stored values of every row, read-only and not decoded."""
        lead = value.ndim - self.trailing
        event = value.shape[value.ndim - self.event_ndim :]
        elements = value.reshape((*value.shape[:lead], self.count, *event))
        if self._all or self.count == 1:  # one element broadcasts over the rows
            return elements
        return np.take(elements, self.flat, axis=lead)

    def argument(self, stored: np.ndarray) -> np.ndarray:
        """What the function receives for stored values of the rows (of one for all: it broadcasts)."""
        value = stored if self.domain is None else self.domain.decode(stored)
        lead = value.ndim - 1 - self.event_ndim
        shape = (*value.shape[:lead], len(self.flat), *value.shape[lead + 1 :])
        return read_only(value if value.shape == shape else np.broadcast_to(value, shape))
