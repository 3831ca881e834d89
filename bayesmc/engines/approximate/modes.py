"""Modes of a log density of free numbers: climbed to from several starts, and told apart.

A quasi-Newton method goes most of the way; Newton's own, with the curvature made positive where it is not
(More and Sorensen), goes the rest, until a step would move nothing by a visible part of a standard deviation.
What a mode is not is told by name: a ridge, along which nothing bends; a density that rises without end.

References
----------
Nocedal and Wright (2006), Numerical Optimization, 2nd ed., sec. 3.4 (modified Newton) and 7.2 (L-BFGS).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from bayesmc.distributions.circular import wrap_angle
from bayesmc.structure.curvature import Curvature, Curved
from bayesmc.structure.free_density import UnconstrainedDensity

#: curvature below which rounding hides nothing of a free number that is of order one
_HIDDEN = 1e-4
#: iterations of the quasi-Newton method, and of Newton's
_FAR, _NEAR = 2000, 100
#: standard deviations that a Newton step may still move the mode, where it is done, and where that is enough
_STILL, _ENOUGH = 1e-9, 1e-4
#: how often a Newton step is cut, and the largest change of a free number by one
_CUTS, _FARTHEST = 40, 20.0
#: free numbers of bounded values beyond which there is no mode in sight, and from which on a climb that
#: cannot go on was on its way there; and where one is stopped
_ENDLESS, _FAR_OUT, _STOP = 100.0, 30.0, 120.0
#: free numbers and slopes of values that go to the edge of their support, and what stands for the edge
_OUT, _LEVEL, _EDGE = 10.0, 1e-3, 45.0
#: standard deviations by which one mode is apart from another
_APART = 0.05


@dataclass(frozen=True, eq=False)
class Mode:
    """A point where a log density is largest nearby.

    Attributes
    ----------
    u : ndarray, shape (size,)
    log_density : float
    curved : Curved
        Minus the second derivatives there.
    root : ndarray, shape (size, size)
        Their lower Cholesky factor.
    step : float
        Standard deviations that a Newton step would still move it.
    edge : ndarray of bool, shape (size,)
        Free numbers that stand for values at the edge of their support, where they are left.
    starts : int
        How many starts ended there.
    """

    u: np.ndarray
    log_density: float
    curved: Curved
    root: np.ndarray
    step: float
    edge: np.ndarray
    starts: int = 1

    @property
    def log_volume(self) -> float:
        """The log of the integral of a Gaussian of this height and curvature (Laplace's method)."""
        size = len(self.u)
        return float(
            self.log_density + 0.5 * size * np.log(2.0 * np.pi) - np.log(np.diag(self.root)).sum()
        )


@dataclass(frozen=True, eq=False)
class NoMode:
    """Where a climb ended without a mode, and why, in words that name free numbers."""

    u: np.ndarray
    log_density: float
    reason: str


def modes_of(
    density: UnconstrainedDensity, starts: np.ndarray, edges: bool = False
) -> tuple[list[Mode], list[NoMode]]:
    """The modes that starts lead to, the one with the highest density first, and climbs without one.

    Parameters
    ----------
    density : UnconstrainedDensity
    starts : ndarray, shape (starts, size)
    edges : bool
        Whether a mode may lie at the edge of a support, where the density has a limit.
    """
    with np.errstate(all="ignore"):
        return _modes_of(density, starts, edges)


def named(labels: Sequence[str], direction: np.ndarray, most: int = 6) -> str:
    """A direction in words: ``0.71 a - 0.71 b``."""
    size = np.abs(direction) / max(float(np.abs(direction).max(initial=0.0)), 1e-300)
    order = [int(k) for k in np.argsort(-size, kind="stable") if size[k] > 0.1]
    shown = order[:most]
    if len(order) == 1:
        return labels[order[0]]
    signs = np.sign(direction[shown[0]]) * direction
    unit = signs / np.linalg.norm(signs)
    words = f"{unit[shown[0]]:.2f} {labels[shown[0]]}"
    for k in shown[1:]:
        words += f" {'+' if unit[k] > 0 else '-'} {abs(unit[k]):.2f} {labels[k]}"
    return words + (f" and {len(order) - most} more" if len(order) > most else "")


# ---- private ------------------------------------------------------------------------------------


def _modes_of(
    density: UnconstrainedDensity, starts: np.ndarray, edges: bool
) -> tuple[list[Mode], list[NoMode]]:
    curvature = Curvature(density)
    ends = sorted((_climbed(density, u, edges) for u in starts), key=lambda end: -end[1])
    found: list[Mode] = []
    lost: list[NoMode] = []
    for u, log, edge in ends:
        known = _known(density, found, u, log)
        if known is None:
            end = _polished(density, curvature, u, edge)
            if isinstance(end, NoMode):
                lost.append(end)
                continue
            known = _known(density, found, end.u, end.log_density)
            if known is None:
                found.append(end)
                continue
        mode = found[known]
        found[known] = replace(mode, starts=mode.starts + 1)
    found.sort(key=lambda mode: -mode.log_density)
    return found, lost


def _climbed(
    density: UnconstrainedDensity, start: np.ndarray, edges: bool
) -> tuple[np.ndarray, float, np.ndarray]:
    """Where a quasi-Newton method leads, and which numbers it takes to the edge of their support."""
    from scipy.optimize import minimize

    def falling(u: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = density.with_gradient(u)
        if not np.isfinite(value):
            return 1e300, np.zeros_like(u)
        return -float(value), -slope

    with np.errstate(all="ignore"):
        found = minimize(
            falling,
            start,
            jac=True,
            method="L-BFGS-B",
            bounds=[(-reach, reach) for reach in np.where(_bounded(density), _STOP, np.inf)],
            options={
                "maxiter": _FAR,
                "maxfun": 3 * _FAR,
                "maxcor": 20,
                "ftol": 1e-13,
                "gtol": 1e-7,
            },
        )
    u = np.asarray(found.x, dtype=float)
    log, before = float(density.value(u)), float(density.value(start))
    if log < before:
        u, log = start, before
    edge = np.zeros(len(u), bool)
    if edges:
        _, slope = density.with_gradient(u)
        out = _bounded(density) & (np.abs(u) > _OUT) & (np.abs(slope) < _LEVEL)
        moved = np.where(out, np.sign(u) * _EDGE, u)
        limit = float(density.value(moved))
        if out.any() and limit >= log - 1e-3:
            u, log, edge = moved, limit, out
    return u, log, edge


def _bounded(density: UnconstrainedDensity) -> np.ndarray:
    """Which free numbers stand for values with bounds."""
    return np.repeat([n.is_bounded for n in density.nodes], [n.size for n in density.nodes])


def _known(
    density: UnconstrainedDensity, found: Sequence[Mode], u: np.ndarray, log: float
) -> int | None:
    """Which mode a point is at, if any."""
    for k, mode in enumerate(found):
        away = u - mode.u
        away = mode.root.T @ np.where(density.angles, wrap_angle(away), away)
        if np.linalg.norm(away) <= _APART and abs(log - mode.log_density) <= _APART:
            return k
    return None


def _polished(
    density: UnconstrainedDensity, curvature: Curvature, u: np.ndarray, edge: np.ndarray
) -> Mode | NoMode:
    """Newton's method, from near a mode; what is at an edge stays there."""
    value, slope = density.with_gradient(u)
    log = float(value)
    curved, root, length = None, None, np.inf
    bounded = _bounded(density) & ~edge
    slope = np.where(edge, 0.0, slope)
    for _ in range(_NEAR):
        if (bounded & (np.abs(u) > _ENDLESS)).any():
            return NoMode(u, log, _endless(density.labels, bounded, u, log))
        curved = _without(curvature.at(u), edge)
        if not np.isfinite(curved.matrix).all():
            break
        scaled = _Scaled(curved)
        root = scaled.root
        direction = scaled.step(slope)
        length = scaled.length(slope)
        if length <= _STILL:
            if root is not None:
                break
            direction = scaled.downhill()  # a saddle: to either side it rises
        ahead = _searched(density, u, log, slope, direction)
        if ahead is None:
            break
        u, log, slope = ahead[0], ahead[1], np.where(edge, 0.0, ahead[2])
    assert curved is not None
    labels, out = density.labels, bounded & (np.abs(u) > _FAR_OUT)
    settled = root is not None and length <= _ENOUGH
    if not settled and (out & (slope * u > 0)).any():
        return NoMode(u, log, _endless(labels, out, u, log))
    if not np.isfinite(curved.matrix).all():
        return NoMode(u, log, "the log density has no second derivatives where a climb ended")
    away = scaled.step(slope)
    if root is None:
        return NoMode(u, log, scaled.refused(labels))
    if not length <= _ENOUGH:
        return NoMode(
            u, log,
            f"a climb did not settle: another step would move {named(labels, away)} by {length:.2g} standard "
            "deviations",
        )  # fmt: skip
    return Mode(u, log, curved, root, float(length), edge)


def _without(curved: Curved, edge: np.ndarray) -> Curved:
    """Curvatures of the numbers that are not at an edge; those that are have 1."""
    if not edge.any():
        return curved
    apart = edge[:, None] | edge
    return replace(curved, matrix=np.where(apart, np.diag(edge.astype(float)), curved.matrix))


def _endless(labels: Sequence[str], out: np.ndarray, u: np.ndarray, log: float) -> str:
    k = int(np.argmax(np.where(out, np.abs(u), 0.0)))
    return (
        f"there is no mode: the log density goes on rising as the free number of {labels[k]} runs off (it is "
        f"{log:.6g} at {u[k]:.3g})"
    )


class _Scaled:
    """Minus second derivatives in units in which their diagonal is 1, factored as far as they can be."""

    def __init__(self, curved: Curved) -> None:
        self.curved = curved
        size = len(curved.matrix)
        with np.errstate(all="ignore"):
            unit = 1.0 / np.sqrt(np.abs(np.diag(curved.matrix)))
        self.unit = np.where(np.isfinite(unit), unit, 1.0)
        matrix = curved.matrix * np.outer(self.unit, self.unit)
        self.floor = max(curved.error * size, 64 * np.finfo(float).eps * size)
        self.root: np.ndarray | None = None
        self.values: np.ndarray | None = None
        try:
            factor = scipy.linalg.cholesky(matrix, lower=True, check_finite=False)
        except scipy.linalg.LinAlgError:
            factor = None
        clear = (
            1e3 * self.floor * size
        )  # the least pivot bounds the least eigenvalue from above alone
        if factor is None or float(np.diag(factor).min(initial=1.0)) ** 2 <= clear:
            self.values, self.vectors = scipy.linalg.eigh(matrix, check_finite=False)
            if factor is None or self.values.min(initial=1.0) <= self.floor:
                return
        self.factor = factor
        self.root = factor / self.unit[:, None]

    def step(self, slope: np.ndarray) -> np.ndarray:
        """Newton's, uphill whatever the signs of the curvature."""
        inner = slope * self.unit
        if self.root is not None:
            return self.unit * scipy.linalg.cho_solve((self.factor, True), inner)
        assert self.values is not None
        size = np.maximum(np.abs(self.values), 1e-8)
        return self.unit * (self.vectors @ ((self.vectors.T @ inner) / size))

    def length(self, slope: np.ndarray) -> float:
        """Standard deviations of the step, as far as the curvature tells them."""
        return float(np.sqrt(max(slope @ self.step(slope), 0.0)))

    def downhill(self) -> np.ndarray:
        """The direction of the most negative curvature."""
        assert self.values is not None
        return self.unit * self.vectors[:, 0]

    def refused(self, labels: Sequence[str]) -> str:
        """Why there is no Gaussian here."""
        assert self.values is not None
        if not self.curved.is_exact and self.floor > 0.1:
            k = int(np.argmin(np.abs(np.diag(self.curved.matrix))))
            return f"the log density has a kink at its mode, or near it (look at {labels[k]})"
        flat = [k for k, v in enumerate(self.values) if v <= self.floor][:4]
        ways = "; ".join(named(labels, self.unit * self.vectors[:, k]) for k in flat)
        how = "flat" if self.values[0] > -self.floor else "not curved downwards"
        steepest = float(np.abs(np.diag(self.curved.matrix)).max(initial=0.0))
        if steepest * np.finfo(float).eps > _HIDDEN and how == "flat":
            return (
                f"the log density is so steep at its mode (as of noise with a standard deviation of "
                f"{steepest**-0.5:.2g}) that rounding hides how it bends along {ways} (free numbers); give "
                "more noise, or use Exact() where all is linear-Gaussian"
            )
        return (
            f"the mode lies on a ridge: the log density is {how} along {ways} (free numbers), which data "
            "and priors leave undetermined; give these nodes a proper prior, or drop one of them"
        )


def _searched(
    density: UnconstrainedDensity,
    u: np.ndarray,
    log: float,
    slope: np.ndarray,
    direction: np.ndarray,
) -> tuple[np.ndarray, float, np.ndarray] | None:
    """A point uphill along a direction; None where there is none."""
    largest = float(np.abs(direction).max(initial=0.0))
    if not np.isfinite(largest) or largest == 0.0:
        return None
    step = min(1.0, _FARTHEST / largest)
    rise = float(slope @ direction)
    for _ in range(_CUTS):
        for sign in (1.0,) if rise > 0 else (1.0, -1.0):
            tried = u + sign * step * direction
            value, new = density.with_gradient(tried)
            if float(value) > log + 1e-4 * step * max(rise, 0.0) - 0.0:
                return tried, float(value), new
            # to rounding as high, and flatter: the end of the climb
            small = 16 * np.finfo(float).eps * (1.0 + abs(log))
            if float(value) >= log - small and np.abs(new).max() < 0.5 * np.abs(slope).max():
                return tried, float(value), new
        step *= 0.25
    return None
