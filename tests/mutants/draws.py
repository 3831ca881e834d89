"""Faults of weighted and independent draws: what a draw weighs, what is made of weights, resampling."""

from __future__ import annotations

import numpy as np
import scipy.special

import bayesmc as bmc
from bayesmc.resampling import multinomial, residual, systematic
from bayesmc.testing.oracles.answers import exact
from bayesmc.testing.posteriors.calibration import simulation_based_calibration
from bayesmc.testing.verdict import Comparison, Verdict, counted
from tests.mutants.faults import Edit
from tests.mutants.mutant import ALPHA, Mutant
from tests.mutants.tests_of import estimated, evidence_of, matched

WEIGHTS = np.array([0.31, 0.02, 0.47, 0.2])


def mixture() -> bmc.BayesNet:
    """A number with a switch."""
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.3))
    net.add("x", bmc.Normal(0.5, 1.0))
    net.add("y", lambda a, x: bmc.Normal(x + 2.0 * a, 1.0))
    return net


def plated() -> bmc.BayesNet:
    """A mean, with readings of which some are missing."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0), plates="i")
    return net


def sprinkler() -> bmc.BayesNet:
    """Finite nodes of three states."""
    net = bmc.BayesNet()
    net.table("a", probs=[0.2, 0.3, 0.5])
    net.table("b", parents=["a"], probs=[[0.7, 0.2, 0.1], [0.1, 0.3, 0.6], [0.3, 0.3, 0.4]])
    net.table("c", parents=["b"], probs=[[0.9, 0.1], [0.5, 0.5], [0.2, 0.8]])
    return net


def held(seed: int) -> Verdict:
    """Whether two errors about a rare event's share hold it 95 times in 100, at 2000 elements of a plate."""
    net, share = bmc.BayesNet(plates={"i": 2000}), 0.02
    net.add("a", bmc.Bernoulli(share), plates="i")
    p = bmc.infer(net, engine=bmc.LikelihoodWeighting(100), rng=seed)
    missed = int((np.abs(p.mean("a") - share) > 2.0 * p.mcse("a")).sum())
    p_value = float(scipy.special.bdtrc(missed - 1, 2000, 0.05)) if missed else 1.0
    errors = (missed - 100.0) / np.sqrt(95.0)
    found = Comparison("intervals that miss", missed / 2000, 0.05, errors, p_value)
    return counted(Verdict("held", ALPHA, [found]))


def offspring(scheme: object) -> object:
    return lambda rng: np.bincount(scheme(WEIGHTS, 5, rng), minlength=4) / 5  # type: ignore[operator]


def median(rng: np.random.Generator) -> np.ndarray:
    return bmc.infer(mixture(), SEEN, engine=WEIGHTED, rng=rng).quantile("x", 0.5)


SEEN = {"y": 1.5}
WEIGHTED = bmc.LikelihoodWeighting(2000)
PROPOSED = bmc.Importance(2000, proposal={"x": lambda y: bmc.Normal(0.5 * y, 1.5)})
MEDIAN = exact(mixture(), SEEN).quantile("x", 0.5)
MATCHED = "compare with exact(), 2000 draws"
RUNS = "repeated_test, 500 runs"

MUTANTS = [
    Mutant(
        "p/q is inverted",
        (Edit("bayesmc.engines.proposing:Propose._divide",
              "state.weigh(-np.where(", "state.weigh(np.where("),),
        matched(mixture, SEEN, PROPOSED),
        MATCHED,
    ),
    Mutant(
        "q is left out of the weights",
        (Edit("bayesmc.engines.proposing:Propose._divide",
              "state.weigh(-np.where(np.isfinite(log_q), log_q, 0.0))", "pass"),),
        evidence_of(mixture, SEEN, bmc.Importance(20, proposal=PROPOSED.proposal), 100),
        "unbiased_evidence_test, 100 runs of 20 draws",
    ),
    Mutant(
        "draws from the prior are weighted by it, too",
        (Edit("bayesmc.network.forward:Draw.__call__",
              "state.values[self.node.name] = self.model.sample_stored(\n"
              "        self.node.name, dist, state.rng, state.batch\n    )",
              "state.values[self.node.name] = self.model.sample_stored(\n"
              "        self.node.name, dist, state.rng, state.batch\n    )\n"
              "    drawn = state.values[self.node.name]\n"
              "    state.weigh(self.model.log_density(self.node.name, dist, drawn))"),),
        matched(mixture, SEEN, WEIGHTED),
        MATCHED,
    ),
    Mutant(
        "a missing plate entry is weighted as if observed",
        (Edit("bayesmc.network.forward:DrawAndWeigh.__call__",
              "np.where(self.elements, density, partial)", "density"),),
        matched(plated, {"y": [2.0, np.nan, np.nan]}, WEIGHTED),
        MATCHED,
    ),
    Mutant(
        "weights are forgotten in a mean",
        (Edit("bayesmc.results.draws:DrawsPosterior._average",
              "diagnostics.weighted_mean(values, self.weights)",
              "diagnostics.weighted_mean(values, None)"),),
        matched(mixture, SEEN, WEIGHTED),
        MATCHED,
    ),
    Mutant(
        "weights are forgotten in a quantile",
        (Edit("bayesmc.results.draws:_quantiles",
              "weights=weights, method=method", 'method="linear"'),),
        estimated(median, MEDIAN, 40),
        "repeated_test, 40 runs of 2000 draws",
    ),
    Mutant(
        "the error of a share that was never seen is zero",
        (Edit("bayesmc.diagnostics:share_mcse",
              "np.multiply(step, unseen)", "0.0 * np.multiply(step, unseen)"),),
        held,
        "two errors about 2000 shares, 100 draws",
    ),
    Mutant(
        "what was never seen weighs half a draw",
        (Edit("bayesmc.diagnostics:share_mcse", "np.sqrt(_ADDED) /", "0.5 /"),),
        held,
        "two errors about 2000 shares, 100 draws",
    ),
    Mutant(
        "the evidence is averaged over one draw too many",
        (Edit("bayesmc.engines.weighted.drawing:WeightedEngine._set_evidence",
              "log_total - float(np.log(draws))", "log_total - float(np.log(draws + 1))"),),
        evidence_of(mixture, SEEN, bmc.LikelihoodWeighting(5), 500),
        "unbiased_evidence_test, 500 runs of 5 draws",
    ),
    Mutant(
        "the last state of a table is never drawn",
        (Edit("bayesmc.engines.forward:TableDraw._compare",
              "for edge in self.edges[1:]:", "for edge in self.edges[2:]:"),),
        matched(sprinkler, {"c": 1}, WEIGHTED),
        MATCHED,
    ),
    Mutant(
        "rejection by a bound that is too low",
        (Edit("bayesmc.engines.weighted.rejection:_unit_tried",
              "np.exp(chunk.log_weight)", "np.exp(chunk.log_weight + 1.0)"),),
        matched(mixture, SEEN, bmc.Rejection(3000)),
        "compare with exact(), 3000 draws",
    ),
    Mutant(
        "what was observed is not weighed",
        (Edit("bayesmc.network.forward:Weigh.__call__",
              "self.weigh(state)", "state.weigh(np.zeros(state.batch))"),),
        lambda seed: simulation_based_calibration(
            bmc.LikelihoodWeighting(100), mixture(), replications=200, alpha=ALPHA, rng=seed),
        "simulation_based_calibration, 200 replications of 100 draws",
    ),
    Mutant(
        "systematic resampling with a fixed offset",
        (Edit("bayesmc.resampling.schemes:systematic", "else rng.random()", "else 0.5"),),
        estimated(offspring(systematic), WEIGHTS, 500),
        RUNS,
    ),
    Mutant(
        "residual resampling without the rest",
        (Edit("bayesmc.resampling.schemes:residual",
              "kept + _scattered(positions, left, rng)", "kept + left"),),
        estimated(offspring(residual), WEIGHTS, 500),
        RUNS,
    ),
    Mutant(
        "multinomial resampling by weights that are not normalised",
        (Edit("bayesmc.resampling.schemes:_scattered",
              "points *= positions[-1]", "points *= 0.9 * positions[-1]"),),
        estimated(offspring(multinomial), WEIGHTS, 500),
        RUNS,
    ),
]  # fmt: skip
