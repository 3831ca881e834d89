"""Enumeration against closed forms, and what it refuses."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.special
import scipy.stats

import bayesmc as bmc
from bayesmc.errors import (
    BudgetError,
    ParameterError,
    UnknownNodeError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.testing import enumerate_posterior


def sprinkler() -> bmc.BayesNet:
    net = bmc.BayesNet("sprinkler")
    net.table("rain", probs=[0.8, 0.2], states=("no", "yes"))
    net.table("sprinkler", ["rain"], [[0.6, 0.4], [0.99, 0.01]], states=("off", "on"))
    net.table("wet", ["sprinkler", "rain"], [[[1, 0], [0.2, 0.8]], [[0.1, 0.9], [0.01, 0.99]]])
    return net


def test_a_textbook_net() -> None:
    found = enumerate_posterior(sprinkler(), {"wet": 1})
    joint = {
        (r, s): pr * ps * pw
        for (r, pr), (s, ps), pw in [
            ((0, 0.8), (0, 0.6), 0.0),
            ((0, 0.8), (1, 0.4), 0.9),
            ((1, 0.2), (0, 0.99), 0.8),
            ((1, 0.2), (1, 0.01), 0.99),
        ]
    }
    total = sum(joint.values())
    assert found.log_marginal_likelihood == pytest.approx(np.log(total), abs=1e-12)
    table = np.array([[joint[0, 0], joint[0, 1]], [joint[1, 0], joint[1, 1]]]) / total
    np.testing.assert_allclose(found.probabilities("rain", "sprinkler"), table, atol=1e-12)
    np.testing.assert_allclose(found.probabilities("sprinkler", "rain"), table.T, atol=1e-12)
    np.testing.assert_allclose(found.probabilities("wet"), [0, 1])
    assert found.accuracy == 0.0
    assert (found.weights > 0).all()


def test_plates_by_hand() -> None:
    """Noisy observations of labels in a plate, one of them missing, with a shared parent."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("p", bmc.Categorical([0.3, 0.7]))
    net.add("z", lambda p: bmc.Bernoulli(0.2 + 0.5 * p), plates="i")
    net.add("x", lambda z: bmc.Normal(2.0 * z, 1.0), plates="i")
    seen = np.array([0.3, np.nan, 1.7])
    found = enumerate_posterior(net, {"x": seen})
    joint = np.zeros((2, 2, 2, 2))
    for p, *z in itertools.product(range(2), repeat=4):
        one = [0.3, 0.7][p]
        for i, state in enumerate(z):
            one *= (0.2 + 0.5 * p) if state else (0.8 - 0.5 * p)
            if i != 1:
                one *= scipy.stats.norm.pdf(seen[i], 2.0 * state, 1.0)
        joint[p, *z] = one
    total = joint.sum()
    # the missing x is a continuous scalar: quadrature, here of a function that integrates to 1
    assert found.log_marginal_likelihood == pytest.approx(np.log(total), abs=1e-8)
    joint /= total
    np.testing.assert_allclose(found.probabilities("p"), joint.sum((1, 2, 3)), atol=1e-8)
    labels = [joint[:, 1].sum(), joint[:, :, 1].sum(), joint[..., 1].sum()]
    np.testing.assert_allclose(found.mean("z"), labels, atol=1e-8)
    assert found.mean("x")[1] == pytest.approx(2 * joint[:, :, 1].sum(), abs=1e-7)
    np.testing.assert_allclose(found.mean("x")[[0, 2]], seen[[0, 2]])
    pairs = found.probabilities("z", "p")
    assert pairs.shape == (3, 2, 2)
    np.testing.assert_allclose(pairs[0], joint.sum((2, 3)).T, atol=1e-8)


@pytest.mark.parametrize("noise", [0.35, 1.0, 5.0])
def test_a_normal_mean(noise: float) -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(1.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, noise))
    found = enumerate_posterior(net, {"y": 2.0})
    precision = 1 + noise**-2
    mean = (1 + 2.0 * noise**-2) / precision
    evidence = scipy.stats.norm.logpdf(2.0, 1.0, np.hypot(1, noise))
    # the promise: 1e-5 where the likelihood is no narrower than a third
    assert found.log_marginal_likelihood == pytest.approx(evidence, abs=1e-5)
    assert found.mean("x") == pytest.approx(mean, abs=2e-5)
    assert found.var("x") == pytest.approx(1 / precision, abs=1e-4)
    assert found.accuracy < 0.05


def test_accuracy_tells_when_the_rule_is_too_coarse() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 0.03))
    found = enumerate_posterior(net, {"y": 0.3})
    true = scipy.stats.norm.logpdf(0.3, 0.0, np.hypot(1, 0.03))
    error = abs(found.log_marginal_likelihood - true)
    assert error > 1e-3
    assert found.accuracy > error
    fine = enumerate_posterior(net, {"y": 0.3}, points=600)
    assert fine.log_marginal_likelihood == pytest.approx(true, abs=1e-6)


def test_other_families() -> None:
    net = bmc.BayesNet()
    net.add("p", bmc.Beta(2.0, 3.0))
    net.add("k", lambda p: bmc.Binomial(10, p))
    net.add("r", bmc.Gamma(3.0, 2.0))
    net.add("n", lambda r: bmc.Poisson(r))
    found = enumerate_posterior(net, {"k": 7, "n": 4})
    assert found.mean("p") == pytest.approx(9 / 15, abs=1e-4)
    assert found.mean("r") == pytest.approx(7 / 3, abs=1e-4)
    evidence = scipy.stats.betabinom.logpmf(7, 10, 2, 3) + scipy.stats.nbinom.logpmf(4, 3, 2 / 3)
    assert found.log_marginal_likelihood == pytest.approx(evidence, abs=1e-4)
    assert found.accuracy < 1e-2


def test_supports_that_depend_on_parents() -> None:
    net = bmc.BayesNet()
    net.add("n", bmc.DiscreteUniform(1, 6))
    net.add("k", lambda n: bmc.Binomial(n, 0.5))
    found = enumerate_posterior(net)
    assert found.mean("k") == pytest.approx(1.75, abs=1e-12)
    assert len(found.weights) == sum(range(2, 8))
    with pytest.raises(UnsupportedError, match="no finite set"):
        found.probabilities("k")


def test_potentials_and_inputs() -> None:
    net = bmc.BayesNet()
    net.input("shift")
    net.add("a", bmc.Bernoulli(0.5))
    net.add("x", lambda a, shift: bmc.Normal(a + shift, 1.0))
    net.potential("tilt", lambda a: 2.0 * a)
    found = enumerate_posterior(net, {"x": 1.5}, {"shift": 1.0})
    odds = np.exp(2.0) * scipy.stats.norm.pdf(1.5, 2) / scipy.stats.norm.pdf(1.5, 1)
    assert found.mean("a") == pytest.approx(odds / (1 + odds), abs=1e-12)


def test_what_has_no_bearing_is_left_out() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.3))
    net.add("n", lambda a: bmc.Poisson(1.0 + a))
    net.add("twice", lambda n: 2 * n)
    found = enumerate_posterior(net)
    assert found.names == ("a",)
    with pytest.raises(UnknownNodeError, match="left out"):
        found.mean("twice")
    assert enumerate_posterior(net, {"n": 2}).mean("twice") == 4.0


def test_refusals() -> None:
    net = bmc.BayesNet(plates={"i": 30})
    net.add("n", bmc.Poisson(2.0))
    net.add("x", lambda n: bmc.Normal(n, 1.0))
    with pytest.raises(UnsupportedError, match="'n' has infinitely many values"):
        enumerate_posterior(net, {"x": 1.0})
    net.add("v", bmc.MvNormal(np.zeros(2), np.eye(2)))
    net.add("y", lambda v: bmc.Normal(v[..., 0], 1.0))
    with pytest.raises(UnsupportedError, match="'v' is a vector"):
        enumerate_posterior(net, {"n": 1, "y": 0.0})
    net.add("z", bmc.Bernoulli(0.5), plates="i")
    with pytest.raises(BudgetError, match="more than 1000 configurations"):
        enumerate_posterior(net, {"n": 1, "v": [0.0, 0.0]}, max_configurations=1000)
    with pytest.raises(ValueError, match="points=3"):
        enumerate_posterior(net, points=3)


def test_impossible_evidence_and_bad_parameters() -> None:
    net = sprinkler()
    with pytest.raises(ZeroProbabilityError):
        enumerate_posterior(net, {"sprinkler": "off", "rain": "no", "wet": 1})
    # nine by nine states, so that the net's own checks do not happen to try the bad one
    bad = bmc.BayesNet()
    bad.add("a", bmc.Categorical(np.full(9, 1 / 9)))
    bad.add("b", lambda: bmc.Categorical(np.append(np.full(8, 1 / 8), 0.0)))
    bad.add("x", lambda a, b: bmc.Normal(0.0, np.where((a == 8) & (b == 8), -1.0, 1.0)))
    assert enumerate_posterior(bad, {"x": 0.0}).mean("a") == pytest.approx(4.0)
    bad.add("b", bmc.Categorical(np.full(9, 1 / 9)), replace=True)
    with pytest.raises(ParameterError, match="node 'x'.*scale"):
        enumerate_posterior(bad, {"x": 0.0})


def test_the_rule_is_the_normal_one() -> None:
    """Moments of a root come out as they are: the rule integrates its own weight exactly."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(2.0, 3.0))
    found = enumerate_posterior(net)
    assert found.mean("x") == pytest.approx(2.0, abs=1e-9)
    assert found.var("x") == pytest.approx(9.0, abs=1e-7)
    third = found.expectation(lambda x: scipy.special.ndtr((x - 2.0) / 3.0), "x")
    assert third == pytest.approx(0.5, abs=1e-9)
