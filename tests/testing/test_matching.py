"""The statistical match: its false-alarm rate, its power, and what it says."""

from __future__ import annotations

import copy
import warnings

import numpy as np
import pytest
import scipy.stats

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning, ShapeError, UnknownNodeError, UnsupportedError
from bayesmc.results.draws import DrawsPosterior
from bayesmc.testing import (
    assert_matches,
    compare,
    enumerate_posterior,
    exact,
    quadrature_posterior,
    repeated_test,
)
from bayesmc.testing.posteriors.samples import Average
from bayesmc.testing.verdict import BUDGET


def diagnosis() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"test": 3})
    net.add("ill", bmc.Categorical([0.7, 0.2, 0.1]), states=("no", "mild", "severe"))
    net.add("positive", lambda ill: bmc.Bernoulli(0.1 + 0.4 * ill), plates="test")
    net.add("fever", lambda ill: bmc.Normal(37.0 + ill, 0.7))
    return net


EVIDENCE = {"positive": np.ma.MaskedArray([1, 0, 1], mask=[False, True, False])}


class Shifted:
    """An answer with one figure moved."""

    def __init__(self, right, **moved) -> None:
        self._right, self._moved = right, moved

    def __getattr__(self, key):
        return self._moved.get(key, getattr(self._right, key))


def weighted(seed: int, draws: int = 4000, **options):
    engine = bmc.LikelihoodWeighting(draws)
    return bmc.infer(diagnosis(), EVIDENCE, engine=engine, rng=seed, **options)


def test_false_alarms_are_as_rare_as_stated() -> None:
    """At alpha = 0.05, at most 0.05 of right answers are rejected.

    80 answers: more than 11 rejections (true rate 0.05) have probability 1e-3; the figures depend on
    each other and Holm is conservative, so fewer are expected, but not none at alpha = 0.5.
    """
    exact = enumerate_posterior(diagnosis(), EVIDENCE)
    answers = [weighted(seed, draws=3000) for seed in range(80)]
    matches = [compare(answer, exact, alpha=0.05) for answer in answers]
    assert sum(bool(m.rejected) for m in matches) <= scipy.stats.binom.ppf(0.999, 80, 0.05)
    loose = [compare(answer, exact, alpha=0.5) for answer in answers[:30]]
    assert any(m.rejected for m in loose)


@pytest.mark.parametrize("keep", ["draws", "summaries"])
def test_a_right_answer_passes_and_says_how_much_was_compared(keep: str) -> None:
    match = assert_matches(weighted(0, keep=keep), enumerate_posterior(diagnosis(), EVIDENCE))
    # evidence, 3 states of ill, 3 x 2 of positive, mean and variance of fever, whose error only draws
    # tell; none is too rare
    assert len(match.comparisons) == 1 + 3 + 6 + (2 if keep == "draws" else 1)
    assert match.skipped == 0
    assert match.worst is not None
    assert not match.rejected


def test_small_faults_are_caught() -> None:
    """Power: with 40,000 draws (ESS 9,000) a probability off by 0.05, a mean off by 0.1 and log
    evidence off by 0.2 are five standard errors away, or more."""
    right = weighted(0, draws=40_000)
    exact = enumerate_posterior(diagnosis(), EVIDENCE)
    wrong = right.probabilities("ill") + [0.05, -0.05, 0.0]
    faults = [
        {"probabilities": lambda n: wrong if n == "ill" else right.probabilities(n)},
        {"mean": lambda n: right.mean(n) + 0.1},
        {"log_marginal_likelihood": right.log_marginal_likelihood + 0.2},
    ]
    named = ["node 'ill', state", "mean of node 'fever'", "log evidence"]
    for fault, name in zip(faults, named, strict=True):
        with pytest.raises(AssertionError, match=name):
            assert_matches(Shifted(right, **fault), exact)


def test_the_message_says_what_differs_by_how_much() -> None:
    right = weighted(0)
    wrong = right.probabilities("positive")[:, ::-1]
    bad = Shifted(
        right, probabilities=lambda n: wrong if n == "positive" else right.probabilities(n)
    )
    with pytest.raises(AssertionError) as caught:
        assert_matches(bad, enumerate_posterior(diagnosis(), EVIDENCE), alpha=0.01)
    text = str(caught.value)
    for part in ("figures deviate", "false-alarm rate 0.01", "node 'positive'[0], state 0", "exact",
                 "standard errors", "p = "):  # fmt: skip
        assert part in text


def test_weight_on_impossible_states_is_caught() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical([0.5, 0.5, 0.0]))
    right = bmc.infer(net, engine=bmc.LikelihoodWeighting(1000), rng=0)
    exact = enumerate_posterior(net)
    assert_matches(right, exact)
    leak = right.probabilities("a") + [-1e-4, 0, 1e-4]  # far below the Monte Carlo error
    with pytest.raises(AssertionError, match="state 2"):
        assert_matches(Shifted(right, probabilities=lambda n: leak), exact)


def test_rare_states_are_not_judged() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical([0.9995, 0.0005]))
    right = bmc.infer(net, engine=bmc.LikelihoodWeighting(1000), rng=0)
    exact = enumerate_posterior(net)
    match = compare(right, exact)
    assert (len(match.comparisons), match.skipped) == (1, 2)  # log evidence alone is compared
    with pytest.raises(AssertionError, match="nothing was judged: 2 figures.*take more draws"):
        assert_matches(right, exact)
    assert assert_matches(right, exact, min_count=0.1).skipped == 0


def test_exact_answers_must_agree_to_the_tolerance() -> None:
    net = diagnosis()
    evidence = {"positive": [1, 0, 1], "fever": 38.0}
    exact = enumerate_posterior(net, evidence)
    right = bmc.infer(net, evidence, engine=bmc.Exact())
    # what is observed is compared only where it is asked for
    assert len(assert_matches(right, exact).comparisons) == 1 + 3
    asked = assert_matches(right, exact, names=["ill", "positive", "fever"])
    assert len(asked.comparisons) == 1 + 3 + 6 + 2
    off = right.probabilities("ill") + [1e-7, -1e-7, 0.0]
    bad = Shifted(right, probabilities=lambda n: off if n == "ill" else right.probabilities(n))
    with pytest.raises(AssertionError, match="node 'ill', state 'no'"):
        assert_matches(bad, exact)
    assert_matches(bad, exact, rtol=1e-6)
    bad = Shifted(right, log_marginal_likelihood=right.log_marginal_likelihood + 1e-6)
    with pytest.raises(AssertionError, match="log evidence"):
        assert_matches(bad, exact)


def test_nan_never_matches() -> None:
    right = weighted(0)
    exact = enumerate_posterior(diagnosis(), EVIDENCE)
    for fault in (
        {"mean": lambda n: right.mean(n) * np.nan},
        {"probabilities": lambda n: right.probabilities(n) * np.nan},
        {"log_marginal_likelihood": np.nan},
    ):
        with pytest.raises(AssertionError):
            assert_matches(Shifted(right, **fault), exact)


def test_shapes_must_agree() -> None:
    right = weighted(0)
    exact = enumerate_posterior(diagnosis(), EVIDENCE)
    bad = Shifted(right, probabilities=lambda n: right.probabilities(n)[..., :1])
    with pytest.raises(AssertionError, match="shape"):
        assert_matches(bad, exact)


def test_too_few_effective_draws_are_not_judged() -> None:
    exact = enumerate_posterior(diagnosis(), EVIDENCE)
    with pytest.warns(bmc.errors.LowEssWarning):
        few = weighted(0, draws=60)
    match = compare(few, exact)
    assert match.skipped >= 5


# ---- variances, quantiles, covariances, angles --------------------------------------------------


def chain_of_two() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"i": 2})
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("v", lambda x: bmc.MvNormal(bmc.stack([x, -x]), np.eye(2)))
    net.add("w", lambda x: bmc.Normal(x, 0.5), plates="i")
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    return net


def answers(**options) -> tuple:
    engine = bmc.LikelihoodWeighting(20_000)
    found = bmc.infer(chain_of_two(), {"y": 1.0}, engine=engine, rng=0, **options)
    return found, bmc.infer(chain_of_two(), {"y": 1.0}, engine=bmc.Exact())


def moved(posterior, method: str, name: str, off):
    """The same answer with one figure of one node moved."""
    right = getattr(posterior, method)
    wrong = copy.copy(posterior)
    setattr(wrong, method, lambda *n: right(*n) + off if n == (name,) else right(*n))
    return wrong


def test_every_figure_of_numbers_is_compared() -> None:
    found, exact = answers()
    match = assert_matches(found, exact)
    figures = {c.what for c in match.comparisons}
    assert {"mean of node 'v'[1]", "variance of node 'w'[0]", "covariance of node 'v'[0] and [1]",
            "covariance of node 'w'[0] and [1]",
            "share of draws up to the 95% quantile of node 'x'"} <= figures  # fmt: skip
    assert match.skipped == 0
    # two exact answers, and draws against draws' exact source
    assert assert_matches(exact, exact).worst.p_value == 1.0
    few = {c.what for c in compare(*answers(keep="summaries")).comparisons}
    assert "mean of node 'x'" in few
    assert not any("quantile" in what or "variance of node 'x'" in what for what in few)
    assert not any("quantile" in c.what for c in compare(found, exact, quantiles=()).comparisons)


@pytest.mark.parametrize(
    ("method", "name", "off", "words"),
    [
        ("var", "x", 0.05, "variance of node 'x'"),
        ("var", "w", np.array([0.0, 0.08]), "variance of node 'w'[1]"),
        ("cov", "v", 0.1 * (1 - np.eye(2)), "covariance of node 'v'[0] and [1]"),
    ],
)
def test_wrong_squares_are_named(method: str, name: str, off, words: str) -> None:
    found, exact = answers()
    match = compare(moved(found, method, name, off), exact)
    assert [c.what for c in match.rejected] == [words]


def test_a_wrong_shape_with_right_moments_shows_in_quantiles() -> None:
    """A uniform law of the right mean and variance: mean and variance pass, quantiles do not."""
    right, wrong = bmc.BayesNet(), bmc.BayesNet()
    right.add("x", bmc.Normal(0.0, 1.0))
    wrong.add("x", bmc.Uniform(-np.sqrt(3.0), np.sqrt(3.0)))
    exact = bmc.infer(right, engine=bmc.Exact())
    match = compare(bmc.infer(wrong, engine=bmc.LikelihoodWeighting(20_000), rng=1), exact)
    assert match.rejected and all("quantile" in c.what for c in match.rejected)


def test_chains_are_judged_by_their_effective_size() -> None:
    exact = answers()[1]
    engine = bmc.MetropolisHastings(250, warmup=150, chains=8)
    chains = bmc.infer(chain_of_two(), {"y": 1.0}, engine=engine, rng=1)
    assert_matches(chains, exact, names=["x"], draws=200, rng=0)
    with pytest.raises(AssertionError, match="quantile of node 'x'"):
        prior = bmc.infer(chain_of_two(), {"y": 0.0}, engine=engine, rng=1)
        assert_matches(prior, exact, names=["x"])


class Heavy:
    """A Cauchy law, whose figures are known."""

    names = ("x",)
    log_marginal_likelihood = None

    def mean(self, name: str) -> np.ndarray:
        return np.array(np.nan)

    def var(self, name: str) -> np.ndarray:
        return np.array(np.inf)

    def quantile(self, name: str, q) -> np.ndarray:
        return scipy.stats.cauchy.ppf(q)


def test_without_moments_quantiles_decide() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.StudentT(1.0, 0.0, 1.0))
    engine = bmc.LikelihoodWeighting(20_000)
    match = assert_matches(bmc.infer(net, engine=engine, rng=0), Heavy())
    assert len(match.comparisons) == 5 and match.skipped == 1
    net.add("x", bmc.StudentT(1.0, 0.1, 1.0), replace=True)
    assert not compare(bmc.infer(net, engine=engine, rng=0), Heavy())


def test_angles_are_compared_across_the_seam() -> None:
    net = bmc.BayesNet()
    net.add("t", bmc.VonMises(np.pi, 3.0))
    net.add("y", lambda t: bmc.Normal(np.sin(t), 0.5))
    engine = bmc.LikelihoodWeighting(20_000)
    exact = enumerate_posterior(net, {"y": 0.1}, points=64)
    found = bmc.infer(net, {"y": 0.1}, engine=engine, rng=0)
    match = assert_matches(found, exact)
    assert {"mean cosine of node 't'", "mean sine of node 't'"} <= {
        c.what for c in match.comparisons
    }
    assert not compare(bmc.infer(net, {"y": 0.6}, engine=engine, rng=0), exact)


# ---- joint draws --------------------------------------------------------------------------------


class Uncoupled(DrawsPosterior):
    """Every node's draws shuffled by themselves: right marginals, wrong coupling."""

    def __init__(self, right: DrawsPosterior) -> None:
        rng = np.random.default_rng(0)
        stored = {
            n: right._stored[n][:, rng.permutation(right._shape[1])]
            if right._stored[n].shape[1] > 1
            else right._stored[n]
            for n in right.names
        }
        super().__init__(right.problem, right.engine, stored, right._shape, independent=True)


def test_averages_of_equal_draws_have_no_error() -> None:
    """Whatever their weights: the mean of equal numbers is off by a rounding error."""
    weights = np.random.default_rng(0).dirichlet(np.ones(1000))[None]
    equal = np.full((1, 1000), 0.1)
    for average in (Average.of(equal), Average.weighted(equal, weights)):
        assert (average.value, average.error, average.support) == (0.1, 0.0, 0.0)


def test_wrong_coupling_shows_in_joint_draws_only() -> None:
    right = answers()[1].resample(2000, rng=0)
    exact = answers()[1]
    assert assert_matches(right, exact, draws=300, rng=1)
    wrong = Uncoupled(right)
    assert compare(wrong, exact, names=["x", "y"])
    match = compare(wrong, exact, names=["x", "w"], draws=600, rng=1)
    assert "joint draws of 'x', 'w' (energy distance)" in {c.what for c in match.rejected}


def test_joint_draws_of_weighted_and_finite_answers() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.4))
    net.add("b", lambda a: bmc.Bernoulli(0.2 + 0.6 * a))
    net.add("c", lambda a, b: bmc.Bernoulli(0.3 + 0.2 * a + 0.2 * b))
    found = bmc.infer(net, {"c": 1}, engine=bmc.LikelihoodWeighting(4000), rng=0)
    exact = enumerate_posterior(net, {"c": 1})
    assert assert_matches(found, exact, draws=300, rng=0)
    assert not compare(Uncoupled(found.resample(4000, rng=0)), exact, draws=500, rng=0)


def test_what_has_no_draws_says_so() -> None:
    found, exact = answers(keep="summaries")
    assert "holds none" in repr(compare(found, exact, draws=100))
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    drawn = bmc.infer(net, engine=bmc.LikelihoodWeighting(1000), rng=0)
    with pytest.raises(UnsupportedError, match="has no draws to compare with"):
        compare(drawn, enumerate_posterior(net), draws=100)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"quantiles": (0.0,)}, "strictly between 0 and 1"),
        ({"alpha": 1.0}, "strictly between 0 and 1"),
        ({"names": "x"}, "sequence of names"),
        ({"names": []}, None),
        ({"draws": 3}, "30 or more"),
        ({"quantiles": 0.5}, "a sequence of levels"),
        ({"quantiles": ["a"]}, "a sequence of levels"),
        ({"rtol": 1j}, "rtol=1j"),
        ({"rtol": -1.0}, "rtol=-1.0.: give a finite number, 0 or more"),
        ({"rtol": np.nan}, "rtol=nan"),
        ({"rtol": "a"}, "rtol='a'"),
        ({"min_count": -1}, "min_count=-1"),
    ],
)
def test_wrong_options_are_named(options: dict, words: str | None) -> None:
    found, exact = answers()
    if words is None:
        assert len(compare(found, exact, **options).comparisons) == 1  # log evidence
        return
    with pytest.raises(ValueError, match=words):
        compare(found, exact, **options)


def test_unknown_options_are_named() -> None:
    with pytest.raises(TypeError, match="no option 'draw'; there are alpha, draws"):
        assert_matches(*answers(), draw=3)


def test_a_call_is_counted_once() -> None:
    found, exact = answers()
    before = BUDGET.calls.get("compare", 0), BUDGET.calls.get("assert_matches", 0)
    compare(found, exact)
    assert_matches(found, exact, draws=50, rng=0)
    after = BUDGET.calls["compare"], BUDGET.calls["assert_matches"]
    assert (after[0] - before[0], after[1] - before[1]) == (1, 1)


def test_variances_are_averages_about_the_exact_mean() -> None:
    """Of weighted draws, whose plain mean is another; and where all squares are equal, with no error."""
    found, exact = answers()
    x, w = found["x"], found.weights
    squares = (x - exact.mean("x")) ** 2
    error = np.sqrt((w**2 * (squares - (w * squares).sum()) ** 2).sum())
    shown = {c.what: c for c in compare(found, exact).comparisons}["variance of node 'x'"]
    off = (w * squares).sum() - exact.var("x")
    assert abs(shown.errors - abs(off) / error) < 1e-4  # the tolerance is part of it
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.add("b", lambda a: a / 7.0)
    coin = bmc.infer(net, engine=bmc.LikelihoodWeighting(3000), rng=0)
    assert assert_matches(coin, enumerate_posterior(net))


def test_quantiles_that_are_none_of_the_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draws may be right, and what is answered of them not: here the weights are forgotten."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    right = quadrature_posterior(net, {"y": 2.0})
    found = bmc.infer(net, {"y": 2.0}, engine=bmc.LikelihoodWeighting(3000), rng=0)
    assert compare(found, right)
    flat = np.asarray(found["x"])
    monkeypatch.setattr(type(found), "quantile", lambda self, name, q: np.quantile(flat, q))
    wrong = compare(found, right)
    assert not wrong
    assert all("as answered, which is none of the draws" in c.what for c in wrong.rejected)


# ---- what must not pass in silence --------------------------------------------------------------


def test_rare_states_that_are_far_too_frequent_are_caught() -> None:
    rare, often = bmc.BayesNet(), bmc.BayesNet()
    rare.add("a", bmc.Bernoulli(0.001))
    often.add("a", bmc.Bernoulli(0.508))
    found = bmc.infer(often, engine=bmc.LikelihoodWeighting(1000), rng=0)
    match = compare(found, enumerate_posterior(rare))
    assert not match
    assert {c.what for c in match.rejected} == {"node 'a', state 0", "node 'a', state 1"}


def test_looking_at_rare_states_costs_no_false_alarms() -> None:
    """200 states, each expected five times: some are met ten times, and are judged for that.

    More than 14 alarms of 100 right answers have probability 1e-4 at alpha = 0.05; without the price of
    looking nearly half of them would be one.
    """
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical(np.full(200, 1 / 200)))
    exact = enumerate_posterior(net)
    rng = np.random.default_rng(5)
    alarms = judged = 0
    for _ in range(100):
        match = compare({"a": rng.integers(200, size=1000)}, exact, alpha=0.05)
        alarms += not match
        judged += len(match.comparisons) > 0
    assert judged > 60
    assert alarms <= 14  # more have probability 1e-4


def own(seed: int, rho: float = 0.0, draws: int = 4000) -> dict:
    """Draws of x and w given y = 1 by autoregression; ``rho`` of each on the one before."""
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(draws, 3))
    for t in range(1, draws):
        z[t] = rho * z[t - 1] + np.sqrt(1 - rho**2) * z[t]
    x = 0.5 + np.sqrt(0.5) * z[:, 0]
    return {"x": x, "w": x[:, None] + 0.5 * z[:, 1:]}


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_draws_of_ones_own(rho: float) -> None:
    exact = answers()[1]
    match = assert_matches(own(0, rho), exact, draws=200, rng=0)
    figures = {c.what for c in match.comparisons}
    assert {"mean of node 'x'", "variance of node 'w'[1]", "joint draws of 'x', 'w' (energy distance)",
            "share of draws up to the 95% quantile of node 'x'"} <= figures  # fmt: skip
    off = own(0, rho)
    with pytest.raises(AssertionError, match="mean of node 'x'.*\n(.*\n)*.*draws of your own"):
        assert_matches({**off, "x": off["x"] + 0.3}, exact)
    shuffled = np.random.default_rng(1).permutation(off["x"])
    assert not compare({**off, "x": shuffled}, exact, 0.05, draws=400, rng=0)


def test_states_of_ones_own_draws() -> None:
    net = diagnosis()
    exact = enumerate_posterior(net, {"positive": [1, 0, 1], "fever": 38.0})
    states, p = np.array(["no", "mild", "severe"]), exact.probabilities("ill")
    rng = np.random.default_rng(0)
    assert len(assert_matches({"ill": rng.choice(states, size=2000, p=p)}, exact).comparisons) == 3
    assert not compare({"ill": rng.choice(states, size=2000, p=p[::-1])}, exact)


def test_what_was_asked_for_and_not_compared_is_no_match() -> None:
    found, exact = answers(keep="summaries")
    with pytest.raises(AssertionError, match=r"draws=100\): joint draws are not compared: .* none"):
        assert_matches(found, exact, draws=100)


def test_wrong_arguments_are_named() -> None:
    found, exact = answers()
    oracle = enumerate_posterior(diagnosis(), EVIDENCE)
    with pytest.raises(TypeError, match=r"stands first; swap the two: compare\(posterior, exact\)"):
        compare(oracle, weighted(0))
    with pytest.raises(TypeError, match="assert_matches: posterior=3 is no posterior; give one of"):
        assert_matches(3, exact)
    with pytest.raises(TypeError, match="compare: exact=3 is no answer; give one"):
        compare(found, 3)
    with pytest.raises(
        UnknownNodeError, match="compare: the exact answer has a node 'ill'.*same net"
    ):
        compare(found, oracle)
    with pytest.raises(
        UnknownNodeError, match=r"names=\['q'\]\): 'q' is no node .* name some of x, "
    ):
        compare(found, exact, names=["q"])
    with pytest.raises(UnknownNodeError, match="the draws have 'q'.*it has x, v, w, y"):
        compare({"q": np.zeros(10)}, exact)
    with pytest.raises(ShapeError, match=r"draws of 'w' have shape \(10,\); give \('draws', 2\)"):
        compare({"w": np.zeros(10)}, exact)
    with pytest.raises(ShapeError, match="give one number for all"):
        compare({"x": np.zeros(10), "w": np.zeros((9, 2))}, exact)
    with pytest.raises(TypeError, match="need an exact answer with a model.*not Heavy"):
        compare({"x": np.zeros(10)}, Heavy())


@pytest.mark.parametrize("size", [1e3, 1e120, 1e200])
def test_means_of_huge_numbers_are_judged(size: float) -> None:
    """Squares of such numbers overflow; a mean off by its own size must not pass for that."""

    def estimate(rng: np.random.Generator) -> float:
        return size * (1.0 + 0.1 * rng.normal())

    assert repeated_test(estimate, size, rng=0)
    assert not repeated_test(estimate, 2 * size, rng=0)
    assert not repeated_test(estimate, 0.0, rng=0)


# ---- beliefs over time --------------------------------------------------------------------------


def level() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("m", bmc.Normal(0.0, 2.0))
    dbn.add("x", lambda x_prev, m: bmc.Normal(0.5 * x_prev + m, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


LEVEL = {"m": 1.3, "y": [0.3, np.nan, 1.1]}


def test_smoothed_and_filtered_beliefs() -> None:
    right, other = exact(level(), LEVEL), exact(level(), {**LEVEL, "y": [0.3, np.nan, 1.2]})
    assert right.log_static == pytest.approx(float(bmc.Normal(0.0, 2.0).log_prob(1.3)))
    smoothed, filtered = bmc.smooth(level(), LEVEL), bmc.filter(level(), LEVEL)
    assert assert_matches(smoothed, right).of_nodes >= 8
    last = assert_matches(filtered, right)
    assert any("'x[2]'" in c.what for c in last.comparisons)
    assert not any("'x[1]'" in c.what for c in last.comparisons)
    for answer in (smoothed, filtered):
        found = [c.what for c in compare(answer, other).rejected]
        assert "log evidence" in found and "mean of node 'x[2]'" in found
    # an answer that does not say what static nodes contribute leaves the evidence out
    engine = bmc.infer(level(), LEVEL, engine=bmc.Exact())
    plain = exact(level().unroll(3), level().unrolled_evidence(LEVEL))
    for without in (engine, plain):
        match = assert_matches(smoothed, without)
        assert not any("evidence" in c.what for c in match.comparisons)
    # what is data is not compared
    assert not any("'y[0]'" in c.what for c in assert_matches(smoothed, engine).comparisons)


def turning() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    turn = np.array([[0.8, -0.4], [0.4, 0.8]])
    start = bmc.MvNormal([0.0, 0.0], [[1.0, 0.6], [0.6, 2.0]])
    dbn.add("x", lambda x_prev: bmc.MvNormal(x_prev @ turn.T, np.eye(2)), initial=start)
    dbn.add("y", lambda x: bmc.Normal(x[..., 0], 1.0))
    return dbn


def test_covariances_of_beliefs() -> None:
    rows = {"y": [0.5, -0.2]}
    right = exact(turning(), rows)
    smoothed = bmc.smooth(turning(), rows)
    match = assert_matches(smoothed, right)
    assert sum(c.what.startswith("covariance") for c in match.comparisons) == 2
    other = bmc.smooth(turning(), rows)
    other.cov = lambda name: -smoothed.cov(name)
    found = compare(other, right).rejected
    assert found and all(c.what.startswith("covariance") for c in found)


def test_beliefs_that_cannot_be_judged() -> None:
    right = exact(level(), LEVEL)
    particles = bmc.filter(level(), LEVEL, engine=bmc.ParticleFilter(2000), rng=0)
    with pytest.raises(UnsupportedError, match="repeated_test"):
        compare(particles, right)
    with pytest.raises(UnsupportedError, match="given none of the rows"):
        compare(bmc.forecast(level(), LEVEL, steps=1), right)
    short = bmc.smooth(level(), {"m": 1.3, "y": [0.3, 0.1]})
    for longer in (right, bmc.infer(level(), LEVEL, engine=bmc.Exact())):
        with pytest.raises(ShapeError, match="about 2 slices, the exact answer about 3"):
            compare(short, longer)
    with pytest.raises(UnknownNodeError, match="only one of the two knows a node"):
        compare(bmc.smooth(turning(), {"y": [0.1, np.nan, 0.2]}), right)
    filtered = bmc.filter(level(), LEVEL)
    with pytest.raises(UnknownNodeError, match="last slice alone"):
        compare(filtered, right, names=["x[0]"])
    with pytest.raises(TypeError, match="it stands first"):
        compare(right, filtered)
    with pytest.raises(TypeError, match="is what an engine believes"):
        compare(filtered, filtered)


def test_chains_that_hardly_reach_a_tail_raise_no_alarm() -> None:
    """Forty chains that stay long where they are: the share beyond a tail seems better known than it is."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 0.7), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.6))
    rows = {"y": [0.0, 2.0, 4.0]}
    right, engine = (
        exact(dbn, rows),
        bmc.ParticleGibbs(draws=100, warmup=20, chains=40, particles=4),
    )
    for seed in (2011774679, 2011774724):  # alarmed at p = 3e-14 and 1e-8
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            found = bmc.infer(dbn, rows, engine=engine, rng=np.random.default_rng(seed))
        assert not compare(found, right, 1e-6).rejected
