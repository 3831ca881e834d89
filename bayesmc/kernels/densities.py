"""Log densities that an accept step compares: where the chains are, and where they might go.

An impossible proposal is noticed by the moved node's own density, before anything else sees it: functions
below may fail where the model says that nothing happens. How proposals are made is the kernels' affair.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Term, Values

#: name, distribution (None for a variable of a factor graph) -> value, log volume of each chain
Candidate = Callable[[str, Distribution | None], tuple[np.ndarray, Any]]


@dataclass(frozen=True, eq=False)
class Compared:
    """A node's elements where they are and where they might go.

    Attributes
    ----------
    new : ndarray
        The proposal; where it is impossible, the current value.
    dead : ndarray of bool, shape (chains, *plates); of a class (chains, members)
        Proposals that are impossible.
    own, rest : ndarray, shape (chains, *plates); of a class (chains, members)
        How much the proposal raises the node's own log density, and all other terms.
    """

    new: np.ndarray
    dead: np.ndarray
    own: np.ndarray
    rest: np.ndarray


def compare(
    blanket: Blanket,
    values: Values,
    new: np.ndarray,
    members: np.ndarray | None,
    dead: np.ndarray | None = None,
) -> Compared:
    """The full conditional of every element at a proposal, minus that at its current value.

    Parameters
    ----------
    new : ndarray, shape (chains, *plates, *event); of a class (chains, members, *event)
    dead : ndarray of bool, optional
        Proposals that are impossible already.
    """
    now = blanket.current(values, members)
    shape = now.shape[: now.ndim - len(blanket.event_shape)]
    if dead is not None and dead.any():
        new = instead(dead, new, now)
    state = blanket.placed(values, np.stack([now, new]), members)
    own = np.broadcast_to(blanket.own_log(state, members), (2, *shape))
    fallen = ~(own[1] > -np.inf)
    if fallen.any():
        dead = fallen if dead is None else dead | fallen
        new = instead(fallen, new, now)
        state = blanket.placed(values, np.stack([now, new]), members)
    rest: Any = 0.0
    for child in blanket.children:
        rest = rest + blanket.child_log(child, state, members)
    gain = np.broadcast_to(rest, (2, *shape))
    dead = np.zeros(shape, dtype=bool) if dead is None else dead
    with np.errstate(invalid="ignore"):
        return Compared(
            new, dead, np.where(dead, -np.inf, own[1] - own[0]), _difference(gain[1], gain[0])
        )


def instead(dead: np.ndarray, new: np.ndarray, now: np.ndarray) -> np.ndarray:
    """``new`` with elements that are impossible replaced by ``now``."""
    event = new.ndim - dead.ndim
    return np.where(dead.reshape(dead.shape + (1,) * event), now, new)


def accepted(log_ratio: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Which proposals are taken: with probability ``min(1, exp(log_ratio))``, never where it is NaN."""
    return -rng.standard_exponential(log_ratio.shape) < log_ratio


class Block:
    """The joint full conditional of some chain nodes.

    Attributes
    ----------
    names : tuple of str
        The nodes, parents first.
    order : tuple of str
        The same, with the deterministic nodes that follow from them in place.
    own : dict
        Node -> its own term, where it has one.
    others : tuple of Term
        All other terms that they enter; potentials first, since they may exclude a configuration.
    scope, given : tuple of str
        Varying nodes that must have values, and what is known besides.
    """

    def __init__(self, target: Target, names: Iterable[str]) -> None:
        inside = set(names)
        self.target = target
        self.names = tuple(n for n in target.chain if n in inside)
        below = set(target.below(self.names))
        self.order = tuple(n for n in target.model.nodes if n in inside or n in below)
        terms = target.terms_of(self.names)
        self.own = {n: target.terms[n] for n in self.names if n in target.terms}
        mine = set(map(id, self.own.values()))
        others = [t for t in terms if id(t) not in mine]
        self.others = tuple(sorted(others, key=lambda t: not t.is_potential))
        read = {n for t in terms for n in t.scope}.union(*(target.model[n].parents for n in below))
        varying = (*target.chain, *target.links)
        self.scope = tuple(n for n in varying if n in read or n in inside or n in below)
        self.given = tuple(n for n in target.known if n in read)

    def has_own_data(self, values: Values) -> bool:
        """Whether what is observed differs from chain to chain: it then has an axis of chains in front."""
        known = self.target.known
        return any(values[n] is not known[n] for n in self.given)

    def rows(self, values: Values, index: Any) -> Values:
        """The state of some chains alone."""
        known = self.target.known
        data = {n: values[n] if values[n] is known[n] else values[n][index] for n in self.given}
        return {**data, **{n: values[n][index] for n in self.scope}}

    def log(self, values: Values, candidate: Candidate | None = None) -> tuple[Values, np.ndarray]:
        """Sum of all terms of the block, log volumes included.

        Parameters
        ----------
        values : dict
            Where the chains are; it replaces candidates that are impossible.
        candidate : callable, optional
            Gives a node's value once its distribution is known; without it, nodes stay.

        Returns
        -------
        state : dict
            Values with the candidates in place, and what follows from them.
        log : ndarray, shape (chains,)
            Minus infinity where the candidate is impossible.
        """
        model, state = self.target.model, dict(values)
        total: Any = np.zeros(len(values[self.names[0]]))
        done: list[str] = []
        for name in self.order:
            term = self.own.get(name)
            done.append(name)
            if name not in self.names:
                state[name], _ = model.evaluate(name, state)
                continue
            dist, batch = (None, ()) if term is None else term.distribution(state)
            volume: Any = 0.0
            if candidate is not None:
                new, volume = candidate(name, dist)
                dead = ~(total > -np.inf)
                state[name] = instead(dead, new, values[name]) if dead.any() else new
            log = 0.0 if dist is None else _summed(term, term.log_of(dist, batch, state[name]))  # type: ignore[union-attr, arg-type]
            total = self._added(total, log + volume, state, values, done)
        for term in self.others:
            total = self._added(total, _summed(term, term.log(state)), state, values, done)
        return state, total

    def _added(
        self, total: np.ndarray, log: Any, state: Values, values: Values, done: list[str]
    ) -> np.ndarray:
        """One more part of the sum; what becomes impossible is put back where it was."""
        was = total > -np.inf
        total = total + log
        if total.min() > -np.inf:  # false for NaN, too
            return total
        total = np.where(was, total, -np.inf)
        dead = ~(total > -np.inf)
        if (dead & was).any():
            total = np.where(dead, -np.inf, total)
            for name in done:
                state[name] = instead(dead, state[name], values[name])
        return total


# ---- private ------------------------------------------------------------------------------------


def _summed(term: Term, log: np.ndarray) -> np.ndarray:
    """Log factors added over the elements of a term, one sum for each chain."""
    if not term.shape:
        return log
    lead = log.shape[: max(log.ndim - len(term.shape), 0)]
    return np.broadcast_to(log, lead + term.shape).sum(axis=tuple(range(-len(term.shape), 0)))


def _difference(new: np.ndarray, now: np.ndarray) -> np.ndarray:
    """``new - now``; from an impossible value to an equally impossible one there is no change."""
    return np.where(new == now, 0.0, new - now)
