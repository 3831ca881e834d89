"""The files of runs: made, held against the call that is made, and one for each unit of work besides.

A run whose work comes in units that save themselves (groups of chains) keeps a file for each beside its own,
as long as it goes on. Its own file says what the run is and in the end has the answer; those of units are
removed then.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayesmc.errors import BayesmcError, CheckpointError
from bayesmc.network import Problem
from bayesmc.network.fingerprint import Fingerprint
from bayesmc.results.posterior import Posterior
from bayesmc.results.saving import ANSWER, RUN, RunFile, observed_variables
from bayesmc.storage import (
    CheckpointFile,
    Group,
    PartFile,
    open_image,
    packed,
    unpacked,
    write_image,
)
from bayesmc.storage.blocks import refused
from bayesmc.storage.image import Image, Stored

#: what of an identity says which unit of a run a file is of
_UNIT = "the group"
#: seconds that a unit waits, again and again, for a file that another process has not let go
_PATIENCE = (0.1, 0.2, 0.4, 0.8, 1.6)


def difference(was: Fingerprint, now: Fingerprint) -> str | None:
    """The first thing in which two runs differ, in words."""
    for what in (*was, *(w for w in now if w not in was)):
        a, b = was.get(what), now.get(what)
        if a == b:
            continue
        if a is None or b is None:
            return f"{what} is {'not there any more' if b is None else 'new'}"
        if a.startswith("=") and b.startswith("="):
            return f"{what} was {a[1:]} and is {b[1:]} now"
        return f"{what} is another one"
    return None


def header_in(image: Image) -> Mapping[str, Any]:
    """What a file says of the run that it belongs to; empty where it belongs to none."""
    found: Mapping[str, Any] | None = unpacked(image.packed, _nothing)["header"]
    return found or {}


def made(path: Path, problem: Any, header: Mapping[str, Any]) -> None:
    """A new file of a run: what it is about, and no draws; one that another process has just made stays.

    Raises
    ------
    CheckpointError
        The disk is full, or may not be written.
    """
    groups: dict[str, Group] = {}
    held = dict(header)
    if isinstance(problem, Problem):
        model = problem.model
        coordinates = {p: model.labels.get(p, range(n)) for p, n in model.sizes.items()}
        groups["observed_data"] = Group(observed_variables(model, problem.observed), coordinates)
        held |= {"observed": problem.observed, "inputs": problem.inputs}
        held["model"] = model.without_functions()
    try:
        write_image(path, groups, packed({"header": held}), {"kind": RUN}, anew=True)
    except FileExistsError:
        return
    except OSError as error:
        raise refused(path, error) from error


def answer_in(path: Path, image: Image, problem: Any, mapped: bool = False) -> Any:
    """The answer of a run that has ended, with the functions of its net; draws left in the file if mapped."""
    answer = unpacked(image.packed, Stored(path, mapped=mapped))["answer"]
    if isinstance(answer, Posterior) and isinstance(problem, Problem):
        answer.bind(problem)
    return answer


class UnitFile(NamedTuple):
    """Where a unit of a run saves itself, and what it is: plain data, which travels to workers.

    Attributes
    ----------
    file : CheckpointFile
    header : dict
        What the file says of the unit.
    """

    file: PartFile
    header: Mapping[str, Any]

    @classmethod
    def belonging(cls, run: RunFile, number: int, count: int, engine: Any) -> UnitFile:
        """That of one of so many units, each of which an engine runs."""
        path = run.path.with_name(f"{run.path.stem}.g{number}{run.path.suffix}")
        identity = {**run.header["identity"], _UNIT: f"={number + 1} of {count}"}
        header = {**run.header, "identity": identity, "engine": engine}
        return cls(PartFile.belonging(run.file, path), header)

    @property
    def path(self) -> Path:
        """Of the unit's file."""
        return Path(self.file.path)

    def begun(self, problem: Problem, mapped: bool = False) -> tuple[RunFile | None, Any]:
        """The file, made or gone on with, or None and the answer of a unit that has ended.

        Raises
        ------
        CheckpointError
            The file is of another run, or another process runs the unit.
        DamagedFileError
        """
        if not self.path.exists():
            made(self.path, problem, self.header)
        image = open_image(self.path)
        was = header_in(image).get("identity", {})
        if why := difference(was, self.header["identity"]):
            raise CheckpointError(
                f"{self.file.given}: {self.path.name} beside it, where a group of chains saves itself, "
                f"belongs to another run: {why}; move it away, or give another path"
            )
        if image.attributes["kind"] == ANSWER:
            return None, answer_in(self.path, image, problem, mapped)
        return self._alone(), None

    def answer(self, problem: Problem) -> Any:
        """That of a unit that has ended, its draws left in the file.

        Raises
        ------
        CheckpointError
            The file is not here.
        """
        try:
            image = open_image(self.path)
        except FileNotFoundError:
            raise CheckpointError(
                f"{self.file.given}: {self.path.name} beside it, where a worker has saved a group of "
                "chains, cannot be seen from here; give a path in a folder that workers share"
            ) from None
        return answer_in(self.path, image, problem, mapped=True)

    def _alone(self) -> RunFile:
        """The file, which a worker whose loss was noticed a moment ago may not have let go yet."""
        for seconds in _PATIENCE:
            try:
                return RunFile(self.file, self.header)
            except CheckpointError:
                time.sleep(seconds)
        return RunFile(self.file, self.header)


def units_so_far(run: RunFile, problem: Problem) -> list[Any]:
    """What the units of a run have come to, those that have come to anything, first to last."""
    found = []
    for path, header, kind in _beside(run.path, run.header["identity"]):
        if kind == ANSWER:
            found.append(unpacked(open_image(path).packed, Stored(path))["answer"])
        else:
            own = RunFile(CheckpointFile(path), header, alone=False)
            found.append(header["engine"].so_far(problem, own))
    return [one for one in found if one is not None]


def remove_units(path: Path, identity: Fingerprint) -> None:
    """Remove the files of a run's units, which nobody needs any more."""
    for own, _, _ in _beside(path, identity):
        with suppress(OSError):  # where they are still open elsewhere: the next call tries again
            own.unlink()


# ---- private ------------------------------------------------------------------------------------


def _nothing(name: str) -> np.ndarray:
    """In the place of arrays that nobody looks at."""
    return np.empty(0)


def _beside(path: Path, identity: Fingerprint) -> Iterator[tuple[Path, Mapping[str, Any], str]]:
    """Files of units of one run that lie beside its own: path, header and kind, first to last."""
    name = re.compile(re.escape(path.stem) + r"\.g(\d+)" + re.escape(path.suffix))
    numbered = [(m, p) for p in path.parent.iterdir() if (m := name.fullmatch(p.name))]
    for _, own in sorted((int(m[1]), p) for m, p in numbered):
        try:
            image = open_image(own)
            header = header_in(image)
        except (OSError, BayesmcError):
            continue
        was = {k: v for k, v in header.get("identity", {}).items() if k != _UNIT}
        if was and difference(was, identity) is None:
            yield own, header, image.attributes["kind"]
