"""Ancestral sampling: shapes, seeds, and draws that follow the joint distribution."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

import bayesmc as bmc
from bayesmc.errors import ParameterError, UnsupportedError
from bayesmc.states import StateArray


def net():
    net = bmc.BayesNet(plates={"p": 3, "k": 2})
    net.add("w", bmc.Dirichlet([2.0, 3.0]))
    net.add("m", bmc.Normal(0.0, 3.0), plates="k")
    net.add("z", lambda w: bmc.Categorical(w), plates="p", states=("a", "b"))
    net.add("x", lambda m, z: bmc.Normal(m[z], 0.5), plates="p")
    net.add("v", lambda x: bmc.MvNormal(bmc.stack([x, -x]), np.eye(2)), plates="p")
    net.add("c", lambda: np.array(7))
    return net


@pytest.mark.parametrize("draws", [0, 1, 2, 3, 5])
def test_shapes(draws):
    got = net().sample(draws, rng=0)
    shapes = {"w": (2,), "m": (2,), "z": (3,), "x": (3,), "v": (3, 2), "c": ()}
    assert {n: v.shape for n, v in got.items()} == {n: (draws, *s) for n, s in shapes.items()}
    assert isinstance(got["z"], StateArray)
    assert all(v.flags.writeable for v in got.values())


def test_seeds():
    a = net()
    one, two, other = a.sample(5, rng=3), net().sample(5, rng=3), a.sample(5, rng=4)
    for name in one:
        np.testing.assert_array_equal(one[name], two[name])
    assert not np.array_equal(one["x"], other["x"])
    seed = np.random.SeedSequence(9)
    np.testing.assert_array_equal(a.sample(5, rng=seed)["x"], a.sample(5, rng=seed)["x"])
    assert seed.n_children_spawned == 0
    generator = np.random.default_rng(1)
    first, second = a.sample(5, rng=generator)["x"], a.sample(5, rng=generator)["x"]
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(first, a.sample(5, rng=np.random.default_rng(1))["x"])
    assert not np.array_equal(a.sample(5)["x"], a.sample(5)["x"])
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    a.sample(5)
    after = np.random.get_state()[1]  # noqa: NPY002 - the global generator rests
    np.testing.assert_array_equal(after, before)


def test_draws_follow_the_joint_distribution():
    """Kolmogorov-Smirnov and binomial tests of a fixed seed; false alarm 5 x 1e-4 in all."""
    a = net()
    n = 4000
    draws = a.sample(n, rng=12)
    alpha = 1e-4
    assert scipy.stats.kstest(draws["m"][:, 1], scipy.stats.norm(0, 3).cdf).pvalue > alpha
    assert scipy.stats.kstest(draws["w"][:, 0], scipy.stats.beta(2, 3).cdf).pvalue > alpha
    located = np.take_along_axis(draws["m"], draws["z"].codes, axis=1)
    residual = (draws["x"] - located).ravel()
    assert scipy.stats.kstest(residual, scipy.stats.norm(0, 0.5).cdf).pvalue > alpha
    hits = int((draws["z"][:, 0] == "a").sum())
    assert scipy.stats.binomtest(hits, n, 0.4).pvalue > alpha
    rest = (draws["v"] - np.stack([draws["x"], -draws["x"]], -1)).ravel()
    assert scipy.stats.kstest(rest, scipy.stats.norm().cdf).pvalue > alpha
    # negative control: the batch axis mistaken for the plate would give this
    wrong = (draws["x"] - draws["m"][:, :1]).ravel()
    assert scipy.stats.kstest(wrong, scipy.stats.norm(0, 0.5).cdf).pvalue < alpha


def test_elements_and_draws_are_independent():
    """Distinct continuous draws everywhere: nothing was broadcast instead of drawn."""
    a = bmc.BayesNet(plates={"p": 4, "q": 3})
    a.add("r", bmc.Normal(0.0, 1.0))
    a.add("x", bmc.Normal(0.0, 1.0), plates=("p", "q"))
    a.add("y", lambda r: bmc.Normal(r, 1.0), plates="p")
    a.add("s", lambda r: bmc.Beta(2.0, 3.0), plates="q")
    a.add("d", lambda y: bmc.Dirichlet(np.ones(2)), plates=("p", "q"))
    draws = a.sample(50, rng=0)
    for name in "rxys":
        assert len(np.unique(draws[name])) == draws[name].size
    assert len(np.unique(draws["d"][..., 0])) == draws["d"][..., 0].size


def test_refusals():
    a = net()
    for bad in (-1, 2.5, True, "3"):
        with pytest.raises(ValueError, match=r"sample\(draws=.*\): draws is a number of draws"):
            a.sample(bad)
    a.add("q", bmc.Density(lambda x: -x * x))
    with pytest.raises(UnsupportedError, match="'q' is a Density without sample="):
        a.sample(1)
    b = net()
    b.potential("f", lambda w: -w[..., 0])
    with pytest.raises(UnsupportedError, match="potential 'f' reweights .*LikelihoodWeighting"):
        b.sample(1)
    c = bmc.BayesNet()
    c.add("s", bmc.Normal(3.5, 1.0))  # below 0 in 2.3e-4 of the draws
    c.add("x", lambda s: bmc.Normal(0.0, s))
    with pytest.raises(ParameterError, match="node 'x': Normal: scale must be positive"):
        c.sample(200_000, rng=0)
