"""Faults of beliefs that are products: Boyen and Koller's projection, and the factored frontier."""

from __future__ import annotations

import numpy as np

import bayesmc as bmc
from tests.mutants.faults import Edit
from tests.mutants.mutant import Mutant
from tests.mutants.tests_of import slices


def coupled() -> bmc.DynamicBayesNet:
    """Three nodes that read each other, with readings of one and of two."""
    dbn = bmc.DynamicBayesNet()
    table = np.array([[[0.9, 0.1], [0.5, 0.5]], [[0.3, 0.7], [0.2, 0.8]]])
    dbn.table("w", ["w_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.4, 0.6])
    dbn.table("x", ["w_prev", "x_prev"], table, initial=[0.7, 0.3])
    dbn.table("z", ["x_prev", "z_prev"], table, ("low", "high"), initial=[0.2, 0.8])
    dbn.table("y", ["x"], [[0.8, 0.2], [0.3, 0.7]])
    dbn.table("u", ["x", "z"], table)
    return dbn


def alone() -> bmc.DynamicBayesNet:
    """One node with readings."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("x", ["x_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.4, 0.6])
    dbn.table("y", ["x"], [[0.8, 0.2], [0.3, 0.7]])
    return dbn


#: two slices, the second of which is exact: what rows tie in the first is within a cluster
TWO = {"y": [0, 1], "u": [1, 1]}
ROWS = {"y": [0, 1, 1, 0], "u": [1, 1, 0, 0]}
OVERLAPPING = bmc.BoyenKoller([["w", "x"], ["x", "z"]])
WHOLE = bmc.BoyenKoller([["w", "x", "z"]])
FILTER = "repeated_test of filter (no draws)"
SMOOTH = "repeated_test of smooth (no draws)"
RUN = "bayesmc.engines.factored.run:FactoredRun"

MUTANTS = [
    Mutant(
        "the projection keeps the marginals of the slice before",
        (Edit(f"{RUN}._passed", "last = found[0]", "last = last or found[0]"),),
        slices(bmc.filter, coupled, TWO, OVERLAPPING, 2),
        FILTER,
    ),
    Mutant(
        "clusters that overlap count what they share twice",
        (Edit("bayesmc.engines.factored.clusters:Cluster.conditional", "if not self.separator:",
              "if True:"),),
        slices(bmc.filter, coupled, TWO, OVERLAPPING, 2),
        FILTER,
    ),
    Mutant(
        "factored beliefs take the evidence in twice",
        (Edit("bayesmc.engines.factored.slices:Stretch.further",
              "[(clique, table[k]) for clique, table in self._linear]",
              "[(clique, table[k]) for clique, table in self._linear] * 2"),),
        slices(bmc.filter, coupled, TWO, OVERLAPPING, 2),
        FILTER,
    ),
    Mutant(
        "factored beliefs leave out the slice before",
        (Edit(f"{RUN}._calibrated", "if before is not None:", "if False:"),),
        slices(bmc.filter, coupled, TWO, OVERLAPPING, 2),
        FILTER,
    ),
    Mutant(
        "smoothed over filtered is not divided",
        (Edit(f"{RUN}._calibrated", "semiring.ratio(later, now)", "later"),),
        slices(bmc.smooth, coupled, ROWS, WHOLE, 2),
        SMOOTH,
    ),
    Mutant(
        "what later rows say is handed back of the wrong slice",
        (Edit(f"{RUN}._backward", "later.put(t - 1, earlier[0])", "later.put(t - 1, found)"),),
        slices(bmc.smooth, coupled, ROWS, WHOLE, 2),
        SMOOTH,
    ),
    Mutant(
        "the factored frontier forgets what was seen",
        (Edit("bayesmc.engines.factored.frontier:Frontier._absorb", "self._margins |= after", "pass"),),
        slices(bmc.filter, alone, {"y": ROWS["y"]}, bmc.FactoredFrontier(), 2),
        FILTER,
    ),
    Mutant(
        "the factored frontier says backwards what it said forwards, too",
        (Edit("bayesmc.engines.factored.frontier:Frontier.go_back",
              "self.semiring.ratio(later[own], self._predicted[own])", "later[own]"),),
        slices(bmc.smooth, alone, {"y": ROWS["y"]}, bmc.FactoredFrontier(), 2),
        SMOOTH,
    ),
]  # fmt: skip
