"""Settings learned from a stretch of a log with known poses: wheel noise, the floor, the tempering of a scan.

Known poses may come from a survey, from mapping, or from a filter that was started where the robot stood.
What is learned is of this robot, this sensor and this map; nothing here localises. The beam model has
``fit_beams``; whether later poses are as good is asked in ``placing``.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayesmc.errors import ModelError, ModelMisfitWarning, ShapeError
from bayesmc.robotics.field import LikelihoodField
from bayesmc.robotics.free_space import FreeSpace
from bayesmc.robotics.grid import OccupancyGrid, as_grid, as_number
from bayesmc.robotics.motion import OdometryMotion
from bayesmc.robotics.poses import as_poses, compose, wrap

#: what variances per square are looked for between, and by how much (m, rad) known poses are off anyway
_LEAST, _MOST, _FLOOR = 1e-6, 1.0, 0.01
#: deviations from which on a step is a stray, such as a jump of whatever made the known poses
_STRAY = 3.0
#: share of strays from which on the two motions are hardly of the same steps
_ASTRAY = 0.2
#: poses beside the true one that a scan is looked at from: metres per cell of the map, and radians
_CELLS, _TURN = 1.0, 0.03
#: scans over which the errors of beams are taken to last
_LAGS = 6
#: pairs of poses that say what a search loses, and which of them counts: the best of ten
_OFFSETS, _NEAREST = 100, 0.1
#: poses on the floor and scans that say how many of the particles of a search a scan leaves, and their share
_SPREAD, _SCANS, _LEFT = 2000, 20, 0.5
#: share of readings that are returns at least; places that scans are compared with, and the share of these
#: that may be likelier
_RETURNS, _ELSEWHERE, _BEATEN = 0.02, 100, 0.2
#: share of known poses that surely are on the floor, and by how much others may be less surely so
_STOOD, _MARGIN = 0.99, 2.0


def fit_odometry(motion: Any, moved: Any) -> tuple[float, float, float, float]:
    """The noise of wheels, of greatest likelihood.

    Parameters
    ----------
    motion : array_like, shape (steps, 3)
        What odometry says of each step: ``between`` of its poses (m, m, rad).
    moved : array_like, shape (steps, 3)
        The same of the known poses.

    Returns
    -------
    tuple of four floats
        ``alphas`` of ``OdometryMotion``, each between 1e-6 and 1, by turns and distances alone; steps
        that are off by more than three deviations are strays. Known poses are taken to be off by
        1 cm and 0.01 rad themselves.

    Raises
    ------
    ShapeError
        The two differ in shape, or there are fewer than 10 steps.

    Warns
    -----
    ModelMisfitWarning
        A fifth of the steps or more are strays, or a variance is at its bound: the two are hardly of the same
        steps.

    References
    ----------
    Thrun, Burgard and Fox (2005), Probabilistic Robotics, table 5.5, for what is fitted.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics import OdometryMotion, fit_odometry
    >>> motion = np.random.default_rng(0).uniform([0.0, -0.1, -0.5], [1.0, 0.1, 0.5], (400, 3))
    >>> moved = OdometryMotion(np.zeros(3), motion, (0.02, 0.01, 0.03, 0.001)).sample(rng=1)
    >>> np.round(fit_odometry(motion, moved), 2).tolist()[1:3]
    [0.01, 0.03]
    """
    from scipy import optimize

    motion, moved = as_poses("fit_odometry", motion), as_poses("fit_odometry", moved)
    if motion.shape != moved.shape or motion.ndim != 2 or len(motion) < 10:
        raise ShapeError(
            f"fit_odometry: motion has shape {motion.shape} and moved {moved.shape}; give (steps, 3) of "
            "both, 10 steps or more"
        )

    seen = OdometryMotion(np.zeros(3), motion, np.zeros(4))
    rotation, last = seen.rotation, wrap(seen.turn - seen.rotation)
    turned, driven = rotation**2 + last**2, seen.translation**2
    chord = np.stack([np.cos(rotation), np.sin(rotation)], axis=-1)
    ahead = (moved[:, :2] * chord).sum(axis=-1) - seen.translation
    aside = wrap(moved[:, 2] - motion[:, 2])

    def fitted(off: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        def missing(logs: np.ndarray) -> float:
            var = np.exp(logs[0]) * one + np.exp(logs[1]) * other + _FLOOR**2
            return float(np.minimum(off**2 / var, _STRAY**2).sum() + np.log(var).sum())

        bounds = [(math.log(_LEAST), math.log(_MOST))] * 2
        found = optimize.minimize(
            missing, np.log([0.01, 0.0025]), method="Nelder-Mead", bounds=bounds
        )
        return np.exp(found.x)

    a1, a2 = fitted(aside, turned, 2 * driven).tolist()
    a3, a4 = fitted(ahead, driven, turned).tolist()
    turns = np.sqrt(a1 * turned + 2 * a2 * driven + _FLOOR**2)
    ways = np.sqrt(a3 * driven + a4 * turned + _FLOOR**2)
    astray = ((np.abs(aside) > _STRAY * turns) | (np.abs(ahead) > _STRAY * ways)).mean()
    if astray > _ASTRAY or max(a1, a2, a3, a4) > 0.99 * _MOST:
        warnings.warn(
            f"fit_odometry: {astray:.0%} of the steps are not what the wheels say, by more than three "
            f"deviations, with variances of {a1:.3g}, {a2:.3g}, {a3:.3g} and {a4:.3g} (at most {_MOST:g}): "
            "are both motions from one pose to the next (between(poses[:-1], poses[1:])), of the same steps, "
            "and in radians?",
            ModelMisfitWarning,
            stacklevel=2,
        )
    return a1, a2, a3, a4


def fit_floor(grid: OccupancyGrid, poses: Any, clearance: float = 0.0) -> FreeSpace:
    """Where a robot can be: cells about as surely free as those where it has been.

    Maps are free wherever beams passed, behind windows, too, and a search that begins there wastes its
    particles and finds places there that look right. Where a robot drives, beams have passed often.

    Parameters
    ----------
    grid : OccupancyGrid
    poses : array_like, shape (poses, 3)
        Where it was (m, m, rad), in all kinds of places.
    clearance : float
        As of ``FreeSpace``.

    Returns
    -------
    FreeSpace
        Of cells with an occupancy below twice that which 99 in 100 of the poses have at most, and never
        above the map's threshold.

    Raises
    ------
    ModelError
        More than half of the poses are not on free cells: they are not of this map, or not in its frame.
    ShapeError
        The poses are not of shape (poses, 3), 20 or more.

    References
    ----------
    Rules of this library's own; measured in "Localising a robot".

    Examples
    --------
    >>> from bayesmc.robotics import OccupancyGrid, fit_floor
    >>> grid = OccupancyGrid([[0.02] * 9, [0.02] * 9, [0.4] * 9], 1.0)  # the last row through a window
    >>> fit_floor(grid, [[0.5, k % 9 + 0.5, 0.0] for k in range(30)]).area, grid.free().sum()
    (18.0, np.int64(27))
    """
    grid, poses = as_grid("fit_floor", grid), as_poses("fit_floor", poses)
    if poses.ndim != 2 or len(poses) < 20:
        raise ShapeError(
            f"fit_floor: poses have shape {poses.shape}; give (poses, 3), 20 poses or more"
        )
    stood = grid.at(poses[:, :2])
    stood = stood[stood < grid.threshold]  # neither unknown nor an obstacle
    if 2 * len(stood) < len(poses):
        raise ModelError(
            f"fit_floor: {len(poses) - len(stood)} of {len(poses)} poses are not on free cells of {grid!r}: "
            "are they in the map's frame, in metres, and x before y?"
        )
    level = _MARGIN * float(np.quantile(stood, _STOOD))
    least = float(np.nanmin(grid.occupancy))  # of a map of 0 and 1: whatever is free
    return FreeSpace(grid, clearance, min(max(level, 2 * least, 1e-6), grid.threshold))


#: radians of a particle's box per metre
_RADIANS = 0.35


@dataclass(frozen=True, eq=False)
class FieldFit:
    """What ``fit_field`` found.

    Parameters
    ----------
    field : LikelihoodField
        With the share of hits and the tempering that were learned: for a robot that knows where it is.
    witnesses : float
        How many independent beams a scan is worth: tempering times beams, before it is cut at 1.
    log_density : float
        Mean log density per beam at the known poses, not tempered: what a filter that is right reaches.
    deviation : float
        Its standard deviation from scan to scan.
    ranges, poses, angles : ndarray
        What it was learned from.
    """

    field: LikelihoodField
    witnesses: float
    log_density: float
    deviation: float
    ranges: np.ndarray
    poses: np.ndarray
    angles: np.ndarray

    def searching(self, particles: int, area: float | FreeSpace, rng: Any = 0) -> LikelihoodField:
        """The field for a robot that may be anywhere, tempered for particles that are sparse.

        So many particles spread over a floor are metres and tenths of a radian apart, and none is quite
        right. The best of ten near the truth, in the box that is one particle's, shall lose one nat by that,
        so that it is not thrown out by the first scan for others that happen to look better. And of particles
        spread over the floor a scan shall leave half (their effective number, in the median over scans), so
        that one scan after the other decides, and not the first few, whatever the number of particles.

        Parameters
        ----------
        particles : int
        area : float or FreeSpace
            The floor, or its area in m^2 where it is all that is free on the map.
        rng : seed, Generator or None

        Returns
        -------
        LikelihoodField
            Its tempering is at most that of ``field``.

        Raises
        ------
        ValueError
            A number is not positive.
        """
        floor = area if isinstance(area, FreeSpace) else FreeSpace(self.field.grid)
        area = area.area if isinstance(area, FreeSpace) else as_number(area)
        if not (particles >= 1 and area > 0):
            raise ValueError(
                f"searching(particles={particles!r}, area={area!r}): give a number of particles and an area "
                "in m^2, both positive"
            )
        side = (area * 2 * math.pi / particles / _RADIANS) ** (1 / 3)
        chance = np.random.default_rng(rng)
        box = np.array([side, side, min(_RADIANS * side, 2 * math.pi)])
        plain, lost = replace(self.field, tempering=1.0), []
        for pose, scan in zip(self.poses, self.ranges, strict=True):
            beside = compose(pose, chance.uniform(-0.5, 0.5, (_OFFSETS, 3)) * box)
            log = plain.given(np.vstack([pose, beside]), self.angles).log_prob(scan)
            lost.append(np.quantile(log[0] - log[1:], _NEAREST))
        loss = max(float(np.mean(lost)), 1.0)
        some = np.unique(np.linspace(0, len(self.ranges) - 1, _SCANS).astype(int))
        spread = plain.given(floor.sample(chance, sample_shape=_SPREAD), self.angles)
        half = _exponent(np.array([spread.log_prob(scan) for scan in self.ranges[some]]), _LEFT)
        return replace(self.field, tempering=min(self.field.tempering, 1.0 / loss, half))


def fit_field(field: LikelihoodField, ranges: Any, poses: Any, angles: Any) -> FieldFit:
    """The share of hits and the tempering of a likelihood field, from scans at known poses.

    Beams of one scan share what is wrong with it, and so do scans from nearly the same place, so that
    their product is far too sure. How much shows in its slopes at the known poses: were beams independent,
    the slopes would vary as much as the curvature says. Tempering is what makes the two agree.

    Parameters
    ----------
    field : LikelihoodField
        Its ``sigma`` is kept: it says how wrong the map is, too. Its tempering does not matter.
    ranges : array_like, shape (scans, beams)
        In order of time, m.
    poses : array_like, shape (scans, 3)
        Where the robot was (m, m, rad).
    angles : array_like, shape (beams,)
        As for ``LikelihoodField.given``.

    Returns
    -------
    FieldFit

    Raises
    ------
    ShapeError
        Scans and poses differ in number, or there are fewer than 20.
    ModelError
        Hardly a reading is below ``max_range``, or scans are no likelier from their poses than from anywhere:
        units, frames or columns are other than they should be.

    References
    ----------
    Ribatet, Cooley and Davison (2012), Bayesian inference from composite likelihoods, Statistica Sinica 22,
    sec. 2.2 (magnitude adjustment).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics import LikelihoodField, OccupancyGrid, fit_field
    >>> room = OccupancyGrid(np.pad(np.zeros((40, 20)), 1, constant_values=1.0), 0.1)
    >>> field, angles = LikelihoodField(room, sigma=0.2, max_range=10.0), np.linspace(-1.5, 1.5, 20)
    >>> poses = np.random.default_rng(0).uniform([1, 0.8, -3], [3, 1.4, 3], (60, 3))
    >>> scans = field.given(poses, angles).sample(rng=1)
    >>> fit = fit_field(field, scans, poses, angles)
    >>> fit.field.tempering <= 1.0, fit.searching(1000, 8.0).tempering < fit.field.tempering
    (True, True)
    """
    ranges, poses = np.asarray(ranges, dtype=float), as_poses("fit_field", poses)
    angles = np.asarray(angles, dtype=float)
    if ranges.shape != (*poses.shape[:1], *angles.shape) or len(poses) < 20:
        raise ShapeError(
            f"fit_field: ranges have shape {ranges.shape}, poses {poses.shape}, angles {angles.shape}; give "
            "(scans, beams), (scans, 3) and (beams,), 20 scans or more"
        )
    _check_in_place(replace(field, tempering=1.0), ranges, poses, angles)
    plain = _with_hits(replace(field, tempering=1.0), ranges, poses, angles)
    log, slopes, curvature = _shape_of(plain, ranges, poses, angles)
    off = slopes - slopes.mean(axis=0)
    spread = off.T @ off / len(off)
    for lag in range(1, _LAGS):
        shared = off[lag:].T @ off[:-lag] / len(off)
        spread = spread + (1 - lag / _LAGS) * (shared + shared.T)
    values, vectors = np.linalg.eigh(curvature)
    told = values > 0.01 * values.max()  # a corridor says nothing of where along it a robot stands
    needed = np.einsum("ik,ij,jk->k", vectors, spread, vectors)[told] / values[told]
    tempering = 1.0 / max(float(needed.mean()), 1e-9)
    per_beam = log / len(angles)
    return FieldFit(
        replace(plain, tempering=min(max(tempering, 1e-3), 1.0)), tempering * len(angles),
        float(per_beam.mean()), float(per_beam.std()), ranges, poses, angles,
    )  # fmt: skip


# ---- private ------------------------------------------------------------------------------------


def _exponent(log: np.ndarray, share: float) -> float:
    """The power of densities (scans, poses), at most 1, at which so large a share is effective."""
    log = log - log.max(axis=-1, keepdims=True)
    low, high = -10.0, 0.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        weights = np.exp(log * math.exp(middle))
        left = weights.sum(axis=-1) ** 2 / (weights**2).sum(axis=-1) / log.shape[-1]
        if np.median(left) > share:
            low = middle
        else:
            high = middle
    return math.exp(high)


def _check_in_place(
    field: LikelihoodField, ranges: np.ndarray, poses: np.ndarray, angles: np.ndarray
) -> None:
    """Refuse scans that are not from their poses: what would be learned from them is worth nothing."""
    seen = ((ranges >= 0) & (ranges < field.max_range)).mean()
    if seen < _RETURNS:
        raise ModelError(
            f"fit_field: {seen:.0%} of the readings are below max_range={field.max_range:g} m; are they in "
            "metres, and from a place where there is something to see?"
        )
    some = np.unique(np.linspace(0, len(ranges) - 1, _SCANS).astype(int))
    spots = FreeSpace(field.grid).sample(0, sample_shape=_ELSEWHERE)
    beaten = []
    for k in some:
        log = field.given(np.vstack([poses[k], spots]), angles).log_prob(ranges[k])
        beaten.append((log[1:] > log[0]).mean())
    if np.median(beaten) > _BEATEN:
        raise ModelError(
            f"fit_field: from {np.median(beaten):.0%} of all places on the floor the scans are likelier than "
            "from the poses given, in the median: are these in the map's frame, x before y, headings in "
            "radians and counterclockwise, in step with the scans, and is the field's mount the laser's?"
        )


def _with_hits(
    field: LikelihoodField, ranges: np.ndarray, poses: np.ndarray, angles: np.ndarray
) -> LikelihoodField:
    """The field with the share of hits that is most likely, by EM; no returns are left out."""
    part = replace(field, z_hit=0.5, z_rand=0.5)
    used = (ranges >= 0) & (ranges < field.max_range)
    log = part.by_beam(poses, angles, np.where(used, ranges, 0.0))[used]
    hit = np.maximum(np.exp(log) / 0.5 - 1.0 / field.max_range, 0.0)
    share = 0.8
    for _ in range(100):
        own = share * hit
        share = float((own / (own + (1 - share) / field.max_range)).mean())
    share = min(max(share, 0.01), 0.99)
    return replace(field, z_hit=share, z_rand=1.0 - share)


def _shape_of(
    field: LikelihoodField, ranges: np.ndarray, poses: np.ndarray, angles: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log densities of scans at their poses, slopes there, shape (scans, 3), and the mean curvature, (3, 3).

    Slopes and curvature are by step: a cell of the map, or a thirtieth of a radian.
    """
    size = field.grid.resolution * _CELLS
    step = np.array([size, size, _TURN])
    one = np.diag(step)
    pairs = [(0, 1), (0, 2), (1, 2)]
    corners = [s * one[i] + t * one[j] for i, j in pairs for s in (1, -1) for t in (1, -1)]
    moves = np.concatenate([np.zeros((1, 3)), one, -one, corners])
    log = np.array(
        [
            field.given(compose(pose, moves), angles).log_prob(scan)
            for pose, scan in zip(poses, ranges, strict=True)
        ]
    )
    mean = log.mean(axis=0)
    slopes = (log[:, 1:4] - log[:, 4:7]) / (2 * step)
    curvature = np.diag(-(mean[1:4] + mean[4:7] - 2 * mean[0]) / step**2)
    for k, (i, j) in enumerate(pairs):
        up, over, under, down = mean[7 + 4 * k : 11 + 4 * k]
        curvature[i, j] = curvature[j, i] = -(up - over - under + down) / (4 * step[i] * step[j])
    return log[:, 0], slopes * step, curvature * step[:, None] * step
