"""A density held against its integral: total, draws, mean and variance, cdf and quantiles.

One batch element at a time, of single numbers (`check_line`), whole numbers (`check_table`) and vectors
(`check_volume`); what a density integrates to is found in ``masses``, shapes and supports are ``densities``'.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import scipy.special

from bayesmc.errors import ParameterError, UnsupportedError
from bayesmc.testing.densities.masses import Element, Table, Volume, line_of, volume_of
from bayesmc.testing.densities.moments import (
    check_moments,
    check_scores,
    check_table_scores,
)
from bayesmc.testing.densities.reports import Report
from bayesmc.testing.kernels.uniformity import uniformity_p_value
from bayesmc.testing.posteriors.samples import Average, energy_comparison

#: an integral is one within this, or within what the rule itself doubts
_ROUNDING = 1e-6
#: figures that are given and integrated agree to this, in standard deviations
_FIGURES = 1e-4
#: a rule that doubts more than this decides nothing
_DOUBT = 0.02
#: cells of the probability integral transform
_CELLS = 20
#: expected counts above which the chi-square limit is taken: within a few per cent in the tail
_MANY = 50.0
#: expected counts of cells of whole numbers, at least
_EXPECTED = 10.0
#: draws that effectively decide an error, at least
_SUPPORT = 30.0
#: rows of vectors that are compared
_ROWS = 400
#: what distances are held against
_KIND = "on average, were the sampler right"
#: components of a vector that are looked at
_COMPONENTS = 24


def check_line(
    element: Element, samples: np.ndarray | None, places: np.ndarray, report: Report
) -> None:
    """A continuous density of one number; ``places`` say where its mass may be."""
    is_angle = element.support.kind == "circle"
    levels = np.quantile(places[np.isfinite(places)], [0.05, 0.25, 0.5, 0.75, 0.95])
    try:
        law = line_of(element, levels)
    except ParameterError as error:
        report.fault(f"the density has no integral: {error}")
        return
    total = float(np.exp(law.log_normalizer))
    words = f"the density integrates to {total:.6g}, not to 1"
    report.agree("integral", total, 1.0, _ROUNDING, words)
    if samples is not None:
        values = samples.astype(float)
        if is_angle:
            values = np.mod(values + np.pi, 2 * np.pi) - np.pi
        levels = np.asarray(law.cdf(values[~np.isnan(values)]))
        _check_transform(levels, report)
        check_scores(levels, report)
    if is_angle:
        grid = law.ppf((np.arange(8192) + 0.5) / 8192)
        _check_direction(element, np.exp(1j * np.asarray(grid)).mean(), report)
        return
    spread = float(np.sqrt(law.var))
    _check_figures(element, float(law.mean), spread, report)
    q = np.linspace(0.05, 0.95, 7)
    _check_cdf(element, np.asarray(law.ppf(q)), q, law.cdf, report)


def _check_transform(levels: np.ndarray, report: Report) -> None:
    """Draws through the cdf are uniform: Kolmogorov's statistic, and counts of equal cells."""
    u = np.sort(levels)
    n = len(u)
    steps = np.arange(1, n + 1) / n
    gap = float(max((steps - u).max(), (u - steps + 1 / n).max()))
    p_value = min(1.0, 2.0 * float(scipy.special.smirnov(n, min(gap, 1.0))))  # bounds both sides
    report.judge(
        "draws against the cdf (Kolmogorov's distance)",
        gap,
        0.0,
        gap * math.sqrt(n),
        p_value,
    )
    counts = np.bincount(np.minimum((u * _CELLS).astype(int), _CELLS - 1), minlength=_CELLS)
    pearson = float(((counts - n / _CELLS) ** 2).sum() / (n / _CELLS))
    if n < _MANY * _CELLS:
        p_value = uniformity_p_value(counts)
    else:
        p_value = float(scipy.special.chdtrc(_CELLS - 1, pearson))
    what = "draws against the density (chi-square of 20 cells)"
    _judge_pearson(report, what, pearson, _CELLS - 1, p_value)


def _judge_pearson(report: Report, what: str, pearson: float, freedom: int, p: float) -> None:
    report.judge(what, pearson, freedom, (pearson - freedom) / math.sqrt(2 * freedom), p, _KIND)


def _check_direction(element: Element, resultant: complex, report: Report) -> None:
    mean, length = _given(element, "mean"), abs(resultant)
    if mean is not None and length > 1e-3:
        off = float(np.abs(np.exp(1j * mean) - resultant / length))
        words = f"mean is {float(mean):.6g}, by the integral {np.angle(resultant):.6g}"
        report.agree("mean direction", off, 0.0, 10 * _FIGURES, words)
    var = _given(element, "var")
    if var is not None and length > 1e-3:
        words = f"var is {float(var):.6g}, by the integral {-2 * math.log(length):.6g} (-2 log R)"
        report.agree("circular variance", math.exp(-float(var) / 2), length, 10 * _FIGURES, words)


def _check_figures(element: Element, mean: float, spread: float, report: Report) -> None:
    given = _given(element, "mean")
    if given is not None and np.isfinite(mean):
        words = f"mean is {float(given):.6g}, by the integral {mean:.6g}"
        unit = spread if np.isfinite(spread) else abs(mean) + 1.0
        report.agree("mean", float(given), mean, _FIGURES * unit + 1e-9 * abs(mean), words)
    given = _given(element, "var")
    if given is not None and np.isfinite(spread):
        words = f"var is {float(given):.6g}, by the integral {spread**2:.6g}"
        report.agree("variance", float(given), spread**2, 10 * _FIGURES * spread**2, words)


def _given(element: Element, what: str) -> np.ndarray | None:
    """A figure that the distribution gives, or None."""
    try:
        found = np.asarray(element.figure(what), dtype=float)
    except (UnsupportedError, NotImplementedError, AttributeError):
        return None
    return found


def _check_cdf(
    element: Element,
    points: np.ndarray,
    levels: np.ndarray,
    right: Callable[[np.ndarray], np.ndarray],
    report: Report,
) -> None:
    """``cdf`` and ``ppf``, where they are given, against the integral."""
    try:
        found = np.asarray(element.figure("cdf", points))
    except (UnsupportedError, NotImplementedError):
        pass
    else:
        expected = np.asarray(right(points))
        at = int(np.argmax(np.abs(found - expected)))
        words = f"cdf({points[at]:.6g}) is {found[at]:.6g}, by the integral {expected[at]:.6g}"
        report.agree("cdf", float(found[at]), float(expected[at]), 1e-5, words)
    try:
        found = np.asarray(element.figure("ppf", levels))
    except (UnsupportedError, NotImplementedError):
        return
    if element.is_discrete:
        off = np.where(found == points, 0.0, 1.0)
    else:
        off = np.abs(np.asarray(right(found)) - levels)
    at = int(np.argmax(off))
    words = f"ppf({levels[at]:.6g}) is {found[at]:.6g}, by the integral {points[at]:.6g}"
    report.agree("ppf", float(off[at]), 0.0, 1e-5, words)


def check_table(element: Element, samples: np.ndarray | None, table: Table, report: Report) -> None:
    """Probabilities of whole numbers."""
    bad = np.isnan(table.probs)
    if bad.any():
        report.fault(f"log_prob is nan at {table.values[bad][0]:.0f}")
        return
    total = float(table.probs.sum())
    if not table.is_whole and not total > 1 + _ROUNDING:
        report.remark("sum of the probabilities: its tail is too long to be summed")
        if samples is not None:
            _check_window(samples, table, report)
        return
    words = f"the probabilities sum to {total:.6g}, not to 1"
    report.agree("sum", total, 1.0, _ROUNDING, words)
    if not total > 0:
        return
    probs = table.probs / total
    if samples is not None:
        _check_counts(samples, table.values, probs, report)
        check_table_scores(samples, table.values, probs, report)
    mean = float(table.values @ probs)
    _check_figures(element, mean, math.sqrt(float((table.values - mean) ** 2 @ probs)), report)
    below = np.cumsum(probs)
    # halfway up steps, where rounding does not choose the value
    heavy = np.flatnonzero(probs > 1e-6)
    heavy = heavy[np.linspace(0, len(heavy) - 1, min(7, len(heavy))).astype(int)]
    normal = Table(table.values, probs, True)
    _check_cdf(element, table.values[heavy], below[heavy] - probs[heavy] / 2, normal.cdf, report)


def _check_window(samples: np.ndarray, table: Table, report: Report) -> None:
    """Half of the draws choose a range of values; how many of the others fall in it is binomial."""
    from scipy.stats import binomtest

    first, second = np.array_split(samples, 2)
    values, probs = table.values, table.probs
    inside = (values >= first.min()) & (values <= first.max())
    if not inside.any():
        return
    low, high, p = values[inside][0], values[inside][-1], min(float(probs[inside].sum()), 1.0)
    kept = second[(second >= low) & (second <= high)]
    n = len(second)
    z = abs(len(kept) - n * p) / math.sqrt(max(n * p * (1 - p), 1.0))
    what = f"share of the draws from {low:.0f} to {high:.0f}"
    p_value = float(binomtest(len(kept), n, p).pvalue)
    report.judge(what, len(kept) / n, p, z, p_value)
    if p > 0 and len(kept):
        _check_counts(kept, values[inside], probs[inside] / probs[inside].sum(), report)


def _check_counts(
    samples: np.ndarray, values: np.ndarray, probs: np.ndarray, report: Report
) -> None:
    """Counts of neighbouring values, merged until ten of each are expected, by Pearson's chi-square."""
    n = len(samples)
    expected = n * probs
    cell = np.zeros(len(values), dtype=int)
    mass, current = 0.0, 0
    for i, e in enumerate(expected.tolist()):
        if mass >= _EXPECTED:
            current, mass = current + 1, 0.0
        cell[i], mass = current, mass + e
    if mass < _EXPECTED and current:  # too little is left for a cell of its own
        cell[cell == current] = current - 1
    size = int(cell.max()) + 1
    if size < 2:
        return
    at = np.clip(np.searchsorted(values, samples), 0, len(values) - 1)
    counts = np.bincount(cell[at], minlength=size)
    wanted = np.bincount(cell, weights=expected, minlength=size)
    pearson = float(((counts - wanted) ** 2 / wanted).sum())
    p_value = float(scipy.special.chdtrc(size - 1, pearson))
    what = f"draws against the probabilities (chi-square of {size} cells)"
    _judge_pearson(report, what, pearson, size - 1, p_value)


def check_volume(element: Element, samples: np.ndarray | None, report: Report) -> None:
    """A continuous density of vectors or matrices."""
    with np.errstate(all="ignore"):
        volume = volume_of(element, samples, report.rng)
    _judge_total(volume, report)
    if samples is None:
        return
    flat = samples.reshape(len(samples), -1)
    if len(volume.draws) >= _SUPPORT:
        rows = volume.draws[:_ROWS].reshape(-1, flat.shape[1])
        angles = ["x"] if element.support.kind == "circle" else []
        found = energy_comparison(
            {"x": flat[:_ROWS]}, {"x": rows}, report.level, report.rng, angles, what="draws"
        )
        report.judge(
            "draws against the density (energy distance)",
            found.found, found.exact, found.errors, found.p_value, _KIND,
        )  # fmt: skip
    else:
        report.remark("draws against the density: too few draws could be made from it")
    with np.errstate(all="ignore"):
        check_moments(element, samples, volume, report)
    turns = element.support.angles(flat.shape[1])
    for what in ("mean", "var"):
        given = _given(element, what)
        if given is None:
            continue
        for k, exact in enumerate(given.ravel().tolist()):
            if not turns[k] and k < _COMPONENTS and np.isfinite(exact):
                column = flat[:, k] if what == "mean" else (flat[:, k] - flat[:, k].mean()) ** 2
                label = f"{what} of component {k}, from draws"
                if np.ptp(column) > 1e-12 * max(1.0, abs(exact)):
                    report.average(label, Average.of(column), exact, abs(exact) + 1.0)
                else:
                    report.agree(label, float(column.mean()), exact, 1e-9, f"{label}: not {exact}")


def _judge_total(volume: Volume, report: Report) -> None:
    total, error = volume.total, volume.error
    if error < _DOUBT * max(abs(total), 1.0):
        words = f"the density integrates to {total:.6g}, not to 1"
        report.agree("integral", total, 1.0, max(1e-4, error), words)
    elif volume.drawn.error == 0 and volume.drawn.value == 0:
        report.fault("the density is zero wherever it was looked at, and cannot be integrated")
    elif volume.drawn.error == 0:
        total = volume.drawn.value
        words = f"the density integrates to {total:.6g}, not to 1"
        report.agree("integral", total, 1.0, 1e-9, words)
    else:
        report.average("integral, by importance sampling", volume.drawn, 1.0, 1.0)
