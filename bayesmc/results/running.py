"""Running sums over chunks of weighted draws: counts, moments, angles, and the tail of the weights.

Each holds its figures twice, weighted by ``w`` and by ``w**2`` (for Monte Carlo errors), relative to a
scale that its owner changes with ``rescale``. None grows with the number of draws.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc import diagnostics
from bayesmc.network import Model

#: joint states up to which scalar finite nodes share one histogram, so that it stays in cache
_GROUP_STATES = 2048


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

    def merge(self, other: JointCounts, weight: np.ndarray) -> None:
        """Take in what another one summed, of a total ``weight`` by w and by w**2, at the same scale."""
        self.histogram += other.histogram

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

    def merge(self, other: PlateCounts, weight: np.ndarray) -> None:
        """See ``JointCounts.merge``."""
        self.table += other.table

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

    def merge(self, other: Moments, weight: np.ndarray) -> None:
        """See ``JointCounts.merge``."""
        step, weight = other.centre - self.centre, weight[:, None]
        self.first += other.first + step * weight
        self.second += other.second + step * (2 * other.first + step * weight)

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

    def merge(self, other: Turns, weight: np.ndarray) -> None:
        """See ``JointCounts.merge``."""
        self.sums += other.sums

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

    def merge(self, other: Tail) -> None:
        """Take in another's."""
        self.draws += other.draws
        kept = other.values()
        if kept.size:
            self._fresh.append(kept)
            self._count += kept.size

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


class Sums:
    """Running weighted sums over chunks of draws, of constant size.

    Scalar finite nodes are counted jointly in groups, one histogram for several nodes; plated ones
    state by state; angles by their turns, also those among a vector's numbers; all other numbers by
    the first two powers of their centred values.
    """

    def __init__(self, model: Model, names: tuple[str, ...]) -> None:
        self.model = model
        self.names = names
        self.draws = 0
        self.top = -np.inf
        self.weight = np.zeros(2)
        self.tail = Tail()
        self._groups: list[JointCounts] | None = None
        self._single: dict[str, PlateCounts | Moments] = {}
        self._turned: dict[str, Turns] = {}
        self._constant: dict[str, np.ndarray] = {}

    def add(self, values: Mapping[str, np.ndarray], log_weight: Any, draws: int) -> None:
        """Take in one chunk of ``draws`` draws with their log weights (a scalar: all equal)."""
        log_weight = np.asarray(log_weight, dtype=float)
        highest = float(log_weight.max())
        heavier = highest > self.top
        if heavier:
            self._rescale(highest)
        self.draws += draws
        self.tail.add(log_weight, draws)
        if self._groups is None:
            self._groups = self._sort(values)
        with np.errstate(all="ignore"):  # draws of weight zero may hold anything
            weights = np.empty((2, draws))
            np.exp(log_weight - (self.top if self.top > -np.inf else 0.0), out=weights[0])
            np.multiply(weights[0], weights[0], out=weights[1])
            for group in self._groups:
                group.add(values, weights)
            for name, kept in self._single.items():
                if heavier and isinstance(kept, Moments):
                    kept.move(values[name], weights[0], self.weight)
                kept.add(values[name], weights)
            for name, turned in self._turned.items():
                turned.add(values[name], weights)
        self.weight += weights[0].sum(), weights[0] @ weights[0]

    def without_model(self) -> Sums:
        """What can be saved of it: the same arrays, and no net."""
        found = copy.copy(self)
        found.model = None  # type: ignore[assignment]
        return found

    def merge(self, other: Sums) -> None:
        """Take in the sums of other draws of the same question; these are of no use afterwards."""
        if other._groups is None:
            return
        if self._groups is None:
            self.__dict__.update(other.__dict__)
            return
        if other.top > self.top:
            self._rescale(other.top)
        elif other.top < self.top:
            other._rescale(self.top)
        self.draws += other.draws
        self.tail.merge(other.tail)
        for group, theirs in zip(self._groups, other._groups, strict=True):
            group.merge(theirs, other.weight)
        for name, single in self._single.items():
            single.merge(other._single[name], other.weight)  # type: ignore[arg-type]
        for name, turned in self._turned.items():
            turned.merge(other._turned[name], other.weight)
        self.weight += other.weight

    @property
    def constant(self) -> frozenset[str]:
        """Nodes whose value was no part of the sampling."""
        return frozenset(self._constant)

    def counts(self, name: str) -> np.ndarray:
        """Weight of each state of a finite node by w and by w**2, shape ``(2, *plates, states)``."""
        node = self.model[name]
        assert node.domain is not None
        if name in self._constant:
            one_hot = np.eye(node.domain.size)[self._constant[name].astype(np.intp)]
            return self.weight.reshape((2,) + (1,) * one_hot.ndim) * one_hot
        kept = self._single.get(name)
        if isinstance(kept, PlateCounts):
            return kept.table.reshape((2, *node.plate_shape, node.domain.size))
        return next(g for g in self._groups or () if name in g.names).counts(name)

    def powers(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A centre and the sums of the first two powers around it, each ``(2, *plates, *event)``."""
        shape = self.model[name].value_shape
        if name in self._constant:
            zero = np.zeros((2, *shape))
            return self._constant[name].astype(float), zero, zero
        kept = self._single[name]
        assert isinstance(kept, Moments)
        first, second = kept.first.reshape((2, *shape)), kept.second.reshape((2, *shape))
        return kept.centre.reshape(shape), first, second

    def turns(self, name: str) -> np.ndarray:
        """Sums of cos, sin, cos^2, cos sin, sin^2 of angles, shape ``(2, 5, *plates, *event)``; zero
        where a vector's numbers are none.
        """
        shape = self.model[name].value_shape
        if name in self._constant:
            figures = np.stack(turns(self._constant[name]))
            return self.weight.reshape((2,) + (1,) * figures.ndim) * figures
        kept = self._turned[name]
        full = np.zeros((2, 5, math.prod(shape)))
        full[..., kept.places] = kept.sums
        return full.reshape((2, 5, *shape))

    def _sort(self, values: Mapping[str, np.ndarray]) -> list[JointCounts]:
        """Decide from the first chunk how each node is summed."""
        groups: list[JointCounts] = []
        for name in self.names:
            node, value = self.model[name], values[name]
            size = math.prod(node.value_shape)
            if value.ndim == len(node.value_shape):
                self._constant[name] = value
            elif node.domain is None:
                angles = node.angles
                if angles is None or not angles.all():
                    self._single[name] = Moments(size) if node.value_shape else ScalarMoments()
                if angles is not None:
                    self._turned[name] = Turns(np.broadcast_to(angles, node.value_shape).ravel())
            elif node.plates:
                self._single[name] = PlateCounts(size, node.domain.size)
            elif groups and groups[-1].size * node.domain.size <= _GROUP_STATES:
                groups[-1] = groups[-1].with_node(name, node.domain.size)
            else:
                groups.append(JointCounts((name,), (node.domain.size,)))
        return groups

    def _rescale(self, highest: float) -> None:
        """Take ``highest`` as the log weight that counts as one."""
        if self.weight[0]:
            scale = np.exp(np.array([1.0, 2.0]) * (self.top - highest))
            self.weight *= scale
            for kept in [*(self._groups or ()), *self._single.values(), *self._turned.values()]:
                kept.rescale(scale)
        self.top = highest
