"""Tables with named axes, and the one way to eliminate variables from their product.

Axes align by name; those in front of the named ones are batch axes, which broadcast. Variables leave in the
order of least product first, all at once that no other table has, so that tables which share no variable
never meet. What products and sums are is up to the caller: of numbers, of logs, or the largest.

References
----------
Koller and Friedman (2009), Probabilistic Graphical Models, algorithms 9.1 and 13.1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from bayesmc.shapes import Shape, unravelled

Variable = Hashable
Scope = tuple[Variable, ...]
Sizes = Mapping[Any, int]
#: makes of some tables one over a scope, other variables gone
Combine = Callable[[Sequence["Table"], Scope, Scope], np.ndarray]


class Table(Protocol):
    """A table with a name for each of its last axes; it is constant along any other."""

    @property
    def scope(self) -> Scope: ...

    @property
    def values(self) -> np.ndarray: ...


class Named(NamedTuple):
    """A plain one."""

    scope: Scope
    values: np.ndarray


def without_ones(values: np.ndarray, scope: Sequence[Variable]) -> Named:
    """A table without its axes of size one."""
    kept = tuple(v for v, n in zip(scope, values.shape, strict=True) if n > 1)
    return Named(kept, values.reshape([n for n in values.shape if n > 1]))


def aligned(table: Table, target: Sequence[Variable], shape: Shape | None = None) -> np.ndarray:
    """The values with these axes in this order, of size one where it has none, or broadcast to ``shape``."""
    scope, values = table.scope, table.values
    lead = values.ndim - len(scope)
    order = [lead + scope.index(v) for v in target if v in scope]
    moved = values.transpose(*range(lead), *order)
    placed = moved[(Ellipsis, *(slice(None) if v in scope else None for v in target))]
    return placed if shape is None else np.broadcast_to(placed, (*values.shape[:lead], *shape))


def log_product(tables: Sequence[Table], scope: Sequence[Variable], sizes: Sizes) -> np.ndarray:
    """The sum of logs over a scope that holds those of all tables, shape ``(*batch, *sizes)``."""
    shape = tuple(sizes[v] for v in scope)
    if not tables:
        return np.zeros(shape)
    total = aligned(tables[0], scope)
    for table in tables[1:]:
        total = total + aligned(table, scope)
    return np.broadcast_to(total, (*total.shape[: total.ndim - len(shape)], *shape))


def eliminate(
    tables: Sequence[Table], keep: Collection[Variable], sizes: Sizes, combine: Combine
) -> list[Table]:
    """Tables over the variables to keep alone, whose product is that of all, the others gone."""
    left: list[Table] = list(tables)
    for touched, gone, scope in steps([t.scope for t in left], keep, sizes):
        made = Named(scope, combine([left[k] for k in touched], scope, gone))
        left = [t for k, t in enumerate(left) if k not in touched] + [made]
    return left


def summed(
    tables: Sequence[Table],
    keep: Sequence[Variable],
    sizes: Sizes,
    reduce: Callable[[np.ndarray, int], np.ndarray],
) -> np.ndarray:
    """The product of logs with all variables but some reduced, shape ``(*batch, *sizes of keep)``.

    Parameters
    ----------
    reduce : callable
        Of an array and an axis: ``log_sum_exp`` or ``np.max``.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.categorical import log_sum_exp
    >>> from bayesmc.factors.named import Named, summed
    >>> rain = Named(("rain",), np.log([0.2, 0.8]))
    >>> wet = Named(("wet", "rain"), np.log([[0.9, 0.1], [0.1, 0.9]]))
    >>> np.exp(summed([rain, wet], ["wet"], {"rain": 2, "wet": 2}, log_sum_exp)).round(3).tolist()
    [0.26, 0.74]
    """

    def combine(chosen: Sequence[Table], scope: Scope, gone: Scope) -> np.ndarray:
        return reduce(_flat(log_product(chosen, (*scope, *gone), sizes), len(gone)), -1)

    return log_product(eliminate(tables, keep, sizes, combine), keep, sizes)


def contract(tables: Sequence[Table], keep: Sequence[Variable]) -> Named:
    """The product of tables without batch axes, summed over every variable that is not kept."""
    moved = _moved(tables, keep)
    if moved is not None:
        return moved
    left = eliminate(tables, keep, sizes_of(tables), lambda chosen, scope, _: _sum(chosen, scope))
    present = {v for t in left for v in t.scope}
    scope = tuple(v for v in keep if v in present)
    return Named(scope, _sum(left, scope))


class Choice(NamedTuple):
    """Where maxima were found: for every configuration of ``given`` the best position of ``chosen``."""

    chosen: Scope
    shape: Shape
    given: Scope
    best: np.ndarray

    def look_up(self, positions: Mapping[Variable, Any]) -> dict[Variable, Any]:
        """The best positions, given those of the other variables; arrays where there are batch axes."""
        batch = self.best.ndim - len(self.given)
        open_ = (
            np.arange(n).reshape(-1, *(1,) * (batch - 1 - k)) if n > 1 else 0
            for k, n in enumerate(self.best.shape[:batch])
        )
        at = self.best[(*open_, *(positions[v] for v in self.given))]
        return dict(zip(self.chosen, unravelled(at, self.shape), strict=True))


def maximise(
    tables: Sequence[Table], keep: Sequence[Variable], sizes: Sizes
) -> tuple[np.ndarray, list[Choice]]:
    """The sum of logs maximised over every variable that is not kept, shape ``(*batch, *sizes of keep)``.

    The choices are in the order in which they were made; look them up from the last to the first.
    """
    left, choices = _maximised(tables, keep, sizes)
    return log_product(left, keep, sizes), choices


def choices_of(tables: Sequence[Table], keep: Sequence[Variable], sizes: Sizes) -> list[Choice]:
    """The choices of ``maximise`` alone: no table over all that is kept is made."""
    return _maximised(tables, keep, sizes)[1]


def largest(
    scopes: Sequence[Iterable[Variable]], keep: Collection[Variable], sizes: Sizes
) -> float:
    """Entries of the largest table that an elimination makes."""
    made = (_entries((*scope, *gone), sizes) for _, gone, scope in steps(scopes, keep, sizes))
    return max(_entries(frozenset(keep), sizes), *made, 1.0)


def steps(
    scopes: Sequence[Iterable[Variable]], keep: Collection[Variable], sizes: Sizes
) -> Iterator[tuple[list[int], Scope, Scope]]:
    """Which tables are multiplied, which variables leave, and which stay: cheapest first.

    Every step takes its tables off the list and puts the result at its end.
    """
    left = [frozenset(s) for s in scopes]
    order = tuple(dict.fromkeys(v for s in scopes for v in s))
    free = [v for v in order if v not in keep]
    while free:
        unions = {v: frozenset().union(*(s for s in left if v in s)) for v in free}
        first = min(free, key=lambda v: _entries(unions[v], sizes))
        touched = [k for k, s in enumerate(left) if first in s]
        left = [s for s in left if first not in s]
        others = frozenset().union(*left)
        gone = tuple(v for v in free if v in unions[first] and v not in others)
        scope = tuple(v for v in order if v in unions[first] and v not in gone)
        yield touched, gone, scope
        left.append(frozenset(scope))
        free = [v for v in free if v not in gone]


def connected(
    variables: Iterable[Variable], scopes: Iterable[Sequence[Variable]]
) -> list[tuple[Any, ...]]:
    """The variables in classes that no scope connects, each in the order given."""
    root = {v: v for v in variables}

    def top(v: Variable) -> Variable:
        while root[v] != v:
            root[v] = root[root[v]]
            v = root[v]
        return v

    for scope in scopes:
        inside = [v for v in scope if v in root]
        for other in inside[1:]:
            root[top(other)] = top(inside[0])
    found: dict[Variable, list[Variable]] = {}
    for v in root:
        found.setdefault(top(v), []).append(v)
    return [tuple(vs) for vs in found.values()]


def sizes_of(tables: Iterable[Table]) -> dict[Variable, int]:
    """Variable -> how many states it has."""
    return {
        v: n
        for t in tables
        for v, n in zip(t.scope, t.values.shape[t.values.ndim - len(t.scope) :], strict=True)
    }


# ---- private ------------------------------------------------------------------------------------


def _maximised(
    tables: Sequence[Table], keep: Sequence[Variable], sizes: Sizes
) -> tuple[list[Table], list[Choice]]:
    choices: list[Choice] = []

    def combine(chosen: Sequence[Table], scope: Scope, gone: Scope) -> np.ndarray:
        flat = _flat(log_product(chosen, (*scope, *gone), sizes), len(gone))
        best = flat.argmax(axis=-1)
        choices.append(Choice(gone, tuple(sizes[v] for v in gone), scope, best))
        return np.take_along_axis(flat, best[..., None], axis=-1)[..., 0]

    return eliminate(tables, keep, sizes, combine), choices


def _flat(values: np.ndarray, last: int) -> np.ndarray:
    """With the last axes as one."""
    return values.reshape(*values.shape[: values.ndim - last], -1)


def _moved(tables: Sequence[Table], keep: Sequence[Variable]) -> Named | None:
    """The commonest product by itself, in a fraction of the time: a row of numbers times a table."""
    if len(tables) != 2 or len(keep) != 1 or len(tables[0].scope) != 1:
        return None
    row, table = tables
    if len(table.scope) != 2 or row.scope[0] in keep:
        return None
    if table.scope == (row.scope[0], keep[0]):
        return Named((keep[0],), row.values @ table.values)
    if table.scope == (keep[0], row.scope[0]):
        return Named((keep[0],), table.values @ row.values)
    return None


def _sum(tables: Sequence[Table], scope: Scope) -> np.ndarray:
    """The product of tables, summed over the variables outside a scope."""
    number = {v: k for k, v in enumerate(dict.fromkeys(v for t in tables for v in t.scope))}
    arguments: list[Any] = []
    for t in tables:
        arguments += [t.values, [number[v] for v in t.scope]]
    if not arguments:
        return np.asarray(1.0)
    wanted = [number[v] for v in scope]
    return np.asarray(np.einsum(*arguments, wanted, optimize=len(tables) > 1))


def _entries(scope: Iterable[Variable], sizes: Sizes) -> float:
    return math.prod(float(sizes[v]) for v in scope)
