"""The joint density: batches, labels, deterministic nodes, impossible values, refusals."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

import bayesmc as bmc
from bayesmc.errors import DensityError, EvidenceError, ParameterError


def hybrid():
    net = bmc.BayesNet(plates={"p": 3})
    net.add("a", bmc.Bernoulli(0.3), states=("no", "yes"))
    net.add("m", lambda a: bmc.Normal(np.where(a == "yes", 2.0, -1.0), 1.5))
    net.add("twice", lambda m: 2 * m)
    net.add("x", lambda twice: bmc.StudentT(4.0, twice, 0.5), plates="p")
    net.add("n", lambda a: bmc.Poisson(np.where(a == "yes", 3.0, 0.5)), plates="p")
    return net


def by_hand(a, m, x, n):
    total = np.log(0.3 if a == "yes" else 0.7)
    total += scipy.stats.norm(2.0 if a == "yes" else -1.0, 1.5).logpdf(m)
    total += scipy.stats.t(4.0, 2 * m, 0.5).logpdf(x).sum()
    return total + scipy.stats.poisson(3.0 if a == "yes" else 0.5).logpmf(n).sum()


def test_equals_the_sum_of_its_factors():
    net = hybrid()
    draws = net.sample(8, rng=0)
    got = net.log_prob(draws)
    assert got.shape == (8,)
    for i in range(8):
        a = str(draws["a"][i])
        one = by_hand(a, draws["m"][i], draws["x"][i], draws["n"][i])
        np.testing.assert_allclose(got[i], one, rtol=1e-10)
        single = net.log_prob({"a": a, "m": draws["m"][i], "x": draws["x"][i], "n": draws["n"][i]})
        assert single.shape == ()
        np.testing.assert_allclose(single, one, rtol=1e-10)


def test_batches_of_any_rank_broadcast():
    net = hybrid()
    rng = np.random.default_rng(0)
    values = {
        "a": np.array(["no", "yes"])[:, None, None],
        "m": rng.normal(size=(4, 1)),
        "x": rng.normal(size=(5, 3)),
        "n": rng.integers(0, 4, size=3),
    }
    got = net.log_prob(values)
    assert got.shape == (2, 4, 5)
    for i, j, k in np.ndindex(2, 4, 5):
        one = by_hand(("no", "yes")[i], values["m"][j, 0], values["x"][k], values["n"])
        np.testing.assert_allclose(got[i, j, k], one, rtol=1e-10)


def test_impossible_values_have_density_zero():
    net = hybrid()
    values = {"a": "yes", "m": 0.0, "x": np.zeros(3), "n": np.array([1, 2, -1])}
    assert net.log_prob(values) == -np.inf
    net = bmc.BayesNet()
    net.add("b", bmc.Gamma(2.0, 1.0))
    net.add("u", lambda b: bmc.Uniform(0.0, b))
    np.testing.assert_array_equal(
        np.isfinite(net.log_prob({"b": 2.0, "u": np.array([-1.0, 1.0, 2.5])})), [False, True, False]
    )
    # a scale that is only bad where the configuration is impossible is no fault
    assert net.log_prob({"b": -2.0, "u": -1.0}) == -np.inf


def test_a_deterministic_value_must_agree():
    net = hybrid()
    values = {"a": "no", "m": 0.25, "x": np.zeros(3), "n": np.ones(3, dtype=int)}
    expected = net.log_prob(values)
    assert net.log_prob({**values, "twice": 0.5}) == expected
    assert net.log_prob({**values, "twice": 0.75}) == -np.inf
    np.testing.assert_array_equal(
        np.isfinite(net.log_prob({**values, "twice": np.array([0.5, 0.6])})), [True, False]
    )
    tabulated = bmc.BayesNet()
    tabulated.add("a", bmc.Bernoulli(0.5))
    tabulated.add("d", lambda a: 2 * a)
    assert tabulated.log_prob({"a": 1, "d": 2}) == np.log(0.5)
    assert tabulated.log_prob({"a": 1, "d": 0}) == -np.inf
    assert tabulated.log_prob({"a": 1, "d": 5}) == -np.inf


def test_refusals():
    net = hybrid()
    values = {"a": "no", "m": 0.0, "x": np.zeros(3), "n": np.ones(3, dtype=int)}
    with pytest.raises(
        EvidenceError, match="log_prob: node 'm' has no value; give all stochastic nodes"
    ):
        net.log_prob({k: v for k, v in values.items() if k != "m"})
    with pytest.raises(EvidenceError, match="log_prob: the net has no node 'mm'.*did you mean 'm'"):
        net.log_prob({**values, "mm": 0.0})
    with pytest.raises(EvidenceError, match=r"'x' has shape \(2,\).*make \(3,\)"):
        net.log_prob({**values, "x": np.zeros(2)})
    with pytest.raises(EvidenceError, match="node 'a': 'maybe' is not a state"):
        net.log_prob({**values, "a": "maybe"})
    with pytest.raises(EvidenceError, match="node 'm'.*give numbers"):
        net.log_prob({**values, "m": "large"})


def test_a_density_that_is_not_finite_names_the_node():
    for value in (np.nan, np.inf):
        net = bmc.BayesNet()
        net.add(
            "x",
            lambda v=value: bmc.Density(
                lambda x: np.where(x > 0, v, -x * x), sample=lambda r, s: -r.random(s)
            ),
        )
        with pytest.raises(DensityError, match=rf"node 'x': the log density of .* is {value}"):
            net.log_prob({"x": 1.0})
        assert net.log_prob({"x": -1.0}) == -1.0


def test_parameters_out_of_range_name_the_node_and_first_index():
    net = bmc.BayesNet(plates={"p": 3})
    net.add("s", bmc.Normal(5.0, 0.1), plates="p")
    net.add("x", lambda s: bmc.Normal(0.0, s), plates="p")
    with pytest.raises(
        ParameterError, match=r"node 'x' \(plate element 1\): .*scale must be positive.*got -2"
    ):
        net.log_prob({"s": [1.0, -2.0, -3.0], "x": np.zeros(3)})


def test_potentials_multiply_the_density():
    net = hybrid()
    draws = net.sample(4, rng=1)
    before = net.log_prob(draws)
    net.potential("pull", lambda m: -m * m)
    np.testing.assert_allclose(net.log_prob(draws), before - draws["m"] ** 2, rtol=1e-12)
    for value in (np.nan, np.inf):
        net = hybrid()
        net.potential("bad", lambda m, v=value: m + v)
        with pytest.raises(
            DensityError,
            match="potential 'bad' is NaN or plus infinity; a log factor must be finite",
        ):
            net.log_prob(draws)
    net = hybrid()
    net.potential("ban", lambda m: np.where(m > -50, -np.inf, 0.0))
    assert (net.log_prob(draws) == -np.inf).all()
    net = hybrid()
    net.potential("wide", lambda m: np.zeros(7) + m[..., None])
    with pytest.raises(ValueError, match=r"potential 'wide' returns shape .*reduce foreign plates"):
        net.log_prob(draws)
