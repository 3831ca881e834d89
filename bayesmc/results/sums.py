"""A posterior held as sums: means, variances and probabilities accumulated chunk by chunk.

Memory does not grow with the number of draws. Sums are kept relative to the largest weight so far and
to a centre near each node's mean, so that neither overflows nor cancels.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bayesmc import diagnostics
from bayesmc.errors import UnsupportedError
from bayesmc.network import CompiledNode, Model, Problem
from bayesmc.results.posterior import Posterior, circular_variance, table_variance
from bayesmc.results.running import (
    JointCounts,
    Moments,
    PlateCounts,
    ScalarMoments,
    Tail,
    Turns,
    turns,
)
from bayesmc.results.shares import steps

#: share of a variance that is rounding
_NONE = 1e-20
#: joint states up to which scalar finite nodes share one histogram, so that it stays in cache
_GROUP_STATES = 2048


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
        return _by_kind(node, lambda: self._plain_mean(name), lambda: self._direction(name))

    def var(self, name: str) -> np.ndarray:
        node = self._numeric(name, "var")
        if node.domain is not None:
            numbers = np.asarray(node.domain.numbers, dtype=float)
            return table_variance(self.probabilities(name), numbers)
        self._kept(name)
        return _by_kind(node, lambda: self._plain_var(name), lambda: self._spread(name))

    def probabilities(self, *names: str) -> np.ndarray:
        if len(names) != 1:
            raise self._cannot("probabilities of several nodes")
        self._finite(names[0])
        self._kept(names[0])
        return self._sums.counts(names[0])[0] / self._sums.weight[0]

    def _mcse(self, what: Any) -> np.ndarray:
        error = self._error(what)
        return diagnostics.share_mcse(error, self._share_count(what, error), self._step(what))

    def _error(self, what: Any) -> np.ndarray:
        """Standard error of independent draws, as they show it."""
        if not isinstance(what, str):
            raise self._cannot("mcse of a function")
        node = self._node(what)
        self._kept(what)
        if node.domain is None:
            return _by_kind(node, lambda: self._plain_error(what), lambda: self._turn_error(what))
        total, squares = self._sums.weight
        counts, heavy = self._sums.counts(what)
        p = counts / total
        if node.domain.labels is not None:
            rest = np.maximum(squares - heavy, 0.0)  # a rounding below zero otherwise
            return np.sqrt(heavy * (1 - p) ** 2 + rest * p**2) / total
        numbers = np.asarray(node.domain.numbers, dtype=float)
        centred = numbers - (p @ numbers)[..., None]
        return np.sqrt((heavy * centred**2).sum(axis=-1)) / total

    def _share_count(self, what: str, error: np.ndarray) -> Any:
        """Effective draws behind shares (`shares`)."""
        node, (total, squares) = self._node(what), self._sums.weight
        if node.domain is None:  # weights are in units of the heaviest
            return np.where(error**2 <= _NONE * squares / total**2, total, total**2 / squares)
        share, heavy = self._sums.counts(what)
        others = 1.0 - np.eye(
            node.domain.size
        )  # summed: what is left of a difference may be rounding
        rest, light = share @ others, heavy @ others
        flipped = share > rest
        mine, own = (
            np.where(flipped, rest, share) / total,
            np.where(flipped, light, heavy) / total**2,
        )
        found = diagnostics.weighted_share_count(mine, own, 1.0 / total)
        if node.domain.labels is not None:
            return found
        several = (share > 0).sum(axis=-1) > 2
        smallest = np.where(share > 0, found, -np.inf).max(axis=-1)
        return np.where(several, total**2 / squares, smallest)

    def _step(self, what: str) -> Any:
        exact = what in self._sums.constant
        return steps(self._node(what), self._seen.get(what), exact)

    def _ess(self, what: Any) -> np.ndarray:
        if not isinstance(what, str):
            raise self._cannot("ess of a function")
        node = self._node(what)
        labelled = node.domain is not None and node.domain.labels is not None
        p = self.probabilities(what) if labelled else None
        variance = p * (1 - p) if p is not None else self.var(what)
        error = self._error(what) ** 2
        total, squares = self._sums.weight
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(error > 0, variance / error, total**2 / squares)

    def _rhat(self, what: Any) -> np.ndarray:
        return np.full(np.shape(self._error(what)), np.nan)

    def _plain_mean(self, name: str) -> np.ndarray:
        centre, first, _ = self._sums.powers(name)
        return centre + first[0] / self._sums.weight[0]

    def _direction(self, name: str) -> np.ndarray:
        cosine, sine = self._sums.turns(name)[0, :2]
        return np.arctan2(sine, cosine)

    def _plain_var(self, name: str) -> np.ndarray:
        _, first, second = self._sums.powers(name)
        total = self._sums.weight[0]
        return np.maximum(second[0] / total - (first[0] / total) ** 2, 0.0)

    def _spread(self, name: str) -> np.ndarray:
        return circular_variance(*(self._sums.turns(name)[0, :2] / self._sums.weight[0]))

    def _plain_error(self, name: str) -> np.ndarray:
        total, squares = self._sums.weight
        _, first, second = self._sums.powers(name)
        mean = first[0] / total
        spread = second[1] - 2 * mean * first[1] + mean**2 * squares
        return np.sqrt(np.maximum(spread, 0.0)) / total

    def _turn_error(self, name: str) -> np.ndarray:
        """Error of the mean direction to first order (delta method)."""
        turns, mean = self._sums.turns(name), self._direction(name)
        c, s = np.cos(mean), np.sin(mean)
        spread = turns[1, 4] * c * c - 2 * turns[1, 3] * c * s + turns[1, 2] * s * s
        length = np.hypot(turns[0, 0], turns[0, 1])
        with np.errstate(divide="ignore", invalid="ignore"):  # numbers that are no angles have none
            return np.sqrt(np.maximum(spread, 0.0)) / length

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


# ---- private ------------------------------------------------------------------------------------


def _by_kind(
    node: CompiledNode, plain: Callable[[], np.ndarray], turned: Callable[[], np.ndarray]
) -> np.ndarray:
    """Figures of a node of numbers: ``turned`` ones of its angles, ``plain`` ones of the others."""
    if node.angles is None:
        return plain()
    return turned() if node.angles.all() else np.where(node.angles, turned(), plain())
