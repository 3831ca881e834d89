"""Templates that were unrolled, asked by their own names; paths, forecasts from beliefs, residual checks."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import QueryError, UnsupportedError

ROWS = [0.3, 0.8, np.nan, 1.2, 2.2]


def level(noise: float = 1.0) -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, noise))
    return dbn


def weather() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], ("dry", "wet"), initial=[0.5, 0.5])
    dbn.table("o", ["s"], [[0.9, 0.1], [0.2, 0.8]])
    return dbn


def test_slices_are_stacked_time_first() -> None:
    posterior = bmc.infer(level(), {"y": ROWS}, engine=bmc.Gibbs(200, warmup=100), rng=0)
    assert posterior["x"].shape == (4, 200, 5)
    np.testing.assert_array_equal(posterior["x"][:, :, 3], posterior["x[3]"])
    for ask in ("mean", "var", "std", "median", "mode", "mcse", "ess", "rhat", "entropy"):
        found = getattr(posterior, ask)("x")
        assert found.shape == (5,) and found[3] == getattr(posterior, ask)("x[3]")
    assert posterior.hdi("x").shape == (5, 2)
    assert posterior.quantile("x", [0.1, 0.9]).shape == (5, 2)
    assert posterior.cov("x").shape == (5, 5)
    assert posterior.predict("y", rng=0)["y"].shape == (4, 200, 5)
    assert posterior.summary(["x"]).names == tuple(f"x[{t}]" for t in range(5))


def test_smoothed_tables_are_the_unrolled_nets() -> None:
    rows = {"o": [0, 1, 1, 0]}
    posterior, smoothed = bmc.infer(weather(), rows), bmc.smooth(weather(), rows)
    np.testing.assert_allclose(posterior.probabilities("s"), smoothed.probabilities("s"))
    assert (
        posterior.mode("s").tolist() == smoothed.mode("s").tolist() == ["wet", "wet", "wet", "dry"]
    )
    assert posterior.probabilities("s", "o").shape == (4, 2, 2)
    np.testing.assert_allclose(posterior.entropy("s"), smoothed.entropy("s"))


def test_datatrees_have_a_dimension_of_time() -> None:
    pytest.importorskip("arviz_base")
    pytest.importorskip("xarray")
    tree = bmc.infer(level(), {"y": ROWS}, engine=bmc.Gibbs(400, warmup=100), rng=0).to_datatree()
    assert tree["posterior"]["x"].dims == ("chain", "draw", "time")
    np.testing.assert_array_equal(tree["observed_data"]["y"], ROWS)


@pytest.mark.parametrize("engine", [bmc.KalmanFilter(), bmc.ParticleFilter(1000)])
def test_paths_hang_together_as_the_posterior_does(engine: Any) -> None:
    """Covariances of neighbours, which no slice by itself knows; five standard errors, fixed seed."""
    draws = 2000
    smoothed = bmc.smooth(level(), {"y": ROWS}, engine=engine, rng=0)
    paths = smoothed.sample_paths(draws, rng=0)["x"]
    exact = bmc.infer(level(), {"y": ROWS}, engine=bmc.Exact()).cov("x")
    assert paths.shape == (draws, 5)
    error = 5 * np.sqrt((np.outer(np.diag(exact), np.diag(exact)) + exact**2) / draws)
    width = (
        1.0 if isinstance(engine, bmc.KalmanFilter) else 2.0
    )  # as few distinct particles as that
    assert (np.abs(np.cov(paths.T) - exact) < width * error).all()
    assert (
        np.abs(np.cov(paths[np.random.default_rng(0).permuted(np.arange(draws))].T) - exact)
    ).max() < 1
    shuffled = np.random.default_rng(0).permuted(paths, axis=0)  # slices by themselves
    assert not (np.abs(np.cov(shuffled.T) - exact) < width * error).all()


def test_paths_of_states_have_their_labels() -> None:
    paths = bmc.smooth(weather(), {"o": [0, 1, 1]}).sample_paths(2000, rng=0)
    share = (paths["s"] == "wet").mean(axis=0)
    wanted = bmc.smooth(weather(), {"o": [0, 1, 1]}).probabilities("s")[:, 1]
    np.testing.assert_allclose(share, wanted, atol=0.06)


def test_paths_are_refused_where_slices_are_all_that_is_known() -> None:
    filtered = bmc.filter(level(), {"y": ROWS})
    with pytest.raises(QueryError, match="smooth"):
        filtered.sample_paths(10)
    grid = bmc.GridFilter({"x": (-8.0, 8.0, 100)})
    with pytest.raises(UnsupportedError, match="GridFilter.*ParticleFilter.*infer"):
        bmc.smooth(level(), {"y": ROWS}, engine=grid).sample_paths(10)
    stored = pickle.loads(pickle.dumps(bmc.smooth(level(), {"y": ROWS})))
    with pytest.raises(UnsupportedError, match="pickles"):
        stored.sample_paths(10)
    with pytest.raises(ValueError, match="whole number"):
        bmc.smooth(level(), {"y": ROWS}).sample_paths(0)


def test_forecasts_go_on_from_beliefs() -> None:
    engine = bmc.KalmanFilter()
    belief = engine.start(level())
    for y in ROWS:
        belief = engine.step(belief, {"y": y})
    found = bmc.forecast(belief, steps=3, engine=engine, queries={"high": lambda x: x > 1.0})
    wanted = bmc.forecast(
        level(), {"y": ROWS}, steps=3, engine=engine, queries={"high": lambda x: x > 1.0}
    )
    assert found.start == wanted.start == 5
    for name in ("x", "y"):
        np.testing.assert_allclose(found.mean(name), wanted.mean(name))
        np.testing.assert_allclose(found.hdi(name), wanted.hdi(name))
        np.testing.assert_allclose(
            found.quantile(name, [0.1, 0.9]), wanted.quantile(name, [0.1, 0.9])
        )
    np.testing.assert_allclose(found.queries["high"], wanted.queries["high"], atol=1e-6)
    assert belief.t == 4  # it stays as it is
    with pytest.raises(TypeError, match="engine="):
        bmc.forecast(belief, steps=3)
    with pytest.raises(TypeError, match="absorbed"):
        bmc.forecast(belief, {"y": [1.0]}, steps=3, engine=engine)
    with pytest.raises(QueryError, match="nothing yet"):
        bmc.forecast(engine.start(level()), steps=3, engine=engine)
    with pytest.raises(TypeError, match="observations"):
        bmc.forecast(level(), steps=3)


def test_residual_checks_are_the_textbooks_and_find_what_is_off() -> None:
    rng = np.random.default_rng(3)
    x = np.cumsum(rng.normal(size=200))
    y = x + rng.normal(size=200)
    filtered = bmc.filter(level(), {"y": y}, engine=bmc.KalmanFilter())
    check, own = filtered.residual_check()["y"], filtered.innovations("y")
    r = [np.mean((own - own.mean())[k:] * (own - own.mean())[: len(own) - k]) for k in range(11)]
    r = [len(own[k:]) * v / (len(own) * r[0]) for k, v in enumerate(r)]
    q = 200 * 202 * sum(r[k] ** 2 / (200 - k) for k in range(1, 11))
    assert check["p_autocorrelation"] == pytest.approx(stats.chi2(10).sf(q))
    assert check["p_normality"] == pytest.approx(stats.jarque_bera(own).pvalue)
    assert min(check[k] for k in check if k.startswith("p_")) > 1e-3
    tight = bmc.KalmanFilter()
    with pytest.warns(bmc.errors.ModelMisfitWarning):
        wrong = bmc.filter(level(0.1), {"y": 4 * y}, engine=tight).residual_check("y", lags=5)
    assert wrong["y"]["p_sd"] < 1e-6
    flat = bmc.DynamicBayesNet()
    flat.add("m", lambda m_prev: bmc.Normal(m_prev, 0.01), initial=bmc.Normal(0.0, 10.0))
    flat.add("y", lambda m: bmc.Normal(m, 7.0))
    assert bmc.filter(flat, {"y": y}).residual_check()["y"]["p_autocorrelation"] < 1e-6


def test_innovations_of_any_filter_are_normal_scores() -> None:
    rng = np.random.default_rng(0)
    y = np.cumsum(rng.normal(size=60)) + rng.normal(size=60)
    exact = bmc.filter(level(), {"y": y}, engine=bmc.KalmanFilter()).innovations("y")
    found = bmc.filter(level(), {"y": y}, engine=bmc.ParticleFilter(2000), rng=0).innovations("y")
    known = np.isfinite(found)
    assert 8 <= known.sum() < 60
    assert np.corrcoef(found[known], exact[known])[0, 1] > 0.9
    with pytest.raises(QueryError, match="not observed"):
        bmc.filter(level(), {"y": y}, engine=bmc.ParticleFilter(100), rng=0).innovations("x")
