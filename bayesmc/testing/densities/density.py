"""Is a density what it says? Its integral, its sampler, its shapes and figures held against each other.

For users' own densities, and for any family: what the log density integrates to is worked out without the
sampler (``masses``), and everything else is compared with that. Faults that need no statistics are said in
words; the rest is judged by p-values, all together under one false-alarm rate.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special

from bayesmc.distributions import Distribution, as_distribution
from bayesmc.errors import BayesmcError, ShapeError, UnsupportedError
from bayesmc.randomness import seed_sequence
from bayesmc.shapes import nearly_equal
from bayesmc.testing.densities.laws import check_line, check_table, check_volume
from bayesmc.testing.densities.masses import WHOLE, Element, table_of
from bayesmc.testing.densities.reports import Fault, Report
from bayesmc.testing.verdict import Verdict, check_level, counted

#: batch elements that are looked at
_ELEMENTS = 3
#: points at which shapes and signs are tried
_POINTS = 24


@dataclass(frozen=True, eq=False, repr=False)
class DensityCheck(Verdict):
    """What is wrong with a density; true where nothing is.

    Attributes
    ----------
    remarks : tuple of str
        What could not be checked, and why.
    """

    remarks: tuple[str, ...] = ()

    @property
    def faults(self) -> tuple[str, ...]:
        """Everything that is wrong, in words."""
        return tuple(map(str, self.rejected))

    def _remarks(self) -> list[str]:
        return [f"  not checked: {remark}" for remark in self.remarks]


def check_density(
    density: Any,
    *,
    draws: int = 10_000,
    gaps: bool = False,
    alpha: float = 1e-3,
    rng: Any = None,
) -> DensityCheck:
    """Hold a density against itself: integral, draws, support, shapes, moments, cdf and quantiles.

    - It integrates to 1: by adaptive quadrature (one number), a product rule (two or three), summation (whole
      numbers), importance sampling (more). Counts of several kinds are not summed.
    - Its draws follow it: of numbers, Kolmogorov's statistic, a chi-square of the probability integral
      transform, and mean and variance of the normal scores; of whole numbers a chi-square and the scores; of
      vectors means, squares and products of up to six numbers in unconstrained coordinates (far values drawn
      in) against their integrals, and the energy distance from draws that the density alone has made (by
      rejection). They lie in the support, and are independent along every axis.
    - The log density is finite inside the support (it may be -inf on whole numbers, and anywhere with
      ``gaps``), -inf outside, and nowhere NaN.
    - Shapes: every batch and sample shape gives the same values, element by element.
    - ``mean``, ``var``, ``cdf`` and ``ppf``, where they are given, agree with the integral.

    A right density fails with probability at most ``alpha`` (Holm's method over all comparisons). That
    is exact for draws of single numbers and for vectors (but for the chi-square, which is a limit from 1000
    draws on), a limit of many draws for whole numbers, moments of vectors, independence, and integrals in
    four or more dimensions. Up to three batch elements are looked at.

    Parameters
    ----------
    density : Distribution
        A ``Density``, a family's or your own; or a frozen ``scipy.stats`` distribution.
    draws : int
        To take from its sampler, 100 or more.
    gaps : bool
        Whether it may be zero inside its support.
    alpha : float
        Family-wise false-alarm rate.
    rng : seed, Generator or None

    Returns
    -------
    DensityCheck
        Its ``faults`` say all that is wrong; so ``assert check_density(density)`` does.

    Raises
    ------
    TypeError
        ``density`` is no distribution.

    References
    ----------
    Kolmogorov (1933); Rosenblatt (1952), Remarks on a multivariate transformation, Ann. Math. Statist. 23;
    Szekely and Rizzo (2004), InterStat 5; Takahasi and Mori (1974), Publ. RIMS 9.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.testing import check_density
    >>> right = bmc.Density(lambda x: np.log(2 * x), lambda rng, shape: np.sqrt(rng.random(shape)),
    ...                     support="unit interval")
    >>> bool(check_density(right, rng=0))
    True
    >>> wrong = bmc.Density(lambda x: np.log(3 * x), support="unit interval")
    >>> check_density(wrong, rng=0).faults
    ('the density integrates to 1.5, not to 1',)
    """
    dist = as_distribution(density)
    if dist is None:
        raise TypeError(
            f"check_density({density!r:.80}): give a distribution, such as bmc.Density(log_prob, sample); "
            "of a node of a net, use check_cpd(net, name)"
        )
    if isinstance(draws, bool) or not isinstance(draws, (int, np.integer)) or draws < 100:
        raise ValueError(f"check_density(draws={draws!r}): give a whole number, 100 or more")
    check_level("check_density", alpha)
    report = Report(alpha, np.random.default_rng(seed_sequence(rng)))
    inspect(dist, report, int(draws), gaps)
    found = report.comparisons
    return counted(DensityCheck("check_density", alpha, found, 0, tuple(report.remarks)))


def inspect(dist: Distribution, report: Report, draws: int, gaps: bool) -> None:
    """All checks of a distribution, into a report."""
    place = report.place
    try:
        batch = dist.batch_shape
        samples = _samples(dist, report, draws)
        points = _points(dist, samples)
        _check_shapes(dist, points, report)
    except (BayesmcError, ValueError, TypeError, IndexError) as error:
        report.fault(str(error))
        return
    every = list(np.ndindex(batch))
    chosen = [every[i] for i in np.unique(np.linspace(0, len(every) - 1, _ELEMENTS).astype(int))]
    for index in chosen if every else ():
        report.place = place + (f"batch element {index}: " if batch else "")
        own = None if samples is None else samples[(slice(None), *index)]
        try:
            _check_element(Element(dist, index), own, points[(slice(None), *index)], report, gaps)
        except (BayesmcError, ValueError, TypeError, IndexError) as error:
            report.fault(str(error))
    report.place = place
    if samples is not None and len(chosen) > 1:
        pairs = [(samples[(slice(None), *i)], samples[(slice(None), *chosen[-1])]) for i in chosen]
        for index, (a, b) in zip(chosen[:-1], pairs[:-1], strict=True):
            _uncorrelated(
                f"rank correlation of draws of batch elements {index} and {chosen[-1]}",
                a,
                b,
                report,
            )


# ---- shapes -------------------------------------------------------------------------------------


def _samples(dist: Distribution, report: Report, draws: int) -> np.ndarray | None:
    """Draws, shape ``(draws, *batch, *event)``; None where there is no sampler."""
    if not getattr(dist, "can_sample", True):
        report.remark("draws: the density was given without a way to sample it")
        return None
    seed = int(report.rng.integers(2**31))
    try:
        samples = np.asarray(dist.sample(seed, draws))
    except UnsupportedError as error:
        report.remark(f"draws: {error}")
        return None
    if samples.dtype.kind not in "biuf":
        raise TypeError(f"sample gives {samples.dtype} numbers; return real ones")
    event = dist.batch_shape + dist.event_shape
    for lead in ((), (3,), (2, 3)):
        shape = np.shape(dist.sample(seed, lead))
        if shape != lead + event:
            report.fault(
                f"sample(rng, {lead}) has shape {shape}, not sample_shape + batch_shape + event_shape = "
                f"{lead + event}"
            )
    if samples.shape != (draws, *event):
        raise ShapeError(
            f"sample(rng, ({draws},)) has shape {samples.shape}, not {(draws, *event)}"
        )
    if not np.array_equal(samples, dist.sample(seed, draws), equal_nan=True):
        report.fault(
            "two samples with the same seed differ: take all randomness from the given rng"
        )
    else:
        report.fine("sample follows the seed")
    return samples


def _points(dist: Distribution, samples: np.ndarray | None) -> np.ndarray:
    """Points of the support, shape ``(points, *batch, *event)``."""
    shape = dist.batch_shape + dist.event_shape
    if samples is not None:
        return samples[:_POINTS]
    if dist.is_discrete:
        return np.stack([np.broadcast_to(k, shape) for k in _whole_numbers(dist)])
    free = dist.transform.unconstrained_shape
    u = np.random.default_rng(0).normal(0.0, 1.5, size=(_POINTS, *dist.batch_shape, *free))
    return np.broadcast_to(dist.constrain(u), (_POINTS, *shape))


def _whole_numbers(dist: Distribution) -> np.ndarray:
    support = dist.support
    if support.kind == "counts":
        return np.arange(3.0)
    low, high = float(np.max(support.low)), float(np.min(support.high))
    start = low if np.isfinite(low) else high - _POINTS if np.isfinite(high) else -_POINTS / 2
    return np.arange(start, min(high, start + _POINTS - 1) + 1)


def _check_shapes(dist: Distribution, points: np.ndarray, report: Report) -> None:
    """``log_prob`` of many points at once against one by one, in several shapes."""
    batch, event = dist.batch_shape, dist.event_shape
    count = len(points)
    whole = np.asarray(dist.log_prob(points))
    if whole.shape != (count, *batch):
        raise ShapeError(
            f"log_prob of values of shape {points.shape} has shape {whole.shape}, not {(count, *batch)}: "
            "reduce the event axes and leave the others alone"
        )
    again = np.asarray(dist.log_prob(points))
    if not nearly_equal(whole, again):
        report.fault("log_prob gives other values when it is asked again")
    wrong = [i for i in range(count) if not _same(dist.log_prob(points[i]), whole[i])]
    if wrong:
        alone = np.ravel(dist.log_prob(points[wrong[0]]))
        report.fault(
            f"log_prob does not broadcast: {_short(np.ravel(whole[wrong[0]]))} at {_short(points[wrong[0]])} "
            f"among others, {_short(alone)} alone"
        )
    half = count // 2
    paired = dist.log_prob(points[: 2 * half].reshape(2, half, *batch, *event))
    if not _same(paired, whole[: 2 * half].reshape(2, half, *batch)):
        report.fault(
            "log_prob does not broadcast: values with two leading axes give other densities"
        )
    origin: Any = (slice(None), *(0,) * len(batch))
    spread = np.asarray(dist.log_prob(points[origin].reshape(count, *(1,) * len(batch), *event)))
    if not _same(spread[origin], whole[origin]):
        report.fault("log_prob does not broadcast: one value for all batch elements gives others")
    if not report.comparisons or not isinstance(report.comparisons[-1], Fault):
        report.fine("log_prob broadcasts")


def _same(found: Any, expected: np.ndarray) -> bool:
    found = np.asarray(found)
    if found.shape != expected.shape:
        return False
    return bool(np.allclose(found, expected, rtol=1e-8, atol=1e-10, equal_nan=True))


# ---- one batch element --------------------------------------------------------------------------


def _check_element(
    element: Element, samples: np.ndarray | None, points: np.ndarray, report: Report, gaps: bool
) -> None:
    _check_inside(element, samples, points, report, gaps)
    _check_outside(element, points, report)
    if samples is not None:
        _check_order(samples, report)
    if element.support.kind == "counts":
        report.remark("integral and draws: counts of several kinds are not summed")
        return
    if element.event_shape and element.is_discrete:
        report.remark("integral and draws: discrete vectors are not summed")
        return
    places = _numeric(samples if samples is not None else points)
    if element.event_shape:
        check_volume(element, samples, report)
    elif element.is_discrete:
        check_table(element, samples, table_of(element, places.ravel()), report)
    else:
        check_line(element, samples, places.ravel(), report)


def _check_inside(
    element: Element, samples: np.ndarray | None, points: np.ndarray, report: Report, gaps: bool
) -> None:
    """Finite and no NaN where the support is, draws in it."""
    before = len(report.comparisons)
    if samples is not None:
        inside = np.asarray(element.support.contains(samples))
        spare = inside.ndim - 1
        inside = np.asarray(inside.all(axis=tuple(range(1, 1 + spare))) if spare else inside)
        if not inside.all():
            report.fault(
                f"sample gives {_short(samples[~inside][0])}, off the support "
                f"({element.support.describe()})"
            )
            samples = samples[inside]
    tried = {"at its own draw": samples, "in the support at": _inner(element, points)}
    for where, values in tried.items():
        if values is None or not len(values):
            continue
        log = np.asarray(element.log_prob(values))
        may_vanish = where != "at its own draw" and (gaps or element.is_discrete)
        bad = ~(log < np.inf) if may_vanish else ~np.isfinite(log)
        if bad.any():
            first = values[bad][0]
            report.fault(f"log_prob is {log[bad][0]} {where} {_short(first)}")
    if len(report.comparisons) == before:
        report.fine("log_prob is finite on the support")


def _inner(element: Element, points: np.ndarray) -> np.ndarray:
    """Points well inside the support that no sampler has chosen."""
    if element.is_discrete:
        return points
    shape = element.transform.unconstrained_shape
    free = np.random.default_rng(1).uniform(-4.0, 4.0, size=(_POINTS, *shape))
    known = np.asarray(element.unconstrain(points))
    usable = known[np.isfinite(known).reshape(len(known), -1).all(axis=1)]
    if len(usable):  # about where the mass is, and as far apart
        centre, spread = np.median(usable, axis=0), usable.std(axis=0)
        free = np.concatenate([free * np.where(spread > 0, spread, 1.0) + centre, usable])
    return np.asarray(element.constrain(free))


def _check_outside(element: Element, points: np.ndarray, report: Report) -> None:
    """Minus infinity off the support."""
    before = len(report.comparisons)
    for value in _outer(element, points):
        log = float(element.log_prob(value))
        if log != -np.inf:
            report.fault(
                f"log_prob is {log:.6g} at {_short(value)}, off the support "
                f"({element.support.describe()}); it must be -inf there"
            )
    if len(report.comparisons) == before:
        report.fine("log_prob is -inf off the support")


def _outer(element: Element, points: np.ndarray) -> Iterator[np.ndarray]:
    support, shape = element.support, element.event_shape
    kind = support.kind
    if kind in ("interval", "integers"):
        step = 1.0 if kind == "integers" else 0.5
        ends = [(support.low, -step), (support.high, step)]
        numbers = [b + s * max(1.0, abs(b) * 1e-6) for b, s in ends if np.isfinite(b)]
        first = float(np.ravel(points)[0])
        if kind == "integers" and abs(first) < WHOLE:
            numbers.append(math.floor(first) + 0.5)
        for number in numbers:
            value = np.array(points[0], dtype=float)
            value[(0,) * len(shape)] = number
            yield value
    elif kind == "simplex":
        yield np.full(shape, 2.0 / shape[0])
        if shape[0] > 1:
            value = np.zeros(shape)
            value[:2] = 1.5, -0.5
            yield value
    elif kind in ("positive definite", "correlation"):
        yield -np.eye(shape[0])
    elif kind == "counts":
        yield np.full(shape, -1.0)
        yield np.full(shape, 0.5)


def _check_order(samples: np.ndarray, report: Report) -> None:
    """Successive draws are independent."""
    _uncorrelated("rank correlation of successive draws", samples[:-1], samples[1:], report)


def _uncorrelated(what: str, a: np.ndarray, b: np.ndarray, report: Report) -> None:
    """Spearman's correlation of the first numbers of two columns, normal in the limit."""
    first, second = (_rank(np.asarray(v).reshape(len(v), -1)[:, 0]) for v in (a, b))
    if first.std() == 0 or second.std() == 0:
        return
    correlation = float(np.corrcoef(first, second)[0, 1])
    z = abs(correlation) * math.sqrt(len(first) - 1)
    report.judge(what, correlation, 0.0, z, 2 * scipy.special.ndtr(-z))


def _rank(column: np.ndarray) -> np.ndarray:
    _, inverse, counts = np.unique(column, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - (counts - 1) / 2)[inverse]


def _numeric(values: np.ndarray) -> np.ndarray:
    return np.asarray(values, dtype=float)


def _short(value: Any) -> str:
    return " ".join(np.array2string(np.asarray(value), precision=6, threshold=8).split())
