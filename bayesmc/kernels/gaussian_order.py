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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayesmc.kernels.gaussian_band import Band, Blocks, Pattern
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.relation import Relation
from bayesmc.structure.target import Target, Term

#: components up to which one dense matrix is best
_SMALL = 24
#: a component that meets so many times as many others as most do is not put into a band
_MANY = 4
#: cost of one column of a band beyond its arithmetic
_COLUMN = 100
#: pairs of components that are looked at
_MOST_PAIRS = 1 << 22


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


class Components:
    """The components of some nodes in natural order, and the terms that join them.

    Parameters
    ----------
    names : sequence of str
    terms : sequence of Term
        All that some node enters.
    """

    def __init__(
        self,
        target: Target,
        names: Sequence[str],
        blankets: Mapping[str, Blanket],
        terms: Sequence[Term],
    ) -> None:
        self.target, self.names, self.terms = target, tuple(names), tuple(terms)
        nodes = {n: target.model[n] for n in names}
        self.counts = {n: math.prod(nodes[n].plate_shape) for n in names}
        self.dims = {n: math.prod(nodes[n].event_shape) for n in names}
        sizes = [self.counts[n] * self.dims[n] for n in names]
        self.start = dict(zip(names, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True))
        self.size = sum(sizes)
        self.entering: dict[str, list[tuple[str, Relation]]] = {t.name: [] for t in terms}
        for name in names:
            for child in blankets[name].children:
                self.entering[child.term.name].append((name, child.relation))

    def of(self, name: str, elements: np.ndarray) -> np.ndarray:
        """Components of elements of a node, one more axis."""
        d = self.dims[name]
        return self.start[name] + elements[..., None] * d + np.arange(d)

    def met(self, term: Term) -> dict[str, np.ndarray | None]:
        """The element of each node that each element of a term reads or is; None where that varies."""
        found = {n: elements_read(relation, term) for n, relation in self.entering[term.name]}
        if term.name in self.start:
            found[term.name] = np.arange(self.counts[term.name])
        return found


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


def elements_read(relation: Relation, term: Term) -> np.ndarray | None:
    """The element of a node that each element of a term reads, shape (elements,); None where it varies."""
    if relation.kind == "lookup":
        return None
    if relation.kind == "rows":
        return relation.rows[0]
    count = math.prod(term.shape)
    if not relation.plates:
        return np.zeros(count, dtype=np.intp)
    at = np.unravel_index(np.arange(count), term.shape)
    picked = [at[term.plates.index(p)] for p in relation.plates]
    return np.ravel_multi_index(picked, relation.shape)


# ---- private ------------------------------------------------------------------------------------


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
    for n in components.names:
        plates = components.target.model[n].plates
        if plates:
            groups.setdefault(plates, []).append(n)
    sizes = {n: components.counts[n] * components.dims[n] for n in components.names}
    for group in sorted(groups.values(), key=lambda g: -sum(sizes[n] for n in g)):
        inside = set(group)
        if all(_meet_alone(components, inside, term) for term in components.terms):
            return _element_by_element(components, group)
    return None


def _meet_alone(components: Components, group: set[str], term: Term) -> bool:
    """Whether every element of a term depends on one element of the group's plates only."""
    entering = components.entering[term.name]
    if sum(n in group for n, _ in entering) + (term.name in group) <= 1:
        return True
    met = [at for n, at in components.met(term).items() if n in group]
    known = [at for at in met if at is not None]
    return len(known) == len(met) and all(np.array_equal(known[0], at) for at in known[1:])


def _element_by_element(components: Components, group: Sequence[str]) -> Order:
    count = components.counts[group[0]]
    width = sum(components.dims[n] for n in group)
    position = np.full(components.size, -1)
    inner = 0
    for n in group:
        d = components.dims[n]
        at = components.of(n, np.arange(count))
        position[at] = np.arange(count)[:, None] * width + inner + np.arange(d)
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
    for term in components.terms:
        for a, b in _meetings(components, term):
            count += math.prod(np.broadcast_shapes(a.shape, b.shape))
            if count > _MOST_PAIRS:
                return None
            found.append(np.stack(np.broadcast_arrays(a, b), axis=-1).reshape(-1, 2))
    pairs = np.concatenate(found)
    pairs = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1)
    keys = np.unique(pairs[:, 0] * components.size + pairs[:, 1])
    return np.stack(np.divmod(keys, components.size), axis=1)


def _meetings(components: Components, term: Term) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Arrays of components that meet pair by pair, to be broadcast."""
    met = components.met(term)
    known = [components.of(n, at) for n, at in met.items() if at is not None]
    joined = np.concatenate(known, axis=1) if known else np.empty((1, 0), dtype=np.intp)
    a, b = _two_of(joined.shape[1])
    yield joined[:, a], joined[:, b]
    for name, elements in met.items():
        if elements is not None:
            continue
        every = components.of(name, np.arange(components.counts[name]))
        a, b = _two_of(every.shape[1])
        yield every[:, a], every[:, b]
        yield joined.reshape(-1, 1), every.reshape(1, -1)  # which one it reads varies


@functools.cache
def _two_of(count: int) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of different numbers below ``count``."""
    return np.triu_indices(count, 1)


def _narrow(size: int, pairs: np.ndarray) -> tuple[np.ndarray, int]:
    """An order in which pairs stand near each other: the given one, or Cuthill and McKee's; and how near."""
    natural = np.arange(size)
    if not len(pairs):
        return natural, 0
    # imported here: sparse matrices take long to load, and few blocks need them
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    a, b = np.concatenate([pairs, pairs[:, ::-1]]).T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(size, size)).tocsr()
    place = np.empty(size, dtype=np.intp)
    place[reverse_cuthill_mckee(graph, symmetric_mode=True)] = natural
    widths = [int(np.abs(np.subtract(*p[pairs].T)).max()) for p in (natural, place)]
    return (place, widths[1]) if widths[1] < widths[0] else (natural, widths[0])
