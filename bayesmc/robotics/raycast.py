"""Ray casting: how far a beam travels on a map before it meets an obstacle.

``ray_cast`` is exact and works on all rays at once; ``RayTable`` looks distances up that were cast
from the centres of cells, and is as exact as cells and headings are fine. Only obstacles stop a
ray: unknown cells and the space beyond the map do not. What a sensor makes of the distance is in
``beams``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from bayesmc.distributions.base import as_float
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.expression import as_one_call
from bayesmc.robotics.grid import OccupancyGrid, as_grid, as_number
from bayesmc.shapes import Shape, broadcast_shapes, first_index

#: rays that are begun at a time: many enough for few calls, few enough for their arrays to stay in cache
_AT_ONCE = 1 << 13
#: leaps after which the rays still under way may be moved together
_GATHER_EVERY = 4
#: least component of a direction: a ray along an axis crosses the other one too far off to matter
_ALONG = 1e-30
_STEPS = 65535  # of the ranges that a table keeps


def ray_cast(grid: OccupancyGrid, poses: Any, angles: Any, max_range: float) -> np.ndarray:
    """Distances along beams to the first obstacle, exact up to rounding.

    Parameters
    ----------
    grid : OccupancyGrid
        Its ``threshold`` decides what is an obstacle.
    poses : array_like, shape (..., 3)
        Of the laser: x, y (m) and heading (rad).
    angles : array_like, shape (beams,) or (..., beams)
        Of the beams against the heading (rad).
    max_range : float
        Distance (m) given where no obstacle is nearer; positive and finite.

    Returns
    -------
    ndarray, shape (..., beams)
        In metres: 0 inside an obstacle. A ray from beyond the map enters it where it meets it.

    Raises
    ------
    ParameterError
        A pose or an angle is not finite, or ``max_range`` is not positive and finite.
    ShapeError
        Poses without three components, or angles that do not fit them.
    TypeError
        ``grid`` is no OccupancyGrid.

    Notes
    -----
    A ray jumps from cell to cell as in Amanatides and Woo's traversal, but over the
    largest empty square that begins at its cell and extends in its direction; these are worked out
    once per map and direction.

    References
    ----------
    Amanatides and Woo (1987), A fast voxel traversal algorithm for ray
    tracing, Eurographics. Leaping over empty squares: Cohen and Sheffer (1994), Proximity clouds,
    The Visual Computer 11.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.grid import OccupancyGrid
    >>> from bayesmc.robotics.raycast import ray_cast
    >>> room = OccupancyGrid(np.pad(np.zeros((40, 20)), 1, constant_values=1.0), 0.1)
    >>> ray_cast(room, [1.1, 1.1, 0.0], np.deg2rad([-90.0, 0.0, 45.0]), 10.0).round(4).tolist()
    [1.0, 3.0, 1.4142]
    """
    grid, max_range = as_grid("ray_cast", grid), _reach(max_range)
    poses, angles = _checked(poses, angles)
    heading = poses[..., 2:] + angles
    shape = heading.shape
    x, y = ((poses[..., k] - grid.origin[k]) / grid.resolution for k in (0, 1))
    x = np.broadcast_to(x[..., None], shape).reshape(-1)
    y = np.broadcast_to(y[..., None], shape).reshape(-1)
    heading = heading.reshape(-1)
    reach = max_range / grid.resolution
    found = _cast(grid.empty_squares, x, y, heading, reach)
    found *= grid.resolution
    return np.minimum(found, max_range, out=found).reshape(shape)


@dataclass(frozen=True, eq=False)
class RayTable:
    """Distances to the first obstacle, looked up by cell and heading.

    They are cast exactly from the centre of a cell the first time that a ray starts in it, in all
    headings, and kept: a filter that has converged pays for the cells that it visits.

    Parameters
    ----------
    grid : OccupancyGrid
    max_range : float
        In metres.
    headings : int
        Number of directions over the circle.

    Raises
    ------
    ParameterError
        ``max_range`` is not positive and finite, or ``headings`` is not a positive whole number.
    TypeError
        ``grid`` is no OccupancyGrid.

    Notes
    -----
    Memory: two bytes per cell and heading, in steps of ``max_range / 65535``. A ray
    from beyond the map is given ``max_range``.

    References
    ----------
    Walsh and Karaman (2018), CDDT: Fast approximate 2D ray casting for
    accelerated localization, ICRA: its lookup table.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.grid import OccupancyGrid
    >>> from bayesmc.robotics.raycast import RayTable
    >>> room = OccupancyGrid(np.pad(np.zeros((40, 20)), 1, constant_values=1.0), 0.1)
    >>> RayTable(room, 10.0).ranges([1.1, 1.1, 0.0], np.deg2rad([-90.0, 0.0])).round(2).tolist()
    [1.05, 2.95]
    """

    grid: OccupancyGrid
    max_range: float
    headings: int = 360
    _kept: np.ndarray = field(init=False, repr=False)
    _known: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        as_grid("RayTable", self.grid)
        _reach(self.max_range)
        if not (isinstance(self.headings, (int, np.integer)) and self.headings > 0):
            raise ParameterError(
                f"RayTable: headings must be a positive whole number; got {self.headings!r}"
            )
        cells = math.prod(self.grid.shape)
        object.__setattr__(self, "_kept", np.zeros((cells, self.headings), dtype=np.uint16))
        object.__setattr__(self, "_known", np.zeros(cells, dtype=bool))

    @as_one_call
    def ranges(self, poses: Any, angles: Any) -> np.ndarray:
        """Distances (m), shapes as of ``ray_cast``.

        Parameters
        ----------
        poses : array_like, shape (..., 3)
        angles : array_like, shape (beams,) or (..., beams)

        Returns
        -------
        ndarray, shape (..., beams)
        """
        poses, angles = _checked(poses, angles)
        cells = self.grid.cell_of(poses)
        inside = self.grid._within(cells)
        flat = np.where(inside, cells[..., 0] * self.grid.shape[1] + cells[..., 1], 0)
        self._fill(flat[inside])
        turns = (poses[..., 2:] + angles) * (self.headings / (2 * np.pi))
        turns += 0.5  # to the nearest heading
        bins = np.floor(turns, out=turns).astype(np.int64)
        bins %= self.headings
        bins += flat[..., None] * self.headings
        found = self._kept.reshape(-1).take(bins) * (self.max_range / _STEPS)
        if not inside.all():
            found[~inside] = self.max_range
        return found

    def _fill(self, flat: np.ndarray) -> None:
        """Cast from the centres of cells that are not known yet."""
        new = np.unique(flat[~self._known[flat]])
        if not len(new):
            return
        centres = self.grid.center_of(np.stack(np.divmod(new, self.grid.shape[1]), axis=-1))
        poses = np.concatenate([centres, np.zeros((len(new), 1))], axis=1)
        angles = np.arange(self.headings) * (2 * np.pi / self.headings)
        found = ray_cast(self.grid, poses, angles, self.max_range)
        self._kept[new] = np.rint(found * (_STEPS / self.max_range))
        self._known[new] = True


# ---- private ------------------------------------------------------------------------------------


class _Rays(NamedTuple):
    """Rays under way, all of them mirrored so that they go right and up.

    Attributes
    ----------
    whole : ndarray of int, shape (4, rays)
        Number of the ray, where its direction's leaps begin, column and row.
    real : ndarray, shape (7, rays)
        Distance so far, start (2), direction (2), and distance per column and per row (2); in
        cells.
    """

    whole: np.ndarray
    real: np.ndarray

    def kept(self, which: np.ndarray) -> _Rays:
        return _Rays(self.whole.take(which, axis=1), self.real.take(which, axis=1))

    def joined(self, other: _Rays) -> _Rays:
        whole = np.concatenate([self.whole, other.whole], axis=1)
        return _Rays(whole, np.concatenate([self.real, other.real], axis=1))


def _cast(
    leaps: np.ndarray, x: np.ndarray, y: np.ndarray, heading: np.ndarray, reach: float
) -> np.ndarray:
    """Distances from points, all in cells, infinite where nothing is met; leaps: the empty squares."""
    found = np.full(x.shape, np.inf)
    rays, begun, turn = _begin(leaps.shape, x, y, heading, 0), _AT_ONCE, 0
    while rays.whole.shape[1] or begun < len(x):
        if rays.whole.shape[1] < _AT_ONCE // 2 and begun < len(x):  # few rays cost as many calls
            rays = rays.joined(_begin(leaps.shape, x, y, heading, begun))
            begun += _AT_ONCE
        leap = _leap(leaps, rays)
        turn += 1
        if turn % _GATHER_EVERY == 0:
            going = (leap > 0) & (rays.real[0] < reach)
            if np.count_nonzero(going) < 0.8 * len(going):
                _arrive(rays.kept(np.flatnonzero(~going)), leaps.shape, found)
                under_way = np.flatnonzero(going)
                rays, leap = rays.kept(under_way), leap.take(under_way)
        _advance(rays, leap)
    return found


def _begin(shape: Shape, x: np.ndarray, y: np.ndarray, heading: np.ndarray, start: int) -> _Rays:
    """The next rays from ``start`` on that meet the map at all."""
    part = slice(start, start + _AT_ONCE)
    _, columns, rows = shape
    x, dx, left = _mirrored(x[part], np.cos(heading[part]), columns - 1)
    y, dy, down = _mirrored(y[part], np.sin(heading[part]), rows - 1)
    slow_x, slow_y = 1 / dx, 1 / dy
    t = np.maximum(np.maximum(-x * slow_x, -y * slow_y), 0.0)  # where it enters the map
    leaves = np.minimum((columns - 1 - x) * slow_x, (rows - 1 - y) * slow_y)
    meets = np.flatnonzero(t < leaves)
    t, x, y, dx, dy, slow_x, slow_y = real = np.array([t, x, y, dx, dy, slow_x, slow_y])[:, meets]
    whole = np.empty((4, len(meets)), dtype=np.int64)
    whole[0] = start + meets
    whole[1] = (2 * left + down)[meets] * (columns * rows)
    whole[2] = np.minimum(x + t * dx, columns - 2)
    whole[3] = np.minimum(y + t * dy, rows - 2)
    return _Rays(whole, real)


def _mirrored(v: np.ndarray, d: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates and directions turned to go up the axis, and which were turned."""
    turned = d < 0
    return np.where(turned, size - v, v), np.maximum(np.abs(d), _ALONG), turned


def _leap(leaps: np.ndarray, rays: _Rays) -> np.ndarray:
    """How many columns and rows each ray may leap: 0 in an obstacle and beyond the map."""
    _, base, ix, iy = rays.whole
    at = ix * leaps.shape[2]
    at += iy
    at += base
    return leaps.reshape(-1).take(at)


def _advance(rays: _Rays, leap: np.ndarray) -> None:
    """Move every ray to where it leaves its empty square, in place; those that leap 0 stay."""
    _, _, ix, iy = rays.whole
    t, x, y, dx, dy, slow_x, slow_y = rays.real
    far_x, far_y = ix + leap, iy + leap
    to_x = far_x - x
    to_x *= slow_x
    to_y = far_y - y
    to_y *= slow_y
    by_x = to_x < to_y
    np.maximum(t, np.minimum(to_x, to_y), out=t)
    # the cell on the other axis: kept inside the square, which rounding might leave
    next_x = (x + t * dx).astype(np.int64)
    next_y = (y + t * dy).astype(np.int64)
    np.maximum(np.minimum(next_x, far_x - 1, out=next_x), ix, out=next_x)
    np.maximum(np.minimum(next_y, far_y - 1, out=next_y), iy, out=next_y)
    ix[:] = np.where(by_x, far_x, next_x)
    iy[:] = np.where(by_x, next_y, far_y)


def _arrive(rays: _Rays, shape: Shape, found: np.ndarray) -> None:
    """Note how far rays came that stopped: those that left the map keep their infinity."""
    number, _, ix, iy = rays.whole
    inside = (ix < shape[1] - 1) & (iy < shape[2] - 1)
    found[number[inside]] = rays.real[0][inside]


def _reach(max_range: Any) -> float:
    reach = as_number(max_range)
    if not 0 < reach < math.inf:
        raise ParameterError(
            f"ray casting: max_range must be positive and finite; got {max_range!r:.80}"
        )
    return reach


def _checked(poses: Any, angles: Any) -> tuple[np.ndarray, np.ndarray]:
    poses, angles = as_float(poses), as_float(angles)
    if poses.shape[-1:] != (3,):
        raise ShapeError(f"ray casting: poses have shape {poses.shape}; give (..., 3)")
    if angles.ndim == 0:
        raise ShapeError("ray casting: angles are one number; give (beams,)")
    try:
        broadcast_shapes(poses.shape[:-1], angles.shape[:-1])
    except ValueError:
        raise ShapeError(
            f"ray casting: angles of shape {angles.shape} do not fit poses of shape {poses.shape}"
        ) from None
    for name, value in (("poses", poses), ("angles", angles)):
        if not np.isfinite(value).all():
            at = first_index(~np.isfinite(value))
            raise ParameterError(
                f"ray casting: {name} must be finite; got {value[at]} at index {at}", at, value[at]
            )
    return poses, angles
