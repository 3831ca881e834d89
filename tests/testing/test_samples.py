"""Draws as evidence: averages corrected for skewness, independent rows, and the energy test's level."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.special
import scipy.stats

import bayesmc as bmc
from bayesmc.errors import ShapeError
from bayesmc.states import StateArray
from bayesmc.testing.posteriors.samples import Draws, energy_comparison, same_distribution


def few(total: int, level: float) -> float:
    """Alarms that a test at ``level`` exceeds in ``total`` repetitions with probability 1e-3."""
    return float(scipy.stats.binom.ppf(0.999, total, level))


def test_equal_laws_are_rejected_no_more_often_than_stated() -> None:
    """500 pairs of samples with ties, angles and labels; the test is exact, so both sides are bounded."""
    rng = np.random.default_rng(0)
    p_values = []
    for _ in range(500):
        a, b = (
            {"k": rng.poisson(1.0, n), "t": rng.vonmises(0, 1, n), "z": rng.integers(3, size=n)}
            for n in (25, 35)
        )
        p_values.append(energy_comparison(a, b, 0.05, rng, ["t"], ["z"]).p_value)
    alarms = sum(p < 0.05 for p in p_values)
    assert 11 <= alarms <= few(500, 0.05)  # fewer than 11 of 500 at 0.05 has probability 1e-3


def coupled(rng: np.random.Generator, n: int, r: float) -> dict[str, np.ndarray]:
    x, z = rng.standard_cauchy(n), rng.standard_normal(n)
    u = scipy.special.ndtri(scipy.stats.cauchy.cdf(x))
    return {"x": x, "y": r * u + np.sqrt(1 - r * r) * z}


def test_wrong_coupling_of_right_marginals_is_seen_even_without_moments() -> None:
    rng = np.random.default_rng(1)
    for seed in range(1):
        a, b = coupled(rng, 200, 0.9), coupled(rng, 200, 0.0)
        assert not same_distribution(a, b, rng=seed)
        # marginals alone say nothing
        assert same_distribution({"x": a["x"]}, {"x": b["x"]}, rng=seed, alpha=1e-4)


def test_angles_have_no_seam_and_labels_no_order() -> None:
    rng = np.random.default_rng(2)
    left, right = (np.mod(rng.vonmises(np.pi, 5, 150), 2 * np.pi) for _ in range(2))
    turned = np.where(right > np.pi, right - 2 * np.pi, right)
    assert same_distribution({"t": left}, {"t": turned}, angles=["t"], rng=0)
    assert not same_distribution({"t": left}, {"t": turned}, rng=0)
    swap = np.array([1, 0, 2])
    codes = rng.choice(3, p=[0.6, 0.3, 0.1], size=200)
    states = ("low", "mid", "high")
    a, b = StateArray(codes, states), StateArray(swap[codes], states)
    assert not same_distribution(a, b, rng=0)
    assert same_distribution(a, StateArray(rng.permutation(codes), states), rng=0)


def test_samples_that_do_not_fit_are_named() -> None:
    x = np.zeros(5)
    with pytest.raises(ShapeError, match="same variables"):
        same_distribution({"x": x}, {"y": x})
    with pytest.raises(ShapeError, match="one number of draws"):
        same_distribution({"x": x, "y": x[:3]}, {"x": x, "y": x})
    with pytest.raises(ShapeError, match="have shape"):
        same_distribution(x, np.zeros((5, 2)))
    assert same_distribution(x, x, rng=0)  # constants agree
    with pytest.raises(ValueError, match="strictly between"):
        same_distribution(x, x, alpha=0)


def skewed(kind: str, rng: np.random.Generator) -> tuple[Draws, np.ndarray]:
    """Draws of an Exp(1) variable, independent or weighted (proposed from a slower one)."""
    net = bmc.BayesNet()
    net.add("x", bmc.Exponential(1.0))
    engine = bmc.LikelihoodWeighting(800)
    if kind == "weighted":
        engine = bmc.Importance(800, proposal={"x": bmc.Exponential(0.7)})
    found = Draws(bmc.infer(net, engine=engine, rng=rng))
    return found, found.values("x")


@pytest.mark.parametrize("kind", ["independent", "weighted"])
def test_p_values_of_skewed_averages_hold_their_level(kind: str) -> None:
    """Squares of exponential draws: 80 averages, at level 0.05, and shares below the median."""
    rng = np.random.default_rng(3)
    squares, shares = [], []
    for _ in range(80):
        draws, x = skewed(kind, rng)
        squares.append(draws.average((x - 1.0) ** 2).p_value(1.0)[1])
        share, n = draws.share(x <= np.log(2), 0.5)
        shares.append(abs(share - 0.5) * 2 * np.sqrt(n))
    assert sum(p < 0.05 for p in squares) <= few(80, 0.05)
    assert sum(s > 1.96 for s in shares) <= few(80, 0.05)
    assert sum(p < 0.5 for p in squares) > 22  # of 40 expected: it does look


def test_an_average_that_few_draws_decide_says_so() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.StudentT(1.5, 0.0, 1.0))
    draws = Draws(bmc.infer(net, engine=bmc.LikelihoodWeighting(4000), rng=0))
    x = draws.values("x")
    assert draws.average(x**2).support < 30 < draws.average(np.tanh(x)).support


@pytest.mark.parametrize("kind", ["weighted", "resampled", "chains"])
def test_independent_rows_follow_the_posterior(kind: str) -> None:
    """Kolmogorov's distance of the rows from the exact law, 25 times at 0.05 (more than 6: 1e-3)."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    engine = {
        "chains": bmc.MetropolisHastings(150, warmup=60, chains=16),
    }.get(kind, bmc.LikelihoodWeighting(3000))
    alarms, sizes = 0, []
    for seed in range(1 if kind == "chains" else 25):
        posterior = bmc.infer(net, {"y": 1.0}, engine=engine, rng=seed)
        if kind == "resampled":
            posterior = posterior.resample(3000, rng=seed)
        rows = Draws(posterior).independent(["x"], 400, np.random.default_rng(seed))["x"]
        sizes.append(len(rows))
        law = scipy.stats.norm(0.5, np.sqrt(0.5))
        alarms += scipy.stats.kstest(rows, law.cdf).pvalue < 0.05
    assert min(sizes) > 50
    assert alarms <= few(len(sizes), 0.05)
