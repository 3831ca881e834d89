"""``GridMap``: an occupancy grid that grows, as a value that is shared until somebody writes.

The plane is cut into square tiles of log odds, and a map holds those that a beam has touched. Maps
never change: whoever puts a scan into one (``grid_mapping``) gets another, which has new tiles where
beams went and the same ones everywhere else. So particles that are resampled copy references, and a
tile lives as long as one map has it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from bayesmc.errors import ParameterError, ShapeError
from bayesmc.objects import FrozenObject
from bayesmc.robotics.grid import OccupancyGrid, as_number

#: cells along the side of a tile, a power of two
TILE = 64
_SHIFT = 6
#: log odds are held as whole multiples of one over this
UNITS = 32
#: squared distances (cells) to the nearest obstacle are right up to this; beyond it they are larger
NEAR = 100
#: what stands for "farther", and what an empty tile is full of
FAR = 255
#: cells within which an obstacle is near
HALO = 10
_EMPTY: Mapping[Any, Any] = MappingProxyType({})

Tiles = Mapping[tuple[int, int], np.ndarray]


class GridMap(FrozenObject):
    """Log odds that square cells of the plane are occupied, in tiles that maps share.

    Parameters
    ----------
    resolution : float
        Side of a cell in metres. Cell ``(0, 0)`` has its lower left corner at the origin of the world.

    Attributes
    ----------
    tiles : mapping
        ``(i, j)`` -> log odds of the cells ``64 i`` to ``64 i + 63`` along x and likewise along y, in
        units of 1/32, shape (64, 64), int8, read-only. Zero, and whatever is on no tile, is unknown.
    squares : mapping
        ``(i, j)`` -> squared distances (cells) from each cell to the nearest obstacle, whose log odds
        are above 0: exact up to 100, and larger beyond; shape (64, 64), uint8, read-only. Where there
        is none, no obstacle is near.

    Raises
    ------
    ParameterError
        The resolution is not positive and finite.

    Notes
    -----
    A tile takes 4 KiB, and as much again for its distances: a map of 100 m x 100 m that is all its own
    holds 8 MiB at 0.05 m, and what two maps have in common is held once. Two maps are equal where all
    their cells are.

    References
    ----------
    Moravec and Elfes (1985), High resolution maps from wide angle sonar; Thrun, Burgard and Fox (2005),
    Probabilistic Robotics, section 9.2 (log odds).

    Examples
    --------
    >>> from bayesmc.robotics import GridMap
    >>> empty = GridMap(0.05)
    >>> empty, empty.log_odds_at([1.0, 2.0]).tolist()
    (GridMap(0 tiles of 3.2 m, cells of 0.05 m), 0.0)
    """

    __slots__ = ("resolution", "squares", "tiles")

    resolution: float
    tiles: Tiles
    squares: Tiles

    def __init__(self, resolution: float) -> None:
        if not 0 < as_number(resolution) < math.inf:
            raise ParameterError(
                f"GridMap: resolution must be positive and finite (m); got {resolution!r:.80}"
            )
        _set(self, float(resolution), _EMPTY, _EMPTY)

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(
            f"GridMap: {name!r} cannot be set: maps are shared, and a scan makes a new one "
            "(ScanMapper.updated)"
        )

    def __delattr__(self, name: str) -> None:
        self.__setattr__(name, None)

    def with_tiles(self, tiles: Tiles, squares: Tiles) -> GridMap:
        """A map with some tiles, and distances, instead of its own, and all others the same.

        The arrays are taken as they are and become read-only; who gives them lets go of them.
        """
        for array in (*tiles.values(), *squares.values()):
            array.flags.writeable = False
        found = object.__new__(GridMap)
        own, near = {**self.tiles, **tiles}, {**self.squares, **squares}
        _set(found, self.resolution, MappingProxyType(own), MappingProxyType(near))
        return found

    @property
    def size(self) -> int:
        """Bytes of its tiles, those that it shares with other maps included."""
        return sum(a.nbytes for part in (self.tiles, self.squares) for a in part.values())

    def log_odds_at(self, points: Any) -> np.ndarray:
        """Log odds at points, shape (...); 0 where nothing is known.

        Parameters
        ----------
        points : array_like, shape (..., >= 2)
            World coordinates (m) in the first two components.

        Raises
        ------
        ShapeError
            Points have fewer than two components.
        ParameterError
            A point is not finite.
        """
        points = np.asarray(points, dtype=float)
        if points.ndim == 0 or points.shape[-1] < 2:
            raise ShapeError(
                f"GridMap.log_odds_at: points have shape {points.shape}; give (..., 2) positions"
            )
        if not np.isfinite(points).all():
            raise ParameterError("GridMap.log_odds_at: a point is not finite")
        cells = np.floor(points[..., :2] / self.resolution).astype(np.int64)
        flat = cells.reshape(-1, 2)
        found = np.zeros(len(flat))
        for key in {(i, j) for i, j in (flat >> _SHIFT).tolist()}:
            tile = self.tiles.get(key)
            if tile is not None:
                at = ((flat >> _SHIFT) == key).all(axis=-1)
                inside = flat[at] & (TILE - 1)
                found[at] = tile[inside[:, 0], inside[:, 1]] / UNITS
        return found.reshape(cells.shape[:-1])

    def grid(self, threshold: float = 0.5) -> OccupancyGrid:
        """The smallest grid with all cells that are known; those that are not are NaN.

        Parameters
        ----------
        threshold : float
            Of the grid: see ``OccupancyGrid``.

        Raises
        ------
        ParameterError
            Nothing is known, or the threshold is out of range.
        """
        if not self.tiles:
            raise ParameterError(
                "GridMap.grid: the map is empty, no beam has touched a cell; put a scan into it first "
                "(ScanMapper.updated)"
            )
        keys = np.array(list(self.tiles))
        low = keys.min(axis=0)
        nx, ny = (keys.max(axis=0) + 1 - low) * TILE
        odds = np.zeros((nx, ny), dtype=np.int8)
        for (i, j), tile in self.tiles.items():
            x, y = (i - low[0]) * TILE, (j - low[1]) * TILE
            odds[x : x + TILE, y : y + TILE] = tile
        known = odds != 0
        if known.any():
            (left, right), (bottom, top) = (
                np.flatnonzero(known.any(axis=1 - axis))[[0, -1]] for axis in (0, 1)
            )
        else:
            left, right, bottom, top = 0, nx - 1, 0, ny - 1
        part = (slice(left, right + 1), slice(bottom, top + 1))
        log_odds = odds[part] / UNITS
        occupancy = np.where(known[part], 1.0 / (1.0 + np.exp(-log_odds)), np.nan)
        x, y = (low * TILE + (left, bottom)) * self.resolution
        return OccupancyGrid(occupancy, self.resolution, (float(x), float(y)), threshold)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, GridMap):
            return NotImplemented
        if self is other:
            return True
        if self.resolution != other.resolution or self.tiles.keys() != other.tiles.keys():
            return False
        return all(
            tile is other.tiles[key] or np.array_equal(tile, other.tiles[key])
            for key, tile in self.tiles.items()
        )

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[Any, ...]:
        return _made, (self.resolution, dict(self.tiles), dict(self.squares))

    def __copy__(self) -> GridMap:
        return self

    def __deepcopy__(self, memo: Any) -> GridMap:
        return self

    def __repr__(self) -> str:
        side = self.resolution * TILE
        return f"GridMap({len(self.tiles)} tiles of {side:g} m, cells of {self.resolution:g} m)"


def as_maps(call: str, maps: Any) -> np.ndarray:
    """Maps as an array of objects, all of the same resolution, shape (...).

    Raises
    ------
    TypeError
        Something else than maps.
    ParameterError
        Resolutions that differ.
    """
    if isinstance(maps, GridMap):
        found = np.empty((), dtype=object)
        found[()] = maps
        return found
    found = np.asarray(maps)
    if found.dtype != object or not all(isinstance(m, GridMap) for m in found.flat):
        what = f"an array of {found.dtype}" if found.dtype != object else f"{maps!r:.80}"
        raise TypeError(f"{call}: maps are GridMaps, one or an array of them; got {what}")
    if len({m.resolution for m in found.flat}) > 1:
        raise ParameterError(f"{call}: maps have different resolutions")
    return found


# ---- private ------------------------------------------------------------------------------------


def _set(made: GridMap, resolution: float, tiles: Tiles, squares: Tiles) -> None:
    object.__setattr__(made, "resolution", resolution)
    object.__setattr__(made, "tiles", tiles)
    object.__setattr__(made, "squares", squares)


def _made(resolution: float, tiles: Tiles, squares: Tiles) -> GridMap:
    """What a pickle calls."""
    return GridMap(resolution).with_tiles(tiles, squares)
