"""Functions read again with some values known: of what cannot be followed for all of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.errors import TraceError
from bayesmc.expression import (
    Expression,
    Family,
    Program,
    as_expression,
    broadcast,
    constant,
    expressions_of,
)
from bayesmc.network.expressions import stored_leaf
from bayesmc.network.model import Model, deterministic_above
from bayesmc.network.readings import Argument, Probe, hold_against, read_function
from bayesmc.shapes import broadcast_shapes


def read_given(
    model: Model,
    name: str,
    values: Mapping[str, np.ndarray],
    cut: frozenset[str] = frozenset(),
) -> Any:
    """What a node's function computes where values are known, of what else it depends on.

    Parameters
    ----------
    values : dict
        Stored values of some nodes, a batch in front or not; the result has the batch in its shapes.
    cut : frozenset of str, optional
        Deterministic nodes that are leaves where their values are not known.

    Returns
    -------
    Family, Expression or Distribution

    Raises
    ------
    TraceError
        It cannot be followed with these either.
    BayesmcError
        It fails on the values.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network.given import read_given
    >>> net = bmc.BayesNet()
    >>> net.input("u")
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda x, u: bmc.Normal(2 * x if u > 0 else x, 1.0))
    >>> read_given(net.model({}, {"u": 1.0}), "y", {"u": np.array(1.0)}).parameters["loc"]
    <Elementwise multiply ()>
    """
    known = dict(values)
    above = [n for n in deterministic_above(model, name, cut) if n not in known]
    for other in (*above, name):
        if all(p in known for p in model[other].parents):
            found = model.evaluate(other, known)[0]
            if other == name:
                return found if isinstance(found, Distribution) else constant(found)
            known[other] = found
    result = _read(model, name, known, cut)
    _check(model, name, known, result)
    return result


# ---- private ------------------------------------------------------------------------------------


def _read(model: Model, name: str, known: Mapping[str, np.ndarray], cut: frozenset[str]) -> Any:
    node = model[name]
    if node.declaration.vectorize:
        raise TraceError("it is called element by element (vectorize=True)")
    arguments = []
    for k, (parent, _) in enumerate(node.links):
        above = model[parent]
        stored: Expression
        if parent in known:
            stored = constant(known[parent])
        elif above.kind != "deterministic" or parent in cut:
            stored = stored_leaf(model, above)
        elif above.domain is None:
            found = as_expression(_read(model, parent, known, cut))
            stored = broadcast(found, broadcast_shapes(found.shape, above.value_shape))
        else:
            raise TraceError(f"node {parent!r} takes finitely many values")
        states = None if above.domain is None else above.domain.size
        shape, dtype = above.value_shape, stored.dtype.str
        arguments.append(Argument(k, shape, dtype, states, None, stored))
    result = read_function(node.declaration.function, arguments, node.links).result
    if node.is_stochastic != isinstance(result, (Family, Distribution)):
        raise TraceError(f"it returns {type(result).__name__}")
    return result


def _check(model: Model, name: str, known: Mapping[str, np.ndarray], result: Any) -> None:
    """Refuse what gives something else than the function, at single entries of the probe."""
    parts = list(expressions_of(result))
    program = Program(parts)
    for end in (0, -1):
        values = Probe(model, 2)
        for leaf in frozenset().union(*(e.leaves for e in parts)):
            rank = model.probe[leaf].ndim - len(model[leaf].value_shape)
            values[leaf] = np.asarray(model.probe[leaf][(end,) * rank])
        values.update(known)
        hold_against(model, name, result, program, lambda values: values, values)
