"""From records to BIF text, which the reader reads back as equal records."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from bayesmc.io.bif.cursor import WORD
from bayesmc.io.record import TableNode


def format_bif(nodes: Iterable[TableNode], name: str = "unknown") -> str:
    """The text of a BIF file; `parse_bif` of it gives equal names, states and tables.

    Names that would not read back as one word are quoted. Numbers are written with the digits
    that identify the float.

    Raises
    ------
    ValueError
        If a name holds a double quote or a line break, for which the format has no spelling.

    Examples
    --------
    >>> from bayesmc.io.bif import TableNode, format_bif
    >>> print(format_bif([TableNode("coin", ("heads", "tails"), (), np.array([0.5, 0.5]))]))
    network unknown {
    }
    variable coin {
      type discrete [ 2 ] { heads, tails };
    }
    probability ( coin ) {
      table 0.5, 0.5;
    }
    <BLANKLINE>
    """
    nodes = list(nodes)
    states = {node.name: node.states for node in nodes}
    lines = [f"network {_spell(name)} {{", "}"]
    for node in nodes:
        listed = ", ".join(map(_spell, node.states))
        lines += [
            f"variable {_spell(node.name)} {{",
            f"  type discrete [ {len(node.states)} ] {{ {listed} }};",
            *(f"  property {text};" for text in node.properties),
            "}",
        ]
    for node in nodes:
        lines += _probability_block(node, states)
    return "\n".join(lines) + "\n"


def _probability_block(node: TableNode, states: Mapping[str, tuple[str, ...]]) -> Iterator[str]:
    if not node.parents:
        yield f"probability ( {_spell(node.name)} ) {{"
        yield f"  table {_row_text(node.probs)};"
    else:
        parents = ", ".join(map(_spell, node.parents))
        yield f"probability ( {_spell(node.name)} | {parents} ) {{"
        for index in np.ndindex(node.probs.shape[:-1]):
            names = (states[p][k] for p, k in zip(node.parents, index, strict=True))
            yield f"  ({', '.join(map(_spell, names))}) {_row_text(node.probs[index])};"
    yield "}"


def _row_text(row: np.ndarray) -> str:
    return ", ".join(map(repr, row.tolist()))


def _spell(name: str) -> str:
    if re.fullmatch(WORD, name):
        return name
    if '"' in name or "\n" in name or "\r" in name:
        raise ValueError(f"format_bif: BIF has no spelling for the name {name!r}; rename it")
    return f'"{name}"'
