"""Elimination orders: how to triangulate the graph of a set of factors, and what it will cost.

Variables are positions ``0..n-1``. This room works on the graph alone: it holds no tables and
multiplies nothing, so that a cost can be told before anything is allocated.
"""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

HEURISTICS = ("min-fill", "min-weight", "min-weighted-fill")
"""What to make smallest at each step: edges added; entries of the clique; both, as a product."""

_RESTARTS = 12
_HARD_ENTRIES = 2e6  # below this a plan is cheap enough that searching on would cost more
_EASY_ENTRIES = 5e4


@dataclass(frozen=True)
class Elimination:
    """An elimination order with the cliques it makes.

    Attributes
    ----------
    order : tuple of int
        Every variable once, first eliminated first.
    cliques : tuple of tuple of int
        For each variable of ``order``: itself, then its neighbours when it is eliminated.
    entries : float
        Sum over these cliques of the number of table entries.
    fill : int
        Edges added; 0 exactly when the graph was chordal and the order is perfect.
    """

    order: tuple[int, ...]
    cliques: tuple[tuple[int, ...], ...]
    entries: float
    fill: int


def elimination_order(
    cardinalities: Sequence[int],
    scopes: Iterable[Sequence[int]],
    heuristic: str | None = None,
) -> Elimination:
    """A good order in which to sum out all variables of a product of factors.

    Parameters
    ----------
    cardinalities : sequence of int
        The number of states of each variable.
    scopes : iterable of sequences of int
        The variables of each factor.
    heuristic : str, optional
        One of `HEURISTICS`. By default all are run, on hard graphs with several deterministic
        ways of breaking ties as well, and the order with the fewest table entries is kept.

    Raises
    ------
    ValueError
        If the heuristic is unknown.

    Notes
    -----
    Greedy triangulation: Koller and Friedman, *Probabilistic Graphical Models* (2009), §9.4.3;
    the counts of missing edges are kept up to date rather than recomputed.

    Examples
    --------
    >>> square = [(0, 1), (1, 2), (2, 3), (3, 0)]
    >>> found = elimination_order([2, 2, 2, 2], square)
    >>> found.fill, max(len(clique) for clique in found.cliques)
    (1, 3)
    """
    if heuristic is not None and heuristic not in HEURISTICS:
        raise ValueError(
            f"elimination_order: unknown heuristic {heuristic!r}; choose one of {HEURISTICS}"
        )
    weights = [math.log2(max(size, 1)) for size in cardinalities]
    adjacency = interaction_graph(len(weights), scopes)
    best: Elimination | None = None
    for name in HEURISTICS if heuristic is None else (heuristic,):
        best = _better(best, _greedy(weights, adjacency, name))
        if heuristic is None and (best.fill == 0 or best.entries < _EASY_ENTRIES):
            return best  # perfect, or too small for another order to be worth its search
    assert best is not None
    if heuristic is None and best.entries > _HARD_ENTRIES:
        for seed in range(_RESTARTS):
            name = HEURISTICS[seed % len(HEURISTICS)]
            best = _better(best, _greedy(weights, adjacency, name, random.Random(seed)))
    return best


def interaction_graph(count: int, scopes: Iterable[Sequence[int]]) -> list[int]:
    """The neighbours of each variable as a bit mask: variables that share a scope are joined."""
    adjacency = [0] * count
    for scope in scopes:
        mask = 0
        for variable in scope:
            mask |= 1 << variable
        for variable in scope:
            adjacency[variable] |= mask
    return [mask & ~(1 << variable) for variable, mask in enumerate(adjacency)]


def bits(mask: int) -> Iterator[int]:
    """The positions of the bits set in ``mask``, smallest first."""
    while mask:
        low = mask & -mask
        yield low.bit_length() - 1
        mask ^= low


def _better(best: Elimination | None, found: Elimination) -> Elimination:
    return found if best is None or found.entries < best.entries else best


class _Graph:
    """A graph under elimination; ``fill`` and ``weight`` of each vertex are kept up to date.

    ``fill[v]`` counts the pairs of neighbours of v that are not joined; ``weight[v]`` is the
    log2 of the table entries of v with its neighbours.
    """

    def __init__(self, weights: Sequence[float], adjacency: Sequence[int]) -> None:
        self.weights = weights
        self.adjacency = list(adjacency)
        self.weight = [
            weights[v] + sum(weights[u] for u in bits(mask)) for v, mask in enumerate(adjacency)
        ]
        self.fill = [self._missing(mask) for mask in adjacency]
        self.added = 0

    def eliminate(self, vertex: int) -> int:
        """Join the neighbours of ``vertex`` and drop it; the mask of those whose counts moved."""
        adjacency = self.adjacency
        neighbours = adjacency[vertex]
        moved = neighbours
        if self.fill[vertex]:
            for u in bits(neighbours):
                missing = neighbours & ~adjacency[u] & ~((2 << u) - 1)
                for w in bits(missing):
                    moved |= self._join(u, w)
        bit = 1 << vertex
        for u in bits(neighbours):
            # Its neighbours that are not joined to the vertex no longer miss that edge.
            self.fill[u] -= (adjacency[u] & ~bit & ~neighbours).bit_count()
            self.weight[u] -= self.weights[vertex]
            adjacency[u] &= ~bit
        adjacency[vertex] = 0
        return moved & ~bit

    def _join(self, u: int, w: int) -> int:
        adjacency, fill = self.adjacency, self.fill
        common = adjacency[u] & adjacency[w]
        for x in bits(common):
            fill[x] -= 1
        fill[u] += (adjacency[u] & ~common).bit_count()
        fill[w] += (adjacency[w] & ~common).bit_count()
        self.weight[u] += self.weights[w]
        self.weight[w] += self.weights[u]
        adjacency[u] |= 1 << w
        adjacency[w] |= 1 << u
        self.added += 1
        return common

    def _missing(self, mask: int) -> int:
        degree = mask.bit_count()
        joined = sum((self.adjacency[u] & mask).bit_count() for u in bits(mask))
        return (degree * (degree - 1) - joined) // 2


def _greedy(
    weights: Sequence[float],
    adjacency: Sequence[int],
    heuristic: str,
    ties: random.Random | None = None,
) -> Elimination:
    graph = _Graph(weights, adjacency)
    fill, weight = graph.fill, graph.weight
    noise = [0.0] * len(weights) if ties is None else [ties.random() for _ in weights]

    def key(v: int) -> tuple[float, float, int]:
        if heuristic == "min-fill":
            return fill[v], round(weight[v], 6) if ties is None else noise[v], v
        if heuristic == "min-weight":
            return round(weight[v], 6), fill[v] if ties is None else noise[v], v
        # Rounding lets equal weights tie although they were summed in different orders.
        return (
            round(fill[v] * 2.0 ** min(weight[v] / 2, 500.0), 6),
            round(weight[v], 6) + noise[v],
            v,
        )

    heap = [key(v) for v in range(len(weights))]
    latest = list(heap)
    heapq.heapify(heap)
    order, cliques, entries = [], [], 0.0
    while heap:
        entry = heapq.heappop(heap)
        v = entry[2]
        if entry is not latest[v]:
            continue  # out of date: the vertex was pushed again with its present key
        neighbours = graph.adjacency[v]
        order.append(v)
        cliques.append((v, *bits(neighbours)))
        entries += 2.0 ** min(weight[v], 1023.0)
        for u in bits(graph.eliminate(v)):
            fresh = key(u)
            if fresh != latest[u]:
                latest[u] = fresh
                heapq.heappush(heap, fresh)
    return Elimination(tuple(order), tuple(cliques), entries, graph.added)
