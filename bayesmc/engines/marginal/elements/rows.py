"""A group of readings in one row: what each reads, made linear where it is asked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import Row
from bayesmc.engines.marginal.elements import updates
from bayesmc.engines.marginal.elements.looks import Seen
from bayesmc.engines.marginal.elements.plan import Group
from bayesmc.engines.marginal.elements.updates import Tangent
from bayesmc.engines.marginal.tables.step import Known
from bayesmc.network import Observed


class GroupRow:
    """The readings of a group in a row.

    Parameters
    ----------
    group : Group
    row : Row

    Attributes
    ----------
    value, present : ndarray, shape (readings, p)
    angles : ndarray of bool, shape (p,)
    """

    def __init__(self, group: Group, row: Row) -> None:
        self.group = group
        values, present, angles = [], [], []
        for look in group.looks:
            node, seen = look.node, row.seen.get(look.node.name)
            shape = (look.count, look.width)
            value = np.zeros(node.value_shape) if seen is None else seen.value.astype(float)
            values.append(value.reshape(shape))
            present.append(present_in(node, seen).reshape(shape))
            own = np.zeros(node.event_shape, bool) if node.angles is None else node.angles
            angles.append(np.broadcast_to(own, node.value_shape).reshape(shape)[0])
        self.present = np.concatenate(present, axis=-1)
        self.value = np.where(self.present, np.concatenate(values, axis=-1), 0.0)
        self.angles = np.concatenate(angles)

    @property
    def some(self) -> np.ndarray:
        """Readings of which anything is there."""
        return np.flatnonzero(self.present.any(axis=-1))

    def of(self, readings: np.ndarray) -> updates.Row:
        """Those of some readings, one after the other."""
        return updates.Row(self.value[readings], self.present[readings], self.angles)


class Looking:
    """A group's readings given what is known: for each of a batch.

    Parameters
    ----------
    group : Group
    known : Known
        Whose particles are the batch.
    """

    def __init__(self, group: Group, known: Known) -> None:
        self.group, self.known = group, known
        self.at = group.looks[0].places(known.values)
        self.entries = [look.entries(known.values, self.at) for look in group.looks]

    def grid(self, points: np.ndarray) -> Tangent:
        """All readings of all of the batch at points: ``(batch, readings, ...)``."""
        values = self._values(None)
        return self._tangent(values, self.entries, points)

    def some(self, which: np.ndarray, reading: np.ndarray, points: np.ndarray) -> Tangent:
        """One reading of each of some of the batch, at points (some, n)."""
        entries = [[e if len(e) == 1 else e[which] for e in own] for own in self.entries]
        wide = np.repeat(points[:, None], self.group.count, axis=1)
        found = self._tangent(self._values(which), entries, wide)
        every = np.arange(len(which))
        return Tangent(*(part[every, reading] for part in found))

    def moments(self, points: np.ndarray) -> list[tuple[Seen, np.ndarray]]:
        """Of each node: what is expected, and how it moves with the elements."""
        values = self._values(None)
        return [
            (look(values, entries, points), look.slopes(values, entries, points))
            for look, entries in zip(self.group.looks, self.entries, strict=True)
        ]

    def slopes_along(self, name: str, points: np.ndarray) -> np.ndarray:
        """How means move with a node that is known, of all readings and nodes: (batch, readings, p, m)."""
        values = self._values(None)
        parts = [
            look.slopes_along(name, values, entries, points)
            for look, entries in zip(self.group.looks, self.entries, strict=True)
        ]
        return np.concatenate(parts, axis=-2)

    # ---- private -------------------------------------------------------------------------------

    def _values(self, which: np.ndarray | None) -> dict[str, np.ndarray]:
        known = self.known
        needed = [n for n in self.group.leaves if n in known.values]
        if which is None:
            return {n: known.values[n] for n in needed}
        return {n: known.values[n][which] if n in known.own else known.values[n] for n in needed}

    def _tangent(
        self, values: dict[str, np.ndarray], entries: Sequence[Any], points: np.ndarray
    ) -> Tangent:
        """Of all readings: the nodes' numbers side by side, their noises independent."""
        means, slopes, noises = [], [], []
        for look, own in zip(self.group.looks, entries, strict=True):
            found = look(values, own, points)
            means.append(found.mean)
            slopes.append(look.slopes(values, own, points))
            noises.append(found.noise)
        p = sum(m.shape[-1] for m in means)
        noise, low = np.zeros((*points.shape[:2], p, p)), 0
        for own in noises:
            high = low + own.shape[-1]
            noise[..., low:high, low:high] = own
            low = high
        return Tangent(np.concatenate(means, axis=-1), np.concatenate(slopes, axis=-2), noise)


def present_in(node: Any, seen: Observed | None) -> np.ndarray:
    """Which of a node's numbers are seen, shape ``(*plates, *event)``."""
    if seen is None:
        return np.zeros(node.value_shape, dtype=bool)
    if seen.mask is None:
        return np.ones(node.value_shape, dtype=bool)
    ones = (1,) * len(node.event_shape)
    full = np.broadcast_to(seen.mask.reshape(seen.mask.shape + ones), node.value_shape)
    return full if seen.parts is None else full | seen.parts
