"""Tables of a net's finite nodes, as files and other libraries hold them: one axis for each parent."""

from __future__ import annotations

import numpy as np

from bayesmc.errors import UnsupportedError
from bayesmc.io.record import TableNode
from bayesmc.network import BayesNet, Model
from bayesmc.shapes import first_index
from bayesmc.structure import Table, tabulate


def check_net(call: str, arguments: str, net: object) -> None:
    """Refuse what is no net, such as a path in its place, in the words of the call."""
    if not isinstance(net, BayesNet):
        raise TypeError(
            f"{call}({arguments}): net is a {type(net).__name__}, {net!r:.60}; give a BayesNet"
        )


def table_of(model: Model, name: str) -> Table | None:
    """A finite node over its finite parents, shape (*cards, *plates or ones, states); None if it is none.

    A node fixed by ``do`` and a deterministic one are tables of zeros and ones.
    """
    node = model[name]
    if node.domain is None:
        return None
    ones = np.eye(node.domain.size)
    if node.kind == "fixed":
        return Table((), ones[np.asarray(node.declaration.value, dtype=np.intp)])
    if node.table is not None and len(set(node.parents)) == len(node.parents):
        open_plates = len(node.parents) + len(node.plates) - node.table.ndim
        return Table(node.parents, ones[node.table.reshape(node.table.shape + (1,) * open_plates)])
    return tabulate(model, node, {})


def records(net: BayesNet, format: str) -> list[TableNode]:  # noqa: A002 - said to the user
    """A discrete net without plates as the records that ``format`` holds, in the order of declaration.

    Raises
    ------
    UnsupportedError
        Names the first node that the format cannot hold, or a potential.
    """
    model = net.model()
    if model.potentials:
        raise UnsupportedError(
            f"write: {format} has no potentials, but the net has {list(model.potentials)}"
        )
    return [_record(model, name, format) for name in net.nodes]


def _record(model: Model, name: str, format: str) -> TableNode:  # noqa: A002
    node = model[name]
    if node.domain is None or node.plates:
        why = "is in a plate" if node.plates else f"is {node.kind} without a finite set of states"
        raise UnsupportedError(f"write: {format} holds discrete nodes only, but {name!r} {why}")
    table = table_of(model, name)
    if table is None:
        fixed = [p for p in dict.fromkeys(node.parents) if model[p].kind == "fixed"]
        raise UnsupportedError(
            f"write: {name!r} is no table of discrete parents"
            + (f" (fixed: {fixed})" if fixed else "")
        )
    if table.invalid is not None:
        at = first_index(table.invalid)
        where = [
            f"{parent}={model[parent].domain.states[k]!r}"  # type: ignore[union-attr]
            for parent, k in zip(table.parents, at, strict=True)
        ]
        raise UnsupportedError(
            f"write: {name!r} has bad parameters at {', '.join(where) or 'its only row'}, and {format} "
            "needs probabilities for every configuration; let the function return some there"
        )
    states = tuple(str(state) for state in node.domain.states)
    return TableNode(name, states, table.parents, table.probs)
