"""Nets of pgmpy: tabular and linear Gaussian conditional densities."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import Normal
from bayesmc.errors import ModelError, UnsupportedError
from bayesmc.io.rows import without_rounding
from bayesmc.network import BayesNet


def from_pgmpy(model: Any) -> BayesNet:
    """A net with the nodes of a pgmpy model; pgmpy itself is not imported.

    Parameters
    ----------
    model : DiscreteBayesianNetwork (BayesianNetwork before pgmpy 1.0) or LinearGaussianBayesianNetwork
        Its nodes are named by strings. A ``TabularCPD`` becomes a table, whose axes are the
        evidence in pgmpy's order and then the variable; ``state_names`` become states (0, 1, ...,
        which pgmpy gives where nobody named states, become plain integers). A
        ``LinearGaussianCPD`` becomes a Normal whose mean is linear in its parents. Which variables
        are latent is not taken over: here that is said by the evidence.

    Raises
    ------
    TypeError
        For what is no directed model of pgmpy.
    ModelError
        A node without a conditional density, or one that contradicts the graph.
    UnsupportedError
        Node names that are no strings (so with dynamic nets), or other conditional densities.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from pgmpy.utils import get_example_model  # doctest: +SKIP
    >>> net = bmc.io.from_pgmpy(get_example_model("asia"))  # doctest: +SKIP
    >>> net["lung"].parents  # doctest: +SKIP
    ('smoke',)
    """
    for method in ("nodes", "predecessors", "get_cpds"):
        if not callable(getattr(model, method, None)):
            raise TypeError(
                f"from_pgmpy: {type(model).__name__} is no directed model of pgmpy (it has no "
                f"{method}()); give a DiscreteBayesianNetwork or LinearGaussianBayesianNetwork"
            )
    cpds = {name: _cpd(model, name) for name in model.nodes()}
    net = BayesNet(getattr(model, "name", None) or None)
    for name, cpd in cpds.items():
        if _is_table(cpd):
            _add_table(net, name, cpd, cpds)
        else:
            _add_linear(net, name, cpd)
    return net


def _cpd(model: Any, name: Any) -> Any:
    """The conditional density of a node, its parents held against the graph."""
    if not isinstance(name, str):
        raise UnsupportedError(
            f"from_pgmpy: the node {name!r} is named by {type(name).__name__}, and here names are "
            "strings; rename it in pgmpy (a dynamic net has to be unrolled there first)"
        )
    cpd = model.get_cpds(name)
    if cpd is None:
        raise ModelError(
            f"from_pgmpy: node {name!r} has no conditional density; give one with model.add_cpds"
        )
    if not (_is_table(cpd) or (hasattr(cpd, "beta") and hasattr(cpd, "std"))):
        raise UnsupportedError(
            f"from_pgmpy: node {name!r} has a {type(cpd).__name__}; only TabularCPD and "
            "LinearGaussianCPD (pgmpy 1.0 or later) have a counterpart that is known here"
        )
    parents = list(cpd.variables[1:])
    if set(parents) != set(model.predecessors(name)):
        raise ModelError(
            f"from_pgmpy: the conditional density of {name!r} is given {parents}, but its parents in "
            f"the graph are {list(model.predecessors(name))}; model.check_model() says more"
        )
    return cpd


def _is_table(cpd: Any) -> bool:
    return hasattr(cpd, "values") and hasattr(cpd, "state_names")


def _add_table(net: BayesNet, name: str, cpd: Any, cpds: Mapping[str, Any]) -> None:
    parents = list(cpd.variables[1:])
    # `values` has one axis per variable, the node's own first
    probs = np.moveaxis(np.asarray(cpd.values, dtype=float), 0, -1)
    for axis, parent in enumerate(parents):
        if not _is_table(cpds[parent]):
            raise UnsupportedError(
                f"from_pgmpy: the table of {name!r} has the parent {parent!r}, which is none itself"
            )
        order = _order(name, cpd.state_names[parent], parent, cpds[parent].state_names[parent])
        probs = np.take(probs, order, axis=axis)
    states = tuple(cpd.state_names[name])
    plain = states == tuple(range(len(states)))
    net.table(name, parents, without_rounding(probs), states=None if plain else states)


def _order(
    name: str, given: Sequence[Hashable], parent: str, states: Sequence[Hashable]
) -> list[int]:
    """Where the parent's states stand on its axis; a child may list them in an order of its own."""
    if len(given) != len(states) or set(given) != set(states):
        raise ModelError(
            f"from_pgmpy: the table of {name!r} gives {parent!r} the states {list(given)}, but its own "
            f"are {list(states)}; pass equal state_names to both"
        )
    return [list(given).index(state) for state in states]


def _add_linear(net: BayesNet, name: str, cpd: Any) -> None:
    parents = list(cpd.variables[1:])
    intercept, *slopes = (float(b) for b in np.ravel(cpd.beta))
    if len(slopes) != len(parents):
        raise ModelError(
            f"from_pgmpy: the conditional density of {name!r} has {len(slopes)} slopes for "
            f"{len(parents)} parents"
        )
    if parents:
        net.add(name, _linear(intercept, slopes, float(cpd.std)), parents=parents)
    else:
        net.add(name, Normal(intercept, float(cpd.std)))


def _linear(intercept: float, slopes: Sequence[float], std: float) -> Callable[..., Normal]:
    def density(*parents: Any) -> Normal:
        mean: Any = intercept
        for slope, parent in zip(slopes, parents, strict=True):
            mean = mean + slope * parent
        return Normal(mean, std)

    return density
