"""Free space: a pose anywhere on the map where there is no obstacle."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.support import Support
from bayesmc.errors import ModelError, ParameterError, ShapeError
from bayesmc.expression import as_one_call
from bayesmc.robotics.grid import OccupancyGrid, as_grid, as_number
from bayesmc.robotics.pose_distributions import POSES
from bayesmc.shapes import Shape, read_only

_LOG_TURN = math.log(2 * math.pi)


class FreeSpace(Distribution):
    """Poses ``(x, y, heading)`` spread evenly over the free space of a map: global localisation starts here.

    Positions are uniform over free cells, headings over the circle (rad, of period 2 pi).

    Parameters
    ----------
    grid : OccupancyGrid
    clearance : float
        Only cells whose centre is at least this far (m) from the nearest obstacle's.
    threshold : float, optional
        Only cells with an occupancy below this; by default the grid's, below which nothing is an obstacle.
        Maps that shade what was hardly seen want a lower one here, such as 0.2.

    Attributes
    ----------
    area : float
        Of the space in square metres.

    Raises
    ------
    ModelError
        The map has no such cell.
    ParameterError
        ``clearance`` is negative or not finite, ``threshold`` not in (0, 1].
    TypeError
        ``grid`` is no OccupancyGrid.

    Notes
    -----
    Its support is that of every distribution of poses, so that it mixes with motion models (a robot that may
    have been carried away); beyond free space the density is zero.

    References
    ----------
    Thrun, Burgard and Fox, Probabilistic Robotics, 2005, section 8.3 (initialisation).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics import FreeSpace, OccupancyGrid
    >>> start = FreeSpace(OccupancyGrid([[0.0, 0.0], [1.0, 1.0]], 0.5))
    >>> start.sample(rng=1, sample_shape=3).shape, start.area
    ((3, 3), 0.5)
    >>> start.log_prob([[0.2, 0.9, 2.0], [0.7, 0.9, 2.0]]).round(4).tolist()  # -log(0.5 * 2 pi)
    [-1.1447, -inf]
    """

    event_shape = (3,)

    def __init__(
        self, grid: OccupancyGrid, clearance: float = 0.0, threshold: float | None = None
    ) -> None:
        grid = as_grid("FreeSpace", grid)
        level = grid.threshold if threshold is None else threshold
        if not 0 < as_number(level) <= 1:
            raise ParameterError(f"FreeSpace: threshold must be in (0, 1]; got {threshold!r:.80}")
        if not 0 <= as_number(clearance) < math.inf:
            raise ParameterError(
                f"FreeSpace: clearance must be nonnegative and finite; got {clearance!r:.80}"
            )
        inside = grid.free(level)
        if clearance:
            inside &= grid.distances >= clearance
        if not inside.any():
            wanted = f" at least {clearance} m from an obstacle" if clearance else ""
            raise ModelError(
                f"FreeSpace: no cell of {grid!r} is free{wanted} (known, with an occupancy below "
                f"{level:g}); is the map inverted, or all of it unknown?"
            )
        self.grid, self.clearance = grid, float(clearance)
        self._inside = inside
        self._cells = np.flatnonzero(inside)
        self.area = len(self._cells) * grid.resolution**2

    @cached_property
    def centers(self) -> np.ndarray:
        """World coordinates (m) of the middles of its cells, shape (cells, 2)."""
        cells = np.stack(np.divmod(self._cells, self.grid.shape[1]), axis=-1)
        return read_only(self.grid.center_of(cells))

    @as_one_call
    def cell_of(self, poses: Any) -> np.ndarray:
        """Which of its cells (their number in ``centers``) poses lie in, shape (...): -1 for none."""
        poses = np.asarray(poses, dtype=float)
        if poses.shape[-1:] != (3,):
            raise ShapeError(f"FreeSpace: poses have shape {poses.shape}; give (..., 3)")
        grid, (nx, ny) = self.grid, self.grid.shape
        with np.errstate(
            invalid="ignore"
        ):  # one axis after the other: in every filter's inner loop
            x = (poses[..., 0] - grid.origin[0]) * (1 / grid.resolution)
            y = (poses[..., 1] - grid.origin[1]) * (1 / grid.resolution)
            within = (x >= 0) & (x < nx) & (y >= 0) & (y < ny) & np.isfinite(poses[..., 2])
            if not within.all():
                x, y = np.where(within, x, nx), np.where(within, y, ny)
            return self._lookup[x.astype(np.intp), y.astype(np.intp)]

    @cached_property
    def _lookup(self) -> np.ndarray:
        """Numbers of the cells, -1 for others; a last row and column stand for what is beyond the map."""
        found = np.pad(np.full(self.grid.shape, -1, dtype=np.intp), (0, 1), constant_values=-1)
        found[:-1, :-1][self._inside] = np.arange(len(self._cells))
        return found

    @property
    def support(self) -> Support:
        return POSES

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        cells = self._cells[rng.integers(len(self._cells), size=shape)]
        poses = rng.random((*shape, 3))
        ix, iy = np.divmod(cells, self.grid.shape[1])
        for axis, index in enumerate((ix, iy)):
            poses[..., axis] += index
            poses[..., axis] *= self.grid.resolution
            poses[..., axis] += self.grid.origin[axis]
        poses[..., 2] *= 2 * np.pi
        poses[..., 2] -= np.pi
        return poses

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        if x.shape[-1:] != (3,):
            raise ShapeError(f"FreeSpace.log_prob: values have shape {x.shape}, not (..., 3)")
        return np.where(self.cell_of(x) >= 0, -math.log(self.area) - _LOG_TURN, -np.inf)
