"""What the run of a filter over a series keeps: answers of constant size, or the particles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import Row, SeriesProblem
from bayesmc.engines.averages import naming
from bayesmc.engines.filtering import (
    Queries,
    first_slices,
    observed_answers,
    refuse_forecast,
)
from bayesmc.engines.particles.agreed import numbers_of, write_agreed
from bayesmc.engines.particles.answers import Answers, at_scouts, evaluated
from bayesmc.engines.particles.blocks import NUMBERS, Block, Figures, alike, diagnosed, figures_of
from bayesmc.engines.particles.errors import ByFamily, Variances, function_errors, node_errors
from bayesmc.engines.particles.families import Families
from bayesmc.engines.particles.genealogy import evidence_error
from bayesmc.engines.particles.made import MadeSlices
from bayesmc.engines.particles.smc import Layout, Particles
from bayesmc.engines.particles.sums import Tally, answers, figures
from bayesmc.engines.particles.tracking import Tracker
from bayesmc.engines.particles.written import (
    KINDS,
    Rows,
    Waiting,
    Written,
    count,
    joined,
    last_rows,
    together,
)
from bayesmc.errors import QueryError
from bayesmc.network import Model
from bayesmc.results.predictive import Predictive
from bayesmc.results.series import SeriesPosterior, without_labels

#: slices that are written together, at most, and those that are though half as many would stay in cache
TOGETHER, FEW = 100, 6
#: what waits to be written
_UNSETTLED = ("_waiting", "_most", "_tallies", "_figures", "_summed")


class Record:
    """Answers about each slice, written as the slices pass, some slices at a time.

    Parameters
    ----------
    problem : SeriesProblem
    layout : Layout
    queries : dict
    keep : bool
        Hold the particles, too.
    tracker : Tracker, optional
        Follows the families; without it there are errors only of slices that come with theirs.
    names : sequence of str, optional
        Nodes about which there are answers; all that are hidden by default.
    """

    def __init__(
        self,
        problem: SeriesProblem,
        layout: Layout,
        queries: Queries,
        keep: bool,
        tracker: Tracker | None = None,
        names: Sequence[str] | None = None,
    ) -> None:
        self.problem, self.layout, self.asked, self.tracker = problem, layout, queries, tracker
        self._nodes = [problem.model[n] for n in (problem.hidden if names is None else names)]
        self._waiting: list[Waiting] = []
        self._most = 1
        self._written: list[Written] = []
        self._packed = 0
        self._room: dict[Any, np.ndarray] = {}
        self.keep = keep
        #: takes sums of slices as they come, or None; and what is summed and not written yet
        self._summing = None if tracker is None or queries else tracker.summing(self._nodes)
        self._tallies: list[Tally] = []
        self._figures: list[Figures] = []
        self._summed: list[Particles] = []

    def add(
        self, k: int, particles: Particles, row: Row | None = None, families: Families | None = None
    ) -> None:
        """Take in the particles of the k-th slice."""
        if self._summing is not None and row is not None and self._summing.fits(particles):
            self._sum(particles, row)
            return
        if self._tallies:
            self.write()
        values = {}
        for name, function in self.asked.items():
            with naming(name):
                values[name] = evaluated(self.layout, particles, self.problem.model, function)
        if self._waiting and not alike(self._waiting[-1].particles, particles):
            self.write()
        self._waiting.append(Waiting(k, particles, row, families, values))
        if len(self._waiting) == 1:
            self._most = self._together(particles)
        if len(self._waiting) >= self._most:
            self.write()

    @property
    def is_written(self) -> bool:
        """Whether no particles wait: then those of the past are not needed any more."""
        return not self._waiting

    @property
    def families(self) -> Families | None:
        """Those of the last slice that is written, or summed."""
        if self._tallies:
            return self._tallies[-1].families
        last = self._written[-1].families if self._written else []
        return last[-1] if last else None

    def write(self) -> None:
        """Work out the answers about all slices that wait, or none where it ends early."""
        if not self._waiting and not self._tallies:
            return
        worked_out = self._worked_out(self._waiting) if self._waiting else self._tallied()
        earlier = self._written
        if earlier and not self.keep:
            earlier = [*earlier[:-1], earlier[-1]._replace(particles=[], families=[])]
            if len(earlier) - self._packed >= TOGETHER:  # many small arrays hold more than one
                earlier = [*earlier[: self._packed], together(earlier[self._packed :])]
                self._packed += 1
        self._written, self._waiting = [*earlier, worked_out], []
        self._tallies, self._figures, self._summed = [], [], []

    def add_made(self, made: MadeSlices) -> None:
        """Take in slices that were made together, the next ones; all before are written."""
        assert self.tracker is not None and self.families is not None
        *earlier, before = self._written
        families, sums = made.followed(self.tracker, self.families, before.particles[-1])
        rows: Rows = {what: {} for what in KINDS} | {"filter": made.diagnosed()}
        for node, found in made.figures_of(self._nodes, figures(sums)):
            for what, own in zip(("means", "variances", "errors"), found, strict=True):
                rows[what][node.name] = own.reshape(-1, *node.value_shape)
        written = Written(rows, [families], [made.particles(len(made) - 1)])
        self._written = [*earlier, before._replace(particles=[], families=[]), written]

    def _sum(self, now: Particles, row: Row) -> None:
        """Take the sums of a slice."""
        assert self.tracker is not None and self._summing is not None
        if self._waiting or len(self._tallies) >= TOGETHER:
            self.write()
        earlier = self._summed[-1] if self._summed else None
        if earlier is None and self._written:
            earlier = self._written[-1].particles[-1]
        tally = self.tracker.tally(self.families, earlier, now, row, self._summing)
        self._tallies.append(tally)
        self._figures.append(figures_of(now))
        self._summed = [*self._summed, now] if self.keep else [now]

    def _tallied(self) -> Written:
        """The answers about slices of which there are sums."""
        found, rows = answers(self._tallies), Rows({what: {} for what in KINDS})
        for node in self._nodes:
            for what, own in zip(("means", "variances", "errors"), found[node.name], strict=True):
                rows[what][node.name] = own.reshape(-1, *node.value_shape)
        rows["filter"] = diagnosed(self._figures, self.layout.lead)
        families = [t.families for t in self._tallies]
        return Written(rows, families if self.keep else families[-1:], self._summed)

    def _worked_out(self, waiting: Sequence[Waiting]) -> Written:
        slices = [w.particles for w in waiting]
        block = Block(self.layout, slices, room=self._room)
        families = self._followed(waiting, block)
        by = ByFamily(block, families) if families else None
        rows: Rows = {what: {} for what in KINDS}
        for node in self._nodes:
            name = node.name
            if write_agreed(rows, block, by, node):
                continue
            if node.domain is not None:
                rows["tables"][name] = block.table(node)
            else:
                rows["means"][name], rows["variances"][name] = block.mean_and_variance(node)
            if by is not None:
                rows["errors"][name] = node_errors(by, block, node)
        for name, function in self.asked.items():
            values = [w.values[name] for w in waiting]
            mean = block.weighted(block.turned(values))
            rows["queries"][name] = mean.reshape(len(values), *values[0].shape[1:])
            if by is not None:
                model = self.problem.model
                pairs = zip(slices, families, strict=True)
                there = [at_scouts(self.layout, p, f, model, function) for p, f in pairs]
                rows["query errors"][name] = function_errors(by, block, values, there)
        rows["filter"] = diagnosed([figures_of(p) for p in slices], self.layout.lead)
        kept = slice(None) if self.keep else slice(-1, None)
        return Written(rows, families[kept], slices[kept])

    def posterior(
        self,
        engine: Any,
        kind: str = "filter",
        steps: int | None = None,
        predictive: Predictive | None = None,
        filtered: FilteredParticles | None = None,
        sharing: Variances | None = None,
    ) -> FilteredParticles:
        """The answers of all slices, or of the first so many; with the figures of a filter, or those here."""
        self.write()
        k = self.problem.steps if steps is None else steps
        tables, means, variances = (self._joined(w, k) for w in ("tables", "means", "variances"))
        seen, families = observed_answers(self.problem, k), self.families
        if filtered is None:
            filter, last = self._joined("filter", k), self._written[-1].particles[-1]
            told = None if families is None else evidence_error(families, last)
        else:
            filter, told = filtered.diagnostics, filtered.log_marginal_likelihood_mcse
            predictive = filtered.predictive
        held = None
        if self.keep:
            particles = [p for w in self._written for p in w.particles]
            known = [f for w in self._written for f in w.families]
            held = Answers(self.layout, self.problem.model, particles[:k], known[:k], sharing)
        return FilteredParticles(
            self.problem.model,
            engine,
            kind,
            answers={
                "tables": {**seen.tables, **tables},
                "means": {**seen.means, **means},
                "variances": {**seen.variances, **variances},
                "queries": self._joined("queries", k),
                "start": self.problem.series.start,
            },
            diagnostics=filter,
            errors=(told, self._joined("errors", k), self._joined("query errors", k)),
            predictive=predictive,
            held=held,
        )

    def smoothed(
        self, engine: Any, sharing: Variances, filtered: FilteredParticles
    ) -> FilteredParticles:
        """The answers of trajectories, with their errors: infinite where the filter's are."""
        self.write()
        assert filtered.mean_errors is not None
        slices = [p for w in self._written for p in w.particles]
        rows = self._written[0].rows  # of all slices at once
        held = Answers(self.layout, self.problem.model, slices, [], sharing)
        rows["errors"] |= held.node_errors(self._nodes, filtered.mean_errors)
        rows["query errors"] |= {name: held.mcse(f) for name, f in self.asked.items()}
        return self.posterior(engine, "smooth", filtered=filtered, sharing=sharing)

    # ---- what is saved of it ---------------------------------------------------------------------

    def written_since(self, slices: int) -> list[Written]:
        """What is written of the slices from one on, but for the last piece, which is ``unsettled``."""
        found, first = [], 0
        for piece in self._written[:-1]:
            end = first + count(piece)
            if end > slices:
                found.append(last_rows(piece, max(slices - first, 0)))
            first = end
        return found

    def unsettled(self) -> dict[str, Any]:
        """All else, which is yet to change."""
        return {name: getattr(self, name) for name in _UNSETTLED} | {"last": self._written[-1:]}

    def go_on(self, written: Sequence[Written], unsettled: Mapping[str, Any]) -> None:
        """Be where another record was."""
        for name in _UNSETTLED:
            setattr(self, name, unsettled[name])
        self._written, self._packed = [*written, *unsettled["last"]], len(written)

    # ---- private -------------------------------------------------------------------------------

    def _together(self, particles: Particles) -> int:
        """Slices that are written together."""
        numbers = sum(numbers_of(particles, n) for n in self._nodes)
        many = NUMBERS // max(numbers, len(particles.weights))
        return min(TOGETHER, max(1, many // 2, min(FEW, many)))

    def _followed(self, waiting: Sequence[Waiting], block: Block) -> list[Families]:
        """The families of slices that wait."""
        if self.tracker is None:
            return [w.families for w in waiting if w.families is not None]
        rows = [w.row for w in waiting if w.row is not None]
        earlier = self._written[-1].particles[-1] if self._written else None
        return self.tracker.after(self.families, earlier, block, rows)

    def _joined(self, what: str, steps: int) -> dict[str, np.ndarray]:
        return first_slices(joined(self._written, what), steps)


class FilteredParticles(SeriesPosterior):
    """What a particle filter says of every slice.

    Attributes
    ----------
    clouds : list of Particles or None
        Those of all slices, with ``keep="particles"``; functions of nodes, quantiles and covariances can
        be asked for then.
    counts : ndarray of int, shape (time,)
        Particles of each slice: always as many, unless ``adapt=`` says otherwise.
    anew : ndarray of int, shape (time,)
        How many of them ``recovery=`` let begin anew.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 2.0))
    >>> dbn.add("y", lambda x: bmc.StudentT(4.0, x, 0.5))
    >>> engine = bmc.ParticleFilter(1000)
    >>> filtered = bmc.filter(dbn, {"y": [1.2, 0.4]}, engine=engine, rng=0, keep="particles")
    >>> filtered.quantile("x", [0.1, 0.9]).shape, filtered.probability(lambda x: x > 0).shape
    ((2, 2), (2,))
    """

    counts: np.ndarray | None = None
    anew: np.ndarray | None = None

    def __init__(
        self,
        model: Model,
        engine: Any,
        kind: str,
        *,
        answers: Mapping[str, Any],
        diagnostics: Mapping[str, np.ndarray],
        errors: tuple[Any, Mapping[str, np.ndarray], Mapping[str, np.ndarray]],
        predictive: Predictive | None = None,
        held: Answers | None = None,
    ) -> None:
        super().__init__(model, engine, kind, diagnostics["increments"], **answers)
        self.log_marginal_likelihood_mcse, self.mean_errors, mcse = errors
        self.queries_mcse = dict(mcse)
        self.weight_ess, self.resampled = diagnostics["weight_ess"], diagnostics["resampled"]
        self.unique_ancestors = diagnostics["unique_ancestors"]
        self.rejuvenated = diagnostics["rejuvenated"]
        self.counts, self.anew = diagnostics["counts"], diagnostics["injected"]
        self.diagnostics, self.predictive, self.held = dict(diagnostics), predictive, held

    @property
    def clouds(self) -> list[Particles] | None:
        return None if self.held is None else self.held.particles

    def mcse(self, what: str | Callable[..., Any]) -> np.ndarray:
        """As of any series; with ``keep="particles"`` a function of nodes has errors, too."""
        return self._kept("mcse of a function").mcse(what) if callable(what) else super().mcse(what)

    def particles(self, name: str) -> np.ndarray:
        """Particles of all slices, shape ``(time, particles, *plates, *event)``, not weighted."""
        return self._alike("particles").stacked(self._node(name))

    @property
    def weights(self) -> np.ndarray:
        """Normalised weights of all slices, shape ``(time, particles, *plates)``."""
        return self._alike("weights").weights()

    @property
    def ancestors(self) -> np.ndarray:
        """Positions of the ancestors in the slice before, shape ``(time, particles, *plates)``.

        Particles that were drawn anew have none: -1.
        """
        return self._alike("ancestors").ancestors()

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions."""
        state = super().__getstate__()
        if self.held is not None:
            state["held"] = self.held._replace(model=state["model"])
        return state

    def last(self, steps: int, kind: str) -> SeriesPosterior:
        """The last so many slices by themselves."""
        refuse_forecast(self, kind)
        return super().last(steps, kind)

    def expectation(self, function: Callable[..., Any]) -> np.ndarray:
        """Means of a function of nodes of a slice, time first; see ``ParticleBelief.expectation``."""
        return self._kept("expectation").expectation(function)

    def probability(self, function: Callable[..., Any]) -> np.ndarray:
        """Probabilities of an event (a function that returns booleans), time first."""
        return self._kept("probability").probability(function)

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Quantiles, shape ``(time, *q.shape, *plates, *event)``."""
        node = without_labels(self._node(name), "quantile")
        return self._kept("quantile").quantile(node.name, q)

    def _held_laws(self, name: str) -> Any:
        return self._kept("hdi, mode, cdf or entropy").laws(name)

    def cov(self, *names: str) -> np.ndarray:
        """Covariance matrices of all numbers of the named nodes, time first; of one number, its variance."""
        return self._kept("cov").cov(*(self._node(name).name for name in names))

    def _alike(self, what: str) -> Answers:
        """What is held, where each slice has as many particles."""
        held = self._kept(what)
        if any(len(p.weights) != held.layout.particles for p in held.particles):
            raise QueryError(
                f"{what}: the number of particles changes from slice to slice (adapt=); see .clouds"
            )
        return held

    def _kept(self, what: str) -> Answers:
        if self.held is None:
            raise self._not_kept(what)
        return self.held
