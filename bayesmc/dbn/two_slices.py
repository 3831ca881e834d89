"""The two-slice picture of a template: what a slice reads of the one before, each slice in a frame.

For all who draw nets.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from bayesmc.dbn.slices import PREVIOUS, TIME
from bayesmc.errors import BayesmcError, UnknownNodeError
from bayesmc.network import Node
from bayesmc.network.shown import net_html

BEFORE, NOW = "slice t - 1", "slice t"
#: sets plates of the slice before apart from those of the slice, unseen
_MARK = "\u200b"


class TwoSlices:
    """A template as nets are drawn: nodes by name, slices as plates around them.

    Nodes of the slice before stand under ``<node>_prev``, those that are read.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.dbn.two_slices import TwoSlices
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev, t: bmc.Normal(x_prev + t, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> drawn = TwoSlices(dbn)
    >>> list(drawn), drawn["x"].parents, drawn["x_prev"].plates
    (['x_prev', 'x'], ('x_prev',), ('slice t - 1',))
    """

    def __init__(self, dbn: Any) -> None:
        graph = dbn.graph
        self.potentials: dict[str, Node] = {}
        self._nodes: dict[str, Node] = {}
        before = {n for n, where in graph.nodes(data="slice") if where == "prev"}
        self.plates: dict[str, int | None] = {NOW: None}
        if before:
            self.plates[BEFORE] = None
        for name in dbn:
            node = dbn[name]
            own = node.plates if name in dbn.static_nodes else (NOW, *node.plates)
            parents = tuple(p for p in node.parents if p != TIME)
            if name + PREVIOUS in before:
                marked = tuple(p + _MARK for p in node.plates)
                self._nodes[name + PREVIOUS] = replace(
                    node, name=name + PREVIOUS, parents=(), plates=(BEFORE, *marked)
                )
                self.plates.update({p + _MARK: dbn.plates[p] for p in node.plates})
            self._nodes[name] = replace(node, parents=parents, plates=own, kind=_kind(node))
            self.plates.update({p: dbn.plates[p] for p in node.plates})

    def __iter__(self) -> Iterator[str]:
        return iter(self._nodes)

    def __getitem__(self, name: str) -> Node:
        if name not in self._nodes:
            raise UnknownNodeError(
                f"the template has no node {name!r}; its nodes are {list(self._nodes)}"
            )
        return self._nodes[name]


def template_html(dbn: Any) -> str:
    """A template as notebooks show it."""
    try:
        drawn = TwoSlices(dbn)
    except BayesmcError as error:
        return net_html(repr(dbn), dbn.template.later, _raising(error), {}, dbn.plates)
    nodes = {name: drawn[name] for name in drawn}
    return net_html(repr(dbn), nodes, nodes.__getitem__, {}, drawn.plates)


# ---- private ------------------------------------------------------------------------------------


def _kind(node: Node) -> str:
    """What the node is drawn as: static ones as any other."""
    return "stochastic" if node.kind == "static" else node.kind


def _raising(error: BayesmcError) -> Callable[[str], Node]:
    def look(name: str) -> Node:
        raise error

    return look
