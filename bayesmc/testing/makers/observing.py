"""Random evidence on a net, always possible: part of one of the net's own joint draws."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.network import BayesNet
from bayesmc.states import StateArray
from bayesmc.testing.makers.choices import Choices, seeded


def random_evidence(net: BayesNet, rng: Any, chance: float = 0.4) -> dict[str, Any]:
    """Possible evidence: one joint draw of the net, of which some nodes are seen.

    Plated nodes may be seen in part. The net must have no potentials and no inputs.

    Parameters
    ----------
    net : BayesNet
    rng : seed or Generator
    chance : float
        Of a node to be seen.

    Examples
    --------
    >>> from bayesmc.testing import random_evidence, random_net
    >>> net = random_net(3)
    >>> set(random_evidence(net, 0)) <= set(net)
    True
    """
    return build_evidence(net, seeded(np.random.default_rng(rng)), chance)


def build_evidence(net: BayesNet, choices: Choices, chance: float = 0.4) -> dict[str, Any]:
    """``random_evidence`` from any source of choices."""
    draw = net.sample(1, rng=choices.integer(0, 2**31 - 1))
    evidence: dict[str, Any] = {}
    for name in net:
        node = net[name]
        if node.kind != "stochastic" or not choices.flag(chance):
            continue
        value = draw[name][0]
        seen = np.ones(value.shape, dtype=bool)
        infinite = (
            node.is_discrete and node.states is None
        )  # what is hidden could not be enumerated
        if node.plates and not infinite and choices.flag(0.5):
            seen = np.array([choices.flag(0.5) for _ in range(value.size)]).reshape(value.shape)
        if seen.any():
            evidence[name] = _as_user_gives(value, seen)
    return evidence


def _as_user_gives(value: Any, seen: np.ndarray) -> Any:
    """A drawn value in the form of evidence, what is not seen in the way of its type."""
    if isinstance(value, StateArray):
        if not value.ndim:
            return value.tolist()
        labels = value.labels.astype(object)
        labels[~seen] = None
        return labels
    if not value.ndim:
        return value.item()
    if seen.all():
        return np.array(value)
    if value.dtype.kind == "f":
        return np.where(seen, value, np.nan)
    return np.ma.MaskedArray(np.array(value), mask=~seen)
