"""The likelihood field of maps that grow: how well the end points of a scan fall on what each particle
has mapped.

As ``field`` does on a given map, with a map for each pose. What the maps say is what was put into them
before; the scan that is weighed is not among it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.support import Support, real_vector
from bayesmc.errors import ParameterError, UnsupportedError
from bayesmc.robotics.grid import as_number
from bayesmc.robotics.grid_map import NEAR, as_maps
from bayesmc.robotics.laser import Laser, as_scans
from bayesmc.robotics.map_windows import MOST, MapWindows, around
from bayesmc.robotics.poses import as_poses
from bayesmc.shapes import Shape, broadcast_shapes


@dataclass(frozen=True)
class MapField:
    """A scan as a density given the pose and a map that grows, by the distance of end points from obstacles.

    The density of one range is ``z_hit * N(d; 0, sigma) + z_rand / max_range``, where d is the
    distance of its end point's cell from the nearest obstacle of the map (farther than 10 cells counts
    as infinitely far); a scan's is the product over its returns, to the power ``tempering``.

    Parameters
    ----------
    laser : Laser
    sigma : float
        Standard deviation (m) of an end point about its obstacle.
    z_hit, z_rand : float
        Shares of beams that end at an obstacle of the map and that end anywhere; at most 1 together.
    tempering : float
        Exponent of the density of a scan: beams are less independent than the product makes them.
        Positive; 1 leaves it as it is.

    Raises
    ------
    ParameterError
        A parameter is out of range.
    TypeError
        ``laser`` is no Laser.

    Notes
    -----
    No returns are left out: their factor is 1, and that of a scan without a return is 1 whatever the
    pose. The density is not normalised over ranges (Thrun et al., section 6.4).

    References
    ----------
    Thrun, Burgard and Fox (2005), Probabilistic Robotics, table 6.3 and section 9.2.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics import GridMap, Laser, MapField, ScanMapper
    >>> laser = Laser([0.0, np.pi / 2])
    >>> seen = ScanMapper(laser).updated(GridMap(0.05), [0.0, 0.0, 0.0], [2.02, 1.02])
    >>> scan = MapField(laser).given([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]], seen)
    >>> bool(np.diff(scan.log_prob([2.02, 1.02]))[0] < 0.0)  # from the second pose the wall is not there
    True
    """

    laser: Laser
    sigma: float = 0.06
    z_hit: float = 0.9
    z_rand: float = 0.1
    tempering: float = 0.3

    def __post_init__(self) -> None:
        if not isinstance(self.laser, Laser):
            raise TypeError(
                f"MapField: give a Laser, such as Laser(angles); got {self.laser!r:.80}"
            )
        for name in ("sigma", "tempering"):
            _require(
                0 < as_number(getattr(self, name)) < math.inf, self, name, "positive and finite"
            )
        for name in ("z_hit", "z_rand"):
            _require(0 < as_number(getattr(self, name)) <= 1, self, name, "above 0 and at most 1")
        total = self.z_hit + self.z_rand
        _require(total <= 1 + 1e-9, self, "z_rand", "such that z_hit + z_rand <= 1")

    def given(self, pose: Any, maps: Any) -> MapScan:
        """The scan that is seen from poses, each in its map.

        Parameters
        ----------
        pose : array_like, shape (..., 3)
            Of the robot: m, m, rad.
        maps : GridMap or array of GridMap, shape (...)
            They broadcast with the poses.

        Returns
        -------
        MapScan
            ``event_shape`` is ``(beams,)``.

        Raises
        ------
        TypeError, ParameterError, ShapeError
            No maps, poses of another shape.
        """
        return MapScan(self, pose, maps)

    def table(self, resolution: float, sigma: float | None = None) -> np.ndarray:
        """Log density (tempered) of a range by the squared distance of its end in cells, (256,)."""
        sigma = self.sigma if sigma is None else sigma
        square = np.arange(256) * resolution**2
        peak = self.z_hit / (math.sqrt(2 * math.pi) * sigma)
        near = np.where(np.arange(256) <= NEAR, peak * np.exp(-0.5 * square / sigma**2), 0.0)
        return np.asarray(self.tempering * np.log(near + self.z_rand / self.laser.max_range))


class MapScan(Distribution):
    """Ranges (m) of a laser's beams from poses in maps of their own: see ``MapField.given``.

    It has no draws: a scan of a place that nobody has mapped cannot be said.
    """

    parameter_ndim = {"pose": 1}

    def __init__(self, field: MapField, pose: Any, maps: Any) -> None:
        pose, maps = as_poses("MapScan", pose), as_maps("MapScan", maps)
        self.field, self.maps = field, maps
        self.batch_shape = broadcast_shapes(pose.shape[:-1], maps.shape)
        self.event_shape = field.laser.angles.shape
        self.pose = pose
        if not math.isfinite(np.add.reduce(pose, axis=None)):
            self.pose = self._check("pose", pose, np.isfinite(pose).all(axis=-1), 0.0, "finite")

    @property
    def support(self) -> Support:
        return real_vector

    @property
    def tempering(self) -> float:
        """Exponent of the density: so much of an independent number is each beam taken for."""
        return self.field.tempering

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        x = as_scans("MapScan", self.field.laser, x)
        lead = broadcast_shapes(x.shape[:-1], self.batch_shape)
        poses = np.broadcast_to(self.pose, (*lead, 3)).reshape(-1, 1, 3)
        maps = np.broadcast_to(self.maps, lead).reshape(-1)
        if x.size == x.shape[-1]:
            return self._of_scan(x.reshape(-1), maps, poses).reshape(lead)
        each = np.broadcast_to(x, (*lead, x.shape[-1])).reshape(len(maps), -1)
        found = [
            self._of_scan(row, maps[k : k + 1], poses[k : k + 1]) for k, row in enumerate(each)
        ]
        return np.reshape(found, lead)

    def _of_scan(self, ranges: np.ndarray, maps: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Log densities of one scan, each from a pose (maps, 1, 3) in its own map, shape (maps,)."""
        ends = self.field.laser.ends(ranges)
        found = np.zeros(len(maps))
        if not len(ends) or not len(maps):
            return found
        size: float = maps[0].resolution
        table = self.field.table(size)
        low, high = around(poses, ends, size)
        for part in parts_of(low, high, size):
            windows = MapWindows(maps[part], low[part], high[part])
            found[part] = windows.sums(poses[part], ends, table)[:, 0]
        return found

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        raise UnsupportedError(
            "MapScan: a scan cannot be drawn from a map that grows: what is not on it yet nobody knows; "
            "leave slices "
            "without a scan out and compose their motion with that of the next"
        )


def parts_of(low: np.ndarray, high: np.ndarray, resolution: float) -> list[slice]:
    """Maps whose windows are laid out together, so that they take 32 MiB or one map."""
    cells = np.prod((high - low).max(axis=0) / resolution + 128)
    step = max(1, int(MOST // cells))
    return [slice(k, k + step) for k in range(0, len(low), step)]


# ---- private ------------------------------------------------------------------------------------


def _require(ok: Any, field: MapField, name: str, requirement: str) -> None:
    if not ok:
        raise ParameterError(
            f"MapField: {name} must be {requirement}; got {getattr(field, name)!r}"
        )
