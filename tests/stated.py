"""Whether the errors that runs of a filter state are those that they have."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import stats

from bayesmc.errors import DegeneracyError, LowEssWarning
from bayesmc.testing.verdict import Comparison, Verdict, counted

#: how far stated errors of evidence and of means may be off by themselves: no more than that is tested
EVIDENCE, MEANS = 1.3, 1.5
#: errors over stated ones of a figure that is off and claims to be exact
_CERTAIN = 1e3


def stated_errors_test(
    ask: Callable[[Any], Any],
    exact: float,
    right: dict[str, Any],
    figures: Callable[[Any], dict[str, tuple[np.ndarray, np.ndarray]]],
    *,
    runs: int,
    alpha: float,
    rng: Any,
) -> Verdict:
    """Squares of errors over stated ones, in many runs: a chi-squared variable for each figure.

    Errors of the evidence are tested for being too small and too large, those of means for being too small
    (a share that no particle has is given more than it may need). Figures whose error is not told are left
    out.

    Parameters
    ----------
    ask : callable
        ``seed -> SeriesPosterior``.
    exact : float
        Log evidence.
    right : dict
        What to compare with, by figure.
    figures : callable
        Values and stated errors of a posterior, by figure.
    """
    rows: dict[str, list[np.ndarray]] = {"log evidence": [], **{key: [] for key in right}}
    for seed in np.random.SeedSequence(rng).spawn(runs):
        with warnings.catch_warnings(), np.errstate(divide="ignore", invalid="ignore"):
            warnings.simplefilter("ignore", LowEssWarning)
            try:
                found = ask(seed)
            except DegeneracyError:
                continue
            off = np.sum(found.log_marginal_likelihood) - exact
            error = np.sqrt(np.sum(np.square(found.log_marginal_likelihood_mcse)))
            rows["log evidence"].append(np.where(error > 0, off / error, np.nan))
            for key, (value, stated) in figures(found).items():
                off = value - right[key]
                known = np.abs(off) <= 1e-9 * (1.0 + np.abs(value))  # as what is seen: rounding
                ratio = np.where(stated > 0, off / stated, _CERTAIN)
                ratio = np.where(known & (stated <= 1e-9 * (1.0 + np.abs(value))), np.nan, ratio)
                rows[key].append(np.where(np.isfinite(stated), ratio, np.nan))
    comparisons = []
    for key, ratios in rows.items():
        columns = np.reshape(ratios, (len(ratios), -1)).T if ratios else []
        for column in columns:
            z = column[np.isfinite(column) & (column != 0)]
            if len(z) >= runs / 2:
                slack = EVIDENCE if key == "log evidence" else MEANS
                comparisons.append(_judged(key, z, slack, key == "log evidence"))
    return counted(Verdict("stated_errors_test", alpha, comparisons))


def _judged(key: str, z: np.ndarray, slack: float, both: bool) -> Comparison:
    total, n = float((z**2).sum()), len(z)
    p = float(stats.chi2.sf(total / slack**2, n))
    if both:
        p = min(1.0, 2.0 * min(p, float(stats.chi2.cdf(total * slack**2, n))))
    far = abs(float(stats.norm.isf(max(p, 1e-300) / 2)))
    return Comparison(f"errors over stated ones of {key}", np.sqrt(total / n), 1.0, far, p)
