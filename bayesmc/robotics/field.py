"""The likelihood field: how well the end points of a laser scan fall on obstacles.

The log density of an end point is looked up by the cell it falls into, so that a scan costs one
pass of gathers however many obstacles there are. Rays are not followed: a wall between robot and
end point counts for nothing (``beams`` on cast rays counts it), and the density is not normalised
over ranges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.base import as_float
from bayesmc.distributions.support import Support, nonnegative, product
from bayesmc.errors import ModelError, ParameterError, ShapeError
from bayesmc.robotics.end_points import BLOCK, EndPointTable
from bayesmc.robotics.grid import OccupancyGrid, as_grid, as_number
from bayesmc.robotics.laser import check_metres
from bayesmc.robotics.poses import check_radians
from bayesmc.shapes import Shape, broadcast_shapes


@dataclass(frozen=True, eq=False)
class LikelihoodField:
    """The end points of a scan as a density given the pose, by the distance to the nearest obstacle.

    The density of one range is ``z_hit * N(d; 0, sigma) + z_rand / max_range``, where d is the
    distance of its end point from the nearest obstacle; a scan's is the product over its beams, to
    the power ``tempering``.

    Parameters
    ----------
    grid : OccupancyGrid
        Its ``threshold`` decides what is an obstacle; unknown cells are none.
    sigma : float
        Standard deviation (m) of an end point about its obstacle.
    z_hit, z_rand : float
        Shares of beams that hit an obstacle of the map and that end anywhere; at most 1 together.
        The rest are no returns.
    max_range : float
        Range (m) from which on a reading is no return.
    mount : (float, float, float)
        Pose of the laser in the robot's frame (m, m, rad).
    tempering : float
        Exponent of the density of a scan: beams are less independent than the product makes them.
        Positive; 1 leaves it as it is.

    Raises
    ------
    ParameterError
        A parameter is out of range, or the mount's heading beyond a full turn (in degrees, most likely).
    TypeError
        ``grid`` is no OccupancyGrid.

    Notes
    -----
    - No returns (at or beyond ``max_range``, negative, not finite) are left out: their factor is 1.
      Evidence of a net is finite, so put scans through ``clean_ranges`` before they become a net's rows.
    - An end point beyond the map has the density ``z_rand / max_range``; of a robot beyond the map,
      all have. Where all of several poses are farther off the map
      than it is wide, and than the longest beam reaches, that is an error.
    - Tables and sums are single precision: a log density is right to about 1e-5 per beam, and an
      end point within 0.001 cells of a border may count for the cell next to it.
    - The density is not normalised over ranges (Thrun et al., section 6.4); evidence computed with
      it compares maps or parameters with each other only roughly.

    References
    ----------
    Thrun, Burgard and Fox, Probabilistic Robotics, 2005, table 6.3.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.field import LikelihoodField
    >>> from bayesmc.robotics.grid import OccupancyGrid
    >>> room = OccupancyGrid(np.pad(np.zeros((40, 20)), 1, constant_values=1.0), 0.1)
    >>> field = LikelihoodField(room, sigma=0.2, max_range=10.0)
    >>> particles = np.array([[1.05, 1.05, 0.0], [2.05, 1.05, 0.0]])
    >>> scan = field.given(particles, np.deg2rad([-90.0, 0.0, 90.0]))
    >>> scan.log_prob([1.0, 3.1, 1.0]).round(2).tolist()  # as the first one would see it
    [1.32, -3.08]
    """

    grid: OccupancyGrid
    sigma: float = 0.2
    z_hit: float = 0.8
    z_rand: float = 0.2
    max_range: float = 80.0
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tempering: float = 1.0

    def __post_init__(self) -> None:
        as_grid("LikelihoodField", self.grid)
        for name in ("sigma", "max_range", "tempering"):
            ok = 0 < as_number(getattr(self, name)) < math.inf
            _require(ok, self, name, "positive and finite")
        for name in ("z_hit", "z_rand"):
            _require(0 <= as_number(getattr(self, name)) <= 1, self, name, "between 0 and 1")
        total = self.z_hit + self.z_rand
        _require(0 < total <= 1 + 1e-9, self, "z_rand", "such that 0 < z_hit + z_rand <= 1")
        mount = [as_number(part) for part in self.mount] if np.ndim(self.mount) == 1 else []
        _require(
            len(mount) == 3 and np.isfinite(mount).all(), self, "mount", "three finite numbers"
        )
        check_radians("LikelihoodField", "headings of a mount", np.array(mount[2:]))

    def given(self, pose: Any, angles: Any) -> FieldScan:
        """The scan of a laser with beams at ``angles``, from ``pose``.

        Parameters
        ----------
        pose : array_like, shape (..., 3)
            Of the robot: x, y (m) and heading (rad).
        angles : array_like, shape (beams,)
            Of the beams against the laser's heading (rad).

        Returns
        -------
        FieldScan
            ``batch_shape`` is that of the poses, ``event_shape`` is ``(beams,)``.

        Raises
        ------
        ParameterError, ShapeError
            As ``FieldScan``.
        """
        return FieldScan(self, pose, angles)

    def by_beam(self, pose: Any, angles: Any, ranges: Any) -> np.ndarray:
        """Log density (tempered) of each range of scans, each from its own pose.

        Parameters
        ----------
        pose : array_like, shape (scans, 3)
        angles : array_like, shape (beams,)
        ranges : array_like, shape (scans, beams)
            Whatever they are; no returns are not left out here.

        Returns
        -------
        ndarray, shape (scans, beams)
        """
        ranges = as_float(ranges)
        found = self._table.along(as_float(pose), as_float(angles), ranges[..., None])
        return np.asarray(found[..., 0], dtype=float)

    @property
    def log_random(self) -> float:
        """Log density (tempered) of an end point that no obstacle explains."""
        if not self.z_rand:
            return -math.inf
        return self.tempering * math.log(self.z_rand / self.max_range)

    def log_density(self) -> np.ndarray:
        """Log density (tempered) of an end point in each cell of the map, shape (nx, ny)."""
        scaled = self.grid.distances / self.sigma
        with np.errstate(divide="ignore", over="ignore"):
            density = self.z_hit * np.exp(-0.5 * scaled**2) / (math.sqrt(2 * math.pi) * self.sigma)
            return self.tempering * np.log(density + self.z_rand / self.max_range)

    @cached_property
    def _table(self) -> EndPointTable:
        """What end points are looked up in; laid out once."""
        return EndPointTable(
            self.grid, self.log_density(), self.log_random, self.mount, self.max_range
        )

    def __repr__(self) -> str:
        return f"LikelihoodField({self.grid!r}, sigma={self.sigma:g}, max_range={self.max_range:g})"


class FieldScan(Distribution):
    """Ranges (m) of a laser's beams from a pose, by a likelihood field: see ``LikelihoodField.given``.

    Draws come from the density of each beam normalised along its ray up to ``max_range`` (in steps
    of half a cell), without the tempering exponent and without no returns.

    Parameters
    ----------
    field : LikelihoodField
    pose : array_like, shape (..., 3)
    angles : array_like, shape (beams,)

    Raises
    ------
    ParameterError
        A pose or an angle is not finite, or an angle beyond a full turn (in degrees, most likely).
    ShapeError
        Poses do not have three components, angles more than one axis, or there is no beam.
    ModelError
        From ``log_prob``: several poses are all farther off the map than it is wide, or a scan's readings are
        all beyond the longest range, and no code for no return.
    """

    parameter_ndim = {"pose": 1, "angles": 1}

    def __init__(self, field: LikelihoodField, pose: Any, angles: Any) -> None:
        pose, angles = as_float(pose), as_float(angles)
        if pose.shape[-1:] != (3,):
            raise ShapeError(
                f"FieldScan: poses have shape {pose.shape}; give (..., 3): x, y, heading"
            )
        if angles.ndim != 1 or not angles.size:
            raise ShapeError(
                f"FieldScan: angles have shape {angles.shape}; give (beams,), one beam or more"
            )
        self.field, self.pose, self.angles = field, pose, angles
        self.batch_shape, self.event_shape = pose.shape[:-1], angles.shape
        if not math.isfinite(np.add.reduce(pose, axis=None)):  # cheaper than every element
            self.pose = self._check("pose", pose, np.isfinite(pose).all(axis=-1), 0.0, "finite")
        check_radians("FieldScan", "angles", angles)

    @property
    def support(self) -> Support:
        return product([(nonnegative, self.event_shape[0])])

    @property
    def tempering(self) -> float:
        """Exponent of the density: so much of an independent number is each beam taken for."""
        return self.field.tempering

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        if x.shape[-1:] != self.event_shape:
            raise ShapeError(f"ranges have shape {x.shape}, not (..., {self.event_shape[0]})")
        if x.ndim == 1:
            return self._of_scan(x, self.pose)
        lead = broadcast_shapes(x.shape[:-1], self.batch_shape)
        pose = np.broadcast_to(self.pose, (*lead, 3))
        own = x.shape[:-1]
        log = np.empty(lead)
        if math.prod(own) * 16 <= math.prod(lead):  # a few scans, such as one per robot of a plate
            x = x.reshape((1,) * (len(lead) - len(own)) + x.shape)
            for index in np.ndindex(*x.shape[:-1]):
                at = tuple(
                    slice(None) if n == 1 else i for i, n in zip(index, x.shape[:-1], strict=True)
                )
                log[at] = self._of_scan(x[index], pose[at])
            return log
        scans = np.broadcast_to(x, (*lead, x.shape[-1])).reshape(-1, x.shape[-1])
        return self._of_pairs(scans, pose.reshape(-1, 3)).reshape(lead)

    def _of_scan(self, ranges: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Log densities of one scan from poses, shape ``pose.shape[:-1]``: the hot path."""
        used = (ranges >= 0) & (ranges < self.field.max_range)
        if not used.any():
            check_metres("LikelihoodField", ranges, self.field.max_range)
            return np.zeros(pose.shape[:-1])
        if not used.all():
            ranges, angles = ranges[used], self.angles[used]
        else:
            angles = self.angles
        table = self.field._table
        rows, outside = table.place(pose.reshape(-1, 3))
        if outside is not None and outside.size > 1 and outside.all():
            self._check_in_sight(pose, float(ranges.max()))
        log = table.scores(ranges, angles, rows, outside)
        return log.reshape(pose.shape[:-1])

    def _check_in_sight(self, pose: np.ndarray, longest: float) -> None:
        """Refuse poses that are all farther from the map than it is wide: such a start is a mistake.

        A belief that was carried off the map by its wheels, or a part of it, goes on, and may come back.
        """
        left, right, bottom, top = self.field.grid.extent
        x, y = pose[..., 0], pose[..., 1]
        away = np.maximum(np.maximum(left - x, x - right), np.maximum(bottom - y, y - top)).min()
        reach = longest + math.hypot(*self.field.mount[:2])
        if away > max(reach, math.hypot(right - left, top - bottom)):
            raise ModelError(
                f"LikelihoodField: all of {x.size} poses are {away:.3g} m or more off the map, which spans x "
                f"{left:g} to {right:g} and y {bottom:g} to {top:g} m; no beam reaches that far: is the "
                "start given in the map's frame and in metres?"
            )

    def _of_pairs(self, scans: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Log densities of scans ``(n, beams)``, each from its own pose ``(n, 3)``."""
        table, log = self.field._table, np.empty(len(scans))
        step = max(1, BLOCK // max(scans.shape[1], 1))
        for start in range(0, len(scans), step):
            part = slice(start, start + step)
            used = (scans[part] >= 0) & (scans[part] < self.field.max_range)
            ranges = np.where(used, scans[part], 0.0)
            density = table.along(pose[part], self.angles, ranges[..., None])[..., 0]
            log[part] = np.where(used, density, 0.0).sum(axis=-1)
        return log

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        field, beams = self.field, len(self.angles)
        pose = np.broadcast_to(self.pose, (*shape, 3)).reshape(-1, 3)
        count = math.ceil(2 * field.max_range / field.grid.resolution)
        width = field.max_range / count
        middles = (np.arange(count) + 0.5) * width
        draws = np.empty((len(pose), beams))
        step = max(1, (1 << 20) // max(beams * count, 1))
        for start in range(0, len(pose), step):
            log = field._table.along(pose[start : start + step], self.angles, middles)
            density = np.exp(log / field.tempering, dtype=float)
            density = np.where(density.sum(axis=-1, keepdims=True) > 0, density, 1.0)
            sums = density.cumsum(axis=-1)
            level = rng.random(sums.shape[:-1]) * sums[..., -1]
            chosen = (sums <= level[..., None]).sum(axis=-1)
            draws[start : start + step] = (chosen + rng.random(chosen.shape)) * width
        return draws.reshape(*shape, beams)


# ---- private ------------------------------------------------------------------------------------


def _require(ok: Any, field: LikelihoodField, name: str, requirement: str) -> None:
    if not ok:
        raise ParameterError(
            f"LikelihoodField: {name} must be {requirement}; got {getattr(field, name)!r}"
        )
