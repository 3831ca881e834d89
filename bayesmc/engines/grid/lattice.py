"""Lattices: cells that lie evenly on a line, in the coordinate that suits a node's support.

On the whole line and on intervals that is the number itself, above or below a bound the logarithm of the
distance from it. A lattice can be widened and made finer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from bayesmc.dbn import Slices


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
