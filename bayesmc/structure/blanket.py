"""The full conditional of one node: its own density and the terms it enters, element by element.

Elements that do not meet are updated together: they have one colour.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.shapes import Shape
from bayesmc.structure.relation import Relation, relation_of
from bayesmc.structure.target import Target, Term, Values

#: components up to which two colours are tried first
_COMPONENTS = 1000


@dataclass(frozen=True, eq=False)
class Child:
    """A term that a node enters other than as its own density, and how their elements relate."""

    term: Term
    relation: Relation


class Blanket:
    """The full conditional of a chain node up to a constant.

    Attributes
    ----------
    own : Term or None
        The node's own density (a variable of a factor graph has none).
    children : tuple of Child
    classes : tuple
        Sets of flat elements to be updated in turn, each of elements that are independent given all
        others; ``(None,)`` where all can move at once.
    path : tuple of str
        Deterministic nodes to recompute when the node moves.
    """

    def __init__(self, target: Target, name: str) -> None:
        self.target = target
        self.name = name
        self.node = target.model[name]
        self.own = target.terms.get(name)
        self.path = target.below((name,))
        self.children = tuple(
            Child(term, relation_of(target, name, term))
            for term in target.terms_of((name,))
            if term is not self.own
        )
        self.size = math.prod(self.node.plate_shape)
        self.classes = self.colours()
        #: whether candidates may have size 1 along plates: every term broadcasts them
        self.broadcasts = all(c.relation.kind == "aligned" for c in self.children)

    @property
    def event_shape(self) -> Shape:
        return self.node.event_shape

    def colours(self) -> tuple[np.ndarray | None, ...]:
        """``classes``, worked out from the children."""
        return _classes(self)

    def current(self, values: Mapping[str, np.ndarray], members: np.ndarray | None) -> np.ndarray:
        """The node's value ``(chains, *plates, *event)``; of a class ``(chains, members, *event)``."""
        value = values[self.name]
        if members is None:
            return value
        return self._flat(value)[(slice(None), members)]

    def moved(
        self, values: Mapping[str, np.ndarray], new: np.ndarray, members: np.ndarray | None
    ) -> np.ndarray:
        """The node's whole value with a class replaced."""
        if members is None:
            return new
        flat = self._flat(values[self.name]).copy()
        flat[:, members] = new
        return flat.reshape(values[self.name].shape)

    def filled(
        self,
        values: Mapping[str, np.ndarray],
        candidate: np.ndarray,
        members: np.ndarray | None,
    ) -> np.ndarray:
        """The node's whole value at a candidate, lead axes in front."""
        return candidate if members is None else self._filled(values[self.name], candidate, members)

    def log_density(
        self,
        values: Mapping[str, np.ndarray],
        candidate: np.ndarray,
        members: np.ndarray | None = None,
    ) -> np.ndarray:
        """Log full conditional of every element at candidate values, up to a constant.

        Parameters
        ----------
        candidate : ndarray, shape (*lead, *plates, *event); of a class (*lead, members, *event)
            ``lead`` broadcasts with the chains.

        Returns
        -------
        ndarray, shape (*lead, *plates); of a class (*lead, members)
        """
        state = self.placed(values, candidate, members)
        total = self.own_log(state, members)
        # a child may have no parameters where the candidate is impossible
        for child in self.children:
            total = total + self.child_log(child, state, members)
        return total

    def placed(
        self,
        values: Mapping[str, np.ndarray],
        candidate: np.ndarray,
        members: np.ndarray | None = None,
    ) -> Values:
        """The state with a candidate in place, deterministic nodes recomputed."""
        state = dict(values)
        if members is not None:
            candidate = self._filled(values[self.name], candidate, members)
        elif not self.broadcasts:
            lead = candidate.shape[: candidate.ndim - len(self.node.value_shape)]
            candidate = np.broadcast_to(candidate, lead + self.node.value_shape)
        state[self.name] = candidate
        self.target.compute(state, self.path)
        return state

    def own_log(
        self, state: Mapping[str, np.ndarray], members: np.ndarray | None = None
    ) -> np.ndarray:
        """Log density of the node itself in a state, shape ``(*lead, *plates)`` or what broadcasts to it."""
        value = state[self.name]
        if self.own is None:
            lead = value.shape[: value.ndim - len(self.node.value_shape)]
            log = np.zeros(lead + (1,) * len(self.node.plates))
        else:
            log = self.own.log(state)
        if members is None:
            return log
        lead = log.shape[: log.ndim - len(self.node.plates)]
        full = np.broadcast_to(log, lead + self.node.plate_shape)
        return full.reshape(*lead, -1)[..., members]

    def child_log(
        self, child: Child, state: Mapping[str, np.ndarray], members: np.ndarray | None = None
    ) -> np.ndarray:
        """One term's log factors in a state, summed for every element of the node."""
        log = child.term.log(state)
        return child.relation.collect(log, child.term.shape, members, state)

    # ---- private -------------------------------------------------------------------------------

    def _flat(self, value: np.ndarray) -> np.ndarray:
        """Value with its plates in one axis."""
        lead = value.shape[: value.ndim - len(self.node.value_shape)]
        return value.reshape(*lead, self.size, *self.event_shape)

    def _filled(self, value: np.ndarray, candidate: np.ndarray, members: np.ndarray) -> np.ndarray:
        lead = candidate.shape[: candidate.ndim - 1 - len(self.event_shape)]
        flat = self._flat(value)
        lead = np.broadcast_shapes(lead, flat.shape[:1])
        full = np.array(np.broadcast_to(flat, lead + flat.shape[1:]))
        place: Any = (Ellipsis, members, *(slice(None),) * len(self.event_shape))
        full[place] = candidate
        return full.reshape(lead + self.node.value_shape)


def colours(count: int, edges: np.ndarray) -> list[np.ndarray]:
    """Colours of ``count`` elements, in their order.

    Parameters
    ----------
    edges : ndarray of int, shape (pairs, 2)
        Elements that must not share a colour; an element may not meet itself.

    Returns
    -------
    list of ndarray of int
        Elements of each colour, ascending: two where two will do (a grid), else greedily at most one more
        than the largest degree.

    References
    ----------
    Welsh and Powell (1967), Computer Journal 10.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.structure.blanket import colours
    >>> [c.tolist() for c in colours(4, np.array([[0, 1], [1, 2], [2, 3]]))]
    [[0, 2], [1, 3]]
    """
    both = np.concatenate([edges, edges[:, ::-1]]).astype(np.intp)
    both = both[both[:, 0] != both[:, 1]]
    if not len(both):
        return [np.arange(count)] if count else []
    found = _two(count, both)
    if found is None:
        found = _greedy(count, both)
    return [np.flatnonzero(found == c) for c in range(found.max() + 1)]


# ---- private ------------------------------------------------------------------------------------


def _classes(blanket: Blanket) -> tuple[np.ndarray | None, ...]:
    """Elements that may move together, by colour; hidden ones only."""
    free = blanket.target.free_elements(blanket.name)
    relations = [c.relation for c in blanket.children]
    coupled = {p for r in relations for p in r.coupled}
    edges = [e for r in relations if r.kind == "rows" and len(e := r.edges)]
    if not coupled and not edges:
        return (free,)
    if coupled:
        shape, plates = blanket.node.plate_shape, blanket.node.plates
        at = np.unravel_index(np.arange(blanket.size), shape)
        inner = [plates.index(p) for p in plates if p in coupled]
        sizes = tuple(shape[i] for i in inner)
        number = np.ravel_multi_index([at[i] for i in inner], sizes)
        sets = [np.flatnonzero(number == k) for k in range(math.prod(sizes))]
        if edges:  # members of a set may still meet in rows
            sets = [np.array([e]) for e in range(blanket.size)]
    else:
        sets = colours(blanket.size, np.concatenate(edges))
    if free is not None:
        sets = [np.intersect1d(s, free) for s in sets]
    return tuple(s for s in sets if len(s))


def _two(count: int, both: np.ndarray) -> np.ndarray | None:
    """Colours 0 and 1 where two will do: the parity of the distance from one element of each component."""
    from scipy.sparse import csgraph, csr_array

    graph = csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
    number, component = csgraph.connected_components(graph, directed=False)
    if number > _COMPONENTS:
        return None
    roots = np.unique(component, return_index=True)[1]
    distance = csgraph.dijkstra(graph, indices=roots, unweighted=True, min_only=True)
    parity = distance.astype(np.intp) % 2
    return None if (parity[both[:, 0]] == parity[both[:, 1]]).any() else parity


def _greedy(count: int, both: np.ndarray) -> np.ndarray:
    """The smallest colour that no neighbour before has, in the order of the elements."""
    order = np.argsort(both[:, 0], kind="stable")
    neighbours = both[order, 1].tolist()
    starts = np.searchsorted(both[order, 0], np.arange(count + 1)).tolist()
    colour = [-1] * count
    for e in range(count):
        taken = {colour[n] for n in neighbours[starts[e] : starts[e + 1]]}
        c = 0
        while c in taken:
            c += 1
        colour[e] = c
    return np.asarray(colour)
