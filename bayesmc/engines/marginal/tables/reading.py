"""What a slice says of the finite nodes that are integrated out, given the values of every particle.

As of exact filters (``engines.discrete``), but that particles stand where rows of a series do there: one call
of a function serves all particles and all states.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS, TIME, Row, Series, Slices
from bayesmc.engines.discrete.rows import Key, Rows, Term
from bayesmc.engines.discrete.terms import Read, SliceReader
from bayesmc.errors import UnsupportedError
from bayesmc.expression import Expression, Program
from bayesmc.shapes import padded
from bayesmc.structure.picked import picked_element


@dataclass(frozen=True, eq=False)
class Look:
    """What a density reads of the nodes that are integrated out, in slices of one kind.

    Attributes
    ----------
    term : Term
    foreign : frozenset of str
        Plates across which it reads elements.
    at : Expression or None
        The flat element that it reads, where it is one picked by values that are known; then ``term`` reads
        this element alone. Otherwise None.
    fault : str or None
        Why it cannot be summed over, to follow its name.
    """

    term: Term
    foreign: frozenset[str]
    at: Expression | None = None
    fault: str | None = None

    @property
    def names(self) -> frozenset[str]:
        """Nodes that are integrated out and that it reads."""
        return frozenset(n for _, n in (*self.term.alone, *self.term.whole))

    @property
    def reads_before(self) -> bool:
        """Whether it reads any of them in the slice before."""
        return any(lag for lag, _ in (*self.term.alone, *self.term.whole))


@dataclass(frozen=True, eq=False)
class ParticleRows(Rows):
    """One slice of all particles: they stand along the first batch axis.

    Attributes
    ----------
    row : Row
    known : dict
        Stored values by the names that functions of the slice have for them, with particles first or the same
        for all.
    own : frozenset of str
        Those with an axis of particles.
    particles : int
    """

    row: Row = Row(0, {}, {})
    known: Mapping[str, np.ndarray] = field(default_factory=dict)
    own: frozenset[str] = frozenset()
    particles: int = 1

    @property
    def count(self) -> int:
        return self.particles

    def observed(self, name: str, lag: int) -> tuple[np.ndarray, np.ndarray] | None:
        seen = self.row.seen.get(name)
        if seen is None or lag:
            return None
        ones = (1,) * self.ndim
        mask = np.ones((1,) * seen.value.ndim, dtype=bool) if seen.mask is None else seen.mask
        return seen.value.reshape(ones + seen.value.shape), mask.reshape(ones + mask.shape)

    def held(self, name: str, lag: int) -> np.ndarray | None:
        """A node's values where particles, or all of them, have some."""
        called = name + PREVIOUS * lag
        value = self.known.get(called)
        if value is None or called not in self.own:
            return value
        return value.reshape(len(value), *(1,) * (self.ndim - 1), *value.shape[1:])


def particle_rows(
    row: Row, known: Mapping[str, np.ndarray], own: frozenset[str], particles: int
) -> ParticleRows:
    """A row's slice, given values with an axis of particles (``own``) and others."""
    none = Series(1, {}, {})
    return ParticleRows(
        none, 0, 1, min(row.t, 2), row=row, known=known, own=own, particles=particles
    )


class TableReader(SliceReader):
    """Reads what densities say of finite nodes, for all particles at once.

    Parameters
    ----------
    slices : Slices
    apart : tuple of str
        Plates whose elements have tables of their own.
    variables : frozenset of str
        Nodes that are integrated out.
    static : dict
    """

    def __init__(
        self,
        slices: Slices,
        apart: tuple[str, ...],
        variables: frozenset[str],
        static: Mapping[str, np.ndarray],
    ) -> None:
        super().__init__(slices, apart, variables, static)
        self.dependent = dependent(slices, variables)
        self._places: dict[Expression, Program] = {}

    def look(self, name: str, kind: int) -> Look:
        """What a node's density reads of the variables."""
        found: dict[Key, bool] = {}
        reads: dict[Key, None] = {}
        foreign: set[str] = set()
        faults: list[str] = []
        clock = False

        def visit(name: str, lag: int, own: Sequence[str], whole: bool) -> None:
            nonlocal clock
            for parent, link in self.model(kind, lag)[name].links:
                stem, back = self.origin(parent, lag)
                if stem == TIME or stem in self.slices.template.inputs:
                    clock = True
                    continue
                if stem in self.static:
                    continue
                above = self.slices.first[stem]
                across = whole or any(p not in own for p in above.plates)
                if stem not in self.variables and stem not in self.dependent:
                    reads[back, stem] = None
                    if back > 1 or (back == 1 and stem not in self.slices.interface):
                        faults.append(f"depends on {stem!r} of the slice before, which is not kept")
                    continue
                foreign.update(link.foreign)
                if back > 1:
                    faults.append(f"depends on {stem!r} of two slices before")
                elif stem in self.variables:
                    found[back, stem] = found.get((back, stem), False) or across
                else:
                    visit(stem, back, above.plates, across)

        visit(name, 0, self.slices.first[name].plates, False)
        alone = tuple(k for k, is_whole in found.items() if not is_whole)
        across = tuple(k for k, is_whole in found.items() if is_whole)
        term = Term(name, kind, alone, across, tuple(reads), clock)
        return Look(term, frozenset(foreign), None, faults[0] if faults else None)

    def picked(self, look: Look) -> Look | None:
        """The same where it is proven to read one element picked by what is known; else None."""
        term = look.term
        names = [n for _, n in term.whole]
        plates = {self.slices.first[n].plates for n in names}
        if not names or term.alone or look.reads_before or len(plates) > 1:
            return None
        model = self.model(term.kind, 0)
        cut = [n for n in model.nodes if n.endswith(PREVIOUS) and not model[n].is_stochastic]
        at = picked_element(model, term.name, names, cut)
        if at is None or at.leaves & {*self.variables, *self.dependent}:
            return None
        if any(n.endswith(PREVIOUS) and n[: -len(PREVIOUS)] in self.variables for n in at.leaves):
            return None
        one = Term(term.name, term.kind, term.whole, (), term.reads, term.clock)
        return Look(one, frozenset(), at, look.fault)

    def place(self, at: Expression, rows: ParticleRows) -> np.ndarray:
        """The elements that are read, shape ``(particles or 1, *plates of the node)``."""
        program = self._places.get(at)
        if program is None:
            program = self._places[at] = Program([at])
        values = {n: rows.known[n] if n in rows.known else self.static[n] for n in at.leaves}
        (found,) = program(values)
        return np.asarray(padded(np.asarray(found), 1 + len(at.shape)))

    def value(self, rows: Rows, name: str, lag: int) -> np.ndarray:
        assert isinstance(rows, ParticleRows)
        if name in self.static:
            return self.static[name]
        if (lag, name) in rows.axes:
            return rows.axes[lag, name]
        found = rows.held(name, lag)
        if found is not None:
            return found
        if name in self.slices.first.nodes and self.slices.first[name].is_stochastic:
            raise UnsupportedError(f"node {name!r} is needed and has no value")
        model = self.model(rows.kind, lag)
        return np.asarray(model.evaluate(name, self._arguments(rows, model, name, lag))[0])

    def over_rows(self, term: Term, rows: Rows, read: Read) -> tuple[Any, ...]:
        """All particles in one call: functions broadcast over a batch, and the time is the same for all."""
        return read(term, rows)

    def tables(self, look: Look, rows: ParticleRows) -> tuple[np.ndarray, np.ndarray | None]:
        """Log densities of a picked element's states, and bad ones: ``(particles or 1, *cards, elements)``.

        Elements are those of the node that reads it.
        """
        log, bad = self._log_tables(look.term, rows)
        node = self.slices.first[look.term.name]
        cards = self.cards(look.term)

        def flat(array: np.ndarray) -> np.ndarray:
            lead = (len(padded(array, 1 + len(cards) + len(node.plates))), *cards)
            return np.broadcast_to(array, lead + node.plate_shape).reshape(
                *lead, math.prod(node.plate_shape)
            )

        return flat(log), None if bad is None else flat(bad)


def dependent(slices: Slices, names: frozenset[str]) -> frozenset[str]:
    """Computed nodes that depend on some nodes, in any slice."""
    found: set[str] = set()
    while True:
        more = {
            n
            for n in slices.dynamic
            if n not in found
            and not slices.first[n].is_stochastic
            and any(
                p.removesuffix(PREVIOUS) in names or p.removesuffix(PREVIOUS) in found
                for model in (slices.first, slices.later)
                for p in model[n].parents
            )
        }
        if not more:
            return frozenset(found)
        found |= more
