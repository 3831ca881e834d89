"""Some rows of one island, a unit of work: particles in, answers about each row and particles out."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import in_slice
from bayesmc.engines.particles.compiled_step import compiled_step
from bayesmc.engines.particles.families import Families
from bayesmc.engines.particles.filter_step import FilterStep
from bayesmc.engines.particles.genealogy import evidence_error
from bayesmc.engines.particles.options import read_by
from bayesmc.engines.particles.record import Record
from bayesmc.engines.particles.smc import Particles, quiet
from bayesmc.engines.particles.tracking import Tracker
from bayesmc.engines.particles.written import KINDS, Rows, Written, joined
from bayesmc.errors import DegeneracyError
from bayesmc.randomness import child, resumed
from bayesmc.randomness import stream as stream_of
from bayesmc.workers.memory import hold, opened


class Cloud(NamedTuple):
    """An island as it stands: its particles, and what is followed beside them."""

    particles: Particles
    families: Families


class Passed(NamedTuple):
    """Some rows of an island.

    Attributes
    ----------
    rows : dict
        Answers by kind and node, slices first, as a ``Record`` writes them.
    cloud : Cloud, Held or None
        After the last row; None where no weight was left.
    chance : dict
        Of the random numbers.
    error : float
        Of the log evidence so far, as families tell it.
    steps : int
        Rows that were passed with some weight left.
    died : DegeneracyError or None
        Why no weight was left in the row after.
    """

    rows: Rows
    cloud: Any
    chance: Any
    error: float
    steps: int
    died: DegeneracyError | None = None


def pass_rows(shared: Mapping[str, Any], unit: tuple[int, int, int, Any, Any]) -> Passed:
    """Rows of one island.

    Parameters
    ----------
    shared : dict
        ``problem``, ``engine`` (the filter of one island), ``queries``, ``seed`` and ``folder``, where clouds
        are put in memory that is shared, or None.
    unit : tuple
        Number of the island, first row, row after the last, its cloud (None before the first row) and its
        random numbers (None: the island's own from the start).
    """
    island, first, last, before, chance = unit
    problem: SeriesProblem = shared["problem"]
    step, cloud = _step(shared), opened(before)
    record = Record(problem, step.layout, shared["queries"], False, Tracker(step))
    now: Particles | None = None
    if cloud is not None:
        now = cloud.particles
        record._written = [Written({kind: {} for kind in KINDS}, [cloud.families], [now])]
    if chance is None:
        rng = stream_of(child(shared["seed"], island), shared["purpose"])
    else:
        rng = resumed(chance)
    died, passed = None, 0
    with quiet():
        for k in range(first, last):
            row, old = problem.series.row(k), now
            try:
                with in_slice(row.t):
                    now = step(old, row, rng)
            except DegeneracyError as failure:
                died = failure
                break
            record.add(k, now, row)
            passed += 1
            if (
                old is not None
                and old is not getattr(cloud, "particles", None)
                and record.is_written
            ):
                step.recycle(old)
        record.write()
        families, error = record.families, 0.0
        if now is not None and families is not None:
            error = float(np.max(evidence_error(families, now)))
    rows: Rows = {kind: joined(record._written, kind) for kind in KINDS}
    found: Any = None
    if died is None:
        assert now is not None and families is not None
        found = Cloud(now, families)
        if shared["folder"] is not None:
            found = hold(found, shared["folder"])
    return Passed(rows, found, rng.bit_generator.state, error, passed, died)


# ---- private ------------------------------------------------------------------------------------


def _step(shared: Mapping[str, Any]) -> FilterStep:
    """The step of an island's filter; every thread has its own, since a step keeps arrays to use again."""
    problem, engine = shared["problem"], shared["engine"]
    key = ("island step", threading.get_ident(), engine.particles)
    step: FilterStep | None = problem.cache.get(key)
    if step is None:
        kept = [*problem.hidden, *read_by(shared["queries"], problem.slices)]
        step = engine.step_of(problem.slices, problem.known_static, kept, problem.seen)
        if not step.integrated:
            step = compiled_step(step, problem.steps, engine.compiled)
        problem.cache[key] = step
    return step
