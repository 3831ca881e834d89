"""The simulated robot of Freiburg's course: odometry in steps, and landmarks that it sees.

``sensor_data.dat`` has lines ``ODOMETRY rot1 trans rot2`` and, after each, ``SENSOR id range bearing``
for the landmarks in view; ``world.dat`` has ``id x y``. There are no times: the step's number stands
for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from bayesmc.errors import FileFormatError
from bayesmc.robotics.logs.reading import Ignored, OnError, Reading, counted, numbers, whole
from bayesmc.robotics.logs.records import Landmark, Measurement, RotTransRot
from bayesmc.robotics.logs.sources import Source


def read_freiburg(
    source: Source, *, on_error: OnError = "raise"
) -> Reading[RotTransRot | Measurement]:
    """The steps and the measurements of a ``sensor_data.dat``, in the order of its lines.

    Parameters
    ----------
    source : path, open file or iterable of lines
    on_error : {"raise", "skip"}
        What becomes of a line that does not read: see `Reading`. An ``ODOMETRY`` line counts as a step
        even where the rest of it is garbled, so that later steps keep their number.

    Returns
    -------
    Reading
        An iterator of `RotTransRot` and `Measurement`; ``t`` is the number of the step, from 1, or 0
        for what is seen before the first. A range may be negative: the simulation adds noise to
        distances near zero.

    Examples
    --------
    >>> from bayesmc.robotics.logs import read_freiburg
    >>> step, seen = read_freiburg(["ODOMETRY 0.1 1.0 0.0", "SENSOR 3 1.9 0.37"])
    >>> step
    RotTransRot(t=1.0, rot1=0.1, trans=1.0, rot2=0.0)
    >>> seen
    Measurement(t=1.0, subject=3, range=1.9, bearing=0.37)
    """
    step = 0

    def parse(line: str) -> RotTransRot | Measurement | Ignored:
        nonlocal step
        fields = line.split()
        if not fields:
            return Ignored("blank")
        if fields[0] not in ("ODOMETRY", "SENSOR"):
            raise FileFormatError("the line begins with neither ODOMETRY nor SENSOR")
        step += fields[0] == "ODOMETRY"
        counted(fields, 4, fields[0])
        first, second, third = numbers(fields[1:], 2)
        if fields[0] == "ODOMETRY":
            return RotTransRot(float(step), first, second, third)
        return Measurement(float(step), whole(fields[1], 2), second, third)

    return Reading(source, parse, on_error=on_error, kind="a log of Freiburg")


def read_freiburg_world(source: Source, *, on_error: OnError = "raise") -> Mapping[int, np.ndarray]:
    """Where the landmarks of a ``world.dat`` stand.

    Parameters
    ----------
    source : path, open file or iterable of lines
    on_error : {"raise", "skip"}
        What becomes of a line that does not read: see `Reading`.

    Returns
    -------
    mapping of int to ndarray, shape (2,)
        In m, by number.

    Examples
    --------
    >>> from bayesmc.robotics.logs import read_freiburg_world
    >>> read_freiburg_world(["1 2 1", "2 0 4"])[2]
    array([0., 4.])
    """

    def parse(line: str) -> Landmark | Ignored:
        fields = line.split()
        if not fields:
            return Ignored("blank")
        counted(fields, 3, "a landmark")
        return Landmark(whole(fields[0], 1), np.array(numbers(fields[1:], 2)))

    landmarks = Reading(source, parse, on_error=on_error, kind="a list of Freiburg's landmarks")
    return MappingProxyType({landmark.subject: landmark.position for landmark in landmarks})
