"""Averages of a user's function under an exact posterior.

Functions of finite nodes are averaged over their joint table. Of continuous nodes, functions whose expression
is affine are exact at the components' means, and an event that compares affine values is a normal
probability in every component; anything else is refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import special

from bayesmc.engines.exact.gaussian_answers import GaussianAnswers
from bayesmc.engines.exact.table_answers import TableAnswers
from bayesmc.errors import BudgetError, TraceError, UnsupportedError
from bayesmc.expression import Expression, Program, TracedArray, leaf, trace
from bayesmc.factors.moments import Components
from bayesmc.passes.affine import refuse_beyond_affine
from bayesmc.passes.events import margin
from bayesmc.results.query import Query
from bayesmc.shapes import Shape, nearly_equal
from bayesmc.structure import Variable, configure

#: configurations up to which a function is averaged over a joint table
_ENTRIES = 1 << 22
#: components of continuous nodes that an event may depend on
_DIRECTIONS = 256
#: of these, moved in one evaluation
_AT_ONCE = 16
#: share of the largest margin below which rounding decides whether an event is true
_CLOSE = 1e-9


def average(tables: TableAnswers, query: Query) -> np.ndarray:
    """The mean of a function of finite nodes, and of what is computed from them, by their joint table."""
    model = tables.model
    if 0 in query.plate_shape:
        return np.zeros(query.plate_shape)
    finite = tables.above(query.nodes)
    alone = tuple(n for n in finite if set(model[n].plates) <= set(query.plates))
    if any(set(model[n].plates) - set(query.plates) for n in _passed(tables, query.nodes)):
        alone = ()
    whole = tuple(n for n in finite if n not in alone)
    variables = [tables.element(n, query.plates, (0,) * len(query.plates)) for n in alone]
    rest = [v for n in whole for v in tables.elements(n)]
    entries = float(math.prod([tables.card(v) for v in [*variables, *rest]]))
    if entries > _ENTRIES:
        raise _too_many(len(variables) + len(rest), entries)
    with np.errstate(all="ignore"):
        missing = tables.missing(query.nodes)
        values, cards = configure(model, tables.known_values, alone, whole, missing)
    flat = {n: _flat(values[n], cards, model[n].value_shape) for n in query.nodes}
    results = query(flat, (math.prod(cards),))
    sizes = query.plate_shape
    out = np.empty(sizes + results.shape[1 + len(sizes) :])
    for at in np.ndindex(sizes):
        table = tables.joint([tables.element(n, query.plates, at) for n in alone] + rest).ravel()
        part = results[(slice(None), *at)].astype(float)
        possible = table > 0  # elsewhere the function may give anything
        out[at] = np.tensordot(table[possible], part[possible], axes=1)
    return out


def gaussian_average(tables: TableAnswers, gaussian: GaussianAnswers, query: Query) -> np.ndarray:
    """The mean of a function, or the probability of an event, of continuous and finite nodes."""
    model = tables.model
    names = list(dict.fromkeys(query.nodes))
    others = [n for n in names if not gaussian.holds(n)]
    inside = all(set(model[n].plates) <= set(query.plates) for n in names)
    alone = query.plates and inside and (others or query.is_event)
    if not alone or _passed(tables, others):
        return _joint_average(tables, gaussian, query)
    sizes = query.plate_shape
    parts = []
    for at in np.ndindex(sizes):  # element by element: each needs no other one's configurations
        where = {n: tables.element(n, query.plates, at) for n in names}
        parts.append(_joint_average(tables, gaussian, query, where)[at])
    if not parts:
        return np.zeros(sizes)
    return np.stack(parts).reshape(sizes + np.shape(parts[0]))


def _joint_average(
    tables: TableAnswers,
    gaussian: GaussianAnswers,
    query: Query,
    where: Mapping[str, Variable] | None = None,
) -> np.ndarray:
    """The average over the joint mixture of all that the function names, or of one element of each."""
    continuous = [n for n in dict.fromkeys(query.nodes) if gaussian.holds(n)]
    others = [n for n in dict.fromkeys(query.nodes) if n not in continuous]
    if where is None:
        extra = [v for n in tables.above(others) for v in tables.elements(n)]
    else:
        extra = [where[n] for n in tables.above(others)]
    events = query.is_event
    if not events and not others:
        # an affine function alone: its mean is its value at the mean
        means = {n: gaussian.mean(n)[None] for n in continuous}
        found: Components | None = None
        columns: dict[str, list[int]] = {}
        weights = np.ones(1)
    else:
        only = None if where is None else {n: where[n][1] for n in continuous}
        found, columns = gaussian.components(continuous, extra, spread=events, only=only)
        weights = found.weights
        means = {n: gaussian.values(n, found.mean, columns[n]) for n in continuous}
    count = len(weights)
    stored = _finite_values(tables, others, found, count)
    # with the checks that it acts draw by draw
    plain = query({**stored, **means}, (count,))
    try:
        followed = _followed(query, stored, means)
        if not followed.leaves:
            return np.tensordot(weights, plain.astype(float), axes=1)
        if events:
            followed = margin(followed)
        refuse_beyond_affine(followed, continuous)
        program = Program([followed])
        (value,) = program(means)
        _hold_against(plain, query.fitted(value, (count,)), events)
    except TraceError as error:
        raise _beyond(continuous, str(error)) from error
    if not events:
        return np.tensordot(weights, plain, axes=1)
    assert found is not None

    def exceeds(blocks: np.ndarray) -> np.ndarray:
        lead, rows = blocks.shape[:-1], blocks.reshape(-1, blocks.shape[-1])
        values = {n: gaussian.values(n, rows, columns[n]) for n in continuous}
        (value,) = program({n: v.reshape(lead + v.shape[1:]) for n, v in values.items()})
        return query.fitted(value, lead)

    return np.tensordot(weights, _chances(exceeds, found, plain), axes=1)


def _followed(
    query: Query, stored: Mapping[str, np.ndarray], means: Mapping[str, np.ndarray]
) -> Expression:
    """What a function makes of all components' values at once, as an expression of the continuous ones."""
    given = [TracedArray(leaf(name, value.shape)) for name, value in means.items()]

    def asked(*values: Any) -> Any:
        return query.raw({**stored, **dict(zip(means, values, strict=True))})

    found = trace(asked, given, is_steady=True)  # it was called on single draws, too
    if not isinstance(found, Expression):
        raise TraceError(f"it returns {type(found).__name__}")
    return found


def _hold_against(plain: np.ndarray, found: np.ndarray, events: bool) -> None:
    """Refuse what was read of a function where the function gives something else.

    An event is true where its margin is above zero; at zero rounding may decide.
    """
    if events:
        close = np.abs(found) <= _CLOSE * np.abs(found[np.isfinite(found)]).max(initial=0.0)
        agrees = bool((close | (plain == (found > 0))).all())
    else:
        agrees = nearly_equal(plain, found)
    if not agrees:
        raise TraceError("what was read of it gives other values than the function")


def covariance(
    tables: TableAnswers, gaussian: GaussianAnswers | None, names: Sequence[str]
) -> np.ndarray:
    """Covariance matrix of all scalars of some nodes, in order, from their joint mixture."""
    continuous = [n for n in dict.fromkeys(names) if gaussian is not None and gaussian.holds(n)]
    others = [n for n in dict.fromkeys(names) if n not in continuous]
    extra = [v for n in tables.above(others) for v in tables.elements(n)]
    if gaussian is not None:
        found, columns = gaussian.components(continuous, extra)
    else:
        found, columns = _table_components(tables, extra), {}
    stored = _finite_values(tables, others, found, len(found.weights))
    parts: list[np.ndarray] = []
    where: list[int] = []
    for name in names:
        if gaussian is not None and name in continuous:
            values = gaussian.values(name, found.mean, columns[name])
            where += columns[name]
        else:
            domain = tables.model[name].domain
            values = stored[name] if domain is None else np.asarray(domain.numbers)[stored[name]]
            where += [-1] * math.prod(tables.model[name].value_shape)
        parts.append(values.reshape(len(found.weights), -1))
    means = np.concatenate(parts, axis=1).astype(float)
    spread = means - found.weights @ means
    within = np.zeros((len(where), len(where)))
    at = np.array(where)
    rows = np.flatnonzero(at >= 0)
    if len(rows):
        inside = np.tensordot(found.weights, found.cov, axes=1)
        within[np.ix_(rows, rows)] = inside[np.ix_(at[rows], at[rows])]
    return within + (spread * found.weights[:, None]).T @ spread


# ---- private ------------------------------------------------------------------------------------


def _chances(
    exceeds: Callable[[np.ndarray], np.ndarray], found: Components, plain: np.ndarray
) -> np.ndarray:
    """In every component the probability that what is affine in the blocks exceeds zero."""
    count, width = found.mean.shape
    if width > _DIRECTIONS:
        raise BudgetError(
            f"probability: the event depends on {width} continuous components; draw from the posterior "
            "with resample(draws)",
            8 * count * width**2,
        )
    spread = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))
    scale = np.where(spread > 0, spread, 1.0)
    steps = np.arange(width)
    moved = np.repeat(found.mean[None], width + 1, axis=0)  # as it is, and each component by itself
    moved[1 + steps, :, steps] += scale.T
    cuts = range(0, width + 1, _AT_ONCE)
    margins = np.concatenate([exceeds(moved[k : k + _AT_ONCE]) for k in cuts])
    centre = margins[0]
    with np.errstate(invalid="ignore"):
        slopes = margins[1:] - centre
    slopes = np.where(np.isfinite(slopes), slopes, 0.0)
    unit = np.abs(slopes).max(axis=0, initial=0.0)  # the sign is all that counts, in any unit
    unit = np.where(unit > 0, unit, 1.0)
    slopes, centre = slopes / unit, centre / unit
    correlation = found.cov / (scale[:, :, None] * scale[:, None, :])
    var = np.einsum("kn...,nkl,ln...->n...", slopes, correlation, slopes)
    sd = np.sqrt(np.maximum(var, 0.0))
    with np.errstate(all="ignore"):
        chance = special.ndtr(centre / sd)
    return np.where(sd > 0, chance, plain)


def _table_components(tables: TableAnswers, variables: Sequence[Variable]) -> Components:
    """The configurations of some variables as components without continuous blocks."""
    entries = float(math.prod(tables.card(v) for v in variables))
    if entries > _ENTRIES:
        raise _too_many(len(variables), entries)
    table = tables.joint(variables)
    at = np.unravel_index(np.flatnonzero(table), table.shape) if variables else ()
    weights = table[table > 0]
    states = dict(zip(variables, at, strict=True))
    empty = np.zeros((len(weights), 0))
    return Components(states, weights / weights.sum(), empty, empty[:, :, None])


def _finite_values(
    tables: TableAnswers, names: Sequence[str], found: Components | None, count: int
) -> dict[str, np.ndarray]:
    """Stored values of nodes that are no Gaussians, in every component.

    Elements that the components say nothing of are given their first state.
    """
    model = tables.model
    values: dict[str, np.ndarray] = {
        n: np.broadcast_to(v, (count, *v.shape)) for n, v in tables.known_values.items()
    }
    for name in tables.above(names):
        node = model[name]
        assert found is not None
        zero = np.zeros(count, dtype=np.intp)
        codes = [found.states.get(v, zero) for v in tables.elements(name)]
        empty = np.zeros((count, 0))
        stacked = np.stack(codes, axis=-1) if codes else empty
        values[name] = stacked.reshape((count, *node.plate_shape)).astype(node.domain.dtype)  # type: ignore[union-attr]
    for name in model.nodes:
        if name not in values and _is_computed(model, name, values):
            values[name], _ = model.evaluate(name, values)
    lacking = [n for n in names if n not in values]
    if lacking:
        raise _beyond(lacking, "it is no affine function of Gaussians")
    return {n: np.broadcast_to(values[n], (count, *model[n].value_shape)) for n in names}


def _is_computed(model: Any, name: str, values: Mapping[str, Any]) -> bool:
    node = model[name]
    return node.kind == "deterministic" and all(p in values for p in node.parents)


def _passed(tables: TableAnswers, nodes: Sequence[str]) -> tuple[str, ...]:
    """Deterministic nodes without a domain on the way to the finite ones."""
    model = tables.model
    found = model.above(tables.missing(nodes), lambda n: model[n].domain is None)
    return tuple(n for n in found if model[n].domain is None and not model[n].is_stochastic)


def _flat(values: np.ndarray, cards: tuple[int, ...], shape: Shape) -> np.ndarray:
    """Values over all configurations, with one batch axis."""
    return np.broadcast_to(values, cards + shape).reshape((math.prod(cards), *shape))


def _too_many(count: int, entries: float) -> BudgetError:
    return BudgetError(
        f"expectation: the function needs the joint table of {count} nodes ({entries:.3g} entries); draw "
        "from the posterior with resample(draws)",
        int(min(8 * entries, 2**62)),
    )


def _beyond(names: Sequence[str], why: str) -> UnsupportedError:
    return UnsupportedError(
        f"an exact posterior averages functions that are affine in continuous nodes, and events that compare "
        f"such values once; this one of {', '.join(map(repr, names))} is neither ({why}): draw with "
        f"resample(draws) and ask there (an interval: marginal({names[0]!r}).distribution.cdf)"
    )
