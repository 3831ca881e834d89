"""The one element of a plate that a density reads, picked by a value that may change from call to call.

``color[place]`` in the density of a reading: whatever the other cells are, it says nothing of them. That is
proven on the expression of the density, for any place, or not claimed.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import Expression, broadcast
from bayesmc.network.expressions import Opaque, density
from bayesmc.network.model import Model
from bayesmc.network.readings import by_element
from bayesmc.passes.reads import elements_read


def picked_element(
    model: Model, name: str, sources: Sequence[str], cut: Collection[str] = ()
) -> Expression | None:
    """The element of some nodes that each element of a node's density reads; None where that is not proven.

    Parameters
    ----------
    model : Model
    name : str
        A node with a density.
    sources : sequence of str
        Nodes in the same plates, in the same order.
    cut : collection of str
        Deterministic nodes whose values are given: others are followed to what they are computed from.

    Returns
    -------
    Expression of whole numbers, shape the plates of the node, or None
        Flat elements in the plates of the sources, the same for all of these, -1 where none is read. It
        depends on none of the sources. None where an element may read several, or the function cannot be
        followed.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.picked import picked_element
    >>> net = bmc.BayesNet(plates={"cell": 3})
    >>> net.add("color", bmc.Bernoulli(0.5), plates="cell")
    >>> net.add("place", bmc.DiscreteUniform(0, 2))
    >>> net.add("reading", lambda color, place: bmc.Normal(color[place], 1.0))
    >>> net.add("two", lambda color, place: bmc.Normal(color[place] + color[0], 1.0))
    >>> model = pose(net, {}).model
    >>> sorted(picked_element(model, "reading", ["color"]).leaves)
    ['place']
    >>> picked_element(model, "two", ["color"]) is None
    True
    """
    read = density(model, name, frozenset(cut))
    if isinstance(read, Opaque):
        return None
    shape = model[name].plate_shape
    found: dict[Expression, None] = {}
    try:
        for root in by_element(read.result):
            for source in sources:
                if source not in root.leaves:
                    continue
                node = model[source]
                count = math.prod(node.plate_shape)
                numbers = np.repeat(np.arange(count), math.prod(node.event_shape))
                ways = elements_read(root, source, numbers.reshape(node.value_shape))
                found.update(dict.fromkeys(broadcast(at, shape) for at in ways))
    except (TraceError, ValueError):  # an entry that reads several, or does not fit the plates
        return None
    if len(found) != 1:
        return None
    (at,) = found
    return None if at.leaves & set(sources) else at
