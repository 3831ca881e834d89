"""Faults of Laplace's method and of checks: where posteriors are Gaussian in free numbers, and beside it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import special

import bayesmc as bmc
from bayesmc.errors import LowEssWarning
from bayesmc.testing.oracles.answers import exact
from bayesmc.testing.posteriors.matching import compare
from bayesmc.testing.posteriors.repeated import repeated_test
from bayesmc.testing.verdict import Verdict
from tests.mutants.faults import Edit
from tests.mutants.mutant import ALPHA, Mutant

AT = "bayesmc.engines.approximate."


def line() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Linear and Gaussian: everything is exact."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("m", bmc.Normal(1.0, 2.0))
    net.add("x", lambda m: bmc.Normal(m, [1.0, 2.0, 3.0]), plates="i")
    net.add("y", lambda x: bmc.Normal(2.0 * x, 1.0), plates="i")
    return net, {"y": [1.0, np.nan, 4.0]}


def log_normal() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """A positive number whose log has a Gaussian posterior."""
    net = bmc.BayesNet()
    net.add("size", bmc.LogNormal(0.5, 0.8))
    net.add("y", lambda size: bmc.Normal(np.log(size), 0.6))
    return net, {"y": -0.4}


def of_log_normal() -> dict[str, np.ndarray]:
    precision = 0.8**-2 + 0.6**-2
    mean = (0.5 * 0.8**-2 - 0.4 * 0.6**-2) / precision
    spread = 0.8**2 + 0.6**2
    return {
        "size": np.exp(mean + 0.5 / precision),
        "var": np.expm1(1 / precision) * np.exp(2 * mean + 1 / precision),
        "evidence": -0.5 * np.log(2 * np.pi * spread) - 0.5 * 0.9**2 / spread,
    }


def exactly(seed: int) -> Verdict:
    net, evidence = line()
    found = bmc.infer(net, evidence, engine=bmc.LaplaceApproximation())
    return compare(found, exact(*line()), ALPHA)


def in_its_own_coordinates(seed: int) -> Verdict:
    def estimate(rng: np.random.Generator) -> dict[str, Any]:
        net, evidence = log_normal()
        found = bmc.infer(net, evidence, engine=bmc.LaplaceApproximation())
        return {
            "size": found.mean("size"),
            "var": found.var("size"),
            "evidence": found.log_marginal_likelihood,
        }

    return repeated_test(estimate, of_log_normal(), replications=2, alpha=ALPHA, rng=seed)


def rates() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("rate", bmc.Gamma(2.0, 1.0))
    net.add("z", bmc.Bernoulli(0.4))
    net.add("y", lambda rate, z: bmc.Poisson(rate * (1.0 + z)))
    return net


def corrected(draws: int) -> Callable[[int], Verdict]:
    """What a check makes of a rate and a state that is summed out."""

    def test(seed: int) -> Verdict:
        net = rates()
        posterior = bmc.infer(net, {"y": 3}, engine=bmc.LaplaceApproximation(), rng=seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LowEssWarning)
            found = posterior.check(draws, rng=seed).posterior
        return compare(found, exact(rates(), {"y": 3}), ALPHA)

    return test


def told_apart(seed: int) -> Verdict:
    """Whether a check tells a Gaussian that is far too narrow from one that fits, as a figure."""

    def estimate(rng: np.random.Generator) -> dict[str, Any]:
        net, evidence = line()
        found = bmc.infer(net, evidence, engine=bmc.LaplaceApproximation())
        return {"k": float(found.check(500, rng=rng).k == -np.inf)}

    return repeated_test(estimate, {"k": np.array(1.0)}, replications=2, alpha=ALPHA, rng=seed)


#: counts whose rate changed once
COUNTS = np.array([1, 0, 1, 1, 0, 1, 1, 1, 1, 0, 0, 4])


def changed() -> bmc.BayesNet:
    """A change point with a rate before it and one after."""
    net = bmc.BayesNet(plates={"t": len(COUNTS)})
    net.add("last", bmc.DiscreteUniform(0, len(COUNTS) - 1))
    for name in ("before", "after"):
        net.add(name, bmc.Gamma(1.0, 0.5))
    first = np.arange(len(COUNTS))
    net.add(
        "y",
        lambda last, before, after: bmc.Poisson(np.where(first <= last, before, after)),
        plates="t",
    )
    return net


def of_changed() -> dict[str, np.ndarray]:
    """The exact answer: rates are summed out for every place of the change."""
    total, before = [], []
    for last in range(len(COUNTS)):
        parts = COUNTS[: last + 1], COUNTS[last + 1 :]
        shapes = [(1.0 + part.sum(), 0.5 + len(part)) for part in parts]
        total.append(sum(np.log(0.5) + special.gammaln(a) - a * np.log(b) for a, b in shapes))
        before.append(shapes[0][0] / shapes[0][1])
    log = np.array(total) - special.gammaln(COUNTS + 1.0).sum() - np.log(len(COUNTS))
    evidence = special.logsumexp(log)
    share = np.exp(log - evidence)
    return {"evidence": evidence, "last": share @ np.arange(len(COUNTS)), "before": share @ before}


def elsewhere(seed: int) -> Verdict:
    """What a check makes of a product that misses changes with other rates."""
    engine = bmc.MeanField(restarts=2)
    posterior = bmc.infer(changed(), {"y": COUNTS}, engine=engine, rng=seed)

    def estimate(rng: np.random.Generator) -> dict[str, Any]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LowEssWarning)
            check = posterior.check(4000, rng=rng)
        found = check.posterior
        evidence = check.log_marginal_likelihood
        return {"evidence": evidence, **{n: found.mean(n) for n in ("last", "before")}}

    return repeated_test(estimate, of_changed(), replications=30, alpha=ALPHA, rng=seed)


EXACT = "compare on a linear-Gaussian net (no draws)"
BOUNDED = "repeated_test of a log-normal posterior (no draws)"
CHECK = "compare of corrected answers (4,000 draws)"
ELSEWHERE = "repeated_test of a change point, corrected (30 checks of 4,000 draws)"

MUTANTS = [
    Mutant(
        "the change of volume is left out of the density that is climbed",
        (Edit("bayesmc.structure.unconstrained:unconstrained_density",
              "kept += used[len(terms) :]", "pass"),
         Edit("bayesmc.structure.unconstrained_check:_check_sum",
              "not abs(found - wanted) <= _RTOL * size", "found is None")),
        in_its_own_coordinates,
        BOUNDED,
    ),
    Mutant(
        "curvature counts half",
        (Edit("bayesmc.structure.curvature:Curvature._exact", "-0.5 * (found", "-0.25 * (found"),
         Edit("bayesmc.structure.curvature:Curvature._agrees", "return False", "pass")),
        exactly,
        EXACT,
    ),
    Mutant(
        "the evidence is without the determinant",
        (Edit(f"{AT}modes:Mode.log_volume", "- np.log(np.diag(self.root)).sum()", "+ 0.0"),),
        exactly,
        EXACT,
    ),
    Mutant(
        "moments of bounded numbers are those of the middle",
        (Edit(f"{AT}free_gaussian:BoundedMarginal._moments", "self.loc + 0.5 * self.scale**2", "self.loc"),),
        in_its_own_coordinates,
        BOUNDED,
    ),
    Mutant(
        "draws have the covariance of the other factor",
        (Edit(f"{AT}free_gaussian:FreeGaussian._placed", 'lower=True, trans="T").T', "lower=True).T"),),
        told_apart,
        "repeated_test of whether a check finds equal weights (500 draws)",
    ),
    Mutant(
        "weights of a check forget what draws are drawn from",
        (Edit(f"{AT}weights:defended", "target - np.logaddexp", "target - 0.0 * np.logaddexp"),),
        corrected(4000),
        CHECK,
    ),
    Mutant(
        "a check forgets the change of volume",
        (Edit(f"{AT}free_gaussian:FreeGaussian._placed", "log - self.density.log_volume(u)", "log"),),
        corrected(4000),
        CHECK,
    ),
    Mutant(
        "a check counts states that were summed out twice",
        (Edit(f"{AT}free_gaussian:FreeGaussian._placed", "np.inf, log + given", "np.inf, log"),),
        corrected(4000),
        CHECK,
    ),
    Mutant(
        "both halves of a defensive mixture count whole",
        (Edit(f"{AT}free_gaussian:FreeGaussian.spread", "_log_t(z)) - np.log(2.0)", "_log_t(z))"),),
        corrected(4000),
        CHECK,
    ),
    Mutant(
        "draws of the prior do not stand beside those of an approximation",
        (Edit(f"{AT}check:checked", "found = defended(posterior, batch, besides)", "pass"),),
        elsewhere,
        ELSEWHERE,
    ),
    Mutant(
        "draws of the prior are weighed as if the approximation had made them",
        (Edit(f"{AT}weights:defended", "np.log(share) + prior)", "np.log(share) - 99.0)"),),
        elsewhere,
        ELSEWHERE,
    ),
]  # fmt: skip
