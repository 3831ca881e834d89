"""Faults of nodes that are linearised, where nothing is sampled and they are extended Kalman filters."""

from __future__ import annotations

import numpy as np

import bayesmc as bmc
from bayesmc.testing.posteriors.repeated import repeated_test
from bayesmc.testing.verdict import Verdict
from tests.mutants.faults import Edit
from tests.mutants.mutant import ALPHA, Mutant

ROWS = {"reach": [2.0, 1.9, 2.1], "bearing": [3.1, -3.1, -2.8]}


def orbit() -> bmc.DynamicBayesNet:
    """A place on the far side, where bearings go through pi."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x",
        lambda x_prev: bmc.MvNormal(x_prev + 0.2 * np.sin(x_prev), 0.05 * np.eye(2)),
        initial=bmc.MvNormal(np.array([-2.0, 0.1]), 0.1 * np.eye(2)),
    )
    dbn.add("reach", lambda x: bmc.Normal(np.hypot(x[..., 0], x[..., 1]), 0.1))
    dbn.add("bearing", lambda x: bmc.WrappedNormal(np.arctan2(x[..., 1], x[..., 0]), 0.1))
    return dbn


def extended(seed: int) -> Verdict:
    """Means, spreads and increments of all slices."""
    found, right = (
        bmc.filter(orbit(), ROWS, engine=engine, rng=seed)
        for engine in (bmc.ParticleFilter(2, marginalize=["x"]), bmc.ExtendedKalmanFilter())
    )
    one, other = (
        {"x": f.mean("x"), "spread": f.var("x"), "log": f.log_marginal_increments}
        for f in (found, right)
    )
    return repeated_test(lambda rng: one, other, replications=2, alpha=ALPHA, rng=seed)


BY = "repeated_test against ExtendedKalmanFilter"
WHERE = "bayesmc.engines.marginal.linearised:LinearisedReader."
MUTANTS = [
    Mutant(
        "derivatives are taken where the slice before was, not where this one is expected",
        (Edit(WHERE + "_passed", "level.tangents(centre[..., part.reads])",
              "(lambda n, p: level.tangents(centre[..., np.where(part.reads < n, part.reads, "
              "(part.reads - n - p) % max(n, 1))] if n else centre[..., part.reads]))("
              "self.layout.n_prev, self.layout.p)"),),
        extended, BY,
    ),
    Mutant(
        "a slice is linearised beside the mean of the one before",
        (Edit(WHERE + "_begun", "centre[..., :n] = mean", "centre[..., :n] = mean + 0.1"),),
        extended, BY,
    ),
    Mutant(
        "residuals of angles are taken the long way round",
        (Edit("bayesmc.engines.marginal.gaussians:take_in",
              "layout.angles[pattern.observed]", "None"),),
        extended, BY,
    ),
]  # fmt: skip
