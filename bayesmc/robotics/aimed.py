"""Poses where a sensor says the robot could be: what to draw from at the start, and once it is lost.

Particles that are spread evenly need to be many, since few of them fall where the first reading allows. A
histogram of how well each bin of poses explains that reading puts them there (the dual of Monte Carlo
localization). It is a proposal: the filter divides by its density, so it may be coarse; it is not the belief.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.support import Support
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.robotics.free_space import FreeSpace
from bayesmc.robotics.grid import as_number
from bayesmc.robotics.pose_distributions import POSES
from bayesmc.shapes import Shape, read_only

#: readings whose histogram is kept: the blocks of a cloud ask for the same one, one after the other
_KEPT = 2


@dataclass(frozen=True, eq=False)
class SensorPoses:
    """Densities over poses, one for each reading of a sensor.

    Free space is cut into squares and the circle of headings into equal parts. Each bin gets the density of
    the reading at its middle as its weight; inside a bin poses are spread evenly.

    Parameters
    ----------
    space : FreeSpace
        Where the robot can be.
    sensor : callable
        ``poses -> distribution`` of one reading, for poses of shape (bins, 3). Bins are coarse, so a sensor
        that is coarser than the model's finds more: a wider ``sigma``, fewer beams, a smaller ``tempering``.
    spacing : float
        Side (m) of the squares.
    headings : int
        Parts of the circle.
    even : float
        Probability that a pose is drawn from ``space`` instead, whatever the reading says: above 0, at most
        1. Without it, poses in bins of no weight could never be drawn, and no weight would make up for that.

    Raises
    ------
    ParameterError
        A spacing that is not positive, no heading, a probability that is 0 or outside 0..1.
    TypeError
        ``space`` is no FreeSpace, or ``sensor`` cannot be called.

    References
    ----------
    Thrun, Fox, Burgard and Dellaert (2001), Robust Monte Carlo localization for mobile robots, Artificial
    Intelligence 128, section 4 (the dual's proposal); Lenser and Veloso (2000), Sensor resetting
    localization for poorly modelled mobile robots.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics import FreeSpace, LikelihoodField, OccupancyGrid, SensorPoses
    >>> room = OccupancyGrid(np.pad(np.zeros((40, 20)), 1, constant_values=1.0), 0.1)
    >>> field, angles = LikelihoodField(room, sigma=0.3, max_range=10.0), np.deg2rad([-90.0, 0.0, 90.0])
    >>> aimed = SensorPoses(FreeSpace(room), lambda pose: field.given(pose, angles), 0.25, 24)
    >>> poses = aimed.given([1.0, 3.1, 1.0]).sample(rng=0, sample_shape=1000)  # as seen from (1, 1, 0)
    >>> near = np.abs(poses[:, 0] - 1.05) < 0.5
    >>> bool(near.mean() > 0.2)  # the same from the other side; a twentieth of them evenly spread
    True
    """

    space: FreeSpace
    sensor: Callable[[np.ndarray], Distribution]
    spacing: float = 0.5
    headings: int = 36
    even: float = 0.05
    _kept: OrderedDict[tuple[Shape, bytes], AimedPoses] = field(
        default_factory=OrderedDict, init=False, repr=False
    )

    def __post_init__(self) -> None:
        if not isinstance(self.space, FreeSpace):
            raise TypeError(
                f"SensorPoses: space must be a FreeSpace, such as FreeSpace(grid); got {self.space!r:.80}"
            )
        if not callable(self.sensor):
            raise TypeError(
                "SensorPoses: sensor must be a function of poses that returns a distribution, such as "
                f"lambda pose: field.given(pose, angles); got {self.sensor!r:.80}"
            )
        if not 0 < as_number(self.spacing) < math.inf:
            raise ParameterError(
                f"SensorPoses: spacing must be positive and finite; got {self.spacing!r:.80}"
            )
        whole = isinstance(self.headings, (int, np.integer)) and not isinstance(self.headings, bool)
        if not whole or self.headings < 1:
            raise ParameterError(f"SensorPoses: headings must be 1 or more; got {self.headings!r}")
        if not 0 < as_number(self.even) <= 1:
            raise ParameterError(
                "SensorPoses: even must be above 0 (a proposal that leaves poses out gives wrong weights) "
                f"and at most 1; got {self.even!r:.80}"
            )

    @property
    def poses(self) -> np.ndarray:
        """The middle of each bin: of the free cells of its square, and of its headings, (bins, 3)."""
        return self._bins.poses

    def given(self, reading: Any) -> AimedPoses:
        """The poses that explain one reading.

        Parameters
        ----------
        reading : array_like
            One reading, of the shape that ``sensor`` says.

        Raises
        ------
        ShapeError
            The sensor has not one density for each pose, or there are several readings at once.
        """
        reading = np.asarray(reading, dtype=float)
        key = reading.shape, reading.tobytes()
        found = self._kept.get(key)
        if found is None:
            found = self._kept[key] = AimedPoses(self, self._weighed(reading))
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return found

    def _weighed(self, reading: np.ndarray) -> np.ndarray:
        """Log weights of the bins."""
        dist, count = self.sensor(self.poses), len(self.poses)
        if dist.batch_shape != (count,):
            raise ShapeError(
                f"SensorPoses: the sensor's densities at {count} poses have batch shape {dist.batch_shape}; "
                "return one for each pose"
            )
        if reading.shape != dist.event_shape:
            raise ShapeError(
                f"SensorPoses: the reading has shape {reading.shape}, and the sensor's are of shape "
                f"{dist.event_shape}; give one reading at a time"
            )
        log = dist.log_prob(reading)
        return np.where(np.isnan(log), -np.inf, log)

    @cached_property
    def _bins(self) -> _Bins:
        return _Bins(self.space, self.spacing, self.headings)


class AimedPoses(Distribution):
    """Poses (x, y, heading) by a histogram over bins, mixed with even ones: see ``SensorPoses.given``.

    Attributes
    ----------
    probabilities : ndarray, shape (bins,)
        Of the bins whose middles are ``SensorPoses.poses``, without the even share.
    """

    event_shape = (3,)

    def __init__(self, aim: SensorPoses, log_weights: np.ndarray) -> None:
        self.aim, self._even = aim, float(aim.even)
        weights = np.exp(log_weights - max(log_weights.max(), -1e300))
        total = weights.sum()
        if not total > 0:  # the reading is possible nowhere, and says nothing
            self._even, weights, total = 1.0, np.ones(len(weights)), float(len(weights))
        self.probabilities = read_only(weights / total)
        self._sums = weights.cumsum()

    @property
    def support(self) -> Support:
        return POSES

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        poses = self.aim.space._sample(rng, shape)
        aimed = rng.random(shape) >= self._even
        chosen = np.searchsorted(self._sums, rng.random(aimed.sum()) * self._sums[-1], "right")
        poses[aimed] = self.aim._bins.sample(np.minimum(chosen, len(self._sums) - 1), rng)
        return poses

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        if x.shape[-1:] != (3,):
            raise ShapeError(f"AimedPoses.log_prob: values have shape {x.shape}, not (..., 3)")
        bins = self.aim._bins
        at = bins.of(x)
        inside = np.where(at >= 0, self.probabilities[at] / bins.volume[at], 0.0)
        evenly = np.exp(self.aim.space._log_prob(x))
        with np.errstate(divide="ignore"):
            return np.log((1 - self._even) * inside + self._even * evenly)


# ---- private ------------------------------------------------------------------------------------


class _Bins:
    """Squares of free cells times parts of the circle; a bin's number counts headings fastest."""

    def __init__(self, space: FreeSpace, spacing: float, headings: int) -> None:
        self.space, self.headings = space, headings
        points = space.centers
        square = np.floor((points - space.grid.origin) / spacing)
        _, self._own = np.unique(square, axis=0, return_inverse=True)
        self._own = self._own.reshape(-1)
        self._count = np.bincount(self._own)
        self._by_square = np.argsort(self._own, kind="stable")
        self._first = self._count.cumsum() - self._count
        middle = [np.bincount(self._own, points[:, axis]) / self._count for axis in (0, 1)]
        self.poses = read_only(self._with_headings(np.stack(middle, axis=-1)))
        volume = self._count * space.grid.resolution**2 * 2 * np.pi / headings
        self.volume = volume.repeat(headings)

    def of(self, poses: np.ndarray) -> np.ndarray:
        """The bin of each pose; -1 outside free space and where a number is not finite."""
        cell = self.space.cell_of(poses)
        inside = cell >= 0
        part = (np.where(inside, poses[..., 2], 0.0) + np.pi) % (2 * np.pi)
        part = np.minimum((part * (self.headings / (2 * np.pi))).astype(np.intp), self.headings - 1)
        return np.where(inside, self._own[cell] * self.headings + part, -1)

    def sample(self, bins: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """A pose spread evenly over each bin."""
        square, part = np.divmod(bins, self.headings)
        found, count = rng.random((len(bins), 3)), self._count[square]
        cell = self._by_square[self._first[square] + rng.integers(count)]
        found[:, :2] -= 0.5
        found[:, :2] *= self.space.grid.resolution
        found[:, :2] += self.space.centers[cell]
        found[:, 2] = (found[:, 2] + part) * (2 * np.pi / self.headings) - np.pi
        return found

    def _with_headings(self, points: np.ndarray) -> np.ndarray:
        turns = (np.arange(self.headings) + 0.5) * (2 * np.pi / self.headings) - np.pi
        found = np.empty((len(points), self.headings, 3))
        found[..., :2] = points[:, None]
        found[..., 2] = turns
        return found.reshape(-1, 3)
