"""What depends on what in a template on a grid: sources of every node, leaves, memories, plates apart.

No values and no tables: sizes of tables can be told from here before any is made.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS, TIME, Slices
from bayesmc.engines.exact.exact import readable_bytes
from bayesmc.engines.grid.axes import Axes
from bayesmc.engines.slice_steps import plates_apart
from bayesmc.errors import ModelError
from bayesmc.network import CompiledNode

#: node (with ``_prev`` in the slice after its own), number of a scalar among the node's
Label = tuple[str, int]


@dataclass(frozen=True, eq=False)
class Sources:
    """What a node's function reads, through nodes that are computed on the way."""

    now: frozenset[str]
    before: frozenset[str]
    computed: frozenset[str]
    timed: bool


class GridStructure:
    """The nodes of a slice and what they depend on.

    Parameters
    ----------
    slices : Slices
    axes : Axes
    max_bytes : float
        What one table may take.
    logs : bool
        For the best path: axes for every hidden node that can have some. Else hidden nodes that nothing
        reads go without axes (they integrate to one).

    Raises
    ------
    ModelError
        A node moves without noise.
    """

    def __init__(self, slices: Slices, axes: Axes, max_bytes: float, logs: bool) -> None:
        self.slices, self.axes, self.max_bytes, self.logs = slices, axes, max_bytes, logs
        self.apart = plates_apart(slices)
        self.lead = tuple(slices.first.sizes[p] for p in self.apart)
        self.memory = _memories(slices)
        own = {*slices.stochastic, *self.memory}
        #: nodes that have axes where they are hidden, parents first
        self.own = tuple(n for n in slices.dynamic if n in own)
        self._sources: dict[tuple[bool, str], Sources] = {}
        self.leaves = self._leaves()

    def sources(self, first: bool, name: str) -> Sources:
        """What a node depends on."""
        key = (first, name)
        if key not in self._sources:
            self._sources[key] = self._read(first, name)
        return self._sources[key]

    def scope(self, first: bool, name: str, hidden: frozenset[str]) -> set[Label]:
        """Labels that a node's table has where these nodes are hidden."""
        sources = self.sources(first, name)
        found: set[Label] = set()
        for n in sources.now | {name}:
            if n in hidden:
                found.update((n, e) for e in range(self.elements(n)))
        for n in sources.before & hidden:
            found.update((n + PREVIOUS, e) for e in range(self.elements(n)))
        return found

    def elements(self, name: str) -> int:
        """Scalars of a node, apart from the plates that are filtered separately."""
        node = self.slices.first[name]
        plates = [
            n for p, n in zip(node.plates, node.plate_shape, strict=True) if p not in self.apart
        ]
        return math.prod(plates) * math.prod(node.event_shape)

    def places(self, node: CompiledNode) -> Iterator[tuple[Any, ...]]:
        """Where the elements of a node stand among its plates, those that are apart all at once."""
        sizes = zip(node.plates, node.plate_shape, strict=True)
        for at in np.ndindex(*(1 if p in self.apart else n for p, n in sizes)):
            yield tuple(
                slice(None) if p in self.apart else k for p, k in zip(node.plates, at, strict=True)
            )

    def apart_of(self, node: CompiledNode) -> tuple[str, ...]:
        """The plates of a node that are apart."""
        return tuple(p for p in node.plates if p in self.apart)

    def too_large(self, name: str, sizes: list[int], count: float) -> str:
        """What to say of a table that does not fit."""
        cells = " x ".join(map(str, sizes))
        return (
            f"GridFilter needs a table of {cells} cells for {name!r}, {readable_bytes(count)}, and "
            f"max_bytes is {readable_bytes(self.max_bytes)}; give fewer cells, as in grid={{{name!r}: (low, "
            "high, cells)}, raise max_bytes=, or use ParticleFilter(particles)"
        )

    # ---- private -------------------------------------------------------------------------------

    def _read(self, first: bool, name: str) -> Sources:
        slices = self.slices
        model = slices.first if first else slices.later
        static, timed = slices.template.static, False
        inputs = {*slices.template.inputs, TIME}
        now, before, computed = set(), set(), set()
        todo = list(model[name].parents)
        while todo:
            parent = todo.pop()
            stem = parent.removesuffix(PREVIOUS)
            if parent in self.own:
                now.add(parent)
            elif parent in slices.dynamic:
                if parent not in computed:
                    computed.add(parent)
                    todo += model[parent].parents
            elif parent in static:
                continue
            elif parent in inputs or stem in inputs:
                timed = True
            elif stem in self.own:
                before.add(stem)
            else:  # a value computed in the slice before
                for was in (True, False):
                    carried = self.sources(was, stem)
                    before |= carried.now
                    timed |= carried.timed
        return Sources(frozenset(now), frozenset(before), frozenset(computed), timed)

    def _leaves(self) -> frozenset[str]:
        """Nodes that nothing random and no later slice reads: hidden, they integrate to one.

        Finite ones that computed nodes read are none: their axes cost little, and those are answered for.
        """
        read = {n for n in self.slices.interface if n in self.own} | {*self.memory}
        for first in (True, False):
            for name in self.own:
                read |= self.sources(first, name).now
            for name in self.slices.interface:
                if name not in self.own:
                    read |= self.sources(first, name).now
            for name in self.slices.dynamic:
                if name not in self.own:
                    now = self.sources(first, name).now
                    read |= {n for n in now if self.slices.first[n].domain is not None}
        free = [n for n in self.own if n not in read and n not in self.axes.asked]
        return frozenset(n for n in free if not self.logs or n not in self.axes.of)


def is_previous(label: Label) -> bool:
    """Whether an axis is one of the slice before."""
    return label[0].endswith(PREVIOUS)


def previous(label: Label) -> Label:
    """What a scalar's axis is called in the slice after."""
    return (label[0] + PREVIOUS, label[1])


# ---- private ------------------------------------------------------------------------------------


def _memories(slices: Slices) -> frozenset[str]:
    """Deterministic nodes that carry something over from the slice before; they must be finite."""
    template = slices.template
    dynamic = [n for n in slices.dynamic if not slices.later[n].is_stochastic]
    carrying: set[str] = set()
    for name in dynamic:
        parents = slices.later[name].parents
        stems = {p.removesuffix(PREVIOUS) for p in parents if p.endswith(PREVIOUS)}
        random = {s for s in stems if s in slices.dynamic}
        if random or carrying & set(parents):
            carrying.add(name)
    found = carrying & set(template.interface)
    for name in sorted(found):
        domains = [m[name].domain for m in (slices.first, slices.later)]
        states = [None if d is None else d.states for d in domains]
        if states[0] is None or states[0] != states[1]:
            raise ModelError(
                f"GridFilter: {name!r} is computed from the slice before and read by the next, so it is a "
                "state that moves without noise and has no density; give it a narrow distribution, or let "
                "the particle filter carry it"
            )
    return frozenset(found)
