"""Fast steps of the forward pass for finite nodes, and how many draws make a chunk.

A finite node whose parents are finite is a table: its draws are integer codes picked by comparing
random bits with cumulative rows, its density a row of logs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.categorical import edges, searched
from bayesmc.errors import BayesmcError, ParameterError
from bayesmc.network import CompiledNode, Model, Observed
from bayesmc.network.calling import Aligner
from bayesmc.network.forward import Pass, Step, step_for, summed, with_potentials
from bayesmc.structure import Table, constants_of, tabulate

#: draws per chunk of a net whose largest node is a scalar
CHUNK = 32768
#: array elements per node and chunk that larger nodes are cut to
_CHUNK_ELEMENTS = 1 << 20
#: table entries up to which a function, or a declared table, is turned into a step
_FUNCTION_ENTRIES = 1 << 20
_TABLE_ENTRIES = 1 << 26
_BITS = 31


def chunk_sizes(model: Model, draws: int) -> list[int]:
    """Draws in each chunk: about ``CHUNK``, fewer for plated nodes, and all about the same."""
    count = chunk_count(model, draws)
    return [draws // count + (k < draws % count) for k in range(count)]


def chunk_count(model: Model, draws: int) -> int:
    """How many chunks there are."""
    largest = max((math.prod(n.value_shape) for n in model.nodes.values()), default=1)
    size = max(1, min(CHUNK, _CHUNK_ELEMENTS // max(largest, 1)))
    return max(1, round(draws / size))


def fast_steps(
    model: Model, observed: Mapping[str, Observed], inputs: Mapping[str, np.ndarray]
) -> list[Step]:
    """One step per node: from a table where there is one, else by the node's function."""
    constants = constants_of(model, inputs)
    kept: dict[str, _Tabulated] = {} if inputs else model.cache.setdefault("tables", {})
    steps: dict[str, Step] = {}
    for name, node in model.nodes.items():
        if name not in kept:
            kept[name] = _Tabulated(model, node, constants)
        step = kept[name].step(observed.get(name))
        steps[name] = step if step is not None else step_for(model, node, observed)
    return with_potentials(model, steps)


def table_of(model: Model, node: CompiledNode, constants: Mapping[str, np.ndarray]) -> Table | None:
    """A finite node's table, if it has one of moderate size."""
    limit = _FUNCTION_ENTRIES if node.declaration.probs is None else _TABLE_ENTRIES
    try:
        return tabulate(model, node, constants, limit)
    except BayesmcError:
        return (
            None  # it fails at some configuration, perhaps an impossible one: call it draw by draw
        )


class _Tabulated:
    """What a node's table makes of it: steps that do not depend on the evidence, made once."""

    def __init__(
        self, model: Model, node: CompiledNode, constants: Mapping[str, np.ndarray]
    ) -> None:
        self.node = node
        self.hidden: Step | None = None
        self.table: Table | None = None
        distinct = len(set(node.parents)) == len(node.parents)
        if node.table is not None:
            if distinct and not any(p in constants for p in node.parents):
                self.hidden = TableCompute(node)
            return
        self.table = table_of(model, node, constants)
        if self.table is not None:
            self.hidden = TableDraw(node, self.table)

    def step(self, seen: Observed | None) -> Step | None:
        if seen is None:
            return self.hidden
        if self.table is None or seen.mask is not None:
            return None
        return TableWeigh(self.node, self.table, seen)


class RowIndex:
    """Row of a table for every draw and plate element, from the positions of the parents."""

    def __init__(self, node: CompiledNode, parents: tuple[str, ...], lead: tuple[int, ...]) -> None:
        cards = lead[: len(parents)]
        links = dict(node.links)
        self.parents: list[tuple[str, Aligner, int]] = []
        rows = 1
        for parent, card in zip(parents, cards, strict=True):
            self.parents.append((parent, links[parent], card))
            rows *= card
        plates = lead[len(parents) :]
        self.offset: np.ndarray | None = None
        if math.prod(plates) > 1:
            self.offset = np.arange(math.prod(plates)).reshape(plates)
            rows *= self.offset.size
        self.rows = rows
        self.dtype = np.min_scalar_type(max(rows - 1, 1))

    def __call__(self, values: Mapping[str, np.ndarray]) -> Any:
        """Integer array that broadcasts to batch and plates (a plain 0 for a single row)."""
        index: Any = None
        for parent, link, card in self.parents:
            codes = link.place(values[parent])
            if index is None:
                index = codes
            else:  # the first product is widened once, so that no code overflows
                index = np.multiply(index, card, dtype=self.dtype, casting="unsafe") + codes
        if self.offset is not None:
            plates = self.offset.size
            index = self.offset if index is None else index.astype(np.intp) * plates + self.offset
        return 0 if index is None else index


class TableDraw:
    """Sample a finite node: count the cumulative probabilities that random bits exceed.

    Bits and thresholds are 31-bit integers: 5e-10 fine, cheaper than floats, and states of probability
    zero have no width at all. Few states are compared one by one, many by binary search.
    """

    def __init__(self, node: CompiledNode, table: Table) -> None:
        self.name = node.name
        self.node = node
        lead = table.probs.shape[:-1]
        self.index = RowIndex(node, table.parents, lead)
        self.dtype = node.domain.dtype  # type: ignore[union-attr]
        self.guard = _Guard(node, table)
        probs = table.probs.reshape(-1, table.probs.shape[-1])
        self.states = probs.shape[1]
        passed = _thresholds(probs)
        self.search = self.states > 5
        if self.search:
            self.width = 1 << int(np.ceil(np.log2(self.states)))
            padded = np.full((len(probs), self.width), 1 << _BITS, dtype=np.uint32)
            padded[:, : self.states - 1] = passed
            self.edges = [padded.ravel()]
        else:
            self.edges = [np.ascontiguousarray(passed[:, k]) for k in range(self.states - 1)]

    def __call__(self, state: Pass) -> None:
        index = self.index(state.values)
        self.guard.check(index, state)
        shape = state.batch + self.node.plate_shape
        bits = _random_bits(state.rng, shape)
        codes = self._search(index, bits) if self.search else self._compare(index, bits)
        codes.flags.writeable = False
        state.values[self.name] = codes

    def _compare(self, index: Any, bits: np.ndarray) -> np.ndarray:
        if not self.edges:
            return np.zeros(bits.shape, dtype=self.dtype)
        if isinstance(index, np.ndarray) and len(self.edges) > 1:
            index = index.astype(np.intp)  # once, where every gather would
        codes = (bits >= self.edges[0].take(index)).view(np.uint8)
        for edge in self.edges[1:]:
            codes += (bits >= edge.take(index)).view(np.uint8)
        return codes

    def _search(self, index: Any, bits: np.ndarray) -> np.ndarray:
        start = np.asarray(index, dtype=np.intp) * self.width
        return searched(self.edges[0], start, bits, self.width).astype(self.dtype)


class TableWeigh:
    """Weight by a finite node that was seen, or whose value is in place: one gather of log probabilities.

    Elements of the plates ``apart`` have weights of their own.
    """

    def __init__(
        self,
        node: CompiledNode,
        table: Table,
        seen: Observed | None = None,
        apart: tuple[str, ...] = (),
    ) -> None:
        self.node, self.name, self.seen, self.apart = node, node.name, seen, apart
        self.index = RowIndex(node, table.parents, table.probs.shape[:-1])
        self.guard = _Guard(node, table)
        with np.errstate(divide="ignore"):
            logs = np.log(table.probs.reshape(-1, table.probs.shape[-1]))
        self.states = logs.shape[1]
        # without plates one column will do; with them the state differs from element to element
        self.is_column = seen is not None and not node.plates
        if seen is not None and self.is_column:
            logs = logs[:, int(seen.value)]
        self.logs = np.ascontiguousarray(logs).ravel()

    def __call__(self, state: Pass) -> None:
        index = self.index(state.values)
        self.guard.check(index, state)
        if self.seen is not None:
            state.values[self.name] = self.seen.value
        if self.is_column:
            state.weigh(self.logs.take(index))
            return
        rows = np.asarray(index, dtype=np.intp) * self.states + state.values[self.name]
        state.weigh(summed(self.logs.take(rows), self.node, self.apart))


class TableCompute:
    """A deterministic node of finite parents: one gather."""

    def __init__(self, node: CompiledNode) -> None:
        assert node.table is not None
        self.node = node
        self.index = RowIndex(node, node.parents, node.table.shape)
        self.codes = np.ascontiguousarray(node.table).ravel()

    def __call__(self, state: Pass) -> None:
        node = self.node
        from_table = np.asarray(self.codes.take(self.index(state.values)))
        lead = from_table.shape[: from_table.ndim - len(node.plates)]
        if from_table.shape != lead + node.plate_shape:
            from_table = np.broadcast_to(from_table, lead + node.plate_shape)
        from_table.flags.writeable = False
        state.values[node.name] = from_table


class _Guard:
    """Refuses configurations with bad parameters when a draw of positive weight reaches one."""

    def __init__(self, node: CompiledNode, table: Table) -> None:
        self.node = node
        self.invalid = None if table.invalid is None else table.invalid.ravel()

    def check(self, index: Any, state: Pass) -> None:
        if self.invalid is None:
            return
        bad = self.invalid.take(index)
        alive = np.asarray(state.log_weight) > -np.inf
        alive = alive.reshape(alive.shape + (1,) * len(self.node.plates))
        if (bad & alive).any():
            raise ParameterError(
                f"node {self.node.name!r}: the function gives bad parameters at a configuration of its "
                "parents that has positive probability; check it there"
            )


def _thresholds(probs: np.ndarray) -> np.ndarray:
    """Cumulative rows as integers of ``_BITS`` bits, shape (rows, states - 1)."""
    return np.rint(np.minimum(edges(probs), 1.0) * float(1 << _BITS)).astype(np.uint32)


def _random_bits(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Independent uniform integers below ``2**_BITS``."""
    count = 1
    for n in shape:
        count *= n
    words = rng.bit_generator.random_raw((count + 1) // 2).view(np.uint32)[:count]
    words >>= np.uint32(32 - _BITS)
    return words.reshape(shape)
