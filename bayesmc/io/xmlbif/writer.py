"""From records to XMLBIF text, which the reader reads back as equal records."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from xml.sax.saxutils import escape

import numpy as np

from bayesmc.io.record import TableNode
from bayesmc.io.xmlbif.elements import BLANKS

# Without the document type, which pyAgrum's reader stumbles over.
_HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'

# What XML 1.0 cannot hold, not even as a numbered reference.
_UNSPEAKABLE = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def format_xmlbif(nodes: Iterable[TableNode], name: str = "unknown") -> str:
    """The text of an XMLBIF file; `parse_xmlbif` of it gives equal names, states and tables.

    Numbers are written with the digits that identify the float, one row to a line.

    Raises
    ------
    ValueError
        If a name is empty, starts or ends with a blank, or holds a control character: the format
        has no spelling for those.

    Examples
    --------
    >>> from bayesmc.io.record import TableNode
    >>> from bayesmc.io.xmlbif import format_xmlbif
    >>> text = format_xmlbif([TableNode("coin", ("heads", "tails"), (), np.array([0.5, 0.5]))])
    >>> print(text[text.index("<BIF") :])
    <BIF VERSION="0.3">
    <NETWORK>
    <NAME>unknown</NAME>
    <VARIABLE TYPE="nature">
      <NAME>coin</NAME>
      <OUTCOME>heads</OUTCOME>
      <OUTCOME>tails</OUTCOME>
    </VARIABLE>
    <DEFINITION>
      <FOR>coin</FOR>
      <TABLE>
        0.5 0.5
      </TABLE>
    </DEFINITION>
    </NETWORK>
    </BIF>
    <BLANKLINE>
    """
    nodes = list(nodes)
    lines = ['<BIF VERSION="0.3">', "<NETWORK>", f"<NAME>{_spell(name)}</NAME>"]
    for node in nodes:
        lines += [
            '<VARIABLE TYPE="nature">',
            f"  <NAME>{_spell(node.name)}</NAME>",
            *(f"  <OUTCOME>{_spell(state)}</OUTCOME>" for state in node.states),
            *(f"  <PROPERTY>{_spell(text)}</PROPERTY>" for text in node.properties),
            "</VARIABLE>",
        ]
    for node in nodes:
        lines += _definition(node)
    return _HEAD + "\n".join([*lines, "</NETWORK>", "</BIF>"]) + "\n"


def _definition(node: TableNode) -> Iterator[str]:
    yield "<DEFINITION>"
    yield f"  <FOR>{_spell(node.name)}</FOR>"
    yield from (f"  <GIVEN>{_spell(parent)}</GIVEN>" for parent in node.parents)
    yield "  <TABLE>"
    for row in np.asarray(node.probs).reshape(-1, len(node.states)).tolist():
        yield "    " + " ".join(map(repr, row))
    yield "  </TABLE>"
    yield "</DEFINITION>"


def _spell(name: str) -> str:
    if not name or name != name.strip(BLANKS) or _UNSPEAKABLE.search(name):
        raise ValueError(f"format_xmlbif: XMLBIF has no spelling for the name {name!r}; rename it")
    # a bare carriage return would be read as a line feed
    return escape(name, {"\r": "&#13;"})
