"""A question posed: a snapshot of the net with its evidence and inputs, ready for any engine."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesmc.errors import ModelError
from bayesmc.network.doubts import warn_of_doubts, warn_of_nothing
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
    for name, found in question[2].items():
        warn_of_doubts(question[1], name, found)
    warn_of_nothing(question[2])
    return Problem(*question)
