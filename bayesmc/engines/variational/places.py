"""Where starts have settled: another place that is about as probable is a part of the posterior left out.

A bound is the log of the mass near a place, or less: one that is lower by ``d`` has about ``exp(-d)`` of the
mass. Places that differ by the order of a plate's elements alone (components of a mixture, with their labels
and weights) are one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import scipy

from bayesmc.engines.variational.ascent import Ascent, restored, stored
from bayesmc.engines.variational.factors import TableFactor
from bayesmc.engines.variational.free import FreeFactor
from bayesmc.engines.variational.parts import part_of
from bayesmc.engines.variational.steps import Plan

#: share of the best place's mass that another has to have
_SHARE = 0.01
#: probabilities, and means in standard deviations, that are others; starts that go on to be compared
_OTHER, _CLIMBS = 0.3, 3
#: bounds that are the same, and elements of a plate whose order is looked at
_SAME, _ELEMENTS = 1e-3, 100

#: node -> means and their standard deviations, or tables and ones
Figures = dict[str, tuple[np.ndarray, np.ndarray]]


def other_places(plan: Plan, found: list[Ascent], sweeps: int, tolerance: float) -> list[Ascent]:
    """One start for each place where some have settled that is no less probable than a share of the best.

    The best start is the first of both lists, and what the factors hold.
    """
    places, climbs = found[:1], 0
    known = [(found[0].bounds[-1], _figures(plan, found[0]))]

    def is_new(ascent: Ascent) -> bool:
        own = ascent.bounds[-1], _figures(plan, ascent)
        return not any(_is_same(plan, own, other) for other in known)

    for ascent in found[1:]:
        if ascent.bounds[-1] < found[0].bounds[-1] + math.log(_SHARE) or not is_new(ascent):
            continue
        if not ascent.converged and climbs < _CLIMBS:
            climbs += 1
            restored(plan, ascent)
            ascent.climb(sweeps - len(ascent.bounds), tolerance)
            stored(plan, ascent)
        if ascent.converged and is_new(ascent):
            places.append(ascent)
            known.append((ascent.bounds[-1], _figures(plan, ascent)))
    found.sort(key=lambda a: -a.bounds[-1])
    places.sort(key=lambda a: -a.bounds[-1])
    restored(plan, found[0])
    return places


# ---- private ------------------------------------------------------------------------------------


def _figures(plan: Plan, ascent: Ascent) -> Figures:
    """Means or tables, and the scales in which they are compared."""
    restored(plan, ascent)
    figures: Figures = {}
    for factor in plan.factors:
        if isinstance(factor, TableFactor):
            table = np.asarray(ascent.state[factor.table])
            figures[", ".join(factor.names)] = table, np.ones_like(table)
        elif isinstance(factor, FreeFactor):
            diagonal = np.linalg.norm(factor.root, axis=1) if factor.is_full else factor.root
            for node in factor.nodes:
                part = slice(node.start, node.start + node.size)
                figures[node.name] = factor.mean[part], np.abs(diagonal[part])
        else:
            own = part_of(factor, ascent.state, plan.target)
            moments = [own.moments(name) for name in factor.names]
            for name, pair in zip(factor.names, moments, strict=True):
                if pair is not None:
                    mean, var = (np.asarray(m, float) for m in pair)
                    with np.errstate(all="ignore"):
                        figures[name] = mean, np.sqrt(var)
            if any(pair is None for pair in moments):
                for k, value in enumerate(factor.spreads(ascent.state)):
                    figures[f"{factor.names[0]} {k}"] = np.asarray(value), np.ones(np.shape(value))
    return figures


def _is_same(plan: Plan, one: tuple[float, Figures], other: tuple[float, Figures]) -> bool:
    """Whether two are one place, or with the same bound one but for the order of a plate's elements."""
    if _near(one[1], other[1]):
        return True
    if abs(one[0] - other[0]) > _SAME:
        return False
    sizes = {size for name in plan.target.chain for size in plan.target.model[name].plate_shape}
    return any(
        _near(one[1], _reordered(one[1], other[1], size))
        for size in sorted(sizes)
        if 1 < size <= _ELEMENTS
    )


def _near(one: Figures, other: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> bool:
    for name, (mean, scale) in one.items():
        its, its_scale = other[name]
        with np.errstate(all="ignore"):
            apart = np.abs(mean - its) / np.maximum(scale, its_scale)
        if (apart > _OTHER).any():
            return False
    return True


def _reordered(one: Figures, other: Figures, size: int) -> Figures:
    """The other with one axis of some size of each node in the order in which they come closest."""
    cost = np.zeros((size, size))
    axes = {n: mean.shape.index(size) for n, (mean, _) in one.items() if size in mean.shape}
    for name, axis in axes.items():
        (a, scale), (b, its) = one[name], other[name]
        rows = [np.moveaxis(v, axis, 0).reshape(size, -1) for v in (a, b, np.maximum(scale, its))]
        with np.errstate(all="ignore"):
            for k in range(size):
                apart = np.abs(rows[0][k] - rows[1]) / np.maximum(rows[2][k], rows[2])
                cost[k] += np.minimum(np.nan_to_num(apart), 1.0).mean(axis=-1)
    _, order = scipy.optimize.linear_sum_assignment(cost)
    return {
        n: (m.take(order, axes[n]), s.take(order, axes[n])) if n in axes else (m, s)
        for n, (m, s) in other.items()
    }


def told(places: Sequence[Ascent], constant: float) -> str:
    """What is to be said of several places."""
    bounds = ", ".join(f"{a.bounds[-1] + constant:.6g}" for a in places)
    return (
        f"MeanField: starts settled in {len(places)} places that differ (bounds {bounds}), and one of them "
        "answers: the posterior has several modes, or nodes are torn from what they depend on; use "
        "Exact() or Gibbs(), or give such nodes one factor (blocks=)"
    )
