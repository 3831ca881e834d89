"""A net as a networkx graph that carries what is known of its nodes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from bayesmc.io.tables import check_net, table_of
from bayesmc.network import BayesNet, Model

if TYPE_CHECKING:
    import networkx


def to_networkx(
    net: BayesNet, *, inputs: Mapping[str, Any] | None = None, tables: bool = True
) -> networkx.DiGraph:
    """The net as a ``networkx.DiGraph`` with the nodes' kinds, states and tables on it.

    ``net.graph`` is the DAG of the declarations alone, before anything is evaluated. This graph
    comes from the compiled net, and so knows what the functions return.

    Parameters
    ----------
    inputs : dict, optional
        Values of the input nodes, as for ``infer``; needed where the net has some.
    tables : bool
        Whether to tabulate finite nodes.

    Returns
    -------
    networkx.DiGraph
        Nodes and edges parents first. Every node has ``kind`` ("stochastic", "deterministic",
        "input" or "fixed"), ``parents`` (in the order of the function's arguments), ``plates``,
        ``event_shape``, ``is_discrete`` and ``states`` (a tuple; None where the values are not
        finitely many). A finite node whose parents are finite and in its own plates also has
        ``probs``, read-only, shape ``(*cards, *plates or ones, states)`` with one axis for each of
        ``table_parents``. The graph has ``name``, ``plates`` (name -> size, None where data decide)
        and ``potentials`` (name -> scope).

    Raises
    ------
    TypeError
        ``net`` is no ``BayesNet``.
    ModelError, EvidenceError
        As on the net's first use: it is compiled.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet("rain")
    >>> net.add("rain", bmc.Bernoulli(0.2), states=("no", "yes"))
    >>> net.add("wet", lambda rain: bmc.Bernoulli(0.25 + 0.5 * (rain == "yes")))
    >>> graph = bmc.io.to_networkx(net)
    >>> graph.nodes["rain"]["states"], list(graph.edges)
    (('no', 'yes'), [('rain', 'wet')])
    >>> graph.nodes["wet"]["probs"].tolist()
    [[0.75, 0.25], [0.25, 0.75]]
    """
    check_net("to_networkx", "net", net)
    import networkx

    # a size for plates that data decide; what is read off the net does not depend on it
    stand_in = {plate: 1 for plate, size in net.plates.items() if size is None}
    model = net.model(None, inputs, stand_in)
    graph = networkx.DiGraph(
        name=net.name or "",
        plates=net.plates,
        potentials={name: potential.parents for name, potential in net.potentials.items()},
    )
    for name in model.nodes:
        graph.add_node(name, **_attributes(model, name, tables))
    for name, node in model.nodes.items():
        graph.add_edges_from((parent, name) for parent in node.parents)
    return graph


def _attributes(model: Model, name: str, tables: bool) -> dict[str, Any]:
    record, domain = model[name].record(), model[name].domain
    found: dict[str, Any] = {
        "kind": record.kind,
        "parents": record.parents,
        "plates": record.plates,
        "event_shape": record.event_shape,
        "is_discrete": record.is_discrete,
        "states": None if domain is None else domain.states,
    }
    table = table_of(model, name) if tables else None
    if table is not None:
        probs = table.probs.view()
        probs.flags.writeable = False
        found.update(probs=probs, table_parents=table.parents)
    return found
