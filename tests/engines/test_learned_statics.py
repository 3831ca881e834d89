"""Static nodes that are computed or learned, and nodes computed from readings that are missing."""

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import QueryError, UnsupportedError

ROWS = 12
KNOWN = {"p": np.array(0.85), "sigma": np.array(0.4)}
FLIP = np.array([[0.9, 0.1], [0.2, 0.8]])


#: as declared, and as a fit leaves them
PRIORS = {"p": bmc.Beta(9.0, 1.0), "sigma": bmc.HalfNormal(1.0)}
LEARNED = {"p": lambda: KNOWN["p"], "sigma": lambda: KNOWN["sigma"]}


def switching(static):
    dbn = bmc.DynamicBayesNet("a level whose drift switches")
    dbn.add_static("p", static["p"])
    dbn.add_static("leave", lambda p: 1 - p)
    dbn.add_static("sigma", static["sigma"])
    dbn.add(
        "s",
        lambda s_prev, p, leave: bmc.Bernoulli(np.where(s_prev == 1, p, leave)),
        initial=lambda p: bmc.Bernoulli(p),
    )
    dbn.add(
        "x",
        lambda x_prev, s, sigma: bmc.Normal(x_prev + np.where(s == 1, 0.3, -0.3), sigma),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    dbn.add("w", lambda leave: bmc.Normal(0.0, leave))  # depends on nothing hidden
    return dbn


def linear(static):
    dbn = bmc.DynamicBayesNet("a level")
    dbn.add_static("p", static["p"])
    dbn.add_static("sigma", static["sigma"])
    dbn.add("x", lambda x_prev, p: bmc.Normal(p * x_prev, 0.4), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x, sigma: bmc.Normal(x, sigma))
    dbn.add("w", lambda sigma: bmc.Normal(0.0, sigma))
    return dbn


def finite(static):
    dbn = bmc.DynamicBayesNet("moods")
    dbn.add_static("p", static["p"])
    dbn.add_static("sigma", static["sigma"])
    dbn.add(
        "s",
        lambda s_prev, p: bmc.Bernoulli(np.where(s_prev == 1, p, 1 - p)),
        initial=bmc.Bernoulli(0.5),
    )
    dbn.add("y", lambda s, sigma: bmc.Normal(s, sigma))
    dbn.add("w", lambda sigma: bmc.Normal(0.0, sigma))
    return dbn


def data(rng):
    y = rng.normal(size=ROWS)
    y[4] = np.nan
    return {"y": y, "w": 0.3 * rng.normal(size=ROWS)}


CASES = {
    "gpb2": (switching, bmc.SwitchingKalmanFilter()),
    "messages": (switching, bmc.ExpectationPropagation()),
    "particles, integrated": (switching, bmc.ParticleFilter(30, marginalize="auto")),
    "grid": (switching, bmc.GridFilter({"x": (-6, 6, 30)})),
    "kalman": (linear, bmc.KalmanFilter()),
    "unscented": (linear, bmc.UnscentedKalmanFilter()),
    "particles": (linear, bmc.ParticleFilter(30)),
    "tables": (finite, bmc.DiscreteFilter()),
}


@pytest.mark.parametrize("case", CASES)
def test_computed_static_nodes_answer_as_observed_ones_do(case):
    make, engine = CASES[case]
    rows = data(np.random.default_rng(1))
    for ask in (bmc.smooth, lambda *a, **k: bmc.forecast(*a, steps=2, **k)):
        computed = ask(make(LEARNED), rows, engine=engine, rng=0)
        observed = ask(make(PRIORS), {**rows, **KNOWN}, engine=engine, rng=0)
        np.testing.assert_allclose(computed.mean("y"), observed.mean("y"), rtol=1e-9)
        np.testing.assert_allclose(computed.var("y"), observed.var("y"), rtol=1e-9)


def test_what_a_fit_returns_is_filtered_by_the_engine_that_fitted_it():
    dbn, rows = switching(PRIORS), data(np.random.default_rng(1))
    engine = bmc.SwitchingKalmanFilter(merging="imm")
    rows["sigma"] = KNOWN["sigma"]
    found = bmc.fit(dbn, rows, prior=True, start={"p": 0.85}, engine=engine)
    filtered = bmc.filter(found.net, rows, engine=engine)
    assert filtered.log_marginal_likelihood == pytest.approx(found.log_likelihood, abs=1e-9)


def moods():
    dbn = bmc.DynamicBayesNet("moods")
    dbn.add("s", lambda s_prev: bmc.Categorical(FLIP[s_prev]), initial=bmc.Categorical([0.5, 0.5]))
    dbn.add("b", lambda s: bmc.Categorical(FLIP[s]))
    dbn.add("y", lambda s: bmc.Normal(s, 0.3))
    dbn.add("other", lambda b: 1 - b, states=(0, 1))
    dbn.add("high", lambda y: np.where(y > 0, 1, 0), states=(0, 1))
    return dbn


GRID = bmc.GridFilter({"y": (-2, 3, 400)})


@pytest.mark.parametrize("engine", [GRID, bmc.ParticleFilter(4000, marginalize="auto")])
@pytest.mark.parametrize("ask", [bmc.filter, bmc.smooth])
def test_nodes_computed_from_missing_readings_are_answered_for(engine, ask):
    """Tolerance of probabilities: 5 standard errors of 4000 draws, a false alarm in some 10^5 runs."""
    y = np.array([0.1, np.nan, 1.2, 0.9])
    exact = ask(moods(), {"y": y}, engine=bmc.DiscreteFilter())
    found = ask(moods(), {"y": y}, engine=engine, rng=0)
    state = exact.probabilities("s")[1]
    told = 0.04 if isinstance(engine, bmc.ParticleFilter) else 1e-3
    np.testing.assert_allclose(found.mean("other"), exact.mean("other"), atol=told)
    low = bmc.Normal(np.array([0.0, 1.0]), 0.3).cdf(0.0)
    assert found.mean("high")[1] == pytest.approx(1 - state @ low, abs=told)
    np.testing.assert_array_equal(found.mean("high")[[0, 2, 3]], [1, 1, 1])


def test_a_reading_without_cells_leaves_what_is_computed_from_it_unanswered_by_name():
    y, plain = np.array([0.1, np.nan, 1.2]), bmc.GridFilter()
    filtered = bmc.filter(moods(), {"y": y}, engine=plain)
    with pytest.raises(UnsupportedError, match="'high' is not answered for"):
        filtered.mean("high")
    assert bmc.forecast(moods(), {"y": y}, steps=2, engine=plain).mean("other").shape == (2,)
    with pytest.raises(
        QueryError, match="'high', which is computed from 'y', which is hidden and not on"
    ):
        bmc.filter(moods(), {"y": y}, engine=plain, queries={"h": lambda high: high == 1})
    assert bmc.filter(moods(), {"y": y}, rng=0).mean("high").shape == (3,)  # by an engine that can
