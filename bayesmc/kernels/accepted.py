"""Draws from a full conditional that leaves some terms out, accepted or refused by these.

A potential that orders two means has no conjugate pair; a term that reads all labels together (both groups of
a mixture exist; a total was seen) ties them. Without such terms the conditional is drawn at once. That draw
knows nothing of where the chain stands, and so the ratio of the terms left out alone decides (an independence
Metropolis-Hastings step). Such a chain forgets its start at one rate only where the ratio of the posterior to
the proposal is bounded, and it is slow where the bound is far above its average: a place that the proposal
hardly reaches and that the terms favour is never left once it is reached, or never reached, however often
draws are accepted elsewhere. So the node moves by the kernel that sees the terms in every sweep, too, unless
they only say what is possible (there a draw is accepted with the same probability wherever the chain stands)
and do not refuse most draws.

References
----------
Tierney (1994), Markov chains for exploring posterior distributions, Annals of Statistics 22(4), sec. 2.3.3;
Mengersen and Tweedie (1996), Rates of convergence of the Hastings and Metropolis algorithms, Annals of
Statistics 24(1), theorem 2.1.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence

import numpy as np

from bayesmc.kernels.base import ANYHOW, How, Kernel, Memory, counted
from bayesmc.kernels.conjugate import Conjugate, conjugate_kernel
from bayesmc.kernels.enumerate import Enumerate
from bayesmc.kernels.slice import Slice
from bayesmc.passes.branches import is_constraint
from bayesmc.structure.blanket import Blanket, Child
from bayesmc.structure.like_terms import with_like_children
from bayesmc.structure.target import Values

#: rate of acceptance below which the node moves by the other kernel, too, and how fast it is learnt (from 0)
_OFTEN, _RATE = 0.25, 0.1


class Accepted(Kernel):
    """Proposes a node from its conditional without some terms.

    Parameters
    ----------
    blanket : Blanket
    left_out : sequence of Child
        Terms that decide.
    proposal : Kernel
        Draws the whole node from its conditional without them, wherever it stands: what has one colour.
    other : Kernel
        Moves it, too, where these terms are more than constraints, or refuse most draws.
    """

    band = None  # where few are accepted the node moves otherwise

    def __init__(
        self, blanket: Blanket, left_out: Sequence[Child], proposal: Kernel, other: Kernel
    ) -> None:
        self.blanket = blanket
        self.names = (blanket.name,)
        self.left_out = [child.term for child in left_out]
        found = [term.expression for term in self.left_out]
        self.constraints = all(e is not None and is_constraint(e) for e in found)
        self.proposal = proposal
        self.other: Kernel | None = other
        self.label = proposal.label
        names = ", ".join(repr(term.name) for term in self.left_out)
        self.match = f"{proposal.match}, accepted by {names}"
        self.evaluations = proposal.evaluations + 2
        if not self.constraints:
            self.evaluations += other.evaluations

    def expect(self, steps: int, chains: int) -> None:
        """Both kernels may want to know."""
        self.proposal.expect(steps, chains)
        if self.other is not None:
            self.other.expect(steps, chains)

    def start(self, values: Values, chains: int) -> Memory:
        """What the kernels remember, counts of what is accepted, and the rate learnt so far."""
        kernels = {"proposal": self.proposal, "other": self.other}
        memory = {n: k.start(values, chains) for n, k in kernels.items() if k is not None}
        return {**memory, "accepted": np.zeros(chains), "moves": 0, "rate": 0.0}

    def alone(self) -> Accepted:
        """The same without the other kernel: a single update, in balance with the way back."""
        found = copy.copy(self)
        found.other = None
        return found

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        name = self.blanket.name
        memory = dict(memory)
        new, taken = self._proposed(values, memory, rng, warmup)
        if self.other is not None and (not self.constraints or memory["rate"] < _OFTEN):
            state = {**values, name: new}
            self.blanket.target.compute(state, self.blanket.path)
            found, memory["other"] = self.other.step(state, memory["other"], rng, warmup)
            new = found[name]
        if not warmup:
            return {name: new}, counted(memory, taken)
        memory["rate"] = (1 - _RATE) * memory["rate"] + _RATE * float(taken.mean())
        return {name: new}, memory

    def moved(self, values: Values, memory: Memory) -> Memory:
        """What both kernels knew of the old place goes."""
        return self._each(memory, lambda kernel, own: kernel.moved(values, own))

    def end_warmup(self, memory: Memory) -> Memory:
        """Which kernels go on is settled."""
        return self._each(memory, lambda kernel, own: kernel.end_warmup(own))

    def _each(self, memory: Memory, done: Callable[[Kernel, Memory], Memory]) -> Memory:
        kernels = {"proposal": self.proposal, "other": self.other}
        return memory | {n: done(k, memory[n]) for n, k in kernels.items() if k is not None}

    def _proposed(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """New values where they are accepted, and which are; the proposal's memory is put in place."""
        name, target = self.blanket.name, self.blanket.target
        drawn, memory["proposal"] = self.proposal.step(values, memory["proposal"], rng, warmup)
        state = {**values, name: drawn[name]}
        target.compute(state, self.blanket.path)
        with np.errstate(invalid="ignore"):  # of impossible places, left for possible ones
            ratio = self._log(state) - self._log(values)
        taken = rng.random(len(ratio)) < np.exp(np.minimum(ratio, 0.0))
        chosen = taken.reshape(-1, *(1,) * (drawn[name].ndim - 1))
        return np.where(chosen, drawn[name], values[name]), taken

    def _log(self, values: Values) -> np.ndarray:
        """Log of the terms left out, shape ``(chains,)``."""
        total = np.zeros(len(values[self.blanket.name]))
        for term in self.left_out:
            log = np.asarray(term.log(values))
            lead = log.shape[: log.ndim - len(term.plates)]
            whole = np.broadcast_to(log, lead + term.shape)
            total = total + whole.reshape(*lead, math.prod(term.shape)).sum(axis=-1)
        return total


def finite_kernel(blanket: Blanket) -> Kernel:
    """All elements at once where only terms that read all of them tie them, else one colour at a time."""
    tying = [child for child in blanket.children if child.relation.kind == "whole"]
    if len(blanket.classes) > 1 and tying:
        free = _without(blanket, tying)
        if all(child.relation.kind == "aligned" for child in free.children):
            return Accepted(blanket, tying, Enumerate(free), Enumerate(blanket))
    return Enumerate(with_like_children(blanket))


def number_kernel(blanket: Blanket, debug: bool = False, how: How = ANYHOW) -> Kernel:
    """The closed form that a node has but for potentials, accepted by these; slices where it has none."""
    slices = Slice(with_like_children(blanket), debug, how)
    potentials = [child for child in blanket.children if child.term.is_potential]
    if not potentials:
        return slices
    found = conjugate_kernel(_without(blanket, potentials), debug)
    if not isinstance(found, Conjugate) or len(found.blanket.classes) > 1:
        return slices
    return Accepted(blanket, potentials, found, slices)


# ---- private ------------------------------------------------------------------------------------


def _without(blanket: Blanket, children: Sequence[Child]) -> Blanket:
    """The blanket of a target without some terms."""
    free = copy.copy(blanket)
    free.children = tuple(child for child in blanket.children if child not in children)
    free.classes = free.colours()
    free.broadcasts = all(c.relation.kind == "aligned" for c in free.children)
    return free
