"""Runs that smooth: trajectories drawn backwards after a filter, and slices by what follows a few later."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.filtering import Queries, pass_slices
from bayesmc.engines.particles.cloud import Cloud, Layout
from bayesmc.engines.particles.families import Families
from bayesmc.engines.particles.record import FilteredParticles, Record
from bayesmc.engines.particles.replicates import Replicates
from bayesmc.engines.particles.sharing import Sharing
from bayesmc.engines.particles.smoothing import TRAJECTORIES, Backward, lagged
from bayesmc.progress import Progress
from bayesmc.randomness import Purpose, stream

if TYPE_CHECKING:
    from bayesmc.engines.particles.filter import ParticleFilter


def backwards(
    engine: ParticleFilter,
    problem: SeriesProblem,
    seed: np.random.SeedSequence,
    queries: Queries,
    progress: bool | None,
) -> tuple[FilteredParticles, FilteredParticles]:
    """Trajectories drawn backwards, and the filter's answer."""
    filtered = engine._passed(problem, seed, True, {}, progress)
    assert filtered.clouds is not None
    static = {n: o.value for n, o in problem.series.static.items()}
    mover = engine._mover(problem.slices, static)
    count = engine.trajectories or min(mover.particles, TRAJECTORIES)
    by_bound = engine.backward == "rejection"
    backward = Backward(mover.plan, mover.layout, by_bound, seen_in_full(problem))
    with quiet():
        rng = stream(seed, Purpose.SMOOTH)
        found = backward.trajectories(filtered.clouds, problem.series, count, rng)
        layout = Layout(count, mover.apart, mover.lead)
        record = Record(problem, layout, queries, True)
        for k, cloud in enumerate(found):
            record.add(k, cloud)
        sharing = Sharing(backward.positions, filtered.clouds, mover.steady)
        smoothed = record.smoothed(engine, sharing, filtered)
    return _given_filtered(smoothed, filtered), filtered


def by_lag(
    engine: ParticleFilter,
    problem: SeriesProblem,
    seed: np.random.SeedSequence,
    lag: int,
    queries: Queries,
    progress: bool | None,
) -> tuple[FilteredParticles, FilteredParticles]:
    """Slices by the particles ``lag`` slices later, through ancestors; and the filter's answer."""
    static = {n: o.value for n, o in problem.series.static.items()}
    mover = engine._mover(problem.slices, static)
    record = Record(problem, mover.layout, queries, False)
    filtered = Record(problem, mover.layout, {}, False)
    window: deque[Cloud] = deque(maxlen=lag + 1)
    rng, rows, last = stream(seed, Purpose.FILTER), problem.series, problem.steps - 1
    looks = Replicates(problem, mover.plan, stream(seed, Purpose.CHECK))
    cloud: Cloud | None = None
    families: Families | None = None

    def move(k: int) -> None:
        nonlocal cloud, families
        row = rows.row(k)
        looks.look(k, cloud, row)
        cloud, families = mover.moved(cloud, families, row, rng)
        filtered.add(k, cloud, families)
        window.append(cloud)
        while window and (len(window) > lag or k == last):
            at = k - len(window) + 1
            record.add(at, lagged(list(window), mover.layout, mover.slices), families)
            window.popleft()

    with Progress(problem.steps, engine.label, progress) as bar, quiet():
        so_far = partial(filtered.posterior, engine, "filter")
        pass_slices(rows.start, problem.steps, move, so_far, bar.advance)
    whole = filtered.posterior(engine)
    whole.predictive = looks.found()
    return _given_filtered(record.posterior(engine, "fixed-lag"), whole), whole


def seen_in_full(problem: SeriesProblem) -> set[str]:
    """Nodes that are seen in full in all slices."""
    return {n for n, o in problem.series.observed.items() if o.mask is None}


@contextmanager
def quiet() -> Iterator[None]:
    """Bad parameters are marked, and weights of zero are no matter."""
    with marking_invalid(), np.errstate(all="ignore"):
        yield


# ---- private ------------------------------------------------------------------------------------


def _given_filtered(found: FilteredParticles, filtered: FilteredParticles) -> FilteredParticles:
    """Smoothed answers with the filter's figures."""
    found.log_marginal_increments = filtered.log_marginal_increments
    found.log_marginal_likelihood = filtered.log_marginal_likelihood
    found.log_marginal_likelihood_mcse = filtered.log_marginal_likelihood_mcse
    found.weight_ess, found.resampled = filtered.weight_ess, filtered.resampled
    found.unique_ancestors = filtered.unique_ancestors
    found.rejuvenated, found.predictive = filtered.rejuvenated, filtered.predictive
    return found
