"""Differences of distribution functions of ranks from the diagonal, as a picture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import missing_extra

#: with one Axes for all: colours, line styles where those are used up, and statistics that a legend names
_COLOURS, _STYLES, _NAMED = 10, ("-", "--", ":", "-."), 12
#: colours of statistics that agree and that deviate, inches of a panel, panels in a row
_PLAIN, _DEVIANT, _PANEL, _COLUMNS = "#2a6f97", "#c1440e", (2.8, 2.2), 4


@dataclass(frozen=True, eq=False)
class Differences:
    """What is drawn: by statistic, at points, with a band for all of them.

    Attributes
    ----------
    difference : dict
        Statistic -> shape ``(K - 1,)``.
    points, low, high : ndarray, shape (K - 1,)
        ``low`` and ``high`` of the distribution function itself.
    alpha : float
        Chance that any leaves the band.
    deviating : tuple of str
        Statistics that left it.
    """

    difference: Mapping[str, np.ndarray]
    points: np.ndarray
    low: np.ndarray
    high: np.ndarray
    alpha: float
    deviating: tuple[str, ...]


def draw_differences(found: Differences, ax: Any) -> Any:
    """Draw them with their band, in panels or in one Axes."""
    names, together = list(found.difference), ax is not None
    axes = _panels(len(names)) if ax is None else np.array([ax] * len(names), dtype=object)
    deviating = set(found.deviating)
    lines = {}
    edges = np.concatenate([[0.0], found.points, [1.0]])
    for one in dict.fromkeys(axes):
        low, high = (np.pad(b - found.points, 1) for b in (found.low, found.high))
        one.fill_between(edges, low, high, color="0.88", linewidth=0)
        one.axhline(0.0, color="0.6", linewidth=0.8)
        one.set_xlim(0.0, 1.0)
        for side in ("top", "right"):
            one.spines[side].set_visible(False)
    # what deviates lies above the others
    for name, one in sorted(zip(names, axes, strict=True), key=lambda n: n[0] in deviating):
        off = name in deviating
        colour, style = _DEVIANT if off else _PLAIN, "-"
        if together:
            more, which = divmod(names.index(name), _COLOURS)
            colour, style = f"C{which}", _STYLES[more % len(_STYLES)]
        (lines[name],) = one.plot(
            edges, np.pad(found.difference[name], 1), color=colour, linestyle=style, label=name,
            linewidth=(2.2 if off else 1.0) if together else 1.4,
        )  # fmt: skip
        if not together:
            one.set_title(name, fontsize="small", color=colour if off else "black")
    if together:
        named = [n for n in names if n in deviating or len(names) <= _NAMED]
        if named:
            ax.legend([lines[n] for n in named], named, frameon=False, fontsize="small")
    _label(found, axes[0], together)
    return axes


def _label(found: Differences, ax: Any, together: bool) -> None:
    """Axes' labels, and the level of the band."""
    count = len(found.difference)
    of = f"all {count} statistics together" if count > 1 else "the statistic"
    title = f"band: {100 * (1 - found.alpha):.6g}% for {of}"
    x, y = "share of the posterior below the truth", "ECDF difference"
    if together:
        ax.set(xlabel=x, ylabel=y)
        ax.set_title(title, fontsize="medium")
    else:
        ax.figure.supxlabel(x, fontsize="medium")
        ax.figure.supylabel(y, fontsize="medium")
        ax.figure.suptitle(title, fontsize="medium")


def _panels(count: int) -> np.ndarray:
    try:
        from matplotlib import pyplot
    except ImportError:
        raise missing_extra("matplotlib", "plot") from None
    columns = min(count, _COLUMNS)
    rows = math.ceil(count / columns)
    size = (max(_PANEL[0] * columns, 4.0), _PANEL[1] * rows + 0.4)
    _, axes = pyplot.subplots(
        rows, columns, figsize=size, layout="constrained", squeeze=False, sharex=True, sharey=True
    )
    for unused, above in zip(axes.ravel()[count:], axes.ravel()[count - columns :], strict=False):
        unused.set_visible(False)
        above.tick_params(labelbottom=True)
    return np.asarray(axes.ravel()[:count])
