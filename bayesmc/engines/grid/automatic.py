"""Grids that are found: range and cells for the one hidden number of a slice, from the model and its data.

A first pass with wide cells lets the grid grow wherever a belief reaches over its ends and refines it where
one stands on few cells. A second pass has cells half as wide, or narrower until the log evidence settles:
what the last halving changed, and what may lie beyond the ends, is the stated error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.dbn import Row
from bayesmc.engines.filtering import in_slice
from bayesmc.engines.grid.axes import Axis, Lattice, Line, axis_of
from bayesmc.engines.grid.landings import Landings, narrowest_piece
from bayesmc.engines.grid.moves import Cells, GridMover
from bayesmc.engines.grid.tables import GridModel
from bayesmc.errors import UnsupportedError, ZeroProbabilityError

#: error of the log evidence (of each series that is filtered by itself) that a grid is made for
TARGET = 0.01
#: error up to which a grid is taken where something lands so far off that particles may miss it: what they
#: aim at themselves
TAKEN_FAR = 0.5
#: cells up to which a grid is found, and entries of tables that a pass may take
MOST_CELLS, MOST_ENTRIES = 4000, 6e9
#: an entry that is evaluated anew in every slice costs as much as so many that are kept
ANEW = 20
#: probability of one cell from which on cells are too wide for a belief
_TOP = 0.5
#: what may lie beyond an end in one slice: so that moments are good, too, where that can be had
_DUST = 1e-6
#: cells per width of the narrowest density, to begin with
_FINE = 1.25
#: what a halving of the cells that were asked for changes, times this, bounds their error
_SAFE = 1.5
#: bytes of beliefs that are kept for the answers, which are worked out again otherwise
_KEPT = float(2**27)
#: relative error of what densities and sums of a row are computed with: log factorials alone take some 1e-14
_ROUNDING = 1e-13


@dataclass(frozen=True, eq=False)
class FoundGrid:
    """A grid, and what it is worth.

    Attributes
    ----------
    name : str
    axis : Axis
    error : ndarray, shape (*apart,)
        Of the log evidence, in absolute value.
    mover : GridMover
    kept : list of Cells or None
        Beliefs of all slices, where they are few.
    far : bool
        Whether something lands far from the rest, where particles seldom come.
    """

    name: str
    axis: Axis
    error: np.ndarray
    mover: GridMover
    kept: list[Cells] | None
    far: bool = False

    @property
    def described(self) -> str:
        """What to say of it."""
        low, high = self.axis.points[0], self.axis.points[-1]
        return f"{self.axis.size} cells from {low:.4g} to {high:.4g}"


def find_grid(
    name: str,
    line: Line,
    make: Callable[[Axis], GridModel],
    rows: Sequence[Row],
    cells: int | None = None,
) -> FoundGrid:
    """The grid of one hidden number.

    Parameters
    ----------
    name : str
    line : Line
    make : callable
        The template on a grid with this axis for the number.
    rows : sequence of Row
    cells : int, optional
        As many as the caller wants; None finds how many.

    Raises
    ------
    UnsupportedError
        No grid of a bounded size holds the beliefs.
    """
    search = _Search(name, make, rows)
    lattice, before = search.held(line, cells)
    if cells is not None:
        lattice = search.covering(lattice, cells)
        others = [
            search.passed(lattice.cut(n), held=True).increments for n in (2 * cells, _other(cells))
        ]
        return search.answer(search.passed(lattice.cut(cells)), others, _SAFE)
    finer = lattice.cut(2 * lattice.cells)
    while True:
        search.check_price(finer)
        found = search.passed(finer)
        wider = found.covering or finer.widened(
            *(found.ends.reshape(2, -1).max(axis=1) > TARGET / 4)
        )
        if wider != finer:  # the first pass saw too little of it
            finer = wider
            continue
        other = search.passed(finer.cut(_other(finer.cells // 2)), held=True)
        others = [before, other.increments]
        done, half = search.answer(found, others), finer.cut(2 * finer.cells)
        small = np.max(done.error) <= TARGET or line.kind == "integers"
        if small or half.cells > MOST_CELLS or search.price(half) > 1:
            return done
        finer, before = half, found.increments


# ---- private ------------------------------------------------------------------------------------


def _other(cells: int) -> int:
    """Cells that lie otherwise: where functions jump, halves of cells may be off by as much as these."""
    return round(1.17 * cells) + 1


@dataclass(frozen=True, eq=False)
class _Passed:
    """One pass over the data."""

    axis: Axis
    mover: GridMover
    increments: np.ndarray
    ends: np.ndarray
    kept: list[Cells] | None
    #: a wider lattice, where this one missed what lands outside: the pass ended there
    covering: Lattice | None = None


class _Search:
    """Passes over the rows of a series on one lattice after the other."""

    def __init__(self, name: str, make: Callable[[Axis], GridModel], rows: Sequence[Row]) -> None:
        self.name, self.make, self.rows = name, make, rows
        self.limit = _DUST
        self.far = False

    def held(self, line: Line, cells: int | None) -> tuple[Lattice, np.ndarray]:
        """A lattice that holds all beliefs, and the log evidence of each row on it.

        It ends where next to nothing is left, or, if that takes too many cells, where the evidence would not
        tell.
        """
        loose = TARGET / (4 * len(self.rows))
        for limit in (min(_DUST, loose), loose):
            self.limit = limit
            try:
                return self.pilot(self.first(line), cells)
            except UnsupportedError:
                if limit == loose:
                    raise
        raise AssertionError

    # ---- where to begin -------------------------------------------------------------------------

    def first(self, line: Line) -> Lattice:
        """A lattice that holds the belief about the first slice, about as fine as densities are wide."""
        low, high = self._guess(line)
        lattice = Lattice(line, low, high, 256)
        if line.kind == "integers":
            lattice = Lattice(line, low, high, round(high - low))
        width = np.inf
        for _ in range(80):
            found = self._tried(self._mover(lattice), None, self.rows[0])
            share = None if found is None else self._shares(found)
            if found is not None and share is None:  # it is seen there
                break
            reached = (True, True) if share is None else self._reached(share, lattice)
            if any(reached):
                span = lattice.high - lattice.low
                wider = lattice.to(
                    lattice.low - span * reached[0], lattice.high + span * reached[1]
                )
                lattice = wider.cut(256)
                continue
            assert share is not None
            tops = share.max(axis=0)
            inside = len(share) * share > self.limit / 2  # as ``_reached`` judges ends
            some = np.flatnonzero(inside.reshape(len(share), -1).any(axis=1))
            width = lattice.step / (2.51 * float(tops.max()))
            if (
                line.kind == "integers"
                or not any(line.grows)
                or np.ptp(some) >= 0.7 * lattice.cells
            ):
                break
            ends = lattice.low + lattice.step * np.array([some[0] - 2, some[-1] + 3])
            lattice = Lattice(line, float(ends[0]), float(ends[1]), 256)
        else:
            raise self._refused("no range was found that holds the belief about its first slice")
        if line.kind == "integers":
            return lattice
        width = min(width, self._narrowest(lattice))
        return self._cut(lattice, _FINE * (lattice.high - lattice.low) / width)

    def _guess(self, line: Line) -> tuple[float, float]:
        """Coordinates between which slice 0 may lie: draws from its density, and what was seen."""
        if not any(line.grows):
            return line.low, line.high
        start = 1.0 if line.kind == "real" else float(np.clip(1.0, line.low + 1, line.high - 1))
        point = float(line.number(np.asarray(0.0))) if line.kind in ("above", "below") else start
        kind = np.int64 if line.kind == "integers" else float
        axis = Axis(np.array([point], dtype=kind), np.ones(1))
        model, row = self.make(axis), self.rows[0]
        placed = model.place(row)
        dist = model.evaluate(True, self.name, model.base(None, placed))
        draws = [np.ravel(dist.sample(np.random.default_rng(0), (400,))).astype(float)]
        for k in {0, len(self.rows) // 2, len(self.rows) - 1}:
            seen = self.rows[k].seen.get(self.name)
            if seen is not None:
                values = np.asarray(seen.value, dtype=float)
                draws.append(np.ravel(values if seen.mask is None else values[seen.mask]))
        u = line.coordinate(np.concatenate(draws))
        u = u[np.isfinite(u)]
        if not len(u):
            raise self._refused("draws from its first density are no numbers")
        low, high = np.quantile(u, [0.01, 0.99])
        if line.kind == "integers":
            low, high = np.floor(low), np.ceil(high) + 1
            span = high - low
            return max(low - span, line.low), min(high + span, line.high + 1)
        span = max(high - low, 1e-9 * max(abs(low), abs(high)), 1e-300)
        return float(low - span), float(high + span)

    def _narrowest(self, lattice: Lattice) -> float:
        """How wide the densities are that lead on from there, in the coordinate."""
        if len(self.rows) < 2:
            return np.inf
        model = self.make(axis_of(lattice.cut(64)))
        before, now = model.place(self.rows[0]), model.place(self.rows[1])
        dist = model.evaluate(False, self.name, model.base(before, now))
        centre: Any = None
        # families without moments, and distributions of the user's that do not say them
        with suppress(UnsupportedError, NotImplementedError, AttributeError):
            centre, width = np.asarray(dist.mean), np.sqrt(np.asarray(dist.var))
        if centre is None or not np.isfinite(width).any():
            draws = dist.sample(np.random.default_rng(0), (64,))
            low, centre, high = np.quantile(draws, [0.25, 0.5, 0.75], axis=0)
            width = (high - low) / 1.35
        width = width / lattice.line.stretch(lattice.line.coordinate(centre))
        width = width[np.isfinite(width) & (width > 0)]
        least = narrowest_piece(dist, lattice)
        return min(least, float(np.quantile(width, 0.1))) if len(width) else least

    # ---- passes ---------------------------------------------------------------------------------

    def pilot(self, lattice: Lattice, cells: int | None) -> tuple[Lattice, np.ndarray]:
        """A pass in which the lattice becomes as wide and as fine as beliefs want; the last one, and logs."""
        mover, before = self._mover(lattice), None
        landings = self._landings(lattice, mover)
        increments, k, impossible = [], 0, 0
        grows = any(lattice.line.grows)
        while k < len(self.rows):
            with in_slice(self.rows[k].t):
                found = self._tried(mover, before, self.rows[k])
                reach = landings.wanted(before, self.rows[k], found)
            share = None if found is None else self._shares(found)
            changed = lattice
            if found is None:
                impossible += 1
                if not grows or impossible > 12:
                    mover.move(before, self.rows[k])  # says what is wrong
                changed = lattice.widened(True, True)
            elif share is not None:
                changed = lattice.widened(*self._reached(share, lattice))
                fixed = cells is not None or lattice.line.kind == "integers"
                if changed.cells == lattice.cells and share.max() > _TOP and not fixed:
                    changed = self._cut(lattice, 2 * lattice.cells)
            held = changed.holding(*reach)
            self.far = self.far or held != changed
            changed = held
            if changed != lattice:
                lattice = changed
                self.check_price(lattice.cut(2 * lattice.cells))
                mover = self._mover(lattice)
                landings = self._landings(lattice, mover)
                continue
            assert found is not None
            increments.append(found.increment)
            before, k = found, k + 1
        return lattice, np.array(increments)

    def passed(self, lattice: Lattice, held: bool = False) -> _Passed:
        """A pass on one lattice, up to where it is seen to be too narrow; it is not where all is ``held``."""
        mover, before = self._mover(lattice), None
        landings = self._landings(lattice, mover)
        increments, kept = [], []
        ends: Any = 0.0
        few = True
        covering = None
        for row in self.rows:
            with in_slice(row.t):
                found = mover.move(before, row)
                if not held:
                    wider = lattice.holding(*landings.wanted(before, row, found))
                    covering = None if wider == lattice else wider
                    ends = ends + landings.lost(before, row, found) / 2  # once for each end
            before = found
            increments.append(before.increment)
            share = self._shares(before)
            if share is not None:
                open_ends = np.where(self._open(lattice), share[[0, -1]].T, 0.0).T
                ends = ends + len(share) * open_ends
            few = few and 2 * before.probs.nbytes * len(self.rows) <= _KEPT
            if few:
                kept.append(before)
            if covering is not None:
                self.far = True
                break
        whole = np.array(increments)
        ends = ends * np.ones((2, *whole.shape[1:]))
        return _Passed(axis_of(lattice), mover, whole, ends, kept if few else None, covering)

    def covering(self, lattice: Lattice, cells: int) -> Lattice:
        """A lattice that misses nothing in so many cells either."""
        for _ in range(20):
            wider = self.passed(lattice.cut(cells)).covering
            if wider is None:
                return lattice
            lattice = wider
        raise self._refused("what lands outside of it lands ever farther")

    def answer(self, found: _Passed, others: Sequence[np.ndarray], times: float = 1.0) -> FoundGrid:
        """A grid with its error: what other cells change, and what may lie beyond the ends."""
        total = found.increments.sum(axis=0)
        times = _SAFE if self.far else times  # functions that jump have errors that halve by chance
        off = times * np.max([np.abs(total - other.sum(axis=0)) for other in others], axis=0)
        rounding = _ROUNDING * np.abs(found.increments).sum(axis=0)
        error = off + found.ends.sum(axis=0) + rounding
        return FoundGrid(self.name, found.axis, error, found.mover, found.kept, self.far)

    def price(self, lattice: Lattice) -> float:
        """What a pass takes, over what it may."""
        model = self._mover(lattice.cut(8)).model
        others = [n for n in model.own if n not in model.leaves and n != self.name]
        domains = [model.slices.first[n].domain for n in others]
        states = np.prod([float(d.size) for d in domains if d is not None], initial=1.0)
        entries = (lattice.cells * states) ** 2 * np.prod(model.lead, initial=1.0)
        anew = ANEW if model.sources(False, self.name).timed else 1
        return float(entries * anew * len(self.rows) / MOST_ENTRIES)

    def check_price(self, lattice: Lattice) -> None:
        """Refuse a lattice that is too large."""
        if lattice.cells > MOST_CELLS:
            low, high = lattice.line.number(np.array([lattice.low, lattice.high]))
            raise self._refused(
                f"beliefs range from {low:.4g} to {high:.4g}, and some are so narrow that this takes more "
                f"than {MOST_CELLS} cells"
            )
        if self.price(lattice) > 1:
            raise self._refused(
                f"{lattice.cells} cells in each of {len(self.rows)} slices take too long"
            )

    # ---- private --------------------------------------------------------------------------------

    def _mover(self, lattice: Lattice) -> GridMover:
        return GridMover(self.make(axis_of(lattice)), np.inf)

    def _landings(self, lattice: Lattice, mover: GridMover) -> Landings:
        return Landings(self.name, lattice, self.make, mover)

    def _tried(self, mover: GridMover, before: Cells | None, row: Row) -> Cells | None:
        try:
            return mover.move(before, row)
        except ZeroProbabilityError:
            return None

    def _shares(self, cells: Cells) -> np.ndarray | None:
        """Probabilities of the cells of the number, shape (n, *apart); zero where it is seen."""
        axis, share = cells.placed.axis(self.name), cells.shares(self.name)
        if axis is None or share is None:
            return None
        return np.where(cells.placed.scalars[axis].widths[-1] > 0, share, 0.0)

    def _open(self, lattice: Lattice) -> np.ndarray:
        """Whether the low and the high end may be moved out."""
        line = lattice.line
        low, high = line.grows
        if line.kind == "integers":
            low, high = lattice.low > line.low, lattice.high < line.high + 1
        return np.array([low, high])

    def _reached(self, share: np.ndarray, lattice: Lattice) -> tuple[bool, bool]:
        """Whether too much may lie beyond the low and the high end: density there times the whole range."""
        beyond = len(share) * share[[0, -1]].reshape(2, -1).max(axis=1)
        low, high = self._open(lattice) & (beyond > self.limit)
        return bool(low), bool(high)

    def _cut(self, lattice: Lattice, cells: float) -> Lattice:
        """So many cells, unless they are too many."""
        finer = lattice.cut(int(min(max(np.ceil(cells), 32), 2 * MOST_CELLS)))
        self.check_price(finer.cut(2 * finer.cells))
        return finer

    def _refused(self, why: str) -> UnsupportedError:
        return UnsupportedError(f"no grid was found for {self.name!r}: {why}")
