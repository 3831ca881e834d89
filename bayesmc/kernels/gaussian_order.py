"""In which order the components of a Normal block are eliminated: read off who meets whom in its terms.

First a part whose precision has a pattern: the elements of one plate that meet only one by one, or, as in a
chain of slices, components that meet only near ones once they stand in the right order. The rest is dense;
what meets nearly everybody (a mean that all slices share) belongs there. The cheapest way is taken.

References
----------
Cuthill and McKee (1969), Reducing the bandwidth of sparse symmetric matrices; Rue and Held (2005), Gaussian
Markov Random Fields, sec. 2.4.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bayesmc.linalg.patterns import Band, Blocks, Pattern
from bayesmc.structure.target import Target

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
        assert seen.mask is not None
        return np.repeat(seen.mask.reshape(-1), self.dims[name])


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


# ---- private ------------------------------------------------------------------------------------


def _known_part(target: Target, name: str) -> np.ndarray:
    """What was seen of a node, zero elsewhere, shape (1, *value)."""
    node, seen = target.model[name], target.seen(name)
    found = np.zeros((1, *node.value_shape))
    if seen is not None:
        assert seen.mask is not None
        mask = seen.mask.reshape(seen.mask.shape + (1,) * len(node.event_shape))
        found[0] = np.where(mask, seen.value, 0.0)
    return found


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
