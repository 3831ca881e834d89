"""End points of beams, looked up in a map's log densities.

Knows the layout of the table and nothing of what its numbers mean; that is ``field``'s.
"""

from __future__ import annotations

import math
import threading

import numpy as np

from bayesmc.robotics.grid import OccupancyGrid
from bayesmc.shapes import read_only

#: end points worked on at a time: more leave the cache, fewer cost calls
BLOCK = 1 << 16
#: cells up to which the table has a margin that no end point can leave, so that none needs clipping
_ROOMY = 1 << 24
#: radians that float32 still holds to a thousandth of a degree
_LARGE_ANGLE = 50.0


class EndPointTable:
    """Log densities by cell, with a margin, flat and in single precision.

    End points are worked out in cells of this table; those of robots on the map stay inside the
    margin where it is wide enough, and are clipped where it is not.
    """

    def __init__(
        self,
        grid: OccupancyGrid,
        log_density: np.ndarray,
        log_random: float,
        mount: tuple[float, float, float],
        max_range: float,
    ) -> None:
        reach = max_range + math.hypot(*mount[:2])
        margin = math.ceil(reach / grid.resolution) + 2
        nx, ny = grid.shape
        self.clips = (nx + 2 * margin) * (ny + 2 * margin) > _ROOMY
        self.margin = 1 if self.clips else margin
        self.grid, self.log_random, self.mount = grid, log_random, mount
        single = log_density.astype(np.float32)
        cells = np.pad(single, self.margin, constant_values=log_random)
        self.shape = cells.shape
        self._corner = np.array(grid.origin)[:, None]
        self._size = np.array(grid.shape)[:, None]
        self._top = np.array(self.shape, dtype=np.float32)[:, None, None] - 1
        self.flat = read_only(cells.ravel())

    def place(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Cosine, sine, x and y (cells), shape (4, poses), and which are beyond the map, if any."""
        # rows of their own: whatever goes along a short last axis is several times slower
        cells = np.subtract(pose.T[:2], self._corner, order="C")
        cells *= 1 / self.grid.resolution
        outside = None
        if cells.size and (cells.min() < 0 or (cells.max(axis=1) >= self._size[:, 0]).any()):
            outside = ~((cells >= 0) & (cells < self._size)).all(axis=0)
            np.clip(cells, 0, self._size, out=cells)
        rows = np.empty((4, len(pose)), dtype=np.float32)
        np.add(cells, self.margin, out=rows[2:], casting="same_kind")
        heading = rows[1]
        heading[:] = pose[:, 2]
        if heading.size and (heading.max() > _LARGE_ANGLE or heading.min() < -_LARGE_ANGLE):
            heading[:] = np.remainder(pose[:, 2], 2 * np.pi)
        np.cos(rows[1], out=rows[0])
        np.sin(rows[1], out=rows[1])
        return rows, outside

    def scores(
        self, ranges: np.ndarray, angles: np.ndarray, rows: np.ndarray, outside: np.ndarray | None
    ) -> np.ndarray:
        """Log densities of one scan from placed poses, summed over its beams, shape (poses,)."""
        count, beams = rows.shape[1], len(ranges)
        # Turning and shifting the end points by each pose is one product of matrices, inner axis four.
        turn = np.zeros((2, beams, 4), dtype=np.float32)
        ex, ey = self._ends(ranges, angles)
        turn[0, :, 0] = turn[1, :, 1] = ex
        turn[1, :, 0] = ey
        np.negative(ey, out=turn[0, :, 1], casting="same_kind")
        turn[0, :, 2] = turn[1, :, 3] = 1.0
        log = np.empty(count)
        step = max(1, min(count, BLOCK // beams))
        rooms = _rooms(beams, step)
        for start in range(0, count, step):
            part = slice(start, min(start + step, count))
            found = self._gather(turn.reshape(-1, 4), rows[:, part], rooms)
            np.add.reduce(found, axis=0, out=log[part], dtype=np.float32)
        if outside is not None:
            log[outside] = beams * self.log_random
        return log

    def along(self, pose: np.ndarray, angles: np.ndarray, ranges: np.ndarray) -> np.ndarray:
        """Log densities at ``ranges`` (..., points) along each beam, shape (poses, beams, points)."""
        (c, s, px, py), outside = self.place(pose)
        c, s, px, py = (row[:, None, None] for row in (c, s, px, py))
        ex, ey = (part.astype(np.float32) for part in self._ends(ranges, angles[:, None]))
        ix = (c * ex - s * ey + px).astype(np.int64)
        iy = (s * ex + c * ey + py).astype(np.int64)
        np.clip(ix, 0, self.shape[0] - 1, out=ix)
        np.clip(iy, 0, self.shape[1] - 1, out=iy)
        found = self.flat[ix * self.shape[1] + iy]
        if outside is not None:
            found[outside] = self.log_random
        return found

    def _ends(self, ranges: np.ndarray, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """End points in the robot's frame, in cells."""
        mx, my, turn = self.mount
        size = self.grid.resolution
        beam = angles + turn
        return (mx + ranges * np.cos(beam)) / size, (my + ranges * np.sin(beam)) / size

    def _gather(self, turn: np.ndarray, rows: np.ndarray, rooms: _Rooms) -> np.ndarray:
        """Log densities (beams, poses) of a block, in one of ``rooms``."""
        place, cells, flat, found = rooms.cut(turn.shape[0] // 2, rows.shape[1])
        np.matmul(turn, rows, out=place.reshape(-1, rows.shape[1]))
        if self.clips:
            np.clip(place, 0, self._top, out=place)
        np.copyto(cells, place, casting="unsafe")  # nothing is negative: this is the floor
        ix, iy = cells
        ix *= np.int32(self.shape[1])
        ix += iy
        np.copyto(flat, ix)
        # "clip" checks no bounds; the margin (or clipping) keeps every index inside
        return np.take(self.flat, flat, out=found, mode="clip")


# ---- private ------------------------------------------------------------------------------------


class _Rooms:
    """Scratch arrays, from which those of a block are cut."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.place, self.cells = np.empty(2 * size, np.float32), np.empty(2 * size, np.int32)
        self.flat, self.found = np.empty(size, np.intp), np.empty(size, np.float32)

    def cut(self, beams: int, poses: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        one, count = (beams, poses), beams * poses
        place, cells = self.place[: 2 * count], self.cells[: 2 * count]
        flat, found = self.flat[:count], self.found[:count]
        return place.reshape(2, *one), cells.reshape(2, *one), flat.reshape(one), found.reshape(one)


_kept = threading.local()


def _rooms(beams: int, poses: int) -> _Rooms:
    """Scratch arrays, used again by whatever is looked up next in this thread.

    They are a megabyte or two whatever the number of poses, and fresh memory costs a fault for each of its
    pages, which is more than what is done with it.
    """
    rooms: _Rooms | None = getattr(_kept, "rooms", None)
    if rooms is None or rooms.size < beams * poses:
        rooms = _kept.rooms = _Rooms(beams * poses)
    return rooms
