"""All elements of a finite node at once, though some term reads them together: proposed, then accepted by it.

Given all others the elements would be independent but for a term that ties them (both groups of a mixture
exist; a total was seen). Drawn from their full conditionals without that term they are a proposal that knows
nothing of where the chain stands, and the term's ratio alone decides (an independence Metropolis-Hastings
step). One that ties loosely accepts nearly always, and one call of each function moves all elements; where it
ties tightly the elements move one after the other, too.

References
----------
Tierney (1994), Markov chains for exploring posterior distributions, Annals of Statistics 22(4), sec. 2.3.3.
"""

from __future__ import annotations

import copy
import math

import numpy as np

from bayesmc.kernels.base import Kernel, Memory, counted
from bayesmc.kernels.enumerate import Enumerate
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.like_terms import with_like_children
from bayesmc.structure.target import Values

#: rate of acceptance below which the elements move one after the other, too, and how fast it is learnt
_OFTEN, _RATE = 0.25, 0.1


class EnumerateAtOnce(Kernel):
    """Proposes all elements of a finite node from their conditionals without what ties them."""

    label = "enumerate"
    band = None  # where few are accepted the elements move one by one

    def __init__(self, blanket: Blanket) -> None:
        self.blanket = blanket
        self.names = (blanket.name,)
        self.tying = [c.term for c in blanket.children if c.relation.kind == "whole"]
        free = copy.copy(blanket)
        free.children = tuple(c for c in blanket.children if c.relation.kind != "whole")
        free.classes = (blanket.target.free_elements(blanket.name),)
        free.broadcasts = True
        self.proposal = Enumerate(free)
        self.each = Enumerate(blanket)
        names = ", ".join(repr(term.name) for term in self.tying)
        self.match = f"{len(self.each.states)} states of all elements at once, accepted by {names}"
        self.evaluations = self.proposal.evaluations + 2

    def start(self, values: Values, chains: int) -> Memory:
        """Counts of what is accepted, the rate learnt so far, and whether elements move alone, too."""
        return {"accepted": np.zeros(chains), "moves": 0, "rate": 1.0}

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        name = self.blanket.name
        new = self.proposal.step(values, {}, rng, warmup)[0][name]
        state = {**values, name: new}
        self.blanket.target.compute(state, self.blanket.path)
        with np.errstate(
            invalid="ignore"
        ):  # of impossible places, which are left for possible ones
            ratio = self._tie(state) - self._tie(values)
        taken = rng.random(len(new)) < np.exp(np.minimum(ratio, 0.0))
        chosen = taken.reshape(-1, *(1,) * (new.ndim - 1))
        moved = {name: np.where(chosen, new, values[name])}
        if memory["rate"] < _OFTEN:
            moved = self.each.step({**values, **moved}, {}, rng, warmup)[0]
        if warmup:
            rate = (1 - _RATE) * memory["rate"] + _RATE * float(taken.mean())
            memory = {**memory, "rate": rate}
        else:
            memory = counted(memory, taken)
        return moved, memory

    def _tie(self, values: Values) -> np.ndarray:
        """Log of the terms that tie the elements, shape ``(chains,)``."""
        total = np.zeros(len(values[self.blanket.name]))
        for term in self.tying:
            log = np.asarray(term.log(values))
            lead = log.shape[: log.ndim - len(term.plates)]
            whole = np.broadcast_to(log, lead + term.shape)
            total = total + whole.reshape(*lead, math.prod(term.shape)).sum(axis=-1)
        return total


def enumerate_kernel(blanket: Blanket) -> Kernel:
    """All elements at once where only terms that read all of them tie them, else one colour at a time."""
    kinds = {child.relation.kind for child in blanket.children}
    tied = len(blanket.classes) > 1 and "whole" in kinds and kinds <= {"whole", "aligned"}
    return EnumerateAtOnce(blanket) if tied else Enumerate(with_like_children(blanket))
