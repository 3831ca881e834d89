"""The range-only data of Carnegie Mellon's Plaza: a mowing robot, radio beacons and GPS.

A folder holds, by example, ``Plaza1_DR.txt`` (time, distance and turn by dead reckoning),
``Plaza1_TD.txt`` (time, the robot's radio, beacon, range) and ``Plaza1_.mat`` with the beacons'
places and the truth. Ranges come with a bias of nearly 3 m, which is left to the model. The headings
that stand beside the surveyed positions of Plaza 2 are turned by pi against the way the robot drives;
they are turned back (``Plaza.turned``).

Djugash, Hamner and Roth (2009), Navigating with ranging radios: five data sets with ground truth,
Journal of Field Robotics 26(9).
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from bayesmc.errors import FileFormatError
from bayesmc.robotics.logs.reading import (
    Ignored,
    LogFault,
    OnError,
    Reading,
    counted,
    numbers,
)
from bayesmc.robotics.logs.records import GroundTruth, Increment, RangeOnly, read_only
from bayesmc.robotics.logs.sources import Source
from bayesmc.robotics.logs.tracks import heading_offset, merge
from bayesmc.robotics.poses import wrap

#: how far from pi, in rad, headings may be off and count as turned round
_BACKWARDS = 0.5
#: metres that must have been driven for that to be said
_FAR = 5.0


@dataclass(frozen=True, eq=False)
class Plaza:
    """One drive on the Plaza.

    Parameters
    ----------
    increments : tuple of Increment
        Dead reckoning.
    ranges : tuple of RangeOnly
        In order of time, which the file's lines are not quite.
    beacons : mapping of int to ndarray, shape (2,)
        Where each beacon stands, in m.
    truth : tuple of GroundTruth
        By GPS. Headings point the way the robot drives: those of a file that point backwards throughout, as
        in Plaza 2, are turned by pi.
    faults : mapping of str to tuple of LogFault
        The lines left out, by file; files without any are not named.
    turned : float
        What was added to the file's headings, in rad: 0, or pi where they pointed backwards.
    """

    increments: tuple[Increment, ...]
    ranges: tuple[RangeOnly, ...]
    beacons: Mapping[int, np.ndarray]
    truth: tuple[GroundTruth, ...]
    faults: Mapping[str, tuple[LogFault, ...]]
    turned: float = 0.0


def read_plaza(
    folder: str | os.PathLike[str], name: str = "Plaza1", *, on_error: OnError = "raise"
) -> Plaza:
    """A whole drive out of its folder.

    Headings of the truth that point backwards throughout, by the surveyed positions and the sign of the
    distances driven, are turned by pi; ``turned`` of the result says so.

    Parameters
    ----------
    folder : path
    name : str
        What its files' names begin with.
    on_error : {"raise", "skip"}
        What becomes of a line that does not read: see `Reading`.

    Raises
    ------
    OSError
        For a file that is missing.
    FileFormatError
        For a ``.mat`` file that does not read or lacks ``TL`` or ``GT``; for lines see `Reading`.
    """
    folder = Path(folder)
    increments = read_plaza_increments(folder / f"{name}_DR.txt", on_error=on_error)
    readings = read_plaza_ranges(folder / f"{name}_TD.txt", on_error=on_error)
    beacons, truth = _tables(folder / f"{name}_.mat")
    steps, seen = tuple(increments), merge(readings)
    by_file = {Path(r.name).name: r.faults for r in (increments, readings) if r.faults}
    truth, turned = _forwards(truth, steps)
    return Plaza(steps, seen, beacons, truth, MappingProxyType(by_file), turned)


def read_plaza_increments(
    source: Source, *, on_error: OnError = "raise", tolerance: float = 0.0
) -> Reading[Increment]:
    """Dead reckoning out of a ``_DR.txt``.

    Parameters
    ----------
    source : path, open file or iterable of lines
    on_error, tolerance
        See `Reading`.

    Examples
    --------
    >>> from bayesmc.robotics.logs import read_plaza_increments
    >>> list(read_plaza_increments(["3.8570e+003 2.0e-001 -5.2e-002"]))
    [Increment(t=3857.0, distance=0.2, turn=-0.052)]
    """
    return Reading(
        source, _increment, on_error=on_error, tolerance=tolerance, kind="a table of Plaza"
    )


def read_plaza_ranges(
    source: Source, *, on_error: OnError = "raise", tolerance: float = math.inf
) -> Reading[RangeOnly]:
    """Ranges out of a ``_TD.txt``, in the order of its lines.

    Parameters
    ----------
    source : path, open file or iterable of lines
    on_error : {"raise", "skip"}
        See `Reading`.
    tolerance : float
        Times may come in any order: in Plaza 1 the lines go back by a minute twice, and the ranges
        on both sides agree with the truth at the times they state. `merge` sorts them.

    Examples
    --------
    >>> from bayesmc.robotics.logs import read_plaza_ranges
    >>> list(read_plaza_ranges(["3.8580e+003 2.0e+000 5.0e+000 6.5466e+001"]))
    [RangeOnly(t=3858.0, beacon=5, range=65.466)]
    """
    return Reading(source, _range, on_error=on_error, tolerance=tolerance, kind="a table of Plaza")


def _increment(line: str) -> Increment | Ignored:
    fields = line.split()
    if not fields:
        return Ignored("blank")
    counted(fields, 3, "a line of dead reckoning")
    return Increment(*numbers(fields))


def _range(line: str) -> RangeOnly | Ignored:
    fields = line.split()
    if not fields:
        return Ignored("blank")
    counted(fields, 4, "a line of ranges")
    t, _, beacon, distance = numbers(fields)
    if beacon < 0 or beacon != math.floor(beacon):
        raise FileFormatError(f"field 3 is not the number of a beacon ({fields[2]})")
    if distance < 0.0:
        raise FileFormatError(f"the range is negative ({fields[3]})")
    return RangeOnly(t, int(beacon), distance)


def _forwards(
    truth: tuple[GroundTruth, ...], steps: tuple[Increment, ...]
) -> tuple[tuple[GroundTruth, ...], float]:
    """The truth with headings that point forwards, and by how much they were turned."""
    if sum(step.distance for step in steps) < _FAR:
        return truth, 0.0  # driven in reverse, or hardly at all: nothing can be said
    offset = heading_offset(truth)
    if not abs(offset) > math.pi - _BACKWARDS:  # NaN, too
        return truth, 0.0
    turn = np.array([0.0, 0.0, math.pi])
    return tuple(
        GroundTruth(r.t, np.append(r.pose[:2], wrap((r.pose + turn)[2]))) for r in truth
    ), math.pi


def _tables(path: Path) -> tuple[Mapping[int, np.ndarray], tuple[GroundTruth, ...]]:
    from scipy.io import loadmat

    path.open("rb").close()  # scipy would look for other names
    try:
        content = loadmat(path, variable_names=("TL", "GT"))
    except Exception as error:  # scipy lets through whatever its parser meets
        raise FileFormatError(f"not readable as a MATLAB file: {error}", path) from error
    beacons = _table(content, "TL", 3, path)
    truth = _table(content, "GT", 4, path)
    places = {}
    for row in beacons:
        places[int(row[0])] = read_only(row[1:])
    return MappingProxyType(places), tuple(GroundTruth(float(r[0]), r[1:]) for r in truth)


def _table(content: Mapping, name: str, columns: int, path: Path) -> np.ndarray:
    table = content.get(name)
    if not isinstance(table, np.ndarray) or table.ndim != 2 or table.shape[1] != columns:
        raise FileFormatError(f"the file needs a table {name} of {columns} columns", path)
    if table.dtype.kind not in "iuf" or not np.isfinite(table).all():
        raise FileFormatError(f"the table {name} holds what are no finite numbers", path)
    return table.astype(np.float64)
