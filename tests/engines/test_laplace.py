"""Laplace's method: exact where posteriors are Gaussian, near where data are many, else refused."""

from __future__ import annotations

import json
import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import special
from scipy.special import i0e

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning, UnsupportedError, ZeroProbabilityError
from bayesmc.testing import compare, gaussian_evidence, random_gaussian_net, session
from bayesmc.testing.verdict import NothingToCompare

LAPLACE = bmc.LaplaceApproximation()


def asked(net: bmc.BayesNet, evidence: dict[str, Any], **options: Any) -> Any:
    return bmc.infer(net, evidence, engine=bmc.LaplaceApproximation(**options), rng=0)


# ---- exact --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["scalars", "plates and vectors"])
def test_linear_gaussian_nets_are_exact(kind: str) -> None:
    """All answers, of nodes on which nothing observed depends and of computed ones, too, and the evidence."""
    options = {"plates": True, "vectors": True} if kind != "scalars" else {}
    answered = 0
    for seed in range(session.seed(), session.seed() + session.scaled(5, 10)):
        net, plain = random_gaussian_net(seed, discrete=0.0, **options)
        evidence = gaussian_evidence(net, seed)
        if LAPLACE.unsupported(net, evidence):
            continue
        posterior = bmc.infer(net, evidence, engine=LAPLACE)
        assert all(posterior._is_closed(n) for n in net)
        try:
            found = compare(posterior, plain.posterior(evidence), rtol=1e-8)
        except NothingToCompare:
            continue
        assert found, (seed, found)
        answered += 1
    assert answered >= 3


def test_joint_covariances_are_exact() -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("m", bmc.Normal(1.0, 2.0))
    net.add("x", lambda m: bmc.Normal(m, [1.0, 2.0, 3.0]), plates="i")
    net.add("y", lambda x: bmc.Normal(2.0 * x, 1.0), plates="i")
    net.add("half", lambda m: 0.5 * m + 1.0)
    net.add("later", lambda half: bmc.Normal(half, 2.0))
    evidence = {"y": [1.0, np.nan, 4.0]}
    posterior, exact = (bmc.infer(net, evidence, engine=e) for e in (LAPLACE, bmc.Exact()))
    names = ("m", "x", "half", "later", "y")
    np.testing.assert_allclose(posterior.cov(*names), exact.cov(*names), atol=1e-10)
    for name in names:
        np.testing.assert_allclose(posterior.mean(name), exact.mean(name), atol=1e-10)
        levels = [0.1, 0.5, 0.9]
        found, right = (p.quantile(name, levels) for p in (posterior, exact))
        np.testing.assert_allclose(found, right, atol=1e-9)
        assert np.isinf(posterior.ess(name)).all()
        assert (posterior.mcse(name) == 0).all()


def test_evidence_has_the_factors_that_nothing_hidden_moves() -> None:
    net = bmc.BayesNet()
    net.add("coin", bmc.Bernoulli(0.25))
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    net.add("other", lambda coin: bmc.Poisson(2.0 + coin))
    evidence = {"coin": 1, "y": 0.3, "other": 4}
    exact = bmc.infer(net, evidence, engine=bmc.Exact())
    assert asked(net, evidence).log_marginal_likelihood == pytest.approx(
        exact.log_marginal_likelihood, abs=1e-10
    )


def test_evidence_that_nothing_hidden_makes_possible_is_refused_by_name() -> None:
    net = bmc.BayesNet()
    net.add("coin", bmc.Categorical([1.0, 0.0]))
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    with pytest.raises(ZeroProbabilityError, match="'coin'"):
        asked(net, {"coin": 1, "y": 0.3})


# ---- against figures that others publish, and sampling --------------------------------------------


@pytest.mark.parametrize("summed", [False, True])
@pytest.mark.parametrize("number", range(3))
def test_clutter(number: int, summed: bool, reference_data: Path) -> None:
    """Minka's clutter problem, the origin of a reading as a mixture, and as labels that are summed out."""
    case = json.loads((reference_data / "ep" / "clutter.json").read_text())[number]
    x = np.array(case["x"])
    net = bmc.BayesNet(plates={"point": len(x)})
    net.add("theta", bmc.Normal(0.0, 10.0))
    scales = np.array([1.0, np.sqrt(10.0)])
    if summed:
        net.add("is_noise", bmc.Bernoulli(0.5), plates="point")
        net.add(
            "x",
            lambda theta, is_noise: bmc.Normal(np.where(is_noise, 0.0, theta), scales[is_noise]),
            plates="point",
        )
    else:
        net.add(
            "x",
            lambda theta: bmc.Mixture(
                [0.5, 0.5], bmc.Normal(bmc.stack([theta, 0.0 * theta]), scales)
            ),
            plates="point",
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a small mode among the clutter
        posterior = asked(net, {"x": x})
    found = [posterior.log_marginal_likelihood, posterior.mean("theta"), posterior.var("theta")]
    np.testing.assert_allclose(np.array(found, float), case["laplace"], atol=1e-6)


def glm(name: str, root: Path) -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Regressions of counts of the Bayesian Population Analysis book, as posteriordb has them."""
    data = json.loads((root / "posteriordb" / "data" / f"{name}.json").read_text())
    year, net = np.array(data["year"]), bmc.BayesNet(plates={"year": len(data["year"])})
    if "N" in data:
        size = np.array(data["N"])
        for node in ("alpha", "b1", "b2"):
            net.add(node, bmc.Normal(0.0, 100.0))
        net.add(
            "C",
            lambda alpha, b1, b2: bmc.Binomial(size, logits=alpha + b1 * year + b2 * year**2),
            plates="year",
        )
    else:
        net.add("alpha", bmc.Uniform(-20.0, 20.0))
        for node in ("b1", "b2", "b3"):
            net.add(node, bmc.Uniform(-10.0, 10.0))
        net.add(
            "C",
            lambda alpha, b1, b2, b3: bmc.Poisson(
                np.exp(alpha + b1 * year + b2 * year**2 + b3 * year**3)
            ),
            plates="year",
        )
    return net, {"C": data["C"]}


@pytest.mark.parametrize("name", ["GLM_Poisson_Data", "GLM_Binomial_data"])
def test_regressions_of_counts(name: str, reference_data: Path) -> None:
    """Means within .1 sd of those of trajectories and sds within a tenth; corrected means within 4 errors.

    False alarms: 4 standard errors are passed once in 16,000; means and sds err by some .03.
    """
    net, evidence = glm(name, reference_data)
    posterior = asked(net, evidence)
    chains = bmc.infer(net, evidence, engine=bmc.HamiltonianMonteCarlo(ess=1000), rng=1)
    check = posterior.check(rng=session.seed())
    assert check.ok
    for node in set(net) - {"C"}:
        sd = chains.std(node)
        assert abs(posterior.mean(node) - chains.mean(node)) < 0.1 * sd
        assert abs(posterior.std(node) / sd - 1.0) < 0.1
        error = np.hypot(check.posterior.mcse(node), chains.mcse(node))
        assert abs(check.posterior.mean(node) - chains.mean(node)) < 4.0 * error


def test_bounded_numbers_have_the_moments_of_their_maps() -> None:
    """Log-normal in closed form; logit-normal, and a bound above, against many points of the Gaussian."""
    net = bmc.BayesNet(plates={"i": 2})
    net.add("scale", bmc.Gamma(3.0, 2.0))
    net.add("share", bmc.Beta(2.0, 5.0), plates="i")
    net.add("below", bmc.Truncated(bmc.Normal(0.0, 2.0), high=1.0))
    net.add("y", lambda scale, share, below: bmc.Normal(scale * share + below, 0.5), plates="i")
    posterior = asked(net, {"y": [0.7, 0.4]})
    drawn = posterior.resample(200_000, rng=0)
    for name in ("scale", "share", "below"):
        error = np.sqrt(drawn.var(name) / 200_000)
        assert (abs(posterior.mean(name) - drawn.mean(name)) < 5 * error).all()
        np.testing.assert_allclose(posterior.std(name), drawn.std(name), rtol=0.03)
        found, right = (p.quantile(name, [0.05, 0.5, 0.95]) for p in (posterior, drawn))
        np.testing.assert_allclose(found, right, atol=0.03 * posterior.std(name).max())


def test_angles_are_circular() -> None:
    """A direction next to the cut: one mode, not two."""
    net = bmc.BayesNet(plates={"i": 6})
    net.add("m", bmc.VonMises(3.0, 0.5))
    net.add("y", lambda m: bmc.VonMises(m, 4.0), plates="i")
    evidence = {"y": [3.1, -3.0, 2.9, -2.9, 3.0, -3.1]}
    posterior = asked(net, evidence)  # a warning of two modes is an error
    # the posterior is von Mises itself
    z = 0.5 * np.exp(3.0j) + 4.0 * np.exp(1j * np.array(evidence["y"])).sum()
    assert posterior.mean("m") == pytest.approx(np.angle(z), abs=1e-6)
    assert posterior.var("m") == pytest.approx(1.0 / abs(z), rel=1e-6)
    check = posterior.check(rng=0)
    log = np.log(i0e(abs(z))) + abs(z) - 6 * np.log(2 * np.pi)
    log -= 6 * (np.log(i0e(4.0)) + 4.0) + np.log(i0e(0.5)) + 0.5
    assert abs(check.log_marginal_likelihood - log) < 4 * check.log_marginal_likelihood_mcse


def test_many_hidden_numbers() -> None:
    rng, n = np.random.default_rng(0), session.scaled(500, 4)
    net = bmc.BayesNet(plates={"i": n})
    net.add("m", bmc.Normal(0.0, 3.0))
    net.add("x", lambda m: bmc.Normal(m, 0.5), plates="i")
    net.add("y", lambda x: bmc.Normal(x, 1.0), plates="i")
    y = rng.normal(2.0, 1.1, size=n)
    posterior = asked(net, {"y": y}, starts=1)
    precision = n / 1.25 + 1 / 9
    assert posterior.mean("m") == pytest.approx(y.sum() / 1.25 / precision, abs=1e-8)
    assert posterior.var("m") == pytest.approx(1 / precision, rel=1e-8)
    assert posterior.mean("x").shape == (n,)


# ---- discrete nodes -------------------------------------------------------------------------------


def test_states_that_were_summed_out_are_drawn_given_numbers() -> None:
    """A mixture of Gaussians near one another, in which labels are told by the numbers alone."""
    net = bmc.BayesNet(plates={"i": 4})
    net.add("w", bmc.Normal(0.0, 1.0))
    net.add("z", bmc.Categorical([0.2, 0.5, 0.3]), plates="i")
    net.add("s", bmc.Bernoulli(0.3))
    net.add("y", lambda w, z, s: bmc.Normal(w + 0.7 * z + 0.5 * s, 1.0), plates="i")
    evidence = {"y": [0.1, 2.0, 1.0, -0.5], "z": [np.nan, np.nan, 2, np.nan]}
    posterior = asked(net, evidence)
    exact = bmc.infer(net, evidence, engine=bmc.Exact())
    check = posterior.check(20_000, rng=session.seed())
    assert check.ok
    for name in ("z", "s"):
        off = abs(check.posterior.probabilities(name) - exact.probabilities(name))
        assert (off < 4.5 * np.sqrt(0.25 / 10_000)).all()
    assert abs(check.posterior.mean("w") - exact.mean("w")) < 4.5 * check.posterior.mcse("w")
    error = check.log_marginal_likelihood_mcse
    assert abs(check.log_marginal_likelihood - exact.log_marginal_likelihood) < 4.5 * error


# ---- what has no Gaussian -------------------------------------------------------------------------


def refusal(net: bmc.BayesNet, evidence: dict[str, Any]) -> str:
    with pytest.raises(UnsupportedError) as caught:
        bmc.infer(net, evidence, engine=LAPLACE)
    return str(caught.value)


def test_a_ridge_is_refused_with_its_direction() -> None:
    net = bmc.BayesNet(plates={"i": 50})
    net.add("a", bmc.Normal(0.0, 1e9))
    net.add("b", bmc.Normal(0.0, 1e9))
    net.add("c", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a, b, c: bmc.Bernoulli(logits=a - 2.0 * b + c), plates="i")
    text = refusal(net, {"y": np.arange(50) % 2})
    assert "ridge" in text
    assert "0.89 a + 0.45 b" in text


def test_a_neck_is_refused_by_name() -> None:
    """Eight schools, centred: with the scale at 0 and all effects equal the density has no bound."""
    net = bmc.BayesNet(plates={"school": 8})
    net.add("mu", bmc.Normal(0.0, 5.0))
    net.add("tau", bmc.HalfCauchy(5.0))
    net.add("theta", lambda mu, tau: bmc.Normal(mu, tau), plates="school")
    error = np.array([15.0, 10, 16, 11, 9, 11, 10, 18])
    net.add("y", lambda theta: bmc.Normal(theta, error), plates="school")
    with np.errstate(all="ignore"):
        text = refusal(net, {"y": [28.0, 8, -3, 7, -1, 1, 18, 12]})
    assert "there is no mode" in text
    assert "tau" in text


def test_a_kink_at_the_mode_is_refused_by_name() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Laplace(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 3.0))
    text = refusal(net, {"y": 0.5})
    assert "kink" in text
    assert "x" in text


def test_jumps_and_infinitely_many_states_are_refused_by_name() -> None:
    net = bmc.BayesNet(plates={"year": 5})
    net.add("change", bmc.Uniform(0.0, 5.0))
    year = np.arange(5)
    net.add("y", lambda change: bmc.Normal(np.where(year < change, 0.0, 2.0), 1.0), plates="year")
    assert "'change'" in refusal(net, {"y": [0.0, 0, 2, 2, 2]})
    net = bmc.BayesNet()
    net.add("rate", bmc.Gamma(2.0, 1.0))
    net.add("count", lambda rate: bmc.Poisson(rate))
    net.add("seen", lambda count: bmc.Normal(count, 1.0))
    assert "'count'" in refusal(net, {"seen": 2.0})
    net = bmc.BayesNet()
    net.table("a", probs=[0.5, 0.5])
    net.table("b", ["a"], [[0.9, 0.1], [0.2, 0.8]])
    assert "'a'" in refusal(net, {"b": 1})


def test_bounds_by_a_state_that_would_be_summed_out_are_refused() -> None:
    net = bmc.BayesNet()
    net.add("z", bmc.Bernoulli(0.5))
    net.add("x", lambda z: bmc.Uniform(1.0 * z, 3.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    assert "'z'" in refusal(net, {"y": 2.0})


def test_other_modes_are_told() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 3.0))
    net.add("y", lambda x: bmc.Normal(x**2, 1.0))
    with pytest.warns(ConvergenceWarning, match=r"2 modes .* log evidence of each: -3.618"):
        posterior = asked(net, {"y": 4.0})
    assert len(posterior.modes) == 2
    logs = [mode["log_evidence"] for mode in posterior.modes]
    assert logs[0] == pytest.approx(logs[1], abs=1e-9)
    ends = sorted(float(mode["values"]["x"]) for mode in posterior.modes)
    assert ends[0] == pytest.approx(-ends[1], abs=1e-6)
    assert sum(mode["starts"] for mode in posterior.modes) <= 8


# ---- what users see -------------------------------------------------------------------------------


def rates() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet()
    net.input("hours")
    net.add("rate", bmc.Gamma(3.0, 1.0))
    net.add("twice", lambda rate: 2.0 * rate)
    net.add("count", lambda rate, hours: bmc.Poisson(rate * hours))
    net.add("next", lambda rate: bmc.Poisson(rate))
    return net, {"count": 12}


def test_the_short_name_and_inputs() -> None:
    net, evidence = rates()
    first, second = (
        bmc.infer(net, evidence, inputs={"hours": 4.0}, engine=engine, rng=0)
        for engine in (bmc.Laplace(), LAPLACE)
    )
    assert first.mean("rate") == second.mean("rate")
    assert first.mean("next") == second.mean("next")
    assert isinstance(bmc.Laplace(), bmc.Distribution)
    for distribution in (bmc.Laplace(1.0, 2.0), bmc.Laplace(0, 1), bmc.Laplace(scale=1.0)):
        with pytest.raises(TypeError, match="is not an engine.*LaplaceApproximation"):
            bmc.infer(net, evidence, inputs={"hours": 4.0}, engine=distribution)
    assert pickle.loads(pickle.dumps(bmc.Laplace())).is_bare
    assert not pickle.loads(pickle.dumps(bmc.Laplace(0.0))).is_bare


def test_the_same_seed_the_same_draws_and_the_mode_whatever_the_seed() -> None:
    net, evidence = rates()
    ask = {"inputs": {"hours": 4.0}, "engine": LAPLACE}
    first, again, other = (bmc.infer(net, evidence, rng=seed, **ask) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first["rate"], again["rate"])
    assert (first["rate"] != other["rate"]).any()
    assert first.mean("rate") == other.mean("rate")


def test_explain_says_what_is_done_and_how_far_to_trust_it() -> None:
    net, evidence = rates()
    told = str(bmc.explain(net, evidence, inputs={"hours": 4.0}, engine=LAPLACE))
    assert "moments by quadrature" in told
    assert "nothing observed depends on it" in told
    assert "check()" in told


def test_pickles_answer_without_functions() -> None:
    net, evidence = rates()
    posterior = bmc.infer(net, evidence, inputs={"hours": 4.0}, engine=LAPLACE, rng=0)
    again = pickle.loads(pickle.dumps(posterior))
    assert again.mean("rate") == posterior.mean("rate")
    assert again.quantile("rate", 0.9) == posterior.quantile("rate", 0.9)
    np.testing.assert_array_equal(again["twice"], posterior["twice"])
    with pytest.raises(UnsupportedError, match="unpickled"):
        again.check()


def test_a_template_is_unrolled_and_plain_answers_of_other_engines_are_not_checked() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    posterior = bmc.infer(dbn, {"y": [0.3, 1.0, 0.7]}, engine=LAPLACE)
    exact = bmc.infer(dbn, {"y": [0.3, 1.0, 0.7]}, engine=bmc.Exact())
    assert posterior.mean("x[2]") == pytest.approx(exact.mean("x[2]"), abs=1e-10)
    with pytest.raises(UnsupportedError, match="no deterministic approximation"):
        exact.check()
    with pytest.raises(TypeError, match="LaplaceApproximation"):
        bmc.filter(dbn, {"y": [0.3]}, engine=LAPLACE)


@pytest.mark.parametrize(
    ("link", "scale", "far"),
    [(special.ndtr, 10.0, 60.0), (lambda x: 1.0 / (1.0 + np.exp(-x)), 100.0, 1000.0)],
    ids=["probit", "logit"],
)
def test_an_optimum_far_from_zero_is_found(link: Any, scale: float, far: float) -> None:
    """The model's own probabilities round to 0 at every point near the prior's middle."""
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, scale))
    net.add("y", lambda a: bmc.Bernoulli(link(a - far)))
    posterior = bmc.infer(net, {"y": 1}, engine=bmc.LaplaceApproximation())
    wide = np.hypot(scale, 1.0 if link is special.ndtr else np.pi / np.sqrt(3.0))
    assert abs(posterior.log_marginal_likelihood - special.log_ndtr(-far / wide)) < 3.0
    assert far - 3.0 < posterior.mean("a") < far + 6.0
