"""States of variables as values of nodes: the most likely path, and draws that rows are held against."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import UNCOMPARED, SeriesProblem
from bayesmc.engines.discrete.limits import first_gap
from bayesmc.engines.discrete.rows import Rows, Term, Variable
from bayesmc.engines.discrete.run import Run
from bayesmc.engines.filtering import quiet
from bayesmc.engines.particles.predictive import Replicates
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.randomness import Purpose, stream
from bayesmc.results.predictive import Predictive

#: slices that are looked at, at most: each costs as much as dozens of rows
_MOST = 60


def path_values(
    run: Run, path: Mapping[Variable, np.ndarray], names: Sequence[str]
) -> dict[str, np.ndarray]:
    """User values of hidden nodes, time first; nodes that rest on missing numbers are left out.

    Parameters
    ----------
    path : dict
        Variable -> its states, shape (steps, sequences).
    """
    plan, reader, found = run.plan, run.plan.reader, {}
    stored = {
        n: _states_of(run, path, n, run.steps) for n in plan.slices.dynamic if n in reader.variables
    }
    for name in names:
        node = plan.slices.first[name]
        if name in reader.variables:
            found[name] = np.array(node.decode(stored[name]), subok=True)
        elif not node.is_stochastic:
            terms = [plan.terms[name, k] for k in (0, 1, 2)]
            if all(first_gap(plan, run.series, t) is None for t in terms):
                found[name] = _computed(run, stored, name)
    return found


def rows_compared(problem: SeriesProblem, run: Run) -> Predictive | None:
    """How rows compare with those that the filter expected; ``run`` has been passed forwards.

    An exact filter answers without a seed, so that the draws are the same always.
    """
    if problem.cache.get(UNCOMPARED):
        return None
    plan = SlicePlan(problem.slices, tuple(run.plan.reader.apart), problem.known_static)
    looks = Replicates(problem, plan, stream(np.random.SeedSequence(0), Purpose.CHECK), most=_MOST)
    with quiet():
        for k in range(problem.steps):
            if looks.wanted(k):
                looks.look(k, _Draws(run, k - 1) if k else None, problem.series.row(k))
    return looks.found()


# ---- private ------------------------------------------------------------------------------------


def _states_of(run: Run, path: Mapping[Variable, np.ndarray], name: str, count: int) -> np.ndarray:
    """Stored values of a node, shape (count, *plates), from states of shape (count, sequences)."""
    reader, node = run.plan.reader, run.plan.slices.first[name]
    found = np.empty((count, *node.plate_shape), dtype=np.intp)
    for element in range(reader.elements(name)):
        reader.put_element(found, node, element, path[0, name, element])
    return found


def _computed(run: Run, stored: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """User values of a deterministic node along the path."""
    plan, parts = run.plan, []
    node = plan.slices.first[name]
    for start, stop in run.stretches(1.0):
        rows = plan.rows(run.series, start, stop)
        term = plan.terms[name, rows.kind]

        def read(term: Term, rows: Rows) -> tuple[Any, ...]:
            values = {}
            for lag, other in (*term.alone, *term.whole):
                values[lag, other] = stored[other][rows.start - lag : rows.stop - lag]
            with quiet():
                value = plan.reader.value(rows.at(values, 1), name, 0)
            return (value.reshape((1,) * (1 + len(node.value_shape) - value.ndim) + value.shape),)

        (value,) = plan.reader.over_rows(term, rows, read)
        own = plan.reader.model(rows.kind, 0)[name]
        stored_rows = np.broadcast_to(value, (rows.count, *node.value_shape))
        is_labelled = own.domain is not None and own.domain.labels is not None
        parts.append(stored_rows if is_labelled else np.asarray(own.decode(stored_rows)))
    joined = np.concatenate(parts)
    if node.domain is not None and node.domain.labels is not None:
        return np.array(node.decode(joined), subok=True)
    return joined


class _Draws:
    """Draws from the belief of one slice."""

    def __init__(self, run: Run, at: int) -> None:
        self.run, self.at = run, at

    def __call__(self, rng: np.random.Generator, count: int) -> dict[str, np.ndarray]:
        run, plan = self.run, self.run.plan
        row, states = run.series.row(self.at), run.drawn(self.at, rng, count)
        values = {**plan.reader.static, **row.inputs, **{n: s.value for n, s in row.seen.items()}}
        model, found = plan.slices.model(row.t), {}
        for name in (n for n in plan.slices.dynamic if n in plan.reader.variables):
            if all((0, name, e) in states for e in range(plan.reader.elements(name))):
                values[name] = _states_of(run, states, name, count)
        for name in plan.slices.interface:
            if name not in values:  # computed; of what the slice alone tells, or nothing is said
                values[name] = model.evaluate(name, values)[0]
            found[name] = values[name]
        return found
