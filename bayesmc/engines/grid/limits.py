"""Why a grid cannot answer, found before any large table exists."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from typing import Any

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.grid.slice import quiet
from bayesmc.engines.grid.sources import Label, is_previous, previous
from bayesmc.engines.grid.tables import GridModel
from bayesmc.errors import BayesmcError
from bayesmc.factors.named import largest
from bayesmc.network.node import nodes_read


def too_large(model: GridModel, problem: SeriesProblem, max_bytes: float) -> str | None:
    """Why the tables do not fit, found from their sizes alone."""
    hidden = frozenset(n for n in problem.hidden if n in model.own and n not in model.leaves)
    sizes: dict[Any, int] = dict(zip(model.apart, model.lead, strict=True))
    labels: list[Label] = []
    for name in sorted(hidden):
        axes = model.axes.of[name]
        for e in range(model.elements(name)):
            label = (name, e)
            labels.append(label)
            sizes[label] = sizes[previous(label)] = axes[e % len(axes)].size
    scopes = []
    for first in (True, False) if problem.steps > 1 else (True,):
        for name in hidden | set(problem.series.observed):
            if name not in model.own or (
                name in model.leaves and name not in problem.series.observed
            ):
                continue
            scope = model.scope(first, name, hidden)
            cells = [sizes[x] for x in scope]
            if 8 * math.prod(map(float, cells)) > max_bytes:
                return model.too_large(name, cells, 8 * math.prod(map(float, cells)))
            if any(map(is_previous, scope)):
                scopes.append(scope)
    belief: set[Any] = {previous(x) for x in labels} | set(model.apart)
    entries = largest([belief, *scopes], (*labels, *model.apart), sizes)
    if 8 * entries > max_bytes:
        names = ", ".join(sorted(hidden))
        return model.too_large(names, [sizes[x] for x in labels], 8 * entries)
    return None


def without_density(problem: SeriesProblem) -> str | None:
    """A node whose density cannot be evaluated, tried where its parents can be."""
    for model in (problem.slices.first, problem.slices.later):
        for name in problem.slices.stochastic:
            try:
                with quiet():
                    dist, _ = model.evaluate(name, model.probe)
                    model.log_density(name, dist, model.probe[name])
            except (BayesmcError, NotImplementedError) as error:
                why = str(error) or "it is not implemented"
                return f"GridFilter evaluates every density, and that of {name!r} cannot be: {why}"
    return None


def unread(
    model: GridModel, queries: Mapping[str, Callable[..., Any]], hidden: Collection[str]
) -> str | None:
    """Why a query cannot be answered: it reads a node that has no axes."""
    for query, function in queries.items():
        for name in nodes_read(function):
            if name in model.leaves and name in hidden:
                return (
                    f"queries={{{query!r}: ...}} reads {name!r}, which is hidden and not on the grid, "
                    "since nothing depends on it"
                )
    return None
