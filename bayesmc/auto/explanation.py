"""What ``explain`` answers: an engine, the reasons, and what it does to each node."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from bayesmc.auto.like_lines import together
from bayesmc.engines.base import Treatment


@dataclass(frozen=True)
class Explanation:
    """Which engine answers a question, and why.

    Printed, like lines of nodes ``x[0]``, ``x[1]``, ... stand as one, ``x[0..99]``.

    Attributes
    ----------
    engine : object
        The engine that would run.
    reasons : tuple of str
    refused : dict
        Engine name -> why it was not taken.
    nodes : dict
        Node -> what the engine does to it.
    table : tuple of Treatment
        The same in columns (node, kernel, why, plates, colour), for engines that move nodes one by one.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> explanation = bmc.explain(net, engine=bmc.LikelihoodWeighting(100))
    engine: LikelihoodWeighting(draws=100)
      because it was asked for
      x  sampled given its parents
    >>> explanation.nodes
    {'x': 'sampled given its parents'}
    """

    engine: Any
    reasons: tuple[str, ...]
    refused: dict[str, str] = field(default_factory=dict)
    nodes: dict[str, str] = field(default_factory=dict)
    table: tuple[Treatment, ...] = ()

    def __str__(self) -> str:
        lines = [f"engine: {self.engine!r}", *(f"  because {r}" for r in self.reasons)]
        lines += [f"not {name}: {why}" for name, why in self.refused.items()]
        if self.table:
            return "\n".join([*lines, *_columns(self.table)])
        shown = together(list(self.nodes.items()))
        width = max((len(n) for n, _ in shown), default=0)
        lines += [f"  {name.ljust(width)}  {what}" for name, what in shown[:40]]
        if len(shown) > 40:
            lines.append(f"  ... and {len(shown) - 40} more lines")
        return "\n".join(lines)


# ---- private ------------------------------------------------------------------------------------


def _columns(table: Sequence[Treatment]) -> list[str]:
    """A table of nodes in aligned columns; columns that are empty throughout are left out."""
    names = [f.name for f in fields(Treatment) if f.name != "why"] + ["why"]
    shown = [n for n in names if any(getattr(row, n) for row in table)]
    rows = [tuple(getattr(row, n) for n in shown) for row in table]
    rows = together(rows, [shown.index("colour")] if "colour" in shown else [])
    cells = [tuple(shown), *rows[:60]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(shown))]
    lines = [
        "  " + "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip()
        for row in cells
    ]
    if len(rows) > 60:
        lines.append(f"  ... and {len(rows) - 60} more lines")
    return lines
