"""Nodes at some values of which a density jumps: found, moved by slices, and answered for."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.mcmc.gibbs import plan_of
from bayesmc.kernels.hamiltonian import Hamiltonian
from bayesmc.network import pose
from bayesmc.structure.jumps import jumps
from bayesmc.structure.target import target_of
from bayesmc.structure.unconstrained import unconstrained_density

YEAR = np.arange(20)
COUNTS = np.random.default_rng(0).poisson(np.where(YEAR < 8, 3.0, 9.0))


def change_point() -> bmc.BayesNet:
    """Coal-mining disasters in small: Carlin, Gelfand and Smith (1992), with a continuous year."""
    net = bmc.BayesNet("change", plates={"year": len(YEAR)})
    net.add("change", bmc.Uniform(0.0, 20.0))
    net.add("early", bmc.LogNormal(1.0, 1.0))
    net.add("late", bmc.LogNormal(1.0, 1.0))
    net.add(
        "y",
        lambda change, early, late: bmc.Poisson(np.where(YEAR < change, early, late)),
        plates="year",
    )
    return net


def of(function: Any) -> frozenset[str]:
    """The nodes at which the mean of data jumps, as a function of two numbers."""
    net = bmc.BayesNet(plates={"year": len(YEAR)})
    net.add("a", bmc.Normal(0.0, 5.0))
    net.add("b", bmc.Normal(0.0, 5.0))
    net.add("y", lambda a, b: bmc.Normal(function(a, b), 1.0), plates="year")
    return jumps(unconstrained_density(target_of(pose(net, {"y": np.zeros(len(YEAR))}))))


@pytest.mark.parametrize(
    ("function", "wanted"),
    [
        (lambda a, b: np.where(YEAR < 3.0 * a, b, 0.0), {"a"}),
        (lambda a, b: np.where(a < b, 1.0, 2.0), {"a", "b"}),
        (lambda a, b: np.sign(a) + b, {"a"}),
        (lambda a, b: (a > 0.0) * b, {"a"}),
        (lambda a, b: a % 1.0 + b, {"a"}),
        (lambda a, b: np.where(YEAR < 3.0 * a, YEAR - 3.0 * a, 0.0) * b, set()),  # a hinge
        (lambda a, b: np.maximum(a, b) + np.abs(a) + np.where(b > 0.0, b, 0.1 * b), set()),
        (lambda a, b: np.clip(a, -1.0, 1.0) + b, set()),
        (lambda a, b: a * YEAR + b, set()),
    ],
)
def test_jumps_are_told_from_bends(function: Any, wanted: set[str]) -> None:
    assert of(function) == wanted


def exact_change() -> tuple[float, float]:
    """Mean and standard deviation of the change, by sums over a grid of all three."""
    log_rate = np.linspace(-2.0, 4.0, 2001)
    rates = np.exp(log_rate)
    prior = -0.5 * (log_rate - 1.0) ** 2  # of the logarithm
    logs = np.array([c * log_rate - rates for c in COUNTS])

    def evidence(rows: slice) -> float:
        total = prior + logs[rows].sum(axis=0)
        return float(np.log(np.exp(total - total.max()).sum()) + total.max())

    # the change is uniform between two years: (k - 1, k] has the first k years early
    log = np.array([evidence(slice(0, k)) + evidence(slice(k, None)) for k in range(1, 21)])
    weights = np.exp(log - log.max())
    weights /= weights.sum()
    middle = np.arange(1, 21) - 0.5
    mean = float(weights @ middle)
    return mean, float(np.sqrt(weights @ (middle - mean) ** 2 + 1.0 / 12.0))


@pytest.mark.parametrize(
    "engine", [bmc.HamiltonianMonteCarlo(), bmc.Gibbs()], ids=lambda e: type(e).__name__
)
def test_a_change_point_is_answered(engine: Any) -> None:
    """False-alarm rate: a mean beyond 4.5 standard errors: 1e-5 each."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # some trajectories diverge where few counts are left
        found = bmc.infer(change_point(), {"y": COUNTS}, engine=engine, rng=3)
    mean, sd = exact_change()
    assert abs(found.mean("change") - mean) < 4.5 * found.mcse("change")
    np.testing.assert_allclose(found.std("change"), sd, rtol=0.15)


def test_slices_move_what_jumps() -> None:
    problem = pose(change_point(), {"y": COUNTS})
    moved = [k.names for k in plan_of(problem).kernels if isinstance(k, Hamiltonian)]
    assert moved == [("early", "late")]
    (row,) = [r for r in bmc.HamiltonianMonteCarlo().table(problem) if r.node == "change"]
    assert "slice" in row.kernel and "the density jumps where it is compared" in row.why
