"""``Laser``: where the beams of a range finder point, and which of its readings are returns.

What a reading says of a map or a pose is not decided here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.errors import ModelError, ParameterError, ShapeError
from bayesmc.robotics.grid import as_number
from bayesmc.robotics.poses import check_radians
from bayesmc.shapes import owned

#: numbers beyond its longest range with which a range finder may say that nothing came back
_CODES = 4


@dataclass(frozen=True, eq=False)
class Laser:
    """The geometry of a range finder.

    Parameters
    ----------
    angles : array_like, shape (beams,)
        Of the beams against the laser's heading (rad).
    max_range : float
        Range (m) from which on a reading is no return; so are those that are not positive, or not finite.
    mount : (float, float, float)
        Pose of the laser in the robot's frame (m, m, rad).

    Raises
    ------
    ShapeError
        Angles have more than one axis, or there is no beam.
    ParameterError
        An angle is not finite or beyond a full turn (in degrees, most likely); the range is not
        positive and finite; the mount is not three finite numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics import Laser
    >>> Laser(np.deg2rad([-90.0, 0.0, 90.0])).ends([1.0, np.inf, 2.0]).round(3).tolist()
    [[0.0, -1.0], [0.0, 2.0]]
    """

    angles: np.ndarray
    max_range: float = 80.0
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        angles = owned(self.angles, float)
        if angles.ndim != 1 or not angles.size:
            raise ShapeError(
                f"Laser: angles have shape {angles.shape}; give (beams,), one beam or more"
            )
        if not np.isfinite(angles).all():
            raise ParameterError("Laser: an angle is not finite")
        check_radians("Laser", "angles", angles)
        object.__setattr__(self, "angles", angles)
        if not 0 < as_number(self.max_range) < math.inf:
            raise ParameterError(
                f"Laser: max_range must be positive and finite (m); got {self.max_range!r:.80}"
            )
        mount = [as_number(part) for part in self.mount] if np.ndim(self.mount) == 1 else []
        if len(mount) != 3 or not np.isfinite(mount).all():
            raise ParameterError(
                f"Laser: mount must be three finite numbers; got {self.mount!r:.80}"
            )
        check_radians("Laser", "headings of a mount", np.array(mount[2:]))

    def returns(self, ranges: np.ndarray) -> np.ndarray:
        """Which readings are returns, a bool for each.

        Raises
        ------
        ModelError
            There is none, and the readings beyond ``max_range`` are no code for that: see ``check_metres``.
        """
        with np.errstate(invalid="ignore"):
            found = np.asarray((ranges > 0) & (ranges < self.max_range))
        if not found.any():
            check_metres("Laser", ranges, self.max_range)
        return found

    def ends(self, ranges: Any) -> np.ndarray:
        """End points of one scan's returns in the robot's frame (m), shape (returns, 2)."""
        ranges = as_scans("Laser", self, ranges)
        used = self.returns(ranges)
        return self._at(ranges[used], self._directions[used])

    def passed(self, ranges: Any, spacing: float) -> np.ndarray:
        """Points along the beams of one scan's returns, short of their ends (m), shape (points, 2)."""
        ranges = as_scans("Laser", self, ranges)
        used = self.returns(ranges)
        ranges, directions = ranges[used], self._directions[used]
        counts = np.maximum(np.floor(ranges / spacing - 0.5).astype(np.int64), 0)
        beam = np.repeat(np.arange(len(ranges)), counts)
        first = np.repeat(np.cumsum(counts) - counts, counts)
        return self._at((np.arange(len(beam)) - first) * spacing, directions[beam])

    @cached_property
    def _directions(self) -> np.ndarray:
        beam = self.angles + self.mount[2]
        return np.stack([np.cos(beam), np.sin(beam)], axis=-1)

    def _at(self, ranges: np.ndarray, directions: np.ndarray) -> np.ndarray:
        return np.asarray(ranges[:, None] * directions + np.array(self.mount[:2], dtype=float))

    def __repr__(self) -> str:
        return f"Laser({len(self.angles)} beams, max_range={self.max_range:g})"


def check_metres(call: str, ranges: np.ndarray, max_range: float) -> None:
    """Refuse a scan without a return whose readings are many different ones beyond the longest range.

    What a range finder says where nothing came back is one number, or not finite; ranges in millimetres, or
    a ``max_range`` that is too short, leave out every return, and the scan would say nothing.

    Raises
    ------
    ModelError
    """
    with np.errstate(invalid="ignore"):
        beyond = ranges[(ranges >= max_range) & np.isfinite(ranges)]
    if len(np.unique(beyond)) > max(_CODES, beyond.size // 4):
        raise ModelError(
            f"{call}: of {ranges.size} readings of a scan none is a return: they are {beyond.min():.4g} to "
            f"{beyond.max():.4g} m, and max_range is {max_range:g} m; are they in millimetres? Give metres, "
            "or the laser's own max_range"
        )


def as_scans(call: str, laser: Laser, ranges: Any) -> np.ndarray:
    """Readings as floats, shape (..., beams).

    Raises
    ------
    ShapeError
        Another number of readings than beams.
    """
    ranges = np.asarray(ranges, dtype=float)
    beams = len(laser.angles)
    if ranges.ndim == 0 or ranges.shape[-1] != beams:
        raise ShapeError(
            f"{call}: ranges have shape {ranges.shape}, and the laser has {beams} beams; give (..., "
            f"{beams}): one "
            "range for each angle, NaN or its max_range where nothing came back"
        )
    return ranges
