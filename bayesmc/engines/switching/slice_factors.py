"""Slices of a switching system as factors for expectation propagation: what couples two neighbours.

The factor of a slice is what the forward pass makes of it: for every pair of modes a Gaussian of the numbers
carried into the slice and of those carried on, given its row and those before. That is the factor proper
times the forward pass's belief about the slice before, which is divided out once, as a prior of that slice's.
So cavities only tilt Gaussians that are there already, as roots: what is known without noise on the way
forward, and starts that are vague, need no precisions.

Numbers are noise: the forward pass's, centred and scaled for each mode as Kim's smoother has them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bayesmc.engines.switching.merging import Mixture, merged
from bayesmc.engines.switching.pairs import Groups, Pairs
from bayesmc.engines.switching.passes import Back, Smoothed, noise_of
from bayesmc.factors.expectation_propagation import Tilted
from bayesmc.factors.messages import ConditionalGaussian, inverse, log_sum
from bayesmc.gaussian import try_cholesky
from bayesmc.linalg.square_root import condition_many

#: a root that is shorter than this share of a row leaves nothing of it
_NOTHING = 1e-12


class Scale(NamedTuple):
    """Noise of the forward pass as ``mean + root @ number``, for every mode.

    Attributes
    ----------
    mean : ndarray, shape (modes, *lead, c)
    root : ndarray, shape (modes, *lead, c, c)
        Lower triangles.
    is_singular : bool
        Whether later rows tell some number without noise; then it is no scale.
    """

    mean: np.ndarray
    root: np.ndarray
    is_singular: bool

    @classmethod
    def of(cls, found: Smoothed) -> Scale:
        root = condition_many(found.spread, 0).factor
        size = np.sqrt(np.vecdot(root, root))
        pivots = root.diagonal(0, -2, -1)
        none = ~(found.log > -np.inf)[..., None]
        short = (pivots <= _NOTHING * size) & ~none
        root = np.where(none[..., None], np.eye(root.shape[-1]), root)
        return cls(np.where(none, 0.0, found.noise), root, bool(short.any()))

    def numbers(self, noise: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Columns of noise, shape (pairs, *lead, c, k), of which the first is of means."""
        noise = noise.copy()
        noise[..., 0] -= self.mean[at]
        return np.linalg.solve(self.root[at], noise)

    def forward(self, log: np.ndarray, with_zeros: bool = False) -> ConditionalGaussian:
        """The forward pass's belief; without zeros, anything of modes that it rules out."""
        precision = np.matrix_transpose(self.root) @ self.root
        precision = 0.5 * (precision + np.matrix_transpose(precision))
        linear = -np.matvec(np.matrix_transpose(self.root), self.mean)
        size = np.log(self.root.diagonal(0, -2, -1)).sum(axis=-1)
        found = np.where(log > -np.inf, log, 0.0) + size - 0.5 * np.vecdot(self.mean, self.mean)
        if with_zeros:
            found = np.where(log > -np.inf, found, -np.inf)
        return ConditionalGaussian(found, linear, precision)

    def smoothed(self, belief: ConditionalGaussian) -> Smoothed:
        """Moments of the noise under a belief that is normalised."""
        log, mean, factor = belief.moments
        return Smoothed(log, self.mean + np.matvec(self.root, mean), self.root @ factor)


class SliceFactor:
    """Two neighbouring slices, ``back`` as the smoother goes back through the later one.

    Attributes
    ----------
    scope : tuple of int
        The slice before and this one.
    log : ndarray, shape (pairs, *lead)
    centre : ndarray, shape (pairs, *lead, 2 c)
        Numbers carried into the slice, and those carried on.
    root : ndarray, shape (pairs, *lead, 2 c, 2 c)
        Of their covariance.
    """

    def __init__(
        self, k: int, pairs: Pairs, back: Back, filtered: Mixture, scales: Sequence[Scale]
    ):
        self.scope = (k - 1, k)
        self.pairs, self.log, self.after = pairs, back.joint, back.after
        assert pairs.by_src is not None
        self.groups: tuple[Groups, Groups] = (pairs.by_src, pairs.by_dst)
        c = back.shift.shape[-1]
        after = back.after.first(c)
        mean, left = filtered.mean[..., :c][pairs.dst], filtered.factor[..., :c, :c][pairs.dst]
        turned = np.concatenate([(after.mean - mean)[..., None], after.factor], axis=-1)
        ahead, free = noise_of(left, turned)
        before = np.concatenate([back.shift[..., None], back.link, back.rest], axis=-1)
        before = scales[k - 1].numbers(before, pairs.src)
        if free is not None:
            ahead = np.concatenate([_wide(ahead, before.shape[-1]), free], axis=-1)
        ahead = scales[k].numbers(ahead, pairs.dst)
        self.centre = np.concatenate([before[..., 0], ahead[..., 0]], axis=-1)
        whole = back.after.factor
        most = max(before.shape[-1] - 1, ahead.shape[-1] - 1, whole.shape[-1])
        parts = [_wide(a, most) for a in (before[..., 1:], ahead[..., 1:], whole)]
        made = condition_many(np.concatenate(parts, axis=-2), 0).factor
        self.root = made[..., : 2 * c, : 2 * c]
        #: all numbers of this slice, by the noise that ``root`` multiplies and by other noise
        self.along, self.beside = made[..., 2 * c :, : 2 * c], made[..., 2 * c :, 2 * c :]

    def tilted(self, cavities: Sequence[ConditionalGaussian], ends: Sequence[int]) -> Tilted:
        log, mean, right = self._noise(cavities)
        total = log_sum(log)
        fine = np.isfinite(total)
        if not fine.any():
            return Tilted(total, [cavities[e] for e in ends])
        if not fine.all():
            log = np.where(fine, log, 0.0)
        c = self.centre.shape[-1] // 2
        beliefs = []
        for end in ends:
            part = slice(end * c, (end + 1) * c)
            numbers = self.centre[..., part] + np.matvec(self.root[..., part, :], mean)
            factor = self.root[..., part, :] @ right
            groups = self.groups[end]
            found = merged(groups.logs(log), groups.of(numbers), groups.of(factor))
            beliefs.append(ConditionalGaussian.of(*found))
        return Tilted(total, beliefs)

    def answer(self, cavities: Sequence[ConditionalGaussian]) -> Mixture | None:
        """All numbers of this slice, of every mode; None where they have no moments."""
        log, mean, right = self._noise(cavities)
        if np.isnan(log).any():
            return None
        numbers = self.after.mean + np.matvec(self.along, mean)
        factor = np.concatenate([self.along @ right, self.beside], axis=-1)
        groups = self.groups[1]
        found = merged(groups.logs(log), groups.of(numbers), groups.of(factor))
        return found._replace(log=found.log - log_sum(found.log))

    def _noise(
        self, cavities: Sequence[ConditionalGaussian]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of every pair tilted: its log mass, and the mean and a root of the covariance of its noise."""
        places, c = (self.pairs.src, self.pairs.dst), self.centre.shape[-1] // 2
        log, linear = self.log, 0.0
        precision: np.ndarray = np.eye(2 * c)
        for end, (cavity, at) in enumerate(zip(cavities, places, strict=True)):
            part = slice(end * c, (end + 1) * c)
            root, centre = self.root[..., part, :], self.centre[..., part]
            turned = root.swapaxes(-1, -2)
            own = cavity.precision[at]
            rest = cavity.linear[at] - np.matvec(own, centre)
            log = log + cavity.log[at] + 0.5 * np.vecdot(centre, cavity.linear[at] + rest)
            linear = linear + np.matvec(turned, rest)
            precision = precision + turned @ own @ root
        none = log == -np.inf
        if none.any():
            precision = np.where(none[..., None, None], np.eye(2 * c), precision)
        precision = 0.5 * (precision + precision.swapaxes(-1, -2))
        lower, bad = try_cholesky(precision)
        left = inverse(lower)
        scaled, right = np.matvec(left, linear), left.swapaxes(-1, -2)
        log = log + 0.5 * np.vecdot(scaled, scaled)
        log = log - np.log(lower.diagonal(0, -2, -1)).sum(axis=-1)
        if bad is not None:
            log = np.where(bad, np.nan, log)
        return log, np.matvec(right, scaled), right


# ---- private ------------------------------------------------------------------------------------


def _wide(rows: np.ndarray, columns: int) -> np.ndarray:
    """With columns of zeros behind them."""
    missing = columns - rows.shape[-1]
    if not missing:
        return rows
    return np.concatenate([rows, np.zeros((*rows.shape[:-1], missing))], axis=-1)
