"""One slice as a forward pass: sample what is hidden, weight by what is seen, in topological order.

The same steps serve every row with the same nodes seen: what was seen is put among the values, and inputs
and the slice before, too, so nothing is built anew from slice to slice. Finite nodes become tables where
their functions do not read the time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS, TIME, Row, Slices
from bayesmc.engines.forward import RowIndex, TableDraw, table_of
from bayesmc.network import CompiledNode, Model, Observed
from bayesmc.network.forward import Compute, Draw, Pass, Step, current_distribution
from bayesmc.structure import Table


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
        self, slices: Slices, apart: tuple[str, ...], static: Mapping[str, np.ndarray]
    ) -> None:
        self.slices, self.apart, self.static = slices, apart, dict(static)
        self._kept: dict[Any, list[Step]] = {}
        self._tables: dict[tuple[bool, str], Table | None] = {}

    def steps(self, row: Row, skip: frozenset[str] = frozenset()) -> list[Step]:
        """The steps of a row's slice, without those of the nodes to ``skip``."""
        partly = any(seen.mask is not None for seen in row.seen.values())
        key = (row.t == 0, frozenset(row.seen), skip)
        found = None if partly else self._kept.get(key)
        if found is None:
            found = self._build(row, skip)
            if not partly:
                self._kept[key] = found
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
        if seen is None:
            return Draw(model, node) if table is None else TableDraw(node, table)
        if seen.mask is not None:
            return DrawAndWeighApart(model, node, seen, self.apart)
        if table is None:
            return WeighApart(model, node, self.apart)
        return TableWeighApart(node, table, self.apart)

    def _build(self, row: Row, skip: frozenset[str]) -> list[Step]:
        return [self.step(row, name) for name in self.slices.dynamic if name not in skip]

    def _table(self, first: bool, name: str) -> Table | None:
        """A finite node's table over what varies, if it is the same in every slice."""
        key = (first, name)
        if key not in self._tables:
            model = self.slices.first if first else self.slices.later
            inputs = {*self.slices.template.inputs, TIME}
            inputs |= {n + PREVIOUS for n in inputs}
            timeless = not inputs & set(model[name].parents)
            self._tables[key] = table_of(model, model[name], self.static) if timeless else None
        return self._tables[key]


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


def summed(log: np.ndarray, node: CompiledNode, apart: tuple[str, ...]) -> np.ndarray:
    """A node's log densities, ``(*lead, *plates)``, summed over all plates but those ``apart``."""
    if not node.plates:
        return log
    lead = log.shape[: max(log.ndim - len(node.plates), 0)]
    full = np.broadcast_to(log, lead + node.plate_shape)
    count = len(lead)
    others = tuple(count + k for k, p in enumerate(node.plates) if p not in apart)
    total = full.sum(axis=others) if others else full
    kept = [p for p in node.plates if p in apart]
    order = [kept.index(p) for p in apart if p in kept]
    if order != sorted(order):
        total = total.transpose(*range(count), *(count + k for k in order))
    return total


class WeighApart:
    """A node whose value is in place: its density is a factor of the weight."""

    def __init__(self, model: Model, node: CompiledNode, apart: tuple[str, ...]) -> None:
        self.model, self.node, self.apart = model, node, apart

    def __call__(self, state: Pass) -> None:
        node = self.node
        dist = current_distribution(self.model, node, state)
        log = self.model.log_density(node.name, dist, state.values[node.name])
        state.weigh(summed(log, node, self.apart) if node.plates else log)


class DrawAndWeighApart:
    """A partly observed node: sample the missing elements, weight by the others."""

    def __init__(
        self, model: Model, node: CompiledNode, seen: Observed, apart: tuple[str, ...]
    ) -> None:
        assert seen.mask is not None
        self.model, self.node, self.seen, self.apart = model, node, seen, apart
        self.elements = seen.mask
        self.mask = seen.mask.reshape(seen.mask.shape + (1,) * len(node.event_shape))

    def __call__(self, state: Pass) -> None:
        node = self.node
        dist = current_distribution(self.model, node, state)
        draws = self.model.sample_stored(node.name, dist, state.rng, state.batch)
        values = np.where(self.mask, self.seen.value, draws)
        values.flags.writeable = False
        log = self.model.log_density(node.name, dist, values)
        state.weigh(summed(np.where(self.elements, log, 0.0), node, self.apart))
        state.values[node.name] = values


class TableWeighApart:
    """A finite node whose value is in place: one gather of log probabilities."""

    def __init__(self, node: CompiledNode, table: Table, apart: tuple[str, ...]) -> None:
        self.node, self.apart = node, apart
        self.index = RowIndex(node, table.parents, table.probs.shape[:-1])
        with np.errstate(divide="ignore"):
            logs = np.log(table.probs.reshape(-1, table.probs.shape[-1]))
        self.states = logs.shape[1]
        self.logs = np.ascontiguousarray(logs).ravel()

    def __call__(self, state: Pass) -> None:
        rows = np.asarray(self.index(state.values), dtype=np.intp)
        log = self.logs.take(rows * self.states + state.values[self.node.name])
        state.weigh(summed(log, self.node, self.apart))


def size_of(slices: Slices) -> int:
    """Numbers that the largest node of a slice holds."""
    return max((math.prod(slices.first[n].value_shape) for n in slices.dynamic), default=1)
