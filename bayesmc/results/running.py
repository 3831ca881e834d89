"""Running sums over chunks of weighted draws: counts, moments, angles, and the tail of the weights.

Each holds its figures twice, weighted by ``w`` and by ``w**2`` (for Monte Carlo errors), relative to a
scale that its owner changes with ``rescale``. None grows with the number of draws.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc import diagnostics


class JointCounts:
    """Scalar finite nodes counted together, in one histogram over their joint states."""

    def __init__(self, names: tuple[str, ...], cards: tuple[int, ...]) -> None:
        self.names = names
        self.cards = cards
        self.size = math.prod(cards)
        self.histogram = np.zeros((2, self.size))

    def rescale(self, scale: np.ndarray) -> None:
        """Multiply what was summed by w and by w**2 with the two entries of ``scale``."""
        self.histogram *= scale[:, None]

    def with_node(self, name: str, card: int) -> JointCounts:
        return JointCounts((*self.names, name), (*self.cards, card))

    def add(self, values: Mapping[str, np.ndarray], weights: np.ndarray) -> None:
        code: Any = values[self.names[0]].astype(np.uint16 if self.size <= 1 << 16 else np.intp)
        for name, card in zip(self.names[1:], self.cards[1:], strict=True):
            code *= card
            code += values[name]
        bins = code.astype(np.intp)
        for row, weight in zip(self.histogram, weights, strict=True):
            row += np.bincount(bins, weights=weight, minlength=self.size)

    def counts(self, name: str) -> np.ndarray:
        axis = self.names.index(name)
        joint = self.histogram.reshape((2, *self.cards))
        return joint.sum(axis=tuple(1 + k for k in range(len(self.cards)) if k != axis))


class PlateCounts:
    """Counts of the states of every element of one plated finite node."""

    def __init__(self, size: int, states: int) -> None:
        self.table = np.zeros((2, size, states))

    def rescale(self, scale: np.ndarray) -> None:
        """See ``JointCounts.rescale``."""
        self.table *= scale[:, None, None]

    def add(self, codes: np.ndarray, weights: np.ndarray) -> None:
        """Take in positions of shape ``(draws, *plates)``."""
        flat = codes.reshape(len(codes), -1)
        for state in range(self.table.shape[2]):
            self.table[:, :, state] += weights @ (flat == state).astype(float)


class Moments:
    """The first two powers of values around a centre near their mean, so that nothing cancels.

    The centre moves when heavier draws come, and the sums with it; a draw of weight zero may hold
    anything, infinity included.
    """

    def __init__(self, size: int) -> None:
        self.centre = np.zeros(size)
        self.first = np.zeros((2, size))
        self.second = np.zeros((2, size))

    def rescale(self, scale: np.ndarray) -> None:
        """See ``JointCounts.rescale``."""
        self.first *= scale[:, None]
        self.second *= scale[:, None]

    def add(self, value: np.ndarray, weights: np.ndarray) -> None:
        """Take in values of shape ``(draws, ...)``."""
        value = value.reshape(len(value), -1)
        first, second = self._sums(value, weights)
        if not np.isfinite(second).all():
            kept = np.where(weights[0][:, None] > 0, value, self.centre)
            first, second = self._sums(kept, weights)
        self.first += first
        self.second += second

    def move(self, value: np.ndarray, weight: np.ndarray, summed: np.ndarray) -> None:
        """Centre on these draws' weighted mean; ``summed`` is the weight summed so far."""
        value = value.reshape(len(value), -1)
        mean = (weight @ value) / weight.sum()
        if not np.isfinite(mean).all():
            mean = (weight @ np.where(weight[:, None] > 0, value, 0.0)) / weight.sum()
        step = np.where(np.isfinite(mean), mean, self.centre) - self.centre
        self.second += step * (step * summed[:, None] - 2 * self.first)
        self.first -= step * summed[:, None]
        self.centre = self.centre + step

    def _sums(self, value: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        centred = value - self.centre
        return weights @ centred, weights @ (centred * centred)


class ScalarMoments(Moments):
    """``Moments`` of one scalar: dot products, with what they share computed once."""

    def __init__(self) -> None:
        super().__init__(1)

    def add(self, value: np.ndarray, weights: np.ndarray) -> None:
        """Take in values of shape ``(draws,)``."""
        weight = weights[0]
        centred = value - self.centre[0]
        heavy = weight * centred
        square = heavy @ centred
        if not math.isfinite(square):
            centred = np.where(weight > 0, centred, 0.0)
            heavy = weight * centred
            square = heavy @ centred
        first, second = self.first, self.second
        first[0, 0] += weight @ centred
        first[1, 0] += weight @ heavy
        second[0, 0] += square
        second[1, 0] += heavy @ heavy


class Turns:
    """Sums of cos, sin, cos^2, cos sin, sin^2 of angles, shape ``(2, 5, angles)``.

    Parameters
    ----------
    angles : ndarray of bool
        Which of a value's numbers are angles, shape (size,).
    """

    def __init__(self, angles: np.ndarray) -> None:
        self.places = np.flatnonzero(angles)
        self._all = len(self.places) == len(angles)
        self.sums = np.zeros((2, 5, len(self.places)))

    def rescale(self, scale: np.ndarray) -> None:
        """See ``JointCounts.rescale``."""
        self.sums *= scale[:, None, None]

    def add(self, value: np.ndarray, weights: np.ndarray) -> None:
        """Take in values of shape ``(draws, ...)``."""
        value = value.reshape(len(value), -1)
        for k, figure in enumerate(turns(value if self._all else value[:, self.places])):
            self.sums[:, k] += weights @ figure


def turns(angle: np.ndarray) -> tuple[np.ndarray, ...]:
    """cos, sin, cos^2, cos sin, sin^2."""
    c, s = np.cos(angle), np.sin(angle)
    return c, s, c * c, c * s, s * s


class Tail:
    """The largest log weights, as many as the Pareto fit needs for the draws so far."""

    def __init__(self) -> None:
        self.draws = 0
        self.kept = np.empty(0)
        self._fresh: list[np.ndarray] = []
        self._count = 0
        self._floor = -np.inf

    def add(self, log_weight: np.ndarray, draws: int) -> None:
        self.draws += draws
        if log_weight.ndim == 0:
            return  # equal weights have no tail
        above = log_weight[log_weight > self._floor] if self._floor > -np.inf else log_weight
        if above.size:
            self._fresh.append(above)
            self._count += above.size
        if self._count > 4 * max(self._needed(), len(self.kept)):
            self.values()

    def values(self) -> np.ndarray:
        """The kept log weights, in no order."""
        if self._fresh:
            merged = np.concatenate([self.kept, *self._fresh])
            size = self._needed()
            self.kept = np.partition(merged, -size)[-size:] if len(merged) > size else merged
            self._fresh, self._count = [], 0
            # more draws lengthen the tail, so what falls below is dropped only with room to spare
            self._floor = float(self.kept.min()) if len(merged) > size else -np.inf
        return self.kept

    def _needed(self) -> int:
        return 5 * diagnostics.tail_length(4 * self.draws)
