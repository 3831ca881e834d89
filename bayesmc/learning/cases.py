"""Expected counts of families over cases of a net of tables: what is hidden falls apart into components.

Given what a case shows, hidden nodes that share no family are independent. So each set of hidden nodes that
hang together is summed over by itself, once for every configuration of what surrounds it, for all cases that
show the same at once. Families that a case shows in full are counted once and for all.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bayesmc.errors import BudgetError, ZeroProbabilityError

#: entries of products that are held at a time, and of one product at most
_AT_ONCE, _MOST = 1 << 17, 1 << 22
MISSING = -1


@dataclass(frozen=True, eq=False)
class Family:
    """A node with its parents: which columns its table has as axes, the node last."""

    name: str
    axes: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Part:
    """How one family, or what a case shows of one node, enters a component.

    Attributes
    ----------
    family : Family or None
        None: of one node, 1 for the states that it may have.
    order : tuple of int
        The table's axes, shown ones first, then hidden ones in the component's order.
    shown : ndarray of int, shape (configurations,)
        Flat position along the shown axes.
    shape : tuple of int
        Of the hidden axes, 1 for each hidden node of the component that it does not read.
    """

    family: Family | None
    order: tuple[int, ...]
    shown: np.ndarray
    shape: tuple[int, ...]


class Step(NamedTuple):
    """One node summed out: of which factors (the parts', then earlier results), on what axis."""

    axis: int
    factors: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Component:
    """Hidden nodes that hang together, in all cases in which they do.

    Attributes
    ----------
    hidden : tuple of int
        Columns.
    weights : ndarray, shape (configurations,)
        How many cases show each configuration of what surrounds them.
    parts : tuple of Part
    steps : tuple of Step
        In which order they are summed out; the last result is a number.
    size : int
        Entries of the largest product on the way.
    entries : int
        Those of all products.
    """

    hidden: tuple[int, ...]
    weights: np.ndarray
    parts: tuple[Part, ...]
    steps: tuple[Step, ...]
    size: int
    entries: int = 0


class Cases:
    """Cases of a net of tables, read once.

    Parameters
    ----------
    names : sequence of str
    cards : sequence of int
        States of each.
    parents : mapping
        Name -> its parents, in the order of its table's axes.
    codes : ndarray of int, shape (cases, names)
        Positions of states, -1 where missing.
    weights : ndarray, shape (cases,), optional
        How often each case came.
    """

    def __init__(
        self,
        names: Sequence[str],
        cards: Sequence[int],
        parents: Mapping[str, Sequence[str]],
        codes: np.ndarray,
        weights: np.ndarray | None = None,
    ) -> None:
        self.names, self.cards = tuple(names), tuple(cards)
        at = {name: k for k, name in enumerate(names)}
        self.families = tuple(Family(n, (*(at[p] for p in parents[n]), at[n])) for n in self.names)
        rows, inverse = np.unique(codes, axis=0, return_inverse=True)
        given = np.ones(len(codes)) if weights is None else np.asarray(weights, dtype=float)
        self.rows = rows
        self.weights = np.bincount(inverse.ravel(), weights=given, minlength=len(rows))
        self.total = float(given.sum())
        some = np.asarray((self.rows < 0).any(axis=1))
        together = self._together(np.flatnonzero(some)) if some.any() else None
        many = len(np.unique(self.rows[some] < 0, axis=0))
        # one pass over all cases, or many small ones: by what either costs, a call being some 1,000 numbers
        all_at_once = together is not None and together.size <= _MOST
        price = together.entries * len(together.weights) if together is not None else 0
        if together is not None and all_at_once and (many == 1 or price < 2e5 * many):
            self.components: tuple[Component, ...] = (together,)
        else:
            self.components = tuple(self._components())
        whole = self.components[:1] == (together,) and together is not None
        self.shown = {f.name: self._shown(f, ~some if whole else None) for f in self.families}

    def expected(self, tables: Mapping[str, np.ndarray]) -> tuple[float, dict[str, np.ndarray]]:
        """The log likelihood of all cases, and the expected count of every entry of every table.

        Raises
        ------
        ZeroProbabilityError
            A case is impossible.
        """
        total, counts = 0.0, {}
        for family in self.families:
            seen, table = self.shown[family.name], tables[family.name]
            if (seen[table <= 0] > 0).any():
                raise self._impossible(f"a case shows what the table of {family.name!r} rules out")
            total += float((seen * np.log(np.where(seen > 0, table, 1.0))).sum())
            counts[family.name] = seen.copy()
        for component in self.components:
            step = max(1, _AT_ONCE // component.size)
            for first in range(0, len(component.weights), step):
                total += self._add(component, slice(first, first + step), tables, counts)
        return total, counts

    def _add(
        self,
        component: Component,
        chosen: slice,
        tables: Mapping[str, np.ndarray],
        counts: Mapping[str, np.ndarray],
    ) -> float:
        """One component's configurations: their log likelihood; counts are added to.

        The derivative of what elimination ends with by a factor, times the factor, is the expected count
        (Darwiche 2003, A differential approach to inference in Bayesian networks, J. ACM 50).
        """
        factors = [self._factor(part, chosen, tables) for part in component.parts]
        for axis, inputs in component.steps:
            product = _product([factors[k] for k in inputs])
            factors.append(product.sum(axis=axis, keepdims=True))
        mass = factors[-1].reshape(-1)
        weights = component.weights[chosen]
        if not (mass > 0).all():
            names = ", ".join(repr(self.names[k]) for k in component.hidden)
            raise self._impossible(f"whatever the states of {names}")
        spare = {k for k, part in enumerate(component.parts) if part.family is None}
        slopes = _backwards(component.steps, factors, weights / mass, spare)
        for part, factor, slope in zip(component.parts, factors, slopes, strict=False):
            if part.family is not None:
                self._count(counts[part.family.name], part, part.shown[chosen], factor * slope)
        return float(weights @ np.log(mass))

    def _factor(self, part: Part, chosen: slice, tables: Mapping[str, np.ndarray]) -> np.ndarray:
        """Configurations stand last: they are many, states few, and inner loops run over what stands last."""
        if part.family is None:
            states = math.prod(part.shape)
            allowed = np.column_stack([np.eye(states), np.ones(states)])  # the last one: whatever
            return allowed[:, part.shown[chosen]].reshape(*part.shape, -1)
        columns = self._columns(tables[part.family.name], part)
        shown = part.shown[chosen] if len(part.shown) > 1 else part.shown
        return columns[:, shown].reshape(*part.shape, -1)

    def _columns(self, table: np.ndarray, part: Part) -> np.ndarray:
        """A table with one column for each position along the shown axes."""
        width = math.prod(part.shape)
        return np.ascontiguousarray(table.transpose(part.order).reshape(-1, width).T)

    def _count(
        self, count: np.ndarray, part: Part, shown: np.ndarray, posterior: np.ndarray
    ) -> None:
        width = math.prod(part.shape)
        if len(part.shown) == 1:  # a table that all cases share
            shown = part.shown
        view = count.transpose(part.order)
        rows = math.prod(view.shape) // width
        at = (shown * width + np.arange(width)[:, None]).ravel()
        added = np.bincount(at, weights=posterior.ravel(), minlength=rows * width)
        view += added.reshape(view.shape)

    # ---- reading -------------------------------------------------------------------------------

    def _shown(self, family: Family, cases: np.ndarray | None) -> np.ndarray:
        """Counts of cases (of those marked) that show a family in full."""
        cards = [self.cards[k] for k in family.axes]
        columns = self.rows[:, list(family.axes)]
        known = (columns >= 0).all(axis=1)
        known = known if cases is None else known & cases
        at = np.ravel_multi_index(tuple(columns[known].T), cards)
        counts = np.bincount(at, weights=self.weights[known], minlength=math.prod(cards))
        return counts.reshape(cards).astype(float)

    def _components(self) -> list[Component]:
        patterns, which = np.unique(self.rows < 0, axis=0, return_inverse=True)
        cases: dict[tuple[int, ...], list[np.ndarray]] = {}
        order = np.argsort(which.ravel(), kind="stable")
        ends = np.cumsum(np.bincount(which.ravel(), minlength=len(patterns)))
        touching = self._touching()
        for k, pattern in enumerate(patterns):
            rows = order[(ends[k - 1] if k else 0) : ends[k]]
            for hidden in _connected(np.flatnonzero(pattern).tolist(), touching, self.families):
                cases.setdefault(hidden, []).append(rows)
        return [self._component(h, np.concatenate(rows), touching) for h, rows in cases.items()]

    def _together(self, rows: np.ndarray) -> Component:
        """All nodes at once, what cases show as factors of their own."""
        shown, inverse = np.unique(self.rows[rows], axis=0, return_inverse=True)
        weights = np.bincount(inverse.ravel(), weights=self.weights[rows], minlength=len(shown))
        nodes = tuple(range(len(self.names)))
        parts = []
        for family in self.families:
            order = tuple(sorted(range(len(family.axes)), key=lambda k, f=family: f.axes[k]))  # type: ignore[misc]
            shape = tuple(self.cards[h] if h in family.axes else 1 for h in nodes)
            parts.append(Part(family, order, np.zeros(1, dtype=np.intp), shape))
        for column in nodes:
            shape = tuple(self.cards[column] if h == column else 1 for h in nodes)
            at = shown[:, column].astype(np.intp)  # -1 is the row that allows all states
            parts.append(Part(None, (), at, shape))
        steps, size, entries = _plan([part.shape for part in parts], self.cards)
        return Component(nodes, weights, tuple(parts), steps, size, entries)

    def _touching(self) -> list[list[int]]:
        """For each column the families that read it."""
        found: list[list[int]] = [[] for _ in self.names]
        for k, family in enumerate(self.families):
            for axis in family.axes:
                found[axis].append(k)
        return found

    def _component(
        self, hidden: tuple[int, ...], rows: np.ndarray, touching: list[list[int]]
    ) -> Component:
        families = [self.families[k] for k in sorted({f for h in hidden for f in touching[h]})]
        around = sorted({a for f in families for a in f.axes} - set(hidden))
        shown, inverse = np.unique(self.rows[rows][:, around], axis=0, return_inverse=True)
        weights = np.bincount(inverse.ravel(), weights=self.weights[rows], minlength=len(shown))
        place = {column: k for k, column in enumerate(around)}
        parts = []
        for family in families:
            known = [k for k, a in enumerate(family.axes) if a not in hidden]
            open_ = sorted(
                (k for k, a in enumerate(family.axes) if a in hidden),
                key=lambda k, axes=family.axes: hidden.index(axes[k]),  # type: ignore[misc]
            )
            cards = [self.cards[family.axes[k]] for k in known]
            columns = tuple(shown[:, place[family.axes[k]]] for k in known)
            at = (
                np.ravel_multi_index(columns, cards)
                if known
                else np.zeros(len(shown), dtype=np.intp)
            )
            shape = tuple(self.cards[h] if h in family.axes else 1 for h in hidden)
            parts.append(Part(family, (*known, *open_), at, shape))
        cards = [self.cards[h] for h in hidden]
        steps, size, entries = _plan([part.shape for part in parts], cards)
        if size > _MOST:
            names = ", ".join(repr(self.names[k]) for k in hidden[:6])
            raise BudgetError(
                f"fit: {len(hidden)} nodes that are hidden together ({names}, ...) take tables of "
                f"{size:.3g} entries; "
                "give data of some of them, or learn a template (DynamicBayesNet) where they form a chain"
            )
        return Component(hidden, weights, tuple(parts), steps, size, entries)

    def _impossible(self, why: str) -> ZeroProbabilityError:
        return ZeroProbabilityError(
            f"fit: a case has probability zero: {why}; start EM from tables without zeros (start=), "
            "or add counts="
        )


def _connected(
    hidden: list[int], touching: list[list[int]], families: Sequence[Family]
) -> list[tuple[int, ...]]:
    """Hidden columns that share a family, one sorted tuple for each set that hangs together."""
    left, found = set(hidden), []
    while left:
        todo = [left.pop()]
        group = set(todo)
        while todo:
            for k in touching[todo.pop()]:
                new = left.intersection(families[k].axes)
                left -= new
                group |= new
                todo += new
        found.append(tuple(sorted(group)))
    return found


def _plan(
    shapes: Sequence[tuple[int, ...]], cards: Sequence[int]
) -> tuple[tuple[Step, ...], int, int]:
    """Nodes summed out one by one, the one whose product is smallest first; the largest product, and all."""
    scopes = [frozenset(k for k, n in enumerate(shape) if n > 1) for shape in shapes]
    live, left = set(range(len(scopes))), {k for k, n in enumerate(cards) if n > 1}
    steps, largest, entries = [], 1, 0

    def size(k: int) -> int:
        joined = frozenset().union(*(scopes[i] for i in live if k in scopes[i]), {k})
        return math.prod(cards[j] for j in joined)

    while left:
        best = min(left, key=lambda k: (size(k), k))
        largest = max(largest, size(best))
        entries += size(best)
        inputs = tuple(sorted(i for i in live if best in scopes[i]))
        live.difference_update(inputs)
        scopes.append(frozenset().union(*(scopes[i] for i in inputs)) - {best})
        live.add(len(scopes) - 1)
        steps.append(Step(best, inputs))
        left.remove(best)
    # what is left are numbers; their product is the last one, along an axis of size 1
    steps.append(Step(0, tuple(sorted(live))))
    return tuple(steps), largest, entries


def _product(factors: Sequence[np.ndarray]) -> np.ndarray:
    found = factors[0]
    for factor in factors[1:]:
        found = found * factor
    return found


def _backwards(
    steps: Sequence[Step],
    factors: Sequence[np.ndarray],
    weights: np.ndarray,
    spare: Container[int],
) -> list[np.ndarray]:
    """Derivatives of the last factor by each but those to spare, times weights.

    Of a factor that all configurations share it is the sum over these.
    """
    first = len(factors) - len(steps)
    slopes: list[Any] = [None] * len(factors)
    slopes[-1] = weights.reshape(*(1,) * (factors[-1].ndim - 1), -1)
    for k in range(len(steps) - 1, -1, -1):
        _, inputs = steps[k]
        above = slopes[first + k]
        for i in inputs:
            if i in spare:
                continue
            others = [factors[j] for j in inputs if j != i]
            slope = _product([above, *others])
            shape = factors[i].shape
            over = tuple(d for d in range(slope.ndim) if shape[d] == 1 and slope.shape[d] > 1)
            slope = slope.sum(axis=over, keepdims=True) if over else slope
            slopes[i] = np.broadcast_to(slope, shape)
    return slopes
