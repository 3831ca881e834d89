"""Which nodes are linear-Gaussian in the hidden continuous nodes above them, proved by tracing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution, MvNormal, Normal, as_distribution
from bayesmc.distributions.base import marking_invalid
from bayesmc.network import CompiledNode, Model, Observed
from bayesmc.network.model import arguments_of
from bayesmc.tracing import TracedCall, Tracer

_GAUSSIAN = (Normal, MvNormal)


def is_hidden(node: CompiledNode, observed: Mapping[str, Observed]) -> bool:
    """Whether a node is continuous and at least partly unobserved."""
    seen = observed.get(node.name)
    free = seen is None or seen.mask is not None
    return node.is_stochastic and not node.is_discrete and node.domain is None and free


def carried(model: Model, observed: Mapping[str, Observed]) -> dict[str, tuple[str, ...]]:
    """For every node the hidden continuous nodes whose values it hands on to its children.

    A hidden continuous node hands on itself, a deterministic node what its parents do.
    """
    found: dict[str, tuple[str, ...]] = {}
    for name, node in model.nodes.items():
        if is_hidden(node, observed):
            found[name] = (name,)
        elif node.kind == "deterministic":
            found[name] = reaching(node.parents, found)
        else:
            found[name] = ()
    return found


def reaching(parents: tuple[str, ...], found: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """The hidden continuous nodes that reach a function through its parents."""
    return tuple(dict.fromkeys(source for p in parents for source in found[p]))


def gaussian_nodes(model: Model, observed: Mapping[str, Observed]) -> tuple[str, ...]:
    """The hidden continuous nodes, and observed ones that depend on them."""
    found = carried(model, observed)
    return tuple(
        name
        for name, node in model.nodes.items()
        if is_hidden(node, observed)
        or (node.is_stochastic and name in observed and reaching(node.parents, found))
    )


def why_not_linear(
    model: Model, observed: Mapping[str, Observed], inputs: Mapping[str, np.ndarray]
) -> str | None:
    """Why a net with this evidence is no conditional linear-Gaussian net, or None.

    Discrete nodes must not depend on hidden continuous ones; hidden continuous nodes and whatever observed
    depends on them must be Normal or MvNormal, with a mean affine in them and a scale free of them.
    """
    kept = model.cache.setdefault("why not linear", {})
    pattern = frozenset((name, seen.mask is None) for name, seen in observed.items())
    if pattern in kept:  # what tracing proves holds for all values
        return kept[pattern]
    if len(kept) > 256:
        kept.clear()
    reason = kept[pattern] = _find_reason(model, observed, inputs)
    return reason


def affine_nodes(
    model: Model, observed: Mapping[str, Observed], inputs: Mapping[str, np.ndarray]
) -> tuple[str, ...]:
    """Deterministic nodes proved affine in hidden continuous ones."""
    found = carried(model, observed)
    values = _traced_values(model, observed, inputs)
    names = []
    for name, node in model.nodes.items():
        if node.kind == "deterministic" and found[name] and node.domain is None:
            _pass_on(model, node, found[name], values)
            if isinstance(values[name], Tracer) and values[name].is_affine:
                names.append(name)
    return tuple(names)


# ---- private ------------------------------------------------------------------------------------


def _find_reason(
    model: Model, observed: Mapping[str, Observed], inputs: Mapping[str, np.ndarray]
) -> str | None:
    found = carried(model, observed)
    values = _traced_values(model, observed, inputs)
    for name, node in model.nodes.items():
        above = reaching(node.parents, found)
        why = None
        if node.kind == "deterministic":
            why = _pass_on(model, node, above, values)
        elif node.is_stochastic and (node.is_discrete or node.domain is not None):
            why = _why_not_discrete_child(node, above, observed.get(name))
        elif is_hidden(node, observed) or (node.is_stochastic and above):
            why = _why_not_gaussian(model, node, above, values)
        if why is not None:
            return f"node {name!r} {why}"
    for name, (potential, _) in model.potentials.items():
        above = reaching(potential.parents, found)
        if above:
            return f"potential {name!r} depends on the continuous {_nodes(above)}"
    return None


def _traced_values(
    model: Model, observed: Mapping[str, Observed], inputs: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """Reachable values of all nodes, those of the hidden continuous ones traced."""
    values: dict[str, Any] = {**model.probe, **inputs}
    for name, seen in observed.items():
        if seen.mask is None:
            values[name] = seen.value
    for name, node in model.nodes.items():
        if is_hidden(node, observed):
            values[name] = Tracer(values[name], [name])
    return values


def _pass_on(
    model: Model, node: CompiledNode, above: tuple[str, ...], values: dict[str, Any]
) -> str | None:
    """Trace a deterministic node, so that its children see what it does."""
    if not above:
        return None
    if node.domain is not None:
        return f"takes finitely many values, which depend on the continuous {_nodes(above)}"
    try:
        result, batch = _call(model, node, values)
        fresh = isinstance(result, Tracer) and result.reason and " in node " not in result.reason
        if fresh:
            result.reason += f" in node {node.name!r}"
        values[node.name] = np.broadcast_to(result, batch + node.value_shape)
    except Exception as error:
        shape = values[node.name].shape
        values[node.name] = Tracer(np.zeros(shape), above, f"{error} in node {node.name!r}")
    return None


def _why_not_discrete_child(
    node: CompiledNode, above: tuple[str, ...], seen: Observed | None
) -> str | None:
    if above:
        return f"is discrete and depends on the continuous {_nodes(above)}"
    if node.domain is None and (seen is None or seen.mask is not None):
        assert node.support is not None
        partly = "" if seen is None else "observed only in part and "
        return f"is {partly}discrete with too many values to enumerate ({node.support.describe()})"
    return None


def _why_not_gaussian(
    model: Model, node: CompiledNode, above: tuple[str, ...], values: Mapping[str, Any]
) -> str | None:
    if len(node.event_shape) > 1:
        return f"is a matrix of shape {node.event_shape}"
    try:
        result, _ = _call(model, node, values)
        if type(result).__module__.startswith("scipy.stats"):
            return (
                "is a distribution of scipy.stats, which cannot be traced; write Normal or MvNormal"
            )
        dist = result if isinstance(result, TracedCall) else as_distribution(result)
    except Exception as error:
        return f"depends on the continuous {_nodes(above)} in a way that cannot be traced ({error})"
    family: Any
    traced: dict[str, Any] = {}
    if isinstance(dist, Distribution):
        family = type(dist)
    elif isinstance(dist, TracedCall):
        family, traced = dist.function, dist.traced
    else:
        return f"returns {type(result).__name__}"
    if family not in _GAUSSIAN:
        on = f" (it depends on the continuous {_nodes(above)})" if above else ""
        return f"is {family.__name__}, not Normal or MvNormal{on}"
    for key, value in traced.items():
        if key != "loc" or not isinstance(value, Tracer):
            return f"has a {key} that depends on the continuous {_nodes(above)}"
        if value.reason:
            names = _nodes(tuple(sorted(value.sources)))
            return f"has a mean that is not known to be affine in {names} (after {value.reason})"
    return None


def _call(model: Model, node: CompiledNode, values: Mapping[str, Any]) -> tuple[Any, Any]:
    """What a function makes of traced parents, and their batch shape."""
    arguments, batch = arguments_of(node.links, values)
    if node.declaration.vectorize:
        raise TypeError("vectorize=True calls it element by element")
    if node.table is not None or node.declaration.function is None:
        return model.evaluate(node.name, values)
    with marking_invalid(), np.errstate(all="ignore"):
        return node.declaration.function(*arguments), batch


def _nodes(names: tuple[str, ...]) -> str:
    return ("node " if len(names) == 1 else "nodes ") + ", ".join(map(repr, names))
