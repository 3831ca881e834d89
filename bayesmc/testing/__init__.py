"""Property-based tests of models, samplers and densities: a kit for ours and for users'.

Four kinds of tools. *Makers*: random nets, templates, factor graphs, distributions and weights, by seed or as
Hypothesis strategies. *Oracles*: exact answers that share no code with the engines; `exact` picks one.
*Tests* of engines and posteriors (`engine_test`, `assert_matches`, `simulation_based_calibration`,
`unbiased_evidence_test`), of kernels (`geweke_test`, `rank_test`, `invariant`, `detailed_balance`) and of
densities (`check_density`, `check_cpd`), each with a stated false-alarm rate and an answer that is true
where nothing deviates.
*Runs*: `session` says a run's seed and whether it is thorough, for the pytest plugin that comes with
bayesmc.

Import it by name (``import bayesmc.testing``). Hypothesis (extra ``test``) is needed for strategies only.
"""

from bayesmc.testing import session
from bayesmc.testing.densities.conditionals import check_cpd
from bayesmc.testing.densities.density import DensityCheck, check_density
from bayesmc.testing.kernels.balance import detailed_balance, invariant
from bayesmc.testing.kernels.geweke import GewekeResult, geweke_test
from bayesmc.testing.kernels.joint import JointModel
from bayesmc.testing.kernels.ranks import RankResult, rank_test
from bayesmc.testing.kernels.transition import (
    KernelMatrix,
    Sweep,
    exact_sweep,
    transition_matrix,
    transition_p_value,
)
from bayesmc.testing.kernels.uniformity import uniformity_p_value
from bayesmc.testing.makers.families import DistributionOptions, random_distribution
from bayesmc.testing.makers.gaussians import GaussianOptions, gaussian_evidence, random_gaussian_net
from bayesmc.testing.makers.graphs import GraphOptions, random_factor_graph
from bayesmc.testing.makers.nets import NetOptions, random_net
from bayesmc.testing.makers.observing import random_evidence
from bayesmc.testing.makers.spelling import as_code
from bayesmc.testing.makers.strategies import (
    bayes_nets,
    dbns,
    distributions,
    evidence_for,
    factor_graphs,
    log_weights,
)
from bayesmc.testing.makers.templates import DbnOptions, RandomDbn, random_dbn
from bayesmc.testing.makers.weights import WeightOptions, random_log_weights
from bayesmc.testing.oracles.answers import ExactAnswer, exact
from bayesmc.testing.oracles.conditional_gaussian import ConditionalGaussian, GaussianAnswer
from bayesmc.testing.oracles.enumeration import Enumerated, enumerate_posterior
from bayesmc.testing.oracles.quadrature import Quadrature, quadrature_posterior
from bayesmc.testing.posteriors.calibration import CalibrationResult, simulation_based_calibration
from bayesmc.testing.posteriors.evidence import EvidenceResult, unbiased_evidence_test
from bayesmc.testing.posteriors.matching import Match, assert_matches, compare
from bayesmc.testing.posteriors.matrix import EngineResult, engine_test
from bayesmc.testing.posteriors.repeated import repeated_test
from bayesmc.testing.posteriors.samples import same_distribution
from bayesmc.testing.verdict import Comparison, Verdict, uncounted

__all__ = [
    "CalibrationResult",
    "Comparison",
    "ConditionalGaussian",
    "DbnOptions",
    "DensityCheck",
    "DistributionOptions",
    "EngineResult",
    "Enumerated",
    "EvidenceResult",
    "ExactAnswer",
    "GaussianAnswer",
    "GaussianOptions",
    "GewekeResult",
    "GraphOptions",
    "JointModel",
    "KernelMatrix",
    "Match",
    "NetOptions",
    "Quadrature",
    "RandomDbn",
    "RankResult",
    "Sweep",
    "Verdict",
    "WeightOptions",
    "as_code",
    "assert_matches",
    "bayes_nets",
    "check_cpd",
    "check_density",
    "compare",
    "dbns",
    "detailed_balance",
    "distributions",
    "engine_test",
    "enumerate_posterior",
    "evidence_for",
    "exact",
    "exact_sweep",
    "factor_graphs",
    "gaussian_evidence",
    "geweke_test",
    "invariant",
    "log_weights",
    "quadrature_posterior",
    "random_dbn",
    "random_distribution",
    "random_evidence",
    "random_factor_graph",
    "random_gaussian_net",
    "random_log_weights",
    "random_net",
    "rank_test",
    "repeated_test",
    "same_distribution",
    "session",
    "simulation_based_calibration",
    "transition_matrix",
    "transition_p_value",
    "unbiased_evidence_test",
    "uncounted",
    "uniformity_p_value",
]
