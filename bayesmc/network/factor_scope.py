"""Scopes: which elements of which variables each factor of a graph reads.

A batch of factors reads a variable either whole or by columns: integer arrays with one element of the
variable per factor. Both are read off the expressions of the functions, which reach through deterministic
nodes: a constant gather (``effect[school]``) counts as the elements that it takes, one by a hidden index as
all. Of what cannot be followed only what it receives is known.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import (
    Constant,
    Expression,
    Gather,
    broadcast,
    constant,
    elementwise,
    mapped,
    ordered,
    replaced,
    reshape,
    substituted,
)
from bayesmc.expression.graph import as_float
from bayesmc.network.calling import Aligner, RowAligner
from bayesmc.network.evidence import Observed
from bayesmc.network.expressions import Opaque, density
from bayesmc.network.model import CompiledNode, Model, potential_shape
from bayesmc.network.readings import by_element
from bayesmc.passes.reads import elements_read
from bayesmc.shapes import Shape


@dataclass(frozen=True, eq=False)
class Reads:
    """What the factors of a batch read of one variable.

    Attributes
    ----------
    columns : tuple of ndarray of int, or None
        Each of shape (factors,): flat elements of the variable; None where every factor may read all.
    """

    columns: tuple[np.ndarray, ...] | None

    def rows_with(self, element: int) -> np.ndarray | None:
        """Positions of the factors that read an element; None for all of them."""
        if self.columns is None:
            return None
        found = np.zeros(len(self.columns[0]), dtype=bool)
        for column in self.columns:
            found |= column == element
        return np.flatnonzero(found)

    def elements(self, rows: np.ndarray | None, count: int) -> np.ndarray:
        """Elements that some factors read, in order, of a variable of ``count`` elements."""
        if self.columns is None:
            return np.arange(count)
        return np.unique([c if rows is None else c[rows] for c in self.columns])

    def couples(self, count: int) -> bool:
        """Whether a factor may read several of the variable's ``count`` elements."""
        return count > 1 if self.columns is None else len(self.columns) > 1


@dataclass(frozen=True, eq=False)
class Scope:
    """A batch of factors and what it reads of hidden variables.

    Attributes
    ----------
    name : str
        Of the node whose conditional density it is, or of the potential.
    kind : str
        ``"conditional"`` or ``"potential"``.
    plates : tuple of str
    shape : tuple of int
        One factor per element: sizes of the plates, or the rows of an index.
    reads : dict
        Variable -> ``Reads``, in the order of the function's arguments, the node itself last.
    """

    name: str
    kind: str
    plates: tuple[str, ...]
    shape: Shape
    reads: dict[str, Reads]


def hidden_elements(model: Model, observed: Mapping[str, Observed]) -> dict[str, np.ndarray]:
    """Hidden stochastic nodes in topological order, each with which of its elements are hidden, flat."""
    found = {}
    for name, node in model.nodes.items():
        seen = observed.get(name)
        if not node.is_stochastic or (seen is not None and seen.mask is None):
            continue
        every = np.ones(math.prod(node.plate_shape), dtype=bool)
        found[name] = every if seen is None or seen.mask is None else ~seen.mask.ravel()
    return found


def factor_scopes(
    model: Model, observed: Mapping[str, Observed], inputs: Mapping[str, np.ndarray]
) -> list[Scope]:
    """Every batch of factors that some hidden variable enters.

    A variable of a constructed graph has no density, and what depends on no hidden variable is a constant.
    """
    hidden = hidden_elements(model, observed)
    known = {n: o.value for n, o in observed.items() if o.mask is None} | dict(inputs)
    values = {n: constant(v) for n, v in known.items()}
    scopes = []
    for name, node in model.nodes.items():
        if not node.is_stochastic or node.declaration.source == "variable":
            continue
        reads = _reads(model, name, node.links, node.plates, node.plate_shape, hidden, values)
        if name in hidden:
            reads[name] = Reads((np.arange(math.prod(node.plate_shape)),))
        scopes.append(Scope(name, "conditional", node.plates, node.plate_shape, reads))
    for name, (potential, links) in model.potentials.items():
        shape = potential_shape(model.sizes, potential)
        reads = _reads(model, name, links, potential.plates, shape, hidden, values)
        scopes.append(Scope(name, "potential", potential.plates, shape, reads))
    return [scope for scope in scopes if scope.reads]


# ---- private ------------------------------------------------------------------------------------


def _reads(
    model: Model,
    name: str,
    links: Sequence[tuple[str, Aligner]],
    plates: tuple[str, ...],
    shape: Shape,
    hidden: Container[str],
    known: Mapping[str, Expression],
) -> dict[str, Reads]:
    """What the factors of a function read of hidden variables, through deterministic nodes."""
    found = density(model, name)
    names = [n for n in model.nodes if n in found.leaves and n in hidden]
    if isinstance(found, Opaque):
        through = [p for p, _ in links if model[p].kind == "deterministic"]
        behind = frozenset().union(*(density(model, p).leaves for p in through))
        return {
            n: Reads(None if n in behind else _received(model[n], links, plates, shape))
            for n in names
        }
    traced = mapped(found.result, lambda e: substituted(e, dict(known)))
    try:
        parts = list(by_element(traced))
    except TraceError:  # of a family of the user's own
        return {n: Reads(None) for n in names}
    return {n: Reads(_columns(parts, model[n], shape)) for n in names if _depend(parts, n)}


def _depend(parts: Iterable[Expression], name: str) -> bool:
    return any(name in part.leaves for part in parts)


def _columns(
    parts: Iterable[Expression], node: CompiledNode, shape: Shape
) -> tuple[np.ndarray, ...] | None:
    """The elements that each factor reads, by the ways in which they come in; None for all of them."""
    every = np.arange(math.prod(node.plate_shape))
    own = every.reshape(node.plate_shape + (1,) * len(node.event_shape))
    columns: dict[bytes, np.ndarray] = {}
    for part in parts:
        if node.name not in part.leaves:
            continue
        try:
            ways = elements_read(_plain(part), node.name, np.broadcast_to(own, node.value_shape))
        except TraceError:
            return None
        for at in ways:
            if not isinstance(at, Constant) or (at.value < 0).any():
                return None
            column = np.broadcast_to(at.value, shape).ravel()
            columns[column.tobytes()] = column
    return tuple(columns.values())


def _plain(root: Expression) -> Expression:
    """An expression that reads the same, without tables that are known: numbers of states, say."""
    instead: dict[Expression, Expression] = {}
    for node in ordered(root):
        if isinstance(node, Gather) and isinstance(node.table, Constant):
            rows = replaced(node.rows, instead)
            behind = (1,) * (len(node.shape) - len(rows.shape))
            wide = broadcast(reshape(rows, rows.shape + behind), node.shape)
            instead[node] = elementwise(as_float, wide)
    return replaced(root, instead)


def _received(
    node: CompiledNode, links: Sequence[tuple[str, Aligner]], plates: tuple[str, ...], shape: Shape
) -> tuple[np.ndarray, ...] | None:
    """The elements that each factor receives as arguments; None where an argument is several."""
    columns = []
    for parent, link in links:
        if parent != node.name:
            continue
        if isinstance(link, RowAligner):
            columns.append(link.flat)
        elif link.foreign:
            return None
        elif not node.plates:
            columns.append(np.zeros(math.prod(shape), dtype=np.intp))
        else:
            grid = dict(zip(plates, np.indices(shape, sparse=True), strict=True))
            full = [np.broadcast_to(grid[p], shape).ravel() for p in node.plates]
            columns.append(np.ravel_multi_index(full, node.plate_shape))
    return tuple(columns)
