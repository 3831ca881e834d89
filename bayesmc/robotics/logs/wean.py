"""Logs of Wean Hall, as the robotics courses of Carnegie Mellon hand them out with its map.

Lines are ``O x y theta t`` for odometry and ``L x y theta xl yl thetal r1 .. rn t`` for a scan, with the
robot's and the laser's pose by odometry. The file is in cm and rad; the records are in m. The
laser sits 25 cm ahead of the robot's centre, and its beams are a degree apart from -90 degrees on.
"""

from __future__ import annotations

import math

import numpy as np

from bayesmc.errors import FileFormatError
from bayesmc.robotics.logs.carmen import sick_angles
from bayesmc.robotics.logs.reading import (
    BadRanges,
    Ignored,
    OnError,
    Reading,
    check_ranges,
    counted,
    numbers,
    ranges,
)
from bayesmc.robotics.logs.records import MAX_RANGE, Laser, Odometry, read_only
from bayesmc.robotics.logs.sources import Source

_CM = 0.01


def read_wean(
    source: Source,
    *,
    on_error: OnError = "raise",
    tolerance: float = 0.0,
    beams: int = 180,
    max_range: float = MAX_RANGE,
    bad_ranges: BadRanges = "fault",
) -> Reading[Odometry | Laser]:
    """The odometry and the laser scans of a Wean Hall log, in m, in the order of its lines.

    Parameters
    ----------
    source : path, open file or iterable of lines
        A path may be gzipped.
    on_error : {"raise", "skip"}
        What becomes of a line that does not read: see `Reading`.
    tolerance : float
        How far, in s, time may run backwards from line to line.
    beams : int
        How many a scan has.
    max_range : float
        From which range in m a beam has seen nothing.
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
    >>> from bayesmc.robotics.logs import read_wean
    >>> (scan,) = read_wean(["L 100 0 0 125 0 0 250 8183 0.5"], beams=2)
    >>> scan.pose, scan.offset, scan.ranges, scan.t
    (array([1., 0., 0.]), array([0.25, 0.  , 0.  ]), array([ 2.5 , 81.83]), 0.5)
    """
    check_ranges("read_wean", max_range, bad_ranges)
    if beams < 1:
        raise ValueError(f"read_wean(beams={beams!r}): give 1 or more")

    def parse(line: str) -> Odometry | Laser | Ignored:
        fields = line.split()
        if not fields:
            return Ignored("blank")
        if fields[0][0] == "#":
            return Ignored("comment")
        if fields[0] == "O":
            return _odometry(fields)
        if fields[0] == "L":
            return _laser(fields, beams, max_range, bad_ranges)
        raise FileFormatError("the line begins with neither O nor L")

    return Reading(source, parse, on_error=on_error, tolerance=tolerance, kind="a Wean Hall log")


def _odometry(fields: list[str]) -> Odometry:
    counted(fields, 5, "O")
    *pose, t = numbers(fields[1:], 2)
    return Odometry(t, _in_metres(pose))


def _laser(fields: list[str], beams: int, max_range: float, bad: BadRanges) -> Laser:
    counted(fields, 7 + beams + 1, f"L of {beams} beams")
    poses = numbers(fields[1:7], 2)
    scan = _CM * np.array(ranges(fields[7:-1], 8, math.inf, bad))
    scan[np.isinf(scan)] = max_range  # exactly so, whatever cm and m round to
    (t,) = numbers(fields[-1:], len(fields))
    robot, laser = _in_metres(poses[:3]), _in_metres(poses[3:])
    return Laser(t, read_only(scan), sick_angles(beams), robot, laser, max_range)


def _in_metres(pose: list[float]) -> np.ndarray:
    x, y, heading = pose
    return read_only((_CM * x, _CM * y, heading))
