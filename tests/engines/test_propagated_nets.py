"""Expectation propagation and assumed-density filtering on nets, against fixed points and exact answers."""

from __future__ import annotations

import copy
import json
import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import integrate, special, stats

import bayesmc as bmc
from bayesmc.engines.propagation.system import system_of
from bayesmc.errors import ConvergenceWarning, UnsupportedError, ZeroProbabilityError
from bayesmc.network import pose
from bayesmc.testing import session
from bayesmc.testing.posteriors.matrix import matrix_case

EP = bmc.ExpectationPropagation


def clutter(points: int, mixture: bool = False) -> bmc.BayesNet:
    """Minka's clutter problem, with a label for every point or without."""
    net = bmc.BayesNet("clutter", plates={"point": points})
    net.add("theta", bmc.Normal(0.0, 10.0))
    if mixture:
        net.add(
            "x",
            lambda theta: bmc.Mixture(
                np.array([0.5, 0.5]),
                bmc.Normal(bmc.stack([theta, 0.0 * theta]), np.array([1.0, np.sqrt(10.0)])),
            ),
            plates="point",
        )
        return net
    net.add("is_clutter", bmc.Bernoulli(0.5), plates="point")
    net.add(
        "x",
        lambda theta, is_clutter: bmc.Normal(
            np.where(is_clutter == 1, 0.0, theta), np.where(is_clutter == 1, np.sqrt(10.0), 1.0)
        ),
        plates="point",
    )
    return net


@pytest.fixture(scope="module")
def cases(reference_data: Path) -> list[dict[str, Any]]:
    """Data sets of the clutter problem with the known fixed points."""
    return json.loads((reference_data / "ep" / "clutter.json").read_text())


def figures(posterior: Any) -> list[float]:
    found = posterior.log_marginal_likelihood, posterior.mean("theta"), posterior.var("theta")
    return [float(f) for f in found]


@pytest.mark.parametrize("mixture", [False, True])
def test_clutter_problem_ends_at_the_known_fixed_points(
    cases: list[dict[str, Any]], mixture: bool
) -> None:
    for case in cases:
        net, rows = clutter(case["n"], mixture), {"x": case["x"]}
        posterior = bmc.infer(net, rows, engine=EP(tolerance=1e-8))
        assert posterior.converged
        assert figures(posterior) == pytest.approx(case["ep"][:3], abs=1e-6)
        if not mixture:
            assert figures(bmc.infer(net, rows, engine=EP())) == pytest.approx(
                case["ep"][:3], abs=1e-4
            )


def test_one_pass_is_assumed_density_filtering_and_something_else(
    cases: list[dict[str, Any]],
) -> None:
    for case in cases:
        net, rows = clutter(case["n"]), {"x": case["x"]}
        once = bmc.infer(net, rows, engine=bmc.AssumedDensity())
        assert figures(once) == pytest.approx(case["adf"][:3], abs=1e-6)
        assert abs(once.mean("theta") - case["ep"][1]) > 1e-3
        mean, var, met = 0.0, 100.0, 0.0
        for x in case["x"]:  # Minka 2001, ch. 3.1
            at_theta = 0.5 * stats.norm.pdf(x, mean, np.sqrt(var + 1))
            whole = at_theta + 0.5 * stats.norm.pdf(x, 0, np.sqrt(10))
            share, met = at_theta / whole, met + np.log(whole)
            gain, off = var / (var + 1), x - mean
            mean = mean + share * gain * off
            var = var - share * gain * var + share * (1 - share) * (gain * off) ** 2
        assert once.log_as_met == pytest.approx(met, abs=1e-9)


# ---- TrueSkill ----------------------------------------------------------------------------------

BETA = 25 / 6


def margin(players: int) -> float:
    """That of a draw, where one game in ten is one."""
    return float(np.sqrt(players) * BETA * special.ndtri(0.55))


def arena(names: str) -> bmc.BayesNet:
    """Players with skills, and how each plays this time."""
    net = bmc.BayesNet("TrueSkill")
    for name in names:
        net.add(name, bmc.Normal(25.0, np.hypot(25 / 3, 25 / 300)))
        net.add(f"plays_{name}", lambda skill: bmc.Normal(skill, BETA), parents=[name])
    return net


def rating(posterior: Any, name: str) -> tuple[float, float]:
    return float(posterior.mean(name)), float(posterior.std(name))


def test_two_players_win_lose_and_draw_as_in_trueskill() -> None:
    net = arena("ab")
    net.add("won", lambda plays_a, plays_b: bmc.Bernoulli(plays_a - plays_b > margin(2)))
    net.add("drawn", lambda plays_a, plays_b: bmc.Bernoulli(np.abs(plays_a - plays_b) < margin(2)))
    won = bmc.infer(net, {"won": 1}, engine=EP())
    assert rating(won, "a") == pytest.approx((29.396, 7.171), abs=2e-3)
    assert rating(won, "b") == pytest.approx((20.604, 7.171), abs=2e-3)
    drawn = bmc.infer(net, {"drawn": 1}, engine=EP())
    assert rating(drawn, "a") == pytest.approx((25.0, 6.458), abs=2e-3)
    lost = bmc.infer(net, {"won": 0, "drawn": 0}, engine=EP())  # what no table of ratings has
    assert lost.mean("a") < 25.0


def test_teams_and_three_players_as_in_trueskill() -> None:
    net = arena("abcd")
    net.add(
        "won",
        lambda plays_a, plays_b, plays_c, plays_d: bmc.Bernoulli(
            plays_a + plays_b - plays_c - plays_d > margin(4)
        ),
    )
    posterior = bmc.infer(net, {"won": 1}, engine=EP())
    assert rating(posterior, "b") == pytest.approx((28.108, 7.774), abs=2e-3)
    net = arena("abc")
    net.add("first", lambda plays_a, plays_b: bmc.Bernoulli(plays_a - plays_b > margin(2)))
    net.potential(  # the same said as a constraint
        "second", lambda plays_b, plays_c: np.where(plays_b - plays_c > margin(2), 0.0, -np.inf)
    )
    posterior = bmc.infer(net, {"first": 1}, engine=EP())
    for name, known in (("a", (31.675, 6.656)), ("b", (25.0, 6.208)), ("c", (18.325, 6.656))):
        assert rating(posterior, name) == pytest.approx(known, abs=2e-3)
    assert posterior.cov("a", "b")[0, 1] > 0.1  # skills hang together now
    assert posterior.check(rng=0).ok


# ---- where it is exact --------------------------------------------------------------------------


def tree(seed: int) -> tuple[bmc.BayesNet, dict[str, Any]]:
    """A random tree of finite nodes in the order of a random permutation's parents, some of it observed."""
    rng = np.random.default_rng(seed)
    net, cards, evidence = bmc.BayesNet(), [], {}
    for k in range(12):
        cards.append(int(rng.integers(2, 5)))
        name = f"v{k}"
        if not k:
            net.table(name, [], rng.dirichlet(np.ones(cards[0])))
            continue
        parent = int(rng.integers(k))
        rows = rng.dirichlet(np.full(cards[k], 0.5), cards[parent])
        net.table(name, [f"v{parent}"], rows)
        if rng.random() < 0.3:
            evidence[name] = int(rng.integers(cards[k]))
    return net, evidence


@pytest.mark.parametrize("seed", range(session.scaled(6)))
def test_trees_of_finite_nodes_are_exact(seed: int) -> None:
    net, evidence = tree(seed)
    posterior = bmc.infer(net, evidence, engine=EP())
    right = bmc.infer(net, evidence, engine=bmc.Exact())
    assert posterior.converged and posterior.sweeps <= 3
    for name in net.graph:
        if name not in evidence:
            assert posterior.probabilities(name) == pytest.approx(
                right.probabilities(name), abs=1e-9
            )
    assert posterior.log_marginal_likelihood == pytest.approx(
        right.log_marginal_likelihood, abs=1e-9
    )


def test_loops_are_said_to_be_loopy(capsys: pytest.CaptureFixture[str]) -> None:
    net = bmc.BayesNet()
    net.table("a", [], [0.5, 0.5])
    net.table("b", ["a"], [[0.9, 0.1], [0.2, 0.8]])
    net.table("c", ["a"], [[0.7, 0.3], [0.3, 0.7]])
    net.table("d", ["b", "c"], [[[0.9, 0.1], [0.5, 0.5]], [[0.4, 0.6], [0.1, 0.9]]])
    bmc.explain(net, {"d": 1}, engine=EP())
    assert "loopy belief propagation" in capsys.readouterr().out
    posterior = bmc.infer(net, {"d": 1}, engine=EP())
    right = bmc.infer(net, {"d": 1}, engine=bmc.Exact())
    assert posterior.probabilities("a") == pytest.approx(right.probabilities("a"), abs=0.05)
    assert abs(posterior.probabilities("a")[0] - right.probabilities("a")[0]) > 1e-6
    tree_net, evidence = tree(0)
    bmc.explain(tree_net, evidence, engine=EP())
    assert "on trees, exact" in capsys.readouterr().out


def test_numbers_that_are_compared_are_one_direction() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a, b: bmc.Bernoulli(a > b))
    posterior = bmc.infer(net, {"y": 1}, engine=EP())
    assert posterior.mean("a") == pytest.approx(1 / np.sqrt(np.pi), abs=1e-6)
    assert posterior.cov("a", "b")[0, 1] == pytest.approx(1 / np.pi, abs=1e-6)
    assert posterior.log_marginal_likelihood == pytest.approx(-np.log(2.0), abs=1e-6)


def test_contradictions_are_refused() -> None:
    net = bmc.BayesNet()
    net.table("a", [], [0.5, 0.5])
    net.table("b", ["a"], [[1.0, 0.0], [0.0, 1.0]])
    net.table("c", ["a"], [[1.0, 0.0], [0.0, 1.0]])
    with pytest.raises(ZeroProbabilityError):
        bmc.infer(net, {"b": 0, "c": 1}, engine=EP())


def test_linear_gaussian_nets_are_exact() -> None:
    exact = 0
    for seed in range(session.scaled(12)):
        net, evidence, answer = matrix_case("gaussian", seed)
        if not system_of(pose(net, evidence)).is_exact:
            continue
        exact += 1
        posterior, right = bmc.infer(net, evidence, engine=EP()), answer(evidence)
        wanted = right.log_marginal_likelihood
        assert posterior.log_marginal_likelihood == pytest.approx(wanted, rel=1e-8, abs=1e-8)
        for name in posterior.approximation.names:
            if net[name].is_discrete:
                continue
            assert posterior.mean(name) == pytest.approx(right.mean(name), rel=1e-8, abs=1e-8)
            assert posterior.var(name) == pytest.approx(right.var(name), rel=1e-8, abs=1e-8)
    assert exact >= 3


# ---- random nets --------------------------------------------------------------------------------

KINDS = ("discrete", "hybrid", "plates", "hybrid plates", "gaussian")


def worst(posterior: Any, right: Any) -> float:
    """By how many standard deviations the mean that is furthest off is so, of what it describes itself."""
    found = 0.0
    for name in posterior.approximation.names:
        node = posterior.model[name]
        if node.domain is not None:
            mean, wanted = posterior.probabilities(name), np.asarray(right.probabilities(name))
            var = wanted * (1.0 - wanted)
        else:
            if posterior.approximation.marginal(name) is None:
                continue
            mean, wanted, var = posterior.mean(name), right.mean(name), right.var(name)
        off = np.abs(mean - wanted)
        off = np.where(off < 1e-9, 0.0, off / np.sqrt(np.maximum(var, 1e-18)))
        found = max(found, float(off.max(initial=0.0)))
    return found


def test_random_nets_are_near_and_what_does_not_settle_warns() -> None:
    """No chance is involved: 200 nets in a thorough run, of which 95 in 100 are to be near."""
    answered, near = 0, 0
    for number in range(session.scaled(30, 7)):
        net, evidence, answer = matrix_case(KINDS[number % 5], session.seed() + number // 5)
        if EP().unsupported(net, evidence):
            continue
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            posterior = bmc.infer(net, evidence, engine=EP())
        if not posterior.converged:
            assert any("not settled" in str(w.message) for w in caught)
            continue
        answered += 1
        near += worst(posterior, answer(evidence)) < 0.1
    assert near >= 0.95 * answered - 1 and answered >= 25


# ---- regressions --------------------------------------------------------------------------------


def probit_net(design: np.ndarray) -> bmc.BayesNet:
    n, d = design.shape
    net = bmc.BayesNet("probit", plates={"row": n})
    net.add("w", bmc.MvNormal(np.zeros(d), 4.0 * np.eye(d)))
    net.add("y", lambda w: bmc.Bernoulli(special.ndtr(np.vecdot(design, w))), plates="row")
    return net


def one_by_one(design: np.ndarray, y: np.ndarray, sweeps: int) -> tuple[np.ndarray, np.ndarray]:
    """Expectation propagation of probit regression as in Rasmussen and Williams (2006), 3.6, in a loop."""
    n, d = design.shape
    cov, mean = 4.0 * np.eye(d), np.zeros(d)
    tau, nu = np.zeros(n), np.zeros(n)
    for _ in range(sweeps):
        for i, (x, sign) in enumerate(zip(design, 2 * y - 1, strict=True)):
            v, m = x @ cov @ x, x @ mean
            cavity_tau, cavity_nu = 1 / v - tau[i], m / v - nu[i]
            cv, cm = 1 / cavity_tau, cavity_nu / cavity_tau
            z = sign * cm / np.sqrt(1 + cv)
            ratio = stats.norm.pdf(z) / stats.norm.cdf(z)
            new_mean = cm + sign * cv * ratio / np.sqrt(1 + cv)
            new_var = cv - cv**2 * ratio * (z + ratio) / (1 + cv)
            tau[i], nu[i] = 1 / new_var - cavity_tau, new_mean / new_var - cavity_nu
            cov = np.linalg.inv(np.eye(d) / 4 + design.T @ (tau[:, None] * design))
            mean = cov @ design.T @ nu
    return mean, cov


def test_probit_regression_is_that_of_a_plain_loop() -> None:
    rng = np.random.default_rng(3)
    design = rng.normal(size=(60, 3))
    y = (design @ [1.0, -0.5, 0.2] + rng.normal(size=60) > 0).astype(int)
    posterior = bmc.infer(probit_net(design), {"y": y}, engine=EP(tolerance=1e-9))
    mean, cov = one_by_one(design, y, 12)
    assert posterior.mean("w") == pytest.approx(mean, abs=1e-7)
    assert posterior.cov("w") == pytest.approx(cov, abs=1e-7)
    latent = bmc.BayesNet("the same with what is hidden", plates={"row": 60})
    latent.add("w", bmc.MvNormal(np.zeros(3), 4.0 * np.eye(3)))
    latent.add("z", lambda w: bmc.Normal(np.vecdot(design, w), 1.0), plates="row")
    latent.add("y", lambda z: bmc.Bernoulli(z > 0), plates="row")
    also = bmc.infer(latent, {"y": y}, engine=EP(tolerance=1e-9))
    assert also.mean("w") == pytest.approx(mean, abs=1e-6)
    assert also.log_marginal_likelihood == pytest.approx(
        posterior.log_marginal_likelihood, abs=1e-6
    )


def test_one_coefficient_against_quadrature() -> None:
    """Logistic, Poisson and heavy tails: the exact posterior of one number, by quadrature."""
    rng = np.random.default_rng(5)
    x = rng.normal(size=30)
    cases = {
        "logistic": (
            lambda w: bmc.Bernoulli(special.expit(w * x)),
            lambda w, y: np.sum(y * w * x - np.logaddexp(0, w * x)),
            (rng.random(30) < special.expit(1.5 * x)).astype(int),
        ),
        "counts": (
            lambda w: bmc.Poisson(np.exp(0.3 + w * x)),
            lambda w, y: np.sum(stats.poisson.logpmf(y, np.exp(0.3 + w * x))),
            rng.poisson(np.exp(0.3 + 0.5 * x)),
        ),
        "outliers": (
            lambda w: bmc.StudentT(3.0, w * x, 0.5),
            lambda w, y: np.sum(stats.t.logpdf(y, 3.0, w * x, 0.5)),
            0.7 * x + 0.5 * rng.standard_t(3, 30),
        ),
    }
    for kind, (density, log, y) in cases.items():
        net = bmc.BayesNet(kind, plates={"row": 30})
        net.add("w", bmc.Normal(0.0, 2.0))
        net.add("y", density, plates="row")
        posterior = bmc.infer(net, {"y": y}, engine=EP())
        grid = posterior.mean("w") + posterior.std("w") * np.linspace(-9, 9, 2001)
        logs = np.array([log(w, y) + stats.norm.logpdf(w, 0, 2) for w in grid])
        weight = np.exp(logs - logs.max())
        total = integrate.simpson(weight, x=grid)
        mean = integrate.simpson(weight * grid, x=grid) / total
        sd = np.sqrt(integrate.simpson(weight * (grid - mean) ** 2, x=grid) / total)
        assert posterior.mean("w") == pytest.approx(mean, abs=0.02 * sd), kind
        assert posterior.std("w") == pytest.approx(sd, rel=0.03), kind
        wanted = np.log(total) + logs.max()
        assert posterior.log_marginal_likelihood == pytest.approx(wanted, abs=0.02), kind


def coin() -> tuple[bmc.BayesNet, np.ndarray, Any]:
    net = bmc.BayesNet(plates={"trial": 12})
    net.add("p", bmc.Beta(2.0, 3.0))
    net.add("y", lambda p: bmc.Bernoulli(p), plates="trial")
    y = np.array([1, 1, 0, 1, 0, 0, 1, 1, 1, 0, 1, 1])
    return net, y, stats.beta(2 + y.sum(), 3 + 12 - y.sum())


def test_numbers_between_bounds_have_exact_priors() -> None:
    net, y, right = coin()
    posterior = bmc.infer(net, {"y": y}, engine=EP(families={"p": "normal"}))
    assert posterior.mean("p") == pytest.approx(right.mean(), abs=0.02 * right.std())
    assert posterior.quantile("p", [0.1, 0.9]) == pytest.approx(
        right.ppf([0.1, 0.9]), abs=0.05 * right.std()
    )
    assert posterior.log_marginal_likelihood == pytest.approx(
        special.betaln(10, 7) - special.betaln(2, 3), abs=0.01
    )
    with pytest.raises(ValueError, match='there is "normal"'):
        EP(families={"p": "beta"})
    with pytest.raises(UnsupportedError, match="no continuous node"):
        bmc.infer(net, {"y": y}, engine=EP(families={"q": "normal"}))


def test_families_of_their_own_are_exact_under_conjugate_factors() -> None:
    net, y, right = coin()
    posterior = bmc.infer(net, {"y": y}, engine=EP())
    assert posterior.mean("p") == pytest.approx(right.mean(), abs=1e-12)
    assert posterior.quantile("p", 0.9) == pytest.approx(right.ppf(0.9), abs=1e-9)
    wanted = special.betaln(10, 7) - special.betaln(2, 3)
    assert posterior.log_marginal_likelihood == pytest.approx(wanted, abs=1e-9)
    net = bmc.BayesNet(plates={"i": 4})
    net.add("rate", bmc.Gamma(2.0, 3.0))
    net.add("shares", bmc.Dirichlet(np.array([1.0, 2.0, 0.5])))
    net.add("count", lambda rate: bmc.Poisson(2.0 * rate), plates="i")
    net.add("wait", lambda rate: bmc.Exponential(rate))
    net.add("kind", lambda shares: bmc.Categorical(shares), plates="i")
    seen = {"count": [1, 0, 3, 2], "wait": 0.7, "kind": [0, 0, 2, 1]}
    posterior = bmc.infer(net, seen, engine=EP())
    assert posterior.mean("rate") == pytest.approx((2 + 6 + 1) / (3 + 8 + 0.7), abs=1e-10)
    assert posterior.mean("shares") == pytest.approx(np.array([3.0, 3.0, 1.5]) / 7.5, abs=1e-10)
    grid = np.linspace(1e-6, 12, 200_001)
    density = stats.gamma(2, scale=1 / 3).pdf(grid) * grid * np.exp(-0.7 * grid)
    density *= np.prod([stats.poisson.pmf(k, 2 * grid) for k in seen["count"]], axis=0)
    shares = special.gammaln([3, 3, 1.5]).sum() - special.gammaln(7.5)
    shares -= special.gammaln([1, 2, 0.5]).sum() - special.gammaln(3.5)
    wanted = np.log(integrate.simpson(density, x=grid)) + shares
    assert posterior.log_marginal_likelihood == pytest.approx(wanted, abs=1e-6)
    assert posterior.check(rng=0).k == -np.inf  # all weights are equal


def test_labels_switch_families_of_their_own() -> None:
    net = bmc.BayesNet(plates={"k": 3, "i": 12})
    net.add("rate", bmc.Gamma(np.array([1.0, 4.0, 20.0]), 1.0), plates="k")
    net.add("weights", bmc.Dirichlet(np.ones(3)))
    net.add("label", lambda weights: bmc.Categorical(weights), plates="i")
    net.add("y", lambda rate, label: bmc.Poisson(rate[label]), plates="i")
    rng = np.random.default_rng(4)
    y = rng.poisson(np.array([0.5, 5.0, 19.0])[np.arange(12) % 3])
    posterior = bmc.infer(net, {"y": y}, engine=EP())
    assert posterior.converged
    long = bmc.infer(net, {"y": y}, engine=bmc.Gibbs(draws=1500, warmup=300, chains=4), rng=0)
    for name in ("rate", "weights"):
        off = np.abs(posterior.mean(name) - long.mean(name)) / long.std(name)
        assert off.max() < 0.2
        assert posterior.std(name) == pytest.approx(long.std(name), rel=0.15)
    with pytest.warns(ConvergenceWarning, match="nothing was said of 'weights'"):
        one = bmc.infer(net, {"y": y}, engine=bmc.AssumedDensity())
    assert np.abs(one.mean("rate") - posterior.mean("rate")).max() > 1e-3
    back = pickle.loads(pickle.dumps(posterior))
    assert (back.mean("rate") == posterior.mean("rate")).all()


def test_shares_of_a_plate_do_not_sum_to_one() -> None:
    """The sum over a plate of Beta nodes is no constant; that over a vector's shares is."""
    net = bmc.BayesNet(plates={"k": 3})
    net.add("p", bmc.Beta(2.0, 2.0), plates="k")
    net.add("y", lambda p: bmc.Categorical(p.array / p.array.sum(axis=-1, keepdims=True)))
    posterior = bmc.infer(net, {"y": 0}, engine=EP())
    long = bmc.infer(net, {"y": 0}, engine=bmc.LikelihoodWeighting(20_000), rng=0)
    assert posterior.mean("p") == pytest.approx(long.mean("p"), abs=0.02)


def test_mean_and_scale_of_numbers() -> None:
    """A factor of two directions: Gaussian data with an unknown scale, against a fine grid.

    One Gaussian for each point's factor makes the scale's spread a tenth too small: that is EP's own bias.
    """
    rng = np.random.default_rng(8)
    net = bmc.BayesNet(plates={"i": 25})
    net.add("m", bmc.Normal(0.0, 5.0))
    net.add("s", bmc.HalfNormal(3.0))
    net.add("y", lambda m, s: bmc.Normal(m, s), plates="i")
    y = rng.normal(1.0, 2.0, 25)
    posterior = bmc.infer(net, {"y": y}, engine=EP())
    assert posterior.converged
    s = np.linspace(0.8, 6.0, 801)[:, None]
    m = np.linspace(-2.5, 4.5, 701)
    logs = stats.halfnorm.logpdf(s, scale=3.0) + stats.norm.logpdf(m, 0, 5)
    logs = logs - 25 * np.log(s) - 0.5 * ((y[:, None, None] - m) ** 2).sum(axis=0) / s**2
    weight = np.exp(logs - logs.max())
    weight /= weight.sum()
    mean_s, mean_m = (weight * s).sum(), (weight * m).sum()
    sd_s, sd_m = (np.sqrt((weight * (v - c) ** 2).sum()) for v, c in ((s, mean_s), (m, mean_m)))
    assert posterior.mean("s") == pytest.approx(mean_s, abs=0.05 * sd_s)
    assert posterior.mean("m") == pytest.approx(mean_m, abs=0.05 * sd_m)
    assert posterior.std("s") == pytest.approx(sd_s, rel=0.12)
    assert posterior.std("m") == pytest.approx(sd_m, rel=0.05)


# ---- answers, refusals, warnings ----------------------------------------------------------------


def test_unsettled_messages_warn_by_how_much(cases: list[dict[str, Any]]) -> None:
    case = cases[1]
    with pytest.warns(
        ConvergenceWarning, match=r"not settled after 2 sweeps: the last one changed a belief by"
    ):
        posterior = bmc.infer(clutter(20), {"x": case["x"]}, engine=EP(sweeps=2))
    assert not posterior.converged and posterior.change > 1e-5 and posterior.sweeps == 2


def test_answers_are_those_of_a_posterior(cases: list[dict[str, Any]]) -> None:
    net, case = clutter(20), cases[0]
    posterior = bmc.infer(net, {"x": case["x"]}, engine=EP(), rng=1)
    assert posterior.probabilities("is_clutter").shape == (20, 2)
    assert posterior.quantile("theta", 0.5) == pytest.approx(posterior.mean("theta"))
    above = posterior.probability(lambda theta: theta > 2.6)
    assert above == pytest.approx(
        stats.norm.sf(2.6, posterior.mean("theta"), posterior.std("theta")), abs=0.05
    )
    assert posterior.mcse(lambda theta: theta**2) > 0 and posterior.mcse("theta") == 0
    assert posterior.summary().columns["mean"].shape == (21,)
    assert posterior.predict("x", rng=0).mean("x").shape == (20,)
    back = pickle.loads(pickle.dumps(posterior))
    assert back.mean("theta") == posterior.mean("theta") and back.sweeps == posterior.sweeps
    assert copy.copy(posterior) is posterior
    found = posterior.check(rng=0)
    assert found.posterior.mean("theta") == pytest.approx(case["exact"][1], abs=0.05)


def refused(net: bmc.BayesNet, evidence: dict[str, Any]) -> str:
    reason = EP().unsupported(net, evidence)
    assert reason is not None
    with pytest.raises(UnsupportedError):
        bmc.infer(net, evidence, engine=EP())
    return reason


def test_refusals_name_the_node() -> None:
    counts = bmc.BayesNet()
    counts.add("n", bmc.Poisson(3.0))
    counts.add("y", lambda n: bmc.Normal(n, 1.0))
    assert "node 'n' is hidden and has infinitely many values" in refused(counts, {"y": 2.0})
    angle = bmc.BayesNet()
    angle.add("a", bmc.VonMises(0.0, 1.0))
    angle.add("y", lambda a: bmc.Normal(np.cos(a), 1.0))
    assert "node 'a' is an angle" in refused(angle, {"y": 0.2})
    branch = bmc.BayesNet()
    branch.add("x", bmc.Normal(0.0, 1.0))
    branch.add(
        "y", lambda x: bmc.Poisson(np.exp([float(v) for v in np.ravel(x)]).reshape(np.shape(x)))
    )
    assert "node 'y' depends on continuous nodes in a way that is not followed" in refused(
        branch, {"y": 2}
    )
    steps = bmc.BayesNet()
    steps.add("x", bmc.Normal(0.0, 1.0))
    steps.add("y", lambda x: bmc.Normal(np.floor(x), 1.0))
    assert "np.floor jumps" in refused(steps, {"y": 2.0})
    two = bmc.BayesNet()
    two.add("a", bmc.Normal(0.0, 1.0))
    two.add("b", bmc.Normal(0.0, 1.0))
    two.add("y", lambda a, b: bmc.Bernoulli((a > 0) & (b > 0)))
    assert "jumps or bends in several directions" in refused(two, {"y": 1})


def test_options_are_checked() -> None:
    for options in ({"sweeps": 0}, {"damping": 1.0}, {"tolerance": 0.0}):
        with pytest.raises(ValueError, match="ExpectationPropagation"):
            EP(**options)
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    with pytest.raises(UnsupportedError, match="nothing to go on with"):
        bmc.infer(net, {}, engine=EP(), resume=bmc.infer(net, {}, engine=EP()))


def test_switched_lines_have_their_own_directions() -> None:
    """A gather by a hidden label: every state is a line of its own, whatever else there is."""
    net = bmc.BayesNet(plates={"k": 4, "i": 24})
    net.add("level", bmc.Normal(np.array([-2.0, 0.0, 1.5, 3.0]), 0.5), plates="k")
    net.add("label", bmc.Categorical(np.full(4, 0.25)), plates="i")
    net.add("y", lambda level, label: bmc.Poisson(np.exp(level[label])), plates="i")
    rng = np.random.default_rng(2)
    y = rng.poisson(np.exp(np.array([-2.0, 0.2, 1.3, 3.1])[np.arange(24) % 4]))
    posterior = bmc.infer(net, {"y": y}, engine=EP())
    assert posterior.converged
    long = bmc.infer(net, {"y": y}, engine=bmc.Gibbs(draws=1500, warmup=300, chains=4), rng=0)
    off = np.abs(posterior.mean("level") - long.mean("level")) / long.std("level")
    assert off.max() < 0.2


# ---- nodes that are partly observed -------------------------------------------------------------


@pytest.mark.parametrize("engine", [EP(), bmc.AssumedDensity()])
def test_check_keeps_what_was_seen_of_finite_plates(engine: Any) -> None:
    """Means within five standard errors: false alarms below one in a million; states are exact."""
    net = bmc.BayesNet("labels, some seen", plates={"i": 4})
    net.add("m", bmc.Normal(0.0, 2.0))
    net.add("z", bmc.Bernoulli(0.5), plates="i")
    net.add("y", lambda m, z: bmc.Normal(m + 2.0 * z, 1.0), plates="i")
    evidence = {"y": [1.0, 1.2, 0.8, 1.1], "z": [0, 0, None, 0]}
    right = bmc.infer(net, evidence, engine=bmc.Exact())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the shape of tails
        check = bmc.infer(net, evidence, engine=engine).check(rng=0)
    found = check.posterior
    assert abs(found.mean("m") - right.mean("m")) < 5 * found.mcse("m")
    assert found.mean("z")[[0, 1, 3]].tolist() == [0.0, 0.0, 0.0]
    off = found.log_marginal_likelihood - right.log_marginal_likelihood
    assert abs(off) < 5 * found.log_marginal_likelihood_mcse < 0.1


def test_a_missing_outcome_changes_nothing_but_what_is_drawn_for_it() -> None:
    """What nobody observed and nobody reads drops out of the factors; expectations of it are drawn.

    Draws: within 0.1 of the exact mean, more than six standard errors of 4000.
    """

    def answers(outcome: Any, y: list[Any], **above: Any) -> Any:
        net = bmc.BayesNet(plates={"i": len(y)})
        ((name, prior),) = above.items()
        net.add(name, prior)
        net.add("y", outcome, parents=[name], plates="i")
        return bmc.infer(net, {"y": y}, engine=EP(tolerance=1e-9), rng=0)

    found = answers(lambda p: bmc.Bernoulli(p), [1, 0, None, 1, 1], p=bmc.Beta(2.0, 3.0))
    assert (found.mean("p"), found.var("p")) == pytest.approx((5 / 9, 20 / 810), abs=1e-9)
    log = special.betaln(5, 4) - special.betaln(2, 3)
    assert found.log_marginal_likelihood == pytest.approx(log, abs=1e-9)
    assert found.mean("y")[[0, 1, 3, 4]].tolist() == [1.0, 0.0, 1.0, 1.0]
    assert found.mean("y")[2] == pytest.approx(5 / 9, abs=0.1)
    w = np.linspace(-15.0, 15.0, 30001)
    for outcome, y, inverse, family in (
        (lambda w: bmc.Bernoulli(special.expit(w)), [1, 0, 1, 1], special.expit, stats.bernoulli),
        (lambda w: bmc.Poisson(np.exp(w)), [1, 0, 3, 2], np.exp, stats.poisson),
    ):
        whole = answers(outcome, y, w=bmc.Normal(0.0, 1.0))
        some = answers(outcome, [*y[:2], None, *y[2:]], w=bmc.Normal(0.0, 1.0))
        for one, two in zip(
            (whole.mean("w"), whole.var("w"), whole.log_marginal_likelihood),
            (some.mean("w"), some.var("w"), some.log_marginal_likelihood),
            strict=True,
        ):
            assert two == pytest.approx(one, abs=1e-6)
        logs = stats.norm.logpdf(w) + sum(family.logpmf(k, inverse(w)) for k in y)
        weight = np.exp(logs)
        evidence = np.log(weight.sum() * (w[1] - w[0]))
        weight /= weight.sum()
        assert some.mean("w") == pytest.approx((weight * w).sum(), abs=0.01)
        assert some.log_marginal_likelihood == pytest.approx(evidence, abs=0.02)
        ahead = (weight * inverse(w)).sum()
        assert some.mean("y")[2] == pytest.approx(ahead, abs=0.1)


# ---- vague priors -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("m", "s", "n"),
    [
        (bmc.Normal(0.0, 100.0), bmc.HalfNormal(5.0), 10),
        (bmc.Normal(0.0, 10.0), bmc.HalfNormal(3.0), 25),
        (bmc.Normal(0.0, 100.0), bmc.Uniform(0.0, 100.0), 25),
        (bmc.Normal(0.0, 1000.0), bmc.HalfNormal(100.0), 40),
    ],
)
def test_mean_and_scale_under_vague_priors(m: Any, s: Any, n: int) -> None:
    """The first lattices are far too coarse; messages must neither stop there nor overshoot."""
    y = np.random.default_rng(1).normal(2.0, 1.0, n)
    net = bmc.BayesNet(plates={"i": n})
    net.add("m", m)
    net.add("s", s)
    net.add("y", lambda m, s: bmc.Normal(m, s), plates="i")
    found = bmc.infer(net, {"y": y}, engine=EP())
    assert found.converged
    scale = np.exp(np.linspace(np.log(0.2), np.log(8.0), 601))[:, None]
    mean = np.linspace(-2.0, 6.0, 801)
    square = ((y - y.mean()) ** 2).sum() + n * (mean - y.mean()) ** 2
    logs = s.log_prob(scale) + m.log_prob(mean) - 0.5 * square / scale**2
    weight = np.exp(logs - logs.max() + (1 - n) * np.log(scale / scale.mean()))
    weight /= weight.sum()
    for name, at in (("m", mean), ("s", scale)):
        right = (weight * at).sum()
        spread = np.sqrt((weight * (at - right) ** 2).sum())
        assert found.mean(name) == pytest.approx(right, abs=0.08 * spread)
        assert found.std(name) == pytest.approx(spread, rel=0.21)  # EP's own bias, of few readings
    assert found.cov("s") == pytest.approx(found.var("s"), rel=1e-9)
    both = np.diag(found.cov("m", "s"))
    assert both == pytest.approx(np.array([found.var("m"), found.var("s")]), rel=1e-9)


@pytest.mark.parametrize("engine", [EP(), bmc.AssumedDensity()])
def test_factors_without_any_message_are_told(engine: Any) -> None:
    net = bmc.BayesNet(plates={"i": 3})
    for name in "abcd":
        net.add(name, bmc.Normal(0.0, 100.0))
    net.add("y", lambda a, b, c, d: bmc.Normal(a * b + c * d, 0.01), plates="i")
    told = (
        "no message could be made for 3 factors of node 'y'; answers are those of the prior there"
    )
    with pytest.warns(ConvergenceWarning, match=told):
        found = bmc.infer(net, {"y": [3.0, 4.0, 5.0]}, engine=engine)
    assert not found.converged and np.isnan(found.log_marginal_likelihood)


def test_covariances_are_those_of_the_beliefs() -> None:
    """Log-normal numbers that hang together, shares, a label: closed forms, and ``var`` on the diagonal."""
    net = bmc.BayesNet("kinds", plates={"i": 6})
    net.add("a", bmc.LogNormal(0.0, 0.5))
    net.add("b", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a, b: bmc.Normal(np.log(a) + b, 0.5), plates="i")
    net.add("p", bmc.Dirichlet(np.array([1.0, 2.0, 3.0])))
    net.add("k", lambda p: bmc.Categorical(p), plates="i")
    net.add("z", bmc.Bernoulli(0.3))
    net.add("w", lambda z: bmc.Normal(1.0 * z, 1.0))
    rows = {"y": [0.5, 0.2, 0.7, 0.1, 0.4, 0.6], "k": [0, 1, 2, 2, 1, 2], "w": 0.8}
    found = bmc.infer(net, rows, engine=EP(), rng=0)
    names = ["a", "b", "p", "z"]
    whole = found.cov(*names)
    var = np.concatenate([np.atleast_1d(found.var(n)) for n in names])
    assert np.diag(whole) == pytest.approx(var, rel=1e-9)
    for name in names:
        assert np.diag(np.atleast_2d(found.cov(name))) == pytest.approx(
            np.atleast_1d(found.var(name)), rel=1e-9
        )
    precision = np.array(
        [[4.0 + 24.0, 24.0], [24.0, 1.0 + 24.0]]
    )  # of log a and b: linear-Gaussian
    free = np.linalg.inv(precision)
    assert whole[0, 1] == pytest.approx(found.mean("a") * free[0, 1], rel=1e-4)
    alpha = np.array([2.0, 4.0, 6.0])
    share = alpha / 12.0
    assert whole[2:5, 2:5] == pytest.approx((np.diag(share) - np.outer(share, share)) / 13.0)
    assert not whole[:2, 2:].any() and not whole[2:5, 5:].any()
