"""Forests of finite variables: all of a forest drawn at once, from factors on single variables and on pairs.

Variables are summed out in rounds of such as have at most two neighbours left and do not meet: leaves are
raked into their neighbours, and of every path each second variable is compressed away. A chain of ``n`` takes
``log2 n`` rounds, each a few array operations, where filtering forward and sampling backward takes ``n``
steps; the law of the draws is the same. No nets here: variables are numbers, factors are arrays.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from bayesmc.categorical import log_sum_exp, pick_log

#: states up to which products of tables are sums of whole arrays, and not of many small matrices
_FEW = 12
#: sums of tables scaled to one below this are done again in logs
_SMALL = 1e-250
#: factors below which two may make such a sum
_ROUGH = 1e-125


class Forest:
    """The order in which variables of a forest are summed out, and drawn in the end.

    Parameters
    ----------
    count : int
        Variables.
    edges : array_like of int, shape (edges, 2)
        Pairs that share a factor; they make no cycle.

    Raises
    ------
    ValueError
        The edges make a cycle.

    Attributes
    ----------
    tables : int
        Tables that are read and made: those of the edges, then others.

    References
    ----------
    Miller and Reif (1985), FOCS 26, 478-489 (rake and compress); Scott (2002), JASA 97, 337-351 (filtering
    forward, sampling backward); Hamze and de Freitas (2004), UAI 20 (trees in fields).

    Examples
    --------
    Two variables that are equal, the second with evidence for state 1:

    >>> import numpy as np
    >>> from bayesmc.kernels.forest import Forest
    >>> forest = Forest(2, [(0, 1)])
    >>> single = np.log([[0.5, 0.1], [0.5, 0.9]])[:, :, None]
    >>> tables = np.zeros((2, 2, forest.tables, 1))
    >>> tables[[0, 1], [1, 0], 0] = -np.inf
    >>> uniform = np.random.default_rng(0).random((2, 1))
    >>> states, log_normaliser = forest.draw(single, tables, uniform)
    >>> states.tolist(), np.exp(log_normaliser).round(6).tolist()
    ([[1], [1]], [0.5])
    """

    def __init__(self, count: int, edges: np.ndarray) -> None:
        self.count = count
        ends = np.asarray(edges, dtype=np.intp).reshape(-1, 2)
        self.edges = len(ends)
        near: list[dict[int, int]] = [{} for _ in range(count)]
        for e, (a, b) in enumerate(ends.tolist()):
            if a == b or b in near[a]:
                raise ValueError(f"edge {e} makes a cycle; give each pair of variables once")
            near[a][b] = near[b][a] = e
        first = [a for a, _ in ends.tolist()]
        left = list(range(count))
        self.rounds: list[_Round] = []
        while left:
            chosen = _apart(left, near)
            if not chosen:
                raise ValueError("the edges make a cycle; leave some out")
            self.rounds.append(_eliminated(chosen, near, first))
            gone = set(chosen)
            left = [v for v in left if v not in gone]
        self.tables = len(first)

    def draw(
        self, single: np.ndarray, tables: np.ndarray, uniform: np.ndarray, what: str = "forest"
    ) -> tuple[np.ndarray, np.ndarray]:
        """States of all variables, drawn jointly, and the log normaliser.

        Parameters
        ----------
        single : ndarray, shape (states, variables, rows)
            Log factors on single variables; ``-inf`` at states that a variable does not have. Overwritten.
        tables : ndarray, shape (states, states, tables, rows)
            Log factors on pairs, the first of an edge on the first axis; what comes after the edges, and all
            in the end, is overwritten.
        uniform : ndarray, shape (variables, rows)
            Random numbers, uniform on [0, 1).
        what : str
            Whose draws these are, for errors.

        Returns
        -------
        states : ndarray of int, shape (variables, rows)
        log_normaliser : ndarray, shape (rows,)

        Raises
        ------
        ZeroProbabilityError
            All joint states of some row are impossible.
        """
        total = np.zeros(single.shape[-1])
        with np.errstate(divide="ignore"):
            for step in self.rounds:
                total += step.sum_out(single, tables)
        drawn = np.zeros(single.shape[1:], dtype=np.intp)
        for step in reversed(self.rounds):
            step.draw(single, tables, drawn, uniform, what)
        return drawn, total


# ---- private ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Side:
    """Some variables, one neighbour of each, and the tables between them."""

    variables: np.ndarray
    neighbours: np.ndarray
    edge: np.ndarray
    is_first: np.ndarray
    _kept: dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]] = field(
        default_factory=dict, init=False
    )

    @property
    def columns(self) -> tuple[np.ndarray, ...]:
        return self.variables, self.neighbours, self.edge, self.is_first

    def taken(self, tables: np.ndarray) -> np.ndarray:
        """Their tables, the variables on the first axis: shape (states, states, variables, rows)."""
        found = tables.take(self.edge, axis=2)
        if self.is_first.all():
            return found
        if not self.is_first.any():
            return found.swapaxes(0, 1)
        return np.where(self.is_first[:, None], found, found.swapaxes(0, 1))

    def given(self, tables: np.ndarray, drawn: np.ndarray) -> np.ndarray:
        """Log factors of all states given the neighbour's, shape (states, variables, rows)."""
        begin, other = self._places(tables.shape)
        return tables.reshape(-1).take(begin + drawn[self.neighbours] * other)

    def _places(self, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Where all states of the variables stand beside the first of their neighbours; how far the next."""
        if shape not in self._kept:
            states, _, count, rows = shape
            size = count * rows
            first = self.is_first[:, None]
            own, other = (
                np.where(first, a, b) for a, b in ((states * size, size), (size, states * size))
            )
            begin = self.edge[:, None] * rows + np.arange(rows)
            self._kept.clear()
            self._kept[shape] = begin + own * np.arange(states)[:, None, None], other
        return self._kept[shape]


@dataclass(frozen=True, eq=False)
class _Round:
    """Variables that are summed out together: ``alone``, with one neighbour, and with two."""

    alone: np.ndarray
    leaf: _Side
    left: _Side
    right: _Side
    #: the neighbours of the leaves, each once, and the order and starts of the leaves by neighbour
    stems: np.ndarray
    order: np.ndarray
    starts: np.ndarray
    #: number of the first new table
    begin: int

    @cached_property
    def members(self) -> np.ndarray:
        return np.concatenate([self.alone, self.leaf.variables, self.left.variables])

    @cached_property
    def both(self) -> _Side:
        """The sides of variables with two neighbours, one after the other."""
        parts = zip(self.left.columns, self.right.columns, strict=True)
        return _Side(*(np.concatenate(pair) for pair in parts))

    def sum_out(self, single: np.ndarray, tables: np.ndarray) -> np.ndarray:
        """Put the sums in place; what the variables without neighbours add to the log normaliser."""
        if len(self.leaf.variables):
            own = single[:, None, self.leaf.variables]
            sums = log_sum_exp(self.leaf.taken(tables) + own, 0)[:, self.order]
            if len(self.stems) < len(self.order):
                sums = np.add.reduceat(sums, self.starts, axis=1)
            single[:, self.stems] += sums
        if len(self.left.variables):
            left = self.left.taken(tables) + single[:, None, self.left.variables]
            end = self.begin + len(self.left.variables)
            tables[:, :, self.begin : end] = _log_product(left, self.right.taken(tables))
        return log_sum_exp(single[:, self.alone], 0).sum(axis=0)

    def draw(
        self,
        single: np.ndarray,
        tables: np.ndarray,
        drawn: np.ndarray,
        uniform: np.ndarray,
        what: str,
    ) -> None:
        """Draw the variables given those that were left when they were summed out."""
        members = self.members
        log = single[:, members]
        begin, end = len(self.alone), len(self.alone) + len(self.leaf.variables)
        if end > begin:
            log[:, begin:end] += self.leaf.given(tables, drawn)
        if len(members) > end:
            given = self.both.given(tables, drawn)
            log[:, end:] += given[:, : len(self.left.variables)]
            log[:, end:] += given[:, len(self.left.variables) :]
        drawn[members] = pick_log(log, uniform[members], f"node {what!r}")


def _apart(left: list[int], near: list[dict[int, int]]) -> list[int]:
    """Variables with at most two neighbours, no two of which meet."""
    beside: set[int] = set()
    chosen = []
    for v in left:
        if len(near[v]) <= 2 and v not in beside:
            chosen.append(v)
            beside.update(near[v])
    return chosen


def _eliminated(chosen: list[int], near: list[dict[int, int]], first: list[int]) -> _Round:
    """The round that sums some variables out; the graph loses them, and gains edges beside them."""
    alone, leaves, middles = [], [], []
    begin = len(first)
    for v in chosen:
        around = list(near[v].items())
        for n, _ in around:
            del near[n][v]
        if not around:
            alone.append(v)
        elif len(around) == 1:
            ((n, e),) = around
            leaves.append((v, n, e, first[e] == v))
        else:
            (a, e), (b, f) = around
            if b in near[a]:
                raise ValueError("the edges make a cycle; leave some out")
            middles.append(((v, a, e, first[e] == v), (v, b, f, first[f] == v)))
            near[a][b] = near[b][a] = len(first)
            first.append(a)
    leaf = _side(leaves)
    stems, counts = np.unique(leaf.neighbours, return_counts=True)
    return _Round(
        np.array(alone, dtype=np.intp),
        leaf,
        _side([m[0] for m in middles]),
        _side([m[1] for m in middles]),
        stems,
        np.argsort(leaf.neighbours, kind="stable"),
        np.cumsum(counts) - counts,
        begin,
    )


def _side(rows: list[tuple[int, int, int, bool]]) -> _Side:
    table = np.array(rows, dtype=np.intp).reshape(-1, 4)
    return _Side(table[:, 0], table[:, 1], table[:, 2], table[:, 3].astype(bool))


def _log_product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Log of ``sum_j exp(left[j, i] + right[j, k])`` for all i and k, axes after these together."""
    top_left, top_right = _top(left), _top(right)
    a, b = np.exp(left - top_left), np.exp(right - top_right)
    if len(left) > _FEW:
        product = np.moveaxis(
            np.moveaxis(a, (0, 1), (-1, -2)) @ np.moveaxis(b, (0, 1), (-2, -1)), (-2, -1), (0, 1)
        )
    else:
        product = a[0][:, None] * b[0]
        for j in range(1, len(a)):
            product += a[j][:, None] * b[j]
    log = np.log(product) + top_left[:, None] + top_right
    if _is_rough(a, left) or _is_rough(b, right):
        small = np.nonzero(product < _SMALL)  # what is impossible, and what was lost
        i, k, variable, row = small
        log[small] = log_sum_exp(left[:, i, variable, row] + right[:, k, variable, row], 0)
    return log


def _is_rough(scaled: np.ndarray, log: np.ndarray) -> bool:
    """Whether some factor is so small, but not zero, that products with it may be lost."""
    small = scaled < _ROUGH
    return bool(small.any() and (log[small] > -np.inf).any())


def _top(log: np.ndarray) -> np.ndarray:
    """The largest along the first axis; 0 where all are ``-inf``."""
    top = log[0]
    for row in log[1:]:
        top = np.maximum(top, row)
    return np.where(top == -np.inf, 0.0, top)
