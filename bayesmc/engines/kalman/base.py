"""What the Gaussian filters share: the questions over a series, and the same moves one row at a time.

A family says how the numbers of a slice come about from those of the slice before, as a mean and as
coefficients of independent normals (``expected``), and why it refuses (``_own_refusal``, ``refused_row``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np

from bayesmc.dbn import DynamicBayesNet, Row, SeriesProblem, Slices, read_static
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.filtering import Asked, FilterEngine, Queries, answer_so_far
from bayesmc.engines.kalman.answers import filter_answers, smooth_answers
from bayesmc.engines.kalman.data import Pattern, SeriesData
from bayesmc.engines.kalman.passes import Filtered, State, backward
from bayesmc.engines.kalman.posterior import GaussianBelief, GaussianSeries
from bayesmc.engines.kalman.rows import Expected, Memory, RowTaker
from bayesmc.engines.kalman.slices import Layout
from bayesmc.errors import UnsupportedError
from bayesmc.network.node import nodes_read
from bayesmc.progress import Progress
from bayesmc.results.predictive import warn_of_misfit


class GaussianFilter(FilterEngine):
    """Base of ``KalmanFilter``, ``ExtendedKalmanFilter`` and ``UnscentedKalmanFilter``."""

    belief: ClassVar[type] = GaussianBelief

    def refusal(self, problem: SeriesProblem) -> str | None:
        common = super().refusal(problem)
        if common is not None:
            return common
        with quiet():
            why = self._own_refusal(problem, self._data(problem))
        return None if why is None else f"{type(self).__name__}: {why}"

    def unable(self, problem: SeriesProblem, asked: Asked) -> str | None:
        reason = super().unable(problem, asked)
        silent = set(self.unanswered(problem)) if asked.queries and reason is None else set()
        for query, function in asked.queries.items():
            for name in nodes_read(function):
                if name in silent:
                    return (
                        f"queries={{{query!r}: ...}} reads {name!r}, which takes no continuous values, and a "
                        "Gaussian belief does not answer for it"
                    )
        return reason

    def unanswered(self, problem: SeriesProblem) -> tuple[str, ...]:
        silent = {n for layout in self._data(problem).layouts for n in layout.silent}
        return tuple(n for n in problem.slices.dynamic if n in silent)

    def describe(self, problem: SeriesProblem) -> dict[str, str]:
        data, found = self._data(problem), {}
        layout = data.layouts[1]
        for name in problem.slices.template.later:
            if name in problem.slices.template.inputs:
                found[name] = "input"
            elif name in problem.slices.template.static:
                found[name] = "static, known"
            elif name in layout.computed:
                found[name] = "computed"
            elif name in layout.certain:
                found[name] = "observed, depends on nothing hidden"
            elif name in layout.seen:
                found[name] = "observed, updates the Gaussian belief"
            elif name in problem.series.observed:
                found[name] = "Gaussian, observed in part"
            elif name in layout.drawn:
                found[name] = "Gaussian"
            elif name in layout.silent:
                found[name] = "not answered for: takes no continuous values"
            else:
                found[name] = "computed from Gaussian nodes"
        return found

    def filter(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        keep: str | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
    ) -> GaussianSeries:
        if keep is not None:
            raise UnsupportedError(
                f"keep={keep!r}: {type(self).__name__} has no particles; ask its result for mean, var and "
                "cov, or use a ParticleFilter"
            )
        data = self._data(problem)
        try:
            found = self._passed(problem, data, False, progress)
        except KeyboardInterrupt as stop:
            return answer_so_far(stop, self)
        answers = filter_answers(self, problem, data, found, queries)
        warn_of_misfit(answers.predictive, type(self).__name__, answers.start, 3)
        return answers

    def smooth(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        lag: int | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
    ) -> GaussianSeries:
        data = self._data(problem)
        found = self._passed(problem, data, True, progress)
        smoothed = backward(data.layouts[0], found, lag)
        kind = "smooth" if lag is None else "fixed-lag"
        answers = smooth_answers(self, problem, data, found, smoothed, kind, queries)
        warn_of_misfit(answers.predictive, type(self).__name__, answers.start, 3)
        return answers

    def most_likely(
        self, problem: SeriesProblem, seed: np.random.SeedSequence, progress: bool | None = None
    ) -> dict[str, np.ndarray]:
        """Smoothed means, which are the mode of a Gaussian trajectory."""
        found = self.smooth(problem, seed, progress=progress)
        return {n: found.mean(n) for n in self._data(problem).layouts[0].rows}

    def _nothing(self, dbn: DynamicBayesNet, static: Mapping[str, Any], rng: Any) -> GaussianBelief:
        return GaussianBelief(dbn, static)

    def _bound(
        self, belief: GaussianBelief, dbn: DynamicBayesNet, slices: Slices
    ) -> GaussianBelief:
        taken = belief.taken
        assert taken is not None
        old = taken.layout
        layout = Layout(slices, old.apart, old.first, old.before, old.unknown)
        taker = RowTaker(self, slices, read_static(slices, belief.static))
        return GaussianBelief(
            dbn, belief.static, belief.t, taker, taken._replace(layout=layout),
            belief.log_marginal_likelihood, belief.inputs,
        )  # fmt: skip

    def _absorbed(self, belief: GaussianBelief, slices: Slices, row: Row) -> GaussianBelief:
        taker = belief.taker
        if taker is None:
            taker = RowTaker(self, slices, read_static(slices, belief.static))
        with quiet():
            taken = taker.take(row, belief.taken)
        total = belief.log_marginal_likelihood + taken.log_density
        return GaussianBelief(
            belief.dbn, belief.static, belief.t + 1, taker, taken,
            total if np.ndim(total) else float(total),
            {n: row.inputs[n] for n in slices.template.inputs},
        )  # fmt: skip

    # ---- for the families ----------------------------------------------------------------------

    def refused_row(self, layout: Layout, values: Mapping[str, np.ndarray]) -> str | None:
        """See ``rows.Family``."""
        raise NotImplementedError

    def expected(
        self,
        layout: Layout,
        values: Mapping[str, np.ndarray],
        state: State,
        pattern: Pattern,
        memory: Memory,
    ) -> Expected:
        """See ``rows.Family``."""
        raise NotImplementedError

    def _own_refusal(self, problem: SeriesProblem, data: SeriesData) -> str | None:
        raise NotImplementedError

    def _forward(
        self,
        problem: SeriesProblem,
        data: SeriesData,
        smoothing: bool,
        advance: Callable[[int], None],
    ) -> Filtered:
        """All slices given the rows up to them."""
        raise NotImplementedError

    # ---- private -------------------------------------------------------------------------------

    def _passed(
        self, problem: SeriesProblem, data: SeriesData, smoothing: bool, progress: bool | None
    ) -> Filtered:
        key = f"gaussian filter {self!r}, smoothing {smoothing}"
        found = problem.cache.get(key)
        if found is None:
            with Progress(problem.steps, self.label, progress) as bar, quiet():
                found = self._forward(problem, data, smoothing, bar.advance)
            problem.cache[key] = found
        return found

    def _data(self, problem: SeriesProblem) -> SeriesData:
        if "kalman data" not in problem.cache:
            with quiet():
                problem.cache["kalman data"] = SeriesData(problem)
        return problem.cache["kalman data"]


@contextmanager
def quiet() -> Iterator[None]:
    """Parameters out of range are marked, and floating-point warnings silent, while functions run."""
    with marking_invalid(), np.errstate(all="ignore"):
        yield
