"""Fingerprints: what a question is, in a form that another process can compare with its own.

A function is told by the graph of what it computes, with what it read from around it as numbers in it; one
that cannot be followed by its code, and by what that reads. So a net that is declared anew by the same
lines has the same fingerprint, and one that says something else has another, in the place where it does.
"""

from __future__ import annotations

import types
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from bayesmc.errors import BayesmcError, CheckpointWarning
from bayesmc.network.digest import digest
from bayesmc.network.evidence import Observed
from bayesmc.network.expressions import Followed, density
from bayesmc.network.model import CompiledNode, Model
from bayesmc.network.sameness import SMALL, parts_of

#: what differs, in words -> what stands there
Fingerprint = dict[str, str]


def fingerprint(model: Model) -> Fingerprint:
    """What a compiled net says, node by node.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.network.fingerprint import fingerprint
    >>> def of(scale):
    ...     net = bmc.BayesNet()
    ...     net.add("x", bmc.Normal(0.0, 1.0))
    ...     net.add("y", lambda x: bmc.Normal(scale * x, 1.0))
    ...     return fingerprint(net.model({}, {}))
    >>> [what for what, now in of(3.0).items() if of(2.0)[what] != now], of(2.0) == of(2.0)
    (["the density of node 'y'"], True)
    """
    return _told(model, _of_function)


def lasting_fingerprint(models: Mapping[str, Model]) -> Fingerprint:
    """What several models say, each by where it stands; empty where functions are gone.

    Functions that cannot be followed are not in it: they may read objects that change as they are used, such
    as one that remembers what it worked out.
    """
    declared = [node.declaration for model in models.values() for node in model.nodes.values()]
    if any(own.source == "function" and own.function is None for own in declared):
        return {}
    return {
        f"{where} {what}": told
        for where, model in models.items()
        for what, told in _told(model, _of_graph).items()
    }


def evidence_fingerprint(observed: Mapping[str, Observed], what: str = "evidence") -> Fingerprint:
    """What was seen, node by node."""
    return {
        f"the {what} of {name!r}": digest((seen.value, seen.mask, seen.parts))
        for name, seen in observed.items()
    }


# ---- private ------------------------------------------------------------------------------------


def _told(model: Model, of_function: Callable[[Model, str, Any], str]) -> Fingerprint:
    found = {"the nodes": _short(list(model.nodes)), "the sizes of plates": repr(dict(model.sizes))}
    if model.labels:
        found["the labels of plates"] = digest(model.labels)
    for name, node in model.nodes.items():
        found[f"the declaration of node {name!r}"] = digest(_outline(node))
        if node.declaration.source == "function":
            found[f"the density of node {name!r}"] = of_function(
                model, name, node.declaration.function
            )
    for name, (potential, _) in model.potentials.items():
        rest = potential.parents, potential.plates, potential.index, potential.is_table
        found[f"the scope of potential {name!r}"] = digest(rest)
        found[f"the potential {name!r}"] = of_function(model, name, potential.function)
    return found


def _short(names: list[str]) -> str:
    return ", ".join(names) if len(names) <= 12 else f"{len(names)} nodes ({digest(names)})"


def _outline(node: CompiledNode) -> tuple[Any, ...]:
    own = node.declaration
    states = None if node.domain is None else node.domain.states
    shown = (node.kind, own.source, node.parents, node.plates, node.value_shape, states)
    return (*shown, own.probs, own.value, own.vectorize)


def _of_function(model: Model, name: str, function: Any) -> str:
    def unseen(value: Any) -> None:
        kind = type(value).__name__
        warnings.warn(
            f"the function of {name!r} reads a {kind}, whose content cannot be compared: if it changes, "
            "the file of a run (checkpoint=, save) will not tell; let the function read arrays and numbers",
            CheckpointWarning,
            stacklevel=2,
        )

    return _of_graph(model, name, function) or "code " + digest(function, unseen)


def _of_graph(model: Model, name: str, function: Any) -> str:
    """Of a function that can be followed, else nothing."""
    try:
        found = density(model, name)
    except BayesmcError:
        return ""
    if not isinstance(found, Followed):
        return ""
    # a graph holds the numbers of large arrays as they were when the function was read
    return "graph " + digest((found.result, *_large(function)))


def _large(function: Any) -> Iterator[np.ndarray]:
    """Large arrays that a function reads, which may have been changed in place."""
    if isinstance(function, types.FunctionType):
        *_, cells, around = parts_of(function) or ([], {})
        for value in (*cells, *around.values()):
            if isinstance(value, np.ndarray) and value.dtype != object and value.size > SMALL:
                yield value
