"""Finite nodes, alone or in small blocks that are drawn jointly: all their states given the rest.

One at a time, nodes tied by (nearly) deterministic tables hardly move, or not at all. Which nodes those are
is found in ``coupling``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from bayesmc.categorical import pick_log
from bayesmc.errors import UnsupportedError
from bayesmc.factors.named import Named, aligned
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.kernels.conditionals import FiniteTerm
from bayesmc.network import Model
from bayesmc.structure.relation import Relation, relation_of
from bayesmc.structure.target import Target, Term, Values

#: joint states of a block
MOST_STATES = 1024


class JointStates(Kernel):
    """Draws a block from all its joint states, whatever the terms around it are.

    Parameters
    ----------
    target : Target
    names : sequence of str
        As for `bayesmc.kernels.tables.joint_states`.
    """

    label = "enumerate jointly"

    def __init__(self, target: Target, names: Sequence[str]) -> None:
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
        self.terms: list[tuple[Term, Relation | None]] = []
        for term in target.terms_of(self.names):
            relations = [
                relation_of(target, n, term)
                for n in names
                if n != term.name and _enters(target, n, term)
            ]
            if self.plates and any(r.kind != "aligned" for r in relations):
                raise UnsupportedError(
                    f"{term.name!r} reads {list(names)} across elements of {self.plates}; their blocks "
                    "cannot be drawn one by one"
                )
            self.terms.append((term, None if term.name in names else relations[0]))

    def log_density(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Log full conditional of the joint states up to a constant, shape ``(states, chains, *plates)``."""
        now = values[self.names[0]]
        state = dict(values)
        axes = (1,) * now.ndim
        for name, codes, dtype in zip(self.names, self.states, self.dtypes, strict=True):
            state[name] = codes.astype(dtype).reshape(-1, *axes)
        self.target.refresh(state, self.names)
        total = np.zeros((self.states.shape[1], *now.shape))
        for term, relation in self.terms:
            log = term.log(state)
            total = total + (log if relation is None else relation.collect(log, term.shape))
        return self._with_seen(total)

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


class RowSums(JointStates):
    """As `JointStates`, where all terms are tables: the log rows that the rest selects are summed.

    Parameters
    ----------
    around : sequence of FiniteTerm
        All terms that the block enters.
    """

    def __init__(self, target: Target, names: Sequence[str], around: Sequence[FiniteTerm]) -> None:
        super().__init__(target, names)
        if len(self.names) == 1:
            self.label, self.match = "enumerate", "sum of tabulated log rows"
        relations = {term.name: relation for term, relation in self.terms}
        self.parts = [
            (_Rows(target.model, table, self.names, self.states), relations[table.term.name])
            for table in around
        ]

    def log_density(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        total = np.zeros((self.states.shape[1], *values[self.names[0]].shape))
        for rows, relation in self.parts:
            log = rows(values)
            total += (
                log if relation is None or not rows.shape else relation.collect(log, rows.shape)
            )
        return self._with_seen(total)


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
