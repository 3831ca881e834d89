"""Values that nodes of a template have in any slice: of computed ones, and of counts that vary."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.distributions.support import Support
from bayesmc.errors import BayesmcError
from bayesmc.network import CompiledNode, Model
from bayesmc.network.labels import Domain

if TYPE_CHECKING:
    from bayesmc.dbn.slices import Template

#: of a computed node whose values are not counted
UNCOUNTED = Domain(0)


def computed_domains(template: Template, first: Model, later: Model) -> dict[str, Domain]:
    """For computed nodes that have other finite values in slice 0 than later, the values of both."""
    found = {}
    for name in template.dynamic:
        nodes = [(first, first[name]), (later, later[name])]
        if any(n.is_stochastic or n.declaration.states is not None for _, n in nodes):
            continue
        values = [_values(model, node) for model, node in nodes]
        if all(node.domain is None for _, node in nodes):
            continue
        if any(v is None for v in values):
            found[name] = UNCOUNTED
            continue
        union: np.ndarray = np.unique(np.concatenate([v for v in values if v is not None]))
        held = [None if node.domain is None else node.domain.numbers for _, node in nodes]
        if not all(h is not None and np.array_equal(h, union) for h in held):
            union.flags.writeable = False
            found[name] = Domain(len(union), values=union)
    return found


def counts_that_vary(template: Template, first: Model, later: Model) -> dict[str, Domain]:
    """Drawn nodes whose values are as many as an input or the time says: no finite set serves all slices."""
    found = {}
    given = {n + end for n in (*template.inputs, "t") for end in ("", "_prev")}
    for model in (first, later):
        for name in template.later:
            node = model.nodes.get(name)
            if node is None or not node.is_stochastic or node.domain is None:
                continue
            read = given & set(node.parents) & set(model.probe)
            plain = read and node.domain.labels is None
            moved = _support_further(model, name, read) if plain else None
            if moved is not None and moved != node.support:
                found[name] = UNCOUNTED
    return found


# ---- private ------------------------------------------------------------------------------------


def _values(model: Model, node: CompiledNode) -> np.ndarray | None:
    """Values of a computed node: of its domain, or of a constant."""
    if node.domain is not None:
        return node.domain.numbers
    if node.parents or node.event_shape:
        return None
    value = np.asarray(model.probe[node.name])
    return np.unique(value) if value.dtype.kind in "biu" else None


def _support_further(model: Model, name: str, parents: set[str]) -> Support | None:
    """Where a node's mass lies with some parents' values larger; None where that goes wrong."""
    moved = {p: np.asarray(model.probe[p]) + 3 for p in parents}
    try:
        with marking_invalid(), np.errstate(all="ignore"):
            dist, _ = model.evaluate(name, {**model.probe, **moved})
    except BayesmcError:  # a function of the user's, at values that need not be possible
        return None
    return dist.support if dist.invalid is None else None
