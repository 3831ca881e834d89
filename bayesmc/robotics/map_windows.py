"""What end points find in maps of cells: parts of several maps side by side, and sums over beams.

Tiles that poses can see are laid into one array, a rectangle for each map, so that many poses in each
of many maps are looked up in one pass of gathers. What the distances mean is not known here: they go
through a table.
"""

from __future__ import annotations

import numpy as np

from bayesmc.robotics.grid_map import FAR, TILE

#: end points worked on at a time: their temporaries stay in cache
_BLOCK = 1 << 16
#: bytes of the rectangles that are laid out at a time
MOST = 1 << 25


class MapWindows:
    """Squared distances to the nearest obstacle around poses, one rectangle of cells for each map.

    Parameters
    ----------
    maps : ndarray of GridMap, shape (maps,)
    low, high : ndarray, shape (maps, 2)
        World coordinates (m) that are looked up lie between these; others count as far from everything.
    """

    def __init__(self, maps: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
        self.resolution = maps[0].resolution
        first = np.floor(low / (self.resolution * TILE)).astype(np.int64)
        last = np.floor(high / (self.resolution * TILE)).astype(np.int64)
        nx, ny = (int(n) for n in (last - first).max(axis=0) + 1)
        self.shape = (nx * TILE, ny * TILE)
        self.corner = first * TILE
        cells = np.full((len(maps), nx, TILE, ny, TILE), FAR, dtype=np.uint8)
        for part, own, (i, j) in zip(cells, maps, first.tolist(), strict=True):
            if len(own.squares) < nx * ny:
                inside = [k for k in own.squares if 0 <= k[0] - i < nx and 0 <= k[1] - j < ny]
            else:
                inside = [(i + x, j + y) for x in range(nx) for y in range(ny)]
                inside = [k for k in inside if k in own.squares]
            for key in inside:
                part[key[0] - i, :, key[1] - j, :] = own.squares[key]
        self.flat = cells.reshape(-1)

    def sums(self, poses: np.ndarray, points: np.ndarray, table: np.ndarray) -> np.ndarray:
        """Sums of ``table``, between the middles of cells interpolated, where points lie as seen from poses.

        Parameters
        ----------
        poses : ndarray, shape (maps, poses, 3)
        points : ndarray, shape (points, 2)
            In the robot's frame (m).
        table : ndarray, shape (256,)
            By squared distance in cells; 255 is farther than any.

        Returns
        -------
        ndarray, shape (maps, poses)
        """
        found = np.empty(poses.shape[:2])
        table = table.astype(np.float32)
        step = max(1, _BLOCK // max(1, len(points) * len(poses)))
        for start in range(0, poses.shape[1], step):
            x, y = self.cells(poses[:, start : start + step], points)
            values = self._between(x, y, table)
            np.add.reduce(values, axis=-1, out=found[:, start : start + step])
        return found

    def _between(self, x: np.ndarray, y: np.ndarray, table: np.ndarray) -> np.ndarray:
        """The table at points given in cells, linear in both directions between four middles."""
        nx, ny = self.shape
        x -= np.float32(0.5)
        y -= np.float32(0.5)
        np.clip(x, 0, nx - 2, out=x)
        np.clip(y, 0, ny - 2, out=y)
        ix, iy = x.astype(np.int32), y.astype(np.int32)
        x -= ix
        y -= iy
        first = np.arange(len(ix), dtype=np.intp) * (nx * ny)
        at = ix * np.intp(ny) + iy + first.reshape(-1, *(1,) * (ix.ndim - 1))
        low = table[self.flat[at]]
        low += y * (table[self.flat[at + 1]] - low)
        at += ny
        high = table[self.flat[at]]
        high += y * (table[self.flat[at + 1]] - high)
        high -= low
        high *= x
        low += high
        return low

    def cells(self, poses: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points lie, in cells from each window's corner, shape (maps, ..., points)."""
        lead = (slice(None),) + (None,) * (poses.ndim - 1)
        scaled = (poses[..., :2] / self.resolution - self.corner[lead[: poses.ndim - 1]])[..., None]
        x0, y0 = scaled[..., 0, :], scaled[..., 1, :]
        c, s = np.cos(poses[..., 2:]), np.sin(poses[..., 2:])
        px, py = points.T / self.resolution
        return (
            (x0 + (c * px - s * py)).astype(np.float32),
            (y0 + (s * px + c * py)).astype(np.float32),
        )

    def rows(self, x: np.ndarray) -> np.ndarray:
        """Where the cells at ``x``, shape (maps, ...), begin in the flat array; those outside on the edge."""
        nx, ny = self.shape
        cells = np.clip(x, 0, nx - 1).astype(np.intp)
        cells *= ny
        first = np.arange(len(x), dtype=np.intp) * (nx * ny)
        cells += first.reshape(-1, *(1,) * (x.ndim - 1))
        return cells

    def columns(self, y: np.ndarray) -> np.ndarray:
        """What cells at ``y`` add to that."""
        return np.clip(y, 0, self.shape[1] - 1).astype(np.intp)


def around(
    poses: np.ndarray, points: np.ndarray, slack: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the points seen from poses (maps, poses, 3), with some room (m), shape (maps, 2) each."""
    c, s = np.cos(poses[..., 2:]), np.sin(poses[..., 2:])
    px, py = points.T if len(points) else np.zeros((2, 1))
    x, y = poses[..., :1] + c * px - s * py, poses[..., 1:2] + s * px + c * py
    room = np.reshape(slack, (-1, 1))
    low = np.stack([x.min(axis=(1, 2)), y.min(axis=(1, 2))], axis=-1) - room
    high = np.stack([x.max(axis=(1, 2)), y.max(axis=(1, 2))], axis=-1) + room
    return low, high
