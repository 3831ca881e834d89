"""``LikelihoodWeighting`` as an engine: seeds, memory, resuming, warnings, evidence and its errors."""

from __future__ import annotations

import math
import tracemalloc
import warnings

import numpy as np
import pytest
import scipy.stats

import bayesmc as bmc
from bayesmc.errors import (
    EvidenceError,
    LowEssWarning,
    ParameterError,
    UnknownNodeError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.testing import assert_matches, enumerate_posterior


def weighting(draws: int = 20_000) -> bmc.LikelihoodWeighting:
    return bmc.LikelihoodWeighting(draws)


def mixture() -> bmc.BayesNet:
    net = bmc.BayesNet("mixture", plates={"i": 4})
    net.add("mean", bmc.Normal(0.0, 2.0))
    net.add("label", bmc.Bernoulli(0.4), plates="i")
    net.add("x", lambda label, mean: bmc.Normal(mean + 2.0 * label, 1.0), plates="i")
    return net


DATA = {"x": [0.2, 1.9, np.nan, 0.7]}


# ---- seeds --------------------------------------------------------------------------------------


@pytest.mark.parametrize("keep", ["draws", "summaries"])
def test_the_same_seed_gives_the_same_answer(keep: str) -> None:
    answers = [
        bmc.infer(mixture(), DATA, engine=weighting(5000), rng=s, keep=keep) for s in (7, 7, 8)
    ]
    means = [a.mean("label") for a in answers]
    np.testing.assert_array_equal(means[0], means[1])
    assert not np.array_equal(means[0], means[2])


def test_seeds_of_every_kind() -> None:
    sequence = np.random.SeedSequence(5)
    first = bmc.infer(mixture(), DATA, engine=weighting(2000), rng=sequence)["mean"]
    again = bmc.infer(mixture(), DATA, engine=weighting(2000), rng=sequence)["mean"]
    np.testing.assert_array_equal(first, again)
    assert sequence.n_children_spawned == 0  # nothing a user passes is changed
    generator = np.random.default_rng(5)
    one = bmc.infer(mixture(), DATA, engine=weighting(2000), rng=generator)["mean"]
    two = bmc.infer(mixture(), DATA, engine=weighting(2000), rng=generator)["mean"]
    assert not np.array_equal(one, two)  # a generator goes on
    renewed = bmc.infer(mixture(), DATA, engine=weighting(2000), rng=np.random.default_rng(5))[
        "mean"
    ]
    np.testing.assert_array_equal(one, renewed)


def test_what_is_asked_of_does_not_change() -> None:
    data = np.array([0.2, 1.9, np.nan, 0.7])
    before = data.copy()
    net = mixture()
    posterior = bmc.infer(net, {"x": data}, engine=weighting(2000), rng=0)
    np.testing.assert_array_equal(data, before)
    mean = posterior.mean("mean")
    data[:] = 100.0
    net.add("mean", bmc.Normal(50.0, 1.0), replace=True)
    np.testing.assert_array_equal(posterior.mean("mean"), mean)


# ---- what is kept -------------------------------------------------------------------------------


def test_memory_of_summaries_does_not_grow_with_draws() -> None:
    net = mixture()

    def peak(draws: int, keep: str) -> int:
        bmc.infer(net, DATA, engine=weighting(1000), rng=0, keep=keep)  # compiled before
        tracemalloc.start()
        bmc.infer(net, DATA, engine=weighting(draws), rng=0, keep=keep)
        used = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return used

    small, large = peak(50_000, "summaries"), peak(500_000, "summaries")
    assert large < 1.5 * small
    assert peak(500_000, "draws") > 3 * large


def test_only_listed_nodes_are_kept() -> None:
    posterior = bmc.infer(mixture(), DATA, engine=weighting(2000), rng=0, keep=["mean"])
    whole = bmc.infer(mixture(), DATA, engine=weighting(2000), rng=0)
    np.testing.assert_array_equal(posterior["mean"], whole["mean"])
    assert posterior.mean("mean") == whole.mean("mean")
    with pytest.raises(UnsupportedError, match="'label' was not kept"):
        posterior.mean("label")
    with pytest.raises(UnknownNodeError, match="'zz'"):
        bmc.infer(mixture(), DATA, engine=weighting(10), keep=["zz"])
    with pytest.raises(ValueError, match="keep='all'"):
        bmc.infer(mixture(), DATA, engine=weighting(10), keep="all")


def test_resume_continues_the_draws() -> None:
    net = mixture()
    first = bmc.infer(net, DATA, engine=weighting(20_000), rng=0)
    both = bmc.infer(net, DATA, engine=weighting(40_000), rng=0, resume=first)
    assert both["mean"].shape == (1, 60_000)
    np.testing.assert_array_equal(both["mean"][:, :20_000], first["mean"])
    fresh = both["mean"][0, 20_000:]
    assert not np.isin(fresh, first["mean"]).any()  # the same seed, but other streams
    assert both.weight_ess > 2 * first.weight_ess
    assert_matches(both, enumerate_posterior(net, DATA))


@pytest.mark.parametrize(
    "other",
    [{"x": [0.2, 1.9, np.nan, 0.8]}, {}, {**DATA, "label": [0, 0, 1, 1]}],
    ids=["other value", "no evidence", "more evidence"],
)
def test_resume_of_another_question_is_refused(other: dict) -> None:
    first = bmc.infer(mixture(), DATA, engine=weighting(2000), rng=0)
    with pytest.raises(UnsupportedError, match="resume"):
        bmc.infer(mixture(), other, engine=weighting(2000), rng=0, resume=first)


def test_resume_of_other_draws_is_refused() -> None:
    first = bmc.infer(mixture(), DATA, engine=weighting(2000), rng=0)
    equal = first.resample(2000, rng=0)  # its weights are gone
    with pytest.raises(UnsupportedError, match="resume"):
        bmc.infer(mixture(), DATA, engine=weighting(2000), rng=0, resume=equal)
    sums = bmc.infer(mixture(), DATA, engine=weighting(2000), rng=0, keep="summaries")
    with pytest.raises(UnsupportedError, match="resume"):
        bmc.infer(mixture(), DATA, engine=weighting(2000), rng=0, resume=sums)


# ---- evidence -----------------------------------------------------------------------------------


def test_partly_observed_plates() -> None:
    """Draws of the missing element, constants elsewhere; the answer matches (false alarms: 1e-3)."""
    posterior = bmc.infer(mixture(), DATA, engine=weighting(40_000), rng=1)
    draws = posterior["x"]
    assert draws.shape == (1, 40_000, 4)
    np.testing.assert_array_equal(
        draws[..., [0, 1, 3]], np.broadcast_to([0.2, 1.9, 0.7], (1, 40_000, 3))
    )
    assert np.ptp(draws[..., 2]) > 1
    assert_matches(posterior, enumerate_posterior(mixture(), DATA))


@pytest.mark.parametrize(
    "missing",
    [
        [0, None, 1, 1],
        np.ma.MaskedArray([0, 9, 1, 1], [False, True, False, False]),
        [0, np.nan, 1, 1],
    ],
    ids=["None", "mask", "NaN"],
)
def test_missing_elements_in_every_form(missing) -> None:
    evidence = {**DATA, "label": missing}
    posterior = bmc.infer(mixture(), evidence, engine=weighting(2000), rng=0)
    expected = bmc.infer(
        mixture(), {**DATA, "label": [0, None, 1, 1]}, engine=weighting(2000), rng=0
    )
    np.testing.assert_array_equal(posterior.mean("label"), expected.mean("label"))
    assert 0 < posterior.mean("label")[1] < 1


def test_vector_evidence() -> None:
    net = bmc.BayesNet(plates={"i": 2})
    net.add("k", bmc.Bernoulli(0.5))
    net.add("v", lambda k: bmc.MvNormal(bmc.stack([k, -1.0 * k]), np.eye(2)), plates="i")
    seen = np.array([[1.0, 0.0], [0.2, -0.4]])
    posterior = bmc.infer(net, {"v": seen}, engine=weighting(), rng=0)
    logs = [scipy.stats.multivariate_normal.logpdf(seen, [k, -k], np.eye(2)).sum() for k in (0, 1)]
    odds = math.exp(logs[1] - logs[0])
    assert posterior.mean("k") == pytest.approx(
        odds / (1 + odds), abs=4 * float(posterior.mcse("k"))
    )
    part = {"v": [[1.0, np.nan], [0.2, -0.4]]}
    odds *= scipy.stats.norm.pdf(0.0, 0.0) / scipy.stats.norm.pdf(0.0, -1.0)
    assert bmc.infer(net, part, engine=bmc.Exact()).mean("k") == pytest.approx(odds / (1 + odds))
    partly = bmc.infer(net, {"v": [[1.0, 0.0], [np.nan, np.nan]]}, engine=weighting(100), rng=0)
    assert partly["v"].shape == (1, 100, 2, 2)


def test_do_inputs_and_potentials() -> None:
    net = bmc.BayesNet()
    net.input("shift")
    net.add("a", bmc.Bernoulli(0.3))
    net.add("x", lambda a, shift: bmc.Normal(a + shift, 1.0))
    net.potential("tilt", lambda a: 1.5 * a)
    inputs = {"shift": 0.4}
    for asked in (net, net.do(a=1)):
        posterior = bmc.infer(asked, {"x": 1.0}, inputs=inputs, engine=weighting(), rng=0)
        assert_matches(posterior, enumerate_posterior(asked, {"x": 1.0}, inputs))
    no_evidence = bmc.infer(net, inputs=inputs, engine=weighting(), rng=0)
    assert_matches(no_evidence, enumerate_posterior(net, None, inputs))
    assert no_evidence.weights is not None  # a potential weighs, too


def test_without_evidence_weights_are_uniform() -> None:
    posterior = bmc.infer(mixture(), engine=weighting(100), rng=0)
    assert posterior.weights is None
    assert posterior.log_weights is None
    assert posterior.log_marginal_likelihood == 0.0
    assert posterior.pareto_k is None


FAULTS = {
    "unknown node": ({"y": 1.0}, "evidence on 'y', which the net does not have"),
    "close name": ({"labels": 1}, "did you mean 'label'"),
    "deterministic node": ({"twice": 1}, "'twice', which is a deterministic node"),
    "input": ({"u": 1.0}, "'u', which is an input node"),
    "unknown state": ({"weather": "foggy"}, "'foggy' is not a state; the states are 'dry', 'wet'"),
    "position for a label": ({"weather": 1}, "give the label, not its position"),
    "number outside the states": ({"label": [0, 1, 2]}, "2 is not among the values 0, 1"),
    "outside the support": ({"p": 1.5}, r"'p' is 1.5, outside its support \(numbers in \[0, 1\]\)"),
    "negative count": ({"n": -1}, r"'n' is -1, outside its support \(integers >= 0\)"),
    "shape": ({"label": [0, 1]}, r"shape \(2,\), but the node's plates \(i=3\)"),
    "NaN without plates": ({"p": np.nan}, "'p' is nan, which means nothing for a node without"),
    "infinity": ({"x": [1.0, np.inf, 0.0]}, "'x' is inf at index 1; it must be finite"),
    "a string for a number": ({"p": "high"}, "'high' is not among its values"),
    "an object": ({"p": object()}, "evidence on 'p'"),
    "no mapping": ([("p", 0.5)], "evidence is a list; give a dict"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_in_evidence_are_named(fault: str) -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.input("u")
    net.add("p", bmc.Beta(2.0, 2.0))
    net.add("n", bmc.Poisson(3.0))
    net.add("weather", bmc.Bernoulli(0.5), states=("dry", "wet"))
    net.add("label", lambda p: bmc.Bernoulli(p), plates="i")
    net.add("x", lambda label: bmc.Normal(label, 1.0), plates="i")
    net.add("twice", lambda n: 2 * n)
    evidence, message = FAULTS[fault]
    with pytest.raises(EvidenceError, match=message):
        bmc.infer(net, evidence, inputs={"u": 1.0}, engine=weighting(10), rng=0)
    with pytest.raises(EvidenceError, match=message):
        bmc.explain(net, evidence, inputs={"u": 1.0})


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ({}, r"input 'u' has no value; pass inputs="),
        ({"u": 1.0, "w": 2.0}, "gives 'w', which is not a declared input"),
        ({"u": np.nan}, "input 'u' is nan"),
        ({"u": [1.0, 2.0]}, r"input 'u' has shape \(2,\)"),
    ],
)
def test_faults_in_inputs_are_named(inputs: dict, message: str) -> None:
    net = bmc.BayesNet()
    net.input("u")
    net.add("x", lambda u: bmc.Normal(u, 1.0))
    with pytest.raises(EvidenceError, match=message):
        bmc.infer(net, inputs=inputs, engine=weighting(10))


@pytest.mark.parametrize("keep", ["draws", "summaries"])
def test_impossible_evidence(keep: str) -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.table("b", ["a"], [[1.0, 0.0], [1.0, 0.0]])
    with pytest.raises(ZeroProbabilityError, match=r"none of 100 draws .*Exact\(\)"):
        bmc.infer(net, {"b": 1}, engine=weighting(100), rng=0, keep=keep)


# ---- parameters ---------------------------------------------------------------------------------


def test_bad_parameters_matter_only_where_possible() -> None:
    """Nine by nine states, so that the net's own checks do not happen to try the bad ones."""
    for kind, bad in (
        ("discrete", lambda a, b: bmc.Bernoulli(np.where((a == 8) & (b == 8), 2.0, 0.3))),
        ("continuous", lambda a, b: bmc.Normal(0.0, np.where((a == 8) & (b == 8), -1.0, 1.0))),
    ):
        net = bmc.BayesNet(kind)
        net.add("a", bmc.Categorical(np.full(9, 1 / 9)))
        net.add("b", bmc.Categorical(np.append(np.full(8, 1 / 8), 0.0)))
        net.add("x", bad, parents=["a", "b"])
        for evidence in ({"x": 1}, {}):
            posterior = bmc.infer(net, evidence, engine=weighting(5000), rng=0)
            assert posterior.mean("a") == pytest.approx(4.0, abs=4 * float(posterior.mcse("a")))
        net.add("b", bmc.Categorical(np.full(9, 1 / 9)), replace=True)
        for evidence in ({"x": 1}, {}):
            with pytest.raises(ParameterError, match="node 'x'"):
                bmc.infer(net, evidence, engine=weighting(5000), rng=0)


@pytest.mark.parametrize("draws", [0, -1, 2.5, True, "many"])
def test_options_are_checked(draws) -> None:
    with pytest.raises(ValueError, match="draws is a whole number, 1 or more"):
        bmc.LikelihoodWeighting(draws)


def test_an_engine_is_an_instance() -> None:
    with pytest.raises(TypeError, match="give an instance"):
        bmc.infer(mixture(), engine=bmc.LikelihoodWeighting)
    with pytest.raises(TypeError, match="is not an engine"):
        bmc.infer(mixture(), engine="lw")


# ---- trust --------------------------------------------------------------------------------------


def test_few_effective_draws_warn_with_the_remedy() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 0.01))
    with pytest.warns(
        LowEssWarning, match=r"worth only [\d.]+ .*more draws, or Exact\(\)"
    ) as caught:
        posterior = bmc.infer(net, {"y": 2.5}, engine=weighting(2000), rng=0)
    assert posterior.weight_ess < 100
    assert caught[0].filename == __file__  # the user's own line


def test_heavy_tails_warn() -> None:
    """Weights exp(x^2 / 2.4) under a normal prior have no variance: k is about 0.8 or more."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.potential("heavy", lambda x: x**2 / 2.4)
    with pytest.warns(LowEssWarning):
        posterior = bmc.infer(net, engine=weighting(), rng=0)
    assert posterior.pareto_k > 0.6


def test_ordinary_evidence_does_not_warn() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for keep in ("draws", "summaries"):
            posterior = bmc.infer(mixture(), DATA, engine=weighting(), rng=0, keep=keep)
            assert posterior.pareto_k < 0.7


def test_tied_weights_are_no_heavy_tail() -> None:
    """Discrete evidence gives few distinct weights, of which the largest are many times the same."""
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical([0.90, 0.07, 0.029, 0.001]))
    net.table("b", ["a"], [[0.999, 0.001], [0.9, 0.1], [0.5, 0.5], [0.01, 0.99]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for seed in range(10):
            for keep in ("draws", "summaries"):
                posterior = bmc.infer(net, {"b": 1}, engine=weighting(), rng=seed, keep=keep)
                assert not posterior.pareto_k > 0.7


@pytest.mark.parametrize("seen", ["finite", "number"])
def test_a_rare_state_of_larger_weight_is_no_heavy_tail(seen: str) -> None:
    """Its weight is bounded: k is above 1, and the answers are as good as their error bars say."""
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical([0.995, 0.005]))
    net.add("x", bmc.Normal(0.0, 1.0))
    if seen == "finite":
        net.table("y", ["a"], [[0.9, 0.1], [0.1, 0.9]])
    else:
        net.add("y", lambda a, x: bmc.Normal(0.1 * x + 3.0 * a, 2.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for seed in range(4):
            for keep in ("draws", "summaries"):
                evidence = {"y": 1 if seen == "finite" else 3.0}
                posterior = bmc.infer(net, evidence, engine=weighting(20_000), rng=seed, keep=keep)
    assert posterior.pareto_k > 0.7


def test_error_bars_cover() -> None:
    """Of 300 answers, those within 2 standard errors: 95.4 % expected; below 91.5 % or above 98.5 % has
    probability 2e-3 (binomial)."""
    net = mixture()
    exact = enumerate_posterior(net, DATA)
    inside = np.zeros(3)
    for seed in range(300):
        posterior = bmc.infer(net, DATA, engine=weighting(3000), rng=seed, keep="summaries")
        inside[0] += abs(posterior.mean("mean") - exact.mean("mean")) < 2 * posterior.mcse("mean")
        inside[1] += (
            abs(posterior.mean("label")[0] - exact.mean("label")[0])
            < 2 * posterior.mcse("label")[0]
        )
        off = posterior.log_marginal_likelihood - exact.log_marginal_likelihood
        inside[2] += abs(off) < 2 * posterior.log_marginal_likelihood_mcse
    assert ((inside >= 0.915 * 300) & (inside <= 0.985 * 300)).all(), inside


def test_explain_says_what_happens_to_each_node() -> None:
    evidence = {**DATA, "mean": 0.5}
    found = bmc.explain(mixture(), evidence, engine=weighting())
    assert found.nodes["mean"] == "weights the draws"
    assert found.nodes["x"] == "weights the draws (missing elements sampled)"
    assert found.nodes["label"] == "sampled given its parents"
    assert "LikelihoodWeighting" in str(found)


def test_a_density_without_sampler_is_refused_unless_observed() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Density(lambda x: -np.abs(x) - np.log(2.0)))
    net.add("a", lambda x: bmc.Bernoulli(1 / (1 + np.exp(-x))))
    assert "'x' is a Density without sample=" in weighting().unsupported(net, {"a": 1})
    with pytest.raises(UnsupportedError, match="observe the node"):
        bmc.infer(net, {"a": 1}, engine=weighting())
    posterior = bmc.infer(net, {"x": 0.7}, engine=weighting(), rng=0)
    assert posterior.log_marginal_likelihood == pytest.approx(-0.7 - np.log(2.0))
