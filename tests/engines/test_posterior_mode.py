"""``bmc.map``: modes in the nodes' own coordinates, at the edge of supports, and where there is none."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import optimize

import bayesmc as bmc
from bayesmc.errors import UnsupportedError


def test_conjugate_modes() -> None:
    net = bmc.BayesNet(plates={"i": 5})
    net.add("rate", bmc.Gamma(2.0, 1.0), plates="i")
    net.add("count", lambda rate: bmc.Poisson(rate), plates="i")
    net.add("share", bmc.Beta(2.0, 3.0))
    net.add("heads", lambda share: bmc.Binomial(10, share))
    net.add("weights", bmc.Dirichlet([2.0, 3.0, 4.0]))
    net.add("kinds", lambda weights: bmc.Multinomial(12, weights))
    counts = np.array([3, 0, 1, 7, 2])
    mode = bmc.map(net, {"count": counts, "heads": 7, "kinds": [5, 0, 7]})
    np.testing.assert_allclose(mode["rate"], (1.0 + counts) / 2.0, atol=1e-7)
    assert mode["share"] == pytest.approx(8.0 / 13.0, abs=1e-7)
    np.testing.assert_allclose(mode["weights"], np.array([6.0, 2.0, 10.0]) / 18.0, atol=1e-7)
    assert mode.at_edge == ()
    values = {**mode.values, "count": counts, "heads": 7, "kinds": [5, 0, 7]}
    assert mode.log_density == pytest.approx(float(net.log_prob(values)), abs=1e-9)


def test_it_is_another_point_than_with_the_change_of_volume() -> None:
    """The mode of a Gamma posterior by the rate, and by its log."""
    net = bmc.BayesNet()
    net.add("rate", bmc.Gamma(3.0, 1.0))
    net.add("count", lambda rate: bmc.Poisson(rate))
    mode = bmc.map(net, {"count": 4})
    assert mode["rate"] == pytest.approx(3.0, abs=1e-7)  # (3 + 4 - 1) / 2
    posterior = bmc.infer(net, {"count": 4}, engine=bmc.LaplaceApproximation())
    assert posterior.quantile("rate", 0.5) == pytest.approx(3.5, abs=1e-7)  # the mode of the log
    assert mode.log_volume == pytest.approx(np.log(3.0), abs=1e-7)


def test_covariance_matrices() -> None:
    """The mode of an inverse Wishart posterior, whose density is by the lower triangle."""
    x = np.random.default_rng(0).normal(size=(20, 2)) @ [[1.0, 0.5], [0.0, 1.0]]
    net = bmc.BayesNet(plates={"i": 20})
    net.add("S", bmc.InverseWishart(5.0, np.eye(2)))
    net.add("x", lambda S: bmc.MvNormal(np.zeros(2), S), plates="i")
    mode = bmc.map(net, {"x": x})
    np.testing.assert_allclose(mode["S"], (np.eye(2) + x.T @ x) / (5 + 20 + 2 + 1), atol=1e-6)


def test_computed_nodes_and_those_that_are_left_out() -> None:
    y = np.random.default_rng(0).normal(2.0, 3.0, size=20)
    net = bmc.BayesNet(plates={"i": 20})
    net.add("mu", bmc.Normal(0.0, 10.0))
    net.add("s", bmc.HalfNormal(5.0))
    net.add("size", lambda mu, s: np.abs(mu) / s)
    net.add("y", lambda mu, s: bmc.Normal(mu, s), plates="i")
    net.add("later", lambda mu, s: bmc.Normal(mu, s))
    mode = bmc.map(net, {"y": y})

    def falling(v: Any) -> float:
        mu, s = v
        if s <= 0:
            return np.inf
        return 0.005 * mu**2 + 0.02 * s**2 + 20 * np.log(s) + 0.5 * np.sum((y - mu) ** 2) / s**2

    found = optimize.minimize(falling, [1.0, 2.0], method="Nelder-Mead", tol=1e-12)
    assert mode["mu"] == pytest.approx(found.x[0], abs=1e-5)
    assert mode["s"] == pytest.approx(found.x[1], abs=1e-5)
    assert mode["size"] == pytest.approx(abs(mode["mu"]) / mode["s"])
    assert mode.left_out == ("later",)
    assert "later" not in mode.values


def test_the_mode_of_a_prior() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(1.0, 2.0))
    net.add("rate", bmc.Gamma(3.0, 2.0))
    mode = bmc.map(net)
    assert (mode["x"], mode["rate"]) == (pytest.approx(1.0), pytest.approx(1.0))


def test_finite_nodes_are_summed_out() -> None:
    """A mixture's mode lies between those of its components."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("z", bmc.Bernoulli(0.5), plates="i")
    net.add("y", lambda x, z: bmc.Normal(x + z, 1.0), plates="i")
    y = np.array([0.5, 1.0, 0.0])
    mode = bmc.map(net, {"y": y})
    assert mode.summed == ("z",)

    def falling(x: Any) -> float:
        each = np.logaddexp(-0.5 * (y - x) ** 2, -0.5 * (y - x - 1) ** 2)
        return float(0.5 * x**2 - each.sum())

    found = optimize.minimize_scalar(falling, (-1.0, 1.0), tol=1e-12)
    assert mode["x"] == pytest.approx(found.x, abs=1e-7)
    assert mode.log_density == pytest.approx(
        -found.fun - 0.5 * 4 * np.log(2 * np.pi) + 3 * np.log(0.5), abs=1e-9
    )


def test_modes_at_the_edge_of_a_support() -> None:
    net = bmc.BayesNet()
    net.add("wait", bmc.Exponential(1.0))
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("y", lambda wait, m: bmc.Normal(wait + m, 1.0))
    mode = bmc.map(net, {"y": -2.0})
    assert mode.at_edge == ("wait",)
    assert mode["wait"] == pytest.approx(0.0, abs=1e-12)
    assert mode["m"] == pytest.approx(-1.0, abs=1e-6)
    limit = float(net.log_prob({"wait": 1e-12, "m": -1.0, "y": -2.0}))
    assert mode.log_density == pytest.approx(limit, abs=1e-9)


def test_the_highest_of_several_and_starts() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.1, 3.0))
    net.add("y", lambda x: bmc.Normal(x**2, 1.0))
    mode = bmc.map(net, {"y": 4.0})
    assert mode["x"] > 0
    assert mode.modes == 2
    near = bmc.map(net, {"y": 4.0}, start={"x": -1.5})
    assert near["x"] < 0
    assert near.modes == 1
    assert near.log_density < mode.log_density
    assert "x=" in repr(mode)


def test_what_has_no_mode_is_refused_by_name() -> None:
    def refused(net: bmc.BayesNet, evidence: dict[str, Any]) -> str:
        with pytest.raises(UnsupportedError, match="^map: ") as caught:
            bmc.map(net, evidence)
        return str(caught.value)

    net = bmc.BayesNet()
    net.add("x", bmc.Gamma(0.5, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    text = refused(net, {"y": -2.0})
    assert "no mode" in text
    assert "x" in text
    net = bmc.BayesNet()
    net.add("flat", bmc.Uniform(0.0, 1.0))
    net.add("y", lambda flat: bmc.Normal(0.0 * flat, 1.0))
    assert "flat along flat" in refused(net, {"y": 1.0})
    net = bmc.BayesNet()
    net.table("a", probs=[0.2, 0.8])
    net.table("b", ["a"], [[0.1, 0.9], [0.4, 0.6]])
    assert "'a'" in refused(net, {"b": 1})
