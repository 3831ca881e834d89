"""A posterior held as draws, weighted or not, shape ``(chain, draw, *plates, *event)``.

Weights are never dropped: every query here is weighted where the draws are. Predictive draws rerun the
net's own forward pass from the posterior draws.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc import diagnostics
from bayesmc.distributions import marking_invalid
from bayesmc.errors import UnknownNodeError, UnsupportedError
from bayesmc.network import BayesNet, Problem, forward, read_inputs
from bayesmc.network.evidence import brought_sizes
from bayesmc.randomness import Purpose, seed_sequence, stream
from bayesmc.resampling import systematic
from bayesmc.results.assessed import AssessedByDraws
from bayesmc.results.datatree import datatree
from bayesmc.results.laws import DrawnLaws, Laws
from bayesmc.results.marginal import Marginal, ends_of
from bayesmc.results.over_time import expanded
from bayesmc.results.posterior import Posterior, quantile_levels, whole_draws
from bayesmc.results.query import Query
from bayesmc.results.shares import chain_count, is_share, slowest, steps, weighted_count
from bayesmc.results.statistics import circular_variance, near


class DrawsPosterior(AssessedByDraws, Posterior):
    """Queries answered from draws.

    Parameters
    ----------
    stored : dict
        Node -> stored values, leading axes (chain, draw), either of which may have size 1 for constants.
    log_weights : ndarray, shape (chain, draw), optional
    independent : bool
        Draws are independent of each other (no chain to diagnose).
    ancestors : ndarray of int, shape (draw,), optional
        Which weighted draw each was resampled from; copies of one draw count once in errors.
    streams : int
        Random streams used so far, so that ``resume`` takes fresh ones.
    """

    #: members that a chain's draws come from in turn; 1 for an ordinary chain
    ensemble_size: int = 1
    superchains: int = 0
    #: log densities at the first draws when they were made, so that ``resume`` notices other functions
    densities: Mapping[str, float] | None = None

    def __init__(
        self,
        problem: Problem,
        engine: Any,
        stored: Mapping[str, np.ndarray],
        shape: tuple[int, int],
        log_weights: np.ndarray | None = None,
        independent: bool = False,
        ancestors: np.ndarray | None = None,
        streams: int = 0,
    ) -> None:
        super().__init__(problem, engine)
        self._stored = dict(stored)
        self._shape = shape
        self.independent = independent
        self.ancestors = ancestors
        self.streams = streams
        self._inputs = dict(problem.inputs)
        self.log_weights = log_weights
        if log_weights is not None:
            self.weights = diagnostics.normalised(log_weights)
            self.weights.flags.writeable = False
            self.weight_ess = diagnostics.weight_ess(log_weights)

    @property
    def names(self) -> tuple[str, ...]:
        """Nodes that can be asked about: those that were kept."""
        return tuple(n for n in super().names if n in self._stored)

    @property
    def pareto_k(self) -> float | None:  # type: ignore[override]
        """Tail shape of the weights (above 0.7 they cannot be trusted); None where uniform."""
        if self.log_weights is None:
            return None
        flat = self.log_weights.ravel()
        return diagnostics.pareto_k(flat[np.isfinite(flat)], flat.size)

    def __getitem__(self, name: str) -> np.ndarray:
        node = self._node(name)
        values = np.broadcast_to(self._of(name), self._shape + node.value_shape)
        return node.decode(values).copy()

    # ---- moments -----------------------------------------------------------------------------

    def mean(self, name: str) -> np.ndarray:
        values = self._values(name, "mean")
        angles = self.model.nodes[name].angles
        if angles is None:
            return self._average(values)
        turned = np.arctan2(self._average(np.sin(values)), self._average(np.cos(values)))
        return np.where(angles, turned, self._average(values))

    def var(self, name: str) -> np.ndarray:
        values = self._values(name, "var")
        with np.errstate(over="ignore", invalid="ignore"):  # a draw of weight zero may be infinite
            spread = self._average((values - self._average(values)) ** 2)
        angles = self.model.nodes[name].angles
        if angles is None:
            return spread
        turned = circular_variance(self._average(np.cos(values)), self._average(np.sin(values)))
        return np.where(angles, turned, spread)

    def cov(self, *names: str) -> np.ndarray:
        """Covariance matrix of all scalars of the named nodes, in order; of one scalar, its variance.

        Angles count by how far they lie from their circular mean, the short way round. ``var`` says
        ``-2 log R`` of them, about as much where they are concentrated.
        """
        if not names:
            raise UnknownNodeError("cov(): name at least one node")
        every = expanded(self.model, names)
        blocks = [self._uncut(name, "cov").reshape(*self._shape, -1) for name in every]
        flat = np.concatenate(blocks, axis=-1)
        flat = (flat - self._average(flat)).reshape(-1, flat.shape[-1])
        matrix = (flat * self._flat_weights()[:, None]).T @ flat
        return matrix[0, 0] if matrix.size == 1 else matrix

    def quantile(self, name: str, q: Any) -> np.ndarray:
        values = self._uncut(name, "quantile")
        flat = values.reshape((math.prod(self._shape), *values.shape[2:]))
        levels = quantile_levels(name, q)
        weights = None if self.weights is None else self.weights.ravel()
        # between two states lies no value, and none is known between weighted draws
        stays = weights is not None or self.model[name].is_discrete
        method: Any = "inverted_cdf" if stays else "linear"
        return _quantiles(flat, levels, weights, method)

    def probabilities(self, *names: str) -> np.ndarray:
        if not names:
            raise UnknownNodeError("probabilities(): name at least one node")
        nodes = [self._finite(name) for name in names]
        plates = tuple(dict.fromkeys(p for node in nodes for p in node.plates))
        sizes = tuple(self.model.sizes[p] for p in plates)
        code: Any = 0
        for name, node in zip(names, nodes, strict=True):
            assert node.domain is not None
            order = [node.plates.index(p) for p in plates if p in node.plates]
            values = self._of(name).transpose(0, 1, *(2 + i for i in order))
            shape = [self.model.sizes[p] if p in node.plates else 1 for p in plates]
            code = code * node.domain.size + values.reshape(values.shape[:2] + tuple(shape)).astype(
                np.intp
            )
        cards = tuple(node.domain.size for node in nodes if node.domain is not None)
        total = math.prod(cards)
        flat = np.broadcast_to(code, self._shape + sizes).reshape(math.prod(self._shape), -1)
        weights = None if self.weights is None else self.weights.ravel()
        rows = [np.bincount(column, weights=weights, minlength=total) for column in flat.T]
        table = np.reshape(rows, (len(rows), total)).astype(float)
        if weights is None:
            table /= len(flat)
        return table.reshape(sizes + cards)

    def _laws(self, name: str) -> Laws:
        node = self._node(name)
        if node.domain is not None and not node.event_shape:
            return super()._laws(name)
        values = self._uncut(name, "hdi, mode, cdf and entropy")
        flat = values.reshape((math.prod(self._shape), *values.shape[2:]))
        weights = None if self.weights is None else self.weights.ravel()
        return DrawnLaws(flat, weights, node.is_discrete)

    # ---- functions ---------------------------------------------------------------------------

    def _averaged(self, query: Query) -> np.ndarray:
        return self._average(self._evaluate(query))

    def _mcse(self, what: str | Query) -> np.ndarray:
        values, step = self._scalars_and_step(what)
        count = self._share_count(values, step, what)
        return diagnostics.share_mcse(self._error(values), count, step)

    def _ess(self, what: str | Query) -> np.ndarray:
        values, step = self._scalars_and_step(what)
        if self.ancestors is not None:
            return diagnostics.weighted_ess(*self._distinct(values))
        if self.weights is not None:
            return diagnostics.weighted_ess(values, self.weights)
        if self.independent:
            return np.full(values.shape[2:], float(math.prod(self._shape)))
        found = diagnostics.chain_statistic("ess", values, self.ensemble_size)
        still = (values == values[:1, :1]).all(axis=(0, 1)) & (np.asarray(step) > 0)
        if still.any():  # chains that never saw another state do not know how soon they would
            return np.where(still, np.fmin(found, self._behind_still(what, values)), found)
        return found

    def _rhat(self, what: str | Query) -> np.ndarray:
        values = self._scalars(what)
        if self.weights is not None or self.independent or self.ancestors is not None:
            return np.full(values.shape[2:], np.nan)
        return diagnostics.chain_statistic("rhat", values, self.ensemble_size, self.superchains)

    # ---- distributions -----------------------------------------------------------------------

    def marginal(self, name: str, index: Any = ()) -> Marginal:
        node = self._node(name)
        if node.domain is not None and not node.event_shape:
            values = np.arange(node.domain.size) if node.domain.labels else node.domain.numbers
            picked = self.probabilities(name)[index if isinstance(index, tuple) else (index,)]
            return Marginal(name, np.asarray(values), picked, node.domain.states)
        draws = self._full(name, "marginal")
        flat = draws.reshape((math.prod(self._shape), *draws.shape[2:]))
        flat = flat[(slice(None), *(index if isinstance(index, tuple) else (index,)))]
        return Marginal(name, flat, self._flat_weights(), ends=ends_of(node))

    def resample(self, draws: int | None = None, rng: Any = None) -> DrawsPosterior:
        count = math.prod(self._shape) if draws is None else whole_draws(draws)
        generator = stream(seed_sequence(rng), Purpose.RESAMPLE)
        picked = generator.permutation(systematic(self._flat_weights(), count, generator))
        chain, draw = np.divmod(picked, self._shape[1])
        stored = {
            name: values
            if values.shape[:2] == (1, 1)
            else values[chain if values.shape[0] > 1 else 0, draw if values.shape[1] > 1 else 0][
                None
            ]
            for name, values in self._stored.items()
        }
        ancestors = picked if self.ancestors is None else self.ancestors[picked]
        duplicated = self.weights is not None or self.ancestors is not None
        problem = self.problem  # which a pickle has lost, and resampling does not need
        if problem is None:
            problem = Problem(None, self.model, self._seen, self._inputs)  # type: ignore[arg-type]
        drawn = DrawsPosterior(
            problem,
            self.engine,
            stored,
            (1, count),
            independent=not duplicated,
            ancestors=ancestors if duplicated else None,
        )
        drawn.problem = self.problem
        return drawn

    def predict(
        self,
        names: str | Sequence[str],
        inputs: Mapping[str, Any] | None = None,
        plates: Mapping[str, int] | None = None,
        rng: Any = None,
        draws: int | None = None,
    ) -> DrawsPosterior:
        problem = self._live("predict")
        listed = isinstance(names, Sequence) and not isinstance(names, str)
        wanted = tuple(expanded(self.model, names if listed else [names]))
        for name in wanted:
            if not isinstance(name, str):
                raise UnknownNodeError(
                    f"predict: {name!r} is no node name; use expectation on its result"
                )
            if not self._node(name).is_stochastic and self._node(name).kind != "deterministic":
                raise UnsupportedError(
                    f"predict({name!r}): {self._node(name).kind} nodes are not drawn"
                )
        seed = seed_sequence(rng)
        if isinstance(problem.net, BayesNet):
            inputs = problem.net.unframed(None, inputs)[1]
        source = self if self.weights is None else self.resample(draws, seed)
        return source._predict(problem, wanted, inputs, plates or {}, stream(seed, Purpose.PREDICT))

    def _predict(
        self,
        problem: Problem,
        wanted: tuple[str, ...],
        inputs: Mapping[str, Any] | None,
        plates: Mapping[str, int],
        rng: np.random.Generator,
    ) -> DrawsPosterior:
        given = problem.inputs if inputs is None else inputs
        plates = {**brought_sizes(self.model, inputs), **plates}
        model = problem.net.model(None, given, {**self.model.sizes, **plates})
        forward.refuse_potentials(model, wanted, "predict")
        declarations = {n: c.declaration for n, c in model.nodes.items()}
        known = read_inputs(declarations, model.sizes, given, model.labels)
        anew = forward.drawn_anew(model, wanted, set(plates), inputs is not None)
        values = {n: self._of(n) for n in model.nodes if n not in anew and n in self._stored}
        missing = {p for n in anew for p in model[n].parents} - anew - {*values, *known}
        if missing:
            self._of(min(missing))  # says that it was not kept
        refused = forward.refuse_unsampled(model, set(model.nodes) - anew, "predict")
        if refused:
            raise UnsupportedError(refused)
        steps = [forward.step_for(model, node, {}) for n, node in model.nodes.items() if n in anew]
        start = forward.Pass(rng, self._shape, {**values, **known})
        with marking_invalid(), np.errstate(all="ignore"):
            drawn = forward.run(steps, start).values
        stored = {n: _chained(drawn[n], len(model[n].value_shape)) for n in drawn}
        new = Problem(problem.net, model, {}, dict(known))
        return DrawsPosterior(
            new,
            self.engine,
            stored,
            self._shape,
            independent=self.independent,
            ancestors=self.ancestors,
        )

    def to_datatree(self, resample: int | None = None, rng: Any = None, **groups: Any) -> Any:
        if self.weights is not None and resample is None:
            raise UnsupportedError(
                "to_datatree: these draws are weighted and ArviZ would drop the weights; pass "
                "resample=draws for equally weighted ones"
            )
        if resample is not None:
            return self.resample(resample, rng).to_datatree(rng=rng, **groups)
        return datatree(self, rng=rng, **groups)

    # ---- private -----------------------------------------------------------------------------

    def _error(self, values: np.ndarray) -> np.ndarray:
        """Standard error of means as the draws show it."""
        if self.ancestors is not None:
            return diagnostics.weighted_mcse(*self._distinct(values))
        if self.weights is not None:
            return diagnostics.weighted_mcse(values, self.weights)
        if self.independent:
            count = math.prod(self._shape)
            spread = (
                values.std(axis=(0, 1), ddof=1) if count > 1 else np.full(values.shape[2:], np.nan)
            )
            return spread / np.sqrt(count)
        return diagnostics.chain_statistic("mcse", values, self.ensemble_size)

    def _share_count(self, values: np.ndarray, step: Any, what: Any) -> Any:
        """Effective draws behind shares (`shares`)."""
        if not np.any(step):
            return 1.0
        weights = self.weights
        if self.ancestors is not None:
            values, weights = self._distinct(values)
        if weights is not None:
            return weighted_count(values, weights)
        if self.independent:
            return float(math.prod(self._shape))
        still = (values == values[:1, :1]).all(axis=(0, 1)).any()
        moving = self._behind_still(what, values) if still else np.inf
        return chain_count(values, moving, self.ensemble_size, step)

    def _behind_still(self, what: Any, values: np.ndarray) -> Any:
        """Effective draws behind figures that never changed, which broadcasts to ``values.shape[2:]``."""
        return self._slowest

    @cached_property
    def _slowest(self) -> float:
        """Effective draws of the scalar that moves slowest in these chains."""
        free = (n for n in self._stored if n not in self._observed)
        return slowest(self._stored, free, self.ensemble_size)

    def _scalars_and_step(self, what: Any) -> tuple[np.ndarray, Any]:
        """What the answers are means of, and by how much an unseen state may move each (`shares`)."""
        if not isinstance(what, Query):
            exact = self._of(what).shape[:2] == (1, 1) and self._shape != (1, 1)
            return self._scalars(what), steps(self._node(what), self._seen.get(what), exact)
        values = self._evaluate(what)
        known = all(self._of(n).shape[:2] == (1, 1) for n in what.nodes) and self._shape != (1, 1)
        return values.astype(float), float(is_share(values) and not known)

    def _distinct(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Each resampled draw once, weighted by its copies."""
        assert self.ancestors is not None
        _, first, copies = np.unique(self.ancestors, return_index=True, return_counts=True)
        return values[:, first], (copies / copies.sum())[None]

    def _of(self, name: str) -> np.ndarray:
        if name in self._inputs:
            return self._inputs[name][None, None]
        if name not in self._stored:
            self._node(name)
            raise UnsupportedError(
                f"{name!r} was not kept (keep= lists {sorted(self._stored)}); add it to keep="
            )
        return self._stored[name]

    def _values(self, name: str, what: str) -> np.ndarray:
        """Numeric values, whose batch axes may have size 1 for constants."""
        node = self._numeric(name, what)
        return np.asarray(node.decode(self._of(name)))

    def _full(self, name: str, what: str) -> np.ndarray:
        values = self._values(name, what)
        return np.broadcast_to(values, self._shape + values.shape[2:])

    def _uncut(self, name: str, what: str) -> np.ndarray:
        """The same with angles within half a turn of their mean."""
        values = self._full(name, what)
        angles = self.model.nodes[name].angles
        return values if angles is None else np.where(angles, near(values, self.mean(name)), values)

    def _flat_weights(self) -> np.ndarray:
        if self.weights is not None:
            return self.weights.ravel()
        total = math.prod(self._shape)
        return np.full(total, 1 / total)

    def _average(self, values: np.ndarray) -> np.ndarray:
        if values.shape[:2] == (1, 1):
            return np.asarray(values[0, 0], dtype=float)
        return np.asarray(diagnostics.weighted_mean(values, self.weights))

    def _evaluate(self, query: Query) -> np.ndarray:
        stored = {
            n: np.broadcast_to(self._of(n), self._shape + self.model[n].value_shape)
            for n in query.nodes
        }
        return query(stored, self._shape)

    def _scalars(self, what: Any) -> np.ndarray:
        """Values of a node or function; a labelled node gives the indicators of its states."""
        if isinstance(what, Query):
            return self._evaluate(what).astype(float)
        node = self._node(what)
        if node.domain is not None and node.domain.labels is not None:
            codes = np.broadcast_to(self._of(what), self._shape + node.value_shape)
            return (codes[..., None] == np.arange(node.domain.size)).astype(float)
        values = self._full(what, "mean").astype(float)
        if node.angles is None:
            return values
        # to first order the circular mean errs as the mean of these does (delta method)
        length = np.sqrt(self._average(np.cos(values)) ** 2 + self._average(np.sin(values)) ** 2)
        turned = np.sin(values - self.mean(what)) / np.maximum(length, 1e-300)
        return np.where(node.angles, turned, values)


def _chained(values: np.ndarray, trailing: int) -> np.ndarray:
    """Values with exactly two batch axes."""
    missing = 2 - (values.ndim - trailing)
    return values.reshape((1,) * missing + values.shape) if missing > 0 else values


def _quantiles(
    values: np.ndarray, levels: np.ndarray, weights: np.ndarray | None, method: Any
) -> np.ndarray:
    """Quantiles of draws on the first axis."""
    return np.quantile(values, levels, axis=0, weights=weights, method=method)
