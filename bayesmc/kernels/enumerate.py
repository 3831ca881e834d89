"""Finite nodes: the full conditional of every state, then a draw from it."""

from __future__ import annotations

import numpy as np

from bayesmc.categorical import pick_log
from bayesmc.errors import ModelError
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Values


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
