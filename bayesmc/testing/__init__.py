"""Tools to test engines, and nets, against exact answers: random nets, enumeration, a statistical match;
and Markov kernels, ours and users', against the joint law they must keep.

Import it by name (``import bayesmc.testing``); it needs the extra ``test`` for ``bayes_nets`` and
``evidence_for`` only.
"""

from bayesmc.testing.balance import detailed_balance, invariant
from bayesmc.testing.conditional_gaussian import ConditionalGaussian, GaussianAnswer
from bayesmc.testing.gaussians import GaussianOptions, gaussian_evidence, random_gaussian_net
from bayesmc.testing.geweke import GewekeResult, geweke_test
from bayesmc.testing.joint import JointModel
from bayesmc.testing.matching import Match, assert_matches, compare
from bayesmc.testing.nets import NetOptions, random_net
from bayesmc.testing.observing import random_evidence
from bayesmc.testing.oracle import Enumerated, enumerate_posterior
from bayesmc.testing.ranks import RankResult, rank_test
from bayesmc.testing.strategies import bayes_nets, evidence_for
from bayesmc.testing.transition import (
    KernelMatrix,
    Sweep,
    exact_sweep,
    transition_matrix,
    transition_p_value,
)
from bayesmc.testing.uniformity import uniformity_p_value
from bayesmc.testing.verdict import Comparison, Verdict

__all__ = [
    "Comparison",
    "ConditionalGaussian",
    "Enumerated",
    "GaussianAnswer",
    "GaussianOptions",
    "GewekeResult",
    "JointModel",
    "KernelMatrix",
    "Match",
    "NetOptions",
    "RankResult",
    "Sweep",
    "Verdict",
    "assert_matches",
    "bayes_nets",
    "compare",
    "detailed_balance",
    "enumerate_posterior",
    "evidence_for",
    "exact_sweep",
    "gaussian_evidence",
    "geweke_test",
    "invariant",
    "random_evidence",
    "random_gaussian_net",
    "random_net",
    "rank_test",
    "transition_matrix",
    "transition_p_value",
    "uniformity_p_value",
]
