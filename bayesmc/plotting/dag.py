"""Draws a net as a graph: nodes by kind, arrows ending at their borders, plates with their sizes.

It needs matplotlib (the extra ``plot``) and brings its own layout, so no graph-drawing program.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.dbn import DynamicBayesNet
from bayesmc.dbn.two_slices import TwoSlices
from bayesmc.drawing.layout import Layout, Point, Rectangle, layered_layout
from bayesmc.errors import UnsupportedError
from bayesmc.network import BayesNet, Node
from bayesmc.plotting.insets import Inset, draw_inset, insets_of
from bayesmc.plotting.pyplot import pyplot
from bayesmc.results import Posterior

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INK = "#22303c"
LINE = "#5b6b79"
CONTINUOUS, DISCRETE, GIVEN = "#eaf2fb", "#fdf1de", "#ffffff"
SHADE = "#b9c3cc"  # observed
PLATE = "#8a99a6"

FONT = 10.0  # points, at one data unit per inch
SMALL = 8.5
HEIGHT = 0.40  # inches
MARGIN = 0.18
LARGEST = (14.0, 10.0)  # inches; a larger net is scaled down
ROW = 0.34  # inches for one row of the legend


def plot_dag(
    net: BayesNet | DynamicBayesNet | Posterior,
    *,
    observed: Collection[str] = (),
    ax: Axes | None = None,
    legend: bool = True,
) -> Axes:
    """Draw the graph of a net with its plates, or of a template over two slices; of an answer with marginals.

    Continuous nodes are ellipses, discrete ones rounded boxes; a deterministic node has a double
    border, an input a dashed one, and an observed node is shaded. Potentials are small black
    squares, joined to what they name.

    Parameters
    ----------
    net : BayesNet, DynamicBayesNet or Posterior
        Of a template, a slice and what it reads of the slice before (``x_prev``), each in a frame. Of a
        posterior its net with marginals in the nodes: bars of states, densities of numbers. Of a node in
        plates every element has a cell as dark as it is probable, or a curve; of many, some evenly taken.
    observed : collection of str
        Names of observed nodes; the evidence itself will do. A posterior knows its own.
    ax : matplotlib.axes.Axes, optional
        Where to draw. By default a new figure of fitting size, one inch per data unit.
    legend : bool
        Explain the kinds of node that occur, in a row below.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    UnknownNodeError
        When ``observed`` names a node that the net lacks.
    UnsupportedError
        What is given has no graph.
    MissingExtraError
        Without matplotlib.

    Examples
    --------
    >>> import matplotlib
    >>> matplotlib.use("agg")
    >>> import bayesmc as bmc
    >>> from bayesmc.plotting import plot_dag
    >>> net = bmc.BayesNet()
    >>> net.add("rain", bmc.Bernoulli(0.2))
    >>> net.add("wet", lambda rain: bmc.Bernoulli(0.1 + 0.8 * rain))
    >>> ax = plot_dag(net, observed={"wet": 1})
    >>> sorted(text.get_text() for text in ax.texts)
    ['discrete', 'observed', 'rain', 'wet']
    """
    plt = pyplot()
    drawn, insets, shaded = _read(net, observed)
    nodes = [drawn[name] for name in drawn]
    factors: Any = drawn.potentials
    shapes = {n.name: _shape(n, n.name in shaded, insets.get(n.name)) for n in nodes}
    shapes |= {name: _factor_shape(name) for name in factors}
    every = {node.name: node for node in nodes} | factors
    edges = [(parent, name) for name, item in every.items() for parent in item.parents]
    plates = {name: item.plates for name, item in every.items()}
    layout = layered_layout(edges, plates, {n: (s.width, s.height) for n, s in shapes.items()})
    page = _page(layout, shapes)
    rows = _legend_rows(_legend_entries(shapes.values()) if legend else [], page)
    page = _with_legend(page, rows)
    pen = _Pen(_new_axes(plt, page) if ax is None else ax, page)
    for name, rectangle in layout.plates.items():
        pen.plate(rectangle, name)
    curves = [pen.edge(route, shapes[a], shapes[b]) for (a, b), route in layout.routes.items()]
    for name, rectangle in layout.plates.items():
        pen.caption(rectangle, name, drawn.plates[name], curves)
    for name, shape in shapes.items():
        pen.node(layout.centres[name], shape, name)
    for (x, y), shape, text in _legend_places(rows, page):
        pen.node((x, y), shape, "")
        pen.text((x + shape.width / 2 + 0.08, y), text, ha="left", scale=SMALL / FONT)
    return pen.ax


@dataclass(frozen=True)
class Shape:
    """What one node looks like; width and height in inches."""

    width: float
    height: float
    box: bool
    fill: str
    double: bool = False
    dashed: bool = False
    shaded: bool = False
    factor: bool = False
    continuous: bool = False
    inset: Inset | None = None


def _read(net: Any, observed: Collection[str]) -> tuple[Any, dict[str, Inset], set[str]]:
    """What is drawn, what is drawn within its nodes, and which of these are observed."""
    if isinstance(net, DynamicBayesNet):
        drawn: Any = TwoSlices(net)
        return drawn, {}, {drawn[name].name for name in observed}
    if isinstance(net, BayesNet):
        return net, {}, {net[name].name for name in observed}
    if isinstance(net, Posterior):
        drawn = net._live("plot_dag").net
        if isinstance(drawn, BayesNet):
            seen = {n: net.model[n].decode(o.value) for n, o in net._seen.items() if o.mask is None}
            known = {drawn[name].name for name in [*observed, *seen]}
            return drawn, insets_of(net, seen), known
    raise UnsupportedError(
        f"plot_dag: a {type(net).__name__} has no graph of nodes to draw; give a BayesNet, a "
        "DynamicBayesNet, or a posterior of a net"
    )


def _shape(node: Node, shaded: bool, inset: Inset | None) -> Shape:
    wide = _text_width(node.name)
    continuous = not node.is_discrete and node.kind != "input"
    box = not continuous or inset is not None
    width = wide + 0.30 if box else max(1.12 * wide + 0.32, 0.62)
    height = HEIGHT
    if inset is not None:
        width, height = max(width, inset.width + 0.24), HEIGHT + inset.height + 0.04
    fill = DISCRETE if node.is_discrete else GIVEN if node.kind == "input" else CONTINUOUS
    return Shape(
        max(width, 0.5),
        height,
        box,
        SHADE if shaded or node.kind == "fixed" else fill,
        double=node.kind == "deterministic",
        dashed=node.kind == "input",
        shaded=shaded or node.kind == "fixed",
        continuous=continuous,
        inset=inset,
    )


def _factor_shape(name: str) -> Shape:
    # as wide as the name beside it asks for, on both sides, so that the square stands in the middle
    return Shape(2 * _text_width(name, SMALL) + 0.4, 0.16, True, INK, factor=True)


def _text_width(text: str, size: float = FONT) -> float:
    from matplotlib.textpath import TextPath

    return float(TextPath((0, 0), text, size=size).get_extents().width) / 72


class _Pen:
    """Draws on axes whose data unit is meant to be an inch; font sizes follow the true scale."""

    def __init__(self, ax: Axes, page: Rectangle) -> None:
        self.ax = ax
        ax.set_xlim(page.left, page.right)
        ax.set_ylim(page.bottom, page.top)
        ax.set_aspect("equal")
        ax.set_axis_off()
        ax.apply_aspect()
        figure: Any = ax.get_figure(root=True)
        drawn = ax.get_window_extent().width / figure.dpi
        self.scale = drawn / (page.right - page.left)

    def text(self, at: Point, text: str, scale: float = 1.0, **style: Any) -> None:
        style = {"ha": "center", "va": "center", "color": INK, "zorder": 4, **style}
        # names may hold what matplotlib would read as mathematics
        self.ax.text(*at, text, fontsize=FONT * self.scale * scale, parse_math=False, **style)

    def node(self, centre: Point, shape: Shape, name: str) -> None:
        if shape.factor:
            shape = replace(shape, width=shape.height)
            self.text((centre[0] + 0.13, centre[1]), name, SMALL / FONT, ha="left")
            name = ""
        style = {"facecolor": shape.fill, "edgecolor": INK, "linewidth": 1.1 * self.scale}
        if shape.dashed:
            style["linestyle"] = (0, (3, 2))
        self.ax.add_patch(_outline(centre, shape, 0.0, zorder=3, label=name, **style))
        if shape.double:
            style["facecolor"] = "none"
            self.ax.add_patch(_outline(centre, shape, 0.045, zorder=3.5, **style))
        if shape.inset is not None:
            top = centre[1] + shape.height / 2
            self.text((centre[0], top - 0.5 * HEIGHT), name)
            width = shape.width - 0.24
            draw_inset(
                self.ax, shape.inset, centre[0] - width / 2, top - HEIGHT + 0.04, width, self.scale
            )
        elif name:
            self.text(centre, name)

    def plate(self, place: Rectangle, name: str) -> None:
        from matplotlib.patches import FancyBboxPatch

        self.ax.add_patch(
            FancyBboxPatch(
                (place.left, place.bottom),
                place.right - place.left,
                place.top - place.bottom,
                boxstyle="round,pad=0,rounding_size=0.1",
                facecolor=(0.5, 0.6, 0.7, 0.06),
                edgecolor=PLATE,
                linewidth=1.0 * self.scale,
                label=f"plate {name}",
                zorder=1,
            )
        )

    def caption(
        self, place: Rectangle, name: str, size: int | None, curves: list[np.ndarray]
    ) -> None:
        """Name and size in the lower right corner, or in the left one if only that is free."""
        text = name if size is None else f"{name}: {size}"
        width, y = _text_width(text, SMALL) + 0.1, place.bottom + 0.06
        boxes = [(place.right - width, place.right), (place.left, place.left + width)]
        taken = [any(_enters(c, box, y, y + 0.14) for c in curves) for box in boxes]
        style = {"va": "bottom", "color": "#566573", "zorder": 2.5}
        if taken == [True, False]:
            self.text((place.left + 0.09, y), text, SMALL / FONT, ha="left", **style)
        else:
            self.text((place.right - 0.09, y), text, SMALL / FONT, ha="right", **style)

    def edge(self, route: list[Point], source: Shape, target: Shape) -> np.ndarray:
        from matplotlib.patches import FancyArrowPatch
        from matplotlib.path import Path

        curve = _curve(route, source, target)
        if target.factor:
            target = replace(target, width=target.height)
        curve = curve[~_covers(route[0], source, curve) & ~_covers(route[-1], target, curve, 0.02)]
        if len(curve) < 2:  # borders touch
            return curve
        self.ax.add_patch(
            FancyArrowPatch(
                path=Path(curve),
                arrowstyle="-" if target.factor else "-|>,head_length=0.55,head_width=0.26",
                mutation_scale=11 * self.scale,
                color=LINE,
                linewidth=1.0 * self.scale,
                shrinkA=0,
                shrinkB=0,
                zorder=2,
            )
        )
        return curve


def _outline(centre: Point, shape: Shape, inset: float, **style: Any) -> Any:
    from matplotlib.patches import Ellipse, FancyBboxPatch

    width, height = shape.width - 2 * inset, shape.height - 2 * inset
    if not shape.box:
        return Ellipse(centre, width, height, **style)
    corner = (centre[0] - width / 2, centre[1] - height / 2)
    rounding = max(0.08 - inset, 0.02) if shape.height > 0.18 else 0.01
    return FancyBboxPatch(
        corner, width, height, boxstyle=f"round,pad=0,rounding_size={rounding}", **style
    )


def _covers(centre: Point, shape: Shape, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Which points lie within a node's border, or within ``margin`` inches of it."""
    across = (points - centre) / (shape.width / 2 + margin, shape.height / 2 + margin)
    return np.abs(across).max(axis=-1) < 1 if shape.box else np.hypot(*across.T) < 1


def _enters(curve: np.ndarray, across: Point, bottom: float, top: float) -> bool:
    x, y = curve.T
    return bool(np.any((across[0] < x) & (x < across[1]) & (bottom < y) & (y < top)))


def _curve(route: list[Point], source: Shape, target: Shape, steps: int = 60) -> np.ndarray:
    """Points along an edge: straight where that is steep, else out at the bottom, in at the top.

    A shallow straight line would run through the neighbours of its ends.
    """
    points = np.array(route)
    t = np.linspace(0, 1, steps)[:, None]
    way = np.abs(points[-1] - points[0])
    if len(points) == 2 and way[0] <= 1.2 * way[1]:
        return points[0] + t * (points[1] - points[0])
    start = points[0] + _port(source, points[1, 0] - points[0, 0]) * (1, -1)
    points[-1] += _port(target, points[-2, 0] - points[-1, 0])
    points[0] = start
    pieces = []
    for a, b in zip(points[:-1:2], points[1::2], strict=True):  # between them the way is vertical
        bend = (0.0, 0.5 * (b[1] - a[1]))
        first, last = a + bend, b - bend
        pieces.append(
            (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * first + 3 * (1 - t) * t**2 * last + t**3 * b
        )
    return np.concatenate(pieces)


def _port(shape: Shape, towards: float) -> np.ndarray:
    """Where on the upper border an edge ends whose other end lies ``towards`` to the side."""
    across = float(np.clip(0.3 * towards, -0.3 * shape.width, 0.3 * shape.width))
    across = 0.0 if shape.factor else across
    up = shape.height / 2
    if not shape.box:
        up *= float(np.sqrt(1 - (2 * across / shape.width) ** 2))
    return np.array((across, up))


def _page(layout: Layout, shapes: dict[str, Shape]) -> Rectangle:
    boxes = [
        *layout.plates.values(),
        *(
            Rectangle(x - s.width / 2, y - s.height / 2, x + s.width / 2, y + s.height / 2)
            for (x, y), s in ((layout.centres[name], s) for name, s in shapes.items())
        ),
        *(Rectangle(x, y, x, y) for route in layout.routes.values() for x, y in route),
    ]
    return Rectangle(
        min((b.left for b in boxes), default=0.0) - MARGIN,
        min((b.bottom for b in boxes), default=0.0) - MARGIN,
        max((b.right for b in boxes), default=1.0) + MARGIN,
        max((b.top for b in boxes), default=1.0) + MARGIN,
    )


def _new_axes(plt: Any, page: Rectangle) -> Axes:
    wide, high = page.right - page.left, page.top - page.bottom
    scale = min(1.0, LARGEST[0] / wide, LARGEST[1] / high)
    return plt.figure(figsize=(wide * scale, high * scale)).add_axes((0, 0, 1, 1))


def _legend_entries(shapes: Iterable[Shape]) -> list[tuple[Shape, str]]:
    """One entry per look that occurs; a net of one kind with nothing observed needs none."""
    shapes = list(shapes)
    small: dict[str, Any] = {"width": 0.34, "height": 0.2}
    boxes = all(shape.box for shape in shapes)
    looks = [
        (
            Shape(**small, box=any(s.inset is not None for s in shapes), fill=CONTINUOUS),
            "continuous",
            lambda s: s.continuous,
        ),
        (
            Shape(**small, box=True, fill=DISCRETE),
            "discrete",
            lambda s: s.box and not (s.continuous or s.dashed or s.factor),
        ),
        (Shape(**small, box=True, fill=GIVEN, dashed=True), "input", lambda s: s.dashed),
        (
            Shape(**small, box=boxes, fill=GIVEN, double=True),
            "deterministic",
            lambda s: s.double,
        ),
        (Shape(**small, box=boxes, fill=SHADE, shaded=True), "observed", lambda s: s.shaded),
    ]
    return [(shape, text) for shape, text, occurs in looks if any(map(occurs, shapes))]


def _legend_rows(
    entries: list[tuple[Shape, str]], page: Rectangle
) -> list[list[tuple[Shape, str, float]]]:
    """Entries with their widths, in as many rows as the page's width asks for."""
    rows: list[list[tuple[Shape, str, float]]] = []
    room = 0.0
    for shape, text in entries:
        width = shape.width + 0.08 + _text_width(text, SMALL) + 0.3
        if width > room:
            rows.append([])
            room = page.right - page.left
        rows[-1].append((shape, text, width))
        room -= width
    return rows


def _with_legend(page: Rectangle, rows: list[list[tuple[Shape, str, float]]]) -> Rectangle:
    widest = max((sum(width for _, _, width in row) for row in rows), default=0.0)
    more = max(widest - (page.right - page.left), 0.0) / 2
    return Rectangle(page.left - more, page.bottom - ROW * len(rows), page.right + more, page.top)


def _legend_places(
    rows: list[list[tuple[Shape, str, float]]], page: Rectangle
) -> Iterable[tuple[Point, Shape, str]]:
    widest = max((sum(width for _, _, width in row) for row in rows), default=0.0)
    for i, row in enumerate(reversed(rows)):
        x = (page.left + page.right - widest + 0.3) / 2
        for shape, text, width in row:
            yield (x + shape.width / 2, page.bottom + ROW * (i + 0.55)), shape, text
            x += width
