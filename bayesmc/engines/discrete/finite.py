"""What filters of finite nodes share: refusals, the calls, and beliefs that take in rows one by one.

A family says how it plans slices, how it passes them and what is too large for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np

from bayesmc.dbn import DynamicBayesNet, Row, Series, SeriesProblem, Slices, read_static
from bayesmc.engines.discrete.answers import SliceAnswers, answer_queries
from bayesmc.engines.discrete.limits import is_untold, why_unreadable
from bayesmc.engines.discrete.posterior import DiscretePosterior, FiniteBelief, window
from bayesmc.engines.discrete.run import Run
from bayesmc.engines.discrete.slices import DiscreteSlices
from bayesmc.engines.discrete.states import rows_compared
from bayesmc.engines.filtering import Asked, FilterEngine, Queries, observed_answers
from bayesmc.engines.slice_steps import plates_apart
from bayesmc.errors import BayesmcError, BudgetError, UnsupportedError
from bayesmc.network.forward import refuse_noiseless, refuse_parts
from bayesmc.network.node import nodes_read
from bayesmc.progress import Progress
from bayesmc.results.predictive import warn_of_misfit


class FiniteFilter(FilterEngine):
    """Base of the filters of templates whose hidden nodes have finitely many values."""

    #: what is said of finite nodes that no other slice reads
    _inside: ClassVar[str] = "summed out in its slice"

    def refusal(self, problem: SeriesProblem) -> str | None:
        common = super().refusal(problem)
        if common is not None:
            return common
        parts = refuse_parts(problem.series.observed, self._name)
        if parts is not None:
            return parts
        for compiled in (problem.slices.first, problem.slices.later):
            reason = refuse_noiseless(compiled, problem.series.observed, self._name)
            if reason is not None:
                return reason
        error = self._why_not(problem)
        return None if error is None else str(error)

    def unable(self, problem: SeriesProblem, asked: Asked) -> str | None:
        reason = super().unable(problem, asked)
        if reason is None and asked.queries:
            try:
                leaves = not self._asks_for_leaves(problem, asked.queries)
                why = self._why_not(problem, leaves)
                if why is None:
                    run = self._run(self._plan(problem, leaves), problem.series)
                    for function in asked.queries.values():
                        SliceAnswers(run).check(function)
            except BayesmcError as error:
                why = UnsupportedError(str(error))
            reason = None if why is None else f"queries={list(asked.queries)}: {why}"
        return reason

    def unanswered(self, problem: SeriesProblem) -> tuple[str, ...]:
        plan, series = self._plan(problem), problem.series
        return tuple(
            n
            for n in problem.hidden
            if n not in plan.reader.variables and is_untold(plan, series, n)
        )

    def treatment(self, problem: SeriesProblem) -> Callable[[str], str]:
        plan, observed = self._plan(problem), problem.series.observed
        kept = self._kept(plan)

        def treated(name: str) -> str:
            if name in kept:
                return kept[name]
            if name in plan.reader.variables:
                return self._inside
            if not problem.model[name].is_stochastic:
                return "computed"
            if name not in observed:
                return "averaged over"
            missing = "; averaged over where it is missing"
            return "observed, a likelihood of the state" + missing * (
                observed[name].mask is not None
            )

        return treated

    def filter(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        keep: str | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
    ) -> DiscretePosterior:
        if keep is not None:
            raise ValueError(
                f"keep={keep!r}: a filter of tables has no particles to keep; leave it out"
            )
        found = self._answer(problem, seed, "filter", None, queries, progress)
        warn_of_misfit(found.predictive, self._name, found.start, 3)
        return found

    def smooth(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        lag: int | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
    ) -> DiscretePosterior:
        kind = "smooth" if lag is None else "fixed-lag"
        found = self._answer(problem, seed, kind, lag, queries, progress)
        warn_of_misfit(found.predictive, self._name, found.start, 3)
        return found

    def _bound(self, belief: FiniteBelief, dbn: DynamicBayesNet, slices: Slices) -> FiniteBelief:
        plan = self._plan_of(belief, slices)
        run = self._run(plan, belief.state.series, belief.t, belief.state.before)
        run.forward()  # the slice once more, from the beliefs before it
        return belief.bound(dbn, slices, run)

    def _absorbed(self, belief: FiniteBelief, slices: Slices, row: Row) -> FiniteBelief:
        t, run = belief.t + 1, belief.state
        series = window(slices, None if run is None else run.series, row)
        if run is None:
            plan = self._online(slices, belief.static, series)
            error = self._too_large(plan, 1)
            if error is not None:
                raise error
        else:
            plan = run.plan
        reason = why_unreadable(plan, series, last=True)
        if reason is not None:
            raise UnsupportedError(self._words(reason))
        after = self._run(plan, series, t, None if run is None else run.last())
        increment = after.forward()[0].reshape(plan.reader.lead)
        return belief.after(slices, row, increment, after)

    # ---- what a family says -----------------------------------------------------------------

    def _planned(
        self,
        slices: Slices,
        static: Mapping[str, np.ndarray],
        series: Series,
        seen: frozenset[str] = frozenset(),
        leaves: bool = True,
        absent: frozenset[str] = frozenset(),
    ) -> DiscreteSlices:
        """The tables of slices; ``series`` is what is known of the first ones."""
        return DiscreteSlices(slices, plates_apart(slices), seen, static, leaves, absent)

    def _run(self, plan: DiscreteSlices, series: Series, first: int = 0, before: Any = None) -> Run:
        """A pass over a series."""
        return Run(plan, series, first, before)

    def _kept(self, plan: Any) -> dict[str, str]:
        """What is said of the nodes that a slice hands on."""
        raise NotImplementedError

    def _too_large(self, plan: DiscreteSlices, steps: int) -> BudgetError | None:
        """Why the tables would be too large; None where they are not."""
        raise NotImplementedError

    # ---- private -------------------------------------------------------------------------------

    @property
    def _name(self) -> str:
        return type(self).__name__

    def _words(self, reason: str) -> str:
        if reason.startswith(f"{self._name}("):  # of its options
            return reason
        return (
            f"{self._name} needs every hidden node to have finitely many values, but {reason}; use "
            "ParticleFilter(particles)"
        )

    def _plan_of(self, belief: FiniteBelief, slices: Slices) -> DiscreteSlices:
        """The plan that a belief goes on with."""
        return self._online(slices, belief.static, belief.state.series)

    def _online(self, slices: Slices, static: Mapping[str, Any], series: Series) -> DiscreteSlices:
        """A plan for any rows."""
        return self._planned(slices, read_static(slices, static), series)

    def _answer(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        kind: str,
        lag: int | None,
        queries: Queries | None,
        progress: bool | None,
    ) -> DiscretePosterior:
        leaves = not self._asks_for_leaves(problem, queries)
        self._check(problem, leaves)
        run = self._run(self._plan(problem, leaves), problem.series)
        with Progress(3, self.label, progress) as bar:
            increments = run.forward().reshape(problem.steps, *run.plan.reader.lead)
            bar.advance()
            if kind != "filter":
                run.backward(lag)
            bar.advance()
            answers = SliceAnswers(run)
            seen, hidden = observed_answers(problem), answers.of(problem.hidden)
            found = DiscretePosterior(
                problem.model, self, kind, increments,
                tables={**seen.tables, **hidden.tables},
                means={**seen.means, **hidden.means},
                variances={**seen.variances, **hidden.variances},
                queries=answer_queries(answers, queries),
                start=problem.series.start,
            )  # fmt: skip
            found.predictive = rows_compared(problem, run)
            run.forget()
            bar.advance()
        return found.read_from(answers)

    def _asks_for_leaves(self, problem: SeriesProblem, queries: Queries | None) -> bool:
        """Whether a query reads finite nodes that would be left to be answered for one by one."""
        names = {p for f in (queries or {}).values() for p in nodes_read(f)}
        own = self._plan(problem).reader.variables
        return any(
            n in names and problem.model[n].domain is not None and n not in own
            and problem.model[n].is_stochastic
            for n in problem.hidden
        )  # fmt: skip

    def _check(self, problem: SeriesProblem, leaves: bool) -> None:
        error = self._why_not(problem, leaves)
        if error is not None:
            raise error

    def _why_not(self, problem: SeriesProblem, leaves: bool = True) -> UnsupportedError | None:
        """What speaks against this engine, found before any large table exists."""
        try:
            plan = self._plan(problem, leaves)
            reason = why_unreadable(plan, problem.series)
        except BudgetError as error:
            return error
        except BayesmcError as error:
            return UnsupportedError(self._words(str(error)))
        if reason is not None:
            return UnsupportedError(self._words(reason))
        too_large = self._too_large(plan, problem.steps)
        if too_large is not None:
            return too_large
        try:
            plan.try_out(problem.series)
        except BayesmcError as error:
            return UnsupportedError(
                f"{self._name} evaluates functions on all states of their parents, also impossible ones, "
                f"and one of them fails there: {error}; use ParticleFilter(particles)"
            )
        return None

    def _plan(self, problem: SeriesProblem, leaves: bool = True) -> DiscreteSlices:
        key = f"{self} slices {leaves}"
        if key not in problem.cache:
            seen = frozenset(n for n, o in problem.series.observed.items() if o.mask is None)
            absent = frozenset(
                n for n in problem.slices.dynamic if n not in problem.series.observed
            )
            problem.cache[key] = self._planned(
                problem.slices, problem.known_static, problem.series, seen, leaves, absent
            )
        return problem.cache[key]
