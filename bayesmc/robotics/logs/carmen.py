"""CARMEN logs: odometry and laser scans, one message per line, read and written.

Three messages are read: ``ODOM``, ``FLASER`` (the front laser of old logs, which says nothing about
its beams) and ``ROBOTLASER1`` (which says all). Comments, ``PARAM`` and other messages are counted
and passed over. The order of fields is that of the CARMEN robot navigation toolkit's ``logger``
(carmen.sourceforge.net, "log file formats"):

    ODOM x y theta tv rv accel time host logger_time
    FLASER n r1 .. rn x y theta odom_x odom_y odom_theta time host logger_time
    ROBOTLASER1 type start fov resolution max accuracy remission_mode n r1 .. rn m e1 .. em
        laser_x laser_y laser_theta x y theta tv rv forward side turn_axis time host logger_time
"""

from __future__ import annotations

import gzip
import math
import os
import re
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from bayesmc.errors import FileFormatError
from bayesmc.robotics.logs.reading import (
    BadRanges,
    Format,
    Ignored,
    OnError,
    Reading,
    check_ranges,
    counted,
    in_order,
    numbers,
    ranges,
    whole,
)
from bayesmc.robotics.logs.records import MAX_RANGE, Laser, Odometry, read_only
from bayesmc.robotics.logs.sources import Source
from bayesmc.robotics.poses import check_radians

MESSAGES = ("ODOM", "FLASER", "ROBOTLASER1")
"""The messages that are read."""

_SAME_ANGLE = 1e-9
"""Angles in rad that differ by no more are those of one beam: steps and spans of floats round."""

_NAME = re.compile(r"[A-Z][A-Z0-9_-]*", re.ASCII)


def read_carmen(
    source: Source,
    *,
    on_error: OnError = "raise",
    tolerance: float = 0.0,
    messages: Sequence[str] = MESSAGES,
    max_range: float = MAX_RANGE,
    angles: Any = None,
    bad_ranges: BadRanges = "fault",
) -> Reading[Odometry | Laser]:
    """The odometry and the laser scans of a CARMEN log, in the order of its lines.

    ``FLASER`` does not say where its beams point: they are taken to be a SICK's, from -90 degrees on
    at steps of 180/n degrees for an even number n of them, 180/(n - 1) for an odd one.

    Parameters
    ----------
    source : path, open file or iterable of lines
        A path may be gzipped.
    on_error : {"raise", "skip"}
        What becomes of a line that does not read: see `Reading`.
    tolerance : float
        How far, in s, time may run backwards from line to line; ``math.inf`` where it may do as it
        likes, as in logs that GMapping has corrected, whose ``ODOM`` lines repeat the past.
    messages : sequence of str
        Which messages to read; the others are counted as ignored.
    max_range : float
        From which range in m a beam of an ``FLASER`` has seen nothing.
    angles : array_like, shape (beams,), optional
        Of the beams of ``FLASER`` in rad, where the laser is no SICK.
    bad_ranges : {"fault", "max"}
        Whether a scan with NaN, infinite or negative ranges is a fault, or these beams have seen
        nothing.

    Returns
    -------
    Reading
        An iterator of `Odometry` and `Laser`; with ``faults``, ``ignored`` and ``lines``.

    Raises
    ------
    OSError, FileFormatError
        See `Reading`.
    ValueError
        For an argument that makes no sense.

    Examples
    --------
    >>> from bayesmc.robotics.logs import read_carmen
    >>> log = read_carmen([
    ...     "# two messages of interest",
    ...     "PARAM robot_frontlaser_offset 0.0",
    ...     "ODOM 1.0 2.0 0.5 0.2 0.0 0.0 10.0 robot 0.1",
    ...     "FLASER 2 1.5 81.83 1.0 2.0 0.5 1.0 2.0 0.5 10.1 robot 0.2",
    ... ])
    >>> odometry, laser = log
    >>> odometry.pose, laser.ranges, laser.angles.round(3)
    (array([1. , 2. , 0.5]), array([ 1.5 , 81.83]), array([-1.571,  0.   ]))
    >>> dict(log.ignored)
    {'comment': 1, 'PARAM': 1}
    """
    check_ranges("read_carmen", max_range, bad_ranges)
    unknown = [m for m in messages if m not in MESSAGES]
    if isinstance(messages, str) or unknown:
        raise ValueError(f"read_carmen(messages={messages!r}): give some of {MESSAGES}")
    parse = _format(frozenset(messages), max_range, angles, bad_ranges)
    return Reading(source, parse, on_error=on_error, tolerance=tolerance, kind="a CARMEN log")


def write_carmen(
    path: str | os.PathLike[str],
    records: Iterable[Odometry | Laser],
    host: str = "bayesmc",
    *,
    tolerance: float = 0.0,
) -> None:
    """Write odometry and scans as a CARMEN log that `read_carmen` reads back the same.

    A scan becomes an ``FLASER`` where its beams are what the reader takes them to be, else a
    ``ROBOTLASER1``, which states them. Numbers are written in full; the angles of beams, which
    both messages give by a first one and a step, come back to 1e-9 rad. Nothing is written unless all
    records can be.

    Parameters
    ----------
    path : path
        Gzipped if it ends in ``.gz``; an existing file is replaced.
    records : iterable of Odometry and Laser
    host : str
        The name of the computer, which each line has.
    tolerance : float
        How far, in s, time may run backwards, as of `read_carmen`, which will need the same.

    Raises
    ------
    FileFormatError
        For a record that would not read back: NaN or negative ranges, beams that are not evenly
        spaced, a time before the last one's or that leaps ahead and comes back; the message says which.
        For no records at all.
    TypeError
        For any other kind of record.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> from bayesmc.robotics.logs import Odometry, read_carmen, write_carmen
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "world.log.gz"
    ...     write_carmen(path, [Odometry(0.5, [1.0, 2.0, 0.1])])
    ...     list(read_carmen(path))
    [Odometry(t=0.5, pose=array([1. , 2. , 0.1]))]
    """
    if len(host.split()) != 1 or not host.isprintable():
        raise ValueError(f"write_carmen(host={host!r}): give a name without blanks")
    parse = _format(frozenset(MESSAGES), MAX_RANGE, None, "fault")
    if not tolerance >= 0.0:
        raise ValueError(f"write_carmen(tolerance={tolerance!r}): give seconds, 0 or more")
    records = tuple(records)
    if not records:
        raise FileFormatError(
            "write_carmen: there are no records, and a log without lines does not read"
        )
    lines = [_checked_line(k, record, host, parse) for k, record in enumerate(records)]
    _check_order(records, tolerance)
    data = "".join(line + "\n" for line in lines).encode("utf-8")
    # no time stamp in the gzip, so that the same records give the same file
    Path(path).write_bytes(gzip.compress(data, mtime=0) if str(path).endswith(".gz") else data)


def sick_angles(beams: int) -> np.ndarray:
    """Where the beams of an ``FLASER`` message point, in rad against the laser's heading.

    Parameters
    ----------
    beams : int

    Returns
    -------
    ndarray, shape (beams,)
        From -pi/2 on, read-only.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.logs import sick_angles
    >>> np.degrees(sick_angles(180))[[0, 1, -1]].round(9), np.degrees(sick_angles(361))[[0, 1, -1]].round(9)
    (array([-90., -89.,  89.]), array([-90. , -89.5,  90. ]))
    """
    return _even_angles(beams, -math.pi / 2, math.pi / max(1, beams - beams % 2))


@lru_cache(maxsize=64)
def _even_angles(beams: int, start: float, step: float) -> np.ndarray:
    return read_only(start + step * np.arange(beams))


def _format(
    messages: frozenset[str], max_range: float, angles: Any, bad: BadRanges
) -> Format[Odometry | Laser]:
    mounted = None if angles is None else read_only(angles)
    if mounted is not None:
        if mounted.ndim != 1 or not np.isfinite(mounted).all():
            raise ValueError(
                "read_carmen(angles=...): give a vector of finite angles, one per beam"
            )
        check_radians("read_carmen", "angles", mounted)

    def parse(line: str) -> Odometry | Laser | Ignored:
        fields = line.split()
        if not fields:
            return Ignored("blank")
        name = fields[0]
        if name[0] == "#":
            return Ignored("comment")
        if name not in messages:
            return _other(name, fields)
        if name == "ODOM":
            return _odom(fields)
        if name == "FLASER":
            return _flaser(fields, max_range, mounted, bad)
        return _robotlaser(fields, bad)

    return parse


def _other(name: str, fields: list[str]) -> Ignored:
    """What is no message to be read, unless it is none at all or the stump of one."""
    if name not in MESSAGES:
        if name in ("O", "L") and len(fields) > 4:
            raise FileFormatError(
                f"a line that begins with {name} looks like one of a Wean Hall log, which read_wean reads"
            )
        if not _NAME.fullmatch(name):
            raise FileFormatError("the line does not begin with the name of a message")
        if any(message.startswith(name) for message in MESSAGES):
            raise FileFormatError(f"the name of the message is cut off ({name!r})")
    return Ignored(name)


def _odom(fields: list[str]) -> Odometry:
    counted(fields, 10, "ODOM")
    x, y, heading, _, _, _, t = numbers(fields[1:8], 2)
    return Odometry(t, read_only((x, y, heading)))


def _flaser(
    fields: list[str], max_range: float, mounted: np.ndarray | None, bad: BadRanges
) -> Laser:
    beams = _beams(fields, 1, "FLASER")
    counted(fields, 2 + beams + 9, f"FLASER of {beams} beams")
    scan = read_only(ranges(fields[2 : 2 + beams], 3, max_range, bad))
    *poses, t = numbers(fields[2 + beams : 9 + beams], 3 + beams)
    if mounted is not None and mounted.size != beams:
        raise FileFormatError(f"FLASER of {beams} beams, where {mounted.size} angles were given")
    angles = sick_angles(beams) if mounted is None else mounted
    return Laser(t, scan, angles, read_only(poses[3:]), read_only(poses[:3]), max_range)


def _robotlaser(fields: list[str], bad: BadRanges) -> Laser:
    beams = _beams(fields, 8, "ROBOTLASER1")
    after = 9 + beams  # position of the number of remissions
    if len(fields) <= after:
        raise FileFormatError(f"ROBOTLASER1 of {beams} beams breaks off after {len(fields)} fields")
    remissions = whole(fields[after], after + 1)
    counted(fields, after + 1 + remissions + 14, f"ROBOTLASER1 of {beams} beams")
    _, start, _, step, max_range, _ = numbers(fields[1:7], 2)
    if step <= 0.0:
        raise FileFormatError(f"the angle between beams is not positive ({fields[4]})")
    if max_range <= 0.0:
        raise FileFormatError(f"the maximal range is not positive ({fields[5]})")
    scan = read_only(ranges(fields[9:after], 10, max_range, bad))
    numbers(fields[after + 1 : after + 1 + remissions], after + 2)
    first = after + 1 + remissions
    *rest, t = numbers(fields[first : first + 12], first + 1)
    angles = _even_angles(beams, start, step)
    return Laser(t, scan, angles, read_only(rest[3:6]), read_only(rest[:3]), max_range)


def _beams(fields: list[str], place: int, name: str) -> int:
    if len(fields) <= place:
        raise FileFormatError(f"{name} breaks off before its number of beams")
    beams = whole(fields[place], place + 1)
    if beams == 0:
        raise FileFormatError(f"{name} has no beams")
    return beams


def _checked_line(
    k: int, record: Odometry | Laser, host: str, parse: Format[Odometry | Laser]
) -> str:
    """The record's line, where the reader would make the same record of it."""
    if not isinstance(record, (Odometry, Laser)):
        raise TypeError(
            f"write_carmen: record {k} is of type {type(record).__name__}; give Odometry or Laser"
        )
    line = _odom_line(record, host) if isinstance(record, Odometry) else _laser_line(record, host)
    try:
        back = parse(line)
    except FileFormatError as error:
        raise FileFormatError(
            f"write_carmen: record {k} is not fit to be written: {error}"
        ) from None
    if isinstance(record, Laser) and isinstance(back, Laser):
        if not _agree(record.angles, back.angles):
            raise FileFormatError(
                f"write_carmen: record {k} has beams that are not evenly spaced, which no message states"
            )
    return line


def _check_order(records: Sequence[Odometry | Laser], tolerance: float) -> None:
    """Refuse times that the reader would."""
    if tolerance == math.inf:
        return
    for k, _, result in in_order(((k, "", r) for k, r in enumerate(records)), tolerance):
        if isinstance(result, str):
            raise FileFormatError(
                f"write_carmen: record {k} is not fit to be written: {result}; sort with merge(records), or "
                "give tolerance= here and to read_carmen"
            )


def _odom_line(record: Odometry, host: str) -> str:
    time = _number(record.t)
    return " ".join(["ODOM", *map(_number, record.pose), "0 0 0", time, host, time])


def _laser_line(record: Laser, host: str) -> str:
    beams, time = record.ranges.size, _number(record.t)
    scan = list(map(_number, record.ranges))
    at, robot = list(map(_number, record.laser_pose)), list(map(_number, record.pose))
    if record.max_range == MAX_RANGE and _agree(record.angles, sick_angles(beams)):
        return " ".join(["FLASER", str(beams), *scan, *at, *robot, time, host, time])
    start = record.angles[0] if beams else 0.0
    step = (record.angles[-1] - start) / (beams - 1) if beams > 1 else 1.0
    stated = map(_number, (start, step * max(1, beams - 1), step, record.max_range))
    return " ".join(
        ["ROBOTLASER1 0", *stated, "0.01 0", str(beams), *scan, "0", *at, *robot, "0 0 0 0 0"]
        + [time, host, time]
    )


def _agree(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.all(np.abs(a - b) <= _SAME_ANGLE))


def _number(value: float) -> str:
    return repr(float(value))
