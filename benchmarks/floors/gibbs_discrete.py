"""Gibbs sampling on a discrete network by hand-written NumPy: many chains at once, one thread.

Two samplers that draw from the same law:

- :class:`Multiplied` takes, for one node after the other, the rows of its own table and of its
  children's that the other nodes select, multiplies them and draws from the product.
- :class:`Tabulated` multiplies ahead: the cumulative full conditional of a node stands in a table
  over its Markov blanket, and all nodes of one colour are drawn together: their positions in the
  tables are one matrix product of strides and states.

Nodes without an observed descendant are no part of the chain: they are drawn forward after it.
No draws are kept, only how often every state was seen. Evidence is sliced out of the tables first.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.floors.lw_discrete import Node

_LARGEST = 2**23  # float32 strides hold positions exactly up to 2**24
_RECORDED = 64  # sweeps between two counts of states


class Multiplied:
    """Rows gathered and multiplied, node after node.

    Parameters
    ----------
    nodes
        ``(name, card, parent indices, table)``, parents first; the table has shape
        ``(card(parent_1), ..., card(parent_n), card)``.
    evidence
        Node name to state index.
    chains, seed
        Number of chains; seed of the SFC64 generator.
    """

    def __init__(
        self, nodes: Sequence[Node], evidence: Mapping[str, int], chains: int, seed: int
    ) -> None:
        self.rng = np.random.Generator(np.random.SFC64(seed))
        self.net = read(nodes, evidence)
        self.codes = start(self.net, chains, self.rng).astype(np.intp)
        self.counts = _Counts(self.net, chains)
        self.steps = [
            (i, [aligned(factor, i, self.net.cards) for factor in self.net.around[i]])
            for i in self.net.order
        ]
        self.cumulative = np.empty((max(self.net.cards), chains))

    def run(self, sweeps: int) -> None:
        """So many sweeps, each state counted."""
        for _ in range(sweeps):
            uniforms = self.rng.random(self.codes.shape)
            for u, (i, factors) in zip(uniforms, self.steps, strict=True):
                self._draw(i, factors, u)
            self.counts.add(self.codes)

    def _draw(self, i: int, factors: list[tuple[tuple, np.ndarray]], u: np.ndarray) -> None:
        product: np.ndarray | None = None
        for index, table in factors:
            rows = table.take(_position(index, self.codes), axis=1) if index else table
            product = rows if product is None else product * rows
        assert product is not None
        sums = self.cumulative[: len(product)]
        sums[0] = product[0]
        for j in range(1, len(product)):
            np.add(sums[j - 1], product[j], out=sums[j])
        u *= sums[-1]
        code = self.codes[i]
        np.greater_equal(u, sums[0], out=code, casting="unsafe")
        for row in sums[1:-1]:
            code += u >= row


class Tabulated:
    """Full conditionals tabulated over Markov blankets, a colour at a time; as ``Multiplied``."""

    def __init__(
        self, nodes: Sequence[Node], evidence: Mapping[str, int], chains: int, seed: int
    ) -> None:
        self.rng = np.random.Generator(np.random.SFC64(seed))
        self.net = read(nodes, evidence)
        first_states = start(self.net, chains, self.rng)
        self.counts = _Counts(self.net, chains)
        groups = _groups(self.net)
        # Nodes of one colour are neighbouring rows, so that a colour's states are one slice.
        self.rows = [i for group in groups for i in group]
        self.codes = first_states[self.rows].astype(np.float32)
        self.steps, first = [], 0
        for group in groups:
            self.steps.append(_Group(self.net, group, self.rows, first, chains))
            first += len(group)

    def run(self, sweeps: int) -> None:
        """So many sweeps, each state counted."""
        for _ in range(sweeps):
            uniforms = self.rng.random(self.codes.shape, dtype=np.float32)
            for step in self.steps:
                step(self.codes, uniforms)
            self.counts.add(self.codes, self.rows)


@dataclass(frozen=True)
class Net:
    """What is left of a network when the evidence is sliced out; hidden nodes are renumbered."""

    names: list[str]
    cards: list[int]
    order: list[int]  # the chain's nodes, parents first, then the barren ones, parents first
    barren: set[int]
    around: list[list[tuple[tuple[int, ...], np.ndarray]]]  # factors of each full conditional
    own: list[tuple[tuple[int, ...], np.ndarray]]  # each hidden node's sliced table, itself last
    seen: list[tuple[tuple[int, ...], np.ndarray]]  # likelihoods of observed nodes


class _Counts:
    """How often each state of each hidden node was seen, counted some sweeps at a time."""

    def __init__(self, net: Net, chains: int) -> None:
        self.cards, self.sweeps = net.cards, 0
        self.buffer = np.empty((_RECORDED, len(net.cards), chains), np.uint8)
        self.width = max(net.cards)
        self.total = np.zeros((len(net.cards), self.width))

    def add(self, codes: np.ndarray, rows: Sequence[int] | None = None) -> None:
        """Note one sweep; ``rows`` says which node each row of ``codes`` is."""
        k = self.sweeps % _RECORDED
        np.copyto(self.buffer[k], codes, casting="unsafe")
        self.sweeps += 1
        if k == _RECORDED - 1:
            self._count(self.buffer, rows)

    def _count(self, block: np.ndarray, rows: Sequence[int] | None) -> None:
        for j in range(1, self.width):
            seen = np.count_nonzero(block >= j, axis=(0, 2))
            if rows is None:
                self.total[:, j] += seen
            else:
                self.total[rows, j] += seen
        self.total[:, 0] += block.shape[0] * block.shape[2]

    def marginals(self) -> list[np.ndarray]:
        """Probabilities of each hidden node, of the whole blocks seen so far."""
        tails = np.hstack([self.total / self.total[:, :1], np.zeros((len(self.total), 1))])
        return [-np.diff(row[: c + 1]) for row, c in zip(tails, self.cards, strict=True)]


class _Group:
    """Nodes that are drawn together: neither is in the other's Markov blanket."""

    def __init__(
        self, net: Net, group: list[int], rows: list[int], first: int, chains: int
    ) -> None:
        place = {i: k for k, i in enumerate(rows)}
        self.where = slice(first, first + len(group))
        self.strides = np.zeros((len(group), len(rows)), np.float32)
        width = max(net.cards[i] for i in group)
        tables, begin = [], 0
        for k, i in enumerate(group):
            blanket, table = conditional(net, i, width)
            for axis, j in enumerate(blanket):
                self.strides[k, place[j]] = math.prod(net.cards[p] for p in blanket[axis + 1 :])
            tables.append(table)
            begin += table.shape[1]
        if begin > _LARGEST:
            raise ValueError(f"a Markov blanket has too many configurations to tabulate: {begin}")
        self.thresholds = np.hstack(tables)  # (width - 1, configurations of all)
        starts = np.cumsum([0] + [table.shape[1] for table in tables[:-1]])
        self.starts = starts.astype(np.float32)[:, None]
        shape = len(group), chains
        self.position, self.index = np.empty(shape, np.float32), np.empty(shape, np.intp)
        self.bound, self.passed = np.empty(shape, np.float32), np.empty(shape, bool)

    def __call__(self, codes: np.ndarray, uniforms: np.ndarray) -> None:
        np.matmul(self.strides, codes, out=self.position)
        np.add(self.position, self.starts, out=self.index, casting="unsafe")
        u, new = uniforms[self.where], codes[self.where]
        for j, row in enumerate(self.thresholds):
            row.take(self.index, out=self.bound, mode="clip")
            if j == 0:
                np.greater_equal(u, self.bound, out=new, casting="unsafe")
            else:
                new += np.greater_equal(u, self.bound, out=self.passed)


def read(nodes: Sequence[Node], evidence: Mapping[str, int]) -> Net:
    names = [name for name, *_ in nodes]
    hidden = [i for i, name in enumerate(names) if name not in evidence]
    number = {i: k for k, i in enumerate(hidden)}
    own, seen = [], []
    for i, (name, _, parents, table) in enumerate(nodes):
        scope = (*parents, i)
        codes = [evidence.get(names[p]) for p in scope]
        sliced = table[tuple(slice(None) if c is None else c for c in codes)]
        free = tuple(number[p] for p, c in zip(scope, codes, strict=True) if c is None)
        (seen if name in evidence else own).append((free, sliced))
    barren = set(range(len(hidden)))
    for scope, _ in seen:
        barren -= set(scope)
    for k in reversed(range(len(hidden))):  # children come after their parents
        if k not in barren:
            barren -= set(own[k][0])
    alive = [*own, *seen]
    around = [
        [own[k]]
        if k in barren
        else [f for n, f in enumerate(alive) if k in f[0] and not (n < len(own) and n in barren)]
        for k in range(len(hidden))
    ]
    order = sorted(range(len(hidden)), key=lambda k: (k in barren, k))
    cards = [nodes[i][1] for i in hidden]
    return Net([names[i] for i in hidden], cards, order, barren, around, own, seen)


def start(net: Net, chains: int, rng: np.random.Generator) -> np.ndarray:
    """Forward draws under which the evidence is possible, (hidden nodes, chains)."""
    found: list[np.ndarray] = []
    for _ in range(100):
        draws = np.zeros((len(net.cards), 10 * chains), np.intp)
        for i, (scope, table) in enumerate(net.own):
            cumulative = np.cumsum(table, axis=-1)[tuple(draws[p] for p in scope[:-1])]
            bounds = np.moveaxis(cumulative[..., :-1], -1, 0).reshape(net.cards[i] - 1, -1)
            draws[i] = (rng.random(10 * chains) >= bounds).sum(axis=0)
        possible = np.ones(10 * chains, bool)
        for scope, table in net.seen:
            possible &= table[tuple(draws[p] for p in scope)] > 0.0
        found.append(draws[:, possible])
        if sum(part.shape[1] for part in found) >= chains:
            return np.hstack(found)[:, :chains]
    raise ValueError("no forward draw makes the evidence possible")


def aligned(
    factor: tuple[tuple[int, ...], np.ndarray], i: int, cards: list[int]
) -> tuple[tuple[tuple[int, int], ...], np.ndarray]:
    """``(parent, stride)`` of the other variables, and the table with ``i`` first: (card, rest)."""
    scope, table = factor
    others = [j for j in scope if j != i]
    front = np.moveaxis(table, scope.index(i), 0).reshape(cards[i], -1)
    strides = [math.prod(cards[j] for j in others[k + 1 :]) for k in range(len(others))]
    return tuple(zip(others, strides, strict=True)), np.ascontiguousarray(front)


def conditional(net: Net, i: int, width: int) -> tuple[list[int], np.ndarray]:
    """The blanket, and the cumulative full conditional, (width - 1, configurations)."""
    factors = net.around[i]
    blanket = sorted({j for scope, _ in factors for j in scope} - {i})
    operands: list = []
    for scope, table in factors:
        operands += [table, [*scope]]
    product = np.einsum(*operands, [i, *blanket]).reshape(net.cards[i], -1)
    total = product.sum(axis=0)
    cumulative = np.cumsum(product, axis=0)[:-1] / np.where(total > 0.0, total, 1.0)
    cumulative[cumulative > 1.0 - 1e-12] = 2.0  # states of probability zero stay out of reach
    table = np.full((width - 1, product.shape[1]), 2.0, np.float32)
    table[: len(cumulative)] = cumulative
    return blanket, table


def _position(index: tuple[tuple[int, int], ...], codes: np.ndarray) -> np.ndarray:
    (first, stride), *others = index
    position = codes[first] * stride if stride > 1 else codes[first]
    for j, stride in others:
        position = position + (codes[j] * stride if stride > 1 else codes[j])
    return position


def _groups(net: Net) -> list[list[int]]:
    """Colours of the chain's nodes, greedily; then the barren ones, each after its parents."""
    blanket = [{j for scope, _ in net.around[i] for j in scope} - {i} for i in net.order]
    around = dict(zip(net.order, blanket, strict=True))
    colours: list[list[int]] = []
    levels: dict[int, int] = {}
    for i in net.order:
        if i in net.barren:
            parents = net.own[i][0][:-1]
            levels[i] = 1 + max((levels.get(p, -1) for p in parents), default=-1)
            continue
        for group in colours:
            if not around[i] & set(group):
                group.append(i)
                break
        else:
            colours.append([i])
    forward: list[list[int]] = [[] for _ in range(1 + max(levels.values(), default=-1))]
    for i, level in levels.items():
        forward[level].append(i)
    return colours + forward
