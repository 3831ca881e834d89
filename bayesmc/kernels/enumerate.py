"""Finite nodes by trying all their states: one at a time, or small blocks jointly.

A term (a node's density or a potential) that depends on finite hidden nodes alone is evaluated once on all
their states, with evidence filled in and deterministic nodes passed through; any other in every step. One at
a time, nodes tied by (nearly) deterministic tables hardly move, or not at all: which nodes those are is found
in ``coupling``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayesmc.categorical import pick_log
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, ModelError, UnsupportedError
from bayesmc.factors.named import Named, aligned, log_product
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.network import Model
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.relation import Relation, relation_of
from bayesmc.structure.tables import configure, reads_of
from bayesmc.structure.target import Target, Term, Values

#: joint states of a block
MOST_STATES = 1024
#: entries up to which a term is tabulated
_TERM_ENTRIES = 1 << 22
#: configurations of a Markov blanket, and entries with the states, up to which a conditional is tabulated
_CONFIGURATIONS = 1 << 16
_ENTRIES = 1 << 20


class Enumerate(Kernel):
    """Draws a finite node from its full conditional, all states tried."""

    label = "enumerate"

    def __init__(self, blanket: Blanket) -> None:
        self.blanket = blanket
        self.names = (blanket.name,)
        domain = blanket.node.domain
        assert domain is not None
        self.states = np.arange(domain.size, dtype=domain.dtype)
        self.match = f"{domain.size} states"
        self.evaluations = float(domain.size)

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        blanket = self.blanket
        state = values
        for members in blanket.classes:
            now = blanket.current(state, members)
            candidate = self.states.reshape((-1,) + (1,) * now.ndim)
            if members is not None:
                candidate = np.broadcast_to(candidate, (len(self.states), 1, len(members)))
            try:
                log = blanket.log_density(state, candidate, members)
            except ModelError:
                log = self._possible(state, candidate, now, members)
            log = np.broadcast_to(log, (len(self.states), *now.shape))
            new = pick_log(log, rng.random(now.shape), f"node {blanket.name!r}")
            new = new.astype(self.states.dtype)
            state = {**state, blanket.name: blanket.moved(state, new, members)}
        return {blanket.name: state[blanket.name]}, memory

    def _possible(
        self,
        state: Values,
        candidate: np.ndarray,
        now: np.ndarray,
        members: np.ndarray | None,
    ) -> np.ndarray:
        """Log full conditionals where a child's function fails at states that are impossible anyway."""
        blanket = self.blanket
        full = np.broadcast_to(candidate, (len(self.states), *now.shape))
        own = blanket.own_log(
            {**state, blanket.name: blanket.filled(state, full, members)}, members
        )
        impossible = np.broadcast_to(own, full.shape) == -np.inf
        if not impossible.any():
            return blanket.log_density(state, candidate, members)  # the fault is another
        log = blanket.log_density(state, np.where(impossible, now, full), members)
        return np.where(impossible, -np.inf, log)


class JointStates(Kernel):
    """Draws a block from all its joint states, whatever the terms around it are.

    Parameters
    ----------
    target : Target
    names : sequence of str
        As for `bayesmc.kernels.tables.joint_states`.
    terms : FiniteTerms, optional
        Of terms that are tables the log rows that the rest selects are summed; others are evaluated.
    """

    label = "enumerate jointly"

    def __init__(
        self, target: Target, names: Sequence[str], terms: FiniteTerms | None = None
    ) -> None:
        self.target = target
        self.names = tuple(names)
        nodes = [target.model[n] for n in names]
        domains = [n.domain for n in nodes]
        self.plates = nodes[0].plates
        cards = [d.size for d in domains if d is not None]
        if len(cards) < len(nodes) or (len(cards) > 1 and math.prod(cards) > MOST_STATES):
            raise UnsupportedError(
                f"nodes {list(names)} have no joint states to try, or more than {MOST_STATES}; leave some out"
            )
        if any(n.plates != self.plates for n in nodes):
            raise UnsupportedError(
                f"nodes {list(names)} live in different plates; join nodes of the same plates"
            )
        self.states = np.indices(cards).reshape(len(cards), -1)
        self.dtypes = [d.dtype for d in domains if d is not None]
        self.match = f"{self.states.shape[1]} joint states of {', '.join(names)}"
        self.parts: list[tuple[Term | _Rows, Relation | None]] = []
        for term in target.terms_of(self.names):
            table = None if terms is None else terms.of(term)
            rows = term if table is None else _Rows(target.model, table, self.names, self.states)
            self.parts.append((rows, self._relation(term)))
        #: terms that are no tables
        self.evaluated = [part for part, _ in self.parts if isinstance(part, Term)]
        if len(self.names) == 1 and not self.evaluated:
            self.label, self.match = "enumerate", "sum of tabulated log rows"

    def _relation(self, term: Term) -> Relation | None:
        """How a term reads the block, element by element; None of a density of the block itself."""
        entering = [n for n in self.names if n != term.name and _enters(self.target, n, term)]
        relations = [relation_of(self.target, n, term) for n in entering]
        if self.plates and any(r.kind != "aligned" for r in relations):
            raise UnsupportedError(
                f"{term.name!r} reads {list(self.names)} across elements of {self.plates}; their blocks "
                "cannot be drawn one by one"
            )
        return None if term.name in self.names else relations[0]

    def log_density(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Log full conditional of the joint states up to a constant, shape ``(states, chains, *plates)``."""
        total = np.zeros((self.states.shape[1], *values[self.names[0]].shape))
        state = self._everywhere(values, total.ndim - 1) if self.evaluated else {}
        for part, relation in self.parts:
            log = part(values) if isinstance(part, _Rows) else part.log(state)
            total += (
                log if relation is None or not part.shape else relation.collect(log, part.shape)
            )
        return self._with_seen(total)

    def _everywhere(self, values: Mapping[str, np.ndarray], ndim: int) -> Values:
        """The state with the block at all its joint states."""
        state = dict(values)
        for name, codes, dtype in zip(self.names, self.states, self.dtypes, strict=True):
            state[name] = codes.astype(dtype).reshape(-1, *(1,) * ndim)
        self.target.refresh(state, self.names)
        return state

    def _with_seen(self, total: np.ndarray) -> np.ndarray:
        """What was seen of the elements leaves no other state."""
        axes = (1,) * (total.ndim - 1)
        for name, codes in zip(self.names, self.states, strict=True):
            seen = self.target.seen(name)
            if seen is not None and seen.mask is not None:
                other = codes.reshape(-1, *axes) != seen.value
                total = np.where(other & seen.mask, -np.inf, total)
        return total

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        log = self.log_density(values)
        drawn = pick_log(log, rng.random(log.shape[1:]), f"nodes {list(self.names)}")
        moved = zip(self.names, self.states, self.dtypes, strict=True)
        return {n: codes[drawn].astype(dtype) for n, codes, dtype in moved}, memory


@dataclass(frozen=True, eq=False)
class FiniteTerm:
    """A term over finite chain nodes, everything else filled in.

    Attributes
    ----------
    scope : tuple of str
        The chain nodes that it depends on, in axis order.
    log : ndarray, shape (*cards, *shape)
        Log factors. ``shape`` is that of the term's plates where some node of the scope has plates; else
        ``()``, the plates summed over.
    plates : tuple of str
        Names of the axes of ``shape``.
    """

    term: Term
    scope: tuple[str, ...]
    log: np.ndarray
    plates: tuple[str, ...] = ()


class FiniteTerms:
    """The terms of a target as tables, each made when first asked for."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self._made: dict[str, FiniteTerm | None] = {}

    def of(self, term: Term) -> FiniteTerm | None:
        """The table of a term; None where it is none, or too large."""
        if term.name not in self._made:
            self._made[term.name] = _tabulated(self.target, term)
        return self._made[term.name]

    def around(self, names: Sequence[str]) -> tuple[FiniteTerm, ...] | None:
        """All terms that some nodes enter; None where one is no table."""
        found = []
        for term in self.target.terms_of(names):
            table = self.of(term)
            if table is None:
                return None
            found.append(table)
        return tuple(found)


@dataclass(frozen=True, eq=False)
class Conditional:
    """The joint full conditional of a block of nodes without plates.

    Attributes
    ----------
    names : tuple of str
        The block; its joint states run in C order, the last node fastest.
    cards : tuple of int
        States of each.
    blanket : tuple of str
        The chain nodes it depends on.
    blanket_cards : tuple of int
    probs : ndarray, shape (configurations of the blanket, joint states)
        Rows sum to one; a row of zeros is an impossible configuration.
    """

    names: tuple[str, ...]
    cards: tuple[int, ...]
    blanket: tuple[str, ...]
    blanket_cards: tuple[int, ...]
    probs: np.ndarray

    @property
    def states(self) -> int:
        """Number of joint states."""
        return self.probs.shape[1]

    @property
    def strides(self) -> tuple[int, ...]:
        """Weight of each node of the blanket in the number of a configuration."""
        return tuple(math.prod(self.blanket_cards[i + 1 :]) for i in range(len(self.blanket)))

    def probabilities(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Probabilities of the joint states given the rest, shape (chains or 1, joint states)."""
        at = np.zeros(1, dtype=np.intp)
        for name, stride in zip(self.blanket, self.strides, strict=True):
            at = at + values[name].astype(np.intp) * stride
        return self.probs[at]


def conditional_of(terms: FiniteTerms, names: Sequence[str]) -> Conditional | None:
    """The full conditional of a block over its Markov blanket; None where it is no table of moderate size.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.enumerate import FiniteTerms, conditional_of
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Bernoulli(0.5))
    >>> net.add("y", lambda x: bmc.Bernoulli(0.2 + 0.6 * x))
    >>> target = target_of(pose(net, {"y": 1}))
    >>> conditional_of(FiniteTerms(target), ["x"]).probs.round(3).tolist()
    [[0.2, 0.8]]
    """
    model = terms.target.model
    around = terms.around(names)
    if around is None or any(model[n].plates or model[n].domain is None for n in names):
        return None
    everyone = dict.fromkeys(n for table in around for n in table.scope)
    if any(model[n].plates for n in everyone):
        return None
    blanket = tuple(n for n in everyone if n not in names)
    block = tuple(names)
    cards, outside = _cards(model, block), _cards(model, blanket)
    rows, states = math.prod(outside), math.prod(cards)
    if rows > _CONFIGURATIONS or rows * states > _ENTRIES:
        return None
    axes = (*blanket, *block)
    sizes = dict(zip(axes, outside + cards, strict=True))
    tables = [Named(table.scope, table.log) for table in around]
    log = log_product(tables, axes, sizes).reshape(rows, states)
    top = log.max(axis=1, keepdims=True)
    probs = np.exp(log - np.where(top > -np.inf, top, 0.0))
    sums = probs.sum(axis=1, keepdims=True)
    return Conditional(block, cards, blanket, outside, probs / np.where(sums > 0, sums, 1.0))


# ---- private ------------------------------------------------------------------------------------


class _Rows:
    """Log factors of one term for all joint states of a block, gathered by the states of the others."""

    def __init__(
        self, model: Model, table: FiniteTerm, names: Sequence[str], states: np.ndarray
    ) -> None:
        scope = table.scope
        inside = [i for i, n in enumerate(scope) if n in names]
        outside = [i for i, n in enumerate(scope) if n not in names]
        log = table.log.transpose(*inside, *outside, *range(len(scope), table.log.ndim))
        cards, sizes = log.shape[: len(inside)], log.shape[len(inside) :]
        self.plates, self.shape = table.plates, sizes[len(outside) :]
        self.others = [
            (scope[i], model[scope[i]].plates, math.prod(sizes[k + 1 :]))
            for k, i in enumerate(outside)
        ]
        self.offset = np.arange(math.prod(self.shape)).reshape(self.shape)
        log = log.reshape(math.prod(cards), -1)
        own = [states[names.index(scope[i])] for i in inside]
        self.log = np.ascontiguousarray(log)
        at = np.ravel_multi_index(own, cards)
        self.local = None if np.array_equal(at, np.arange(len(log))) else at

    def __call__(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Shape ``(joint states, chains or 1, *shape)``."""
        index = self.offset[None]
        for name, plates, stride in self.others:
            at = values[name]
            if self.shape:
                at = aligned(Named(plates, at), self.plates)
            index = index + at.astype(np.intp) * stride
        found = self.log.take(index, axis=1)
        return found if self.local is None else found.take(self.local, axis=0)


def _enters(target: Target, name: str, term: Term) -> bool:
    return bool({name, *target.below((name,))} & set(term.scope))


def _tabulated(target: Target, term: Term) -> FiniteTerm | None:
    model = target.model
    scope, whole, others = reads_of(model, term.scope, term.plates, target.is_known, True)
    if whole or others:
        return None
    cards = _cards(model, scope)
    if float(math.prod(cards)) * math.prod(term.shape) > _TERM_ENTRIES:
        return None
    try:
        with marking_invalid(), np.errstate(all="ignore"):
            values, _ = configure(model, target.known, scope, (), term.scope)
            if term.is_potential:
                log = term.log(values)
            else:
                dist, batch = term.distribution(values)
                if dist.invalid is not None and dist.invalid.any():
                    return None  # perhaps only where the configuration is impossible
                log = term.log_of(dist, batch, values[term.name])
    except BayesmcError:
        return None  # it fails at some configuration, perhaps an impossible one
    log = np.broadcast_to(log, cards + term.shape)
    if not any(model[n].plates for n in scope):
        return FiniteTerm(term, scope, log.sum(axis=tuple(range(len(cards), log.ndim))))
    return FiniteTerm(term, scope, log, term.plates)


def _cards(model: Model, names: Sequence[str]) -> tuple[int, ...]:
    return tuple(model[n].domain.size for n in names)  # type: ignore[union-attr]
