"""What ``filter`` makes of a particle filter: the plain run, answers some rows late, a run that is saved."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import Queries
from bayesmc.engines.particles.compiled_step import is_worth_compiling
from bayesmc.engines.particles.lags import by_lag
from bayesmc.engines.particles.record import FilteredParticles
from bayesmc.results import RunFile


def run_of(
    engine: Any,
    problem: SeriesProblem,
    seed: np.random.SeedSequence,
    keep: bool,
    queries: Queries,
    progress: bool | None,
    file: RunFile | None,
) -> tuple[FilteredParticles, FilteredParticles]:
    """The answer, and that of the filter, which is the same unless it comes some rows late."""
    if file is not None:
        return _saved(engine, problem, seed, keep, queries, progress, file)
    sized = engine._sized(engine._enough(problem, seed, keep, progress))
    if engine.delay is not None:
        return by_lag(sized, problem, seed, engine.delay, keep, queries, progress, "filter")
    found = sized._passed(problem, seed, keep, queries, progress)
    return found, found


# ---- private ------------------------------------------------------------------------------------


def _saved(
    engine: Any,
    problem: SeriesProblem,
    seed: np.random.SeedSequence,
    keep: bool,
    queries: Queries,
    progress: bool | None,
    file: RunFile,
) -> tuple[FilteredParticles, FilteredParticles]:
    """A run that saves itself, or goes on, with as many particles and the same code as it was begun with."""
    if file.state is None:
        sized = engine._sized(engine._enough(problem, seed, keep, progress))
        compiled = engine.compiled
        if compiled is None:
            compiled = is_worth_compiling(sized.particles, problem.steps)
        file.save(None, {"particles": sized.particles, "compiled": compiled})
        file.state = {"particles": sized.particles, "compiled": compiled}
    sized = engine._sized(file.state["particles"])
    if engine.delay is None:
        found = whole = sized._passed(problem, seed, keep, queries, progress, saver=file)
    else:
        late = keep, queries, progress, "filter", file
        found, whole = by_lag(sized, problem, seed, engine.delay, *late)
    file.finish(found)
    return found, whole
