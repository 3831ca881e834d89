"""What can be read off a factor graph: its variables and factors, blankets, the sum of its log factors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.distributions.support import Support
from bayesmc.errors import EvidenceError, QueryError, UnknownNodeError
from bayesmc.network.evidence import Observed, store
from bayesmc.network.factor_scope import Scope
from bayesmc.network.joint import node_log_prob
from bayesmc.network.model import CompiledNode, Model
from bayesmc.shapes import Shape, broadcast_shapes

Values = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class VariableRecord:
    """One variable of a factor graph.

    Attributes
    ----------
    name : str
    plates : tuple of str
    states : tuple or None
        Values of a finite variable in order; None for others.
    support : Support or None
        Where its values lie; None where that depends on other variables.
    event_shape : tuple of int
        Shape of one value; ``()`` for a scalar.
    size : int
        Number of hidden elements.
    """

    name: str
    plates: tuple[str, ...]
    states: tuple[Any, ...] | None
    support: Support | None
    event_shape: Shape
    size: int


@dataclass(frozen=True)
class FactorRecord:
    """One batch of like factors.

    Attributes
    ----------
    name : str
        Of the factor, or of the node whose conditional density it is.
    scope : tuple of str
        The hidden variables that it reads, each once.
    rows : int
        Number of factors in the batch.
    kind : str
        ``"conditional"`` (a density of a net) or ``"potential"``.
    plates : tuple of str
        The batch has one factor per element of these; none with an index.
    """

    name: str
    scope: tuple[str, ...]
    rows: int
    kind: str
    plates: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class GraphView:
    """A model with what is known of it, and what its factors read.

    Attributes
    ----------
    hidden : dict
        Variable -> which of its elements are hidden, shape (elements,).
    """

    model: Model
    observed: Mapping[str, Observed]
    inputs: Mapping[str, np.ndarray]
    hidden: Mapping[str, np.ndarray]
    scopes: Sequence[Scope]

    def variables(self) -> dict[str, VariableRecord]:
        """Name -> record of every hidden variable."""
        found = {}
        for name, hidden in self.hidden.items():
            node = self.model[name]
            states = node.domain.states if node.domain is not None else None
            found[name] = VariableRecord(
                name, node.plates, states, node.support, node.event_shape, int(hidden.sum())
            )
        return found

    def factors(self) -> tuple[FactorRecord, ...]:
        """Every batch of factors that a hidden variable enters."""
        return tuple(
            FactorRecord(s.name, tuple(s.reads), math.prod(s.shape), s.kind, s.plates)
            for s in self.scopes
        )

    def markov_blanket(
        self, name: str, element: int | Sequence[int] | None
    ) -> frozenset[str] | frozenset[tuple[str, Shape]]:
        """See ``FactorGraph.markov_blanket``."""
        hidden = self.elements_of("markov_blanket", name)
        entered = [s for s in self.scopes if name in s.reads]
        if element is None:
            others = {other for s in entered for other in s.reads if other != name}
            coupled = any(s.reads[name].couples(len(hidden)) for s in entered)
            return frozenset(others | {name} if coupled else others)
        flat = self.flat("markov_blanket", name, element)
        members = {other: np.zeros_like(mask) for other, mask in self.hidden.items()}
        for scope in entered:
            rows = scope.reads[name].rows_with(flat)
            if rows is not None and not len(rows):
                continue
            for other, reads in scope.reads.items():
                members[other][reads.elements(rows, len(members[other]))] = True
        members[name][flat] = False
        return frozenset(
            pair
            for other, mask in members.items()
            for pair in self._pairs(other, np.flatnonzero(mask & self.hidden[other]))
        )

    def elements_of(self, call: str, name: str) -> np.ndarray:
        """Which elements of a variable are hidden; what is no hidden variable is refused."""
        if name in self.hidden:
            return self.hidden[name]
        what = "is no variable of the factor graph"
        if name in self.observed:
            what = "is observed"
        elif name in self.model.nodes:
            what = f"is {self.model[name].kind}"
        raise UnknownNodeError(
            f"{call}({name!r}): {name!r} {what}; its hidden variables are {list(self.hidden)[:12]}"
        )

    def flat(self, call: str, name: str, element: int | Sequence[int]) -> int:
        """An index in a variable's plates as a flat one, of a hidden element."""
        node = self.model[name]
        shape = node.plate_shape
        at = (element,) if isinstance(element, (int, np.integer)) else element
        fits = isinstance(at, Sequence) and len(at) == len(shape)
        if not fits or not all(isinstance(i, (int, np.integer)) for i in at):
            raise QueryError(
                f"{call}({name!r}, element={element!r}): give one whole number for each of its plates "
                f"{node.plates}"
            )
        if not all(0 <= i < n for i, n in zip(at, shape, strict=True)):
            raise QueryError(
                f"{call}({name!r}, element={element!r}): outside its plates, of sizes {shape}"
            )
        flat = int(np.ravel_multi_index(tuple(int(i) for i in at), shape)) if shape else 0
        if not self.hidden[name][flat]:
            raise QueryError(f"{call}({name!r}, element={element!r}): that element is observed")
        return flat

    def stored(
        self, call: str, given: Mapping[str, Any], without: str | None = None
    ) -> tuple[Values, Shape]:
        """Stored values of all variables (but one), evidence filled in, and their common batch shape."""
        if not isinstance(given, Mapping):
            raise EvidenceError(
                f"{call}: give a dict from variable to value, not {type(given).__name__}"
            )
        for name in given:
            self._refuse_given(call, name)
        values: Values = dict(self.inputs)
        batch: Shape = ()
        for name in self.model.nodes:
            seen = self.observed.get(name)
            if name not in self.hidden:
                if seen is not None:
                    values[name] = seen.value
                continue
            if name not in given:
                if name == without:
                    continue
                raise EvidenceError(f"{call}: variable {name!r} has no value; give all hidden ones")
            node = self.model[name]
            value = self._stored(call, node, given[name], seen)
            lead = value.shape[: value.ndim - len(node.value_shape)]
            try:
                batch = broadcast_shapes(batch, lead)
            except ValueError:
                raise EvidenceError(
                    f"{call}: the values of {name!r} have batch shape {lead}, which does not broadcast with "
                    f"{batch} of those before"
                ) from None
            values[name] = value
        return values, batch

    def log_prob(self, values: Values) -> np.ndarray:
        """Sum of all log factors at complete stored values, shape their batch."""
        total: Any = np.zeros(())
        values = dict(values)
        with marking_invalid(), np.errstate(all="ignore"):
            for name, node in self.model.nodes.items():
                if node.is_stochastic:
                    total = total + node_log_prob(self.model, name, values[name], values, total)
                elif node.kind != "input":
                    values[name], _ = self.model.evaluate(name, values)
            for name in self.model.potentials:
                total = total + self.model.potential(name, values)
        return total

    def _pairs(self, name: str, flat: np.ndarray) -> Iterator[tuple[str, Shape]]:
        shape = self.model[name].plate_shape
        if not shape:
            yield from ((name, ()) for _ in flat)
            return
        axes = (axis.tolist() for axis in np.unravel_index(flat, shape))
        for at in zip(*axes, strict=True):
            yield name, at

    def _refuse_given(self, call: str, name: str) -> None:
        if name in self.hidden:
            return
        what = "is no variable of the graph"
        if name in self.observed:
            what = "is observed; its value is the evidence's"
        elif name in self.model.nodes:
            what = f"is {self.model[name].kind} and follows from the others"
        raise EvidenceError(f"{call}: {name!r} {what}; leave it out")

    def _stored(
        self, call: str, node: CompiledNode, value: Any, seen: Observed | None
    ) -> np.ndarray:
        try:
            stored = store(node, value)
        except EvidenceError as error:
            raise EvidenceError(f"{call}: {error}") from None
        if seen is None or seen.mask is None:
            return stored
        mask = seen.mask.reshape(seen.mask.shape + (1,) * len(node.event_shape))
        return np.where(mask, seen.value, stored)
