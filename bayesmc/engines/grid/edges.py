"""Beliefs that go on beyond their grid: which ends of an axis are open, and what stands in the cells there.

An end of an axis is open if the node's support goes on by a cell or more beyond its outer point; a belief
reaches over it if the density in the outer cell is not small beside the highest one. At a bound of the
support (a rate's zero), and on a circle that is covered whole, densities may be as high as they like.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bayesmc.dbn import Slices
from bayesmc.distributions.support import Support
from bayesmc.engines.grid.axes import Axes, Axis
from bayesmc.engines.grid.slice import Placed, Scalar
from bayesmc.engines.grid.sources import Label

#: share of the turn that an axis on a circle may lack
_TURN = 2 * np.pi * (1 - 1e-6)


class Outer(NamedTuple):
    """The outer cell in which most is left.

    Attributes
    ----------
    name : str
    point : float
    share : float
        Its density over the highest one.
    """

    name: str
    point: float
    share: float


class Edges:
    """The open ends of a grid's axes.

    Parameters
    ----------
    slices : Slices
    axes : Axes
    """

    def __init__(self, slices: Slices, axes: Axes) -> None:
        self.slices, self.axes = slices, axes
        self._ends: dict[tuple[bool, Label], tuple[int, ...]] = {}

    def highest(self, probs: np.ndarray, now: Placed) -> Outer | None:
        """Where a belief reaches farthest over open ends; ``probs`` has shape (*cells, *apart)."""
        found: Outer | None = None
        for k, scalar in enumerate(now.scalars):
            ends = self._open(now, scalar)
            if not ends:
                continue
            marginal = now.marginal(probs, k)
            widths = np.broadcast_to(scalar.widths, marginal.shape)
            density = np.divide(marginal, widths, out=np.zeros(widths.shape), where=widths > 0)
            top = density.max(axis=0)
            for end in ends:
                # where an element is seen, its first point is what was seen
                share = np.where(widths[-1] > 0, density[end] / top, 0.0)
                if found is None or share.max() > found.share:
                    at = int(share.argmax())
                    points = np.broadcast_to(scalar.points, widths.shape)[end]
                    found = Outer(scalar.label[0], float(points.flat[at]), float(share.flat[at]))
        return found

    def reached(self, positions: Mapping[Label, np.ndarray], now: Placed) -> Outer | None:
        """A scalar that stands in the outer cell of an open end; ``positions`` have shape (*apart,)."""
        for scalar in now.scalars:
            for end in self._open(now, scalar):
                at = positions[scalar.label]
                widths = np.broadcast_to(scalar.widths, (scalar.size, *at.shape))
                hit = (at == end % scalar.size) & (widths[-1] > 0)
                if hit.any():
                    points = np.broadcast_to(scalar.points, widths.shape)[end]
                    return Outer(scalar.label[0], float(points[hit].flat[0]), 1.0)
        return None

    # ---- private -------------------------------------------------------------------------------

    def _open(self, now: Placed, scalar: Scalar) -> tuple[int, ...]:
        """Open ends of a scalar's axis: of 0 and -1."""
        first = now.row.t == 0
        key = (first, scalar.label)
        if key not in self._ends:
            name, number = scalar.label
            node, axes = self.slices.model(now.row.t)[name], self.axes.of[name]
            component = number % len(axes)
            ends: tuple[int, ...] = ()
            if node.domain is None and node.support is not None:
                ends = _open_ends(node.support, component, axes[component])
            self._ends[key] = ends
        return self._ends[key]


# ---- private ------------------------------------------------------------------------------------


def _open_ends(support: Support, component: int, axis: Axis) -> tuple[int, ...]:
    part = _part(support, component)
    points, widths = axis.points, axis.widths
    if part.kind == "circle":
        return () if widths.sum() >= _TURN else (0, -1)
    low, high = _bound(part.low, -np.inf), _bound(part.high, np.inf)
    beyond = (low <= points[0] - widths[0], high >= points[-1] + widths[-1])
    return tuple(end for end, goes_on in zip((0, -1), beyond, strict=True) if goes_on)


def _part(support: Support, component: int) -> Support:
    """The support of one component."""
    for part, count in support.parts:
        size = max(count, 1)
        if component < size:
            return _part(part, component)
        component -= size
    return support


def _bound(bound: object, otherwise: float) -> float:
    """A bound that is the same for all parents; one that moves with them may lie anywhere."""
    values = np.ravel(np.asarray(bound, dtype=float))
    return float(values[0]) if (values == values[0]).all() else otherwise
