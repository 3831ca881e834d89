"""Several independent series at once: each a question of its own, here or by an executor's workers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bayesmc.dbn import DynamicBayesNet, SeriesProblem, pose_series
from bayesmc.errors import BayesmcError, CheckpointError, EvidenceError
from bayesmc.network.columns import is_frame
from bayesmc.randomness import child, parent, seed_sequence
from bayesmc.results import SeriesPosterior
from bayesmc.results.run_files import header_in
from bayesmc.storage import CheckpointFile, PartFile, open_image
from bayesmc.workers import completed
from bayesmc.workers.units import gathered, workers_of

#: units of work for each worker: a slow series holds up little
_UNITS = 8
#: what files of a folder are of, in words
_PLURAL = {"series": "series", "set": "evidence sets"}

#: of a posed problem, an engine or None, a seed and options to the answer
Answer = Callable[[SeriesProblem, Any, np.random.SeedSequence, dict[str, Any]], SeriesPosterior]


def is_several(observations: Any) -> bool:
    """Whether observations are those of several series."""
    if not isinstance(observations, Sequence) or isinstance(observations, str):
        return False
    return all(isinstance(one, Mapping) or is_frame(one) for one in observations)


class Folder:
    """Where several questions save themselves, each in a file of its own, as if it were asked about alone.

    Parameters
    ----------
    call : str
        ``"filter"``.
    checkpoint : path or CheckpointFile
        Of a folder, made where there is none.
    kind : str
        What files are called: ``series0.nc``, ...

    Raises
    ------
    CheckpointError
        It is a file, or cannot be made.
    """

    def __init__(self, call: str, checkpoint: Any, kind: str = "series") -> None:
        self.file = CheckpointFile.of(checkpoint)
        self.path = Path(self.file.path)
        said = f"{call}(checkpoint={str(self.path)!r})"
        if self.path.exists() and not self.path.is_dir():
            raise CheckpointError(
                f"{said}: several {_PLURAL[kind]} are saved in a folder, one file for each, and this is a "
                "file; give the path of a folder"
            )
        try:
            self.path.mkdir(exist_ok=True)
        except OSError as error:
            raise CheckpointError(
                f"{said}: the folder cannot be made: {error.strerror or error}"
            ) from error

        #: what a file that is here says of the run; empty where there is none
        self.header: Mapping[str, Any] = {}
        first = next(self.path.glob(f"{kind}*.nc"), None)
        if first is not None:
            self.header = header_in(open_image(first))

    @property
    def engine(self) -> Any:
        """The engine that the run was told to answer with; None where it was left to choose."""
        return self.header.get("engine") if self.header.get("named") else None

    @property
    def seed(self) -> np.random.SeedSequence | None:
        """That of the run; None where none has begun."""
        return parent(self.header["seed"]) if "seed" in self.header else None


def seed_of(folder: Folder | None, rng: Any) -> np.random.SeedSequence:
    """The seed of all series: the one that is given, or that of the folder, or a new one."""
    found = folder.seed if folder is not None and rng is None else None
    return seed_sequence(rng) if found is None else found


def in_folder(folder: CheckpointFile, kind: str, k: int) -> PartFile:
    """The file of one of several."""
    return PartFile.belonging(folder, Path(folder.path) / f"{kind}{k}.nc")


def several(
    call: str,
    answer: Answer,
    dbn: DynamicBayesNet,
    observations: Sequence[Mapping[str, Any]],
    inputs: Any,
    engine: Any,
    seed: np.random.SeedSequence,
    options: dict[str, Any],
    progress: bool | None,
    executor: Any,
    folder: Folder | None = None,
) -> list[SeriesPosterior]:
    """The answers about some series, in their order; None in place of those that Ctrl-C left out."""
    problems = _posed(call, dbn, observations, inputs)
    size = 1
    if executor is not None:
        size = max(1, len(problems) // (_UNITS * workers_of(executor)))
    units = [(k, problems[k : k + size]) for k in range(0, len(problems), size)]
    shared = {
        "first": problems[0] if problems else None, "answer": answer, "engine": engine, "seed": seed,
        "options": options, "folder": None if folder is None else folder.file,
    }  # fmt: skip
    results = completed(
        _series_answered, shared, units, executor,
        label="series", total=len(units), progress=progress,
    )  # fmt: skip
    said = "{} of {} series, and None for the others"
    return gathered(results, [unit[0] for unit in units], len(problems), call, said)


# ---- private ------------------------------------------------------------------------------------


def _series_answered(
    shared: Mapping[str, Any], unit: tuple[int, list[SeriesProblem]]
) -> list[SeriesPosterior]:
    found = []
    for k, problem in enumerate(unit[1], unit[0]):
        seed, options = child(shared["seed"], k), shared["options"]
        if shared["folder"] is not None:
            options = {**options, "checkpoint": in_folder(shared["folder"], "series", k)}
        try:
            answer = shared["answer"](problem, shared["engine"], seed, options)
        except BayesmcError as error:
            raise _in_series(error, k) from None
        if answer.steps < problem.series.steps:  # Ctrl-C cut it short: left out, as those to come
            raise KeyboardInterrupt
        found.append(answer)
    return found


def _posed(
    call: str, dbn: DynamicBayesNet, observations: Sequence[Mapping[str, Any]], inputs: Any
) -> list[SeriesProblem]:
    """All series read; what they share is one object, which travels once."""
    given = [inputs] * len(observations)
    if inputs is not None and not isinstance(inputs, Mapping) and not is_frame(inputs):
        given = list(inputs)
        if len(given) != len(observations):
            raise EvidenceError(
                f"{call}: {len(observations)} series and {len(given)} inputs; give one dict for all, or one "
                "for each"
            )
    found: list[SeriesProblem] = []
    for k, (rows, own) in enumerate(zip(observations, given, strict=True)):
        try:
            problem = pose_series(dbn, rows, own)
        except BayesmcError as error:
            raise _in_series(error, k) from None
        same = bool(found) and problem.slices is found[0].slices
        found.append(replace(problem, dbn=found[0].dbn) if same else problem)
    return found


def _in_series(error: BayesmcError, k: int) -> BayesmcError:
    error.args = (f"series {k}: {error}", *error.args[1:])
    return error
