"""Adaptive quadrature over boxes, cell by cell, for functions given by their logarithm.

A cell carries a tensor Clenshaw-Curtis rule; the rule of half the order sits on every second node, so
that each axis tells for itself how far the cell's integral may be off, and the cell is halved along the
worst. All nodes are kept: they are a discrete stand-in for the integrand. It knows nothing of nets, and
does not find peaks: cells must be made fine where those are.

References
----------
Clenshaw and Curtis (1960), A method for numerical integration on an automatic computer, Numerische
Mathematik 2. Trefethen (2008), Is Gauss quadrature better than Clenshaw-Curtis?, SIAM Review 50.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from bayesmc.errors import BudgetError

#: log of a sum over functions ``(functions, points)`` at points ``(points, d)``
LogFunction = Callable[[np.ndarray], np.ndarray]

_ROUNDS = 10_000


@dataclass(frozen=True, eq=False)
class Rule:
    """Clenshaw-Curtis on [-1, 1].

    Attributes
    ----------
    nodes, weights, coarse : ndarray, shape (order + 1,)
        ``coarse`` has the weights of half the order, zero on nodes that it does not use.
    """

    nodes: np.ndarray
    weights: np.ndarray
    coarse: np.ndarray


def clenshaw_curtis(order: int) -> Rule:
    """The rule of an even order, exact for polynomials up to it.

    Examples
    --------
    >>> from bayesmc.testing.oracles.cells import clenshaw_curtis
    >>> rule = clenshaw_curtis(8)
    >>> bool(abs(rule.weights @ rule.nodes**8 - 2 / 9) < 1e-15)
    True
    """
    nodes = np.cos(np.pi * np.arange(order + 1) / order)
    coarse = np.zeros(order + 1)
    coarse[::2] = _weights(order // 2)
    return Rule(nodes, _weights(order), coarse)


@dataclass(frozen=True, eq=False)
class Cells:
    """Leaves of the subdivision.

    Attributes
    ----------
    low, high : ndarray, shape (cells, d)
    logs : ndarray, shape (cells, functions, nodes ** d)
        Of the integrand at the tensor nodes.
    log_integral : float
    error : float
        Estimated, relative to the integral.
    rule : Rule
    evaluations : int
    """

    low: np.ndarray
    high: np.ndarray
    logs: np.ndarray
    log_integral: float
    error: float
    rule: Rule
    evaluations: int

    def points(self) -> np.ndarray:
        """All nodes, shape ``(cells, nodes ** d, d)``."""
        return _nodes(self.low, self.high, self.rule)

    def log_weights(self, coarse: bool = False) -> np.ndarray:
        """Log of each node's share of the integral, shape ``(cells, functions, nodes ** d)``; of the
        rule of half the order on request."""
        one = self.rule.coarse if coarse else self.rule.weights
        product = np.ones(1)
        for _ in range(self.low.shape[1]):
            product = np.multiply.outer(product, one).ravel()
        volume = np.prod((self.high - self.low) / 2, axis=1)
        with np.errstate(divide="ignore"):
            return self.logs + np.log(product) + np.log(volume)[:, None, None] - self.log_integral

    def first_axis_cdf(self) -> Callable[[np.ndarray], np.ndarray]:
        """The share of the integral at or below a value of the first coordinate."""
        d, n = self.low.shape[1], len(self.rule.nodes)
        density = np.exp(self.logs - self.log_integral).sum(axis=1).reshape(-1, n, n ** (d - 1))
        across = np.ones(1)
        for _ in range(d - 1):
            across = np.multiply.outer(across, self.rule.weights).ravel()
        half = (self.high - self.low) / 2
        lines = density @ across * np.prod(half, axis=1)[:, None]
        below = np.polynomial.chebyshev.chebint(_to_chebyshev(n - 1) @ lines.T, lbnd=-1)
        middle, width = self.low[:, 0] + half[:, 0], half[:, 0]

        def cdf(at: np.ndarray) -> np.ndarray:
            flat = np.ravel(at)
            place = np.clip((flat[:, None] - middle) / width, -1.0, 1.0)
            parts = np.polynomial.chebyshev.chebval(place, below[:, None, :], tensor=False)
            return np.clip(parts.sum(axis=1), 0.0, 1.0).reshape(np.shape(at))

        return cdf


def integrate(
    log_function: LogFunction,
    start: tuple[np.ndarray, np.ndarray],
    *,
    rtol: float,
    order: int,
    max_evaluations: int,
    max_batch: int,
) -> Cells:
    """Integrate the sum of some functions over the cells ``start`` (``low``, ``high``: ``(cells, d)``).

    Raises
    ------
    BudgetError
        The relative error is above ``rtol`` after ``max_evaluations``.
    """
    rule = clenshaw_curtis(order)
    work = _Work(log_function, rule, max(1, max_batch // (order + 1) ** start[0].shape[1]))
    work.add(*start)
    for _ in range(_ROUNDS):
        total, errors = work.total, work.errors.sum(axis=1)
        error = float(errors.sum() / total) if total > 0 else math.inf
        if error <= rtol or total == 0.0:
            blind, axes = work.blind(0.1 * rtol)
            if not blind.size:
                break
            work.split(blind, axes)
            continue
        if work.evaluations >= max_evaluations:
            raise BudgetError(
                f"the integral is known to {error:.1e} after {work.evaluations} evaluations, {rtol:.1e} is "
                "asked for; give a larger rtol= or max_evaluations=, or observe more"
            )
        work.split(_worst(errors, 0.3 * rtol * total))
    return work.result(error if total > 0 else 0.0)


# ---- private ------------------------------------------------------------------------------------


class _Work:
    """The leaves so far, with what each contributes, all over one common factor ``exp(top)``."""

    def __init__(self, log_function: LogFunction, rule: Rule, batch: int) -> None:
        self.log_function, self.rule, self.batch = log_function, rule, batch
        self.parts: list[np.ndarray] = []
        self.low = self.high = self.errors = np.zeros((0, 0))
        self.values = np.zeros(0)
        self.logs = np.zeros((0, 0, 0))
        self.top = -np.inf
        self.evaluations = 0

    @property
    def total(self) -> float:
        return float(self.values.sum())

    def add(self, low: np.ndarray, high: np.ndarray) -> None:
        logs = np.concatenate(
            [
                self._evaluate(low[at : at + self.batch], high[at : at + self.batch])
                for at in range(0, len(low), self.batch)
            ]
        )
        self._raise_top(float(logs.max(initial=-np.inf)))
        values, errors = self._judge(logs, low, high)
        if not len(self.low):
            self.low, self.high, self.logs = low, high, logs
            self.values, self.errors = values, errors
            return
        self.low, self.high = np.concatenate([self.low, low]), np.concatenate([self.high, high])
        self.logs = np.concatenate([self.logs, logs])
        self.values = np.concatenate([self.values, values])
        self.errors = np.concatenate([self.errors, errors])

    def split(self, rows: np.ndarray, axis: np.ndarray | None = None) -> None:
        """Halve these cells, each along its worst axis, or a given one."""
        axis = self.errors[rows].argmax(axis=1) if axis is None else axis
        pairs = halved(self.low[rows], self.high[rows], axis)
        keep = np.ones(len(self.low), dtype=bool)
        keep[rows] = False
        self.low, self.high, self.logs = self.low[keep], self.high[keep], self.logs[keep]
        self.values, self.errors = self.values[keep], self.errors[keep]
        self.add(*pairs)

    def result(self, error: float) -> Cells:
        with np.errstate(divide="ignore"):
            log_integral = float(np.log(self.total)) + self.top if self.total > 0 else -math.inf
        return Cells(
            self.low, self.high, self.logs, log_integral, error, self.rule, self.evaluations
        )

    def blind(self, share: float) -> tuple[np.ndarray, np.ndarray]:
        """Cells that do not see what their neighbours do, and the axis along which to halve each.

        A ridge that leaves a fine cell may pass between the nodes of the wide one behind. So the highest
        node on each face is held against the interpolant of the cell across; where they disagree by
        more than ``share`` of the integral, over a volume such as that of the cell which sees it, the
        other is too wide.
        """
        n, d = len(self.rule.nodes), self.low.shape[1]
        heights = np.exp(self.logs - self.top).sum(axis=1).reshape(-1, *(n,) * d)
        volume = np.prod(self.high - self.low, axis=1)
        enough = share * self.total
        found: dict[int, int] = {}
        for axis in range(d):
            for end, outward in ((0, 1.0), (n - 1, -1.0)):
                face = np.take(heights, end, axis=axis + 1).reshape(len(heights), -1)
                rows = np.flatnonzero(face.max(axis=1) * volume > enough)
                points = self._on_face(rows, face[rows].argmax(axis=1), axis, end, outward)
                at, across = self._holding(points, rows)
                seen = self._interpolated(heights[across], across, points[at])
                off = np.abs(seen - face[rows[at]].max(axis=1)) * volume[rows[at]]
                for own, other in zip(rows[at][off > enough], across[off > enough], strict=True):
                    widths = (self.high - self.low)[other] / (self.high - self.low)[own]
                    found[int(other)] = int(widths.argmax())
        return np.array(list(found), dtype=int), np.array(list(found.values()), dtype=int)

    def _on_face(
        self, rows: np.ndarray, place: np.ndarray, axis: int, end: int, outward: float
    ) -> np.ndarray:
        """Points a little outside of cells, at a node (by its place on the face) of one of their faces."""
        n, d = len(self.rule.nodes), self.low.shape[1]
        indices = np.stack(np.unravel_index(place, (n,) * (d - 1)), axis=-1) if d > 1 else None
        unit = np.empty((len(rows), d))
        if indices is not None:
            unit[:, [k for k in range(d) if k != axis]] = self.rule.nodes[indices]
        unit[:, axis] = outward * (1.0 + 1e-9)
        low, high = self.low[rows], self.high[rows]
        return 0.5 * (low + high) + 0.5 * (high - low) * unit

    def _holding(self, points: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which points lie in another cell, and in which."""
        at, across = [], []
        for k, point in enumerate(points):
            inside = ((self.low <= point) & (point <= self.high)).all(axis=1)
            inside[rows[k]] = False
            hit = np.flatnonzero(inside)
            if hit.size:
                at.append(k)
                across.append(hit[0])
        return np.array(at, dtype=int), np.array(across, dtype=int)

    def _interpolated(
        self, heights: np.ndarray, cells: np.ndarray, points: np.ndarray
    ) -> np.ndarray:
        """What the nodes of cells say about a point in each."""
        low, high = self.low[cells], self.high[cells]
        unit = np.clip((points - 0.5 * (low + high)) / (0.5 * (high - low)), -1.0, 1.0)
        to_chebyshev = _to_chebyshev(len(self.rule.nodes) - 1)
        for k in range(points.shape[1]):
            basis = np.polynomial.chebyshev.chebvander(unit[:, k], len(to_chebyshev) - 1)
            heights = np.einsum("ca,ca...->c...", basis @ to_chebyshev, heights)
        return heights

    def _evaluate(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        points = _nodes(low, high, self.rule)
        logs = self.log_function(points.reshape(-1, points.shape[-1]))
        self.evaluations += logs.size
        return np.moveaxis(logs.reshape(len(logs), *points.shape[:2]), 0, 1)

    def _raise_top(self, found: float) -> None:
        if found <= self.top:
            return
        if self.top > -np.inf:
            factor = math.exp(self.top - found)
            self.values, self.errors = self.values * factor, self.errors * factor
        self.top = found

    def _judge(
        self, logs: np.ndarray, low: np.ndarray, high: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Integrals of cells, and their errors along each axis."""
        d, n = low.shape[1], len(self.rule.nodes)
        if self.top == -np.inf:
            return np.zeros(len(low)), np.zeros(low.shape)
        heights = np.exp(logs - self.top).sum(axis=1).reshape(-1, *(n,) * d)
        volume = np.prod((high - low) / 2, axis=1)
        value = volume * _contract(heights, [self.rule.weights] * d)
        errors = np.empty(low.shape)
        off = self.rule.weights - self.rule.coarse
        for k in range(d):
            along = [off if j == k else self.rule.weights for j in range(d)]
            errors[:, k] = np.abs(volume * _contract(heights, along))
        return value, _sharpened(errors, value)


def halved(low: np.ndarray, high: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both halves of every cell, cut along its own axis."""
    rows = np.arange(len(low))
    middle = 0.5 * (low[rows, axis] + high[rows, axis])
    left, right = high.copy(), low.copy()
    left[rows, axis] = right[rows, axis] = middle
    return np.concatenate([low, right]), np.concatenate([left, high])


def _sharpened(errors: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The difference of two rules is the error of the coarse one. Where it is small the fine rule, of
    twice the order, is better by about the same factor again; three quarters of that are claimed."""
    share = errors / np.maximum(values, 1e-300)[:, None]
    return errors * np.minimum(1.0, 30.0 * share**0.75) + 1e-15 * values[:, None]


def _worst(errors: np.ndarray, enough: float) -> np.ndarray:
    """The fewest cells without which the errors add up to ``enough``."""
    order = np.argsort(errors)
    small = np.cumsum(errors[order]) <= enough
    return order[~small]


def _contract(heights: np.ndarray, weights: Iterable[np.ndarray]) -> np.ndarray:
    for one in reversed(list(weights)):
        heights = heights @ one
    return heights


def _nodes(low: np.ndarray, high: np.ndarray, rule: Rule) -> np.ndarray:
    d = low.shape[1]
    axes = np.meshgrid(*[rule.nodes] * d, indexing="ij")
    unit = np.stack([a.ravel() for a in axes], axis=-1)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    return middle[:, None] + half[:, None] * unit


def _weights(order: int) -> np.ndarray:
    """Clenshaw-Curtis weights, from the integrals of Chebyshev polynomials."""
    moments = np.zeros(order + 1)
    even = np.arange(0, order + 1, 2)
    moments[even] = 2.0 / (1.0 - even**2)
    return moments @ _to_chebyshev(order)


def _to_chebyshev(order: int) -> np.ndarray:
    """Matrix from values at the nodes to Chebyshev coefficients."""
    k = np.arange(order + 1)
    matrix = 2.0 / order * np.cos(np.pi * np.outer(k, k) / order)
    matrix[:, [0, -1]] /= 2
    matrix[[0, -1]] /= 2
    return matrix
