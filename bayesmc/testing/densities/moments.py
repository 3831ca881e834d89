"""Moments of draws against those of the density: a sampler's location, scale and coupling.

Of single numbers the moments of normal scores, whose law is known whatever the density; of vectors means,
variances and covariances in unconstrained coordinates, far values drawn in so that all moments exist.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.special

from bayesmc.testing.densities.masses import Element, Rule, Volume, free_angles, free_draws
from bayesmc.testing.densities.reports import Report
from bayesmc.testing.posteriors.samples import Average

#: numbers of a vector that are looked at
_NUMBERS = 6
#: in standard deviations, what no squashed number exceeds
_BOUND = 4.0
#: cdf values are kept this far from 0 and 1, where scores are infinite
_EDGE = 1e-15
#: a product rule that doubts a moment more than this decides nothing
_DOUBT = 2e-3
#: draws that effectively decide an error, at least
_SUPPORT = 30.0


def check_scores(levels: np.ndarray, report: Report) -> None:
    """Normal scores of draws of one number, from their cdf values: mean 0 and variance 1, exactly so."""
    levels = levels[~np.isnan(levels)]  # faults that are told elsewhere
    scores = scipy.special.ndtri(np.clip(levels, _EDGE, 1.0 - _EDGE))
    n = len(scores)
    if not n:
        return
    mean, square = float(scores.mean()), float((scores**2).sum())
    z = abs(mean) * math.sqrt(n)
    report.judge(
        "mean of the draws' normal scores", mean, 0.0, z, 2 * float(scipy.special.ndtr(-z))
    )
    tails = scipy.special.chdtr(n, square), scipy.special.chdtrc(n, square)
    report.judge(
        "mean square of the draws' normal scores",
        square / n, 1.0, abs(square / n - 1) * math.sqrt(n / 2), min(1.0, 2 * float(min(tails))),
    )  # fmt: skip


def check_table_scores(
    samples: np.ndarray, values: np.ndarray, probs: np.ndarray, report: Report
) -> None:
    """The same of whole numbers, with scores halfway up the steps of the cdf."""
    middle = np.clip(np.cumsum(probs) - probs / 2, _EDGE, 1.0 - _EDGE)
    scores = scipy.special.ndtri(middle)
    at = np.clip(np.searchsorted(values, samples), 0, len(values) - 1)
    for what, power in (("mean", 1), ("mean square", 2)):
        column = scores[at] ** power
        exact = float(scores**power @ probs)
        drawn = Average.of(column)
        if drawn.support >= _SUPPORT:  # else the chi-square has the last word
            report.average(f"{what} of the draws' normal scores", drawn, exact, 1.0)


def check_moments(element: Element, samples: np.ndarray, volume: Volume, report: Report) -> None:
    """Means, variances and covariances of vectors, against the density's by a rule of integration."""
    free = free_draws(element, samples)
    free = free[~np.isnan(free).any(axis=1)]
    turns = free_angles(element.support, free.shape[1])
    if len(free) < 2 or not volume.rules:
        return
    centre = np.median(free, axis=0)
    low, high = np.quantile(free, [0.25, 0.75], axis=0)
    spread = np.where((high > low) & np.isfinite(high - low), (high - low) / 1.35, 1.0)
    centre = np.where(np.isfinite(centre), centre, 0.0)

    names = _names(turns)
    drawn = _features(free, turns, centre, spread)
    integrated = [(rule, _features(rule.points, turns, centre, spread)) for rule in volume.rules]
    where = " (unconstrained, far values drawn in)"
    undecided = False
    for i in range(len(names)):
        for j in (-1, *range(i, len(names))):
            column = _moment(drawn, i, j)
            what = _label(names, i, j) + where
            found = [_integral(rule, _moment(features, i, j)) for rule, features in integrated]
            best = next((f for f in found if f is not None), None)
            own = Average.of(column)
            if best is None or own.support < _SUPPORT:
                undecided = True
                continue
            exact, tolerance = best
            errors, p_value = _difference(own, exact).p_value(0.0, tolerance)
            report.judge(what, own.value, exact.value, errors, p_value)
    if undecided:
        report.remark(
            "some moments of the draws: too few draws decide them, or no rule integrates them"
        )


# ---- private ------------------------------------------------------------------------------------


def _features(
    u: np.ndarray, turns: np.ndarray, centre: np.ndarray, spread: np.ndarray
) -> np.ndarray:
    """Bounded numbers that keep location and scale, shape (rows, features); of an angle cosine and sine."""
    columns = []
    for k in range(min(len(turns), _NUMBERS)):
        if turns[k]:
            columns += [np.cos(u[:, k]), np.sin(u[:, k])]
        else:
            columns.append(_BOUND * np.tanh((u[:, k] - centre[k]) / (spread[k] * _BOUND)))
    return np.stack(columns, axis=1)


def _names(turns: np.ndarray) -> list[str]:
    found: list[str] = []
    for k, turn in enumerate(turns[:_NUMBERS].tolist()):
        found += [f"cosine of number {k}", f"sine of number {k}"] if turn else [f"number {k}"]
    return found


def _label(names: list[str], i: int, j: int) -> str:
    if j < 0:
        return f"mean of {names[i]}"
    if i == j:
        return f"mean square of {names[i]}"
    return f"mean product of {names[i]} and {names[j]}"


def _moment(features: np.ndarray, i: int, j: int) -> np.ndarray:
    return features[:, i] if j < 0 else features[:, i] * features[:, j]


def _integral(rule: Rule, column: np.ndarray) -> tuple[Average, float] | None:
    """A mean under the normalised density with its chance error, and what else it may be off by."""
    total = float(rule.masses.sum())
    if not 0 < total < np.inf:
        return None
    value = float(rule.masses @ column / total)
    if rule.coarse is not None:
        again = float(rule.coarse.sum())
        off = abs(float(rule.coarse @ column) / again - value) if again > 0 else math.inf
        return (Average(value, 0.0, 0.0, math.inf), off + 1e-9) if off < _DOUBT else None
    pulls = rule.masses * (column - value) * (len(column) / total)
    drawn = Average.of(pulls)
    if drawn.support < _SUPPORT:
        return None
    return Average(value, drawn.error, drawn.skewness, drawn.support), 0.0


def _difference(first: Average, second: Average) -> Average:
    """Of two independent averages."""
    error = math.hypot(first.error, second.error)
    third = first.skewness * first.error**3 - second.skewness * second.error**3
    skewness = third / error**3 if error > 0 else 0.0
    return Average(first.value - second.value, error, skewness, min(first.support, second.support))
