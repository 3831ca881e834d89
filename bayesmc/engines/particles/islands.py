"""One huge cloud of particles as islands, which exchange only when their weights need it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from bayesmc.categorical import log_sum_exp
from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import (
    Asked,
    FilterEngine,
    Queries,
    answer_so_far,
    hand_over,
    observed_answers,
)
from bayesmc.engines.particles.compiled_step import is_worth_compiling
from bayesmc.engines.particles.enough import warn_of_errors
from bayesmc.engines.particles.filter import ParticleFilter
from bayesmc.engines.particles.island_answers import IslandRows, answered
from bayesmc.engines.particles.island_rows import Passed, pass_rows
from bayesmc.engines.particles.island_saved import SavedIslands
from bayesmc.engines.particles.options import check_count, check_number
from bayesmc.engines.particles.record import FilteredParticles
from bayesmc.engines.slice_steps import plates_apart
from bayesmc.errors import UnsupportedError
from bayesmc.progress import Progress
from bayesmc.randomness import Purpose, stream
from bayesmc.resampling import systematic
from bayesmc.results import RunFile
from bayesmc.workers import completed
from bayesmc.workers.memory import drop, folder, shares_memory

#: rows that islands pass on their own before they are looked at, at first, at least and at most
_FIRST, _LEAST, _MOST = 16, 2, 256


class FilteredIslands(FilteredParticles):
    """What islands of particles say of every slice.

    Attributes
    ----------
    exchanged : ndarray of int
        Slices after which islands were resampled.
    """

    exchanged: np.ndarray


@dataclass(frozen=True)
class IslandFilter(FilterEngine):
    """A particle filter whose cloud is cut into islands, for workers to share.

    Every island is a particle filter of its own; it weighs what its particles have made of the rows so far.
    Islands are resampled as particles are, whole, and only in rows after which their weights have become
    uneven, so that workers seldom wait for each other. The estimate of the evidence is unbiased for any
    number of islands, and one island is the plain filter, bit for bit.

    Parameters
    ----------
    cloud : ParticleFilter
        With the number of particles of all islands together.
    islands : int
        Which divides it. It belongs to the question: a seed gives the same answer whoever works.
    threshold : float
        Share of the islands below which their effective number has them resampled.

    Raises
    ------
    DegeneracyError
        From the filter: in the same row all islands are left without weight.

    Notes
    -----
    ``filter(executor=)`` hands islands to workers, some rows at a time; processes of one machine share the
    particles' memory. Whether islands exchange is decided row by row all the same: rows that were passed
    beyond one after which they should have are passed again. ``exchanged`` of the answer says where.

    The error of the evidence adds up what the families of each island tell (see ``ParticleFilter``), those
    that share an ancestor among those of the last 50 rows counted as one.

    References
    ----------
    Verge, Dubarry, Del Moral and Moulines (2015), On parallel implementation of sequential Monte Carlo
    methods: the island particle model, Statistics and Computing 25, sec. 3 (double bootstrap with adaptive
    selection); Whiteley, Lee and Heine (2016), On the role of interaction in sequential Monte Carlo
    algorithms, Bernoulli 22.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 2.0))
    >>> dbn.add("y", lambda x: bmc.StudentT(4.0, x, 0.5))
    >>> engine = bmc.IslandFilter(bmc.ParticleFilter(4000), islands=4)
    >>> filtered = bmc.filter(dbn, {"y": [1.2, 0.4, 0.7]}, engine=engine, rng=0)
    >>> filtered.mean("x").shape, filtered.counts.tolist()
    ((3,), [4000, 4000, 4000])
    """

    cloud: ParticleFilter
    islands: int = 4
    threshold: float = 0.9

    label: ClassVar[str] = "islands of particles"
    saves: ClassVar[bool] = True
    spreads: ClassVar[bool] = True

    def __post_init__(self) -> None:
        name = "IslandFilter"
        if not isinstance(self.cloud, ParticleFilter):
            raise TypeError(
                f"{name}(cloud={self.cloud!r}): give the particle filter, "
                "IslandFilter(ParticleFilter(100_000), islands=8)"
            )
        check_count("islands", self.islands, "such as 8", name)
        share = "a share of the islands, 0 to 1"
        check_number("threshold", self.threshold, (int, float), lambda x: 0 <= x <= 1, share, name)
        count = self.cloud.particles
        if self.islands == 1:
            return
        if count is None:
            raise ValueError(
                f"{name}: say how many particles there are in all, "
                "IslandFilter(ParticleFilter(100_000), ...)"
            )
        if count % self.islands or count // self.islands < 2:
            raise ValueError(
                f"{name}: {count} particles do not make {self.islands} equal islands of two or more"
            )
        for option in ("adapt", "recovery", "delay"):
            if getattr(self.cloud, option) is not None:
                raise ValueError(
                    f"{name}: islands have as many particles in every row and answer as rows come; leave out "
                    f"{option}= of the ParticleFilter, or have one island"
                )

    def refusal(self, problem: SeriesProblem) -> str | None:
        why = self.cloud.refusal(problem)
        if why is not None or self.islands == 1:
            return why
        apart = plates_apart(problem.slices)
        if apart:
            return (
                f"IslandFilter: elements of the plate {apart[0]!r} never meet and have weights of their own, "
                "so islands would have to exchange for each; ParticleFilter(particles) filters them side by "
                "side, and filter takes a list of series"
            )
        return None

    def unable(self, problem: SeriesProblem, asked: Asked) -> str | None:
        if self.islands == 1:
            return self.cloud.unable(problem, asked)
        if asked.what in ("smooth", "fixed-lag") or asked.keep is not None:
            return (
                "IslandFilter keeps no particles of past slices, and does not smooth; "
                "ParticleFilter(particles) does"
            )
        return super().unable(problem, asked)

    def treatment(self, problem: SeriesProblem) -> Callable[[str], str]:
        return self.cloud.describe(problem).__getitem__

    def describe(self, problem: SeriesProblem) -> dict[str, str]:
        return self.cloud.describe(problem)

    def effort(self, problem: SeriesProblem) -> str:
        if self.islands == 1:
            return self.cloud.effort(problem)
        each = self._island().particles
        return f"{self.islands} islands of {each} particles; {self.cloud.effort(problem)}"

    def filter(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        keep: str | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
        executor: Any = None,
        checkpoint: RunFile | None = None,
    ) -> FilteredParticles:
        if self.islands == 1:
            told: dict[str, Any] = {"keep": keep, "queries": queries, "progress": progress}
            return self.cloud.filter(problem, seed, checkpoint=checkpoint, **told)
        why = self.refusal(problem) or self.unable(problem, Asked("filter", keep))
        if why is not None:
            raise UnsupportedError(why)
        try:
            with ExitStack() as stack:
                where = stack.enter_context(folder()) if shares_memory(executor) else None
                run = _Run(self, problem, seed, queries or {}, where, executor, checkpoint)
                found = run.whole(
                    stack.enter_context(Progress(problem.steps, self.label, progress))
                )
            if checkpoint is not None:
                checkpoint.finish(found)
        except KeyboardInterrupt as stop:
            found = answer_so_far(stop, self)
        warn_of_errors(found, found, problem.slices, self.cloud)
        return found

    def smooth(self, problem: SeriesProblem, seed: np.random.SeedSequence, **options: Any) -> Any:
        if self.islands == 1:
            return self.cloud.smooth(problem, seed, **options)
        raise UnsupportedError(self.unable(problem, Asked("smooth")) or "")

    def _island(self) -> ParticleFilter:
        assert self.cloud.particles is not None
        return replace(self.cloud, particles=self.cloud.particles // self.islands)


# ---- private ------------------------------------------------------------------------------------


class _Run:
    """One run: islands as they stand, and the rows that all of them have passed."""

    def __init__(
        self,
        engine: IslandFilter,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        queries: Queries,
        where: str | None,
        executor: Any,
        file: RunFile | None = None,
    ) -> None:
        self.engine, self.problem, self.queries, self.executor = engine, problem, queries, executor
        island = _with_its_code(engine._island(), problem, file)
        self.shared = {
            "problem": problem, "engine": island, "queries": queries, "seed": seed,
            "purpose": Purpose.FILTER, "folder": where,
        }  # fmt: skip
        count = engine.islands
        self.rng = stream(seed, Purpose.RESAMPLE)
        self.clouds: list[Any] = [None] * count
        self.chances: list[Any] = [None] * count
        #: log weights of islands, and what their sum stands for
        self.log = np.full(count, -np.log(count))
        self.rows = IslandRows(count)
        self.exchanged: list[int] = []
        self.saved = None if file is None else SavedIslands(file, self.rows)

    def whole(self, bar: Progress) -> FilteredParticles:
        """All rows."""
        (k, ahead), steps = self.begun(), self.problem.steps
        bar.advance(k)
        try:
            while k < steps:
                last = min(k + ahead, steps)
                passed = self.passed(k, last)
                stop = self.first_uneven(k, last, passed)
                if stop is None:
                    self.taken(passed, last - k, bar)
                    ahead = min(2 * ahead, _MOST)
                else:
                    if stop < last:
                        self.forget(passed)
                        passed = self.passed(k, stop)
                    self.taken(passed, stop - k, bar)
                    self.exchange()
                    ahead = max(_LEAST, min(2 * (stop - k), _MOST))
                    last = stop
                k = last
                if self.saved is not None and k < steps:
                    self.saved.passed(self.state(k, ahead))
        except (Exception, KeyboardInterrupt) as error:
            hand_over(error, self.posterior(k) if k else None)
            raise
        return self.posterior(steps)

    def begun(self) -> tuple[int, int]:
        """Rows that all islands have passed, and how many they pass next: of an earlier process, or none."""
        state = None if self.saved is None else self.saved.begin(self.shared["folder"])
        if state is None:
            return 0, _FIRST
        self.clouds, self.chances, self.log = state["clouds"], state["chances"], state["log"]
        self.rng.bit_generator.state = state["generator"]
        return state["passed"], state["ahead"]

    def state(self, passed: int, ahead: int) -> dict[str, Any]:
        """What another process needs to go on."""
        return {
            "passed": passed, "ahead": ahead, "clouds": self.clouds, "chances": self.chances,
            "log": self.log, "generator": self.rng.bit_generator.state,
        }  # fmt: skip

    def passed(self, first: int, last: int) -> list[Passed]:
        """Rows passed by all islands."""
        units = [
            (i, first, last, cloud, chance)
            for i, (cloud, chance) in enumerate(zip(self.clouds, self.chances, strict=True))
        ]
        found: list[Any] = [None] * len(units)
        for number, one in completed(pass_rows, self.shared, units, self.executor):
            found[number] = one
        return found

    def first_uneven(self, first: int, last: int, passed: Sequence[Passed]) -> int | None:
        """The row before which islands exchange, as a position; None where they need not."""
        steps = max(one.steps for one in passed)
        alive = np.array([one.steps for one in passed])
        if not steps:
            raise next(one.died for one in passed if one.died is not None)
        paths = self.paths(passed, steps)
        top = paths.max(axis=1, keepdims=True)
        weights = np.exp(paths - top)
        ess = weights.sum(axis=1) ** 2 / (weights**2).sum(axis=1)
        poor = ess < self.engine.threshold * self.engine.islands
        poor |= np.arange(1, steps + 1) > alive.min()  # some island has no weight left
        at = np.flatnonzero(poor)
        if not at.size:
            whole = steps == last - first
            return None if whole else first + steps  # in the row after, all of them die
        stop = first + int(at[0]) + 1
        return None if stop == self.problem.steps else stop

    def paths(self, passed: Sequence[Passed], steps: int) -> np.ndarray:
        """Log weights of islands after each row, shape (rows, islands)."""
        found = np.full((steps, len(passed)), -np.inf)
        for i, one in enumerate(passed):
            if one.steps:
                increments = one.rows["filter"]["increments"]
                found[: one.steps, i] = self.log[i] + np.cumsum(increments)
        return found

    def taken(self, passed: Sequence[Passed], steps: int, bar: Progress) -> None:
        """Keep the answers about some rows, and where islands stand after them."""
        paths = self.paths(passed, steps)
        self.rows.add([one.rows for one in passed], paths, self.log, [one.error for one in passed])
        old, self.clouds = self.clouds, [one.cloud for one in passed]
        drop([c for c in old if c is not None], self.clouds)
        self.chances = [one.chance for one in passed]
        self.log = paths[-1]
        bar.advance(steps)

    def forget(self, passed: Sequence[Passed]) -> None:
        """Rows that were passed in vain."""
        drop([one.cloud for one in passed], self.clouds)

    def exchange(self) -> None:
        """Islands resampled whole; each goes on with random numbers of its own."""
        total = float(log_sum_exp(self.log))
        count = len(self.log)
        weights = np.exp(self.log - self.log.max())
        chosen = systematic(weights, count, self.rng)
        # who stays, stays in its place: only copies move
        kept = set(chosen.tolist())
        spare = iter(np.sort(chosen)[np.flatnonzero(np.diff(np.sort(chosen), prepend=-1) == 0)])
        source = [i if i in kept else int(next(spare)) for i in range(count)]
        old, self.clouds = self.clouds, [self.clouds[j] for j in source]
        drop([c for c in old if c is not None], self.clouds)
        self.log = np.full(count, total - np.log(count))
        self.rows.exchanged(source)

    def posterior(self, steps: int) -> FilteredParticles:
        """The answers of all islands about the first so many rows."""
        combined = answered(self.rows, self.problem)
        seen = observed_answers(self.problem, steps)
        answers: Mapping[str, Any] = {
            "tables": {**seen.tables, **combined["tables"]},
            "means": {**seen.means, **combined["means"]},
            "variances": {**seen.variances, **combined["variances"]},
            "queries": combined["queries"],
            "start": self.problem.series.start,
        }
        found = FilteredIslands(
            self.problem.model, self.engine, "filter", answers=answers, diagnostics=combined["filter"],
            errors=(self.rows.error, combined["errors"], combined["query errors"]),
        )  # fmt: skip
        start = self.problem.series.start
        found.exchanged = np.array([start + k for k in self.rows.exchanges], dtype=int)
        return found


def _with_its_code(engine: ParticleFilter, problem: SeriesProblem, file: RunFile | None) -> Any:
    """The filter of an island; of a run that is saved with the kind of code it was begun with."""
    if file is None:
        return engine
    if file.state is None:
        compiled = engine.compiled
        if compiled is None:
            assert engine.particles is not None
            compiled = is_worth_compiling(engine.particles, problem.steps)
        file.state = {"compiled": compiled}
        file.save(None, file.state)
    return replace(engine, compiled=file.state["compiled"])
