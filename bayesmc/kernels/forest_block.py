"""Forests of finite nodes drawn as one block: filtering and sampling along chains and trees.

One at a time, the states of a hidden Markov chain hardly move: each is held by its neighbours. Here the
factors on all of them are collected, whatever else they depend on (rates, emissions, other chains), and the
whole forest is drawn from its joint full conditional. ``forest_search`` finds the blocks, ``forest_terms``
reads factors, ``forest`` draws.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.kernels.base import Kernel, Memory
from bayesmc.kernels.forest import Forest
from bayesmc.kernels.forest_terms import COLOURS, Readers
from bayesmc.structure.joint_values import FEWEST, JointValues
from bayesmc.structure.target import Target, Values


class ForestBlock(Kernel):
    """Draws finite nodes jointly, no factor reading more than two of them, and these making no cycle.

    Parameters
    ----------
    target : Target
    names : sequence of str
        Chain nodes with few states. If they live in plates, in the same ones, and nothing they enter reads
        them across elements; the forests of all elements are then drawn at once.

    Raises
    ------
    ValueError
        The nodes are no such forest.

    References
    ----------
    Scott (2002), JASA 97, 337-351.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.forest_block import ForestBlock
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Bernoulli(0.5))
    >>> net.add("y", lambda x: bmc.Bernoulli(0.1 + 0.8 * x))
    >>> net.add("z", lambda x, y: bmc.Normal(x + y, 0.1))
    >>> target = target_of(pose(net, {"z": 2.0}))
    >>> kernel = ForestBlock(target, ("x", "y"))
    >>> start = {name: np.zeros(4, dtype=np.uint8) for name in ("x", "y")}
    >>> new, _ = kernel.step({**target.known, **start}, {}, np.random.default_rng(0), False)
    >>> new["x"].tolist(), new["y"].tolist()
    ([1, 1, 1, 1], [1, 1, 1, 1])
    """

    label = "forest"

    def __init__(self, target: Target, names: Sequence[str]) -> None:
        self.target = target
        self.names = tuple(names)
        nodes = [target.model[n] for n in names]
        self.plate_shape = nodes[0].plate_shape
        if any(n.plates != nodes[0].plates or n.domain is None for n in nodes):
            raise ValueError(f"nodes {list(names)} are not finite nodes of the same plates")
        self.cards = [n.domain.size for n in nodes if n.domain is not None]
        self.dtypes = [n.domain.dtype for n in nodes if n.domain is not None]
        place = {n: i for i, n in enumerate(names)}
        members = members_of(target, self.names)
        edges = list(dict.fromkeys(m for m in members.values() if len(m) > 1))
        colour = _two_colours(self.names, edges)
        edges = [(a, b) if colour[a] < colour[b] else (b, a) for a, b in edges]
        self.forest = Forest(len(names), np.array([(place[a], place[b]) for a, b in edges]))
        self.candidates: Values = {}
        for name, card, dtype in zip(names, self.cards, self.dtypes, strict=True):
            shape = [1] * (COLOURS + 1 + len(self.plate_shape))
            shape[colour[name]] = card
            self.candidates[name] = np.arange(card, dtype=dtype).reshape(shape)
        ordered = {t: tuple(sorted(m, key=colour.__getitem__)) for t, m in members.items()}
        number = {e: i for i, e in enumerate(edges)}
        self.read = Readers(target, ordered, colour, self.candidates)
        self.places = [
            _places([number[m] if len(m) > 1 else place[m[0]] for m in reader.members])
            for reader in self.read.all
        ]
        self.states = max(self.cards)
        self.possible = np.zeros((self.states, len(names), *self.plate_shape))
        for i, name in enumerate(names):
            self.possible[self.cards[i] :, i] = -np.inf
            seen = target.seen(name)
            if seen is not None and seen.mask is not None:
                for k in range(self.cards[i]):
                    self.possible[k, i][seen.mask & (seen.value != k)] = -np.inf
        self._kept: tuple[np.ndarray, np.ndarray] | None = None
        alike = len(set(self.dtypes)) == 1 and len(names) >= FEWEST
        #: the array of all values that is left in the state for others
        self.joint = JointValues(target.model, self.names) if alike else None
        size = f"{len(edges)} pairs of {len(names)} nodes, {self.states} states"
        self.match = f"filtering and sampling along {size}"

    def log_factors(self, values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, bool]:
        """Log factors on single nodes and on pairs, as ``Forest.draw`` takes them; are all proper?

        Rows are chains, and elements of the plates within them. The arrays are good until the next call.
        """
        chains = len(values[self.names[0]])
        rows = chains * math.prod(self.plate_shape)
        single, pairs = self._room(rows)
        single.reshape(*single.shape[:2], chains, *self.plate_shape)[:] = self.possible[:, :, None]
        pairs[:, :, : self.forest.edges] = 0.0
        state = self.read.placed(values)
        proper = True
        for reader, at in zip(self.read.all, self.places, strict=True):
            log, fine = reader.log(state, chains)
            proper &= fine
            axes = len(reader.axes)
            log = np.moveaxis(log, axes, axes + 1)  # (*states, terms, chains, *plates)
            log = log.reshape(*log.shape[: axes + 1], rows)
            where = single if axes == 1 else pairs
            own: Any = (*(slice(0, n) for n in log.shape[:axes]), at)
            where[own] += log
        return single, pairs, proper

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        single, pairs, proper = self.log_factors(values)
        count, rows = single.shape[1:]
        chains = len(values[self.names[0]])
        uniform = rng.random((chains, rows // chains * count)).reshape(rows, count)
        drawn, _ = self.forest.draw(single, pairs, np.ascontiguousarray(uniform.T), self._shown())
        new = self._spread(drawn)
        if not proper:
            self._check({**values, **new})
        return new, memory

    def _room(self, rows: int) -> tuple[np.ndarray, np.ndarray]:
        """Arrays to be filled, the same in every sweep: new ones cost more than filling them."""
        if self._kept is None or self._kept[0].shape[-1] != rows:
            single = np.empty((self.states, len(self.names), rows))
            self._kept = single, np.empty((self.states, self.states, self.forest.tables, rows))
        return self._kept

    def _spread(self, drawn: np.ndarray) -> Values:
        """The values of each node, from positions ``(nodes, rows)``."""
        alike = len(set(self.dtypes)) == 1
        stored = drawn.astype(self.dtypes[0]) if alike else drawn
        if self.plate_shape:
            stored = stored.reshape(len(self.names), -1, *self.plate_shape)
        stored.flags.writeable = False
        if alike:
            new = dict(zip(self.names, stored, strict=True))
            if self.joint is not None:
                new |= self.joint.kept(new, np.ascontiguousarray(stored.swapaxes(0, 1)))
            return new
        return {n: v.astype(t) for n, v, t in zip(self.names, stored, self.dtypes, strict=True)}

    def _check(self, values: Values) -> None:
        """Raise where what was drawn has parameters that are wrong."""
        self.target.refresh(values, self.names)
        for reader in self.read.all:
            for term in reader.terms:
                term.log(values)

    def _shown(self) -> str:
        """The nodes for errors, which put it in quotes."""
        few = ", ".join(self.names[:3])
        return few if len(self.names) <= 3 else f"{few}, ... ({len(self.names)} nodes jointly)"


def members_of(target: Target, names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Terms that some nodes enter, through deterministic nodes as well, and which of them each reads."""
    above: dict[str, dict[str, None]] = {n: {n: None} for n in names}
    for link in target.below(names):
        found: dict[str, None] = {}
        for parent in target.model[link].parents:
            found |= above.get(parent, {})
        above[link] = found
    members = {}
    for term in target.terms_of(names):
        read: dict[str, None] = {}
        for name in term.scope:
            read |= above.get(name, {})
        members[term.name] = tuple(read)
    return members


# ---- private ------------------------------------------------------------------------------------


def _places(numbers: list[int]) -> slice | np.ndarray:
    """Where to put what some terms say: as a slice, which is faster, where they stand at even distances."""
    step = numbers[1] - numbers[0] if len(numbers) > 1 else 1
    end = numbers[0] + step * len(numbers)
    if step > 0 and numbers == list(range(numbers[0], end, step)):
        return slice(numbers[0], end, step)
    return np.array(numbers)


def _two_colours(names: Sequence[str], edges: Sequence[tuple[str, ...]]) -> dict[str, int]:
    """Colours of the nodes, such that the ends of an edge differ."""
    near: dict[str, list[str]] = {n: [] for n in names}
    for edge in edges:
        if len(edge) > COLOURS:
            raise ValueError(f"a factor reads {len(edge)} of the nodes: {list(edge)}")
        near[edge[0]].append(edge[1])
        near[edge[1]].append(edge[0])
    colour: dict[str, int] = {}
    for root in names:
        if root in colour:
            continue
        colour[root], todo = 0, [root]
        while todo:
            name = todo.pop()
            for other in near[name]:
                if other not in colour:
                    colour[other] = 1 - colour[name]
                    todo.append(other)
    return colour
