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
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from bayesmc.structure.curvature import Curvature, Curved
from bayesmc.structure.free_density import UnconstrainedDensity

#: iterations of the quasi-Newton method, and of Newton's
_FAR, _NEAR = 2000, 200
#: standard deviations that a Newton step may still move the mode, where it is done, and where that is enough
_STILL, _ENOUGH = 1e-9, 1e-4
#: how often a Newton step is cut, and the largest change of a free number by one
_CUTS, _FARTHEST = 40, 20.0
#: free numbers beyond which there is no mode in sight
_ENDLESS = 200.0
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
    starts : int
        How many starts ended there.
    """

    u: np.ndarray
    log_density: float
    curved: Curved
    root: np.ndarray
    step: float
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


def modes_of(density: UnconstrainedDensity, starts: np.ndarray) -> tuple[list[Mode], list[NoMode]]:
    """The modes that starts lead to, the one with the highest density first, and climbs without one.

    Parameters
    ----------
    density : UnconstrainedDensity
    starts : ndarray, shape (starts, size)
    """
    curvature = Curvature(density)
    ends = sorted((_climbed(density, u) for u in starts), key=lambda end: -end[1])
    found: list[Mode] = []
    lost: list[NoMode] = []
    for u, log in ends:
        known = _known(found, u, log)
        if known is None:
            end = _polished(density, curvature, u)
            if isinstance(end, NoMode):
                lost.append(end)
                continue
            known = _known(found, end.u, end.log_density)
            if known is None:
                found.append(end)
                continue
        mode = found[known]
        found[known] = Mode(
            mode.u, mode.log_density, mode.curved, mode.root, mode.step, mode.starts + 1
        )
    found.sort(key=lambda mode: -mode.log_density)
    return found, lost


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


def _climbed(density: UnconstrainedDensity, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Where a quasi-Newton method leads."""
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
    return (u, log) if log >= before else (start, before)


def _is_plain(node: object) -> bool:
    transform = getattr(node, "transform", None)
    return type(transform).__name__ in ("Identity", "Wrapped")


def _known(found: Sequence[Mode], u: np.ndarray, log: float) -> int | None:
    """Which mode a point is at, if any."""
    for k, mode in enumerate(found):
        away = mode.root.T @ (u - mode.u)
        if np.linalg.norm(away) <= _APART and abs(log - mode.log_density) <= _APART:
            return k
    return None


def _polished(density: UnconstrainedDensity, curvature: Curvature, u: np.ndarray) -> Mode | NoMode:
    """Newton's method, from near a mode."""
    value, slope = density.with_gradient(u)
    log = float(value)
    curved, root, length = None, None, np.inf
    for _ in range(_NEAR):
        curved = curvature.at(u)
        if not np.isfinite(curved.matrix).all():
            return NoMode(u, log, "the log density has no second derivatives where a climb ended")
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
        u, log, slope = ahead
    assert curved is not None
    labels = density.labels
    far = np.abs(u) > _ENDLESS
    away = scaled.step(slope)
    endless = far & _bounded(density)
    if endless.any():
        k = int(np.argmax(np.where(endless, np.abs(u), 0.0)))
        return NoMode(
            u, log,
            f"the log density goes on rising as the free number of {labels[k]} runs off (it is {u[k]:.3g}, "
            f"the log density {log:.6g}): there is no mode",
        )  # fmt: skip
    if root is None:
        return NoMode(u, log, scaled.refused(labels))
    if not length <= _ENOUGH:
        return NoMode(
            u, log,
            f"a climb did not settle: another step would move {named(labels, away)} by {length:.2g} standard "
            "deviations",
        )  # fmt: skip
    return Mode(u, log, curved, root, float(length))


def _bounded(density: UnconstrainedDensity) -> np.ndarray:
    """Which free numbers stand for bounded ones."""
    parts = [np.full(node.size, not _is_plain(node)) for node in density.nodes]
    return np.concatenate(parts) if parts else np.zeros(0, bool)


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
            factor = linalg.cholesky(matrix, lower=True, check_finite=False)
        except linalg.LinAlgError:
            factor = None
        clear = (
            1e3 * self.floor * size
        )  # the least pivot bounds the least eigenvalue from above alone
        if factor is None or float(np.diag(factor).min(initial=1.0)) ** 2 <= clear:
            self.values, self.vectors = linalg.eigh(matrix, check_finite=False)
            if factor is None or self.values.min(initial=1.0) <= self.floor:
                return
        self.factor = factor
        self.root = factor / self.unit[:, None]

    def step(self, slope: np.ndarray) -> np.ndarray:
        """Newton's, uphill whatever the signs of the curvature."""
        inner = slope * self.unit
        if self.root is not None:
            return self.unit * linalg.cho_solve((self.factor, True), inner)
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
