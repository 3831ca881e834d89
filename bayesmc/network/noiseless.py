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
from bayesmc.network.node import Declaration


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


_MARK = "bayesmc_computes"
