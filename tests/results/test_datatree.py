"""Groups of ArviZ's tree, as PyMC writes them, and that ArviZ takes them."""

import pickle
import warnings
from pathlib import Path

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning, LowEssWarning, UnsupportedError

pytest.importorskip("arviz_base")
pytest.importorskip("xarray")

DAYS = [f"d{k}" for k in range(6)]
X = np.linspace(-1.0, 1.0, 6)


def line() -> bmc.BayesNet:
    net = bmc.BayesNet("line", plates={"day": DAYS})
    net.input("x", plates="day")
    net.add("a", bmc.Normal(0.0, 3.0))
    net.add("sd", bmc.HalfNormal(2.0))
    net.add("k", bmc.Bernoulli(0.5), states=("no", "yes"))
    net.add("mu", lambda a, x: a + 2.0 * x, plates="day")
    net.add("y", lambda mu, sd, k: bmc.Normal(mu + (k == "yes"), sd), plates="day")
    return net


def chains(missing: bool) -> bmc.Posterior:
    y = 1.0 + 2.0 * X + np.random.default_rng(0).normal(size=6)
    if missing:
        y[3] = np.nan
    engine = bmc.Gibbs(300, warmup=100, chains=4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # so few draws need not have mixed
        return bmc.infer(line(), {"y": y}, inputs={"x": X}, engine=engine, rng=0)


def test_groups_dimensions_and_coordinates() -> None:
    posterior = chains(False)
    prior = bmc.prior_predict(line(), 50, inputs={"x": X}, rng=0)
    tree = posterior.to_datatree(log_likelihood=True, predictive=True, prior=prior, rng=1)
    assert set(tree.children) == {
        "posterior", "observed_data", "constant_data", "log_likelihood", "posterior_predictive", "prior",
        "prior_predictive",
    }  # fmt: skip
    assert tree["constant_data"]["x"].dims == ("day",)
    for group in ("log_likelihood", "posterior_predictive"):
        assert tree[group]["y"].dims == ("chain", "draw", "day")
        assert tree[group]["y"].shape == (4, 300, 6)
        assert tree[group]["day"].values.tolist() == DAYS
    np.testing.assert_array_equal(tree["log_likelihood"]["y"], posterior.log_likelihood()["y"])
    assert set(tree["prior"].data_vars) == {"a", "sd", "k", "mu"}
    assert tree["prior_predictive"]["y"].shape == (1, 50, 6)
    assert tree["posterior"]["k"].attrs["states"] == ["no", "yes"]
    codes = tree["posterior"]["k"].values
    np.testing.assert_array_equal(codes == 1, posterior["k"] == "yes")


@pytest.mark.parametrize("missing", [False, True])
def test_arvizs_loo_of_the_tree_is_ours(missing: bool) -> None:
    from arviz_stats import loo

    posterior = chains(missing)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LowEssWarning)
        warnings.simplefilter("ignore", UserWarning)
        tree = posterior.to_datatree(log_likelihood=True)
        found, wanted = posterior.loo(), loo(tree, pointwise=True)
    assert found.elpd == pytest.approx(wanted.elpd, abs=1e-8)
    assert found.se == pytest.approx(wanted.se, abs=1e-8)
    np.testing.assert_allclose(found.pareto_k, wanted.pareto_k.values.ravel(), atol=1e-8)
    if missing:
        assert tree["log_likelihood"]["y_observed"].values.tolist() == DAYS[:3] + DAYS[4:]


def test_predictions_have_plates_of_their_own() -> None:
    net = bmc.BayesNet(plates={"i": None})
    net.input("x", plates="i")
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a, x: bmc.Normal(a * x, 1.0), plates="i")
    posterior = bmc.infer(net, {"y": [1.0, 2.0]}, inputs={"x": [1.0, 2.0]}).resample(30, rng=0)
    new = posterior.predict("y", inputs={"x": [1.0, 2.0, 3.0]}, rng=0)
    tree = posterior.to_datatree(predictions=new)
    assert tree["predictions"]["y"].shape == (1, 30, 3) and tree["observed_data"]["y"].shape == (2,)
    assert tree["predictions_constant_data"]["x"].values.tolist() == [1.0, 2.0, 3.0]


def test_slices_are_a_dimension_in_every_group() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    posterior = bmc.infer(dbn, {"y": [1.0, np.nan, 2.0]})
    tree = posterior.to_datatree(resample=20, rng=0, log_likelihood=True, predictive=True)
    assert tree["posterior_predictive"]["y"].dims == ("chain", "draw", "time")
    assert tree["log_likelihood"]["y"].shape == (1, 20, 2)
    assert posterior.resample(20, rng=0)["x"].shape == (1, 20, 3)


def test_weighted_draws_are_refused_in_any_group() -> None:
    posterior = chains(False)
    weighted = bmc.infer(line(), {}, inputs={"x": X}, engine=bmc.LikelihoodWeighting(100), rng=0)
    weighted.weights = np.full((1, 100), 0.01)
    with pytest.raises(UnsupportedError, match="the group 'prior' are weighted"):
        posterior.to_datatree(prior=weighted)


@pytest.mark.parametrize("way", ["pickle", "file"])
def test_dates_travel_with_an_answer(way: str, tmp_path: Path) -> None:
    """Of a template's data by their index; a stored answer numbered its slices 0, 1, ... instead."""
    pd = pytest.importorskip("pandas")
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    rows = pd.DataFrame({"y": X[:4]}, index=pd.date_range("2024-01-01", periods=4, freq="MS"))
    answer = bmc.infer(dbn, rows, engine=bmc.Exact())
    wanted = answer.to_datatree(resample=3, rng=0)["posterior"]["time"].values
    assert (wanted == rows.index.values).all()
    if way == "pickle":
        kept = pickle.loads(pickle.dumps(answer.resample(3, rng=0)))
    else:
        pytest.importorskip("h5netcdf")
        answer.resample(3, rng=0).save(tmp_path / "answer.nc")
        kept = bmc.load(tmp_path / "answer.nc")
    assert (kept.to_datatree()["posterior"]["time"].values == wanted).all()
