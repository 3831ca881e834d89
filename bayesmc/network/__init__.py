"""Declared nets: ``BayesNet`` and what it compiles to."""

from bayesmc.network.evidence import Observed, read_evidence, read_inputs
from bayesmc.network.model import CompiledNode, Model
from bayesmc.network.net import BayesNet
from bayesmc.network.node import Node
from bayesmc.network.problem import Problem, pose

__all__ = [
    "BayesNet",
    "CompiledNode",
    "Model",
    "Node",
    "Observed",
    "Problem",
    "pose",
    "read_evidence",
    "read_inputs",
]
