"""A question posed: a snapshot of the net with its evidence and inputs, ready for any engine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import ModelError
from bayesmc.network.evidence import Observed, read_evidence, read_inputs
from bayesmc.network.model import Model
from bayesmc.network.net import BayesNet


@dataclass(frozen=True, eq=False)
class Problem:
    """What an engine is asked.

    Attributes
    ----------
    net : BayesNet
        A snapshot: later declarations on the user's net do not reach it.
    model : Model
    observed : dict
        Node name -> ``Observed``.
    inputs : dict
        Input name -> stored value.
    """

    net: BayesNet
    model: Model
    observed: dict[str, Observed]
    inputs: dict[str, np.ndarray]


def pose(
    net: BayesNet, evidence: Mapping[str, Any] | None, inputs: Mapping[str, Any] | None = None
) -> Problem:
    """Validate the net, read evidence and inputs, and take the snapshot."""
    if not isinstance(net, BayesNet):
        raise ModelError(f"expected a BayesNet, not {type(net).__name__}")
    known = evidence if isinstance(evidence, Mapping) else None
    model = net.model(known, inputs)
    observed = read_evidence(model, evidence)
    given = read_inputs({n: c.declaration for n, c in model.nodes.items()}, model.sizes, inputs)
    return Problem(net.snapshot(), model, observed, given)
