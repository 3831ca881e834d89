"""Posteriors from Markov chains: draws or sums that know their chains, and where to go on from.

How a chain moves is the engines' affair; here stands what is asked of its draws. Figures for chains whose
every draw comes from the next member of an ensemble are taken over blocks of one draw per member.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from bayesmc.errors import UnsupportedError
from bayesmc.network import CompiledNode, Model, Problem
from bayesmc.results.checkpoint import Checkpoint
from bayesmc.results.draws import DrawsPosterior
from bayesmc.results.posterior import Posterior
from bayesmc.results.relabelling import ordered, symmetries
from bayesmc.results.sums import Sums, SumsPosterior

#: batch means kept per chain, once there are as many; twice as many are merged in pairs
_BATCHES = 16
#: draws that summaries take in at once
_BUFFER = 32
#: numbers that the buffers of all nodes may hold together
_BUFFER_ELEMENTS = 1 << 21
#: numbers that the batch means of one node may take; a larger node has no errors in summaries
_BATCH_ELEMENTS = 1 << 22


class _Chains(Posterior):
    """What a posterior from Markov chains tells besides."""

    #: block of nodes -> share of accepted proposals since the warmup, shape (chain,)
    acceptance: dict[str, np.ndarray]
    #: members that a chain's draws come from in turn; 1 for an ordinary chain
    ensemble_size: int
    #: sweeps before the first draw, during which the engine adapted
    warmup: int
    checkpoint: Checkpoint | None
    #: finite node -> how often the hidden numbers below each element were drawn anew with it, at the least
    #: as often as chains started, shape (*plates,); only nodes that may wait for such numbers
    renewals: Mapping[str, np.ndarray] = MappingProxyType({})
    #: a sentence where chains name components differently that the model does not tell apart
    label_switching: str | None = None

    def _describe(
        self,
        shape: tuple[int, int],
        acceptance: Mapping[str, np.ndarray],
        ensemble_size: int,
        warmup: int,
        checkpoint: Checkpoint | None,
    ) -> None:
        self._chains_and_draws = shape
        self.acceptance = dict(acceptance)
        self.ensemble_size = ensemble_size
        self.warmup = warmup
        self.checkpoint = checkpoint

    def _renewed(self, nodes: Iterable[str]) -> dict[str, np.ndarray]:
        """Renewals of some nodes, or of those that they are computed from."""
        found, todo = {}, list(nodes)
        while todo:
            name = todo.pop()
            if name in self.renewals:
                found[name] = self.renewals[name]
            elif self.model[name].kind == "deterministic":
                todo += self.model[name].parents
        return found

    def _title(self) -> str:
        chains, draws = self._chains_and_draws
        many = f"{chains} chain{'s' if chains > 1 else ''} of {draws} draws"
        title = f"{super()._title()}: {many} after {self.warmup} of warmup"
        return f"{title}\n{self.label_switching}" if self.label_switching else title

    def _reload(self) -> str:
        if self.checkpoint is None:
            return super()._reload()
        return "declare the net and call infer again (resume= this posterior adds to its draws)"

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        if self.checkpoint is not None and self.problem is not None:
            state["checkpoint"] = self.checkpoint.noted(self.problem)
        return state


class ChainsPosterior(_Chains, DrawsPosterior):
    """Draws of Markov chains, shape ``(chain, draw, *plates, *event)``.

    Parameters
    ----------
    acceptance : dict
        Block of nodes -> acceptance rate since the warmup, shape (chain,); none where all is exact.
    ensemble_size : int
        Members that a chain's draws come from in turn.
    warmup : int
    checkpoint : Checkpoint, optional
        What ``resume`` needs.

    Notes
    -----
    With an ensemble, neighbouring draws are nearly independent while those ``ensemble_size`` apart are
    not, so errors, effective sizes and R-hat are those of block means (``diagnostics.chain_statistic``).
    """

    def __init__(
        self,
        problem: Problem,
        engine: Any,
        stored: Mapping[str, np.ndarray],
        shape: tuple[int, int],
        acceptance: Mapping[str, np.ndarray] | None = None,
        ensemble_size: int = 1,
        warmup: int = 0,
        checkpoint: Checkpoint | None = None,
    ) -> None:
        super().__init__(problem, engine, stored, shape)
        self._describe(shape, acceptance or {}, ensemble_size, warmup, checkpoint)

    def relabelled(self, by: str) -> ChainsPosterior:
        """The same draws with components named by the order of a node, draw by draw.

        A model that does not tell its components apart leaves chains free to name them differently. What
        is asked of the answer here is about the component with the smallest value of ``by``, the next, and
        so on. Nodes that are computed from others are computed again, and left out where ``keep=`` left out
        what they are computed from.

        Parameters
        ----------
        by : str
            A node with one number for each component, as ``label_switching`` names it.

        Raises
        ------
        UnsupportedError
            The components are told apart by the model or its evidence, or ``by`` has no number for each.

        References
        ----------
        Stephens (2000), Dealing with label switching in mixture models, JRSS B 62, sec. 2.

        Examples
        --------
        >>> import numpy as np
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet(plates={"cluster": 2, "point": 6})
        >>> net.add("mean", bmc.Normal(0.0, 10.0), plates="cluster")
        >>> net.add("label", bmc.Bernoulli(0.5), plates="point")
        >>> net.add("x", lambda label, mean: bmc.Normal(mean[label], 1.0), plates="point")
        >>> data = {"x": [-3.2, -2.8, -3.0, 1.8, 2.2, 2.0]}
        >>> posterior = bmc.infer(net, data, engine=bmc.Gibbs(500, warmup=200), rng=0)
        >>> posterior.relabelled("mean").mean("mean").round()
        array([-3.,  2.])
        """
        self._node(by)
        problem = self._live("relabelled")
        point = None if self.checkpoint is None else self.checkpoint.values
        for found in [] if point is None else symmetries(problem, point):
            if by in found.axes and self.model[by].value_shape == (found.size,):
                twin = copy.copy(self.__dict__)
                new = object.__new__(type(self))
                new.__dict__.update(twin)
                new.__dict__.pop("_slowest", None)
                new._stored = ordered(problem, self._stored, found, by)
                new.checkpoint = new.label_switching = None
                new.renewals = {
                    n: np.full_like(count, count.min(initial=np.inf))
                    for n, count in self.renewals.items()
                }
                return new
        raise UnsupportedError(
            f"relabelled({by!r}): its elements are no components that the model could name otherwise; ask of "
            "the posterior as it is"
        )

    def _behind_still(self, what: Any, values: np.ndarray) -> Any:
        """Those of the slowest scalar that moved, or renewals, where these are fewer."""
        if isinstance(what, str) and what in self.renewals:
            count = self.renewals[what]
            shape = count.shape + (1,) * (values.ndim - 2 - count.ndim)
            return np.minimum(self._slowest, count.reshape(shape))
        fewest = self._slowest
        nodes = [what] if isinstance(what, str) else what.nodes
        for name, count in self._renewed(nodes).items():
            stored = self._of(name)
            still = (stored == stored[:1, :1]).reshape(*self._shape, *count.shape, -1)
            still = still.all(axis=(0, 1, -1))
            fewest = min(fewest, count[still].min(initial=np.inf))
        return fewest

    def _predict(self, *arguments: Any) -> DrawsPosterior:
        drawn = super()._predict(*arguments)
        assert drawn.problem is not None
        return ChainsPosterior(
            drawn.problem,
            self.engine,
            drawn._stored,
            self._shape,
            self.acceptance,
            self.ensemble_size,
            self.warmup,
        )


class ChainsSums(_Chains, SumsPosterior):
    """Means, variances and probabilities of Markov chains, summed as they went.

    Monte Carlo errors come from batch means, never below those of independent draws, and effective sizes
    from the errors; R-hat compares halves of the chains by their batch means, without ranks. They are NaN
    with fewer than four batches, and for nodes of very many numbers.

    References
    ----------
    Flegal and Jones (2010), Annals of Statistics 38(2).
    """

    def __init__(
        self,
        problem: Problem,
        engine: Any,
        running: RunningChains,
        acceptance: Mapping[str, np.ndarray],
        warmup: int,
        checkpoint: Checkpoint,
    ) -> None:
        super().__init__(problem, engine, running.total(), False)
        self._running = running
        shape = (running.chains, running.draws)
        self._describe(shape, acceptance, running.ensemble, warmup, checkpoint)

    def _error(self, what: Any) -> np.ndarray:
        independent = super()._error(what)
        series = self._batch_means(what)
        if series is None:
            return np.where(independent == 0, 0.0, np.nan)
        batches, chains = series.shape[:2]
        error = np.sqrt(series.var(axis=(0, 1), ddof=1) / (batches * chains))
        return np.maximum(error, independent)

    def _share_count(self, what: str, error: np.ndarray) -> Any:
        """Effective draws behind shares; of those that never changed, of the slowest scalar that did."""
        found = self._moved(what)
        return np.where(np.isnan(found), self._behind_still(what, found), found)

    def _behind_still(self, what: str, figures: np.ndarray) -> Any:
        """Those of the slowest scalar that moved, or renewals, where these are fewer."""
        if what in self.renewals:
            count = self.renewals[what]
            shape = count.shape + (1,) * (figures.ndim - count.ndim)
            return np.minimum(self._slowest, count.reshape(shape))
        fewest = [c.min(initial=np.inf) for c in self._renewed([what]).values()]
        return min([self._slowest, *fewest])

    def _ess(self, what: Any) -> np.ndarray:
        found = self._moved(what)
        behind = self._behind_still(what, found)
        still = np.where(np.asarray(self._step(what)) > 0, behind, self._sums.draws)
        missing = np.isnan(self._error(what))
        return np.where(np.isnan(found) & ~missing, still, found)

    def moves(self, name: str) -> np.ndarray:
        """Whether each figure of a node ever changed, as far as is known."""
        return self._error(name) != 0

    def _moved(self, what: Any) -> np.ndarray:
        """Effective draws of what ever changed; NaN for all else."""
        error, independent = self._error(what), super()._error(what)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(independent > 0, independent / error, np.nan)
        return self._sums.draws * share**2

    @cached_property
    def _slowest(self) -> float:
        """Effective draws of the scalar that moves slowest in these chains; the chains where none does."""
        names = [n for n in self._running.names if self._running.is_batched(n)]
        sizes = np.concatenate([np.zeros(0), *(self._moved(n).ravel() for n in names)])
        sizes = sizes[np.isfinite(sizes)]
        return float(sizes.min()) if sizes.size else float(self._running.chains)

    def _rhat(self, what: Any) -> np.ndarray:
        variance = self._sums.draws * super()._error(what) ** 2
        series = self._batch_means(what)
        if series is None:
            return np.full(variance.shape, np.nan)
        half = len(series) // 2
        means = np.concatenate([series[:half].mean(axis=0), series[-half:].mean(axis=0)])
        within = variance - means.var(axis=0)
        draws = self._running.draws / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = means.var(axis=0, ddof=1) / np.where(within > 1e-12 * variance, within, 0.0)
            rhat = np.sqrt((draws - 1) / draws + ratio)
        return np.where(variance > 0, rhat, np.nan)

    def _batch_means(self, name: str) -> np.ndarray | None:
        """Means of batches, shape ``(batch, chain, *figure)``, of what the node's mean errs like."""
        series = self._running.batch_means(name)
        if series is None or len(series) < 4:
            return None
        node = self._node(name)
        shape = series.shape[:2] + node.value_shape
        if node.angles is not None:
            first, sine = np.moveaxis(series, 2, 0)
            mean, turns = self.mean(name), self._sums.turns(name)[0, :2] / self._sums.weight[0]
            with np.errstate(divide="ignore", invalid="ignore"):  # where numbers are no angles
                turned = (sine * np.cos(mean) - first * np.sin(mean)) / np.hypot(*turns)
            return np.where(node.angles, turned, first)
        labelled = node.domain is not None and node.domain.labels is not None
        return series.reshape((*shape, -1) if labelled else shape)

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        return {**state, "_running": self._running.with_model(state["model"])}


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
        return copy.deepcopy(self, {id(self._sums.model): model})

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
            dtype = stored_dtype(node, values[name])
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


def stored_dtype(node: CompiledNode, values: np.ndarray) -> np.dtype:
    """The type that draws of a node are kept in: the smallest for positions of a finite one."""
    return values.dtype if node.domain is None else node.domain.dtype


# ---- private ------------------------------------------------------------------------------------


class _BatchMeans:
    """Means of equally long batches; when there are too many, neighbours are merged."""

    def __init__(self) -> None:
        self._kept: list[np.ndarray] = []
        self._length = 1
        self._sum: Any = 0.0
        self._count = 0

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
