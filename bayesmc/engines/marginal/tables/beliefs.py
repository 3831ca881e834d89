"""Tables that particles carry: what they say of finite nodes, and one draw from each of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bayesmc.engines.marginal.tables.plan import Group
from bayesmc.network import CompiledNode


class Tables(NamedTuple):
    """Beliefs of all particles about finite nodes that are integrated out.

    Attributes
    ----------
    groups : tuple of Group
    logs : tuple of ndarray, shapes (particles, elements, states)
        Of each group, logs of probabilities; of a particle that is impossible, minus infinity throughout.
    """

    groups: tuple[Group, ...]
    logs: tuple[np.ndarray, ...]

    def taken(self, ancestors: np.ndarray | None) -> Tables:
        """Those of the ancestors, which may differ between elements of plates."""
        if ancestors is None:
            return self
        if ancestors.ndim == 1:
            return self._replace(logs=tuple(log.take(ancestors, axis=0) for log in self.logs))
        found = []
        for log in self.logs:
            apart = log.reshape(len(log), *ancestors.shape[1:], -1)
            moved = np.take_along_axis(apart, ancestors[..., None], 0)
            found.append(moved.reshape(len(ancestors), *log.shape[1:]))
        return self._replace(logs=tuple(found))

    def joined(self, parties: Sequence[Tables], at: np.ndarray) -> Tables:
        """Some of those of several parties, one after the other."""
        logs = (np.concatenate(own)[at] for own in zip(*(p.logs for p in parties), strict=True))
        return self._replace(logs=tuple(logs))

    def has(self, name: str) -> bool:
        """Whether there is a table about a node."""
        return any(name in g.names for g in self.groups)

    def probabilities(self, name: str) -> np.ndarray:
        """Of a node's states, shape ``(particles, *plates, states)``."""
        group, log = self._of(name)
        return group.probabilities(np.exp(log), name)

    def drawn(self, rng: np.random.Generator) -> list[np.ndarray]:
        """A joint state of each table, shapes ``(particles, elements)``."""
        return [drawn(log, rng) for log in self.logs]

    def values(
        self, codes: Sequence[np.ndarray], nodes: Sequence[CompiledNode]
    ) -> dict[str, np.ndarray]:
        """Stored values of nodes at joint states, shape ``(particles, *plates)``."""
        found = {}
        for group, own in zip(self.groups, codes, strict=True):
            for node in nodes:
                if node.name in group.names:
                    assert node.domain is not None
                    value = group.values(own, node.name).astype(node.domain.dtype)
                    value.flags.writeable = False
                    found[node.name] = value
        return found

    # ---- private -------------------------------------------------------------------------------

    def _of(self, name: str) -> tuple[Group, np.ndarray]:
        return next(p for p in zip(self.groups, self.logs, strict=True) if name in p[0].names)


def drawn(log: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Positions along the last axis by the exponentials of logs."""
    top = log.max(axis=-1, keepdims=True)
    shares = np.exp(log - np.where(top > -np.inf, top, 0.0)).cumsum(axis=-1)
    level = rng.random(log.shape[:-1]) * shares[..., -1]
    return np.minimum((shares <= level[..., None]).sum(axis=-1), log.shape[-1] - 1)
