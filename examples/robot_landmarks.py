"""A helper, not a script: logs of robots among landmarks as arrays, and generated logs in the same files.

``marks_seen`` reads a folder of UTIAS MRCLAM, ``ranges_heard`` one of Plaza; both give a `Drive`, one row
for each slice of time. ``write_mrclam`` and ``write_plaza`` simulate a robot and write the same files, so
that what the examples do is done with or without the logs of real robots.

A slice is an instant at which something was measured, and every second where nothing was. What the wheels say
in between is added up along exact arcs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bayesmc.robotics import bearing_to, between, pose_errors, range_to, unicycle, wrap
from bayesmc.robotics.logs import merge, pose_at, read_mrclam, read_plaza, stack

EVERY = 1.0  # s between slices at most


@dataclass(frozen=True, eq=False)
class Drive:
    """One robot's drive, slice by slice.

    Parameters
    ----------
    times : ndarray, shape (T,)
        In s from the start.
    motion : ndarray, shape (T, 3)
        Its pose seen from the slice before, by the wheels.
    effort : ndarray, shape (T, 3)
        Metres driven, radians turned and seconds passed since the slice before: noise grows with them.
    seen : ndarray, shape (T, L, ...)
        What was measured of each landmark; NaN where nothing was.
    marks : ndarray, shape (L, 2)
        Where the landmarks stand.
    truth : ndarray, shape (T, 3)
        Where the robot was; NaN where that is not known.
    """

    times: np.ndarray
    motion: np.ndarray
    effort: np.ndarray
    seen: np.ndarray
    marks: np.ndarray
    truth: np.ndarray

    @property
    def start(self) -> np.ndarray:
        """The first pose, which all filters are told."""
        return self.truth[0]

    @property
    def reckoned(self) -> np.ndarray:
        """Dead reckoning: the wheels alone, from the true start."""
        return _chained(self.start, self.motion)

    def error(self, poses: np.ndarray) -> np.ndarray:
        """Distance from the truth in every slice, in m, shape (T,)."""
        return pose_errors(poses, self.truth)[0]

    def rmse(self, poses: np.ndarray) -> float:
        """Root mean square of the error over time: every second counts the same, seen or unseen.

        Slices crowd where landmarks are seen, so each counts as long as it lasts.
        """
        lasts = np.diff(self.times, append=self.times[-1])
        square = self.error(poses) ** 2
        known = np.isfinite(square)
        return float(np.sqrt((square * lasts)[known].sum() / lasts[known].sum()))


def marks_seen(folder: Path, robot: int) -> Drive:
    """One robot of a folder of MRCLAM: ranges and bearings, shape (T, 15, 2), to the landmarks alone."""
    data = read_mrclam(folder, [robot])
    log = data.robots[robot]
    subjects, marks = _landmarks(data.landmarks)
    readings = [m for m in log.measurements if m.subject in subjects]
    told = stack(log.velocities)
    held = np.diff(told["t"])
    wheels = told["t"], told["v"][:-1] * held, told["omega"][:-1] * held
    values = [(m.range, m.bearing) for m in readings]
    where = [subjects[m.subject] for m in readings]
    return _drive(wheels, [m.t for m in readings], where, values, marks, log.truth)


def ranges_heard(folder: Path, name: str = "Plaza1") -> Drive:
    """The drive in a folder of Plaza: ranges, shape (T, 4), to the beacons."""
    data = read_plaza(folder, name)
    beacons, marks = _landmarks(data.beacons)
    steps = stack(data.increments)
    wheels = steps["t"], steps["distance"][1:], steps["turn"][1:]
    values = [r.range for r in data.ranges]
    where = [beacons[r.beacon] for r in data.ranges]
    return _drive(wheels, [r.t for r in data.ranges], where, values, marks, data.truth)


def ellipse(centre: np.ndarray, cov: np.ndarray, deviations: float = 2.0) -> np.ndarray:
    """Outline of so many standard deviations, shape (2, 60)."""
    angle = np.linspace(0.0, 2 * np.pi, 60)
    root = np.linalg.cholesky(cov + 1e-12 * np.eye(2))
    return centre[:, None] + deviations * root @ np.stack([np.cos(angle), np.sin(angle)])


# ---- generated logs -------------------------------------------------------------------------------


def write_mrclam(folder: Path, seconds: float = 200.0, seed: int = 1, depths: bool = False) -> Path:
    """A folder as `read_mrclam` expects it, of one robot among 15 landmarks.

    Its wheels say a tenth too much, bearings are a degree off, and one in a hundred is of something else.
    With ``depths`` it reads, as the robots of MRCLAM do, how deep landmarks stand along its camera's axis.
    """
    rng = np.random.default_rng(seed)
    times, poses, v, omega = _driven(seconds, 0.02, (0.12, 0.25), rng)
    marks = rng.uniform([-3.0, -4.0], [4.0, 4.0], (15, 2)) + poses[:, :2].mean(axis=0)
    told = np.stack([times, 1.1 * v, 1.1 * omega], axis=-1)
    told[:, 1:] *= 1 + 0.1 * rng.standard_normal(told[:, 1:].shape)
    rows = []
    for k in range(25, len(times), 15):
        distance, angle = range_to(poses[k], marks), bearing_to(poses[k], marks)
        for j in np.flatnonzero((distance < 4.0) & (np.abs(angle) < 0.6)):
            off = rng.uniform(-0.6, 0.6) if rng.random() < 0.01 else angle[j]
            noise = rng.standard_normal(2) * (0.15, 0.02)
            far = distance[j] * np.cos(angle[j]) if depths else distance[j]
            rows.append((times[k], 101 + j, abs(far + noise[0]), off + noise[1]))
    number = np.arange(6, 21)
    stand = np.column_stack([number, marks, np.full((15, 2), 1e-4)])
    tables = {
        "Barcodes": (np.column_stack([number, number + 95]), "%d %d"),
        "Landmark_Groundtruth": (stand, "%d %.6f %.6f %.6f %.6f"),
        "Robot1_Odometry": (told, "%.3f %.5f %.5f"),
        "Robot1_Measurement": (np.array(rows), "%.3f %d %.5f %.5f"),
        "Robot1_Groundtruth": (np.column_stack([times, poses]), "%.3f %.6f %.6f %.6f"),
    }
    for name, (table, format_) in tables.items():
        np.savetxt(folder / f"{name}.dat", table, format_, header=name)
    return folder


def write_plaza(
    folder: Path, seconds: float = 600.0, bias: float = 2.5, seed: int = 2, noise: float = 0.01
) -> Path:
    """A folder as `read_plaza` expects it: four beacons, whose ranges are all ``bias`` too long.

    The wheels are off by ``noise`` rad every 0.2 s.
    """
    from scipy.io import savemat

    rng = np.random.default_rng(seed)
    times, poses, v, omega = _driven(seconds, 0.2, (1.0, 0.12), rng)
    centre, reach = poses[:, :2].mean(axis=0), np.ptp(poses[:, :2], axis=0).max()
    corners = np.array([[-1.0, -0.8], [0.9, -1.0], [1.0, 0.7], [-0.7, 1.1]])
    marks = centre + 0.7 * reach * corners
    steps = np.column_stack([times[1:], 0.2 * v[:-1], 0.2 * omega[:-1]])
    steps[:, 1] *= 1 + 0.1 * rng.standard_normal(len(steps))
    steps[:, 2] += noise * rng.standard_normal(len(steps)) + 0.0005
    rows = []
    for k in range(5, len(times) - 1):
        beacon = k % 4
        noise = rng.standard_normal() * 1.0 + bias
        if rng.random() < 0.4:
            far = range_to(poses[k], marks[beacon]) + noise
            rows.append((times[k], 2, beacon, abs(far)))
    np.savetxt(folder / "Plaza1_DR.txt", steps, "%.8e")
    np.savetxt(folder / "Plaza1_TD.txt", np.array(rows), "%.8e")
    tables = {
        "TL": np.column_stack([np.arange(4), marks]),
        "GT": np.column_stack([times, poses]),
    }
    savemat(folder / "Plaza1_.mat", tables)
    return folder


# ---- private --------------------------------------------------------------------------------------


def _landmarks(places: Mapping[int, np.ndarray]) -> tuple[dict[int, int], np.ndarray]:
    """The place in the plate of each landmark's number, and where it stands."""
    return {number: k for k, number in enumerate(places)}, np.stack(list(places.values()))


def _drive(
    wheels: tuple[np.ndarray, np.ndarray, np.ndarray],
    instants: Iterable[float],
    where: list[int],
    values: list[Any],
    marks: np.ndarray,
    track: Any,
) -> Drive:
    """Slices of what was driven and measured: reading k is of landmark ``where[k]``, at ``instants[k]``.

    Two readings of one landmark at one instant would be one too many for its element of the plate: the later
    one gets a slice of its own, which lasts no time.
    """
    knots, distance, turn = wheels
    when, found = np.array(list(instants)), np.array(values)
    within = (when >= knots[0]) & (when <= knots[-1])
    when, found, which = when[within], found[within], np.array(where)[within]
    again = _copies(when, which)
    stops = np.arange(knots[0], knots[-1], EVERY)
    keys = sorted({(t, 0) for t in stops} | set(zip(when.tolist(), again.tolist(), strict=True)))
    place = {key: k for k, key in enumerate(keys)}
    times = np.array([t for t, _ in keys])
    seen = np.full((len(times), len(marks), *found.shape[1:]), np.nan)
    rows = [place[key] for key in zip(when.tolist(), again.tolist(), strict=True)]
    seen[rows, which] = found
    at, sums = _reckoned(knots, distance, turn, times)
    motion = np.concatenate([np.zeros((1, 3)), between(at[:-1], at[1:])])
    effort = np.diff(sums, axis=0, prepend=sums[:1])
    return Drive(times - times[0], motion, effort, seen, marks, pose_at(merge(track), times))


def _copies(when: np.ndarray, which: np.ndarray) -> np.ndarray:
    """How many readings of the same landmark at the same instant came before each."""
    count: dict[tuple[float, int], int] = {}
    copies = np.zeros(len(when), dtype=int)
    for k, key in enumerate(zip(when.tolist(), which.tolist(), strict=True)):
        copies[k] = count.get(key, 0)
        count[key] = copies[k] + 1
    return copies


def _reckoned(
    knots: np.ndarray, distance: np.ndarray, turn: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Poses from the origin by the wheels at given times; and metres, radians and seconds until then.

    Between two knots the wheels hold their speeds, so a part of the time is a part of the arc.
    """
    every = np.union1d(knots, times)
    k = np.clip(np.searchsorted(knots, every[:-1], side="right") - 1, 0, len(distance) - 1)
    share = np.diff(every) / np.diff(knots)[k]
    forward, turned = distance[k] * share, turn[k] * share
    arcs = unicycle(np.zeros(3), forward, turned, 1.0)
    sums = np.cumsum(np.stack([np.abs(forward), np.abs(turned), np.diff(every)], axis=-1), axis=0)
    at = np.searchsorted(every, times)
    poses = _chained(np.zeros(3), np.concatenate([np.zeros((1, 3)), arcs]))
    return poses[at], np.concatenate([np.zeros((1, 3)), sums])[at]


def _chained(start: np.ndarray, motions: np.ndarray) -> np.ndarray:
    """Poses reached by one motion after the other: `compose` over a whole drive at once."""
    heading = start[2] + np.cumsum(motions[:, 2])
    before = heading - motions[:, 2]
    sine, cosine = np.sin(before), np.cos(before)
    x = start[0] + np.cumsum(cosine * motions[:, 0] - sine * motions[:, 1])
    y = start[1] + np.cumsum(sine * motions[:, 0] + cosine * motions[:, 1])
    return np.stack([x, y, wrap(heading)], axis=-1)


def _driven(
    seconds: float, dt: float, usual: tuple[float, float], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times, poses and velocities of a robot that turns now this way, now that, and stays near its start."""
    times = dt * np.arange(round(seconds / dt))
    phase = 2 * np.pi * rng.random(2)
    speed, rate = usual
    v = speed * (1 + 0.3 * np.sin(2 * np.pi * times / 41 + phase[0]))
    omega = rate * (0.6 + np.sin(2 * np.pi * times / 60 + phase[1]))
    arcs = unicycle(np.zeros(3), v * dt, omega * dt, 1.0)
    poses = _chained(np.zeros(3), np.concatenate([np.zeros((1, 3)), arcs[:-1]]))
    return times, poses, v, omega
