"""Sampling of any one-dimensional density by the inverse of its cdf, found by quadrature.

The support is mapped to a line on which power laws at its ends become exponentials; ``panels``
integrates there. Outside what the map and the panels resolve, there is an error and no answer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions.adapt import as_distribution
from bayesmc.distributions.base import Distribution, as_float, as_quantile
from bayesmc.distributions.density import Density
from bayesmc.distributions.panels import Panels, adapt
from bayesmc.distributions.support import Support, interval, real
from bayesmc.errors import ParameterError, UnsupportedError
from bayesmc.shapes import Shape, first_index

_REACH = 340.0  # exp of twice this is still a number
_TOLERANCE = 1e-10
_ACCEPTED = 1e-8  # relative error of the integral with which an answer is given
_ENDS = 1e-11  # share of an outermost panel
#: nearer than this many units in the last place to a bound, distances from it have no digits
_BLUR = 2.0**26


class InverseCdf(Distribution):
    """A continuous density of one number, normalised and sampled through the inverse of its cdf.

    The density is integrated adaptively (Gauss-Kronrod panels, relative error 1e-10 asked, 1e-8
    required), which takes some thousand evaluations per batch element when it is built; cdf,
    quantiles and draws then cost none. So a density that depends on parents is dear: it is built
    anew, in about a millisecond, for each configuration. Modes are looked for where the log density
    points to them. A spike narrower than a thousandth of its distance from the bounds (from zero,
    where there are none) whose log density does not show on the wider mass about it can escape any
    such scheme: name it in ``points``.

    Parameters
    ----------
    density : Density, Distribution, frozen scipy.stats distribution or callable
        What to sample, up to a constant factor; a function maps values to log densities,
        broadcasting with its batch as in ``Density``. Other distributions need only a
        ``log_prob`` and a support.
    low, high : array_like, optional
        Bounds, where the support of ``density`` is wider than wanted.
    points : sequence of float
        Where to look closely: modes, kinks, jumps.

    Attributes
    ----------
    log_normalizer : ndarray
        Log of the integral of ``exp(density.log_prob(x))``.

    Raises
    ------
    ParameterError
        ``high`` is not above ``low``, or the density's integral is zero, infinite or not resolved,
        or the log density is NaN or plus infinity inside the bounds.
    DensityError
        A function fails on arrays, or does not return numbers.
    UnsupportedError
        ``density`` is discrete or has vectors as values.

    References
    ----------
    Devroye, Non-Uniform Random Variate Generation, 1986, section II.2; Derflinger, Hörmann and
    Leydold, ACM Transactions on Modeling and Computer Simulation 20, 2010.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> flat_top = bmc.InverseCdf(bmc.Density(lambda x: -(x**4)))
    >>> float(flat_top.log_normalizer.round(6)), float(flat_top.var.round(6))
    (0.594875, 0.337989)
    >>> flat_top.sample(rng=0, sample_shape=3).round(3).tolist()
    [0.248, -0.42, -0.968]
    """

    def __init__(
        self, density: Any, low: Any = None, high: Any = None, *, points: Any = ()
    ) -> None:
        self.density = _usable(density)
        start, stop = _bounds(self.density.support)
        low = start if low is None else np.maximum(start, as_float(low))
        high = stop if high is None else np.minimum(stop, as_float(high))
        self._set_batch(self.density.batch_shape, low.shape, high.shape)
        self._adopt(self.density)
        ok = low < high
        if not ok.all():
            shown = np.broadcast_to(high, ok.shape)[first_index(~ok)]
            self._reject("high", shown, ~ok, "above low, within the support")
            low, high = np.where(ok, low, start), np.where(ok, high, stop)
        self.low, self.high = low, high
        lead = (-1,) + (1,) * len(self.batch_shape)
        self._points = as_float(points).reshape(lead)
        with np.errstate(all="ignore"):
            self._build()

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        return [*self.density.parameters(), (self.low, 0), (self.high, 0)]

    @property
    def log_normalizer(self) -> np.ndarray:
        panels = self._panels
        value = np.log(np.where(panels.total > 0, panels.total, 1.0)) + panels.log_scale
        return value.reshape(self.batch_shape)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        return self._quantile(rng.random(shape) + 2.0**-54)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        outside = (x < self.low) | (x > self.high)
        return np.where(outside, -np.inf, self.density.log_prob(x) - self.log_normalizer)

    @property
    def mean(self) -> np.ndarray:
        """Infinite where the integral diverges at one end, NaN where at both."""
        return self._moments[0]

    @property
    def var(self) -> np.ndarray:
        """Infinite where the integral diverges, NaN where the mean is not finite."""
        return self._moments[1]

    @property
    def support(self) -> Support:
        if np.all(np.isneginf(self.low)) and np.all(np.isposinf(self.high)):
            return real
        support = self.density.support
        if support.kind != "interval":
            return interval(self.low, self.high)
        return interval(
            self.low,
            self.high,
            support.open_low and bool(np.all(self.low == support.low)),
            support.open_high and bool(np.all(self.high == support.high)),
        )

    def cdf(self, x: Any) -> np.ndarray:
        x = np.asarray(x, dtype=float)
        shape = np.broadcast_shapes(x.shape, self.batch_shape)
        with np.errstate(all="ignore"):
            inside = np.broadcast_to(np.clip(x, self.low, self.high), shape)
            at = np.broadcast_to(self._map.back(inside), shape).ravel()
            value = self._panels.integral(at, self._elements(shape), self._table).reshape(shape)
        value = np.where(x <= self.low, 0.0, np.where(x >= self.high, 1.0, value))
        return np.where(np.isnan(x), np.nan, value)

    def ppf(self, q: Any) -> np.ndarray:
        q = as_quantile(q)
        value = self._quantile(np.where(np.isnan(q), 0.5, q))
        value = np.where(q == 0, self.low, np.where(q == 1, self.high, value))
        return np.where(np.isnan(q), np.nan, value)

    def _quantile(self, q: np.ndarray) -> np.ndarray:
        shape = np.broadcast_shapes(q.shape, self.batch_shape)
        with np.errstate(all="ignore"):
            flat = np.broadcast_to(q, shape).ravel()
            at = self._panels.inverse(flat, self._elements(shape), self._table)
            return np.clip(self._map.out(at.reshape(shape)), self.low, self.high)

    def _elements(self, shape: Shape) -> np.ndarray:
        """The batch element to which each entry of an array of ``shape`` belongs, raveled."""
        elements = np.arange(int(np.prod(self.batch_shape))).reshape(self.batch_shape)
        return np.broadcast_to(elements, shape).ravel()

    # ---- building ---------------------------------------------------------------------------

    def _build(self) -> None:
        self._map: _Map = _map_of(self.low, self.high)
        panels = self._integrate(1e-2)
        if isinstance(self._map, _Line):  # coordinates that fit the mass keep all digits
            panels = self._centre(panels)
        self._refuse(panels)
        total = np.where(panels.total > 0, panels.total, 1.0)
        self._panels = replace(panels, total=total)
        self._table = self._panels.table()

    def _centre(self, panels: Panels) -> Panels:
        usable = panels.total > 0
        safe = replace(panels, total=np.where(usable, panels.total, 1.0))
        table = safe.table()
        element = np.arange(len(usable))
        places = [safe.inverse(np.full(len(usable), q), element, table) for q in (0.25, 0.5, 0.75)]
        left, middle, right = (self._map.out(at.reshape(self.batch_shape)) for at in places)
        spread = np.maximum(right - left, 64 * np.spacing(np.abs(middle)))
        good = usable.reshape(self.batch_shape) & np.isfinite(middle) & np.isfinite(spread)
        if len(panels.tops) > 1:  # what stood out before may not on the new scale
            tops = self._map.out(panels.tops.reshape(-1, *self.batch_shape))
            points = np.broadcast_to(self._points, (len(self._points), *self.batch_shape))
            self._points = np.concatenate([points, tops])
        self._map = _Line(np.where(good, middle, 0.0), np.where(good, spread, 1.0))
        return self._integrate(_TOLERANCE)

    def _integrate(self, tolerance: float, extra: Any = None) -> Panels:
        exact = tolerance if isinstance(self._map, _Line) else _TOLERANCE
        size = int(np.prod(self.batch_shape))
        edges = _first_edges() + np.zeros((1, size))
        marks = self._columns(self._marks()) if self._points.size else None
        return adapt(lambda at: self._log_mass(at, extra), edges, exact, marks)

    def _marks(self) -> np.ndarray:
        points = np.clip(self._points, self.low, self.high)
        marks = np.broadcast_to(self._map.back(points), (len(points), *self.batch_shape))
        return np.clip(marks, -_REACH, _REACH)

    def _columns(self, values: np.ndarray) -> np.ndarray:
        """Values of shape ``(..., *batch)`` with the batch as one axis."""
        lead = values.shape[: values.ndim - len(self.batch_shape)]
        return values.reshape(int(np.prod(lead)), int(np.prod(self.batch_shape)))

    def _log_mass(self, at: np.ndarray, extra: Any = None) -> np.ndarray:
        """Log density in the mapped coordinate, for points of shape (n, B)."""
        at = at.reshape(len(at), *self.batch_shape)
        least, most = self._map.clear()
        inner = np.clip(at, least, most)
        value = self._log_at(inner, extra)
        # beyond, the distance from the bound has no digits: the power law there goes on
        for end, beyond in ((least, at < least), (most, at > most)):
            if np.any(beyond):
                end = np.broadcast_to(end, self.batch_shape)
                step = np.sign(end)
                last = self._log_at(end[None], extra)
                slope = last - self._log_at((end - step)[None], extra)
                power = np.where(np.isneginf(last), -np.inf, last + slope * np.abs(at - end))
                value = np.where(beyond, power, value)
        return self._columns(np.broadcast_to(value, at.shape))

    def _log_at(self, at: np.ndarray, extra: Any) -> np.ndarray:
        x = self._map.out(at)
        value = self.density.log_prob(np.clip(x, self.low, self.high)) + self._map.log_slope(at)
        return value if extra is None else value + extra(x)

    def _refuse(self, panels: Panels) -> None:
        """Raise for, or mark, the elements whose integral has not come out."""
        good = np.ones(len(panels.total), dtype=bool)
        if self.invalid is not None:
            good = ~np.ravel(np.broadcast_to(self.invalid, self.batch_shape))
        faults = [
            ("log_prob", np.full(len(good), np.nan), panels.broken,
             "a number below infinity inside the bounds"),
            ("integral", panels.total, ~(panels.total > 0),
             "positive (all points looked at have density zero; give low= and high= about the mass)"),
            ("share of mass at the far ends", panels.ends.max(axis=0),
             (panels.ends > _ENDS).any(axis=0),
             "negligible (the integral diverges, or give low= and high=)"),
            ("relative error of the integral", panels.error, ~(panels.error <= _ACCEPTED),
             f"at most {_ACCEPTED:g} (a peak too narrow or a density too rough: shift and scale it, or "
             "give low=, high= and points=)"),
        ]  # fmt: skip
        for name, values, bad, requirement in faults:
            bad = bad & good
            if bad.any():
                shaped = bad.reshape(self.batch_shape)
                index = first_index(shaped)
                if name.startswith("share") and self._is_no_logarithm(shaped):
                    requirement += (
                        "; it is nowhere negative: the function must return the LOG density"
                    )
                self._reject(name, values.reshape(self.batch_shape)[index], shaped, requirement)
                good &= ~bad

    def _is_no_logarithm(self, bad: np.ndarray) -> bool:
        """Whether the log density of the ``bad`` elements looks like a density: nowhere negative."""
        at = np.linspace(-8.0, 8.0, 129).reshape((-1,) + (1,) * bad.ndim)
        with np.errstate(all="ignore"):
            values = np.broadcast_to(self.density.log_prob(self._map.out(at)), (129, *bad.shape))
        return bool((values[:, bad] >= 0).all())

    @cached_property
    def _moments(self) -> tuple[np.ndarray, np.ndarray]:
        with np.errstate(all="ignore"):
            middle = self._quantile(np.full(self.batch_shape, 0.5))
            quarters = [self._quantile(np.full(self.batch_shape, q)) for q in (0.25, 0.75)]
            spread = quarters[1] - quarters[0]

            def standard(x: np.ndarray) -> np.ndarray:
                return (x - middle) / spread

            second = self._moment_panels(lambda x: np.log1p(standard(x) ** 2))
            first = self._moment_panels(lambda x: np.log1p(np.abs(standard(x))))
            x = standard(self._map.out(self._unfold(first.nodes)))
            mass = self._unfold(first.masses) / (1 + np.abs(x))
            mass /= mass.sum(axis=(0, 1))
            mean = (mass * x).sum(axis=(0, 1))
            left, right = (self._unfold(end) > _ENDS for end in first.ends)
            mean = np.where(left & right, np.nan, np.where(left, -np.inf, mean))
            mean = np.where(right & ~left, np.inf, mean)
            x = standard(self._map.out(self._unfold(second.nodes)))
            mass = self._unfold(second.masses) / (1 + x * x)
            mass /= mass.sum(axis=(0, 1))
            var = (mass * (x - mean) ** 2).sum(axis=(0, 1))
            var = np.where(self._unfold(second.ends.max(axis=0) > _ENDS), np.inf, var)
            var = np.where(np.isfinite(mean), var, np.nan)
            return middle + spread * mean, spread**2 * var

    def _moment_panels(self, extra: Callable[[np.ndarray], np.ndarray]) -> Panels:
        return self._integrate(_TOLERANCE, extra)

    def _unfold(self, values: np.ndarray) -> np.ndarray:
        return values.reshape(values.shape[:-1] + self.batch_shape)


class _Map:
    """From a line to the support: ``out`` and ``back``, the log of the slope, where digits end."""

    def out(self, at: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def back(self, x: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def log_slope(self, at: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def clear(self) -> tuple[Any, Any]:
        """Between which points of the line a value's distance from each bound has digits."""
        return -_REACH, _REACH


class _Line(_Map):
    """The whole line: ``centre + scale * sinh(at)``."""

    def __init__(self, centre: Any, scale: Any) -> None:
        self.centre, self.scale = centre, scale

    def out(self, at: np.ndarray) -> np.ndarray:
        return self.centre + self.scale * np.sinh(at)

    def back(self, x: np.ndarray) -> np.ndarray:
        return np.clip(np.arcsinh((x - self.centre) / self.scale), -_REACH, _REACH)

    def log_slope(self, at: np.ndarray) -> np.ndarray:
        return np.log(self.scale) + np.log(np.cosh(at))


class _Ray(_Map):
    """A half line from ``end``: ``end + sign * exp(at)``; upside down when it runs to the left."""

    def __init__(self, end: Any, sign: float) -> None:
        self.end, self.sign = end, sign

    def out(self, at: np.ndarray) -> np.ndarray:
        return self.end + self.sign * np.exp(self.sign * at)

    def back(self, x: np.ndarray) -> np.ndarray:
        at = self.sign * np.log(self.sign * (x - self.end))
        return np.clip(at, -_REACH, _REACH)

    def log_slope(self, at: np.ndarray) -> np.ndarray:
        return self.sign * at

    def clear(self) -> tuple[Any, Any]:
        least = np.maximum(np.log(_BLUR * np.spacing(np.abs(self.end))), -_REACH)
        return (least, _REACH) if self.sign > 0 else (-_REACH, -least)


class _Segment(_Map):
    """An interval, by the logistic function, measured from the nearer bound."""

    def __init__(self, low: Any, high: Any) -> None:
        self.low, self.high, self.width = low, high, high - low

    def out(self, at: np.ndarray) -> np.ndarray:
        part = self.width / (1 + np.exp(np.abs(at)))
        return np.where(at < 0, self.low + part, self.high - part)

    def back(self, x: np.ndarray) -> np.ndarray:
        return np.clip(np.log(x - self.low) - np.log(self.high - x), -_REACH, _REACH)

    def log_slope(self, at: np.ndarray) -> np.ndarray:
        size = np.abs(at)
        return np.log(self.width) - size - 2 * np.log1p(np.exp(-size))

    def clear(self) -> tuple[Any, Any]:
        ends = [
            np.log(_BLUR * np.spacing(np.abs(bound)) / self.width)
            for bound in (self.low, self.high)
        ]
        ends = [np.clip(end, -_REACH, -2.0) for end in ends]
        return ends[0], -ends[1]


def _map_of(low: np.ndarray, high: np.ndarray) -> _Map:
    below, above = np.isfinite(low), np.isfinite(high)
    for bound, finite in (("low", below), ("high", above)):
        if finite.any() and not finite.all():
            raise UnsupportedError(
                f"InverseCdf: {bound} is finite for some batch elements and infinite for others; "
                "make two distributions"
            )
    if below.all() and above.all():
        return _Segment(low, high)
    if below.all():
        return _Ray(low, 1.0)
    return _Ray(high, -1.0) if above.all() else _Line(0.0, 1.0)


def _bounds(support: Support) -> tuple[np.ndarray, np.ndarray]:
    if support.kind == "circle":
        return np.asarray(-np.pi), np.asarray(np.pi)
    if support.kind == "interval":
        return np.asarray(support.low, dtype=float), np.asarray(support.high, dtype=float)
    return np.asarray(-np.inf), np.asarray(np.inf)


def _usable(density: Any) -> Distribution:
    dist = as_distribution(density)
    if dist is None and callable(density):
        dist = Density(density)
    if dist is None:
        raise ParameterError(
            f"InverseCdf: density must be a Density, a distribution or a function; got "
            f"{type(density).__name__}"
        )
    if dist.event_shape or dist.is_discrete:
        what = "discrete" if dist.is_discrete else f"of vectors of shape {dist.event_shape}"
        raise UnsupportedError(
            f"InverseCdf: a density of one continuous number is needed; {type(dist).__name__} is "
            f"{what}"
        )
    return dist


def _first_edges() -> np.ndarray:
    """Fine where the mass is likely, coarser outwards, shape (panels + 1, 1)."""
    inner = np.linspace(-8.0, 8.0, 129)
    outer = 8.0 * (_REACH / 8.0) ** np.linspace(0, 1, 25)[1:]
    return np.concatenate([-outer[::-1], inner, outer])[:, None]
