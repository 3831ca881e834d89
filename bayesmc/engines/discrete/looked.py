"""Draws from the beliefs of a discrete filter, so that rows can be held against those that it expects."""

from __future__ import annotations

import numpy as np

from bayesmc.categorical import pick
from bayesmc.dbn import SeriesProblem
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.discrete.path import states_of
from bayesmc.engines.discrete.rows import Variable
from bayesmc.engines.discrete.run import Run
from bayesmc.engines.particles.replicates import Replicates
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.randomness import Purpose, stream
from bayesmc.results.predictive import Predictive

#: slices that are looked at, at most: each costs as much as dozens of rows
_MOST = 60


def rows_compared(problem: SeriesProblem, run: Run) -> Predictive | None:
    """How rows compare with those that the filter expected; ``run`` has been passed forwards.

    An exact filter answers without a seed, so that the draws are the same always.
    """
    static = {n: o.value for n, o in problem.series.static.items()}
    plan = SlicePlan(problem.slices, tuple(run.plan.reader.apart), static)
    looks = Replicates(problem, plan, stream(np.random.SeedSequence(0), Purpose.CHECK), most=_MOST)
    with marking_invalid(), np.errstate(all="ignore"):
        for k in range(problem.steps):
            if looks.wanted(k):
                looks.look(k, _Draws(run, k - 1) if k else None, problem.series.row(k))
    return looks.found()


# ---- private ------------------------------------------------------------------------------------


class _Draws:
    """Draws from the belief of one slice."""

    def __init__(self, run: Run, at: int) -> None:
        self.run, self.at = run, at

    def __call__(self, rng: np.random.Generator, count: int) -> dict[str, np.ndarray]:
        run, plan = self.run, self.run.plan
        row, states = run.series.row(self.at), self._states(rng, count)
        values = {**plan.reader.static, **row.inputs, **{n: s.value for n, s in row.seen.items()}}
        model, found = plan.slices.model(row.t), {}
        for name in (n for n in plan.slices.dynamic if n in plan.reader.variables):
            if all((0, name, e) in states for e in range(plan.reader.elements(name))):
                values[name] = states_of(run, states, name, count)
        for name in plan.slices.interface:
            if name not in values:  # computed; of what the slice alone tells, or nothing is said
                values[name] = model.evaluate(name, values)[0]
            found[name] = values[name]
        return found

    def _states(self, rng: np.random.Generator, count: int) -> dict[Variable, np.ndarray]:
        """Of every variable that the next slice reads, shape (count, sequences)."""
        found: dict[Variable, np.ndarray] = {}
        for chain, passed in zip(self.run.plan.chains, self.run.passed, strict=True):
            belief = passed.belief[self.at]
            sizes = [self.run.plan.cards[v] for v in chain.state]
            flat = pick(belief.T, rng.random((count, len(belief))))
            if sizes:
                codes = np.unravel_index(flat, sizes)
                found.update(zip(chain.state, codes, strict=True))
        return found
