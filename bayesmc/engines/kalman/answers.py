"""From vectors of unknown numbers to answers about nodes, for filters and smoothers alike."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.averages import naming
from bayesmc.engines.filtering import Queries, observed_answers
from bayesmc.engines.kalman.data import SeriesData
from bayesmc.engines.kalman.passes import Filtered, Smoothed
from bayesmc.engines.kalman.posterior import GaussianSeries, Spreads, on_circle
from bayesmc.engines.kalman.queries import View, expectation


def filter_answers(
    engine: Any,
    problem: SeriesProblem,
    data: SeriesData,
    found: Filtered,
    queries: Queries | None = None,
) -> GaussianSeries:
    """Every slice given the rows up to it; of the first so many, where no more were passed."""
    spreads = Spreads(found.factors, found.which)
    return _answers(engine, problem, data, "filter", found, found.means, spreads, queries)


def smooth_answers(
    engine: Any,
    problem: SeriesProblem,
    data: SeriesData,
    found: Filtered,
    smoothed: Smoothed,
    kind: str,
    queries: Queries | None = None,
) -> GaussianSeries:
    """Every slice given later rows, too."""
    layout, roots = data.layouts[0], found.factors
    left = roots[..., : layout.carried][found.which]
    if left.ndim == 3:  # the same in all elements of the plates apart
        left = left.reshape(len(left), *(1,) * len(layout.lead), *left.shape[1:])
    means = found.means + np.matvec(left, smoothed.noise)
    spreads = Spreads(roots, found.which, smoothed.spread)
    return _answers(engine, problem, data, kind, found, means, spreads, queries)


# ---- private ------------------------------------------------------------------------------------


def _answers(
    engine: Any,
    problem: SeriesProblem,
    data: SeriesData,
    kind: str,
    filtered: Filtered,
    means: np.ndarray,
    spreads: Spreads,
    queries: Queries | None,
) -> GaussianSeries:
    variances = spreads.variances()
    layout, steps = data.layouts[0], len(means)
    answers = observed_answers(problem, steps)
    wide = variances.reshape(
        len(variances), *(1,) * (means.ndim - variances.ndim), *variances.shape[1:]
    )
    full = np.broadcast_to(wide, means.shape)
    for name, place in layout.rows.items():
        node = layout.slices.first[name]
        answers.means[name] = layout.unpacked(node, on_circle(layout, name, means[..., place]))
        answers.variances[name] = layout.unpacked(node, full[..., place])
    for name, value in data.computed(steps).items():
        node = layout.slices.first[name]
        value = np.broadcast_to(value, (steps, *node.value_shape))
        if node.domain is not None:
            answers.tables[name] = np.eye(node.domain.size)[value.astype(np.intp)]
        else:
            answers.means[name] = value.astype(float)
            answers.variances[name] = np.zeros(value.shape)
    found = GaussianSeries(
        problem.model, engine, kind, filtered.increments, tables=answers.tables, means=answers.means,
        variances=answers.variances, start=problem.series.start,
    )  # fmt: skip
    found.layout, found.spreads = layout, spreads
    found.normalised = filtered.innovations
    found.predictive = filtered.innovations.predictive()
    found.view = View(layout, means, spreads, _known(problem, data, steps))
    for name, function in (queries or {}).items():
        with naming(name):
            found.queries[name], found.queries_mcse[name] = expectation(found.view, function)
    return found


def _known(problem: SeriesProblem, data: SeriesData, steps: int) -> dict[str, np.ndarray]:
    """Stored values of nodes that are known in every slice."""
    series = problem.series
    found = {n: o.value for n, o in series.static.items()}
    found |= {n: o.value[:steps] for n, o in series.observed.items() if o.mask is None}
    computed = data.computed(steps).items()
    sizes = {n: problem.slices.first[n].value_shape for n, _ in computed}
    return found | {n: np.broadcast_to(v, (steps, *sizes[n])) for n, v in computed}
