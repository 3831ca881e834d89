"""What ``filter`` makes of a particle filter: the plain run, answers some rows late, a run that is saved."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import Queries
from bayesmc.engines.marginal import options as marginal
from bayesmc.engines.particles.compiled_step import is_worth_compiling
from bayesmc.engines.particles.enough import START, Errors, enough, errors_of, price
from bayesmc.engines.particles.lags import by_lag
from bayesmc.engines.particles.record import FilteredParticles
from bayesmc.engines.slice_steps import plates_apart
from bayesmc.errors import DegeneracyError
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
    sized = with_enough(engine, problem, seed, keep, progress)
    if engine.delay is not None:
        return by_lag(sized, problem, seed, engine.delay, keep, queries, progress, "filter")
    found = sized._passed(problem, seed, keep, queries, progress)
    return found, found


def with_enough(
    engine: Any,
    problem: SeriesProblem,
    seed: np.random.SeedSequence,
    keep: bool,
    progress: bool | None,
) -> Any:
    """The filter with as many particles as its errors need, by runs whose draws do not come back."""
    if engine.particles is not None or engine.adapt is not None:
        return engine._sized(START)

    def tried(particles: int, unit: int) -> Errors:
        try:
            found = engine._sized(particles)._passed(problem, seed, False, {}, progress, unit)
        except DegeneracyError:
            return Errors()
        return errors_of(found, problem.slices)

    sizes = problem.slices.first.sizes
    slices = problem.steps * math.prod(sizes[p] for p in plates_apart(problem.slices))
    slices *= price(engine, marginal.numbers_carried(engine, problem))
    return engine._sized(enough(tried, engine.tolerance, slices, engine.budget, keep))


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
        sized = with_enough(engine, problem, seed, keep, progress)
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
