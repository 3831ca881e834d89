"""What ``filter`` makes of a particle filter: the plain run, answers some rows late, a run that is saved."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import Queries
from bayesmc.engines.particles.compiled_step import is_worth_compiling
from bayesmc.engines.particles.lags import by_lag
from bayesmc.engines.particles.record import FilteredParticles
from bayesmc.errors import UnsupportedError
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
        found = _saved(engine, problem, seed, keep, queries, progress, file)
        return found, found
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
) -> FilteredParticles:
    """A run that saves itself, or goes on, with as many particles and the same code as it was begun with."""
    if engine.delay is not None:
        raise UnsupportedError(
            f"ParticleFilter(delay={engine.delay}): a run whose answers come some rows late is not saved; "
            "leave checkpoint= out, or delay="
        )
    if file.state is None:
        sized = engine._sized(engine._enough(problem, seed, keep, progress))
        compiled = engine.compiled
        if compiled is None:
            compiled = is_worth_compiling(sized.particles, problem.steps)
        file.save(None, {"particles": sized.particles, "compiled": compiled})
        file.state = {"particles": sized.particles, "compiled": compiled}
    sized = engine._sized(file.state["particles"])
    found: FilteredParticles = sized._passed(problem, seed, keep, queries, progress, saver=file)
    file.finish(found)
    return found
