"""Forward and backward over the slices of a series, whose coefficients are known beforehand.

Covariances do not depend on the data, so they come first, and stop as soon as a slice repeats the one before
to rounding; means follow, with a run of like slices as one recursion. How one slice is conditioned is in
``kernels.kalman``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bayesmc.engines.kalman.data import Pattern, SeriesData
from bayesmc.engines.kalman.reading import Linear
from bayesmc.engines.kalman.slices import Layout
from bayesmc.errors import DegeneracyError
from bayesmc.kernels.kalman import (
    Conditioned,
    Turned,
    back,
    condition,
    log_densities,
    multiplied,
    standardised,
    turned,
)

_EPS = float(np.finfo(float).eps)
#: slices alike from which on their means are worked out as one recursion
_RUN = 8


class State(NamedTuple):
    """What is known of the numbers that the next slice reads: ``mean + factor @ (independent normals)``."""

    mean: np.ndarray
    factor: np.ndarray


@dataclass(frozen=True, eq=False)
class Filtered:
    """Every slice given the rows up to it.

    Attributes
    ----------
    means : ndarray, shape (time, *lead, n)
    factors : list of ndarray, shape ([*lead], n, n)
        Roots of covariances; ``which`` says which one is a slice's.
    turns : list of Turned or None
        What carries a smoother to the slice before; None in slice 0, and where no smoother asks.
    which : ndarray of int, shape (time,)
        Which of the factors and turns are a slice's.
    increments : ndarray, shape (time, *lead)
    innovations : list of ndarray
        Standardised, by slice; empty unless a smoother wants them.
    """

    means: np.ndarray
    factors: list[np.ndarray]
    turns: list[Turned | None]
    which: np.ndarray
    increments: np.ndarray
    innovations: list[np.ndarray]


def forward(
    data: SeriesData,
    matrices: tuple[Linear, Linear | None],
    smoothing: bool,
    advance: Callable[[int], None],
) -> Filtered:
    """The filter: ``matrices`` are those of slice 0 and of the later ones."""
    chosen = _Chosen(data, matrices)
    covariances = _Covariances(data, chosen, smoothing)
    conditioned, factors, which = covariances.run(advance)
    layout = data.layouts[0]
    filtered = Filtered(
        np.empty((data.steps, *layout.lead, layout.n)),
        factors,
        [
            None if c.turn is None or not k else turned(c, layout.carried)
            for k, c in enumerate(conditioned)
        ],
        which,
        data.certain(),
        [],
    )
    _Means(data, chosen, filtered, conditioned, smoothing).run()
    if not np.isfinite(filtered.increments).all():
        at = np.isfinite(filtered.increments).reshape(data.steps, -1).all(axis=1)
        k = int(np.argmin(at))
        raise DegeneracyError(f"the row of slice {k} has no density given those before", k)
    return filtered


def start_state(layout: Layout) -> State:
    """Before slice 0 there is nothing."""
    return State(np.zeros((*layout.lead, 0)), np.zeros((0, 0)))


def rows_of(
    moves: np.ndarray, noise: np.ndarray, factor: np.ndarray, absent: np.ndarray | None
) -> np.ndarray:
    """Coefficients of the noise of the slice before and of its own, observed numbers first.

    An observed number that an element lacks becomes noise of its own, which tells nothing.
    """
    moved = moves @ factor
    if absent is None and moved.ndim == noise.ndim == 2:
        return np.concatenate((moved, noise), axis=1)
    lead = np.broadcast_shapes(
        moved.shape[:-2], noise.shape[:-2], () if absent is None else absent.shape[:-1]
    )
    parts = [np.broadcast_to(a, lead + a.shape[-2:]) for a in (moved, noise)]
    rows = np.concatenate(parts, axis=-1)
    if absent is None:
        return rows
    p = absent.shape[-1]
    fresh = np.zeros((*lead, rows.shape[-2], p))
    rows[..., :p, :] = np.where(absent[..., None], 0.0, rows[..., :p, :])
    index = np.arange(p)
    fresh[..., index, index] = absent
    return np.concatenate([rows, fresh], axis=-1)


def full_factor(layout: Layout, pattern: Pattern, found: Conditioned) -> np.ndarray:
    """Root of the covariance of all unknown numbers; rows of those observed are zero."""
    if pattern.given is None:
        return found.factor
    kept = pattern.kept - layout.p
    full = np.zeros((*found.factor.shape[:-2], layout.n, layout.n))
    full[..., kept, : len(kept)] = found.factor
    return np.where(pattern.given[..., None], 0.0, full)


def absorbed(
    layout: Layout,
    pattern: Pattern,
    found: Conditioned,
    mean: np.ndarray,
    row: np.ndarray,
    given: np.ndarray | None,
    angles: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Take in a row: means of the unknown numbers, standardised innovations, log density of the row.

    Parameters
    ----------
    mean : ndarray, shape (*lead, observed + kept)
        What is expected of the numbers that the pattern chooses.
    row : ndarray, shape (*lead, observed)
    given : ndarray, shape (*lead, n), or None
        Values of unknown numbers that are observed.
    angles : ndarray of bool, shape (observed,), or None
        Observed numbers whose innovations are angles.
    """
    p = len(pattern.observed)
    off = row - mean[..., :p]
    if angles is not None:
        off = np.where(angles, np.remainder(off + np.pi, 2 * np.pi) - np.pi, off)
    seen: Any = None
    if pattern.absent is not None:
        off = np.where(pattern.absent, 0.0, off)
        seen = p - pattern.absent.sum(axis=-1)
    eta = standardised(found.root, off)
    after = mean[..., p:] + multiplied(found.gain, eta)
    if pattern.given is not None:
        assert given is not None
        kept = pattern.kept - layout.p
        full = np.zeros((*after.shape[:-1], layout.n))
        full[..., kept] = after
        after = np.where(pattern.given, given, full)
    return after, eta, log_densities(found.root, eta, seen)


class Smoothed(NamedTuple):
    """Every slice given later rows: the noise of ``means + factor @ noise`` has these moments.

    Attributes
    ----------
    noise : ndarray, shape (time, *lead, carried)
    spread : ndarray, shape (time, [*lead], carried, carried)
    """

    noise: np.ndarray
    spread: np.ndarray


def backward(data_layout: Layout, filtered: Filtered, lag: int | None) -> Smoothed:
    """The smoother: of all rows, or of those up to ``lag`` slices later."""
    carried, steps = data_layout.carried, len(filtered.which)
    lead = data_layout.lead
    links = {w: turn for w, turn in enumerate(filtered.turns) if turn is not None}
    shifts = np.zeros((steps, *lead, carried))
    for k in range(1, steps):
        shifts[k] = multiplied(links[int(filtered.which[k])].shift, filtered.innovations[k])
    wide = np.broadcast_shapes(*(step.spread.shape[:-2] for step in links.values()))
    noise = np.zeros((steps, *lead, carried))
    spread = np.broadcast_to(np.eye(carried), (steps, *wide, carried, carried)).copy()
    if lag is None:
        for k in range(steps - 2, -1, -1):
            step = links[int(filtered.which[k + 1])]
            noise[k] = shifts[k + 1] + multiplied(step.link, noise[k + 1])
            spread[k] = back(step, spread[k + 1])
        return Smoothed(noise, spread)
    if lag == 0 or steps == 1:
        return Smoothed(noise, spread)
    shape = (*wide, carried, carried)
    later_ones = filtered.which[1:]
    link = np.stack([np.broadcast_to(links[int(w)].link, shape) for w in later_ones])
    rest = np.stack([np.broadcast_to(links[int(w)].spread, shape) for w in later_ones])
    for ahead in range(
        min(lag, steps - 1), 0, -1
    ):  # slice k goes from k + ahead to the one before that
        count = steps - ahead
        later = slice(ahead - 1, steps - 1)
        shared = link[later].reshape(count, *(1,) * (len(lead) - len(wide)), *shape)
        noise[:count] = shifts[ahead:] + np.matvec(shared, noise[:count])
        turn = np.matrix_transpose(link[later])
        spread[:count] = link[later] @ spread[:count] @ turn + rest[later]
    return Smoothed(noise, spread)


# ---- private ------------------------------------------------------------------------------------


class _Chosen:
    """The matrices of each slice, of the numbers that its pattern chooses."""

    def __init__(self, data: SeriesData, matrices: tuple[Linear, Linear | None]) -> None:
        self.matrices = matrices
        self.patterns, self.pattern = data.patterns
        self._kept: dict[tuple[int, int, int], tuple[np.ndarray, np.ndarray]] = {}

    def key(self, k: int) -> tuple[int, int, int]:
        """Slices of one key have the same moves and noise."""
        return min(k, 1), self._index(k), int(self.pattern[k])

    def __call__(self, key: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Moves and noise."""
        if key in self._kept:
            return self._kept[key]
        linear, chosen = self.linear(key[0]), self.patterns[key[2]].chosen
        moves, noise = (_at(a, key[1])[..., chosen, :] for a in (linear.moves, linear.noise))
        if len(linear.moves) == len(linear.noise) == 1:
            self._kept[key] = moves, noise
        return moves, noise

    def linear(self, k: int) -> Linear:
        """The matrices of all slices like the k-th."""
        found = self.matrices[min(k, 1)]
        assert found is not None
        return found

    def _index(self, k: int) -> int:
        """Which entry of its matrices a slice has."""
        if k == 0:
            return 0
        later = self.linear(k)
        return 0 if len(later.moves) == len(later.noise) == 1 else k - 1


class _Covariances:
    """The part that does not depend on the data."""

    def __init__(self, data: SeriesData, chosen: _Chosen, smoothing: bool) -> None:
        self.data, self.chosen, self.smoothing = data, chosen, smoothing

    def run(
        self, advance: Callable[[int], None]
    ) -> tuple[list[Conditioned], list[np.ndarray], np.ndarray]:
        steps = self.data.steps
        conditioned: list[Conditioned] = []
        factors: list[np.ndarray] = []
        which = np.zeros(steps, dtype=np.intp)
        factor = np.zeros((0, 0))
        carried = self.data.layouts[0].carried
        last, settled = None, False
        for k in range(steps):
            key = self.chosen.key(k)
            if not (settled and key == last):
                pattern, layout = self.chosen.patterns[key[2]], self.data.layout(k)
                moves, noise = self.chosen(key)
                rows = rows_of(moves, noise, factor, pattern.absent)
                found = condition(
                    rows, len(pattern.observed), layout.n_prev if self.smoothing else None
                )
                full = full_factor(layout, pattern, found)
                after = full[..., :carried, :carried]
                settled = (
                    key == last and _alike(factor, after) and _alike_record(conditioned[-1], found)
                )
                factor, last = after, key
                conditioned.append(found)
                factors.append(full)
            which[k] = len(conditioned) - 1
            advance(1)
        return conditioned, factors, which


class _Means:
    """The part that does: means and log densities, given the covariances."""

    def __init__(
        self,
        data: SeriesData,
        chosen: _Chosen,
        filtered: Filtered,
        conditioned: list[Conditioned],
        smoothing: bool,
    ) -> None:
        self.data, self.chosen, self.found = data, chosen, filtered
        self.conditioned = conditioned
        self.smoothing = smoothing

    def run(self) -> None:
        which = self.found.which
        starts = np.flatnonzero(np.diff(which, prepend=-1))
        mean = np.zeros((*self.data.layouts[0].lead, 0))
        for low, high in zip(starts, [*starts[1:], len(which)], strict=True):
            pattern = self.chosen.patterns[self.chosen.pattern[low]]
            if high - low >= _RUN and pattern.given is None:
                mean = self._run(int(low), int(high), mean, pattern)
            else:
                for k in range(low, high):
                    mean = self._one(k, mean, pattern)

    def _one(self, k: int, before: np.ndarray, pattern: Pattern) -> np.ndarray:
        layout = self.data.layout(k)
        moves, _ = self.chosen(self.chosen.key(k))
        mean = _at(self.chosen.linear(k).offset, max(k - 1, 0))[..., pattern.chosen]
        if layout.n_prev:
            mean = mean + multiplied(moves, before)
        given = None if self.data.given is None else self.data.given[0][k]
        found = self.conditioned[self.found.which[k]]
        row = self._row(layout, pattern, k, k + 1)[0]
        after, eta, log = absorbed(layout, pattern, found, mean, row, given)
        self.found.means[k] = after
        self.found.increments[k] += log
        if self.smoothing:
            self.found.innovations.append(eta)
        return after[..., : layout.carried]

    def _run(self, low: int, high: int, before: np.ndarray, pattern: Pattern) -> np.ndarray:
        """Like slices: the recursion of the mean with the gain put in, the rest for all at once."""
        layout, p = self.data.layout(low), len(pattern.observed)
        found = self.conditioned[self.found.which[low]]
        moves, _ = self.chosen(self.chosen.key(low))
        offset = self.chosen.linear(low).offset
        offset = offset if len(offset) == 1 else offset[low - 1 : high - 1]
        row = self._row(layout, pattern, low, high)
        gain = found.gain @ _inverse(found.root)
        closed = moves[..., p:, :] - gain @ moves[..., :p, :]
        drive = offset[..., p:] + multiplied(gain, row - offset[..., :p])
        c = layout.carried
        means = self.found.means[low:high]
        previous = np.empty((high - low, *before.shape))
        matrix, steps = closed[..., :c, :], np.ascontiguousarray(drive[..., :c])
        for k in range(high - low):
            previous[k] = before
            before = multiplied(matrix, before) + steps[k]
        expected = offset + multiplied(moves, previous)
        eta = standardised(found.root, row - expected[..., :p])
        means[...] = expected[..., p:] + multiplied(found.gain, eta)
        self.found.increments[low:high] += log_densities(found.root, eta)
        if self.smoothing:
            self.found.innovations.extend(eta)
        return means[-1][..., :c]

    def _row(self, layout: Layout, pattern: Pattern, low: int, high: int) -> np.ndarray:
        """Values of the observed numbers, shape (time, *lead, observed)."""
        seen = self.data.seen(low, high)
        if self.data.given is None or len(pattern.observed) == layout.p:
            return seen
        places = pattern.observed[layout.p :] - layout.p
        return np.concatenate([seen, self.data.given[0][low:high][..., places]], axis=-1)


def _at(array: np.ndarray, index: int) -> np.ndarray:
    """An entry along time, of arrays that have one for all."""
    return array[0] if len(array) == 1 else array[index]


def _inverse(root: np.ndarray) -> np.ndarray:
    """Inverse of a lower root, column by column."""
    p = root.shape[-1]
    columns = [standardised(root[..., None, :, :], np.eye(p))] if p else [np.zeros(root.shape)]
    return np.matrix_transpose(columns[0])


def _alike(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two roots differ by rounding alone: relative to each entry, or to its own row's diagonal."""
    if a.shape != b.shape:
        return False
    size = np.maximum(np.abs(b), np.abs(b.diagonal(0, -2, -1))[..., None])
    return bool((np.abs(a - b) <= 2 * _EPS * size).all())


def _alike_record(a: Conditioned, b: Conditioned) -> bool:
    return _alike(a.root, b.root) and _alike(a.factor, b.factor)
