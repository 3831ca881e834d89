"""Faults of exact inference: tables, elimination, mixtures of Gaussians, draws of an exact answer."""

from __future__ import annotations

import bayesmc as bmc
from tests.mutants.faults import Edit
from tests.mutants.mutant import Mutant
from tests.mutants.tests_of import matched


def collider() -> bmc.BayesNet:
    """Two binary causes that differ, a common effect by a function, and a reading of it."""
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.2))
    net.add("b", bmc.Bernoulli(0.6))
    net.add("c", lambda a, b: bmc.Bernoulli(0.05 + 0.7 * a + 0.2 * b))
    net.add("d", lambda c, b: bmc.Bernoulli(0.1 + 0.6 * c + 0.2 * b))
    return net


def chain() -> bmc.BayesNet:
    """Four finite nodes in a row."""
    net = bmc.BayesNet()
    net.table("a", probs=[0.2, 0.3, 0.5])
    step = [[0.8, 0.1, 0.1], [0.1, 0.7, 0.2], [0.1, 0.1, 0.8]]
    for parent, name in ("ab", "bc", "cd"):
        net.table(name, parents=[parent], probs=step)
    return net


def switched() -> bmc.BayesNet:
    """A switch that moves a mean, with its reading, and what follows from it."""
    net = bmc.BayesNet()
    net.add("k", bmc.Bernoulli(0.4))
    net.add("x", lambda k: bmc.Normal(3.0 * k, 1.0))
    net.add("y", lambda x: bmc.Normal(0.5 * x, 1.0))
    net.add("z", lambda x: bmc.Normal(x, 0.5))
    return net


EXACT = bmc.Exact()
BY = "compare with exact() (no draws)"

MUTANTS = [
    Mutant(
        "a table's axes are transposed",
        (Edit("bayesmc.structure.tables:configurations",
              "_along(ahead + k, sizes[k], ", "_along(ahead + len(alone) - 1 - k, sizes[k], "),),
        matched(collider, {"d": 1}, EXACT),
        BY,
    ),
    Mutant(
        "a table's axes are transposed, for those who draw from it",
        (Edit("bayesmc.structure.tables:tabulate",
              "_along(axis, card, len(cards), ", "_along(len(cards) - 1 - axis, card, len(cards), "),),
        matched(collider, {"d": 1}, bmc.LikelihoodWeighting(4000)),
        "compare with exact(), 4000 draws",
    ),
    Mutant(
        "elimination takes the largest instead of the sum",
        (Edit("bayesmc.factors.propagation:row_sums",
              "return matrix.dot(ones(matrix.shape[1]))", "return matrix.max(axis=1)"),
         Edit("bayesmc.factors.propagation:weighted_rows",
              "return weights.dot(matrix)", "return (weights[:, None] * matrix).max(axis=0)"),
         Edit("bayesmc.factors.propagation:middle_sums",
              "flat.dot(adder)", "table.max(axis=1).reshape(before, after)")),
        matched(chain, {"d": 1}, EXACT),
        BY,
    ),
    Mutant(
        "draws of a clique ignore the separator",
        (Edit("bayesmc.factors.calibrated:Calibrated.sample",
              "rows * tree.cardinalities[v] + codes[v]", "rows * tree.cardinalities[v]"),),
        matched(chain, {"d": 1}, EXACT, draws=2000),
        "compare with exact(), 2000 draws of the answer",
    ),
    Mutant(
        "a mixture's variance forgets the spread of its means",
        (Edit("bayesmc.factors.moments:Components.collapsed",
              "within + (spread * self.weights[:, None]).T @ spread", "within"),),
        matched(switched, {"y": 0.7}, EXACT),
        BY,
    ),
    Mutant(
        "draws of a Gaussian forget its parents",
        (Edit("bayesmc.factors.moments:Moments.sample",
              "value = value + np.matvec(_flat(given.gain, given)[at], above)", "pass"),),
        matched(switched, {"y": 0.7}, EXACT, draws=2000),
        "compare with exact(), 2000 draws of the answer",
    ),
]  # fmt: skip
