"""Beliefs that messages make: jointly Gaussian coordinates, component by component, and finite variables.

Everything is in natural parameters: an exact part, which is never approximated, and the sum of all messages.
Components of one size are one array, and so are finite variables with equally many states.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy

from bayesmc.factors.families import Family
from bayesmc.factors.tilted import log_integral, log_sum
from bayesmc.gaussian import try_cholesky
from bayesmc.linalg.patterns import lapack

#: log of what is impossible: its exponential is 0, and sums and differences of it stay numbers
IMPOSSIBLE = -1e3
#: below this nothing is left of a belief
NOTHING = 0.9 * IMPOSSIBLE


def components(count: int, groups: Iterable[np.ndarray]) -> np.ndarray:
    """The component of each coordinate, where those of a group belong together.

    Parameters
    ----------
    count : int
    groups : iterable of ndarray of int, shape (m, q)
        A group in every row.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.engines.propagation.beliefs import components
    >>> components(5, [np.array([[0, 2], [2, 4]])]).tolist()
    [0, 1, 0, 2, 0]
    """
    groups = list(groups)
    if count and any(len(g) == 1 and len(np.unique(g)) == count for g in groups):
        return np.zeros(count, dtype=int)
    ends = [(g[:, :1].repeat(g.shape[1] - 1, 1).ravel(), g[:, 1:].ravel()) for g in groups]
    if not count or not ends:
        return np.arange(count)
    one, two = (np.concatenate(e) for e in zip(*ends, strict=True))
    links = scipy.sparse.coo_array(
        (np.ones(len(one), dtype=bool), (one, two)), shape=(count, count)
    )
    found = scipy.sparse.csgraph.connected_components(links, directed=False)[1]
    _, where, found = np.unique(found, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(where))[found]


@dataclass(eq=False)
class Blocks:
    """Components of one size: ``exp(linear' x - x' precision x / 2)`` each.

    Attributes
    ----------
    precision, linear : ndarray, shapes (components, n, n) and (components, n)
        Exact part and messages together.
    cov, mean : ndarray
        As of the last ``refreshed``.
    """

    precision: np.ndarray
    linear: np.ndarray
    cov: np.ndarray = field(init=False)
    mean: np.ndarray = field(init=False)
    _right: np.ndarray | None = field(init=False, default=None, repr=False)

    def refreshed(self, which: np.ndarray | None = None) -> np.ndarray:
        """Invert anew; components that have no integral keep their moments, and are True in the answer."""
        at = slice(None) if which is None else which
        if len(self.precision) == 1 and self._refreshed_one():
            return np.zeros(1, dtype=bool)
        root, bad = try_cholesky(self.precision[at])
        if bad is None:
            bad = np.zeros(len(root), dtype=bool)
        left = np.linalg.solve(root, np.broadcast_to(np.eye(root.shape[-1]), root.shape))
        cov = np.matrix_transpose(left) @ left
        mean = np.matvec(cov, self.linear[at])
        if which is None and not hasattr(self, "cov"):
            self.cov, self.mean = cov, mean
        elif not bad.any():
            self.cov[at], self.mean[at] = cov, mean
        else:
            kept = bad[:, None]
            self.cov[at] = np.where(kept[..., None], self.cov[at], cov)
            self.mean[at] = np.where(kept, self.mean[at], mean)
        return bad

    def _refreshed_one(self) -> bool:
        """Invert the only component anew, where it is proper."""
        n = self.linear.shape[1]
        if self._right is None:
            self._right = np.eye(n, n + 1, order="F")
        self._right[:, n] = self.linear[0]
        _, found, fault = lapack().dposv(self.precision[0], self._right, lower=1)
        if fault or not np.isfinite(found.sum()):
            return False
        if not hasattr(self, "cov"):
            self.cov, self.mean = np.empty_like(self.precision), np.empty_like(self.linear)
        cov = found[:, :n]
        np.multiply(0.5, cov + cov.T, out=self.cov[0])
        self.mean[0] = found[:, n]
        return True

    @property
    def log_total(self) -> float:
        return float(log_integral(self.precision, self.linear).sum()) if len(self.linear) else 0.0


@dataclass(eq=False)
class Finite:
    """Variables with equally many states: sums of the logs of messages, shape (variables, states)."""

    logs: np.ndarray

    @property
    def probabilities(self) -> np.ndarray:
        return np.exp(normalised(self.logs))

    @property
    def log_total(self) -> float:
        return float(log_sum(self.logs).sum())


@dataclass(eq=False)
class Conjugates:
    """Elements of one family: natural parameters, exact part and messages, shape (elements, statistics)."""

    family: Family
    naturals: np.ndarray

    @property
    def log_total(self) -> float:
        return float(self.family.log_total(self.naturals).sum())


@dataclass(eq=False)
class Beliefs:
    """All of them.

    Attributes
    ----------
    blocks : list of Blocks
    finite : list of Finite
    size : ndarray of int, shape (coordinates,)
        In which of ``blocks`` a coordinate is; ``component`` and ``place`` say where there.
    centre : ndarray, shape (coordinates,)
        From where coordinates are counted in ``blocks``; moments have it added.
    """

    blocks: list[Blocks]
    finite: list[Finite]
    size: np.ndarray
    component: np.ndarray
    place: np.ndarray
    families: list[Conjugates] = field(default_factory=list)
    centre: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.centre = np.zeros(len(self.size))

    @classmethod
    def of(cls, component: np.ndarray, cards: Sequence[int], counts: Sequence[int]) -> Beliefs:
        """Nothing known yet: coordinates by their components, finite variables by their numbers of states."""
        of, at, length = np.unique(component, return_inverse=True, return_counts=True)
        sizes = np.unique(length)
        size = np.searchsorted(sizes, length)[at] if len(of) else np.zeros(0, dtype=int)
        rank = np.zeros(len(of), dtype=int)
        blocks = []
        for n in sizes.tolist():
            mine = np.flatnonzero(length == n)
            rank[mine] = np.arange(len(mine))
            blocks.append(Blocks(np.zeros((len(mine), n, n)), np.zeros((len(mine), n))))
        place = np.zeros(len(component), dtype=int)
        order = np.argsort(at, kind="stable")
        starts = np.cumsum([0, *length])[:-1]
        place[order] = np.arange(len(order)) - np.repeat(starts, length)
        where = rank[at] if len(of) else np.zeros(0, dtype=int)
        finite = [Finite(np.zeros((m, c))) for c, m in zip(cards, counts, strict=True)]
        return cls(blocks, finite, size, where, place)

    def enter(self, coordinates: np.ndarray, matrix: np.ndarray, value: np.ndarray) -> None:
        """Multiply ``exp(-|A x - z|^2 / 2)`` in, up to ``z' z``, exactly; of coordinates of one component."""
        block = self.blocks[self.size[coordinates[0]]]
        c, places = self.component[coordinates[0]], self.place[coordinates]
        np.add.at(block.precision, (c, places[:, None], places[None, :]), matrix.T @ matrix)
        np.add.at(block.linear, (c, places), matrix.T @ value)

    @property
    def log_total(self) -> float:
        gaussian = sum(b.log_total for b in self.blocks)
        finite = sum(f.log_total for f in self.finite)
        return gaussian + finite + sum(c.log_total for c in self.families)

    def moments(self, coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of some coordinates, in order."""
        n = len(coordinates)
        mean, cov = np.zeros(n), np.zeros((n, n))
        size, where, place = (a[coordinates] for a in (self.size, self.component, self.place))
        for k, block in enumerate(self.blocks):
            for c in np.unique(where[size == k]):
                mine = np.flatnonzero((size == k) & (where == c))
                at = place[mine]
                mean[mine] = block.mean[c, at]
                cov[np.ix_(mine, mine)] = block.cov[c][np.ix_(at, at)]
        return mean + self.centre[coordinates], cov

    def variances(self, coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means and variances of some coordinates, each by itself."""
        mean, var = np.zeros(len(coordinates)), np.zeros(len(coordinates))
        size, where, place = (a[coordinates] for a in (self.size, self.component, self.place))
        for k, block in enumerate(self.blocks):
            mine = size == k
            mean[mine] = block.mean[where[mine], place[mine]]
            var[mine] = block.cov[where[mine], place[mine], place[mine]]
        return mean + self.centre[coordinates], var


def normalised(logs: np.ndarray) -> np.ndarray:
    """Log probabilities over the last axis."""
    return logs - log_sum(logs)[..., None]


def clipped(logs: np.ndarray) -> np.ndarray:
    """Logs of a message, the largest 0, none below what counts as impossible."""
    top = logs.max(axis=-1, keepdims=True)
    return np.maximum(logs - np.where(np.isfinite(top), top, 0.0), IMPOSSIBLE)
