"""Mean field against published fixed points, closed forms, and the equations that a fixed point fulfils."""

from __future__ import annotations

import copy
import itertools
import json
import math
import pickle
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import optimize, special

import bayesmc as bmc
from bayesmc.engines.approximate.stored import completed
from bayesmc.engines.approximate.weights import log_joint
from bayesmc.engines.variational.ascent import BoundError, check_bound
from bayesmc.errors import (
    ConvergenceWarning,
    EngineWarning,
    LowEssWarning,
    ReducibleWarning,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.network import pose
from bayesmc.testing import session


def clutter(n: int) -> bmc.BayesNet:
    """Minka's clutter problem: half of the points are about zero."""
    net = bmc.BayesNet(plates={"point": n})
    net.add("theta", bmc.Normal(0.0, 10.0))
    net.add("noise", bmc.Bernoulli(0.5), plates="point")

    @net.node(plates="point")
    def x(theta: Any, noise: Any) -> Any:
        return bmc.Normal(np.where(noise, 0.0, theta), np.where(noise, math.sqrt(10.0), 1.0))

    return net


def mixture(n: int, kinds: int, alpha: float, precision: bool = False) -> bmc.BayesNet:
    """Bishop's mixture, by covariances or by precisions."""
    net = bmc.BayesNet(plates={"kind": kinds, "point": n})
    net.add("weights", bmc.Dirichlet(np.full(kinds, alpha)))
    if precision:
        net.add("scatter", bmc.Wishart(2.0, np.eye(2)), plates="kind")
        net.add(
            "mean",
            lambda scatter: bmc.MvNormal(np.zeros(2), np.linalg.inv(scatter)),
            plates="kind",
        )
    else:
        net.add("scatter", bmc.InverseWishart(2.0, np.eye(2)), plates="kind")
        net.add("mean", lambda scatter: bmc.MvNormal(np.zeros(2), scatter), plates="kind")
    net.add("label", lambda weights: bmc.Categorical(weights), plates="point")

    @net.node(plates="point")
    def x(label: Any, mean: Any, scatter: Any) -> Any:
        own = scatter[label]
        return bmc.MvNormal(mean[label], np.linalg.inv(own) if precision else own)

    return net


def faithful(root: Path) -> np.ndarray:
    rows = np.genfromtxt(root / "mixtures" / "faithful.csv", delimiter=",", skip_header=1)[:, -2:]
    return (rows - rows.mean(axis=0)) / rows.std(axis=0)


BISHOP = bmc.MeanField(blocks=[("mean", "scatter")])


def never_falls(posterior: Any) -> bool:
    return bool((np.diff(posterior.elbos) >= -1e-9).all())


# ---- published figures --------------------------------------------------------------------------


def test_clutter(reference_data: Path) -> None:
    for case in json.loads((reference_data / "ep" / "clutter.json").read_text()):
        posterior = bmc.infer(clutter(case["n"]), {"x": case["x"]}, engine=bmc.MeanField(), rng=0)
        found = posterior.elbo, posterior.mean("theta"), posterior.var("theta")
        np.testing.assert_allclose(found, case["vb"], atol=1e-6)
        assert posterior.converged and never_falls(posterior)
        assert posterior.elbo < case["exact"][0]


@pytest.mark.parametrize("alpha", [1e-3, 1.0])
@pytest.mark.parametrize("kinds", range(1, 7))
def test_faithful(reference_data: Path, kinds: int, alpha: float) -> None:
    file = json.loads((reference_data / "ep" / "vbgmm_faithful.json").read_text())
    want, points = file[f"a0={alpha},K={kinds}"], faithful(reference_data)
    net = mixture(len(points), kinds, alpha)
    posterior = bmc.infer(net, {"x": points}, engine=replace(BISHOP, restarts=5), rng=1)
    assert posterior.converged and never_falls(posterior)
    assert abs(posterior.elbo - want["elbo"]) < 1e-3
    assert posterior.bounds[0] == posterior.elbo == posterior.bounds.max()
    weights = np.sort(posterior.mean("weights"))[::-1]
    np.testing.assert_allclose(weights, np.sort(want["weights"])[::-1], atol=1e-4)
    if kinds == 6 and alpha < 1:
        np.testing.assert_allclose(weights[:2], [0.64286, 0.35712], atol=1e-4)
        assert (weights[2:] < 1e-4).all()


def test_precisions_say_the_same_as_covariances(reference_data: Path) -> None:
    points = faithful(reference_data)
    both = [
        bmc.infer(mixture(len(points), 2, 1.0, p), {"x": points}, engine=BISHOP, rng=1)
        for p in (False, True)
    ]
    assert abs(both[0].elbo - both[1].elbo) < 1e-7
    order = [np.argsort(p.mean("weights")) for p in both]
    means = [p.mean("mean")[k] for p, k in zip(both, order, strict=True)]
    np.testing.assert_allclose(means[0], means[1], atol=1e-5)


# ---- closed forms ---------------------------------------------------------------------------------


def test_normal_gamma_block_is_exact() -> None:
    """DeGroot (1970), sec. 9.6: mean and precision of a normal, with their evidence."""
    rng = np.random.default_rng(0)
    x = rng.normal(3.0, 2.0, 20)
    a, b, at, worth = 2.0, 3.0, 1.0, 0.5
    n, mean = len(x), x.mean()
    count, shape = worth + n, a + n / 2
    middle = (worth * at + n * mean) / count
    rate = b + 0.5 * ((x - mean) ** 2).sum() + 0.5 * worth * n * (mean - at) ** 2 / count
    evidence = (
        special.gammaln(shape) - special.gammaln(a) + a * math.log(b) - shape * math.log(rate)
    )
    evidence += 0.5 * math.log(worth / count) - 0.5 * n * math.log(2 * math.pi)
    for inverse in (False, True):
        net = bmc.BayesNet(plates={"i": n})
        if inverse:
            net.add("s", bmc.InverseGamma(a, b))
            net.add("m", lambda s: bmc.Normal(at, np.sqrt(s / worth)))
            net.add("x", lambda m, s: bmc.Normal(m, np.sqrt(s)), plates="i")
        else:
            net.add("s", bmc.Gamma(a, b))
            net.add("m", lambda s: bmc.Normal(at, 1 / np.sqrt(worth * s)))
            net.add("x", lambda m, s: bmc.Normal(m, s**-0.5), plates="i")
        posterior = bmc.infer(net, {"x": x}, engine=bmc.MeanField(blocks=[("m", "s")]), rng=0)
        np.testing.assert_allclose(posterior.elbo, evidence, rtol=1e-12)
        t = bmc.StudentT(2 * shape, middle, math.sqrt(rate / (shape * count)))
        np.testing.assert_allclose(posterior.mean("m"), middle, rtol=1e-12)
        np.testing.assert_allclose(posterior.var("m"), t.var, rtol=1e-12)
        np.testing.assert_allclose(posterior.quantile("m", 0.9), t.ppf(0.9), rtol=1e-10)
        family = (bmc.InverseGamma if inverse else bmc.Gamma)(shape, rate)
        np.testing.assert_allclose(posterior.mean("s"), family.mean, rtol=1e-12)
        check = posterior.check(2000, rng=1)
        assert check.k == -np.inf  # all weights are equal: draws and their density are right, too
        np.testing.assert_allclose(check.log_marginal_likelihood, evidence, rtol=1e-9)


def test_one_wishart_component_is_exact() -> None:
    """Murphy (2007), eq. 266: the evidence of a normal with normal-inverse-Wishart prior."""
    rng = np.random.default_rng(1)
    x = rng.normal(size=(12, 2)) @ np.array([[1.0, 0.4], [0.0, 0.7]]) + 1.0
    n, d, df, worth = 12, 2, 4.0, 0.3
    count, after = worth + n, df + n
    mean = x.mean(axis=0)
    scale = np.eye(d) + (x - mean).T @ (x - mean) + worth * n / count * np.outer(mean, mean)
    evidence = special.multigammaln(after / 2, d) - special.multigammaln(df / 2, d)
    evidence += -0.5 * after * np.linalg.slogdet(scale)[1] + 0.5 * d * math.log(worth / count)
    evidence -= 0.5 * n * d * math.log(math.pi)
    net = bmc.BayesNet(plates={"i": n})
    net.add("cov", bmc.InverseWishart(df, np.eye(d)))
    net.add("mean", lambda cov: bmc.MvNormal(np.zeros(d), cov / worth))
    net.add("x", lambda mean, cov: bmc.MvNormal(mean, cov), plates="i")
    posterior = bmc.infer(net, {"x": x}, engine=bmc.MeanField(blocks=[("mean", "cov")]), rng=0)
    np.testing.assert_allclose(posterior.elbo, evidence, rtol=1e-11)
    np.testing.assert_allclose(posterior.mean("cov"), scale / (after - d - 1), rtol=1e-11)
    np.testing.assert_allclose(posterior.mean("mean"), n * mean / count, rtol=1e-11)
    assert posterior.check(1000, rng=1).k == -np.inf


def test_single_nodes_are_exact() -> None:
    net = bmc.BayesNet(plates={"i": 5})
    net.add("p", bmc.Beta(2.0, 3.0))
    net.add("rate", bmc.Gamma(2.0, 1.0))
    net.add("shares", bmc.Dirichlet([1.0, 2.0, 0.5]))
    net.add("x", lambda p: bmc.Binomial(10, p), plates="i")
    net.add("y", lambda rate: bmc.Poisson(2.0 * rate), plates="i")
    net.add("z", lambda shares: bmc.Categorical(shares), plates="i")
    seen = {"x": [1, 2, 3, 4, 5], "y": [3, 1, 4, 1, 5], "z": [0, 1, 1, 2, 1]}
    posterior = bmc.infer(net, seen, engine=bmc.MeanField(), rng=0)
    np.testing.assert_allclose(posterior.mean("p"), 17 / 55)
    np.testing.assert_allclose(posterior.mean("rate"), 16 / 11)
    np.testing.assert_allclose(posterior.mean("shares"), np.array([2.0, 5.0, 1.5]) / 8.5)
    assert posterior.check(1000, rng=0).k == -np.inf


# ---- fixed points by brute force --------------------------------------------------------------------


def finite_net(rng: np.random.Generator) -> tuple[bmc.BayesNet, dict[str, Any], list[str]]:
    """Five nodes of two or three states that hang together; two are seen."""
    net, cards = bmc.BayesNet(), rng.integers(2, 4, 5)
    for k, parents in enumerate([(), (0,), (0, 1), (1, 0), (2, 3)]):
        probs = rng.dirichlet(np.ones(cards[k]), tuple(cards[p] for p in parents))
        net.table(f"v{k}", [f"v{p}" for p in parents], probs)
    seen = {"v4": int(rng.integers(cards[4])), "v2": int(rng.integers(cards[2]))}
    return net, seen, ["v0", "v1", "v3"]


@pytest.mark.filterwarnings("ignore:MeanField. starts settled")
@pytest.mark.parametrize("seed", range(session.scaled(6, 30)))
def test_tables_are_a_fixed_point(seed: int) -> None:
    """Every factor is what the others make the best one, and the bound is what it says, by all states."""
    rng = np.random.default_rng([session.seed(), seed])
    net, seen, hidden = finite_net(rng)
    posterior = bmc.infer(net, seen, engine=bmc.MeanField(), rng=seed)
    tables = [posterior.probabilities(n) for n in hidden]
    log = np.array(
        [
            net.log_prob({**seen, **dict(zip(hidden, state, strict=True))})
            for state in itertools.product(*(range(len(t)) for t in tables))
        ]
    ).reshape([len(t) for t in tables])
    joint = np.einsum("a,b,c->abc", *tables)
    entropy = sum(float(special.entr(t).sum()) for t in tables)
    np.testing.assert_allclose(posterior.elbo, (joint * log).sum() + entropy, atol=1e-9)
    assert posterior.elbo <= special.logsumexp(log) + 1e-9
    for k, own in enumerate(tables):
        others = [t for j, t in enumerate(tables) if j != k]
        expected = np.einsum("sab,a,b->s", np.moveaxis(log, k, 0), *others)
        np.testing.assert_allclose(own, special.softmax(expected), atol=1e-6)


def test_blocks_of_finite_nodes_come_closer() -> None:
    rng = np.random.default_rng(5)
    net, seen, hidden = finite_net(rng)
    exact = bmc.infer(net, seen, engine=bmc.Exact())
    bounds = []
    for blocks in (None, [hidden[:2]], [hidden]):
        posterior = bmc.infer(net, seen, engine=bmc.MeanField(blocks=blocks), rng=0)
        bounds.append(posterior.elbo)
    assert bounds[0] < bounds[1] < bounds[2]
    np.testing.assert_allclose(bounds[2], exact.log_marginal_likelihood, atol=1e-9)
    for name in hidden:
        np.testing.assert_allclose(
            posterior.probabilities(name), exact.probabilities(name), atol=1e-9
        )
    assert posterior.check(500, rng=0).k == -np.inf


def test_elements_of_a_finite_plate_that_meet_are_updated_in_turn() -> None:
    net = bmc.BayesNet(plates={"i": 4})
    net.add("z", bmc.Bernoulli(0.3), plates="i")
    net.add("x", lambda z: bmc.Normal(z.sum("i"), 1.0))
    posterior = bmc.infer(net, {"x": 2.2}, engine=bmc.MeanField(), rng=0)
    exact = bmc.infer(net, {"x": 2.2}, engine=bmc.Exact())
    assert never_falls(posterior) and posterior.elbo < exact.log_marginal_likelihood
    p = posterior.probabilities("z")[:, 1]
    total, prior = p.sum(), math.log(0.3 / 0.7)
    for k in range(4):  # the update of one given the mean of the others
        rest = total - p[k]
        want = special.expit(prior - 0.5 * ((2.2 - rest - 1) ** 2 - (2.2 - rest) ** 2))
        assert abs(p[k] - want) < 1e-6


@pytest.mark.parametrize("seed", range(session.scaled(4, 40)))
def test_gaussian_nets_have_exact_means_and_conditional_variances(seed: int) -> None:
    """Bishop (2006), sec. 10.1.2: each factor has the variance given all others."""
    rng = np.random.default_rng([session.seed(), seed])
    net, names = bmc.BayesNet(), [f"v{k}" for k in range(5)]
    precision, linear = np.zeros((5, 5)), np.zeros(5)
    for k, name in enumerate(names):
        gains = rng.normal(size=k) * (rng.random(k) < 0.7)
        offset, sd = rng.normal(), rng.uniform(0.5, 1.5)
        net.add(
            name,
            lambda *parents, gains=gains, offset=offset, sd=sd: bmc.Normal(
                sum((g * p for g, p in zip(gains, parents, strict=True)), offset), sd
            ),
            parents=names[:k],
        )
        row = np.concatenate([-gains, [1.0], np.zeros(4 - k)])
        precision += np.outer(row, row) / sd**2
        linear += row * offset / sd**2
    own, given = precision[:4, :4], precision[:4, 4]
    posterior = bmc.infer(net, {"v4": 1.5}, engine=bmc.MeanField(tolerance=1e-10), rng=0)
    mean = np.linalg.solve(own, linear[:4] - given * 1.5)
    for k in range(4):
        np.testing.assert_allclose(posterior.mean(names[k]), mean[k], atol=1e-6)
        np.testing.assert_allclose(posterior.var(names[k]), 1 / own[k, k], rtol=1e-9)
    exact = bmc.infer(net, {"v4": 1.5}, engine=bmc.Exact()).log_marginal_likelihood
    gap = 0.5 * (np.log(np.diag(own)).sum() - np.linalg.slogdet(own)[1])
    np.testing.assert_allclose(exact - posterior.elbo, gap, atol=1e-6)


# ---- without closed forms -----------------------------------------------------------------------------


def test_a_joint_block_of_normals_is_exact() -> None:
    rng = np.random.default_rng(2)
    design = rng.normal(size=(15, 3))
    net = bmc.BayesNet(plates={"i": 15})
    for name in "abc":
        net.add(name, bmc.Normal(0.0, 2.0))
    net.add(
        "y",
        lambda a, b, c: bmc.Normal(a * design[:, 0] + b * design[:, 1] + c * design[:, 2], 0.7),
        plates="i",
    )
    y = design @ [1.0, -2.0, 0.5] + 0.7 * rng.normal(size=15)
    exact = bmc.infer(net, {"y": y}, engine=bmc.Exact())
    posterior = bmc.infer(net, {"y": y}, engine=bmc.MeanField(blocks=[("a", "b", "c")]), rng=0)
    assert "unconstrained" in bmc.explain(net, {"y": y}, engine=posterior.engine).nodes["a"]
    for name in "abc":
        np.testing.assert_allclose(posterior.mean(name), exact.mean(name), atol=1e-5)
        np.testing.assert_allclose(posterior.var(name), exact.var(name), rtol=1e-4)
    off = abs(posterior.elbo - exact.log_marginal_likelihood)
    assert off < 4 * posterior.elbo_mcse + 1e-7
    assert never_falls(posterior)


def test_one_number_without_a_closed_form() -> None:
    """A Poisson count with a normal log rate, whose bound is known: the best normal by another climb."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.5, 1.5))
    net.add("y", lambda x: bmc.Poisson(np.exp(x)))
    posterior = bmc.infer(net, {"y": 4}, engine=bmc.MeanField(), rng=0)

    def lost(at: np.ndarray) -> float:
        m, s = at[0], math.exp(at[1])
        fit = 4 * m - math.exp(m + 0.5 * s**2) - special.gammaln(5.0)
        prior = -0.5 * ((m - 0.5) ** 2 + s**2) / 1.5**2 - math.log(1.5)
        return -(fit + prior + math.log(s) + 0.5)

    best = optimize.minimize(lost, [1.0, -1.0], tol=1e-12)
    np.testing.assert_allclose(posterior.elbo, -best.fun, atol=1e-8)
    assert posterior.elbo_mcse < 1e-8
    np.testing.assert_allclose(posterior.mean("x"), best.x[0], atol=1e-5)
    np.testing.assert_allclose(posterior.std("x"), math.exp(best.x[1]), rtol=1e-5)


def test_closed_forms_beside_a_node_without() -> None:
    """Half-Cauchy scale of a hierarchy: everything else keeps its closed form."""
    y = np.array([28.0, 8, -3, 7, -1, 1, 18, 12])
    error = np.array([15.0, 10, 16, 11, 9, 11, 10, 18])
    net = bmc.BayesNet(plates={"school": 8})
    net.add("mu", bmc.Normal(0.0, 5.0))
    net.add("tau", bmc.HalfCauchy(5.0))
    net.add("theta", lambda mu, tau: bmc.Normal(mu, tau), plates="school")
    net.add("y", lambda theta: bmc.Normal(theta, error), plates="school")
    engine = bmc.MeanField(restarts=3)
    said = bmc.explain(net, {"y": y}, engine=engine).nodes
    assert said["mu"] == said["theta"] == "closed form: normal"
    assert "unconstrained" in said["tau"] and "in the density of 'tau'" in said["tau"]
    posterior = bmc.infer(net, {"y": y}, engine=engine, rng=0)
    assert posterior.converged and never_falls(posterior)
    # the fixed point of mu given the others: expected precisions of tau by its own draws
    draws = posterior.resample(40_000, rng=1)["tau"]
    inverse = (draws**-2.0).mean()
    want = inverse * posterior.mean("theta").sum() / (1 / 25 + 8 * inverse)
    np.testing.assert_allclose(posterior.mean("mu"), want, rtol=0.05)


# ---- partly seen, blocks, and what it refuses ------------------------------------------------------


def test_partly_seen_nodes() -> None:
    """What was seen is a point; the rest has a factor, whose fixed point is checked by hand."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("m", bmc.Normal(0.0, 3.0))
    net.add("x", lambda m: bmc.Normal(m, 1.0), plates="i")
    net.add("y", lambda x: bmc.Normal(2.0 * x, 0.5), plates="i")
    seen = {"x": [1.0, np.nan, 3.0], "y": [2.5, 4.0, np.nan]}
    posterior = bmc.infer(net, seen, engine=bmc.MeanField(tolerance=1e-10), rng=0)
    exact = bmc.infer(net, seen, engine=bmc.Exact())
    np.testing.assert_allclose(posterior.mean("x"), exact.mean("x"), atol=1e-6)
    np.testing.assert_allclose(posterior.mean("m"), exact.mean("m"), atol=1e-6)
    np.testing.assert_allclose(posterior.var("x"), [0.0, 1 / 17, 0.0], atol=1e-9)
    assert abs(posterior.mean("y")[2] - 6.0) < 0.1  # drawn from the net
    net = bmc.BayesNet(plates={"i": 3})
    net.add("p", bmc.Beta(1.0, 1.0), plates="i")
    net.add("rate", bmc.Gamma(1.0, 1.0), plates="i")
    net.add("z", lambda p: bmc.Bernoulli(p), plates="i")
    net.add("n", lambda rate, z: bmc.Poisson(rate * (1.0 + z)), plates="i")
    seen = {
        "p": [0.5, np.nan, np.nan],
        "rate": [np.nan, 2.0, np.nan],
        "z": [1, np.nan, 0],
        "n": [2, 3, 4],
    }
    posterior = bmc.infer(net, seen, engine=bmc.MeanField(), rng=0)
    assert posterior.mean("p")[0] == 0.5 and posterior.var("p")[0] == 0.0
    assert posterior.mean("rate")[1] == 2.0
    np.testing.assert_allclose(posterior.mean("rate")[[0, 2]], [1.0, 2.5])
    np.testing.assert_allclose(posterior.probabilities("z")[[0, 2], 1], [1.0, 0.0])
    check = posterior.check(2000, rng=0)
    assert check.ok
    assert posterior.elbo < check.log_marginal_likelihood + 4 * check.log_marginal_likelihood_mcse


def test_refusals() -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("n", bmc.Poisson(3.0))
    net.add("k", bmc.Bernoulli(0.5))
    net.add("x", lambda m, n: bmc.Normal(m + n, 1.0), plates="i")
    net.add("y", lambda m, k: bmc.Normal(m + k, 1.0))
    with pytest.raises(UnsupportedError, match="'n'"):  # infinitely many states
        bmc.infer(net, {"x": [1.0, 2.0, 3.0]}, engine=bmc.MeanField())
    with pytest.raises(UnsupportedError, match="'m', which has numbers"):
        bmc.infer(net, {"y": 1.0}, engine=bmc.MeanField(blocks=[("k", "m")]))
    with pytest.raises(UnsupportedError, match="'q' is no hidden node"):
        bmc.infer(net, {"y": 1.0}, engine=bmc.MeanField(blocks=[("m", "q")]))
    opaque = bmc.BayesNet()
    opaque.add("m", bmc.Normal(0.0, 1.0))
    opaque.add("x", lambda m: bmc.Normal(np.asarray(m, dtype=object).astype(float), 1.0))
    with pytest.raises(UnsupportedError, match="not followed"):
        bmc.infer(opaque, {"x": 1.0}, engine=bmc.MeanField())
    for bad in ({"restarts": 0}, {"tolerance": 0.0}, {"sweeps": 1.5}, {"blocks": "ab"}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            bmc.MeanField(**bad)
    with pytest.raises(ValueError, match="each in one"):
        bmc.MeanField(blocks=[("a", "b"), ("b", "c")])
    impossible = bmc.BayesNet()
    impossible.add("a", bmc.Bernoulli(0.5))
    impossible.table("b", [], [1.0, 0.0])
    impossible.table("c", ["a"], [[0.5, 0.5], [0.1, 0.9]])
    with pytest.raises(ZeroProbabilityError):
        bmc.infer(impossible, {"b": 1, "c": 0}, engine=bmc.MeanField())


def test_vectors_seen_in_part_are_refused() -> None:
    """Of one that nothing hides the part seen would be left out, and the prior answer."""
    net = bmc.BayesNet()
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("y", lambda m: bmc.MvNormal(bmc.stack([m, m]), np.array([[1.0, 0.9], [0.9, 1.0]])))
    with pytest.raises(UnsupportedError, match="of 'y' some components are missing"):
        bmc.infer(net, {"y": [3.0, np.nan]}, engine=bmc.MeanField(), rng=0)


@pytest.mark.parametrize(
    ("mean", "jumps"),
    [
        (lambda x: np.where(x > 0, 0.9, 0.2), True),
        (lambda x: np.sign(x - 40.0), True),
        (lambda x: np.floor(x / 7.0), True),
        (lambda x: 1.0 * (x > 41.0), True),
        (lambda x: x % 1, True),
        (lambda x: np.where(x > 40.0, x, 40.0), False),
        (lambda x: np.abs(x - 40.0), False),
        (lambda x: np.where(x > 1e6, 1.0, np.tanh(x)), False),  # out of reach
    ],
)
def test_jumps_are_refused_and_bends_are_not(mean: Any, jumps: bool) -> None:
    """Points cross a jump without a gradient telling: the factor would be that of another density."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(40.0 if not jumps else 39.0, 45.0))
    net.add("y", lambda x: bmc.Normal(mean(x), 1.0))
    if jumps:
        with pytest.raises(UnsupportedError, match="jumps at some values of node 'x'"):
            bmc.infer(net, {"y": 0.7}, engine=bmc.MeanField(restarts=1), rng=0)
    else:
        bmc.infer(net, {"y": 0.7}, engine=bmc.MeanField(restarts=1), rng=0)


@pytest.mark.parametrize(("sigmoid", "scale"), [(special.ndtr, 5.0), (special.expit, 20.0)])
@pytest.mark.parametrize("mixed", [False, True])
def test_no_and_yes_are_mirror_images_far_out(sigmoid: Any, scale: float, mixed: bool) -> None:
    """Where ``log(1 - p)`` is zero to the last digit, too: steps, tables and the bound see one function."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, scale))
    net.add("k", bmc.Bernoulli(0.5))
    shift = 2.0 if mixed else 0.0
    net.add("y", lambda x, k: bmc.Bernoulli(sigmoid(x + shift * (k - 0.5))))
    yes, no = (bmc.infer(net, {"y": y}, engine=bmc.MeanField(restarts=1), rng=0) for y in (1, 0))
    np.testing.assert_allclose(yes.mean("x"), -no.mean("x"), rtol=1e-5)
    np.testing.assert_allclose(yes.std("x"), no.std("x"), rtol=1e-5)
    np.testing.assert_allclose(yes.elbo, no.elbo, rtol=1e-6)
    np.testing.assert_allclose(yes.probabilities("k"), no.probabilities("k")[::-1], rtol=1e-5)
    assert yes.elbo < math.log(0.5)  # of the evidence


def test_places_that_differ_are_told_and_orders_of_components_are_not() -> None:
    """Two dice that add up to two (from 0): one of three ways answers, with bounds that are all the same."""
    net = bmc.BayesNet()
    net.table("a", [], np.full(6, 1 / 6))
    net.table("b", [], np.full(6, 1 / 6))
    net.add("sum", lambda a, b: bmc.Normal(1.0 * a + b, 0.01))
    with pytest.warns(
        EngineWarning, match=r"starts settled in . places .*bounds 0.102713, 0.102713"
    ):
        bmc.infer(net, {"sum": 2.0}, engine=bmc.MeanField(), rng=0)
    rng = np.random.default_rng(0)
    mix = bmc.BayesNet(plates={"kind": 2, "i": 30})
    mix.add("weights", bmc.Dirichlet(np.ones(2)))
    mix.add("mean", bmc.Normal(0.0, 10.0), plates="kind")
    mix.add("label", lambda weights: bmc.Categorical(weights), plates="i")
    mix.add("x", lambda label, mean: bmc.Normal(mean[label], 1.0), plates="i")
    x = rng.normal(size=30) + np.where(np.arange(30) < 10, -4.0, 4.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        posterior = bmc.infer(mix, {"x": x}, engine=bmc.MeanField(), rng=0)
    assert np.ptp(posterior.bounds[:3]) < 1e-3


def test_a_bound_that_falls_is_a_fault() -> None:
    with pytest.raises(BoundError, match="fell"):
        check_bound(-10.0, -10.1)
    with pytest.raises(BoundError):
        check_bound(-10.0, math.nan)


def test_not_settled_is_said() -> None:
    with pytest.warns(ConvergenceWarning, match="after 2 sweeps"):
        posterior = bmc.infer(
            clutter(4), {"x": [0.1, 2.0, 2.2, -6.0]}, engine=bmc.MeanField(sweeps=2), rng=0
        )
    assert not posterior.converged and posterior.sweeps == 2


def test_answers_travel_and_repeat() -> None:
    x = {"x": [0.1, 2.0, 2.2, -6.0]}
    one, two = (bmc.infer(clutter(4), x, engine=bmc.MeanField(), rng=3) for _ in range(2))
    assert one.elbo == two.elbo and one.mean("theta") == two.mean("theta")
    square = one.expectation(lambda theta: theta**2)
    error = one.mcse(lambda theta: theta**2)
    assert abs(square - one.var("theta") - one.mean("theta") ** 2) < 5 * error
    assert one.mcse("theta") == 0.0 and copy.deepcopy(one) is one
    again = pickle.loads(pickle.dumps(one))
    np.testing.assert_array_equal(again.mean("theta"), one.mean("theta"))
    np.testing.assert_array_equal(again.probabilities("noise"), one.probabilities("noise"))
    assert again.expectation(lambda theta: theta**2) == square
    assert "theta" in str(one.summary())


def test_engines_that_know_nothing_hidden() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", lambda a: bmc.Normal(a, 1.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        posterior = bmc.infer(net, {"a": 1.0}, engine=bmc.MeanField(), rng=0)
    np.testing.assert_allclose(posterior.elbo, bmc.Normal(0.0, 1.0).log_prob(1.0))
    assert abs(posterior.mean("b") - 1.0) < 5 * posterior.mcse("b")


def test_plans_are_made_once() -> None:
    problem = pose(clutter(4), {"x": [0.1, 2.0, 2.2, -6.0]})
    engine = bmc.MeanField()
    assert engine._plan(problem) is engine._plan(problem)


def test_edges_within_reach_and_angles_are_refused() -> None:
    """A factor that is squeezed in front of an edge would look sure of itself."""
    net = bmc.BayesNet(plates={"i": 5})
    net.add("top", bmc.Gamma(2.0, 1.0))
    net.add("y", lambda top: bmc.Uniform(0.0, top), plates="i")
    with pytest.raises(UnsupportedError, match="zero beyond some values of node 'top'"):
        bmc.infer(net, {"y": [0.1, 0.5, 1.0, 2.0, 1.5]}, engine=bmc.MeanField(restarts=1), rng=0)
    net = bmc.BayesNet()
    net.add("a", bmc.VonMises(0.0, 1.0))
    net.add("y", lambda a: bmc.Normal(np.cos(a), 1.0))
    with pytest.raises(UnsupportedError, match="'a' is an angle"):
        bmc.infer(net, {"y": 1.0}, engine=bmc.MeanField())


def test_zero_probabilities_that_tie_nodes_are_told() -> None:
    """A copy: independent factors can say that both are 0 or that both are 1, and no more."""
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.table("b", ["a"], [[1.0, 0.0], [0.0, 1.0]])
    net.add("y", lambda a, b: bmc.Normal(a + 0.5 * b, 3.0))
    with pytest.warns(ReducibleWarning, match="'a'"):
        posterior = bmc.infer(net, {"y": 0.5}, engine=bmc.MeanField(), rng=0)
    assert sorted(posterior.probabilities("a")) == [0.0, 1.0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        both = bmc.infer(net, {"y": 0.5}, engine=bmc.MeanField(blocks=[("a", "b")]), rng=0)
        known = bmc.infer(net, {"y": 0.5, "a": 1}, engine=bmc.MeanField(), rng=0)  # no other way
    np.testing.assert_allclose(
        both.probabilities("a"), bmc.infer(net, {"y": 0.5}, engine=bmc.Exact()).probabilities("a")
    )
    assert known.probabilities("b")[1] == 1.0


# ---- ways in which labels and blocks come --------------------------------------------------------------


def labelled(rng: np.random.Generator) -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Some labels are known, some points missing."""
    net = bmc.BayesNet(plates={"k": 2, "n": 40})
    net.add("w", bmc.Dirichlet(np.ones(2)))
    net.add("m", bmc.Normal(0.0, 5.0), plates="k")
    net.add("p", bmc.Gamma(1.0, 1.0), plates="k")
    net.add("z", lambda w: bmc.Categorical(w), plates="n")
    net.add("x", lambda z, m, p: bmc.LogNormal(m[z], p[z] ** -0.5), plates="n")
    z = np.repeat([0, 1], 20)
    x = np.exp(rng.normal(4.0 * z - 2.0, 1.0))
    known, missing = np.arange(40) % 7 == 0, np.arange(40) % 5 == 0
    return net, {"x": np.where(missing, np.nan, x), "z": np.where(known, z, np.nan)}


def free_scales(rng: np.random.Generator) -> tuple[bmc.BayesNet, dict[str, Any]]:
    """A mixture whose scales have no closed form."""
    net = bmc.BayesNet(plates={"k": 2, "n": 30})
    net.add("s", bmc.HalfNormal(2.0), plates="k")
    net.add("m", bmc.Normal(0.0, 5.0), plates="k")
    net.add("z", bmc.Categorical([0.4, 0.6]), plates="n")
    net.add("x", lambda z, m, s: bmc.Normal(m[z], s[z]), plates="n")
    return net, {"x": rng.normal(np.repeat([-3.0, 3.0], 15), 1.0)}


def two_plates(rng: np.random.Generator) -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Labels in two plates, with weights of their rows; vectors with known spreads."""
    net = bmc.BayesNet(plates={"a": 4, "b": 7, "k": 2})
    net.add("w", bmc.Dirichlet(np.ones(2)), plates="a")
    net.add("m", bmc.MvNormal(np.zeros(2), 9.0 * np.eye(2)), plates="k")
    net.add("z", lambda w: bmc.Categorical(w), plates=("a", "b"))
    net.add(
        "x", lambda z, m: bmc.MvNormal(m[z], scale_diag=np.array([1.0, 0.5])), plates=("a", "b")
    )
    return net, {"x": rng.normal(size=(4, 7, 2)) + 3.0 * rng.integers(0, 2, (4, 7, 1))}


def factorial(rng: np.random.Generator) -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Two labels that add up."""
    net = bmc.BayesNet(plates={"n": 30})
    net.add("a", bmc.Normal(0.0, 5.0))
    net.add("b", bmc.Normal(0.0, 5.0))
    net.add("u", bmc.Bernoulli(0.5), plates="n")
    net.add("v", bmc.Bernoulli(0.3), plates="n")
    net.add("x", lambda a, b, u, v: bmc.Normal(a * u + b * v, 1.0), plates="n")
    return net, {"x": rng.normal(3.0 * (rng.random(30) < 0.5) - 4.0 * (rng.random(30) < 0.3), 1.0)}


def matrices(rng: np.random.Generator) -> tuple[bmc.BayesNet, dict[str, Any]]:
    """A Wishart precision whose scale is hidden, too."""
    net = bmc.BayesNet(plates={"n": 20})
    net.add("s", bmc.Wishart(5.0, np.eye(2)))
    net.add("p", lambda s: bmc.Wishart(6.0, s / 4.0))
    net.add("x", lambda p: bmc.MvNormal(np.zeros(2), np.linalg.inv(p)), plates="n")
    return net, {"x": rng.normal(size=(20, 2))}


@pytest.mark.filterwarnings("ignore:MeanField. starts settled")
@pytest.mark.parametrize(
    ("make", "blocks"),
    [
        (labelled, None), (free_scales, None), (two_plates, None), (factorial, None),
        (factorial, [("u", "v")]), (matrices, None),
    ],
)  # fmt: skip
def test_the_bound_is_below_what_weighted_draws_say(make: Any, blocks: Any) -> None:
    """By the model's own functions: what was read, entropies and densities of draws must all be right."""
    net, seen = make(np.random.default_rng(4))
    posterior = bmc.infer(net, seen, engine=bmc.MeanField(restarts=3, blocks=blocks), rng=0)
    assert posterior.converged and never_falls(posterior)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LowEssWarning)
        check = posterior.check(4000, rng=0)
    gap = check.log_marginal_likelihood - posterior.elbo
    error = 4 * np.hypot(check.log_marginal_likelihood_mcse, posterior.elbo_mcse)
    assert -error < gap < 1.0 + error
    # the mean of the log weights of draws is the bound itself
    raw = log_weights(posterior, 4000)
    assert (
        abs(raw.mean() - posterior.elbo)
        < 5 * raw.std() / math.sqrt(len(raw)) + 4 * posterior.elbo_mcse
    )


def log_weights(posterior: Any, draws: int) -> np.ndarray:
    """Log density of the model less that of the approximation, of its own draws."""
    rng = np.random.default_rng(1)
    drawn = posterior.approximation.draw(rng, draws)
    values = completed(posterior.problem, posterior.approximation.names, drawn, rng)
    log = log_joint(posterior.problem, posterior.approximation.names, values, draws)
    return log - drawn.log_density
