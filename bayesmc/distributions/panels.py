"""Adaptive quadrature of many one-dimensional log densities at once, kept as an invertible cdf.

The line is cut into panels; on each the density is known at the 15 Gauss-Kronrod nodes, and panels
are halved where the two rules disagree. Every batch element has panels of its own, equally many, so
that all are refined in the same array operations. What is left is piecewise polynomial: its integral
and the inverse of that cost no further call of the density. Coordinates are the caller's affair.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# Kronrod's extension of the 7-point Gauss rule (Kronrod, 1965; the numbers of QUADPACK's qk15)
_HALF = [0.991455371120812639206854697526329, 0.949107912342758524526189684047851,
         0.864864423359769072789712788640926, 0.741531185599394439863864773280788,
         0.586087235467691130294144691693013, 0.405845151377397166906606412076961,
         0.207784955007898467600689403773245]  # fmt: skip
_KRONROD = [0.022935322010529224963732008058970, 0.063092092629978553290700663189204,
            0.104790010322250183839876322541518, 0.140653259715525918745189590510238,
            0.169004726639267902826583426598550, 0.190350578064785409913256402421014,
            0.204432940075298892414161999234649]  # fmt: skip
_GAUSS = [0.0, 0.129484966168869693270611432679082, 0.0, 0.279705391489276667901467771423780,
          0.0, 0.381830050505118944950369775488975, 0.0]  # fmt: skip
_X = np.array([-x for x in _HALF] + [0.0] + _HALF[::-1])
_K = np.array([*_KRONROD, 0.209482141084727828012999174891714, *_KRONROD[::-1]])
_G = np.array([*_GAUSS, 0.417959183673469387755102040816327, *_GAUSS[::-1]])
_COUNT = len(_X)

_ROUNDS = 120
_MOST = 4096  # panels
_AT_ONCE = 4096  # quantiles
_PEAKS = 32
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


@dataclass(frozen=True, eq=False)
class Panels:
    """A piecewise polynomial density per batch element, and its integral.

    Attributes
    ----------
    edges : ndarray, shape (panels + 1, B)
        In increasing order.
    heights : ndarray, shape (15, panels, B)
        The density at the nodes, relative to ``exp(log_scale)``.
    log_scale : ndarray, shape (B,)
    total : ndarray, shape (B,)
        Integral of the relative density.
    error : ndarray, shape (B,)
        Difference of the two rules, summed and relative to the total.
    ends : ndarray, shape (2, B)
        Share of the integral in the outermost panels.
    broken : ndarray of bool, shape (B,)
        Where the log density came out NaN or plus infinity.
    tops : ndarray, shape (count, B)
        Local maxima, repeated for elements that have fewer.

    References
    ----------
    Piessens et al., QUADPACK, 1983, section 3.4 (globally adaptive Gauss-Kronrod quadrature).
    """

    edges: np.ndarray
    heights: np.ndarray
    log_scale: np.ndarray
    total: np.ndarray
    error: np.ndarray
    ends: np.ndarray
    broken: np.ndarray
    tops: np.ndarray

    @property
    def nodes(self) -> np.ndarray:
        """Shape (15, panels, B)."""
        return _nodes(self.edges[:-1], self.edges[1:])

    @property
    def masses(self) -> np.ndarray:
        """Share of each node in the integral, shape (15, panels, B)."""
        half = 0.5 * np.diff(self.edges, axis=0)
        return _K[:, None, None] * self.heights * half / self.total

    def integral(self, at: np.ndarray, element: np.ndarray, table: _Table) -> np.ndarray:
        """Share of the integral of batch ``element`` left of ``at`` (both of shape (N,))."""
        panel = _locate(self.edges, at, element)
        low, high, start, coefficients = table.of(panel, element)
        s = np.clip((at - low) / (0.5 * (high - low)) - 1.0, -1.0, 1.0)
        return np.clip(start + _series(coefficients, s), 0.0, 1.0)

    def inverse(self, q: np.ndarray, element: np.ndarray, table: _Table) -> np.ndarray:
        """Where the share reaches ``q`` (both of shape (N,)), by Newton's steps kept in a bracket."""
        cuts = range(0, len(q), _AT_ONCE)  # blocks that stay in the cache
        blocks = [
            self._inverse(q[i : i + _AT_ONCE], element[i : i + _AT_ONCE], table) for i in cuts
        ]
        return np.concatenate(blocks) if blocks else q

    def _inverse(self, q: np.ndarray, element: np.ndarray, table: _Table) -> np.ndarray:
        panel = _locate(table.cumulative, q, element)
        low, high, start, coefficients = table.of(panel, element)
        wanted = q - start
        a, b = np.full(q.shape, -1.0), np.ones(q.shape)
        whole = _series(coefficients, b)
        s = np.clip(2 * wanted / np.where(whole > 0, whole, 1.0) - 1.0, -1.0, 1.0)
        for _ in range(80):
            missing = _series(coefficients, s) - wanted
            a, b = np.where(missing < 0, s, a), np.where(missing < 0, b, s)
            step = s - missing / _slope(coefficients, s)
            step = np.where((step > a) & (step < b), step, 0.5 * (a + b))
            done = np.abs(missing) <= 1e-15 * whole  # nothing is left of it beside the other panels
            s = np.where(done, s, step)
            if done.all():
                break
        return low + 0.5 * (high - low) * (s + 1.0)

    def table(self) -> _Table:
        """What lookups need, made once."""
        half = 0.5 * np.diff(self.edges, axis=0) / self.total
        coefficients = np.einsum("kj,jpb->kpb", _INTEGRATE, self.heights) * half
        cumulative = np.concatenate([np.zeros((1, len(self.total))), self.masses.sum(0).cumsum(0)])
        cumulative = np.maximum.accumulate(cumulative, axis=0)
        return _Table(self.edges, cumulative / cumulative[-1], coefficients)


@dataclass(frozen=True, eq=False)
class _Table:
    edges: np.ndarray
    cumulative: np.ndarray
    coefficients: np.ndarray

    def of(
        self, panel: np.ndarray, element: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Bounds, mass before and coefficients of panels of batch elements (shape (N,))."""
        pick = (panel, element)
        return (
            self.edges[pick],
            self.edges[panel + 1, element],
            self.cumulative[pick],
            self.coefficients[:, panel, element],
        )


def adapt(
    log_density: Callable[[np.ndarray], np.ndarray],
    edges: np.ndarray,
    tolerance: float,
    marks: np.ndarray | None = None,
) -> Panels:
    """Refine ``edges`` until the integral is known to ``tolerance``, relative, or panels run out.

    Parameters
    ----------
    log_density : callable
        Maps points of shape (n, B) to log densities of that shape; column b is batch element b.
    edges : ndarray, shape (panels + 1, B)
        Where to start; increasing.
    tolerance : float
    marks : ndarray, shape (count, B), optional
        Where to look closely, beside the peaks that the log density points to.

    Returns
    -------
    Panels
        Whose ``error`` says whether it has come out.
    """
    low, high = edges[:-1], edges[1:]
    logs = _evaluate(log_density, low, high)
    tops, hidden = _peaks(log_density, _nodes(low, high), logs)
    found = tops[hidden]
    if marks is not None:
        found = np.concatenate([found, marks])
    if len(found):
        edges = _closer(edges, found)
        low, high = edges[:-1], edges[1:]
        logs = _evaluate(log_density, low, high)
    for _ in range(_ROUNDS):
        mass, error, total = _measure(low, high, logs)
        share = np.where(_splittable(low, high), error, 0.0) / np.where(total > 0, total, 1.0)
        need = share > tolerance / (4 * len(low))
        count = int(need.sum(axis=0).max(initial=0))
        if (share.sum(axis=0) <= tolerance).all() or not count or len(low) >= _MOST:
            break
        low, high, logs = _split(log_density, low, high, logs, share, min(count, len(low)))
    order = np.argsort(low, axis=0)
    low, high = (np.take_along_axis(v, order, axis=0) for v in (low, high))
    logs = np.take_along_axis(logs, order[None], axis=1)
    return _finish(low, high, logs, tops)


def _peaks(
    log_density: Callable[[np.ndarray], np.ndarray], nodes: np.ndarray, logs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Local maxima, shape (count, B), and which of them the panels are too coarse to see.

    A log density points to its peaks from far away: every local maximum among the nodes is climbed
    by golden section, and is hidden where the top is well above the nodes (by a nat).
    """
    nodes, values = (
        v.swapaxes(0, 1).reshape(v.shape[0] * v.shape[1], v.shape[2]) for v in (nodes, logs)
    )
    values = np.where(np.isnan(values), -np.inf, values)
    inner = values[1:-1]
    is_top = (inner >= values[:-2]) & (inner > values[2:])
    count = min(int(is_top.sum(axis=0).max(initial=0)), _PEAKS)
    if not count:
        return nodes[:0], np.zeros(0, dtype=bool)
    ranked = np.argsort(np.where(is_top, -inner, np.inf), axis=0, kind="stable")[:count] + 1
    valid = np.take_along_axis(is_top, ranked - 1, axis=0)
    ranked = np.where(valid, ranked, ranked[:1])
    low, high = (np.take_along_axis(nodes, ranked + k, axis=0) for k in (-1, 1))
    seen = np.take_along_axis(values, ranked, axis=0)
    top, height = _climb(log_density, low, high)
    # an element whose own peak was seen is given the place all the same: it costs little
    return top, np.asarray((height > seen + 1.0).any(axis=1))


def _closer(edges: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """Edges with others about the marks (both one column per batch element), nearer and nearer."""
    steps = 4.0 ** -np.arange(2.0, 20.0)
    around = np.concatenate([-steps, [0.0], steps[::-1]])
    close = np.clip(marks[:, None] + around[:, None], edges[0], edges[-1])
    return np.sort(np.concatenate([edges, close.reshape(-1, edges.shape[1])]), axis=0)


def _climb(
    log_density: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Maximum in each bracket by golden section."""
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left, at_right = log_density(left), log_density(right)
    for _ in range(80):
        up = at_left < at_right
        low, high = np.where(up, left, low), np.where(up, high, right)
        new = np.where(up, low + _GOLDEN * (high - low), high - _GOLDEN * (high - low))
        at_new = log_density(new)
        left, right = np.where(up, right, new), np.where(up, new, left)
        at_left, at_right = np.where(up, at_right, at_new), np.where(up, at_new, at_left)
    return left, at_left


def _finish(low: np.ndarray, high: np.ndarray, logs: np.ndarray, tops: np.ndarray) -> Panels:
    mass, error, total = _measure(low, high, logs)
    safe = np.where(total > 0, total, 1.0)
    heights, scale = _relative(logs)
    return Panels(
        edges=np.concatenate([low, high[-1:]]),
        heights=heights,
        log_scale=scale,
        total=total,
        error=error.sum(axis=0) / safe,
        ends=np.stack([mass[0], mass[-1]]) / safe,
        broken=(np.isnan(logs) | (logs == np.inf)).any(axis=(0, 1)),
        tops=tops,
    )


def _evaluate(
    log_density: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    nodes = _nodes(low, high)
    return log_density(nodes.reshape(_COUNT * len(low), low.shape[1])).reshape(nodes.shape)


def _nodes(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return low + (0.5 * (high - low)) * (_X[:, None, None] + 1.0)


def _relative(logs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    usable = np.where(np.isnan(logs) | (logs == np.inf), -np.inf, logs)
    scale = usable.max(axis=(0, 1))
    scale = np.where(np.isfinite(scale), scale, 0.0)
    return np.exp(usable - scale), scale


def _measure(
    low: np.ndarray, high: np.ndarray, logs: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass and error of each panel, and the total."""
    heights, _ = _relative(logs)
    half = 0.5 * (high - low)
    mass = np.einsum("j,jpb->pb", _K, heights) * half
    error = np.abs(mass - np.einsum("j,jpb->pb", _G, heights) * half)
    return mass, error, mass.sum(axis=0)


def _splittable(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return high - low > 1e-13 * np.maximum(np.abs(low), np.abs(high))


def _split(
    log_density: Callable[[np.ndarray], np.ndarray],
    low: np.ndarray,
    high: np.ndarray,
    logs: np.ndarray,
    share: np.ndarray,
    count: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Halve the ``count`` worst panels of every batch element."""
    worst = np.argsort(-share, axis=0, kind="stable")
    halved, kept = worst[:count], worst[count:]
    a, b = np.take_along_axis(low, halved, axis=0), np.take_along_axis(high, halved, axis=0)
    middle = 0.5 * (a + b)
    new_low, new_high = np.concatenate([a, middle]), np.concatenate([middle, b])
    new_logs = _evaluate(log_density, new_low, new_high)
    return (
        np.concatenate([np.take_along_axis(low, kept, axis=0), new_low]),
        np.concatenate([np.take_along_axis(high, kept, axis=0), new_high]),
        np.concatenate([np.take_along_axis(logs, kept[None], axis=1), new_logs], axis=1),
    )


def _locate(table: np.ndarray, at: np.ndarray, element: np.ndarray) -> np.ndarray:
    """Index of the panel that holds each ``at``, by bisection in its batch element's column."""
    low = np.zeros(at.shape, dtype=np.intp)
    high = np.full(at.shape, len(table) - 1, dtype=np.intp)
    while (high - low > 1).any():
        middle = (low + high) >> 1
        right = table[middle, element] <= at
        low, high = np.where(right, middle, low), np.where(right, high, middle)
    return low


def _integration_matrix() -> np.ndarray:
    """From values at the nodes to Legendre coefficients of the integral from -1."""
    legendre = np.polynomial.legendre
    fit = np.linalg.inv(legendre.legvander(_X, _COUNT - 1))
    return np.stack([legendre.legint(fit[:, j], lbnd=-1) for j in range(_COUNT)], axis=1)


_INTEGRATE = _integration_matrix()


def _series(coefficients: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Legendre series of coefficients (K, N) at ``s`` (N,), by Clenshaw's recurrence."""
    one, two = coefficients[-1], np.zeros_like(s)
    for k in range(len(coefficients) - 2, -1, -1):
        one, two = coefficients[k] + (2 * k + 1) / (k + 1) * s * one - (k + 1) / (k + 2) * two, one
    return one


def _slope(coefficients: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Derivative of the series; ``P_k' = (2k - 1) P_{k-1} + P_{k-2}'``."""
    before, now = np.ones_like(s), s
    d_before, d_now = np.zeros_like(s), np.ones_like(s)
    total = coefficients[1].copy()
    for k in range(2, len(coefficients)):
        d_next = (2 * k - 1) * now + d_before
        total += coefficients[k] * d_next
        d_before, d_now = d_now, d_next
        before, now = now, ((2 * k - 1) * s * now - (k - 1) * before) / k
    return total
