"""``DiscreteFilter``: exact answers over time where everything hidden is finite.

Options, refusals and the calls; tables of slices are made in ``slices``, passed along in
``chain`` and read in ``answers``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bayesmc.dbn import DynamicBayesNet, Row, SeriesProblem, Slices, read_static
from bayesmc.engines.discrete.answers import SliceAnswers, answer_queries, best_path
from bayesmc.engines.discrete.limits import is_untold, size_refusal, why_unreadable
from bayesmc.engines.discrete.posterior import DiscreteBelief, DiscretePosterior, window
from bayesmc.engines.discrete.run import Run
from bayesmc.engines.discrete.slices import DiscreteSlices
from bayesmc.engines.discrete.states import path_values, rows_compared
from bayesmc.engines.filtering import Asked, FilterEngine, Queries, observed_answers
from bayesmc.engines.slice_steps import plates_apart
from bayesmc.errors import BayesmcError, BudgetError, UnsupportedError
from bayesmc.network.forward import refuse_noiseless, refuse_parts
from bayesmc.network.node import nodes_read
from bayesmc.progress import Progress
from bayesmc.results.predictive import warn_of_misfit


@dataclass(frozen=True)
class DiscreteFilter(FilterEngine):
    """Exact filtering, smoothing and decoding where all hidden nodes have finitely many values.

    The nodes that the next slice reads form one joint state; whatever else is hidden is summed out within
    its slice. Variables that never meet are passed separately, and elements of plates that never meet are
    one more array axis, so 64 sequences cost little more than one. Observed nodes may have any density,
    and be read by the next slice; where one is missing, it is averaged over if nothing depends on it.

    Parameters
    ----------
    max_states : int
        Joint states of one chain above which it refuses.
    max_bytes : float
        Memory above which it refuses, with the figure, before allocating.

    Notes
    -----
    A slice costs the square of the number of joint states. ``most_likely`` maximises over all hidden finite
    nodes together, missing observations included; a missing continuous observation is averaged over.

    References
    ----------
    Rabiner (1989), A tutorial on hidden Markov models; Murphy (2002), Dynamic Bayesian networks, sec. 3.4
    (the interface algorithm); Koller and Friedman (2009), sec. 15.2.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc import DiscreteFilter
    >>> dbn = bmc.DynamicBayesNet("umbrella world")
    >>> dbn.table("rain", ["rain_prev"], [[0.7, 0.3], [0.3, 0.7]], ("no", "yes"), initial=[0.5, 0.5])
    >>> dbn.table("umbrella", ["rain"], [[0.8, 0.2], [0.1, 0.9]], ("no", "yes"))
    >>> seen = {"umbrella": ["yes", "yes", "no"]}
    >>> smoothed = bmc.smooth(dbn, seen, engine=DiscreteFilter())
    >>> smoothed.probabilities("rain")[:, 1].round(3).tolist()
    [0.862, 0.799, 0.191]
    >>> bmc.most_likely(dbn, seen, engine=DiscreteFilter())["rain"].tolist()
    ['yes', 'yes', 'no']
    """

    max_states: int = 1 << 16
    max_bytes: float = 2.0 * 2**30

    label: ClassVar[str] = "discrete filter"
    is_exact: ClassVar[bool] = True
    belief: ClassVar[type] = DiscreteBelief

    def __post_init__(self) -> None:
        n = self.max_states
        if isinstance(n, bool) or not isinstance(n, (int, np.integer)) or n < 1:
            raise ValueError(
                f"DiscreteFilter(max_states={n!r}): give a number of states, 1 or more"
            )
        if not (isinstance(self.max_bytes, (int, float)) and self.max_bytes > 0):
            raise ValueError(
                f"DiscreteFilter(max_bytes={self.max_bytes!r}): give a positive number of bytes"
            )

    def refusal(self, problem: SeriesProblem) -> str | None:
        common = super().refusal(problem)
        if common is not None:
            return common
        parts = refuse_parts(problem.series.observed, "DiscreteFilter")
        if parts is not None:
            return parts
        for compiled in (problem.slices.first, problem.slices.later):
            reason = refuse_noiseless(compiled, problem.series.observed, "DiscreteFilter")
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
                    run = Run(self._plan(problem, leaves), problem.series)
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
        sizes = {v[1]: c.size for c in plan.chains for v in c.state}

        def treated(name: str) -> str:
            if name in sizes:
                return f"part of a state with {sizes[name]} values"
            if name in plan.reader.variables:
                return "summed out in its slice"
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
                f"keep={keep!r}: an exact filter has no particles to keep; leave it out"
            )
        found = self._answer(problem, seed, "filter", None, queries, progress)
        warn_of_misfit(found.predictive, "DiscreteFilter", found.start, 3)
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
        warn_of_misfit(found.predictive, "DiscreteFilter", found.start, 3)
        return found

    def most_likely(
        self, problem: SeriesProblem, seed: np.random.SeedSequence, progress: bool | None = None
    ) -> dict[str, np.ndarray]:
        self._check(problem, leaves=False)
        run = Run(self._plan(problem, leaves=False), problem.series)
        path = best_path(run)
        if path is None or run.is_suspect:
            run.forward()  # says what is impossible, or wrong
        assert path is not None
        return path_values(run, path, problem.hidden)

    def _bound(
        self, belief: DiscreteBelief, dbn: DynamicBayesNet, slices: Slices
    ) -> DiscreteBelief:
        static = read_static(slices, belief.static)
        plan = DiscreteSlices(slices, plates_apart(slices), frozenset(), static)
        run = Run(plan, belief.state.series, belief.t, belief.state.before)
        run.forward()  # the slice once more, from the beliefs before it
        return belief.bound(dbn, slices, run)

    def _absorbed(self, belief: DiscreteBelief, slices: Slices, row: Row) -> DiscreteBelief:
        t, run = belief.t + 1, belief.state
        if run is None:
            static = read_static(slices, belief.static)
            plan = DiscreteSlices(slices, plates_apart(slices), frozenset(), static)
            error = size_refusal(plan, 1, self.max_states, self.max_bytes)
            if error is not None:
                raise error
        else:
            plan = run.plan
        series = window(slices, None if run is None else run.series, row)
        reason = why_unreadable(plan, series, last=True)
        if reason is not None:
            raise UnsupportedError(_words(reason))
        before = None if run is None else [p.logs(slice(-1, None))[0] for p in run.passed]
        after = Run(plan, series, t, before)
        increment = after.forward()[0].reshape(plan.reader.lead)
        return belief.after(slices, row, increment, after)

    # ---- private -------------------------------------------------------------------------------

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
        run = Run(self._plan(problem, leaves), problem.series)
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
            return UnsupportedError(_words(str(error)))
        if reason is not None:
            return UnsupportedError(_words(reason))
        too_large = size_refusal(plan, problem.steps, self.max_states, self.max_bytes)
        if too_large is not None:
            return too_large
        try:
            plan.try_out(problem.series)
        except BayesmcError as error:
            return UnsupportedError(
                "DiscreteFilter evaluates functions on all states of their parents, also impossible ones, "
                f"and one of them fails there: {error}; use ParticleFilter(particles)"
            )
        return None

    def _plan(self, problem: SeriesProblem, leaves: bool = True) -> DiscreteSlices:
        key = f"discrete slices {leaves}"
        if key not in problem.cache:
            seen = frozenset(n for n, o in problem.series.observed.items() if o.mask is None)
            absent = frozenset(
                n for n in problem.slices.dynamic if n not in problem.series.observed
            )
            static = {n: o.value for n, o in problem.series.static.items()}
            apart = plates_apart(problem.slices)
            problem.cache[key] = DiscreteSlices(problem.slices, apart, seen, static, leaves, absent)
        return problem.cache[key]


# ---- private ------------------------------------------------------------------------------------


def _words(reason: str) -> str:
    return (
        f"DiscreteFilter needs every hidden node to have finitely many values, but {reason}; use "
        "ParticleFilter(particles)"
    )
