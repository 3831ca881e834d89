"""Tables and small pictures as HTML: everything escaped, colours that do on light and dark grounds.

Lines and letters take the colour of the page (``currentColor``), and what is filled lets it shine through.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

#: rows of a table that are shown, the first and the last of them
MOST = 60
_WIDE, _HIGH = 180, 32


def table(
    head: Sequence[str], rows: Sequence[Sequence[str]], title: str = "", raw: Sequence[int] = ()
) -> str:
    """A table of texts; a column's entries are markup already where ``raw`` names its position.

    Of many rows the first and the last are shown, and how many there are.

    Examples
    --------
    >>> from bayesmc.drawing.html import table
    >>> table(["", "p"], [["a<b", "0.5"]]).count("a&lt;b")
    1
    """
    shown = list(rows)
    if len(shown) > MOST:
        gap = [f"... {len(rows) - MOST} more ..."] + [""] * (len(head) - 1)
        shown = [*rows[: MOST // 2], gap, *rows[-MOST // 2 :]]
    lines = []
    for row in shown:
        cells = [c if k in raw else escape(str(c)) for k, c in enumerate(row)]
        first = f'<th style="text-align:left">{cells[0]}</th>' if cells else ""
        rest = "".join(f'<td style="{_side(c)}">{c}</td>' for c in cells[1:])
        lines.append(f"<tr>{first}{rest}</tr>")
    caption = (
        f'<caption style="text-align:left;caption-side:top">{escape(title)}</caption>'
        if title
        else ""
    )
    names = "".join(f'<th style="text-align:left">{escape(str(c))}</th>' for c in head)
    body = f"<thead><tr>{names}</tr></thead><tbody>{''.join(lines)}</tbody>"
    return f'<table style="color:inherit">{caption}{body}</table>'


def listed(title: str, items: Sequence[str]) -> str:
    """A heading with a list below it; nothing where there are no items."""
    if not items:
        return ""
    lines = "".join(f"<li>{escape(item)}</li>" for item in items)
    return f'<div>{escape(title)}<ul style="margin:0">{lines}</ul></div>'


def folded(title: str, inside: str) -> str:
    """Markup behind a line that opens it."""
    return f"<details><summary>{escape(title)}</summary>{inside}</details>"


def band(middle: np.ndarray, low: np.ndarray | None = None, high: np.ndarray | None = None) -> str:
    """A line over time as a small picture, with a band around it where its ends are given.

    Parameters
    ----------
    middle, low, high : ndarray, shape (time,)
    """
    low = middle if low is None else low
    high = middle if high is None else high
    every = np.concatenate([low, high])
    every = every[np.isfinite(every)]
    if not every.size:
        return ""
    bottom, span = float(every.min()), float(np.ptp(every)) or 1.0
    steps = np.unique(np.linspace(0, len(middle) - 1, min(len(middle), 2 * _WIDE)).astype(int))
    across = 2 + (_WIDE - 4) * steps / max(len(middle) - 1, 1)

    def path(values: np.ndarray, backwards: bool = False) -> str:
        down = _HIGH - 2 - (_HIGH - 4) * (values[steps] - bottom) / span
        points = [f"{x:.1f},{y:.1f}" for x, y in zip(across, down, strict=True) if np.isfinite(y)]
        return " ".join(reversed(points) if backwards else points)

    fill = f"{path(high)} {path(low, backwards=True)}"
    return (
        f'<svg width="{_WIDE}" height="{_HIGH}" viewBox="0 0 {_WIDE} {_HIGH}" role="img">'
        f'<polygon points="{fill}" fill="currentColor" fill-opacity="0.18"/>'
        f'<polyline points="{path(middle)}" fill="none" stroke="currentColor" stroke-width="1.3"/></svg>'
    )


def figure(value: float) -> str:
    """A number as tables show it.

    Examples
    --------
    >>> from bayesmc.drawing.html import figure
    >>> figure(0.123456), figure(float("nan")), figure(2.5e7)
    ('0.1235', '-', '2.5e+07')
    """
    if np.isnan(value):
        return "-"
    if value and (abs(value) >= 1e6 or abs(value) < 1e-4):
        return f"{value:.3g}"
    return f"{value:.0f}" if abs(value) >= 1e4 else f"{value:.4g}"


# ---- private ------------------------------------------------------------------------------------


def _side(cell: str) -> str:
    """Numbers to the right, words to the left."""
    is_figure = cell[:1] in tuple("-.0123456789") and len(cell) < 16
    return "text-align:right;white-space:nowrap" if is_figure else "text-align:left"
