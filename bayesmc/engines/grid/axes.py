"""Axes of a grid: the points at which densities are evaluated, and how much of the line each stands for.

Reads what users give as ``grid=``; finite nodes are their states, and bounded ones are cut evenly without
being asked. A lattice is an axis of even cells, in the coordinate that suits a node's support (the logarithm
of the distance from a bound); it can be widened and made finer. Nothing here knows slices of time or beliefs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayesmc.dbn import Slices
from bayesmc.network import CompiledNode
from bayesmc.shapes import owned


@dataclass(frozen=True)
class Line:
    """The line that a number lies on.

    Attributes
    ----------
    kind : str
        ``"real"``, ``"above"`` or ``"below"`` a bound, ``"interval"``, ``"circle"``, ``"integers"``.
    low, high : float
        Bounds, possibly infinite.
    """

    kind: str
    low: float = -math.inf
    high: float = math.inf

    def coordinate(self, x: np.ndarray) -> np.ndarray:
        """Where numbers lie in the coordinate in which cells are even."""
        if self.kind == "above":
            return np.log(x - self.low)
        if self.kind == "below":
            return -np.log(self.high - x)
        return np.asarray(x, dtype=float)

    def number(self, u: np.ndarray) -> np.ndarray:
        """The inverse of ``coordinate``."""
        if self.kind == "above":
            return self.low + np.exp(u)
        if self.kind == "below":
            return self.high - np.exp(-u)
        return u

    def stretch(self, u: np.ndarray) -> np.ndarray:
        """How much of the line a unit of the coordinate stands for."""
        if self.kind == "above":
            return np.exp(u)
        if self.kind == "below":
            return np.exp(-u)
        return np.ones_like(u)

    @property
    def grows(self) -> tuple[bool, bool]:
        """Whether cells may be added at the low and at the high end, whatever stands there now."""
        bounded = self.kind in ("interval", "circle")
        return not bounded, not bounded


@dataclass(frozen=True)
class Lattice:
    """Even cells between two coordinates."""

    line: Line
    low: float
    high: float
    cells: int

    @property
    def step(self) -> float:
        """The distance between neighbours, in the coordinate."""
        return (self.high - self.low) / self.cells

    @property
    def comes_round(self) -> bool:
        """Whether the last cell is next to the first: a circle that is covered whole."""
        turn = 2 * math.pi
        return self.line.kind == "circle" and abs(self.high - self.low - turn) <= 1e-9 * turn

    def cut(self, cells: int) -> Lattice:
        """The same range in so many cells."""
        if self.line.kind == "integers":
            return self
        return replace(self, cells=max(int(cells), 8))

    def widened(self, low: bool, high: bool) -> Lattice:
        """A quarter wider at these ends, of cells as wide as before."""
        more = max(self.cells // 4, 8)
        return self.to(self.low - more * self.step * low, self.high + more * self.step * high)

    def holding(self, low: float, high: float) -> Lattice:
        """Wide enough for these coordinates, too."""
        low, high = min(self.low, low), max(self.high, high)
        if self.line.kind == "integers":
            low, high = math.floor(low), math.ceil(high) + (high > self.high)
        # whole cells more, so that cells that it has stay where they are
        down, up = (
            math.ceil((self.low - low) / self.step),
            math.ceil((high - self.high) / self.step),
        )
        if not down and not up:
            return self
        return self.to(self.low - down * self.step, self.high + up * self.step)

    def to(self, low: float, high: float) -> Lattice:
        """Another range, of cells as wide as before; within the bounds of the line."""
        step = self.step
        if self.line.kind == "integers":
            low, high = max(low, self.line.low), min(high, self.line.high + 1)
        cells = max(round((high - low) / step), 1)
        return replace(self, low=low, high=high, cells=cells)


def line_of(slices: Slices, name: str) -> Line | None:
    """The line of a node of one number; None where its support is none."""
    models = (slices.first, slices.later)
    supports = [m[name].support for m in models]
    if any(s is None for s in supports):
        return None
    kinds = {s.kind for s in supports if s is not None}
    if kinds == {"circle"}:
        return Line("circle", -math.pi, math.pi)
    if not kinds <= {"real", "interval", "integers"}:
        return None
    low, high = -math.inf, math.inf
    if all(s is not None and s.is_constant for s in supports) and "real" not in kinds:
        low = min(float(np.min(s.low)) for s in supports if s is not None)
        high = max(float(np.max(s.high)) for s in supports if s is not None)
    if slices.first[name].is_discrete:
        return Line("integers", low, high)
    if math.isfinite(low) and math.isfinite(high):
        return Line("interval", low, high)
    if math.isfinite(low):
        return Line("above", low)
    return Line("below", -math.inf, high) if math.isfinite(high) else Line("real")


#: cells of bounded nodes where nothing is said of them
CELLS = 200
#: rules that turn an interval into points and widths
RULES = ("midpoint", "trapezoid", "simpson", "gauss-legendre")
#: supports on which a product of intervals has a volume
_FLAT = ("real", "interval", "circle", "real vector", "product", "integers")


@dataclass(frozen=True, eq=False)
class Axis:
    """Points on a line.

    Attributes
    ----------
    points : ndarray, shape (n,)
        Stored values: positions for finite nodes.
    widths : ndarray, shape (n,)
        Quadrature weights: the length that a point stands for, 1 for isolated values.
    lattice : Lattice or None
        The even cells that it is made of, if it is.
    """

    points: np.ndarray
    widths: np.ndarray
    lattice: Lattice | None = None

    @property
    def size(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class Axes:
    """The axes of all nodes of a slice that can have some.

    Attributes
    ----------
    of : dict
        Node -> one axis per component of its event, in C order; all plate elements have the same.
    asked : frozenset of str
        Nodes named in ``grid=``.
    missing : dict
        Other nodes with a density -> why they have none, and how to give them some.
    """

    of: dict[str, tuple[Axis, ...]]
    asked: frozenset[str]
    missing: dict[str, str]


def read_axes(slices: Slices, grid: Mapping[str, Any], cells: int, rule: str) -> Axes:
    """The axes of all nodes of a slice, from ``grid=`` and from supports.

    Raises
    ------
    ValueError
        A grid that is none, or for a node that takes none.
    """
    found: dict[str, tuple[Axis, ...]] = {}
    missing = {}
    for name in grid:
        if name not in slices.stochastic:
            raise ValueError(
                f"GridFilter(grid=...): {name!r} is no node with a density in the template; there are "
                f"{list(slices.stochastic)}"
            )
    for name in slices.dynamic:
        node = slices.first[name]
        if node.domain is not None:
            if name in grid:
                raise ValueError(
                    f"GridFilter(grid=...): {name!r} is finite; its states are its cells, so leave it out"
                )
            size = node.domain.size
            found[name] = (Axis(owned(np.arange(size)), owned(np.ones(size))),)
        elif not node.is_stochastic:
            continue
        elif (kind := _unfit(slices, name)) is not None:
            missing[name] = (
                f"{name!r} has values on {kind}, which a product of intervals does not fill"
            )
        elif name in grid:
            found[name] = _axes(node, grid[name], rule)
        else:
            bounds = _bounds(slices, name)
            if bounds is None:
                missing[name] = (
                    f"{name!r} is hidden and unbounded; give it a grid, grid={{{name!r}: (low, high, "
                    "cells)} or an array of points"
                )
            else:
                axis = _interval(name, *bounds, cells, rule)
                found[name] = (axis,) * math.prod(node.event_shape)
    return Axes(found, frozenset(grid), missing)


def axis_of(lattice: Lattice) -> Axis:
    """Points and widths of even cells."""
    if lattice.line.kind == "integers":
        values = np.arange(round(lattice.low), round(lattice.high))
        return Axis(owned(values, np.int64), owned(np.ones(len(values))))
    u = lattice.low + lattice.step * (np.arange(lattice.cells) + 0.5)
    points, widths = lattice.line.number(u), lattice.step * lattice.line.stretch(u)
    return Axis(owned(points), owned(widths), lattice)


def check_rule(rule: str) -> None:
    """Refuse a ``quadrature=`` that is none."""
    if rule not in RULES:
        raise ValueError(f"GridFilter(quadrature={rule!r}): give one of {', '.join(RULES)}")


# ---- private ------------------------------------------------------------------------------------


def _unfit(slices: Slices, name: str) -> str | None:
    for model in (slices.first, slices.later):
        support = model[name].support
        if support is None:
            continue
        kinds = {support.kind, *(part.kind for part, _ in support.parts)}
        if not kinds <= set(_FLAT):
            return support.describe()
    return None


def _bounds(slices: Slices, name: str) -> tuple[float, float] | None:
    """The interval that holds a node in every slice; None where it is infinite or varies."""
    lows, highs = [], []
    for model in (slices.first, slices.later):
        support = model[name].support
        if support is None or support.kind not in ("interval", "circle") or not support.is_constant:
            return None
        if support.kind == "circle":
            lows.append(-np.pi)
            highs.append(np.pi)
        else:
            lows.append(float(np.min(support.low)))
            highs.append(float(np.max(support.high)))
    low, high = min(lows), max(highs)
    return (low, high) if math.isfinite(low) and math.isfinite(high) else None


def _axes(node: CompiledNode, given: Any, rule: str) -> tuple[Axis, ...]:
    """One axis per component; one grid for all of them, or a list of one each."""
    count = math.prod(node.event_shape)
    several = isinstance(given, (list, tuple)) and any(np.ndim(part) > 0 for part in given)
    if not several:
        return (_axis(node, given, rule),) * count
    if len(given) != count:
        raise ValueError(
            f"GridFilter(grid=...): {node.name!r} has {count} components, but {len(given)} grids; give one "
            "for all, or a list of one each"
        )
    return tuple(_axis(node, part, rule) for part in given)


def _axis(node: CompiledNode, given: Any, rule: str) -> Axis:
    what = f"GridFilter(grid={{{node.name!r}: ...}})"
    if isinstance(given, tuple):
        low, high, cells = _bounds_and_cells(what, given)
        if node.is_discrete:
            raise ValueError(f"{what}: the node counts; give the values, such as np.arange(100)")
        return _interval(node.name, low, high, cells, rule)
    try:
        points = np.array(given, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{what}: give an array of points or (low, high, cells)") from None
    if points.ndim != 1 or len(points) < 2 or not np.isfinite(points).all():
        raise ValueError(
            f"{what}: points of shape {points.shape}; give two finite ones or more, on one axis, or "
            "(low, high, cells)"
        )
    if (np.diff(points) <= 0).any():
        raise ValueError(f"{what}: points must increase")
    if node.is_discrete:
        if (points != np.floor(points)).any():
            raise ValueError(f"{what}: the node counts; give whole numbers")
        return Axis(owned(points, np.int64), owned(np.ones(len(points))))
    return Axis(owned(points), owned(_widths(what, points, rule)))


def _bounds_and_cells(what: str, given: tuple[Any, ...]) -> tuple[float, float, int]:
    """A tuple is an interval and how many cells it has; points come as a list or an array."""
    try:
        low, high, cells = map(float, given)
    except (TypeError, ValueError):
        low = high = cells = math.nan
    fits = -math.inf < low < high < math.inf and cells >= 2
    if not (fits and cells == math.floor(cells) < math.inf):
        raise ValueError(
            f"{what}: the tuple {given!r} is no (low, high, cells) with low < high and a whole number of "
            "cells, 2 or more; for points give a list or an array"
        )
    return low, high, int(cells)


def _interval(name: str, low: float, high: float, cells: int, rule: str) -> Axis:
    """An interval by a rule; only the midpoint rule has cells, the others so many points."""
    if rule == "midpoint":
        return axis_of(Lattice(Line("real"), low, high, cells))
    if rule == "gauss-legendre":
        points, weights = np.polynomial.legendre.leggauss(cells)
        half = (high - low) / 2
        return Axis(owned(low + half * (points + 1)), owned(weights * half))
    points = np.linspace(low, high, cells)
    return Axis(owned(points), owned(_widths(f"GridFilter(grid={{{name!r}: ...}})", points, rule)))


def _widths(what: str, points: np.ndarray, rule: str) -> np.ndarray:
    """What every given point stands for."""
    gaps = np.diff(points)
    ends: Sequence[float] = (gaps[0], gaps[-1])
    inner = (gaps[1:] + gaps[:-1]) / 2
    if rule == "midpoint":  # the outer cells are as wide on both sides of their points
        return np.concatenate([ends[:1], inner, ends[1:]])
    if rule == "trapezoid":
        return np.concatenate([[ends[0] / 2], inner, [ends[1] / 2]])
    if rule == "simpson":
        if len(points) % 2 == 0 or np.ptp(gaps) > 1e-9 * gaps.max():
            raise ValueError(f"{what}: Simpson's rule wants an odd number of evenly spaced points")
        weights = np.full(len(points), 2.0)
        weights[1::2] = 4.0
        weights[[0, -1]] = 1.0
        return weights * gaps.mean() / 3
    raise ValueError(
        f'{what}: quadrature="gauss-legendre" places the points itself; give (low, high, cells)'
    )
