"""Declared nets: ``BayesNet`` and ``FactorGraph``, and what they compile to."""

from bayesmc.network.evidence import Observed, read_evidence, read_inputs
from bayesmc.network.factor_graph import FactorGraph
from bayesmc.network.model import CompiledNode, Model
from bayesmc.network.net import BayesNet
from bayesmc.network.node import Node
from bayesmc.network.problem import Problem, pose

__all__ = [
    "BayesNet",
    "CompiledNode",
    "FactorGraph",
    "Model",
    "Node",
    "Observed",
    "Problem",
    "pose",
    "read_evidence",
    "read_inputs",
]
