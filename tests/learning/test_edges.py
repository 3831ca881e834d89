"""Estimates at the edge of their support: against concave problems, dense Gaussians, grids of values."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning
from tests.learning.test_fit import walk


def quietly(net: Any, data: Any, **options: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return bmc.fit(net, data, **options)


def dense(y: np.ndarray, q: float, r: float) -> float:
    at = np.minimum(*np.indices((len(y), len(y))))
    cov = 9.0 + q**2 * at + r**2 * np.eye(len(y))
    return float(stats.multivariate_normal(np.zeros(len(y)), cov).logpdf(y))


@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_a_noise_that_is_zero_is_a_maximum(unit: float) -> None:
    y = np.random.default_rng(1).normal(size=40)
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("q", bmc.HalfNormal(5.0 * unit))
    dbn.add_static("r", bmc.HalfNormal(5.0 * unit))
    dbn.add("x", lambda x_prev, q: bmc.Normal(x_prev, q), initial=bmc.Normal(0.0, 3.0 * unit))
    dbn.add("y", lambda x, r: bmc.Normal(x, r))
    found = quietly(dbn, {"y": unit * y})
    assert found.converged and found.at_edge == ("q",) and np.isnan(found.std_errors["q"])
    assert "at its edge: q" in repr(found) and "at its edge: q" in str(found.summary())
    r = float(found["r"]) / unit
    best = dense(y, 0.0, r)
    assert found.log_likelihood + 40 * np.log(unit) == pytest.approx(best, abs=1e-6)
    assert all(dense(y, q, s) < best for q in (0.03, 0.3) for s in (r, 0.95 * r, 1.05 * r))
    bend = (dense(y, 0.0, r + 1e-3) - 2 * best + dense(y, 0.0, r - 1e-3)) / 1e-6
    assert found.std_errors["r"] / unit == pytest.approx((-bend) ** -0.5, rel=1e-3)


@pytest.mark.thorough
def test_random_levels_are_at_the_edge_where_the_dense_gaussian_has_its_maximum() -> None:
    edges = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        y = np.cumsum(0.15 * rng.normal(size=25)) + rng.normal(size=25)
        found = quietly(walk(), {"y": y})
        assert found.converged
        q, r = float(found["q"]), float(found["r"])
        best = dense(y, q, r)
        scales = np.array([0.7, 0.9, 1.0, 1.1, 1.4])
        assert max(dense(y, a, r * s) for a in (0.02, 0.1, 0.3, 1.0) for s in scales) < best + 1e-6
        if found.at_edge:
            edges += 1
            assert dense(y, 0.0, r) == pytest.approx(best, abs=1e-6)
        else:
            assert dense(y, 0.0, r) < best - 1e-6
    assert 0 < edges < 6  # both kinds were seen


def test_a_start_at_the_edge_does_not_hold_what_lies_inside() -> None:
    y = np.cumsum(np.random.default_rng(0).normal(size=30))
    free = quietly(walk(), {"y": y + 0.1})
    stuck = quietly(walk(), {"y": y + 0.1}, start={"q": 1e-9, "r": 3.0})
    assert stuck["q"] == pytest.approx(float(free["q"]), rel=1e-3)


def mixture(means: np.ndarray, points: int) -> bmc.BayesNet:
    """Shares of components that are known: their likelihood is concave."""
    net = bmc.BayesNet(plates={"i": points})
    net.add("share", bmc.Dirichlet(np.ones(len(means))))
    net.add("which", lambda share: bmc.Categorical(share), plates="i")
    net.add("x", lambda which: bmc.Normal(means[which], 1.0), plates="i")
    return net


def test_random_shares_are_zero_where_the_concave_maximum_is() -> None:
    """By the conditions of Karush, Kuhn and Tucker, and the curvature of those that are not zero."""
    edges = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        means, x = 2.0 * rng.normal(size=4), rng.normal(size=30)
        found = quietly(mixture(means, 30), {"x": x})
        share = found["share"]
        heights = stats.norm(means, 1.0).pdf(x[:, None])
        slopes = (heights / (heights @ share)[:, None]).mean(axis=0)
        assert found.converged and (slopes < 1 + 1e-4).all()
        zero = np.flatnonzero(slopes < 1 - 1e-3)
        named = sorted(int(label[6:-1]) for label in found.at_edge)
        assert set(named) >= set(zero) and (share[zero] < 1e-4).all()
        assert (np.isnan(found.std_errors["share"]) == np.isin(range(4), named)).all()
        edges.append(len(named))
        left = np.setdiff1d(range(4), named)
        if not len(left):  # one of them is 1
            continue
        along = heights[:, left[1:]] - heights[:, left[:1]]  # the first of them takes the rest
        lever = along / (heights @ share)[:, None]
        spread = np.linalg.inv(lever.T @ lever)
        wanted = np.sqrt([spread.sum(), *np.diagonal(spread)])
        np.testing.assert_allclose(found.std_errors["share"][left], wanted, rtol=5e-3)
    assert len(set(edges)) > 1, edges


def forward(start: np.ndarray, rows: np.ndarray, seen: np.ndarray, y: np.ndarray) -> float:
    belief, total = start, 0.0
    for t, k in enumerate(y):
        belief = (belief if not t else belief @ rows) * seen[:, k]
        total += np.log(belief.sum())
        belief = belief / belief.sum()
    return total


@pytest.mark.thorough
def test_rows_of_a_hidden_chain_that_end_at_zero_are_maxima() -> None:
    seen = np.array([[0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8]])
    start = np.full(3, 1 / 3)
    edges = 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        rows = np.array([[0.7, 0.3, 0.0], [0.0, 0.6, 0.4], [0.5, 0.0, 0.5]])
        state, y = 0, []
        for _ in range(60):
            y.append(int(rng.choice(3, p=seen[state])))
            state = int(rng.choice(3, p=rows[state]))
        dbn = bmc.DynamicBayesNet(plates={"state": 3})
        dbn.add_static("row", bmc.Dirichlet(np.ones(3)), plates="state")
        dbn.add(
            "c", lambda c_prev, row: bmc.Categorical(row[c_prev]), initial=bmc.Categorical(start)
        )
        dbn.add("y", lambda c: bmc.Categorical(seen[c]))
        found = quietly(dbn, {"y": np.array(y)})
        assert found.converged
        best = found["row"]
        height = forward(start, best, seen, np.array(y))
        assert found.log_likelihood == pytest.approx(height, abs=1e-8)
        for at in np.ndindex(3, 3):
            other = best.copy()
            other[at[0]] = 0.99 * best[at[0]] + 0.01 * np.eye(3)[at[1]]
            assert forward(start, other, seen, np.array(y)) < height
        named = [f"row[{i}, {j}]" in found.at_edge for i, j in np.ndindex(3, 3)]
        assert (np.isnan(found.std_errors["row"]).ravel() == named).all()
        edges += sum(named)
    assert edges > 3


def test_sums_that_are_not_told_apart_are_told_whatever_end_is_an_edge() -> None:
    net = bmc.BayesNet(plates={"i": 20})
    for name in "ab":
        net.add(name, bmc.HalfNormal(5.0))
    net.add("y", lambda a, b: bmc.Normal(a + b, 1.0), plates="i")
    y = 2.0 + np.random.default_rng(0).normal(size=20)
    for start in ({"a": 1.0, "b": 1.0}, {"a": 1e-6, "b": 2.0}, {"a": 1e-3, "b": 1.5}):
        with pytest.warns(ConvergenceWarning, match="flat in a with b:"):
            found = bmc.fit(net, {"y": y}, start=start)
        assert not found.converged and np.isnan([*found.std_errors.values()]).all()
    two = bmc.DynamicBayesNet()
    for name in ("r", "s"):
        two.add_static(name, bmc.HalfNormal(5.0))
    two.add("x", lambda x_prev: bmc.Normal(x_prev, 0.5), initial=bmc.Normal(0.0, 3.0))
    two.add("y", lambda x, r, s: bmc.Normal(x, np.sqrt(r**2 + s**2)))
    for start in ({"r": 1e-6, "s": 1.0}, {"r": 0.3, "s": 0.4}):
        with pytest.warns(ConvergenceWarning, match="flat in r with s:"):
            bmc.fit(two, {"y": y}, start=start)


def test_what_rises_without_end_is_no_maximum_at_an_edge() -> None:
    lone = bmc.BayesNet(plates={"i": 2})
    lone.add("m", bmc.Normal(0.0, 5.0))
    lone.add("s", bmc.HalfNormal(5.0))
    lone.add("y", lambda m, s: bmc.Normal(m, s), plates="i")
    spike = bmc.BayesNet(plates={"i": 8})
    spike.add("s", bmc.HalfNormal(1.0))
    spike.add("z", bmc.Bernoulli(0.5), plates="i")
    spike.add("y", lambda z, s: bmc.Normal(0.0, np.where(z == 1, s, 1.0)), plates="i")
    pole = bmc.BayesNet()
    pole.add("p", bmc.Beta(0.5, 0.5))
    pole.add("k", lambda p: bmc.Binomial(5, p))
    same = {"y": [1.0, 1.0]}
    zeros = {"y": [0.0, 1.2, -0.7, 0.3, 2.0, -1.1, 0.4, 0.9]}
    for net, data, prior in ((lone, same, False), (spike, zeros, False), (pole, {"k": 0}, True)):
        with pytest.warns(ConvergenceWarning):
            start = {"m": 1.0, "s": 0.1} if net is lone else {"s": 1e-3} if net is spike else None
            found = bmc.fit(net, data, prior=prior, start=start, restarts=1)
        assert not found.converged and not found.at_edge


def test_what_nothing_reads_is_flat_from_one_edge_to_the_other() -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("p", bmc.Uniform(0.0, 1.0))
    net.add("w", bmc.Dirichlet(np.ones(3)))
    net.add("m", bmc.Normal(0.0, 3.0))
    net.add("y", lambda m, p, w: bmc.Normal(m + 0.0 * p + 0.0 * w[..., 0], 1.0), plates="i")
    for start in ({"p": 1e-9, "w": [1e-9, 0.5, 0.5 - 1e-9], "m": 0.0}, None):
        with pytest.warns(ConvergenceWarning, match="flat in .*p.*: the data"):
            found = bmc.fit(net, {"y": [0.3, 1.0, 2.0]}, start=start)
        assert not found.converged and not found.at_edge
        assert found.std_errors["m"] == pytest.approx(3**-0.5, rel=1e-5)


def test_all_numbers_may_be_at_edges() -> None:
    net = bmc.BayesNet(plates={"i": 12})
    net.add("p", bmc.Uniform(0.0, 1.0))
    net.add("y", lambda p: bmc.Bernoulli(p), plates="i")
    for seen in (0, 1):
        found = quietly(net, {"y": np.full(12, seen)})
        assert found.converged and found.at_edge == ("p",)
        assert found["p"] == pytest.approx(seen, abs=1e-6)
    bound = bmc.BayesNet(plates={"i": 12})
    bound.add("m", bmc.Uniform(-1.0, 1.0))
    bound.add("y", lambda m: bmc.Normal(m, 1.0), plates="i")
    assert quietly(bound, {"y": np.full(12, 3.0)}).at_edge == ("m",)
    assert quietly(bound, {"y": np.full(12, 0.9)}).at_edge == ()


def test_tables_name_their_edges_too() -> None:
    net = bmc.BayesNet()
    net.table("a", [], [0.5, 0.5])
    net.table("b", ["a"], [[0.5, 0.5], [0.0, 1.0]])
    found = bmc.fit(net, {"a": [0, 0, 0, 1], "b": [1, 1, 1, 1]})
    assert found.converged and found.at_edge == ("b[0, 0]", "b[0, 1]")  # the others were given
