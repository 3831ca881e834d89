"""Several independent series at once: each a question of its own, here or by an executor's workers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.dbn import DynamicBayesNet, SeriesProblem, pose_series
from bayesmc.errors import BayesmcError, EvidenceError
from bayesmc.network.columns import is_frame
from bayesmc.randomness import child
from bayesmc.results import SeriesPosterior
from bayesmc.workers import completed
from bayesmc.workers.units import gathered, workers_of

#: units of work for each worker: a slow series holds up little
_UNITS = 8

#: of a posed problem, an engine or None, a seed and options to the answer
Answer = Callable[[SeriesProblem, Any, np.random.SeedSequence, dict[str, Any]], SeriesPosterior]


def is_several(observations: Any) -> bool:
    """Whether observations are those of several series."""
    if not isinstance(observations, Sequence) or isinstance(observations, str):
        return False
    return all(isinstance(one, Mapping) or is_frame(one) for one in observations)


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
) -> list[SeriesPosterior]:
    """The answers about some series, in their order; None in place of those that Ctrl-C left out."""
    problems = _posed(call, dbn, observations, inputs)
    size = 1
    if executor is not None:
        size = max(1, len(problems) // (_UNITS * workers_of(executor)))
    units = [(k, problems[k : k + size]) for k in range(0, len(problems), size)]
    shared = {
        "first": problems[0] if problems else None, "answer": answer, "engine": engine, "seed": seed,
        "options": options,
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
        seed = child(shared["seed"], k)
        try:
            found.append(shared["answer"](problem, shared["engine"], seed, shared["options"]))
        except BayesmcError as error:
            raise _in_series(error, k) from None
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
