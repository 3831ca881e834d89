"""Finite nodes whose whole Markov blanket is finite tables: draws by lookup.

Where the blanket has few configurations the full conditional stands in a table, and a draw is a gather and
some comparisons; nodes, and small blocks of nodes, that do not meet are drawn together. Anything else is left
to other kernels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from bayesmc.categorical import edges, impossible, searched
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.kernels.enumerate import (
    MOST_STATES,
    Conditional,
    FiniteTerms,
    JointStates,
    conditional_of,
)
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Values

#: conditionals of more states are drawn by binary search
_COMPARED = 6
#: table entries of a group: positions are computed in float32, which holds whole numbers up to 2**24
_GROUP_ENTRIES = 1 << 22
#: conditionals of a group: its matrix of strides stays small beside the states that it multiplies
_GROUP_SIZE = 48
#: nodes of a blanket that are gathered one by one in groups of more: long chains, whose matrix is mostly zero
_GATHERED = 4


def joint_states(target: Target, names: Sequence[str], terms: FiniteTerms | None = None) -> Kernel:
    """The kernel that draws some finite nodes jointly.

    Parameters
    ----------
    target : Target
    names : sequence of str
        Chain nodes with few joint states. If they live in plates, in the same ones, and nothing they enter
        reads them across elements; the blocks of all elements are then drawn at once.
    terms : FiniteTerms, optional
        Tables made before.

    Raises
    ------
    UnsupportedError
        The nodes make no such block.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.tables import joint_states
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Bernoulli(0.5))
    >>> net.add("y", bmc.Bernoulli(0.5))
    >>> net.add("parity", lambda x, y: bmc.Bernoulli((x + y) % 2 * 1.0))
    >>> target = target_of(pose(net, {"parity": 1}))
    >>> kernel = joint_states(target, ("x", "y"))
    >>> start = {"x": np.ones(4, dtype=np.uint8), "y": np.zeros(4, dtype=np.uint8)}
    >>> new, _ = kernel.step({**target.known, **start}, {}, np.random.default_rng(0), False)
    >>> (new["x"] + new["y"]).tolist()
    [1, 1, 1, 1]
    """
    terms = FiniteTerms(target) if terms is None else terms
    conditional = conditional_of(terms, names)
    if conditional is not None and conditional.states <= MOST_STATES:
        return TableSweep(target, (conditional,))
    return JointStates(target, names, terms)


def table_kernel(blanket: Blanket, terms: FiniteTerms | None = None) -> Kernel | None:
    """The kernel of one finite node whose own density and children are tables; None where they are not.

    Parameters
    ----------
    blanket : Blanket
    terms : FiniteTerms, optional
        Tables made before, to be shared between nodes.
    """
    if blanket.node.domain is None:
        return None
    terms = FiniteTerms(blanket.target) if terms is None else terms
    conditional = conditional_of(terms, (blanket.name,))
    if conditional is not None:
        return TableSweep(blanket.target, (conditional,))
    around = terms.around((blanket.name,))
    if around is None or any(c.relation.kind != "aligned" for c in blanket.children):
        return None
    return JointStates(blanket.target, (blanket.name,), terms)


def table_kernels(
    target: Target, blocks: Sequence[Sequence[str]], terms: FiniteTerms | None = None
) -> tuple[list[Kernel], list[tuple[str, ...]]]:
    """One kernel for all nodes and blocks whose full conditionals are tables, and those that are left.

    Parameters
    ----------
    blocks : sequence of sequence of str
        Single nodes as blocks of one; a node may stand in several.
    """
    terms = FiniteTerms(target) if terms is None else terms
    found = [conditional_of(terms, block) for block in blocks]
    ready = [c for c in found if c is not None]
    left = [tuple(b) for b, c in zip(blocks, found, strict=True) if c is None]
    return ([TableSweep(target, ready)] if ready else []), left


class TableSweep(Kernel):
    """Draws nodes and blocks from tabulated full conditionals, those that do not meet at once.

    Parameters
    ----------
    conditionals : sequence of Conditional
        Each is drawn once per step.
    """

    label = "enumerate"
    match = "full conditional tabulated over the Markov blanket"

    def __init__(self, target: Target, conditionals: Sequence[Conditional]) -> None:
        self.conditionals = tuple(conditionals)
        parts = [p for colour in _colours(self.conditionals) for p in _parts(colour)]
        self.names = tuple(dict.fromkeys(n for part in parts for c in part for n in c.names))
        outside = dict.fromkeys(n for c in self.conditionals for n in c.blanket)
        self.rows = (*self.names, *(n for n in outside if n not in self.names))
        place = {n: i for i, n in enumerate(self.rows)}
        self.groups = [_Group(part, place) for part in parts]
        domains = [target.model[n].domain for n in self.names]
        self.dtypes = [d.dtype for d in domains if d is not None]
        self.dtype = max(self.dtypes, key=lambda d: d.itemsize)

    def words(self, name: str) -> tuple[str, str]:
        with_it = [c.names for c in self.conditionals if name in c.names and len(c.names) > 1]
        if not with_it:
            return self.label, self.match
        others = dict.fromkeys(n for names in with_it for n in names if n != name)
        return self.label, f"{self.match}, jointly with {', '.join(others)}"

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        chains = len(values[self.names[0]])
        # one more row of ones carries where the tables of a group begin
        codes = np.ones((len(self.rows) + 1, chains), dtype=np.float32)
        codes[:-1] = np.concatenate([values[n] for n in self.rows]).reshape(-1, chains)
        draws = sum(group.count for group in self.groups)
        levels = np.ascontiguousarray(rng.random((chains, draws)).T)
        begin = 0
        for group in self.groups:
            group.draw(codes, levels[begin : begin + group.count])
            begin += group.count
        new = codes[: len(self.names)].astype(self.dtype)
        new.flags.writeable = False
        if self.dtype.itemsize == 1:
            return dict(zip(self.names, new, strict=True)), memory
        moved = zip(self.names, new, self.dtypes, strict=True)
        return {n: row.astype(dtype, copy=False) for n, row, dtype in moved}, memory


# ---- private ------------------------------------------------------------------------------------


class _Group:
    """Conditionals that are drawn together: no two meet, and all are compared or all searched.

    Positions in their tables are one product of a matrix of strides with the states of all nodes; in a large
    group, whose blankets are small, the states of every first, every second ... neighbour are gathered.
    """

    def __init__(self, part: Sequence[Conditional], place: Mapping[str, int]) -> None:
        self.part = tuple(part)
        self.count = len(part)
        self.width = _width(part[0])
        self.near = _neighbours(part, place, self.width) if self.count > _GROUP_SIZE else []
        if not self.near:
            self.columns, self.strides = _strides(part, place, self.width)
        self.edges = _searched(part, self.width) if self.width > 1 else _compared(part)
        dead = np.concatenate([c.probs.sum(axis=1) == 0 for c in part])
        self.impossible = dead if dead.any() else None
        self.written = [np.array([place[n] for n in c.names]) for c in part]
        self.states = [np.indices(c.cards).reshape(len(c.cards), -1) for c in part]
        # single nodes are stored as they are drawn, neighbouring rows as one slice
        self.rows: slice | np.ndarray | None = None
        if all(len(c.names) == 1 for c in part):
            self.rows = np.concatenate(self.written)
            first = int(self.rows[0])
            if (self.rows == np.arange(first, first + self.count)).all():
                self.rows = slice(first, first + self.count)

    def draw(self, codes: np.ndarray, levels: np.ndarray) -> None:
        """Replace the states of its nodes in ``codes`` (nodes and a row of ones, chains)."""
        index = self._positions(codes).astype(np.intp)
        if self.impossible is not None:
            self._check(index)
        new = self._search(index, levels) if self.width > 1 else self._compare(index, levels)
        if self.rows is not None:
            codes[self.rows] = new
            return
        for rows, states, drawn in zip(self.written, self.states, new, strict=True):
            codes[rows] = states[:, drawn]

    def _positions(self, codes: np.ndarray) -> np.ndarray:
        """Where the tables are read, shape (part, chains)."""
        if not self.near:
            return self.strides @ (codes if self.columns is None else codes[self.columns])
        rows, strides = self.near[0]
        index = strides * codes.take(rows, axis=0)
        for rows, strides in self.near[1:]:
            index += strides * codes.take(rows, axis=0)
        return index

    def _compare(self, index: np.ndarray, levels: np.ndarray) -> np.ndarray:
        new = np.zeros(levels.shape, dtype=np.uint8)
        for count, table in self.edges:
            passed = levels[:count] >= table.take(index[:count])
            new[:count] += passed.view(np.uint8)
        return new

    def _search(self, index: np.ndarray, levels: np.ndarray) -> np.ndarray:
        return searched(self.edges[0][1], index, levels, self.width)

    def _check(self, index: np.ndarray) -> None:
        assert self.impossible is not None
        bad = self.impossible.take(index // self.width)
        if bad.any():
            names = self.part[int(np.argwhere(bad)[0, 0])].names
            what = f"node {names[0]!r}" if len(names) == 1 else f"nodes {list(names)}"
            raise impossible(what)


def _colours(conditionals: Sequence[Conditional]) -> list[list[Conditional]]:
    """Sets in which nobody moves what another reads or moves, greedily in the given order."""
    sets: list[tuple[list[Conditional], set[str], set[str]]] = []
    for c in conditionals:
        near = {*c.names, *c.blanket}
        at = (s for s in sets if not s[1] & near and not s[2] & set(c.names))
        chosen = next(at, None)
        if chosen is None:
            chosen = ([], set(), set())
            sets.append(chosen)
        chosen[0].append(c)
        chosen[1].update(c.names)
        chosen[2].update(c.blanket)
    return [members for members, _, _ in sets]


def _parts(colour: Sequence[Conditional]) -> Iterator[list[Conditional]]:
    """A colour cut into groups: alike in how they are drawn, of moderate size, many states first."""
    by_width: dict[int, list[Conditional]] = {}
    for c in colour:
        by_width.setdefault(_width(c), []).append(c)
    for width, members in by_width.items():
        few = [c for c in members if len(c.blanket) <= _GATHERED]
        if len(few) <= _GROUP_SIZE:
            yield from _cut(members, width, _GROUP_SIZE)
            continue
        yield from _cut(few, width, len(few))
        yield from _cut([c for c in members if len(c.blanket) > _GATHERED], width, _GROUP_SIZE)


def _cut(members: Sequence[Conditional], width: int, most: int) -> Iterator[list[Conditional]]:
    """Groups of at most so many conditionals, and of not too many table entries."""
    part: list[Conditional] = []
    entries = 0
    for c in sorted(members, key=lambda c: -c.states):
        size = len(c.probs) * width
        if part and (entries + size > _GROUP_ENTRIES or len(part) == most):
            yield part
            part, entries = [], 0
        part.append(c)
        entries += size
    if part:
        yield part


def _width(c: Conditional) -> int:
    """Entries of a row to be searched; 1 where states are compared one by one."""
    return 1 if c.states <= _COMPARED else 1 << (c.states - 1).bit_length()


def _strides(
    part: Sequence[Conditional], place: Mapping[str, int], width: int
) -> tuple[np.ndarray | None, np.ndarray]:
    """Rows of the states that are read (None for all), and their weights, shape (part, rows)."""
    ones = len(place)
    used = sorted({place[n] for c in part for n in c.blanket} | {ones})
    columns = np.array(used) if 2 * len(used) < ones else None
    at = {row: i for i, row in enumerate(used)} if columns is not None else range(ones + 1)
    strides = np.zeros((len(part), len(at)), dtype=np.float32)
    begin = 0
    for row, c in enumerate(part):
        for name, stride in zip(c.blanket, c.strides, strict=True):
            strides[row, at[place[name]]] = stride * width
        strides[row, at[ones]] = begin
        begin += len(c.probs) * width
    return columns, strides


def _neighbours(
    part: Sequence[Conditional], place: Mapping[str, int], width: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rows of the states that each conditional reads, and their weights ``(part, 1)``; where tables begin."""
    ones = len(place)
    count = max(len(c.blanket) for c in part) + 1
    rows = np.full((count, len(part)), ones)
    strides = np.zeros((count, len(part), 1), dtype=np.float32)
    begin = 0
    for i, c in enumerate(part):
        strides[0, i] = begin
        rows[1 : len(c.blanket) + 1, i] = [place[n] for n in c.blanket]
        strides[1 : len(c.blanket) + 1, i, 0] = np.multiply(c.strides, width)
        begin += len(c.probs) * width
    return list(zip(rows, strides, strict=True))


def _compared(part: Sequence[Conditional]) -> list[tuple[int, np.ndarray]]:
    """For each k the number of conditionals that have a k-th edge, and those edges over all rows."""
    rows = [edges(c.probs) for c in part]
    found = []
    for k in range(max(e.shape[1] for e in rows)):
        having = [e[:, k] for e in rows if e.shape[1] > k]
        found.append((len(having), np.concatenate(having)))
    return found


def _searched(part: Sequence[Conditional], width: int) -> list[tuple[int, np.ndarray]]:
    """All edges, each row padded to ``width`` with what no draw exceeds."""
    padded = []
    for c in part:
        rows = np.full((len(c.probs), width), np.inf)
        rows[:, : c.states - 1] = edges(c.probs)
        padded.append(rows.ravel())
    return [(len(part), np.concatenate(padded))]
