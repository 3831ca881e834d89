"""Slices of a series as array axes: values of nodes on rows of time and on states of variables.

Time is the first batch axis and each variable has one of its own, so that one call of a user's function
serves many slices and all states.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bayesmc.dbn import TIME, Series
from bayesmc.errors import UnsupportedError
from bayesmc.network import CompiledNode, Model
from bayesmc.structure.tables import configurations

if TYPE_CHECKING:
    from bayesmc.engines.discrete.terms import SliceReader

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
    reader: SliceReader | None = None
    axes: Mapping[Key, np.ndarray] | None = None
    ndim: int = 1

    @property
    def count(self) -> int:
        return self.stop - self.start

    def one(self, k: int) -> Rows:
        """The k-th of them alone."""
        return Rows(self.series, self.start + k, self.start + k + 1, self.kind)

    def on_axes(self, reader: SliceReader, term: Term) -> Rows:
        """With a term's variables along axes of their own."""
        first = reader.slices.first
        alone, whole = ([first[name] for _, name in keys] for keys in (term.alone, term.whole))
        values, cards = configurations(alone, whole, reader.apart, ahead=1)
        axes = dict(zip((*term.alone, *term.whole), values, strict=True))
        return self.at(reader, axes, 1 + len(cards))

    def at(self, reader: SliceReader, values: Mapping[Key, np.ndarray], ndim: int) -> Rows:
        """With given values of variables, whose batch has ``ndim`` axes, that of time first."""
        return Rows(self.series, self.start, self.stop, self.kind, reader, values, ndim)

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

    def arguments(self, model: Model, name: str, lag: int) -> dict[str, np.ndarray]:
        """Values of a node's parents, of the slice ``lag`` back."""
        reader, found = self._reader, {}
        for parent in model[name].parents:
            stem, back = reader.origin(parent, lag)
            value = self.value(stem, back)
            if back > lag and not reader.slices.first[stem].is_stochastic:
                source = reader.model(self.kind, back)[stem] if back <= 1 else model[parent]
                value = _handed_on(value, source, model[parent])
            found[parent] = value
        return found

    def value(self, name: str, lag: int) -> np.ndarray:
        """Stored values of a node of the slice ``lag`` back."""
        reader = self._reader
        assert self.axes is not None
        if name == TIME and self.count == 1:
            return np.asarray(self.start - lag)
        if name == TIME:
            times = np.arange(self.start - lag, self.stop - lag)
            return times.reshape(-1, *(1,) * (self.ndim - 1))
        if name in reader.static:
            return reader.static[name]
        if name in self.series.inputs:
            rows = self.series.inputs[name][self._rows(lag)]
            if self.count == 1:  # as single slices have it, for functions that take one at a time
                return rows[0, ...]
            return rows.reshape(len(rows), *(1,) * (self.ndim - 1), *rows.shape[1:])
        if (lag, name) in self.axes:
            return self.axes[lag, name]
        if reader.slices.first[name].is_stochastic:
            seen = self.observed(name, lag)
            if seen is None:
                raise UnsupportedError(f"node {name!r} is needed and was not observed")
            return seen[0]
        model = reader.model(self.kind, lag)
        result, _ = model.evaluate(name, self.arguments(model, name, lag))
        return np.asarray(result)

    @property
    def _reader(self) -> SliceReader:
        assert self.reader is not None, "place the rows first: on_axes or at"
        return self.reader

    def _rows(self, lag: int) -> slice:
        first = self.start - lag - self.series.start
        return slice(first, first + self.count)


# ---- private ------------------------------------------------------------------------------------


def _handed_on(value: np.ndarray, source: CompiledNode, target: CompiledNode) -> np.ndarray:
    """Stored values of a deterministic node as the next slice reads them, which may number them otherwise."""
    if source.domain is None and target.domain is None:
        return value
    if source.domain is not None and target.domain is not None:
        if source.domain.states == target.domain.states:
            return value
    plain = source.decode(value)
    if target.domain is None:
        return np.asarray(plain)
    states = target.domain.numbers
    if states is not None:
        order = np.argsort(states)
        at = order[np.minimum(np.searchsorted(states[order], plain), len(states) - 1)]
        if (states[at] == plain).all():
            return at
    raise UnsupportedError(
        f"deterministic node {source.name!r} takes other values in slice 0 than later; give it states="
    )
