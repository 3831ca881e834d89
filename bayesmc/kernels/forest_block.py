"""Forests of finite nodes drawn as one block: filtering and sampling along chains and trees.

One at a time, the states of a hidden Markov chain hardly move: each is held by its neighbours. Here the
factors on all of them are collected, whatever else they depend on (rates, emissions, other chains), and the
whole forest is drawn from its joint full conditional. ``forest_search`` finds the blocks, ``forest`` draws.

All variables of a forest are put at all their states at once: a forest has two colours, and the variables of
each colour vary along an axis of their own, before the chains. A term then comes out on all states of the
one or two variables that it reads, whatever it computes from them on the way; like terms are one.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import BayesmcError
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.kernels.forest import Forest
from bayesmc.network.model import invalid_error
from bayesmc.shapes import broadcast_shapes
from bayesmc.structure.like_functions import LinkSteps, Slots
from bayesmc.structure.like_terms import LikeTerms, like_groups
from bayesmc.structure.programs import FEWEST, JointValues
from bayesmc.structure.relation import Relation
from bayesmc.structure.target import Target, Term, Values

#: axes of candidates, one for each colour
COLOURS = 2


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
        edges = list(  # two factors may name one pair in either order
            dict.fromkeys((a, b) if colour[a] < colour[b] else (b, a) for a, b in edges)
        )
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


@dataclass(frozen=True, eq=False)
class Reader:
    """Some like terms, or one, and the variables of the forest that each reads.

    Attributes
    ----------
    terms : tuple of Term
    members : tuple of tuple of str
        For each term one variable, or two in the order of their colours.
    """

    target: Target
    terms: tuple[Term, ...]
    members: tuple[tuple[str, ...], ...]
    axes: tuple[int, ...]
    one: Term
    slots: Slots | None
    fixed: Values

    def log(self, state: Mapping[str, np.ndarray], chains: int) -> tuple[np.ndarray, bool]:
        """Log factors ``(*states, chains, terms, *plates)``, and whether all have proper parameters."""
        values = state if self.slots is None else {**self.slots.gathered(state), **self.fixed}
        try:
            log, proper = _log(self.one, values)
        except BayesmcError:
            for term in self.terms:  # the first stands for all, and its name alone would be said
                _log(term, state)
            raise
        group = 0 if self.slots is None else 1
        plates = self.one.shape
        want = COLOURS + 1 + group + len(plates)
        log = log.reshape((1,) * (want - log.ndim) + log.shape)
        full = (*log.shape[: COLOURS + 1], *(log.shape[COLOURS + 1 :][:group]), *plates)
        log = self._collected(np.broadcast_to(log, full), plates)
        if not group:
            log = np.expand_dims(log, COLOURS + 1)
        log = log[tuple(slice(None) if c in self.axes else 0 for c in range(COLOURS))]
        sizes = [self.target.model[n].domain.size for n in self.members[0]]  # type: ignore[union-attr]
        tail = log.shape[len(sizes) + 2 :]
        return np.broadcast_to(log, (*sizes, chains, len(self.terms), *tail)), proper

    def _collected(self, log: np.ndarray, plates: tuple[int, ...]) -> np.ndarray:
        node = self.target.model[self.members[0][0]]
        if len(self.one.plates) != len(plates):  # rows of an index, of variables without plates
            return log.sum(axis=tuple(range(log.ndim - len(plates), log.ndim)))
        relation = Relation("aligned", node.plates, node.plate_shape, self.one.plates)
        return relation.collect(log, plates)


class Readers:
    """The terms around a forest, like ones together, and what is computed on the way to them.

    Parameters
    ----------
    members : dict
        Name of a term -> the one or two variables of the forest that it reads, in the order of their colours.
    colour : dict
        Variable -> its axis.
    candidates : dict
        Variable -> all its states, along its axis.
    """

    def __init__(
        self,
        target: Target,
        members: Mapping[str, tuple[str, ...]],
        colour: Mapping[str, int],
        candidates: Values,
    ) -> None:
        self.target = target
        self.members = members
        self.colour = colour
        self.candidates = candidates
        links = target.below(colour)
        self._axes = {n: frozenset([c]) for n, c in colour.items()}
        for link in links:
            parents = target.model[link].parents
            self._axes[link] = frozenset().union(*(self._axes.get(p, ()) for p in parents))
        self.links = LinkSteps(target, links, self._along)
        often: dict[tuple[str, ...], int] = {}
        self._turn: dict[str, int] = {}
        for name, these in members.items():  # no group reads a variable, or a pair, twice
            self._turn[name] = often[these] = often.get(these, 0) + 1
        groups = like_groups(target, [target.terms[n] for n in members], self._how)
        taken = {n for group in groups for n in group.names}
        self.all = [self._of_group(group) for group in groups]
        self.all += [self._of_term(target.terms[n]) for n in members if n not in taken]

    def placed(self, values: Mapping[str, np.ndarray]) -> Values:
        """The state with all variables at all their states."""
        state = {**values, **self.candidates}
        self.links.compute(state)
        return state

    def _along(self, name: str) -> Hashable:
        """The axes of what a term or a link reads."""
        signature = self.target.signatures.of(name)
        return signature and tuple(self._axes.get(n) for n in signature.scope)

    def _how(self, term: Term) -> Hashable:
        these = self.members[term.name]
        return self._turn[term.name], tuple(self.colour[n] for n in these), self._along(term.name)

    def _of_group(self, group: LikeTerms) -> Reader:
        scope = group.slots.sources
        own = {n: self.candidates[n] for n in scope if n in self.candidates}
        sources = {n: s for n, s in scope.items() if n not in own}
        slots = Slots(self.target, sources, len(group.names))
        fixed = {n: np.expand_dims(v, COLOURS + 1) for n, v in own.items()}
        terms = tuple(self.target.terms[n] for n in group.names)
        return self._reader(terms, group.term, slots, fixed)

    def _of_term(self, term: Term) -> Reader:
        return self._reader((term,), term, None, {})

    def _reader(
        self, terms: tuple[Term, ...], one: Term, slots: Slots | None, fixed: Values
    ) -> Reader:
        members = tuple(self.members[t.name] for t in terms)
        axes = tuple(self.colour[n] for n in members[0])
        return Reader(self.target, terms, members, axes, one, slots, fixed)


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


def _log(term: Term, values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, bool]:
    """Log factors, and whether all parameters are proper.

    Where they are not the factor is one: other factors may make the state impossible, and if they do not,
    it may be drawn, and then the term says what is wrong.
    """
    if term.is_potential:
        return term.log(values), True
    dist, batch = term.distribution(values)
    if dist.invalid is None or not dist.invalid.any():
        return term.log_of(dist, batch, values[term.name]), True
    node, value = term.model[term.name], values[term.name]
    lead = broadcast_shapes(batch, value.shape[: value.ndim - len(node.value_shape)])
    log = term.model.log_density(term.name, dist, value)
    fault = None
    if dist.problem is None or not dist.problem.is_overflow:
        fault = invalid_error(node, dist, np.broadcast_to(True, lead), lead)
    log = np.where(dist.invalid, -np.inf if fault is None else 0.0, log)
    return (log if term.mask is None else np.where(term.mask, log, 0.0)), fault is None
