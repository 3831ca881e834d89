"""Putting scans into maps of cells: ``ScanMapper``, the inverse sensor model of a laser.

Many maps take a scan at once, each from a pose of its own; what they share before, they share
afterwards where no beam went. Where a robot is, is not decided here.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import EvidenceWarning, ParameterError
from bayesmc.robotics.grid import as_number
from bayesmc.robotics.grid_map import FAR, HALO, NEAR, TILE, UNITS, as_maps
from bayesmc.robotics.laser import Laser, as_scans
from bayesmc.robotics.poses import as_poses
from bayesmc.shapes import broadcast_shapes

#: stands for "farther" while distances are worked out, such that adding NEAR does not overflow
_CAP = 120
#: maps that are worked on at a time: their cells stay in cache
_BLOCK = 32
_CELLS = TILE * TILE
_NOTHING = (
    "ScanMapper: a scan without a return was put into a map that is empty, and it stays so: where the robot "
    "is follows from its motion alone until something is seen; where that is in every scan, see whether "
    "ranges are in metres and max_range is the laser's"
)
#: cells from the origin up to which whole numbers count them
_FARTHEST = 1e9


@dataclass(frozen=True)
class ScanMapper:
    """What a scan says of the cells that its beams cross: free up to the end point, occupied there.

    A cell is updated once by a scan, however many of its beams cross it; where one ends, it is occupied.

    Parameters
    ----------
    laser : Laser
    occupied, free : float
        Probability that a cell is occupied given that a beam ends in it, and that one passes through
        it: above and below one half.
    least, most : float
        Probabilities that cells are held between, so that a map can change its mind.

    Raises
    ------
    ParameterError
        A probability is out of range.
    TypeError
        ``laser`` is no Laser.

    References
    ----------
    Thrun, Burgard and Fox (2005), Probabilistic Robotics, tables 9.1 and 9.2; Hornung et al. (2013), OctoMap,
    Autonomous Robots 34, equation 4 (bounds).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics import GridMap, Laser, ScanMapper
    >>> mapper = ScanMapper(Laser([0.0, np.pi / 2]))
    >>> seen = mapper.updated(GridMap(0.05), [0.0, 0.0, 0.0], [2.02, 1.02])[()]
    >>> seen.log_odds_at([[1.0, 0.0], [2.02, 0.0], [0.0, 1.02], [-1.0, 0.0]]).round(2).tolist()
    [-0.41, 0.84, 0.84, 0.0]
    """

    laser: Laser
    occupied: float = 0.7
    free: float = 0.4
    least: float = 0.03
    most: float = 0.97

    def __post_init__(self) -> None:
        if not isinstance(self.laser, Laser):
            raise TypeError(
                f"ScanMapper: give a Laser, such as Laser(angles); got {self.laser!r:.80}"
            )
        for name, low, high in (
            ("occupied", 0.5, 1.0),
            ("free", 0.0, 0.5),
            ("least", 0.018, 0.5),
            ("most", 0.5, 0.982),
        ):
            if not low < as_number(getattr(self, name)) < high:
                raise ParameterError(
                    f"ScanMapper: {name} must be between {low:g} and {high:g}; "
                    f"got {getattr(self, name)!r:.80}"
                )

    def updated(self, maps: Any, pose: Any, ranges: Any) -> np.ndarray:
        """Maps with a scan put into them.

        Parameters
        ----------
        maps : GridMap or array of GridMap, shape (...)
        pose : array_like, shape (..., 3)
            Of the robot: m, m, rad.
        ranges : array_like, shape (..., beams)
            In m; what is no return (see ``Laser``) says nothing.

        Returns
        -------
        ndarray of GridMap, shape (...)
            New ones; those given stay as they are.

        Raises
        ------
        TypeError, ParameterError, ShapeError
            No maps, maps of different resolutions, poses that are not finite, as many ranges as there
            are not beams.
        ModelError
            All readings of a scan are beyond the longest range, and no code for no return.

        Warns
        -----
        EvidenceWarning
            A scan without a return comes to a map that is empty.
        """
        maps, pose = as_maps("ScanMapper", maps), as_poses("ScanMapper", pose)
        if not np.isfinite(pose).all():
            raise ParameterError("ScanMapper: a pose is not finite")
        scans = as_scans("ScanMapper", self.laser, ranges)
        if (
            pose.size
            and maps.size
            and np.abs(pose[..., :2]).max() > _FARTHEST * maps.flat[0].resolution
        ):
            raise ParameterError(
                "ScanMapper: a pose is more than a thousand million cells from the origin of the map; "
                "are positions in metres, and did the robot start near the origin?"
            )
        shape = broadcast_shapes(maps.shape, pose.shape[:-1], scans.shape[:-1])
        found = np.empty(math.prod(shape), dtype=object)
        olds = np.broadcast_to(maps, shape).reshape(-1)
        poses = np.broadcast_to(pose, (*shape, 3)).reshape(-1, 3)
        each = np.broadcast_to(scans, (*shape, scans.shape[-1])).reshape(len(found), -1)
        same = scans.size == scans.shape[-1]
        step = _BLOCK if same else 1
        for start in range(0, len(found), step):
            part = slice(start, start + step)
            found[part] = self._put(olds[part], poses[part], each[start])
        return found.reshape(shape)

    # ---- private -------------------------------------------------------------------------------

    def _put(self, maps: np.ndarray, poses: np.ndarray, ranges: np.ndarray) -> np.ndarray:
        """One scan into some maps, each from its own pose."""
        size = maps[0].resolution
        ends, passed = self.laser.ends(ranges), self.laser.passed(ranges, size)
        if not len(ends):
            if not any(one.tiles for one in maps):
                warnings.warn(_NOTHING, EvidenceWarning, stacklevel=3)
            return maps
        touched = _Touched(maps, _placed(poses, ends, size), _placed(poses, passed, size))
        old = touched.tiles(maps)
        change = np.where(
            touched.hit, self._units(self.occupied), touched.crossed * self._units(self.free)
        )
        low, high = self._units(self.least), self._units(self.most)
        new = np.clip(old + change, low, high).astype(np.int8)
        return _with(maps, touched, old, new)

    def _units(self, probability: float) -> np.int16:
        """Log odds as whole multiples, at least one from 0."""
        units = UNITS * math.log(probability / (1.0 - probability))
        return np.int16(math.copysign(max(1, round(abs(units))), units))


# ---- private ------------------------------------------------------------------------------------


def _placed(poses: np.ndarray, points: np.ndarray, size: float) -> np.ndarray:
    """Cells of points of the robot's frame from each pose, shape (2, poses, points)."""
    c, s = np.cos(poses[:, 2:]) / size, np.sin(poses[:, 2:]) / size
    x, y = points.T
    cells = np.empty((2, len(poses), len(points)), dtype=np.int32)
    np.floor(c * x - s * y + poses[:, :1] / size, out=cells[0], casting="unsafe")
    np.floor(s * x + c * y + poses[:, 1:2] / size, out=cells[1], casting="unsafe")
    return cells


class _Touched:
    """Tiles that the beams of a scan touch, and their cells that it hits or crosses, (slots, 64, 64)."""

    def __init__(self, maps: np.ndarray, ends: np.ndarray, passed: np.ndarray) -> None:
        count = len(maps)
        low = np.minimum(
            ends.min(axis=(1, 2)), passed.min(axis=(1, 2)) if passed.size else ends.min(axis=(1, 2))
        )
        low = low // TILE
        high = np.maximum(
            ends.max(axis=(1, 2)), passed.max(axis=(1, 2)) if passed.size else ends.max(axis=(1, 2))
        )
        nx, ny = high // TILE - low + 1
        rows = (np.arange(count, dtype=np.int64) * (nx * ny))[:, None]
        shift = TILE.bit_length() - 1

        def tile_of(cells: np.ndarray) -> np.ndarray:
            x, y = cells
            return rows + ((x >> shift) - low[0]) * ny + ((y >> shift) - low[1])

        own, crossed = tile_of(ends), tile_of(passed)
        there = np.zeros(count * nx * ny, dtype=bool)
        there[own] = True
        there[crossed] = True
        self.slots = np.flatnonzero(there)
        slot = np.cumsum(there) - 1
        self.hit = self._marked(slot[own], ends)
        self.crossed = self._marked(slot[crossed], passed)
        owner, rest = np.divmod(self.slots, nx * ny)
        self.owner = owner
        i, j = rest // ny + low[0], rest % ny + low[1]
        self.keys = list(zip(i.tolist(), j.tolist(), strict=True))

    def _marked(self, slot: np.ndarray, cells: np.ndarray) -> np.ndarray:
        x, y = cells
        inside = TILE - 1
        found = np.zeros(len(self.slots) * _CELLS, dtype=bool)
        found[slot * _CELLS + (x & inside) * TILE + (y & inside)] = True
        return found.reshape(-1, TILE, TILE)

    def tiles(self, maps: np.ndarray) -> np.ndarray:
        """Log odds before, int16."""
        found = np.zeros((len(self.slots), TILE, TILE), dtype=np.int16)
        for k, (owner, key) in enumerate(zip(self.owner.tolist(), self.keys, strict=True)):
            tile = maps[owner].tiles.get(key)
            if tile is not None:
                found[k] = tile
        return found


def _with(maps: np.ndarray, touched: _Touched, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """The maps with new tiles, and the distances that change with them."""
    own: list[dict[tuple[int, int], np.ndarray]] = [{} for _ in maps]
    written = (new != old).any(axis=(1, 2))
    owners = touched.owner.tolist()
    for k in np.flatnonzero(written).tolist():
        own[owners[k]][touched.keys[k]] = new[k].copy()  # a view would keep all of them alive
    near: list[dict[tuple[int, int], np.ndarray]] = [{} for _ in maps]
    dirty = _dirty((new > 0) != (old > 0), touched)
    blocks = np.zeros((len(dirty), TILE + 2 * HALO, TILE + 2 * HALO), dtype=bool)
    for block, (owner, key) in zip(blocks, dirty, strict=True):
        _obstacles(block, maps[owner].tiles, own[owner], key)
    for found, (owner, key) in zip(_squares(blocks), dirty, strict=True):
        near[owner][key] = found.copy()
    result = np.empty(len(maps), dtype=object)
    for k, old_map in enumerate(maps):
        result[k] = old_map.with_tiles(own[k], near[k])
    return result


def _dirty(changed: np.ndarray, touched: _Touched) -> list[tuple[int, tuple[int, int]]]:
    """Tiles from which some obstacle that came or went is near, by map."""
    bands = (slice(0, HALO), slice(None), slice(TILE - HALO, TILE))
    found: dict[tuple[int, tuple[int, int]], None] = {}
    for dx, along in enumerate(bands):
        for dy, across in enumerate(bands):
            for k in np.flatnonzero(changed[:, along, across].any(axis=(1, 2))).tolist():
                i, j = touched.keys[k]
                found[int(touched.owner[k]), (i + dx - 1, j + dy - 1)] = None
    return list(found)


#: for each of three tiles in a row: where it goes in a block with a halo, and which part of it
_PARTS = (
    (slice(0, HALO), slice(TILE - HALO, TILE)),
    (slice(HALO, HALO + TILE), slice(0, TILE)),
    (slice(HALO + TILE, 2 * HALO + TILE), slice(0, HALO)),
)


def _obstacles(block: np.ndarray, old: Any, new: Any, key: tuple[int, int]) -> None:
    """Fill in obstacles of a tile and of what lies around it."""
    i, j = key
    for dx, (to_x, from_x) in enumerate(_PARTS):
        for dy, (to_y, from_y) in enumerate(_PARTS):
            near = (i + dx - 1, j + dy - 1)
            tile = new.get(near)
            if tile is None:
                tile = old.get(near)
            if tile is not None:
                np.greater(tile[from_x, from_y], 0, out=block[to_x, to_y])


def _squares(blocks: np.ndarray) -> np.ndarray:
    """Squared distances (cells) to the nearest obstacle, exact up to ``NEAR``: (blocks, 64, 64), uint8.

    The square of the distance is a minimum along x of minima along y (Felzenszwalb and Huttenlocher
    2012), and only obstacles within the halo count.
    """
    far = np.where(blocks, np.uint8(0), np.uint8(_CAP))
    for axis in (2, 1):
        middle = [slice(None)] * 3
        middle[axis] = slice(HALO, HALO + TILE)
        found = far[tuple(middle)].copy()
        room = np.empty_like(found)
        for k in range(1, HALO + 1):
            for start in (HALO - k, HALO + k):
                middle[axis] = slice(start, start + TILE)
                np.add(far[tuple(middle)], np.uint8(k * k), out=room)
                np.minimum(found, room, out=found)
        far = found
    far[far > NEAR] = FAR
    return far
