"""Tables of a net learned from cases, of a template from its series: what is read, what comes back."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import DynamicBayesNet
from bayesmc.errors import (
    ConvergenceWarning,
    EvidenceError,
    ModelError,
    UnsupportedError,
    did_you_mean,
)
from bayesmc.learning.cases import MISSING, Cases
from bayesmc.learning.expectation_maximisation import (
    Expected,
    Learned,
    Tables,
    inside,
    maximised,
)
from bayesmc.learning.fitted import Fit, lonely
from bayesmc.learning.series_counts import SeriesCounts
from bayesmc.network import BayesNet, CompiledNode, Model
from bayesmc.network.columns import array_of
from bayesmc.progress import Progress


class Climb(NamedTuple):
    """How far and how often expectation-maximisation goes, see ``fit``; ``bar`` is told of its steps."""

    tolerance: float
    most: int
    restarts: int
    rng: np.random.Generator
    bar: Progress


def fit_tables(
    net: BayesNet | DynamicBayesNet,
    data: Mapping[str, Any],
    inputs: Mapping[str, Any] | None,
    learned: Sequence[str],
    counts: Any,
    start: Mapping[str, Any],
    climb: Climb,
) -> Fit:
    """See ``fit``; ``again`` is how often EM begins, and a generator."""
    if isinstance(net, DynamicBayesNet):
        series = SeriesCounts(net, data, inputs, learned)
        begin = {n: _begin(n, t, start) for n, t in series.tables().items()}
        _check_names(start, begin)
        found, ends = _highest(series.expected, begin, start, counts, climb)
        return _fit(series.filled(found.tables), found, begin, counts, ends)
    if inputs:
        raise UnsupportedError("fit: tables are learned of nets without inputs; leave inputs= out")
    model = net.model()
    _check_net(net, model, learned)
    names = [n for n, node in model.nodes.items() if node.is_stochastic]
    if not data:
        raise EvidenceError(
            "fit: there are no data; give a column for each node, with one entry for each case"
        )
    _check_columns(data, model)
    columns = {n: _codes(model[n], data[n]) for n in names if n in data}
    lengths = {n: len(c) for n, c in columns.items()}
    if len(set(lengths.values())) > 1:
        raise EvidenceError(f"fit: columns have different lengths: {lengths}; a row is one case")
    rows = next(iter(lengths.values()))
    hidden = np.full(rows, MISSING, dtype=np.int32)
    codes = np.stack([columns.get(n, hidden) for n in names], axis=1)
    tables = {n: _table_of(net, model, n) for n in names}
    cases = Cases(
        names,
        [model[n].domain.size for n in names],  # type: ignore[union-attr]
        {n: model[n].parents for n in names},
        codes,
    )
    known = {n: t for n, t in tables.items() if n not in learned}
    begin = {n: _begin(n, tables[n], start) for n in learned}
    _check_names(start, begin)

    def expected(at: Mapping[str, np.ndarray]) -> tuple[float, Mapping[str, np.ndarray]]:
        return cases.expected({**known, **at})

    found, ends = _highest(expected, begin, start, counts, climb)
    declarations = {
        n: replace(d, probs=found.tables[n]) if n in found.tables else d
        for n, d in net.declarations.items()
    }
    filled = BayesNet.of(net.name, declarations, net._plates)
    return _fit(filled, found, begin, counts, ends)


# ---- private ------------------------------------------------------------------------------------


def _told_of(bar: Progress, expected: Expected) -> Expected:
    """Expected counts, of each of which a bar is told."""

    def counted(at: Mapping[str, np.ndarray]) -> tuple[float, Mapping[str, np.ndarray]]:
        found = expected(at)
        bar.tell(f"fit: log likelihood {found[0]:.4f}")
        bar.advance()
        return found

    return counted


def _begins(
    begin: Tables, start: Mapping[str, Any], restarts: int, rng: np.random.Generator
) -> list[Tables]:
    """Tables to begin at: those of the net, then random rows of all that are not given."""
    found = [begin]
    for _ in range(restarts - 1):
        drawn = {}
        for name, table in begin.items():
            rows = rng.standard_gamma(1.0, size=table.shape) * (table > 0)
            drawn[name] = table if name in start else rows / rows.sum(axis=-1, keepdims=True)
        found.append(drawn)
    return found


def _highest(
    expected: Expected, begin: Tables, start: Mapping[str, Any], counts: Any, climb: Climb
) -> tuple[Learned, np.ndarray]:
    """The highest end of EM, and all, highest first."""
    added, told = _dirichlet(begin, counts), _told_of(climb.bar, expected)
    begins = _begins(begin, start, climb.restarts, climb.rng)
    found = [maximised(told, at, added, climb.tolerance, climb.most) for at in begins]
    best = max(found, key=lambda each: each.objective)
    return best, np.sort([each.objective for each in found])[::-1]


def _fit(filled: Any, found: Learned, begin: Tables, counts: Any, ends: np.ndarray) -> Fit:
    if not found.converged:
        warnings.warn(
            f"fit: EM still rose by {found.history[-1] - found.history[-2]:.3g} nats in its last "
            "iteration; give more "
            "max_iterations=",
            ConvergenceWarning,
            stacklevel=4,
        )
    elif (alone := lonely(ends)) is not None:
        warnings.warn(f"fit: {alone}", ConvergenceWarning, stacklevel=4)
    added = any(
        np.any(np.asarray(c) > 0)
        for c in (counts.values() if isinstance(counts, Mapping) else [counts])
    )
    how = "EM, posterior mode" if added else "EM, maximum likelihood"
    return Fit(
        filled, found.tables, found.errors, found.log_likelihood, found.objective, found.history,
        found.converged, len(found.history) - 1, how, climbs=ends,
        at_edge=_at_edge(found.tables, begin),
    )  # fmt: skip


def _at_edge(tables: Tables, begin: Tables) -> tuple[str, ...]:
    """Entries that were learned to be 0 or 1."""
    found = []
    for name, table in tables.items():
        out = ~inside(table) & inside(begin[name])
        found += [f"{name}[{', '.join(map(str, at))}]" for at in np.argwhere(out).tolist()]
    return tuple(found)


def _check_columns(data: Mapping[str, Any], model: Model) -> None:
    for name in data:
        if name not in model.nodes:
            raise EvidenceError(
                f"fit: the data have a column {name!r}, which is no "
                f"node{did_you_mean(name, model.nodes)}; drop it, or "
                "rename it"
            )


def _check_net(net: BayesNet, model: Model, learned: Sequence[str]) -> None:
    if net.potentials:
        raise UnsupportedError(
            "fit: a net with potentials is not normalised; tables are learned of nets without"
        )
    for name, node in model.nodes.items():
        if node.kind != "stochastic":
            raise UnsupportedError(
                f"fit: node {name!r} is {node.kind}; tables are learned of nets whose nodes are "
                "random and finite"
            )
        if node.domain is None or node.event_shape or node.plates:
            what = "has plates" if node.plates else "has no finite states"
            raise UnsupportedError(
                f"fit: node {name!r} {what}; tables are learned of nets that describe one case by "
                "finite nodes, from "
                "data with one row for each case. Of other nets declare what is unknown as nodes with priors"
            )


def _table_of(net: BayesNet, model: Model, name: str) -> np.ndarray:
    """A node's table, declared or worked out from its function."""
    declared = net.declarations[name]
    if declared.probs is not None:
        return np.array(declared.probs)
    node = model[name]
    cards = [model[p].domain.size for p in node.parents]  # type: ignore[union-attr]
    grid = np.indices([*cards, 1]).reshape(len(cards) + 1, -1)
    values = {p: grid[k] for k, p in enumerate(node.parents)}
    given, _ = model.evaluate(name, values)
    assert node.domain is not None
    size = node.domain.size
    logs = model.log_density(name, given, np.arange(size).reshape(-1, 1))
    full = np.broadcast_to(logs, (size, grid.shape[1]))
    return np.exp(full).T.reshape(*cards, size)


def _codes(node: CompiledNode, column: Any) -> np.ndarray:
    """Positions of states, -1 where missing."""
    assert node.domain is not None
    values = column if isinstance(column, np.ma.MaskedArray) else array_of(column)
    if values.ndim != 1:
        raise EvidenceError(
            f"fit: column {node.name!r} has shape {values.shape}; give one entry for each case"
        )
    missing = (
        np.ma.getmaskarray(values)
        if isinstance(values, np.ma.MaskedArray)
        else np.zeros(len(values), bool)
    )
    plain = np.asarray(values)
    missing = missing | (plain != plain) | np.array([v is None for v in plain.tolist()], dtype=bool)
    states = {_plain(s): k for k, s in enumerate(node.domain.states)}
    codes = np.full(len(plain), MISSING, dtype=np.int32)
    kept = plain[~missing]
    try:
        found, inverse = np.unique(
            kept.astype(object).astype(str) if kept.dtype == object else kept, return_inverse=True
        )
    except TypeError as error:
        raise EvidenceError(f"fit: column {node.name!r}: {error}") from error
    texts = {str(s): k for s, k in states.items()}
    places = np.empty(len(found), dtype=np.int32)
    for k, value in enumerate(found.tolist()):
        at = states.get(_plain(value), texts.get(str(value)) if kept.dtype == object else None)
        if at is None:
            shown = ", ".join(map(repr, list(states)[:8]))
            raise EvidenceError(
                f"fit: column {node.name!r} has {value!r}, which is no "
                f"state{did_you_mean(str(value), map(str, states))}; "
                f"its states are {shown}"
            )
        places[k] = at
    codes[~missing] = places[inverse.ravel()]
    return codes


def _plain(value: Any) -> Any:
    """Numbers that are equal, as one."""
    if isinstance(value, (bool, np.bool_)):
        return int(value)
    if isinstance(value, (float, np.floating)) and float(value).is_integer():
        return int(value)
    return value.item() if isinstance(value, np.generic) else value


def _begin(name: str, table: np.ndarray, start: Mapping[str, Any]) -> np.ndarray:
    if name not in start:
        return table
    wanted = f"give probabilities of shape {table.shape}, whose rows sum to 1"
    try:
        given = np.asarray(start[name], dtype=float)
    except (TypeError, ValueError):
        raise ModelError(
            f"fit: start of {name!r} is no array of numbers, but {start[name]!r}; {wanted}"
        ) from None
    if given.shape != table.shape:
        raise ModelError(f"fit: start of {name!r} has shape {given.shape}; {wanted}")
    if not np.allclose(given.sum(axis=-1), 1.0) or (given < 0).any():
        raise ModelError(f"fit: start of {name!r} is no table of probabilities; {wanted}")
    return given / given.sum(axis=-1, keepdims=True)


def _check_names(start: Mapping[str, Any], begin: Tables) -> None:
    for name in start:
        if name not in begin:
            raise ModelError(
                f"fit: start= names {name!r}, which is not learned{did_you_mean(name, begin)}: {list(begin)}"
            )


def _dirichlet(tables: Tables, counts: Any) -> dict[str, np.ndarray]:
    given = counts if isinstance(counts, Mapping) else dict.fromkeys(tables, counts)
    found = {}
    for name, table in tables.items():
        try:
            own = np.broadcast_to(np.asarray(given.get(name, 0.0), dtype=float), table.shape)
        except (TypeError, ValueError):
            raise ModelError(
                f"fit: counts of {name!r} do not fit its table of shape {table.shape}; give a number, "
                "or one for "
                "each entry"
            ) from None
        if not (own >= 0).all():
            raise ModelError(f"fit: counts of {name!r} are negative; give 0 or more")
        found[name] = own
    for name in given:
        if name not in tables:
            raise ModelError(f"fit: counts= names {name!r}, which is not learned: {list(tables)}")
    return found
