"""Graph colouring: elements that do not meet are updated together."""

from __future__ import annotations

import numpy as np

#: components up to which two colours are tried first
_COMPONENTS = 1000


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
    >>> from bayesmc.structure.colouring import colours
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
