"""Poses in the plane: composing, comparing and averaging them.

A pose is an array ``(..., 3)``: x and y in metres, and the heading in radians, 0 along +x and
counterclockwise. All functions take arrays with any leading axes (particles, plates) that
broadcast. Headings that come out lie in ``[-pi, pi)``, and differences of headings go the short way
round.

Distributions of poses are in ``pose_distributions``; how a robot moves is in ``steps`` and ``motion``,
what it senses in ``landmarks`` and its neighbours. Nothing here knows of any of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.distributions.base import as_float
from bayesmc.distributions.circular import wrap_angle
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.shapes import Shape, broadcast_shapes

#: radians, with some for rounding
_FULL_TURN = 2 * np.pi + 1e-3


def compose(a: Any, b: Any) -> np.ndarray:
    """The pose ``b``, given in the frame of ``a``, in the frame that ``a`` is given in.

    Parameters
    ----------
    a, b : array_like, shape (..., 3)
        Poses in m, m, rad; their leading axes broadcast.

    Returns
    -------
    ndarray, shape (..., 3)

    Raises
    ------
    ShapeError
        A pose has not three components, or leading axes do not broadcast.

    References
    ----------
    Smith, Self and Cheeseman (1990), Estimating uncertain spatial relationships in robotics, equation 3 (the
    compounding ``a + b``).

    Examples
    --------
    One metre ahead, then a quarter turn to the left; twice:

    >>> import numpy as np
    >>> from bayesmc.robotics.poses import compose
    >>> step = [1.0, 0.0, np.pi / 2]
    >>> compose(step, step).round(3).tolist()
    [1.0, 1.0, -3.142]
    """
    a, b = as_poses("compose", a), as_poses("compose", b)
    check_leading("compose", a, b)
    sine, cosine = sin_cos(a[..., 2])
    x = a[..., 0] + (cosine * b[..., 0] - sine * b[..., 1])
    y = a[..., 1] + (sine * b[..., 0] + cosine * b[..., 1])
    return joined_pose(x, y, turned_back(a[..., 2] + b[..., 2]))


def inverse(a: Any) -> np.ndarray:
    """The pose that undoes ``a``: ``compose(a, inverse(a))`` is the origin.

    Parameters
    ----------
    a : array_like, shape (..., 3)

    Returns
    -------
    ndarray, shape (..., 3)

    References
    ----------
    Smith, Self and Cheeseman (1990), equation 6 (the inverse relationship).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.poses import inverse
    >>> inverse([1.0, 2.0, np.pi / 2]).round(3).tolist()
    [-2.0, 1.0, -1.571]
    """
    a = as_poses("inverse", a)
    sine, cosine = sin_cos(a[..., 2])
    x = -(cosine * a[..., 0] + sine * a[..., 1])
    y = sine * a[..., 0] - cosine * a[..., 1]
    return joined_pose(x, y, turned_back(-a[..., 2]))


def between(a: Any, b: Any) -> np.ndarray:
    """The pose ``b`` seen from ``a``: ``compose(a, between(a, b))`` is ``b``.

    Parameters
    ----------
    a, b : array_like, shape (..., 3)

    Returns
    -------
    ndarray, shape (..., 3)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.poses import between
    >>> between([1.0, 1.0, np.pi / 2], [1.0, 3.0, np.pi]).round(3).tolist()
    [2.0, 0.0, 1.571]
    """
    a, b = as_poses("between", a), as_poses("between", b)
    check_leading("between", a, b)
    sine, cosine = sin_cos(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    ahead, left = cosine * dx + sine * dy, cosine * dy - sine * dx
    return joined_pose(ahead, left, turned_back(b[..., 2] - a[..., 2]))


def transform(pose: Any, points: Any) -> np.ndarray:
    """Points of the robot's frame in the world.

    Parameters
    ----------
    pose : array_like, shape (..., 3)
    points : array_like, shape (..., 2)
        In m; their leading axes broadcast with the pose's. For many points of every pose give the
        pose an axis for them: ``transform(pose[..., None, :], points)``.

    Returns
    -------
    ndarray, shape (..., 2)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.poses import transform
    >>> transform([1.0, 1.0, np.pi / 2], [[1.0, 0.0], [0.0, 1.0]]).round(3).tolist()
    [[1.0, 2.0], [0.0, 1.0]]
    """
    pose, points = as_poses("transform", pose), as_points("transform", points)
    check_leading("transform", pose, points)
    sine, cosine = sin_cos(pose[..., 2])
    px, py = points[..., 0], points[..., 1]
    x, y = pose[..., 0] + (cosine * px - sine * py), pose[..., 1] + (sine * px + cosine * py)
    return np.stack(np.broadcast_arrays(x, y), axis=-1)


def wrap(angle: Any) -> np.ndarray:
    """The same angle in ``[-pi, pi)``.

    Parameters
    ----------
    angle : array_like
        In rad, of any size; angles in ``[-pi, pi)`` keep every digit.

    Returns
    -------
    ndarray

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.poses import wrap
    >>> wrap([3 * np.pi, 0.5, 7.0]).round(3).tolist()
    [-3.142, 0.5, 0.717]
    """
    return wrap_angle(angle)


def angle_between(a: Any, b: Any) -> np.ndarray:
    """The turn from heading ``a`` to heading ``b`` the short way round, in ``[-pi, pi)``.

    Parameters
    ----------
    a, b : array_like
        Angles in rad, which broadcast.

    Returns
    -------
    ndarray

    Examples
    --------
    >>> from bayesmc.robotics.poses import angle_between
    >>> angle_between([3.1, 0.0], [-3.1, 0.25]).round(3).tolist()
    [0.083, 0.25]
    """
    return wrap_angle(np.asarray(b, dtype=float) - np.asarray(a, dtype=float))


def compass(heading: Any) -> np.ndarray:
    """Headings of one convention in the other: ``pi / 2 - heading``, which is its own inverse.

    One convention is this package's, 0 along +x and counterclockwise; the other that of a compass, 0 along +y
    and clockwise, which the lecture notes' motion model implies (see ``steps.euler_step``).

    Parameters
    ----------
    heading : array_like
        In rad.

    Returns
    -------
    ndarray
        In ``[-pi, pi)``.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.poses import compass
    >>> compass([0.0, np.pi / 2, -np.pi]).round(3).tolist()
    [1.571, 0.0, -1.571]
    """
    return angle_between(heading, 0.5 * np.pi)


def mean_pose(poses: Any, weights: Any = None, axis: int = 0) -> np.ndarray:
    """Weighted mean of poses, the heading's on the circle.

    Parameters
    ----------
    poses : array_like, shape (..., 3)
    weights : array_like, optional
        Nonnegative, not necessarily normalised; of the shape of ``poses`` without its last axis, or
        one for each entry along ``axis``.
    axis : int
        What is averaged over, counted among the leading axes: the particles, usually the first.

    Returns
    -------
    ndarray, shape (..., 3)
        Without ``axis``. The heading is the direction of the mean of ``(cos, sin)``; where that
        mean is zero no direction is better than another.

    Raises
    ------
    ParameterError
        No weight is positive, or one is negative or not finite.
    ShapeError
        There are no poses along ``axis``, they have not three components, or weights do not fit them.

    References
    ----------
    Mardia and Jupp (2000), Directional Statistics, section 2.2.1.

    Examples
    --------
    Headings on both sides of pi, whose plain mean would point the other way:

    >>> import numpy as np
    >>> from bayesmc.robotics.poses import mean_pose
    >>> mean_pose([[0.0, 0.0, 3.0], [1.0, 2.0, -3.1]]).round(3).tolist()
    [0.5, 1.0, 3.092]
    """
    poses = as_poses("mean_pose", poses)
    if poses.ndim < 2:
        raise ShapeError("mean_pose: one pose alone has no axis to average over; give (n, 3)")
    lead = poses.shape[:-1]
    axis = range(len(lead))[axis]
    if not lead[axis]:
        raise ShapeError(f"mean_pose: poses of shape {poses.shape} have no entry along axis {axis}")
    share = _shares(lead, weights, axis)[..., None]
    sine, cosine = sin_cos(poses[..., 2])
    parts = np.stack([poses[..., 0], poses[..., 1], sine, cosine], axis=-1)
    total = (share * parts).sum(axis=axis)
    return joined_pose(total[..., 0], total[..., 1], wrap(np.arctan2(total[..., 2], total[..., 3])))


def pose_errors(estimate: Any, truth: Any) -> tuple[np.ndarray, np.ndarray]:
    """How far an estimate is from the truth.

    Parameters
    ----------
    estimate, truth : array_like, shape (..., 3)

    Returns
    -------
    distance : ndarray, shape (...)
        Between the positions, in m.
    heading : ndarray, shape (...)
        From the true heading to the estimated one, in rad, in ``[-pi, pi)``.

    Raises
    ------
    ShapeError
        A pose has not three components, or leading axes do not broadcast.

    Examples
    --------
    >>> from bayesmc.robotics.poses import pose_errors
    >>> distance, heading = pose_errors([3.0, 4.0, 3.1], [0.0, 0.0, -3.1])
    >>> float(distance), float(heading.round(3))
    (5.0, -0.083)
    """
    estimate, truth = as_poses("pose_errors", estimate), as_poses("pose_errors", truth)
    check_leading("pose_errors", estimate, truth)
    off = estimate - truth
    return np.hypot(off[..., 0], off[..., 1]), wrap_angle(off[..., 2])


def as_poses(call: str, pose: Any) -> np.ndarray:
    """Poses as floats, or an error that names the call."""
    pose = as_float(pose)
    if not pose.ndim or pose.shape[-1] != 3:
        raise ShapeError(
            f"{call}: a pose has the components x, y, heading on its last axis; got shape {pose.shape}"
        )
    return pose


def as_points(call: str, points: Any) -> np.ndarray:
    """Points of the plane as floats, or an error that names the call."""
    points = as_float(points)
    if not points.ndim or points.shape[-1] != 2:
        raise ShapeError(
            f"{call}: a point has the components x, y on its last axis; got shape {points.shape}"
        )
    return points


def check_leading(call: str, a: np.ndarray, b: np.ndarray) -> None:
    """Nothing, where all axes but the last broadcast.

    Raises
    ------
    ShapeError
        Where they do not; it names the call.
    """
    if a.ndim > 1 and b.ndim > 1 and a.shape[:-1] != b.shape[:-1]:
        try:
            broadcast_shapes(a.shape[:-1], b.shape[:-1])
        except ValueError:
            raise ShapeError(
                f"{call}: arrays of shape {a.shape} and {b.shape} do not fit; their leading axes must "
                "broadcast"
            ) from None


def check_radians(call: str, name: str, angles: np.ndarray) -> None:
    """Nothing, where angles are finite and none is beyond a full turn: a sensor's are not.

    Raises
    ------
    ParameterError
        Degrees, most likely; it names the call.
    """
    reach = float(max(angles.max(), -angles.min())) if angles.size else 0.0
    if not reach <= _FULL_TURN:  # NaN fails as well
        at = int(np.argmax(~(np.abs(angles) <= _FULL_TURN)))
        if not np.isfinite(angles.flat[at]):
            raise ParameterError(f"{call}: {name} must be finite; got {angles.flat[at]}")
        raise ParameterError(
            f"{call}: {name} are in radians; got {angles.flat[at]:g}, more than a full turn; of degrees give "
            "np.deg2rad(...)"
        )


def check_turns(call: str, name: str, motion: np.ndarray) -> None:
    """Nothing, where no motion, shape (..., 3), turns by more than a full turn: that of ``between`` does not.

    Raises
    ------
    ParameterError
        Degrees, most likely; it names the call.
    """
    turn = motion[..., 2]
    most = max(float(turn.max()), -float(turn.min())) if turn.size else 0.0
    if _FULL_TURN < most < np.inf:
        raise ParameterError(
            f"{call}: the turn of {name} is in radians; got {most:g}, more than a full turn; of degrees give "
            "np.deg2rad(...), of two poses between(before, after)"
        )


def joined_pose(x: Any, y: Any, heading: Any) -> np.ndarray:
    """Poses from their components, which broadcast."""
    shape = broadcast_shapes(np.shape(x), np.shape(y), np.shape(heading))
    pose = np.empty((*shape, 3))
    pose[..., 0], pose[..., 1], pose[..., 2] = x, y, heading
    return pose


def sin_cos(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sine and cosine."""
    return np.sin(angle), np.cos(angle)


def turned_back(heading: np.ndarray) -> np.ndarray:
    """The same as ``wrap`` to rounding, and several times faster: for headings of some turns at most."""
    turned = heading - (2 * np.pi) * np.rint(heading * (0.5 / np.pi))
    return np.where(np.abs(turned) >= np.pi, -np.pi, turned)


# ---- private ------------------------------------------------------------------------------------


def _shares(lead: Shape, weights: Any, axis: int) -> np.ndarray:
    """Weights that sum to one along an axis."""
    if weights is None:
        return np.full(lead, 1.0 / lead[axis])
    weights = as_float(weights)
    if weights.shape == (lead[axis],):
        weights = weights.reshape([-1 if k == axis else 1 for k in range(len(lead))])
    elif weights.shape != lead:
        raise ShapeError(
            f"mean_pose: weights have shape {weights.shape}; give ({lead[axis]},), one for each "
            f"entry along axis {axis}, or {lead}"
        )
    total = weights.sum(axis=axis, keepdims=True)
    if not ((weights >= 0).all() and np.isfinite(total).all() and (total > 0).all()):
        raise ParameterError(
            "mean_pose: weights must be nonnegative and finite, and some positive; of log weights "
            "give np.exp(log_weights - log_weights.max())"
        )
    return weights / total
