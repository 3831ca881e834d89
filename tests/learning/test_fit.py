"""Parameters by climbing: against closed forms, a dense Gaussian, and fixed points of EM."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning, EvidenceError, ModelError, UnsupportedError


def counts() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"day": 4})
    net.add("rate", bmc.Gamma(2.0, 1.0))
    net.add("count", lambda rate: bmc.Poisson(rate), plates="day")
    return net


def test_maxima_and_errors_are_the_closed_forms() -> None:
    data = {"count": [3, 1, 4, 2]}
    found = bmc.fit(counts(), data)
    assert found.converged and found["rate"] == pytest.approx(2.5)
    assert found.std_errors["rate"] == pytest.approx(np.sqrt(2.5 / 4), rel=1e-5)
    assert found.log_likelihood == pytest.approx(stats.poisson(2.5).logpmf(data["count"]).sum())
    mode = bmc.fit(counts(), data, prior=True)
    assert mode["rate"] == pytest.approx((2 + 10 - 1) / (1 + 4))
    assert mode["rate"] == pytest.approx(float(bmc.map(counts(), data)["rate"]), rel=1e-6)
    assert mode.objective == pytest.approx(mode.log_likelihood + stats.gamma(2.0).logpdf(2.2))
    assert found.net.do  # what was learned is fixed
    assert bmc.infer(found.net, {}, engine=bmc.LikelihoodWeighting(10), rng=0)["rate"].std() == 0


def walk() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("q", bmc.HalfNormal(5.0))
    dbn.add_static("r", bmc.HalfNormal(5.0))
    dbn.add("x", lambda x_prev, q: bmc.Normal(x_prev, q), initial=bmc.Normal(0.0, 3.0))
    dbn.add("y", lambda x, r: bmc.Normal(x, r))
    return dbn


def walked(steps: int = 30) -> np.ndarray:
    rng = np.random.default_rng(4)
    return np.cumsum(0.7 * rng.normal(size=steps)) + 1.3 * rng.normal(size=steps)


def test_a_local_level_is_the_maximum_of_the_dense_gaussian() -> None:
    y = walked()
    found = bmc.fit(walk(), {"y": y}, start={"q": 0.7, "r": 1.3})
    at = np.minimum(*np.indices((len(y), len(y))))

    def log_density(q: float, r: float) -> float:
        cov = 9.0 + q**2 * at + r**2 * np.eye(len(y))
        return float(stats.multivariate_normal(np.zeros(len(y)), cov).logpdf(y))

    q, r = (float(found[n]) for n in ("q", "r"))
    best = log_density(q, r)
    assert found.log_likelihood == pytest.approx(best, abs=1e-8)
    h = 1e-3
    for dq, dr in ((h, 0.0), (-h, 0.0), (0.0, h), (0.0, -h)):
        assert log_density(q + dq, r + dr) < best
    corners = [log_density(q + a * h, r + b * h) for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    qr = (corners[0] - corners[1] - corners[2] + corners[3]) / (4 * h * h)
    qq = (log_density(q + h, r) - 2 * best + log_density(q - h, r)) / h**2
    rr = (log_density(q, r + h) - 2 * best + log_density(q, r - h)) / h**2
    cov = np.linalg.inv(-np.array([[qq, qr], [qr, rr]]))
    np.testing.assert_allclose(found.covariance, cov, rtol=0.01)
    smoothed = bmc.smooth(found.net, {"y": y})  # a template whose static nodes are known
    wanted = bmc.smooth(walk(), {"y": y, "q": q, "r": r})
    np.testing.assert_allclose(smoothed.mean("x"), wanted.mean("x"))


def test_a_fit_is_a_table_for_notebooks_and_pandas() -> None:
    pandas = pytest.importorskip("pandas")
    net = bmc.BayesNet(plates={"i": 4, "k": ["a", "b"]})
    net.add("m", bmc.Normal(0.0, 10.0), plates="k")
    net.add("y", lambda m: bmc.Normal(m, 1.0), plates=("k", "i"))
    found = bmc.fit(net, {"y": np.arange(8.0).reshape(2, 4)}, learn="m")
    frame = found.to_dataframe()
    pandas.testing.assert_frame_equal(frame, found.summary().to_dataframe())
    assert list(frame.index) == ["m[a]", "m[b]"]
    np.testing.assert_allclose(frame["estimate"], [1.5, 5.5], atol=1e-4)
    assert "m[a]" in found._repr_html_() and "maximum likelihood" in found._repr_html_()


def test_labels_are_summed_out() -> None:
    rng = np.random.default_rng(0)
    z = rng.random(100) < 0.4
    net = bmc.BayesNet(plates={"k": 2, "i": 100})
    net.add("w", bmc.Dirichlet([1.0, 1.0]))
    net.add("mu", bmc.Normal(0.0, 5.0), plates="k")
    net.add("z", lambda w: bmc.Categorical(w), plates="i")
    net.add("x", lambda z, mu: bmc.Normal(mu[z], 1.0), plates="i")
    x = np.where(z, 3.0, -1.0) + rng.normal(size=100)
    found = bmc.fit(net, {"x": x})
    w, mu = found["w"], found["mu"]
    mass = stats.norm(mu, 1.0).pdf(x[:, None]) * w
    assert found.log_likelihood == pytest.approx(np.log(mass.sum(axis=1)).sum())
    share = mass / mass.sum(axis=1, keepdims=True)  # a fixed point of EM
    np.testing.assert_allclose(share.mean(axis=0), w, atol=1e-5)
    np.testing.assert_allclose(share.T @ x / share.sum(axis=0), mu, atol=1e-4)


@pytest.mark.thorough
def test_hidden_numbers_are_integrated_out() -> None:
    schools = bmc.BayesNet(plates={"s": 6})
    schools.add("mu", bmc.Normal(0.0, 50.0))
    schools.add("tau", bmc.HalfNormal(20.0))
    schools.add("theta", lambda mu, tau: bmc.Normal(mu, tau), plates="s")
    schools.add("y", lambda theta: bmc.Normal(theta, 2.0), plates="s")
    y = np.array([28.0, 8.0, -3.0, 7.0, -1.0, 18.0])
    effects = bmc.fit(schools, {"y": y})
    assert effects["mu"] == pytest.approx(y.mean(), abs=1e-3)
    assert effects["tau"] == pytest.approx(np.sqrt(y.var() - 4.0), rel=1e-4)


@pytest.mark.thorough
def test_numbers_at_an_edge_have_no_error() -> None:
    rng = np.random.default_rng(1)
    found = bmc.fit(walk(), {"y": rng.normal(size=60)}, start={"q": 0.3, "r": 1.0})
    assert found["q"] < 1e-3 or found.converged  # no walk at all: the level stands still
    summary = found.summary()
    assert summary["r"]["se"] == pytest.approx(1.0 / np.sqrt(120), rel=0.3)


def bad(net: Any, data: Any, **options: Any) -> Any:
    return lambda: bmc.fit(net, data, **options)


def test_what_cannot_be_learned_is_refused_in_words() -> None:
    data = {"count": [1, 2, 3, 4]}
    known = bmc.BayesNet()
    known.add("y", lambda: bmc.Normal(0.0, 1.0))
    mixed = walk()
    mixed.table("s", ["s_prev"], [[0.9, 0.1], [0.1, 0.9]], initial=[0.5, 0.5])
    for ask, error, says in (
        (bad("net", data), ModelError, "expected a BayesNet"),
        (bad(counts(), data, learn="rat"), ModelError, "did you mean 'rate'|no node"),
        (bad(counts(), data, learn="count"), ModelError, "the data have it"),
        (bad(counts(), data, start={"x": 1.0}), ModelError, "not learned"),
        (bad(counts(), data, start={"rate": -1.0}), bmc.errors.EvidenceError, "support"),
        (bad(counts(), data, engine=bmc.KalmanFilter()), UnsupportedError, "templates"),
        (bad(known, {"y": 1.0}), ModelError, "nothing to learn"),
        (
            bad(walk(), {"y": walked()}, engine=bmc.ParticleFilter(10)),
            UnsupportedError,
            "random error",
        ),
        (bad(walk(), {"y": walked()}, learn=["q"]), UnsupportedError, "'r' is neither learned"),
        (bad(walk(), {"y": walked()}, learn=["x", "q", "r"]), UnsupportedError, "every slice"),
        (bad(mixed, {"y": walked()}), ModelError, 'learn="tables"'),
    ):
        with pytest.raises(error, match=says):
            ask()


def test_a_climb_cut_short_says_so() -> None:
    with pytest.warns(ConvergenceWarning, match="before a maximum"):
        start = {"q": 4.0, "r": 0.05}
        found = bmc.fit(walk(), {"y": walked()}, start=start, max_iterations=1, tolerance=1e3)
    assert not found.converged or len(found.history) < 4


def line(x: np.ndarray, z: np.ndarray) -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"i": len(x)})
    net.add("b", bmc.Normal(0.0, 5.0))
    net.add("c", bmc.Normal(0.0, 5.0))
    net.add("s", bmc.HalfNormal(2.0))
    net.add("y", lambda b, c, s: bmc.Normal(b * x + c * z, s), plates="i")
    return net


def test_what_the_data_do_not_tell_is_named() -> None:
    rng = np.random.default_rng(0)
    x, z = rng.normal(size=(2, 30))
    y = 3 * x + rng.normal(size=30)
    with pytest.warns(ConvergenceWarning, match="flat in b with c:"):
        found = bmc.fit(line(x, 2 * x), {"y": y})
    assert not found.converged and np.isfinite(found.std_errors["s"])
    assert np.isnan([found.std_errors["b"], found.std_errors["c"]]).all()
    assert bmc.fit(line(x, z), {"y": y}).converged  # without a warning
    assert bmc.fit(line(x, 2 * x + 0.01 * z), {"y": y}).converged  # hard to tell, and told

    net = bmc.BayesNet(plates={"i": 30})
    net.add("b", bmc.Normal(0.0, 5.0))
    net.add("y", lambda b: bmc.Bernoulli(logits=b * x), plates="i")
    with pytest.warns(ConvergenceWarning, match="flat in b: .* off to infinity"):
        assert not bmc.fit(net, {"y": (x > 0).astype(int)}).converged
    with pytest.warns(ConvergenceWarning, match="flat in q"):
        bmc.fit(walk(), {"y": [1.3]})


def test_errors_do_not_depend_on_units() -> None:
    net = bmc.BayesNet(plates={"i": 4})
    net.add("m", bmc.Normal(0.0, 1000.0))
    net.add("y", lambda m: bmc.Normal(m, 1000.0), plates="i")
    found = bmc.fit(net, {"y": [100.0, 2000.0, -500.0, 400.0]})
    assert found["m"] == pytest.approx(500.0) and found.std_errors["m"] == pytest.approx(500.0)


def test_nothing_observed_is_refused() -> None:
    for net, data in ((counts(), {"count": [None] * 4}), (walk(), {"y": [np.nan] * 3})):
        with pytest.raises(EvidenceError, match="nothing is observed"):
            bmc.fit(net, data)


def test_climbs_that_disagree_are_counted_and_told() -> None:
    net = bmc.BayesNet(plates={"i": 40})
    net.add("m", bmc.Normal(0.0, 10.0))
    net.add("y", lambda m: bmc.StudentT(1.0, m, 0.3), plates="i")
    y = np.concatenate([np.full(14, -8.0), np.full(16, 0.0), np.full(10, 8.0)])
    y = y + 0.1 * np.random.default_rng(0).normal(size=40)
    found = bmc.fit(net, {"y": y}, restarts=12)
    assert len(found.climbs) == 12 and found.climbs[0] == found.objective
    assert (np.diff(found.climbs) <= 0).all() and found.climbs[-1] < found.climbs[0] - 1.0
    assert abs(float(found["m"])) < 0.2
    assert "of 12 climbs ended there" in repr(found)
    with pytest.warns(
        ConvergenceWarning, match="starts disagree: of 2 climbs one ended at.*restarts="
    ):
        lone = bmc.fit(net, {"y": y}, start={"m": -8.0}, restarts=2)
    assert lone.climbs[0] > lone.climbs[1] + 1.0
    alone = bmc.fit(net, {"y": y}, start={"m": -8.0})
    assert len(alone.climbs) == 1 and alone.objective == pytest.approx(lone.climbs[1], abs=1e-3)
    for wrong in (0, 2.5, True):
        with pytest.raises(ModelError, match="restarts is .*whole number of climbs"):
            bmc.fit(net, {"y": y}, restarts=wrong)


def test_expectation_maximisation_begins_again() -> None:
    """Two hidden classes from a start at which they are alike: EM stays there, random starts do not."""
    net = bmc.BayesNet()
    net.table("kind", [], [0.5, 0.5])
    for k in range(4):
        net.table(f"y{k}", ["kind"], [[0.5, 0.5], [0.5, 0.5]])
    rng = np.random.default_rng(0)
    kind = rng.random(300) < 0.4
    cases = {f"y{k}": (rng.random(300) < np.where(kind, 0.9, 0.1)).astype(int) for k in range(4)}
    stuck, found = bmc.fit(net, cases), bmc.fit(net, cases, restarts=4)
    assert len(stuck.climbs) == 1 and len(found.climbs) == 4
    assert found.log_likelihood > stuck.log_likelihood + 100
    share = kind.mean()
    np.testing.assert_allclose(sorted(found["kind"]), [share, 1 - share], atol=0.05)


def test_a_grid_is_found_once_for_a_climb_and_tells_what_it_tells_anew() -> None:
    rng = np.random.default_rng(3)
    h = np.zeros(12)
    for t in range(1, 12):
        h[t] = 0.8 * h[t - 1] + 0.5 * rng.normal()
    y = np.exp(h / 2) * rng.normal(size=12)
    dbn = bmc.DynamicBayesNet("volatility")
    dbn.add_static("k", bmc.HalfNormal(3.0))
    dbn.add("h", lambda h_prev: bmc.Normal(0.8 * h_prev, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda h, k: bmc.Normal(0.0, k * np.exp(h / 2)))
    found = bmc.fit(dbn, {"y": y}, restarts=1)
    filtered = bmc.filter(found.net, {"y": y}, engine=bmc.GridFilter())
    assert found.log_likelihood == pytest.approx(filtered.log_marginal_likelihood, abs=0.01)
    k = float(found["k"])
    for other in (0.9 * k, 1.1 * k):
        lower = bmc.filter(dbn, {"y": y, "k": other}, engine=bmc.GridFilter())
        assert lower.log_marginal_likelihood < found.log_likelihood + 0.01
