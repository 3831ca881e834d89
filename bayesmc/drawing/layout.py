"""Places the nodes of a small DAG on a page: layers from top to bottom, plates as clear rectangles.

The method is that of Sugiyama, Tagawa and Toda (1981, IEEE Trans. Syst. Man Cybern. 11(2)): layers
by longest path, few crossings by barycentres, coordinates by a linear program as in *dot* (Gansner,
Koutsofios, North and Vo 1993, IEEE Trans. Softw. Eng. 19(3)). The sides of a plate are variables of
that program, so that a plate holds its members and nobody else.

This module knows names, edges and sizes only: neither nets nor matplotlib.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from bayesmc.drawing.ordering import Edge, Item, Ordering, plates_of

Point = tuple[float, float]

GAP = 0.38  # inches between neighbours of a layer
PAD = 0.16  # inches from a plate's side to its members, and between sides
CAPTION = 0.2  # inches below the members of a plate, for its name
BEND_WIDTH = 0.05
LAYER_GAP = 0.42  # inches between layers without plates
CROSSING = 0.8  # inches of detour that one crossing less is worth


@dataclass(frozen=True)
class Rectangle:
    """A plate's place, in inches, with ``bottom < top``."""

    left: float
    bottom: float
    right: float
    top: float


@dataclass(frozen=True)
class Layout:
    """Where everything goes, in inches, x to the right and y upwards.

    Attributes
    ----------
    centres : dict of str to (x, y)
    routes : dict of (source, target) to list of (x, y)
        The points that an edge passes, from the centre of its source to that of its target;
        between them it goes straight down through every layer in between.
    plates : dict of str to Rectangle
    """

    centres: dict[str, Point]
    routes: dict[Edge, list[Point]]
    plates: dict[str, Rectangle]


def layered_layout(
    edges: Sequence[Edge], plates: Mapping[str, tuple[str, ...]], sizes: Mapping[str, Point]
) -> Layout:
    """Lay out a DAG.

    Parameters
    ----------
    edges : sequence of (parent, child)
    plates : mapping of str to tuple of str
        The plates of each node; its keys are the nodes, in an order that breaks ties.
    sizes : mapping of str to (width, height)
        In inches.
    """
    layer_of = _layers(list(plates), edges)
    routes = {edge: _route(edge, layer_of) for edge in edges}
    spans = _spans(plates, layer_of)
    widths = {item: _width(item, sizes) for route in routes.values() for item in route}
    widths |= {name: sizes[name][0] for name in plates}
    drawn: list[tuple[float, int, Any, Any, Any]] = []
    for crossings, order in Ordering(plates, layer_of, routes, spans).candidates():
        xs, sides, cost = _coordinates(order, routes, plates, spans, widths)
        drawn.append((cost + CROSSING * crossings, len(drawn), order, xs, sides))
    _, _, order, xs, sides = min(drawn)
    levels = _nesting(plates, spans)
    ys = _heights(order, sizes, spans, levels)
    place = {item: (xs[item], ys[depth]) for depth, row in enumerate(order) for item in row}
    heights = [_row_height(row, sizes) for row in order]
    rectangles = {}
    for name, (first, last) in spans.items():
        inset = levels[name]
        bottom = ys[last] - heights[last] / 2 - inset * (PAD + CAPTION)
        top = ys[first] + heights[first] / 2 + inset * PAD
        rectangles[name] = Rectangle(sides[name][0], bottom, sides[name][1], top)
    return Layout(
        {name: place[name] for name in plates},
        {edge: _passed(route, place, heights, layer_of) for edge, route in routes.items()},
        rectangles,
    )


def _layers(names: Sequence[str], edges: Sequence[Edge]) -> dict[str, int]:
    """Longest path from a root; then roots come down to just above their first child."""
    children: dict[str, list[str]] = {name: [] for name in names}
    waiting = dict.fromkeys(names, 0)
    for parent, child in edges:
        children[parent].append(child)
        waiting[child] += 1
    roots = [name for name in names if not waiting[name]]
    layer = dict.fromkeys(names, 0)
    ready = list(roots)
    while ready:
        name = ready.pop()
        for child in children[name]:
            layer[child] = max(layer[child], layer[name] + 1)
            waiting[child] -= 1
            if not waiting[child]:
                ready.append(child)
    for name in roots:
        if children[name]:
            layer[name] = min(layer[child] for child in children[name]) - 1
    return layer


def _route(edge: Edge, layer: Mapping[str, int]) -> list[Item]:
    source, target = edge
    bends: list[Item] = [(source, target, i) for i in range(layer[source] + 1, layer[target])]
    return [source, *bends, target]


def _passed(
    route: list[Item],
    place: Mapping[Item, Point],
    heights: Sequence[float],
    layer: Mapping[str, int],
) -> list[Point]:
    points = []
    for depth, item in enumerate(route[1:-1], layer[route[0]] + 1):  # type: ignore[index]
        x, y = place[item]
        points += [(x, y + heights[depth] / 2), (x, y - heights[depth] / 2)]
    return [place[route[0]], *points, place[route[-1]]]


def _spans(
    plates: Mapping[str, tuple[str, ...]], layer: Mapping[str, int]
) -> dict[str, tuple[int, int]]:
    """First and last layer of every plate, in order of first appearance."""
    spans: dict[str, tuple[int, int]] = {}
    for name, own in plates.items():
        for plate in own:
            first, last = spans.get(plate, (layer[name], layer[name]))
            spans[plate] = (min(first, layer[name]), max(last, layer[name]))
    return spans


def _width(item: Item, sizes: Mapping[str, Point]) -> float:
    return sizes[item][0] if isinstance(item, str) else BEND_WIDTH


def _row_height(row: Sequence[Item], sizes: Mapping[str, Point]) -> float:
    return max((sizes[item][1] for item in row if isinstance(item, str)), default=0.0)


def _nesting(
    plates: Mapping[str, tuple[str, ...]], spans: Mapping[str, tuple[int, int]]
) -> dict[str, int]:
    """How many sides lie between a plate's members and its own side, this one included.

    Plates that share a member and a first or last layer would draw the same line; the smaller one
    goes inside.
    """
    members = {p: {n for n, own in plates.items() if p in own} for p in spans}
    by_size = sorted(spans, key=lambda p: (len(members[p]), spans[p][1] - spans[p][0]))
    levels: dict[str, int] = {}
    for plate in by_size:
        inner = [levels[q] for q in levels if members[q] & members[plate]]
        levels[plate] = 1 + max(inner, default=0)
    return levels


def _heights(
    order: Sequence[Sequence[Item]],
    sizes: Mapping[str, Point],
    spans: Mapping[str, tuple[int, int]],
    levels: Mapping[str, int],
) -> list[float]:
    """y of each layer's centre, from 0 downwards, with room for the sides of plates between."""
    ys, y = [], 0.0
    for depth, row in enumerate(order):
        if depth:
            ending = [levels[p] for p, (_, last) in spans.items() if last == depth - 1]
            starting = [levels[p] for p, (first, _) in spans.items() if first == depth]
            room = max(ending, default=0) * (PAD + CAPTION) + max(starting, default=0) * PAD
            y -= _row_height(order[depth - 1], sizes) / 2 + LAYER_GAP + room
            y -= _row_height(row, sizes) / 2
        ys.append(y)
    return ys


def _coordinates(
    order: Sequence[Sequence[Item]],
    routes: Mapping[Edge, list[Item]],
    plates: Mapping[str, tuple[str, ...]],
    spans: Mapping[str, tuple[int, int]],
    widths: Mapping[Item, float],
) -> tuple[dict[Item, float], dict[str, tuple[float, float]], float]:
    """x of every item, the two sides of every plate, and the cost, by a linear program.

    It minimises the horizontal way of the edges (straight long edges before all), holds each parent
    over the mean of its children, and keeps plates narrow, under the order within layers.
    """
    program = _Program()
    x = {item: program.variable() for row in order for item in row}
    sides = {plate: (program.variable(), program.variable()) for plate in spans}
    for row in order:
        for a, b in pairwise(row):
            gap = GAP if isinstance(a, str) and isinstance(b, str) else GAP / 2
            program.at_least({x[b]: 1, x[a]: -1}, (widths[a] + widths[b]) / 2 + gap)
    levels = _nesting(plates, spans)
    for plate, (first, last) in spans.items():
        left, right = sides[plate]
        program.cost({right: 1, left: -1}, 0.5)
        for row in order[first : last + 1]:
            members = [plate in plates_of(item, plates) for item in row]
            middle = members.index(True) if any(members) else len(row) // 2
            for i, item in enumerate(row):
                half = widths[item] / 2
                if members[i]:
                    inset = half + PAD * levels[plate]
                    program.at_least({x[item]: 1, left: -1}, inset)
                    program.at_least({right: 1, x[item]: -1}, inset)
                elif isinstance(item, str):  # bends may lie anywhere: edges may cross a side
                    near, far = (x[item], left) if i < middle else (right, x[item])
                    own = max((levels[p] for p in plates[item]), default=0)
                    program.at_least({far: 1, near: -1}, half + PAD * (own + 1), soft=100.0)
    page = program.variable(), program.variable()
    program.cost({page[1]: 1, page[0]: -1}, 0.05)
    for variable in [*x.values(), *(side for pair in sides.values() for side in pair)]:
        program.at_least({variable: 1, page[0]: -1}, 0.0)
        program.at_least({page[1]: 1, variable: -1}, 0.0)
    for route in routes.values():
        for a, b in pairwise(route):
            bends = (not isinstance(a, str)) + (not isinstance(b, str))
            program.distance({x[a]: 1, x[b]: -1}, (1.0, 2.0, 8.0)[bends])
    _centre_families(program, x, routes)
    values, cost = program.solve()
    return (
        {item: float(values[i]) for item, i in x.items()},
        {plate: (float(values[a]), float(values[b])) for plate, (a, b) in sides.items()},
        cost,
    )


def _centre_families(
    program: _Program, x: Mapping[Item, int], routes: Mapping[Edge, list[Item]]
) -> None:
    """Of equally short placements, take the one with parents and children over their middles."""
    families: dict[tuple[Item, int], list[Item]] = {}
    for route in routes.values():
        families.setdefault((route[0], 1), []).append(route[1])
        families.setdefault((route[-1], 0), []).append(route[-2])
    for (item, _), others in families.items():
        if len(others) > 1:
            terms = {x[item]: 1.0}
            for other in others:
                terms[x[other]] = terms.get(x[other], 0.0) - 1 / len(others)
            program.distance(terms, 1.5)


class _Program:
    """A linear program written row by row: minimise a cost under lower bounds on sums."""

    def __init__(self) -> None:
        self.costs: list[float] = []
        self.rows: list[dict[int, float]] = []
        self.bounds: list[float] = []

    def variable(self, cost: float = 0.0) -> int:
        self.costs.append(cost)
        return len(self.costs) - 1

    def cost(self, terms: Mapping[int, float], weight: float) -> None:
        for variable, factor in terms.items():
            self.costs[variable] += weight * factor

    def at_least(self, terms: Mapping[int, float], bound: float, soft: float | None = None) -> None:
        row = dict(terms)
        if soft is not None:  # what falls short costs, so that the program always has a solution
            short = self.variable(soft)
            row[short] = 1.0
            self.at_least({short: 1.0}, 0.0)
        self.rows.append(row)
        self.bounds.append(bound)

    def distance(self, terms: Mapping[int, float], weight: float) -> None:
        """Charge ``weight`` times the absolute value of the sum."""
        away = self.variable(weight)
        self.at_least({**terms, away: 1.0}, 0.0)
        self.at_least({**{v: -f for v, f in terms.items()}, away: 1.0}, 0.0)

    def solve(self) -> tuple[np.ndarray, float]:
        from scipy.optimize import linprog
        from scipy.sparse import csr_array

        if not self.rows:
            return np.zeros(len(self.costs)), 0.0
        entries = [(i, v, -f) for i, row in enumerate(self.rows) for v, f in row.items()]
        i, v, f = map(np.array, zip(*entries, strict=True))
        matrix = csr_array((f, (i, v)), shape=(len(self.rows), len(self.costs)))
        result = linprog(self.costs, A_ub=matrix, b_ub=-np.array(self.bounds), bounds=(None, None))
        if result.x is None:
            raise RuntimeError(f"the layout's linear program has no solution: {result.message}")
        return result.x, float(result.fun)
