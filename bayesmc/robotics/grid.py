"""Occupancy grids: where a robot may be, and how far it is to the nearest obstacle.

A grid is a frozen value: occupancy probabilities of square cells in the world's frame, indexed
``[ix, iy]`` along x and y. Poses in free space are in ``free_space``; reading map
files is in ``mapfile``, looking along rays in ``raycast``; building a map from scans (mapping) is
not done here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions.parameters import as_number as as_number  # handed on to the room
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.expression import as_one_call
from bayesmc.shapes import first_index, read_only

#: a cell index that no map has, for points that are not finite
_NOWHERE = -(2**31)


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """Probabilities that square cells are occupied.

    Parameters
    ----------
    occupancy : array_like, shape (nx, ny)
        Probability that cell ``[ix, iy]`` is occupied, along x and y; NaN or -1 where unknown.
    resolution : float
        Side of a cell in metres.
    origin : (float, float)
        World coordinates (m) of the lower left *corner* of cell ``[0, 0]``, not of its centre.
    threshold : float
        Cells of at least this probability are obstacles, known cells below it are free; unknown
        ones are neither.

    Raises
    ------
    ShapeError
        ``occupancy`` does not have two axes, or has no cells.
    ParameterError
        Probabilities outside 0..1, a resolution that is not positive and finite, an origin that is
        not finite, a threshold outside (0, 1].

    References
    ----------
    Thrun, Burgard and Fox, Probabilistic Robotics, 2005, chapter 9.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.grid import OccupancyGrid
    >>> room = OccupancyGrid(np.pad(np.zeros((4, 2)), 1, constant_values=1.0), 0.5, origin=(-1.0, 0.0))
    >>> room.shape, room.extent, room.cell_of([0.2, 0.6]).tolist()
    ((6, 4), (-1.0, 2.0, 0.0, 2.0), [2, 1])
    >>> room.distances[2, 1], int(room.free().sum())  # metres between centres of cells
    (np.float64(0.5), 8)
    """

    occupancy: np.ndarray
    resolution: float
    origin: tuple[float, float] = (0.0, 0.0)
    threshold: float = 0.5

    def __post_init__(self) -> None:
        object.__setattr__(self, "occupancy", _probabilities(self.occupancy))
        for name, least in (("resolution", 0.0), ("threshold", 0.0)):
            object.__setattr__(self, name, _positive(name, getattr(self, name), least))
        if self.threshold > 1.0:
            raise ParameterError(
                f"OccupancyGrid: threshold must be at most 1; got {self.threshold}"
            )
        object.__setattr__(self, "origin", _point("origin", self.origin))

    @classmethod
    def from_counts(
        cls,
        hits: Any,
        passes: Any,
        resolution: float,
        origin: tuple[float, float] = (0.0, 0.0),
        *,
        prior: tuple[float, float] = (1.0, 1.0),
        threshold: float = 0.5,
    ) -> OccupancyGrid:
        """A grid from how often beams ended in each cell, and how often they passed through it.

        The probability is the posterior mean under a Beta prior (the counting model); a cell that
        no beam reached is unknown.

        Parameters
        ----------
        hits, passes : array_like of int, shape (nx, ny)
            Counts, nonnegative.
        resolution, origin, threshold
            As of the class.
        prior : (float, float)
            Positive counts to begin with, of hits and of passes.

        Raises
        ------
        ShapeError
            The two arrays differ in shape.
        ParameterError
            A count is negative or not finite.

        References
        ----------
        Hähnel, Mapping with Mobile Robots, 2004, section 2.3.2 (the counting model).

        Examples
        --------
        >>> from bayesmc.robotics.grid import OccupancyGrid
        >>> OccupancyGrid.from_counts([[3, 0, 0]], [[1, 2, 0]], 0.1).occupancy.round(3).tolist()
        [[0.667, 0.25, nan]]
        """
        hits, passes = _counts("hits", hits), _counts("passes", passes)
        if hits.shape != passes.shape:
            raise ShapeError(
                f"OccupancyGrid.from_counts: hits have shape {hits.shape}, passes {passes.shape}; "
                "give counts of the same cells"
            )
        more, less = (_positive("prior", part, 0.0) for part in prior)
        total = hits + passes
        value = np.where(total > 0, (hits + more) / (total + more + less), np.nan)
        return cls(value, resolution, origin, threshold)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells along x and along y."""
        nx, ny = self.occupancy.shape
        return nx, ny

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """``(left, right, bottom, top)`` in metres, for ``imshow(grid.occupancy.T, origin="lower")``."""
        (x, y), (nx, ny), size = self.origin, self.shape, self.resolution
        return x, x + nx * size, y, y + ny * size

    def occupied(self, threshold: float | None = None) -> np.ndarray:
        """Which cells are obstacles: at least ``threshold`` (by default the grid's own), shape (nx, ny)."""
        return self.occupancy >= (self.threshold if threshold is None else threshold)

    def free(self, threshold: float | None = None) -> np.ndarray:
        """Which cells are known and below ``threshold`` (by default the grid's own), shape (nx, ny)."""
        return self.occupancy < (self.threshold if threshold is None else threshold)

    def contains(self, points: Any) -> np.ndarray:
        """Whether points lie on the map.

        Parameters
        ----------
        points : array_like, shape (..., >= 2)
            World coordinates (m) in the first two components: positions or poses.

        Returns
        -------
        ndarray of bool, shape (...)
            False for points that are not finite.
        """
        return self._within(self.cell_of(points))

    @as_one_call
    def cell_of(self, points: Any) -> np.ndarray:
        """The cell of each point; beyond the map, an index below 0 or of ``shape`` and above.

        Parameters
        ----------
        points : array_like, shape (..., >= 2)
            World coordinates (m) in the first two components: positions or poses.

        Returns
        -------
        ndarray of int, shape (..., 2)
        """
        points = np.asarray(points, dtype=float)
        if points.ndim == 0 or points.shape[-1] < 2:
            raise ShapeError(
                f"OccupancyGrid: points have shape {points.shape}; give (..., 2) positions or (..., 3) poses"
            )
        with np.errstate(invalid="ignore", over="ignore"):
            cells = np.floor((points[..., :2] - self.origin) / self.resolution)
            return np.where(np.abs(cells) < -_NOWHERE, cells, _NOWHERE).astype(np.int64)

    def center_of(self, cells: Any) -> np.ndarray:
        """World coordinates (m) of the centres of cells, shape (..., 2)."""
        return (np.asarray(cells) + 0.5) * self.resolution + self.origin

    def at(self, points: Any) -> np.ndarray:
        """Occupancy at points, shape (...): NaN where unknown and beyond the map."""
        cells = self.cell_of(points)
        inside = self._within(cells)
        ix, iy = np.moveaxis(np.where(inside[..., None], cells, 0), -1, 0)
        return np.where(inside, self.occupancy[ix, iy], np.nan)

    @cached_property
    def distances(self) -> np.ndarray:
        """Exact Euclidean distance (m) from the centre of each cell to that of the nearest obstacle.

        Shape (nx, ny), computed once; infinite everywhere on a map without obstacles.

        References
        ----------
        Maurer, Qi and Raghavan (2003), A linear time algorithm for computing
        exact Euclidean distance transforms, IEEE PAMI 25(2): what
        ``scipy.ndimage.distance_transform_edt`` runs.
        """
        from scipy.ndimage import distance_transform_edt

        occupied = self.occupied()
        if not occupied.any():
            return read_only(np.full(self.shape, np.inf))
        return read_only(distance_transform_edt(~occupied) * self.resolution)

    @cached_property
    def empty_squares(self) -> np.ndarray:
        """How far rays may leap: sides (cells) of the largest empty squares that begin at each cell.

        Shape (4, nx + 1, ny + 1), computed once. Entry ``2 * left + down`` is for rays that go left
        or right, down or up, and is mirrored so that they go right and up. Obstacles have 0, and so
        do the last column and row, which stand for the space beyond the map.
        """
        return _empty_squares(self.occupied())

    def _within(self, cells: np.ndarray) -> np.ndarray:
        return np.asarray(((cells >= 0) & (cells < self.shape)).all(axis=-1))

    def __repr__(self) -> str:
        (nx, ny), size = self.shape, self.resolution
        return f"OccupancyGrid({nx} x {ny} cells of {size:g} m, origin={self.origin})"


def as_grid(call: str, grid: Any) -> OccupancyGrid:
    """The grid, or an error that names the call."""
    if not isinstance(grid, OccupancyGrid):
        found = (
            f"an array of shape {grid.shape}" if isinstance(grid, np.ndarray) else f"{grid!r:.80}"
        )
        raise TypeError(
            f"{call}: give an OccupancyGrid, such as OccupancyGrid(array, 0.05) or read_map(path); got "
            f"{found}"
        )
    return grid


# ---- private ------------------------------------------------------------------------------------


def _probabilities(value: Any) -> np.ndarray:
    """Occupancies as a private read-only array of floats, NaN where unknown."""
    array = np.array(value, dtype=float)
    if array.ndim != 2 or not array.size:
        raise ShapeError(
            f"OccupancyGrid: occupancy has shape {array.shape}; give an array (nx, ny) with at least one cell"
        )
    array[array == -1] = np.nan
    bad = ~(np.isnan(array) | ((array >= 0) & (array <= 1)))
    if bad.any():
        at = first_index(bad)
        raise ParameterError(
            f"OccupancyGrid: occupancy must be between 0 and 1 (NaN or -1: unknown); got {array[at]:g} "
            f"at cell {at}; percentages are divided by 100, counts go to OccupancyGrid.from_counts",
            at,
            array[at],
        )
    array.flags.writeable = False
    return array


def _positive(name: str, value: Any, least: float) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ParameterError(f"OccupancyGrid: {name} must be a number; got {value!r:.80}") from None
    if not least < number < math.inf:
        raise ParameterError(f"OccupancyGrid: {name} must be positive and finite; got {number}")
    return number


def _point(name: str, value: Any) -> tuple[float, float]:
    point = np.asarray(value, dtype=float)
    if point.shape != (2,) or not np.isfinite(point).all():
        raise ParameterError(f"OccupancyGrid: {name} must be two finite numbers; got {value!r:.80}")
    return float(point[0]), float(point[1])


def _counts(name: str, value: Any) -> np.ndarray:
    array = np.asarray(value, dtype=float)
    bad = ~((array >= 0) & np.isfinite(array))
    if bad.any():
        at = first_index(bad)
        raise ParameterError(
            f"OccupancyGrid.from_counts: {name} must be nonnegative and finite; "
            f"got {array[at]:g} at cell {at}",
            at,
            array[at],
        )
    return array


def _empty_squares(occupied: np.ndarray) -> np.ndarray:
    """See ``OccupancyGrid.empty_squares``."""
    nx, ny = occupied.shape
    sides = np.zeros((4, nx + 1, ny + 1), dtype=np.int64)
    free = np.zeros((nx + 1, ny + 1), dtype=bool)
    for left in (0, 1):
        for down in (0, 1):
            free[:nx, :ny] = ~occupied[:: 1 - 2 * left, :: 1 - 2 * down]
            _grow(sides[2 * left + down].reshape(-1), free.reshape(-1), nx, ny)
    return read_only(sides)


def _grow(side: np.ndarray, free: np.ndarray, nx: int, ny: int) -> None:
    """Fill in one direction, an antidiagonal at a time: one more than the least of three neighbours."""
    right, up = ny + 1, 1
    for total in range(nx + ny - 2, -1, -1):
        first, last = max(0, total - ny + 1), min(nx - 1, total)
        # in flat order an antidiagonal has the stride of one column less one row
        at = slice(first * ny + total, last * ny + total + 1, ny)
        beside = [side[at.start + k : at.stop + k : ny] for k in (right, up, right + up)]
        least = np.minimum(np.minimum(beside[0], beside[1]), beside[2])
        side[at] = (least + 1) * free[at]
