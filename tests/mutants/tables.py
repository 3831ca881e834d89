"""Faults of the tables that particles carry of finite nodes."""

from __future__ import annotations

import numpy as np

import bayesmc as bmc
from tests.mutants.faults import Edit
from tests.mutants.mutant import Mutant
from tests.mutants.tests_of import evidence_of


def mapped() -> bmc.DynamicBayesNet:
    """Two cells that change colour most of the time, one who goes to and fro, and readings."""
    dbn = bmc.DynamicBayesNet(plates={"cell": 2})
    dbn.add(
        "color",
        lambda color_prev: bmc.Bernoulli(np.where(color_prev == 1, 0.1, 0.9)),
        initial=bmc.Bernoulli(0.5),
        plates="cell",
    )
    dbn.table("place", ["place_prev"], [[0.1, 0.9], [0.8, 0.2]], initial=[0.9, 0.1])
    dbn.add("reading", lambda color, place: bmc.Bernoulli(np.where(color[place] == 1, 0.95, 0.05)))
    return dbn


READINGS = {"reading": [1, 1, 1, 1, 1]}
TABLES = bmc.ParticleFilter(40, marginalize=["color"], ess_threshold=2.0)
TEST = evidence_of(mapped, READINGS, TABLES, 100)
BY = "unbiased_evidence_test, 100 runs of 40 particles"

MUTANTS: tuple[Mutant, ...] = (
    Mutant(
        "tables are not resampled with their particles",
        (Edit("bayesmc.engines.marginal.tables.beliefs:Tables.taken",
              "log.take(ancestors, axis=0)", "log[: len(ancestors)]"),),
        TEST, BY, is_long=True,
    ),
    Mutant(
        "a reading updates another element than the one that it reads",
        (Edit("bayesmc.engines.marginal.tables.groups:touched",
              "log[every, at] = own", "log[every, 1 - at] = own"),),
        TEST, BY,
    ),
    Mutant(
        "a particle is weighed by the likeliest state of a table, not by the sum over states",
        (Edit("bayesmc.engines.marginal.tables.groups:touched",
              "sums[every, at] += total", "sums[every, at] += own.max(axis=-1)"),),
        TEST, BY, is_long=True,
    ),
    Mutant(
        "elements that no reading reads forget their transition",
        (Edit("bayesmc.engines.marginal.tables.step:TableFilter.advanced",
              "logs.append(log)",
              "logs.append(log if before is None else np.where("
              "(log == moved.log).all(axis=-1)[..., None], before.logs[k], log))"),),
        TEST, BY,
    ),
)  # fmt: skip
