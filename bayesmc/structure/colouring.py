"""Graph colouring: elements that do not meet are updated together."""

from __future__ import annotations

import numpy as np


def colours(count: int, edges: np.ndarray) -> list[np.ndarray]:
    """Greedy colouring of ``count`` elements, in their order.

    Parameters
    ----------
    edges : ndarray of int, shape (pairs, 2)
        Elements that must not share a colour; an element may not meet itself.

    Returns
    -------
    list of ndarray of int
        Elements of each colour, ascending. A grid in raster order takes two, a graph of largest degree d
        at most d + 1.

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
    if not len(edges):
        return [np.arange(count)]
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[both[:, 0] != both[:, 1]]
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
    found = np.asarray(colour)
    return [np.flatnonzero(found == c) for c in range(max(colour) + 1)]
