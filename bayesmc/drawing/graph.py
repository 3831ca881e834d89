"""A small DAG as inline SVG: ellipses, boxes, arrows and plates, by the layout of ``layout``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

from bayesmc.drawing.layout import Layout, Point, Rectangle, layered_layout

_SCALE = 72.0  # pixels of an inch of the layout
_FONT, _SMALL = 13.0, 11.0
_HEIGHT = 0.42
_MARGIN = 0.15
_FILLS = {"continuous": "#4f8fd6", "discrete": "#e0992f", "given": "#888888"}


@dataclass(frozen=True)
class Mark:
    """How a node is drawn.

    Attributes
    ----------
    kind : "continuous", "discrete" or "given"
        Ellipses, rounded boxes, and boxes of what is known.
    double, dashed : bool
        Its border: of what is computed, and of inputs.
    factor : bool
        A small square with its name beside it.
    hint : str
        Shown where the mouse rests.
    """

    kind: str = "continuous"
    double: bool = False
    dashed: bool = False
    factor: bool = False
    hint: str = ""


def graph(
    marks: Mapping[str, Mark],
    edges: Sequence[tuple[str, str]],
    plates: Mapping[str, tuple[str, ...]],
    captions: Mapping[str, str],
) -> str:
    """An ``<svg>`` element.

    Parameters
    ----------
    marks : mapping of str to Mark
        The nodes.
    edges : sequence of (parent, child)
    plates : mapping of str to tuple of str
        The plates of each node.
    captions : mapping of str to str
        What stands in the corner of a plate.

    Examples
    --------
    >>> from bayesmc.drawing.graph import Mark, graph
    >>> picture = graph({"a": Mark(), "b": Mark()}, [("a", "b")], {"a": (), "b": ()}, {})
    >>> picture.count("<ellipse"), picture.count("<polygon")
    (2, 1)
    """
    sizes = {name: _size(name, mark) for name, mark in marks.items()}
    placed = layered_layout(edges, plates, sizes)
    page = _page(placed, sizes)
    parts = [_plate(page, rectangle, captions[p]) for p, rectangle in placed.plates.items()]
    for (source, target), route in placed.routes.items():
        ends = (sizes[source], marks[source]), (sizes[target], marks[target])
        parts.append(_edge(page, route, ends))
    parts += [_node(page, placed.centres[n], sizes[n], n, mark) for n, mark in marks.items()]
    wide, high = (page.right - page.left) * _SCALE, (page.top - page.bottom) * _SCALE
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide:.0f} {high:.0f}" width="{wide:.0f}" '
        f'style="max-width:100%;height:auto" role="img" font-family="sans-serif" fill="currentColor">'
        f"{''.join(parts)}</svg>"
    )


# ---- private ------------------------------------------------------------------------------------


def _text_width(text: str, size: float = _FONT) -> float:
    """About how wide a text is, in inches of the layout."""
    ems = sum(_ems(c) for c in text)
    return ems * size / _SCALE


def _ems(letter: str) -> float:
    if letter in "ijltf.,:;|!'()[] ":
        return 0.33
    if letter in "mwMW":
        return 0.87
    if ord(letter) > 0x2E80:  # letters of double width
        return 1.05
    return 0.7 if letter.isupper() else 0.58


def _size(name: str, mark: Mark) -> Point:
    if mark.factor:
        return 2 * _text_width(name, _SMALL) + 0.4, 0.16
    wide = _text_width(name)
    return max(wide + 0.3 if mark.kind != "continuous" else 1.15 * wide + 0.34, 0.55), _HEIGHT


def _page(placed: Layout, sizes: Mapping[str, Point]) -> Rectangle:
    xs, ys = [0.0], [0.0]
    for name, (x, y) in placed.centres.items():
        wide, high = sizes[name]
        xs, ys = [*xs, x - wide / 2, x + wide / 2], [*ys, y - high / 2, y + high / 2]
    for box in placed.plates.values():
        xs, ys = [*xs, box.left, box.right], [*ys, box.bottom, box.top]
    for route in placed.routes.values():
        xs, ys = [*xs, *(x for x, _ in route)], [*ys, *(y for _, y in route)]
    return Rectangle(min(xs) - _MARGIN, min(ys) - _MARGIN, max(xs) + _MARGIN, max(ys) + _MARGIN)


def _at(page: Rectangle, point: Point) -> str:
    return f"{(point[0] - page.left) * _SCALE:.1f},{(page.top - point[1]) * _SCALE:.1f}"


def _text(page: Rectangle, point: Point, text: str, size: float, anchor: str) -> str:
    x, y = _at(page, point).split(",")
    return (
        f'<text x="{x}" y="{y}" font-size="{size:g}" text-anchor="{anchor}" '
        f'dominant-baseline="central">{escape(text)}</text>'
    )


def _plate(page: Rectangle, box: Rectangle, caption: str) -> str:
    x, y = _at(page, (box.left, box.top)).split(",")
    wide, high = (box.right - box.left) * _SCALE, (box.top - box.bottom) * _SCALE
    label = _text(page, (box.right - 0.08, box.bottom + 0.11), caption, _SMALL, "end")
    return (
        f'<rect x="{x}" y="{y}" width="{wide:.1f}" height="{high:.1f}" rx="7" fill="currentColor" '
        f'fill-opacity="0.04" stroke="currentColor" stroke-opacity="0.5"/>{label}'
    )


def _node(page: Rectangle, centre: Point, size: Point, name: str, mark: Mark) -> str:
    hint = f"<title>{escape(mark.hint)}</title>" if mark.hint else ""
    if mark.factor:
        beside = _text(page, (centre[0] + 0.15, centre[1]), name, _SMALL, "start")
        square = _outline(page, centre, (size[1], size[1]), box=True)
        return f'<g>{hint}<g fill="currentColor">{square}</g>{beside}</g>'
    dashes = ' stroke-dasharray="4 3"' if mark.dashed else ""
    style = f'stroke="currentColor" fill="{_FILLS[mark.kind]}" fill-opacity="0.25"{dashes}'
    box = mark.kind != "continuous"
    parts = f"<g {style}>{_outline(page, centre, size, box)}</g>"
    if mark.double:
        inner = _outline(page, centre, (size[0] - 0.1, size[1] - 0.1), box)
        parts += f'<g stroke="currentColor" fill="none">{inner}</g>'
    return f"<g>{hint}{parts}{_text(page, centre, name, _FONT, 'middle')}</g>"


def _outline(page: Rectangle, centre: Point, size: Point, box: bool) -> str:
    x, y = (float(v) for v in _at(page, centre).split(","))
    wide, high = size[0] * _SCALE, size[1] * _SCALE
    if not box:
        return f'<ellipse cx="{x:.1f}" cy="{y:.1f}" rx="{wide / 2:.1f}" ry="{high / 2:.1f}"/>'
    corner = f'x="{x - wide / 2:.1f}" y="{y - high / 2:.1f}"'
    return f'<rect {corner} width="{wide:.1f}" height="{high:.1f}" rx="{min(6.0, high / 4):.1f}"/>'


def _edge(page: Rectangle, route: Sequence[Point], ends: Sequence[tuple[Point, Mark]]) -> str:
    """Straight where that is steep, else out below and in above, straight down through layers between."""
    points = list(route)
    way = abs(points[-1][0] - points[0][0]), abs(points[-1][1] - points[0][1])
    if len(points) == 2 and way[0] <= 1.2 * way[1]:
        first = _border(points[0], points[1], *ends[0])
        last = _border(points[1], points[0], *ends[1])
        path, before = f"M{_at(page, first)} L{_at(page, last)}", first
    else:
        points[0] = (points[0][0], points[0][1] - _half(*ends[0]))
        points[-1] = (points[-1][0], points[-1][1] + _half(*ends[1]))
        path = f"M{_at(page, points[0])}"
        for k in range(0, len(points) - 1, 2):
            (x0, y0), (x1, y1) = points[k], points[k + 1]
            bend = (y1 - y0) / 2
            path += (
                f" C{_at(page, (x0, y0 + bend))} {_at(page, (x1, y1 - bend))} {_at(page, (x1, y1))}"
            )
            if k + 2 < len(points):
                path += f" L{_at(page, points[k + 2])}"
        last = points[-1]
        before = last[0], last[1] + 1.0
    head = "" if ends[1][1].factor else _head(page, before, last)
    return f'<path d="{path}" fill="none" stroke="currentColor" stroke-opacity="0.8"/>{head}'


def _head(page: Rectangle, before: Point, last: Point) -> str:
    """The tip of an arrow; a marker would need a name that no other picture of a page has."""
    length = math.hypot(last[0] - before[0], last[1] - before[1]) or 1.0
    x, y = (last[0] - before[0]) / length, (last[1] - before[1]) / length
    back = last[0] - 0.12 * x, last[1] - 0.12 * y
    left, right = ((back[0] - side * 0.045 * y, back[1] + side * 0.045 * x) for side in (1.0, -1.0))
    return f'<polygon points="{_at(page, last)} {_at(page, left)} {_at(page, right)}"/>'


def _half(size: Point, mark: Mark) -> float:
    return size[1] / 2


def _border(centre: Point, towards: Point, size: Point, mark: Mark) -> Point:
    """Where the line from a node's centre leaves it."""
    across, up = towards[0] - centre[0], towards[1] - centre[1]
    a, b = (size[1] if mark.factor else size[0]) / 2, size[1] / 2
    if mark.kind == "continuous" and not mark.factor:
        share = 1 / max(math.hypot(across / a, up / b), 1e-9)
    else:
        share = min(a / max(abs(across), 1e-9), b / max(abs(up), 1e-9))
    share = min(share, 1.0)
    return centre[0] + share * across, centre[1] + share * up
