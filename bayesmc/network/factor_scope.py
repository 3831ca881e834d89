"""Scopes: which elements of which variables each factor of a graph reads.

A batch of factors reads a variable either whole or by columns: integer arrays with one element of the
variable per factor. Scopes reach through deterministic nodes, and a constant gather (``effect[school]``)
counts as the elements that it takes; one by a hidden index counts as all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.network.align import Aligner, RowAligner
from bayesmc.network.evidence import Observed
from bayesmc.network.model import CompiledNode, Model, arguments_of, potential_shape
from bayesmc.plates import PlateArray
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

    def joined(self, other: Reads) -> Reads:
        """What is read by either."""
        if self.columns is None or other.columns is None:
            return Reads(None)
        new = [c for c in other.columns if not any(np.array_equal(c, d) for d in self.columns)]
        return Reads((*self.columns, *new))

    def through(self, inner: Reads) -> Reads:
        """What is read of a variable behind a deterministic node that itself reads ``inner``."""
        if self.columns is None or inner.columns is None:
            return Reads(None)
        found = Reads(())
        for outer in self.columns:
            found = found.joined(Reads(tuple(column[outer] for column in inner.columns)))
        return found


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
    reader = _Reader(model, observed, inputs)
    scopes = []
    for name, node in model.nodes.items():
        if node.kind == "deterministic":
            what = node.declaration
            reader.computed[name] = reader.reads(
                node.links, node.plates, node.plate_shape, what.function, what.vectorize
            )
        elif node.is_stochastic and node.declaration.source != "variable":
            scopes.append(reader.conditional(node))
    for name, (potential, links) in model.potentials.items():
        shape = potential_shape(model.sizes, potential)
        reads = reader.reads(links, potential.plates, shape, potential.function)
        scopes.append(Scope(name, "potential", potential.plates, shape, reads))
    return [scope for scope in scopes if scope.reads]


# ---- private ------------------------------------------------------------------------------------


class _Reader:
    """What functions read, found from the shapes of their parents and from constant gathers."""

    def __init__(
        self, model: Model, observed: Mapping[str, Observed], inputs: Mapping[str, np.ndarray]
    ) -> None:
        self.model = model
        self.hidden = hidden_elements(model, observed)
        #: what deterministic nodes read
        self.computed: dict[str, dict[str, Reads]] = {}
        seen = {n: o.value for n, o in observed.items() if o.mask is None}
        self._known = {**inputs, **seen}
        self._trial: dict[str, np.ndarray] | None = None

    def conditional(self, node: CompiledNode) -> Scope:
        """The scope of a node's conditional density."""
        what = node.declaration
        reads = self.reads(node.links, node.plates, node.plate_shape, what.function, what.vectorize)
        if node.name in self.hidden:
            own = Reads((np.arange(math.prod(node.plate_shape)),))
            reads[node.name] = own.joined(reads.pop(node.name)) if node.name in reads else own
        return Scope(node.name, "conditional", node.plates, node.plate_shape, reads)

    def reads(
        self,
        links: tuple[tuple[str, Aligner], ...],
        plates: tuple[str, ...],
        shape: Shape,
        function: Any,
        vectorize: bool = False,
    ) -> dict[str, Reads]:
        """What a function reads of hidden variables, through deterministic nodes."""
        found: dict[str, Reads] = {}
        gathers = None
        for position, (parent, link) in enumerate(links):
            inner = self._behind(parent)
            if not inner:
                continue
            if link.foreign and gathers is None:
                gathers = {} if vectorize else self._gathers(links, shape, function)
            outer = _aligned(self.model[parent], link, plates, shape, (gathers or {}).get(position))
            for variable, reads in inner.items():
                step = outer if reads is None else outer.through(reads)
                found[variable] = found[variable].joined(step) if variable in found else step
        return {v: r for v, r in found.items() if r.columns != ()}

    def _behind(self, parent: str) -> Mapping[str, Reads | None]:
        """The hidden variables behind a parent; None for the parent itself."""
        if parent in self.hidden:
            return {parent: None}
        return self.computed.get(parent, {})

    def _gathers(
        self, links: tuple[tuple[str, Aligner], ...], shape: Shape, function: Any
    ) -> dict[int, list[tuple[np.ndarray, ...] | None]]:
        """For each argument with foreign plates the constant indices it is gathered by, None for others.

        The function is called once. Hidden values come with batch axes, known ones without, so an index
        without batch axes is the same whatever the hidden variables are.
        """
        try:
            values = self._values()
            arguments, _ = arguments_of(links, values)
            notes: dict[int, list[tuple[np.ndarray, ...] | None]] = {}
            for position, argument in enumerate(arguments):
                if isinstance(argument, PlateArray):
                    notes[position] = []
                    arguments[position] = _Noted(argument, notes[position], shape)
            with marking_invalid(), np.errstate(all="ignore"):
                function(*arguments)
        except Exception:
            return {}  # not known: every factor may read all
        return notes

    def _values(self) -> dict[str, np.ndarray]:
        """Reachable values: hidden ones with batch axes, known ones and what follows from them without."""
        if self._trial is None:
            values = {**self.model.probe, **self._known}
            with marking_invalid(), np.errstate(all="ignore"):
                for name, node in self.model.nodes.items():
                    if node.kind in ("deterministic", "fixed"):
                        values[name], _ = self.model.evaluate(name, values)
            self._trial = values
        return self._trial


def _aligned(
    parent: CompiledNode,
    link: Aligner,
    plates: tuple[str, ...],
    shape: Shape,
    gathers: list[tuple[np.ndarray, ...] | None] | None,
) -> Reads:
    """Which elements of a parent itself each factor reads."""
    if isinstance(link, RowAligner):
        return Reads((link.flat,))
    if not link.foreign:
        return Reads((_column(parent, plates, shape, ()),))
    if gathers is None or None in gathers:
        return Reads(None)
    found = Reads(())
    for keys in gathers:
        assert keys is not None
        by_plate = tuple(zip(link.foreign, keys, strict=True))
        found = found.joined(Reads((_column(parent, plates, shape, by_plate),)))
    return found


def _column(
    parent: CompiledNode,
    plates: tuple[str, ...],
    shape: Shape,
    gathered: tuple[tuple[str, np.ndarray], ...],
) -> np.ndarray:
    """Flat element of a parent for every factor: its own along shared plates, as gathered along others."""
    grid = dict(zip(plates, np.indices(shape, sparse=True), strict=True)) if plates else {}
    at = {**grid, **dict(gathered)}
    if not parent.plates:
        return np.zeros(math.prod(shape), dtype=np.intp)
    full = [np.broadcast_to(at[p], shape).ravel() for p in parent.plates]
    return np.ravel_multi_index(full, parent.plate_shape)


class _Noted(PlateArray):
    """A ``PlateArray`` that notes how it is used: constant indices of whole gathers, None for all else."""

    __slots__ = ("_inner", "_notes", "_shape")

    def __init__(self, inner: PlateArray, notes: list[Any], shape: Shape) -> None:
        self._inner, self._notes, self._shape = inner, notes, shape
        self.plates, self.own, self.event_ndim = inner.plates, inner.own, inner.event_ndim

    @property
    def array(self) -> np.ndarray:  # type: ignore[override]
        """The plain values; who takes them may read any element."""
        self._notes.append(None)
        return self._inner.array

    def _component(self, keys: tuple[Any, ...]) -> PlateArray:
        return _Noted(self._inner._component(keys), self._notes, self._shape)

    def _gather(self, keys: tuple[Any, ...]) -> Any:
        result = self._inner._gather(keys)
        constant = len(keys) == len(self.plates) and all(map(self._is_constant, keys))
        self._notes.append(tuple(np.asarray(k) for k in keys) if constant else None)
        return result

    def _is_constant(self, key: Any) -> bool:
        if isinstance(key, (PlateArray, slice)) or np.ndim(key) > len(self._shape):
            return False
        try:
            return np.broadcast_shapes(np.shape(key), self._shape) == self._shape
        except ValueError:
            return False
