"""Reading what a user says of a factor graph: supports of variables, rows of an index, log tables.

Everything is settled here when it is declared, so that a fault is told at the line that made it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import Density
from bayesmc.distributions.support import Support, as_support, integers
from bayesmc.errors import (
    BayesmcError,
    DensityError,
    ModelError,
    ShapeError,
    UnknownNodeError,
    did_you_mean,
)
from bayesmc.network.captured import captured
from bayesmc.network.declaring import Constant
from bayesmc.network.labels import Domain, domain_with_states
from bayesmc.network.node import Declaration, Potential, bind, plain_states
from bayesmc.shapes import Shape, as_shape, first_index, from_one, owned


def variable_declaration(
    name: str, support: Any, plates: tuple[str, ...], event_shape: Any
) -> Declaration:
    """A variable as a node whose density is flat: log 1 everywhere on its support."""
    try:
        values, states = _values_of(support)
        density = Density(
            _Flat(len(as_shape(event_shape))), None, as_shape(event_shape), values, batch_shape=()
        )
        if values.size is not None:
            domain_with_states(values.size, int(np.asarray(values.low)), states)
    except (BayesmcError, ValueError) as error:
        raise ModelError(f"variable {name!r}: {error}") from None
    if not values.is_single:
        raise ModelError(
            f"variable {name!r}: its support has many bounds; give one support for all"
        )
    return Declaration(
        name, "variable", (), plates, states, Constant(density), event_shape=density.event_shape
    )


def support_of(declaration: Declaration) -> Support:
    """The support that a variable was declared with."""
    assert isinstance(declaration.function, Constant)
    return declaration.function.distribution.support


def domain_of(declaration: Declaration) -> Domain | None:
    """The finite domain of a variable; None for one that is not finite."""
    support = support_of(declaration)
    if support.size is None or declaration.event_shape:
        return None
    return domain_with_states(support.size, int(np.asarray(support.low)), declaration.states)


def read_factor(
    name: str,
    log_potential: Any,
    scope: str | Sequence[str] | None,
    index: Any,
    plates: tuple[str, ...] | None,
    variables: Mapping[str, Declaration],
    sizes: Mapping[str, int],
) -> Potential:
    """A batch of factors as a potential; see ``FactorGraph.factor``."""
    is_table = not callable(log_potential)
    names = _scope(name, log_potential, scope, variables, is_table)
    if index is not None:
        if plates is not None:
            raise ModelError(f"factor {name!r}: give index= or plates=, not both")
        rows = _read_index(name, names, index, variables, sizes)
        own: tuple[str, ...] = ()
        lead: Shape = (len(rows[0]),)
    else:
        rows = None
        _refuse_twice(name, names)
        union = dict.fromkeys(p for n in names for p in variables[n].plates)
        own = tuple(union) if plates is None else plates
        lead = tuple(sizes[p] for p in own)
    function = log_potential
    if is_table:
        function = _LogTable(*_read_table(name, log_potential, names, lead, variables))
    else:
        _, function = bind(name, log_potential, names)
    around = () if is_table else captured(log_potential)
    return Potential(name, names, function, own, rows, is_table, around)


# ---- private ------------------------------------------------------------------------------------


class _Flat:
    """The log density of a variable, which says nothing: zero."""

    def __init__(self, event_ndim: int) -> None:
        self.event_ndim = event_ndim

    def __call__(self, x: np.ndarray) -> np.ndarray:
        return np.zeros(np.shape(x)[: np.ndim(x) - self.event_ndim])


class _LogTable:
    """A function of positions that looks log factors up, shape ``(*elements or (), *cards)``."""

    def __init__(self, table: np.ndarray, elements: Shape) -> None:
        self.table = table
        self.elements = np.ix_(*(np.arange(n) for n in elements))

    def __call__(self, *positions: np.ndarray) -> np.ndarray:
        return self.table[(*self.elements, *(p.astype(np.intp) for p in positions))]


def _values_of(support: Any) -> tuple[Support, tuple[Any, ...] | None]:
    """The support of a variable's density, and its states where they are not the integers from 0."""
    if isinstance(support, (bool, np.bool_)) or support is None:
        raise ModelError(f"{support!r} is no support; give states, a number of states, or a name")
    if isinstance(support, (int, np.integer)):
        if support < 1:
            raise ModelError(f"{support} states are too few; a number of states is 1 or more")
        return integers(0, int(support) - 1), None
    if isinstance(support, (str, Support)):
        return as_support(support), None
    if isinstance(support, (range, np.ndarray)):
        support = list(support)
    states = plain_states(support)
    if not states:
        raise ModelError("it has no states; give at least one")
    return integers(0, len(states) - 1), states


def _scope(
    name: str,
    log_potential: Any,
    scope: str | Sequence[str] | None,
    variables: Mapping[str, Declaration],
    is_table: bool,
) -> tuple[str, ...]:
    if scope is None:
        if is_table:
            raise ModelError(f"factor {name!r}: a table needs scope=, the variable of every axis")
        names, _ = bind(name, log_potential, None)
    else:
        names = (scope,) if isinstance(scope, str) else tuple(scope)
    if not names:
        raise ModelError(
            f"factor {name!r} is over no variable; name what it depends on in scope=, or as arguments"
        )
    for variable in names:
        if variable not in variables:
            known = ", ".join(map(repr, variables)) or "none"
            raise UnknownNodeError(
                f"factor {name!r}: its scope names {variable!r}, which is no variable of the graph "
                f"({known}){did_you_mean(variable, variables)}; declare it before the factor, with "
                f"fg.variable({variable!r}, ...)"
            )
    return names


def _refuse_twice(name: str, names: tuple[str, ...]) -> None:
    for variable in names:
        if names.count(variable) > 1:
            raise ModelError(
                f"factor {name!r}: {variable!r} stands twice in its scope, so index= must say which elements "
                "meet, one integer array per entry of the scope"
            )


def _read_index(
    name: str,
    names: tuple[str, ...],
    index: Any,
    variables: Mapping[str, Declaration],
    sizes: Mapping[str, int],
) -> tuple[np.ndarray, ...]:
    """Flat positions for every entry of the scope, all of one length."""
    entries = _entries(name, names, index)
    flats = [
        _flat(name, variable, k, entry, variables[variable].plates, sizes)
        for k, (variable, entry) in enumerate(zip(names, entries, strict=True))
    ]
    lengths = {len(f) for f in flats if f is not None}
    if not lengths:
        raise ModelError(
            f"factor {name!r}: no variable of its scope is in a plate, so there is one factor and no "
            "index=; leave it out"
        )
    if len(lengths) > 1:
        each = ", ".join(
            f"{n!r}: {len(f)}" for n, f in zip(names, flats, strict=True) if f is not None
        )
        raise ShapeError(
            f"factor {name!r}: the arrays of index= differ in length ({each}); every row takes one element "
            "of each"
        )
    rows = lengths.pop()
    whole = tuple(owned(np.zeros(rows, dtype=np.intp)) if f is None else f for f in flats)
    _refuse_loops(name, names, whole)
    return whole


def _entries(name: str, names: tuple[str, ...], index: Any) -> tuple[Any, ...]:
    """What ``index`` says for each entry of the scope."""
    if len(names) == 1 and (isinstance(index, np.ndarray) and index.ndim == 1):
        return (index,)
    if not isinstance(index, (tuple, list, np.ndarray)) or len(index) != len(names):
        count = f"{len(index)} entries" if isinstance(index, (tuple, list, np.ndarray)) else "none"
        raise ModelError(
            f"factor {name!r}: index= has {count}, but the scope has {len(names)} "
            f"({', '.join(names)}); give one integer array for each, of one length (a tuple of arrays for a "
            "variable in several plates, None for one in none)"
        )
    return tuple(index)


def _flat(
    name: str,
    variable: str,
    position: int,
    entry: Any,
    plates: tuple[str, ...],
    sizes: Mapping[str, int],
) -> np.ndarray | None:
    """One entry of an index as positions among all elements of its variable."""
    what = f"factor {name!r}: index= of {variable!r} (entry {position})"
    if not plates:
        if entry is not None:
            raise ModelError(f"{what} is given, but the variable is in no plate; give None")
        return None
    parts = entry if len(plates) > 1 else (entry,)
    if not isinstance(parts, (tuple, list)) or len(parts) != len(plates):
        raise ModelError(
            f"{what}: the variable is in plates {plates}; give a tuple of {len(plates)} arrays, one per plate"
        )
    arrays = [_whole_numbers(f"{what}, plate {p!r}", a) for p, a in zip(plates, parts, strict=True)]
    if len({len(a) for a in arrays}) > 1:
        raise ShapeError(f"{what}: its arrays differ in length ({[len(a) for a in arrays]})")
    for plate, array in zip(plates, arrays, strict=True):
        outside = (array < 0) | (array >= sizes[plate])
        if outside.any():
            (row,) = first_index(outside)
            raise ModelError(
                f"{what} is {array[row]} at row {row}, outside plate {plate!r}, whose positions are "
                f"0..{sizes[plate] - 1}"
                + from_one(int(array.min()), int(array.max()), sizes[plate])
            )
    return owned(np.ravel_multi_index(arrays, tuple(sizes[p] for p in plates)), np.intp)


def _whole_numbers(what: str, value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.size == 0 and array.ndim == 1:
        return np.zeros(0, dtype=np.intp)
    if array.dtype.kind not in "iu" or array.ndim != 1:
        raise ModelError(
            f"{what} is an array of {array.dtype} of shape {array.shape}; give integer positions, shape "
            "(rows,)"
        )
    return array.astype(np.intp)


def _refuse_loops(name: str, names: tuple[str, ...], flats: tuple[np.ndarray, ...]) -> None:
    """A factor's scope is a set: one row must not name an element twice."""
    for a in range(len(names)):
        for b in range(a):
            if names[a] != names[b]:
                continue
            same = flats[a] == flats[b]
            if same.any():
                (row,) = first_index(same)
                raise ModelError(
                    f"factor {name!r}: row {row} of index= names one element of {names[a]!r} twice "
                    f"(entries {b} and {a}); a factor's scope holds each element once"
                )


def _read_table(
    name: str,
    log_potential: Any,
    names: tuple[str, ...],
    elements: Shape,
    variables: Mapping[str, Declaration],
) -> tuple[np.ndarray, Shape]:
    """A log table and the shape of its leading axes: none, or one entry per factor."""
    try:
        table = owned(log_potential, float)
    except (TypeError, ValueError):
        raise ModelError(
            f"factor {name!r}: {type(log_potential).__name__} is neither a function nor a table of logs"
        ) from None
    cards = []
    for variable in names:
        domain = domain_of(variables[variable])
        if domain is None:
            raise ModelError(
                f"factor {name!r}: {variable!r} has no finite set of states, so no axis of a table can "
                "hold it; give a function"
            )
        cards.append(domain.size)
    if table.shape not in (tuple(cards), (*elements, *cards)):
        each = f" or {(*elements, *cards)}, one table per factor" if elements else ""
        raise ShapeError(
            f"factor {name!r}: the table has shape {table.shape}, but the states of {names} make "
            f"{tuple(cards)}{each}"
        )
    bad = ~(table < np.inf)
    if bad.any():
        at = first_index(bad)
        raise DensityError(
            f"factor {name!r}: the table is {table[at]} at {at}; a log factor is a number or -inf"
        )
    return table, elements if table.ndim > len(cards) else ()
