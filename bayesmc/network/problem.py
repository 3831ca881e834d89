"""A question posed: a snapshot of the net with its evidence and inputs, ready for any engine."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesmc.errors import EvidenceWarning, ModelError
from bayesmc.network.doubts import warn_of_doubts
from bayesmc.network.evidence import Observed, read_question
from bayesmc.network.factor_graph import FactorGraph
from bayesmc.network.model import Model
from bayesmc.network.net import BayesNet


@dataclass(frozen=True, eq=False)
class Problem:
    """What an engine is asked.

    Attributes
    ----------
    net : BayesNet or FactorGraph
        A snapshot: later declarations on the user's own do not reach it.
    model : Model
    observed : dict
        Node name -> ``Observed``.
    inputs : dict
        Input name -> stored value.
    cache : dict
        What engines derived from the question and may use again; it lives as long as the problem.
    """

    net: BayesNet | FactorGraph
    model: Model
    observed: dict[str, Observed]
    inputs: dict[str, np.ndarray]
    cache: dict[str, Any] = field(default_factory=dict, repr=False)


def pose(
    net: BayesNet | FactorGraph,
    evidence: Any,
    inputs: Any = None,
) -> Problem:
    """Validate the net or factor graph, read evidence and inputs, and take the snapshot.

    Evidence and inputs may be data frames (``frames``).
    """
    if isinstance(net, FactorGraph):
        return Problem(*net.question(evidence, inputs))
    if not isinstance(net, BayesNet):
        raise ModelError(f"expected a BayesNet or a FactorGraph, not {type(net).__name__}")
    evidence, inputs = net.unframed(evidence, inputs)
    question = read_question(net, evidence, inputs)
    _, model, observed, _ = question
    for name, found in observed.items():
        if model[name].angles is not None:
            warn_of_doubts(model, name, found)
    if observed and not any(found.value.size for found in observed.values()):
        warnings.warn(
            f"evidence on {', '.join(map(repr, observed))} is empty (size 0): nothing is learned from it, "
            "and the answer is the prior",
            EvidenceWarning,
            stacklevel=2,
        )
    return Problem(*question)
