"""How a robot in the plane moves: conditional densities of its next pose, given the last and a control.

Two models, each with draws and an exact density: a robot that drives an arc with noise on its two
velocities (``VelocityMotion``), and one whose odometry is trusted up to noise on a rotation, a
translation and a rotation (``OdometryMotion``). The third way is Gaussian noise about any step:
``PoseNormal`` about one of ``steps``.

Poses are as in ``poses``: m, m, rad, heading 0 along +x and counterclockwise. Everything broadcasts
over leading axes, so a parent's particles and plates come through as they are. Estimating the noise
is left to whoever declares ``alphas`` as a node.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.distributions import WrappedNormal
from bayesmc.distributions.base import as_float
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.robotics.pose_distributions import PoseDistribution
from bayesmc.robotics.poses import (
    as_poses,
    check_turns,
    compose,
    joined_pose,
    sin_cos,
    turned_back,
    wrap,
)
from bayesmc.robotics.steps import sinc
from bayesmc.shapes import Shape

#: metres below which the density of a displacement, which may have a pole at none, is taken as constant
_LEAST = 1e-9
_LOG_2PI = float(np.log(2 * np.pi))
#: nodes for moments over the noise of a turn: to rounding while that has a deviation of a radian or less
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(21)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


class VelocityMotion(PoseDistribution):
    """The next pose of a robot that is told two velocities, drives an arc, and turns a little at its end.

    The velocities driven are ``v + N(0, a1 v^2 + a2 omega^2)`` and ``omega + N(0, a3 v^2 + a4
    omega^2)``, held for ``dt``; then the robot turns on the spot by ``dt N(0, a5 v^2 + a6
    omega^2)``.

    Parameters
    ----------
    pose_prev : array_like, shape (..., 3)
        m, m, rad.
    v, omega : array_like, shape (...)
        Commanded velocities in m/s and rad/s (counterclockwise).
    dt : array_like, shape (...)
        Duration in s, nonnegative.
    alphas : array_like, shape (..., 6)
        a1 to a6, nonnegative: variances per squared velocity.
    floor : array_like, number or shape (3,)
        Positive standard deviations in m, rad and rad that the length of the arc, its turn and the
        last turn have at least (added in squares), also where the robot stands still, so that there
        is always a density.

    Raises
    ------
    ParameterError
        A number is not finite, ``dt`` or one of the ``alphas`` negative, ``floor`` not positive.
    ShapeError
        The last axes are not 3 and 6.

    Notes
    -----
    The density is exact. The displacement ``(c, b)`` in polar coordinates of the old pose is
    reached by every arc of turn ``2 (b + k pi)``, k whole: ahead, backing up, and with full turns.
    For each the length follows, the rest of the heading is the last turn (mod 2 pi, whichever k),
    and the change of variables from (length, turn, last turn) to (x, y, heading) has the Jacobian
    ``c |sin(a) / a| / 2`` with a half the turn. The terms are summed over all k that the noise can
    reach. Table 5.1 of the book takes the arc ahead alone and leaves the Jacobian out.

    The Jacobian is zero where nothing is displaced, and the density has a pole there that
    integrates; within a nanometre it is taken as constant. Noise is held for a step, so ``alphas``
    belong to a duration: steps of half of it have half the variance in sum. ``mean`` and ``cov``
    are moments under the noise, by Gauss-Hermite quadrature.

    References
    ----------
    Thrun, Burgard and Fox (2005), Probabilistic Robotics, tables 5.1 and 5.3.

    Examples
    --------
    >>> from bayesmc.robotics.motion import VelocityMotion
    >>> moved = VelocityMotion([0.0, 0.0, 0.0], 1.0, 0.5, 0.5, alphas=[0.01, 0, 0.04, 0, 0.01, 0])
    >>> moved.sample(rng=0, sample_shape=4).shape, moved.mean.round(3).tolist()
    ((4, 3), [0.494, 0.062, 0.25])
    """

    parameter_ndim = {"pose_prev": 1, "v": 0, "omega": 0, "dt": 0, "alphas": 1, "floor": 1}

    def __init__(
        self, pose_prev: Any, v: Any, omega: Any, dt: Any, alphas: Any, floor: Any = 1e-4
    ) -> None:
        pose = as_poses("VelocityMotion", pose_prev)
        v, omega, dt = as_float(v), as_float(omega), as_float(dt)
        alphas, floor = _noise("VelocityMotion", alphas, 6, floor)
        self._set_batch(pose.shape[:-1], v.shape, omega.shape, dt.shape, alphas.shape[:-1])
        self.pose_prev = self._finite_pose("pose_prev", pose)
        self.v, self.omega = self._finite("v", v), self._finite("omega", omega)
        fine = (dt >= 0) & (dt < np.inf)
        self.dt = self._check("dt", dt, fine, 1.0, "nonnegative and finite")
        self.alphas, self.floor = _checked_noise(self, alphas, floor)
        self.length, self.turn = self.v * self.dt, self.omega * self.dt
        squares = self.length**2, self.turn**2
        #: standard deviations of the arc's length, its turn and the last turn
        self.scales = tuple(_root_of(self.alphas, 2 * k, squares, self.floor[k]) for k in range(3))

    @property
    def mean(self) -> np.ndarray:
        """Mean, the heading's in ``[-pi, pi)``."""
        at, _ = self._displacements()
        shift = self.length[..., None] * (_WEIGHTS[:, None] * at).sum(axis=-2)
        ahead = joined_pose(shift[..., 0], shift[..., 1], self.turn)
        return np.broadcast_to(compose(self.pose_prev, ahead), (*self.batch_shape, 3))

    @property
    def cov_root(self) -> np.ndarray:
        at, turns = self._displacements()
        share = np.sqrt(_WEIGHTS)[:, None]
        off = self.length[..., None, None] * (at - (_WEIGHTS[:, None] * at).sum(-2, keepdims=True))
        by_turn = _columns(share * off, share[:, 0] * turns)
        by_length = _columns(share * self.scales[0][..., None, None] * at, 0.0)
        last = _columns(np.zeros(2), self.scales[2])[..., None, :]
        batch = np.broadcast_shapes(*(a.shape[:-2] for a in (by_turn, by_length, last)))
        rows = [np.broadcast_to(a, batch + a.shape[-2:]) for a in (by_turn, by_length, last)]
        upper = np.linalg.qr(np.concatenate(rows, axis=-2), mode="r")
        return _turned_root(self.pose_prev[..., 2], np.matrix_transpose(upper), self.batch_shape)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        noise = rng.standard_normal((3, *shape))
        for k, scale in enumerate(self.scales):
            noise[k] *= scale
        length, turn, last = noise
        length += self.length
        turn += self.turn
        last += turn
        last += self.pose_prev[..., 2]
        turn *= 0.5  # in place from here on: new arrays cost more than what is done with them
        length *= sinc(turn)
        turn += self.pose_prev[..., 2]
        return _gone(self.pose_prev, length, turn, last)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        distance, direction, turned = _polar(self.pose_prev, x, 0.5 * self.turn)
        length, turn, last = self.scales
        value = WrappedNormal(0.0, last).log_prob(turned - 2 * direction)
        value = value + np.log(2.0) - _LOG_2PI - np.log(length) - np.log(turn) - np.log(distance)
        # the chord may point back: then it has a sign, and its direction lies within a quarter turn
        quarters = np.rint(direction / np.pi)
        chord = distance * (1.0 - 2.0 * np.remainder(quarters, 2.0))
        direction = direction - np.pi * quarters
        sine = np.sin(direction)
        nearest = np.rint((0.5 * self.turn - direction) / np.pi)
        reach = 1 + int(np.ceil(8 * turn.max(initial=0.0) / (2 * np.pi)))
        total: Any = -np.inf
        for k in range(-reach, reach + 1):
            half = direction + np.pi * (nearest + k)
            total = np.logaddexp(total, self._log_arc(chord, half, sine))
        return value + total

    def _log_arc(self, chord: np.ndarray, half: np.ndarray, sine: np.ndarray) -> np.ndarray:
        """Log density of an arc that turns by twice ``half``, up to what all arcs share."""
        stretch = np.where(half == 0, 1.0, half / sine)  # of the arc beside its chord
        length = (chord * stretch - self.length) / self.scales[0]
        turn = (2 * half - self.turn) / self.scales[1]
        value = np.log(np.abs(stretch)) - 0.5 * (length * length + turn * turn)
        return np.where(np.isinf(stretch), -np.inf, value)  # full turns lead nowhere

    def _displacements(self) -> tuple[np.ndarray, np.ndarray]:
        """Displacement per length in the old frame, (..., nodes, 2), at nodes of the turn; and the
        nodes, (..., nodes), as differences from the expected turn.
        """
        off = self.scales[1][..., None] * _NODES
        half = 0.5 * (self.turn[..., None] + off)
        sine, cosine = sin_cos(half)
        return sinc(half)[..., None] * np.stack([cosine, sine], axis=-1), off


class OdometryMotion(PoseDistribution):
    """The next pose of a robot whose odometry saw a rotation, a translation and a rotation, each with noise.

    Parameters
    ----------
    pose_prev : array_like, shape (..., 3)
        m, m, rad.
    motion : array_like, shape (..., 3)
        What odometry says of the step: the new pose seen from the old one, ``between(odom_prev, odom)``.
    alphas : array_like, shape (..., 4)
        Nonnegative: variances are ``a1 rot^2 + a2 trans^2`` of each rotation and
        ``a3 trans^2 + a4 (rot1^2 + rot2^2)`` of the translation.
    floor : array_like, number or shape (3,)
        Positive standard deviations in rad, m and rad of the first rotation, the translation and
        the last rotation at least (added in squares), so that there is a density also where
        odometry saw nothing.
    least : float
        Metres of translation below which its direction is noise: the whole turn counts as the last rotation.

    Raises
    ------
    ParameterError
        A number is not finite, one of the ``alphas`` negative, ``floor`` not positive or ``least`` negative;
        ``motion`` turns by more than a full turn (in degrees, most likely).
    ShapeError
        The last axes are not 3, 3 and 4.

    Notes
    -----
    A robot that backs up is not one that turns by pi twice: the first rotation is taken within a
    quarter turn and the translation then has a sign, as AMCL does for the noise. What is drawn
    always has the odometry's translation and turn as its centre; ``least`` changes the sizes of the
    noise alone.

    The density is exact: in polar coordinates ``(c, b)`` of the old pose the translation is c in
    direction b or -c in the opposite one, the rotations are known up to full turns, and the
    Jacobian is ``1 / c``. It has a pole that integrates where nothing is displaced; within a
    nanometre it is taken as constant. ``mean`` and ``cov`` are exact, too.

    References
    ----------
    Thrun, Burgard and Fox (2005), Probabilistic Robotics, tables 5.5 and 5.6. For backing up and
    ``least``: the differential model of ROS AMCL (``amcl_odom.cpp``).

    Examples
    --------
    >>> from bayesmc.robotics.motion import OdometryMotion
    >>> from bayesmc.robotics.poses import between
    >>> seen = between([5.0, 5.0, 0.1], [5.5, 5.05, 0.1])
    >>> moved = OdometryMotion([0.0, 0.0, 0.0], seen, alphas=[0.05, 0.01, 0.01, 0.01])
    >>> moved.mean.round(3).tolist(), float(moved.log_prob([0.5, 0.0, 0.0]).round(3))
    ([0.502, -0.0, 0.0], 6.907)
    """

    parameter_ndim = {"pose_prev": 1, "motion": 1, "alphas": 1, "floor": 1}

    def __init__(
        self, pose_prev: Any, motion: Any, alphas: Any, floor: Any = 1e-4, least: float = 0.01
    ) -> None:
        pose, motion = as_poses("OdometryMotion", pose_prev), as_poses("OdometryMotion", motion)
        if not 0 <= least < np.inf:
            raise ParameterError(
                f"OdometryMotion(least={least!r}): give metres, nonnegative and finite"
            )
        check_turns("OdometryMotion", "motion", motion)
        alphas, floor = _noise("OdometryMotion", alphas, 4, floor)
        self._set_batch(pose.shape[:-1], motion.shape[:-1], alphas.shape[:-1])
        self.pose_prev = self._finite_pose("pose_prev", pose)
        self.motion = self._finite_pose("motion", motion)
        self.alphas, self.floor = _checked_noise(self, alphas, floor)
        self.rotation, self.translation, self.turn = _folded(self.motion)
        self.scales = self._scales(float(least))

    def _scales(self, least: float) -> tuple[np.ndarray, ...]:
        """Standard deviations of the first rotation, the translation and the last rotation."""
        clear = np.abs(self.translation) >= least
        first = _number(np.where(clear, self.rotation, 0.0))
        last = _number(wrap(self.turn - first))
        turned, distance = first * first, self.translation * self.translation
        after, alphas, floor = last * last, self.alphas, self.floor
        return (
            _root_of(alphas, 0, (turned, distance), floor[0]),
            _root_of(alphas, 2, (distance, turned + after), floor[1]),
            _root_of(alphas, 0, (after, distance), floor[2]),
        )

    @property
    def mean(self) -> np.ndarray:
        """Mean, the heading's in ``[-pi, pi)``."""
        shift = self.translation * np.exp(-0.5 * self.scales[0] ** 2)
        sine, cosine = sin_cos(self.rotation)
        ahead = joined_pose(shift * cosine, shift * sine, self.turn)
        return np.broadcast_to(compose(self.pose_prev, ahead), (*self.batch_shape, 3))

    @property
    def cov_root(self) -> np.ndarray:
        # along the chord, across it, and the heading: only the last two are correlated
        first, last = self.scales[0] ** 2, self.scales[2] ** 2
        square, noise = self.translation**2, self.scales[1] ** 2
        shrunk, heading = np.exp(-first), first + last
        along = 0.5 * noise * (1 + shrunk**2) + 0.5 * square * np.expm1(-first) ** 2
        bulge = np.sinh(first)  # the variance across is shrunk * (square + noise) * sinh(first)
        alone = shrunk * (square * (bulge - first * first / heading) + noise * bulge)
        common = self.translation * first * np.sqrt(shrunk / heading)
        shape = np.broadcast_shapes(along.shape, alone.shape)
        root = np.zeros((*shape, 3, 3))
        root[..., 0, 0], root[..., 1, 1] = np.sqrt(along), np.sqrt(np.maximum(alone, 0.0))
        root[..., 1, 2], root[..., 2, 2] = common, np.sqrt(heading)
        return _turned_root(self.pose_prev[..., 2] + self.rotation, root, self.batch_shape)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        noise = rng.standard_normal((3, *shape))
        for k, scale in enumerate(self.scales):
            noise[k] *= scale
        rotation, translation, last = noise
        translation += self.translation
        heading = self.pose_prev[..., 2]
        last += rotation
        last += heading + self.turn
        rotation += heading + self.rotation
        return _gone(self.pose_prev, translation, rotation, last)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        distance, direction, turned = _polar(self.pose_prev, x, self.rotation)
        first, middle, last = self.scales
        total: Any = -np.inf
        for sign, start in ((1.0, direction), (-1.0, direction + np.pi)):
            z = (sign * distance - self.translation) / middle
            rotation = start - self.rotation
            value = WrappedNormal(0.0, first).log_prob(rotation)
            value = value + WrappedNormal(0.0, last).log_prob(turned - self.turn - rotation)
            total = np.logaddexp(total, value - 0.5 * z * z)
        return total - 0.5 * _LOG_2PI - np.log(middle) - np.log(distance)


# ---- private ------------------------------------------------------------------------------------


def _gone(pose: np.ndarray, distance: Any, direction: Any, heading: Any) -> np.ndarray:
    """Poses at a distance in a direction of the world, with new headings."""
    sine, cosine = sin_cos(direction)
    sine *= distance
    cosine *= distance
    cosine += pose[..., 0]
    sine += pose[..., 1]
    return joined_pose(cosine, sine, turned_back(heading))


def _polar(
    pose: np.ndarray, x: np.ndarray, expected: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance and direction of a pose seen from another, and the turn.

    No displacement has no direction; there it is the ``expected`` one.
    """
    x = as_poses("log_prob", x)
    dx, dy = x[..., 0] - pose[..., 0], x[..., 1] - pose[..., 1]
    distance = np.hypot(dx, dy)
    direction = np.where(distance < _LEAST, expected, np.arctan2(dy, dx) - pose[..., 2])
    return np.maximum(distance, _LEAST), wrap(direction), x[..., 2] - pose[..., 2]


def _folded(motion: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First rotation within a quarter turn, translation with its sign, and the whole turn."""
    dx, dy, turn = (_number(motion[..., k]) for k in range(3))
    back = _number(np.where(dx < 0, -1.0, 1.0))
    return np.arctan2(back * dy, back * dx), back * np.hypot(dx, dy), _number(wrap(turn))


def _noise(call: str, alphas: Any, count: int, floor: Any) -> tuple[np.ndarray, np.ndarray]:
    alphas, floor = as_float(alphas), as_float(floor)
    if not alphas.ndim or alphas.shape[-1] != count:
        raise ShapeError(
            f"{call}: alphas has shape {alphas.shape}; give {count} numbers on the last axis"
        )
    if floor.shape not in ((), (1,), (3,)):
        raise ShapeError(f"{call}: floor has shape {floor.shape}; give one number or three")
    return alphas, np.broadcast_to(floor, (3,))


def _checked_noise(
    dist: Any, alphas: np.ndarray, floor: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    if not (floor.min() > 0 and floor.max() < np.inf):
        raise ParameterError(
            f"{type(dist).__name__}: floor must be positive and finite; got {floor.tolist()}"
        )
    if alphas.size and alphas.min() >= 0 and alphas.max() < np.inf:
        return alphas, floor
    fine = ((alphas >= 0) & (alphas < np.inf)).all(axis=-1)
    return dist._check("alphas", alphas, fine, 0.0, "nonnegative and finite"), floor


def _root_of(alphas: np.ndarray, at: int, squares: tuple[Any, Any], floor: Any) -> np.ndarray:
    """Standard deviation: the root of ``a[at] squares[0] + a[at + 1] squares[1]`` and the floor's square."""
    one, other = _number(alphas[..., at]), _number(alphas[..., at + 1])
    return np.sqrt(one * squares[0] + other * squares[1] + floor * floor)


def _number(value: np.ndarray) -> Any:
    """The number that an array without axes holds, whose arithmetic is several times faster."""
    return value[()]


def _columns(position: Any, heading: Any) -> np.ndarray:
    """Deviations of position, (..., 2), and of heading, (...), side by side."""
    return joined_pose(position[..., 0], position[..., 1], heading)


def _turned_root(heading: np.ndarray, root: np.ndarray, batch: Shape) -> np.ndarray:
    """A root of a covariance in a frame of that heading, in the world's."""
    sine, cosine = (a[..., None] for a in sin_cos(heading))
    turned = np.empty((*batch, 3, 3))
    turned[..., 0, :] = cosine * root[..., 0, :] - sine * root[..., 1, :]
    turned[..., 1, :] = sine * root[..., 0, :] + cosine * root[..., 1, :]
    turned[..., 2, :] = root[..., 2, :]
    return turned
