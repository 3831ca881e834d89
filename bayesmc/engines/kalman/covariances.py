"""What does not depend on the data: roots of covariances over the slices of a series, worked out once each.

Conditioning a slice takes the root before it and the slice's kind. Where both have been met before, to
rounding, nothing is worked out again: so covariances settle where all slices are alike, and go round where
missing rows come round. Otherwise there is one triangularisation per slice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.engines.kalman.data import Pattern, SeriesData
from bayesmc.engines.kalman.reading import Linear
from bayesmc.engines.kalman.slices import Layout
from bayesmc.linalg.square_root import Conditioned, condition

_EPS = float(np.finfo(float).eps)
#: roots among which one that repeats is looked for
_KEPT = 1 << 14
#: characters of a number in hexadecimal by which it is looked up: the sign, 0x1. and ten digits, 40 bits
_DIGITS = 14

Key = tuple[int, int, int]


class Chosen:
    """The matrices of each slice, of the numbers that its pattern chooses."""

    def __init__(self, data: SeriesData, matrices: tuple[Linear, Linear | None]) -> None:
        self.matrices = matrices
        self.patterns, self.pattern = data.patterns
        self._kept: dict[Key, tuple[np.ndarray, np.ndarray]] = {}

    def keys(self) -> list[Key]:
        """By slice: those of one key have the same moves and noise."""
        later = self.matrices[1]
        alike = later is None or len(later.moves) == len(later.noise) == 1
        return [
            (min(k, 1), 0 if alike or not k else k - 1, pattern)
            for k, pattern in enumerate(self.pattern.tolist())
        ]

    def __call__(self, key: Key) -> tuple[np.ndarray, np.ndarray]:
        """Moves and noise."""
        if key in self._kept:
            return self._kept[key]
        linear, chosen = self.linear(key[0]), self.patterns[key[2]].chosen
        moves, noise = (at(a, key[1])[..., chosen, :] for a in (linear.moves, linear.noise))
        if len(linear.moves) == len(linear.noise) == 1:
            self._kept[key] = moves, noise
        return moves, noise

    def linear(self, k: int) -> Linear:
        """The matrices of all slices like the k-th."""
        found = self.matrices[min(k, 1)]
        assert found is not None
        return found


class Covariances(NamedTuple):
    """Conditioning by kind of slice.

    Attributes
    ----------
    conditioned : list of Conditioned
    patterns : list of int
        The pattern of each of them.
    which : ndarray of int, shape (time,)
        Which of them is a slice's.
    """

    conditioned: list[Conditioned]
    patterns: list[int]
    which: np.ndarray


def worked_out(
    data: SeriesData, chosen: Chosen, smoothing: bool, advance: Callable[[int], None]
) -> Covariances:
    """The covariances of all slices; ``smoothing`` keeps what takes a smoother back."""
    carried, n_prev = data.layouts[0].carried, data.layouts[1].n_prev
    gone = [_given_carried(pattern, carried) for pattern in chosen.patterns]
    found = Covariances([], [], np.empty(data.steps, dtype=np.intp))
    states = _States(np.zeros((0, 0)))
    met: dict[tuple[int, Key], tuple[int, int]] = {}  # (state, kind of slice) -> (record, state)
    state, told = 0, 0
    for k, key in enumerate(chosen.keys()):
        entry = met.get((state, key))
        if entry is None:
            pattern = chosen.patterns[key[2]]
            moves, noise = chosen(key)
            rows = rows_of(moves, noise, states.root(state), pattern.absent)
            turned = (n_prev if k else 0) if smoothing else None
            made = condition(rows, len(pattern.observed), turned)
            found.conditioned.append(made)
            found.patterns.append(key[2])
            after = made.factor[..., :carried, :carried]
            missing = gone[key[2]]
            if missing is not None:
                after = np.where(missing, 0.0, after)
            entry = len(found.conditioned) - 1, states.add(after)
            if len(met) >= _KEPT:
                met.clear()
            met[state, key] = entry
        found.which[k], state = entry
        if k - told >= 99:
            advance(k - told)
            told = k
    advance(data.steps - told)
    return found


def rows_of(
    moves: np.ndarray, noise: np.ndarray, factor: np.ndarray, absent: np.ndarray | None
) -> np.ndarray:
    """Coefficients of the noise of the slice before and of its own, observed numbers first.

    An observed number that an element lacks becomes noise of its own, which tells nothing.
    """
    if absent is None and moves.ndim == noise.ndim == factor.ndim == 2:
        c = factor.shape[1]
        rows = np.empty((len(moves), c + noise.shape[1]))
        rows[:, :c] = moves.dot(factor)
        rows[:, c:] = noise
        return rows
    moved = moves @ factor
    lead = np.broadcast_shapes(
        moved.shape[:-2], noise.shape[:-2], () if absent is None else absent.shape[:-1]
    )
    parts = [np.broadcast_to(a, lead + a.shape[-2:]) for a in (moved, noise)]
    rows = np.concatenate(parts, axis=-1)
    return rows if absent is None else without_absent(rows, absent)


def without_absent(rows: np.ndarray, absent: np.ndarray) -> np.ndarray:
    """Rows of what some elements lack as noise of their own, which tells nothing; overwrites them."""
    p = absent.shape[-1]
    rows[..., :p, :] = np.where(absent[..., None], 0.0, rows[..., :p, :])
    fresh = np.zeros((*rows.shape[:-1], p))
    index = np.arange(p)
    fresh[..., index, index] = absent
    return np.concatenate([rows, fresh], axis=-1)


def full_factor(layout: Layout, pattern: Pattern, factor: np.ndarray) -> np.ndarray:
    """Root of the covariance of all unknown numbers; rows of those observed are zero.

    Parameters
    ----------
    factor : ndarray, shape (..., kept, kept)
    """
    if pattern.given is None:
        return factor
    kept = pattern.kept - layout.p
    full = np.zeros((*factor.shape[:-2], layout.n, layout.n))
    full[..., kept, : len(kept)] = factor
    return np.where(pattern.given[..., None], 0.0, full)


def by_pattern(patterns: Sequence[int] | np.ndarray) -> list[np.ndarray]:
    """Places of the entries that have the same pattern."""
    found = np.asarray(patterns, dtype=np.intp)
    order = np.argsort(found, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(found[order])) + 1)


def stacked_fields(records: Sequence[Any], field: str) -> np.ndarray:
    """A field of records of one pattern, with the axes of plates where any has them."""
    arrays = [getattr(record, field) for record in records]
    if (
        field == "turn" and len({a.shape[-1] for a in arrays}) > 1
    ):  # what is certain makes them wider
        widest = max(a.shape[-1] for a in arrays)
        arrays = [
            np.concatenate([a, np.zeros((*a.shape[:-1], widest - a.shape[-1]))], axis=-1)
            for a in arrays
        ]
    if len({a.ndim for a in arrays}) > 1:
        lead = max((a.shape[:-2] for a in arrays), key=len)
        arrays = [np.broadcast_to(a, lead + a.shape[-2:]) for a in arrays]
    return np.stack(arrays)


def certain_of(records: Sequence[Conditioned]) -> np.ndarray | None:
    """Which observed numbers follow from others, by kind, shape (kinds, [*lead], p); None where none does."""
    if all(record.certain is None for record in records):
        return None
    arrays = [
        np.zeros(1, dtype=bool) if record.certain is None else record.certain for record in records
    ]
    return np.stack(np.broadcast_arrays(*arrays))


def at(array: np.ndarray, index: int) -> np.ndarray:
    """An entry along time, of arrays that have one for all."""
    return array[0] if len(array) == 1 else array[index]


# ---- private ------------------------------------------------------------------------------------


class _States:
    """Roots that the next slice starts from; one that differs from another by rounding alone is that one."""

    def __init__(self, start: np.ndarray) -> None:
        self._roots = [start]
        self._near: dict[str, int] = {}

    def root(self, state: int) -> np.ndarray:
        return self._roots[state]

    def add(self, root: np.ndarray) -> int:
        """The number of a root, a new one unless it is known."""
        near = root.item(-1).hex()[:_DIGITS] if root.size else ""
        known = self._near.get(near)
        if known is not None and _alike(self._roots[known], root):
            return known
        if len(self._near) >= _KEPT:
            self._near.clear()
        self._roots.append(root)
        self._near[near] = len(self._roots) - 1
        return len(self._roots) - 1


def _given_carried(pattern: Pattern, carried: int) -> np.ndarray | None:
    """Which of the numbers that the next slice reads are observed, if any is."""
    if pattern.given is None or not pattern.given[..., :carried].any():
        return None
    return pattern.given[..., :carried, None]


def _alike(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two roots differ by rounding alone: relative to each entry, or to its own row's diagonal."""
    if a.shape != b.shape:
        return False
    size = np.maximum(np.abs(b), np.abs(b.diagonal(0, -2, -1))[..., None])
    return bool((np.abs(a - b) <= 2 * _EPS * size).all())
