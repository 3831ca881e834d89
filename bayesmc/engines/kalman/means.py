"""What depends on the data: means, innovations and log densities of all slices, given their covariances.

Given the gains the mean of a slice is affine in the mean of the slice before, so the one thing that goes
slice by slice is a small product. What leads to it, and everything that follows from it, is done for many
slices at once, those of one pattern together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from bayesmc.distributions.circular import wrap_angle
from bayesmc.distributions.noiseless import ALLOWED, FLOOR, ROUNDED
from bayesmc.engines.kalman.covariances import (
    Chosen,
    Covariances,
    at,
    by_pattern,
    certain_of,
    stacked_fields,
)
from bayesmc.engines.kalman.data import Pattern, SeriesData
from bayesmc.engines.kalman.slices import Layout
from bayesmc.linalg.square_root import Conditioned, log_densities, multiplied, standardised, went_in
from bayesmc.results.predictive import Predictive

#: slices of one kind on end from which on they share their matrices
_RUN = 64
#: otherwise, slices and numbers that are worked on at once
_CHUNK = 1024
_ENTRIES = 1 << 21


class Innovations:
    """Standardised innovations of all slices, written as the slices pass.

    Parameters
    ----------
    layout : Layout
        Of any slice.
    names : iterable of str
        Observed nodes.
    steps : int

    Attributes
    ----------
    nis : ndarray, shape (time, *lead)
        Squares of the innovations, normalised by their joint covariance.
    df : ndarray of int, shape (time, *lead)
        Numbers that were observed.
    """

    def __init__(self, layout: Layout, names: Iterable[str], steps: int) -> None:
        self.layout, shape = layout, (steps, *layout.lead)
        self.nis = np.zeros(shape)
        self.df = np.zeros(shape, dtype=np.intp)
        self._of = {n: np.full((*shape, layout.size(n)), np.nan) for n in names}

    def put(
        self, at: Any, layout: Layout, pattern: Pattern, root: np.ndarray, eta: np.ndarray
    ) -> None:
        """Those of slices ``at`` (an index, or an array of them): roots, and what they standardise to."""
        p = len(pattern.observed)
        if not p:
            return
        self.nis[at] = np.vecdot(eta, eta)
        with np.errstate(invalid="ignore", divide="ignore"):
            off = multiplied(root, eta) / np.sqrt(np.vecdot(root, root))
        self.df[at] = p
        if pattern.absent is not None:
            self.df[at] = p - pattern.absent.sum(axis=-1)
            off = np.where(pattern.absent, np.nan, off)
        for name, place in layout.seen.items():
            if name in self._of:
                self._of[name][at] = off[..., place]
        given = pattern.observed[layout.p :] - layout.p
        for name in (n for n in layout.rows if n in self._of and len(given)):
            place = layout.rows[name]
            own = np.flatnonzero((given >= place.start) & (given < place.stop))
            rows = self._of[name][at]
            rows[..., given[own] - place.start] = off[..., layout.p + own]
            self._of[name][at] = rows

    def first(self, steps: int) -> Innovations:
        """Of the first so many slices."""
        found = Innovations(self.layout, (), steps)
        found.nis, found.df = self.nis[:steps], self.df[:steps]
        found._of = {n: v[:steps] for n, v in self._of.items()}
        return found

    def of(self, name: str) -> np.ndarray | None:
        """A node's, each number by its own standard deviation, shape ``(time, *plates, *event)``; or None."""
        if name not in self._of:
            return None
        return self.layout.unpacked(self.layout.slices.first[name], self._of[name])

    def predictive(self) -> Predictive:
        """The same as ranks: rows of a Gaussian are the less likely the larger their NIS."""
        seen = self.df > 0
        df = np.maximum(self.df, 1)
        ranks = np.where(seen, special.chdtrc(df, self.nis), np.nan)
        deficits = np.where(seen, 0.5 * (self.nis - self.df) / df, np.nan)
        return Predictive(ranks, deficits, {n: special.ndtr(self.of(n)) for n in self._of})


class Means(NamedTuple):
    """Means given the rows up to each slice.

    Attributes
    ----------
    means : ndarray, shape (time, *lead, n)
    increments : ndarray, shape (time, *lead)
        Log densities of rows.
    shifts : ndarray, shape (time, *lead, carried), or None
        What the innovations of a slice tell of the noise of the one before; for smoothers.
    innovations : Innovations
    """

    means: np.ndarray
    increments: np.ndarray
    shifts: np.ndarray | None
    innovations: Innovations


def all_means(data: SeriesData, chosen: Chosen, covariances: Covariances, smoothing: bool) -> Means:
    """The means of all slices."""
    layout, steps = data.layouts[0], data.steps
    shape = (steps, *layout.lead)
    shifts = np.zeros((*shape, layout.carried)) if smoothing else None
    innovations = Innovations(layout, data.series.observed, steps)
    found = Means(np.empty((*shape, layout.n)), data.certain(), shifts, innovations)
    work = _Work(data, chosen, covariances, found)
    mean = work.first()
    for low, high in work.stretches():
        mean = work.stretch(low, high, mean)
    return found


def absorbed(
    layout: Layout,
    pattern: Pattern,
    found: Conditioned,
    mean: np.ndarray,
    row: np.ndarray,
    given: np.ndarray | None,
    angles: np.ndarray | None = None,
    terms: Callable[[], np.ndarray] | None = None,
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
    terms : callable, optional
        How large the terms are whose sum is ``mean``; without it they count as no larger than that.
    """
    p = len(pattern.observed)
    off = row - mean[..., :p]
    if angles is not None:
        off = np.where(angles, wrap_angle(off), off)
    off, seen = _present(pattern, off)
    eta = _solved(_single(found.root), off)
    after = mean[..., p:] + _times(found.gain, eta)
    after = _placed(layout, pattern, after, given)
    log = log_densities(found.root, eta, seen, found.certain)
    if found.certain is not None:
        size = np.abs(mean) if terms is None else terms()
        wrong = _contradicts(found.certain, found.root, eta, row, mean[..., :p], size[..., :p])
        log = np.where(wrong, -np.inf, log)
    return after, eta, log


# ---- private ------------------------------------------------------------------------------------


class _Part(NamedTuple):
    """Slices of one pattern; matrices have an axis for time, of length 1 where all share them."""

    slices: np.ndarray
    pattern: Pattern
    kinds: np.ndarray
    offset: np.ndarray
    moves: np.ndarray
    made: Conditioned
    row: np.ndarray
    given: np.ndarray | None


class _Work:
    def __init__(
        self, data: SeriesData, chosen: Chosen, covariances: Covariances, found: Means
    ) -> None:
        self.data, self.chosen, self.covariances, self.found = data, chosen, covariances, found
        self.carried, self.lead = data.layouts[0].carried, data.layouts[0].lead

    def first(self) -> np.ndarray:
        """Slice 0: the mean of what slice 1 reads."""
        layout, chosen = self.data.layouts[0], self.chosen
        pattern = chosen.patterns[chosen.pattern[0]]
        mean = at(chosen.linear(0).offset, 0)[..., pattern.chosen]
        given = None if self.data.given is None else self.data.given[0][0]
        made = self.covariances.conditioned[self.covariances.which[0]]
        row = self._row(layout, pattern, np.zeros(1, dtype=np.intp))[0]
        after, eta, log = absorbed(layout, pattern, made, mean, row, given)
        self.found.innovations.put(0, layout, pattern, made.root, eta)
        self.found.means[0] = after
        self.found.increments[0] += log
        return after[..., : layout.carried]

    def stretches(self) -> Iterator[tuple[int, int]]:
        """Slices to work on together: long runs of one kind, and what is between them in pieces."""
        steps, which = self.data.steps, self.covariances.which
        edges = [0, *(np.flatnonzero(np.diff(which)) + 1).tolist(), steps]
        size = max(self.data.layouts[1].n + self.data.layouts[1].p, 1) * max(self.carried, 1)
        piece = max(1, min(_CHUNK, _ENTRIES // (size * max(math.prod(self.lead), 1))))
        low = 1
        for start, stop in [*zip(edges, edges[1:], strict=False), (steps, steps)]:
            start = max(start, 1)
            if stop - start >= _RUN or start == steps:
                for cut in range(low, start, piece):
                    yield cut, min(cut + piece, start)
                if stop > start:
                    yield start, stop
                low = stop

    def stretch(self, low: int, high: int, before: np.ndarray) -> np.ndarray:
        """Some slices after slice 0, of which ``before`` is the mean of what the first reads."""
        groups = by_pattern(self.chosen.pattern[low:high])
        parts = [self._part(low + group) for group in groups]
        closed = [self._closed(part) for part in parts]
        lead = np.broadcast_shapes(*(matrix.shape[1:-2] for matrix, _ in closed))
        c, count = self.carried, high - low
        shared = len(parts) == 1 and len(closed[0][0]) == 1
        matrices = np.empty((1 if shared else count, *lead, c, c))
        drives = np.empty((count, *self.lead, c))
        for group, (matrix, drive) in zip(groups, closed, strict=True):
            matrices[slice(None) if shared else group] = matrix
            drives[group] = drive
        previous, after = _followed(matrices, drives, before)
        for group, part in zip(groups, parts, strict=True):
            self._write(part, previous[group])
        return after

    def _part(self, slices: np.ndarray) -> _Part:
        chosen, layout = self.chosen, self.data.layouts[1]
        pattern, linear = chosen.patterns[chosen.pattern[slices[0]]], chosen.linear(1)
        kinds, inverse = np.unique(self.covariances.which[slices], return_inverse=True)
        records = [self.covariances.conditioned[k] for k in kinds]

        def whole(field: str) -> np.ndarray:
            return self._wide(stacked_fields(records, field), 2, inverse)

        moves = linear.moves if len(linear.moves) == 1 else linear.moves[slices - 1]
        offset = linear.offset if len(linear.offset) == 1 else linear.offset[slices - 1]
        certain = certain_of(records)
        if certain is not None:
            certain = self._wide(certain, 1, inverse)
        made = Conditioned(whole("root"), whole("gain"), np.zeros(0), None, certain)
        return _Part(
            slices, pattern, kinds, offset[..., pattern.chosen],
            self._wide(moves[..., pattern.chosen, :], 2), made, self._row(layout, pattern, slices),
            None if self.data.given is None else self.data.given[0][slices],
        )  # fmt: skip

    def _wide(self, array: np.ndarray, tail: int, inverse: np.ndarray | None = None) -> np.ndarray:
        """With axes for the plates apart, and one entry per slice where there are several."""
        if inverse is not None and len(array) > 1:
            array = array[inverse]
        ones = 1 + len(self.lead) + tail - array.ndim
        return array.reshape(len(array), *(1,) * ones, *array.shape[1:])

    def _closed(self, part: _Part) -> tuple[np.ndarray, np.ndarray]:
        """What a slice makes of the mean before it: matrices, (time, [*lead], c, c), and what is added."""
        pattern, p, c = part.pattern, len(part.pattern.observed), self.carried
        look = part.moves[..., :p, :]
        if pattern.absent is not None:
            look = np.where(pattern.absent[..., None], 0.0, look)
        root = _single(part.made.root)
        gain = part.made.gain[..., :c, :]
        each = root if root.ndim == 2 else root[..., None, :, :]
        scaled = np.matrix_transpose(_solved(each, np.matrix_transpose(look)))
        matrices = part.moves[..., p : p + c, :] - gain @ scaled
        off, _ = _present(pattern, part.row - part.offset[..., :p])
        drives = part.offset[..., p : p + c] + _times(gain, _solved(root, off))
        if pattern.given is not None and (known := pattern.given[..., :c]).any():
            assert part.given is not None
            matrices = np.where(known[..., None], 0.0, matrices)
            drives = np.where(known, part.given[..., :c], drives)
        return matrices, drives

    def _write(self, part: _Part, previous: np.ndarray) -> None:
        """Everything that follows from the means of the slices before."""
        layout, pattern, made = self.data.layouts[1], part.pattern, part.made
        expected = part.offset + _times(part.moves, previous)

        def terms() -> np.ndarray:
            return np.abs(part.offset) + _times(np.abs(part.moves), np.abs(previous))

        after, eta, log = absorbed(
            layout, pattern, made, expected, part.row, part.given, terms=terms
        )
        self.found.means[part.slices] = after
        self.found.increments[part.slices] += log
        self.found.innovations.put(part.slices, layout, pattern, made.root, eta)
        if self.found.shifts is not None:
            records = [self.covariances.conditioned[k] for k in part.kinds]
            inverse = np.searchsorted(part.kinds, self.covariances.which[part.slices])
            turn = stacked_fields(records, "turn")[..., : len(pattern.observed)]
            self.found.shifts[part.slices] = _times(self._wide(turn, 2, inverse), eta)

    def _row(self, layout: Layout, pattern: Pattern, slices: np.ndarray) -> np.ndarray:
        """Values of the observed numbers, shape (time, *lead, observed)."""
        first, later = int(slices[0]), int(slices[-1])
        seen = self.data.seen(first, later + 1)[slices - first]
        if self.data.given is None or len(pattern.observed) == layout.p:
            return seen
        places = pattern.observed[layout.p :] - layout.p
        return np.concatenate([seen, self.data.given[0][slices][..., places]], axis=-1)


def _contradicts(
    certain: np.ndarray,
    root: np.ndarray,
    eta: np.ndarray,
    row: np.ndarray,
    mean: np.ndarray,
    terms: np.ndarray,
) -> np.ndarray:
    """Whether something observed is not what it must be given the rest, shape (..., *lead).

    It may be a small difference of large numbers, which rounding leaves its mark on.
    """
    off = np.abs(eta) * root.diagonal(0, -2, -1)
    row = np.where(np.isnan(row), 0.0, np.abs(row))  # elements may lack some
    allowed = ALLOWED * (row + np.abs(mean)) + ROUNDED * went_in(root, row + terms) + FLOOR
    return (certain & (off > allowed)).any(axis=-1)


def _followed(
    matrices: np.ndarray, drives: np.ndarray, before: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """``x[k + 1] = matrices[k] @ x[k] + drives[k]`` from ``before``: all but the last, and the last."""
    found, count = np.empty(drives.shape), len(drives)
    c = drives.shape[-1]
    if not c:
        return found, before
    if found[0].size == 1:  # the arithmetic of Python's numbers is the faster one
        x, numbers = before.item(), []
        slopes = matrices.ravel().tolist() * (count if len(matrices) == 1 else 1)
        for slope, drive in zip(slopes, drives.ravel().tolist(), strict=True):
            numbers.append(x)
            x = slope * x + drive
        return np.array(numbers).reshape(found.shape), np.full(before.shape, x)
    index = [0] * count if len(matrices) == 1 else range(count)
    if math.prod(matrices.shape[1:-2]) == 1:
        turned = np.ascontiguousarray(
            np.matrix_transpose(matrices.reshape(len(matrices), c, c))
        )  # for vectors as rows
        for k, m in enumerate(index):
            found[k] = before
            before = before.dot(turned[m]) + drives[k]
        return found, before
    for k, m in enumerate(index):
        found[k] = before
        before = np.matvec(matrices[m], before) + drives[k]
    return found, before


def _present(pattern: Pattern, off: np.ndarray) -> tuple[np.ndarray, Any]:
    """Innovations without those that elements lack, and how many there are if not all."""
    if pattern.absent is None:
        return off, None
    count = len(pattern.observed) - pattern.absent.sum(axis=-1)
    return np.where(pattern.absent, 0.0, off), count


def _placed(
    layout: Layout, pattern: Pattern, after: np.ndarray, given: np.ndarray | None
) -> np.ndarray:
    """Means of all unknown numbers, from those that were worked out and those that are given."""
    if pattern.given is None:
        return after
    assert given is not None
    full = np.zeros((*after.shape[:-1], layout.n))
    full[..., pattern.kept - layout.p] = after
    return np.where(pattern.given, given, full)


def _single(matrix: np.ndarray) -> np.ndarray:
    """One matrix where there is one for all."""
    alone = math.prod(matrix.shape[:-2]) == 1
    return matrix.reshape(matrix.shape[-2:]) if alone else matrix


def _times(matrix: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return multiplied(_single(matrix), vectors)


def _solved(root: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return standardised(root, vectors) if vectors.shape[-1] else vectors
