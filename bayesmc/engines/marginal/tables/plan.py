"""Which finite nodes have tables together, what one table is about, and why some nodes cannot have one.

Nodes that some density connects have a table of their joint states. Plates that all of them live in, and
across which no density reads, leave a table for each element; a density that reads one element picked by
known values does not read across.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bayesmc.dbn import PREVIOUS, Slices
from bayesmc.engines.discrete.rows import Variable
from bayesmc.engines.marginal.tables.reading import Look, TableReader
from bayesmc.engines.slice_steps import plates_apart
from bayesmc.factors.named import connected

#: joint states of one table, and numbers that a particle has in one slice: up to which nodes that are named
#: are integrated out, and up to which "auto" does so
MOST_STATES, MOST_NUMBERS = 1024, 1 << 14
AUTO_STATES, AUTO_NUMBERS = 256, 1 << 10


@dataclass(frozen=True, eq=False)
class Group:
    """Finite nodes that have a table together, one for each element of some plates.

    Attributes
    ----------
    names : tuple of str
    plates : tuple of str
        Whose elements have tables of their own; those that are filtered separately come first.
    lead : tuple of int
        Their sizes.
    node_plates, inner : dict
        Node -> its plates, and sizes of those that are not among them.
    cards : dict
        Node -> its states.
    """

    names: tuple[str, ...]
    plates: tuple[str, ...]
    lead: tuple[int, ...]
    node_plates: Mapping[str, tuple[str, ...]]
    inner: Mapping[str, tuple[int, ...]]
    cards: Mapping[str, int]

    @property
    def elements(self) -> int:
        """How many tables there are."""
        return math.prod(self.lead)

    @property
    def variables(self) -> tuple[tuple[str, int], ...]:
        """Node and element that each axis of a table is about."""
        return tuple((n, e) for n in self.names for e in range(math.prod(self.inner[n])))

    @property
    def sizes(self) -> tuple[int, ...]:
        """Lengths of these axes."""
        return tuple(self.cards[n] for n, _ in self.variables)

    @property
    def states(self) -> int:
        """Joint states of one table."""
        return math.prod(self.sizes)

    def scope(self, lag: int) -> tuple[Variable, ...]:
        """The axes as variables of a slice, or of the one before."""
        return tuple((lag, n, e) for n, e in self.variables)

    def probabilities(self, tables: np.ndarray, name: str) -> np.ndarray:
        """Of a node's states, ``(particles, *plates, states)``, by tables of all joint states."""
        n = len(tables)
        whole = tables.reshape(n * self.elements, *self.sizes)
        parts = []
        for axis, (other, _) in enumerate(self.variables):
            if other == name:
                gone = tuple(1 + k for k in range(len(self.sizes)) if k != axis)
                parts.append(whole.sum(axis=gone) if gone else whole)
        return self.placed(np.stack(parts, axis=1), name, n)

    def values(self, codes: np.ndarray, name: str) -> np.ndarray:
        """A node's stored values by joint states ``(particles, elements)``: ``(particles, *plates)``."""
        found = np.unravel_index(codes.reshape(-1), self.sizes)
        own = [k for k, (n, _) in enumerate(self.variables) if n == name]
        return self.placed(np.stack([found[k] for k in own], axis=1), name, len(codes))

    def placed(self, array: np.ndarray, name: str, n: int) -> np.ndarray:
        """Figures ``(particles * elements, node's elements, *rest)`` as ``(particles, *plates, *rest)``."""
        rest = array.shape[2:]
        found = array.reshape(n, *self.lead, *self.inner[name], *rest)
        plates = self.node_plates[name]
        now = [*self.plates, *(p for p in plates if p not in self.plates)]
        order = [1 + now.index(p) for p in plates]
        return found.transpose(0, *order, *range(1 + len(plates), found.ndim))

    def flat(self, name: str) -> np.ndarray:
        """Of each flat element of a node's plates, all of which have tables, the number of its table."""
        plates = self.node_plates[name]
        numbers = np.arange(self.elements).reshape(self.lead)
        return numbers.transpose([self.plates.index(p) for p in plates]).reshape(-1)


class Fault(NamedTuple):
    """Why some nodes cannot be integrated out together.

    Attributes
    ----------
    nodes : tuple of str
        Without any of which there may be no fault.
    reason : str
        A sentence.
    is_size : bool
        Tables would be too large.
    is_filtered : bool
        A Kalman filter takes in what depends on them.
    """

    nodes: tuple[str, ...]
    reason: str
    is_size: bool = False
    is_filtered: bool = False


@dataclass(frozen=True, eq=False)
class TablePlan:
    """Finite nodes that are integrated out.

    Attributes
    ----------
    names : frozenset of str
    groups : tuple of Group
    readers : tuple of TableReader
        Of each group.
    looks : dict
        Group, node and kind of slice -> what the node's density reads of the group.
    below : frozenset of str
        Nodes with a density that depend on them, and are not integrated out.
    computed : frozenset of str
        Computed nodes that do, or are told once these are.
    """

    names: frozenset[str]
    groups: tuple[Group, ...]
    readers: tuple[TableReader, ...]
    looks: Mapping[tuple[int, str, int], Look]
    below: frozenset[str]
    computed: frozenset[str]

    @property
    def hidden(self) -> frozenset[str]:
        """Nodes that particles have no value of before these are drawn."""
        return self.names | self.computed

    def told(self, is_first: bool) -> frozenset[str]:
        """Nodes whose densities these tables take in, in slice 0 or in others."""
        return frozenset(n for _, n, kind in self.looks if (kind == 0) == is_first)

    @property
    def joint(self) -> float:
        """Joint states of all nodes that are integrated out, in bits."""
        return sum(g.elements * math.log2(max(g.states, 1)) for g in self.groups)

    @property
    def largest(self) -> tuple[float, float]:
        """Joint states of the largest table, and those of all."""
        sizes = [float(g.states) for g in self.groups]
        return max(sizes, default=1.0), sum(sizes)


def planned(
    slices: Slices,
    names: Collection[str],
    seen: Collection[str],
    apart_from: Collection[str],
    static: Mapping[str, np.ndarray],
    limits: tuple[int, int],
) -> TablePlan | Fault:
    """How some finite nodes are integrated out together.

    Parameters
    ----------
    names : collection of str
        Finite hidden nodes.
    seen : collection of str
        Nodes that are seen in full in every slice.
    apart_from : collection of str
        Nodes that others integrate out, or weigh.
    static : dict
    limits : tuple of int
        Joint states of a table, and numbers of a particle.
    """
    variables = frozenset(names)
    apart = plates_apart(slices)
    reader = TableReader(slices, apart, variables, static)
    looks = {(n, k): reader.look(n, k) for n in slices.stochastic for k in (0, 1, 2)}
    reading = [n for n in slices.stochastic if any(looks[n, k].names for k in (0, 1, 2))]
    fault = _fault(slices, variables, reader, looks, reading, seen, apart_from)
    if fault is not None:
        return fault
    for (name, kind), look in looks.items():
        if name not in variables and look.term.whole:
            looks[name, kind] = reader.picked(look) or look
    while True:
        groups = _groups(slices, variables, looks, apart)
        across = [
            key
            for key, look in looks.items()
            if look.at is not None and not _is_whole(slices, groups, look)
        ]
        if not across:
            break
        for key in across:  # what is picked is one of several elements of a table
            looks[key] = reader.look(*key)
    for group in groups:
        fault = _too_large(group, looks, limits)
        if fault is not None:
            return fault
    readers = tuple(TableReader(slices, g.plates, frozenset(g.names), static) for g in groups)
    for own in readers:
        own.dependent = reader.dependent
    found = {}
    for k, group in enumerate(groups):
        for name in slices.stochastic:
            read = [looks[name, kind].names & set(group.names) for kind in (0, 1, 2)]
            for kind in (0, 1, 2):
                told = read[0] if kind == 0 else read[1] | read[2]
                if name in group.names or told:
                    found[k, name, kind] = looks[name, kind]
    below = frozenset(n for n in reading if n not in variables)
    waiting = reader.dependent | _ends_below(slices, below)
    return TablePlan(variables, tuple(groups), readers, found, below, waiting)


def nodes_read(slices: Slices) -> frozenset[str]:
    """Nodes that some density reads, through computed nodes or not."""
    found: set[str] = set()
    todo = list(slices.stochastic)
    met = set(todo)
    while todo:
        name = todo.pop()
        for model in (slices.first, slices.later):
            for parent in model[name].parents:
                stem = parent.removesuffix(PREVIOUS)
                if stem not in slices.dynamic:
                    continue
                found.add(stem)
                if stem not in met and not slices.first[stem].is_stochastic:
                    met.add(stem)
                    todo.append(stem)
    return frozenset(found)


# ---- private ------------------------------------------------------------------------------------


def _fault(
    slices: Slices,
    variables: frozenset[str],
    reader: TableReader,
    looks: Mapping[tuple[str, int], Look],
    reading: Iterable[str],
    seen: Collection[str],
    apart_from: Collection[str],
) -> Fault | None:
    """Why what depends on some nodes forbids that they are integrated out."""
    read = nodes_read(slices)
    for name in reading:
        own = {n for k in (0, 1, 2) for n in looks[name, k].names} - {name}
        others = tuple(n for n in slices.dynamic if n in own)
        for kind in (0, 1, 2):
            fault = looks[name, kind].fault
            if fault is not None:
                own_too = (name,) if name in variables else ()
                return Fault((*others, *own_too), f"node {name!r} {fault}")
        if name in variables:
            continue
        if name in apart_from:
            reason = f"{name!r} depends on it, and a Kalman filter takes it in"
            return Fault(others, reason, is_filtered=True)
        if name not in seen and name in read:
            return Fault(others, f"{name!r}, which is sampled, depends on it")
    for (
        name
    ) in slices.dynamic:  # what is computed, or missing, is worked out from a draw of two slices
        if name in reader.dependent or (name in reading and name not in seen):
            for kind in (0, 1, 2):
                fault = reader.look(name, kind).fault
                if fault is not None:
                    every = tuple(n for n in slices.dynamic if n in variables)
                    return Fault(every, f"node {name!r} {fault}")
    return None


def _ends_below(slices: Slices, below: frozenset[str]) -> frozenset[str]:
    """Nodes computed from some others in a slice that no density and no later slice needs: they can wait."""
    found: set[str] = set()
    needed = {*nodes_read(slices), *slices.interface}
    for name in slices.dynamic:
        parents = {*slices.first[name].parents, *slices.later[name].parents}
        if (
            not slices.first[name].is_stochastic
            and name not in needed
            and parents & (below | found)
        ):
            found.add(name)
    return frozenset(found)


def _groups(
    slices: Slices,
    variables: frozenset[str],
    looks: Mapping[tuple[str, int], Look],
    apart: tuple[str, ...],
) -> list[Group]:
    """Nodes that densities connect, and the plates whose elements have tables of their own."""
    scopes = []
    for (name, _), look in looks.items():
        own = (name,) if name in variables else ()
        scopes.append((*own, *sorted(look.names)))
    order = [n for n in slices.dynamic if n in variables]
    found = []
    for names in connected(order, [s for s in scopes if s]):
        across = {
            p
            for (name, _), look in looks.items()
            if name in names or look.names & set(names)
            for p in look.foreign
        }
        nodes = [slices.first[n] for n in names]
        shared = [p for p in nodes[0].plates if all(p in node.plates for node in nodes)]
        plates = [p for p in shared if p not in across]
        plates = [*(p for p in apart if p in plates), *(p for p in plates if p not in apart)]
        sizes = slices.first.sizes
        found.append(
            Group(
                tuple(names),
                tuple(plates),
                tuple(sizes[p] for p in plates),
                {n.name: n.plates for n in nodes},
                {n.name: tuple(sizes[p] for p in n.plates if p not in plates) for n in nodes},
                {n.name: n.domain.size for n in nodes if n.domain is not None},
            )
        )
    return found


def _is_whole(slices: Slices, groups: Iterable[Group], look: Look) -> bool:
    """Whether every element of the nodes that are picked from has a table of its own."""
    group = next(g for g in groups if look.names & set(g.names))
    return all(set(slices.first[n].plates) <= set(group.plates) for n in look.names)


def _too_large(
    group: Group, looks: Mapping[tuple[str, int], Look], limits: tuple[int, int]
) -> Fault | None:
    most, numbers = limits
    states = math.prod(map(float, group.sizes))
    what = ", ".join(map(repr, group.names))
    if states > most:
        of = "one table of the joint states of" if len(group.variables) > 1 else "a table of"
        reason = f"{of} {what} would have {states:.3g} entries, more than {most}"
        return Fault(group.names, reason, True)
    moves = any(
        look.reads_before and look.term.reads
        for (name, kind), look in looks.items()
        if kind and (name in group.names or look.names & set(group.names))
    )
    each = group.elements * states * (states if moves else 1.0)
    if each > numbers:
        reason = (
            f"tables of {what} would be {each:.3g} numbers for each particle, more than {numbers}"
        )
        return Fault(group.names, reason, True)
    return None
