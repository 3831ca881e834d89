"""What one number's distribution says beyond moments: cdf, narrowest intervals, mode and entropy.

One class for each kind of knowledge: a table of states, draws with weights, normal numbers, and a curve
(quantiles, with the cdf or the density where these are known). All numbers of a node are answered for at
once, each by itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.special import ndtr, ndtri

from bayesmc.errors import QueryError, UnsupportedError

#: levels at which narrowest intervals and modes of curves are looked for, and how often around the best
_LEVELS, _ZOOMS = 129, 6
#: nearest that levels come to 0 and 1
_END = 1e-12
#: standard normal scores between which the entropy of a curve is integrated, in even steps
_SCORES = np.linspace(-8.0, 8.0, 641)
#: cells of the histogram that a kernel density of draws is made from
_CELLS = 1024


class Laws(Protocol):
    """The distributions of all numbers of a node, of shape ``shape``, each by itself."""

    def cdf(self, points: np.ndarray) -> np.ndarray:
        """Probabilities of values up to points that broadcast against ``shape`` from behind."""
        ...

    def hdi(self, prob: float) -> np.ndarray:
        """Ends of the narrowest intervals of that probability, shape ``(*shape, 2)``."""
        ...

    def mode(self) -> np.ndarray:
        """The most likely values, shape ``shape``; of a table positions of states."""
        ...

    def entropy(self) -> np.ndarray:
        """In nats, differential where values are continuous, shape ``shape``."""
        ...


@dataclass(frozen=True, eq=False)
class TableLaws:
    """Finitely many states.

    Attributes
    ----------
    table : ndarray, shape (*shape, states)
    numbers : ndarray, shape (states,), or None
        What the states are worth; labels are worth nothing and have no order.
    name : str
        Of the node, for what is told.
    """

    table: np.ndarray
    numbers: np.ndarray | None
    name: str

    def cdf(self, points: np.ndarray) -> np.ndarray:
        numbers = self._ordered("cdf")
        below = numbers <= np.asarray(points, dtype=float)[..., None]
        return np.minimum((self.table * below).sum(axis=-1), 1.0)

    def hdi(self, prob: float) -> np.ndarray:
        numbers = self._ordered("hdi")
        order = np.argsort(numbers)
        flat = self.table[..., order].reshape(-1, len(order))
        ends = [_narrowest(numbers[order], row, prob) for row in flat]
        return np.reshape(ends, (*self.table.shape[:-1], 2)).astype(float)

    def mode(self) -> np.ndarray:
        return self.table.argmax(axis=-1)

    def entropy(self) -> np.ndarray:
        return entropy_of(self.table)

    def _ordered(self, what: str) -> np.ndarray:
        if self.numbers is None:
            raise unordered(what, self.name)
        return self.numbers


@dataclass(frozen=True, eq=False)
class DrawnLaws:
    """Draws with weights.

    Attributes
    ----------
    values : ndarray, shape (draws, *shape)
    weights : ndarray or None
        Shape ``(draws,)``, or that of values, which sum to 1 over draws; None where they are equal.
    is_discrete : bool
    """

    values: np.ndarray
    weights: np.ndarray | None
    is_discrete: bool

    def cdf(self, points: np.ndarray) -> np.ndarray:
        points = np.asarray(points, dtype=float)
        values, weights = self._columns()
        full = np.broadcast_to(points, np.broadcast_shapes(points.shape, self.values.shape[1:]))
        lead = full.shape[: full.ndim - (self.values.ndim - 1)]
        flat = full.reshape(math.prod(lead), values.shape[1])
        found = np.empty(flat.shape)
        for k, column in enumerate(values.T):
            order = np.argsort(column)
            below = np.concatenate([[0.0], np.cumsum(weights[order, k])])
            found[:, k] = below[np.searchsorted(column[order], flat[:, k], side="right")]
        return np.minimum(found.reshape(full.shape), 1.0)

    def hdi(self, prob: float) -> np.ndarray:
        values, weights = self._columns()
        found = []
        for k, column in enumerate(values.T):
            order = np.argsort(column)
            if self.weights is None:
                found.append(_shortest_half(column[order], prob))
            else:
                found.append(_narrowest(column[order], weights[order, k], prob))
        return np.reshape(found, (*self.values.shape[1:], 2)).astype(float)

    def mode(self) -> np.ndarray:
        values, weights = self._columns()
        find = _most_frequent if self.is_discrete else _densest
        found = [find(column, weights[:, k]) for k, column in enumerate(values.T)]
        return np.reshape(found, self.values.shape[1:])

    def entropy(self) -> np.ndarray:
        values, weights = self._columns()
        find = _plug_in_entropy if self.is_discrete else _spacing_entropy
        found = [find(column, weights[:, k]) for k, column in enumerate(values.T)]
        return np.reshape(found, self.values.shape[1:]).astype(float)

    def _columns(self) -> tuple[np.ndarray, np.ndarray]:
        """Values and weights, shape ``(draws, numbers)``."""
        values = self.values.reshape(len(self.values), math.prod(self.values.shape[1:]))
        if self.weights is None:
            return values, np.broadcast_to(1.0 / len(values), values.shape)
        weights = self.weights
        weights = weights.reshape(weights.shape + (1,) * (self.values.ndim - weights.ndim))
        return values, np.broadcast_to(weights, self.values.shape).reshape(values.shape)


@dataclass(frozen=True, eq=False)
class NormalLaws:
    """Normal numbers; those without spread are known.

    Attributes
    ----------
    mean, std : ndarray, shape shape
    """

    mean: np.ndarray
    std: np.ndarray

    def cdf(self, points: np.ndarray) -> np.ndarray:
        away = np.asarray(points, dtype=float) - self.mean
        spread = np.where(self.std > 0, self.std, 1.0)
        return np.where(self.std > 0, ndtr(away / spread), (away >= 0).astype(float))

    def hdi(self, prob: float) -> np.ndarray:
        reach = float(ndtri(0.5 + 0.5 * prob)) * self.std
        return np.stack([self.mean - reach, self.mean + reach], axis=-1)

    def mode(self) -> np.ndarray:
        return np.array(self.mean, dtype=float)

    def entropy(self) -> np.ndarray:
        with np.errstate(divide="ignore"):
            return 0.5 * (1.0 + math.log(2 * math.pi)) + np.log(self.std)


@dataclass(frozen=True, eq=False)
class CurveLaws:
    """Continuous numbers whose quantiles are known.

    Attributes
    ----------
    shape : tuple of int
    ppf : callable
        From levels to quantiles, both of a shape ``(*lead, *shape)``.
    below : callable or None
        The cdf, from points of such a shape; found from the quantiles where there is none.
    log_density : callable or None
        The same; differences of quantiles stand in where there is none.
    """

    shape: tuple[int, ...]
    ppf: Callable[[np.ndarray], np.ndarray]
    below: Callable[[np.ndarray], np.ndarray] | None = None
    log_density: Callable[[np.ndarray], np.ndarray] | None = None

    def cdf(self, points: np.ndarray) -> np.ndarray:
        points = np.asarray(points, dtype=float)
        full = np.broadcast_to(points, np.broadcast_shapes(points.shape, self.shape))
        if self.below is not None:
            return np.asarray(self.below(full))
        low, high = np.zeros(full.shape), np.ones(full.shape)
        for _ in range(45):  # bisection on the level, each number at its own
            middle = 0.5 * (low + high)
            reached = self.ppf(middle) <= full
            low, high = np.where(reached, middle, low), np.where(reached, high, middle)
        return 0.5 * (low + high)

    def hdi(self, prob: float) -> np.ndarray:
        low, high = np.zeros(self.shape), np.full(self.shape, 1.0 - prob)
        for _ in range(_ZOOMS):
            levels = np.clip(low + self._even() * (high - low), _END, 1.0 - prob - _END)
            width = self.ppf(levels + prob) - self.ppf(levels)
            best = np.where(np.isnan(width), np.inf, width).argmin(axis=0)[None]
            low, high = _around(levels, best)
        level = np.take_along_axis(levels, best, axis=0)
        return np.stack([self.ppf(level)[0], self.ppf(level + prob)[0]], axis=-1)

    def mode(self) -> np.ndarray:
        z = np.linspace(-6.0, 6.0, 4 * _LEVELS)
        points = self._at_scores(z)
        if self.log_density is None:
            best = self._log_slope(z, points).argmax(axis=0)[None]
            return np.take_along_axis(points, best, axis=0)[0]
        for _ in range(_ZOOMS):
            height = self.log_density(points)
            best = np.where(np.isnan(height), -np.inf, height).argmax(axis=0)[None]
            found = np.take_along_axis(points, best, axis=0)[0]
            low, high = _around(points, best)
            points = low + self._even() * (high - low)
        return found

    def entropy(self) -> np.ndarray:
        z = _SCORES if self.log_density is not None else _SCORES[np.abs(_SCORES) <= 6.0]
        points = self._at_scores(z)
        if self.log_density is not None:
            height = self.log_density(points)
        else:
            height = self._log_slope(z, points)
        mass = np.exp(-0.5 * z * z)
        mass = self._ahead(mass / mass.sum())
        size = np.abs(points).max(axis=0, initial=0.0)
        known = points[-1] - points[0] <= 1e-14 * size + 1e-100
        with np.errstate(invalid="ignore"):
            return np.where(known, -np.inf, -(mass * height).sum(axis=0))

    def _even(self) -> np.ndarray:
        return self._ahead(np.linspace(0.0, 1.0, _LEVELS))

    def _ahead(self, row: np.ndarray) -> np.ndarray:
        """Numbers along an axis before those of the shape."""
        return row.reshape(-1, *(1,) * len(self.shape))

    def _at_scores(self, z: np.ndarray) -> np.ndarray:
        """Quantiles at standard normal scores, shape ``(scores, *shape)``."""
        levels = np.broadcast_to(self._ahead(ndtr(z)), (len(z), *self.shape))
        return self.ppf(levels)

    def _log_slope(self, z: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Log densities at quantiles of standard normal scores, from how far these lie apart."""
        slope = np.gradient(points, z, axis=0)
        known = self._ahead(-0.5 * z * z - 0.5 * math.log(2 * math.pi))
        with np.errstate(divide="ignore"):
            return np.where(slope > 0, known - np.log(np.maximum(slope, 1e-300)), -np.inf)


def curve_between(
    shape: tuple[int, ...], quantile: Callable[[np.ndarray], np.ndarray]
) -> CurveLaws:
    """Numbers of which quantiles are known at the same levels for all, ``(levels,)`` to ``(levels, *shape)``.

    They are asked once, at standard normal scores of even steps, and what lies between is on straight lines.
    """
    z = np.linspace(-6.5, 6.5, 1041)
    grid = ndtr(z)
    table = quantile(grid)

    def ppf(levels: np.ndarray) -> np.ndarray:
        found = np.empty(levels.shape)
        for at in np.ndindex(shape):
            each = (..., *at)
            found[each] = np.interp(levels[each], grid, table[(slice(None), *at)])
        return found

    return CurveLaws(shape, ppf)


def mixture_laws(mixture: Any) -> CurveLaws:
    """Of scalars that are a ``Mixture`` with a closed cdf, its batch being the shape."""
    return CurveLaws(mixture.batch_shape, mixture.ppf, mixture.cdf, mixture.log_prob)


@dataclass(frozen=True, eq=False)
class SliceLaws:
    """Several in a row, slice by slice; slices come first in what is answered."""

    slices: Sequence[Laws]

    def cdf(self, points: np.ndarray) -> np.ndarray:
        points = np.asarray(points, dtype=float)
        rest = max(np.ndim(self.slices[0].mode()), 0)
        at = points.ndim - rest - 1  # where the axis of slices stands
        if at < 0 or points.shape[at] not in (1, len(self.slices)):
            raise ValueError("points of a series have an axis of slices before those of the node")
        rows = np.moveaxis(points, at, 0)
        rows = np.broadcast_to(rows, (len(self.slices), *rows.shape[1:]))
        found = [law.cdf(row) for law, row in zip(self.slices, rows, strict=True)]
        return np.moveaxis(np.stack(found), 0, at)

    def hdi(self, prob: float) -> np.ndarray:
        return np.stack([law.hdi(prob) for law in self.slices])

    def mode(self) -> np.ndarray:
        return np.stack([law.mode() for law in self.slices])

    def entropy(self) -> np.ndarray:
        return np.stack([law.entropy() for law in self.slices])


def point_laws(values: np.ndarray, is_discrete: bool) -> DrawnLaws:
    """What is known: one value with certainty."""
    return DrawnLaws(np.asarray(values)[None], None, is_discrete)


def entropy_of(table: np.ndarray) -> np.ndarray:
    """Entropies of tables, over the last axis, in nats."""
    logs = np.log(np.where(table > 0, table, 1.0))
    return -(table * logs).sum(axis=-1) + 0.0


def unordered(what: str, name: str) -> UnsupportedError:
    """Labels have no order."""
    return UnsupportedError(
        f"{what}({name!r}): the states are labels, which have no order; use probabilities({name!r}), "
        f"mode({name!r}) or entropy({name!r})"
    )


def interval_probability(name: str, prob: Any) -> float:
    """The probability of an interval, between 0 and 1.

    Raises
    ------
    QueryError
    """
    is_number = isinstance(prob, (int, float, np.number)) and not isinstance(prob, bool)
    if not is_number or not 0 < prob < 1:
        raise QueryError(
            f"hdi({name!r}, prob={prob!r}): prob is the probability of the interval, a number between 0 and 1"
        )
    return float(prob)


# ---- private ------------------------------------------------------------------------------------


def _around(grid: np.ndarray, best: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points of a grid on either side of the best ones."""
    low = np.take_along_axis(grid, np.maximum(best - 1, 0), axis=0)[0]
    high = np.take_along_axis(grid, np.minimum(best + 1, len(grid) - 1), axis=0)[0]
    return low, high


def _narrowest(values: np.ndarray, weights: np.ndarray, prob: float) -> tuple[Any, Any]:
    """The narrowest interval of sorted values that holds the weight ``prob``, and of equals the heaviest."""
    total = np.concatenate([[0.0], np.cumsum(weights)])
    wanted = total[:-1] + prob * total[-1] * (1 - 1e-12)
    last = np.searchsorted(total, wanted) - 1  # the value with which so much is reached
    fits = (last < len(values)) & (weights > 0)
    first = np.flatnonzero(fits)
    last = last[fits]
    width = values[last] - values[first]
    best = np.lexsort([-(total[last + 1] - total[first]), width])[0]
    return values[first[best]], values[last[best]]


def _shortest_half(values: np.ndarray, prob: float) -> tuple[Any, Any]:
    """Of equally weighted draws, as ArviZ counts them."""
    count = len(values)
    inside = int(np.floor(prob * count))
    if inside >= count:
        return values[0], values[-1]
    best = int(np.argmin(values[inside:] - values[: count - inside]))
    return values[best], values[best + inside]


def _most_frequent(values: np.ndarray, weights: np.ndarray) -> Any:
    found, place = np.unique(values, return_inverse=True)
    return found[np.bincount(place.ravel(), weights=weights).argmax()]


def _densest(values: np.ndarray, weights: np.ndarray) -> float:
    """The top of a kernel density; a bandwidth by Silverman's rule (1986, eq. 3.31)."""
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    lower, middle, upper = values[order][
        np.minimum(np.searchsorted(below, [0.25, 0.5, 0.75]), len(values) - 1)
    ]
    mean = weights @ values
    spread = math.sqrt(max(weights @ (values - mean) ** 2, 0.0))
    scale = min(spread, (upper - lower) / 1.349) if upper > lower else spread
    if not scale > 0:
        return float(middle)
    width = 0.9 * scale * (1.0 / np.sum(weights**2)) ** -0.2
    low, high = max(values.min(), lower - 8 * scale), min(values.max(), upper + 8 * scale)
    counts, edges = np.histogram(values, bins=_CELLS, range=(low, high), weights=weights)
    cell = edges[1] - edges[0]
    reach = min(int(np.ceil(4 * width / cell)), _CELLS // 2)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * cell / width) ** 2)
    # mass that lies beyond the ends of the data is folded back, so that a mode at an end is found there
    padded = np.pad(counts, reach, mode="symmetric")
    at = int(np.convolve(padded, kernel, mode="valid").argmax())
    return float(0.5 * (edges[at] + edges[at + 1]))


def _plug_in_entropy(values: np.ndarray, weights: np.ndarray) -> float:
    _, place = np.unique(values, return_inverse=True)
    return float(entropy_of(np.bincount(place.ravel(), weights=weights)))


def _spacing_entropy(values: np.ndarray, weights: np.ndarray) -> float:
    """Differential entropy from spacings of quantiles (Vasicek 1976), with the correction for few draws."""
    found, place = np.unique(values, return_inverse=True)
    if len(found) < 3:
        return -math.inf
    mass = np.bincount(place.ravel(), weights=weights)
    count = max(int(min(1.0 / np.sum(mass**2), len(found))), 3)
    middle = np.cumsum(mass) - 0.5 * mass
    even = np.interp((np.arange(count) + 0.5) / count, middle, found)
    m = max(int(np.floor(math.sqrt(count) + 0.5)), 1)
    m = min(m, (count - 1) // 2)
    above, under = np.arange(count) + m, np.arange(count) - m
    # at the ends spacings are of fewer steps (Ebrahimi, Pflughoeft and Soofi 1994)
    steps = np.minimum(above, count - 1) - np.maximum(under, 0)
    width = even[np.minimum(above, count - 1)] - even[np.maximum(under, 0)]
    with np.errstate(divide="ignore"):
        return float(np.mean(np.log(width * count / steps)))
