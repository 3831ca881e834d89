"""Saving as a run goes on: when, and what is there when it is started again."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bayesmc.storage.blocks import Blocks
from bayesmc.storage.packing import packed, unpacked
from bayesmc.storage.replacing import clear_leftovers

#: time between two blocks, in units of what saving the last one took
_PATIENCE = 20.0


@dataclass(frozen=True)
class CheckpointFile:
    """Where a run saves itself, and how often: ``infer(..., checkpoint=CheckpointFile("run.nc", every=60))``.

    A path by itself is the same with the defaults.

    Parameters
    ----------
    path : path
    every : float
        Seconds between two blocks, which is what is lost at most; more where saving takes long, so that it
        costs a twentieth of the time at most. 0 saves whenever it can.
    repair : bool
        Go on from the last block that is whole where the file was cut off; otherwise that is an error.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> bmc.CheckpointFile("run.nc", every=60)
    CheckpointFile(path='run.nc', every=60, repair=False)
    """

    path: str | os.PathLike[str]
    every: float = 10.0
    repair: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.path, (str, os.PathLike)):
            raise TypeError(
                f"checkpoint={self.path!r}: give the path of a file, or CheckpointFile(path, every=seconds)"
            )
        number = isinstance(self.every, (int, float)) and not isinstance(self.every, bool)
        if not number or not 0 <= self.every < math.inf:
            raise ValueError(
                f"CheckpointFile(every={self.every!r}): give seconds, 0 or more, such as 60"
            )

    @classmethod
    def of(cls, given: Any) -> CheckpointFile:
        """What a user gave as ``checkpoint=``."""
        return given if isinstance(given, cls) else cls(given)


@dataclass(frozen=True)
class PartFile(CheckpointFile):
    """Where a part of what is asked saves itself; ``given`` is the path for all."""

    given: str | os.PathLike[str] = ""

    @classmethod
    def belonging(cls, file: CheckpointFile, path: Path) -> PartFile:
        """One with the options of that for all."""
        return cls(path, file.every, file.repair, file.path)


class Saver:
    """Saves blocks of one run, and hands out what an earlier process saved of it.

    Parameters
    ----------
    file : CheckpointFile
    header : dict
        What the file says of the run.
    alone : bool
        Let no other process save there.
    """

    def __init__(self, file: CheckpointFile, header: Mapping[str, Any], alone: bool = True) -> None:
        self.file, self.header = file, header
        self.path, self.every = Path(file.path), float(file.every)
        named = file.given if isinstance(file, PartFile) else file.path
        self.blocks = Blocks(self.path, file.repair, alone, named)
        if alone:
            clear_leftovers(self.path)
        last = self.blocks.state
        #: what was saved last, or None
        self.state: Any = None if last is None else unpacked(last)
        self._cost, self._saved = 0.0, time.monotonic()

    def rows(self) -> Iterator[Any]:
        """All rows that were saved, block by block."""
        return map(unpacked, self.blocks.rows())

    def close(self) -> None:
        """Let other processes save there."""
        self.blocks.close()

    def due(self) -> bool:
        """Whether it is time for the next block."""
        return time.monotonic() - self._saved >= max(self.every, _PATIENCE * self._cost)

    def save(self, rows: Any, state: Any) -> None:
        """Add rows (None: there are none) and the state that follows them.

        Raises
        ------
        CheckpointError
            The disk is full, or may not be written.
        UnsupportedError
            The state is no data.
        """
        begun = time.monotonic()
        self.blocks.append(None if rows is None else packed(rows), packed(state))
        self._saved = time.monotonic()
        self._cost = self._saved - begun if self.every else 0.0
