"""What of a node moves when, along what line, within what bounds: for kernels that go number by number."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions.support import Support, is_half_line
from bayesmc.distributions.transforms import Transform
from bayesmc.lowering import Turns
from bayesmc.shapes import Shape
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Values


@dataclass(frozen=True, eq=False)
class Line:
    """What one component moves along: its numbers, their logs, an angle, or the cells of integers.

    Attributes
    ----------
    start, end : ndarray
        Bounds of the numbers; a density may be infinite there, which rounding can reach.
    here : ndarray
        Where it is, which is taken in place of numbers that are not inside.
    """

    is_integer: bool
    on_logs: bool
    circle: Transform | None
    start: Any
    end: Any
    here: np.ndarray

    def value(self, at: np.ndarray) -> np.ndarray:
        """The component's value at places along the line."""
        if self.is_integer:
            return np.floor(at)
        if self.on_logs:
            return self.start + np.exp(at)
        # what depends on an angle need not repeat itself beyond the cut
        return at if self.circle is None else self.circle.constrain(at)

    def candidate(self, at: np.ndarray, dtype: np.dtype) -> tuple[np.ndarray, Any]:
        """The value to be tried at places, and what its log density lacks there, if anything."""
        found = self.value(at)
        if self.is_integer:
            return found.astype(dtype), None
        inside = (found > self.start) & (found < self.end)
        volume = np.where(inside, at if self.on_logs else 0.0, -np.inf)
        return np.where(inside, found, self.here), volume


class Sites:
    """The numbers of a node: classes of elements in turn, components of a vector one after the other.

    Parameters
    ----------
    blanket : Blanket
    components : sequence of tuple of int
        In the order in which they move.
    """

    def __init__(self, blanket: Blanket, components: Sequence[tuple[int, ...]]) -> None:
        self.blanket, self.components = blanket, tuple(components)

    @property
    def is_integer(self) -> bool:
        return self.blanket.node.is_discrete

    @property
    def on_logs(self) -> bool:
        """Whether it is above a bound: scales differ by factors."""
        support = self.blanket.node.support
        return support is not None and is_half_line(support)

    def turns(self) -> Iterator[tuple[np.ndarray | None, tuple[int, ...]]]:
        """What moves after what: members of a class, and their component."""
        for members in self.blanket.classes:
            for component in self.components:
                yield members, component

    def turns_in_machine_code(self, growth: int) -> Turns:
        """The same for machine code; intervals grow by so many widths but on a circle."""
        turns, shape = list(self.turns()), self.blanket.event_shape
        everything, size = np.arange(self.blanket.size), math.prod(shape)
        elements = [everything if members is None else members for members, _ in turns]
        components = [int(np.ravel_multi_index(c, shape)) if c else 0 for _, c in turns]
        places = [at * size + c for at, c in zip(elements, components, strict=True)]
        lines = [self._line(component) for _, component in turns]
        return Turns(places, elements, lines, [0 if x == "circle" else growth for x in lines])

    def lead(self, values: Values) -> Shape:
        """The axes of the node's value before its plates."""
        shape = values[self.blanket.name].shape
        return shape[: len(shape) - len(self.blanket.node.value_shape)]

    def intervals(
        self, values: Values, width: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Widths and bounds of all numbers, in the order in which they move, each (chains, numbers).

        Members of a group of like nodes (``structure.stacked``) are chains, too.
        """
        lead = self.lead(values)
        found: list[list[np.ndarray]] = [[], [], []]
        for members, component in self.turns():
            at: Any = (Ellipsis, *component)
            own = width[at]
            support = self.support(values, component)
            if support.kind == "circle":
                own = np.full(own.shape, 2 * np.pi)
            ndim = len(self.blanket.node.plates)
            if members is not None:
                own, ndim = own.ravel()[members], 1
            for part, what in zip(found, (own, *self.bounds(support, members)), strict=True):
                wide = np.broadcast_to(what, (*lead, *own.shape[own.ndim - ndim :]))
                part.append(wide.reshape(math.prod(lead), -1))
        joined = [p[0] if len(p) == 1 else np.concatenate(p, axis=1) for p in found]
        widths, low, high = (np.ascontiguousarray(a, float) for a in joined)
        return widths, low, high

    def support(self, values: Values, component: tuple[int, ...]) -> Support:
        """Where one component may lie, given the parents."""
        blanket = self.blanket
        support = blanket.node.support
        if support is None:  # it depends on them
            assert blanket.own is not None
            support = blanket.own.distribution(values)[0].support
        assert support is not None
        return _part(support, component[0]) if support.kind == "product" else support

    def bounds(self, support: Support, members: np.ndarray | None) -> tuple[Any, Any]:
        """Bounds of a support, broadcasting to ``(chains, *plates)`` or the class."""
        blanket = self.blanket
        if support.kind not in ("interval", "integers"):
            return -np.inf, np.inf
        ends = []
        for end in (support.low, support.high):
            end = np.asarray(end, dtype=float)
            if members is not None and end.ndim:
                lead = end.shape[: max(end.ndim - len(blanket.node.plates), 0)]
                end = np.broadcast_to(end, lead + blanket.node.plate_shape)
                end = end.reshape(*lead, -1)[..., members]
            ends.append(end)
        return ends[0], ends[1]

    # ---- private -------------------------------------------------------------------------------

    def _line(self, component: tuple[int, ...]) -> str:
        """Along what one component moves."""
        target = self.blanket.target
        kind = self.support({**target.model.probe, **target.known}, component).kind
        if kind == "circle":
            return kind
        return "integer" if self.is_integer else ("logs" if self.on_logs else "real")


# ---- private ------------------------------------------------------------------------------------


def _part(support: Support, component: int) -> Support:
    """The support of one component of a product."""
    for part, size in support.parts:
        component -= max(size, 1)
        if component < 0:
            return part
    raise AssertionError("a product has a part for every component")
