"""Where every component of a Normal block stands, and in which order components are eliminated.

Read off who meets whom in its terms: first a part whose precision has a pattern, the elements of one plate
that meet only one by one, or, as in a chain of slices, components that meet only near ones once they stand
in the right order. The rest is one dense matrix; what meets nearly everybody (a mean that all slices share)
belongs there. The cheapest way is taken.

References
----------
Cuthill and McKee (1969), Reducing the bandwidth of sparse symmetric matrices; Rue and Held (2005), Gaussian
Markov Random Fields, sec. 2.4.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.linalg.patterns import Band, Blocks, Pattern
from bayesmc.structure.target import Target, Values

#: components up to which one dense matrix is best
_SMALL = 24
#: a component that meets so many times as many others as most do is not put into a band
_MANY = 4
#: cost of one column of a band beyond its arithmetic
_COLUMN = 100
#: pairs of components that are looked at, each in both orders
_MOST_PAIRS = 1 << 23


@dataclass(frozen=True, eq=False)
class Order:
    """Where components stand.

    Attributes
    ----------
    position : ndarray of int, shape (size,)
        Place in the order of elimination, by natural order (nodes, elements, components of an element).
    first : Pattern
        What is eliminated first; the rest is dense.
    """

    position: np.ndarray
    first: Pattern

    @property
    def rest(self) -> int:
        """Components of the dense rest."""
        return len(self.position) - self.first.size

    @property
    def entries(self) -> int:
        """Numbers that are stored of the precision."""
        return self.first.entries + self.first.size * self.rest + self.rest**2


@dataclass(frozen=True, eq=False)
class Meeting:
    """Which components meet in elements of terms.

    Attributes
    ----------
    at : ndarray of int, shape (elements, columns)
        Components, in natural order, that each element reads always.
    varying : tuple of (int, int, bool)
        Components ``start`` to ``stop`` of which each element reads some that vary, and whether those are
        always of one element of a plate.
    """

    at: np.ndarray
    varying: tuple[tuple[int, int, bool], ...]


class Components:
    """The components of some nodes in natural order: nodes, elements, components of an element.

    Parameters
    ----------
    target : Target
    names : sequence of str

    Attributes
    ----------
    counts, dims, start : dict
        Node -> its elements, the components of each, and where they begin.
    state : dict
        Node -> its value with what is free at zero, shape ``(1, *value)``.
    free, base : ndarray or None
        Which components are free, and the values of the others; None where all are free.
    meetings : list of Meeting
        Put in place by those who know the terms.
    """

    def __init__(self, target: Target, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.nodes = {n: target.model[n] for n in names}
        self.counts = {n: math.prod(node.plate_shape) for n, node in self.nodes.items()}
        self.dims = {n: math.prod(node.event_shape) for n, node in self.nodes.items()}
        sizes = [self.counts[n] * self.dims[n] for n in names]
        self.start = dict(zip(names, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True))
        self.size = sum(sizes)
        self.partly = tuple(n for n in names if target.seen(n) is not None)
        self.state = {n: _known_part(target, n) for n in names}
        self.free: np.ndarray | None = None
        self.base: np.ndarray | None = None
        if self.partly:
            seen = [self._is_seen(target, n) for n in names]
            self.free = ~np.concatenate(seen)
            self.base = np.concatenate([self.state[n].reshape(-1) for n in names])
        self.meetings: list[Meeting] = []

    def size_of(self, name: str) -> tuple[int, int]:
        """How many components a node has, and one element of it."""
        return self.counts[name] * self.dims[name], self.dims[name]

    def starts(self, names: Sequence[str]) -> np.ndarray:
        """Where the components of some nodes begin."""
        return np.array([self.start[n] for n in names])

    def _is_seen(self, target: Target, name: str) -> np.ndarray:
        """Of each component of a node."""
        seen = target.seen(name)
        if seen is None:
            return np.zeros(self.counts[name] * self.dims[name], bool)
        node = self.nodes[name]
        numbers = seen.numbers(len(node.event_shape))
        return np.broadcast_to(numbers, node.value_shape).reshape(-1)


def order_of(components: Components) -> Order:
    """The order of elimination that costs least."""
    size = components.size
    best = Order(np.arange(size), Blocks(0, 0))
    if size <= _SMALL:
        return best
    local = _local(components)
    if local is not None:
        best = local
        if local.rest + _blocks(local).width <= _SMALL:
            return best
    return min([best, *_bands(components)], key=_cost)


class Layout:
    """Where every component of the block stands: those eliminated first, then the dense rest.

    Attributes
    ----------
    cut, dg : int
        Components eliminated first, and of the rest.
    width : int
        How far a band that is eliminated first reaches from the diagonal; 0 where there is none.
    entries : int
        Numbers that are stored of a precision: of the first part, between it and the rest (row by row), of
        the rest; and one to throw away.
    """

    def __init__(self, components: Components) -> None:
        self.components, self.names = components, components.names
        order = order_of(components)
        self.position, self.first = order.position, order.first
        self.size = len(self.position)
        self.cut, self.dg = self.first.size, order.rest
        self.width = self.first.width if isinstance(self.first, Band) else 0
        self.entries = order.entries + 1
        self._units = np.empty(0, dtype=np.intp)
        if components.free is not None:  # the diagonal of what was seen
            seen = self.position[~components.free]
            self._units = self.entry(seen, seen)
        self._alike = tuple(self._like_nodes())

    def entry(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Entry of the precision for two positions; what is kept elsewhere goes to the last."""
        cut, dg, first = self.cut, self.dg, self.first
        # all kinds are computed and one picked
        found = np.full(np.broadcast_shapes(row.shape, column.shape), -1)
        row_first, column_first = row < cut, column < cut
        if cut:
            found = np.where(row_first & column_first, first.entry(row, column), found)
            mixed = first.entries + row * dg + (column - cut)
            found = np.where(row_first & ~column_first, mixed, found)
        rest = first.entries + cut * dg + (row - cut) * dg + (column - cut)
        found = np.where(~row_first & ~column_first, rest, found)
        return np.where(found < 0, self.entries - 1, found)

    def parts(self, precision: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Precision of what is eliminated first (as stored), between that and the rest, and of the rest."""
        lead, cut, dg = len(precision), self.cut, self.dg
        begin, end = self.first.entries, self.first.entries + cut * dg
        mixed = precision[:, begin:end].reshape(lead, cut, dg)
        return precision[:, :begin], mixed, precision[:, end:-1].reshape(lead, dg, dg)

    def with_units(self, precision: np.ndarray) -> np.ndarray:
        """Ones on the diagonal of what was seen, which nothing else says anything about."""
        if not len(self._units):
            return precision
        precision = precision.copy()
        precision[:, self._units] = 1.0
        return precision

    def dense(self, precision: np.ndarray) -> np.ndarray:
        """The whole precision matrix (for checks)."""
        first, mixed, rest = self.parts(precision)
        cut = self.cut
        full = np.zeros((len(precision), self.size, self.size))
        full[:, :cut, :cut] = self.first.dense(first)
        full[:, :cut, cut:] = mixed
        full[:, cut:, :cut] = np.swapaxes(mixed, -1, -2)
        full[:, cut:, cut:] = rest
        return full

    def split(self, joined: np.ndarray, values: Mapping[str, np.ndarray]) -> Values:
        """A joined vector per chain as values of the nodes; what was seen stays."""
        chains = len(joined)
        new: Values = {}
        columns = None
        for names, at in self._alike:
            shape = (len(names), chains, *self.components.nodes[names[0]].value_shape)
            if len(names) == 1:
                rows = joined.take(at[0], axis=1).reshape(shape)
            else:
                columns = np.ascontiguousarray(joined.T) if columns is None else columns
                rows = np.moveaxis(columns[at], -1, 1).reshape(shape)
            rows.flags.writeable = False
            new.update(zip(names, rows, strict=True))
        for name in self.components.partly:
            new[name] = np.where(self._free(name), new[name], values[name])
        return new

    def joined(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Values of the nodes as one vector per chain, what was seen as zero."""
        flat = [
            np.where(self._free(n), values[n], 0.0).reshape(len(values[n]), -1) for n in self.names
        ]
        joined = np.empty((len(flat[0]), self.size))
        joined[:, self.position] = np.concatenate(flat, axis=1)
        return joined

    # ---- private -------------------------------------------------------------------------------

    def _free(self, name: str) -> np.ndarray:
        """Which components of a node are free, in the shape of its values."""
        components, start = self.components, self.components.start[name]
        shape = components.nodes[name].value_shape
        if components.free is None:
            return np.ones(shape, dtype=bool)
        return components.free[start : start + math.prod(shape)].reshape(shape)

    def _like_nodes(self) -> Iterator[tuple[tuple[str, ...], np.ndarray]]:
        """Nodes of one shape, and their positions ``(nodes, components)``."""
        groups: dict[Any, list[str]] = {}
        for name in self.names:
            groups.setdefault(self.components.nodes[name].value_shape, []).append(name)
        for names in groups.values():
            size, _ = self.components.size_of(names[0])
            start = self.components.starts(names)
            yield tuple(names), self.position[start[:, None] + np.arange(size)]


class BlockSums:
    """Precision, linear term and constant of the log density of a block, as terms add to them.

    The precision has one row where all chains have the same.
    """

    def __init__(self, chains: int, layout: Layout) -> None:
        self.precision = np.zeros((1, layout.entries))
        self.linear = np.zeros((chains, layout.size))
        self.constant = np.zeros(chains)
        self.bad = np.zeros(chains, dtype=bool)

    def add(self, precision: np.ndarray, linear: np.ndarray, constant: np.ndarray) -> None:
        if len(precision) > len(self.precision):
            self.precision = self.precision + precision
        else:
            self.precision += precision
        self.linear += linear
        self.constant += constant


# ---- private ------------------------------------------------------------------------------------


def _known_part(target: Target, name: str) -> np.ndarray:
    """What was seen of a node, zero elsewhere, shape (1, *value)."""
    return target.with_seen(name, np.zeros((1, *target.model[name].value_shape)))


def _cost(order: Order) -> float:
    """Arithmetic of a factorisation, for one chain."""
    first, rest = order.first, order.rest
    if isinstance(first, Band):
        columns = float(first.size) * (_COLUMN + (first.width + 1 + rest) ** 2)
    else:
        width = _blocks(order).width
        columns = first.size * (width**2 / 3 + width * rest + rest**2)
    return columns + rest**3 / 3


def _blocks(order: Order) -> Blocks:
    assert isinstance(order.first, Blocks)
    return order.first


def _local(components: Components) -> Order | None:
    """Nodes of one plate that meet only element by element, first; None where there are none."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for name, node in components.nodes.items():
        if node.plates:
            groups.setdefault(node.plates, []).append(name)
    sizes = {n: components.size_of(n)[0] for n in components.names}
    for group in sorted(groups.values(), key=lambda g: -sum(sizes[n] for n in g)):
        order = _element_by_element(components, group)
        inside = order.position < order.first.size
        element = np.where(inside, order.position // _blocks(order).width, -1)
        if all(_meet_alone(meeting, element) for meeting in components.meetings):
            return order
    return None


def _meet_alone(meeting: Meeting, element: np.ndarray) -> bool:
    """Whether every element of terms depends on one element of the group's plates only."""
    met = element[meeting.at]
    varying = [one for start, _, one in meeting.varying if element[start] >= 0]
    if varying:
        return varying == [True] and not (met >= 0).any()
    highest = met.max(axis=1, initial=-1)
    return bool(((met < 0) | (met == highest[:, None])).all())


def _element_by_element(components: Components, group: Sequence[str]) -> Order:
    count = components.counts[group[0]]
    width = sum(components.dims[n] for n in group)
    position = np.full(components.size, -1)
    inner = 0
    for n in group:
        d = components.dims[n]
        place = np.arange(count)[:, None] * width + inner + np.arange(d)
        position[components.start[n] : components.start[n] + count * d] = place.reshape(-1)
        inner += d
    rest = np.flatnonzero(position < 0)
    position[rest] = count * width + np.arange(len(rest))
    return Order(position, Blocks(count, width))


def _bands(components: Components) -> Iterator[Order]:
    """Orders in which a band comes first: of all components, and without those that meet many."""
    pairs = _pairs(components)
    if pairs is None:
        return
    size = components.size
    degree = np.bincount(pairs.ravel(), minlength=size)
    most = _MANY * max(float(np.median(degree)), 1.0)
    apart = [np.zeros(size, dtype=bool)]
    if (degree > most).any():
        apart.append(degree > most)
    for hub in apart:
        inside = np.flatnonzero(~hub)
        if not len(inside):
            continue
        number = np.full(size, -1)
        number[inside] = np.arange(len(inside))
        kept = number[pairs[~hub[pairs].any(axis=1)]]
        place, width = _narrow(len(inside), kept)
        position = np.empty(size, dtype=np.intp)
        position[inside] = place
        position[hub] = len(inside) + np.arange(int(hub.sum()))
        yield Order(position, Band(len(inside), width))


def _pairs(components: Components) -> np.ndarray | None:
    """Components that meet in an element of a term, shape (pairs, 2); None where they are too many."""
    found = [np.empty((0, 2), dtype=np.intp)]
    count = 0
    for meeting in components.meetings:
        at = meeting.at[:1] if (meeting.at == meeting.at[:1]).all() else meeting.at
        groups = [at, *(np.arange(*span[:2])[None] for span in meeting.varying)]
        count += sum(g.shape[0] * g.shape[1] ** 2 for g in groups)
        count += sum(at.size * g.size for g in groups[1:])
        if count > _MOST_PAIRS:
            return None
        for group in groups:
            a, b = _two_of(group.shape[1])
            found.append(np.stack([group[:, a], group[:, b]], axis=-1).reshape(-1, 2))
        for group in groups[1:]:  # which one it reads varies
            pair = np.broadcast_arrays(at.reshape(-1, 1), group)
            found.append(np.stack(pair, axis=-1).reshape(-1, 2))
    pairs = np.concatenate(found)
    pairs = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1)
    keys = np.unique(pairs[:, 0] * components.size + pairs[:, 1])
    return np.stack(np.divmod(keys, components.size), axis=1)


@functools.cache
def _two_of(count: int) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of different numbers below ``count``."""
    return np.triu_indices(count, 1)


def _narrow(size: int, pairs: np.ndarray) -> tuple[np.ndarray, int]:
    """An order in which pairs stand near each other: the given one, or Cuthill and McKee's; and how near."""
    natural = np.arange(size)
    width = int(np.abs(np.subtract(*pairs.T)).max(initial=0))
    if width < 2:  # no order is narrower
        return natural, width
    # imported here: sparse matrices take long to load, and few blocks need them
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    a, b = np.concatenate([pairs, pairs[:, ::-1]]).T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(size, size)).tocsr()
    place = np.empty(size, dtype=np.intp)
    place[reverse_cuthill_mckee(graph, symmetric_mode=True)] = natural
    other = int(np.abs(np.subtract(*place[pairs].T)).max())
    return (place, other) if other < width else (natural, width)
