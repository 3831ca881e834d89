"""A template asked as a plain net: the question unrolled, with the template at hand for those who want it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.dbn import DynamicBayesNet, SeriesProblem, pose_series
from bayesmc.network import BayesNet, FactorGraph, Problem, pose
from bayesmc.results import Posterior
from bayesmc.results.over_time import TIMES

#: where a problem keeps the question over time that it was unrolled from
_SERIES = "series"


def pose_any(
    net: BayesNet | FactorGraph | DynamicBayesNet,
    evidence: Mapping[str, Any] | None,
    inputs: Mapping[str, Any] | None = None,
    earlier: Posterior | None = None,
) -> Problem:
    """A posed problem: of a net as it is, of a template unrolled over its data.

    Parameters
    ----------
    evidence, inputs : dict, optional
        Of a template: observations and inputs, time first.
    earlier : Posterior, optional
        An answer that may be gone on with: if it is to the same template, its net is taken, so that the
        question is the same and nothing is compiled twice.

    Raises
    ------
    ModelError, EvidenceError, PlateError

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.unrolled import pose_any, series_of
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> problem = pose_any(dbn, {"y": [0.3, 0.7]})
    >>> list(problem.model.nodes), series_of(problem).steps
    (['x[0]', 'y[0]', 'x[1]', 'y[1]'], 2)
    """
    if not isinstance(net, DynamicBayesNet):
        return pose(net, evidence, inputs)
    evidence, inputs, times = net.unframed(evidence, inputs)
    series = pose_series(net, evidence, inputs)
    was = None if earlier is None else earlier.problem
    if was is not None and _same_template(was, series):
        unrolled: Any = was.net
    else:
        unrolled = net.unroll(series.steps, inputs)
    problem = pose(unrolled, net.unrolled_evidence(evidence or {}))
    problem.cache[_SERIES] = series
    if times is not None and len(times) == series.steps:
        problem.model.cache[TIMES] = times
    return problem


def series_of(problem: Problem) -> SeriesProblem | None:
    """The question over time that a problem was unrolled from; None where it is that of a plain net."""
    return problem.cache.get(_SERIES)


# ---- private ------------------------------------------------------------------------------------


def _same_template(was: Problem, now: SeriesProblem) -> bool:
    """Whether an earlier problem unrolled the same declarations over as many slices and the same inputs."""
    old = series_of(was)
    if old is None or old.steps != now.steps:
        return False
    mine, yours = old.dbn.template, now.dbn.template
    return (
        _same(mine.later, yours.later)
        and _same(mine.first, yours.first)
        and mine.static == yours.static
        and old.slices.first.sizes == now.slices.first.sizes
        and all(np.array_equal(v, now.series.inputs[n]) for n, v in old.series.inputs.items())
    )


def _same(old: Mapping[str, Any], new: Mapping[str, Any]) -> bool:
    return list(old) == list(new) and all(d is new[n] for n, d in old.items())
