"""A posterior held as sums: means, variances and probabilities accumulated chunk by chunk.

Memory does not grow with the number of draws. Sums are kept relative to the largest weight so far and
to a centre near each node's mean, so that neither overflows nor cancels.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc import diagnostics
from bayesmc.errors import UnsupportedError
from bayesmc.network import Model, Problem
from bayesmc.results.posterior import Posterior, circular_variance, table_variance

#: joint states up to which scalar finite nodes share one histogram, so that it stays in cache
_GROUP_STATES = 2048


class Sums:
    """Running weighted sums over chunks of draws, of constant size.

    Every figure is kept twice, weighted by ``w`` and by ``w**2`` (for Monte Carlo errors). Scalar finite
    nodes are counted jointly in groups, one histogram for several nodes; plated ones state by state;
    all others by the first two powers of their centred values.
    """

    def __init__(self, model: Model, names: tuple[str, ...]) -> None:
        self.model = model
        self.names = names
        self.draws = 0
        self.top = -np.inf
        self.weight = np.zeros(2)
        self._summed = np.zeros(2)
        self.tail = _Tail()
        self._groups: list[_Group] | None = None
        self._states: dict[str, np.ndarray] = {}
        self._powers: dict[str, np.ndarray] = {}
        self._centre: dict[str, np.ndarray] = {}
        self._turns: dict[str, np.ndarray] = {}
        self._constant: dict[str, np.ndarray] = {}

    def add(self, values: Mapping[str, np.ndarray], log_weight: Any, draws: int) -> None:
        """Take in one chunk of ``draws`` draws with their log weights (a scalar: all equal)."""
        with np.errstate(all="ignore"):  # draws of weight zero may hold anything
            self._add(values, log_weight, draws)

    def _add(self, values: Mapping[str, np.ndarray], log_weight: Any, draws: int) -> None:
        before = self.top
        weights = self._relative(np.asarray(log_weight, dtype=float), draws)
        if self._groups is None:
            self._groups = self._sort(values)
        for group in self._groups:
            group.add(values, weights)
        for name in self._states:
            self._add_states(name, values[name], weights)
        for name in self._centre:
            value = values[name].reshape(draws, -1)
            if self.top > before:  # heavier draws than any before: they say best where the mean is
                self._move_centre(name, value, weights[0])
            self._add_powers(name, value, weights)
        for name, sums in self._turns.items():
            angle = values[name].reshape(len(values[name]), -1)
            c, s = np.cos(angle), np.sin(angle)
            for k, figure in enumerate((c, s, c * c, c * s, s * s)):
                sums[:, k] += weights @ figure

    def counts(self, name: str) -> np.ndarray:
        """Weight of each state of a finite node by w and by w**2, shape ``(2, *plates, states)``."""
        node = self.model[name]
        assert node.domain is not None
        if name in self._constant:
            one_hot = np.eye(node.domain.size)[self._constant[name].astype(np.intp)]
            return self.weight.reshape((2,) + (1,) * one_hot.ndim) * one_hot
        if name in self._states:
            return self._states[name].reshape((2, *node.plate_shape, node.domain.size))
        return next(g for g in self._groups or () if name in g.names).counts(name)

    def powers(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A centre and the sums of the first two powers around it, each ``(2, *plates, *event)``."""
        shape = self.model[name].value_shape
        if name in self._constant:
            zero = np.zeros((2, *shape))
            return self._constant[name].astype(float), zero, zero
        first, second = self._powers[name].reshape((2, 2, *shape))
        return self._centre[name].reshape(shape), first, second

    def turns(self, name: str) -> np.ndarray:
        """Sums of cos, sin, cos^2, cos sin, sin^2 of an angle, shape ``(2, 5, *plates, *event)``."""
        shape = self.model[name].value_shape
        if name in self._constant:
            c, s = np.cos(self._constant[name]), np.sin(self._constant[name])
            figures = np.stack([c, s, c * c, c * s, s * s])
            return self.weight.reshape((2,) + (1,) * figures.ndim) * figures
        return self._turns[name].reshape((2, 5, *shape))

    def _sort(self, values: Mapping[str, np.ndarray]) -> list[_Group]:
        """Decide from the first chunk how each node is summed."""
        groups: list[_Group] = []
        for name in self.names:
            node, value = self.model[name], values[name]
            size = math.prod(node.value_shape)
            if value.ndim == len(node.value_shape):
                self._constant[name] = value
            elif node.domain is None and node.support is not None and node.support.kind == "circle":
                self._turns[name] = np.zeros((2, 5, size))
            elif node.domain is None:
                self._centre[name] = np.zeros(size)
                self._powers[name] = np.zeros((2, 2, size))
            elif node.plates:
                self._states[name] = np.zeros((2, size, node.domain.size))
            elif groups and groups[-1].size * node.domain.size <= _GROUP_STATES:
                groups[-1] = groups[-1].with_node(name, node.domain.size)
            else:
                groups.append(_Group((name,), (node.domain.size,)))
        return groups

    def _relative(self, log_weight: np.ndarray, draws: int) -> np.ndarray:
        """Rows ``w`` and ``w**2`` relative to the largest weight so far; older sums are rescaled."""
        highest = float(log_weight.max())
        if highest > self.top:
            if self.weight[0]:
                self._rescale(np.exp(np.array([1.0, 2.0]) * (self.top - highest)))
            self.top = highest
        self.draws += draws
        self.tail.add(log_weight, draws)
        weights = np.empty((2, draws))
        np.exp(log_weight - (self.top if self.top > -np.inf else 0.0), out=weights[0])
        np.multiply(weights[0], weights[0], out=weights[1])
        self._summed = self.weight.copy()
        self.weight += weights[0].sum(), weights[0] @ weights[0]
        return weights

    def _rescale(self, scale: np.ndarray) -> None:
        self.weight *= scale
        for group in self._groups or ():
            group.histogram *= scale[:, None]
        for array in self._states.values():
            array *= scale[:, None, None]
        for array in self._powers.values():
            array *= scale[None, :, None]
        for array in self._turns.values():
            array *= scale[:, None, None]

    def _add_states(self, name: str, codes: np.ndarray, weights: np.ndarray) -> None:
        table = self._states[name]
        flat = codes.reshape(len(codes), -1)
        for state in range(table.shape[2]):
            table[:, :, state] += weights @ (flat == state).astype(float)

    def _add_powers(self, name: str, value: np.ndarray, weights: np.ndarray) -> None:
        first, second = self._powers[name]
        rows, squares = self._centred_sums(name, value, weights)
        if not np.isfinite(squares).all():  # a draw of weight zero may be infinite
            kept = np.where(weights[0][:, None] > 0, value, self._centre[name])
            rows, squares = self._centred_sums(name, kept, weights)
        first += rows
        second += squares

    def _centred_sums(
        self, name: str, value: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Sums of the centred values and of their squares, each by w and by w**2, ``(2, size)``."""
        if value.shape[1] == 1:  # a scalar: dot products, with what they share computed once
            weight = weights[0]
            centred = value[:, 0] - self._centre[name]
            heavy = weight * centred
            rows = np.array([[weight @ centred], [weight @ heavy]])
            return rows, np.array([[heavy @ centred], [heavy @ heavy]])
        centred = value - self._centre[name]
        return weights @ centred, weights @ (centred * centred)

    def _move_centre(self, name: str, value: np.ndarray, weight: np.ndarray) -> None:
        """Take the chunk's weighted mean as the centre, and the sums so far along with it."""
        alive = weight > 0
        mean = (weight[alive] @ value[alive]) / weight[alive].sum()
        mean = np.where(np.isfinite(mean), mean, self._centre[name])
        step = mean - self._centre[name]
        first, second = self._powers[name]
        # the chunk's own weight is not in these sums yet
        total = self._summed[:, None]
        second += step * (step * total - 2 * first)
        first -= step * total
        self._centre[name] = mean


class _Group:
    """Scalar finite nodes counted together, in one histogram over their joint states."""

    def __init__(self, names: tuple[str, ...], cards: tuple[int, ...]) -> None:
        self.names = names
        self.cards = cards
        self.size = math.prod(cards)
        self.histogram = np.zeros((2, self.size))

    def with_node(self, name: str, card: int) -> _Group:
        return _Group((*self.names, name), (*self.cards, card))

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


class _Tail:
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


class SumsPosterior(Posterior):
    """Means, variances and probabilities only; anything else needs ``keep="draws"``."""

    def __init__(self, problem: Problem, engine: Any, sums: Sums, weighted: bool) -> None:
        super().__init__(problem, engine)
        self._sums = sums
        self._weighted = weighted
        if weighted:
            total, squares = sums.weight
            self.weight_ess = float(total**2 / squares)

    @property
    def pareto_k(self) -> float | None:  # type: ignore[override]
        """Tail shape of the weights; None where uniform."""
        if not self._weighted:
            return None
        tail = self._sums.tail.values()
        return diagnostics.pareto_k(tail[np.isfinite(tail)], self._sums.draws)

    def mean(self, name: str) -> np.ndarray:
        node = self._numeric(name, "mean")
        if node.domain is not None:
            return self.probabilities(name) @ np.asarray(node.domain.numbers, dtype=float)
        self._kept(name)
        if self._is_circular(name):
            cosine, sine = self._sums.turns(name)[0, :2]
            return np.arctan2(sine, cosine)
        centre, first, _ = self._sums.powers(name)
        return centre + first[0] / self._sums.weight[0]

    def var(self, name: str) -> np.ndarray:
        node = self._numeric(name, "var")
        if node.domain is not None:
            numbers = np.asarray(node.domain.numbers, dtype=float)
            return table_variance(self.probabilities(name), numbers)
        self._kept(name)
        if self._is_circular(name):
            return circular_variance(*(self._sums.turns(name)[0, :2] / self._sums.weight[0]))
        _, first, second = self._sums.powers(name)
        total = self._sums.weight[0]
        return np.maximum(second[0] / total - (first[0] / total) ** 2, 0.0)

    def probabilities(self, *names: str) -> np.ndarray:
        if len(names) != 1:
            raise self._cannot("probabilities of several nodes")
        self._finite(names[0])
        self._kept(names[0])
        return self._sums.counts(names[0])[0] / self._sums.weight[0]

    def mcse(self, what: Any) -> np.ndarray:
        if not isinstance(what, str):
            raise self._cannot("mcse of a function")
        node = self._node(what)
        self._kept(what)
        total, squares = self._sums.weight
        if self._is_circular(what):
            turns, mean = self._sums.turns(what), self.mean(what)
            c, s = np.cos(mean), np.sin(mean)
            spread = turns[1, 4] * c * c - 2 * turns[1, 3] * c * s + turns[1, 2] * s * s
            return np.sqrt(np.maximum(spread, 0.0)) / np.hypot(turns[0, 0], turns[0, 1])
        if node.domain is None:
            _, first, second = self._sums.powers(what)
            mean = first[0] / total
            spread = second[1] - 2 * mean * first[1] + mean**2 * squares
            return np.sqrt(np.maximum(spread, 0.0)) / total
        counts, heavy = self._sums.counts(what)
        p = counts / total
        if node.domain.labels is not None:
            rest = np.maximum(squares - heavy, 0.0)  # a rounding below zero otherwise
            return np.sqrt(heavy * (1 - p) ** 2 + rest * p**2) / total
        numbers = np.asarray(node.domain.numbers, dtype=float)
        centred = numbers - (p @ numbers)[..., None]
        return np.sqrt((heavy * centred**2).sum(axis=-1)) / total

    def ess(self, what: Any) -> np.ndarray:
        if not isinstance(what, str):
            raise self._cannot("ess of a function")
        node = self._node(what)
        labelled = node.domain is not None and node.domain.labels is not None
        p = self.probabilities(what) if labelled else None
        variance = p * (1 - p) if p is not None else self.var(what)
        error = self.mcse(what) ** 2
        total, squares = self._sums.weight
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(error > 0, variance / error, total**2 / squares)

    def rhat(self, what: Any) -> np.ndarray:
        return np.full(np.shape(self.mcse(what)), np.nan)

    def _quantile_columns(self, name: str) -> dict[str, np.ndarray]:
        return {}

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        sums = copy.copy(self._sums)
        sums.model = state["model"]
        return {**state, "_sums": sums}

    def _figures(self, name: str) -> dict[str, np.ndarray]:
        columns = super()._figures(name)
        return {k: v for k, v in columns.items() if not k.endswith("%")}

    def _kept(self, name: str) -> None:
        if name not in self._sums.names:
            raise UnsupportedError(f"{name!r}: inputs have no posterior")

    def _remedy(self) -> str:
        return 'call infer with keep="draws"'
