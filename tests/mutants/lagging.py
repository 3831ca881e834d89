"""Faults of answers that look ahead, where particles carry Gaussian beliefs about earlier slices."""

from __future__ import annotations

from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.testing.oracles.answers import exact
from bayesmc.testing.posteriors.repeated import repeated_test
from bayesmc.testing.verdict import Verdict
from tests.mutants.faults import Edit
from tests.mutants.filters import driven
from tests.mutants.mutant import ALPHA, Mutant

RISING = {"y": [0.3, 0.8, 2.5, 5.0]}


def figures(found: Any, t: int) -> dict[str, np.ndarray]:
    mean = found.mean("x")[t]
    return {"x": mean, "square": found.var("x")[t] + mean**2, "z": found.probabilities("z")[t]}


def late(seed: int) -> Verdict:
    """The second slice given all four rows: moments times the ratio of evidences."""
    right = exact(driven(), RISING)
    engine = bmc.ParticleFilter(300, marginalize="auto", delay=2, ess_threshold=2.0)

    def estimate(rng: np.random.Generator) -> dict[str, np.ndarray]:
        found = bmc.filter(driven(), RISING, engine=engine, rng=rng)
        ratio = np.exp(found.log_marginal_likelihood - right.log_marginal_likelihood)
        return {name: ratio * figure for name, figure in figures(found, 1).items()}

    return repeated_test(estimate, figures(right, 1), replications=30, alpha=ALPHA, rng=seed)


BY = "repeated_test, 30 runs of 300 particles"
MUTANTS = [
    Mutant(
        "delayed answers have the weights of their own rows",
        (Edit("bayesmc.engines.particles.backward:lagged",
              "spoken = filtered[-1]", "spoken = filtered[0]._replace(inner=filtered[-1].inner)"),),
        late, BY,
    ),
    Mutant(
        "beliefs about earlier slices stay behind when particles are resampled",
        (Edit("bayesmc.engines.marginal.lagging:Lagged.taken",
              "found = self._replace(mean=self.mean.take(ancestors, axis=0))", "found = self"),),
        late, BY,
    ),
    Mutant(
        "later rows move no mean of an earlier slice",
        (Edit("bayesmc.engines.marginal.lagging:told_more",
              "own.mean + np.matvec(gain, eta)", "own.mean"),),
        late, BY,
    ),
    Mutant(
        "noise of an earlier slice that no later row tells of is forgotten",
        (Edit("bayesmc.engines.marginal.lagging:told_more",
              "np.concatenate([own.spread[turned.at], before @ rest], axis=-1)",
              "own.spread[turned.at]"),),
        late, BY,
    ),
]  # fmt: skip
