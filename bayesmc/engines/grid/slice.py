"""A slice on a grid: which scalars are hidden, where they stand, and values that run over all of them.

A *scalar* is one component of one plate element of a node; each hidden one has a batch axis of its own, those
of the slice before first, so that one call of a node's function fills its table. Plates whose elements never
meet are no scalars: they stay axes of the values, of size one where all their elements agree.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS, Row, Slices, with_computed
from bayesmc.engines.grid.axes import Axes
from bayesmc.engines.grid.sources import GridStructure, Label, previous
from bayesmc.errors import BayesmcError, UnsupportedError
from bayesmc.factors.named import Named, aligned
from bayesmc.network import CompiledNode
from bayesmc.shapes import Shape

Values = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Scalar:
    """A hidden number and the points it can be at, each of shape ``(n, *apart)`` (or ones)."""

    label: Label
    points: np.ndarray
    widths: np.ndarray

    @property
    def size(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class Placed:
    """What stands where in a slice.

    Attributes
    ----------
    row : Row
    scalars : tuple of Scalar
        One for every batch axis of ``values``.
    values : dict
        Node -> stored values, ``(*batch, *plates, *event)``; no batch axes where seen.
    """

    row: Row
    scalars: tuple[Scalar, ...]
    values: Values

    @property
    def labels(self) -> tuple[Label, ...]:
        return tuple(s.label for s in self.scalars)

    @property
    def shape(self) -> Shape:
        return tuple(s.size for s in self.scalars)

    def axis(self, name: str) -> int | None:
        """The axis of a node of one number; None where it has none."""
        return next((k for k, s in enumerate(self.scalars) if s.label[0] == name), None)

    def marginal(self, probs: np.ndarray, axis: int) -> np.ndarray:
        """Probabilities ``(*cells, *apart)`` summed over all cells but those along one axis."""
        return probs.sum(axis=tuple(k for k in range(len(self.scalars)) if k != axis))


def sizes_by_label(before: Placed | None, now: Placed) -> dict[Label, int]:
    """How many points every hidden number has, in the order of the axes: of the slice before, and of this."""
    was = {} if before is None else {previous(s.label): s.size for s in before.scalars}
    return was | {s.label: s.size for s in now.scalars}


def same_points(one: Placed, other: Placed) -> bool:
    """Whether two slices have the same hidden numbers at the same points."""
    return one.labels == other.labels and all(
        np.array_equal(a.points, b.points) and np.array_equal(a.widths, b.widths)
        for a, b in zip(one.scalars, other.scalars, strict=True)
    )


class GridSlices(GridStructure):
    """Places the scalars of slices and evaluates nodes on them.

    Parameters
    ----------
    slices, axes, max_bytes, logs
        See ``GridStructure``.
    static : dict
        Stored values of static nodes that have a density.
    """

    def __init__(
        self,
        slices: Slices,
        axes: Axes,
        static: Mapping[str, np.ndarray],
        max_bytes: float,
        logs: bool = False,
    ) -> None:
        super().__init__(slices, axes, max_bytes, logs)
        self.static = with_computed(slices, static)
        self._whole: set[tuple[bool, str]] = set()
        self._open: dict[tuple[bool, str], list[tuple[int, tuple[Any, ...], Any]]] = {}
        self._spread: dict[tuple[bool, str, tuple[Label, ...]], np.ndarray] = {}

    def place(self, row: Row) -> Placed:
        """The scalars of a slice, and values that run over them.

        Raises
        ------
        UnsupportedError
            A hidden node has no grid.
        """
        model, values = self.slices.model(row.t), {}
        open_, scalars = [], []
        for name in self.own:
            seen = row.seen.get(name)
            if seen is not None and (seen.mask is None or name in self.leaves):
                values[name] = seen.value
            elif name not in self.leaves:
                if name not in self.axes.of:
                    raise UnsupportedError(f"GridFilter: {self.axes.missing[name]}")
                known = (row.t == 0, name)
                if seen is None and known not in self._open:
                    self._open[known] = list(self._scalars(model[name], row))
                mine = self._open[known] if seen is None else list(self._scalars(model[name], row))
                open_.append((model[name], mine))
                scalars += [s for _, _, s in mine if isinstance(s, Scalar)]
        order = {s.label: k for k, s in enumerate(scalars)}
        labels = tuple(order)
        for node, mine in open_:
            key = (row.t == 0, node.name, labels)
            if node.name in row.seen:
                values[node.name] = self._filled(node, mine, order)
                continue
            if key not in self._spread:
                self._spread[key] = self._filled(node, mine, order)
            values[node.name] = self._spread[key]
        placed = Placed(row, tuple(scalars), values)
        base = self.base(None, placed)
        for name in self.slices.interface:
            if name not in values and name not in self.leaves:
                values[name] = self.computed(row.t == 0, name, base)
        return placed

    def base(self, before: Placed | None, now: Placed) -> Values:
        """All values in place, with batch axes of the slice before and of this one."""
        found = {**self.static, **now.row.inputs, **now.values}
        for name in self.slices.interface if before is not None else ():
            assert before is not None
            value = before.values[name]
            trailing = len(self.slices.first[name].value_shape)
            lead = value.ndim - trailing
            if lead:
                ones = (1,) * len(now.scalars)
                value = value.reshape(value.shape[:lead] + ones + value.shape[lead:])
            found[name + PREVIOUS] = value
        return found

    def computed(self, first: bool, name: str, base: Values) -> np.ndarray:
        """The value of a deterministic node."""
        base = self._with_computed(first, name, base)
        return base[name] if name in base else self._evaluate(first, name, base)

    def evaluate(self, first: bool, name: str, base: Values) -> Any:
        """A node's distribution on the whole grid."""
        return self._evaluate(first, name, self._with_computed(first, name, base))

    # ---- private: scalars -------------------------------------------------------------------

    def _scalars(
        self, node: CompiledNode, row: Row
    ) -> Iterator[tuple[int, tuple[Any, ...], Scalar | np.ndarray]]:
        """Every element of a node: number, index, and its scalar, or its value where it is seen."""
        seen = row.seen.get(node.name)
        axes = self.axes.of[node.name]
        events = math.prod(node.event_shape)
        number = 0
        for at in self.places(node):
            mask = None if seen is None or seen.mask is None else self._turned(seen.mask[at], node)
            for k, event in enumerate(np.ndindex(*node.event_shape)):
                axis = axes[k % events]
                ones = (1,) * len(self.apart)
                points = axis.points.reshape(-1, *ones)
                widths = axis.widths.reshape(-1, *ones)
                label = (node.name, number)
                index = (*at, *event)
                number += 1
                if mask is None or not mask.any():
                    yield number, index, Scalar(label, points, widths)
                    continue
                assert seen is not None
                value = self._turned(seen.value[index], node)
                if mask.all():
                    yield number, index, value
                    continue
                # where it is seen, the first point is what was seen and the others count nothing
                unit = (np.arange(axis.size) == 0).astype(float).reshape(-1, *ones)
                points = np.where(mask, value, points)
                yield number, index, Scalar(label, points, np.where(mask, unit, widths))

    def _turned(self, part: np.ndarray, node: CompiledNode) -> np.ndarray:
        """An array over a node's plates that are apart, with these in the common order."""
        return aligned(Named(self.apart_of(node), np.asarray(part)), self.apart)

    def _filled(
        self,
        node: CompiledNode,
        mine: list[tuple[int, tuple[Any, ...], Any]],
        order: Mapping[Label, int],
    ) -> np.ndarray:
        """A hidden node's values along the batch axes of its scalars."""
        parts = []
        for _, index, found in mine:
            if isinstance(found, Scalar):
                lead = [1] * len(order)
                lead[order[found.label]] = found.size
                part = found.points.reshape(*lead, *found.points.shape[1:])
            else:
                part = found.reshape((1,) * len(order) + found.shape)
            parts.append((index, aligned(Named(self.apart, part), self.apart_of(node))))
        shape = np.broadcast_shapes(*(part.shape for _, part in parts))
        batch, wide = shape[: len(order)], iter(shape[len(order) :])
        plates = [
            next(wide) if p in self.apart else n
            for p, n in zip(node.plates, node.plate_shape, strict=True)
        ]
        kind = (
            node.domain.dtype if node.domain is not None else np.result_type(*(p for _, p in parts))
        )
        out = np.empty((*batch, *plates, *node.event_shape), dtype=kind)
        for index, part in parts:
            out[(..., *index)] = part
        out.flags.writeable = False
        return out

    # ---- private: values --------------------------------------------------------------------

    def _with_computed(self, first: bool, name: str, base: Values) -> Values:
        needed = self.sources(first, name).computed
        found = dict(base)
        for n in self.slices.dynamic:
            if n in needed and n not in found:
                found[n] = self._evaluate(first, n, found)
        return found

    def _evaluate(self, first: bool, name: str, base: Values) -> Any:
        """A distribution or value; plates that are apart have size one where their elements agree."""
        model = self.slices.first if first else self.slices.later
        if not self.apart:
            return model.evaluate(name, base)[0]
        if (first, name) not in self._whole:
            try:
                return self._narrowed(model[name], model.evaluate(name, base)[0])
            except BayesmcError:  # a function that counts on the size of a plate
                self._whole.add((first, name))
        wide = {p: _widened(model[p], base[p]) for p in model[name].parents}
        return self._narrowed(model[name], model.evaluate(name, {**base, **wide})[0])

    def _narrowed(self, node: CompiledNode, value: Any) -> Any:
        if not isinstance(value, np.ndarray):
            return value
        lead = value.ndim - len(node.value_shape)
        for k, plate in enumerate(node.plates):
            if plate in self.apart and value.strides[lead + k] == 0:
                value = value[(slice(None),) * (lead + k) + (slice(0, 1),)]
        return value


# ---- private ------------------------------------------------------------------------------------


def _widened(node: CompiledNode, value: np.ndarray) -> np.ndarray:
    lead = value.shape[: value.ndim - len(node.value_shape)]
    return np.broadcast_to(value, lead + node.value_shape)
