"""One slice as a forward pass: sample what is hidden, weight by what is seen, in topological order.

The same steps serve every row with the same nodes seen: what was seen is put among the values, and inputs
and the slice before, too, so nothing is built anew from slice to slice. Finite nodes become tables where
their functions do not read the time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Set
from types import MappingProxyType
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS, TIME, Row, Slices, undrawn, with_computed
from bayesmc.distributions import Distribution
from bayesmc.engines.forward import TableDraw, TableWeigh, table_of
from bayesmc.engines.proposal import FUNCTION, as_function, bound
from bayesmc.engines.proposing import proposal_steps
from bayesmc.engines.slice_program import whole_slice
from bayesmc.errors import ModelError, UnknownNodeError
from bayesmc.kernels.proposal import Key, Proposal, names_of
from bayesmc.network import CompiledNode, Model, Observed
from bayesmc.network.forward import (
    Compute,
    Draw,
    DrawAndWeigh,
    Pass,
    Step,
    WeighDrawn,
    current_distribution,
    nothing,
    summed,
)
from bayesmc.shapes import read_only
from bayesmc.structure import Table

#: numbers of a node that nothing reads that count as one
_WIDE = 64


class SlicePlan:
    """Steps of the slices of a template, by which nodes are seen.

    Parameters
    ----------
    slices : Slices
    apart : tuple of str
        Plates whose elements have weights of their own; all weights have shape ``(*batch, *apart)``.
    static : dict
        Values of the static nodes.
    """

    def __init__(
        self,
        slices: Slices,
        apart: tuple[str, ...],
        static: Mapping[str, np.ndarray],
        proposals: SliceProposals | None = None,
    ) -> None:
        self.slices, self.apart = slices, apart
        self.static = with_computed(slices, static)
        self.proposals = proposals
        #: whether densities that can be followed are read, which takes milliseconds, to be evaluated together
        self.is_read = False
        self._kept: dict[Any, list[Step]] = {}
        self._undrawn = undrawn(slices)
        self._tables: dict[tuple[bool, str], Table | None] = {}

    @property
    def guided(self) -> bool:
        """Whether anything is drawn with a look at the row."""
        asked = self.proposals
        return asked is not None and bool(asked.first or asked.later)

    def steps(self, row: Row) -> list[Step]:
        """The steps of a row's slice."""
        for seen in row.seen.values():
            if seen.mask is not None:
                return self._build(row)
        key = (row.t == 0, *row.seen)
        found = self._kept.get(key)
        if found is None:
            found = self._kept[key] = self._build(row)
        return found

    def known(self, row: Row) -> dict[str, np.ndarray]:
        """Values in place before a slice is passed, but for the slice before."""
        found = {**self.static, **row.inputs}
        for name, seen in row.seen.items():
            found[name] = seen.value
        return found

    def step(self, row: Row, name: str) -> Step:
        """The step of one node."""
        model = self.slices.model(row.t)
        node = model[name]
        seen = row.seen.get(name)
        if not node.is_stochastic:
            return Compute(model, node)
        table = self._table(row.t == 0, name)
        if table is not None and table.invalid is not None:
            table = None  # its function says at which particle
        if name in self._undrawn:
            if seen is None:
                return Unknown(node)
            if seen.mask is not None:
                return WeighSeen(model, node, seen, self.apart)
        if seen is None:
            if table is not None:
                return TableDraw(node, table)
            return quickly(model, node, QuickDraw, Draw(model, node))
        if seen.mask is not None:
            return DrawAndWeigh(model, node, seen, self.apart)
        return self.factor(row, name)

    def factor(self, row: Row, name: str) -> Step:
        """The density of one node, whose value is in place in full, as a factor of the weight."""
        model = self.slices.model(row.t)
        table = self._table(row.t == 0, name)
        if table is None or table.invalid is not None:
            return quickly(
                model, model[name], QuickWeigh, WeighDrawn(model, model[name], self.apart)
            )
        return TableWeigh(model[name], table, apart=self.apart)

    def _build(self, row: Row) -> list[Step]:
        model = self.slices.model(row.t)
        order = [n for n in model.nodes if n in self.slices.dynamic]  # slice 0 may have its own
        plain = {name: self.step(row, name) for name in order}
        asked = [] if self.proposals is None else self.proposals.of(row)
        if not asked:
            steps = list(plain.values())
            if self.is_read and all(seen.mask is None for seen in row.seen.values()):
                return whole_slice(model, order, row.seen, steps)
            return steps
        every = {name: plain.get(name, nothing) for name in model.nodes}
        return proposal_steps(model, row.seen, every, asked, self.apart)

    def _table(self, first: bool, name: str) -> Table | None:
        """A finite node's table over what varies, if it is the same in every slice."""
        key = (first, name)
        if key not in self._tables:
            model = self.slices.first if first else self.slices.later
            inputs = {*self.slices.template.inputs, TIME}
            inputs |= {n + PREVIOUS for n in inputs}
            node = model[name]
            timeless = node.domain is not None and not inputs & set(node.parents)
            self._tables[key] = table_of(model, node, self.static) if timeless else None
        return self._tables[key]


class SliceProposals:
    """Proposals of a filter, read against both models of a template.

    A proposal that names the slice before does not apply in slice 0, nor does one that names a node below its
    targets where that is missing: the nodes' own densities are drawn from there. Slice 0 may have proposals
    of its own, which come before the others.

    Parameters
    ----------
    slices : Slices
    given, initial : dict
        As ``check_specification`` leaves it; of all slices, and of slice 0 alone.
    engine : str
        For messages.
    """

    def __init__(
        self,
        slices: Slices,
        given: Mapping[Key, Any],
        engine: str,
        initial: Mapping[Key, Any] = MappingProxyType({}),
    ) -> None:
        self.engine, self._slices = engine, slices
        #: for each proposal what it reads and can only know by having seen it
        self._looks: dict[tuple[bool, Key], frozenset[str]] = {}
        self.first = [self._bound(slices.first, True, k, spec) for k, spec in initial.items()]
        own = {name for proposal in self.first for name in proposal.names}
        self.later = [self._bound(slices.later, False, k, spec) for k, spec in given.items()]
        for later in self.later:
            if own & set(later.names) or any(p.endswith(PREVIOUS) for p in later.parents):
                continue
            self.first.append(self._bound(slices.first, True, later.key, given[later.key]))

    def check(self, observed: Set[str], throughout: Set[str]) -> None:
        """Refuse proposals that look at nodes which a series never observes, or draw what it always does.

        Raises
        ------
        ModelError
        """
        for first, proposal in [(True, p) for p in self.first] + [(False, p) for p in self.later]:
            always = [n for n in proposal.names if n in throughout]
            if always:
                raise ModelError(
                    f"{proposal.what}: {always[0]!r} is observed in every slice, so nothing is drawn; "
                    "propose hidden nodes"
                )
            never = sorted(self._looks[first, proposal.key] - observed)
            if never:
                raise ModelError(
                    f"{proposal.what}: it names {never[0]!r}, which depends on what is to be drawn and is "
                    "not observed; name observed nodes, inputs, or the slice before"
                )

    def of(self, row: Row) -> list[Proposal]:
        """Those that apply in a row's slice."""
        seen = {n for n, o in row.seen.items() if o.mask is None}
        first = row.t == 0
        asked = self.first if first else self.later
        return [p for p in asked if self._looks[first, p.key] <= seen and not seen & set(p.names)]

    def _bound(self, model: Model, first: bool, key: Key, spec: Any) -> Proposal:
        """A proposal read against one of the models."""
        for name in names_of(key):
            check_target(self._slices, name, f"{self.engine}: proposal for {key!r}")
        found = bound(self.engine, model, key, as_function(self.engine, key, spec, FUNCTION))
        if not found.is_independent:
            own = next(p for p in found.parents if p in found.names)
            raise ModelError(
                f"{found.what}: it names {own!r}, which it is to draw; name observed nodes, inputs, "
                + ("" if first else f"the slice before ({own + PREVIOUS!r}) ")
                + "or nodes drawn before"
            )
        self._looks[first, key] = frozenset(found.parents) & _below(self._slices, found.names)
        return found


def plates_apart(slices: Slices) -> tuple[str, ...]:
    """Plates whose elements never meet: every one is a filter of its own.

    All nodes with a density live in them, and no function reads across their elements.
    """
    stochastic = [slices.first[n] for n in slices.stochastic]
    if not stochastic:
        return ()
    found = [p for p in stochastic[0].plates if all(p in node.plates for node in stochastic)]
    for model in (slices.first, slices.later):
        varies = {n for n in model.nodes if n not in slices.template.static}
        varies -= {n for n in model.nodes if model[n].kind == "input"}
        for name in slices.dynamic:
            for parent, link in model[name].links:
                if parent in varies:
                    found = [p for p in found if p not in link.foreign]
    return tuple(found)


class Quick:
    """A node without plates whose parents arrive as they are: its function called without ceremony.

    What is out of the ordinary (an error, parameters out of range, another shape) goes the plain way, which
    says what is wrong.
    """

    def __init__(self, node: CompiledNode, plain: Step) -> None:
        assert node.declaration.function is not None
        self.name, self.function, self.plain = node.name, node.declaration.function, plain
        self.parents, self.event_shape = node.parents, node.event_shape
        times = (TIME, TIME + PREVIOUS)
        self.times = tuple(k for k, p in enumerate(node.parents) if p in times)

    def distribution(self, state: Pass) -> Distribution | None:
        """The node's distribution, if there is nothing to say about it."""
        values = state.values
        arguments: list[Any] = [values[p] for p in self.parents]
        for k in self.times:  # the arithmetic of Python's numbers is the faster one
            arguments[k] = arguments[k].item()
        try:
            dist = self.function(*arguments)
        except Exception:  # whatever it is, the plain step explains it
            return None
        if not isinstance(dist, Distribution) or dist.invalid is not None:
            return None
        batch = dist.batch_shape
        fits = (batch == state.batch or batch == ()) and dist.event_shape == self.event_shape
        return dist if fits else None


class QuickDraw(Quick):
    """A hidden number or vector: drawn."""

    def __call__(self, state: Pass) -> None:
        dist = self.distribution(state)
        if dist is None:
            self.plain(state)
            return
        draws = dist.sample_to(state.rng, state.batch)
        draws.flags.writeable = False
        state.values[self.name] = draws


class QuickWeigh(Quick):
    """A number or vector in place: its density is a factor of the weight."""

    def __call__(self, state: Pass) -> None:
        dist = self.distribution(state)
        if dist is not None:
            log = dist.log_prob_unchecked(state.values[self.name])
            if not log.size or log.item(log.argmax()) < math.inf:  # false for NaN, too
                state.weigh(log)
                return
        self.plain(state)


class Unknown:
    """A hidden node that cannot be drawn and that nothing reads: not a number, the same for all particles."""

    def __init__(self, node: CompiledNode) -> None:
        self.name, self.value = node.name, read_only(np.full(node.value_shape, np.nan))

    def __call__(self, state: Pass) -> None:
        state.values[self.name] = self.value


class WeighSeen:
    """The same with some plate elements seen: these weigh, the others are not numbers."""

    def __init__(
        self, model: Model, node: CompiledNode, seen: Observed, apart: tuple[str, ...]
    ) -> None:
        assert seen.mask is not None
        self.model, self.node, self.seen, self.apart = model, node, seen.value, apart
        self.elements = seen.mask
        mask = seen.mask.reshape(seen.mask.shape + (1,) * len(node.event_shape))
        self.value = read_only(np.where(mask, seen.value, np.nan))

    def __call__(self, state: Pass) -> None:
        dist = current_distribution(self.model, self.node, state, drawn=~self.elements)
        log = self.model.log_density(self.node.name, dist, self.seen)
        state.weigh(summed(np.where(self.elements, log, 0.0), self.node, self.apart))
        state.values[self.node.name] = self.value


def quickly(model: Model, node: CompiledNode, kind: type[Quick], plain: Step) -> Step:
    """The quick step where a node has one, else the plain one."""
    nodes = [node, *(model[p] for p in node.parents)]
    simple = not any(n.plates or n.domain is not None for n in nodes)
    simple = simple and node.declaration.source == "function" and not node.declaration.vectorize
    quick: Any = kind(node, plain)
    return quick if simple and not node.unsampled else plain


def size_of(slices: Slices) -> int:
    """Numbers per particle by which blocks of particles are measured: those of the largest node.

    What nothing reads (most often it is seen) counts for a fraction: a scan of a laser is a wide node, but
    its density takes a few numbers of each particle, and small blocks would cost more than they save.
    """
    read = {p for n in slices.dynamic for p in slices.later[n].parents} | set(slices.interface)
    sizes = {n: math.prod(slices.first[n].value_shape) for n in slices.dynamic}
    return max((k if n in read else k // _WIDE for n, k in sizes.items()), default=1)


def check_target(slices: Slices, name: str, what: str) -> None:
    """Refuse what is not drawn in a slice as the target of a density.

    Raises
    ------
    UnknownNodeError, ModelError
    """
    template = slices.template
    if name not in template.later:
        raise UnknownNodeError(f"{what}: {template.unknown(name)}")
    node = slices.later[name]
    if name in template.static or not node.is_stochastic:
        kind = "static" if name in template.static else node.kind
        raise ModelError(
            f"{what}: {name!r} is {kind} and not drawn in a slice; propose a stochastic node"
        )


# ---- private ------------------------------------------------------------------------------------


def _below(slices: Slices, names: tuple[str, ...]) -> frozenset[str]:
    """Nodes of a slice that depend on some of its nodes."""
    reached = set(names)
    for name in slices.dynamic:
        if reached & set(slices.later[name].parents):
            reached.add(name)
    return frozenset(reached - set(names))
