"""Interventions: a node cut from its parents and fixed at a value (Pearl 2009, sec. 3.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.errors import EvidenceError, UnknownNodeError
from bayesmc.network.declaring import ModelStore, unknown
from bayesmc.network.evidence import plate_sizes, store
from bayesmc.network.labels import by_label
from bayesmc.network.model import CompiledNode, Model
from bayesmc.network.node import Declaration
from bayesmc.shapes import owned


def intervened(
    net: ModelStore, sizes: Mapping[str, int | None], values: Mapping[str, Any]
) -> dict[str, Declaration]:
    """The declarations of nodes fixed at values.

    Raises
    ------
    UnknownNodeError, EvidenceError
    """
    for name in values:
        if name not in net.declarations:
            raise UnknownNodeError(f"do({name}=...): {unknown(net.declarations, name)}")
    model = net.probe(plate_sizes(sizes, net.declarations, values))
    return {name: _fixed(name, model[name], value, model) for name, value in values.items()}


# ---- private ------------------------------------------------------------------------------------


def _fixed(name: str, node: CompiledNode, value: Any, model: Model) -> Declaration:
    """The declaration of ``node`` fixed at ``value``; what it cannot be is refused."""
    if node.kind == "input":
        raise EvidenceError(f"do({name}=...): {name!r} is an input; pass it with inputs=")
    above = model.above([name], lambda _: True)
    has_inputs = any(model.nodes[n].kind == "input" for n in above)
    value = by_label(f"do({name}=...)", value, node.plates, model.labels)
    node = _widened(node, value, has_inputs)
    try:
        stored = store(node, value)
    except (TypeError, ValueError) as error:
        raise EvidenceError(
            f"do({name}=...): {error}; it needs a value for every element"
        ) from error
    if stored.dtype.kind == "f" and not np.isfinite(stored).all():
        raise EvidenceError(
            f"do({name}=...): {value!r} is not finite; it needs a value for every element"
        )
    if not has_inputs:  # whose values, and so the support, are not known yet
        _check_do(name, node, value, stored)
    if stored.shape != node.value_shape:
        raise EvidenceError(f"do({name}=...): shape {stored.shape}, not {node.value_shape}")
    return Declaration(
        name,
        "fixed",
        (),
        node.plates,
        node.declaration.states,
        event_shape=node.event_shape,
        value=owned(stored),
        domain=node.domain,
    )


def _widened(node: CompiledNode, value: Any, has_inputs: bool) -> CompiledNode:
    """The node without its domain where that does not bind.

    A deterministic node may be set to numbers its function never returns; and where inputs without
    values stand above, the domain found with stand-ins says nothing.
    """
    bound = node.is_stochastic and not has_inputs
    if bound or node.domain is None or node.domain.labels is not None:
        return node
    known = np.isin(np.asarray(value), np.asarray(node.domain.numbers)).all()
    return node if known else replace(node, domain=None)


def _check_do(name: str, node: CompiledNode, value: Any, stored: np.ndarray) -> None:
    """Refuse a value outside the support."""
    if node.support is None or node.domain is not None:
        return
    if not np.all(node.support.contains(stored)):
        raise EvidenceError(
            f"do({name}=...): {value!r} is outside the support ({node.support.describe()})"
        )
