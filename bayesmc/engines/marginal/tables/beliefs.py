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
    past : tuple of tuples of ndarray, shapes (particles or 1, elements or 1, states, states)
        For one slice before, two, and so on, and each group, the probabilities of the states there (rows)
        given those of this slice (columns), along the particle's ancestors. A row that comes says nothing
        more of them, so they are only moved on (Rabiner 1989).
    """

    groups: tuple[Group, ...]
    logs: tuple[np.ndarray, ...]
    past: tuple[tuple[np.ndarray, ...], ...] = ()

    def back(self, slices: int) -> Tables:
        """Those about so many slices before, given the same rows."""
        if not slices:
            return self._replace(past=())
        with np.errstate(divide="ignore"):
            logs = tuple(
                np.log((given @ np.exp(log)[..., None])[..., 0])
                for given, log in zip(self.past[slices - 1], self.logs, strict=True)
            )
        return Tables(self.groups, logs)

    def looking_back(self, before: Tables, pairs: Sequence[np.ndarray], most: int) -> Tables:
        """With what is known of the slices before, at most so many.

        Parameters
        ----------
        before : Tables
            Of the ancestors, in the slice before.
        pairs : sequence of ndarray
            Log transitions of each group.
        """
        last = tuple(_given_next(log, pair) for log, pair in zip(before.logs, pairs, strict=True))
        past = [last]
        for own in before.past[: most - 1]:
            past.append(tuple(a @ b for a, b in zip(own, last, strict=True)))
        return self._replace(past=tuple(past[:most]))

    def taken(self, ancestors: np.ndarray | None) -> Tables:
        """Those of the ancestors, which may differ between elements of plates."""
        if ancestors is None:
            return self
        if ancestors.ndim == 1:
            past = tuple(
                tuple(a if len(a) == 1 else a.take(ancestors, axis=0) for a in own)
                for own in self.past
            )
            logs = tuple(log.take(ancestors, axis=0) for log in self.logs)
            return self._replace(logs=logs, past=past)
        past = tuple(
            tuple(_apart(a, ancestors, g.elements) for a, g in zip(own, self.groups, strict=True))
            for own in self.past
        )
        found = []
        for log in self.logs:
            apart = log.reshape(len(log), *ancestors.shape[1:], -1)
            moved = np.take_along_axis(apart, ancestors[..., None], 0)
            found.append(moved.reshape(len(ancestors), *log.shape[1:]))
        return self._replace(logs=tuple(found), past=past)

    def joined(self, parties: Sequence[Tables], at: np.ndarray) -> Tables:
        """Some of those of several parties, one after the other."""
        logs = (np.concatenate(own)[at] for own in zip(*(p.logs for p in parties), strict=True))
        return self._replace(logs=tuple(logs), past=())

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
    states = log.shape[-1]
    top = np.array(log[..., 0])
    for k in range(1, states):  # a few states: reductions over a short axis take longer
        np.maximum(top, log[..., k], out=top)
    top = np.where(top > -np.inf, top, 0.0)
    sums = np.exp(log - top[..., None])
    for k in range(1, states):
        sums[..., k] += sums[..., k - 1]
    level = rng.random(log.shape[:-1]) * sums[..., -1]
    found = np.zeros(level.shape, dtype=np.intp)
    for k in range(states - 1):
        found += sums[..., k] <= level
    return found


# ---- private ------------------------------------------------------------------------------------


def _given_next(log: np.ndarray, pair: np.ndarray) -> np.ndarray:
    """Probabilities of states given the next slice's; zeros where that cannot be.

    Parameters
    ----------
    log : ndarray, shape (particles, elements, states)
    pair : ndarray, shape (particles or 1, elements or 1, states, states)
    """
    both = log[..., :, None] + pair
    top = both.max(axis=-2, keepdims=True)
    share = np.exp(both - np.where(top > -np.inf, top, 0.0))
    total = share.sum(axis=-2, keepdims=True)
    return share / np.where(total > 0, total, 1.0)


def _apart(array: np.ndarray, ancestors: np.ndarray, elements: int) -> np.ndarray:
    """Of ancestors that differ between plates."""
    wide = np.broadcast_to(array, (len(ancestors), elements, *array.shape[2:]))
    apart = wide.reshape(len(wide), *ancestors.shape[1:], -1)
    moved = np.take_along_axis(apart, ancestors[..., None], 0)
    return moved.reshape(wide.shape)
