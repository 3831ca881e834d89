"""A mean-field approximation ready to be improved: one step for each factor, and the bound."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bayesmc.engines.variational.factors import Factor, State, TableFactor, table_of
from bayesmc.engines.variational.free import FREE, FreeFactor
from bayesmc.engines.variational.labels import LabelTerm
from bayesmc.engines.variational.reading import Sum
from bayesmc.expression import Expression, Program
from bayesmc.passes.arithmetic import ZERO, add
from bayesmc.passes.arrays import for_arrays
from bayesmc.passes.derivatives import gradient
from bayesmc.passes.logarithms import stable
from bayesmc.structure.target import Target


class ByLabel:
    """What elements of a plate say by one label: all terms side by side, as one product of matrices."""

    def __init__(self, terms: Sequence[LabelTerm], free: FreeFactor | None) -> None:
        self.terms, self.free = terms, free
        self.statistics = np.concatenate([t.statistics for t in terms])
        self._turned = np.ascontiguousarray(self.statistics.T)
        coefficients = _climbed([t.coefficients for t in terms], free)
        self._program = Program(for_arrays(coefficients))
        ends = np.cumsum([len(t.statistics) for t in terms])
        self._parts = [slice(e - len(t.statistics), e) for t, e in zip(terms, ends, strict=True)]
        self._logs = np.empty((terms[0].coefficients.shape[0], self.statistics.shape[1]))

    def logs(self, state: State) -> np.ndarray:
        """Expected log densities of all elements at all labels, shape (states, elements), written over."""
        parts = [averaged(c, 2, self.free) for c in self._program(state)]
        return np.matmul(np.concatenate(parts, axis=1), self.statistics, out=self._logs)

    def add_up(self, state: State) -> None:
        """Put the expected sums of statistics under a new table into the state."""
        table = state[table_of((self.terms[0].label,))]
        sums = table.reshape(len(table), -1) @ self._turned
        for term, part in zip(self.terms, self._parts, strict=True):
            state[term.sums.name] = sums[:, part]


class Step:
    """The update of one factor.

    Attributes
    ----------
    factor : Factor
    by_label : ByLabel or None
        Of a table: what is said by its labels.
    """

    def __init__(self, factor: Factor, sums: Sequence[Sum], free: FreeFactor | None) -> None:
        self.factor, self.free = factor, free
        self.by_label: ByLabel | None = None
        self._program: Program | None = None
        self._names: tuple[str, ...] = ()
        own = set(factor.moments)
        used = [s for s in sums if s.total.leaves & own]
        if isinstance(factor, FreeFactor):
            factor.prepare(total_of(s.total for s in used))
            return
        if isinstance(factor, TableFactor):
            terms = [s.by_label for s in sums if s.by_label is not None]
            terms = [t for t in terms if t.label == factor.names[0]]
            used = [s for s in used if s.by_label is None]
            self.by_label = ByLabel(terms, free) if terms else None
        if used:
            (total,) = _climbed([total_of(s.total for s in used)], free)
            slopes = gradient(total, factor.moments)
            self._names = tuple(slopes)
            roots = _climbed([slopes[n] for n in self._names], free)
            self._program = Program(for_arrays(roots))

    def update(self, state: State) -> None:
        """Make the factor the best given all others."""
        factor = self.factor
        if isinstance(factor, TableFactor) and factor.one_by_one:
            for element in range(factor.elements):
                factor.update_one(state, self._slopes(state), element)
        else:
            factor.update(state, self._slopes(state))
        self.tell(state)

    def tell(self, state: State) -> None:
        """Put what follows from the factor's moments into the state."""
        if self.by_label is not None:
            self.by_label.add_up(state)

    # ---- private -------------------------------------------------------------------------------

    def _slopes(self, state: State) -> State:
        """Derivatives of the expected log joint density by the factor's moments."""
        shapes, found = self.factor.shapes, {}
        if self._program is not None:
            for name, value in zip(self._names, self._program(state), strict=True):
                shape = shapes[name]
                value = averaged(value, len(shape), self.free)
                found[name] = value if value.shape == shape else np.broadcast_to(value, shape)
        if self.by_label is not None:
            (name,) = self.factor.moments
            logs = self.by_label.logs(state).reshape(shapes[name])
            if name in found:
                logs += found[name]
            found[name] = logs
        elif isinstance(self.factor, TableFactor):
            found = {name: np.array(value) for name, value in found.items()}
        for name in self.factor.moments:
            if name not in found and name in shapes:
                found[name] = np.zeros(shapes[name])
        return found


@dataclass(frozen=True, eq=False)
class Plan:
    """A mean-field approximation.

    Attributes
    ----------
    target : Target
    factors : tuple of Factor
        In the order of a sweep: numbers first, then tables.
    sums : tuple of Sum
        The terms' expectations.
    free : FreeFactor or None
    why : dict
        Node -> what kind of factor it has, and why no closer one.
    """

    target: Target
    factors: tuple[Factor, ...]
    sums: tuple[Sum, ...]
    free: FreeFactor | None
    why: dict[str, str]

    @cached_property
    def steps(self) -> tuple[Step, ...]:
        return tuple(Step(factor, self.sums, self.free) for factor in self.factors)

    def start(self, state: State, values: Mapping[str, np.ndarray]) -> None:
        """Put points into a state."""
        for step in self.steps:
            step.factor.start(state, values)
            step.tell(state)

    def bound(self, state: State) -> float:
        """The evidence lower bound, up to factors of what is known."""
        total = self.energy(state) + sum(f.entropy(state) for f in self.factors)
        return total if self.free is None else total + self.free.bound_parts(state)

    def energy(self, state: State) -> float:
        """The expected log joint density."""
        found = self.values(state)
        return self.free.average(found) if self.free is not None else float(found)

    def values(self, state: State) -> np.ndarray:
        """The same at every point of the free numbers."""
        (found,) = self._energy(state)
        return np.asarray(found)

    def energy_as_written(self, state: State) -> float:
        """The same in the arithmetic of the model's own functions, to be held against these."""
        if self.free is None:
            return self.energy(state)
        (found,) = Program(for_arrays([total_of(s.total for s in self.sums)]))(state)
        return self.free.average(np.asarray(found))

    @cached_property
    def _energy(self) -> Program:
        return Program(for_arrays(_climbed([total_of(s.total for s in self.sums)], self.free)))


def averaged(value: np.ndarray, rank: int, free: FreeFactor | None) -> np.ndarray:
    """The average over the points of free numbers, where a value of some rank depends on these."""
    value = np.asarray(value)
    if value.ndim == rank or free is None:
        return value
    return np.tensordot(free.weights, value, 1)


def total_of(parts: Iterable[Expression]) -> Expression:
    """The sum of numbers."""
    total: Expression = ZERO
    for part in parts:
        total = add(total, part)
    return total


def _climbed(roots: Sequence[Expression], free: FreeFactor | None) -> list[Expression]:
    """As the free factor climbs it: all steps are of one function far out, or the bound falls."""
    return list(roots) if free is None else stable(roots)


__all__ = ["FREE", "ByLabel", "Plan", "Step", "averaged", "total_of"]
