"""Marginals inside the nodes of a graph: bars of states, densities of numbers, plates by elements.

Sizes are inches, as those of the graph are. What is drawn is read off a posterior once; nothing here
lays out.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.errors import UnsupportedError
from bayesmc.plotting.look import BLUE
from bayesmc.results import Posterior
from bayesmc.states import StateArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDE, ROW, SMALL = 1.25, 0.155, 7.0  # of a picture, of a row of states; points
TALL = 0.5  # of a density
STATES, ELEMENTS, CURVES = 8, 60, 24
OUTSIDE = 0.005


@dataclass(frozen=True, eq=False)
class Inset:
    """What is drawn below a node's name.

    Attributes
    ----------
    states : tuple of str
        Rows; none for a density.
    table : ndarray, shape (states, elements) or (0, 0)
    curves : ndarray, shape (curves, points) or (0, 0)
        Heights, the largest 1.
    ends : (str, str)
        What stands below the ends of a density.
    text : str
        In place of all that: the value of an observed node.
    """

    states: tuple[str, ...] = ()
    table: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    curves: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    ends: tuple[str, str] = ("", "")
    text: str = ""

    @property
    def height(self) -> float:
        """Inches."""
        if self.text:
            return ROW
        return ROW * len(self.states) if self.states else TALL + 0.16

    @property
    def width(self) -> float:
        """Inches."""
        return (0.06 * len(self.text) + 0.1) if self.text else WIDE


def insets_of(posterior: Posterior, observed: dict[str, Any]) -> dict[str, Inset]:
    """For every node what is drawn in it; nodes that say nothing in a picture are left out."""
    found = {}
    for name in posterior.names:
        node = posterior.model.nodes[name]
        if name in observed:
            inset = _value(observed[name])
        elif node.domain is not None and not node.event_shape:
            inset = _table(posterior, name)
        else:
            inset = _curves(posterior, name)
        if inset is not None:
            found[name] = inset
    return found


def draw_inset(ax: Axes, inset: Inset, left: float, top: float, width: float, scale: float) -> None:
    """Draw one, ``scale`` being what an inch has become."""
    style: dict[str, Any] = {
        "fontsize": SMALL * scale,
        "parse_math": False,
        "zorder": 5,
        "va": "center",
    }
    if inset.text:
        ax.text(left + width / 2, top - ROW / 2, inset.text, ha="center", **style)
    elif inset.states:
        _draw_table(ax, inset, left, top, width, style)
    else:
        _draw_curves(ax, inset, left, top, width, style)


# ---- private ------------------------------------------------------------------------------------


def _value(value: Any) -> Inset | None:
    """An observed scalar's value in few characters."""
    if np.ndim(value):
        return None
    if isinstance(value, StateArray):
        one: Any = value.labels.item()
    else:
        one = value.item() if isinstance(value, (np.ndarray, np.generic)) else value
    text = f"{one:.4g}" if isinstance(one, float) else str(one)
    return Inset(text=f"= {text}" if len(text) <= 14 else f"= {text[:13]}...")


def _table(posterior: Posterior, name: str) -> Inset | None:
    node = posterior.model.nodes[name]
    assert node.domain is not None
    try:
        table = np.asarray(posterior.probabilities(name))
    except UnsupportedError:
        return None
    table = table.reshape(-1, table.shape[-1]).T
    states = [str(s) for s in node.domain.states]
    if len(states) > STATES:
        mean = table.mean(axis=1)
        kept = np.sort(np.argsort(-mean, kind="stable")[: STATES - 1])
        rest = np.setdiff1d(np.arange(len(states)), kept)
        table = np.vstack([table[kept], table[rest].sum(axis=0)])
        states = [*(states[k] for k in kept), f"{len(rest)} others"]
    if table.shape[1] > ELEMENTS:
        table = table[:, np.linspace(0, table.shape[1] - 1, ELEMENTS).astype(int)]
    return Inset(tuple(s if len(s) <= 9 else s[:8] + "..." for s in states), table)


def _curves(posterior: Posterior, name: str) -> Inset | None:
    shape = posterior.model.nodes[name].value_shape
    indices = list(np.ndindex(shape))
    if len(indices) > CURVES:
        indices = [indices[k] for k in np.linspace(0, len(indices) - 1, CURVES).astype(int)]
    try:
        marginals = [posterior.marginal(name, at) for at in indices]
        ends = np.array([m.bounds(OUTSIDE) for m in marginals])
    except UnsupportedError:
        return None
    vary = ends[:, 0] < ends[:, 1]
    if vary.any():  # elements that were observed have no curve
        marginals = [m for m, varies in zip(marginals, vary, strict=True) if varies]
        ends = ends[vary]
    low, high = float(ends[:, 0].min()), float(ends[:, 1].max())
    if not np.isfinite([low, high]).all():
        return None
    if low == high:
        return _value(low)
    room = 0.05 * (high - low)
    left, right = low - room, high + room
    if all(
        m.distribution is None for m in marginals
    ):  # no further than draws: a scale is not below 0
        left = max(left, min(float(m.values.min()) for m in marginals))
        right = min(right, max(float(m.values.max()) for m in marginals))
    left = max(left, min(m.ends[0] for m in marginals))
    right = min(right, max(m.ends[1] for m in marginals))
    points = np.linspace(left, right, 120)
    heights = np.array([m.density(points) for m in marginals])
    peak = heights.max(axis=1, keepdims=True)
    heights = heights / np.where(peak > 0, peak, 1.0)
    return Inset(curves=heights, ends=(f"{points[0]:.3g}", f"{points[-1]:.3g}"))


def _draw_table(
    ax: Axes, inset: Inset, left: float, top: float, width: float, style: dict[str, Any]
) -> None:
    from matplotlib.patches import Rectangle

    names = 0.075 * max(len(s) for s in inset.states) + 0.06
    shares = 0.38 if inset.table.shape[1] == 1 else 0.0
    names = min(names, width - shares - 0.25)
    room = width - names - shares
    for k, (state, row) in enumerate(zip(inset.states, inset.table, strict=True)):
        y = top - ROW * (k + 0.5)
        ax.text(left + names - 0.04, y, state, ha="right", **style)
        tall = 0.78 * ROW
        frame: dict[str, Any] = {"facecolor": "#ffffff", "edgecolor": "none", "zorder": 4.2}
        ax.add_patch(Rectangle((left + names, y - tall / 2), room, tall, **frame))
        cells = room / len(row)
        for i, p in enumerate(row):
            if shares:
                place = {"xy": (left + names, y - tall / 2), "width": room * p, "height": tall}
                ax.add_patch(Rectangle(**place, facecolor=BLUE, linewidth=0, zorder=4.5))
                text = (
                    f"{100 * p:.0f} %"
                    if 0.005 <= p <= 0.995 or p in (0, 1)
                    else "< 1 %"
                    if p < 0.5
                    else "> 99 %"
                )
                ax.text(left + width, y, text, ha="right", **style)
            else:
                place = {
                    "xy": (left + names + i * cells, y - tall / 2),
                    "width": cells,
                    "height": tall,
                }
                ax.add_patch(
                    Rectangle(**place, facecolor=BLUE, alpha=float(p), linewidth=0, zorder=4.5)
                )


def _draw_curves(
    ax: Axes, inset: Inset, left: float, top: float, width: float, style: dict[str, Any]
) -> None:
    x = np.linspace(left, left + width, inset.curves.shape[1])
    bottom = top - TALL
    many = len(inset.curves)
    for heights in inset.curves:
        y = bottom + 0.94 * TALL * heights
        if many == 1:
            ax.fill_between(x, bottom, y, color=BLUE, alpha=0.3, linewidth=0, zorder=4.4)
        ax.plot(
            x,
            y,
            color=BLUE,
            linewidth=1.0 if many == 1 else 0.6,
            alpha=1.0 if many < 4 else 0.6,
            zorder=4.5,
        )
    ax.plot([left, left + width], [bottom, bottom], color="#5b6b79", linewidth=0.6, zorder=4.6)
    ax.text(left, bottom - 0.09, inset.ends[0], ha="left", **style)
    ax.text(left + width, bottom - 0.09, inset.ends[1], ha="right", **style)
