"""What a robot's log says, one frozen value per line: odometry, scans, measurements, truth.

Lengths are in metres, angles in radians, times in seconds; a pose is ``[x, y, heading]`` with heading
0 along +x and counterclockwise positive. Headings are kept as they were logged, not wrapped. Which
file says it how is the business of the readers; nothing here opens a file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from bayesmc.errors import ParameterError, ShapeError
from bayesmc.robotics.poses import between

MAX_RANGE = 80.0
"""Range in m from which a SICK laser has seen nothing; its logs say 81.83 or 81.91 then."""

UNKNOWN_SUBJECT = 0
"""Subject of a measurement whose barcode is nobody's: a misread one, most likely."""


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """Base of all records: equal where every field is, arrays element by element (NaN equals NaN)."""

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(
            np.array_equal(getattr(self, f.name), getattr(other, f.name), equal_nan=True)
            for f in fields(self)
        )


@dataclass(frozen=True, slots=True, eq=False)
class Timed(Record):
    """A record with a time.

    Parameters
    ----------
    t : float
        Time in s; from which moment it counts is the log's affair.
    """

    t: float


@dataclass(frozen=True, slots=True, eq=False)
class Odometry(Timed):
    """Where the wheels say that the robot is.

    Parameters
    ----------
    t : float
    pose : ndarray, shape (3,)
        In the frame of the odometry, which drifts.
    """

    pose: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", _vector(self, "pose", 3))


@dataclass(frozen=True, slots=True, eq=False)
class GroundTruth(Timed):
    """Where the robot really was, by motion capture or GPS.

    Parameters
    ----------
    t : float
    pose : ndarray, shape (3,)
    """

    pose: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", _vector(self, "pose", 3))


@dataclass(frozen=True, slots=True, eq=False)
class Laser(Timed):
    """One scan of a laser range finder.

    Parameters
    ----------
    t : float
    ranges : ndarray, shape (beams,)
        In m; at ``max_range`` and beyond nothing was seen.
    angles : ndarray, shape (beams,)
        Of the beams against the laser's heading.
    pose : ndarray, shape (3,)
        Of the robot, by odometry unless the log was corrected.
    laser_pose : ndarray, shape (3,), optional
        Of the laser, in the same frame; the robot's if left out.
    max_range : float
        In m, positive.

    Raises
    ------
    ShapeError
        Where angles and ranges do not match, or a pose is not three numbers.
    ParameterError
        For a time that is not finite, or a ``max_range`` that is not positive.

    Examples
    --------
    >>> from bayesmc.robotics.logs import Laser
    >>> scan = Laser(0.0, [2.0, 81.83], [-0.5, 0.5], [1.0, 1.0, 0.0], [1.25, 1.0, 0.0])
    >>> scan.returned
    array([ True, False])
    >>> scan.offset
    array([0.25, 0.  , 0.  ])
    """

    ranges: np.ndarray
    angles: np.ndarray
    pose: np.ndarray
    laser_pose: np.ndarray = None  # type: ignore[assignment]  # set to the pose below
    max_range: float = MAX_RANGE

    def __post_init__(self) -> None:
        if not math.isfinite(self.t):
            raise ParameterError(f"Laser: t must be finite; got {self.t}")
        if not self.max_range > 0.0:
            raise ParameterError(f"Laser: max_range must be positive; got {self.max_range}")
        if self.laser_pose is None:
            object.__setattr__(self, "laser_pose", self.pose)
        for name, size in (("ranges", None), ("angles", None), ("pose", 3), ("laser_pose", 3)):
            object.__setattr__(self, name, _vector(self, name, size))
        if self.ranges.shape != self.angles.shape:
            raise ShapeError(
                f"Laser: {self.ranges.size} ranges and {self.angles.size} angles; give each beam one of both"
            )

    @property
    def returned(self) -> np.ndarray:
        """Which beams saw something, shape ``(beams,)``."""
        return self.ranges < self.max_range

    @property
    def offset(self) -> np.ndarray:
        """Pose of the laser seen from the robot, shape ``(3,)``."""
        return between(self.pose, self.laser_pose)


@dataclass(frozen=True, slots=True, eq=False)
class Measurement(Timed):
    """Range and bearing to something known by its number.

    Parameters
    ----------
    t : float
    subject : int
        What was seen; ``UNKNOWN_SUBJECT`` where the log does not tell.
    range : float
        In m.
    bearing : float
        In rad, against the robot's heading.
    """

    subject: int
    range: float
    bearing: float


@dataclass(frozen=True, slots=True, eq=False)
class RangeOnly(Timed):
    """The distance of a radio beacon.

    Parameters
    ----------
    t : float
    beacon : int
    range : float
        In m, with whatever bias the radio has.
    """

    beacon: int
    range: float


@dataclass(frozen=True, slots=True, eq=False)
class Velocity(Timed):
    """Forward and turning speed from ``t`` to the next such record.

    Parameters
    ----------
    t : float
    v : float
        In m/s.
    omega : float
        In rad/s.
    """

    v: float
    omega: float


@dataclass(frozen=True, slots=True, eq=False)
class Increment(Timed):
    """How far the robot drove and turned between the last such record and this one.

    Parameters
    ----------
    t : float
        At the end of the step.
    distance : float
        In m.
    turn : float
        In rad.
    """

    distance: float
    turn: float


@dataclass(frozen=True, slots=True, eq=False)
class RotTransRot(Timed):
    """A step of odometry as a turn, a straight line and a second turn.

    Parameters
    ----------
    t : float
        At the end of the step.
    rot1 : float
        In rad.
    trans : float
        In m.
    rot2 : float
        In rad.
    """

    rot1: float
    trans: float
    rot2: float


@dataclass(frozen=True, slots=True, eq=False)
class Landmark(Record):
    """Where a landmark stands.

    Parameters
    ----------
    subject : int
    position : ndarray, shape (2,)
        In m.
    sd : ndarray, shape (2,)
        Standard deviation of the position in m; zeros where it is exact.
    """

    subject: int
    position: np.ndarray
    sd: np.ndarray = None  # type: ignore[assignment]  # set to zeros below

    def __post_init__(self) -> None:
        if self.sd is None:
            object.__setattr__(self, "sd", np.zeros(2))
        for name in ("position", "sd"):
            object.__setattr__(self, name, _vector(self, name, 2))


@dataclass(frozen=True, slots=True, eq=False)
class Barcode(Record):
    """Which barcode a subject wears.

    Parameters
    ----------
    subject : int
    barcode : int
    """

    subject: int
    barcode: int


def read_only(values: object) -> np.ndarray:
    """A new array of floats that cannot be changed; records keep such a one without copying it."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def _vector(record: Record, name: str, size: int | None) -> np.ndarray:
    """A field as a vector that nobody else can change."""
    value = getattr(record, name)
    is_own = type(value) is np.ndarray and value.dtype == np.float64 and _is_fixed(value)
    array = value if is_own else read_only(value)
    if array.ndim != 1 or (size is not None and array.size != size):
        expected = "a vector" if size is None else f"{size} numbers"
        raise ShapeError(
            f"{type(record).__name__}: {name} has shape {array.shape}; give {expected}"
        )
    return array


def _is_fixed(array: np.ndarray) -> bool:
    flags = array.flags
    return flags.owndata and not flags.writeable
