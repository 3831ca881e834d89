"""Sensors of known landmarks: what a robot at a pose should read, and densities of what it does read.

``range_to``, ``bearing_to`` and ``cone_range`` say what a perfect sensor reads; ``bearing``,
``range_only``, ``range_and_bearing`` and ``sonar`` are conditional densities about them. Each reads
one landmark, and landmarks are a plate: in a node of that plate the pose arrives with an axis of
one for them, and an array of landmarks ``(L, 2)`` lines up with it. Landmarks that were not seen
are NaN in the row.

Which landmark a reading is of is known here. Sensors that read a map are in modules of their own.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.distributions import (
    Distribution,
    Mixture,
    Normal,
    StudentT,
    Uniform,
    VonMises,
    WrappedNormal,
)
from bayesmc.distributions.base import as_float
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.plates import PlateArray
from bayesmc.robotics.pose_distributions import AndAngle
from bayesmc.robotics.poses import as_points, as_poses, check_leading, turned_back


def range_to(pose: Any, landmark: Any) -> np.ndarray:
    """Distance from a robot to a landmark.

    Parameters
    ----------
    pose : array_like, shape (..., 3) or (..., 2)
        A pose, or a position alone; in m and rad.
    landmark : array_like, shape (..., 2)
        In m.

    Returns
    -------
    ndarray, shape (...)
        In m.

    Raises
    ------
    ShapeError
        The last axes are not those of poses and points, or the others do not broadcast.

    References
    ----------
    Thrun, Burgard and Fox (2005), Probabilistic Robotics, table 6.4.

    Examples
    --------
    >>> from bayesmc.robotics.landmarks import range_to
    >>> range_to([0.0, 0.0, 1.0], [[3.0, 4.0], [0.0, 2.0]]).tolist()
    [5.0, 2.0]
    """
    dx, dy = _offset("range_to", pose, landmark)
    return np.hypot(dx, dy)


def bearing_to(pose: Any, landmark: Any) -> np.ndarray:
    """Direction in which a robot has a landmark.

    Parameters
    ----------
    pose : array_like, shape (..., 3) or (..., 2)
        Of a pose the bearing is relative to the heading, counterclockwise. Of a position alone, a
        robot that does not know or have a heading, it is absolute: 0 along +x.
    landmark : array_like, shape (..., 2)
        In m.

    Returns
    -------
    ndarray, shape (...)
        In rad, in ``[-pi, pi)``; of a landmark where the robot is, minus its heading.

    Raises
    ------
    ShapeError
        The last axes are not those of poses and points, or the others do not broadcast.

    References
    ----------
    Thrun, Burgard and Fox (2005), Probabilistic Robotics, table 6.4; Dellaert, Monte Carlo
    Inference (lecture notes), equation 7.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.landmarks import bearing_to
    >>> bearing_to([0.0, 0.0, np.pi / 2], [0.0, 2.0]).round(3).tolist()
    0.0
    >>> bearing_to([0.0, 0.0], [0.0, 2.0]).round(3).tolist()
    1.571
    """
    dx, dy = _offset("bearing_to", pose, landmark)
    direction = np.arctan2(dy, dx)
    if np.shape(pose)[-1] == 3:
        direction = direction - np.asarray(pose)[..., 2]
    return turned_back(direction)


def bearing(pose: Any, landmark: Any, scale: Any, outlier: Any = 0.0) -> Distribution:
    """Density of a measured bearing: normal noise on the circle, so that a full turn costs nothing.

    Parameters
    ----------
    pose : array_like, shape (..., 3) or (..., 2)
    landmark : array_like, shape (..., 2)
    scale : array_like, shape (...)
        Standard deviation in rad, positive.
    outlier : array_like, shape (...)
        Share of readings that come from anywhere on the circle, such as of a landmark taken for another.

    Returns
    -------
    WrappedNormal or Mixture, batch shape (...)

    Raises
    ------
    ParameterError
        ``scale`` is not positive or ``outlier`` not between 0 and 1.
    ShapeError
        The last axes are not those of poses and points.

    References
    ----------
    Dellaert, Monte Carlo Inference (lecture notes), equation 8, and the robust densities mentioned after it.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.landmarks import bearing
    >>> seen = bearing([0.0, 0.0, 3.1], [-5.0, 0.0], 0.1)
    >>> seen.log_prob([0.05, 0.05 + 2 * np.pi]).round(3).tolist()
    [1.38, 1.38]
    """
    return _robust_angle(bearing_to(pose, landmark), scale, outlier)


def range_only(
    pose: Any, landmark: Any, scale: Any, bias: Any = 0.0, df: Any = None
) -> Distribution:
    """Density of a measured range.

    Parameters
    ----------
    pose : array_like, shape (..., 3) or (..., 2)
    landmark : array_like, shape (..., 2)
    scale : array_like, shape (...)
        Standard deviation in m, or the scale of Student's t; positive.
    bias : array_like, shape (...)
        Metres by which readings are too long: a number, or a node of its own that is estimated.
    df : array_like, optional
        Degrees of freedom of Student's t distribution; the fewer, the heavier the tails. Without it
        the noise is normal.

    Returns
    -------
    Normal or StudentT, batch shape (...)

    Raises
    ------
    ParameterError
        ``scale`` or ``df`` is not positive, ``bias`` not finite.
    ShapeError
        The last axes are not those of poses and points.

    References
    ----------
    Thrun, Burgard and Fox (2005), Probabilistic Robotics, table 6.4; Lange, Little and Taylor
    (1989), Robust statistical modeling using the t distribution, JASA 84.

    Examples
    --------
    >>> from bayesmc.robotics.landmarks import range_only
    >>> float(range_only([0.0, 0.0, 0.0], [3.0, 4.0], 0.5, bias=0.25).mean)
    5.25
    >>> float(range_only([0.0, 0.0], [3.0, 4.0], 0.5, df=3.0).log_prob(9.0).round(2))
    -6.52
    """
    return _robust_number(range_to(pose, landmark) + as_float(bias), scale, df)


def range_and_bearing(
    pose: Any,
    landmark: Any,
    range_scale: Any,
    bearing_scale: Any,
    bias: Any = 0.0,
    df: Any = None,
    outlier: Any = 0.0,
) -> AndAngle:
    """Density of a range and a bearing measured at once, as one vector.

    Parameters
    ----------
    pose : array_like, shape (..., 3) or (..., 2)
    landmark : array_like, shape (..., 2)
    range_scale, bearing_scale : array_like, shape (...)
        In m and rad, positive.
    bias : array_like, shape (...)
        Of the range, in m.
    df : array_like, optional
        Of the range: degrees of freedom of Student's t.
    outlier : array_like, shape (...)
        Of the bearing: share of readings from anywhere on the circle.

    Returns
    -------
    AndAngle, batch shape (...), event shape (2,)

    Raises
    ------
    ParameterError, ShapeError
        As ``range_only`` and ``bearing``.

    Notes
    -----
    A row holds both or neither. A sensor that at times reads one of them alone is two nodes,
    ``range_only`` and ``bearing``, which say the same.

    References
    ----------
    Thrun, Burgard and Fox (2005), Probabilistic Robotics, table 6.4.

    Examples
    --------
    >>> from bayesmc.robotics.landmarks import range_and_bearing
    >>> seen = range_and_bearing([0.0, 0.0, 0.0], [[3.0, 4.0], [0.0, 2.0]], 0.1, 0.05)
    >>> seen.mean.round(3).tolist()
    [[5.0, 0.927], [2.0, 1.571]]
    """
    return RangeAndBearing(
        range_only(pose, landmark, range_scale, bias, df),
        bearing(pose, landmark, bearing_scale, outlier),
    )


class RangeAndBearing(AndAngle):
    """A range and a bearing side by side; rows whose columns are swapped do not pass unnoticed."""

    def doubt(self, values: np.ndarray) -> str | None:
        """What is strange about rows, shape (..., 2), or None; ``network.evidence`` asks.

        Ranges are hardly ever negative, and bearings are as often as not: rows of which it is the other way
        round are swapped.
        """
        ranges, bearings = values[..., 0].ravel(), values[..., 1].ravel()
        if not ranges.size or np.abs(ranges).max() > 2 * np.pi or bearings.min() < 0:
            return None
        negative = (ranges < 0).mean()
        if negative < 0.1 or (ranges.size < 5 and bearings.max() <= np.pi):
            return None
        return (
            f"{int((ranges < 0).sum())} of {ranges.size} ranges are negative, and no bearing is; a row is "
            "(range in m, bearing in rad): are they swapped? give values[..., ::-1]"
        )


def cone_range(pose: Any, points: Any, opening: Any, max_range: Any) -> np.ndarray:
    """What a perfect sonar reads: the range of the nearest point within its cone.

    Parameters
    ----------
    pose : array_like, shape (..., 3)
        Of the sonar, which looks along the heading: ``compose(robot, mount)`` for one that is
        mounted elsewhere.
    points : array_like, shape (P, 2) or (..., P, 2)
        Landmarks or points of obstacles, in m; or the ``PlateArray`` of a node whose plates the
        child lacks, one point each.
    opening : array_like, shape (...)
        Whole angle of the cone in rad, positive.
    max_range : array_like, shape (...)
        Reading where nothing is nearer, in m; positive.

    Returns
    -------
    ndarray, shape (...)
        In m.

    Raises
    ------
    ParameterError
        ``opening`` or ``max_range`` is not positive.
    ShapeError
        The last axes are not those of poses and points.

    Notes
    -----
    It makes arrays of (..., P) numbers. For walls of many points use a map.

    References
    ----------
    Thrun, Burgard and Fox (2005), Probabilistic Robotics, section 6.3 (range finders).

    Examples
    --------
    A point ahead, and a nearer one to the side that the cone does not reach:

    >>> from bayesmc.robotics.landmarks import cone_range
    >>> cone_range([0.0, 0.0, 0.0], [[2.0, 0.1], [0.0, 1.0]], opening=0.5, max_range=5.0).round(3).tolist()
    2.002
    >>> cone_range([0.0, 0.0, 3.0], [[2.0, 0.1], [0.0, 1.0]], opening=0.5, max_range=5.0).tolist()
    5.0
    """
    pose = as_poses("cone_range", pose)
    opening = _positive("cone_range", "opening", opening)
    max_range = _positive("cone_range", "max_range", max_range)
    points = as_points("cone_range", _plain(points))
    if points.ndim < 2:
        raise ShapeError(f"cone_range: points must have shape (P, 2); got {points.shape}")
    ahead = pose[..., None, :]
    inside = np.abs(bearing_to(ahead, points)) <= 0.5 * opening[..., None]
    found = np.where(inside, range_to(ahead, points), np.inf)
    return np.minimum(found.min(axis=-1, initial=np.inf), max_range)


def sonar(
    pose: Any,
    points: Any,
    scale: Any,
    opening: Any,
    max_range: Any,
    df: Any = None,
    outlier: Any = 0.0,
) -> Distribution:
    """Density of a sonar's reading: noise about the nearest point in the cone.

    Parameters
    ----------
    pose : array_like, shape (..., 3)
        Of the sonar, which looks along the heading.
    points : array_like, shape (P, 2) or (..., P, 2)
        As in ``cone_range``.
    scale : array_like, shape (...)
        Standard deviation in m, or the scale of Student's t; positive.
    opening : array_like, shape (...)
        Whole angle of the cone in rad.
    max_range : array_like, shape (...)
        Reading where nothing is nearer, in m; the noise is about that, too.
    df : array_like, optional
        Degrees of freedom of Student's t.
    outlier : array_like, shape (...)
        Share of readings from anywhere between 0 and ``max_range``: echoes of people, specular
        reflection, crosstalk.

    Returns
    -------
    Normal, StudentT or Mixture, batch shape (...)

    Raises
    ------
    ParameterError
        ``scale``, ``opening``, ``max_range`` or ``df`` is not positive, or ``outlier`` not between 0 and 1.
    ShapeError
        The last axes are not those of poses and points.

    References
    ----------
    Thrun, Burgard and Fox (2005), Probabilistic Robotics, section 6.3; the beam model of a map
    has readings that are short or at the maximum as parts of their own.

    Examples
    --------
    >>> from bayesmc.robotics.landmarks import sonar
    >>> reading = sonar([0.0, 0.0, 0.0], [[2.0, 0.0]], 0.1, opening=0.4, max_range=5.0, outlier=0.1)
    >>> reading.log_prob([2.0, 3.5]).round(3).tolist()
    [1.284, -3.912]
    """
    near = _robust_number(cone_range(pose, points, opening, max_range), scale, df)
    if _is_none(outlier):
        return near
    return Mixture(_shares(outlier), [near, Uniform(0.0, max_range)])


# ---- private ------------------------------------------------------------------------------------


def _offset(call: str, pose: Any, landmark: Any) -> tuple[np.ndarray, np.ndarray]:
    pose, landmark = as_float(pose), as_points(call, landmark)
    if not pose.ndim or pose.shape[-1] not in (2, 3):
        raise ShapeError(
            f"{call}: a pose has the components x, y, heading on its last axis, a position x, y; got shape "
            f"{pose.shape}"
        )
    check_leading(call, pose, landmark)
    return landmark[..., 0] - pose[..., 0], landmark[..., 1] - pose[..., 1]


def _robust_angle(expected: np.ndarray, scale: Any, outlier: Any) -> Distribution:
    near = WrappedNormal(expected, scale)
    if _is_none(outlier):
        return near
    return Mixture(_shares(outlier), [near, VonMises(0.0, 0.0)])


def _robust_number(expected: np.ndarray, scale: Any, df: Any) -> Distribution:
    return Normal(expected, scale) if df is None else StudentT(df, expected, scale)


def _is_none(outlier: Any) -> bool:
    """Whether there are no outliers, whatever else changes: a share that is an array stays a mixture."""
    return isinstance(outlier, (int, float)) and outlier == 0


def _shares(outlier: Any) -> np.ndarray:
    outlier = as_float(outlier)
    return np.stack([1.0 - outlier, outlier], axis=-1)


def _positive(call: str, name: str, value: Any) -> np.ndarray:
    value = as_float(value)
    if not (value > 0).all():
        raise ParameterError(f"{call}: {name} must be positive; got {value.min(initial=np.inf):g}")
    return value


def _plain(points: Any) -> Any:
    """Points of a node in foreign plates as one list of them, after the axes of batch and child plates."""
    if not isinstance(points, PlateArray):
        return points
    array = points.array
    return array.reshape((*array.shape[: array.ndim - 1 - len(points.plates)], -1, 2))
