"""After a filter: trajectories drawn backwards, and fixed lags."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import Queries
from bayesmc.engines.marginal.smoothing import (
    MarginalBackward,
    lagged_beliefs,
    why_not_backwards,
)
from bayesmc.engines.particles.backward import TRAJECTORIES, Backward, lagged
from bayesmc.engines.particles.coalescence import Sharing
from bayesmc.engines.particles.families import Families
from bayesmc.engines.particles.record import FilteredParticles, Record, filtered_by
from bayesmc.engines.particles.smc import Particles, quiet
from bayesmc.engines.particles.tracking import Tracker
from bayesmc.randomness import Purpose, stream


class Backwards(NamedTuple):
    """How many trajectories are drawn backwards (None: as many as particles), and whether by rejection."""

    trajectories: int | None = None
    rejection: bool = True


def backwards(
    engine: Any,
    problem: SeriesProblem,
    seed: np.random.SeedSequence,
    queries: Queries,
    progress: bool | None,
    asked: Backwards,
) -> tuple[FilteredParticles, FilteredParticles]:
    """Trajectories drawn backwards, and the filter's answer."""
    step = engine.step_of(problem.slices, problem.known_static, seen=problem.seen)
    filtered = filtered_by(engine, step, problem, seed, True, {}, progress)
    assert filtered.held is not None
    count = asked.trajectories or min(step.layout.particles, TRAJECTORIES)
    backward: Any
    if step.integrated and why_not_backwards(step.slices, step.split) is None:
        backward = MarginalBackward(step, asked.rejection)
    else:
        backward = Backward(step.plan, step.layout, asked.rejection, problem.seen)
    with quiet():
        rng = stream(seed, Purpose.SMOOTH)
        found = backward.trajectories(filtered.held.particles, problem.series, count, rng)
        record = Record(problem, replace(step.layout, particles=count), queries, True)
        for k, here in enumerate(found):
            record.add(k, here)
        steady = Tracker(step).steady
        sharing = Sharing(backward.positions, filtered.held.particles, steady)
        return record.smoothed(engine, sharing, filtered), filtered


def by_lag(
    engine: Any,
    problem: SeriesProblem,
    seed: np.random.SeedSequence,
    lag: int,
    queries: Queries,
    progress: bool | None,
) -> tuple[FilteredParticles, FilteredParticles]:
    """Slices by the particles ``lag`` slices later, through ancestors; and the filter's answer."""
    step = engine.step_of(problem.slices, problem.known_static, seen=problem.seen)
    rng = stream(seed, Purpose.SMOOTH)
    record = Record(problem, step.layout, queries, False)
    window: deque[Particles] = deque(maxlen=lag + 1)

    def look_back(k: int, now: Particles, families: Families) -> None:
        window.append(now)
        while window and (len(window) > lag or k == problem.steps - 1):
            at = k - len(window) + 1
            if step.integrated:
                here = lagged_beliefs(step, list(window), problem.series, at, rng)
            else:
                here = lagged(list(window), step.layout, step.slices)
            record.add(at, here, families=families)
            window.popleft()

    whole = filtered_by(engine, step, problem, seed, False, {}, progress, look_back=look_back)
    return record.posterior(engine, "fixed-lag", filtered=whole), whole
