"""Slices of a series as array axes, and the factors over finite variables that are read off them.

Time is the first batch axis and each variable has one of its own, so that one call of a user's function
serves many slices and all states.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from bayesmc.dbn import TIME, Series

#: slices back, node
Key = tuple[int, str]
#: slices back, node, element of its plates
Variable = tuple[int, str, int]


@dataclass(frozen=True, eq=False)
class Piece:
    """A log factor over finite variables.

    Attributes
    ----------
    node : str
        Whose conditional density it is.
    scope : tuple of Variable
    values : ndarray, shape (rows or 1, sequences or 1, *cards)
    is_evidence : bool
        It says what was seen, not what is possible.
    invalid : ndarray of bool or None
        Configurations with bad parameters, where ``values`` is 0; same shape.
    """

    node: str
    scope: tuple[Variable, ...]
    values: np.ndarray
    is_evidence: bool = False
    invalid: np.ndarray | None = None


#: a factor of one
NEUTRAL = Piece("", (), np.zeros((1, 1)))


@dataclass(frozen=True, eq=False)
class Term:
    """What a node's density, or a computed node, depends on in slices of one kind.

    Attributes
    ----------
    name : str
    kind : int
        0: slice 0; 1: slice 1, whose slice before is slice 0; 2: all others.
    alone : tuple of Key
        Variables of which each element of the node reads the one of its own place.
    whole : tuple of Key
        Variables of which it reads all elements.
    reads : tuple of Key
        Nodes that are no variables: their values come from the data.
    clock : bool
        It reads the time or an input.
    hands_on : bool
        It reads a computed node of the slice before that is no variable, so that slice 0 differs from others.
    """

    name: str
    kind: int
    alone: tuple[Key, ...]
    whole: tuple[Key, ...]
    reads: tuple[Key, ...]
    clock: bool
    hands_on: bool = False


@dataclass(frozen=True, eq=False)
class Rows:
    """Slices ``start`` to ``stop - 1`` of a series, with time as the first batch axis.

    Attributes
    ----------
    axes : dict
        Values of variables by key; those of one term stand along batch axes.
    ndim : int
        Batch axes, that of time included.
    kind : int
        Of all its slices.
    """

    series: Series
    start: int
    stop: int
    kind: int
    axes: Mapping[Key, np.ndarray] = field(default_factory=dict)
    ndim: int = 1

    @property
    def count(self) -> int:
        return self.stop - self.start

    def one(self, k: int) -> Rows:
        """The k-th of them alone."""
        return replace(self, start=self.start + k, stop=self.start + k + 1)

    def at(self, values: Mapping[Key, np.ndarray], ndim: int) -> Rows:
        """With given values of variables, whose batch has ``ndim`` axes, that of time first."""
        return replace(self, axes=values, ndim=ndim)

    def observed(self, name: str, lag: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Values and mask of an observed node, time first; None where it is not among the data."""
        found = self.series.observed.get(name)
        if found is None:
            return None
        part = self._rows(lag)
        node_ndim = found.value.ndim - 1
        value = found.value[part]
        value = value.reshape(len(value), *(1,) * (self.ndim - 1), *value.shape[1:])
        if found.mask is None:
            return value, np.ones((1,) * (self.ndim + node_ndim), dtype=bool)
        mask = found.mask[part]
        return value, mask.reshape(len(mask), *(1,) * (self.ndim - 1), *mask.shape[1:])

    def clock(self, name: str, lag: int) -> np.ndarray:
        """The time, or an input, of the slice ``lag`` back."""
        if self.count == 1:  # as single slices have it, for functions that take one at a time
            single = self.start - lag
            return np.asarray(
                single if name == TIME else self.series.inputs[name][self._rows(lag)][0]
            )
        times = np.arange(self.start - lag, self.stop - lag)
        found = times if name == TIME else self.series.inputs[name][self._rows(lag)]
        return found.reshape(len(found), *(1,) * (self.ndim - 1), *found.shape[1:])

    def _rows(self, lag: int) -> slice:
        first = self.start - lag - self.series.start
        return slice(first, first + self.count)
