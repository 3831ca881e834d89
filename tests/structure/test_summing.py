"""Finite nodes summed out of log densities, beside sums over all their joint states; the public function."""

from __future__ import annotations

import itertools
import math
import pickle
from collections.abc import Iterator
from typing import Any
from unittest import mock

import numpy as np
import pytest
from scipy import special, stats

import bayesmc as bmc
from bayesmc.errors import EvidenceError, ShapeError, UnsupportedError
from bayesmc.network import pose
from bayesmc.structure import summing
from bayesmc.structure.target import Target, target_of
from bayesmc.structure.unconstrained import unconstrained_density
from bayesmc.testing import session
from bayesmc.testing.makers.nets import random_net
from bayesmc.testing.makers.observing import random_evidence

SEEDS = range(session.seed(), session.seed() + session.scaled(40, 8))


def finite_of(target: Target) -> list[str]:
    return [n for n in target.chain if target.model[n].is_discrete]


def joint_states(target: Target, names: list[str]) -> Iterator[dict[str, np.ndarray]]:
    """All stored values of finite nodes that agree with what was seen."""
    ways = []
    for name in names:
        node, seen = target.model[name], target.seen(name)
        count = math.prod(node.plate_shape)
        own = []
        for states in itertools.product(range(node.domain.size), repeat=count):
            value = np.array(states, int).reshape(node.plate_shape)
            if seen is None or (value == seen.value)[seen.mask].all():
                own.append(value)
        ways.append(own)
    for values in itertools.product(*ways):
        yield dict(zip(names, values, strict=True))


def by_states(target: Target, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log density and gradient as sums over all joint states."""
    names = finite_of(target)
    density = unconstrained_density(target, [n for n in target.chain if n not in names])
    terms = target.terms_of([*density.names, *names])
    outside = [t for t in terms if t not in target.terms_of(density.names)]
    parts = []
    for values in joint_states(target, names):
        value, slopes = density.with_gradient(u, values)
        found = {**target.known, **values}
        found.update(density.constrain(u[0], found))  # on which the terms outside do not depend
        with np.errstate(all="ignore"):
            target.compute(found, target.links)
            own = sum(
                np.sum(np.where(True if t.mask is None else t.mask, t.log(found), 0.0))
                for t in outside
            )
        parts.append((value + own, slopes))
    logs = np.array([v for v, _ in parts])
    total = special.logsumexp(logs, axis=0)
    shares = np.exp(logs - total)
    return total, sum(s[..., None] * g for s, (_, g) in zip(shares, parts, strict=True))


def count_of(target: Target) -> float:
    cards = [
        (target.model[n].domain.size if target.model[n].domain else np.inf)
        ** math.prod(target.model[n].plate_shape)
        for n in finite_of(target)
    ]
    return math.prod(cards)


def test_random_nets_beside_all_joint_states() -> None:
    compared = 0
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        net = random_net(seed, hybrid=True, plates=True)
        problem = pose(net, random_evidence(net, rng, 0.25))
        nodes = problem.model.nodes.items()
        target = target_of(
            problem, [n for n, v in nodes if v.is_stochastic and n not in problem.observed]
        )
        finite = finite_of(target)
        if not finite or len(finite) == len(target.chain) or count_of(target) > 3000:
            continue
        try:
            density = unconstrained_density(target, None, finite)
        except UnsupportedError as error:
            assert "joint states" in str(error) or "finite set of states" in str(error), (
                seed,
                error,
            )
            continue
        u = rng.normal(size=(3, density.size))
        value, slopes = density.with_gradient(u)
        wanted, gradient = by_states(target, u)
        np.testing.assert_allclose(value, wanted, rtol=1e-9, err_msg=str(seed))
        np.testing.assert_allclose(slopes, gradient, rtol=1e-7, atol=1e-7, err_msg=str(seed))
        compared += 1
    assert compared >= len(SEEDS) // 5


def mixture(labels: Any = None) -> tuple[bmc.BayesNet, dict[str, Any]]:
    rng = np.random.default_rng(0)
    net = bmc.BayesNet("mixture", plates={"cluster": 3, "point": 40, "twice": 2})
    net.add("weights", bmc.Dirichlet(np.ones(3)))
    net.add("mean", bmc.Normal(0.0, 10.0), plates="cluster")
    net.add("label", lambda weights: bmc.Categorical(weights), plates="point")
    net.add("x", lambda label, mean: bmc.Normal(mean[label], 1.0), plates=("point", "twice"))
    evidence: dict[str, Any] = {"x": rng.normal(size=(40, 2)) * 3}
    evidence["x"][7, 1] = np.nan
    if labels is not None:
        evidence["label"] = labels
    return net, evidence


def mixed(f: Any, u: np.ndarray, x: np.ndarray, labels: np.ndarray) -> float:
    """The density of the mixture by its formula."""
    v = f.constrain(u)
    seen = ~np.isnan(x)
    logs = np.where(
        seen[..., None],
        stats.norm(v["mean"], 1.0).logpdf(np.where(seen, x, 0.0)[..., None]),
        0.0,
    )
    table = np.log(v["weights"]) + logs.sum(axis=1)
    table = np.where((labels[:, None] < 0) | (labels[:, None] == np.arange(3)), table, -np.inf)
    prior = stats.dirichlet(np.ones(3)).logpdf(v["weights"])
    volume = f._density.log_volume(u)
    return (
        special.logsumexp(table, axis=1).sum()
        + prior
        + stats.norm(0, 10).logpdf(v["mean"]).sum()
        + volume
    )


@pytest.mark.parametrize("is_partial", [False, True])
def test_labels_are_summed_point_by_point(is_partial: bool) -> None:
    labels = np.full(40, -1)
    if is_partial:
        labels[:10] = np.arange(10) % 3
    given = np.ma.array(np.maximum(labels, 0), mask=labels < 0) if is_partial else None
    net, evidence = mixture(given)
    f = bmc.log_density(net, evidence)
    assert f.summed == ("label",)
    for seed in range(5):
        u = np.random.default_rng(seed).normal(size=f.size)
        value, slopes = f(u)
        np.testing.assert_allclose(value, mixed(f, u, evidence["x"], labels), rtol=1e-11)
        steps = np.eye(f.size) * 1e-5
        wanted = [(f.value(u + s) - f.value(u - s)) / 2e-5 for s in steps]
        np.testing.assert_allclose(slopes, wanted, rtol=1e-6, atol=1e-5)


def test_a_wrong_table_is_seen_before_first_use() -> None:
    """Negative control: entries that count twice."""
    split = summing._Component._split

    def twice(self: Any, *args: Any) -> Any:
        rest, table = split(self, *args)
        return rest, summing.add(table, table)

    net, evidence = mixture()
    with (
        mock.patch.object(summing._Component, "_split", twice),
        pytest.raises(UnsupportedError, match="sum over the states of label"),
    ):
        bmc.log_density(net, evidence)


def test_chains_of_labels_are_listed_or_refused() -> None:
    def net(steps: int) -> bmc.BayesNet:
        made = bmc.BayesNet()
        made.add("stay", bmc.Beta(4.0, 2.0))
        made.add("z0", bmc.Bernoulli(0.5))
        for t in range(1, steps):
            made.add(
                f"z{t}",
                lambda z, stay: bmc.Bernoulli(np.where(z == 1, stay, 1 - stay)),
                parents={"z": f"z{t - 1}", "stay": "stay"},
            )
        made.add("y", lambda z: bmc.Normal(z, 0.5), parents={"z": f"z{steps - 1}"})
        return made

    f = bmc.log_density(net(4), {"y": 0.8})
    assert f.summed == ("z0", "z1", "z2", "z3")
    u = np.array([0.3])
    stay = special.expit(0.3)
    turn = np.array([[stay, 1 - stay], [1 - stay, stay]])
    ends = np.array([0.5, 0.5]) @ np.linalg.matrix_power(turn, 3)
    wanted = (
        np.log(ends @ stats.norm([0.0, 1.0], 0.5).pdf(0.8))
        + stats.beta(4.0, 2.0).logpdf(stay)
        + np.log(stay * (1 - stay))
    )
    np.testing.assert_allclose(f.value(u), wanted, rtol=1e-12)
    with pytest.raises(UnsupportedError, match="joint states"):
        bmc.log_density(net(12), {"y": 0.8})


def test_what_is_discrete_without_end_is_refused() -> None:
    net = bmc.BayesNet()
    net.add("rate", bmc.Gamma(2.0, 1.0))
    net.add("n", lambda rate: bmc.Poisson(rate))
    net.add("y", lambda n: bmc.Normal(n, 1.0))
    with pytest.raises(UnsupportedError, match="'n' has no finite set of states"):
        bmc.log_density(net, {"y": 2.0})


def test_factor_graphs() -> None:
    graph = bmc.FactorGraph("chain", plates={"site": 4})
    graph.variable("w", "positive")
    graph.variable("x", "real", plates="site")
    graph.variable("s", (0, 1), plates="site")
    graph.factor(lambda w: -w, scope="w")
    graph.factor(lambda x, w: -0.5 * w * x**2, scope=("x", "w"))
    graph.factor(lambda s, x: s * x - 0.1 * x**2, scope=("s", "x"))
    graph.factor(lambda a, b: -0.3 * (a - b) ** 2, scope=("x", "x"), index=([0, 1, 2], [1, 2, 3]))
    f = bmc.log_density(graph, {"x": [0.3, np.nan, np.nan, -0.2]})
    assert f.labels == ["w", "x[1]", "x[2]"]
    u = np.array([0.4, 0.5, -0.3])
    w, x = np.exp(0.4), np.array([0.3, 0.5, -0.3, -0.2])
    wanted = (
        0.4 - w - 0.5 * w * (x**2).sum() - 0.1 * (x**2).sum() + np.logaddexp(0, x).sum()
        - 0.3 * (np.diff(x) ** 2).sum()
    )  # fmt: skip
    np.testing.assert_allclose(f.value(u), wanted, rtol=1e-12)


def eight_schools() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet("eight schools", plates={"school": 8})
    sd = np.array([15.0, 10.0, 16.0, 11.0, 9.0, 11.0, 10.0, 18.0])
    net.add("mu", bmc.Normal(0.0, 5.0))
    net.add("tau", bmc.HalfCauchy(5.0))
    net.add("theta", lambda mu, tau: bmc.Normal(mu, tau), plates="school")
    net.add("y", lambda theta: bmc.Normal(theta, sd), plates="school")
    return net, {"y": [28.0, 8.0, -3.0, 7.0, -1.0, 1.0, 18.0, 12.0]}


def test_the_public_function() -> None:
    net, evidence = eight_schools()
    f = bmc.log_density(net, evidence)
    assert (f.size, f.names, f.labels[:3]) == (
        10,
        ("mu", "tau", "theta"),
        ["mu", "tau", "theta[0]"],
    )
    u = np.random.default_rng(0).normal(size=(4, 10))
    values = f.constrain(u)
    wanted = net.log_prob({**values, **evidence}) + u[:, 1]
    np.testing.assert_allclose(f.value(u), wanted, rtol=1e-12)
    np.testing.assert_allclose(f.unconstrain(values), u, rtol=1e-12)
    np.testing.assert_array_equal(f.gradient(u), f(u)[1])
    with pytest.raises(ShapeError, match=r"not \(..., 10\)"):
        f(np.zeros(9))
    with pytest.raises(EvidenceError, match="a value of node 'tau'"):
        f.unconstrain({"mu": 0.0})


def test_unobserved_nodes_count_too() -> None:
    """Neal's funnel has no data."""
    net = bmc.BayesNet(plates={"dim": 3})
    net.add("v", bmc.Normal(0.0, 3.0))
    net.add("x", lambda v: bmc.Normal(0.0, np.exp(v / 2)), plates="dim")
    f = bmc.log_density(net)
    u = np.array([0.5, 1.0, -1.0, 2.0])
    wanted = stats.norm(0, 3).logpdf(0.5) + stats.norm(0, np.exp(0.25)).logpdf(u[1:]).sum()
    np.testing.assert_allclose(f.value(u), wanted, rtol=1e-12)


def test_it_travels() -> None:
    net = bmc.BayesNet(plates={"point": 3})
    net.add("rate", bmc.Gamma(2.0, 1.0))
    net.add("y", lambda rate: bmc.Poisson(rate), plates="point")
    f = bmc.log_density(net, {"y": [1, 2, 3]})
    cloudpickle = pytest.importorskip("cloudpickle")
    sent = pickle.loads(cloudpickle.dumps(f))  # noqa: S301 - our own
    u = np.array([[0.3], [-0.2]])
    np.testing.assert_array_equal(sent.value(u), f.value(u))


def test_copies_are_bounded() -> None:
    net, evidence = mixture()
    with (
        mock.patch.object(summing, "MOST_STATES", 2),
        pytest.raises(UnsupportedError, match="Gibbs"),
    ):
        bmc.log_density(net, evidence)


def test_bounds_that_depend_on_what_is_summed_are_refused() -> None:
    net = bmc.BayesNet()
    net.add("z", bmc.Bernoulli(0.5))
    net.add("x", lambda z: bmc.Uniform(0.0, 1.0 + z))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    with pytest.raises(UnsupportedError, match="bounds of a continuous node depend on it"):
        bmc.log_density(net, {"y": 0.5})


@pytest.mark.parametrize("compiled", [False, None])
def test_slopes_beside_impossible_components(compiled):
    """Under one state of the label both components are impossible; the slope of the rest is kept."""
    net = bmc.BayesNet(plates={"i": 4})
    net.add("c", bmc.Normal(0.0, 1.0))
    net.add("w", bmc.Beta(2.0, 2.0))
    net.add("t", bmc.Bernoulli(0.6), plates="i")

    @net.node(plates="i")
    def x(c, t, w):
        share = w * t
        parts = [bmc.Binomial(18, logits=c), bmc.Binomial(18, 0.0)]
        return bmc.Mixture(bmc.stack([share, 1 - share]), parts)

    density = bmc.log_density(net, {"x": [0, 2, 5, 0]}, compiled=compiled)
    u = np.array([0.6, -0.3])
    wanted = [(density(u + e)[0] - density(u - e)[0]) / 2e-5 for e in 1e-5 * np.eye(2)]
    np.testing.assert_allclose(density(u)[1], wanted, rtol=1e-6)
