"""Errors of smoothed means: which trajectories share particles, and how alike they are.

A mean over trajectories is off because they are few, and because the particles of each slice are. Two
trajectories that pass through the same particle share what it is off by. With ``d`` what a trajectory's value
lies off the mean of R, pairs of such trajectories give for each slice s

    U_s = sum over particles i of s, over pairs r, r' through i, of d_r d_r' / R^2,

an estimate without bias of sum_i w_i^2 h_i^2 (w_i the smoothed weight of a particle, h_i what the smoothed
mean is off given that trajectories pass there): the variance that draws of that slice cause. The sum of all
U_s and of sum_r d_r^2 / R^2 is the variance of the mean, as for the genealogies of a filter.

A particle is not drawn independently of the one it comes from where resampling leaves that as many offspring
as its weight demands: what the deviations of a particle's parent say of its own (by least squares) has been
counted in the slice before, and counts there alone.

A slice where trajectories share three particles or fewer says nothing of how far off these are: the error is
infinite there, for slices nearby that hang on it, and within reach of three such slices in a row.

References
----------
Douc, Garivier, Moulines and Olsson (2011), Ann. Appl. Probab. 21, th. 8 (the variance of backward
simulation); Lee and Whiteley (2018), Variance estimation in the particle filter, Biometrika 105 (pairs).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bayesmc.engines.particles.errors import LAST, Variances
from bayesmc.engines.particles.smc import Particles

#: how far from a slice others are looked at, and for how many slices each of these stands
_OFFSETS = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 16, 20, 28, 36, 52, 68, 100, 132])
_STANDS = np.r_[1.0, np.diff(_OFFSETS[:-1]) / 2 + np.diff(_OFFSETS[1:]) / 2, 16.0]
#: slices in a row that say nothing, after which none within reach does
_RUN = 3
#: slices over which a part is averaged, to see whether those further off have one
_NEARBY = 21


class Sharing(Variances):
    """Who shares particles with whom; variances by that.

    Parameters
    ----------
    positions : sequence of ndarray of int
        For each slice, those of trajectories among the particles, shape ``(trajectories, *apart)``.
    filtered : sequence of Particles
        Those of the filter.
    steady : bool
        Whether resampling leaves particles the offspring that their weight demands, but for one.
    """

    def __init__(
        self, positions: Sequence[np.ndarray], filtered: Sequence[Particles], steady: bool
    ) -> None:
        self.count = positions[0].shape[0]
        rows = [index.reshape(self.count, -1).T for index in positions]  # elements first
        self._groups = [
            _grouped(own, len(c.weights)) for own, c in zip(rows, filtered, strict=True)
        ]
        #: particles that trajectories are worth in each slice, shape (time, elements)
        self.even = np.stack([g.even for g in self._groups])
        self._links: list[_Links | None] = [None]
        for k in range(1, len(filtered)):
            linked = not np.any(filtered[k].rejuvenated) and (
                steady or filtered[k].ancestors is None
            )
            pair = self._groups[k - 1], self._groups[k]
            self._links.append(_linked(*pair, filtered[k]) if linked else None)
        #: independent draws that a slice's trajectories are worth, at most
        self.worth = np.minimum(self.even, self.count)

    def variances(self, off: np.ndarray, weighted: np.ndarray | None = None) -> np.ndarray:
        steps, elements = self.even.shape
        squares = np.square(off, dtype=float).sum(axis=-1) / self.count**2
        columns = off.swapaxes(2, 3).reshape(steps, elements * self.count, -1).astype(float)
        # parts of slices before and after, by how far off they are
        parts = np.zeros((2, len(_OFFSETS), *squares.shape))
        signs = np.array([[-1], [1]])
        for s in range(steps):
            at = s - signs * _OFFSETS
            side, kind = np.nonzero((at >= 0) & (at < steps) & ((_OFFSETS > 0) | (signs < 0)))
            found = self._part(s, columns[at[side, kind]])
            parts[side, kind, at[side, kind]] = found / self.count**2
        return self._total(squares, parts)

    # ---- private -------------------------------------------------------------------------------

    def _part(self, s: int, off: np.ndarray) -> np.ndarray:
        """What draws of the s-th slice cause in some slices, whose values lie off by so much."""
        now, links = self._groups[s], self._links[s]
        squares = np.square(off)
        sums = now.summed(off)
        pairs = now.of_elements(np.square(sums) - now.summed(squares))
        if links is None:
            return pairs
        before, share = self._groups[s - 1], links.share[:, None]
        earlier = before.summed(off)
        level = before.of_elements((np.square(earlier) - before.summed(squares)) * share)
        own = np.where(links.same[:, None], squares, 0.0)  # no pair, but one trajectory with itself
        both = (sums * earlier[:, links.parents] - now.summed(own)) * share[links.parents]
        common = now.of_elements(np.where(links.known[:, None], both, 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.clip(np.where(level > 0, common / level, 0.0), 0.0, 1.0)
        return pairs - 2.0 * slope * common + slope**2 * level

    def _total(self, squares: np.ndarray, parts: np.ndarray) -> np.ndarray:
        """What trajectories and slices cause, from each slice outwards as far as anything is left of it."""
        from scipy.ndimage import uniform_filter1d  # slow to import

        steps, even = len(squares), self.even[..., None]
        free = np.maximum(even, LAST) - 1.0
        factor = np.where(np.isinf(even), 1.0, free / np.where(np.isinf(free), 1.0, free - 2.0))
        lost = np.broadcast_to(even < LAST, squares.shape)
        total, alone = squares.copy(), np.zeros(squares.shape, dtype=bool)
        for side, sign in enumerate((-1, 1)):
            going = np.ones(squares.shape, dtype=bool)
            for kind, offset in enumerate(_OFFSETS):
                if side and not offset:
                    continue
                at = np.arange(steps) + sign * offset
                there = ((at >= 0) & (at < steps)).reshape(-1, 1, 1)
                at = at.clip(0, steps - 1)
                part = np.where(there, parts[side, kind], 0.0)
                if offset:  # pairs agree by chance, too: neighbours say what is left of it
                    going &= there & (lost[at] | (uniform_filter1d(part, _NEARBY, axis=0) > 0))
                total += np.where(going, part * (_STANDS[kind] * factor[at]), 0.0)
                alone |= going & lost[at]
        alone |= _near_runs(lost)
        total = np.where(alone, np.inf, np.maximum(total, squares))
        return np.where(squares > 0, total, 0.0)


# ---- private ------------------------------------------------------------------------------------


class _Groups(NamedTuple):
    """Trajectories of a slice by the particles that they pass through, one element after the other."""

    #: rows (trajectories of elements) sorted by group, where groups start, and those of elements
    order: np.ndarray
    starts: np.ndarray
    firsts: np.ndarray
    #: for rows their group
    member: np.ndarray
    #: for groups their particle, counted through all elements
    keys: np.ndarray
    #: particles that trajectories are worth, by element
    even: np.ndarray

    def summed(self, values: np.ndarray) -> np.ndarray:
        """Sums over groups of ``(slices, rows, numbers)``."""
        return np.add.reduceat(values[:, self.order], self.starts, axis=1)

    def of_elements(self, values: np.ndarray) -> np.ndarray:
        """Sums over the groups of elements."""
        return np.add.reduceat(values, self.firsts, axis=1)


class _Links(NamedTuple):
    """Groups of a slice and their parents' in the slice before."""

    #: for groups that of the parent, if it is known: if a trajectory passes there
    parents: np.ndarray
    known: np.ndarray
    #: for rows whether they pass through the parent
    same: np.ndarray
    #: for groups of the slice before, one by the number of children, 0 where there are none
    share: np.ndarray


def _near_runs(lost: np.ndarray) -> np.ndarray:
    """Slices that a run of lost ones is near: what hangs on which cannot be seen through it."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d  # slow to import

    runs = minimum_filter1d(lost.astype(np.uint8), _RUN, axis=0, mode="constant")
    return np.asarray(
        maximum_filter1d(runs, 2 * int(_OFFSETS[-1]) + 1, axis=0, mode="constant") > 0
    )


def _grouped(own: np.ndarray, particles: int) -> _Groups:
    elements, count = own.shape
    each = (own + particles * np.arange(elements)[:, None]).reshape(-1)
    order = np.argsort(each, kind="stable")
    keys, starts, member, sizes = np.unique(each[order], True, True, True)
    group = np.empty_like(member)
    group[order] = member
    firsts = np.searchsorted(keys, particles * np.arange(elements))
    together = np.add.reduceat(sizes * (sizes - 1.0), firsts)
    with np.errstate(divide="ignore"):
        even = count * (count - 1.0) / together if count > 1 else np.zeros(elements)
    return _Groups(order, starts, firsts, group, keys, even)


def _linked(before: _Groups, now: _Groups, particles: Particles) -> _Links:
    n = len(particles.weights)
    element, particle = now.keys // n, now.keys % n
    if particles.ancestors is None:
        parents, children = now.keys, np.ones(len(before.keys))
    else:
        ancestors = particles.ancestors.reshape(n, -1).T  # sorted, elements first
        parents = ancestors[element, particle] + n * element
        flat = (ancestors + n * np.arange(len(ancestors))[:, None]).reshape(-1)
        ends = (np.searchsorted(flat, before.keys, side) for side in ("right", "left"))
        children = np.subtract(*ends).astype(float)
    at = np.searchsorted(before.keys, parents).clip(max=len(before.keys) - 1)
    known = before.keys[at] == parents
    same = known[now.member] & (at[now.member] == before.member)
    share = np.where(children > 0, 1.0 / np.maximum(children, 1.0), 0.0)
    return _Links(at, known, same, share)
