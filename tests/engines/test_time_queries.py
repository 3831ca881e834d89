"""Functions of nodes and events under beliefs of every exact filter: closed forms, tables, and each other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import bayesmc as bmc
from bayesmc.errors import EngineWarning, QueryError, UnknownNodeError


def linear() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 0.7), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.6))
    return dbn


def rows(steps: int = 12) -> dict[str, Any]:
    y = np.random.default_rng(0).normal(size=max(steps, 6))
    y[5] = np.nan
    return {"y": y[:steps]}


#: functions of a normal number with mean m and standard deviation s, and what their means are
FUNCTIONS: dict[str, tuple[Callable[..., Any], Callable[..., Any], float]] = {
    "an event": (lambda x: x > 0.3, lambda m, s: norm.sf(0.3, m, s), 2e-5),
    "a narrow event": (
        lambda x: (x > 0.3) & (x < 0.34),
        lambda m, s: norm.cdf(0.34, m, s) - norm.cdf(0.3, m, s),
        2e-5,
    ),
    "a square": (lambda x: x**2, lambda m, s: m**2 + s**2, 1e-6),
    "a curve": (lambda x: np.exp(x), lambda m, s: np.exp(m + s**2 / 2), 1e-5),
    "a kink": (
        lambda x: np.maximum(x, 0.0),
        lambda m, s: m * norm.cdf(m / s) + s * norm.pdf(m / s),
        2e-5,
    ),
    "a step": (
        lambda x: np.where(x > 0.3, 2.0, -1.0),
        lambda m, s: 3 * norm.sf(0.3, m, s) - 1,
        1e-4,
    ),
}
ASKED = {name: function for name, (function, _, _) in FUNCTIONS.items()}


@pytest.mark.parametrize("engine", [None, bmc.GridFilter(), bmc.UnscentedKalmanFilter()], ids=repr)
@pytest.mark.parametrize("call", [bmc.filter, bmc.smooth])
def test_functions_of_one_number(call: Any, engine: Any) -> None:
    found = call(linear(), rows(), engine=engine, queries=ASKED)
    assert type(found.engine) is type(engine or bmc.KalmanFilter())
    plain = call(linear(), rows())
    m, s = plain.mean("x"), plain.std("x")
    for name, (_, right, atol) in FUNCTIONS.items():
        np.testing.assert_allclose(found.queries[name], right(m, s), atol=atol, err_msg=name)
    later = found.probability(ASKED["an event"])
    np.testing.assert_array_equal(later, found.queries["an event"])
    np.testing.assert_array_equal(found.expectation(ASKED["a kink"]), found.queries["a kink"])
    wanted = norm.ppf([0.05, 0.5], m[:, None], s[:, None])
    np.testing.assert_allclose(found.quantile("x", [0.05, 0.5]), wanted, atol=1e-3)
    with pytest.raises(QueryError, match="not booleans"):
        found.probability(ASKED["a kink"])


@pytest.mark.parametrize(
    "engine", [bmc.KalmanFilter(), bmc.GridFilter({"x": (-8, 8, 200)})], ids=repr
)
def test_beliefs_row_by_row_answer_alike(engine: Any) -> None:
    filtered = bmc.filter(linear(), rows(4), engine=engine, queries=ASKED)
    belief = engine.start(linear())
    for value in rows(4)["y"]:
        belief = engine.step(belief, {"y": value})
    for name, function in ASKED.items():
        np.testing.assert_allclose(
            belief.expectation(function), filtered.queries[name][-1], atol=1e-9
        )
    assert abs(belief.probability(ASKED["an event"]) - filtered.queries["an event"][-1]) < 1e-9
    np.testing.assert_allclose(
        belief.quantile("x", 0.3), filtered.quantile("x", 0.3)[-1], atol=1e-9
    )


@pytest.mark.parametrize("lag", [2, None])
def test_observed_and_forecast_nodes(lag: int | None) -> None:
    asked = {"above": lambda x, y: x > y, "product": lambda x, y: x * y}
    found = bmc.smooth(linear(), rows(), lag=lag, queries=asked)
    assert type(found.engine) is bmc.KalmanFilter
    seen = np.isfinite(rows()["y"])
    right = norm.sf(rows()["y"], found.mean("x"), found.std("x"))
    np.testing.assert_allclose(found.queries["above"][seen], right[seen], atol=2e-5)
    np.testing.assert_allclose(found.queries["above"][~seen], 0.5, atol=0.01)
    ahead = bmc.forecast(linear(), rows(), steps=3, queries={"up": lambda y: y > 0})
    right = norm.sf(0.0, ahead.mean("y"), ahead.std("y"))
    np.testing.assert_allclose(ahead.queries["up"], right, atol=2e-5)
    assert ahead.probability(lambda y: y > 0).shape == (3,)


def test_several_numbers_have_a_stated_error() -> None:
    """Moments of third order are exact; events have an error that is neither too small nor idle."""
    dbn = bmc.DynamicBayesNet(plates={"s": 2})
    dbn.add(
        "v",
        lambda v_prev: bmc.MvNormal(0.9 * v_prev, [[1.0, 0.6], [0.6, 1.0]]),
        initial=bmc.MvNormal([1.0, 0.0], np.eye(2)),
        plates="s",
    )
    dbn.add("y", lambda v: bmc.Normal(v[..., 0], 1.0), plates="s")
    data = {"y": np.random.default_rng(1).normal(size=(6, 2))}
    asked = {
        "product": lambda v: v[..., 0] * v[..., 1],
        "corner": lambda v: (v[..., 0] > 0.2) & (v[..., 1] > -0.1),
    }
    found = bmc.filter(dbn, data, queries=asked)
    assert type(found.engine) is bmc.KalmanFilter
    cov, mean = found.cov("v"), found.mean("v")
    right = mean.prod(axis=-1) + cov[..., 0, 1]
    np.testing.assert_allclose(found.queries["product"], right, atol=1e-9)
    from scipy.stats import multivariate_normal as mvn

    chance = [
        mvn(-mean[t, k], cov[t, k]).cdf([-0.2, 0.1]) for t in range(6) for k in range(2)
    ]  # P(v > c) = P(-v < -c)
    off = np.abs(found.queries["corner"].ravel() - chance)
    error = found.queries_mcse["corner"].ravel()
    assert (error > 0).all() and (off <= 6 * error).all()  # six of t(7): 1 in 1,800, of twelve
    assert error.max() < 2e-3


def test_joint_events_of_finite_nodes() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("a", ["a_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.5, 0.5])
    table = [[[0.8, 0.2], [0.3, 0.7]], [[0.1, 0.9], [0.6, 0.4]]]
    dbn.table("b", ["b_prev", "a"], table, initial=[0.5, 0.5])
    dbn.add("y", lambda a, b: bmc.Normal(a + 2 * b, 1.0))
    data = {"y": [0.1, 1.0, 2.0, 3.0]}
    asked = {"same": lambda a, b: a == b, "sum": lambda a, b: a + b}
    found = bmc.smooth(dbn, data, queries=asked)
    assert type(found.engine) is bmc.DiscreteFilter
    whole = bmc.infer(dbn, data, engine=bmc.Exact())
    joint = np.stack([whole.probabilities(f"a[{t}]", f"b[{t}]") for t in range(4)])
    right = joint[:, 0, 0] + joint[:, 1, 1]
    np.testing.assert_allclose(found.queries["same"], right, atol=1e-12)
    np.testing.assert_allclose(found.probability(asked["same"]), right, atol=1e-12)
    assert not np.allclose(right, (found.probabilities("a") * found.probabilities("b")).sum(axis=1))
    engine = bmc.DiscreteFilter()
    belief = engine.start(dbn)
    for value in data["y"]:
        belief = engine.step(belief, {"y": value})
    np.testing.assert_allclose(belief.probability(asked["same"]), right[-1], atol=1e-12)
    assert abs(belief.expectation(asked["sum"]) - belief.mean("a") - belief.mean("b")) < 1e-12


def test_events_on_a_grid_do_not_depend_on_where_its_points_are() -> None:
    """A truth value that is computed, a regime beside, elements apart."""
    dbn = bmc.DynamicBayesNet(plates={"s": 2})
    dbn.table("z", ["z_prev"], [[0.95, 0.05], [0.1, 0.9]], initial=[0.5, 0.5], plates="s")
    dbn.add(
        "x",
        lambda x_prev, z: bmc.Normal(0.9 * x_prev, 0.2 + z),
        initial=bmc.Normal(0.0, 1.0),
        plates="s",
    )
    dbn.add("y", lambda x: bmc.Poisson(np.exp(x)), plates="s")
    dbn.add("up", lambda x: x > 0.2, plates="s")
    data = {"y": dbn.sample(10, rng=3)["y"][0]}
    asked = {"both": lambda x, z: (x > 0.2) & (z == 1)}
    found = bmc.filter(dbn, data, queries=asked)
    assert type(found.engine) is bmc.GridFilter
    for cells in (190, 231):
        other = bmc.GridFilter({"x": (-11.0, 8.0, cells)})
        again = bmc.filter(dbn, data, queries=asked, engine=other)
        np.testing.assert_allclose(found.queries["both"], again.queries["both"], atol=1e-4)
        np.testing.assert_allclose(found.mean("up"), again.mean("up"), atol=1e-4)


def test_a_query_that_only_particles_answer_is_said() -> None:
    dbn = linear()
    dbn.add("up", lambda x: x > 0)
    dbn.add("n", lambda x: bmc.Poisson(np.exp(x)))
    with pytest.warns(
        EngineWarning, match=r"queries=\['n'\] has ParticleFilter answer where GridF"
    ):
        found = bmc.filter(dbn, rows(3), queries={"n": lambda n: n > 1}, rng=0)
    assert type(found.engine) is bmc.ParticleFilter
    bmc.filter(dbn, rows(3), queries={"n": lambda x: x > 1})


FILTERS = (
    bmc.KalmanFilter(),
    bmc.UnscentedKalmanFilter(),
    bmc.GridFilter({"x": (-8, 8, 200)}),
    bmc.ParticleFilter(2000),
)


@pytest.mark.parametrize("engine", FILTERS, ids=lambda e: type(e).__name__)
def test_arguments_with_a_default_are_no_nodes(engine: Any) -> None:
    """Seven standard errors of the particles' shares, about 0.012: 1e-12, forty times or so."""
    found = bmc.filter(
        linear(), rows(), engine=engine, queries={"q": lambda x, c=0.3: x > c}, rng=1
    )
    exact = bmc.filter(linear(), rows())
    right = norm.sf(0.3, exact.mean("x"), exact.std("x"))
    drawn = isinstance(engine, bmc.ParticleFilter)
    np.testing.assert_allclose(found.queries["q"], right, atol=0.085 if drawn else 2e-5)
    belief = engine.step(engine.start(linear(), rng=1), {"y": rows()["y"][0]})
    assert np.isclose(belief.probability(lambda x, c=0.3: x > c), found.queries["q"][0], rtol=1e-12)
    for wrong in (lambda *x: x[0], lambda **x: x["x"]):
        with pytest.raises(UnknownNodeError, match="names no node"):
            belief.expectation(wrong)
    with pytest.raises(UnknownNodeError, match="'z'"):
        belief.expectation(lambda x, z: x)


def test_a_default_is_not_read_from_a_node_of_its_name() -> None:
    for engine in FILTERS:
        asked = {"q": lambda x, y=0.0: 0 * x + y}
        found = bmc.filter(linear(), {"y": [1.0]}, engine=engine, queries=asked, rng=1)
        np.testing.assert_allclose(found.queries["q"], [0.0], atol=1e-12)
