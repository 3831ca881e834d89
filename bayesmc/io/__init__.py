"""Reading and writing nets in the formats other programs speak, and taking over their nets.

``read`` and ``write`` choose the format by the file's name; each format's text lives in a room of its
own that knows no nets. ``from_pgmpy``, ``from_pyagrum`` and ``to_networkx`` translate objects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from bayesmc.errors import CycleError, FileFormatError
from bayesmc.io.adapters import from_pgmpy, from_pyagrum, to_networkx
from bayesmc.io.bif import format_bif, parse_bif
from bayesmc.io.content import read_bytes, read_text, write_bytes
from bayesmc.io.data import read_data
from bayesmc.io.record import TableNode
from bayesmc.io.tables import check_net, records
from bayesmc.io.xmlbif import format_xmlbif, parse_xmlbif
from bayesmc.network import BayesNet
from bayesmc.network.node import topological_order

__all__ = ["from_pgmpy", "from_pyagrum", "read", "read_data", "to_networkx", "write"]


class _Format(NamedTuple):
    """How a format is called, and its two directions between content and records."""

    name: str
    content: Callable[[str | PathLike[str]], Any]
    parse: Callable[[Any, Any], list[TableNode]]
    format: Callable[[Iterable[TableNode], str], str]


_BIF = _Format("BIF", read_text, parse_bif, format_bif)
_XMLBIF = _Format("XMLBIF", read_bytes, parse_xmlbif, format_xmlbif)
_FORMATS = {".bif": _BIF, ".xmlbif": _XMLBIF, ".bifxml": _XMLBIF, ".xml": _XMLBIF}


def read(path: str | PathLike[str]) -> BayesNet:
    """A discrete net from a BIF file (``.bif``) or an XMLBIF file (``.xmlbif``, ``.bifxml``, ``.xml``).

    Either may be compressed (``.gz`` added to the name). Node names, states and their order are the
    file's; states are strings. Rows off by rounding (at most 1e-6, or 5e-7 for each entry) are
    renormalised. The net is named after the file.

    Raises
    ------
    FileFormatError
        With file and line, where the text is not of the format, a row is no probability vector, or
        the parents form a cycle.
    OSError
        If the file cannot be opened.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet("coin")
    >>> net.table("toss", probs=[0.5, 0.5], states=("heads", "tails"))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "coin.xmlbif"
    >>> bmc.io.write(net, path)
    >>> bmc.io.read(path)["toss"].states
    ('heads', 'tails')
    """
    chosen = _format_of(path)
    net = BayesNet(Path(path).name.split(".")[0])
    nodes = chosen.parse(chosen.content(path), path)
    _check_acyclic(nodes, path)
    for node in nodes:
        net.table(node.name, node.parents, node.probs, states=node.states)
    return net


def write(net: BayesNet, path: str | PathLike[str]) -> None:
    """Write a discrete net without plates in the format of the file's name, as ``read`` knows them.

    A name ending in ``.gz`` is compressed. Nodes stand in the order of their declaration. Functions
    of discrete parents are written as the tables they make, states that are numbers as their text.

    Raises
    ------
    TypeError
        ``net`` is no ``BayesNet``.
    UnsupportedError
        The net has a node that the format cannot hold: continuous, plated, an input, or with a
        potential.
    ValueError
        A name for which the format has no spelling.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet("rain")
    >>> net.add("rain", bmc.Bernoulli(0.2), states=("no", "yes"))
    >>> net.add("wet", lambda rain: bmc.Bernoulli(0.25 + 0.5 * (rain == "yes")))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "rain.bif"
    >>> bmc.io.write(net, path)
    >>> print(path.read_text().partition("wet | ")[2])
    rain ) {
      (no) 0.75, 0.25;
      (yes) 0.25, 0.75;
    }
    <BLANKLINE>
    """
    check_net("write", "net, path", net)
    chosen = _format_of(path)
    text = chosen.format(records(net, chosen.name), net.name or "unknown")
    write_bytes(path, text.encode())


def _check_acyclic(nodes: Sequence[TableNode], path: str | PathLike[str]) -> None:
    try:
        topological_order({node.name: node.parents for node in nodes})
    except CycleError as error:
        lines = {node.name: node.line for node in nodes}
        raise FileFormatError(
            f"the variables' parents form a cycle: {' -> '.join(error.path)}; a Bayes net has none",
            path,
            lines[error.path[0]],
        ) from None


def _format_of(path: str | PathLike[str]) -> _Format:
    name = str(path).lower().removesuffix(".gz")
    for suffix, chosen in _FORMATS.items():
        if name.endswith(suffix):
            return chosen
    known = ", ".join(_FORMATS)
    raise FileFormatError(
        f"the name ends in none of the formats known here: {known}, or one of these and .gz", path
    )
