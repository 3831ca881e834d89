"""``Rejection``: exact draws, bounds proved and given, what it reports and what it refuses."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
import scipy.stats

import bayesmc as bmc
from bayesmc.engines.weighted.bounds import proved_log_bound
from bayesmc.errors import (
    BudgetError,
    EnvelopeError,
    EvidenceError,
    ShapeError,
    UnknownNodeError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.network import pose
from bayesmc.testing import assert_matches, enumerate_posterior


def mixture() -> bmc.BayesNet:
    net = bmc.BayesNet("mixture", plates={"i": 4})
    net.add("mean", bmc.Normal(0.0, 2.0))
    net.add("label", bmc.Bernoulli(0.4), plates="i")
    net.add("x", lambda label, mean: bmc.Normal(mean + 2.0 * label, 1.0 + 0.5 * label), plates="i")
    return net


DATA = {"x": [0.2, 1.9, np.nan, 0.7]}


def scaled() -> bmc.BayesNet:
    """No bound can be proved: the scale is hidden and may be as small as it likes."""
    net = bmc.BayesNet()
    net.add("s", bmc.Uniform(0.5, 2.0))
    net.add("y", lambda s: bmc.Normal(0.0, s))
    return net


#: of Normal(0, 0.5) at its peak
PEAK = float(scipy.stats.norm.logpdf(0.0, 0.0, 0.5))


def infer(net: bmc.BayesNet, evidence: Any, draws: int = 2000, rng: int = 0, **options: Any) -> Any:
    keep = options.pop("keep", "draws")
    inputs = options.pop("inputs", None)
    engine = bmc.Rejection(draws, **options)
    return bmc.infer(net, evidence, engine=engine, rng=rng, keep=keep, inputs=inputs)


# ---- draws --------------------------------------------------------------------------------------


def test_draws_are_from_the_exact_posterior() -> None:
    """Kolmogorov-Smirnov against the conjugate posterior; false alarms 1e-3, the seed is fixed."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 0.5))
    posterior = infer(net, {"y": 1.5}, 4000)
    exact = scipy.stats.norm(1.5 / 1.25, np.sqrt(0.2))
    draws = posterior["x"].ravel()
    assert scipy.stats.kstest(draws, exact.cdf).pvalue > 1e-3
    prior = infer(net, {}, 4000)["x"].ravel()  # negative control
    assert scipy.stats.kstest(prior, exact.cdf).pvalue < 1e-9
    # neighbours are independent: |r| < 4.5 / sqrt(n) but for 7e-6
    assert abs(np.corrcoef(draws[1:], draws[:-1])[0, 1]) < 4.5 / np.sqrt(4000)
    assert posterior.weights is None and posterior.log_weights is None
    assert posterior.ess("x") == 4000


@pytest.mark.parametrize("keep", ["draws", "summaries"])
def test_plates_partly_observed(keep: str) -> None:
    posterior = infer(mixture(), DATA, 5000, keep=keep)
    assert_matches(posterior, enumerate_posterior(mixture(), DATA))


def test_kept_draws_summaries_and_names_agree() -> None:
    whole, sums, some = (
        infer(mixture(), DATA, keep=k) for k in ("draws", "summaries", ["mean", "x"])
    )
    assert sums.mean("mean") == pytest.approx(whole.mean("mean"), rel=1e-9)
    np.testing.assert_allclose(sums.probabilities("label"), whole.probabilities("label"))
    np.testing.assert_array_equal(some["mean"], whole["mean"])
    np.testing.assert_array_equal(some["x"][0, :, 0], np.full(2000, 0.2))
    assert whole.proposed == sums.proposed == some.proposed
    with pytest.raises(UnsupportedError, match="'label' was not kept"):
        some.mean("label")


def test_more_draws_begin_with_the_same() -> None:
    few, many = infer(mixture(), DATA, 500), infer(mixture(), DATA, 3000)
    np.testing.assert_array_equal(few["mean"][0], many["mean"][0, :500])
    assert few.proposed < many.proposed
    assert not np.array_equal(infer(mixture(), DATA, 500, rng=1)["mean"], few["mean"])


def test_discrete_evidence_is_never_drawn() -> None:
    """Accepting with p/max p: 1 in 2 where drawing the evidence and comparing accepts 1 in 200."""
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.table("b", ["a"], [[0.99, 0.01], [1.0, 0.0]])
    posterior = infer(net, {"b": 1}, 4000)
    assert posterior.acceptance_rate == pytest.approx(0.5, abs=0.03)  # 5 standard errors of 8,000
    assert posterior.mean("a") == 0.0
    found, error = posterior.log_marginal_likelihood, posterior.log_marginal_likelihood_mcse
    assert abs(found - np.log(0.005)) < 4 * error


def test_inputs_potentials_and_do() -> None:
    net = bmc.BayesNet()
    net.input("shift")
    net.add("a", bmc.Bernoulli(0.3))
    net.add("x", lambda a, shift: bmc.Normal(a + shift, 1.0))
    net.potential("tilt", lambda a: 1.5 * a)
    inputs = {"shift": 0.4}
    for asked in (net, net.do(a=1)):
        for evidence in ({"x": 1.0}, {}):
            posterior = infer(asked, evidence, 5000, inputs=inputs)
            assert_matches(posterior, enumerate_posterior(asked, evidence, inputs))


def test_without_evidence_everything_is_accepted() -> None:
    posterior = infer(mixture(), {}, 100)
    assert posterior.proposed == 100
    assert posterior.acceptance_rate == 1.0
    assert posterior.log_marginal_likelihood == posterior.log_marginal_likelihood_mcse == 0.0


# ---- what it reports ----------------------------------------------------------------------------


def test_acceptance_and_evidence() -> None:
    posterior = infer(mixture(), DATA, 3000)
    assert posterior.acceptance_rate == 3000 / posterior.proposed
    shown = f"Rejection: 3000 of {posterior.proposed} proposals accepted"
    assert str(posterior.summary()).startswith(shown)
    expected = enumerate_posterior(mixture(), DATA).log_marginal_likelihood
    error = posterior.log_marginal_likelihood_mcse
    assert 0.01 < error < 0.03
    assert abs(posterior.log_marginal_likelihood - expected) < 4 * error  # false alarms: 6e-5
    back = pickle.loads(pickle.dumps(posterior))
    assert back.proposed == posterior.proposed
    assert back.engine == posterior.engine


def test_error_bars_of_the_evidence_cover() -> None:
    """Of 300 answers, those within 2 standard errors: some 95 %; below 91 % or above 99 % has
    probability 2e-3 (binomial)."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    exact = scipy.stats.norm.logpdf(0.8, 0.0, np.sqrt(2.0))
    inside = 0
    for seed in range(300):
        p = infer(net, {"y": 0.8}, 400, seed, keep=[])
        inside += abs(p.log_marginal_likelihood - exact) < 2 * p.log_marginal_likelihood_mcse
    assert 0.91 * 300 <= inside <= 0.99 * 300


def test_one_draw_gives_no_estimate_of_the_evidence() -> None:
    posterior = infer(mixture(), DATA, 1)
    assert posterior["mean"].shape == (1, 1)
    assert posterior.log_marginal_likelihood is None


# ---- bounds -------------------------------------------------------------------------------------


def parented(child: Any, **hidden: Any) -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("k", bmc.Bernoulli(0.5))
    net.add("v", bmc.Normal(0.0, 1.0))
    net.add("d", lambda v: np.exp(v))
    net.add("n", bmc.Poisson(3.0))
    net.add("y", child)
    return net


normal, t = scipy.stats.norm, scipy.stats.t
#: child, what was seen, its log bound (None: none can be proved)
PROVED: dict[str, tuple[Any, float, float | None]] = {
    "no parents": (bmc.Normal(0.0, 2.0), 1.0, normal.logpdf(1.0, 0.0, 2.0)),
    "finite parents": (lambda k: bmc.Gamma(2.0, 1.0 + k), 1.0, np.log(4.0) - 2.0),
    "a table at what was seen": (lambda k: bmc.Bernoulli(0.2 + 0.1 * k), 1, np.log(0.3)),
    "counts of finite parents": (lambda k: bmc.Poisson(1.0 + 5.0 * k), 1, -1.0),
    "counts of any parents": (lambda n, v: bmc.Poisson(np.exp(v) + n), 1, 0.0),
    "a normal's scale is constant": (lambda v: bmc.Normal(v**3, 0.5), 9.0, normal.logpdf(0, 0, 0.5)),
    "a scale by finite parents": (lambda v, k: bmc.Normal(v, 1.0 + k), 9.0, normal.logpdf(0)),
    "a student's": (lambda d, k: bmc.StudentT(3.0, d, 1.0 + k), 9.0, t.logpdf(0, 3.0)),
    "a laplace's": (lambda d: bmc.Laplace(np.where(d > 1, d, -d), 1.0), 9.0, -np.log(2.0)),
    "of a count": (lambda n: bmc.Cauchy(n, 1.0), 9.0, -np.log(np.pi)),
    "a hidden scale": (lambda v: bmc.Normal(0.0, np.exp(v)), 0.0, None),
    "a scale through a computed node": (lambda k, d: bmc.Normal(k, d), 0.0, None),
    "hidden degrees of freedom": (lambda d: bmc.StudentT(d, 0.0, 1.0), 0.0, None),
    "another family": (lambda d: bmc.Gamma(2.0, d), 1.0, None),
    "a branch on a value": (lambda v: bmc.Normal(v, 1.0 if np.all(v < 99) else 0.1), 0.0, None),
    "SciPy's": (lambda v: scipy.stats.norm(v, 1.0), 0.0, None),
    "an infinite density": (lambda k: bmc.Beta(0.5, 0.5 + k), 0.0, None),
}  # fmt: skip


@pytest.mark.parametrize("case", PROVED)
def test_bounds_are_proved_or_not(case: str) -> None:
    child, seen, expected = PROVED[case]
    net = parented(child)
    found = proved_log_bound(pose(net, {"y": seen}), "y")
    if expected is None:
        assert found is None
        assert "give bound={'y': ...}" in bmc.Rejection(10).unsupported(net, {"y": seen})
    else:
        assert found is not None and found.shape == ()
        assert float(found) == pytest.approx(float(expected), abs=1e-12)


@pytest.mark.parametrize("case", [c for c, (_, _, bound) in PROVED.items() if bound is not None])
def test_no_density_exceeds_a_proved_bound(case: str) -> None:
    """By a hundred thousand draws of everything above."""
    child, seen, expected = PROVED[case]
    net = parented(child)
    drawn = bmc.infer(net, {"y": seen}, engine=bmc.LikelihoodWeighting(100_000), rng=0)
    if drawn.log_weights is not None:
        assert drawn.log_weights.max() <= expected + 1e-12


def test_bounds_of_plates_and_gathers() -> None:
    net = bmc.BayesNet(plates={"c": 3, "p": 5})
    net.add("mean", bmc.Normal(0.0, 5.0), plates="c")
    net.add("label", bmc.Categorical(np.ones(3) / 3), plates="p")
    net.add("x", lambda label, mean: bmc.Normal(mean[label], 0.5), plates="p")
    found = proved_log_bound(pose(net, {"x": np.zeros(5)}), "x")
    np.testing.assert_allclose(found, np.full(5, PEAK))
    seen = proved_log_bound(pose(net, {"x": np.zeros(5), "mean": [0.0, 1.0, 9.0]}), "x")
    np.testing.assert_allclose(seen, np.full(5, PEAK))
    vector = bmc.BayesNet()
    vector.add("v", bmc.MvNormal(np.zeros(2), np.eye(2)))
    vector.add("y", lambda v: bmc.MvNormal(v**2, 2 * np.eye(2)))
    found = proved_log_bound(pose(vector, {"y": [0.0, 0.0]}), "y")
    assert float(found) == pytest.approx(-np.log(4 * np.pi))


def test_a_given_bound_is_used() -> None:
    tight, loose = (infer(scaled(), {"y": 0.3}, bound={"y": b}) for b in (PEAK, PEAK + 1.0))
    assert tight.acceptance_rate > 2 * loose.acceptance_rate
    for posterior in (tight, loose):
        s = np.linspace(0.5, 2.0, 4001)
        p = scipy.stats.norm.pdf(0.3, 0.0, s)
        assert abs(posterior.mean("s") - (p @ s) / p.sum()) < 4.5 * posterior.mcse("s")
        z = np.log(p.mean())
        error = posterior.log_marginal_likelihood_mcse
        assert abs(posterior.log_marginal_likelihood - z) < 4.5 * error


def test_a_bound_by_plate_element() -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("s", bmc.Uniform(0.5, 2.0))
    net.add("y", lambda s: bmc.Normal(0.0, s), plates="i")
    evidence = {"y": [0.1, np.nan, 1.0]}
    one = infer(net, evidence, 500, bound={"y": PEAK})
    each = infer(net, evidence, 500, bound={"y": [PEAK, 77.0, PEAK]})  # unobserved: does not count
    np.testing.assert_array_equal(one["s"], each["s"])
    with pytest.raises(
        ShapeError, match=r"bound of 'y' has shape \(2,\), but its plates make \(3,\)"
    ):
        infer(net, evidence, 10, bound={"y": [PEAK, PEAK]})


def test_a_violated_bound_raises_with_the_point() -> None:
    with pytest.raises(
        EnvelopeError, match=r"log density of 'y' is .* at s=.*bound={'y'"
    ) as caught:
        infer(scaled(), {"y": 0.0}, bound={"y": PEAK - 0.5})
    point = caught.value.point
    density = scipy.stats.norm.logpdf(0.0, 0.0, point["s"])
    assert density > PEAK - 0.5
    assert caught.value.ratio == pytest.approx(np.exp(density - (PEAK - 0.5)))
    infer(scaled(), {"y": 0.0}, bound={"y": PEAK})  # the bound itself is none


def test_potentials_need_a_bound_where_none_is_proved() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.potential("tilt", lambda x: -np.abs(x))
    why = bmc.Rejection(10).unsupported(net, {})
    assert "the potential 'tilt'" in why and "LikelihoodWeighting" in why
    posterior = infer(net, {}, bound={"tilt": 0.0})
    x = np.linspace(-8, 8, 4001)
    p = np.exp(-(x**2) / 2 - np.abs(x))
    assert abs(posterior.var("x") - (p @ x**2) / p.sum()) < 0.06  # 4.5 standard errors
    with pytest.raises(EnvelopeError, match="log potential 'tilt' is .* at x="):
        infer(net, {}, bound={"tilt": -0.5})


# ---- refusals -----------------------------------------------------------------------------------


def test_unbounded_evidence_is_refused_and_says_what_can() -> None:
    with pytest.raises(UnsupportedError, match="density of observed 'y'.*LikelihoodWeighting"):
        infer(scaled(), {"y": 0.3})


def test_it_gives_up_with_the_rate_so_far() -> None:
    with pytest.raises(
        BudgetError, match=r"5000 proposals gave \d+ of 2000 draws.*LikelihoodWeighting"
    ):
        infer(mixture(), DATA, max_proposals=5000)
    needed = infer(mixture(), DATA, 100).proposed
    assert infer(mixture(), DATA, 100, max_proposals=needed).proposed == needed
    with pytest.raises(BudgetError):
        infer(mixture(), DATA, 100, max_proposals=needed - 1)


@pytest.mark.parametrize("keep", ["draws", "summaries"])
def test_impossible_evidence(keep: str) -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.table("b", ["a"], [[1.0, 0.0], [1.0, 0.0]])
    with pytest.raises(ZeroProbabilityError, match="'b' is impossible whatever its parents are"):
        infer(net, {"b": 1}, keep=keep)
    net.add("c", lambda a: bmc.Bernoulli(a))
    net.add("d", lambda a: bmc.Bernoulli(1 - a))
    with pytest.raises(ZeroProbabilityError, match="none of 3000 proposals was accepted"):
        infer(net, {"c": 1, "d": 1}, keep=keep, max_proposals=3000)


@pytest.mark.parametrize(
    ("bound", "error", "message"),
    [
        ({"z": 0.0}, UnknownNodeError, "bound= names 'z': the net has no node"),
        ({"s": 0.0}, EvidenceError, "'s', which is not observed"),
    ],
)
def test_bounds_of_what_does_not_weigh(bound: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        infer(scaled(), {"y": 0.3}, bound=bound)


def test_options_are_checked() -> None:
    for draws in (0, 2.5, True):
        with pytest.raises(ValueError, match="draws is a whole number"):
            bmc.Rejection(draws)
    with pytest.raises(ValueError, match="max_proposals is a whole number"):
        bmc.Rejection(10, max_proposals=0)
    with pytest.raises(TypeError, match="give a dict"):
        bmc.Rejection(10, bound=0.5)  # type: ignore[arg-type]
    for value in (np.inf, None, "high"):
        with pytest.raises(ValueError, match="a log bound is a finite number"):
            bmc.Rejection(10, bound={"y": value})


def test_there_is_nothing_to_resume() -> None:
    net = mixture()
    first = infer(net, DATA, 100)
    with pytest.raises(UnsupportedError, match="more draws begin with the same"):
        bmc.infer(net, DATA, engine=bmc.Rejection(100), rng=0, resume=first)


def test_a_density_without_sampler_is_refused() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Density(lambda x: -np.abs(x) - np.log(2.0)))
    net.add("a", lambda x: bmc.Bernoulli(1 / (1 + np.exp(-x))))
    assert "'x' is a Density without sample=" in bmc.Rejection(10).unsupported(net, {"a": 1})


def test_explain_says_how_draws_are_accepted() -> None:
    found = bmc.explain(mixture(), DATA, engine=bmc.Rejection(10)).nodes
    assert found["mean"] == "sampled given its parents"
    assert found["x"] == (
        "accepts a draw with probability p/bound (log bound -2.757, proved), missing elements sampled"
    )
    given = bmc.explain(scaled(), {"y": 0.3}, engine=bmc.Rejection(10, bound={"y": PEAK})).nodes
    assert given["y"] == "accepts a draw with probability p/bound (log bound -0.2258, given)"
