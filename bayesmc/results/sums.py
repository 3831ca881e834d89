"""A posterior held as sums: means, variances and probabilities accumulated chunk by chunk.

Memory does not grow with the number of draws. Sums are kept relative to the largest weight so far and
to a centre near each node's mean, so that neither overflows nor cancels.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc import diagnostics
from bayesmc.errors import UnsupportedError
from bayesmc.network import CompiledNode, Model, Problem
from bayesmc.results.posterior import Posterior, quantile_levels
from bayesmc.results.running import Sums
from bayesmc.results.shares import steps, weighted_share_count
from bayesmc.results.statistics import circular_variance, table_quantile, table_variance

#: share of a variance that is rounding
_NONE = 1e-20
#: batch means kept per chain, once there are as many; twice as many are merged in pairs
_BATCHES = 16
#: draws that summaries take in at once
_BUFFER = 32
#: numbers that the buffers of all nodes may hold together
_BUFFER_ELEMENTS = 1 << 21
#: numbers that the batch means of one node may take; a larger node has no errors in summaries
_BATCH_ELEMENTS = 1 << 22


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

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Of finite nodes, whose probabilities are summed; numbers are summed by their moments alone."""
        node = self._numeric(name, "quantile")
        levels = quantile_levels(name, q)
        if node.domain is None:
            raise self._cannot("quantile")
        return table_quantile(self.probabilities(name), np.asarray(node.domain.numbers), levels)

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
        found = weighted_share_count(mine, own, 1.0 / total)
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

    def bind(self, problem: Problem) -> None:
        super().bind(problem)
        self._sums.model = problem.model

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


class RunningChains:
    """Sums and batch means of chains, of constant size.

    Draws are taken in by the buffer, and a buffer always holds the same number of them, so that what is
    summed does not depend on where a run was cut.

    Parameters
    ----------
    model : Model
    names : tuple of str
    chains, ensemble : int
    """

    def __init__(self, model: Model, names: tuple[str, ...], chains: int, ensemble: int) -> None:
        self.chains = chains
        self.ensemble = ensemble
        self.draws = 0
        self._sums = Sums(model, names)
        self._pending = 0
        self._buffers: dict[str, np.ndarray] = {}
        self._constant: dict[str, np.ndarray] = {}
        self._means: dict[str, _BatchMeans] = {}

    @staticmethod
    def joined(parts: Sequence[RunningChains]) -> RunningChains:
        """The chains of several runs of the same length as those of one."""
        one = parts[0]
        if len({(part.draws, part.chains) for part in parts}) > 1:
            raise UnsupportedError(
                'infer: keep="summaries" cannot put groups of chains of unlike lengths together, as Ctrl-C '
                'leaves them; keep="draws" can'
            )
        found = copy.copy(one)
        found.chains = sum(part.chains for part in parts)
        found._sums = Sums(one._sums.model, one.names)
        for part in parts:
            found._sums.merge(copy.deepcopy(part._sums, {id(one._sums.model): one._sums.model}))
        buffers = {n: np.concatenate([p._buffers[n] for p in parts], 1) for n in one._buffers}
        means = {n: _BatchMeans.joined([p._means[n] for p in parts]) for n in one._means}
        found._buffers, found._means = buffers, means
        return found

    @property
    def names(self) -> tuple[str, ...]:
        return self._sums.names

    def add(self, values: Mapping[str, np.ndarray]) -> None:
        """Take in one draw of every chain, ``(chain, *plates, *event)``, or without chains if constant."""
        if not self.draws:
            self._prepare(values)
        at = self._pending
        for name, buffer in self._buffers.items():
            buffer[at] = values[name]
        self.draws += 1
        self._pending += 1
        if self._pending == self._size:
            self._empty()

    def total(self) -> Sums:
        """The sums over all draws so far, for reading only."""
        if not self._pending:
            return self._sums
        model = self._sums.model
        sums = copy.deepcopy(self._sums, {id(model): model})
        self._add_to(sums)
        return sums

    def is_batched(self, name: str) -> bool:
        """Whether batch means are kept: not of constants, nor of nodes of very many numbers."""
        return name in self._means

    def batch_means(self, name: str) -> np.ndarray | None:
        """Means of equal batches, shape ``(batch, chain, figures...)``; None where there are none."""
        means = self._means.get(name)
        return None if means is None else means.values

    def with_model(self, model: Model) -> RunningChains:
        """The same for another compilation of the same net, independent of this one."""
        held = self._sums.model
        found = copy.deepcopy(self, {} if held is None else {id(held): model})
        found._sums.model = model
        return found

    def without_model(self) -> RunningChains:
        """What can be saved of it: the same arrays, and no net."""
        found = copy.copy(self)
        found._sums = self._sums.without_model()
        return found

    def _prepare(self, values: Mapping[str, np.ndarray]) -> None:
        """Decide from the first draw what is constant, and how many draws make a buffer."""
        moving = {}
        for name in self.names:
            node = self._sums.model[name]
            if values[name].ndim == len(node.value_shape):
                self._constant[name] = np.array(values[name])
            else:
                moving[name] = node
        numbers = self.chains * sum(math.prod(node.value_shape) for node in moving.values())
        draws = min(_BUFFER, max(1, _BUFFER_ELEMENTS // max(numbers, 1)))
        self._size = self.ensemble * max(1, draws // self.ensemble)
        for name, node in moving.items():
            dtype = node.stored_dtype(values[name])
            shape = (self._size, self.chains, *node.value_shape)
            self._buffers[name] = np.empty(shape, dtype=dtype)
            width = math.prod(_figures(node, values[name][None]).shape[2:])
            if 2 * _BATCHES * self.chains * width <= _BATCH_ELEMENTS:
                self._means[name] = _BatchMeans()

    def _empty(self) -> None:
        self._add_to(self._sums)
        for name, means in self._means.items():
            means.add(_figures(self._sums.model[name], self._buffers[name]).mean(axis=0))
        self._pending = 0

    def _add_to(self, sums: Sums) -> None:
        count = self._pending * self.chains
        values = {
            n: b[: self._pending].reshape(count, *b.shape[2:]) for n, b in self._buffers.items()
        }
        sums.add({**self._constant, **values}, 0.0, count)


# ---- private ------------------------------------------------------------------------------------


def _by_kind(
    node: CompiledNode, plain: Callable[[], np.ndarray], turned: Callable[[], np.ndarray]
) -> np.ndarray:
    """Figures of a node of numbers: ``turned`` ones of its angles, ``plain`` ones of the others."""
    if node.angles is None:
        return plain()
    return turned() if node.angles.all() else np.where(node.angles, turned(), plain())


class _BatchMeans:
    """Means of equally long batches; when there are too many, neighbours are merged."""

    def __init__(self) -> None:
        self._kept: list[np.ndarray] = []
        self._length = 1
        self._sum: Any = 0.0
        self._count = 0

    @staticmethod
    def joined(parts: Sequence[_BatchMeans]) -> _BatchMeans:
        """Those of other chains beside them."""
        found = copy.copy(parts[0])
        each = zip(*(part._kept for part in parts), strict=True)
        found._kept = [np.concatenate(means) for means in each]
        if found._count:
            found._sum = np.concatenate([part._sum for part in parts])
        return found

    def add(self, mean: np.ndarray) -> None:
        """Take in the mean of one more buffer, shape ``(chain, ...)``."""
        self._sum = self._sum + mean
        self._count += 1
        if self._count < self._length:
            return
        self._kept.append(self._sum / self._length)
        self._sum, self._count = 0.0, 0
        if len(self._kept) == 2 * _BATCHES:
            pairs = zip(self._kept[::2], self._kept[1::2], strict=True)
            self._kept = [(a + b) / 2 for a, b in pairs]
            self._length *= 2

    @property
    def values(self) -> np.ndarray | None:
        return np.stack(self._kept) if self._kept else None


def _figures(node: CompiledNode, draws: np.ndarray) -> np.ndarray:
    """What the answers about a node are means of, shape ``(draw, chain, ...)``.

    With angles there are two: cosines and sines, for numbers that are none themselves and zero.
    """
    if node.domain is None:
        if node.angles is None:
            return draws
        cosine, sine = np.cos(draws), np.sin(draws)
        pair = np.where(node.angles, cosine, draws), np.where(node.angles, sine, 0.0)
        return np.stack(pair, axis=2)
    if node.domain.labels is None:
        return np.take(np.asarray(node.domain.numbers, dtype=float), draws)
    return (draws[..., None] == np.arange(node.domain.size)).astype(float)
