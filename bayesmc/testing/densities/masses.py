"""What a density integrates to, found without its sampler: by quadrature, summation or importance sampling.

One batch element of a distribution at a time (`Element`). Of single numbers the answer comes with a cdf, of
vectors with independent draws that the density alone has made. Nothing is judged here, but in ``laws``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import scipy.optimize

from bayesmc.distributions import Distribution, InverseCdf
from bayesmc.distributions.support import Support
from bayesmc.shapes import Shape
from bayesmc.testing.posteriors.samples import Average

#: draws of an importance sampler
_DRAWS = 20_000
#: points of the grid along each dimension, by their number
_GRID = {1: 401, 2: 141, 3: 61}
#: how far the double-exponential grid reaches: sinh(pi / 2 sinh(3.2)) is 1e8
_REACH = 3.2
#: values of a discrete variable that are summed at most
_MOST_VALUES = 1 << 20
#: whole numbers below this have neighbours, and halves between them
WHOLE = 2.0**52
#: a term so small beside the sum ends it
_NEGLIGIBLE = 1e-14
#: degrees of freedom of the importance sampler's t distributions
_FREEDOM = 4.0


class Element(Distribution):
    """One batch element of a distribution, as a distribution of its own.

    Parameters
    ----------
    whole : Distribution
    index : tuple of int
        In its batch shape.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.testing.densities.masses import Element
    >>> second = Element(bmc.Normal([0.0, 5.0], 1.0), (1,))
    >>> second.batch_shape, float(second.log_prob(5.0).round(6))
    ((), -0.918939)
    """

    def __init__(self, whole: Distribution, index: Shape) -> None:
        self.whole, self.index = whole, index
        self.event_shape = whole.event_shape
        self.is_discrete = whole.is_discrete  # type: ignore[misc]
        self._support = _support_of(whole.support, whole.batch_shape, index)

    @property
    def support(self) -> Support:
        return self._support

    def figure(self, what: str, *arguments: Any) -> Any:
        """A property or method of the whole, of this element."""
        found = getattr(self.whole, what)
        if arguments:
            shape = np.shape(arguments[0]) + (1,) * len(self.whole.batch_shape)
            found = found(np.reshape(arguments[0], shape))
            found = np.broadcast_to(found, np.shape(arguments[0]) + self.whole.batch_shape)
            at: Any = (..., *self.index)
            return found[at]
        full = self.whole.batch_shape + self.event_shape
        return np.broadcast_to(found, full)[self.index]

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = self.whole.sample(rng, shape)
        return np.array(draws[(slice(None),) * len(shape) + self.index])

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        cut = x.ndim - len(self.event_shape)
        lead, event = x.shape[:cut], x.shape[cut:]
        batch = self.whole.batch_shape
        value = self.whole.log_prob(x.reshape(lead + (1,) * len(batch) + event))
        at: Any = (..., *self.index)
        return np.broadcast_to(value, lead + batch)[at]


@dataclass(frozen=True, eq=False)
class Table:
    """Probabilities of whole numbers.

    Attributes
    ----------
    values, probs : ndarray, shape (values,)
    is_whole : bool
        Whether what was left out is negligible.
    """

    values: np.ndarray
    probs: np.ndarray
    is_whole: bool

    def cdf(self, x: Any) -> np.ndarray:
        below = np.concatenate([[0.0], np.cumsum(self.probs)])
        return below[np.searchsorted(self.values, x, side="right")]


@dataclass(frozen=True, eq=False)
class Rule:
    """Points with masses, whose sums are integrals against a density.

    Attributes
    ----------
    points : ndarray, shape (n, size)
        In unconstrained coordinates.
    masses : ndarray, shape (n,)
    coarse : ndarray, shape (n,) or None
        Masses of every second point, for the error; None where the points are drawn.
    """

    points: np.ndarray
    masses: np.ndarray
    coarse: np.ndarray | None


@dataclass(frozen=True, eq=False)
class Volume:
    """The integral of a density of vectors.

    Attributes
    ----------
    total, error : float
        By quadrature, and how far it may be off; infinite where there is none.
    drawn : Average
        The same by importance sampling.
    draws : ndarray, shape (n, *event_shape)
        Independent draws from the density, perhaps few.
    rules : tuple of Rule
        The product rule, where there is one, and the importance sampler.
    """

    total: float
    error: float
    drawn: Average
    draws: np.ndarray
    rules: tuple[Rule, ...] = ()


def line_of(element: Element, points: np.ndarray) -> InverseCdf:
    """A density of one number, integrated; raises ``ParameterError`` where that fails."""
    return InverseCdf(element, points=np.unique(points[np.isfinite(points)]))


def table_of(element: Element, points: np.ndarray) -> Table:
    """Probabilities of a variable on whole numbers, summed outwards from ``points`` until none counts."""
    low, high = float(element.support.low), float(element.support.high)
    inside = points[(points >= low) & (points <= high) & (np.abs(points) < WHOLE)]
    inside = inside[inside == np.floor(inside)]
    if len(inside):
        start, stop = float(inside.min()), float(inside.max())
    else:
        start = stop = low if np.isfinite(low) else high if np.isfinite(high) else 0.0
    values = np.arange(start, min(stop, start + _MOST_VALUES) + 1)
    probs = np.exp(element.log_prob(values))
    is_whole, last = True, float(values[-1])
    for side in (-1, 1):
        end = low if side < 0 else high
        edge, width, before = (start if side < 0 else last), 64.0, math.inf
        taken = 0
        while edge != end:
            room = abs(end - edge)
            more = edge + side * np.arange(1, min(width, room) + 1)
            added = np.exp(element.log_prob(more))
            values, probs = np.append(values, more), np.append(probs, added)
            edge, width, taken = float(more[-1]), width * 2, taken + len(more)
            found = float(probs.sum())
            share = float(added.sum()) / found if found > 0 else math.inf
            if np.isfinite(end) and abs(end - start) < _MOST_VALUES:
                continue
            if share < _NEGLIGIBLE and before < _NEGLIGIBLE:
                break
            before = share
            if taken > _MOST_VALUES or math.isnan(share):
                is_whole = False
                break
    order = np.argsort(values)
    return Table(values[order], probs[order], is_whole)


def volume_of(element: Element, draws: np.ndarray | None, rng: np.random.Generator) -> Volume:
    """A continuous density of vectors, integrated in unconstrained coordinates.

    By a double-exponential product rule (Takahasi and Mori 1974) up to three dimensions, whose error is the
    change from every second point; and by importance sampling from t distributions about its mode
    and about ``draws``, whose acceptance leaves independent draws.
    """
    transform = element.transform
    shape = transform.unconstrained_shape
    size = math.prod(shape)
    turns = free_angles(element.support, size)

    def log_density(u: np.ndarray) -> np.ndarray:
        u = u.reshape(u.shape[:-1] + shape)
        with np.errstate(all="ignore"):
            value = element.log_prob(transform.constrain(u)) + transform.log_abs_det_jacobian(u)
        return np.where(np.isnan(value), -np.inf, value)

    free = None
    if draws is not None:
        free = free_draws(element, draws)
        free = free[np.isfinite(free).all(axis=1)]
    places = _places(log_density, free, size, turns)
    total, error, rules = math.nan, math.inf, []
    if size in _GRID:
        tried = [_grid(log_density, place, turns) for place in places]
        total, error, rule = min(tried, key=lambda found: found[1])
        rules.append(rule)
    drawn, kept, sampled = _importance(log_density, places, turns, rng)
    values = np.asarray(transform.constrain(kept.reshape(len(kept), *shape)))
    return Volume(total, error, drawn, values, (*rules, sampled))


def free_draws(element: Element, draws: np.ndarray) -> np.ndarray:
    """Draws in unconstrained coordinates, shape (draws, size)."""
    with np.errstate(all="ignore"):
        return np.asarray(element.transform.unconstrain(draws)).reshape(len(draws), -1)


def free_angles(support: Support, size: int) -> np.ndarray:
    """Which of the unconstrained numbers are angles, shape (size,)."""
    if support.kind != "product":
        return np.full(size, support.kind == "circle")
    parts = []
    for part, count in support.parts:
        width = max(count, 1) - (part.kind == "simplex")
        parts.append(np.full(width, part.kind == "circle"))
    return np.concatenate(parts)


# ---- private ------------------------------------------------------------------------------------

#: a centre and a matrix that spreads standard numbers about it
_Place = tuple[np.ndarray, np.ndarray]


def _support_of(support: Support, batch: Shape, index: Shape) -> Support:
    """The support of one batch element, with numbers for bounds."""
    if support.kind not in ("interval", "integers"):
        return support
    low, high = (
        float(np.broadcast_to(b, batch)[index]) if np.ndim(b) <= len(batch) else float(np.min(b))
        for b in (support.low, support.high)
    )
    return Support(support.kind, low, high, support.open_low, support.open_high)


def _places(
    log_density: Callable[[np.ndarray], np.ndarray],
    free: np.ndarray | None,
    size: int,
    turns: np.ndarray,
) -> list[_Place]:
    """About the mode as the density has it, and about the draws as they are."""
    starts = [np.zeros(size)]
    places: list[_Place] = []
    if free is not None and len(free) > 10 * size:
        centre, cov = np.median(free, axis=0), np.atleast_2d(np.cov(free.T))
        places.append((centre, _root(cov, turns)))
        starts.append(free[np.argmax(log_density(free))])
    start = max(starts, key=lambda u: float(log_density(u)))

    def height(u: np.ndarray) -> float:
        value = -float(log_density(u))
        return value if math.isfinite(value) else 1e300

    with np.errstate(all="ignore"):
        simplex = scipy.optimize.minimize(height, start, method="Nelder-Mead",
                                          options={"maxfev": 400 * size})  # fmt: skip
        found = scipy.optimize.minimize(height, simplex.x, method="BFGS")
    inverse = np.asarray(found.hess_inv)
    usable = np.isfinite(inverse).all() and (np.diagonal(inverse) > 0).all()
    places.append((found.x, _root(inverse if usable else np.eye(size), turns)))
    return places


def _root(cov: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """A Cholesky factor in which angles stand alone."""
    cov = np.where(turns[:, None] != turns, 0.0, cov)
    cov = np.where(turns[:, None] & ~np.eye(len(cov), dtype=bool), 0.0, cov)
    scale = np.diag(np.maximum(np.diagonal(cov), 1e-12))
    try:
        return np.linalg.cholesky(cov + 1e-9 * scale)
    except np.linalg.LinAlgError:
        return np.sqrt(scale)


def _grid(
    log_density: Callable[[np.ndarray], np.ndarray], place: _Place, turns: np.ndarray
) -> tuple[float, float, Rule]:
    """The integral by the product rule, how far it may be off, and the rule."""
    centre, root = place
    size = len(centre)
    count = _GRID[size]
    t = np.linspace(-_REACH, _REACH, count)
    axes, weights = [], []
    for turn in turns:
        if turn:
            period = np.linspace(-np.pi, np.pi, count)
            ends = np.where(np.abs(period) == np.pi, 0.5, 1.0)
            axes.append(period)
            weights.append(ends * (period[1] - period[0]))
        else:
            inner = np.pi / 2 * np.sinh(t)
            axes.append(np.sinh(inner))
            weights.append(np.cosh(inner) * np.pi / 2 * np.cosh(t) * (t[1] - t[0]))
    z = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    numbers = ~turns
    u = np.where(turns, z, centre + (z * numbers) @ root.T)
    # sums of logs over a column of the factor that is an angle's own are left out
    log_stretch = np.log(np.diagonal(root)[numbers]).sum()
    points = u.reshape(-1, size)
    values = np.exp(log_density(points) + log_stretch)
    every = np.zeros(count)
    every[::2] = 2.0
    fine = values * _product(weights)
    coarse = values * _product([every * weight for weight in weights])
    total, again = float(fine.sum()), float(coarse.sum())
    if not math.isfinite(total):
        total, again = math.nan, math.inf
    return total, abs(total - again) if total == total else math.inf, Rule(points, fine, coarse)


def _product(weights: list[np.ndarray]) -> np.ndarray:
    """Weights of a product rule, as the points run."""
    found = np.ones(1)
    for weight in weights:
        found = (found[:, None] * weight).ravel()
    return found


def _importance(
    log_density: Callable[[np.ndarray], np.ndarray],
    places: list[_Place],
    turns: np.ndarray,
    rng: np.random.Generator,
) -> tuple[Average, np.ndarray, Rule]:
    """The integral from draws of a mixture of t distributions, the draws that rejection keeps, and all."""
    size = len(turns)
    which = rng.integers(len(places), size=_DRAWS)
    z = rng.normal(size=(_DRAWS, size))
    z /= np.sqrt(rng.chisquare(_FREEDOM, size=(_DRAWS, 1)) / _FREEDOM)
    u = np.empty((_DRAWS, size))
    for k, (centre, root) in enumerate(places):
        u[which == k] = centre + 1.2 * z[which == k] @ root.T
    u = np.where(turns, rng.uniform(-np.pi, np.pi, size=u.shape), u)
    log_proposal = np.logaddexp.reduce([_log_t(u, place, turns) for place in places], axis=0)
    log_proposal -= math.log(len(places)) + turns.sum() * math.log(2 * math.pi)
    log_weight = log_density(u) - log_proposal
    top = log_weight.max()
    if not math.isfinite(top):
        return Average(0.0, 0.0, 0.0, 0.0), u[:0], Rule(u[:0], np.empty(0), None)
    weights = np.exp(log_weight - top)
    found, scale = Average.of(weights), math.exp(min(top, 700.0))
    support = found.support if found.error > 0 else float(_DRAWS)
    average = Average(found.value * scale, found.error * scale, found.skewness, support)
    accepted = rng.random(_DRAWS) < weights
    accepted[weights.argmax()] = False  # given the largest weight, the others are independent
    return average, u[accepted], Rule(u, weights, None)


def _log_t(u: np.ndarray, place: _Place, turns: np.ndarray) -> np.ndarray:
    """Log density of numbers that are no angles under a multivariate t distribution about a place."""
    centre, root = place
    keep = ~turns
    size = int(keep.sum())
    if not size:
        return np.zeros(len(u))
    root = 1.2 * root[np.ix_(keep, keep)]
    z = scipy.linalg.solve_triangular(root, (u - centre)[:, keep].T, lower=True)
    half = 0.5 * (_FREEDOM + size)
    constant = math.lgamma(half) - math.lgamma(0.5 * _FREEDOM)
    constant -= 0.5 * size * math.log(_FREEDOM * math.pi) + np.log(np.diagonal(root)).sum()
    return constant - half * np.log1p((z**2).sum(axis=0) / _FREEDOM)
