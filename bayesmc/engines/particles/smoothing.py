"""After a filter: trajectories drawn backwards."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.dbn.slices import Slices
from bayesmc.engines.filtering import Queries
from bayesmc.engines.marginal.smoothing import MarginalBackward, why_not_backwards
from bayesmc.engines.particles.backward import TRAJECTORIES, Backward
from bayesmc.engines.particles.coalescence import Sharing
from bayesmc.engines.particles.record import FilteredParticles, Record
from bayesmc.engines.particles.run import filtered_by
from bayesmc.engines.particles.smc import quiet
from bayesmc.engines.particles.tracking import Tracker
from bayesmc.errors import ParameterError, UnsupportedError
from bayesmc.network.node import way_out_of_lag
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
    step.whole = True
    filtered = filtered_by(engine, step, problem, seed, True, {}, progress)
    assert filtered.held is not None
    count = asked.trajectories or min(step.layout.particles, TRAJECTORIES)
    backward: Any
    if step.integrated and why_not_backwards(step.slices, step.split) is None:
        backward = MarginalBackward(step, asked.rejection)
    else:
        backward = Backward(step.plan, step.layout, asked.rejection, problem.seen)
    with quiet(), _saying_lags(problem.slices):
        rng = stream(seed, Purpose.SMOOTH)
        found = backward.trajectories(filtered.held.particles, problem.series, count, rng)
        record = Record(problem, replace(step.layout, particles=count), queries, True)
        for k, here in enumerate(found):
            record.add(k, here)
        steady = Tracker(step).steady
        sharing = Sharing(backward.positions, filtered.held.particles, steady)
        return record.smoothed(engine, sharing, filtered), filtered


# ---- private ------------------------------------------------------------------------------------


@contextmanager
def _saying_lags(slices: Slices) -> Iterator[None]:
    """Where a lag without a density is in the way, the error says how to declare it."""
    try:
        yield
    except ParameterError as error:
        bare = [n for n in slices.stochastic if slices.later[n].noiseless]
        for name in bare:
            lag = way_out_of_lag(slices.template.later[name])
            if lag is not None:
                raise UnsupportedError(
                    "ParticleFilter weighs trajectories by densities of the slice that follows, and "
                    f"{name!r} has none: {lag}; or smooth with lag="
                ) from error
        raise
