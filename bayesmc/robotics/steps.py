"""Where a robot in the plane gets to in one step, without noise: the means of motion models.

A step is a plain function of arrays: around ``euler_step`` or ``unicycle`` a net puts ``PoseNormal``, and
filters with Gaussian beliefs differentiate them. Models with noise of their own are in ``motion``.
Poses are as in ``poses``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bayesmc.distributions.base import as_float
from bayesmc.expression import is_traced
from bayesmc.robotics.poses import as_poses, joined_pose, sin_cos, turned_back

#: of ``sin(a) / a`` in powers of the square, highest first and without the first; to rounding up to a = 0.5
_SERIES = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(6, 0, -1))


def euler_step(pose: Any, v: Any, omega: Any, dt: Any, heading_zero: str = "x") -> np.ndarray:
    """A step straight ahead along the old heading, then a turn: the mean of the lecture notes' motion model.

    Parameters
    ----------
    pose : array_like, shape (..., 3)
    v : array_like, shape (...)
        Forward velocity, m/s.
    omega : array_like, shape (...)
        Rate at which the heading grows, rad/s.
    dt : array_like, shape (...)
        Duration in s.
    heading_zero : "x" or "y"
        The axis along which heading 0 points. ``"x"`` is this package's convention, with headings
        counterclockwise: ``(x + v cos(h) dt, y + v sin(h) dt, h + omega dt)``. ``"y"`` is the
        notes': ``(x + v sin(h) dt, y + v cos(h) dt, h + omega dt)``, with headings clockwise as on
        a compass.

    Returns
    -------
    ndarray, shape (..., 3)

    Raises
    ------
    ShapeError
        ``pose`` has not three components.
    ValueError
        ``heading_zero`` is another word.

    Notes
    -----
    The notes print the second component as ``y + v * theta(h) dt``, a misprint of ``cos``: the
    first component is ``x + v sin(h) dt``, and the step must have length ``v dt``. So with h = 0
    the robot drives along +y, and with h = pi / 2 along +x. ``poses.compass`` turns headings of one
    convention into the other (``omega`` changes its sign), and sensors that read headings expect
    this package's: the notes' own bearing, ``atan2(dy, dx) - h``, does.

    References
    ----------
    Dellaert, Monte Carlo Inference (lecture notes), section 2.1.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.steps import euler_step
    >>> euler_step([0.0, 0.0, 0.0], 2.0, 0.5, 1.0).tolist()
    [2.0, 0.0, 0.5]
    >>> euler_step([0.0, 0.0, 0.0], 2.0, 0.5, 1.0, heading_zero="y").tolist()
    [0.0, 2.0, 0.5]
    """
    if heading_zero not in ("x", "y"):
        raise ValueError(
            f'euler_step(heading_zero={heading_zero!r}): give "x" (counterclockwise) or "y" (as on a compass)'
        )
    pose = as_poses("euler_step", pose)
    v, omega, dt = as_float(v), as_float(omega), as_float(dt)
    sine, cosine = sin_cos(pose[..., 2])
    if heading_zero == "y":
        sine, cosine = cosine, sine
    step = v * dt
    return joined_pose(
        pose[..., 0] + step * cosine,
        pose[..., 1] + step * sine,
        turned_back(pose[..., 2] + omega * dt),
    )


def unicycle(pose: Any, v: Any, omega: Any, dt: Any) -> np.ndarray:
    """Where an arc of constant velocities ends: exact, and smooth where the turn goes to zero.

    Parameters
    ----------
    pose : array_like, shape (..., 3)
    v : array_like, shape (...)
        Forward velocity, m/s; negative backwards.
    omega : array_like, shape (...)
        Angular velocity, rad/s, counterclockwise.
    dt : array_like, shape (...)
        Duration in s.

    Returns
    -------
    ndarray, shape (..., 3)

    Notes
    -----
    An arc of length s that turns by 2 a has a chord of length ``s sin(a) / a`` in the direction
    ``heading + a``. Unlike the usual ``v / omega (sin(h + omega dt) - sin(h))`` nothing cancels or
    is divided by zero when a is small.

    References
    ----------
    Thrun, Burgard and Fox (2005), Probabilistic Robotics, equation 5.9.

    Examples
    --------
    Half of a circle of radius one, and a straight line:

    >>> import numpy as np
    >>> from bayesmc.robotics.steps import unicycle
    >>> unicycle([0.0, 0.0, 0.0], np.pi, np.pi, 1.0).round(3).tolist()
    [0.0, 2.0, -3.142]
    >>> unicycle([0.0, 0.0, 0.0], 1.0, 0.0, 2.0).tolist()
    [2.0, 0.0, 0.0]
    """
    pose = as_poses("unicycle", pose)
    v, omega, dt = as_float(v), as_float(omega), as_float(dt)
    half = 0.5 * omega * dt
    chord = v * dt * sinc(half)
    sine, cosine = sin_cos(pose[..., 2] + half)
    x, y = pose[..., 0] + chord * cosine, pose[..., 1] + chord * sine
    return joined_pose(x, y, turned_back(pose[..., 2] + 2 * half))


def sinc(a: np.ndarray) -> np.ndarray:
    """``sin(a) / a``; by its series where all angles are small, which is several times faster."""
    if is_traced(a) or not np.size(a) or max(np.max(a), -np.min(a)) > 0.5:
        return np.sinc(a / np.pi)
    square = a * a
    value = square * _SERIES[0]
    for coefficient in _SERIES[1:]:
        value += coefficient
        value *= square
    value += 1.0
    return value
