"""Faults of expectation propagation on nets, where it must be exact.

On trees of finite nodes it is, and of factors that are Gaussian without looking so; one mixture by itself
keeps its moments, and one truncation has those of a truncated normal.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning
from bayesmc.testing.posteriors.repeated import repeated_test
from bayesmc.testing.verdict import Verdict
from tests.mutants.faults import Edit
from tests.mutants.mutant import ALPHA, Mutant
from tests.mutants.tests_of import Test

#: digits to which nothing is left to chance
_DIGITS = 5


def chain() -> bmc.BayesNet:
    """Four finite nodes in a row."""
    net = bmc.BayesNet()
    net.table("a", [], [0.3, 0.7])
    for name, above in (("b", "a"), ("c", "b"), ("d", "c")):
        net.table(name, [above], [[0.8, 0.2], [0.3, 0.7]])
    return net


def disguised() -> bmc.BayesNet:
    """A standard normal number, and a constraint that is a normal density of it."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.potential("near one", lambda x: -2.0 * (x - 1.0) ** 2)
    return net


def mixed() -> bmc.BayesNet:
    """A number whose mean follows a coin."""
    net = bmc.BayesNet()
    net.add("s", bmc.Bernoulli(0.5))
    net.add("x", lambda s: bmc.Normal(3.0 * s, 1.0))
    return net


def halved() -> bmc.BayesNet:
    """A standard normal number that is known to exceed a half."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("large", lambda x: bmc.Bernoulli(x > 0.5))
    return net


def shared() -> bmc.BayesNet:
    """Three throws of a coin of unknown bias."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("p", bmc.Beta(1.0, 1.0))
    net.add("k", lambda p: bmc.Bernoulli(p), plates="i")
    return net


def told(
    make: Callable[[], bmc.BayesNet],
    evidence: dict[str, Any],
    right: dict[str, np.ndarray],
    **options: Any,
) -> Test:
    """Figures of a net by messages, against known ones."""

    def test(seed: int) -> Verdict:
        def estimate(rng: np.random.Generator) -> dict[str, np.ndarray]:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ConvergenceWarning)  # figures are what is judged
                engine = bmc.ExpectationPropagation(**{"tolerance": 1e-10, **options})
                found = bmc.infer(make(), evidence, engine=engine)
            figures = {"log": np.nan_to_num(found.log_marginal_likelihood)}
            for name in right:
                kind, _, node = name.partition(" ")
                if kind != "log":
                    figures[name] = np.nan_to_num(getattr(found, kind)(node))
            return {name: np.round(figures[name], _DIGITS) for name in right}

        known = {name: np.round(value, _DIGITS) for name, value in right.items()}
        return repeated_test(estimate, known, replications=2, alpha=ALPHA, rng=seed)

    return test


def _of_chain() -> dict[str, np.ndarray]:
    step = np.array([[0.8, 0.2], [0.3, 0.7]])
    joint = np.einsum("a,ab,bc,cd->abcd", np.array([0.3, 0.7]), step, step, step)[..., 1]
    total = joint.sum()
    return {
        "probabilities b": joint.sum(axis=(0, 2)) / total,
        "probabilities a": joint.sum(axis=(1, 2)) / total,
        "log": np.log(total),
    }


DISGUISED = {
    "mean x": np.array(0.8),
    "var x": np.array(0.2),
    "log": np.array(-0.5 * np.log(5.0) - 2.0 + 0.5 * 16.0 / 5.0),
}
#: of a standard normal beyond a half, by its density there over the mass
_HAZARD = 1.1410777703680237
HALVED = {
    "mean x": np.array(_HAZARD),
    "var x": np.array(1.0 + 0.5 * _HAZARD - _HAZARD**2),
    "log": np.array(-1.175911761593618),
}
AT = "bayesmc.engines.propagation."
BY = "repeated_test of infer (no draws)"
TRUNCATED = told(halved, {"large": 1}, HALVED)
TREE, GAUSSIAN = told(chain, {"d": 1}, _of_chain()), told(disguised, {}, DISGUISED)

MUTANTS = [
    Mutant(
        "the message of a table is not divided out of its cavity",
        (Edit(f"{AT}batch:Batch._tilted", "beliefs.finite[e.group].logs[e.at[at]] - own[at]",
              "beliefs.finite[e.group].logs[e.at[at]]"),),
        TREE,
        BY,
    ),
    Mutant(
        "the evidence forgets what tables' messages integrate to",
        (Edit(f"{AT}batch:Batch._constants", "logs -= log_sum(cavity + table[at])", "pass"),),
        TREE,
        BY,
    ),
    Mutant(
        "a factor's own Gaussian stays in its cavity",
        (Edit(f"{AT}batch:Batch._tilted", "precision = own - self.precision[at]", "precision = own"),),
        told(mixed, {}, {"mean x": np.array(1.5), "var x": np.array(3.25)}),
        BY,
    ),
    Mutant(
        "of rows that are visited at once the own Gaussian stays in the cavity",
        (Edit(f"{AT}lines:LineBatch.visit", "precision = own - self.precision[:, 0, 0]",
              "precision = own - 0.97 * self.precision[:, 0, 0]"),),
        told(halved, {"large": 1}, {k: v for k, v in HALVED.items() if k != "log"}),
        BY,
    ),
    Mutant(
        "the evidence forgets what Gaussian messages integrate to",
        (Edit(f"{AT}batch:Batch._constants",
              "logs -= log_integral(own, found.linear + self.linear[at])", "pass"),
         Edit(f"{AT}lines:LineBatch.constants", "return whole - ", "return whole - 0.0 * ")),
        GAUSSIAN,
        BY,
    ),
    Mutant(
        "damping keeps the new share instead of the old",
        (Edit(f"{AT}pace:Pace.__init__", "self.given = self.share = 1.0 - damping",
              "self.given = self.share = damping"),),
        told(disguised, {}, {"var x": np.array(0.25), "mean x": np.array(0.75)}, sweeps=1, damping=0.25),
        "repeated_test of one sweep (no draws)",
    ),
    Mutant(
        "mixtures are replaced by Gaussians without the spread of their means",
        (Edit("bayesmc.factors.tilted:mixed", "cov + off[..., :, None] * off[..., None, :]", "cov"),),
        told(mixed, {}, {"mean x": np.array(1.5), "var x": np.array(3.25)}),
        BY,
    ),
    Mutant(
        "quadrature does not know where a factor jumps",
        (Edit(f"{AT}kernels:Density._integrated", "breaks)", "None)"),),
        TRUNCATED,
        BY,
    ),
    Mutant(
        "a family of its own is matched without dividing the message out",
        (Edit(f"{AT}conjugate:ConjugateBatch._faced", " - self.sites[at]", ""),),
        told(shared, {"k": np.array([1, 0, 1])}, {"mean p": np.array(0.6), "log": np.log(1.0 / 12.0)}),
        BY,
    ),
]  # fmt: skip
