"""Where the next slice may lie: pieces of the densities that lead on, held against the range of a lattice.

A lattice that grows by the density in its outer cells sees what goes on beyond its ends, not what lands far
from them: a component of a mixture, a function that jumps. Here all pieces of the densities are looked up,
from all cells that have probability and from some beyond the ends.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import bayesmc.distributions as families
from bayesmc.dbn import Row
from bayesmc.distributions import Affine, Distribution, Mixture, Truncated
from bayesmc.distributions.adapt import ScipyUnivariate
from bayesmc.engines.grid.axes import Axis, Lattice
from bayesmc.engines.grid.moves import Cells, GridMover
from bayesmc.engines.grid.slice import Placed
from bayesmc.engines.grid.tables import GridModel, ends_of

#: probability, times what the row makes of it, from which on a piece must be on the lattice
_COUNTS = 1e-12
#: the same for a draw from a density whose pieces are not known, and draws in all
_SEEN, _DRAWS = 1e-8, 4096
#: widths around the centre of a piece that are covered; its ends are looked after by density
_WIDTHS = 4.0
#: points beyond each end, and how far they reach in lengths of the lattice
_BEYOND, _REACH = 32, 0.5
#: points at which a row is asked what it makes of pieces with little probability
_ASKED = 64
#: families of one piece
_SINGLE = (
    families.Normal, families.StudentT, families.Laplace, families.Cauchy, families.HalfNormal,
    families.HalfCauchy, families.LogNormal, families.InverseGamma, families.Weibull, families.Uniform,
    families.Gamma, families.Exponential, families.Poisson, families.Binomial, families.NegativeBinomial,
    families.Geometric, families.DiscreteUniform, families.Beta,
)  # fmt: skip


class Pieces(NamedTuple):
    """Pieces of a density with one peak each, on the last axis.

    Attributes
    ----------
    weights, low, centre, high : ndarray, shape (*batch, K)
        Probabilities; medians, and the quantiles at one standard deviation of a normal density.
    known : bool
        Whether these are all there are; else they are draws.
    """

    weights: np.ndarray
    low: np.ndarray
    centre: np.ndarray
    high: np.ndarray
    known: bool


def pieces_of(dist: Distribution, batch: int) -> Pieces:
    """Pieces of a distribution with so many batch elements.

    Mixtures of families with one peak have their components, those families one piece; any other is drawn
    from.
    """
    levels = (0.1587, 0.5, 0.8413)
    if isinstance(dist, Mixture) and all(map(_is_single, dist.parts)):
        low, centre, high = map(dist.component_ppf, levels)
        return Pieces(dist.weights, low, centre, high, True)
    if _is_single(dist):
        low, centre, high = (np.asarray(dist.ppf(q))[..., None] for q in levels)
        return Pieces(np.ones(1), low, centre, high, True)
    count = max(_DRAWS // max(batch, 1), 64)
    draws = np.moveaxis(dist.sample(np.random.default_rng(0), (count,)), 0, -1).astype(float)
    return Pieces(np.full(1, 1 / count), draws, draws, draws, False)


class Landings:
    """What lands where, of one node on one lattice.

    Parameters
    ----------
    name : str
    lattice : Lattice
    make : callable
        The template on a grid with this axis for the number.
    mover : GridMover
        Of the lattice.
    """

    def __init__(
        self, name: str, lattice: Lattice, make: Callable[[Axis], GridModel], mover: GridMover
    ) -> None:
        self.name, self.lattice, self.make, self.mover = name, lattice, make, mover
        line = lattice.line
        span = lattice.high - lattice.low
        self.low, self.high = lattice.low, lattice.high
        self.far = self.low - _REACH * span, self.high + _REACH * span
        self.can_grow = any(line.grows)
        self._kept: dict[Any, _Landed] = {}
        self._ghosts: list[tuple[np.ndarray, GridModel]] | None = None
        #: whether pieces were all known so far
        self.known = True

    def wanted(self, before: Cells | None, row: Row, found: Cells | None) -> tuple[float, float]:
        """Coordinates that the lattice must reach, so that nothing that counts lands outside.

        Parameters
        ----------
        before : Cells or None
            The belief about the slice before.
        row : Row
        found : Cells or None
            The belief about this slice on the lattice; None where nothing there explains the row.
        """
        low, high = self.low, self.high
        if not self.can_grow or self._is_seen(row):
            return low, high
        landed = self._landed(self.mover.model, before, row, (self.low, self.high))
        if len(landed.at):
            weights = landed.weights * self._shares(before)[landed.cells]
            counts = self._count(landed, weights, before, row, found)
            low = min(low, landed.low[counts].min(initial=np.inf))
            high = max(high, landed.high[counts].max(initial=-np.inf))
        if before is None or self._is_seen(before.placed.row):
            return low, high
        return self._beyond(before, row, found, low, high)

    def lost(self, before: Cells | None, row: Row, found: Cells) -> np.ndarray:
        """A bound for the share of the evidence that is left out, where pieces are not known."""
        if self.known or not self.can_grow or self._is_seen(row):
            return np.zeros(np.shape(found.increment))
        span = self.high - self.low
        out = span * np.geomspace(1e-3, 1e4, 200)
        seen = [np.ravel(np.asarray(s.value, dtype=float)) for s in row.seen.values()]
        some = self.lattice.line.coordinate(np.concatenate(seen)) if seen else np.empty(0)
        u = np.concatenate([self.low - out[::-1], self.high + out, some[np.isfinite(some)]])
        most = self._log_ratio(u, before, row, found).max(initial=0.0)
        return np.abs(1 - found.mass) * np.exp(min(max(most, 0.0), 700.0))

    # ---- private --------------------------------------------------------------------------------

    def _is_seen(self, row: Row) -> bool:
        return self.name in row.seen and row.seen[self.name].mask is None

    def _shares(self, before: Cells | None) -> np.ndarray:
        """Probabilities of the cells of the slice before, the largest of all plate elements."""
        share = None if before is None else before.shares(self.name)
        return np.ones(1) if share is None else share.reshape(len(share), -1).max(axis=1)

    def _landed(
        self, model: GridModel, before: Cells | None, row: Row, ends: tuple[float, float]
    ) -> _Landed:
        """Pieces outside these ends, of a density on the cells of a model."""
        was = None if before is None else before.placed
        fixed = model.is_fixed(self.name, was, row)
        inside = model is self.mover.model
        key = (id(model), was is not None and was.row.t == 0, inside and ends_of(was))
        if fixed and key in self._kept:
            return self._kept[key]
        if was is not None and not inside:
            was = model.place(was.row)
        now = model.place(row)
        dist = model.evaluate(was is None, self.name, model.base(was, now))
        found = self._outside(dist, was, now, ends)
        if fixed:
            self._kept[key] = found
        return found

    def _outside(
        self, dist: Any, was: Placed | None, now: Placed, ends: tuple[float, float]
    ) -> _Landed:
        node = self.mover.model.slices.first[self.name]
        before = 0 if was is None else len(was.scalars)
        lead = before + len(now.scalars)
        shape = (1,) * (lead + len(node.plates) - len(dist.batch_shape)) + dist.batch_shape
        pieces = pieces_of(dist, int(np.prod(shape)))
        self.known = self.known and pieces.known
        count = max(p.shape[-1] for p in (pieces.weights, pieces.centre))
        whole = [np.broadcast_to(p, (*shape, count)) for p in pieces[:4]]
        if was is None and pieces.known and count == 1 and np.prod(shape[:lead]) == 1:
            return _nothing()  # one peak in slice 0: the ends of the lattice tell
        axis = None if was is None else was.axis(self.name)
        cells = np.zeros(whole[0].shape, dtype=np.intp)
        if axis is not None and shape[axis] > 1:
            cells += np.arange(shape[axis]).reshape(-1, *(1,) * (cells.ndim - 1 - axis))
        coordinate = self.lattice.line.coordinate
        low, at, high = (coordinate(p) for p in whole[1:])
        some = np.isfinite(at) & (whole[0] > 0) & ((at < ends[0]) | (at > ends[1]))
        at, low, high = at[some], low[some], high[some]
        low = np.where(np.isfinite(low), at - _WIDTHS * (at - low), at)
        high = np.where(np.isfinite(high), at + _WIDTHS * (high - at), at)
        alike = axis is not None and shape[axis] == 1
        return _Landed(whole[0][some], at, low, high, cells[some], bool(alike), pieces.known)

    def _count(
        self, landed: _Landed, weights: np.ndarray, before: Cells | None, row: Row,
        found: Cells | None,
    ) -> np.ndarray:  # fmt: skip
        """Which pieces count: those with probability, and those that the row asks for."""
        least = _COUNTS if landed.known else _SEEN
        counts = weights > least
        rest = np.flatnonzero(~counts & (weights > 0))
        if found is None:
            counts[rest] = True
        elif len(rest):
            u = landed.at[rest]
            bins = np.digitize(u, np.linspace(u.min(), u.max(), _ASKED))
            order = np.lexsort((-weights[rest], bins))
            best = order[np.unique(bins[order], return_index=True)[1]]
            asked = rest[best]
            ratio = self._log_ratio(landed.at[asked], before, row, found)
            counts[asked] = ratio + np.log(weights[asked]) > np.log(least)
        return counts

    def _log_ratio(self, u: np.ndarray, before: Cells | None, row: Row, found: Cells) -> np.ndarray:
        """What the row makes of points, relative to its log density on the lattice."""
        values = self.lattice.line.number(u)
        if self.lattice.line.kind == "integers":
            values = np.round(values).astype(np.int64)
        mover = GridMover(self.make(Axis(values, np.ones(len(u)))), np.inf)
        placed, log = mover.likelihood(before, row)
        axis = placed.axis(self.name)
        if axis is None:
            return np.zeros(len(u))
        log = log.max(axis=tuple(k for k in range(len(placed.scalars)) if k != axis))
        ratio = (log - found.increment).reshape(len(u), -1).max(axis=1)
        return np.where(np.isnan(ratio), -np.inf, ratio)

    def _beyond(
        self, before: Cells, row: Row, found: Cells | None, low: float, high: float
    ) -> tuple[float, float]:
        """How far the ends must go, as functions may jump from numbers beyond them."""
        axis = before.placed.axis(self.name)
        if axis is None or self.lattice.line.kind == "integers":
            return low, high
        if before.placed.scalars[axis].size != self.mover.model.axes.of[self.name][0].size:
            return low, high  # a belief on a narrower lattice does not tell how it ends on this one
        share = self._shares(before)
        for side, (u, model) in enumerate(self._models_beyond()):
            landed = self._landed(model, before, row, self.far)
            if landed.alike or not len(landed.at) or not landed.known:
                continue
            weights = landed.weights * share[-side]
            counts = self._count(landed, weights, before, row, found)
            if counts.any():
                reached = u[landed.cells[counts]]
                low = min(low, float(reached.max())) if not side else low
                high = max(high, float(reached.min())) if side else high
        return low, high

    def _models_beyond(self) -> list[tuple[np.ndarray, GridModel]]:
        if self._ghosts is None:
            at = (np.arange(_BEYOND) + 1) / _BEYOND
            self._ghosts = []
            for u in (
                self.low + (self.far[0] - self.low) * at,
                self.high + (self.far[1] - self.high) * at,
            ):
                values = self.lattice.line.number(u)
                self._ghosts.append((u, self.make(Axis(values, np.ones(len(u))))))
        return self._ghosts


def narrowest_piece(dist: Distribution, lattice: Lattice) -> float:
    """How narrow the pieces of a mixture are in the coordinate, leaving out few of its batch elements."""
    if not isinstance(dist, Mixture) or not all(map(_is_single, dist.parts)):
        return np.inf
    pieces = pieces_of(dist, 1)
    width = (pieces.high - pieces.low) / 2
    width = width / lattice.line.stretch(lattice.line.coordinate(pieces.centre))
    width = width.reshape(-1, width.shape[-1])
    width = np.where(np.isfinite(width) & (width > 0), width, np.inf)
    return float(np.quantile(width, 0.1, axis=0, method="lower").min())


# ---- private ------------------------------------------------------------------------------------


class _Landed(NamedTuple):
    """Pieces that land outside: probabilities, where, what to cover, and from which cell."""

    weights: np.ndarray
    at: np.ndarray
    low: np.ndarray
    high: np.ndarray
    cells: np.ndarray
    alike: bool
    known: bool


def _nothing() -> _Landed:
    none = np.empty(0)
    return _Landed(none, none, none, none, np.empty(0, dtype=np.intp), False, True)


def _is_single(dist: Any) -> bool:
    if isinstance(dist, (Affine, Truncated)):
        return _is_single(dist.base)
    if isinstance(dist, ScipyUnivariate):
        family = type(dist.scipy.dist)
        return family.__module__.startswith("scipy.stats._") and family.__name__ != "rv_histogram"
    return type(dist) in _SINGLE
