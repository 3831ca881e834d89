"""UTIAS multi-robot cooperative localisation and mapping (MRCLAM): five robots among 15 landmarks.

A folder holds ``Barcodes.dat``, ``Landmark_Groundtruth.dat``, and for each robot its ``_Odometry``
(velocities), ``_Measurement`` (range and bearing to barcodes) and ``_Groundtruth`` (motion capture);
each may be gzipped. Subjects 1 to 5 are the robots, 6 to 20 the landmarks. The column of
measurements that their header calls subjects are barcodes; the records have subjects.

Leung, Halpern, Barfoot and Liu (2011), The UTIAS multi-robot cooperative localization and mapping
dataset, International Journal of Robotics Research 30(8).
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from bayesmc.errors import FileFormatError
from bayesmc.robotics.logs.reading import (
    Ignored,
    LogFault,
    OnError,
    Reading,
    counted,
    numbers,
    whole,
)
from bayesmc.robotics.logs.records import (
    UNKNOWN_SUBJECT,
    Barcode,
    GroundTruth,
    Landmark,
    Measurement,
    Record,
    Velocity,
    read_only,
)
from bayesmc.robotics.logs.sources import Source

R = TypeVar("R", bound=Record)


@dataclass(frozen=True, eq=False)
class MrclamRobot:
    """What one robot did, saw and where it was.

    Parameters
    ----------
    velocities : tuple of Velocity
    measurements : tuple of Measurement
        Of landmarks, of other robots, and of ``UNKNOWN_SUBJECT``.
    truth : tuple of GroundTruth
    """

    velocities: tuple[Velocity, ...]
    measurements: tuple[Measurement, ...]
    truth: tuple[GroundTruth, ...]


@dataclass(frozen=True, eq=False)
class Mrclam:
    """One of the datasets, or some robots of it.

    Parameters
    ----------
    robots : mapping of int to MrclamRobot
        By subject.
    landmarks : mapping of int to ndarray, shape (2,)
        Where each stands, in m, by subject.
    barcodes : mapping of int to int
        The subject that wears a barcode.
    faults : mapping of str to tuple of LogFault
        The lines left out, by file; files without any are not named.
    """

    robots: Mapping[int, MrclamRobot]
    landmarks: Mapping[int, np.ndarray]
    barcodes: Mapping[int, int]
    faults: Mapping[str, tuple[LogFault, ...]]


def read_mrclam(
    folder: str | os.PathLike[str],
    robots: Iterable[int] | None = None,
    *,
    on_error: OnError = "raise",
    tolerance: float = 0.0,
) -> Mrclam:
    """A whole dataset out of its folder.

    Parameters
    ----------
    folder : path
        Files end in ``.dat`` or ``.dat.gz``.
    robots : iterable of int, optional
        Which robots; all that the folder has a file of, if left out.
    on_error : {"raise", "skip"}
        What becomes of a line that does not read: see `Reading`.
    tolerance : float
        How far, in s, time may run backwards from line to line.

    Raises
    ------
    FileNotFoundError
        For a file that is missing; a robot needs its three.
    FileFormatError
        See `Reading`; and where two subjects wear one barcode.
    """
    folder = Path(folder)
    faults: dict[str, tuple[LogFault, ...]] = {}

    def everything(stem: str, read: Callable[..., Reading[R]], **options: Any) -> tuple[R, ...]:
        reading = read(_file(folder, stem), on_error=on_error, **options)
        records = tuple(reading)
        if reading.faults:
            faults[Path(reading.name).name] = reading.faults
        return records

    subjects = _subjects(everything("Barcodes", read_mrclam_barcodes), folder)
    stand = everything("Landmark_Groundtruth", read_mrclam_landmarks)
    timed = {"tolerance": tolerance}
    seen = {"barcodes": subjects, **timed}
    found = {
        k: MrclamRobot(
            everything(f"Robot{k}_Odometry", read_mrclam_velocities, **timed),
            everything(f"Robot{k}_Measurement", read_mrclam_measurements, **seen),
            everything(f"Robot{k}_Groundtruth", read_mrclam_truth, **timed),
        )
        for k in (_present(folder) if robots is None else robots)
    }
    return Mrclam(
        MappingProxyType(found),
        MappingProxyType({landmark.subject: landmark.position for landmark in stand}),
        MappingProxyType(subjects),
        MappingProxyType(faults),
    )


def read_mrclam_velocities(
    source: Source, *, on_error: OnError = "raise", tolerance: float = 0.0
) -> Reading[Velocity]:
    """Velocities out of a robot's ``_Odometry.dat``.

    Parameters
    ----------
    source : path, open file or iterable of lines
    on_error, tolerance
        See `Reading`.

    Examples
    --------
    >>> from bayesmc.robotics.logs import read_mrclam_velocities
    >>> list(read_mrclam_velocities(["# Time v omega", "1248444187.156  0.086  -0.398"]))
    [Velocity(t=1248444187.156, v=0.086, omega=-0.398)]
    """

    def parse(line: str) -> Velocity | Ignored:
        fields = line.split()
        return _passed(fields) or Velocity(*_row(fields, 3, "a line of odometry"))

    return Reading(source, parse, on_error=on_error, tolerance=tolerance, kind="a table of MRCLAM")


def read_mrclam_measurements(
    source: Source,
    barcodes: Mapping[int, int],
    *,
    on_error: OnError = "raise",
    tolerance: float = 0.0,
) -> Reading[Measurement]:
    """Ranges and bearings out of a robot's ``_Measurement.dat``.

    Parameters
    ----------
    source : path, open file or iterable of lines
    barcodes : mapping of int to int
        The subject that wears a barcode; any other barcode is ``UNKNOWN_SUBJECT``, and no fault: the
        line is sound, the camera misread.
    on_error, tolerance
        See `Reading`.

    Examples
    --------
    >>> from bayesmc.robotics.logs import read_mrclam_measurements
    >>> list(read_mrclam_measurements(["1248444189.599  61  6.6  -0.022"], {61: 14}))
    [Measurement(t=1248444189.599, subject=14, range=6.6, bearing=-0.022)]
    """
    subjects = dict(barcodes)

    def parse(line: str) -> Measurement | Ignored:
        fields = line.split()
        if passed := _passed(fields):
            return passed
        t, _, distance, bearing = _row(fields, 4, "a measurement")
        if distance < 0.0:
            raise FileFormatError(f"the range is negative ({fields[2]})")
        subject = subjects.get(whole(fields[1], 2), UNKNOWN_SUBJECT)
        return Measurement(t, subject, distance, bearing)

    return Reading(source, parse, on_error=on_error, tolerance=tolerance, kind="a table of MRCLAM")


def read_mrclam_truth(
    source: Source, *, on_error: OnError = "raise", tolerance: float = 0.0
) -> Reading[GroundTruth]:
    """Poses out of a robot's ``_Groundtruth.dat``.

    Parameters
    ----------
    source : path, open file or iterable of lines
    on_error, tolerance
        See `Reading`.

    Examples
    --------
    >>> from bayesmc.robotics.logs import read_mrclam_truth
    >>> list(read_mrclam_truth(["1248444175.103  1.4  -3.9  2.2"]))
    [GroundTruth(t=1248444175.103, pose=array([ 1.4, -3.9,  2.2]))]
    """

    def parse(line: str) -> GroundTruth | Ignored:
        fields = line.split()
        if passed := _passed(fields):
            return passed
        t, *pose = _row(fields, 4, "a line of truth")
        return GroundTruth(t, read_only(pose))

    return Reading(source, parse, on_error=on_error, tolerance=tolerance, kind="a table of MRCLAM")


def read_mrclam_landmarks(source: Source, *, on_error: OnError = "raise") -> Reading[Landmark]:
    """Where the landmarks stand, out of ``Landmark_Groundtruth.dat``.

    Parameters
    ----------
    source : path, open file or iterable of lines
    on_error
        See `Reading`.

    Examples
    --------
    >>> from bayesmc.robotics.logs import read_mrclam_landmarks
    >>> (landmark,) = read_mrclam_landmarks(["6  0.5  -4.25  0.0001  0.0002"])
    >>> landmark.subject, landmark.position
    (6, array([ 0.5 , -4.25]))
    """

    def parse(line: str) -> Landmark | Ignored:
        fields = line.split()
        if passed := _passed(fields):
            return passed
        _, x, y, sd_x, sd_y = _row(fields, 5, "a landmark")
        return Landmark(whole(fields[0], 1), read_only((x, y)), read_only((sd_x, sd_y)))

    return Reading(source, parse, on_error=on_error, kind="a table of MRCLAM")


def read_mrclam_barcodes(source: Source, *, on_error: OnError = "raise") -> Reading[Barcode]:
    """Who wears which barcode, out of ``Barcodes.dat``.

    Parameters
    ----------
    source : path, open file or iterable of lines
    on_error
        See `Reading`.

    Examples
    --------
    >>> from bayesmc.robotics.logs import read_mrclam_barcodes
    >>> list(read_mrclam_barcodes([" 14   61"]))
    [Barcode(subject=14, barcode=61)]
    """

    def parse(line: str) -> Barcode | Ignored:
        fields = line.split()
        if passed := _passed(fields):
            return passed
        counted(fields, 2, "a barcode")
        return Barcode(whole(fields[0], 1), whole(fields[1], 2))

    return Reading(source, parse, on_error=on_error, kind="a table of MRCLAM")


def _passed(fields: list[str]) -> Ignored | None:
    if not fields:
        return Ignored("blank")
    return Ignored("comment") if fields[0][0] == "#" else None


def _row(fields: list[str], count: int, what: str) -> list[float]:
    counted(fields, count, what)
    return numbers(fields)


def _subjects(wear: Iterable[Barcode], folder: Path) -> dict[int, int]:
    subjects: dict[int, int] = {}
    for subject, barcode in ((w.subject, w.barcode) for w in wear):
        if subjects.setdefault(barcode, subject) != subject:
            raise FileFormatError(
                f"barcode {barcode} is worn by subjects {subjects[barcode]} and {subject}; one is wrong",
                _file(folder, "Barcodes"),
            )
    return subjects


def _file(folder: Path, stem: str) -> Path:
    for name in (f"{stem}.dat", f"{stem}.dat.gz"):
        if (folder / name).is_file():
            return folder / name
    raise FileNotFoundError(f"read_mrclam: {folder} has neither {stem}.dat nor {stem}.dat.gz")


def _present(folder: Path) -> list[int]:
    names = (re.match(r"Robot(\d+)_", path.name) for path in folder.iterdir())
    return sorted({int(match[1]) for match in names if match})
