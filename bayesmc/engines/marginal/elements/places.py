"""Readings that are not linear over what they leave of a belief: its moments by importance sampling.

A bearing alone leaves a wedge of a vague belief, a range alone a ring: no tangent holds over these, wherever
it is taken. There points that lie evenly in the belief are moved to where readings fit, each becomes a
Gaussian as wide as a tangent holds there, and the mixture of these is the proposal for the mean, the
covariance and the evidence of the posterior. So a Gaussian is kept that has its moments, but not its shape.
Points are the same for all particles and runs: answers about elements do not depend on chance.

References
----------
Owen and Zhou (2000), Safe and effective importance sampling, JASA 95 (mixtures as proposals, weighed as a
whole); Jazwinski (1970), Stochastic Processes and Filtering Theory, sec. 9.3 (densities by their moments).
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from bayesmc.distributions.circular import wrap_angle
from bayesmc.engines.marginal.elements import updates
from bayesmc.engines.marginal.elements.updates import (
    At,
    Belief,
    Row,
    Tangent,
    conditioned,
    is_smooth,
    mode,
    placed,
    plain,
    whitened,
)

#: points that are moved (of one number), how far out they lie, and pairs of draws from Gaussians
_POINTS, _OUT, _PAIRS = 32, 1.2, 2
#: spread of these Gaussians beside the belief, how often it is halved, and how much wider they are at last
_WIDE, _HALVINGS, _WIDER = 0.5, 5, 1.2
#: standard deviations of the noise by which a tangent may be off in them, and a reading at a point that fits
_HELD, _FITS = 0.7, 4.0
#: batches are worked through in parts of so many densities
_BLOCK = 2_000_000


class Linear(NamedTuple):
    """Rows made linear, and beliefs given those of which no tangent holds.

    Attributes
    ----------
    tangent : Tangent
        With what it expects at the beliefs' means.
    row : Row
    wild : ndarray of bool, shape (batch,), or None
        For which ``after`` and ``log`` stand instead.
    after : Belief, or None
    log : ndarray, shape (batch,), or None
    """

    tangent: Tangent
    row: Row
    wild: np.ndarray | None = None
    after: Belief | None = None
    log: np.ndarray | None = None

    def of(self, some: np.ndarray) -> Linear:
        """Of some of the batch."""
        found = Linear(Tangent(*(part[some] for part in self.tangent)), self.row.of(some))
        if self.wild is None or self.after is None or self.log is None:
            return found
        after = Belief(self.after.mean[some], self.after.root[some])
        return found._replace(wild=self.wild[some], after=after, log=self.log[some])

    def conditioned(self, prior: Belief) -> tuple[Belief, np.ndarray]:
        """Beliefs given the rows, and log densities of these."""
        after, log = conditioned(prior, self.row, self.tangent)
        if self.wild is None or self.after is None or self.log is None:
            return after, log
        mean = np.where(self.wild[:, None], self.after.mean, after.mean)
        root = np.where(self.wild[:, None, None], self.after.root, after.root)
        return Belief(mean, root), np.where(self.wild, self.log, log)

    def log_predictive(self, prior: Belief) -> np.ndarray:
        """Log densities of the rows alone."""
        log = updates.log_predictive(prior, self.row, self.tangent)
        return log if self.wild is None or self.log is None else np.where(self.wild, self.log, log)


def linearised(prior: Belief, row: Row, at: At, bent: bool) -> Linear:
    """Rows made linear for beliefs; where no tangent holds, beliefs given them by their moments."""
    if not bent:
        return Linear(*plain(prior, row, at))
    found, turned, holds = placed(prior, row, at)
    wild = np.flatnonzero(~holds)
    if not len(wild) or not np.diagonal(found.noise, 0, -2, -1).all():
        return Linear(found, turned)
    mean, root = np.array(prior.mean), np.array(prior.root)
    log, is_wild = np.zeros(len(mean)), ~holds
    n = mean.shape[-1]
    part = max(1, _BLOCK // (2 * _PAIRS * _count(n) ** 2 * n))
    for low in range(0, len(wild), part):
        own = wild[low : low + part]
        some = Belief(prior.mean[own], prior.root[own])

        def at_own(x: np.ndarray, which: np.ndarray, own: np.ndarray = own) -> Tangent:
            return at(x, own[which])

        after, log[own], lost = moments(some, row.of(own), at_own)
        mean[own], root[own] = after.mean, after.root
        is_wild[own[lost]] = False
    return Linear(found, turned, is_wild, Belief(mean, root), log)


def moments(prior: Belief, row: Row, at: At) -> tuple[Belief, np.ndarray, np.ndarray]:
    """Gaussians with the moments of beliefs given rows, log densities of rows, and which have none.

    Parameters
    ----------
    prior : Belief
        Of a batch.
    row : Row
    at : callable
        Tangents at points, shape (some, n), of some of the batch.
    """
    count, n = prior.mean.shape
    starts, own = _even(n)
    k, d = own.shape[:2]
    owner = np.repeat(np.arange(count), k)
    every, rows = Belief(prior.mean[owner], prior.root[owner]), row.of(owner)
    flat = np.tile(starts, (count, 1))

    def at_own(x: np.ndarray, which: np.ndarray) -> Tangent:
        return at(x, owner[which])

    near = Belief(every.mean + np.matvec(every.root, flat), _WIDE * every.root)
    z = flat + _WIDE * mode(near, rows, at_own)
    root, fits = _kernels(every, rows, z, at_own)
    root, fits = _WIDER * root.reshape(count, k, n, n), fits.reshape(count, k)
    centre = z.reshape(count, k, n)
    draws = centre[:, :, None] + np.matvec(root[:, :, None], own)
    log_q = _mixture(draws.reshape(count, -1, n), centre, root, fits)
    owner = np.repeat(np.arange(count), k * d)
    points = prior.mean[owner] + np.matvec(prior.root[owner], draws.reshape(-1, n))
    log_p = _log_density(at(points, owner), row.of(owner)).reshape(count, -1)
    log_p = (
        log_p - 0.5 * np.square(draws).sum(axis=-1).reshape(count, -1) - 0.5 * n * np.log(2 * np.pi)
    )
    log = np.where(fits.repeat(d, axis=1) & np.isfinite(log_p), log_p - log_q, -np.inf)
    top = log.max(axis=1, keepdims=True)
    lost = ~np.isfinite(top[:, 0])
    share = np.exp(log - np.where(lost[:, None], 0.0, top))
    total = np.where(lost, 1.0, share.sum(axis=1))
    found = np.log(total) + top[:, 0] - np.log(np.maximum(fits.sum(axis=1), 1) * d)
    share = share / total[:, None]
    draws = draws.reshape(count, -1, n)
    middle = np.vecmat(share, draws)
    wide = np.sqrt(share)[..., None] * (draws - middle[:, None])
    root = np.matrix_transpose(np.linalg.qr(wide, mode="r"))
    return Belief(prior.mean + np.matvec(prior.root, middle), prior.root @ root), found, lost


# ---- private ------------------------------------------------------------------------------------


def _count(n: int) -> int:
    """Points for an element of so many numbers: what readings leave of it may be a surface of one less."""
    return _POINTS * 2 ** min(n * (n - 1) // 2, 4)


@cache
def _even(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Points, always the same: where to begin, ``(k, n)``, and what is drawn at each, ``(k, d, n)``."""
    count = _count(n)
    root = np.max(np.roots([1.0, *([0.0] * (n - 1)), -1.0, -1.0]).real)  # Roberts' sequence
    steps = root ** -np.arange(1.0, n + 1)
    every = np.arange(1, count * _PAIRS + 1)[:, None]
    starts, draws = (ndtri((shift + every * steps) % 1.0) for shift in (0.5, 0.37))
    starts = np.concatenate([starts[: count // 2], -starts[: count // 2]])
    starts *= _OUT / np.sqrt(np.square(starts).mean(axis=0))
    draws = draws.reshape(_PAIRS, count, n).swapaxes(0, 1)
    draws = np.concatenate([draws, -draws], axis=1)
    draws /= np.sqrt(np.square(draws).mean(axis=(0, 1)))
    for array in (starts, draws):
        array.flags.writeable = False
    return starts, draws


def _kernels(prior: Belief, row: Row, z: np.ndarray, at: At) -> tuple[np.ndarray, np.ndarray]:
    """Roots of covariances at points (batch, n), as wide as tangents hold; and which points fit rows."""
    count, n = z.shape
    move = np.matvec(prior.root, z)
    found = at(prior.mean + move, np.arange(count))
    off = whitened(found.noise, row.off(found.mean), row.present)
    fits = is_smooth(found, prior.root) & (np.linalg.norm(off, axis=-1) <= _FITS)
    slopes = np.where(fits[:, None, None], found.slopes, 0.0)
    scaled = whitened(found.noise, slopes @ prior.root, row.present)
    power = np.matrix_transpose(scaled) @ scaled
    root, width = np.zeros((count, n, n)), _WIDE
    left = np.flatnonzero(fits)
    for k in range(_HALVINGS):
        lower = np.linalg.cholesky(power[left] + np.eye(n) / width**2)
        root[left] = np.matrix_transpose(np.linalg.inv(lower))
        if k == _HALVINGS - 1 or not len(left):
            break
        some, holds = row.of(left), np.ones(len(left), bool)
        wide = prior.root[left] @ root[left]
        for side in (1.5, -1.5):
            step = side * wide.sum(axis=-1)
            made = at(prior.mean[left] + move[left] + step, left)
            missed = made.mean - found.mean[left] - np.matvec(slopes[left], step)
            missed = np.where(row.angles, wrap_angle(missed), missed)
            missed = whitened(found.noise[left], missed, some.present)
            holds &= np.linalg.norm(missed, axis=-1) <= _HELD
        left, width = left[~holds], 0.5 * width
    return root, fits


def _mixture(
    draws: np.ndarray, centre: np.ndarray, root: np.ndarray, fits: np.ndarray
) -> np.ndarray:
    """Log densities of the mean of some of the Gaussians of each of a batch, shape (batch, draws)."""
    count, k, n = centre.shape
    safe = np.where(fits[..., None, None], root, np.eye(n))
    inverse = np.linalg.inv(safe)
    at_centre = np.matvec(inverse, centre)
    turned = np.matrix_transpose(inverse.reshape(count, k * n, n))
    eta = (draws @ turned).reshape(*draws.shape[:2], k, n) - at_centre[:, None]
    log = -0.5 * np.square(eta).sum(axis=-1)
    log += np.where(fits, np.linalg.slogdet(inverse)[1], -np.inf)[:, None]
    top = log.max(axis=-1, keepdims=True)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        total = np.log(np.exp(log - top).sum(axis=-1)) + top[..., 0]
    return total - np.log(np.maximum(fits.sum(axis=-1), 1))[:, None] - 0.5 * n * np.log(2 * np.pi)


def _log_density(found: Tangent, row: Row) -> np.ndarray:
    """Log densities of rows, shape (batch,)."""
    off = whitened(found.noise, row.off(found.mean), row.present)
    log_det = np.log(
        np.abs(np.diagonal(updates.seen_root(found.noise, row.present), 0, -2, -1))
    ).sum(-1)
    return -0.5 * np.square(off).sum(-1) - log_det - 0.5 * row.present.sum(-1) * np.log(2 * np.pi)
