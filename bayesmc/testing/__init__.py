"""Tools to test engines, and nets, against exact answers: random nets, enumeration, a statistical match.

Import it by name (``import bayesmc.testing``); it needs the extra ``test`` for ``bayes_nets`` and
``evidence_for`` only.
"""

from bayesmc.testing.conditional_gaussian import ConditionalGaussian, GaussianAnswer
from bayesmc.testing.gaussians import GaussianOptions, gaussian_evidence, random_gaussian_net
from bayesmc.testing.matching import Comparison, Match, assert_matches, compare
from bayesmc.testing.nets import NetOptions, random_net
from bayesmc.testing.observing import random_evidence
from bayesmc.testing.oracle import Enumerated, enumerate_posterior
from bayesmc.testing.strategies import bayes_nets, evidence_for

__all__ = [
    "Comparison",
    "ConditionalGaussian",
    "Enumerated",
    "GaussianAnswer",
    "GaussianOptions",
    "Match",
    "NetOptions",
    "assert_matches",
    "bayes_nets",
    "compare",
    "enumerate_posterior",
    "evidence_for",
    "gaussian_evidence",
    "random_evidence",
    "random_gaussian_net",
    "random_net",
]
