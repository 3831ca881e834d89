"""Finite nodes: the full conditional of every state, then a draw from it."""

from __future__ import annotations

import numpy as np

from bayesmc.errors import ModelError, ZeroProbabilityError
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
            new = draw_states(log, rng, blanket.name).astype(self.states.dtype)
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


def draw_states(log: np.ndarray, rng: np.random.Generator, name: str) -> np.ndarray:
    """Positions drawn from unnormalised log probabilities, states first: shape ``log.shape[1:]``."""
    return states_at(log, rng.random(log.shape[1:]), name)


def states_at(log: np.ndarray, uniform: np.ndarray, name: str) -> np.ndarray:
    """As ``draw_states``, from uniform random numbers of shape ``log.shape[1:]``."""
    count = len(log)
    top = log[0]
    for k in range(1, count):
        top = np.maximum(top, log[k])
    if not np.isfinite(top).all():
        raise ZeroProbabilityError(
            f"node {name!r}: no state has positive probability given the others; the chain is at an "
            "impossible configuration"
        )
    edges = np.exp(log[0] - top)
    cumulative = [edges]
    for k in range(1, count):
        edges = edges + np.exp(log[k] - top)
        cumulative.append(edges)
    level = uniform * edges
    found = (level >= cumulative[0]).view(np.uint8)
    for k in range(1, count - 1):
        found = found + (level >= cumulative[k])
    return found if count > 1 else np.zeros(top.shape, dtype=np.uint8)
