"""Lines about many like nodes (the slices of an unrolled template) put together as one."""

from __future__ import annotations

import re
from collections.abc import Sequence

#: lines from which they are put together
_FEWEST = 3
#: stretches of numbers that are listed one by one
_STRETCHES = 3
_NUMBERED = re.compile(r"^(.*)\[(\d+)\]$", re.DOTALL)
_NUMBER = re.compile(r"\[\d+\]")
_REPEATED = re.compile(r"('[^',]*', )(\1)+")


def together(lines: Sequence[tuple[str, ...]], varied: Sequence[int] = ()) -> list[tuple[str, ...]]:
    """Lines with the like ones as one, where the first of them stood.

    Parameters
    ----------
    lines : sequence of tuple of str
        A node's name, and what is said of it. Lines are alike if their names are but for a number in
        brackets, and so is all they say.
    varied : sequence of int
        Entries that may differ; all of them are shown.

    Returns
    -------
    list of tuple of str
        In what is said of several nodes, every number in brackets is ``[t]``.

    Examples
    --------
    >>> from bayesmc.auto.like_lines import together
    >>> together([("q", "slice"), *((f"x[{t}]", f"slice for y[{t}]") for t in range(100))])
    [('q', 'slice'), ('x[0..99]', 'slice for y[t]')]
    """
    groups: dict[tuple[str, ...], list[int]] = {}
    for at, (name, *said) in enumerate(lines):
        found = _NUMBERED.match(name)
        if found is not None:
            kept = [_general(s) for k, s in enumerate(said, 1) if k not in varied]
            groups.setdefault((found[1], *kept), []).append(at)
    first = {members[0]: members for members in groups.values() if len(members) >= _FEWEST}
    hidden = {at for members in first.values() for at in members[1:]}
    result = []
    for at, line in enumerate(lines):
        if at in first:
            result.append(_joined([lines[k] for k in first[at]], varied))
        elif at not in hidden:
            result.append(line)
    return result


# ---- private ------------------------------------------------------------------------------------


def _general(words: str) -> str:
    return _REPEATED.sub(r"\1", _NUMBER.sub("[t]", words) + ", ")[:-2]


def _joined(lines: Sequence[tuple[str, ...]], varied: Sequence[int]) -> tuple[str, ...]:
    found = [_NUMBERED.match(line[0]) for line in lines]
    numbers = [int(f[2]) for f in found if f is not None]
    base = found[0][1] if found[0] is not None else ""
    said = [
        ", ".join(dict.fromkeys(line[k] for line in lines))
        if k in varied
        else _general(lines[0][k])
        for k in range(1, len(lines[0]))
    ]
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
