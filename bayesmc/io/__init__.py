"""Reading and writing nets in the formats other programs speak.

``read`` and ``write`` choose the format by the file's name; each format's text lives in a module of its
own that knows no nets.
"""

from __future__ import annotations

import gzip
from os import PathLike
from pathlib import Path

import numpy as np

from bayesmc.errors import FileFormatError, UnsupportedError
from bayesmc.io.bif import BifNode, format_bif, parse_bif, read_text
from bayesmc.network import BayesNet, Model
from bayesmc.structure import tabulate

__all__ = ["read", "write"]


def read(path: str | PathLike[str]) -> BayesNet:
    """A discrete net from a BIF file (``.bif``, or ``.bif.gz``).

    Node names, states and their order are the file's. Rows off by rounding (at most 1e-6) are
    renormalised.

    Raises
    ------
    FileFormatError
        With file and line, where the text is not BIF or a row is no probability vector.
    OSError
        If the file cannot be opened.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet("coin")
    >>> net.table("toss", probs=[0.5, 0.5], states=("heads", "tails"))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "coin.bif"
    >>> bmc.io.write(net, path)
    >>> bmc.io.read(path)["toss"].states
    ('heads', 'tails')
    """
    _check_suffix(path)
    net = BayesNet(Path(path).name.split(".")[0])
    for node in parse_bif(read_text(path), path):
        net.table(node.name, node.parents, node.probs, states=node.states)
    return net


def write(net: BayesNet, path: str | PathLike[str]) -> None:
    """Write a discrete net without plates as BIF; a name ending in ``.gz`` is compressed.

    Functions of discrete parents are written as the tables they make.

    Raises
    ------
    UnsupportedError
        The net has a node that BIF cannot hold: continuous, plated, an input, or with a potential.
    """
    _check_suffix(path)
    model = net.model()
    if model.potentials:
        raise UnsupportedError(
            f"write: BIF has no potentials, but the net has {list(model.potentials)}"
        )
    text = format_bif([_bif_node(model, name) for name in model.nodes], net.name or "unknown")
    data = text.encode()
    Path(path).write_bytes(gzip.compress(data, mtime=0) if str(path).endswith(".gz") else data)


def _bif_node(model: Model, name: str) -> BifNode:
    node = model[name]
    if node.domain is None or node.plates:
        why = "is in a plate" if node.plates else f"is {node.kind} without a finite set of states"
        raise UnsupportedError(f"write: BIF holds discrete nodes only, but {name!r} {why}")
    states = tuple(str(s) for s in node.domain.states)
    if node.kind == "fixed":
        assert node.declaration.value is not None
        return BifNode(name, states, (), np.eye(len(states))[int(node.declaration.value)])
    if node.table is not None:
        return BifNode(name, states, node.parents, np.eye(len(states))[node.table])
    parents = tuple(dict.fromkeys(node.parents))
    table = tabulate(model, node, {})
    if table is None:
        fixed = [p for p in parents if model[p].kind == "fixed"]
        raise UnsupportedError(
            f"write: {name!r} is no table of discrete parents"
            + (f" (fixed: {fixed})" if fixed else "")
        )
    return BifNode(name, states, table.parents, table.probs)


def _check_suffix(path: str | PathLike[str]) -> None:
    name = str(path).removesuffix(".gz")
    if not name.lower().endswith(".bif"):
        raise FileFormatError(
            "the name does not end in .bif or .bif.gz, the formats known here", path
        )
