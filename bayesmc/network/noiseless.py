"""Computed nodes that are observed: read as nodes without noise, which exact engines condition on.

A function that returns a value instead of a distribution says where all mass lies. Observed, it is what
``Normal(value, 0.0)`` says: engines that need a density refuse that and name the node, exact ones answer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.distributions import MvNormal, Normal
from bayesmc.distributions.base import Distribution, marking_invalid
from bayesmc.distributions.noiseless import plane_log_density
from bayesmc.errors import BayesmcError
from bayesmc.network.model import Model
from bayesmc.network.node import Declaration

_MARK = "bayesmc_computes"
#: share by which parents are moved to see what their roundings do
_SHARE = 2.0**-20


def observed_links(nodes: Any, evidence: Mapping[str, Any]) -> dict[str, int]:
    """Observed nodes that are computed, and numbers or vectors of them: name -> event axes.

    Parameters
    ----------
    nodes : mapping
        Name -> something with ``kind``, ``is_discrete`` and ``event_shape``.
    evidence : dict
    """
    found = {}
    for name in (n for n, value in evidence.items() if n in nodes and value is not None):
        node = nodes[name]
        if node.kind == "deterministic" and not node.is_discrete and len(node.event_shape) < 2:
            found[name] = len(node.event_shape)
    return found


def without_noise(declaration: Declaration, rank: int) -> Declaration:
    """The node as one without noise about what its function returns, a value with ``rank`` event axes."""
    function = declaration.function
    assert function is not None

    def link(*values: Any) -> Any:
        value = function(*values)
        if not rank:
            return Normal(value, 0.0)
        size = np.shape(value)[-1]
        return MvNormal(value, np.zeros((size, size)))

    link.__dict__[_MARK] = True
    return replace(declaration, function=link)


def is_link(declaration: Declaration) -> bool:
    """Whether a node was computed before ``without_noise``."""
    return _MARK in getattr(declaration.function, "__dict__", {})


def point_log_density(
    model: Model, name: str, result: Distribution, values: Mapping[str, np.ndarray]
) -> np.ndarray | None:
    """Log density of a seen node that may lack noise, ``plane_log_density`` with rounded parents.

    Parameters
    ----------
    result : Distribution
        What the node is given its parents.
    values : mapping of str to ndarray
        Stored values of the node and its parents, batch axes first.
    """
    log = plane_log_density(result, values[name])
    if log is None or not (log == -np.inf).any():
        return log
    return plane_log_density(result, values[name], _terms(model, name, result, values))


def _terms(
    model: Model, name: str, result: Distribution, values: Mapping[str, np.ndarray]
) -> np.ndarray:
    """How large the terms are that a mean is the sum of: slopes times parents."""
    at = np.asarray(result.loc)  # type: ignore[attr-defined]
    total = np.zeros(())
    for parent in model[name].parents:
        value = np.asarray(values[parent])
        if value.dtype.kind != "f" or model[parent].domain is not None:
            continue
        try:
            with marking_invalid(), np.errstate(all="ignore"):
                moved = model.evaluate(name, {**values, parent: value * (1 + _SHARE)})[0].loc
        except (BayesmcError, ValueError, FloatingPointError):
            continue  # no such value of the parent is allowed
        change = np.abs(moved - at) / _SHARE
        total = total + np.where(np.isfinite(change), change, 0.0)
    return total
