"""Posteriors held as draws, on hand-made draws whose answers are known."""

from __future__ import annotations

import copy
import pickle
import sys

import numpy as np
import pytest
import scipy.stats
from arviz_stats.base import array_stats

import bayesmc as bmc
from bayesmc.errors import MissingExtraError, ShapeError, UnknownNodeError, UnsupportedError
from bayesmc.network import pose
from bayesmc.results import DrawsPosterior

CHAINS, DRAWS = 2, 300


def the_net():
    net = bmc.BayesNet(plates={"k": ("first", "second"), "p": 3})
    net.add("m", bmc.Normal(0.0, 1.0), plates="k")
    net.add("z", bmc.Bernoulli(0.5), plates="p", states=("no", "yes"))
    net.add("g", bmc.DiscreteUniform(0, 1), plates="p")
    net.add("spin", bmc.Bernoulli(0.5), states=(-1, 1))
    net.add("v", bmc.MvNormal(np.zeros(2), np.eye(2)))
    net.add("s", lambda m: m.sum("k"))
    net.add("x", lambda m, g: bmc.Normal(m[g], 1.0), plates="p")
    net.add("y", lambda s: bmc.Normal(s, 1.0))
    return net


def draws(seed=0):
    rng = np.random.default_rng(seed)
    shape = (CHAINS, DRAWS)
    stored = {
        "m": rng.normal(size=(*shape, 2)),
        "z": rng.integers(0, 2, size=(*shape, 3)).astype(np.uint8),
        "g": rng.integers(0, 2, size=(*shape, 3)).astype(np.uint8),
        "spin": rng.integers(0, 2, size=shape).astype(np.uint8),
        "v": rng.normal(size=(*shape, 2)),
        "x": rng.normal(size=(*shape, 3)),
        "y": np.full((1, 1), 4.0),  # observed
    }
    stored["s"] = stored["m"].sum(-1)
    return stored


def posterior(weighted, **kwargs):
    problem = pose(the_net(), {"y": 4.0})
    log_weights = np.random.default_rng(9).normal(size=(CHAINS, DRAWS)) if weighted else None
    return DrawsPosterior(
        problem, bmc.LikelihoodWeighting(600), draws(), (CHAINS, DRAWS), log_weights, **kwargs
    )


def the_weights(weighted):
    if not weighted:
        return np.full((CHAINS, DRAWS), 1 / (CHAINS * DRAWS))
    w = np.exp(np.random.default_rng(9).normal(size=(CHAINS, DRAWS)))
    return w / w.sum()


both = pytest.mark.parametrize("weighted", [False, True], ids=["unweighted", "weighted"])


@both
def test_moments(weighted):
    p, w, d = posterior(weighted), the_weights(weighted), draws()
    for name in ("m", "v", "x", "s"):
        mean = np.tensordot(w, d[name], axes=([0, 1], [0, 1]))
        var = np.tensordot(w, (d[name] - mean) ** 2, axes=([0, 1], [0, 1]))
        np.testing.assert_allclose(p.mean(name), mean, rtol=1e-10)
        np.testing.assert_allclose(p.var(name), var, rtol=1e-10)
        np.testing.assert_allclose(p.std(name), np.sqrt(var), rtol=1e-10)
    np.testing.assert_allclose(p.mean("spin"), (w * (2.0 * d["spin"] - 1)).sum(), rtol=1e-10)
    assert p.mean("y") == 4.0 and p.var("y") == 0.0
    flat = np.concatenate([d["m"].reshape(-1, 2), d["s"].reshape(-1, 1)], axis=1)
    expected = np.cov(flat.T, aweights=w.ravel(), ddof=0)
    np.testing.assert_allclose(p.cov("m", "s"), expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(p.cov("s"), expected[2, 2], rtol=1e-9)
    assert np.linalg.matrix_rank(p.cov("m", "s")) == 2  # s is the sum of m


@both
def test_quantiles(weighted):
    p, w, d = posterior(weighted), the_weights(weighted), draws()
    q = [0.1, 0.5, 0.9]
    got = p.quantile("m", q)
    assert got.shape == (3, 2)
    for k in range(2):
        values = d["m"][..., k].ravel()
        below = [(w.ravel() * (values <= g)).sum() for g in got[:, k]]
        step = w.max()
        np.testing.assert_allclose(below, q, atol=1.01 * step)
    assert p.quantile("m", 0.5).shape == (2,)
    assert p.quantile("y", 0.3) == 4.0
    if not weighted:
        np.testing.assert_allclose(got, np.quantile(d["m"].reshape(-1, 2), q, axis=0))


@both
def test_probabilities_and_joint_tables(weighted):
    p, w, d = posterior(weighted), the_weights(weighted), draws()
    got = p.probabilities("z")
    assert got.shape == (3, 2)
    for i in range(3):
        for s in range(2):
            np.testing.assert_allclose(got[i, s], w[d["z"][..., i] == s].sum(), rtol=1e-10)
    joint = p.probabilities("z", "spin", "g")
    assert joint.shape == (3, 2, 2, 2)
    for i, a, b, c in np.ndindex(3, 2, 2, 2):
        where = (d["z"][..., i] == a) & (d["spin"] == b) & (d["g"][..., i] == c)
        np.testing.assert_allclose(joint[i, a, b, c], w[where].sum(), rtol=1e-10)
    np.testing.assert_allclose(joint.sum(axis=(2, 3)), got)
    np.testing.assert_allclose(p.probabilities("spin"), joint.sum((1, 3))[0])


@both
def test_expectations_of_functions(weighted):
    p, w, d = posterior(weighted), the_weights(weighted), draws()

    def average(values):
        return np.tensordot(w, values, axes=([0, 1], [0, 1]))

    np.testing.assert_allclose(p.expectation(lambda m: m.max(axis=-1)), average(d["m"].max(-1)))
    np.testing.assert_allclose(p.expectation("m"), p.mean("m"))
    np.testing.assert_allclose(
        p.expectation(lambda a, b: a * b, names={"a": "spin", "b": "s"}),
        average((2.0 * d["spin"] - 1) * d["s"]),
    )
    located = np.take_along_axis(d["m"], d["g"].astype(int), axis=-1)
    np.testing.assert_allclose(p.expectation(lambda m, g: m[g], plates="p"), average(located))
    np.testing.assert_allclose(
        p.expectation(lambda m, g, shift=2.0: m[g] + shift, plates=("p",)), average(located) + 2.0
    )
    np.testing.assert_allclose(
        p.expectation(lambda m: m.mean("k"), plates="p"), np.repeat(average(d["m"].mean(-1)), 3)
    )
    np.testing.assert_allclose(p.probability(lambda z: z == "yes"), p.probabilities("z")[:, 1])
    np.testing.assert_allclose(p.probability(lambda s, y: s > y), average((d["s"] > 4.0) * 1.0))
    np.testing.assert_allclose(p.expectation(lambda spin: spin == 1), p.probabilities("spin")[1])
    np.testing.assert_allclose(
        p.expectation(lambda v: np.vecdot(v, v)), average((d["v"] ** 2).sum(-1))
    )


def test_a_query_that_drops_or_mixes_the_batch_is_refused():
    p = posterior(True)
    for bad in (
        lambda m: m.max(),
        lambda m: m.mean(axis=0),
        lambda m: 1.0,
        lambda m: m.sum(axis=(0, 1)),
        lambda v: v[0],
        lambda s: s[:, :10],
    ):
        with pytest.raises(
            ShapeError,
            match=r"query: the function returns shape .* for draws of batch shape .*keep the leading axes",
        ):
            p.expectation(bad)
    with pytest.raises(ShapeError, match="lacks the plates|returns shape"):
        p.expectation(lambda m: m.array[..., 0, 0], plates="p")
    with pytest.raises(ValueError, match=r"used ungathered"):
        p.expectation(lambda m: m, plates="p")
    with pytest.raises(UnknownNodeError, match="argument 'w' is not a node"):
        p.expectation(lambda w: w)
    with pytest.raises(UnknownNodeError, match=r"argument \*v names no node"):
        p.expectation(lambda *v: v[0])
    with pytest.raises(UnknownNodeError, match="no plate 'r'"):
        p.expectation(lambda m: m, plates="r")
    with pytest.raises(
        UnsupportedError, match="returns float64 values, not booleans; use expectation"
    ):
        p.probability(lambda s: s)
    with pytest.raises(ValueError, match="'maybe' is not a state"):
        p.probability(lambda z: z == "maybe")
    with pytest.raises(ValueError, match="read-only"):
        p.expectation(lambda m: m.__iadd__(1.0))


def test_labels_have_no_numbers():
    p = posterior(False)
    for what in ("mean", "var", "std", "cov"):
        with pytest.raises(
            UnsupportedError, match=r"labels and have no .*use probabilities\('z'\)"
        ):
            getattr(p, what)("z")
    with pytest.raises(UnsupportedError, match="labels"):
        p.quantile("z", 0.5)
    with pytest.raises(
        UnsupportedError, match=r"probabilities\('m'\): the node has no finite set of states"
    ):
        p.probabilities("m")
    with pytest.raises(UnknownNodeError, match="no node 'mm'"):
        p.mean("mm")
    with pytest.raises(UnknownNodeError, match="name at least one node"):
        p.probabilities()


def test_raw_draws_are_unweighted_and_the_users_own():
    p, d = posterior(True), draws()
    np.testing.assert_array_equal(p["m"], d["m"])
    assert (p["z"] == "yes").sum() == d["z"].sum() and p["z"].shape == (CHAINS, DRAWS, 3)
    assert set(np.unique(p["spin"])) == {-1, 1}
    assert p["y"].shape == (CHAINS, DRAWS) and (p["y"] == 4.0).all()
    taken = p["m"]
    taken[...] = 0.0
    np.testing.assert_array_equal(p["m"], d["m"])
    np.testing.assert_allclose(p.weights, the_weights(True), rtol=1e-12)
    with pytest.raises(ValueError, match="read-only"):
        p.weights[0, 0] = 1.0
    assert posterior(False).weights is None and posterior(False).log_weights is None


# ---- errors, ESS, R-hat -------------------------------------------------------------------------


def test_diagnostics_of_weighted_draws():
    p, w, d = posterior(True), the_weights(True), draws()
    assert p.weight_ess == pytest.approx(1 / (w**2).sum())
    mean = (w * d["s"]).sum()
    error = np.sqrt((w**2 * (d["s"] - mean) ** 2).sum())
    assert p.mcse("s") == pytest.approx(error)
    assert p.ess("s") == pytest.approx((w * (d["s"] - mean) ** 2).sum() / error**2)
    assert p.mcse(lambda s: 2 * s) == pytest.approx(2 * error)
    assert p.mcse("z").shape == (3, 2) and p.mcse("m").shape == (2,)
    assert np.isnan(p.rhat("m")).all()
    assert np.isfinite(p.pareto_k)


def test_diagnostics_of_chains():
    p, d = posterior(False), draws()
    for kind in ("ess", "rhat", "mcse"):
        got = getattr(p, kind)("m")
        for k in range(2):
            one = getattr(array_stats, kind)(d["m"][..., k], chain_axis=0, draw_axis=1)
            assert got[k] == pytest.approx(float(one))
        assert getattr(p, kind)(lambda m: m[..., 0]) == pytest.approx(got[0])
    assert p.weight_ess is None and p.pareto_k is None


def test_diagnostics_of_independent_draws():
    p, d = posterior(False, independent=True), draws()
    n = CHAINS * DRAWS
    np.testing.assert_allclose(p.mcse("m"), d["m"].reshape(n, 2).std(0, ddof=1) / np.sqrt(n))
    assert p.ess("m").tolist() == [n, n] and np.isnan(p.rhat("m")).all()


# ---- summary, marginals -------------------------------------------------------------------------


@both
def test_summary(weighted):
    p = posterior(weighted)
    s = p.summary()
    assert "y" not in s.names  # observed
    expected = {
        "m[first]",
        "m[second]",
        "z[0, no]",
        "z[2, yes]",
        "g[1]",
        "spin",
        "v[0]",
        "s",
        "x[2]",
    }
    assert expected <= set(s.names)
    assert len(s) == 2 + 6 + 3 + 1 + 2 + 1 + 3 == len(list(s))
    assert s["m[second]"]["mean"] == pytest.approx(p.mean("m")[1])
    assert s["m[second]"]["sd"] == pytest.approx(p.std("m")[1])
    assert s["m[second]"]["5%"] == pytest.approx(p.quantile("m", 0.05)[1])
    assert s["z[1, yes]"]["mean"] == pytest.approx(p.probabilities("z")[1, 1])
    assert s["s"]["mcse"] == pytest.approx(p.mcse("s"))
    assert all(len(v) == len(s) for v in s.columns.values())
    assert list(p.summary(["v"])) == ["v[0]", "v[1]"]
    title, head, *lines = str(s).splitlines()
    assert "LikelihoodWeighting" in title
    assert head.split() == list(s.columns)
    assert [line[: line.index("  ")] for line in lines] == list(s.names)
    assert {len(line) for line in lines} == {len(head)}  # columns aligned
    with pytest.raises(UnknownNodeError, match="no row or column 'median'"):
        s["median"]
    with pytest.raises(UnknownNodeError, match="no node 'w'"):
        p.summary(["w"])
    assert set(s.to_dict()) == set(s.names)


@both
def test_marginal_histogram_and_density(weighted):
    p, w, d = posterior(weighted), the_weights(weighted), draws()
    marginal = p.marginal("s")
    heights, edges = marginal.histogram(bins=15)
    expected, at = np.histogram(d["s"].ravel(), bins=15, weights=w.ravel(), density=True)
    np.testing.assert_allclose(heights, expected)
    np.testing.assert_allclose(edges, at)
    assert (heights * np.diff(edges)).sum() == pytest.approx(1.0)
    grid = np.linspace(-15, 15, 4001)
    for rule in ("scott", "silverman"):
        reference = scipy.stats.gaussian_kde(d["s"].ravel(), rule, weights=w.ravel())
        got = marginal.density(grid, rule)
        assert np.trapezoid(got, grid) == pytest.approx(1.0, abs=1e-6)
        # SciPy's bandwidth uses the variance with a small-sample correction
        np.testing.assert_allclose(got, reference(grid), atol=4e-3 * got.max())
    at_zero = (w * scipy.stats.norm(d["s"], 0.3).pdf(0.0)).sum()
    assert marginal.density(0.0, 0.3) == pytest.approx(at_zero)
    with pytest.raises(ValueError, match="bandwidth='wide' is not"):
        marginal.density(0.0, "wide")
    with pytest.raises(ValueError, match="must be positive"):
        marginal.density(0.0, -1.0)


@both
def test_marginals_of_parts_and_of_states(weighted):
    p, d = posterior(weighted), draws()
    np.testing.assert_array_equal(p.marginal("m", 1).values, d["m"][..., 1].ravel())
    np.testing.assert_array_equal(p.marginal("x", (2,)).values, d["x"][..., 2].ravel())
    with pytest.raises(UnsupportedError, match=r"ask for one scalar with marginal\('m', index\)"):
        p.marginal("m").histogram()
    table = p.marginal("z", 2)
    assert table.states == ("no", "yes")
    np.testing.assert_allclose(table.probabilities, p.probabilities("z")[2])
    with pytest.raises(UnsupportedError, match=r"use \.probabilities of a discrete node"):
        table.density(0.0)
    with pytest.raises(UnsupportedError, match="a continuous node has no table of states"):
        p.marginal("s").probabilities  # noqa: B018


# ---- resample, predict, pickle, ArviZ -----------------------------------------------------------


def test_resampling_turns_weights_into_counts():
    p, w = posterior(True), the_weights(True)
    equal = p.resample(60_000, rng=0)
    assert equal.weights is None and equal["m"].shape == (1, 60_000, 2)
    # systematic: every draw within one copy of its expectation
    values, counts = np.unique(equal["s"], return_counts=True)
    order = np.argsort(draws()["s"].ravel())
    expected = 60_000 * w.ravel()[order]
    assert len(values) == CHAINS * DRAWS and np.abs(counts - expected).max() <= 1 + 1e-6
    np.testing.assert_allclose(equal.mean("m"), p.mean("m"), atol=1e-3)
    np.testing.assert_allclose(equal["m"].sum(-1), equal["s"], rtol=1e-12)  # jointly
    np.testing.assert_array_equal(p.resample(50, rng=1)["m"], p.resample(50, rng=1)["m"])
    assert p.resample(rng=0)["m"].shape == (1, CHAINS * DRAWS, 2)
    assert (equal["y"] == 4.0).all()


def test_predictive_draws_follow_the_posterior_draws():
    p, d = posterior(False), draws()
    new = p.predict("x", rng=0)
    assert new["x"].shape == (CHAINS, DRAWS, 3)
    located = np.take_along_axis(d["m"], d["g"].astype(int), axis=-1)
    residual = (new["x"] - located).ravel()
    assert scipy.stats.kstest(residual, scipy.stats.norm().cdf).pvalue > 1e-4  # false alarm 1e-4
    assert (
        scipy.stats.kstest((d["x"] - located).ravel(), scipy.stats.norm().cdf).pvalue < 1e-4
    )  # control
    np.testing.assert_array_equal(new["m"], d["m"])
    np.testing.assert_array_equal(p.predict("x", rng=0)["x"], new["x"])
    anew = p.predict("y", rng=0)["y"]  # observed: drawn anew
    assert anew.std() > 1.0
    assert scipy.stats.kstest((anew - d["s"]).ravel(), scipy.stats.norm().cdf).pvalue > 1e-4


def test_prediction_on_resized_plates_and_new_inputs():
    net = bmc.BayesNet(plates={"site": ("a", "b")})
    net.input("u", plates="site")
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("x", lambda m, u: bmc.Normal(m * u, 0.1), plates="site")
    net.add("top", lambda x: x.max("site"))
    p = bmc.infer(
        net,
        {"x": [1.0, 2.0]},
        inputs={"u": [1.0, 2.0]},
        engine=bmc.LikelihoodWeighting(4000),
        rng=0,
    )
    new = p.predict("x", inputs={"u": np.arange(5.0)}, plates={"site": 5}, rng=0)
    assert new["x"].shape[2:] == (5,)
    np.testing.assert_allclose(new.mean("x"), np.arange(5.0) * p.mean("m"), atol=0.02)
    np.testing.assert_allclose(new["top"], new["x"].max(-1))
    rows = [n for n in new.summary().names if n.startswith("x[")]
    assert len(rows) == 5 and all(
        len(c) == len(new.summary()) for c in new.summary().columns.values()
    )
    same = p.predict("x", inputs={"u": [10.0, 20.0]}, rng=0)
    np.testing.assert_allclose(same.mean("x"), [10 * p.mean("m"), 20 * p.mean("m")], rtol=0.02)


def test_prediction_needs_only_the_parents_that_were_kept():
    net = bmc.BayesNet()
    net.input("u")
    net.add("z", bmc.Normal(0.0, 1.0))
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("aside", lambda z: 2 * z)
    net.add("y", lambda x, u: bmc.Normal(x + u, 0.1))
    engine = bmc.LikelihoodWeighting(3000)
    p = bmc.infer(net, {"y": 2.0}, inputs={"u": 1.0}, engine=engine, rng=0, keep=["x"])
    new = p.predict("y", rng=0)
    # 3000 draws worth a few hundred: within 0.2 of the mean, some 10 standard errors
    assert new.mean("y") == pytest.approx(float(p.mean("x")) + 1.0, abs=0.2)
    assert p.predict("y", inputs={"u": 5.0}, rng=0).mean("y") == pytest.approx(
        float(p.mean("x")) + 5.0, abs=0.2
    )
    lacking = bmc.infer(net, {"y": 2.0}, inputs={"u": 1.0}, engine=engine, rng=0, keep=["z"])
    with pytest.raises(UnsupportedError, match=r"'x' was not kept .*add it to keep="):
        lacking.predict("y", rng=0)


def test_queries_of_inputs():
    net = bmc.BayesNet()
    net.input("u")
    net.add("x", lambda u: bmc.Bernoulli(u))
    exact = bmc.infer(net, inputs={"u": 0.5}, engine=bmc.Exact())
    assert exact.expectation(lambda x, u: x * u) == pytest.approx(0.25)
    for keep in ("draws", ["x"]):
        p = bmc.infer(
            net, inputs={"u": 0.5}, engine=bmc.LikelihoodWeighting(2000), rng=0, keep=keep
        )
        assert p.expectation(lambda x, u: x * u) == pytest.approx(0.5 * float(p.mean("x")))


@pytest.mark.parametrize("engine", [bmc.Exact(), bmc.LikelihoodWeighting(500)])
def test_nodes_that_a_potential_reweights_are_not_predicted(engine):
    """Drawn given its parents alone, such a node would ignore the potential."""
    net = bmc.BayesNet()
    net.add("x", bmc.Bernoulli(0.5))
    net.add("y", lambda x: bmc.Bernoulli(0.2 + 0.5 * x))
    net.add("free", lambda x: bmc.Bernoulli(0.2 + 0.5 * x))
    net.potential("f", lambda y: -3.0 * y)
    p = bmc.infer(net, engine=engine, rng=0)
    with pytest.raises(UnsupportedError, match=r"predict\('y'\).*potential 'f' reweights it"):
        p.predict("y", rng=1)
    assert p.predict("free", rng=1)["free"].ndim == 2


def test_predict_refusals():
    p = posterior(False)
    with pytest.raises(UnknownNodeError, match="no node 'w'"):
        p.predict("w")
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.add("x", lambda a: bmc.Density(lambda x: -((x - a) ** 2)))
    q = bmc.infer(net, {"x": 0.0}, engine=bmc.LikelihoodWeighting(200), rng=0)
    with pytest.raises(
        UnsupportedError, match="predict samples .*'x' is a Density without sample="
    ):
        q.predict("x")


@both
def test_pickles_carry_no_functions_and_answer_the_same(weighted):
    p = posterior(weighted)
    twin = pickle.loads(pickle.dumps(p))
    for what in ("mean", "var"):
        np.testing.assert_array_equal(getattr(twin, what)("m"), getattr(p, what)("m"))
    np.testing.assert_array_equal(twin.probabilities("z", "g"), p.probabilities("z", "g"))
    np.testing.assert_array_equal(twin["z"].codes, p["z"].codes)
    assert str(twin.summary()) == str(p.summary())
    assert twin.expectation(lambda m: m.max(axis=-1)) == p.expectation(lambda m: m.max(axis=-1))
    assert twin.weight_ess == p.weight_ess
    with pytest.raises(
        UnsupportedError, match="predict: this posterior was loaded or unpickled.*call infer again"
    ):
        twin.predict("x")


def test_arviz_takes_equal_weights_only(monkeypatch):
    with pytest.raises(
        UnsupportedError, match="to_datatree: these draws are weighted .*pass resample=draws"
    ):
        posterior(True).to_datatree()
    monkeypatch.setitem(sys.modules, "arviz_base", None)
    for call in (
        lambda: posterior(False).to_datatree(),
        lambda: posterior(True).to_datatree(resample=50),
    ):
        with pytest.raises(
            MissingExtraError, match=r"arviz-base is not installed.*pip install 'bayesmc\[arviz\]'"
        ):
            call()


def test_to_datatree():
    pytest.importorskip("arviz_base")
    tree = posterior(False).to_datatree()
    assert tree["posterior"]["m"].dims == ("chain", "draw", "k")
    assert list(tree["posterior"]["k"].values) == ["first", "second"]
    assert float(tree["observed_data"]["y"]) == 4.0


def test_arviz_takes_the_datatree():
    """The extra installs what ArviZ's functions of a tree need, not only what makes one."""
    pytest.importorskip("arviz_base")
    pytest.importorskip("xarray_einstats")
    import arviz_stats

    p = posterior(False)
    table = arviz_stats.summary(p.to_datatree(), var_names=["m"], round_to=None)
    np.testing.assert_allclose(table["mean"].to_numpy(float), p.mean("m").ravel(), rtol=1e-6)


def test_to_datatree_shows_gaps_in_the_data_as_gaps():
    pytest.importorskip("arviz_base")
    net = bmc.BayesNet(plates={"p": ("a", "b", "c")})
    net.add("x", bmc.Normal(0.0, 1.0), plates="p")
    net.add("y", lambda x: bmc.Normal(x, 1.0), plates="p")
    net.add("k", lambda x: bmc.Bernoulli(1 / (1 + np.exp(-x))), plates="p", states=("no", "yes"))
    evidence = {"y": [1.0, np.nan, 3.0], "k": ["yes", "no", None]}
    p = bmc.infer(net, evidence, engine=bmc.LikelihoodWeighting(3000), rng=0)
    tree = p.to_datatree(resample=100, rng=0)
    np.testing.assert_array_equal(tree["observed_data"]["y"].values, [1.0, np.nan, 3.0])
    seen = tree["observed_data"]["k"].values.tolist()
    assert seen[:2] == ["yes", "no"] and seen[2] not in ("yes", "no")
    full = bmc.infer(net, {"y": [1.0, 2.0, 3.0]}, engine=bmc.LikelihoodWeighting(3000), rng=0)
    whole = full.to_datatree(resample=10, rng=0)["observed_data"]["y"].values
    assert whole.tolist() == [1.0, 2.0, 3.0]


def test_nodes_that_were_not_kept():
    net = the_net()
    p = bmc.infer(net, {"y": 4.0}, engine=bmc.LikelihoodWeighting(5000), rng=0, keep=["s", "z"])
    assert p.mean("s").shape == () and p.probabilities("z").shape == (3, 2)
    with pytest.raises(UnsupportedError, match=r"'m' was not kept .*add it to keep="):
        p.mean("m")
    assert {n.split("[")[0] for n in p.summary(["s", "z"]).names} == {"s", "z"}


def test_summary_of_what_was_kept():
    p = bmc.infer(the_net(), engine=bmc.LikelihoodWeighting(500), rng=0, keep=["s", "z"])
    assert {n.split("[")[0] for n in p.summary().names} == {"s", "z"}


@pytest.mark.parametrize("weighted", [False, True])
def test_a_pickle_says_what_it_misses_and_does_what_needs_no_functions(weighted):
    twin = pickle.loads(pickle.dumps(posterior(weighted)))
    with pytest.raises(UnsupportedError, match="predict: .* it misses those of the nodes 'm', .*"):
        twin.predict("x")
    drawn = twin.resample(50, rng=0)
    np.testing.assert_array_equal(drawn["m"], posterior(weighted).resample(50, rng=0)["m"])
    with pytest.raises(UnsupportedError, match="unpickled"):
        drawn.predict("x")


def test_a_copy_keeps_its_functions():
    p = posterior(False)
    for twin in (copy.copy(p), copy.deepcopy(p)):
        np.testing.assert_array_equal(twin.predict("x", rng=0)["x"], p.predict("x", rng=0)["x"])
