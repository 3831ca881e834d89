"""``Importance``: proposals of every form, orders of drawing, what is refused, what it shares."""

from __future__ import annotations

import copy
import pickle
import warnings
from typing import Any

import numpy as np
import pytest
import scipy.stats

import bayesmc as bmc
from bayesmc.errors import (
    BudgetError,
    CycleError,
    DensityError,
    EvidenceError,
    LowEssWarning,
    ModelError,
    ParameterError,
    ShapeError,
    SupportWarning,
    UnknownNodeError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.testing import assert_matches, enumerate_posterior


def mixture() -> bmc.BayesNet:
    net = bmc.BayesNet("mixture", plates={"i": 4})
    net.add("mean", bmc.Normal(0.0, 2.0))
    net.add("label", bmc.Bernoulli(0.4), plates="i")
    net.add("x", lambda label, mean: bmc.Normal(mean + 2.0 * label, 1.0), plates="i")
    return net


DATA = {"x": [0.2, 1.9, np.nan, 0.7]}
SEEN = {"x": [0.2, 1.9, 0.3, 0.7]}


#: a handful of draws shows what is computed, not what is true
FEW = pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")


def infer(
    proposal: Any, net: Any = None, evidence: Any = DATA, draws: int = 20_000, **options: Any
):
    options = {"rng": 1, **options}
    net = mixture() if net is None else net
    return bmc.infer(net, evidence, engine=bmc.Importance(draws, proposal), **options)


# ---- right answers ------------------------------------------------------------------------------

#: proposals for the mixture, by evidence
FORMS: dict[str, tuple[dict[Any, Any], dict[str, Any]]] = {
    "a distribution": ({"mean": bmc.StudentT(4.0, 0.5, 1.5)}, DATA),
    "a frozen SciPy distribution": ({"mean": scipy.stats.t(4.0, 0.5, 1.5)}, DATA),
    "a density with a sampler": (
        {
            "mean": bmc.Density(
                lambda x: np.log(0.25) - np.abs(x) / 2.0,
                lambda rng, shape: rng.laplace(0.0, 2.0, shape),
            )
        },
        DATA,
    ),
    "by ancestors": ({"label": lambda mean: bmc.Bernoulli(np.where(mean > 0, 0.3, 0.7))}, DATA),
    "by evidence below": ({"label": lambda x: bmc.Bernoulli(1 / (1 + np.exp(1.0 - x)))}, SEEN),
    "a plate read as foreign": ({"mean": lambda x: bmc.StudentT(4.0, x.mean("i") - 1, 1.0)}, SEEN),
    "missing elements": ({"x": lambda label, mean: bmc.Normal(mean + label, 2.0)}, DATA),
    "against the arrow": (
        {"x": bmc.Normal(1.0, 2.0), "mean": lambda x: bmc.Normal(x.mean("i"), 2.5)},
        DATA,
    ),
    "a child that is not proposed": (
        {"label": bmc.Bernoulli(0.6), "mean": lambda label: bmc.Normal(1 - label.mean("i"), 2.0)},
        SEEN,
    ),
    "all at once": (
        {
            "label": lambda x: bmc.Bernoulli(1 / (1 + np.exp(2.0 - 2.0 * x))),
            "mean": lambda x, label: bmc.StudentT(4.0, (x - 2 * label).mean("i"), 0.6),
        },
        SEEN,
    ),
    "a block by names": (
        {("mean", "label"): lambda x: {"mean": bmc.Normal(0.5, 1.5), "label": bmc.Bernoulli(0.5)}},
        SEEN,
    ),
    "a constant block": (
        {
            ("label", "mean"): {
                "mean": bmc.Normal(0.5, 1.5),
                "label": bmc.Bernoulli([0.2, 0.6, 0.2, 0.4]),
            }
        },
        DATA,
    ),
    "a block of one plated node": (
        {("label",): {"label": bmc.Bernoulli([0.2, 0.6, 0.5, 0.4])}},
        DATA,
    ),
    "a default is no parent": ({"mean": lambda shift=0.5: bmc.Normal(shift, 2.0)}, DATA),
    "keyword only": ({"label": lambda *, mean: bmc.Bernoulli(0.5 + 0.0 * mean)}, DATA),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_proposal_gives_the_posterior(form: str) -> None:
    """Each comparison has a false-alarm rate of 1e-3; the seed is fixed."""
    proposal, evidence = FORMS[form]
    posterior = infer(proposal, evidence=evidence, draws=40_000)
    assert posterior.weight_ess > 2000
    assert_matches(posterior, enumerate_posterior(mixture(), evidence))


def test_a_good_proposal_beats_the_prior() -> None:
    """The exact conditionals as proposals: all weights are equal, and the evidence is exact."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 0.1))
    posterior = infer({"x": lambda y: bmc.Normal(y / 1.01, 0.1 / np.sqrt(1.01))}, net, {"y": 2.0})
    assert posterior.weight_ess == pytest.approx(20_000, rel=1e-6)
    expected = scipy.stats.norm.logpdf(2.0, 0.0, np.sqrt(1.01))
    assert posterior.log_marginal_likelihood == pytest.approx(expected, abs=1e-9)
    with pytest.warns(LowEssWarning):
        assert infer({}, net, {"y": 4.0}, draws=2000).weight_ess < 100


@FEW
def test_weights_are_p_over_q() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    posterior = infer({"x": bmc.Normal(0.5, 2.0)}, net, {}, draws=50)
    x = posterior["x"]
    p, q = scipy.stats.norm.logpdf(x), scipy.stats.norm.logpdf(x, 0.5, 2.0)
    np.testing.assert_allclose(posterior.log_weights, p - q, atol=1e-12)


@FEW
def test_a_block_as_one_vector() -> None:
    """Components go to the names in order: scalars, then plates and events in C order."""
    net = bmc.BayesNet(plates={"i": 2})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("v", lambda a: bmc.MvNormal(bmc.stack([a, -a]), np.eye(2)), plates="i")
    centre = np.array([0.3, 1.0, 2.0, 3.0, 4.0])
    posterior = infer({("a", "v"): bmc.MvNormal(centre, np.diag([1e-6] * 5))}, net, {}, draws=200)
    np.testing.assert_allclose(posterior["a"], 0.3, atol=0.01)
    np.testing.assert_allclose(
        posterior["v"][0], np.broadcast_to([[1, 2], [3, 4]], (200, 2, 2)), atol=0.01
    )
    a, v = posterior["a"], posterior["v"]
    means = np.stack([a, -a], axis=-1)[:, :, None, :]
    flat = np.concatenate([a[..., None], v.reshape(1, 200, 4)], axis=-1)
    p = scipy.stats.norm.logpdf(a) + scipy.stats.norm.logpdf(v, means, 1.0).sum(axis=(-1, -2))
    q = scipy.stats.norm.logpdf(flat, centre, 1e-3).sum(axis=-1)
    np.testing.assert_allclose(posterior.log_weights, p - q, atol=1e-6)


def test_a_vector_block_by_evidence_is_right() -> None:
    """A whole plate drawn from one Gaussian, the exact posterior: all weights are equal."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("m", bmc.Normal(0.0, 2.0))
    net.add("t", lambda m: bmc.Normal(m, 1.0), plates="i")
    net.add("y", lambda t: bmc.Normal(t, 0.5), plates="i")
    prior = np.full((4, 4), 4.0) + np.diag([0.0, 1.0, 1.0, 1.0])
    read = np.eye(4)[1:]
    seen = np.array([0.5, 1.5, -0.2])
    gain = prior @ read.T @ np.linalg.inv(read @ prior @ read.T + 0.25 * np.eye(3))
    mean, cov = gain @ seen, prior - gain @ read @ prior

    def block(y: Any) -> bmc.Distribution:
        return bmc.MvNormal(np.matvec(gain, y.array), cov)

    posterior = infer({("m", "t"): block}, net, {"y": seen}, draws=5000)
    assert posterior.weight_ess == pytest.approx(5000, rel=1e-6)
    found = np.append(posterior.mean("m"), posterior.mean("t"))
    errors = np.append(posterior.mcse("m"), posterior.mcse("t"))
    assert (np.abs(found - mean) < 4.5 * errors).all()  # false alarms: 4 * 7e-6


def test_discrete_values_of_every_kind() -> None:
    """Labels, numeric states and shifted supports: a proposal speaks the values of the support."""
    net = bmc.BayesNet()
    net.add("w", bmc.Categorical([0.7, 0.2, 0.1]), states=("dry", "wet", "snow"))
    net.add("s", bmc.Bernoulli(0.3), states=(-1, 1))
    net.add("d", bmc.DiscreteUniform(2, 4))
    net.add("n", bmc.Poisson(2.0))
    net.add("y", lambda w, s, d, n: bmc.Normal((w == "snow") * 2.0 + s + d - n, 1.0))
    proposal = {
        "w": lambda s: bmc.Categorical(np.where((s == 1)[..., None], [0.2, 0.3, 0.5], 1 / 3)),
        "s": lambda y: bmc.Bernoulli(0.6),
        "d": lambda w: bmc.DiscreteUniform(2 - (w == "wet"), 5),  # 1 and 5 are no values of it
        "n": bmc.Poisson(3.0),
    }
    evidence = {"y": 1.5}
    posterior = infer(proposal, net, evidence, draws=60_000)
    assert set(np.unique(posterior["d"])) <= {2, 3, 4}
    plain = bmc.infer(net, evidence, engine=bmc.LikelihoodWeighting(60_000), rng=2)
    for name in "wsd":
        a, b = posterior.probabilities(name), plain.probabilities(name)
        # the standard deviation of a share is at most half of ess**-0.5; false alarms: 8 * 7e-6
        spread = 0.5 * np.hypot(posterior.weight_ess**-0.5, plain.weight_ess**-0.5)
        assert np.abs(a - b).max() < 4.5 * spread
    both = np.hypot(posterior.mcse("n"), plain.mcse("n"))
    assert abs(posterior.mean("n") - plain.mean("n")) < 4.5 * both
    both = np.hypot(posterior.log_marginal_likelihood_mcse, plain.log_marginal_likelihood_mcse)
    assert abs(posterior.log_marginal_likelihood - plain.log_marginal_likelihood) < 4.5 * both


def test_a_draw_outside_the_support_weighs_nothing() -> None:
    net = bmc.BayesNet()
    net.add("rate", bmc.Gamma(2.0, 1.0))
    net.add("root", lambda rate: np.sqrt(rate))  # not a number below zero
    net.add("y", lambda root: bmc.Normal(0.0, root))
    posterior = infer({"rate": bmc.Normal(1.5, 2.0)}, net, {"y": 0.7}, draws=40_000)
    negative = posterior["rate"] < 0
    assert 0.1 < negative.mean() < 0.4
    assert (posterior.weights[negative] == 0).all()
    plain = bmc.infer(net, {"y": 0.7}, engine=bmc.LikelihoodWeighting(40_000), rng=0)
    error = np.hypot(posterior.mcse("rate"), plain.mcse("rate"))
    assert abs(posterior.mean("rate") - plain.mean("rate")) < 4.5 * error  # false alarms: 7e-6


def test_densities_without_a_sampler_can_be_proposed() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Density(lambda x: -np.abs(x) - np.log(2.0)))
    net.add("a", lambda x: bmc.Bernoulli(1 / (1 + np.exp(-x))))
    assert "or propose it" in bmc.Importance(10).unsupported(net, {"a": 1})
    posterior = infer({"x": bmc.Laplace(0.5, 1.2)}, net, {"a": 1})
    assert posterior.log_marginal_likelihood == pytest.approx(np.log(0.5), abs=0.03)


def test_inputs_potentials_and_do() -> None:
    net = bmc.BayesNet()
    net.input("shift")
    net.add("a", bmc.Bernoulli(0.3))
    net.add("b", lambda a: bmc.Bernoulli(0.2 + 0.5 * a))
    net.add("x", lambda b, shift: bmc.Normal(b + shift, 1.0))
    net.potential("tilt", lambda a, b: 1.5 * a * b)
    inputs = {"shift": 0.4}
    proposal = {"b": lambda x, shift: bmc.Bernoulli(np.clip(x - shift, 0.1, 0.9))}
    for asked in (net, net.do(a=1)):
        posterior = infer(proposal, asked, {"x": 1.0}, inputs=inputs)
        assert_matches(posterior, enumerate_posterior(asked, {"x": 1.0}, inputs))


# ---- what it shares with likelihood weighting ---------------------------------------------------


@pytest.mark.parametrize("evidence", [DATA, SEEN, {}], ids=["partly", "wholly", "none"])
def test_without_proposals_it_is_likelihood_weighting(evidence: dict[str, Any]) -> None:
    ours = infer({}, evidence=evidence, draws=70_000)
    plain = bmc.infer(mixture(), evidence, engine=bmc.LikelihoodWeighting(70_000), rng=1)
    for name in ours.names:
        np.testing.assert_array_equal(ours[name], plain[name])
    assert (ours.log_weights is None) == (plain.log_weights is None)
    if ours.log_weights is not None:
        np.testing.assert_array_equal(ours.log_weights, plain.log_weights)
    assert ours.log_marginal_likelihood == plain.log_marginal_likelihood


def test_kept_draws_summaries_and_names_agree() -> None:
    proposal = FORMS["all at once"][0]
    whole = infer(proposal, evidence=SEEN, draws=40_000)
    sums = infer(proposal, evidence=SEEN, draws=40_000, keep="summaries")
    some = infer(proposal, evidence=SEEN, draws=40_000, keep=["mean"])
    assert sums.mean("mean") == pytest.approx(whole.mean("mean"), rel=1e-9)
    assert sums.log_marginal_likelihood == pytest.approx(whole.log_marginal_likelihood, abs=1e-9)
    assert sums.weight_ess == pytest.approx(whole.weight_ess)
    np.testing.assert_array_equal(some["mean"], whole["mean"])
    with pytest.raises(UnsupportedError, match="'label' was not kept"):
        some.mean("label")
    again = infer(proposal, evidence=SEEN, draws=40_000)
    np.testing.assert_array_equal(again["mean"], whole["mean"])


@FEW
def test_resume_goes_on_with_the_same_proposals_only() -> None:
    proposal = FORMS["all at once"][0]
    net = mixture()
    first = infer(proposal, net, SEEN, draws=5000)
    both = infer(proposal, net, SEEN, draws=5000, resume=first)
    assert both["mean"].shape == (1, 10_000)
    np.testing.assert_array_equal(both["mean"][:, :5000], first["mean"])
    assert not np.isin(both["mean"][0, 5000:], first["mean"]).any()
    for other in ({}, {"mean": bmc.Normal(0.0, 2.0)}):
        with pytest.raises(UnsupportedError, match="earlier Importance posterior"):
            infer(other, net, SEEN, draws=100, resume=first)
    weighted = bmc.infer(net, SEEN, engine=bmc.LikelihoodWeighting(100), rng=0)
    with pytest.raises(UnsupportedError, match="earlier Importance posterior"):
        infer({}, net, SEEN, draws=100, resume=weighted)


def test_a_narrow_proposal_warns_with_the_remedy() -> None:
    """q = N(0, 0.3) under p = N(0, 1): the tail of the weights has shape 1 - 0.3^2 = 0.91."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    with pytest.warns(LowEssWarning, match="proposals nearer the posterior") as caught:
        posterior = infer({"x": bmc.Normal(0.0, 0.3)}, net, {}, draws=20_000)
    assert posterior.pareto_k > 0.7
    assert caught[0].filename == __file__


@pytest.mark.parametrize("model", ["exponential", "gamma"])
def test_a_heavy_tail_warns_though_most_weights_are_even(model: str) -> None:
    """Most draws count (ESS above half), yet a narrow proposal misses a tail of the posterior.

    Seeds are fixed; those of which k exceeds 0.7 must warn, and there must be some.
    """
    net = bmc.BayesNet()
    if model == "exponential":
        net.add("x", bmc.StudentT(3.0, 0.0, 1.0))
        net.add("y", lambda x: bmc.Normal(np.exp(x), 1.0))
        evidence, proposal = {"y": 0.5}, {"x": bmc.Normal(-1.0, 0.8)}
    else:
        net.add("x", bmc.Gamma(2.0, 1.0))
        evidence, proposal = {}, {"x": bmc.Normal(1.5, 1.5)}
    even = 0
    for keep in ("draws", "summaries"):
        for seed in (0, 3, 5):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                engine = bmc.Importance(20_000, proposal=proposal)
                posterior = bmc.infer(net, evidence, engine=engine, keep=keep, rng=seed)
            heavy = posterior.pareto_k > 0.7
            assert [w.category for w in caught] == [LowEssWarning] * heavy
            even += heavy and posterior.weight_ess > 10_000
    assert even >= 2


def test_nothing_compatible_is_an_error() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Uniform(0.0, 1.0))
    with (
        pytest.warns(SupportWarning, match=r"\[2, 3\] and never gives others"),
        pytest.raises(ZeroProbabilityError, match="none of 100 draws.*proposals of 'x' reach"),
    ):
        infer({"x": bmc.Uniform(2.0, 3.0)}, net, {}, draws=100)


def test_draws_that_do_not_fit_in_memory() -> None:
    with pytest.raises(BudgetError, match=r"Importance: .* do not fit in memory"):
        infer({}, draws=10**15)


# ---- the engine as a value ----------------------------------------------------------------------


def test_the_engine_keeps_a_copy_that_cannot_be_changed() -> None:
    given = {"mean": bmc.Normal(0.0, 3.0)}
    engine = bmc.Importance(100, given)
    given["label"] = bmc.Bernoulli(0.5)
    assert list(engine.proposal) == ["mean"]
    with pytest.raises(TypeError):
        engine.proposal["label"] = bmc.Bernoulli(0.5)  # type: ignore[index]
    assert copy.deepcopy(engine) == engine
    assert hash(engine) == hash(bmc.Importance(100))
    assert repr(engine) == "Importance(draws=100, proposal={'mean': ...})"


@FEW
def test_pickles_travel_without_functions() -> None:
    posterior = infer({"mean": lambda x: bmc.Normal(x.mean("i"), 2.0)}, evidence=SEEN, draws=100)
    back = pickle.loads(pickle.dumps(posterior))
    assert back.mean("mean") == posterior.mean("mean")
    assert repr(back.engine) == repr(posterior.engine)
    with pytest.raises(UnsupportedError, match="hold no functions"):
        bmc.infer(mixture(), SEEN, engine=back.engine)


def test_explain_says_what_is_proposed() -> None:
    engine = bmc.Importance(100, {("mean", "label"): FORMS["a block by names"][0]["mean", "label"]})
    found = bmc.explain(mixture(), SEEN, engine=engine).nodes
    assert found["mean"] == "proposed by its function jointly with 'label', weighted p/q"
    assert found["x"] == "weights the draws"
    partly = bmc.explain(mixture(), DATA, engine=bmc.Importance(9, {"x": bmc.Normal(0.0, 2.0)}))
    assert (
        partly.nodes["x"]
        == "proposed by its function, weighted p/q; observed elements weigh the draws"
    )


# ---- what is refused ----------------------------------------------------------------------------


def zoo() -> bmc.BayesNet:
    net = bmc.BayesNet("zoo", plates={"i": 3})
    net.input("u")
    net.add("p", bmc.Beta(2.0, 2.0))
    net.add("k", lambda p: bmc.Bernoulli(p), plates="i")
    net.add("v", bmc.MvNormal(np.zeros(2), np.eye(2)))
    net.add("twice", lambda p: 2 * p)
    net.add("x", lambda k: bmc.Normal(k, 1.0), plates="i")
    return net


NORMAL = bmc.Normal(0.0, 1.0)
REFUSED: dict[str, tuple[dict[Any, Any], type[Exception], str]] = {
    "unknown node": ({"q": NORMAL}, UnknownNodeError, "for 'q': the net has no node 'q'"),
    "close name": ({"twic": NORMAL}, UnknownNodeError, "did you mean 'twice'"),
    "deterministic": ({"twice": NORMAL}, ModelError, "'twice' is deterministic and never drawn"),
    "input": ({"u": NORMAL}, ModelError, "'u' is an input and never drawn"),
    "observed": ({"x": NORMAL}, EvidenceError, "'x' is observed, so there is nothing to draw"),
    "unknown argument": (
        {"p": lambda z: NORMAL},
        UnknownNodeError,
        "its argument 'z' is no node.*z=z",
    ),
    "itself": ({"p": lambda p: NORMAL}, ModelError, "it names 'p', which it is to draw"),
    "its own block": (
        {("p", "v"): lambda v: NORMAL},
        ModelError,
        "it names 'v', which it is to draw",
    ),
    "starred": ({"p": lambda *a: NORMAL}, ModelError, r"\*a is refused"),
    "unreadable": ({"p": max}, ModelError, "the arguments of .* cannot be read; wrap it"),
    "a class": ({"p": dict}, TypeError, "the proposal for .p. is <class .dict.>; give a function"),
    "a cycle": (
        {"p": lambda k: bmc.Beta(1.0, 1.0), "k": lambda p: bmc.Bernoulli(p)},
        CycleError,
        "need each other in a cycle: (k -> p -> k|p -> k -> p)",
    ),
    "an own descendant": ({"p": lambda k: bmc.Beta(1.0, 1.0)}, CycleError, "cycle"),
    "through a computed node": ({"p": lambda twice: bmc.Beta(1.0, 1.0)}, CycleError, "twice"),
    "an array": ({"p": lambda: np.zeros(3)}, ModelError, "returns an array of shape"),
    "nothing": ({"p": lambda: None}, ModelError, "for 'p': the function returns None"),
    "a fault inside": ({"p": lambda u: 1 / (u - u) + {}}, ModelError, "for 'p': "),
    "bad parameters": (
        {"p": lambda u: bmc.Beta(-u, 1.0)},
        ParameterError,
        "for 'p': Beta: .*got -1",
    ),
    "bad in a plate": (
        {"k": lambda p: bmc.Bernoulli(p + np.array([0.0, 2.0, 0.0]))},
        ParameterError,
        r"for 'k' \(plate element 1\): Bernoulli",
    ),
    "discrete for continuous": (
        {"p": bmc.Bernoulli(0.5)},
        ModelError,
        "'p' is continuous, but Bernoulli",
    ),
    "continuous for discrete": (
        {"k": NORMAL},
        ModelError,
        "'k' is discrete, but Normal is continuous",
    ),
    "wrong event": (
        {"v": NORMAL},
        ShapeError,
        r"values of shape \(\), but one value of 'v' has shape \(2,\)",
    ),
    "too many elements": ({"k": bmc.Bernoulli([0.5] * 4)}, ShapeError, r"batch shape \(4,\)"),
    "a batch without a plate": (
        {"p": bmc.Beta([1.0, 2.0], 1.0)},
        ShapeError,
        r"for 'p': Beta has batch",
    ),
    "no sampler": (
        {"p": bmc.Density(lambda x: 0 * x, support=(0, 1))},
        UnsupportedError,
        "for 'p'",
    ),
    "a lying sampler": (
        {"p": bmc.Density(lambda x: 0 * x, lambda rng, s: 2 + rng.random(s), support=(0, 1))},
        DensityError,
        "for 'p': the log density at one of its own draws is -inf",
    ),
    "a density that is no number": (
        {"p": bmc.Density(lambda x: np.nan * x, lambda rng, s: rng.random(s), support=(0, 1))},
        DensityError,
        "its own draws is nan",
    ),
    "a block lacks a part": (
        {("p", "v"): lambda: {"p": bmc.Beta(1.0, 1.0)}},
        ModelError,
        r"distributions for \['p'\], but the block is \['p', 'v'\]",
    ),
    "a block has a number": (
        {("p", "v"): lambda: {"p": 0.5, "v": NORMAL}},
        ModelError,
        "returns float for 'p'",
    ),
    "a block of the wrong size": (
        {("p", "v"): bmc.MvNormal(np.zeros(2), np.eye(2))},
        ShapeError,
        r"the block has 3 components \(p 1, v 2\)",
    ),
    "a block of two kinds": (
        {("p", "k"): bmc.MvNormal(np.zeros(4), np.eye(4))},
        ModelError,
        "'k' is discrete",
    ),
    "bad parameters of a block": (
        {("p", "v"): lambda u: bmc.MvNormal(np.zeros(3), np.eye(3) * -u)},
        ParameterError,
        r"for \('p', 'v'\): MvNormal",
    ),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_faults_name_the_proposal(fault: str) -> None:
    proposal, error, message = REFUSED[fault]
    with pytest.raises(error, match=message) as caught:
        infer(proposal, zoo(), {"x": [0.1, 0.2, 0.3]}, draws=10, inputs={"u": 1.0})
    assert "Importance" in str(caught.value)
    assert "node 'p'" not in str(caught.value)  # not the node's fault


def test_partly_observed_nodes_in_a_vector_or_a_cycle() -> None:
    with pytest.raises(UnsupportedError, match="'x' is partly observed, and a vector cannot"):
        infer({("mean", "x"): bmc.MvNormal(np.zeros(5), np.eye(5))}, draws=10)
    with pytest.raises(CycleError, match="'x' is observed only in part, so it is drawn"):
        infer({"mean": lambda x: bmc.Normal(x.mean("i"), 1.0)}, draws=10)


@pytest.mark.parametrize(
    ("proposal", "error", "message"),
    [
        ([("p", NORMAL)], TypeError, "give a dict"),
        ({"p": 3.0}, TypeError, "the proposal for 'p' is 3.0"),
        ({"p": None}, TypeError, "the proposal for 'p' is None"),
        ({"p": {"p": NORMAL}}, TypeError, "the proposal for 'p' is"),
        ({3: NORMAL}, TypeError, "the key 3"),
        ({(): NORMAL}, TypeError, r"the key \(\)"),
        ({"p": NORMAL, ("p", "v"): NORMAL}, ModelError, "'p' has two proposals"),
        ({("p", "p"): NORMAL}, ModelError, "'p' has two proposals"),
    ],
)
def test_what_is_no_proposal_is_refused_at_once(
    proposal: Any, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        bmc.Importance(10, proposal)


@pytest.mark.parametrize("draws", [0, 2.5, True])
def test_draws_are_checked(draws: Any) -> None:
    with pytest.raises(ValueError, match="Importance.*draws is a whole number"):
        bmc.Importance(draws)


def test_bad_parameters_matter_only_where_the_weight_is_positive() -> None:
    """Draws that the first proposal made impossible may break the second one."""
    net = bmc.BayesNet()
    net.add("s", bmc.Gamma(2.0, 1.0))
    net.add("x", lambda s: bmc.Normal(0.0, s))
    proposal = {"s": bmc.Normal(1.5, 1.5), "x": lambda s: bmc.Normal(0.0, s)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # a normal proposal is lighter than a gamma, and k = 0.9 says so
        warnings.filterwarnings("ignore", "importance sampling: the weights have a heavy tail")
        posterior = infer(proposal, net, {})
    assert (posterior["s"] < 0).any()
    assert posterior.mean("s") == pytest.approx(2.0, abs=5 * float(posterior.mcse("s")))


# ---- proposals that leave gaps --------------------------------------------------------------------

GAPS = {
    "a finite node's other states": (
        bmc.DiscreteUniform(3, 6),
        bmc.Categorical([0.25] * 4),
        "4, 5, 6",
    ),
    "a state of probability zero": (bmc.Bernoulli(0.5), bmc.Bernoulli(1.0), "never gives 0"),
    "negative numbers": (bmc.Normal(0.0, 1.0), bmc.Gamma(2.0, 2.0), "others of the real numbers"),
    "large counts": (bmc.Poisson(2.0), bmc.Binomial(3, 0.5), "others of the integers >= 0"),
}


@pytest.mark.parametrize("gap", GAPS)
def test_a_proposal_that_cannot_reach_all_values_is_warned_of(gap: str) -> None:
    target, proposal, words = GAPS[gap]
    net = bmc.BayesNet()
    net.add("x", target)
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    engine = bmc.Importance(500, proposal={"x": proposal})
    with pytest.warns(SupportWarning, match=words) as caught:
        bmc.infer(net, {"y": 3.0}, engine=engine, rng=0)
    assert len(caught) == 1  # once, not for every chunk


def test_a_proposal_that_covers_its_target_is_not_warned_of() -> None:
    net = bmc.BayesNet()
    net.add("n", bmc.Poisson(2.0))
    net.add("u", bmc.Uniform(0.0, 1.0))
    net.add("y", lambda n, u: bmc.Normal(n + u, 1.0))
    proposal = {"n": bmc.Geometric(0.3), "u": bmc.Normal(0.5, 1.0)}
    with warnings.catch_warnings():
        warnings.simplefilter("error", SupportWarning)
        bmc.infer(net, {"y": 3.0}, engine=bmc.Importance(5000, proposal=proposal), rng=0)


def test_draws_of_probability_zero_excuse_their_children_in_any_order() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Gamma(3.0, 2.0))
    net.add("b", lambda a: bmc.Exponential(a))
    net.add("y", lambda b: bmc.Normal(b, 0.5))
    proposals = {"b": lambda y: bmc.Normal(y, 1.0), "a": bmc.Normal(1.0, 1.0)}
    backwards = dict(reversed(proposals.items()))
    answers = [
        bmc.infer(net, {"y": 1.5}, engine=bmc.Importance(20_000, proposal=p), rng=0).mean("a")
        for p in (proposals, backwards)
    ]
    assert answers[0] == pytest.approx(answers[1], abs=0.05)
