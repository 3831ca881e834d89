"""Numbers that move along trajectories with finite nodes summed out, which are then drawn given them.

Drawn in turn with them, a label and what decides about it may cling to each other: an animal that was never
seen is either not there or hard to catch, and which of both changes only as fast as the slower of the two.
Summed out, it holds nothing. A trajectory leaves the numbers' own distribution as it is, and the labels come
from theirs given the numbers: together that is a move of all of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.kernels.base import Memory
from bayesmc.kernels.hamiltonian import Hamiltonian
from bayesmc.structure.free_density import UnconstrainedDensity
from bayesmc.structure.summed_states import StateDraws
from bayesmc.structure.target import Values


class SummedOut(Hamiltonian):
    """The No-U-Turn sampler on a density with finite nodes summed out of it, and a draw of these.

    Parameters
    ----------
    density : UnconstrainedDensity
        With ``summed`` nodes.
    given : tuple of str
    **options
        As of ``Hamiltonian``.

    Notes
    -----
    The trajectories do not depend on the states: others may move these as well.
    """

    def __init__(
        self, density: UnconstrainedDensity, given: tuple[str, ...] = (), **options: Any
    ) -> None:
        super().__init__(density, given, **options)
        self.names = (*density.names, *density.summed)
        self._domains = {n: density.target.model[n].domain for n in density.summed}
        self._states = StateDraws(density)

    def words(self, name: str) -> tuple[str, str]:
        domain = self._domains.get(name)
        if domain is None:
            return super().words(name)
        return "summed out", f"{domain.size} states, then drawn given all numbers"

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        new, memory = super().step(values, memory, rng, warmup)
        u = memory["place"]["u"]
        read = {**values, **new}
        if self.apart(memory):  # states are drawn given the numbers as they are declared
            u = self._moving.declared.unconstrain(read)
        states, _ = self._states(u, rng, None, read)
        return {**new, **states}, memory
