"""Robots: poses, motion, sensors, maps and logs; each piece a conditional density for any dynamic Bayes net.

Nothing here filters: a robot's belief is that of a ``DynamicBayesNet`` whose transition is one of ``motion``
and whose sensors are ``landmarks``, ``beams`` or ``field``, and every engine over time runs on it. Lengths
are metres, angles radians, times seconds.
"""

from __future__ import annotations

from bayesmc.robotics.aimed import AimedPoses, SensorPoses
from bayesmc.robotics.beam_fit import BeamFit, fit_beams
from bayesmc.robotics.beams import BeamModel, Beams, clean_ranges
from bayesmc.robotics.brightness import Ceiling
from bayesmc.robotics.calibration import FieldFit, fit_field, fit_floor, fit_odometry
from bayesmc.robotics.field import FieldScan, LikelihoodField
from bayesmc.robotics.free_space import FreeSpace
from bayesmc.robotics.grid import OccupancyGrid
from bayesmc.robotics.grid_map import GridMap
from bayesmc.robotics.grid_mapping import ScanMapper
from bayesmc.robotics.landmarks import (
    bearing,
    bearing_to,
    cone_range,
    range_and_bearing,
    range_only,
    range_to,
    sonar,
)
from bayesmc.robotics.laser import Laser
from bayesmc.robotics.map_field import MapField, MapScan
from bayesmc.robotics.mapfile import read_map, write_map
from bayesmc.robotics.motion import OdometryMotion, VelocityMotion
from bayesmc.robotics.placing import PlaceCheck, check_poses
from bayesmc.robotics.pose_distributions import AndAngle, PoseNormal
from bayesmc.robotics.poses import (
    angle_between,
    between,
    compass,
    compose,
    inverse,
    mean_pose,
    pose_errors,
    transform,
    wrap,
)
from bayesmc.robotics.raycast import RayTable, ray_cast
from bayesmc.robotics.scan_matching import ScanMatcher
from bayesmc.robotics.steps import euler_step, unicycle

__all__ = [
    "AimedPoses",
    "AndAngle",
    "BeamFit",
    "BeamModel",
    "Beams",
    "Ceiling",
    "FieldFit",
    "FieldScan",
    "FreeSpace",
    "GridMap",
    "Laser",
    "LikelihoodField",
    "MapField",
    "MapScan",
    "OccupancyGrid",
    "OdometryMotion",
    "PlaceCheck",
    "PoseNormal",
    "RayTable",
    "ScanMapper",
    "ScanMatcher",
    "SensorPoses",
    "VelocityMotion",
    "angle_between",
    "bearing",
    "bearing_to",
    "between",
    "check_poses",
    "clean_ranges",
    "compass",
    "compose",
    "cone_range",
    "euler_step",
    "fit_beams",
    "fit_field",
    "fit_floor",
    "fit_odometry",
    "inverse",
    "mean_pose",
    "pose_errors",
    "range_and_bearing",
    "range_only",
    "range_to",
    "ray_cast",
    "read_map",
    "sonar",
    "transform",
    "unicycle",
    "wrap",
    "write_map",
]
