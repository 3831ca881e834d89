"""The run of a particle filter over a series: slice by slice, or several in a call, saved or not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import Queries, pass_slices
from bayesmc.engines.particles.families import Families
from bayesmc.engines.particles.filter_step import FilterStep
from bayesmc.engines.particles.made import Ahead
from bayesmc.engines.particles.predictive import Replicates
from bayesmc.engines.particles.record import FilteredParticles, Record
from bayesmc.engines.particles.saved import Recorded, SavedFilter
from bayesmc.engines.particles.smc import Particles, quiet
from bayesmc.engines.particles.tracking import Tracker
from bayesmc.progress import Progress
from bayesmc.randomness import Purpose, stream
from bayesmc.storage import Saver


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
    names: Sequence[str] | None = None,
    saver: Saver | None = None,
    late: Recorded | None = None,
) -> FilteredParticles:
    """All slices, one by one, with a random stream; Ctrl-C goes on, with the answer so far.

    Runs of another ``unit`` than 0, which only say how many particles are needed, compare no rows. There are
    answers about some nodes, or all that are hidden. What ``late`` keeps is saved, too.
    """
    record = Record(problem, step.layout, queries, keep, Tracker(step), names)
    rng, check = (stream(seed, what, unit) for what in (Purpose.FILTER, Purpose.CHECK))
    looks = None if unit or step.too_wide else Replicates(problem, step.plan, check)
    now: Particles | None = None
    is_ahead = step.machine is not None and look_back is None
    ahead = Ahead(step.machine, problem, record) if is_ahead else None
    saved = None if saver is None else SavedFilter(saver, record, looks, rng, late)
    begun = 0
    if saved is not None:
        begun, now = saved.begin()

    def move(k: int) -> None:
        if k < begun:  # passed before this process
            return
        moved(k)
        if saved is not None and (ahead is None or ahead.is_idle):
            saved.passed(k, now)

    def moved(k: int) -> None:
        nonlocal now
        if ahead is not None and ahead.reaches(k, now, rng):
            now = ahead.passed(k, looks)
            return
        row, old = problem.series.row(k), now
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

    def so_far(steps: int) -> FilteredParticles:
        if ahead is not None:
            ahead.stop(steps)
        return record.posterior(engine, "filter", steps)

    with Progress(problem.steps, engine.label, progress) as bar, quiet():
        pass_slices(problem.series.start, problem.steps, move, so_far, bar.advance)
        return record.posterior(engine, predictive=None if looks is None else looks.found())
