"""Monte Carlo localisation written by hand in NumPy: one thread, everything in place.

It computes what a run of bayesmc's answers with on the same template (``OdometryMotion``, a
``LikelihoodField`` and resampling by position): the mean pose of every slice, circular in the heading, and
the increments of the log-likelihood. What makes it fast: coordinates in planes of their own, SFC64, offspring
counted and summed up instead of searched, and end points turned by all poses in one product of matrices,
single precision, in blocks that stay in cache.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from benchmarks.floors.particle import Filtered

BLOCK = 1 << 16  # end points
SHARE = 1.0  # of the particles, below which their effective number has them resampled
FLOOR = 1e-4  # standard deviations that the motion has at least
LEAST = 0.01  # m, below which a translation has no direction


@dataclass(frozen=True)
class Floor:
    """A map as log densities of end points.

    Parameters
    ----------
    cells : ndarray, shape (nx, ny)
        Log density of an end point in each cell, tempered.
    beyond : float
        That of an end point beyond the map.
    resolution : float
        Side of a cell in m.
    origin : (float, float)
        Corner of the first cell in m.
    reach : float
        Range in m from which on a reading is none.
    mount : (float, float, float)
        Pose of the laser on the robot.
    """

    cells: np.ndarray
    beyond: float
    resolution: float
    origin: tuple[float, float]
    reach: float
    mount: tuple[float, float, float]

    def laid_out(self) -> tuple[np.ndarray, int, int]:
        """The cells with a margin that no end point leaves, flat; their row length and the margin."""
        reach = self.reach + math.hypot(*self.mount[:2])
        margin = math.ceil(reach / self.resolution) + 2
        padded = np.pad(self.cells.astype(np.float32), margin, constant_values=self.beyond)
        return padded.ravel(), padded.shape[1], margin


class Localization:
    """Filters on one map; made once, as a map is laid out once.

    Parameters
    ----------
    floor : Floor
    angles : ndarray, shape (beams,)
    start, spread : array_like, shape (3,)
        Mean and standard deviations of the first pose.
    alphas : tuple of float
        The four variances of odometry.
    """

    def __init__(
        self,
        floor: Floor,
        angles: np.ndarray,
        start: np.ndarray,
        spread: tuple[float, ...],
        alphas: tuple[float, ...],
    ) -> None:
        self.floor, self.angles = floor, angles
        self.start, self.spread, self.alphas = np.asarray(start), np.asarray(spread), alphas
        self.flat, self.row, self.margin = floor.laid_out()
        size = max(BLOCK, len(angles))  # fresh memory costs a fault for each page
        self.ends, self.at = np.empty(2 * size, np.float32), np.empty(2 * size, np.int32)
        self.cells, self.found = np.empty(size, np.intp), np.empty(size, np.float32)
        self.rows = np.empty((4, 0), dtype=np.float32)

    def filtered(
        self, scans: np.ndarray, motion: np.ndarray, particles: int, seed: int
    ) -> Filtered:
        """Filter scans, shape (steps, beams), with the steps of the robot, (steps, 3)."""
        n, rng = particles, np.random.Generator(np.random.SFC64(seed))
        pose, spare, noise = np.empty((3, n)), np.empty((3, n)), np.empty((3, n))
        log, weights, running = np.empty(n), np.empty(n), np.empty(n)
        mean, increments = np.empty((len(scans), 3)), np.zeros(len(scans))
        rng.standard_normal(out=pose)
        pose *= self.spread[:, None]
        pose += self.start[:, None]
        ess, level = float(n), math.log(n)
        for t, scan in enumerate(scans):
            fresh = t == 0 or ess < SHARE * n
            if t:
                if fresh:
                    ancestors = _ancestors(weights, running, rng.random())
                    np.take(pose, ancestors, axis=1, out=spare, mode="clip")
                    pose, spare, level = spare, pose, math.log(n)
                rng.standard_normal(out=noise)
                self._move(pose, noise, motion[t])
            if fresh:
                self.weigh(pose, scan, log)
            else:
                self.weigh(pose, scan, running)
                log += running
            top = log.item(log.argmax())
            np.subtract(log, top, out=weights)
            np.exp(weights, out=weights)
            total, squares = float(weights.sum()), float(weights.dot(weights))
            ess = total * total / squares
            before, level = level, top + math.log(total)
            increments[t] = level - before
            mean[t, :2] = pose[:2].dot(weights) / total
            np.cos(pose[2], out=noise[0])
            np.sin(pose[2], out=noise[1])
            mean[t, 2] = math.atan2(noise[1].dot(weights), noise[0].dot(weights))
        return Filtered(mean, increments)

    def weigh(self, pose: np.ndarray, scan: np.ndarray, out: np.ndarray) -> None:
        """Log density of a scan from poses in planes, shape (3, n)."""
        floor, n = self.floor, pose.shape[1]
        seen = (scan >= 0) & (scan < floor.reach)
        ranges, angles, beams = scan[seen], self.angles[seen], int(seen.sum())
        if not beams:
            out.fill(0.0)
            return
        mx, my, turned = floor.mount
        ex = (mx + ranges * np.cos(angles + turned)) / floor.resolution
        ey = (my + ranges * np.sin(angles + turned)) / floor.resolution
        turn = np.zeros((2, beams, 4), dtype=np.float32)
        turn[0, :, 0], turn[0, :, 1], turn[0, :, 2] = ex, -ey, 1.0
        turn[1, :, 0], turn[1, :, 1], turn[1, :, 3] = ey, ex, 1.0
        if self.rows.shape[1] != n:
            self.rows = np.empty((4, n), dtype=np.float32)
        rows = self.rows
        rows[1] = pose[2]
        np.cos(rows[1], out=rows[0])
        np.sin(rows[1], out=rows[1])
        for k in (0, 1):
            np.subtract(pose[k], floor.origin[k], out=out)
            out *= 1 / floor.resolution
            np.clip(out, 0.0, floor.cells.shape[k], out=out)
            out += self.margin
            rows[2 + k] = out
        width = max(1, min(n, BLOCK // beams))
        for low in range(0, n, width):
            part = rows[:, low : low + width]
            size = beams * part.shape[1]
            ends, at = self.ends[: 2 * size], self.at[: 2 * size].reshape(2, size)
            np.matmul(turn.reshape(-1, 4), part, out=ends.reshape(2 * beams, -1))
            np.copyto(at, ends.reshape(2, size), casting="unsafe")
            at[0] *= np.int32(self.row)
            np.add(at[0], at[1], out=self.cells[:size], dtype=np.intp)
            found = self.found[:size]
            self.flat.take(self.cells[:size], out=found, mode="clip")
            by_beam = found.reshape(beams, -1)
            np.add.reduce(by_beam, axis=0, out=out[low : low + width], dtype=np.float32)
        self._beyond(pose, out, beams)

    def _beyond(self, pose: np.ndarray, out: np.ndarray, beams: int) -> None:
        """A robot beyond the map sees nothing that the map explains."""
        (left, bottom), size = self.floor.origin, self.floor.resolution
        nx, ny = self.floor.cells.shape
        x, y = pose[0], pose[1]
        if x.min() >= left and x.max() < left + nx * size:
            if y.min() >= bottom and y.max() < bottom + ny * size:
                return
        outside = (x < left) | (x >= left + nx * size) | (y < bottom) | (y >= bottom + ny * size)
        out[outside] = beams * self.floor.beyond

    def _move(self, pose: np.ndarray, noise: np.ndarray, motion: np.ndarray) -> None:
        """A rotation, a translation and a rotation with noise, in place."""
        dx, dy, turn = motion.tolist()
        back = -1.0 if dx < 0 else 1.0
        rotation, distance = math.atan2(back * dy, back * dx), back * math.hypot(dx, dy)
        first = rotation if abs(distance) >= LEAST else 0.0
        last = math.remainder(turn - first, 2 * math.pi)
        a1, a2, a3, a4 = self.alphas
        far = distance * distance
        noise[0] *= math.sqrt(a1 * first * first + a2 * far + FLOOR**2)
        noise[1] *= math.sqrt(a3 * far + a4 * (first * first + last * last) + FLOOR**2)
        noise[2] *= math.sqrt(a1 * last * last + a2 * far + FLOOR**2)
        x, y, heading = pose
        turned, length, end = noise
        end += turned
        end += turn
        turned += heading
        turned += rotation
        length += distance
        heading += end
        np.cos(turned, out=end)
        end *= length
        x += end
        np.sin(turned, out=end)
        end *= length
        y += end


def _ancestors(weights: np.ndarray, running: np.ndarray, u: float) -> np.ndarray:
    """Systematic resampling: sorted positions of the ancestors."""
    n = len(weights)
    np.add.accumulate(weights, out=running)
    running *= n / running[-1]
    running += u
    edges = running.astype(np.intp)
    edges[-1] = n  # the sum may round below n
    counts = np.bincount(edges, minlength=n)[:n]
    return np.add.accumulate(counts, out=counts)
