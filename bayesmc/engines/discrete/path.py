"""The most likely path as user values: states of all hidden finite nodes, and what is computed from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.discrete.limits import first_gap
from bayesmc.engines.discrete.rows import Rows, Term, Variable
from bayesmc.engines.discrete.run import Run


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
        n: states_of(run, path, n, run.steps) for n in plan.slices.dynamic if n in reader.variables
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


def states_of(run: Run, path: Mapping[Variable, np.ndarray], name: str, count: int) -> np.ndarray:
    """Stored values of a node, shape (count, *plates), from states of shape (count, sequences)."""
    reader, node = run.plan.reader, run.plan.slices.first[name]
    shape = (count, *reader.lead)
    inner = [p for p in node.plates if p not in reader.apart]
    elements = [path[0, name, e].reshape(shape) for e in range(reader.elements(name))]
    sizes = tuple(run.plan.slices.first.sizes[p] for p in inner)
    full = np.stack(elements, axis=-1) if elements else np.empty((*shape, 0), dtype=np.intp)
    full = full.reshape(*shape, *sizes)
    have = [*reader.apart, *inner]
    lacking = tuple(1 + k for k, p in enumerate(have) if p not in node.plates)
    full = full[tuple(0 if k in lacking else slice(None) for k in range(full.ndim))]
    left = [p for p in have if p in node.plates]
    return full.transpose(0, *(1 + left.index(p) for p in node.plates))


# ---- private ------------------------------------------------------------------------------------


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
            placed = rows.at(plan.reader, values, 1)
            with marking_invalid(), np.errstate(all="ignore"):
                value = placed.value(name, 0)
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
