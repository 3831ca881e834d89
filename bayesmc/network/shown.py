"""A net as notebooks show it: its graph with plates, and a table of its nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from html import escape
from typing import Any

from bayesmc.drawing.graph import Mark, graph
from bayesmc.drawing.html import folded, table
from bayesmc.errors import BayesmcError
from bayesmc.network.node import Declaration, Node

#: nodes up to which the graph is drawn
_DRAWN = 40


def net_html(
    title: str,
    declarations: Mapping[str, Any],
    look: Callable[[str], Node],
    potentials: Mapping[str, Any],
    plates: Mapping[str, int | None],
) -> str:
    """A net's graph, and its nodes as a table.

    What is not complete yet (a parent that is missing) is shown as far as it goes, with what is wrong.

    Parameters
    ----------
    declarations : dict
        Name -> what was declared, with ``parents`` and ``plates``.
    look : callable
        Name -> what the node is, which may raise.
    """
    nodes, fault = {}, ""
    for name in declarations if len(declarations) <= _DRAWN else ():
        try:
            nodes[name] = look(name)
        except BayesmcError as error:
            fault = str(error)
            break
    parts = [f"<div><b>{escape(title)}</b></div>"]
    if fault:
        parts.append(f"<div>not complete yet: {escape(fault)}</div>")
    every = {**declarations, **potentials}
    if 0 < len(every) <= _DRAWN:
        marks = {n: _mark(n, d, nodes.get(n)) for n, d in declarations.items()}
        marks |= {n: Mark(factor=True, hint="potential") for n in potentials}
        edges = [(p, n) for n, d in every.items() for p in d.parents if p in every]
        own = {n: tuple(d.plates) for n, d in every.items()}
        used = {p: f"{p}" if plates.get(p) is None else f"{p}: {plates[p]}" for p in plates}
        parts.append(graph(marks, edges, own, used))
    rows = [_row(n, d, nodes.get(n)) for n, d in declarations.items()]
    rows += [
        [n, "potential", ", ".join(d.parents), ", ".join(d.plates), ""]
        for n, d in potentials.items()
    ]
    head = ["node", "kind", "parents", "plates", "values"]
    listed = table(head, rows)
    parts.append(folded("the nodes", listed) if len(every) <= _DRAWN else listed)
    return f"<div>{''.join(parts)}</div>"


# ---- private ------------------------------------------------------------------------------------


def _kind(declaration: Any, node: Node | None) -> str:
    if node is not None:
        return node.kind
    source = getattr(declaration, "source", "")
    return source if isinstance(declaration, Declaration) and source in ("input", "fixed") else ""


def _values(node: Node | None) -> str:
    if node is None:
        return ""
    if node.states is not None:
        states = [str(s) for s in node.states]
        return ", ".join(states[:6]) + (f", ... ({len(states)})" if len(states) > 6 else "")
    what = "whole numbers" if node.is_discrete else "numbers"
    return f"{what} {node.event_shape}" if node.event_shape else what


def _mark(name: str, declaration: Any, node: Node | None) -> Mark:
    kind = _kind(declaration, node)
    shape = "given" if kind in ("input", "fixed") else "continuous"
    if shape == "continuous" and node is not None and node.is_discrete:
        shape = "discrete"
    hint = f"{name}: {kind or 'node'} {_values(node)}".strip()
    return Mark(shape, double=kind == "deterministic", dashed=kind == "input", hint=hint)


def _row(name: str, declaration: Any, node: Node | None) -> list[str]:
    parents, plates = ", ".join(declaration.parents), ", ".join(declaration.plates)
    return [name, _kind(declaration, node), parents, plates, _values(node)]
