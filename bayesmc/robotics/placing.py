"""Is a robot where its filter says? Scans from there, beside scans from where it is known to have been.

A likelihood field asks where beams end, and takes most wrong places for likely enough. Rays that are
followed through the map ask more: a wrong place has walls in front of what was seen, or nothing where it was
seen. Nothing here moves a belief.
"""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np

from bayesmc.errors import ModelMisfitWarning, ShapeError
from bayesmc.robotics.calibration import FieldFit
from bayesmc.robotics.field import LikelihoodField
from bayesmc.robotics.free_space import FreeSpace
from bayesmc.robotics.poses import as_poses, compose
from bayesmc.robotics.raycast import ray_cast

#: standard deviations of the field that a reading may be away from what its ray meets
_WIDE = 3.0
#: poses anywhere on the floor for every scan that is looked at, and scans
_ANYWHERE, _SCANS = 20, 40


class PlaceCheck(NamedTuple):
    """What ``check_poses`` found.

    Attributes
    ----------
    unexplained : ndarray, shape (scans,)
        Share of each scan's beams that do not read what their rays meet on the map.
    known, limit, anywhere : float
        The mean share over a window: at the known poses, in the worst window of them; from which on a robot
        is not where it is said to be; and from anywhere on the floor. The limit is halfway.
    lost : ndarray of bool, shape (scans,)
        Whether the last ``window`` scans (or as many as there are) have more than the limit.
    """

    unexplained: np.ndarray
    known: float
    limit: float
    anywhere: float
    lost: np.ndarray


def check_poses(fit: FieldFit, ranges: Any, poses: Any, window: int = 20) -> PlaceCheck:
    """Whether scans look as they should from where a filter says the robot was.

    A beam is unexplained where its reading is more than three ``sigma`` of the field from what a ray meets
    that is cast from the pose: nearer, or behind a wall. How many are so at poses that are known, and from
    anywhere on the floor, is measured; a robot is lost from halfway between the two.

    Parameters
    ----------
    fit : FieldFit
        Of ``fit_field``: it knows the map, the beams, and a stretch with known poses.
    ranges : array_like, shape (scans, beams)
        In order of time, m; beams as in the fit.
    poses : array_like, shape (scans, 3)
        As estimated, such as ``filtered.mean("pose")`` (m, m, rad): where the filter claims to know. The mean
        of a belief that is wide, or in pieces, is no place that a robot is at.
    window : int
        Scans that are judged together: people in front of one are no fault.

    Returns
    -------
    PlaceCheck

    Raises
    ------
    TypeError
        ``fit`` is no FieldFit.
    ShapeError
        Ranges, poses and the fit's beams do not go together.
    ValueError
        ``window`` is not a positive whole number.

    Warns
    -----
    ModelMisfitWarning
        The robot is not where it is said to be in the last scan.

    References
    ----------
    Compare Fox, Burgard and Thrun (1999), Markov localization for mobile robots in dynamic environments,
    JAIR 11, sec. 3.2 (distance filter); the limit is this library's own.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics import LikelihoodField, OccupancyGrid, check_poses, fit_field, ray_cast
    >>> cells = np.pad(np.zeros((80, 40)), 1, constant_values=1.0)
    >>> cells[30:34, 10:30] = 1.0
    >>> room, angles = OccupancyGrid(cells, 0.1), np.linspace(-1.5, 1.5, 20)
    >>> poses = np.random.default_rng(0).uniform([4, 0.5, -3], [7.5, 3.5, 3], (60, 3))
    >>> scans = ray_cast(room, poses, angles, 10.0)
    >>> fit = fit_field(LikelihoodField(room, 0.1, max_range=10.0), scans[:40], poses[:40], angles)
    >>> check_poses(fit, scans[40:], poses[40:]).lost[-1]
    np.False_
    """
    if not isinstance(fit, FieldFit):
        raise TypeError(f"check_poses: give a FieldFit, which fit_field returns; got {fit!r:.80}")
    if isinstance(window, bool) or not isinstance(window, int | np.integer) or window < 1:
        raise ValueError(f"check_poses: window must be a positive whole number; got {window!r:.80}")
    ranges, poses = np.asarray(ranges, dtype=float), as_poses("check_poses", poses)
    if poses.ndim != 2 or ranges.shape != (len(poses), len(fit.angles)) or not len(poses):
        raise ShapeError(
            f"check_poses: ranges have shape {ranges.shape}, poses {poses.shape}, and the fit has "
            f"{len(fit.angles)} beams; give (scans, beams) and (scans, 3)"
        )
    own = _unexplained(fit.field, fit.ranges, fit.poses, fit.angles)
    known = float(_windows(own, min(window, len(own)))[min(window, len(own)) - 1 :].max())
    anywhere = max(_elsewhere(fit), known)
    limit = 0.5 * (known + anywhere)
    found = _unexplained(fit.field, ranges, poses, fit.angles)
    lost = _windows(found, window) > limit
    if lost[-1]:
        share = float(_windows(found, window)[-1])
        warnings.warn(
            f"check_poses: from where the robot is said to be, {share:.0%} of the beams of the last "
            f"{min(window, len(found))} scans do not read what their rays meet on the map; from known poses "
            f"it is at worst {known:.0%}, from anywhere {anywhere:.0%}: the robot is somewhere else (search "
            "again, with more particles or another seed), the filter does not know yet (look at its spread), "
            "or the map has changed",
            ModelMisfitWarning,
            stacklevel=2,
        )
    return PlaceCheck(found, known, limit, anywhere, lost)


# ---- private ------------------------------------------------------------------------------------


def _unexplained(
    field: LikelihoodField, ranges: np.ndarray, poses: np.ndarray, angles: np.ndarray
) -> np.ndarray:
    """Share of each scan's beams that are not near what their rays meet; what is no return reads the most."""
    reach = field.max_range
    read = np.where((ranges >= 0) & (ranges < reach), ranges, reach)
    met = ray_cast(field.grid, compose(poses, np.array(field.mount)), angles, reach)
    return np.asarray((np.abs(read - met) > _WIDE * field.sigma).mean(axis=-1))


def _windows(shares: np.ndarray, window: int) -> np.ndarray:
    """Means of the last ``window`` numbers, or of as many as there are."""
    sums = np.concatenate([[0.0], np.cumsum(shares)])
    end = np.arange(1, len(shares) + 1)
    begin = np.maximum(end - window, 0)
    return np.asarray((sums[end] - sums[begin]) / (end - begin))


def _elsewhere(fit: FieldFit) -> float:
    """What is unexplained from anywhere on the floor, on average."""
    some = np.unique(np.linspace(0, len(fit.ranges) - 1, _SCANS).astype(int))
    spots = FreeSpace(fit.field.grid).sample(0, sample_shape=len(some) * _ANYWHERE)
    scans = fit.ranges[some].repeat(_ANYWHERE, axis=0)
    return float(_unexplained(fit.field, scans, spots, fit.angles).mean())
