"""Pointwise likelihoods, leave-one-out, WAIC, comparisons, predictive checks: against ArviZ, by hand."""

from __future__ import annotations

import warnings
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import LowEssWarning, PlateError, QueryError, UnsupportedError

X = np.linspace(-1.0, 1.0, 12)
Y = np.array([0.1, -0.5, 0.3, 0.2, 0.9, 0.4, 1.1, 0.6, 1.5, 1.2, 1.1, np.nan])


def line(tail: Any = bmc.Normal) -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"day": None})
    net.input("x", plates="day")
    net.add("a", bmc.Normal(0.0, 3.0))
    net.add("b", bmc.Normal(0.0, 3.0))
    net.add("sd", bmc.HalfNormal(2.0))
    net.add("y", lambda a, b, sd, x: tail(a + b * x, sd), plates="day")
    return net


def student(mean: Any, sd: Any) -> bmc.StudentT:
    return bmc.StudentT(3.0, mean, sd)


@cache
def chains(tail: Any = bmc.Normal) -> bmc.Posterior:
    engine = bmc.Gibbs(500, warmup=300)
    return bmc.infer(line(tail), {"y": Y}, inputs={"x": X}, engine=engine, rng=0)


def test_log_likelihoods_are_the_densities_at_the_draws() -> None:
    posterior = chains()
    found = posterior.log_likelihood()["y"]
    mean = posterior["a"][..., None] + posterior["b"][..., None] * X
    wanted = stats.norm(mean, posterior["sd"][..., None]).logpdf(np.nan_to_num(Y))
    np.testing.assert_allclose(found[..., :-1], wanted[..., :-1])
    assert np.isnan(found[..., -1]).all()
    with pytest.raises(QueryError, match="not observed"):
        posterior.log_likelihood("a")


def test_criteria_are_arvizs_on_the_same_draws() -> None:
    pytest.importorskip("arviz_base")
    pytest.importorskip("xarray")
    from arviz_stats import compare, loo

    trees, ours = {}, {}
    for name, tail in {"normal": bmc.Normal, "t": student}.items():
        posterior = chains(tail)
        log = posterior.log_likelihood()["y"][..., :-1]
        trees[name] = loo(posterior.to_datatree(log_likelihood=True), pointwise=True)
        ours[name] = posterior.loo()
        assert ours[name].elpd == pytest.approx(trees[name].elpd, abs=1e-8)
        assert ours[name].se == pytest.approx(trees[name].se, abs=1e-8)
        assert ours[name].p == pytest.approx(trees[name].p, abs=1e-8)
        np.testing.assert_allclose(ours[name].pareto_k, trees[name].pareto_k.values, atol=1e-8)
        flat = log.reshape(-1, 11)  # Watanabe's formula as ArviZ has it
        waic = (np.log(np.exp(flat).mean(axis=0)) - flat.var(axis=0)).sum()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LowEssWarning)
            assert posterior.waic().elpd == pytest.approx(waic, abs=1e-8)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pandas' on ArviZ's own code
        table, wanted = bmc.compare(ours), compare(trees)
    assert list(table.names) == list(wanted.index)
    for key in ("elpd", "se", "p", "elpd_diff", "dse"):
        np.testing.assert_allclose(table[key], wanted[key], atol=1e-8)
    np.testing.assert_allclose(table["weight"], wanted["weight"], atol=2e-3)


def test_what_cannot_be_assessed_is_refused_in_words() -> None:
    posterior = chains()
    exact = bmc.BayesNet(plates={"day": 3})
    exact.add("m", bmc.Normal(0.0, 1.0))
    exact.add("y", lambda m: bmc.Normal(m, 1.0), plates="day")
    seen = {"y": [0.0, 1.0, 2.0]}
    with pytest.raises(UnsupportedError, match="resample"):
        bmc.infer(exact, seen).loo()
    weighted = bmc.infer(exact, seen, engine=bmc.LikelihoodWeighting(1000), rng=0)
    with pytest.raises(UnsupportedError, match="weighted.*resample"):
        weighted.loo()
    assert weighted.resample(500, rng=0).loo().elpd < 0
    with pytest.raises(QueryError, match="two models"):
        bmc.compare({"one": posterior})
    with pytest.raises(QueryError, match="observations"):
        bmc.compare({"one": posterior, "other": weighted.resample(500, rng=0)})
    with pytest.raises(QueryError, match="nothing was observed"):
        bmc.prior_predict(exact, 10, rng=0).log_likelihood()


def test_an_outlier_is_told_of() -> None:
    net = bmc.BayesNet(plates={"day": 8})
    net.add("m", bmc.Normal(0.0, 100.0))
    net.add("y", lambda m: bmc.Normal(m, 1.0), plates="day")
    posterior = bmc.infer(net, {"y": [0.1, 0.2, 0.3, 0.0, -0.2, 0.1, 0.0, 40.0]}).resample(
        2000, rng=0
    )
    with pytest.warns(LowEssWarning, match="Pareto k"):
        found = posterior.loo()
    assert found.pareto_k is not None and found.pareto_k.argmax() == 7 and found.warning


def test_predictions_bring_their_own_plates() -> None:
    posterior = chains()
    more = posterior.predict("y", inputs={"x": [0.0, 0.5, 2.0, 3.0]}, rng=0)
    assert more["y"].shape == (4, 500, 4)
    np.testing.assert_allclose(
        more.mean("y"), posterior.mean("a") + posterior.mean("b") * [0, 0.5, 2, 3], atol=0.2
    )
    two = bmc.BayesNet(plates={"day": None})
    for name in ("u", "v"):
        two.input(name, plates="day")
    two.add("m", bmc.Normal(0.0, 1.0))
    two.add("y", lambda m, u, v: bmc.Normal(m * u + v, 1.0), plates="day")
    known = {"u": np.ones(3), "v": np.zeros(3)}
    found = bmc.infer(two, {"y": np.ones(3)}, inputs=known, engine=bmc.Gibbs(300, warmup=50), rng=0)
    with pytest.raises(PlateError, match="4 and 3"):
        found.predict("y", inputs={"u": np.ones(4), "v": np.ones(3)})


def test_prior_predictions() -> None:
    prior = bmc.prior_predict(line(), 4000, inputs={"x": [0.0, 1.0]}, rng=0)
    assert prior["y"].shape == (1, 4000, 2)
    assert prior.std("a") == pytest.approx(3.0, rel=0.06)  # five standard errors
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    assert bmc.prior_predict(dbn, 50, steps=4, rng=0)["x"].shape == (1, 50, 4)
    with pytest.raises(bmc.errors.ModelError, match="steps="):
        bmc.prior_predict(dbn, 50)
    with pytest.raises(PlateError):
        bmc.prior_predict(_sizeless(), 10)


def _sizeless() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"p": None})
    net.add("y", bmc.Normal(0.0, 1.0), plates="p")
    return net


def test_predictive_checks_find_what_a_model_misses() -> None:
    net = bmc.BayesNet(plates={"day": 30})
    net.add("m", bmc.Normal(0.0, 10.0))
    net.add("y", lambda m: bmc.Normal(m, 1.0), plates="day")
    y = np.r_[np.random.default_rng(0).normal(size=29), 9.0]
    check = bmc.infer(net, {"y": y}).predictive_check("y", rng=0)
    assert check["max"]["p"] < 0.01 and 0.1 < check["mean"]["p"] < 0.9
    assert check["max"]["observed"] == 9.0
    with pytest.raises(UnsupportedError, match="one number"):
        bmc.infer(net, {"y": y}).predictive_check("y", {"all": lambda v: v}, rng=0)


def test_loo_of_too_few_draws_or_copies_is_refused_by_name() -> None:
    net = bmc.BayesNet(plates={"day": 5})
    net.add("mean", bmc.Normal(0.0, 10.0))
    net.add("y", lambda mean: bmc.Normal(mean, 1.0), plates="day")
    seen = {"y": [0.1, 1.4, -0.3, 0.8, 0.5]}
    with pytest.raises(QueryError, match="20 draws are too few"):
        bmc.infer(net, seen).resample(20, rng=0).loo()
    for draws in (100, 300):  # worth 8 and 24
        with pytest.warns(LowEssWarning):
            weighted = bmc.infer(net, seen, engine=bmc.LikelihoodWeighting(draws), rng=0)
        with pytest.raises(QueryError, match="4000 draws are copies of"):
            weighted.resample(4000, rng=0).loo()
    enough = bmc.infer(net, seen, engine=bmc.LikelihoodWeighting(20_000), rng=0)
    assert enough.resample(4000, rng=0).loo().elpd == pytest.approx(-6.2, abs=0.3)


def line_of(name: str | None, values: np.ndarray) -> Any:
    net = bmc.BayesNet(name, plates={"i": None})
    net.add("m", bmc.Normal(0.0, 10.0))
    net.add("z", lambda m: bmc.Normal(m, 1.0), plates="i")
    return bmc.infer(net, {"z": values}).resample(1000, rng=0)


def test_densities_of_transformed_data_are_brought_to_one_scale_or_refused() -> None:
    y = np.exp(np.linspace(-1.0, 1.0, 9))
    raw, logs = line_of("raw", y), line_of("logs", np.log(y))
    for criterion in ("loo", "waic"):
        plain = getattr(logs, criterion)()
        moved = getattr(logs, criterion)(log_jacobian=-np.log(y))
        np.testing.assert_allclose(moved.pointwise, plain.pointwise - np.log(y), atol=1e-9)
        assert moved.p == pytest.approx(plain.p, abs=1e-9)
    with pytest.raises(
        QueryError, match=r"'z' and 'z'.*other scale.*loo\(log_jacobian=-np.log\(y\)\)"
    ):
        bmc.compare({"raw": raw, "logs": logs})
    with pytest.raises(QueryError, match="log_jacobian= is not the same"):
        bmc.compare({"moved": logs.loo(log_jacobian={"z": -np.log(y)}), "logs": logs, "raw": raw})
    shifted = line_of("shifted", y - 1.0)
    assert bmc.compare({"raw": raw, "moved": shifted.loo(log_jacobian=0.0)}).names
    for wrong, said in (
        ({"y": 1.0}, "'y' is none of the observed nodes"),
        (np.ones(3), r"broadcast to its observations, shape \(9,\), not \(3,\)"),
        (np.full(9, np.nan), "not finite"),
    ):
        with pytest.raises(QueryError, match=said):
            logs.loo(log_jacobian=wrong)


def test_a_list_of_models_is_compared_by_the_names_of_their_nets() -> None:
    y = np.linspace(-1.0, 1.0, 9)
    first, second, nameless = line_of("first", y), line_of("second", y), line_of(None, y)
    assert set(bmc.compare([first, second]).names) == {"first", "second"}
    for wrong in ([first, nameless], [first, first], [first.loo(), second.loo()]):
        with pytest.raises(QueryError, match="no names of their own"):
            bmc.compare(wrong)
    with pytest.raises(QueryError, match="two models or more.*not one"):
        bmc.compare([first])
