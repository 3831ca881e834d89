"""Gaussian beliefs about single elements conditioned on what picks them, many at a time.

Means of readings are made linear at the mean of the belief, as the extended Kalman filter does. Where the
belief is so vague that such a tangent does not hold over what it leaves of the belief (a landmark met for the
first time), it is taken at the mode instead, found by Gauss and Newton: the iterated extended Kalman filter,
which is Laplace's method. So a first sight is placed by what is read, whatever the prior mean is. Where the
tangent at the mode does not hold, either, ``places`` goes on.

References
----------
Bell and Cathey (1993), The iterated Kalman filter update as a Gauss-Newton method, IEEE TAC 38; Särkkä and
Svensson (2023), Bayesian Filtering and Smoothing, 2nd ed., sec. 7.4; Thrun, Burgard and Fox (2005),
Probabilistic Robotics, sec. 13.3.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bayesmc.distributions.circular import wrap_angle
from bayesmc.engines.kalman.covariances import without_absent
from bayesmc.engines.kalman.data import Pattern
from bayesmc.engines.kalman.means import absorbed
from bayesmc.linalg.square_root import condition_many

#: standard deviations of the noise that a tangent may be off by, and those of what it leaves of a belief
#: at which it is tried
HELD, _ENDS = 0.5, 1.5
#: standard deviations of the noise that a tangent may change by along one of the belief
_STEEP = 1e6
#: how nearly readings without noise are met
_EXACT = 1e-6
#: steps of Gauss and Newton, halvings of each, and the length, in standard deviations, of a step that is none
_STEPS, _HALVINGS, _SETTLED = 60, 10, 1e-3
#: share of what a reading is off that a tangent may miss along a step
_BENT = 0.3


class Tangent(NamedTuple):
    """Readings made linear at a point: shapes (batch, p), (batch, p, n), (batch, p, p)."""

    mean: np.ndarray
    slopes: np.ndarray
    noise: np.ndarray


#: readings' tangents at points (batch, n), of some of the batch
At = Callable[[np.ndarray, np.ndarray], Tangent]


class Belief(NamedTuple):
    """Gaussians: means (batch, n) and roots of covariances (batch, n, n)."""

    mean: np.ndarray
    root: np.ndarray


class Row(NamedTuple):
    """What was read: values (batch, p), which are there (batch, p), which are angles (p,)."""

    value: np.ndarray
    present: np.ndarray
    angles: np.ndarray

    def off(self, expected: np.ndarray) -> np.ndarray:
        """What values are off; nothing for those that are not there."""
        off = self.value - expected
        if self.angles.any():
            off = np.where(self.angles, wrap_angle(off), off)
        return np.where(self.present, off, 0.0)

    def turned(self, expected: np.ndarray) -> Row:
        """With angles near to what is expected, as numbers like others."""
        value = np.where(self.angles, expected + self.off(expected), self.value)
        return Row(value, self.present, np.zeros_like(self.angles))

    def of(self, some: np.ndarray) -> Row:
        return Row(self.value[some], self.present[some], self.angles)


def expected_at(prior: Belief, point: np.ndarray, found: Tangent) -> Tangent:
    """What a tangent at a point expects at the mean of the belief."""
    moved = np.matvec(found.slopes, prior.mean - point)
    return found._replace(mean=found.mean + moved)


def plain(prior: Belief, row: Row, at: At) -> tuple[Tangent, Row]:
    """Tangents at means of beliefs; angles of the row are turned so that they are off the short way round."""
    found = at(prior.mean, np.arange(len(prior.mean)))
    return found, row.turned(found.mean)


def placed(prior: Belief, row: Row, at: At) -> tuple[Tangent, Row, np.ndarray]:
    """Tangents at means of beliefs, or at modes where those do not hold; the row; whether tangents hold.

    What tangents expect is at the means of the beliefs.
    """
    found, turned = plain(prior, row, at)
    holds = _holds(prior, row, turned, found, at)
    again = np.flatnonzero(~holds)
    if not len(again):
        return found, turned, holds
    some, own = Belief(prior.mean[again], prior.root[again]), row.of(again)

    def at_some(x: np.ndarray, which: np.ndarray) -> Tangent:
        return at(x, again[which])

    point = some.mean + np.matvec(some.root, mode(some, own, at_some))
    there = at_some(point, np.arange(len(again)))
    smooth = is_smooth(there, some.root)
    tangent = _masked(there, smooth)
    turned_there = own.turned(tangent.mean)
    tangent = expected_at(some, point, tangent)
    holds[again] = smooth & _holds(some, own, turned_there, tangent, at_some)
    value = np.array(turned.value)
    value[again] = turned_there.value
    parts = [np.array(a) for a in found]
    for whole, part in zip(parts, tangent, strict=True):
        whole[again] = part
    return Tangent(*parts), turned._replace(value=value), holds


def conditioned(prior: Belief, row: Row, found: Tangent) -> tuple[Belief, np.ndarray]:
    """The belief given the row, and the log density of the row."""
    p, n = row.value.shape[-1], prior.mean.shape[-1]
    shape = (len(prior.mean), p + n, n + p)
    rows = np.zeros(shape)
    rows[:, :p, :n], rows[:, :p, n:] = found.slopes @ prior.root, found.noise
    rows[:, p:, :n] = prior.root
    absent = None if row.present.all() else ~row.present
    if absent is not None:
        rows = without_absent(rows, absent)
    made = condition_many(rows, p)
    mean = np.concatenate([found.mean, prior.mean], axis=-1)
    pattern = Pattern(np.arange(p), p + np.arange(n), None, absent)
    value = np.where(row.present, row.value, np.nan)
    layout = None
    after, _, log = absorbed(
        layout, pattern, made, mean, value, None, row.angles if row.angles.any() else None  # type: ignore[arg-type]
    )  # fmt: skip
    return Belief(after, made.factor), log


def log_predictive(prior: Belief, row: Row, found: Tangent) -> np.ndarray:
    """The log density of the row alone."""
    left = found.slopes @ prior.root
    covariance = left @ np.matrix_transpose(left) + found.noise @ np.matrix_transpose(found.noise)
    both = row.present[..., :, None] & row.present[..., None, :]
    covariance = np.where(both, covariance, np.eye(row.value.shape[-1]))
    off = row.off(found.mean)
    root = np.linalg.cholesky(covariance)
    eta = np.linalg.solve(root, off[..., None])[..., 0]
    count = row.present.sum(axis=-1)
    log_det = np.log(np.diagonal(root, 0, -2, -1)).sum(axis=-1)
    return -0.5 * (np.vecdot(eta, eta) + count * np.log(2 * np.pi)) - log_det


# ---- private ------------------------------------------------------------------------------------


def seen_root(noise: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Roots of covariances of what is there, with 1 for what is not."""
    if present.all():
        return noise
    both = present[..., :, None] & present[..., None, :]
    covariance = noise @ np.matrix_transpose(noise)
    return np.linalg.cholesky(np.where(both, covariance, np.eye(present.shape[-1])))


def whitened(noise: np.ndarray, off: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Numbers (batch, p) or slopes (batch, p, k) in units of the noise; 0 for what is not there."""
    is_flat = off.ndim == 2
    wide = np.where(present[..., None], off[..., None] if is_flat else off, 0.0)
    found = np.linalg.solve(seen_root(noise, present), wide)
    return found[..., 0] if is_flat else found


def is_smooth(found: Tangent, root: np.ndarray) -> np.ndarray:
    """Where there is a tangent: none is where a reading turns within nothing, as a bearing at no range."""
    steep = np.abs(found.slopes @ root).max(axis=(-2, -1), initial=0.0)
    finite = np.isfinite(found.mean).all(axis=-1) & np.isfinite(steep)
    sizes = np.abs(np.diagonal(found.noise, 0, -2, -1)).min(axis=-1)
    return finite & (np.where(finite, steep, 0.0) <= _STEEP * np.where(sizes > 0, sizes, np.inf))


def _holds(prior: Belief, row: Row, turned: Row, found: Tangent, at: At) -> np.ndarray:
    """Whether tangents hold over what they leave of beliefs: at both ends of it, for readings and slopes."""
    every = np.arange(len(prior.mean))
    holds = is_smooth(found, prior.root) | ~row.present.any(axis=-1)
    if not np.diagonal(found.noise, 0, -2, -1).all():
        return _meets(prior, row, turned, found, at)
    tame = _masked(found, holds)
    scaled = whitened(tame.noise, tame.slopes @ prior.root, row.present)
    off = whitened(tame.noise, turned.off(tame.mean), row.present)
    across = np.matrix_transpose(scaled)
    lower = np.linalg.cholesky(across @ scaled + np.eye(scaled.shape[-1]))
    own = np.matrix_transpose(np.linalg.inv(lower))
    new = np.matvec(own @ np.matrix_transpose(own), np.matvec(across, off))
    root = prior.root @ own
    for side in (_ENDS, -_ENDS):
        move = np.matvec(prior.root, new) + side * root.sum(axis=-1)
        made = at(prior.mean + move, every)
        missed = made.mean - tame.mean - np.matvec(tame.slopes, move)
        missed = np.where(row.angles, wrap_angle(missed), missed)
        missed = whitened(tame.noise, missed, row.present)
        bent = whitened(tame.noise, (made.slopes - tame.slopes) @ root, row.present)
        holds &= (np.abs(missed) <= HELD).all(axis=-1)
        holds &= np.square(bent).sum(axis=(-2, -1)) <= HELD**2
    return holds | ~row.present.any(axis=-1)


def _meets(prior: Belief, row: Row, turned: Row, found: Tangent, at: At) -> np.ndarray:
    """The same where a reading has no noise: whether it is met."""
    smooth = np.isfinite(found.mean).all(axis=-1) & np.isfinite(found.slopes).all(axis=(-2, -1))
    new = conditioned(prior, turned, _masked(found, smooth))[0].mean
    off = row.off(at(new, np.arange(len(new))).mean)
    return smooth & (np.abs(off) <= _EXACT * (1 + np.abs(row.value))).all(axis=-1)


def _floored(found: Tangent, root: np.ndarray) -> Tangent:
    """With a little noise where there is none, to be near to what is read."""
    sizes = np.diagonal(found.noise, 0, -2, -1)
    if sizes.all():
        return found
    steep = np.nan_to_num(np.abs(found.slopes @ root).max(axis=-1))
    more = np.where(sizes == 0, _EXACT * steep + 1e-300, 0.0)
    return found._replace(noise=found.noise + more[..., None] * np.eye(more.shape[-1]))


def _masked(found: Tangent, finite: np.ndarray) -> Tangent:
    return Tangent(
        np.where(finite[:, None], found.mean, 0.0),
        np.where(finite[:, None, None], found.slopes, 0.0),
        found.noise,
    )


def _step(prior: Belief, row: Row, point: np.ndarray, found: Tangent) -> np.ndarray:
    """Where Gauss and Newton go, in standard normals of the prior: shape (batch, n)."""
    scaled = np.linalg.solve(found.noise, found.slopes @ prior.root)
    scaled = np.where(row.present[..., None], scaled, 0.0)
    off = np.linalg.solve(found.noise, row.off(found.mean)[..., None])[..., 0]
    off = np.where(row.present, off, 0.0) + np.matvec(scaled, point)
    turned = np.matrix_transpose(scaled)
    n = point.shape[-1]
    return np.linalg.solve(turned @ scaled + np.eye(n), np.matvec(turned, off)[..., None])[..., 0]


def mode(prior: Belief, row: Row, at: At) -> np.ndarray:
    """Modes of beliefs given rows, in standard normals of beliefs, shape (batch, n)."""
    count, n = prior.mean.shape
    every = np.arange(count)

    def found_at(z: np.ndarray, which: np.ndarray) -> tuple[Tangent, np.ndarray]:
        some = Belief(prior.mean[which], prior.root[which])
        own = row.of(which)
        made = _floored(at(some.mean + np.matvec(some.root, z), which), some.root)
        off = np.linalg.solve(made.noise, own.off(made.mean)[..., None])[..., 0]
        off = np.where(own.present, off, 0.0)
        cost = 0.5 * (np.vecdot(z, z) + np.vecdot(off, off))
        smooth = is_smooth(made, some.root)
        return made, np.where(np.isfinite(cost) & smooth, cost, np.inf)

    best, (tangent, cost) = np.zeros((count, n)), found_at(np.zeros((count, n)), every)
    lost = np.flatnonzero(~np.isfinite(cost))
    for start in np.concatenate([np.eye(n), -np.eye(n)]) * 0.1:
        if not len(lost):
            break
        z = np.broadcast_to(start, (len(lost), n))
        made, own = found_at(z, lost)
        better = own < cost[lost]
        to = lost[better]
        best[to], cost[to] = z[better], own[better]
        for whole, part in zip(tangent, made, strict=True):
            whole[to] = part[better]
    going = np.flatnonzero(np.isfinite(cost))
    for _ in range(_STEPS):
        if not len(going):
            break
        going = going[_moved(prior, row, going, best, tangent, found_at)]
    return best


def _moved(
    prior: Belief,
    row: Row,
    going: np.ndarray,
    best: np.ndarray,
    tangent: Tangent,
    found_at: Callable[[np.ndarray, np.ndarray], tuple[Tangent, np.ndarray]],
) -> np.ndarray:
    """One step of some, in place, as long as tangents hold along it; and whether it was one.

    A step is halved until what each reading is off changes about as its tangent says. So readings come nearer
    on a straight line, which from afar no descent of their squares does.
    """
    some = Belief(prior.mean[going], prior.root[going])
    own = Tangent(*(part[going] for part in tangent))
    rows = row.of(going)
    move = _step(some, rows, best[going], own) - best[going]
    change = np.matvec(own.slopes, np.matvec(some.root, move))
    off, sizes = rows.off(own.mean), np.diagonal(own.noise, 0, -2, -1)
    allowed = _BENT * np.abs(off) + HELD * sizes
    length, gone = np.ones(len(going)), np.zeros(len(going))
    left = np.arange(len(going))
    for _ in range(_HALVINGS):
        z = best[going[left]] + length[left, None] * move[left]
        made, cost = found_at(z, going[left])
        wrong = rows.of(left).off(made.mean) - off[left] + length[left, None] * change[left]
        if rows.angles.any():
            wrong = np.where(rows.angles, wrap_angle(wrong), wrong)
        wrong = np.where(rows.present[left], wrong, 0.0)
        good = np.isfinite(cost) & (np.abs(wrong) <= allowed[left]).all(axis=-1)
        to = going[left[good]]
        best[to] = z[good]
        gone[left[good]] = np.linalg.norm(length[left[good], None] * move[left[good]], axis=-1)
        for whole, part in zip(tangent, made, strict=True):
            whole[to] = part[good]
        left = left[~good]
        length[left] *= 0.5
        if not len(left):
            break
    scaled = np.linalg.solve(tangent.noise[going], tangent.slopes[going] @ some.root)
    spread = 1.0 + np.sqrt(np.square(scaled).sum(axis=(-2, -1)))  # steps in posterior deviations
    return gone * spread > _SETTLED
