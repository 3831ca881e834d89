"""``KalmanFilter``: exact filtering and smoothing of linear-Gaussian templates."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import hand_over
from bayesmc.engines.kalman.answers import filter_answers
from bayesmc.engines.kalman.base import GaussianFilter
from bayesmc.engines.kalman.covariances import rows_of
from bayesmc.engines.kalman.data import Pattern, SeriesData
from bayesmc.engines.kalman.levels import why_not_matched
from bayesmc.engines.kalman.passes import Filtered, State, forward
from bayesmc.engines.kalman.reading import Linear, read_linear, reads_time, why_not_gaussian
from bayesmc.engines.kalman.rows import Expected, Memory, contradicts, impossible_row
from bayesmc.engines.kalman.slices import Layout
from bayesmc.errors import DegeneracyError, UnsupportedError
from bayesmc.linalg.square_root import multiplied


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

    def expected(
        self,
        layout: Layout,
        values: Mapping[str, np.ndarray],
        state: State,
        pattern: Pattern,
        memory: Memory,
    ) -> Expected:
        timeless = memory(("timeless", layout), lambda: not reads_time(layout))

        def read() -> Linear:
            return _read_row(layout, values)

        def choose() -> Linear:
            linear, at = memory(("matrices", layout), read) if timeless else read(), pattern.chosen
            moves, noise = (a[0][..., at, :] for a in (linear.moves, linear.noise))
            return Linear(linear.offset[0][..., at], moves, noise)

        whole = timeless and pattern.given is None  # what is seen in part may differ in every row
        found = memory(("chosen", layout), choose) if whole else choose()
        mean = found.offset + multiplied(found.moves, state.mean)
        rows = rows_of(found.moves, found.noise, state.factor, pattern.absent)

        def terms() -> np.ndarray:
            return np.abs(found.offset) + multiplied(np.abs(found.moves), np.abs(state.mean))

        return Expected(mean, rows, terms)


# ---- private ------------------------------------------------------------------------------------


def _others(*layouts: Layout) -> str:
    """Filters that take such slices."""
    if any(layout.silent or why_not_matched(layout) is not None for layout in layouts):
        return "use ParticleFilter"
    return "use ExtendedKalmanFilter, UnscentedKalmanFilter or ParticleFilter"


def _read_row(layout: Layout, values: Mapping[str, np.ndarray]) -> Linear:
    """Coefficients of one slice."""
    static = layout.slices.template.static
    row = {n: v if n in static else np.asarray(v)[None] for n, v in values.items()}
    return read_linear(layout, row, 1)
