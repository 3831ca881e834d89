"""Numbers that a discrete filter knows given the states: cdf and quantiles against sums over the states."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import UnsupportedError

RATES = np.array([3.0, 11.0, 40.0])
ROWS = np.array([[0.8, 0.2, 0.0], [0.1, 0.7, 0.2], [0.0, 0.4, 0.6]])


def hmm() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet(plates={"site": 2})
    dbn.input("scale")
    start = [0.5, 0.5, 0.0]
    dbn.table("c", ["c_prev"], ROWS, initial=start)
    dbn.add("n", lambda c, scale: bmc.Poisson(scale * RATES[c]))
    dbn.add("x", lambda c: bmc.Normal(RATES[c], 1.0 + c), plates="site")
    dbn.add("pair", lambda c: bmc.MvNormal(RATES[c][..., None] * np.ones(2), np.eye(2)))
    return dbn


SCALE = np.array([1.0, 1.0, 2.0, 1.0, 0.5, 1.0, 3.0])
DATA = {
    "n": [2, 12, 70, np.nan],
    "x": [[3.0, 2.0], [np.nan, 10.0], [39.0, np.nan], [np.nan, np.nan]],
}


def checked(found: bmc.results.SeriesPosterior, scale: np.ndarray) -> None:
    """Against sums over the states, each slice by itself."""
    weights = found.probabilities("c")
    points = np.array([0.0, 2.5, 12.0, 41.0])
    counts = stats.poisson(scale[:, None, None] * RATES[:, None])
    wanted = np.einsum("tc,tcp->tp", weights, counts.cdf(points))
    np.testing.assert_allclose(found.cdf("n", points), wanted, atol=1e-12)
    normal = stats.norm(RATES[:, None], 1.0 + np.arange(3)[:, None])
    wanted = np.einsum("tc,cp->tp", weights, normal.cdf(points))
    np.testing.assert_allclose(found.cdf("x", points)[..., 1], wanted, atol=1e-12)
    levels = np.array([0.05, 0.5, 0.999])
    at = found.quantile("x", levels)
    assert at.shape == (len(weights), 3, 2)
    below = np.einsum("tc,tcp->tp", weights, normal.cdf(at[:, None, :, 0]))
    np.testing.assert_allclose(below, np.tile(levels, (len(weights), 1)), atol=1e-9)
    for t, at in enumerate(found.quantile("n", levels)):
        masses = weights[t] @ stats.poisson(scale[t] * RATES[:, None]).pmf(np.arange(300))
        below = np.cumsum(masses)
        np.testing.assert_array_equal(at, [np.argmax(below >= q) for q in levels])
        low, high = found.hdi("n", 0.8)[t].astype(int)
        assert masses[low : high + 1].sum() >= 0.8 - 1e-9
        assert found.mode("n")[t] == masses.argmax()
        inside = masses[masses > 0]
        assert found.entropy("n")[t] == pytest.approx(-(inside * np.log(inside)).sum(), abs=1e-9)
    np.testing.assert_array_equal(found.median("n"), found.quantile("n", 0.5))


def test_forecasts_of_numbers_are_mixtures_over_the_states() -> None:
    ahead = bmc.forecast(hmm(), DATA, steps=3, inputs={"scale": SCALE}, engine=bmc.DiscreteFilter())
    checked(ahead, SCALE[4:])
    engine = bmc.DiscreteFilter()
    belief = engine.start(hmm())
    for t in range(4):
        row = {n: v[t] for n, v in DATA.items()}
        belief = engine.step(belief, row, inputs={"scale": SCALE[t]})
    assert belief.cdf("n", 12.0) == pytest.approx(
        belief.probabilities("c") @ stats.poisson(RATES).cdf(12.0)
    )
    again = bmc.forecast(belief, engine=engine, steps=3, inputs={"scale": SCALE[4:]})
    np.testing.assert_allclose(again.cdf("n", [5, 20]), ahead.cdf("n", [5, 20]), atol=1e-12)


def test_filtered_and_smoothed_numbers_that_are_missing_are_mixtures_too() -> None:
    for ask in (bmc.filter, bmc.smooth):
        found = ask(hmm(), DATA, inputs={"scale": SCALE[:4]}, engine=bmc.DiscreteFilter())
        weights = found.probabilities("c")
        wanted = weights @ stats.norm(RATES, 1.0 + np.arange(3)).cdf(10.0)
        missing = np.isnan(DATA["x"])
        np.testing.assert_allclose(
            found.cdf("x", 10.0)[missing], np.stack([wanted] * 2, 1)[missing]
        )
        seen = np.asarray(DATA["x"])[~missing]
        np.testing.assert_array_equal(found.cdf("x", 10.0)[~missing], seen <= 10.0)
        np.testing.assert_array_equal(found.quantile("x", 0.3)[~missing], seen)
        assert found.quantile("n", 0.3)[:3].tolist() == DATA["n"][:3]
        assert found.cdf("n", 12.0)[3] == pytest.approx(weights[3] @ stats.poisson(RATES).cdf(12.0))
        other = copy.deepcopy(found)
        np.testing.assert_array_equal(other.quantile("x", 0.3), found.quantile("x", 0.3))


def test_what_is_no_number_with_a_cdf_is_refused_by_name() -> None:
    ahead = bmc.forecast(hmm(), DATA, steps=3, inputs={"scale": SCALE}, engine=bmc.DiscreteFilter())
    for ask in (ahead.cdf, ahead.quantile):
        with pytest.raises(UnsupportedError, match="'pair' has no quantile.*means and variances"):
            ask("pair", 0.5)
    with pytest.raises(UnsupportedError, match="'n' has no quantile"):
        pickle.loads(pickle.dumps(ahead)).cdf("n", 3)
