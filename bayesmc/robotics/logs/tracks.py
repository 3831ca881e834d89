"""What everybody does with a log that is read: thin it out, line it up by time, make arrays of it.

These take records, or arrays of times and poses, from whatever reader; nothing here knows of files.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np

from bayesmc.errors import ShapeError
from bayesmc.robotics.logs.records import GroundTruth, Laser, Odometry, Record, Timed
from bayesmc.robotics.poses import angle_between, between, wrap

T = TypeVar("T", bound=Timed)

#: mean resultant length from which on directions are one direction with noise
_AGREES = 0.8


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A scan worth an update of the filter.

    Parameters
    ----------
    laser : Laser
    motion : ndarray, shape (3,)
        Its pose seen from the keyframe before, by odometry; zeros for the first.
    """

    laser: Laser
    motion: np.ndarray


def keyframes(
    records: Iterable[Record], distance: float = 0.2, angle: float = 0.15
) -> Iterator[Keyframe]:
    """The laser scans that lie a minimal motion apart, with the odometry in between.

    Neighbouring scans of a slow robot see the same; a filter that takes them for independent becomes
    too sure. The first scan is one, and then each that is ``distance`` from the last keyframe or
    has turned by ``angle``. Motion too small for a keyframe is not lost: it adds up to the next one.

    Parameters
    ----------
    records : iterable of records
        In order of time, from whatever reader; those that are no `Laser` are passed over.
    distance : float
        In m.
    angle : float
        In rad.

    Returns
    -------
    iterator of Keyframe

    Raises
    ------
    ValueError
        For a negative threshold or NaN; at the end, where there were records and none was a scan.
    TypeError
        For what is no iterable of records.

    Examples
    --------
    >>> from bayesmc.robotics.logs import Laser, keyframes
    >>> scans = [Laser(float(k), [1.0], [0.0], [0.15 * k, 0.0, 0.0]) for k in range(5)]
    >>> [(key.laser.t, key.motion.round(2).tolist()) for key in keyframes(scans)]
    [(0.0, [0.0, 0.0, 0.0]), (2.0, [0.3, 0.0, 0.0]), (4.0, [0.3, 0.0, 0.0])]
    """
    if not (distance >= 0.0 and angle >= 0.0):
        raise ValueError(
            f"keyframes(distance={distance!r}, angle={angle!r}): give 0 or more of both"
        )
    if isinstance(records, (str, bytes)) or not isinstance(records, Iterable):
        raise TypeError(
            f"keyframes: give records, such as those of read_carmen(path); got {records!r:.80}"
        )
    return _keyframes(records, distance, angle)


def pose_at(
    track: Iterable[GroundTruth | Odometry], times: Any, *, max_gap: float = math.inf
) -> np.ndarray:
    """Poses at given times, interpolated linearly; headings go the short way round.

    Parameters
    ----------
    track : iterable of records with a pose
        `GroundTruth` or `Odometry`, in order of time.
    times : array_like, shape (...)
        In s.
    max_gap : float
        Where two records are further apart than this, in s, nothing is known in between.

    Returns
    -------
    ndarray, shape (..., 3)
        Headings in [-pi, pi). NaN before the first record, after the last one and in gaps: nothing
        is extrapolated.

    Raises
    ------
    ShapeError
        For a track without records.
    ValueError
        For a track whose times run backwards.

    Examples
    --------
    >>> from bayesmc.robotics.logs import GroundTruth, pose_at
    >>> truth = [GroundTruth(0.0, [0.0, 0.0, 3.0]), GroundTruth(1.0, [2.0, 0.0, -3.0])]
    >>> pose_at(truth, [0.25, 2.0]).round(3).tolist()
    [[0.5, 0.0, 3.071], [nan, nan, nan]]
    """
    columns = stack(track)
    known, poses = columns["t"], columns["pose"]
    times = np.asarray(times, dtype=np.float64)
    if np.any(np.diff(known) < 0.0):
        raise ValueError("pose_at(track): its times run backwards; sort it with merge(track)")
    # the record at or before each time, and the one after it
    right = np.clip(np.searchsorted(known, times, side="right"), 1, max(1, known.size - 1))
    left, right = right - 1, np.minimum(right, known.size - 1)
    gap = known[right] - known[left]
    within = np.clip(times, known[0], known[-1])  # the others become NaN below
    share = np.where(gap > 0.0, (within - known[left]) / np.where(gap > 0.0, gap, 1.0), 0.0)
    found = poses[left] + share[..., None] * (poses[right] - poses[left])
    turn = angle_between(poses[left, 2], poses[right, 2])
    found[..., 2] = wrap(poses[left, 2] + share * turn)
    is_exact = (times == known[left]) | (times == known[right])
    is_known = (times >= known[0]) & (times <= known[-1]) & ((gap <= max_gap) | is_exact)
    found[~is_known] = np.nan
    return found


def heading_offset(track: Iterable[GroundTruth | Odometry], distance: float = 0.5) -> float:
    """By how much a robot's direction of travel is off its recorded headings, in rad.

    Nearly 0 for headings that belong to the positions; pi for those that point backwards (or a robot that
    drives in reverse), a quarter turn for a compass taken for a heading. Look at it before a filter is
    started at a recorded pose.

    Parameters
    ----------
    track : iterable of records with a pose
        `GroundTruth` or `Odometry`, in order of time.
    distance : float
        Pieces of this length, in m, say where the robot goes: longer than positions are uncertain, shorter
        than its curves.

    Returns
    -------
    float
        Direction of travel less heading, averaged on the circle, in [-pi, pi). NaN where it never gets so
        far, and where the pieces do not agree (mean resultant length below 0.8): recorded headings then have
        no offset that is one number.

    Raises
    ------
    ShapeError
        For a track without records.
    ValueError
        ``distance`` is not positive.

    Examples
    --------
    >>> from bayesmc.robotics.logs import GroundTruth, heading_offset
    >>> backwards = [GroundTruth(float(k), [0.5 * k, 0.0, 3.0]) for k in range(9)]
    >>> round(heading_offset(backwards), 3)  # drives along +x, and is said to look almost along -x
    -3.0
    """
    if not distance > 0.0:
        raise ValueError(f"heading_offset(distance={distance!r}): give a length in m above 0")
    poses = stack(track)["pose"]
    offsets, start = [], 0
    for k in range(1, len(poses)):
        dx, dy = poses[k, :2] - poses[start, :2]
        if math.hypot(dx, dy) >= distance:
            offsets.append(math.atan2(dy, dx) - poses[(start + k) // 2, 2])
            start = k
    if not offsets:
        return math.nan
    mean = complex(np.exp(1j * np.array(offsets)).mean())
    return float(wrap(np.angle(mean))) if abs(mean) >= _AGREES else math.nan


def merge(*streams: Iterable[T]) -> tuple[T, ...]:
    """The records of all streams in order of time; at equal times in the order of the streams.

    Parameters
    ----------
    *streams : iterables of records

    Examples
    --------
    >>> from bayesmc.robotics.logs import Measurement, Velocity, merge
    >>> steps = [Velocity(0.0, 1.0, 0.0), Velocity(1.0, 0.5, 0.0)]
    >>> seen = [Measurement(0.5, 7, 2.0, 0.1)]
    >>> [type(record).__name__ for record in merge(steps, seen)]
    ['Velocity', 'Measurement', 'Velocity']
    """
    return tuple(sorted((r for stream in streams for r in stream), key=attrgetter("t")))


def stack(records: Iterable[Record]) -> dict[str, np.ndarray]:
    """The fields of records of one kind as arrays with a leading axis.

    Parameters
    ----------
    records : iterable of records

    Returns
    -------
    dict of str to ndarray, shape (records, ...)

    Raises
    ------
    ShapeError
        Where there are no records, of more than one kind, or of scans with differently many beams.

    Examples
    --------
    >>> from bayesmc.robotics.logs import Velocity, stack
    >>> columns = stack([Velocity(0.0, 1.0, 0.0), Velocity(1.0, 0.5, 0.1)])
    >>> columns["v"]
    array([1. , 0.5])
    """
    rows = tuple(records)
    kinds = {type(row) for row in rows}
    if len(kinds) != 1:
        named = ", ".join(sorted(kind.__name__ for kind in kinds)) or "none at all"
        raise ShapeError(f"stack(records): give records of one kind; there are {named}")
    columns = {}
    for field in fields(rows[0]):
        values = [getattr(row, field.name) for row in rows]
        if len({np.shape(value) for value in values}) != 1:
            raise ShapeError(f"stack(records): {field.name} is not equally long in all records")
        columns[field.name] = np.array(values)
    return columns


def _keyframes(records: Iterable[Record], distance: float, angle: float) -> Iterator[Keyframe]:
    last: Laser | None = None
    record: Any = None
    for record in records:
        if not isinstance(record, Laser):
            if not isinstance(record, Record):
                raise TypeError(
                    "keyframes: give records, such as those of read_carmen(path); one is of type "
                    f"{type(record).__name__}"
                )
            continue
        if last is None:
            motion = np.zeros(3)
        else:
            motion = between(last.pose, record.pose)
            if math.hypot(motion[0], motion[1]) < distance and abs(motion[2]) < angle:
                continue
        last = record
        motion.flags.writeable = False
        yield Keyframe(record, motion)
    if last is None and record is not None:
        raise ValueError(
            f"keyframes: no record is a Laser, the last one is of type {type(record).__name__}; did the "
            "reader take the log's scans?"
        )
