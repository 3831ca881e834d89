"""A posterior held as sums: means, variances and probabilities accumulated chunk by chunk.

Memory does not grow with the number of draws. Sums are kept relative to the largest weight so far and
to a centre near each node's mean, so that neither overflows nor cancels.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc import diagnostics
from bayesmc.errors import UnsupportedError
from bayesmc.network import Model, Problem
from bayesmc.results.posterior import Posterior


class Sums:
    """Running weighted sums over chunks of draws, mergeable and of constant size.

    For each node two rows are kept, one weighted by ``w`` and one by ``w**2`` (for Monte Carlo errors):
    counts of the states of finite nodes, and powers 0, 1, 2 of the centred values of all others.
    """

    def __init__(self, model: Model, names: tuple[str, ...]) -> None:
        self.model = model
        self.names = names
        self.draws = 0
        self.top = -np.inf
        self.weight = np.zeros(2)
        self.counts: dict[str, np.ndarray] = {}
        self.powers: dict[str, np.ndarray] = {}
        self.centre: dict[str, np.ndarray] = {}
        self.tail = np.empty(0)

    def add(self, values: Mapping[str, np.ndarray], log_weight: Any, draws: int) -> None:
        """Take in one chunk of ``draws`` draws with their log weights (a scalar: all equal)."""
        log_weight = np.broadcast_to(np.asarray(log_weight, dtype=float), (draws,))
        weights = self._relative(log_weight, draws)
        self.weight += weights.sum(axis=1)
        for name in self.names:
            node = self.model[name]
            value = values[name]
            batched = value.ndim > len(node.value_shape)
            flat = value.reshape(draws, -1) if batched and value.shape[0] == draws else value.reshape(1, -1)
            if node.domain is not None:
                self._count(name, flat, node.domain.size, weights)
            else:
                self._power(name, flat.astype(float, copy=False), weights)

    def _relative(self, log_weight: np.ndarray, draws: int) -> np.ndarray:
        """Rows ``w`` and ``w**2`` relative to the largest weight so far; older sums are rescaled."""
        highest = float(log_weight.max(initial=-np.inf))
        if highest > self.top:
            scale = np.exp(np.array([1.0, 2.0]) * (self.top - highest)) if self.draws else np.ones(2)
            self.weight *= scale
            for kept in (self.counts, self.powers):
                for array in kept.values():
                    array *= scale.reshape((2,) + (1,) * (array.ndim - 1))
            self.top = highest
        self.draws += draws
        weights = np.empty((2, draws))
        top = self.top if np.isfinite(self.top) else 0.0
        np.exp(log_weight - top, out=weights[0])
        np.multiply(weights[0], weights[0], out=weights[1])
        self._keep_tail(log_weight)
        return weights

    def _keep_tail(self, log_weight: np.ndarray) -> None:
        """The largest log weights, as many as the Pareto fit may need for the draws so far."""
        if len(self.tail) and log_weight.max() == log_weight.min() == self.tail.min():
            if len(self.tail) >= 5 * diagnostics.tail_length(self.draws):
                return
        size = 5 * diagnostics.tail_length(2 * self.draws)
        merged = np.concatenate([self.tail, log_weight])
        self.tail = np.partition(merged, -size)[-size:] if len(merged) > size else merged

    def _count(self, name: str, codes: np.ndarray, size: int, weights: np.ndarray) -> None:
        table = self.counts.setdefault(name, np.zeros((2, codes.shape[1], size)))
        if codes.shape[0] == 1:
            total = weights.sum(axis=1)
            table[:, np.arange(codes.shape[1]), codes[0]] += total[:, None]
            return
        rest = weights.sum(axis=1)[:, None]
        for state in range(1, size):
            indicator = codes if size == 2 else codes == state
            mass = weights @ indicator.astype(float)
            table[:, :, state] += mass
            rest = rest - mass
        table[:, :, 0] += np.maximum(rest, 0.0)

    def _power(self, name: str, values: np.ndarray, weights: np.ndarray) -> None:
        if name not in self.centre:
            mean = weights[0] @ values / weights[0].sum() if len(values) > 1 and weights[0].any() else values.mean(0)
            self.centre[name] = np.where(np.isfinite(mean), mean, 0.0)
            self.powers[name] = np.zeros((2, 2, values.shape[1]))
        centred = values - self.centre[name]
        rows = weights if len(values) > 1 else weights.sum(axis=1, keepdims=True)
        self.powers[name][:, 0] += rows @ centred
        self.powers[name][:, 1] += rows @ (centred * centred)


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
        tail = self._sums.tail
        return diagnostics.pareto_k(tail[np.isfinite(tail)], self._sums.draws)

    def mean(self, name: str) -> np.ndarray:
        node = self._numeric(name, "mean")
        if node.domain is not None:
            return self._expected_state(name, 1)
        self._kept(name)
        first = self._sums.powers[name][0, 0] / self._sums.weight[0]
        return (self._sums.centre[name] + first).reshape(node.value_shape)

    def var(self, name: str) -> np.ndarray:
        node = self._numeric(name, "var")
        if node.domain is not None:
            numbers = np.asarray(node.domain.numbers, dtype=float)
            p = self.probabilities(name)
            return p @ numbers**2 - (p @ numbers) ** 2
        self._kept(name)
        first, second = self._sums.powers[name][0] / self._sums.weight[0]
        return np.maximum(second - first**2, 0.0).reshape(node.value_shape)

    def probabilities(self, *names: str) -> np.ndarray:
        if len(names) != 1:
            raise self._cannot("probabilities of several nodes")
        node = self._finite(names[0])
        self._kept(names[0])
        assert node.domain is not None
        table = self._sums.counts[names[0]][0] / self._sums.weight[0]
        return table.reshape((*node.plate_shape, node.domain.size))

    def mcse(self, what: Any) -> np.ndarray:
        if not isinstance(what, str):
            raise self._cannot("mcse of a function")
        node = self._node(what)
        self._kept(what)
        total = self._sums.weight[0]
        if node.domain is None:
            second = self._sums.powers[what][1]
            mean = self._sums.powers[what][0, 0] / total
            squares = second[1] - 2 * mean * second[0] + mean**2 * self._sums.weight[1]
            return (np.sqrt(np.maximum(squares, 0.0)) / total).reshape(node.value_shape)
        p = self._sums.counts[what][0] / total
        heavy = self._sums.counts[what][1]
        if node.domain.labels is not None:
            squares = heavy * (1 - p) ** 2 + (self._sums.weight[1] - heavy) * p**2
            return (np.sqrt(squares) / total).reshape((*node.plate_shape, node.domain.size))
        numbers = np.asarray(node.domain.numbers, dtype=float)
        centred = numbers - (p @ numbers)[:, None]
        return (np.sqrt((heavy * centred**2).sum(axis=-1)) / total).reshape(node.plate_shape)

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

    def _expected_state(self, name: str, power: int) -> np.ndarray:
        numbers = np.asarray(self.model[name].domain.numbers, dtype=float)  # type: ignore[union-attr]
        return self.probabilities(name) @ numbers**power

    def _quantile_columns(self, name: str) -> dict[str, np.ndarray]:
        return {}

    def _figures(self, name: str) -> dict[str, np.ndarray]:
        columns = super()._figures(name)
        return {k: v for k, v in columns.items() if not k.endswith("%")}

    def _kept(self, name: str) -> None:
        if name not in self._sums.names:
            raise UnsupportedError(f"{name!r}: inputs have no posterior")

    def _remedy(self) -> str:
        return 'call infer with keep="draws"'
