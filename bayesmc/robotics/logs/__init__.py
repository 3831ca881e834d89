"""Logs of robots as iterators of typed records, whatever file they come from.

CARMEN, UTIAS MRCLAM, Wean Hall, Plaza and Freiburg's course; faults are reported with their line,
and skipped or raised, as asked. Maps are in ``bayesmc.robotics.mapfile``; nothing here filters or
corrects what a log says, but for Plaza's headings that point backwards (``Plaza.turned``).
"""

from bayesmc.robotics.logs.carmen import read_carmen, sick_angles, write_carmen
from bayesmc.robotics.logs.freiburg import read_freiburg, read_freiburg_world
from bayesmc.robotics.logs.mrclam import (
    Mrclam,
    MrclamRobot,
    read_mrclam,
    read_mrclam_barcodes,
    read_mrclam_landmarks,
    read_mrclam_measurements,
    read_mrclam_truth,
    read_mrclam_velocities,
)
from bayesmc.robotics.logs.plaza import (
    Plaza,
    read_plaza,
    read_plaza_increments,
    read_plaza_ranges,
)
from bayesmc.robotics.logs.reading import LogFault, Reading
from bayesmc.robotics.logs.records import (
    MAX_RANGE,
    UNKNOWN_SUBJECT,
    Barcode,
    GroundTruth,
    Increment,
    Landmark,
    Laser,
    Measurement,
    Odometry,
    RangeOnly,
    Record,
    RotTransRot,
    Timed,
    Velocity,
)
from bayesmc.robotics.logs.tracks import (
    Keyframe,
    heading_offset,
    keyframes,
    merge,
    pose_at,
    stack,
)
from bayesmc.robotics.logs.wean import read_wean

__all__ = [
    "MAX_RANGE", "UNKNOWN_SUBJECT", "Barcode", "GroundTruth", "Increment", "Keyframe", "Landmark",
    "Laser", "LogFault", "Measurement", "Mrclam", "MrclamRobot", "Odometry", "Plaza", "RangeOnly",
    "Reading", "Record", "RotTransRot", "Timed", "Velocity", "heading_offset", "keyframes", "merge",
    "pose_at", "read_carmen", "read_freiburg", "read_freiburg_world", "read_mrclam", "read_mrclam_barcodes",
    "read_mrclam_landmarks", "read_mrclam_measurements", "read_mrclam_truth",
    "read_mrclam_velocities", "read_plaza", "read_plaza_increments", "read_plaza_ranges",
    "read_wean", "sick_angles", "stack", "write_carmen",
]  # fmt: skip
