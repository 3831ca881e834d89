"""An exact posterior: finite nodes answered from tables, continuous ones from mixtures of Gaussians."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from bayesmc.engines.exact.gaussian_answers import GaussianAnswers
from bayesmc.engines.exact.hybrid_plan import Solved
from bayesmc.engines.exact.query_averages import average, covariance, gaussian_average
from bayesmc.engines.exact.table_answers import TableAnswers
from bayesmc.errors import BudgetError, UnknownNodeError, UnsupportedError
from bayesmc.network import Problem
from bayesmc.network.forward import Compute, Pass, run
from bayesmc.randomness import Purpose, seed_sequence, stream
from bayesmc.results.draws import DrawsPosterior
from bayesmc.results.laws import Laws, point_laws
from bayesmc.results.marginal import Marginal, gaussian_marginal
from bayesmc.results.over_time import expanded
from bayesmc.results.posterior import Posterior, quantile_levels, whole_draws
from bayesmc.results.query import Query
from bayesmc.results.statistics import table_quantile, table_variance
from bayesmc.structure import known_values


class ExactPosterior(Posterior):
    """Queries answered from tables and Gaussians, without Monte Carlo error.

    Parameters
    ----------
    solved : Solved
        Both parts of the answer, evidence entered.
    """

    log_marginal_likelihood_mcse = 0.0

    def __init__(self, problem: Problem, engine: Any, solved: Solved) -> None:
        super().__init__(problem, engine)
        known = known_values(problem.model, solved.net.constants, problem.observed)
        self._tables = TableAnswers(problem.model, solved.net, solved.calibrated, known)
        self._gaussian: GaussianAnswers | None = None
        if solved.moments is not None:
            self._gaussian = GaussianAnswers(problem.model, problem.observed, solved.moments)
        self.log_marginal_likelihood = float(solved.calibrated.log_z)

    # ---- tables ------------------------------------------------------------------------------

    def probabilities(self, *names: str) -> np.ndarray:
        if not names:
            raise UnknownNodeError("probabilities(): name at least one node")
        nodes = [self._finite(name) for name in names]
        if len(nodes) == 1:
            return self._tables.table(names[0])
        plates = tuple(dict.fromkeys(p for node in nodes for p in node.plates))
        sizes = tuple(self.model.sizes[p] for p in plates)
        cards = tuple(node.domain.size for node in nodes if node.domain is not None)
        tables = [
            self._tables.joint([self._tables.element(name, plates, at) for name in names])
            for at in np.ndindex(sizes)
        ]
        return np.reshape(np.stack(tables) if tables else np.zeros(sizes + cards), sizes + cards)

    # ---- moments -----------------------------------------------------------------------------

    def mean(self, name: str) -> np.ndarray:
        node = self._numeric(name, "mean")
        if node.domain is not None:
            return self._tables.table(name) @ np.asarray(node.domain.numbers, dtype=float)
        if self._gaussian is not None and self._is_gaussian(name):
            return self._gaussian.mean(name)
        self._refuse_beyond(name, "mean")
        return self._moment(name, lambda x: x)

    def var(self, name: str) -> np.ndarray:
        node = self._numeric(name, "var")
        if node.domain is not None:
            numbers = np.asarray(node.domain.numbers, dtype=float)
            return table_variance(self._tables.table(name), numbers)
        if self._gaussian is not None and self._is_gaussian(name):
            return self._gaussian.var(name)
        self._refuse_beyond(name, "var")
        mean = self.mean(name)
        return self._moment(name, lambda x: (x - mean) ** 2)

    def _moment(self, name: str, power: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Of an observed node, or of a deterministic one without a finite domain."""
        seen = self._tables.known(name)
        if seen is not None:
            return np.asarray(power(seen), dtype=float)
        return self.expectation(lambda value: power(value), names={"value": name})

    def cov(self, *names: str) -> np.ndarray:
        if not names:
            raise UnknownNodeError("cov(): name at least one node")
        names = tuple(expanded(self.model, names))
        nodes = [self._numeric(name, "cov") for name in names]
        if all(node.domain is not None for node in nodes):
            matrix = self._table_cov(names)
        else:
            for name in names:
                self._refuse_beyond(name, "cov")
            matrix = covariance(self._tables, self._gaussian, names)
        return matrix[0, 0] if matrix.size == 1 else matrix

    def _table_cov(self, names: Sequence[str]) -> np.ndarray:
        """Covariance of finite nodes, pair by pair."""
        scalars = [(v, self._numbers(name)) for name in names for v in self._tables.elements(name)]
        matrix = np.empty((len(scalars), len(scalars)))
        for i, (a, x) in enumerate(scalars):
            for j, (b, y) in enumerate(scalars[: i + 1]):
                table = self._tables.joint([a, b])
                x0, y0 = x - table.sum(1) @ x, y - table.sum(0) @ y
                matrix[i, j] = matrix[j, i] = x0 @ table @ y0
        return matrix

    def _numbers(self, name: str) -> np.ndarray:
        domain = self.model[name].domain
        assert domain is not None
        return np.asarray(domain.numbers, dtype=float)

    def _is_gaussian(self, name: str) -> bool:
        return self._gaussian is not None and self._gaussian.holds(name)

    def quantile(self, name: str, q: Any) -> np.ndarray:
        node = self._numeric(name, "quantile")
        levels = quantile_levels(name, q)
        if self._gaussian is not None and self._is_gaussian(name):
            everywhere = tuple(slice(None) for _ in node.plates)
            spread = levels.reshape(levels.shape + (1,) * len(node.plates))
            parts = [
                self._gaussian.distribution(name, (*everywhere, *at)).ppf(spread)
                for at in np.ndindex(node.event_shape)
            ]
            return np.stack(parts, axis=-1).reshape(levels.shape + node.value_shape)
        if node.domain is None:
            self._refuse_beyond(name, "quantile")
            seen = self._tables.known(name)
            if seen is None:
                raise self._cannot(f"quantile of {name!r}, which has no finite set of values")
            return np.broadcast_to(seen, levels.shape + seen.shape).copy()
        return table_quantile(self._tables.table(name), np.asarray(node.domain.numbers), levels)

    def _laws(self, name: str) -> Laws:
        node = self._node(name)
        if self._gaussian is not None and self._is_gaussian(name):
            return self._gaussian.laws(name)
        if node.domain is not None:
            return super()._laws(name)
        self._refuse_beyond(name, "hdi, mode, cdf and entropy")
        seen = self._tables.known(name)
        if seen is None:
            raise self._cannot(f"hdi, mode, cdf and entropy of {name!r}")
        return point_laws(seen, node.is_discrete)

    def _figures(self, name: str) -> dict[str, np.ndarray]:
        node = self.model[name]
        answered = not self._is_beyond(name) and (
            self.problem is not None or self._has_marginal(name)
        )
        if answered:
            with suppress(BudgetError):  # too large a mixture says so when it is asked for
                return super()._figures(name)
        # a function of Gaussians that is not affine, or one that stayed behind in a pickle
        empty = np.full(node.value_shape, np.nan)
        columns = ("mean", "sd", *self._quantile_names(), "mcse", "ess", "rhat")
        return dict.fromkeys(columns, empty)

    def _quantile_columns(self, name: str) -> dict[str, np.ndarray]:
        if self._has_marginal(name):
            with suppress(BudgetError):
                return super()._quantile_columns(name)
        empty = np.full(self.model[name].value_shape, np.nan)
        return dict.fromkeys(self._quantile_names(), empty)

    def _has_marginal(self, name: str) -> bool:
        """Whether a node's own distribution is at hand, not only averages over what it is computed from."""
        node = self.model[name]
        known = node.domain is not None or self._tables.known(name) is not None
        return known or self._is_gaussian(name)

    def _refuse_beyond(self, name: str, what: str) -> None:
        if self._is_beyond(name):
            raise UnsupportedError(
                f"{what} of {name!r}: it is computed from continuous nodes in a way that is not affine, so "
                "it is no mixture of Gaussians; draw with resample(draws) and ask there"
            )

    def _is_beyond(self, name: str) -> bool:
        """Whether a node is computed from continuous ones in a way that is not affine."""
        if self._has_marginal(name):
            return False
        parents = self.model[name].parents
        return any(self._is_gaussian(p) or self._is_beyond(p) for p in parents)

    # ---- functions ---------------------------------------------------------------------------

    def _averaged(self, query: Query) -> np.ndarray:
        """The function on every configuration of what it needs, averaged over their joint table."""
        gaussian = [n for n in query.nodes if self._is_gaussian(n)]
        if set(self._tables.missing(query.nodes)) - set(gaussian):
            self._live("expectation of a deterministic node")
        for name in query.nodes:
            self._refuse_beyond(name, "probability" if query.is_event else "expectation")
        if gaussian:
            assert self._gaussian is not None
            return gaussian_average(self._tables, self._gaussian, query)
        return average(self._tables, query)

    # ---- draws and diagnostics ----------------------------------------------------------------

    def _mcse(self, what: str | Query) -> np.ndarray:
        return np.zeros(self._shape_of(what))

    def _ess(self, what: str | Query) -> np.ndarray:
        return np.full(self._shape_of(what), np.inf)

    def _rhat(self, what: str | Query) -> np.ndarray:
        return np.full(self._shape_of(what), np.nan)

    def _shape_of(self, what: str | Query) -> tuple[int, ...]:
        if isinstance(what, Query):
            return self._averaged(what).shape
        node = self._node(what)
        if node.domain is not None and node.domain.labels is not None:
            return (*node.plate_shape, node.domain.size)
        return node.value_shape

    def marginal(self, name: str, index: Any = ()) -> Marginal:
        at = index if isinstance(index, tuple) else (index,)
        if self._gaussian is not None and self._is_gaussian(name):
            self._node(name)
            return gaussian_marginal(name, self._gaussian.distribution(name, at))
        self._node(name)
        self._refuse_beyond(name, "marginal")
        node = self._finite(name)
        assert node.domain is not None
        values = np.arange(node.domain.size) if node.domain.labels else node.domain.numbers
        table = self._tables.table(name)[at]
        return Marginal(name, np.asarray(values), table, node.domain.states)

    def resample(self, draws: int | None = None, rng: Any = None) -> DrawsPosterior:
        problem = self._live("resample")
        count = 1000 if draws is None else whole_draws(draws)
        generator = stream(seed_sequence(rng), Purpose.RESAMPLE)
        drawn = self._tables.calibrated.sample(generator, count)
        values = dict(self._tables.known_values)
        for name, node in self.model.nodes.items():
            if node.domain is not None and node.kind != "fixed":
                elements = range(math.prod(node.plate_shape))
                empty = np.zeros((count, 0))
                columns = np.stack([drawn[(name, e)] for e in elements], -1) if elements else empty
                values[name] = columns.reshape((count, *node.plate_shape)).astype(node.domain.dtype)
        if self._gaussian is not None:
            values.update(self._gaussian.draw(generator, drawn, count))
        rest = [
            Compute(self.model, n) for name, n in self.model.nodes.items() if name not in values
        ]
        with np.errstate(all="ignore"):
            values = run(rest, Pass(generator, (count,), values)).values
        stored = {
            name: value[None]
            if value.ndim > len(self.model[name].value_shape)
            else value[None, None]
            for name, value in values.items()
        }
        return DrawsPosterior(problem, self.engine, stored, (1, count), independent=True)

    def predict(
        self,
        names: str | Sequence[str],
        inputs: Mapping[str, Any] | None = None,
        plates: Mapping[str, int] | None = None,
        rng: Any = None,
        draws: int | None = None,
    ) -> DrawsPosterior:
        self._live("predict")
        seed = seed_sequence(rng)
        source = self.resample(4000 if draws is None else draws, seed)
        return source.predict(names, inputs, plates, seed)

    def to_datatree(self, resample: int | None = None, rng: Any = None, **groups: Any) -> Any:
        if resample is None:
            raise UnsupportedError(
                "to_datatree: an exact posterior has no draws; pass resample=draws"
            )
        return self.resample(resample, rng).to_datatree(rng=rng, **groups)

    def bind(self, problem: Problem) -> None:
        super().bind(problem)
        self._tables.model = problem.model
        if self._gaussian is not None:
            self._gaussian.model = problem.model

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        tables, gaussian = copy.copy(self._tables), copy.copy(self._gaussian)
        tables.model = state["model"]
        if gaussian is not None:
            gaussian.model = state["model"]
        return {**state, "_tables": tables, "_gaussian": gaussian}
