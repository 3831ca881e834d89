"""One question, three kinds of posterior: draws, sums and exact tables answer alike."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import UnsupportedError

EVIDENCE = {"x": [0.0, 2.5, 5.0], "seen": "yes"}


def the_net():
    net = bmc.BayesNet(plates={"p": 3})
    net.add("rain", bmc.Bernoulli(0.3), states=("no", "yes"))
    net.add("level", bmc.Categorical([0.2, 0.5, 0.3]), states=(0.0, 2.5, 5.0))
    net.add("g", lambda rain: bmc.Bernoulli(np.where(rain == "yes", 0.7, 0.2)), plates="p")
    net.add("total", lambda g: g.sum("p"))
    net.add("x", lambda level, g: bmc.Normal(level + g, 2.0), plates="p")
    net.add(
        "seen", lambda rain: bmc.Bernoulli(np.where(rain == "yes", 0.9, 0.2)), states=("no", "yes")
    )
    return net


@pytest.fixture(scope="module")
def answers():
    net = the_net()
    draws = bmc.LikelihoodWeighting(60_000)
    return {
        "exact": bmc.infer(net, EVIDENCE, engine=bmc.Exact()),
        "draws": bmc.infer(net, EVIDENCE, engine=draws, rng=0),
        "sums": bmc.infer(net, EVIDENCE, engine=draws, rng=0, keep="summaries"),
    }


def brute_force():
    """All configurations by the joint density alone."""
    net = the_net()
    grid = np.stack(
        np.meshgrid([0, 1], [0, 1, 2], [0, 1], [0, 1], [0, 1], indexing="ij"), -1
    ).reshape(-1, 5)
    values = {
        "rain": np.array(["no", "yes"])[grid[:, 0]],
        "level": np.array([0.0, 2.5, 5.0])[grid[:, 1]],
        "g": grid[:, 2:],
        "x": np.array(EVIDENCE["x"]),
        "seen": np.array("yes"),
    }
    log_p = net.log_prob(values)
    top = log_p.max()
    w = np.exp(log_p - top)
    return grid, w / w.sum(), top + np.log(w.sum())


def test_exact_is_brute_force(answers):
    p = answers["exact"]
    grid, w, log_z = brute_force()
    levels = np.array([0.0, 2.5, 5.0])
    assert p.log_marginal_likelihood == pytest.approx(log_z, rel=1e-12)
    np.testing.assert_allclose(p.probabilities("rain"), np.bincount(grid[:, 0], w), rtol=1e-10)
    np.testing.assert_allclose(p.probabilities("level"), np.bincount(grid[:, 1], w), rtol=1e-10)
    for t in range(4):
        expected = w @ (grid[:, 2:].sum(1) == t)
        assert p.probability(lambda total, t=t: total == t) == pytest.approx(expected)
    joint = np.zeros((3, 2, 3))
    for row, one in zip(grid, w, strict=True):
        for i in range(3):
            joint[i, row[0], row[1]] += one
    np.testing.assert_allclose(p.probabilities("rain", "level"), joint[0], rtol=1e-10)
    with_g = np.zeros((3, 2, 2))
    for row, one in zip(grid, w, strict=True):
        for i in range(3):
            with_g[i, row[2 + i], row[0]] += one
    np.testing.assert_allclose(p.probabilities("g", "rain"), with_g, rtol=1e-10)
    level = levels[grid[:, 1]]
    mean = w @ level
    assert p.mean("level") == pytest.approx(mean)
    assert p.var("level") == pytest.approx(w @ (level - mean) ** 2)
    both = np.stack([level, *grid[:, 2:].T.astype(float)])
    np.testing.assert_allclose(
        p.cov("level", "g"), np.cov(both, aweights=w, ddof=0), rtol=1e-9, atol=1e-13
    )
    f = np.exp(0.1 * level) * (grid[:, 0] == 1) + grid[:, 2:].sum(1)
    got = p.expectation(lambda level, rain, total: np.exp(0.1 * level) * (rain == "yes") + total)
    assert got == pytest.approx(w @ f)
    by_element = p.expectation(lambda g, level: g * level, plates="p")
    np.testing.assert_allclose(
        by_element, [w @ (grid[:, 2 + i] * level) for i in range(3)], rtol=1e-10
    )
    whole = p.expectation(lambda g: g.max(axis=-1))
    assert whole == pytest.approx(w @ grid[:, 2:].max(1))
    assert p.probability(lambda g: g.sum(axis=-1) >= 2) == pytest.approx(
        w @ (grid[:, 2:].sum(1) >= 2)
    )
    order = np.cumsum(np.bincount(grid[:, 1], w))
    for q in (0.05, 0.3, 0.5, 0.95):
        assert p.quantile("level", q) == levels[np.searchsorted(order, q)]


@pytest.mark.parametrize("kind", ["draws", "sums"])
def test_weighted_answers_are_within_their_errors(answers, kind):
    """Some 20 comparisons at 4.5 standard errors: false alarm about 1e-4 in all."""
    exact, got = answers["exact"], answers[kind]
    for name in ("rain", "level", "g"):
        e, p = exact.probabilities(name), got.probabilities(name)
        error = np.sqrt(e * (1 - e) / got.weight_ess)
        assert (np.abs(p - e) < 4.5 * error).all()
    for name in ("level", "g", "total"):
        assert (np.abs(got.mean(name) - exact.mean(name)) < 4.5 * got.mcse(name)).all()
        np.testing.assert_allclose(got.var(name), exact.var(name), rtol=0.05)
    error = got.log_marginal_likelihood_mcse
    assert abs(got.log_marginal_likelihood - exact.log_marginal_likelihood) < 4.5 * error
    # negative control: dropping the weights is seen
    prior = the_net().sample(20_000, rng=0)["level"].mean()
    assert abs(prior - exact.mean("level")) > 4.5 * got.mcse("level")


def test_sums_are_the_draws_without_the_draws(answers):
    draws, sums = answers["draws"], answers["sums"]
    for name in ("rain", "level", "g"):
        np.testing.assert_allclose(sums.probabilities(name), draws.probabilities(name), rtol=1e-9)
        np.testing.assert_allclose(sums.mcse(name), draws.mcse(name), rtol=1e-6)
        np.testing.assert_allclose(sums.ess(name), draws.ess(name), rtol=1e-6)
    for name in ("level", "total", "x"):
        np.testing.assert_allclose(sums.mean(name), draws.mean(name), rtol=1e-9)
        np.testing.assert_allclose(sums.var(name), draws.var(name), rtol=1e-7, atol=1e-12)
    assert sums.weight_ess == pytest.approx(draws.weight_ess)
    assert sums.log_marginal_likelihood == pytest.approx(draws.log_marginal_likelihood)
    assert sums.pareto_k == pytest.approx(draws.pareto_k, abs=0.02, nan_ok=True)
    for refused in (
        lambda: sums.quantile("x", 0.5),
        lambda: sums["level"],
        lambda: sums.resample(3),
        lambda: sums.expectation(lambda level: level),
        lambda: sums.probabilities("rain", "g"),
        lambda: sums.predict("x"),
        lambda: sums.marginal("level"),
    ):
        with pytest.raises(UnsupportedError, match='keep="draws"'):
            refused()


def test_sums_keep_precision_far_from_zero():
    net = bmc.BayesNet(plates={"p": 2})
    net.add("x", bmc.Normal(1e9, 1.0), plates="p")
    net.add("y", lambda x: bmc.Normal(x, 1.0), plates="p")
    p = bmc.infer(
        net, {"y": [1e9, 1e9]}, engine=bmc.LikelihoodWeighting(50_000), rng=0, keep="summaries"
    )
    np.testing.assert_allclose(p.var("x"), 0.5, rtol=0.05)
    np.testing.assert_allclose(p.mean("x") - 1e9, 0.0, atol=0.05)


def test_exact_summary_has_every_node(answers):
    s = answers["exact"].summary()
    assert s["total"]["mean"] == pytest.approx(answers["exact"].mean("total"))
    assert "x[0]" not in s.names


def test_exact_diagnostics_and_summary(answers):
    p = answers["exact"]
    assert p.mcse("level") == 0.0 and p.mcse("rain").tolist() == [0.0, 0.0]
    assert np.isinf(p.ess("g")).all() and np.isnan(p.rhat("g")).all()
    assert p.log_marginal_likelihood_mcse == 0.0
    assert p.weights is None and p.log_weights is None
    s = p.summary(["rain", "level", "g"])
    assert s["rain[yes]"]["mean"] == pytest.approx(p.probabilities("rain")[1])
    assert s["level"]["mean"] == pytest.approx(p.mean("level"))
    assert s["level"]["50%"] == p.quantile("level", 0.5)


def test_resampled_exact_draws(answers):
    exact = answers["exact"]
    p = exact.resample(40_000, rng=0)
    for name in ("rain", "level", "g"):
        e = exact.probabilities(name)
        # about 20 states at 4.5 standard errors: false alarm 1e-4
        assert (
            np.abs(p.probabilities(name) - e) < 4.5 * np.sqrt(e * (1 - e) / 40_000) + 1e-12
        ).all()
    np.testing.assert_array_equal(p["g"].sum(-1), p["total"])
    np.testing.assert_array_equal(p["x"][0, 0], EVIDENCE["x"])
    new = exact.predict("x", rng=1)
    np.testing.assert_allclose(new.mean("x"), exact.mean("level") + exact.mean("g"), atol=0.2)


def test_exact_refuses_raw_draws_with_the_remedy(answers):
    with pytest.raises(UnsupportedError, match=r"raw draws: ExactPosterior .*resample\(draws\)"):
        answers["exact"]["rain"]
    with pytest.raises(UnsupportedError, match="exact posterior has no draws; pass resample=draws"):
        answers["exact"].to_datatree()
    with pytest.raises(ValueError, match="quantiles lie between 0 and 1"):
        answers["exact"].quantile("level", 1.5)


@pytest.mark.parametrize(
    "kind",
    [
        "exact",
        "draws",
        "sums",
    ],
)
def test_every_posterior_pickles_without_its_functions(answers, kind):
    p = answers[kind]
    twin = pickle.loads(pickle.dumps(p))
    for name in ("rain", "level", "g"):
        np.testing.assert_array_equal(twin.probabilities(name), p.probabilities(name))
    assert twin.mean("level") == p.mean("level")
    assert twin.log_marginal_likelihood == p.log_marginal_likelihood
    assert str(twin.summary(["rain", "level"])) == str(p.summary(["rain", "level"]))
    assert "Posterior" in repr(twin)


@pytest.mark.parametrize("kind", ["exact", "draws"])
def test_pickled_posteriors_still_take_queries(answers, kind):
    """Tables and draws answer without the net's own functions, which a pickle does not carry."""
    p = answers[kind]
    twin = pickle.loads(pickle.dumps(p))
    for query in (
        lambda rain: rain == "yes",
        lambda level, g: level * g.max(axis=-1),
        lambda g: g.max(axis=-1),
    ):
        expected = p.expectation(query)
        np.testing.assert_allclose(twin.expectation(query), expected, rtol=1e-12)
    by_element = twin.expectation(lambda g, level: g * level, plates="p")
    np.testing.assert_allclose(by_element, p.expectation(lambda g, level: g * level, plates="p"))
    assert twin.probability(lambda rain: rain == "yes") == pytest.approx(p.probabilities("rain")[1])
    if kind == "exact":  # a sum over a plate is no table, and needs its function
        with pytest.raises(UnsupportedError, match="loaded or unpickled.*call infer again"):
            twin.expectation(lambda total: total)


def test_a_uniform_posterior_has_no_weights():
    p = bmc.infer(the_net(), engine=bmc.LikelihoodWeighting(500), rng=0)
    assert p.weights is None and p.weight_ess is None and p.log_marginal_likelihood == 0.0
    assert p["x"].shape == (1, 500, 3)
