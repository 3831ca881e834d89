"""Faults of plates integrated out element by element, in a small linear-Gaussian world."""

from __future__ import annotations

import itertools
from functools import cache
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.testing.posteriors.repeated import repeated_test
from bayesmc.testing.verdict import Verdict
from tests.mutants.faults import Edit
from tests.mutants.mutant import ALPHA, Mutant

SHARES = np.array([0.6, 0.4])


def world(unknown: bool, looks: int = 2) -> bmc.DynamicBayesNet:
    """A robot that moves, and sees where two landmarks are from where it is."""
    dbn = bmc.DynamicBayesNet(plates={"mark": 2, "look": looks})
    dbn.add(
        "pose",
        lambda pose_prev: bmc.MvNormal(0.9 * pose_prev, np.array([[0.5, 0.1], [0.1, 0.3]])),
        initial=bmc.MvNormal(np.zeros(2), 0.5 * np.eye(2)),
    )
    dbn.add(
        "mark",
        lambda mark_prev: bmc.MvNormal(mark_prev, scale_diag=np.zeros(2)),
        plates="mark",
        initial=bmc.MvNormal(np.zeros(2), np.diag([4.0, 2.0])),
    )
    if unknown:
        dbn.add("which", lambda: bmc.Categorical(SHARES), plates="look")
    else:
        dbn.input("which", plates="look")
    dbn.add(
        "seen",
        lambda pose, mark, which: bmc.MvNormal(mark[which] - pose, scale_diag=[0.5, 0.6]),
        plates="look",
    )
    return dbn


@cache
def series(unknown: bool) -> tuple[np.ndarray, np.ndarray]:
    """Labels and readings, of which one is missing."""
    steps = 2 if unknown else 4
    labels = np.random.default_rng(5).integers(0, 2, (steps, 2))
    drawn = world(False).sample(steps, inputs={"which": labels}, rng=4)
    rows = np.array(drawn["seen"][0])
    rows[1, 0] = np.nan
    return labels, rows


@cache
def exactly(unknown: bool) -> tuple[float, np.ndarray]:
    """The log evidence, and means of all that there is in the last slice, by Kalman filters of all labels."""
    labels, rows = series(unknown)
    ways = [labels]
    if unknown:
        every = itertools.product(range(2), repeat=labels.size)
        ways = [np.array(way).reshape(labels.shape) for way in every]
    logs, means = [], []
    for way in ways:
        inputs = {"which": way}
        found = bmc.filter(world(False), {"seen": rows}, inputs=inputs, engine=bmc.KalmanFilter())
        prior = np.log(SHARES[way]).sum() if unknown else 0.0
        logs.append(found.log_marginal_likelihood + prior)
        means.append(figures(found))
    total = np.logaddexp.reduce(logs)
    return float(total), np.exp(np.array(logs) - total) @ np.array(means)


def figures(found: Any) -> np.ndarray:
    """Means and second moments of the last slice."""
    parts = []
    for name in ("pose", "mark"):
        mean, var = found.mean(name)[-1].ravel(), found.var(name)[-1].ravel()
        parts += [mean, var + mean**2]
    return np.concatenate(parts)


def unbiased(
    seed: int, unknown: bool, proposal: str | None, runs: int = 150, particles: int = 60
) -> Verdict:
    """The evidence, and answers weighed by it: neither has a bias, however few particles there are."""
    labels, rows = series(unknown)
    inputs = {} if unknown else {"which": labels}
    total, means = exactly(unknown)
    engine = bmc.ParticleFilter(particles, marginalize="mark", proposal=proposal)

    def run(rng: np.random.Generator) -> np.ndarray:
        found = bmc.filter(world(unknown), {"seen": rows}, inputs=inputs, engine=engine, rng=rng)
        share = np.exp(found.log_marginal_likelihood - total)
        return np.append(share * figures(found), share)

    return repeated_test(run, np.append(means, 1.0), replications=runs, alpha=ALPHA, rng=seed)


BY = "repeated_test against Kalman filters, 150 runs"
GUIDE = "bayesmc.engines.marginal.elements.guides:Guide.drawn"
MUTANTS = [
    Mutant(
        "the proposal's mean is taken instead of a draw",
        (Edit(GUIDE, "np.matvec(found.root,", "0.0 * np.matvec(found.root,"),),
        lambda seed: unbiased(seed, False, "optimal"), BY, is_long=True,
    ),
    Mutant(
        "weights of a guided pose are without p/q",
        (Edit(GUIDE, "return log_p - log_q + more,", "return 0.0 * log_p + more,"),),
        lambda seed: unbiased(seed, False, "optimal"), BY,
    ),
    Mutant(
        "innovations have the covariance of another matrix",
        (Edit("bayesmc.engines.marginal.elements.updates:conditioned",
              "found.slopes @ prior.root,", "found.slopes,"),),
        lambda seed: unbiased(seed, False, "optimal"), BY, is_long=True,
    ),
    Mutant(
        "a pick weighs by its own density, not by the sum over all",
        (Edit("bayesmc.engines.marginal.elements.step:ElementFilter._picked",
              "level = log_sum_exp(joint, axis=1)", "level = joint.max(axis=1)"),),
        lambda seed: unbiased(seed, True, "optimal"), BY,
    ),
]  # fmt: skip
