"""What ``explain`` answers: an engine, the reasons, and what it does to each node."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from html import escape
from typing import Any

from bayesmc.drawing.html import listed, table
from bayesmc.engines.base import Treatment

#: lines from which they are put together
_FEWEST = 3
#: stretches of numbers that are listed one by one
_STRETCHES = 3
_NUMBERED = re.compile(r"^(.*)\[(\d+)\]$", re.DOTALL)
_NUMBER = re.compile(r"\[\d+\]")
_REPEATED = re.compile(r"('[^',]*', )(\1)+")


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
        The same in columns (node, kernel, why, plates, colour, cost), for engines that move nodes one by one.
    effort : str
        How many chains, and how long, of engines that run some.

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
    effort: str = ""

    def __str__(self) -> str:
        lines = [f"engine: {self.engine!r}", *(f"  because {r}" for r in self.reasons)]
        lines += [f"  runs {self.effort}"] if self.effort else []
        lines += [f"not {name}: {why}" for name, why in self.refused.items()]
        if self.table:
            return "\n".join([*lines, *_columns(self.table)])
        shown = together(list(self.nodes.items()))
        width = max((len(n) for n, _ in shown), default=0)
        lines += [f"  {name.ljust(width)}  {what}" for name, what in shown[:40]]
        if len(shown) > 40:
            lines.append(f"  ... and {len(shown) - 40} more lines")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """As notebooks show it."""
        parts = [f"<div><b>engine: {escape(repr(self.engine))}</b></div>"]
        why = [*self.reasons, *([f"runs {self.effort}"] if self.effort else [])]
        parts.append(listed("because", why))
        parts.append(listed("not", [f"{name}: {what}" for name, what in self.refused.items()]))
        if self.table:
            head, *rows = _cells(self.table)
            parts.append(table(head, rows))
        elif self.nodes:
            parts.append(table(["node", ""], together(list(self.nodes.items()))))
        return f"<div>{''.join(parts)}</div>"


def together(
    lines: Sequence[tuple[str, ...]], varied: Sequence[int] = (), summed: Sequence[int] = ()
) -> list[tuple[str, ...]]:
    """Lines with the like ones as one, where the first of them stood.

    Parameters
    ----------
    lines : sequence of tuple of str
        A node's name, and what is said of it. Lines are alike if their names are but for a number in
        brackets, and so is all they say.
    varied : sequence of int
        Entries that may differ; all of them are shown.
    summed : sequence of int
        Entries that are numbers, or empty, and add up.

    Returns
    -------
    list of tuple of str
        In what is said of several nodes, every number in brackets is ``[t]``.

    Examples
    --------
    >>> from bayesmc.auto.explanation import together
    >>> together([("q", "slice"), *((f"x[{t}]", f"slice for y[{t}]") for t in range(100))])
    [('q', 'slice'), ('x[0..99]', 'slice for y[t]')]
    """
    groups: dict[tuple[str, ...], list[int]] = {}
    for at, (name, *said) in enumerate(lines):
        found = _NUMBERED.match(name)
        if found is not None:
            kept = [_general(s) for k, s in enumerate(said, 1) if k not in (*varied, *summed)]
            groups.setdefault((found[1], *kept), []).append(at)
    first = {members[0]: members for members in groups.values() if len(members) >= _FEWEST}
    hidden = {at for members in first.values() for at in members[1:]}
    result = []
    for at, line in enumerate(lines):
        if at in first:
            result.append(_joined([lines[k] for k in first[at]], varied, summed))
        elif at not in hidden:
            result.append(line)
    return result


# ---- private ------------------------------------------------------------------------------------


def _columns(treated: Sequence[Treatment]) -> list[str]:
    """A table of nodes in aligned columns."""
    cells = _cells(treated)
    rows, cells = cells[1:], cells[:61]
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    lines = [
        "  " + "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip()
        for row in cells
    ]
    if len(rows) > 60:
        lines.append(f"  ... and {len(rows) - 60} more lines")
    return lines


def _cells(treated: Sequence[Treatment]) -> list[tuple[str, ...]]:
    """A table of nodes, its head first; columns that are empty throughout are left out."""
    names = [f.name for f in fields(Treatment) if f.name != "why"] + ["why"]
    shown = [n for n in names if any(getattr(row, n) for row in treated)]
    rows = [tuple(str(getattr(row, n) or "") for n in shown) for row in treated]
    varied, summed = ([shown.index(n)] if n in shown else [] for n in ("colour", "cost"))
    rows = together(rows, varied, summed)
    for at in summed:
        rows = [(*row[:at], _percent(row[at]), *row[at + 1 :]) for row in rows]
    return [tuple(shown), *rows]


def _percent(share: str) -> str:
    """A share in per cent; empty where there is none."""
    return share and (f"{float(share):.0%}".replace("%", " %") if float(share) >= 0.01 else "< 1 %")


def _general(words: str) -> str:
    return _REPEATED.sub(r"\1", _NUMBER.sub("[t]", words) + ", ")[:-2]


def _joined(
    lines: Sequence[tuple[str, ...]], varied: Sequence[int], summed: Sequence[int]
) -> tuple[str, ...]:
    found = [_NUMBERED.match(line[0]) for line in lines]
    numbers = [int(f[2]) for f in found if f is not None]
    base = found[0][1] if found[0] is not None else ""
    said = []
    for k in range(1, len(lines[0])):
        if k in varied:
            said.append(", ".join(dict.fromkeys(line[k] for line in lines)))
        elif k in summed:
            said.append(str(sum(float(line[k] or 0) for line in lines) or ""))
        else:
            said.append(_general(lines[0][k]))
    return (f"{base}[{_stretches(sorted(numbers))}]", *said)


def _stretches(numbers: Sequence[int]) -> str:
    """``0..3, 5..9``, or the whole and how many of it."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    if len(runs) > _STRETCHES:
        return f"{numbers[0]}..{numbers[-1]}, {len(numbers)} of these"
    return ", ".join(f"{a}..{b}" if b > a else f"{a}" for a, b in runs)
