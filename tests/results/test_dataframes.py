"""Answers as data frames say what the answers say, under names that one finds them by."""

import importlib

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import MissingExtraError, QueryError, UnsupportedError

pd = pytest.importorskip("pandas")


def cities() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"city": ["Bonn", "Ulm"], "i": 3})
    net.add("m", bmc.Normal(0.0, 1.0), plates="city")
    net.add("k", bmc.Bernoulli(0.3), states=("no", "yes"), plates="city")
    net.add("v", bmc.MvNormal(np.zeros(2), np.eye(2)))
    net.add("y", lambda m: bmc.Normal(m, 1.0), plates=("city", "i"))
    return net


SEEN = {"y": np.ones((2, 3))}


def test_draws() -> None:
    posterior = bmc.infer(cities(), SEEN, engine=bmc.Gibbs(500, warmup=50, chains=2), rng=0)
    frame = posterior.to_dataframe()
    assert list(frame.columns) == ["m[Bonn]", "m[Ulm]", "k[Bonn]", "k[Ulm]", "v[0]", "v[1]"]
    assert frame.index.names == ["chain", "draw"] and len(frame) == 1000
    np.testing.assert_array_equal(frame.loc[1]["m[Ulm]"], posterior["m"][1, :, 1])
    np.testing.assert_array_equal(frame["v[1]"].to_numpy(), posterior["v"][..., 1].ravel())
    states = posterior["k"][..., 0].labels.ravel()
    assert frame["k[Bonn]"].tolist() == states.tolist()
    assert list(frame["k[Bonn]"].cat.categories) == ["no", "yes"]


def test_draws_of_answers_that_have_none_of_equal_weight() -> None:
    exact = bmc.infer(cities(), SEEN)
    with pytest.raises(UnsupportedError, match="pass resample=draws"):
        exact.to_dataframe()
    assert len(exact.to_dataframe(names="m", resample=7, rng=0)) == 7
    weighted = bmc.infer(cities(), SEEN, engine=bmc.LikelihoodWeighting(5000), rng=0)
    with pytest.raises(UnsupportedError, match="drop the weights; pass resample=draws"):
        weighted.to_dataframe()
    wanted = weighted.resample(30, rng=1)["m"][0, :, 0]
    frame = weighted.to_dataframe(names=["m"], resample=30, rng=1)
    np.testing.assert_array_equal(frame["m[Bonn]"], wanted)


def test_summaries_and_probabilities() -> None:
    posterior = bmc.infer(cities(), SEEN)
    summary = posterior.to_dataframe("summary", "m")
    np.testing.assert_allclose(summary["mean"], posterior.mean("m"))
    assert list(summary.index) == ["m[Bonn]", "m[Ulm]"]
    table = posterior.to_dataframe("probabilities").set_index(["node", "element", "state"])
    assert table.loc[("k", "Ulm", "yes"), "probability"] == pytest.approx(0.3)
    assert len(table) == 4
    with pytest.raises(UnsupportedError, match="'m'.*no finite set of states"):
        posterior.to_dataframe("probabilities", "m")
    with pytest.raises(QueryError, match="'draw'.*give one of 'draws', 'summary'"):
        posterior.to_dataframe("draw")


def test_beliefs_over_time() -> None:
    dbn = bmc.DynamicBayesNet(plates={"city": ["Bonn", "Ulm"]})
    dbn.table("w", ["w_prev"], [[0.9, 0.1], [0.2, 0.8]], ("dry", "wet"), initial=[0.5, 0.5])

    @dbn.node(initial=bmc.Normal(0.0, 1.0), plates="city")
    def x(x_prev, w):
        return bmc.Normal(x_prev + (w == "wet"), 1.0)

    dbn.add("y", lambda x: bmc.Normal(x, 1.0), plates="city")
    index = pd.date_range("2024-01-01", periods=3, freq="MS")
    rows = pd.DataFrame({"y[Bonn]": [1.0, 2.0, 3.0], "y[Ulm]": [3.0, None, 1.0]}, index=index)
    found = bmc.filter(dbn, rows, engine=bmc.ParticleFilter(200), rng=0)
    frame = found.to_dataframe(["w", "x"])
    assert (frame.index == index).all() and frame.columns.names == ["node", "element", "statistic"]
    np.testing.assert_array_equal(frame["x", "Ulm", "mean"], found.mean("x")[:, 1])
    np.testing.assert_array_equal(frame["x", "Bonn", "sd"], found.std("x")[:, 0])
    np.testing.assert_array_equal(frame["w", "", "wet"], found.probabilities("w")[:, 1])
    later = bmc.forecast(dbn, {"y": rows.to_numpy()}, steps=2, rng=0).to_dataframe("x")
    assert later.index.tolist() == [3, 4]


def test_quantiles_over_time() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    found = bmc.filter(dbn, {"y": [1.0, 2.0]})
    frame = found.to_dataframe("x", quantiles=[0.05, 0.975])
    np.testing.assert_allclose(frame["x", "", "97.5%"], found.quantile("x", 0.975))
    assert frame.index.tolist() == [0, 1]


def test_without_pandas(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str, *rest):
        raise ImportError(name)

    posterior = bmc.infer(cities(), SEEN)
    monkeypatch.setattr(importlib, "import_module", absent)
    for what in ("probabilities", "summary"):
        with pytest.raises(MissingExtraError, match=r"pip install 'bayesmc\[pandas\]'"):
            posterior.to_dataframe(what)
