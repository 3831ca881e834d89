"""Functions that can be followed only where some values are known: exact engines answer all the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import bayesmc as bmc
from bayesmc.errors import TraceError, UnsupportedError
from bayesmc.network import pose
from bayesmc.network.expressions import Opaque, density
from bayesmc.network.given import read_given

CURVE = CubicSpline([0.0, 1.0, 2.0], [1.0, 3.0, -2.0])


def follows(x: Any, size: float) -> bmc.Normal:
    return bmc.Normal(size * x + 1.0, 1.0)


def branches() -> bmc.BayesNet:
    """A branch on an input, directly or in a computed node, and a curve that NumPy hands to nobody."""
    net = bmc.BayesNet()
    net.input("u")
    net.add("s", bmc.Categorical([0.5, 0.25, 0.25]))
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("turned", lambda x, u: 2.0 * x if u > 0 else -x)
    net.add("direct", lambda x, u: follows(x, 2.0 if u > 0 else -1.0))
    net.add("through", lambda turned: bmc.Normal(turned + 1.0, 1.0))
    net.add("curved", lambda x, s: follows(x, CURVE(s)))
    return net


@pytest.mark.parametrize("u", [1.0, -1.0])
@pytest.mark.parametrize("seen", ["direct", "through"])
def test_branches_on_inputs_are_read_where_these_are_known(seen: str, u: float) -> None:
    posterior = bmc.infer(branches(), {seen: 3.0}, inputs={"u": u}, engine=bmc.Exact())
    gain = 2.0 if u > 0 else -1.0
    assert posterior.mean("x") == pytest.approx(gain * 2.0 / (1 + gain**2), abs=1e-14)


def test_finite_parents_of_what_cannot_be_followed_are_enumerated() -> None:
    posterior = bmc.infer(branches(), {"curved": 3.0}, inputs={"u": 1.0}, engine=bmc.Exact())
    gain, prior = np.array([1.0, 3.0, -2.0]), np.array([0.5, 0.25, 0.25])
    var = 1 + gain**2
    weights = prior * np.exp(-0.5 * 4.0 / var) / np.sqrt(var)
    weights /= weights.sum()
    assert posterior.mean("x") == pytest.approx(weights @ (gain * 2.0 / var), abs=1e-12)
    np.testing.assert_allclose(posterior.probabilities("s"), weights, atol=1e-12)


def test_computed_parents_have_the_plates_of_their_node() -> None:
    """Though the function that computes them knows no plates."""
    net = bmc.BayesNet(plates={"k": 2, "i": 3})
    net.add("s", bmc.Bernoulli(0.25), plates="i")
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("twice", lambda x: 2.0 * x, plates="k")
    net.add("y", lambda twice, s: bmc.Normal(twice[[1, 0, 1]] + CURVE(s), 1.0), plates="i")
    evidence = {"y": np.array([3.0, 2.5, 3.5])}
    posterior = bmc.infer(net, evidence, engine=bmc.Exact())
    states = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    off = evidence["y"] - CURVE(states)
    var = 1.0 / (1.0 + 4.0 * 3)
    log = np.log(np.where(states, 0.25, 0.75)).sum(-1) - 0.5 * (off**2).sum(-1)
    mean = 2.0 * off.sum(-1) * var
    weights = np.exp(log + 0.5 * mean**2 / var)
    assert posterior.mean("x") == pytest.approx(weights @ mean / weights.sum(), abs=1e-12)


def test_what_looks_at_hidden_numbers_is_refused() -> None:
    """Negative control: a branch on the hidden node itself."""
    net = branches()
    net.add("y", lambda x, u: follows(x, float(np.vectorize(float)(u)) + (x**2).sum() * 0.0))
    with pytest.raises(UnsupportedError, match="'y'"):
        bmc.infer(net, {"y": 1.0}, inputs={"u": 1.0}, engine=bmc.Exact())


def test_another_function_of_numbers_is_refused() -> None:
    def lie(x: Any, u: Any) -> Any:
        return bmc.Normal((x**2 if isinstance(x, np.ndarray) else x) * (1.0 if u > 0 else 2.0), 1.0)

    net = branches()
    net.add("y", lie)
    model = pose(net, {}, {"u": 1.0}).model
    assert isinstance(density(model, "y"), Opaque)
    with pytest.raises(TraceError, match="other values than the function"):
        read_given(model, "y", {"u": np.array(1.0)})


def test_nodes_that_are_cut_stay_leaves() -> None:
    """Gaussian filters have a place for computed nodes of the slice before, and look no further."""
    net = bmc.BayesNet()
    net.input("u")
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("twice", lambda x: 2.0 * x)
    net.add("y", lambda twice, u: bmc.Normal(twice if u > 0 else -twice, 1.0))
    model = net.model({}, {"u": 1.0})
    known = {"u": np.array(1.0)}
    for cut, leaf in ((frozenset(), "x"), (frozenset({"twice"}), "twice")):
        assert read_given(model, "y", known, cut).parameters["loc"].leaves == {leaf}


def test_filters_go_through_computed_nodes_of_functions_that_are_read_with_values() -> None:
    gains = [np.array([0.5, 2.0])]
    dbn = bmc.DynamicBayesNet()
    dbn.table("k", [], [0.5, 0.5])
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("d", lambda x, d_prev: x + 0.5 * d_prev, initial=lambda x: x)
    dbn.add("y", lambda d, k: bmc.Normal(gains[0][k] * d, 1.0))
    rows = {"y": [0.5, 1.0, 2.0], "k": [0, 1, 1]}
    found = bmc.filter(dbn, rows, engine=bmc.KalmanFilter())
    exact = bmc.infer(dbn, rows, engine=bmc.Exact())
    np.testing.assert_allclose(found.log_marginal_likelihood, exact.log_marginal_likelihood)
    np.testing.assert_allclose(found.mean("x")[-1], exact.mean("x[2]"))
