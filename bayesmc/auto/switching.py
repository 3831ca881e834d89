"""Switching systems where no engine is named: what merging does to filters, and who smooths.

Nobody knows what a filter with merged Gaussians is off by; that it would say something else if it had merged
sooner shows that merging matters. Kim's smoother goes back once and cannot tell where it is wrong;
expectation propagation is nearer wherever its messages settle, and says where they do not. What it may cost
is counted before it starts.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import Queries
from bayesmc.engines.propagation.engine import ExpectationPropagation
from bayesmc.engines.switching.filter import SwitchingKalmanFilter
from bayesmc.errors import (
    BayesmcError,
    ConvergenceWarning,
    EngineWarning,
    InterruptWarning,
    UnsupportedError,
)
from bayesmc.results import SeriesPosterior

#: slices passed back and forth that are spent at most where nobody asked for it: some 50 s
_BUDGET = 100_000
#: sweeps below which it is not begun: most series need as many
_FEWEST = 15
#: what an undamped sweep may still change, of a belief in standard deviations, for it to be an answer
_NEAR = 0.1
#: differences that merging sooner makes, of the log evidence and of probabilities, of which nobody is told
_SAME = 0.1, 0.1
#: the same where rows are missing: what rounding leaves where modes make no difference
_ROUNDED = 1e-8
#: why it is taken
REASON = (
    "hidden numbers are linear-Gaussian given finite nodes; answers are approximate, and where messages do "
    "not come near to settling SwitchingKalmanFilter answers instead, with a warning"
)


def within_budget(problem: SeriesProblem) -> ExpectationPropagation:
    """Expectation propagation with as many sweeps as its budget has, the usual number at most."""
    plain = ExpectationPropagation()
    if plain.refusal(problem) is not None:
        return plain
    sweeps = min(int(_BUDGET / plain.sweep_cost(problem)), plain.sweeps)
    return plain if sweeps == plain.sweeps else ExpectationPropagation(sweeps=max(sweeps, 1))


def why_too_long(engine: ExpectationPropagation, problem: SeriesProblem) -> str | None:
    """Why it is not begun, or None."""
    if engine.sweeps >= _FEWEST:
        return None
    return (
        f"ExpectationPropagation: {problem.steps} slices would take too long for a default (a sweep costs "
        "about as much as Kim's smoother, and most series need some 20); ask for it by name"
    )


def warn_where_merging_matters(
    call: str, found: SeriesPosterior, problem: SeriesProblem, lag: int | None = None
) -> None:
    """Hold a filter whose Gaussians were merged against one that merges them sooner, by GPB1.

    That both agree is no proof: what modes did in rows without data both lose alike, so these are spoken of,
    too. That they differ shows that merging matters; by how much, neither tells.

    Warns
    -----
    EngineWarning
    """
    engine = found.engine
    if not isinstance(engine, SwitchingKalmanFilter) or getattr(found, "interrupted", False):
        return
    sooner, seed = replace(engine, merging="gpb1"), np.random.SeedSequence(0)
    differs = "it cannot be merged sooner (merging='gpb1') to see how much that matters"
    try:
        with warnings.catch_warnings():  # whoever stops this has his answer
            warnings.simplefilter("ignore", (InterruptWarning, EngineWarning))
            rough = (
                sooner.smooth(problem, seed, lag=lag, progress=False)
                if call == "smooth"
                else sooner.filter(problem, seed, progress=False)
            )
    except BayesmcError:
        rough = None
    except KeyboardInterrupt:
        return
    if rough is not None:
        if rough.steps < found.steps:
            return
        evidence, probability = _differences(found, rough)
        gap = _has_gap(problem)
        same = (_ROUNDED, _ROUNDED) if gap else _SAME
        if evidence <= same[0] and probability <= same[1]:
            return
        differs = (
            f"merged sooner (merging='gpb1') the log evidence differs by {evidence:.2g} and probabilities by "
            f"up to {probability:.2g}"
            + (", and rows are missing, where merging loses most" if gap else "")
        )
    warnings.warn(
        f"{call}: SwitchingKalmanFilter answers, which merges Gaussians: what it says is approximate, and "
        f"{differs}. Its own error nobody knows: hold it against engine=bmc.ParticleFilter("
        "marginalize='auto', proposal='optimal'), which states one; if it is what you want, name it, "
        "engine=bmc.SwitchingKalmanFilter()",
        EngineWarning,
        stacklevel=3,
    )


def settled_or_kim(
    engine: ExpectationPropagation,
    problem: SeriesProblem,
    queries: Queries | None,
    progress: bool | None,
) -> SeriesPosterior:
    """Where messages settle, or nearly, what they say; else what Kim's smoother does.

    On series with one hidden number, whose exact answer is known, messages that had nearly settled were off
    by .006 to .15 in probabilities of modes at worst, and Kim's smoother by .09 to .5.

    Warns
    -----
    ConvergenceWarning
        Messages have nearly settled, or come to where they did by a way that others had not to take.
    EngineWarning
        It is Kim's smoother's answer, and why.
    """
    try:
        found, doubt = engine.smoothed(problem, queries, progress)
    except UnsupportedError as error:
        doubt = str(error)
    else:
        ahead = np.max(found.change / (1.0 - np.asarray(found.damping)), initial=0.0)
        if ahead <= _NEAR and np.isfinite(found.log_marginal_likelihood).all():
            if doubt is not None:
                warnings.warn(doubt, ConvergenceWarning, stacklevel=3)
            return found
    warnings.warn(
        "smooth: SwitchingKalmanFilter answers (Kim's smoother: probabilities of modes may be off by some "
        "tenths, most of all where rows are missing), as ExpectationPropagation, mostly nearer, could not. "
        f"{doubt}",
        EngineWarning,
        stacklevel=3,
    )
    others = "ParticleFilter(particles)"  # messages have just failed
    kim = SwitchingKalmanFilter()
    return kim.smoothed(problem, others, queries=queries, progress=progress)


# ---- private ------------------------------------------------------------------------------------


def _differences(found: SeriesPosterior, rough: SeriesPosterior) -> tuple[float, float]:
    """Of the log evidence, and of probabilities of states."""
    logs = (np.sum(np.asarray(f.log_marginal_increments), axis=0) for f in (found, rough))
    finite = [n for n in found.names if found.model[n].domain is not None]
    off = (found.probabilities(n) - rough.probabilities(n) for n in finite)
    probability = max((float(np.max(np.abs(d), initial=0.0)) for d in off), default=0.0)
    return float(np.max(np.abs(np.subtract(*logs)))), probability


def _has_gap(problem: SeriesProblem) -> bool:
    """Whether some slice has no data, and a later one has."""
    seen = np.zeros(problem.steps, dtype=bool)
    for observed in problem.series.observed.values():
        mask = np.ones(problem.steps, dtype=bool) if observed.mask is None else observed.mask
        seen |= mask.reshape(problem.steps, -1).any(axis=1)
    return bool(not seen[: np.flatnonzero(seen)[-1]].all()) if seen.any() else False
