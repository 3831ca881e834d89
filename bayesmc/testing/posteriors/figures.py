"""One node's figures in a posterior and in an exact answer, each with the law that says if they agree.

Probabilities and shares by binomial tails, means by their standard errors, squares and products corrected
for skewness, angles by cosine and sine, and all without Monte Carlo error by a tolerance. Which figures are
asked for, and what becomes of the comparisons, is ``matching``'s affair.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special

from bayesmc.errors import QueryError, UnsupportedError
from bayesmc.results.statistics import near
from bayesmc.testing.oracles.enumeration import Enumerated
from bayesmc.testing.posteriors.samples import Average, Draws
from bayesmc.testing.verdict import Comparison

#: effective number of draws below which a mean or log evidence is not judged: no normal limit yet
MIN_ESS = 100.0
#: the same for averages of squares and products, in draws that decide their error
_MIN_SUPPORT = 30.0
#: nodes of more numbers are judged without their covariances
_MAX_COV = 5
#: accuracy of an exact answer's variances and covariances in units of that of its means
_SQUARES = 100.0
#: standard errors, in units of the figure, that are rounding
_ROUNDING = 1e-12
#: p-values of rare states that were judged because they are too frequent are multiplied by their number and
#: by this: the choice of what to judge looked at the draws, and adds at most a twentieth of ``alpha`` so
_PICKED = 10.0
#: standard deviation, for values about 1, below which a node is taken for constant
_CONSTANT = 1e-7


class Table:
    """Comparisons as they come in."""

    def __init__(self, tolerance: float, min_count: float) -> None:
        self.tolerance = tolerance
        self.min_count = min_count
        self.comparisons: list[Comparison] = []
        self.skipped = 0
        #: states too rare to be judged, and those of them that the draws show often all the same
        self._rare = 0
        self._frequent: list[Comparison] = []

    def rare(self, frequent: Comparison | None) -> None:
        """A state that is too rare to be judged, or a comparison where the draws show it often."""
        self._rare += 1
        if frequent is None:
            self.skipped += 1
        else:
            self._frequent.append(frequent)

    def settle(self) -> None:
        """Take in the rare states that were judged, at the price of having looked for them."""
        for one in self._frequent:
            p_value = min(1.0, _PICKED * self._rare * one.p_value)
            self.add(one.what, one.found, one.exact, one.errors, p_value)
        self._frequent = []

    def add(self, what: str, found: float, exact: float, errors: float, p_value: float) -> None:
        comparison = Comparison(what, float(found), float(exact), float(errors), float(p_value))
        self.comparisons.append(comparison)

    def is_close(self, found: float, exact: float, scale: float = 1.0, times: float = 1.0) -> bool:
        allowed = times * self.tolerance * max(scale, abs(exact))
        return bool(abs(found - exact) <= allowed)

    def equal(
        self, what: str, found: float, exact: float, scale: float = 1.0, times: float = 1.0
    ) -> None:
        """A figure without Monte Carlo error."""
        near_enough = self.is_close(found, exact, scale, times)
        errors, p_value = (0.0, 1.0) if near_enough else (np.inf, 0.0)
        self.add(what, found, exact, errors, p_value)

    def normal(
        self, what: str, found: float, exact: float, error: float, scale: float = 1.0
    ) -> None:
        """A figure with a normal error; what the tolerance explains does not count."""
        excess = max(abs(found - exact) - self.tolerance * max(scale, abs(exact)), 0.0)
        z = excess / error
        self.add(what, found, exact, z, 2.0 * float(scipy.special.ndtr(-z)))

    def average(self, what: str, found: float, exact: float, drawn: Average, scale: float) -> None:
        """A figure with the error and skewness of an average of draws."""
        if drawn.error <= _ROUNDING * scale:
            self.equal(what, found, exact, max(scale, 1.0), _SQUARES)
        elif not np.isfinite(drawn.error) or drawn.support < _MIN_SUPPORT:
            self.skipped += 1
        else:
            shown = Average(float(found), drawn.error, drawn.skewness, drawn.support)
            errors, p_value = shown.p_value(exact, _SQUARES * self.tolerance * scale)
            self.add(what, found, exact, errors, p_value)


@dataclass(frozen=True)
class Pair:
    """One node of a posterior and of the exact answer."""

    table: Table
    posterior: Any
    exact: Any
    name: str
    node: Any
    sample: Draws | None

    def both(self, what: str) -> tuple[np.ndarray, np.ndarray] | None:
        """A figure of both, of one shape; None where one of them has no answer."""
        found, value = (asked(a, what, self.name) for a in (self.posterior, self.exact))
        if found is None or value is None:
            return None
        found, value = np.asarray(found), np.asarray(value)
        if found.shape != value.shape:
            shapes = f"{what} of shape {found.shape}, not {value.shape}"
            raise AssertionError(f"node {self.name!r}: {shapes}")
        return found, value

    def what(self, figure: str, at: tuple[int, ...]) -> str:
        return f"{figure} of node {self.name!r}{_element(at)}"

    def effective(self, shape: tuple[int, ...]) -> np.ndarray:
        """Effective number of draws behind each element; the worst of its states for labels."""
        posterior, node = self.posterior, self.node
        ess = np.asarray(posterior.ess(self.name), dtype=float)
        if node.domain is not None and node.domain.labels is not None:
            ess = ess.min(axis=-1)
        ess = np.where(np.isnan(ess), np.inf if posterior.weight_ess is None else ess, ess)
        if posterior.weight_ess is not None:
            ess = np.fmin(ess, posterior.weight_ess)
        return np.broadcast_to(ess, shape)


def compare_states(pair: Pair) -> None:
    """Probabilities of all states, by binomial tails."""
    table, node = pair.table, pair.node
    figures = pair.both("probabilities")
    if figures is None:
        return
    found, value = figures
    count = pair.effective(value.shape[:-1])
    for at in np.ndindex(value.shape):
        p, q, n = float(value[at]), float(found[at]), float(count[at[:-1]])
        what = f"node {pair.name!r}{_element(at[:-1])}, state {node.domain.states[at[-1]]!r}"
        if p == 0.0 or p > 1 - 1e-12 or not np.isfinite(n) or not np.isfinite(q):
            if p == 0.0 and table.tolerance < 1e-6:
                exactly = table.is_close(q, 0.0) if not np.isfinite(n) else q == 0.0
                table.add(what, q, p, 0.0 if exactly else np.inf, 1.0 if exactly else 0.0)
            else:
                table.equal(what, q, p)
        elif n * p * (1 - p) < table.min_count:
            often = n * q * (1 - q) >= table.min_count
            table.rare(_binomial(table, what, q, p, n) if often else None)
        else:
            table.comparisons.append(_binomial(table, what, q, p, n))


def _binomial(
    table: Table, what: str, q: float, p: float, n: float, shown: tuple[float, float] | None = None
) -> Comparison:
    """Two-sided binomial tail at ``n`` effective draws, interpolated by the incomplete beta function."""
    off = q - p
    off = np.sign(off) * max(abs(off) - table.tolerance, 0.0)
    k = min(max(n * (p + off), 0.0), n)
    above = float(scipy.special.betainc(k, n - k + 1, p)) if k > 0 else 1.0
    below = 1.0 - float(scipy.special.betainc(k + 1, n - k, p)) if k < n else 1.0
    error = np.sqrt(p * (1 - p) / n)
    found, exact = shown or (q, p)
    errors = float(abs(off) / error)
    return Comparison(what, float(found), float(exact), errors, min(1.0, 2 * min(above, below)))


def compare_mean(pair: Pair) -> None:
    """Means, by the larger of the posterior's standard error and the exact variance's."""
    table, posterior = pair.table, pair.posterior
    figures = pair.both("mean")
    if figures is None:
        return
    found, value = figures
    spread = np.sqrt(np.maximum(pair.exact.var(pair.name), 0.0))
    count = pair.effective(value.shape)
    error = np.broadcast_to(posterior.mcse(pair.name), value.shape)
    for at in np.ndindex(value.shape):
        what = pair.what("mean", at)
        m, x, sd, n = float(value[at]), float(found[at]), float(spread[at]), float(count[at])
        if not np.isfinite(m) or (np.isfinite(n) and not np.isfinite(sd)):
            table.skipped += 1  # no mean, or one without a standard error: quantiles judge it
        elif not np.isfinite(n) or not np.isfinite(x) or sd <= 1e-9 * max(1.0, abs(m)):
            table.equal(what, x, m, max(sd, 1.0) if np.isfinite(sd) else 1.0)
        elif n < MIN_ESS:
            table.skipped += 1
        else:
            table.normal(what, x, m, max(sd / np.sqrt(n), float(error[at])), sd)


def compare_var(pair: Pair) -> None:
    """Variances, by the error of squared deviations."""
    table, sample = pair.table, pair.sample
    figures = pair.both("var")
    if figures is None:
        return
    found, value = figures
    count = pair.effective(value.shape)
    drawn = None if sample is None else sample.values(pair.name)
    mean = np.asarray(pair.exact.mean(pair.name))
    for at in np.ndindex(value.shape):
        what = pair.what("variance", at)
        v, x, n = float(value[at]), float(found[at]), float(count[at])
        if not np.isfinite(v):
            continue
        if not np.isfinite(n) or v <= (_CONSTANT * max(1.0, abs(float(mean[at])))) ** 2:
            table.equal(what, x, v, max(v, 1.0), _SQUARES)
        elif not np.isfinite(x):
            table.equal(what, x, v)
        elif drawn is not None and n >= MIN_ESS:
            # about the exact mean it is an average; about its own it errs to second order, too, which is
            # all there is where squares are constant
            x += (float(np.asarray(pair.posterior.mean(pair.name))[at]) - float(mean[at])) ** 2
            column = _column(drawn, at)
            table.average(what, x, v, sample.average((column - mean[at]) ** 2), v)  # type: ignore[union-attr]
        elif drawn is not None:
            table.skipped += 1


def compare_cov(pair: Pair) -> None:
    """Covariances between the numbers of one node; their variances are judged already."""
    table, sample = pair.table, pair.sample
    size = math.prod(pair.node.value_shape)
    if not 2 <= size <= _MAX_COV:
        return
    figures = pair.both("cov")
    if figures is None or not np.isfinite(figures[1]).all():
        return
    found, value = figures
    places = list(np.ndindex(pair.node.value_shape))
    count = pair.effective(pair.node.value_shape)
    spread = np.sqrt(np.maximum(np.diagonal(value), 0.0))
    mean = np.asarray(pair.exact.mean(pair.name), dtype=float).ravel()
    constant = _CONSTANT * max(1.0, float(np.abs(mean).max()))
    values = None if sample is None else sample.values(pair.name)
    drawn = None if values is None else values.reshape(*values.shape[:2], size)
    for j in range(size):
        for i in range(j):
            what = (
                f"covariance of node {pair.name!r}{_element(places[i])} and {_element(places[j])}"
            )
            v, x, scale = float(value[i, j]), float(found[i, j]), float(spread[i] * spread[j])
            if min(spread[i], spread[j]) <= constant:
                continue
            if not np.isfinite(count).any() or not np.isfinite(x):
                table.equal(what, x, v, max(scale, 1.0), _SQUARES)
            elif drawn is not None and count.min() >= MIN_ESS:
                off = np.ravel(pair.posterior.mean(pair.name)) - mean
                x += float(off[i] * off[j])  # as with variances
                a, b = (drawn[..., k] - mean[k] for k in (i, j))
                table.average(what, x, v, sample.average(a * b), scale)  # type: ignore[union-attr]
            elif drawn is not None:
                table.skipped += 1


def compare_quantiles(pair: Pair, levels: Sequence[float]) -> None:
    """The share of draws up to the exact quantile; of exact answers the quantiles themselves.

    What is answered as a quantile must be one of the draws' own, which chance does not excuse.
    """
    if not len(levels) or not hasattr(pair.exact, "quantile"):
        return
    value = asked(pair.exact, "quantile", pair.name, list(levels))
    if value is None:
        return
    count = pair.effective(pair.node.value_shape)
    found = asked(pair.posterior, "quantile", pair.name, list(levels))
    values = None if pair.sample is None else pair.sample.values(pair.name)
    for k, q in enumerate(levels):
        for at in np.ndindex(pair.node.value_shape):
            what = f"{pair.what(f'{100 * q:g}% quantile', at)}"
            x = float(value[(k, *at)])
            if np.isinf(count[at]) and found is not None:
                pair.table.equal(what, float(found[(k, *at)]), x, max(abs(x), 1.0), _SQUARES)
            elif values is not None and np.isfinite(count[at]):
                column = _column(values, at)
                if found is not None and not pair.sample.lies_at(column, float(found[(k, *at)]), q):  # type: ignore[union-attr]
                    own = f"{what} as answered, which is none of the draws"
                    pair.table.add(own, float(found[(k, *at)]), x, np.inf, 0.0)
                _compare_share(pair, what, column, at, x, q, float(count[at]))


def _compare_share(
    pair: Pair,
    what: str,
    column: np.ndarray,
    at: tuple[int, ...],
    x: float,
    q: float,
    most: float,
) -> None:
    """``most`` is the effective number of draws of the node, which chains do not exceed in a tail."""
    assert pair.sample is not None
    p = q
    atom = pair.node.is_discrete or bool((np.abs(column - x) <= 1e-9 * (1 + abs(x))).mean() > 1e-2)
    if atom:
        # a quantile with mass of its own: the exact answer must say how much lies up to it
        mass = asked(pair.exact, "cdf", pair.name, x)
        if mass is None or not pair.node.is_discrete:
            return
        p = float(np.asarray(mass)[at])
    if not 0 < p < 1 or column.min() == column.max():
        return
    share, n = pair.sample.share(column <= x, p)
    if pair.sample.block:  # chains that are slow to reach a tail look independent there
        n = min(n, most)
    if not n * p * (1 - p) >= pair.table.min_count:
        pair.table.skipped += 1
    else:
        shown = f"share of draws up to the {what}"
        pair.table.comparisons.append(_binomial(pair.table, shown, share, p, n))


def compare_angles(pair: Pair) -> None:
    """Cosine and sine, whose means have no seam; figures of exact answers by mean and variance."""
    means, variances = pair.both("mean"), pair.both("var")
    if means is None or variances is None:
        return
    angles = np.broadcast_to(pair.node.angles, pair.node.value_shape)
    (found_mean, mean), (found_var, var) = means, variances
    mean, var = np.array(mean, dtype=float), np.array(var, dtype=float)
    if isinstance(pair.exact, Enumerated):  # its moments are those of numbers
        cosine, sine = (pair.exact.expectation(f, pair.name) for f in (np.cos, np.sin))
        mean = np.where(angles, np.arctan2(sine, cosine), mean)
        var = np.where(angles, -2 * np.log(np.minimum(np.hypot(cosine, sine), 1.0)), var)
    count = pair.effective(pair.node.value_shape)
    drawn = None if pair.sample is None else pair.sample.values(pair.name)
    for at in np.ndindex(pair.node.value_shape):
        n = float(count[at])
        if not angles[at]:
            _compare_number(pair, at, (found_mean, mean), (found_var, var), drawn, n)
        elif not np.isfinite(n):
            turned = float(near(found_mean[at], mean[at]))
            pair.table.equal(pair.what("mean", at), turned, float(mean[at]))
            length, right = (math.exp(-0.5 * float(v[at])) for v in (found_var, var))
            what = pair.what("mean resultant length", at)
            pair.table.equal(what, length, right, 1.0, _SQUARES)
        elif drawn is not None and n >= MIN_ESS:
            for label, turn in (("cosine", np.cos), ("sine", np.sin)):
                x, m = (
                    math.exp(-0.5 * float(v[at])) * float(turn(c[at]))
                    for c, v in ((found_mean, found_var), (mean, var))
                )
                average = pair.sample.average(turn(_column(drawn, at)))  # type: ignore[union-attr]
                pair.table.average(pair.what(f"mean {label}", at), x, m, average, 1.0)
        else:
            pair.table.skipped += 1


def _compare_number(
    pair: Pair,
    at: tuple[int, ...],
    means: tuple[np.ndarray, np.ndarray],
    variances: tuple[np.ndarray, np.ndarray],
    drawn: np.ndarray | None,
    n: float,
) -> None:
    """Mean and variance of a number beside an angle."""
    x, m, v = float(means[0][at]), float(means[1][at]), float(variances[1][at])
    found_var = float(variances[0][at])
    if not np.isfinite(n):
        pair.table.equal(pair.what("mean", at), x, m)
        pair.table.equal(pair.what("variance", at), found_var, v, max(v, 1.0), _SQUARES)
    elif drawn is None or n < MIN_ESS or not np.isfinite(v):
        pair.table.skipped += 1
    else:
        assert pair.sample is not None
        column = _column(drawn, at)
        pair.table.average(
            pair.what("mean", at), x, m, pair.sample.average(column), math.sqrt(max(v, 0.0))
        )
        found_var += (x - m) ** 2  # as in `compare_var`
        squares = pair.sample.average((column - m) ** 2)
        pair.table.average(pair.what("variance", at), found_var, v, squares, v)


# ---- private ------------------------------------------------------------------------------------


def asked(answer: Any, what: str, *arguments: Any) -> Any:
    """A figure of an answer, or None where it cannot say."""
    method: Callable[..., Any] | None = getattr(answer, what, None)
    if method is None:
        return None
    try:
        return method(*arguments)
    except (UnsupportedError, NotImplementedError, QueryError):
        return None


def _element(at: tuple[int, ...]) -> str:
    return f"[{', '.join(map(str, at))}]" if at else ""


def _column(values: np.ndarray, at: tuple[int, ...]) -> np.ndarray:
    """Draws of one number of a node, shape ``(chain, draw)``."""
    place: Any = (..., *at)
    return values[place]
