"""``KalmanFilter``: exact filtering and smoothing of linear-Gaussian templates; what such filters share.

A family says how the numbers of a slice come about from those of the slice before, as a mean and as
coefficients of independent normals (``expected``), and why it refuses (``_own_refusal``, ``refused_row``).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bayesmc.dbn import DynamicBayesNet, Row, SeriesProblem, Slices, read_static
from bayesmc.engines.filtering import (
    Asked,
    FilterEngine,
    Queries,
    answer_so_far,
    hand_over,
    quiet,
)
from bayesmc.engines.kalman.covariances import rows_of
from bayesmc.engines.kalman.data import SeriesData
from bayesmc.engines.kalman.levels import why_not_matched
from bayesmc.engines.kalman.passes import (
    Ahead,
    Expected,
    Filtered,
    RowTaker,
    backward,
    contradicts,
    forward,
    impossible_row,
)
from bayesmc.engines.kalman.posterior import (
    GaussianBelief,
    GaussianSeries,
    GaussianState,
    filter_answers,
    smooth_answers,
)
from bayesmc.engines.kalman.reading import Linear, read_linear, reads_time, why_not_gaussian
from bayesmc.engines.kalman.slices import Layout
from bayesmc.errors import DegeneracyError, UnsupportedError
from bayesmc.linalg.square_root import multiplied
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

    def treatment(self, problem: SeriesProblem) -> Callable[[str], str]:
        layout = self._data(problem).layouts[1]
        kinds: list[tuple[Collection[str], str]] = [
            (layout.computed, "computed"),
            (layout.certain, "observed, depends on nothing hidden"),
            (layout.seen, "observed, updates the Gaussian belief"),
            (problem.series.observed, "Gaussian, observed in part"),
            (layout.drawn, "Gaussian"),
            (layout.silent, "not answered for: takes no continuous values"),
        ]
        other = "computed from Gaussian nodes"
        return lambda name: next((words for names, words in kinds if name in names), other)

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

    def _bound(
        self, belief: GaussianBelief, dbn: DynamicBayesNet, slices: Slices
    ) -> GaussianBelief:
        taken = belief.state.taken
        old = taken.layout
        layout = Layout(slices, old.apart, old.first, old.before, old.unknown)
        taker = RowTaker(self, slices, read_static(slices, belief.static))
        return belief.bound(dbn, slices, GaussianState(taker, taken._replace(layout=layout)))

    def _absorbed(self, belief: GaussianBelief, slices: Slices, row: Row) -> GaussianBelief:
        taker, before = belief.state or (None, None)
        if taker is None:
            taker = RowTaker(self, slices, read_static(slices, belief.static))
        with quiet():
            taken = taker.take(row, before)
        return belief.after(slices, row, taken.log_density, GaussianState(taker, taken))

    # ---- for the families ----------------------------------------------------------------------

    def refused_row(self, layout: Layout, values: Mapping[str, np.ndarray]) -> str | None:
        """See ``passes.Family``."""
        raise NotImplementedError

    def expected(self, ahead: Ahead) -> Expected:
        """See ``passes.Family``."""
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


@dataclass(frozen=True)
class KalmanFilter(GaussianFilter):
    """Exact beliefs about templates whose hidden nodes are linear-Gaussian.

    Hidden nodes, and observed ones that depend on them, are Normal or MvNormal with means that are affine in
    hidden nodes of the same slice and of the one before, and scales that do not depend on hidden nodes. Both
    are proved from the declared functions. They may vary with the index of the slice, with inputs, static
    nodes and whatever is observed throughout; such nodes may be of any kind.

    Notes
    -----
    Covariances are carried as triangular roots (the array form): conditioning is one QR decomposition per
    slice, smoothing goes back through its orthogonal factors. No covariance is subtracted or inverted, so
    vague starts (``Normal(0, 1e7)``) and deterministic or exactly observed states keep full precision. Where
    nothing but data varies with time, covariances are worked out until they repeat to rounding, also in turn
    where missing rows come round.

    ``smooth`` is the Rauch–Tung–Striebel smoother, ``most_likely`` its means, which are the joint mode.
    Plates whose elements never meet are leading axes, not one joint state.

    References
    ----------
    Kalman (1960), J. Basic Engineering 82; Rauch, Tung and Striebel (1965), AIAA Journal 3; Kailath, Sayed
    and Hassibi (2000), Linear Estimation, ch. 12.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc import KalmanFilter
    >>> dbn = bmc.DynamicBayesNet("local level")
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1e7))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 2.0))
    >>> rows = {"y": [1.0, 3.0, None, 2.0]}
    >>> bmc.filter(dbn, rows, engine=KalmanFilter()).mean("x").round(3).tolist()
    [1.0, 2.111, 2.111, 2.054]
    >>> bmc.smooth(dbn, rows, engine=KalmanFilter()).std("x").round(3).tolist()
    [1.356, 1.273, 1.4, 1.433]
    """

    label: ClassVar[str] = "Kalman filter"
    is_exact: ClassVar[bool] = True

    def _own_refusal(self, problem: SeriesProblem, data: SeriesData) -> str | None:
        for later in (0, 1):
            layout = data.layouts[later]
            why = why_not_gaussian(layout, data.at(min(later, data.steps - 1)))
            if why is not None:
                return f"{why}; {_others(*data.layouts)}"
        try:
            self._matrices(problem, data)
        except UnsupportedError as error:
            return f"{error}; {_others(*data.layouts)}"
        return None

    def refused_row(self, layout: Layout, values: Mapping[str, np.ndarray]) -> str | None:
        why = why_not_gaussian(layout, values)
        return None if why is None else f"{why}; {_others(layout)}"

    def _forward(
        self,
        problem: SeriesProblem,
        data: SeriesData,
        smoothing: bool,
        advance: Callable[[int], None],
    ) -> Filtered:
        found = forward(data, self._matrices(problem, data), smoothing, advance)
        finite = np.isfinite(found.increments).reshape(data.steps, -1).all(axis=1)
        if not finite.all():
            k = int(np.argmin(finite))
            error: Exception = DegeneracyError(
                f"the row of slice {k} has no density given those before", k
            )
            if contradicts(data.layout(k), found.increments[k]):
                error = impossible_row(k)
            if k:
                hand_over(error, filter_answers(self, problem, data, found.first(k)))
            raise error
        return found

    def _matrices(self, problem: SeriesProblem, data: SeriesData) -> tuple[Linear, Linear | None]:
        if "kalman matrices" not in problem.cache:
            found: list[Linear | None] = [
                read_linear(layout, data.values(low, high), high - low)
                for layout, (low, high) in data.spans()
            ]
            problem.cache["kalman matrices"] = (*found, None)[:2]
        return problem.cache["kalman matrices"]

    def expected(self, ahead: Ahead) -> Expected:
        layout, values, pattern, memory = ahead.layout, ahead.values, ahead.pattern, ahead.memory
        timeless = memory(("timeless", layout), lambda: not reads_time(layout))

        def read() -> Linear:
            return _read_row(layout, values)

        def choose() -> Linear:
            linear, at = memory(("matrices", layout), read) if timeless else read(), pattern.chosen
            moves, noise = (a[0][..., at, :] for a in (linear.moves, linear.noise))
            return Linear(linear.offset[0][..., at], moves, noise)

        whole = timeless and pattern.given is None  # what is seen in part may differ in every row
        found = memory(("chosen", layout), choose) if whole else choose()
        mean = found.offset + multiplied(found.moves, ahead.mean)
        rows = rows_of(found.moves, found.noise, ahead.factor, pattern.absent)

        def terms() -> np.ndarray:
            return np.abs(found.offset) + multiplied(np.abs(found.moves), np.abs(ahead.mean))

        return Expected(mean, rows, terms)


# ---- private ------------------------------------------------------------------------------------


def _others(*layouts: Layout) -> str:
    """Filters that take such slices."""
    for layout in layouts:
        nodes = [layout.model[n] for n in layout.drawn]
        if any(n.domain is not None for n in nodes) and any(n.domain is None for n in nodes):
            return "use SwitchingKalmanFilter or ParticleFilter"
    if any(layout.silent or why_not_matched(layout) is not None for layout in layouts):
        return "use ParticleFilter"
    return "use ExtendedKalmanFilter, UnscentedKalmanFilter or ParticleFilter"


def _read_row(layout: Layout, values: Mapping[str, np.ndarray]) -> Linear:
    """Coefficients of one slice."""
    static = layout.slices.template.static
    row = {n: v if n in static else np.asarray(v)[None] for n, v in values.items()}
    return read_linear(layout, row, 1)
