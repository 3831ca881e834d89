"""Answers some rows late: what particles say of their ancestors, and of what they carry along."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import Queries
from bayesmc.engines.particles.backward import lagged
from bayesmc.engines.particles.families import Families
from bayesmc.engines.particles.filter_step import FilterStep
from bayesmc.engines.particles.record import FilteredParticles, Record
from bayesmc.engines.particles.run import filtered_by
from bayesmc.engines.particles.smc import Bare, Particles
from bayesmc.engines.particles.written import Written
from bayesmc.randomness import Purpose, stream
from bayesmc.storage import Saver


def by_lag(
    engine: Any,
    problem: SeriesProblem,
    seed: np.random.SeedSequence,
    lag: int,
    keep: bool,
    queries: Queries,
    progress: bool | None,
    kind: str = "fixed-lag",
    saver: Saver | None = None,
) -> tuple[FilteredParticles, FilteredParticles]:
    """Slices by the particles ``lag`` slices later, through ancestors; and the filter's answer.

    As an answer of ``filter`` it is what is handed over where a run ends early; the filter has none then.
    """
    step = engine.step_of(problem.slices, problem.known_static, seen=problem.seen)
    step.lag = lag
    late = _Late(Record(problem, step.layout, queries, keep), step, seed)

    def look_back(k: int, now: Particles, families: Families) -> None:
        late.add(k, now, families, k == problem.steps - 1)

    is_answer = kind == "filter"
    options: dict[str, Any] = {"look_back": look_back, "names": () if is_answer else None}
    options |= {"saver": saver, "late": late}
    try:
        whole = filtered_by(engine, step, problem, seed, False, {}, progress, **options)
    except (Exception, KeyboardInterrupt) as stop:
        before = getattr(stop, "filtered", None)
        if before is not None and is_answer:
            late.end(before.steps - 1)
            found = late.record.posterior(engine, kind, before.steps, filtered=before)
            stop.filtered = found  # type: ignore[union-attr]
        raise
    return late.record.posterior(engine, kind, filtered=whole), whole


class _Late:
    """Writes answers about slices as soon as rows enough have come."""

    def __init__(self, record: Record, step: FilterStep, seed: np.random.SeedSequence) -> None:
        self.record, self.step, self.seed = record, step, seed
        self._window: deque[tuple[Particles, Families]] = deque()

    def add(self, k: int, now: Particles, families: Families, is_last: bool) -> None:
        """The k-th slice is there."""
        window = self._window
        if len(window) > 1:  # the newest know of all before
            old, its = window[-2]
            window[-2] = old._replace(inner=None), its
        window.append((now, families))
        if is_last:
            self.end(k)
        elif len(window) > self.step.lag:
            self._say(k, False)

    def end(self, k: int) -> None:
        """No slice comes after the k-th: the last ones are answered with what there is."""
        while self._window and self._window[-1][0].t > self.record.problem.series.start + k:
            self._window.pop()  # it broke off in the middle
        again = len(self._window) <= self.step.lag
        while self._window:
            self._say(k, again)
            again = True

    # ---- what is saved of it ---------------------------------------------------------------------

    def written_since(self, slices: int) -> list[Written]:
        """What is settled of the slices from one on."""
        return self.record.written_since(slices)

    def unsettled(self) -> dict[str, Any]:
        """What is yet to change, and the slices that wait."""
        return {**self.record.unsettled(), "window": list(self._window)}

    def go_on(self, written: list[Written], unsettled: dict[str, Any]) -> None:
        """Be where another one was."""
        self.record.go_on(written, unsettled)
        self._window = deque(unsettled["window"])

    # ---- private -------------------------------------------------------------------------------

    def _say(self, k: int, again: bool) -> None:
        """Answer for the first slice that waits; ``again`` by the same particles as the one before."""
        window = self._window
        own = looked_back([p for p, _ in window], self.step, self.seed)
        if again:
            own = own._replace(ancestors=None)
        self.record.add(k - len(window) + 1, own, families=window[-1][1])
        window.popleft()


def looked_back(
    window: Sequence[Particles], step: FilterStep | Bare, seed: np.random.SeedSequence
) -> Particles:
    """What the last of some slices in a row says of the first, of what is integrated out, too."""
    found = lagged(window, step.layout, step.slices)
    if found.inner is None or len(window) == 1:
        return found
    inner, tables = found.inner.back(len(window) - 1), found.tables
    rng = stream(seed, Purpose.SMOOTH, found.t)
    drawn = inner.completed(rng)
    if tables is not None:
        tables = tables.back(len(window) - 1)
        nodes = [step.slices.first[n] for g in tables.groups for n in g.names]
        drawn |= tables.values(tables.drawn(rng), nodes)
    return found._replace(values=found.values | drawn, inner=inner, tables=tables)
