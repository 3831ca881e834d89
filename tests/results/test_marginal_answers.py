"""Intervals, modes, cdfs and entropies of every kind of posterior, held against closed forms and SciPy."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import QueryError, UnsupportedError
from bayesmc.results.laws import CurveLaws, DrawnLaws, TableLaws

SEEN = {"y": [0.5, np.nan, np.nan]}


def net() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"p": 3})
    net.add("s", bmc.Bernoulli(0.3), states=("no", "yes"))
    net.add("m", lambda s: bmc.Normal(np.where(s == "yes", 4.0, 0.0), 1.0))
    net.add("k", bmc.Binomial(5, 0.4))
    net.add("y", lambda m: bmc.Normal(m, 1.0), plates="p")
    return net


ENGINES = {
    "weighted": (bmc.LikelihoodWeighting(20_000), 0.1),
    "chains": (bmc.Gibbs(draws=1000, warmup=100), 0.15),
    "propagation": (bmc.ExpectationPropagation(), 0.12),  # one Gaussian for a mixture of two
}


@pytest.mark.parametrize("kind", ENGINES)
def test_every_kind_of_posterior_answers_as_the_exact_one(kind: str) -> None:
    """Deterministic at these seeds; bounds are some five standard errors of the estimates."""
    engine, near = ENGINES[kind]
    exact = bmc.infer(net(), SEEN, engine=bmc.Exact())
    found = bmc.infer(net(), SEEN, engine=engine, rng=0)
    assert found.hdi("y").shape == (3, 2) and found.cdf("y", [0.0, 1.0]).shape == (2, 3)
    np.testing.assert_allclose(found.hdi("m"), exact.hdi("m"), atol=2 * near)
    np.testing.assert_allclose(found.median("m"), exact.median("m"), atol=near)
    np.testing.assert_allclose(found.mode("m"), exact.mode("m"), atol=3 * near)
    np.testing.assert_allclose(found.entropy("m"), exact.entropy("m"), atol=near)
    np.testing.assert_allclose(found.cdf("m", [-1.0, 2.0]), exact.cdf("m", [-1.0, 2.0]), atol=near)
    np.testing.assert_allclose(found.entropy("s", "k"), exact.entropy("s", "k"), atol=near)
    assert found.mode("s").tolist() == "no" and found.mode("k") == 2
    assert found.entropy("y")[0] == -np.inf and found.hdi("y")[0].tolist() == [0.5, 0.5]


def test_exact_answers_are_those_of_closed_forms() -> None:
    exact = bmc.infer(net(), SEEN, engine=bmc.Exact())
    p, mean, sd = exact.probabilities("s"), exact.mean("m"), exact.std("m")
    given = [bmc.infer(net(), {**SEEN, "s": s}, engine=bmc.Exact()) for s in ("no", "yes")]
    parts = [stats.norm(float(g.mean("m")), float(g.std("m"))) for g in given]

    def density(x: Any) -> Any:
        return p[0] * parts[0].pdf(x) + p[1] * parts[1].pdf(x)

    x = np.linspace(mean - 12 * sd, mean + 12 * sd, 400_001)
    mass = density(x) * (x[1] - x[0])
    assert exact.entropy("m") == pytest.approx(-(mass * np.log(density(x))).sum(), abs=1e-6)
    assert exact.mode("m") == pytest.approx(x[density(x).argmax()], abs=1e-3)
    low, high = exact.hdi("m", 0.8)
    assert density(low) == pytest.approx(density(high), rel=1e-3)  # of equal height at both ends
    assert exact.cdf("m", high) - exact.cdf("m", low) == pytest.approx(0.8, abs=1e-6)
    table = exact.probabilities("k")
    assert exact.entropy("k") == pytest.approx(stats.entropy(table))
    np.testing.assert_allclose(exact.cdf("k", [1.0, 2.5]), table.cumsum()[[1, 2]])


def test_intervals_of_draws_are_arvizs() -> None:
    from arviz_stats.base import array_stats

    x = np.random.default_rng(0).gamma(3.0, size=(4000, 2))
    found = DrawnLaws(x, None, False).hdi(0.8)
    np.testing.assert_array_equal(found, [array_stats.hdi(x[:, k], 0.8) for k in (0, 1)])


def test_weighted_draws_are_like_their_copies() -> None:
    rng = np.random.default_rng(1)
    x, copies = rng.gamma(3.0, size=500), rng.integers(0, 4, 500)
    weighted = DrawnLaws(x, copies / copies.sum(), False)
    copied = DrawnLaws(np.repeat(x, copies), None, False)
    np.testing.assert_allclose(weighted.hdi(0.8), copied.hdi(0.8), atol=0.1)
    np.testing.assert_allclose(weighted.cdf(np.array([2.0])), copied.cdf(np.array([2.0])))
    assert weighted.hdi(0.8)[1] - weighted.hdi(0.8)[0] < copied.hdi(0.95)[1] - copied.hdi(0.95)[0]


def test_curves_know_skewed_and_bounded_numbers() -> None:
    gamma = stats.gamma(3.0)
    for curve, near in (
        (CurveLaws((), gamma.ppf), 0.02),
        (CurveLaws((), gamma.ppf, gamma.cdf, gamma.logpdf), 1e-5),
    ):
        assert curve.mode() == pytest.approx(2.0, abs=near)
        assert curve.entropy() == pytest.approx(gamma.entropy(), abs=1e-3)
        low, high = curve.hdi(0.89)
        assert gamma.pdf(low) == pytest.approx(gamma.pdf(high), abs=1e-4)
        assert curve.cdf(np.array(2.5)) == pytest.approx(gamma.cdf(2.5), abs=1e-6)
    low, high = CurveLaws((), stats.expon.ppf).hdi(0.5)
    assert low == pytest.approx(0.0, abs=1e-9) and high == pytest.approx(np.log(2.0))


def test_tables_hold_what_they_say() -> None:
    table = TableLaws(np.array([[0.1, 0.5, 0.3, 0.1], [0.4, 0.1, 0.1, 0.4]]), np.arange(4.0), "x")
    assert table.hdi(0.8).tolist() == [[1.0, 2.0], [0.0, 3.0]]


def test_draws_of_the_densest_value_at_an_end() -> None:
    x = np.random.default_rng(0).exponential(size=4000)
    assert DrawnLaws(x, None, False).mode() < 0.1  # the top of an exponential's density is 0
    assert DrawnLaws(x, None, False).entropy() == pytest.approx(1.0, abs=0.05)


def test_sums_answer_of_finite_nodes_and_refuse_numbers() -> None:
    engine = bmc.LikelihoodWeighting(20_000)
    found = bmc.infer(net(), SEEN, engine=engine, rng=0, keep="summaries")
    assert found.median("k") == 2 and found.mode("s").tolist() == "no"
    for ask in (found.hdi, found.median, found.entropy, found.mode):
        with pytest.raises(UnsupportedError, match='keep="draws"'):
            ask("m")


def test_what_makes_no_sense_is_refused_in_words() -> None:
    found = bmc.infer(net(), SEEN)
    for ask in (found.hdi, found.median):
        with pytest.raises(UnsupportedError, match="labels.*probabilities"):
            ask("s")
    with pytest.raises(UnsupportedError, match="no order"):
        found.cdf("s", 0.0)
    with pytest.raises(QueryError, match="between 0 and 1"):
        found.hdi("m", 95)
    with pytest.raises(QueryError, match="points are numbers"):
        found.cdf("m", "high")
    with pytest.raises(QueryError, match="at least one"):
        found.entropy()


def level() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


ROWS = [0.3, 0.8, np.nan, 1.2, 2.2]
SERIES = {
    "grid": (bmc.GridFilter({"x": (-8.0, 8.0, 400)}), {}, 0.02),
    "particles": (bmc.ParticleFilter(4000), {"keep": "particles"}, 0.12),
    "unscented": (bmc.UnscentedKalmanFilter(), {}, 1e-6),
}


@pytest.mark.parametrize("kind", SERIES)
def test_filters_answer_as_kalmans(kind: str) -> None:
    """Deterministic at this seed."""
    engine, options, near = SERIES[kind]
    exact = bmc.filter(level(), {"y": ROWS}, engine=bmc.KalmanFilter())
    found = bmc.filter(level(), {"y": ROWS}, engine=engine, rng=0, **options)
    sd = exact.std("x")
    np.testing.assert_allclose(exact.hdi("x", 0.95)[:, 1], exact.mean("x") + 1.959964 * sd)
    np.testing.assert_allclose(exact.entropy("x"), stats.norm(0, sd).entropy())
    for ask in ("hdi", "median", "entropy"):
        wanted = getattr(exact, ask)("x")
        np.testing.assert_allclose(getattr(found, ask)("x"), wanted, atol=2 * near + 1e-9)
    np.testing.assert_allclose(found.mode("x"), exact.mode("x"), atol=4 * near + 0.05)
    points = [0.0, 1.0]
    assert found.cdf("x", points).shape == (5, 2)
    np.testing.assert_allclose(found.cdf("x", points), exact.cdf("x", points), atol=near + 1e-9)


def test_beliefs_say_what_their_series_says() -> None:
    for engine in (bmc.KalmanFilter(), bmc.ParticleFilter(500)):
        own = {"rng": 0} if isinstance(engine, bmc.ParticleFilter) else {}
        belief = engine.step(engine.start(level(), **own), {"y": 0.3})
        low, high = belief.hdi("x")
        assert low < belief.median("x") < high and belief.cdf("x", high) > 0.85
        assert np.isfinite([belief.entropy("x"), belief.mode("x")]).all()
        again = pickle.loads(pickle.dumps(belief))
        np.testing.assert_array_equal(again.hdi("x"), belief.hdi("x"))


def test_particles_that_were_not_kept_say_so() -> None:
    found = bmc.filter(level(), {"y": ROWS}, engine=bmc.ParticleFilter(50), rng=0)
    for ask in (found.hdi, found.mode, found.entropy, found.median):
        with pytest.raises(UnsupportedError, match='keep="particles"'):
            ask("x")
