"""Tools to test engines, and nets, against exact answers: random nets, enumeration, a statistical match;
and Markov kernels, ours and users', against the joint law they must keep.

Import it by name (``import bayesmc.testing``); it needs the extra ``test`` for ``bayes_nets`` and
``evidence_for`` only.
"""

from bayesmc.testing.conditional_gaussian import ConditionalGaussian, GaussianAnswer
from bayesmc.testing.gaussians import GaussianOptions, gaussian_evidence, random_gaussian_net
from bayesmc.testing.kernels import GewekeResult, RankResult, geweke_test, rank_test
from bayesmc.testing.matching import Comparison, Match, assert_matches, compare
from bayesmc.testing.nets import NetOptions, random_net
from bayesmc.testing.observing import random_evidence
from bayesmc.testing.oracle import Enumerated, enumerate_posterior
from bayesmc.testing.strategies import bayes_nets, evidence_for
from bayesmc.testing.transition import (
    KernelMatrix,
    Sweep,
    exact_sweep,
    transition_matrix,
    transition_p_value,
)
from bayesmc.testing.uniformity import uniformity_p_value

__all__ = [
    "Comparison",
    "ConditionalGaussian",
    "Enumerated",
    "GaussianAnswer",
    "GaussianOptions",
    "GewekeResult",
    "KernelMatrix",
    "Match",
    "NetOptions",
    "RankResult",
    "Sweep",
    "assert_matches",
    "bayes_nets",
    "compare",
    "enumerate_posterior",
    "evidence_for",
    "exact_sweep",
    "gaussian_evidence",
    "geweke_test",
    "random_evidence",
    "random_gaussian_net",
    "random_net",
    "rank_test",
    "transition_matrix",
    "transition_p_value",
    "uniformity_p_value",
]
