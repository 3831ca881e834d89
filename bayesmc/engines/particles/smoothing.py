"""Runs over a series: a filter's, trajectories drawn backwards after it, and fixed lags."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import Queries, pass_slices
from bayesmc.engines.particles.backward import TRAJECTORIES, Backward, lagged
from bayesmc.engines.particles.coalescence import Sharing
from bayesmc.engines.particles.filter_step import FilterStep
from bayesmc.engines.particles.genealogy import Families
from bayesmc.engines.particles.predictive import Replicates
from bayesmc.engines.particles.record import FilteredParticles, Record
from bayesmc.engines.particles.smc import Particles, quiet
from bayesmc.engines.particles.tracking import Tracker
from bayesmc.progress import Progress
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
    step = engine.step_of(problem.slices, static_of(problem))
    filtered = filtered_by(engine, step, problem, seed, True, {}, progress)
    assert filtered.held is not None
    count = asked.trajectories or min(step.layout.particles, TRAJECTORIES)
    backward = Backward(step.plan, step.layout, asked.rejection, seen_in_full(problem))
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
    step = engine.step_of(problem.slices, static_of(problem))
    record = Record(problem, step.layout, queries, False)
    window: deque[Particles] = deque(maxlen=lag + 1)

    def look_back(k: int, now: Particles, families: Families) -> None:
        window.append(now)
        while window and (len(window) > lag or k == problem.steps - 1):
            at = k - len(window) + 1
            record.add(at, lagged(list(window), step.layout, step.slices), families=families)
            window.popleft()

    whole = filtered_by(engine, step, problem, seed, False, {}, progress, look_back=look_back)
    return record.posterior(engine, "fixed-lag", filtered=whole), whole


def filtered_by(
    engine: Any,
    step: FilterStep,
    problem: SeriesProblem,
    seed: np.random.SeedSequence,
    keep: bool,
    queries: Queries,
    progress: bool | None,
    unit: int = 0,
    look_back: Callable[[int, Particles, Families], None] | None = None,
) -> FilteredParticles:
    """All slices, one by one, with a random stream; Ctrl-C goes on, with the answer so far.

    Runs of another ``unit`` than 0, which only say how many particles are needed, compare no rows.
    """
    record = Record(problem, step.layout, queries, keep, Tracker(step))
    rng, rows = stream(seed, Purpose.FILTER, unit), problem.series
    check = stream(seed, Purpose.CHECK, unit)
    looks = Replicates(problem, step.plan, check) if unit == 0 else None
    now: Particles | None = None

    def move(k: int) -> None:
        nonlocal now
        row, old = rows.row(k), now
        if looks is not None:
            looks.look(k, old, row)
        now = step(old, row, rng)
        record.add(k, now, row)
        if look_back is not None:
            record.write()
            assert record.families is not None
            look_back(k, now, record.families)
        if old is not None and not keep and look_back is None and record.is_written:
            step.recycle(old)

    with Progress(problem.steps, engine.label, progress) as bar, quiet():
        so_far = partial(record.posterior, engine, "filter")
        pass_slices(rows.start, problem.steps, move, so_far, bar.advance)
        return record.posterior(engine, predictive=None if looks is None else looks.found())


def static_of(problem: SeriesProblem) -> dict[str, np.ndarray]:
    """Values of the static nodes."""
    return {n: o.value for n, o in problem.series.static.items()}


def seen_in_full(problem: SeriesProblem) -> set[str]:
    """Nodes that are seen in full in all slices."""
    return {n for n, o in problem.series.observed.items() if o.mask is None}
