"""Orders the layers of a drawing from left to right, so that few edges cross.

The second step of Sugiyama's method, with plates: a plate that spans a layer splits it into what
stands left, inside and right. This room knows names and their layers, not coordinates.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Mapping
from itertools import pairwise

import numpy as np

Edge = tuple[str, str]
Bend = tuple[str, str, int]  # where a long edge passes a layer: source, target, layer
Item = str | Bend


class Ordering:
    """Left-to-right order within each layer: few crossings, and plates kept together.

    Which side of a plate an outsider takes follows from its key, a running guess of its position.

    Parameters
    ----------
    plates : mapping of str to tuple of str
        The plates of each node.
    layer : mapping of str to int
    routes : mapping of (source, target) to list of items
        What an edge passes from layer to layer: its source, its bends, its target.
    spans : mapping of str to (first, last)
        The layers of each plate.
    """

    def __init__(
        self,
        plates: Mapping[str, tuple[str, ...]],
        layer: Mapping[str, int],
        routes: Mapping[Edge, list[Item]],
        spans: Mapping[str, tuple[int, int]],
    ) -> None:
        self.spans = spans
        self.members = {p: [n for n, own in plates.items() if p in own] for p in spans}
        self.rows: list[list[Item]] = [[] for _ in range(max(layer.values(), default=-1) + 1)]
        for name, depth in layer.items():
            self.rows[depth].append(name)
        self.above: dict[Item, list[Item]] = {}
        self.below: dict[Item, list[Item]] = {}
        for (source, _), route in routes.items():
            for depth, item in enumerate(route[1:-1], layer[source] + 1):
                self.rows[depth].append(item)
            for upper, lower in pairwise(route):
                self.below.setdefault(upper, []).append(lower)
                self.above.setdefault(lower, []).append(upper)
        self.plates = {item: plates_of(item, plates) for row in self.rows for item in row}

    def candidates(self, starts: int = 8, sweeps: int = 12) -> list[tuple[int, list[list[Item]]]]:
        """From each of a few deterministic starts, the number of crossings and the order."""
        rng = np.random.default_rng(0)
        found = []
        for start in range(starts if len(self.plates) > 2 else 1):
            keys = {
                item: rng.normal() if start else i - len(row) / 2.0
                for row in self.rows
                for i, item in enumerate(row)
            }
            rows = [self._arrange(row, depth, keys) for depth, row in enumerate(self.rows)]
            best, fewest = rows, self._untangle(rows)
            for sweep in range(sweeps):
                rows = self._sweep(rows, keys, downwards=sweep % 2 == 0)
                self._swap(rows, even_if_equal=True)
                crossings = self._untangle(rows)
                if crossings < fewest:
                    best, fewest = [list(row) for row in rows], crossings
            found.append((fewest, [list(row) for row in best]))
        return found

    def _sweep(
        self, rows: list[list[Item]], keys: dict[Item, float], downwards: bool
    ) -> list[list[Item]]:
        rows = list(rows)
        towards, away = (self.above, self.below) if downwards else (self.below, self.above)
        for depth in range(len(rows)) if downwards else reversed(range(len(rows))):
            for item in rows[depth]:
                neighbours = towards.get(item) or away.get(item)
                if neighbours:
                    keys[item] = _mean([keys[other] for other in neighbours])
            rows[depth] = self._arrange(rows[depth], depth, keys)
            for i, item in enumerate(rows[depth]):
                keys[item] = i - (len(rows[depth]) - 1) / 2
        return rows

    def _arrange(self, row: list[Item], depth: int, keys: Mapping[Item, float]) -> list[Item]:
        active = [p for p, (first, last) in self.spans.items() if first <= depth <= last]
        centre = {p: _mean([keys[n] for n in self.members[p]]) for p in self.spans}
        return self._split(sorted(row, key=keys.__getitem__), active, centre, keys)

    def _split(
        self,
        row: list[Item],
        active: list[str],
        centre: Mapping[str, float],
        keys: Mapping[Item, float],
    ) -> list[Item]:
        inside = {p: [item for item in row if p in self.plates[item]] for p in active}
        plate = max(active, key=lambda p: len(inside[p]), default=None)
        if plate is None or len(row) < 2:
            return row

        def on_the_left(item: Item) -> bool:
            # Plates side by side keep their sides in every layer, or their rectangles would cross.
            others = [p for p in self.plates[item] if p != plate]
            if others:
                return (_mean([centre[p] for p in others]), min(others)) < (centre[plate], plate)
            return keys[item] < centre[plate]

        outside = [item for item in row if plate not in self.plates[item]]
        left = [item for item in outside if on_the_left(item)]
        right = [item for item in outside if item not in left]
        rest = [p for p in active if p != plate]
        return [
            *self._split(left, rest, centre, keys),
            *self._split(inside[plate], rest, centre, keys),
            *self._split(right, rest, centre, keys),
        ]

    def _untangle(self, rows: list[list[Item]]) -> int:
        """Swap neighbours of like plates while that removes crossings; the number that is left."""
        while self._swap(rows):
            pass
        return sum(self._crossings(rows, depth) for depth in range(len(rows) - 1))

    def _swap(self, rows: list[list[Item]], even_if_equal: bool = False) -> bool:
        improved = False
        for depth, row in enumerate(rows):
            for i in range(len(row) - 1):
                if self.plates[row[i]] != self.plates[row[i + 1]]:
                    continue
                before = self._crossings_at(rows, depth)
                row[i], row[i + 1] = row[i + 1], row[i]
                after = self._crossings_at(rows, depth)
                improved |= after < before
                if after > before or (after == before and not even_if_equal):
                    row[i], row[i + 1] = row[i + 1], row[i]
        return improved

    def _crossings_at(self, rows: list[list[Item]], depth: int) -> int:
        return self._crossings(rows, depth - 1) + self._crossings(rows, depth)

    def _crossings(self, rows: list[list[Item]], depth: int) -> int:
        """Crossings of the edges between layer ``depth`` and the one below."""
        if not 0 <= depth < len(rows) - 1:
            return 0
        rank = {item: i for i, item in enumerate(rows[depth + 1])}
        seen: list[int] = []
        crossings = 0
        for item in rows[depth]:
            ends = [rank[low] for low in self.below.get(item, ())]
            crossings += sum(len(seen) - bisect_right(seen, end) for end in ends)
            for end in ends:  # edges from one item do not cross each other
                insort(seen, end)
        return crossings


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)


def plates_of(item: Item, plates: Mapping[str, tuple[str, ...]]) -> frozenset[str]:
    """A node's plates; a bend lies in those that both ends of its edge share."""
    if isinstance(item, str):
        return frozenset(plates[item])
    return frozenset(plates[item[0]]).intersection(plates[item[1]])
