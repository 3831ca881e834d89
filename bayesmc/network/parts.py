"""Nets made of others' declarations: some nodes with their ancestors, or a net and more nodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from bayesmc.network.net import BayesNet
from bayesmc.network.node import Declaration


def ancestral(net: BayesNet, names: Iterable[str]) -> BayesNet:
    """The net of some nodes and all their ancestors, whose joint density it has; without potentials.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.network.parts import ancestral
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Bernoulli(0.3))
    >>> net.add("x", lambda a: bmc.Normal(a, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> list(ancestral(net, ["x"]))
    ['a', 'x']
    """
    declared, wanted, todo = net.declarations, set[str](), list(names)
    while todo:
        name = todo.pop()
        if name in declared and name not in wanted:
            wanted.add(name)
            todo.extend(declared[name].parents)
    return BayesNet.of(net.name, {n: d for n, d in declared.items() if n in wanted}, net._plates)


def with_nodes(net: BayesNet, declarations: Mapping[str, Declaration]) -> BayesNet:
    """The net with more nodes, or others in their place; nothing is compiled."""
    return BayesNet.of(net.name, {**net.declarations, **declarations}, net._plates)


def without_idle_plates(net: BayesNet) -> BayesNet:
    """The net without the plates that no node is on."""
    used = {plate for declared in net.declarations.values() for plate in declared.plates}
    return BayesNet.of(net.name, net.declarations, net._plates.only(used))
