"""Do the rows of a series look like rows that the filter expected? Ranks, and the one warning.

A filter says before each row what rows it expects. Of its figures, all uniform or near 0 where the model is
right, this room keeps those that mean the same whatever the filter: where each value lies among what was
expected of it, and how likely each row is beside rows that the model draws. How they come about
is each filter's affair (Gaussian innovations, rows drawn from particles).
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy import special

from bayesmc.errors import EngineWarning, ModelMisfitWarning

#: rows are unlikely where so small a share of the rows that were expected is less likely
UNLIKELY = 0.05
#: chance at which a model that is right has as many unlikely rows
_ALPHA = 1e-6
#: nats per number that must be missing, too, so that a model that is a little off does not alarm: of a
#: Gaussian that is where squares are three times what they should be
_NATS = 1.0
#: what one row counts for at most: an outlier now and then is none of the model's
_CAP = 20.0
#: rows of a stretch that is judged by itself, too, and share of it that must be unlikely: a filter may be
#: lost for a while
_STRETCH, _SHARE = 30, 0.5


class Misfit(NamedTuple):
    """Rows that the model does not explain.

    Attributes
    ----------
    few, many : int
        Unlikely rows, of how many.
    first, last : int
        Between these rows.
    nats : float
        Their typical deficit: the mean of all, with at most 20 from each; in a stretch the median.
    """

    few: int
    many: int
    first: int
    last: int
    nats: float


@dataclass(frozen=True, eq=False)
class Predictive:
    """How rows compare with what was expected of them.

    Attributes
    ----------
    row_ranks : ndarray, shape (time, *plates)
        Share of the rows that were expected that are less likely than the one that came; uniform where the
        model is right. NaN where nothing was seen or compared. Plates are those filtered separately.
    row_deficits : ndarray, shape (time, *plates)
        By how many nats per observed number the row is less likely than expected; 0 on average.
    ranks : dict
        Observed node -> share of what was expected of each number that is smaller, shape ``(time, *plates,
        *event)``.
    broken : str
        Why no more rows were compared from some slice on; empty where nothing was in the way.
    """

    row_ranks: np.ndarray
    row_deficits: np.ndarray
    ranks: Mapping[str, np.ndarray] = field(default_factory=dict)
    broken: str = ""

    def first(self, steps: int) -> Predictive:
        """Of the first so many slices."""
        ranks = {n: r[:steps] for n, r in self.ranks.items()}
        return Predictive(self.row_ranks[:steps], self.row_deficits[:steps], ranks, self.broken)

    def misfit(self) -> Misfit | None:
        """Where a warning is due, the rows that are to blame.

        All rows are judged together, those of each element of the plates by themselves, and stretches of 30
        rows. Too many must be unlikely for chance, and by a margin. The chance of a warning where the
        model is right is 1e-6 at most, since rows are unlikely with probability 0.05 each, independently of
        those before.
        """
        steps = len(self.row_ranks)
        ranks = self.row_ranks.reshape(steps, -1)
        deficits = self.row_deficits.reshape(ranks.shape)
        known = np.isfinite(ranks) & ~np.isnan(deficits)
        low = known & (ranks < UNLIKELY)
        seen = np.flatnonzero(known.any(axis=1))
        if not low.any():
            return None
        # groups of rows as (first, last, element): among slices where something was compared
        ends: list[tuple[int, int, int | None]] = [(0, len(seen), None)]
        if ranks.shape[1] > 1:
            ends += [(0, len(seen), k) for k in range(ranks.shape[1])]
        starts = range(0, len(seen) - _STRETCH + 1, _STRETCH // 2) if len(seen) > _STRETCH else ()
        ends += [(k, k + _STRETCH, None) for k in starts]
        # elements of one slice may share what they do not explain: together they count as one row
        ones = np.vstack([low[seen].sum(axis=1) / known[seen].sum(axis=1), np.ones(len(seen))])
        pooled, each = _running(ones.T), _running(np.stack([low, known], axis=-1)[seen])
        counts = [_between(pooled if e is None else each[:, e], a, b) for a, b, e in ends]
        few, many = np.floor(np.array(counts) + 1e-9).T
        # of so many binomial ones or more
        chance = special.betainc(np.maximum(few, 1), np.maximum(many - few, 0) + 1, UNLIKELY)
        blamed = (few > 0) & (chance * len(ends) < _ALPHA)
        for k in np.flatnonzero(blamed):
            first, last, element = ends[k]
            rows, wide = seen[first:last], slice(None) if element is None else element
            part = deficits[rows, wide][known[rows, wide]]
            is_stretch = last - first < len(seen)
            nats = np.median(part) if is_stretch else np.minimum(part, _CAP).mean()
            if nats > _NATS and (not is_stretch or few[k] >= _SHARE * many[k]):
                unlikely = int(low[rows, wide].sum())
                return Misfit(unlikely, len(part), int(rows[0]), int(rows[-1]), float(nats))
        return None


def warn_of_misfit(found: Predictive | None, who: str, start: int, stacklevel: int) -> None:
    """The warning where rows are, as a whole or in a stretch, far less likely than was expected.

    ``start`` is the slice that the first row belongs to.

    Warns
    -----
    ModelMisfitWarning
    EngineWarning
        Rows were no longer compared, since a function broke on one that was drawn.
    """
    if found is not None and found.broken:
        warnings.warn(
            f"{who}: rows are held against others that the model draws (row_ranks), and one of these broke "
            f"the comparison in {found.broken}; from there on none is compared, all other answers are as "
            "they would be. Functions should take whatever values the model can draw",
            EngineWarning,
            stacklevel=stacklevel + 1,
        )
    misfit = None if found is None else found.misfit()
    if misfit is None:
        return
    few, many, first, last, nats = misfit
    warnings.warn(
        f"{who}: {few} of {many} rows compared in slices {start + first} to {start + last} are less likely "
        "than 95 % of the rows that the filter expected (row_ranks), typically by "
        f"{nats:.3g} nats per number more than they should (row_deficits): the model does not fit there, or "
        "the filter is sure of what is wrong, and its spreads do not say so; look at the start, at units "
        "and signs of what goes in (predictive_ranks say which node is off), or at noise that is too narrow",
        ModelMisfitWarning,
        stacklevel=stacklevel + 1,
    )


# ---- private ------------------------------------------------------------------------------------


def _running(counts: np.ndarray) -> np.ndarray:
    """Sums over slices, time first, of none, one, two, ... of them."""
    return np.concatenate([np.zeros((1, *counts.shape[1:])), np.cumsum(counts, axis=0)])


def _between(sums: np.ndarray, first: int, last: int) -> np.ndarray:
    """The sum over some slices from running sums."""
    return sums[last] - sums[first]
