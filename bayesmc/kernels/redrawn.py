"""A finite node moved together with what depends on it, numbers or many finite nodes, which is drawn anew.

Tried state by state, a switch ``s`` waits for a number ``m`` below it that fits another state, and ``m``
waits for ``s``: both may stand still for ever, in every chain, and look certain. Here a new state is
proposed, or the old one again, the numbers are drawn from their densities given it, and the likelihood of
what depends on either decides. How often numbers are drawn anew says what a state that was never seen may
weigh. The elements of a finite node in plates hold one above them in the same way, all together.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np

from bayesmc.errors import BayesmcError
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.kernels.densities import accepted, instead
from bayesmc.network.model import CompiledNode
from bayesmc.structure.blanket import Blanket, Child
from bayesmc.structure.target import Target, Values

#: states of a node, and numbers drawn anew for one of its elements, at most
_STATES, _NUMBERS = 64, 24
#: elements that are moved one at a time, at most
_ONE_BY_ONE = 64
#: kernels that act in one sweep; of more, each waits for its turn
_AT_ONCE = 8


class _Group(NamedTuple):
    """A node and what is drawn anew with it; by which relation each term's elements are told apart."""

    names: tuple[str, ...]
    apart: tuple[tuple[Blanket, Child], ...] | None


class Redrawn(Kernel):
    """Proposes a finite node's state and, given it, draws of what depends on it (Metropolis-Hastings).

    Parameters
    ----------
    target : Target
    blankets : dict
        Of the nodes that move.
    group : _Group
        The finite node first.
    turn, turns : int
        It acts in one of so many sweeps.

    References
    ----------
    Liu (2001), Monte Carlo Strategies in Scientific Computing, sec. 6.7 (grouping); Green (1995), Biometrika
    82, of proposals that draw what a new model needs from its prior.
    """

    label = "redrawn"
    evaluations = 2.0  # before and after

    def __init__(
        self,
        target: Target,
        blankets: Mapping[str, Blanket],
        group: _Group,
        turn: int = 0,
        turns: int = 1,
    ) -> None:
        self.target = target
        self.names = group.names
        self.blanket = blankets[group.names[0]]
        self.group = group
        self.turn, self.turns = turn, turns
        #: whether elements that take turns do so from the last one on
        self.from_last = False
        self.drawn = tuple(n for n in target.chain if n in group.names[1:])
        self.match = f"with {', '.join(self.drawn)} drawn anew"
        domain = self.blanket.node.domain
        assert domain is not None
        self.states, self.dtype = domain.size, domain.dtype
        own = {id(target.terms[n]) for n in self.drawn}
        self.terms = tuple(t for t in target.terms_of(self.names) if id(t) not in own)

    def words(self, name: str) -> tuple[str, str]:
        first = self.names[0]
        return self.label, self.match if name == first else f"anew with {first}"

    def start(self, values: Values, chains: int) -> Memory:
        return {"sweep": self.turn, "renewed": np.zeros((chains, self.blanket.size))}

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        memory = {**memory, "sweep": memory["sweep"] + 1}
        now = {n: values[n] for n in self.names}
        if memory["sweep"] % self.turns:
            return now, memory
        state = dict(values)
        for members in self._sets():
            rate = self._move(state, members, rng)
            if not warmup:
                renewed = memory["renewed"].copy()
                renewed[:, slice(None) if members is None else members] += rate
                memory["renewed"] = renewed
        return {n: state[n] for n in self.names}, memory

    # ---- private -------------------------------------------------------------------------------

    def _sets(self) -> list[np.ndarray | None]:
        """Elements to be moved in turn."""
        if not self.blanket.node.plates:
            return [None]
        free = self.target.free_elements(self.names[0])
        if self.group.apart is not None:
            return [free]
        each = list(range(self.blanket.size) if free is None else free)
        return [np.array([e]) for e in (each[::-1] if self.from_last else each)]

    def _move(
        self, state: Values, members: np.ndarray | None, rng: np.random.Generator
    ) -> np.ndarray:
        """Move some elements in ``state``; the chance of taking each proposal, shape (chains, members)."""
        chains = len(state[self.names[0]])
        try:
            new, dead = self._proposed(state, members, rng)
            log = self._log(new) - self._log(state)
        except BayesmcError:  # a function may mind a state that chains never meet
            return np.zeros((chains, 1))
        if self.group.apart is None:
            dead = np.asarray(dead.reshape(chains, -1).any(axis=1))
        log = np.where(dead, -np.inf, log)
        take = accepted(log, rng)
        for name in self.names:
            state[name] = instead(~take, new[name], state[name])
        self.target.refresh(state, self.names)
        rate = np.exp(np.minimum(np.nan_to_num(log, nan=-np.inf), 0.0)).reshape(chains, -1)
        return rate if members is None or rate.shape[1] == 1 else rate[:, members]

    def _proposed(
        self, state: Values, members: np.ndarray | None, rng: np.random.Generator
    ) -> tuple[Values, np.ndarray]:
        """A state with proposals in place, and which of them are impossible, (chains, *plates)."""
        name, now, trial = self.names[0], state[self.names[0]], dict(state)
        asked = np.zeros(self.blanket.size, dtype=bool)
        asked[slice(None) if members is None else members] = True
        asked = np.broadcast_to(asked.reshape(now.shape[1:]), now.shape)
        step = 1 + (rng.random(now.shape) * (self.states - 1)).astype(int)
        flip = asked & (rng.random(now.shape) < 0.5)
        trial[name] = np.where(flip, (now + step) % self.states, now).astype(self.dtype)
        dead = ~(np.broadcast_to(self.blanket.own_log(trial), now.shape) > -np.inf)
        trial[name] = instead(dead, trial[name], now)
        self.target.compute(trial, self.blanket.path)
        for other in self.drawn:
            dist, _ = self.target.terms[other].distribution(trial)
            draws = self.target.model.sample_stored(other, dist, rng, (len(now),))
            plates = draws.shape[: 1 + len(self.target.model[other].plates)]
            bad: np.ndarray = ~np.isfinite(draws.reshape(*plates, -1)).all(axis=-1)
            if dist.invalid is not None:
                bad = np.asarray(bad | dist.invalid)
            dead = dead | (bad if now.ndim > 1 else bad.reshape(len(now), -1).any(axis=1))
            kept = bad | ~asked if now.ndim > 1 else bad
            trial[other] = instead(kept, draws, state[other])
            self.target.compute(trial, self.target.below((other,)))
        return trial, dead

    def _log(self, state: Values) -> np.ndarray:
        """Log density of all but what is drawn: of every element, or of every chain."""
        if self.group.apart is None:
            return np.asarray(self.target.log_density(state, self.terms))
        total: Any = self.blanket.own_log(state)
        for blanket, child in self.group.apart:
            total = total + blanket.child_log(child, state)
        return np.broadcast_to(total, state[self.names[0]].shape)


def redrawn_kernels(
    target: Target, blankets: Mapping[str, Blanket], joined: Collection[Kernel] = ()
) -> list[Kernel]:
    """The kernels for all finite nodes that may wait for what is hidden below them.

    Parameters
    ----------
    target : Target
    blankets : dict
        Of the nodes that are to be moved.
    joined : sequence of Kernel
        Others that there are: what one of them moves together does not wait.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.redrawn import redrawn_kernels
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("on", bmc.Bernoulli(0.01))
    >>> net.add("level", lambda on: bmc.Normal(8.0 * on, 0.5))
    >>> net.add("seen", lambda level: bmc.StudentT(3.0, level, 1.0))
    >>> target = target_of(pose(net, {"seen": 6.0}))
    >>> kernels = redrawn_kernels(target, {n: Blanket(target, n) for n in target.chain})
    >>> [kernel.names for kernel in kernels]
    [('on', 'level')]
    """
    groups = []
    for name, children in waiting(target).items():
        if any({name, *children} <= set(kernel.names) for kernel in joined):
            continue
        for below in _drawn_with(target, name):
            if blankets.keys() >= {name, *below}:
                group = _grouped(target, blankets, (name, *below))
                groups += [] if group is None else [group]
    turns = -(-len(groups) // _AT_ONCE)
    return [
        Redrawn(target, blankets, group, turn % max(turns, 1), turns)
        for turn, group in enumerate(groups)
    ]


def waiting(target: Target) -> dict[str, tuple[str, ...]]:
    """Finite nodes of the chain with hidden numbers below them, or several elements, which are named."""
    found: dict[str, tuple[str, ...]] = {}
    for child in target.chain:
        term = target.terms.get(child)
        if term is None:
            continue
        for name in target.hidden_above(term):
            above = target.model[name]
            if above.domain is None or above.domain.size < 2:
                continue
            if target.model[child].domain is None or _is_one_of_many(above, target.model[child]):
                found[name] = (*found.get(name, ()), child)
    return found


def renewals(
    target: Target, kernels: Collection[Kernel], memory: Collection[Memory]
) -> dict[str, np.ndarray]:
    """How often chains have drawn anew what waits for a finite node: node -> counts, shape (*plates).

    It is the sum over chains of the chances that it was; none where nothing moves a node with what hangs on
    it. Nodes on which nothing hidden hangs, or only what is moved with them, are left out.
    """
    found = {}
    for name, below in waiting(target).items():
        count = np.zeros(target.model[name].plate_shape)
        for kernel, kept in zip(kernels, memory, strict=True):
            if isinstance(kernel, Redrawn):
                if kernel.names[0] == name:
                    renewed = kept["renewed"].sum(axis=0)
                    count = np.maximum(count, renewed.reshape(count.shape))
            elif {name, *below} <= set(kernel.names):
                break
        else:
            found[name] = count
    return found


# ---- private ------------------------------------------------------------------------------------


def _is_one_of_many(above: CompiledNode, child: CompiledNode) -> bool:
    """Whether many elements of a finite child hang on one of a node's."""
    return set(above.plates) < set(child.plates)


def _drawn_with(target: Target, name: str) -> list[tuple[str, ...]]:
    """What may be drawn anew with a node: its children that hold it, and all that is hidden below it."""
    children = waiting(target)[name]
    below = {name}
    for other in target.chain:
        term = target.terms.get(other)
        if term is not None and below & set(target.hidden_above(term)):
            below.add(other)
    every = tuple(n for n in target.chain if n in below and n != name)
    return [children] if every == children else [children, every]


def _grouped(
    target: Target, blankets: Mapping[str, Blanket], names: tuple[str, ...]
) -> _Group | None:
    """A node and what is drawn with it, where that is little and has a sampler; None elsewhere."""
    model, first = target.model, names[0]
    node, drawn = model[first], names[1:]
    if node.event_shape or node.domain is None or node.domain.size > _STATES:
        return None
    if blankets[first].own is None:
        return None
    each = sum(math.prod(model[n].value_shape) for n in drawn) / max(blankets[first].size, 1)
    if each > _NUMBERS or any(model[n].unsampled or target.seen(n) is not None for n in drawn):
        return None
    if not node.plates:
        return _Group(names, None)
    if any(model[n].plates != node.plates for n in drawn):
        return None
    entered: dict[str, list[tuple[Blanket, Child]]] = {}
    for name in names:
        for child in blankets[name].children:
            entered.setdefault(child.term.name, []).append((blankets[name], child))
    own = {n: entered.pop(n) for n in drawn if n in entered}
    if any(c.relation.kind != "aligned" for pairs in own.values() for _, c in pairs):
        return None
    if all(_is_apart(pairs) for pairs in entered.values()):
        return _Group(names, tuple(pairs[0] for pairs in entered.values()))
    return _Group(names, None) if blankets[first].size <= _ONE_BY_ONE else None


def _is_apart(pairs: list[tuple[Blanket, Child]]) -> bool:
    """Whether each element of a term depends on one element alone of the nodes that enter it."""
    if all(child.relation.kind == "aligned" for _, child in pairs):
        return True
    (blanket, child), *others = pairs
    return not others and child.relation.kind in ("lookup", "rows") and len(blanket.classes) == 1
