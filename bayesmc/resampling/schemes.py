"""Five ways to draw indices in proportion to weights, all unbiased, all with one signature.

``scheme(weights, draws, rng)`` takes weights of shape ``(n, *batch)`` and returns sorted indices of
shape ``(draws, *batch)``. On average index ``i`` comes ``draws * weights[i] / sum`` times; the schemes
differ in how far a single number of offspring may stray from that. An index of weight zero never comes.

All of them work on *edges*: entry ``i`` of the edges says how many draws fall on indices up to ``i``. With
``x`` the running sum of the expected offspring, and ``draws`` random points on ``[0, draws)`` (one in each
``[k, k + 1)``, or anywhere), it is the number of points below ``x[i]``. Equal neighbours in ``x`` have equal
edges, and none lies below a leading zero, which keeps weights of zero out; the edge at the end of ``x`` is
set to ``draws``, which keeps indices within bounds whatever the rounding.

Checks of weights cost one look at the smallest and one at the sum. Sums that overflow, or are so small that
dividing by them would, are taken again of weights divided by the largest.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np

# entries worked on at a time, so that temporaries stay in the cache
_BLOCK = 16_384
# between these a sum, its square and its reciprocal are exact to rounding
_SMALL, _LARGE = 1e-120, 1e120


class Scheme(Protocol):
    """What every resampling scheme is: ``scheme(weights, draws, rng)`` gives sorted indices."""

    def __call__(
        self, weights: np.ndarray, draws: int, rng: np.random.Generator, /
    ) -> np.ndarray: ...


def multinomial(weights: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
    """Independent indices, sorted: the plain scheme, and the one with the largest variance.

    Parameters
    ----------
    weights : array_like, shape (n, *batch)
        Nonnegative, on any scale.
    draws : int
        Number of indices per batch element.
    rng : numpy.random.Generator

    Returns
    -------
    ndarray of intp, shape (draws, *batch)
        Sorted along axis 0.

    Raises
    ------
    ValueError
        If a weight is negative, infinite or NaN, or all are zero.

    Notes
    -----
    Sorted uniforms come from exponential spacings and are merged with the running sums, so the cost is
    linear in ``n + draws``.

    References
    ----------
    Gordon, Salmond and Smith (1993), IEE Proc. F 140(2); Devroye (1986), Non-Uniform Random Variate
    Generation, ch. V (sorted uniforms).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.resampling import multinomial
    >>> picked = multinomial(np.array([0.5, 0.0, 0.5]), 1000, np.random.default_rng(1))
    >>> np.bincount(picked).tolist()
    [517, 0, 483]
    """
    draws = _count_of(draws)
    positions = _cumulative_offspring(weights, draws)
    return _unfolded(_scattered(positions, draws, rng), draws)


def stratified(weights: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
    """Sorted indices from one uniform point in each of ``draws`` strata of equal mass.

    Offspring number at least ``floor(draws * weight) - 1`` and at most ``ceil(draws * weight) + 1``. Never
    more variance than :func:`multinomial`, whatever is averaged.

    Parameters and errors are those of :func:`multinomial`.

    References
    ----------
    Kitagawa (1996), JCGS 5(1); Douc, Cappe and Moulines (2005).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.resampling import stratified
    >>> picked = stratified(np.array([0.5, 0.0, 0.5]), 1001, np.random.default_rng(0))
    >>> np.bincount(picked).tolist()
    [501, 0, 500]
    """
    draws = _count_of(draws)
    positions = _cumulative_offspring(weights, draws)
    points = _one_per_stratum(draws, positions.shape[1:], rng)
    return _unfolded(_closed(_below(positions, points), positions, draws), draws)


def systematic(weights: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
    """Sorted indices from one comb of ``draws`` equally spaced points, shifted by one uniform.

    Offspring number ``floor`` or ``ceil`` of ``draws * weight``. The fastest scheme, and no unbiased one has
    numbers of less variance. The variance of a mean hangs on the order of the particles, though, and in
    unlucky orders it need not vanish with their number; :func:`ssp` has no such order.

    Parameters and errors are those of :func:`multinomial`.

    References
    ----------
    Carpenter, Clifford and Fearnhead (1999); Douc, Cappe and Moulines (2005), sec. 2.4.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.resampling import systematic
    >>> systematic(np.array([0.5, 0.25, 0.25]), 4, np.random.default_rng(0)).tolist()
    [0, 0, 1, 2]
    """
    draws = _count_of(draws)
    positions = _cumulative_offspring(weights, draws)
    # ceil(x - u) of the points k + u lie below x: the whole part of x + (1 - u), but for u = 0
    shift = rng.random(positions.shape[1:]) if positions.ndim > 1 else rng.random()
    positions += (1.0 - shift) % 1.0
    return _unfolded(_closed(positions.astype(np.intp), positions, draws), draws)


def residual(weights: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
    """Sorted indices: ``floor(draws * weight)`` of each for certain, the rest by :func:`multinomial`.

    The rest is drawn in proportion to what the floors left over. Never more variance than
    :func:`multinomial`, whatever is averaged.

    Parameters and errors are those of :func:`multinomial`.

    References
    ----------
    Liu and Chen (1998), JASA 93(443); Douc, Cappe and Moulines (2005).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.resampling import residual
    >>> picked = residual(np.array([0.5, 0.3, 0.2]), 10, np.random.default_rng(0))
    >>> np.bincount(picked).tolist()
    [5, 3, 2]
    """
    draws = _count_of(draws)
    kept, positions, left = _kept_and_left(weights, draws)
    return _unfolded(kept + _scattered(positions, left, rng), draws)


def ssp(weights: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
    """Sorted indices by the Srinivasan sampling process, whose offspring are negatively associated.

    Offspring number ``floor`` or ``ceil`` of ``draws * weight``, as with :func:`systematic`, but means
    converge whatever the order of the particles. Never more variance than :func:`residual`, whatever
    is averaged.

    Parameters and errors are those of :func:`multinomial`.

    Notes
    -----
    The process lets the residuals fight in order, two at a time, until each is 0 or 1: ordered pivotal
    sampling (Deville and Tille 1998). That has the same law as Deville's systematic sampling (Chauvet
    2012): one point in each unit stratum of the running sum of the residuals, with the unit
    across a border taken at most once. Only "was it taken in the stratum before" passes from one stratum
    to the next, and it is resolved for all strata at once, without a loop over particles.

    References
    ----------
    Gerber, Chopin and Whiteley (2019), Annals of Statistics 47(4); Srinivasan (2001), FOCS; Chauvet
    (2012), Bernoulli 18(4); Chauvet and Ruiz-Gazen (2017), Statistics and Probability Letters 121.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.resampling import ssp
    >>> picked = ssp(np.array([0.5, 0.25, 0.25]), 5, np.random.default_rng(0))
    >>> np.bincount(picked).tolist()
    [2, 2, 1]
    """
    draws = _count_of(draws)
    kept, positions, left = _kept_and_left(weights, draws)
    points = _pivotal_points(positions, left, rng)
    return _unfolded(kept + _closed(_below(positions, points), positions, left), draws)


#: every scheme by its name
SCHEMES: Mapping[str, Scheme] = MappingProxyType(
    {
        "multinomial": multinomial,
        "stratified": stratified,
        "systematic": systematic,
        "residual": residual,
        "ssp": ssp,
    }
)


def ess(weights: np.ndarray) -> Any:
    """Effective number of equally weighted particles, ``(sum w)**2 / sum w**2``.

    Parameters
    ----------
    weights : array_like, shape (n, *batch)
        Nonnegative, on any scale. ``bayesmc.diagnostics.weight_ess`` takes log weights.

    Returns
    -------
    float or ndarray, shape batch
        Between 1 and n.

    Raises
    ------
    ValueError
        If a weight is negative, infinite or NaN, or all are zero.

    References
    ----------
    Kong, Liu and Wong (1994), JASA 89(425).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.resampling import ess
    >>> ess(np.array([1.0, 1.0, 0.0, 0.0]))
    2.0
    >>> ess(np.array([[1.0, 1.0], [1.0, 0.0], [1.0, 0.0]])).round(6).tolist()
    [3.0, 1.0]
    """
    weights = _checked(weights)
    total = np.add.reduce(weights, axis=0)
    if not _is_moderate(total):
        weights = _rescaled(weights)
        total = np.add.reduce(weights, axis=0)
    # not a BLAS product, whose threads cost far more than they save
    squares = np.einsum("i...,i...->...", weights, weights)
    return total * total / squares if weights.ndim > 1 else float(total * total / squares)


# ---- private ------------------------------------------------------------------------------------


def _count_of(draws: int) -> int:
    """``draws`` as a plain integer; an error says so where it is none, or negative."""
    try:
        count = operator.index(draws)
    except TypeError:
        count = -1
    if count < 0:
        raise ValueError(f"resampling: draws={draws!r}; give a whole number, 0 or more")
    return count


def _expected_offspring(weights: np.ndarray, draws: int) -> np.ndarray:
    """``draws * weights / sum``, a new array of shape (n, *batch)."""
    weights = _checked(weights)
    total = np.add.reduce(weights, axis=0)
    if not _is_moderate(total):
        weights = _rescaled(weights)
        total = np.add.reduce(weights, axis=0)
    return weights * (draws / total)


def _cumulative_offspring(weights: np.ndarray, draws: int) -> np.ndarray:
    """Running sums of ``expected_offspring`` along axis 0; the last is ``draws`` up to rounding.

    A weight of zero repeats the entry before it exactly.
    """
    weights = _checked(weights)
    running = np.add.accumulate(weights, axis=0)
    if not _is_moderate(running[-1]):
        running = np.add.accumulate(_rescaled(weights), axis=0)
    running *= draws / running[-1]
    return running


def _checked(weights: np.ndarray) -> np.ndarray:
    """As floats, with nothing negative; what is infinite or NaN shows in the sum."""
    weights = np.asarray(weights, dtype=float)
    if weights.ndim == 0 or len(weights) == 0:
        raise ValueError(
            f"resampling: weights of shape {weights.shape}; give at least one, particles on axis 0"
        )
    if (
        weights.size and weights.item(weights.argmin()) < 0
    ):  # faster than a reduction, for few weights
        where = np.argwhere(weights < 0)[0].tolist()
        raise ValueError(
            f"resampling: the weight at {where} is negative ({weights[tuple(where)]}); "
            "weights are exp(log_weights), not log weights"
        )
    return weights


def _is_moderate(total: Any) -> bool:
    if isinstance(total, float):  # a NumPy scalar is one; its array operations cost a microsecond
        return _SMALL < total < _LARGE
    return bool(((total > _SMALL) & (total < _LARGE)).all())


def _rescaled(weights: np.ndarray) -> np.ndarray:
    """Weights divided by the largest of their batch element, or the error that there is none."""
    top = weights.max(axis=0)
    good = (top > 0) & (top < np.inf)
    if np.all(good):
        return weights / top
    where = tuple(np.argwhere(~good)[0].tolist())
    place = f" in batch element {where}" if where else ""
    fault = "all weights are zero" if top[where] == 0 else f"a weight is {top[where]}"
    raise ValueError(
        f"resampling: {fault}{place}; weights must be finite with a positive sum "
        "(from log weights, subtract their maximum before exp)"
    )


def _unfolded(edges: np.ndarray, draws: int) -> np.ndarray:
    """The index of each draw: how many edges lie at or below its number.

    Counting and summing avoids the branch per particle of ``np.repeat``, three times slower at 10**6.
    """
    batch = edges.shape[1:]
    lanes = 1
    if batch:
        lanes = math.prod(batch)
        edges = (edges.reshape(len(edges), lanes) * lanes + np.arange(lanes)).ravel()
    counts = np.bincount(edges, minlength=draws * lanes)[: draws * lanes]
    counts = counts.reshape(draws, *batch) if batch else counts
    return np.add.accumulate(counts, axis=0, out=counts)


def _closed(edges: np.ndarray, positions: np.ndarray, draws: Any) -> np.ndarray:
    """Edges that end at ``draws`` where the positions end, whatever the rounding of either."""
    ends = edges[-1] == draws
    if ends if edges.ndim == 1 else ends.all():
        return edges
    # not edges[-1] alone: after it in mass there may be weights of zero
    return np.where(positions >= positions[-1], draws, np.minimum(edges, draws))


def _scattered(positions: np.ndarray, draws: Any, rng: np.random.Generator) -> np.ndarray:
    """Edges of ``draws`` independent uniform points; ``draws`` is a number, or one per batch element."""
    n, batch = len(positions), positions.shape[1:]
    points = rng.standard_exponential((_most(draws) + 1, *batch))
    np.add.accumulate(points, axis=0, out=points)
    # those of a batch element beyond its own number come to lie beyond its last position
    points *= positions[-1] / _taken(points, np.broadcast_to(draws, (1, *batch)))[0]
    # Both are sorted, and a stable sort merges two runs in linear time; searchsorted is three times
    # slower at 10**6. Positions come first among equals, so a point on a position is not below it.
    order = np.argsort(np.concatenate([positions, points[:-1]]), axis=0, kind="stable")
    ranks = np.nonzero((order < n).T)[-1].reshape(*batch[::-1], n).T
    return _closed(ranks - _column(n, batch), positions, draws)


def _below(positions: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How many points lie below each position; the one of ``[k, k + 1)`` is ``k + points[k]``.

    Whole and fraction are compared apart, since their sum may round into the next stratum.
    """
    edges = positions.astype(np.intp)
    rows = max(1, _BLOCK // max(1, math.prod(positions.shape[1:])))
    for start in range(0, len(edges), rows):
        whole = edges[start : start + rows]
        fraction = positions[start : start + rows] - whole
        whole += fraction > _taken(points, whole)
    return edges


def _one_per_stratum(strata: int, batch: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Uniform on [0, 1), shape (strata + 1, *batch); the last row lies beyond reach."""
    points = np.empty((strata + 1, *batch))
    rng.random(out=points[:strata])
    points[strata] = 2.0
    return points


def _kept_and_left(weights: np.ndarray, draws: int) -> tuple[np.ndarray, np.ndarray, Any]:
    """Edges of the certain offspring, running sums of the residuals, and draws still to be made."""
    expected = _expected_offspring(weights, draws)
    certain = expected.astype(np.intp)
    expected -= certain
    kept = np.add.accumulate(certain, axis=0, out=certain)
    return kept, np.add.accumulate(expected, axis=0, out=expected), draws - kept[-1]


def _pivotal_points(positions: np.ndarray, left: Any, rng: np.random.Generator) -> np.ndarray:
    """One point per stratum, uniform each, such that no unit across a border is taken twice.

    With ``before`` the mass of the first stratum outside the unit across the border and ``after`` that
    unit's mass in the second: if the first did not take it, the second does with probability
    ``after / before``, hence with ``after`` in all; otherwise its point is uniform beyond that unit.
    """
    batch, strata = positions.shape[1:], _most(left)
    points = _one_per_stratum(strata, batch, rng)
    if strata < 2:
        return points
    border = _column(strata, batch)[1:]
    # Batch elements with fewer strata than most read nonsense beyond their own; it stays there.
    across = np.minimum(_unfolded(positions.astype(np.intp), strata - 1), len(positions) - 1)
    after = _taken(positions, across) - border
    before = _taken(positions, across - 1) - (border - 1)
    beyond = points[1:strata]
    beyond *= 1.0 - after
    beyond += after
    may_enter = rng.random(before.shape) * before < after
    # Was the unit across its upper border taken in stratum j? If its point lies there, and the stratum was
    # not entered from below; the latter hangs on stratum j - 1 only where it may be entered.
    lies_there = points[: strata - 1] >= before
    hangs = np.zeros_like(lies_there)
    hangs[1:] = lies_there[1:] & may_enter[:-1]
    decided = np.maximum.accumulate(np.where(hangs, 0, border - 1), axis=0)
    was_taken = _taken(lies_there & ~hangs, decided)
    np.copyto(beyond, 0.0, where=may_enter & ~was_taken)
    return points


def _most(draws: Any) -> int:
    return int(draws) if np.ndim(draws) == 0 else int(draws.max(initial=0))


def _column(n: int, batch: tuple[int, ...]) -> np.ndarray:
    """``0 .. n - 1`` on axis 0, to be broadcast over a batch."""
    return np.arange(n).reshape(n, *(1,) * len(batch))


def _taken(values: np.ndarray, indices: np.ndarray) -> np.ndarray:
    return values[indices] if values.ndim == 1 else np.take_along_axis(values, indices, axis=0)
