"""Gaussian beliefs about single elements conditioned on what picks them, many at a time.

Means of readings are made linear at the mean of the belief, as the extended Kalman filter does. Where the
belief is so vague that this says little about where it ends up (a landmark met for the first time), the
tangent misses the reading at the updated mean; then it is taken at the mode instead, found by Gauss and
Newton: the iterated extended Kalman filter, which is Laplace's method. So a first sight is placed by what is
read, whatever the prior mean is.

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

#: standard deviations of the noise that a tangent may miss a reading by at the updated mean
_MISSED = 3.0
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


def linearised(prior: Belief, row: Row, at: At, bent: bool) -> tuple[Tangent, Row]:
    """The tangent that a belief is conditioned by, with what it expects at the belief's mean; and the row.

    Angles of the row are turned so that they are off the short way round from where the tangent is taken.
    """
    every = np.arange(len(prior.mean))
    found = at(prior.mean, every)
    plain = row.turned(found.mean)
    if not bent:
        return found, plain
    finite = np.isfinite(found.mean).all(axis=-1) & np.isfinite(found.slopes).all(axis=(-2, -1))
    tame = _masked(found, finite)
    sizes = np.abs(np.diagonal(found.noise, 0, -2, -1))
    new = _updated(prior, row, tame)
    missed = at(new, every).mean - tame.mean - np.matvec(tame.slopes, new - prior.mean)
    missed = np.where(row.angles, wrap_angle(missed), missed)
    is_off = ~(np.abs(missed) <= _MISSED * sizes) & row.present
    again = np.flatnonzero((is_off.any(axis=-1) | ~finite) & row.present.any(axis=-1))
    if not len(again):
        return found, plain
    some = Belief(prior.mean[again], prior.root[again])
    point = _mode(some, row.of(again), lambda x, which: at(x, again[which]))
    tangent = at(point, again)
    there = expected_at(some, point, tangent)
    value = np.array(plain.value)
    value[again] = row.of(again).turned(tangent.mean).value
    parts = [np.array(a) for a in found]
    for whole, own in zip(parts, there, strict=True):
        whole[again] = own
    return Tangent(*parts), plain._replace(value=value)


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


def _updated(prior: Belief, row: Row, found: Tangent) -> np.ndarray:
    """Means given the row."""
    noise = found.noise
    if not np.diagonal(noise, 0, -2, -1).all():
        return conditioned(prior, row, found)[0].mean
    step = _step(prior, row, np.zeros_like(prior.mean), found)
    return prior.mean + np.matvec(prior.root, step)


def _mode(prior: Belief, row: Row, at: At) -> np.ndarray:
    """Modes of beliefs given rows, shape (batch, n), from where the prior is and places around it."""
    count, n = prior.mean.shape
    every = np.arange(count)

    def found_at(z: np.ndarray, which: np.ndarray) -> tuple[Tangent, np.ndarray]:
        some = Belief(prior.mean[which], prior.root[which])
        own = row.of(which)
        made = at(some.mean + np.matvec(some.root, z), which)
        off = np.linalg.solve(made.noise, own.off(made.mean)[..., None])[..., 0]
        off = np.where(own.present, off, 0.0)
        cost = 0.5 * (np.vecdot(z, z) + np.vecdot(off, off))
        smooth = np.isfinite(made.slopes).all(axis=(-2, -1))
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
    return prior.mean + np.matvec(prior.root, best)


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
    allowed = _BENT * np.abs(off) + _MISSED / 6 * sizes
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
