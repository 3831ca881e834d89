"""Distributions of poses, and of numbers beside an angle.

``PoseDistribution`` is what all distributions of poses share, those of ``motion`` included; ``PoseNormal``
adds Gaussian noise to a pose, ``AndAngle`` sets an angle beside an independent part. Poses are as in
``poses``: m, m, rad, the heading's period 2 pi. How a robot moves or senses is not known here.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.distributions import Distribution, Joint, MvNormal, WrappedNormal
from bayesmc.distributions.adapt import as_distribution
from bayesmc.distributions.circular import wrap_angle
from bayesmc.distributions.support import Support, circle, product, real_vector
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.robotics.poses import joined_pose, turned_back
from bayesmc.shapes import Shape

#: two numbers and an angle
POSES: Support = product([(real_vector, 2), (circle, 0)])


class PoseDistribution(Distribution):
    """Base of distributions of poses: two numbers and an angle.

    Attributes
    ----------
    cov_root : ndarray, shape (..., 3, 3)
        A root of the covariance, ``cov_root @ cov_root.T``, of (x, y, heading's deviation from its
        mean). It is what filters with Gaussian beliefs need beside ``mean``, and may be singular.
    """

    event_shape: Shape = (3,)

    @property
    def support(self) -> Support:
        return POSES

    @property
    def cov_root(self) -> np.ndarray:
        raise NotImplementedError

    @property
    def cov(self) -> np.ndarray:
        """Covariance, shape ``(*batch_shape, 3, 3)``."""
        root = self.cov_root
        return np.broadcast_to(root @ np.matrix_transpose(root), (*self.batch_shape, 3, 3))

    @property
    def var(self) -> np.ndarray:
        return np.linalg.diagonal(self.cov)

    def _finite_pose(self, name: str, pose: np.ndarray) -> np.ndarray:
        if np.isfinite(np.add.reduce(pose, axis=None)):  # cheaper than looking at every element
            return pose
        return self._check(name, pose, np.isfinite(pose).all(axis=-1), 0.0, "finite")


class PoseNormal(PoseDistribution):
    """Normal distribution of a pose: Gaussian noise is added, and the heading taken as an angle.

    Give exactly one of ``cov``, ``scale_tril`` and ``scale_diag``.

    Parameters
    ----------
    loc : array_like, shape (..., 3)
        x, y in m, heading in rad (any finite angle).
    cov : array_like, shape (..., 3, 3)
        Covariance of the noise in m and rad.
    scale_tril : array_like, shape (..., 3, 3)
        Its lower Cholesky factor.
    scale_diag : array_like, shape (..., 3)
        Standard deviations of independent components.

    Raises
    ------
    ParameterError, ShapeError
        As ``MvNormal``.

    Notes
    -----
    The density is the sum over all headings that differ by full turns: the normal density of the
    position times the wrapped normal density of the heading given the position, so no term of the
    sum is dropped.

    References
    ----------
    Mardia and Jupp (2000), Directional Statistics, section 3.5.7 (wrapping).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.pose_distributions import PoseNormal
    >>> pose = PoseNormal([0.0, 0.0, 3.1], scale_diag=[0.1, 0.1, 0.05])
    >>> pose.log_prob([[0.0, 0.0, 3.1], [0.0, 0.0, 3.1 - 2 * np.pi]]).round(4).tolist()
    [4.8441, 4.8441]
    """

    parameter_ndim = {"loc": 1, "cov": 2}

    def __init__(
        self, loc: Any, cov: Any = None, *, scale_tril: Any = None, scale_diag: Any = None
    ) -> None:
        self._flat = MvNormal(loc, cov, scale_tril=scale_tril, scale_diag=scale_diag)
        if self._flat.event_shape != (3,):
            raise ShapeError(f"PoseNormal: loc must have shape (..., 3); got {np.shape(loc)}")
        self._set_batch(self._flat.batch_shape)
        self._adopt(self._flat)
        self.loc = self._flat.loc

    @property
    def mean(self) -> np.ndarray:
        """Mean, the heading's in ``[-pi, pi)``."""
        loc = self.loc
        wrapped = joined_pose(loc[..., 0], loc[..., 1], wrap_angle(loc[..., 2]))
        return np.broadcast_to(wrapped, (*self.batch_shape, 3))

    @property
    def cov(self) -> np.ndarray:
        return np.broadcast_to(self._flat.cov, (*self.batch_shape, 3, 3))

    @property
    def cov_root(self) -> np.ndarray:
        return np.broadcast_to(self._flat.scale_tril, (*self.batch_shape, 3, 3))

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = self._flat.sample_to(rng, shape)
        draws[..., 2] = turned_back(draws[..., 2])
        return draws

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        root = self._flat.scale_tril
        off = x - self.loc
        first = off[..., 0] / root[..., 0, 0]
        second = (off[..., 1] - root[..., 1, 0] * first) / root[..., 1, 1]
        area = 2 * np.pi * root[..., 0, 0] * root[..., 1, 1]
        expected = root[..., 2, 0] * first + root[..., 2, 1] * second
        heading = WrappedNormal(0.0, root[..., 2, 2]).log_prob(off[..., 2] - expected)
        return -0.5 * (first * first + second * second) - np.log(area) + heading


class AndAngle(Joint):
    """A number or a vector, and an angle independent of it, side by side: the last component is the angle.

    It is a pose from a position and a heading, or a range and a bearing.

    Parameters
    ----------
    part : Distribution or frozen scipy.stats distribution
        Continuous, of numbers or vectors.
    angle : Distribution
        On the circle: ``VonMises``, ``WrappedNormal`` or a ``Mixture`` of such. Batch shapes broadcast.

    Raises
    ------
    ParameterError
        ``angle`` does not lie on the circle.
    UnsupportedError
        ``part`` is no part of a ``Joint``.

    References
    ----------
    Koller and Friedman, Probabilistic Graphical Models, 2009, section 2.1.4 (independence).

    Examples
    --------
    Somewhere in a room of 6 by 4 metres, in any direction:

    >>> from bayesmc.distributions import Joint, Uniform, VonMises
    >>> from bayesmc.robotics.pose_distributions import AndAngle
    >>> room = AndAngle(Joint(Uniform(0.0, 6.0), Uniform(0.0, 4.0)), VonMises(0.0, 0.0))
    >>> room.sample(rng=0, sample_shape=5).shape, float(room.log_prob([1.0, 1.0, 9.0]).round(4))
    ((5, 3), -5.0159)
    """

    parts_as_given = True

    def __init__(self, part: Any, angle: Any) -> None:
        super().__init__(part)
        last = as_distribution(angle)
        if last is None or last.event_shape or last.support.kind != "circle":
            raise ParameterError(
                "AndAngle: the second part must be an angle, such as WrappedNormal(0.0, 0.1); got "
                f"{angle!r:.80}"
            )
        self.parts = (*self.parts, last)
        self._sizes = (*self._sizes, 0)
        self.event_shape = (self.event_shape[0] + 1,)
        self._set_batch(*(p.batch_shape for p in self.parts))
        self._adopt(last)

    @property
    def cov_root(self) -> np.ndarray:
        """A root of the covariance, shape ``(*batch_shape, d, d)``; that of the angle is circular."""
        cov = np.asarray(self.cov)
        try:
            return np.linalg.cholesky(cov)
        except np.linalg.LinAlgError:
            raise ParameterError(
                "AndAngle: the parts' covariance is not positive definite"
            ) from None
