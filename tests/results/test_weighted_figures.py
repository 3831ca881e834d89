"""Figures of weighted draws that must survive what computing does to numbers, and resampling to errors.

Sums against draws where weights and values are extreme, errors that duplicates do not shrink,
variances far from zero, infinities of weight zero, tables that round above 1.
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import bayesmc as bmc


def weighting(draws: int) -> bmc.LikelihoodWeighting:
    return bmc.LikelihoodWeighting(draws)


def two_ways(net: bmc.BayesNet, evidence: dict, draws: int = 50_000) -> list[bmc.Posterior]:
    """The same draws kept, and only summed; what their weights are worth is not the question."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", bmc.errors.LowEssWarning)
        return [
            bmc.infer(net, evidence, engine=weighting(draws), rng=0, keep=keep)
            for keep in ("draws", "summaries")
        ]


# ---- sums are the draws -------------------------------------------------------------------------


def exponential_of_a_wide_prior() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("s", bmc.Normal(0.0, 10.0))
    net.add("e", lambda s: np.exp(s))
    net.add("v", lambda s: bmc.stack([np.exp(s), s]))
    net.add("y", lambda s: bmc.Normal(s, 0.1))
    return net


def heavy_tailed_prior() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("s", bmc.StudentT(0.2, 0.0, 1.0))
    net.add("e", lambda s: np.cbrt(s))
    net.add("v", lambda s: bmc.stack([s, s]))
    net.add("y", lambda s: bmc.Normal(s, 0.1))
    return net


@pytest.mark.parametrize("make", [exponential_of_a_wide_prior, heavy_tailed_prior])
def test_sums_are_the_draws_where_the_prior_is_far_wider_than_the_posterior(make) -> None:
    """A centre taken from unweighted draws (1e20 and more here) swallows the posterior's spread."""
    draws, sums = two_ways(make(), {"y": 0.0})
    prior = make().sample(2000, rng=0)["e"]
    assert np.abs(prior).max() > 100 * draws.std("e")  # the trap is set
    for name in ("s", "e", "v"):
        np.testing.assert_allclose(sums.mean(name), draws.mean(name), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(sums.std(name), draws.std(name), rtol=1e-5)
        np.testing.assert_allclose(sums.mcse(name), draws.mcse(name), rtol=1e-5)
        np.testing.assert_allclose(sums.ess(name), draws.ess(name), rtol=1e-5)


def test_sums_are_the_draws_when_the_first_chunk_weighs_nothing() -> None:
    """Two draws in 10,000 are possible, chunks of 16,384 draws: weights begin late."""
    net = bmc.BayesNet()
    net.add("u", bmc.Uniform(0.0, 1.0))
    net.add("w", bmc.Normal(100.0, 1.0))
    net.add("y", lambda u: bmc.Bernoulli(np.where(u < 2e-5, 1.0, 0.0)))
    draws, sums = two_ways(net, {"y": 1}, 200_000)
    assert not draws.weights[0, :16_384].any()
    for name in ("u", "w"):
        for figure in ("mean", "std", "mcse", "ess"):
            expected = getattr(draws, figure)(name)
            np.testing.assert_allclose(getattr(sums, figure)(name), expected, rtol=1e-7)


# ---- zero times infinity ------------------------------------------------------------------------


def test_infinite_values_of_weight_zero_do_not_count() -> None:
    net = bmc.BayesNet()
    net.add("s", bmc.Normal(0.0, 500.0))
    net.add("e", lambda s: np.exp(s))  # infinite above 709, where the weight is exactly zero
    net.add("y", lambda s: bmc.Normal(s, 1.0))
    draws, sums = two_ways(net, {"y": 0.0})
    values, weights = draws["e"], draws.weights
    assert np.isinf(values).any() and not weights[np.isinf(values)].any()
    alive = weights > 0
    mean = float(weights[alive] @ values[alive])
    var = float(weights[alive] @ (values[alive] - mean) ** 2)
    for p in (draws, sums):
        assert p.mean("e") == pytest.approx(mean, rel=1e-9)
        assert p.var("e") == pytest.approx(var, rel=1e-6)
        assert np.isfinite(p.mcse("e")) and np.isfinite(p.ess("e"))
    assert draws.expectation(lambda e: e) == pytest.approx(mean, rel=1e-9)


def test_infinite_values_of_positive_weight_do_count() -> None:
    net = bmc.BayesNet()
    net.add("s", bmc.Normal(0.0, 500.0))
    net.add("e", lambda s: np.exp(s))
    for keep in ("draws", "summaries"):
        p = bmc.infer(net, engine=weighting(1000), rng=0, keep=keep)
        with np.errstate(all="ignore"):
            assert p.mean("e") == np.inf


# ---- variances ----------------------------------------------------------------------------------


@pytest.mark.parametrize("far", [0, 10**8, 10**12])
def test_variances_of_numbers_far_from_zero(far: int) -> None:
    """Three equally likely neighbours have variance 2/3 wherever they lie."""
    net = bmc.BayesNet()
    net.add("t", bmc.DiscreteUniform(far, far + 2))
    net.add("k", bmc.Categorical([0.2, 0.5, 0.3]), states=(far, far + 1.0, far + 5.0))
    p = np.array([0.2, 0.5, 0.3])
    numbers = np.array([0.0, 1.0, 5.0])
    of_k = p @ (numbers - p @ numbers) ** 2
    exact = bmc.infer(net, engine=bmc.Exact())
    assert exact.var("t") == pytest.approx(2 / 3, rel=1e-3 if far > 1e9 else 1e-12)
    assert exact.var("k") == pytest.approx(of_k, rel=1e-3 if far > 1e9 else 1e-12)
    for keep in ("draws", "summaries"):
        got = bmc.infer(net, engine=weighting(50_000), rng=0, keep=keep)
        # the sampling error of these variances is below 0.5 %: six of them
        assert got.var("t") == pytest.approx(2 / 3, rel=0.03)
        assert got.var("k") == pytest.approx(of_k, rel=0.03)


# ---- errors after resampling --------------------------------------------------------------------


@pytest.fixture(scope="module")
def sharp() -> bmc.Posterior:
    """10,000 draws that are worth some ten."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 0.001))
    net.add("z", lambda x: bmc.Normal(x, 1e-6))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", bmc.errors.LowEssWarning)
        return bmc.infer(net, {"y": 1.0}, engine=weighting(10_000), rng=0)


RESAMPLED = {
    "resample": lambda p: p.resample(10_000, rng=1),
    "resample twice": lambda p: p.resample(10_000, rng=1).resample(10_000, rng=2),
    "predict": lambda p: p.predict("y", rng=1),
    "predict of resampled": lambda p: p.resample(10_000, rng=1).predict("y", rng=2),
    "resample of predicted": lambda p: p.predict("y", rng=1).resample(10_000, rng=2),
}


@pytest.mark.parametrize("how", RESAMPLED)
def test_copies_of_a_draw_do_not_shrink_its_error(sharp, how: str) -> None:
    assert sharp.weight_ess < 30
    moved = RESAMPLED[how](sharp)
    distinct = len(np.unique(moved["x"]))
    assert moved.weights is None and distinct < 100  # the trap is set: 10,000 draws, few values
    for name in ("x", "z"):
        # resampling adds noise of its own, so somewhat above; 10,000 draws would be 20 times below
        assert 0.7 < moved.mcse(name) / sharp.mcse(name) < 3.0
        assert (
            moved.ess(name) <= 2 * distinct
        )  # more than distinct where the heavy ones are central
    assert 0.7 < moved.mcse(lambda x: 2 * x) / sharp.mcse(lambda x: 2 * x) < 3.0
    row = moved.summary()["x"]
    assert row["mcse"] == pytest.approx(float(moved.mcse("x"))) and row["ess"] <= 2 * distinct


def test_resampling_equal_draws_keeps_nearly_all_of_them() -> None:
    """Unweighted independent draws, each once: nothing is duplicated, so the error is the usual one."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    p = bmc.infer(net, engine=weighting(2000), rng=0).resample(2000, rng=1)
    assert p.ess("x") == pytest.approx(2000)
    assert p.mcse("x") == pytest.approx(p.std("x") / np.sqrt(2000), rel=1e-3)


def test_the_error_after_resampling_covers() -> None:
    """Of 200 standardised errors the standard deviation is 1 within 0.2 but for 1e-4 (chi-square)."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 0.05))
    truth = 1 / (1 + 0.05**2)
    off, naive = [], []
    for seed in range(200):
        p = bmc.infer(net, {"y": 1.0}, engine=weighting(4000), rng=seed).resample(4000, rng=seed)
        off.append(float((p.mean("x") - truth) / p.mcse("x")))
        naive.append(float((p.mean("x") - truth) / (p.std("x") / np.sqrt(4000))))
    assert np.std(off) == pytest.approx(1.0, abs=0.2)
    assert np.std(naive) > 2  # negative control: what counting copies as draws would claim


# ---- summaries ----------------------------------------------------------------------------------


def test_summary_of_labelled_states_that_round_above_one() -> None:
    """Observed labels have probability 1 up to rounding; sqrt(p (1 - p)) must not become NaN."""
    net = bmc.BayesNet(plates={"p": ("x", "y")})
    net.add("a", bmc.Bernoulli(0.3), states=("no", "yes"), plates="p")
    above = 0
    for seed in range(5):
        for keep in ("draws", "summaries"):
            p = bmc.infer(net, {"a": ["yes", None]}, engine=weighting(1000), rng=seed, keep=keep)
            above += bool(p.probabilities("a").max() > 1)
            s = p.summary(["a"])
            assert s["a[x, yes]"]["sd"] == pytest.approx(0.0, abs=1e-6)
            assert s["a[x, no]"]["sd"] == 0.0
            assert 0.4 < s["a[y, yes]"]["sd"] < 0.51
    assert above  # the trap is set


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_summary_of_very_few_draws_does_not_fail(count: int) -> None:
    net = bmc.BayesNet(plates={"p": 2})
    net.add("x", bmc.Normal(0.0, 1.0), plates="p")
    net.add("k", bmc.Bernoulli(0.5), states=("no", "yes"))
    p = bmc.infer(net, engine=weighting(count), rng=0)
    s = p.summary()
    assert np.isfinite(s["mean"]).all() and np.isnan(p.mcse("x")).all() == (count == 1)
    assert s["x[0]"]["5%"] <= s["x[0]"]["95%"]
    for bad in (0, -3, 2.5, True):
        with pytest.raises(ValueError, match=r"resample\(draws=.*\): draws is a whole number, 1"):
            p.resample(bad, rng=0)
