"""Where a scan fits a map: a Gaussian about the best pose near the one that odometry expects, as a proposal.

Poses are laid around what the motion says, in three passes: a lattice that is wide enough for its noise,
scored with fewer beams, and a finer one laid out along the axes of what the first leaves. The moments
of what they find are those of the proposal. All particles go through both at once, each in its own map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.errors import ParameterError
from bayesmc.robotics.grid import as_number
from bayesmc.robotics.grid_map import as_maps
from bayesmc.robotics.laser import as_scans
from bayesmc.robotics.map_field import MapField, parts_of
from bayesmc.robotics.map_windows import MapWindows, around
from bayesmc.robotics.pose_distributions import PoseNormal
from bayesmc.shapes import broadcast_shapes

#: deviations of the motion's noise that are searched to either side
_REACH = 3.0
#: deviations of what the first pass leaves that the second covers, and points along each axis
_SPAN, _POINTS = 2.5, 5
#: points of the lattice to either side, at most: of each coordinate, and of the heading
_SHIFTS, _TURNS = 4, 10
_EYE = np.eye(3)


@dataclass(frozen=True)
class ScanMatcher:
    """A proposal for poses that looks at the scan: p(scan | pose, map) p(pose | motion), as a Gaussian
    about its mode.

    Parameters
    ----------
    field : MapField
        The model's own, or one that is coarser.
    reach : float
        Metres of position that are searched to either side at most.
    turn : float
        The same of the heading, in rad.
    beams : int
        Returns that the first pass looks at, at most.
    widening : float
        Factor on the covariance, 1 or more: a proposal that is narrower than what it stands for leaves
        poses out, and weights then rest on few particles.

    Raises
    ------
    ParameterError
        A parameter is out of range.
    TypeError
        ``field`` is no MapField.

    References
    ----------
    Grisetti, Stachniss and Burgard (2007), Improved techniques for grid mapping with Rao-Blackwellized
    particle filters, IEEE Transactions on Robotics 23, equations 15 and 16; Olson (2009), Real-time
    correlative scan matching, ICRA.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics import GridMap, Laser, MapField, PoseNormal, ScanMapper, ScanMatcher
    >>> laser = Laser(np.linspace(-3.0, 3.0, 90))
    >>> room = 2.0 / np.maximum(np.abs(np.cos(laser.angles)), np.abs(np.sin(laser.angles)))
    >>> seen = ScanMapper(laser).updated(GridMap(0.05), [0.0, 0.0, 0.0], room)  # a square, from its middle
    >>> wheels = PoseNormal([0.15, 0.1, 0.05], scale_diag=[0.1, 0.1, 0.05])
    >>> found = ScanMatcher(MapField(laser)).given(wheels, seen, room)  # it is seen from the middle again
    >>> bool(np.hypot(*found.mean[:2]) < 0.03)
    True
    """

    field: MapField
    reach: float = 0.6
    turn: float = 0.5
    beams: int = 60
    widening: float = 1.2

    def __post_init__(self) -> None:
        if not isinstance(self.field, MapField):
            raise TypeError(
                f"ScanMatcher: give a MapField, such as MapField(Laser(angles)); got {self.field!r:.80}"
            )
        for name, least in (("reach", 0.0), ("turn", 0.0), ("beams", 2.0), ("widening", 0.999)):
            if not least < as_number(getattr(self, name)) < math.inf:
                raise ParameterError(
                    f"ScanMatcher: {name} must be above {least:g} and finite; got {getattr(self, name)!r:.80}"
                )

    def given(self, motion: Any, maps: Any, ranges: Any) -> PoseNormal:
        """Where the robot is, by where its motion has it and what it sees.

        Parameters
        ----------
        motion : Distribution
            Of the pose, with ``mean`` and ``cov``: an OdometryMotion, a VelocityMotion, a PoseNormal.
        maps : GridMap or array of GridMap, shape (...)
        ranges : array_like, shape (..., beams)

        Returns
        -------
        PoseNormal
            ``batch_shape`` is what the three broadcast to. Without a return, or where nothing near is
            mapped, it has the moments of the motion, a little wider.

        Raises
        ------
        TypeError, ShapeError, ParameterError
            No distribution of poses, no maps, as many ranges as there are not beams.
        """
        if not isinstance(motion, Distribution) or motion.event_shape != (3,):
            raise TypeError(
                "ScanMatcher: give a distribution of poses for where the robot went, such as "
                f"OdometryMotion(pose_prev, motion, alphas); got {motion!r:.80}"
            )
        maps = as_maps("ScanMatcher", maps)
        scans = as_scans("ScanMatcher", self.field.laser, ranges)
        lead = broadcast_shapes(motion.batch_shape, maps.shape, scans.shape[:-1])
        mean = np.broadcast_to(motion.mean, (*lead, 3)).reshape(-1, 3)
        cov = np.broadcast_to(motion.cov, (*lead, 3, 3)).reshape(-1, 3, 3)  # type: ignore[attr-defined]
        flat = np.broadcast_to(maps, lead).reshape(-1)
        each = np.broadcast_to(scans, (*lead, scans.shape[-1])).reshape(len(flat), -1)
        found = _Moments(np.array(mean), np.array(cov))
        same = scans.size == scans.shape[-1]
        for part in [slice(0, len(flat))] if same else [slice(k, k + 1) for k in range(len(flat))]:
            self._matched(found, part, flat, each[part.start] if len(flat) else scans.reshape(-1))
        cov = self.widening * found.cov
        return PoseNormal(found.mean.reshape(*lead, 3), cov.reshape(*lead, 3, 3))

    # ---- private -------------------------------------------------------------------------------

    def _matched(self, found: _Moments, which: slice, maps: np.ndarray, ranges: np.ndarray) -> None:
        """Put the moments given one scan in the place of those given the motion alone."""
        ends = self.field.laser.ends(ranges)
        mean, cov, maps = found.mean[which], found.cov[which], maps[which]
        if not len(ends) or not len(maps):
            return
        size: float = maps[0].resolution
        deviations = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
        limits = np.array([self.reach, self.reach, self.turn])
        wide = np.minimum(_REACH * deviations.max(axis=0), limits)
        low, high = around(mean[:, None], ends, size)
        swung = wide[:2].max() + wide[2] * float(np.hypot(*ends.T).max())
        low, high = low - swung, high + swung
        for part in parts_of(low, high, size):
            windows = MapWindows(maps[part], low[part], high[part])
            prior = _Moments(mean[part], cov[part])
            first = self._lattice(windows, prior, ends, wide)
            some = ends[:: max(1, math.ceil(len(ends) / self.beams))]
            second = self._along(windows, prior, some, len(ends) / len(some), first)
            mean[part], cov[part] = self._along(windows, prior, ends, 1.0, second)

    def _lattice(
        self, windows: MapWindows, prior: _Moments, ends: np.ndarray, wide: np.ndarray
    ) -> _Moments:
        """Moments over a lattice of poses about where the motion ends."""
        size = windows.resolution
        some = ends[:: max(1, math.ceil(len(ends) / self.beams))]
        share = len(ends) / len(some)
        far = float(np.sort(np.hypot(*some.T))[len(some) * 3 // 4])
        turns = _axis(wide[2], size / max(far, size), _TURNS)
        shift = _axis(wide[0], size, _SHIFTS), _axis(wide[1], size, _SHIFTS)
        apart = max(shift[0][1] - shift[0][0], shift[1][1] - shift[1][0])
        blurred = math.hypot(self.field.sigma, 0.5 * apart)
        table = (share * self.field.table(size, blurred)).astype(np.float32)
        poses = np.repeat(prior.mean[:, None], len(turns), axis=1)
        poses[..., 2] += turns
        x, y = windows.cells(poses, some)
        log = np.empty((*poses.shape[:2], len(shift[0]), len(shift[1])))
        at, squares = np.empty(x.shape, dtype=np.intp), np.empty(x.shape, dtype=np.uint8)
        values = np.empty(x.shape, dtype=np.float32)
        columns = [windows.columns(y + np.float32(dy / size)) for dy in shift[1]]
        for a, dx in enumerate(shift[0]):
            row = windows.rows(x + np.float32(dx / size))
            for b, column in enumerate(columns):
                np.add(row, column, out=at)
                np.take(windows.flat, at, out=squares, mode="clip")  # they lie within
                np.take(table, squares, out=values, mode="clip")
                np.add.reduce(values, axis=-1, out=log[:, :, a, b])
        grid = np.meshgrid(turns, *shift, indexing="ij")
        off = np.stack([grid[1], grid[2], grid[0]], axis=-1).reshape(-1, 3)
        log = log.reshape(len(log), -1) + _normal_log(off, prior.cov)
        step = np.array([shift[0][1] - shift[0][0], shift[1][1] - shift[1][0], turns[1] - turns[0]])
        found = _moments(np.broadcast_to(off, (len(log), *off.shape)), log)
        return _Moments(prior.mean + found.mean, found.cov + np.diag(step**2 / 12))

    def _along(
        self,
        windows: MapWindows,
        prior: _Moments,
        ends: np.ndarray,
        share: float,
        first: _Moments,
    ) -> _Moments:
        """Moments over poses along the axes of what the pass before leaves."""
        table = share * self.field.table(windows.resolution)
        line = np.linspace(-_SPAN, _SPAN, _POINTS)
        points = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
        root = np.linalg.cholesky(first.cov)
        poses = first.mean[:, None] + np.matvec(root[:, None], points)
        log = windows.sums(poses, ends, table)
        log += _normal_log(poses - prior.mean[:, None], prior.cov)
        found = _moments(poses, log)
        least = np.matmul(root, np.matrix_transpose(root)) * (line[1] - line[0]) ** 2 / 12
        return _Moments(found.mean, found.cov + least)


# ---- private ------------------------------------------------------------------------------------


class _Moments(NamedTuple):
    """Means (maps, 3) and covariances (maps, 3, 3) of poses."""

    mean: np.ndarray
    cov: np.ndarray


def _axis(wide: float, step: float, most: int) -> np.ndarray:
    """Points to either side of 0, at least one and at most so many, and so far apart where that is enough."""
    count = min(max(1, math.ceil(wide / step)), most)
    return np.linspace(-wide, wide, 2 * count + 1)


def _normal_log(off: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Log densities, up to a constant, of deviations (..., points, 3), shape (maps, points)."""
    precision = np.linalg.inv(cov)
    return np.asarray(-0.5 * ((off @ precision) * off).sum(axis=-1))


def _moments(values: np.ndarray, log: np.ndarray) -> _Moments:
    """Weighted means and covariances over the second axis."""
    weights = np.exp(log - log.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    mean = np.vecmat(weights, values)
    off = values - mean[:, None]
    return _Moments(mean, np.matrix_transpose(off * weights[..., None]) @ off)
