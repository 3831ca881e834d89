"""The one call for exact answers: which oracle it takes, against others, and why it refuses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.stats

import bayesmc as bmc
from bayesmc.errors import (
    BudgetError,
    ModelError,
    ParameterError,
    ShapeError,
    UnknownNodeError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.network import pose
from bayesmc.testing import (
    compare,
    enumerate_posterior,
    gaussian_evidence,
    random_evidence,
    random_gaussian_net,
    random_net,
    same_distribution,
)
from bayesmc.testing.makers.linear_dbns import random_linear_dbn
from bayesmc.testing.oracles.answers import ExactAnswer, exact
from bayesmc.testing.oracles.linear import linear_posterior
from bayesmc.testing.oracles.quadrature import quadrature_posterior


def distance(found: Any, other: Any, names: Any = None) -> float:
    """Largest difference of log evidence, probabilities, and means and deviations (in deviations)."""
    off = [abs(found.log_marginal_likelihood - other.log_marginal_likelihood)]
    for name in found.names if names is None else names:
        if found.model[name].domain is not None:
            off.append(np.abs(found.probabilities(name) - other.probabilities(name)).max(initial=0))
            continue
        spread = np.maximum(found.std(name), 1.0)
        off.append((np.abs(found.mean(name) - other.mean(name)) / spread).max(initial=0))
        off.append(
            (np.abs(found.std(name) - np.sqrt(np.maximum(other.var(name), 0.0))) / spread).max(
                initial=0
            )
        )
    return float(max(off))


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("options", [{}, {"plates": True, "vectors": True}])
def test_linear_gaussian_nets(seed: int, options: dict[str, Any]) -> None:
    """Coefficients read off functions give what those that made the functions give."""
    net, plain = random_gaussian_net(seed, **options)
    evidence = gaussian_evidence(net, seed)
    found, other = exact(net, evidence), plain.posterior(evidence)
    assert found.method in ("linear-Gaussian", "enumeration")
    assert set(found.names) == set(other.names)
    assert distance(found, other) < 1e-6


def test_the_comparison_sees_a_changed_coefficient() -> None:
    def net(slope: float) -> bmc.BayesNet:
        made = bmc.BayesNet()
        made.add("x", bmc.Normal(0.0, 1.0))
        made.add("y", lambda x: bmc.Normal(slope * x, 1.0))
        return made

    assert distance(exact(net(1.0), {"y": 1.0}), exact(net(1.0), {"y": 1.0})) == 0.0
    assert distance(exact(net(1.0), {"y": 1.0}), exact(net(1.001), {"y": 1.0})) > 1e-4


@pytest.mark.parametrize("hybrid", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_random_nets(seed: int, hybrid: bool) -> None:
    """All are answered, whatever they hold: finite ones as by elimination, others as enumeration with a
    fixed rule answers them."""
    net = random_net(seed, hybrid=hybrid)
    evidence = random_evidence(net, seed)
    found, other = exact(net, evidence), enumerate_posterior(net, evidence)
    if not hybrid:
        eliminated = bmc.infer(net, evidence, engine=bmc.Exact())
        assert found.log_marginal_likelihood == pytest.approx(eliminated.log_marginal_likelihood)
        for name in (n for n in found.names if found.model[n].domain is not None):
            np.testing.assert_allclose(
                found.probabilities(name), eliminated.probabilities(name), atol=1e-10
            )
    names = [n for n in found.names if n in other.names]
    assert distance(found, other, names) <= 2 * (found.accuracy + other.accuracy) + 1e-8


@pytest.mark.parametrize("seed", [0, 3])
def test_templates(seed: int) -> None:
    """Dense conditioning of the unrolled net, against the engine's elimination."""
    case = random_linear_dbn(seed)
    found, other = exact(case.dbn, case.observations, case.inputs), case.exact(case.steps)
    assert found.method == "linear-Gaussian"
    assert found.steps == case.steps
    assert found.log_marginal_likelihood == pytest.approx(other.log_marginal_likelihood, rel=1e-9)
    for name in case.hidden:
        if name in case.dbn.static_nodes:
            continue
        whole = found.mean(name)
        assert whole.shape[0] == case.steps
        for t in range(case.steps):
            np.testing.assert_allclose(whole[t], other.mean(f"{name}[{t}]"), rtol=1e-7, atol=1e-7)
            np.testing.assert_allclose(found.mean(f"{name}[{t}]"), whole[t])


def test_a_hidden_markov_model() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("z", lambda z_prev: bmc.Bernoulli(0.1 + 0.8 * z_prev), initial=bmc.Bernoulli(0.5))
    dbn.add("y", lambda z: bmc.Normal(2.0 * z, 1.0))
    rows = np.array([0.3, np.nan, 1.8, 2.2])
    found, smoothed = exact(dbn, {"y": rows}), bmc.smooth(dbn, {"y": rows})
    np.testing.assert_allclose(found.probabilities("z"), smoothed.probabilities("z"), atol=1e-10)
    assert found.quantile("z", [0.01, 0.99]).shape == (2, 4)


def test_a_constant_above_states() -> None:
    """A node without parents that is computed, not drawn (``t[0]`` of an unrolled template is one)."""
    net = bmc.BayesNet()
    net.add("c", lambda: 0.4)
    net.add("a", lambda c: bmc.Bernoulli(c))
    net.add("x", lambda a, c: bmc.Normal(a + c, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    found, other = exact(net, {"y": 1.0}), bmc.infer(net, {"y": 1.0}, engine=bmc.Exact())
    assert found.method == "linear-Gaussian"
    assert found.mean("x") == pytest.approx(other.mean("x"))
    assert quadrature_posterior(net, {"y": 1.0}).mean("x") == pytest.approx(other.mean("x"))


def test_static_nodes_of_plates_whose_size_data_tell() -> None:
    dbn = bmc.DynamicBayesNet(plates={"p": None})
    dbn.add_static("a", bmc.Normal(0.0, 1.0), plates="p")
    dbn.add_static("s", lambda a: bmc.Normal(a.sum("p"), 1.0))
    dbn.add(
        "x", lambda x_prev, a: bmc.Normal(x_prev + a, 1.0), initial=bmc.Normal(0.0, 1.0), plates="p"
    )
    dbn.add("y", lambda x, s: bmc.Normal(x + s, 1.0), plates="p")
    rows = {"s": 0.3, "y": np.array([[0.1, 0.2], [0.3, -0.4]])}
    found = exact(dbn, rows)
    assert found.log_static is None  # one of them is hidden
    a = np.array([0.5, -0.1])
    log = bmc.Normal(0.0, 1.0).log_prob(a).sum() + bmc.Normal(a.sum(), 1.0).log_prob(0.3)
    assert exact(dbn, {**rows, "a": a}).log_static == pytest.approx(float(log))


@pytest.mark.parametrize("evidence", [{"y": 1.0}, {}], ids=str)
def test_covariances(evidence: dict[str, Any]) -> None:
    """Of enumerated, linear and integrated answers."""
    net, _ = mixture()
    net.add("k", lambda a: bmc.Categorical(bmc.stack([0.5, 0.3 + 0.1 * a, 0.2 - 0.1 * a])))
    found, other = exact(net, evidence), bmc.infer(net, evidence, engine=bmc.Exact())
    np.testing.assert_allclose(found.cov("x", "w"), other.cov("x", "w"), rtol=1e-9)
    seen = exact(net, {"x": 1.5, "y": 1.0})
    assert seen.method == "enumeration"
    p = seen.probabilities("a", "k")
    a, k = np.arange(2), np.arange(3)
    mean_a, mean_k = p.sum(1) @ a, p.sum(0) @ k
    assert seen.cov("a", "k")[0, 1] == pytest.approx((a - mean_a) @ p @ (k - mean_k))
    integrated = quadrature_posterior(net, {"y": 1.0, "k": 1})
    assert integrated.var("x") == pytest.approx(
        exact(net, {"y": 1.0, "k": 1}).cov("x")[0, 0], rel=1e-6
    )


def mixture() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.3))
    net.add("x", lambda a: bmc.Normal(4.0 * a, 1.0 + a))
    net.add("w", lambda x: 2.0 * x - 1.0)
    net.add("y", lambda x: bmc.Normal(x, 3.0))
    return net, {"y": 1.0}


def test_questions_to_a_gaussian_answer() -> None:
    """Quantiles, cdf and functions under a mixture of two normals, against quadrature."""
    net, evidence = mixture()
    found = exact(net, evidence)
    assert found.method == "linear-Gaussian"
    assert "continuous" in found.passed_over["enumeration"]
    fine = quadrature_posterior(net, evidence)
    levels = [0.02, 0.5, 0.97]
    np.testing.assert_allclose(found.quantile("x", levels), fine.quantile("x", levels), atol=1e-6)
    np.testing.assert_allclose(found.quantile("w", levels), 2 * found.quantile("x", levels) - 1)
    np.testing.assert_allclose(found.cdf("x", levels), fine.cdf("x", levels), atol=1e-7)
    assert found.quantile("a", [0.01, 0.99]).tolist() == [0.0, 1.0]
    assert found.quantile("y", 0.4) == pytest.approx(1.0)
    by_name = found.expectation(lambda x, a: a * np.cos(x))
    assert by_name == pytest.approx(
        fine.expectation(lambda x, a: a * np.cos(x), "x", "a"), abs=1e-6
    )
    renamed = found.expectation(lambda one, two: two * np.cos(one), "x", "a")
    assert renamed == by_name
    assert found.expectation(lambda x, w: x * w) == pytest.approx(
        2 * (found.var("x") + found.mean("x") ** 2) - found.mean("x"), abs=1e-9
    )
    assert repr(found).startswith("ExactAnswer('linear-Gaussian', log_marginal_likelihood=-")


def test_quadrature_where_nothing_is_linear() -> None:
    net = bmc.BayesNet()
    net.add("r", bmc.Gamma(3.0, 2.0))
    net.add("n", lambda r: bmc.Poisson(r))
    found = exact(net, {"n": 4})
    assert (found.method, found.steps) == ("quadrature", None)
    assert "'r' is Gamma, no Normal" in found.passed_over["linear-Gaussian"]
    assert found.mean("r") == pytest.approx(7 / 3, abs=1e-6)
    quantiles = scipy.stats.gamma.ppf([0.1, 0.9], 7, scale=1 / 3)
    np.testing.assert_allclose(found.quantile("r", [0.1, 0.9]), quantiles, atol=1e-6)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: bmc.Normal(x**2, 1.0),
        lambda x: bmc.Normal(np.where(x > 2.0, 2.0, x), 1.0),
        lambda x: bmc.Normal(x, np.exp(0.1 * x)),
        lambda x: bmc.StudentT(4.0, x, 1.0),
        lambda x: bmc.Bernoulli(1 / (1 + np.exp(-x))),
    ],
)
def test_what_is_not_linear_is_not_taken_for_it(function: Any) -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", function)
    with pytest.raises(UnsupportedError, match="node 'y'"):
        linear_posterior(pose(net, {"y": 1}))
    assert exact(net, {"y": 1}).method == "quadrature"
    # where nothing observed depends on it, it is only left out
    assert linear_posterior(pose(net, {})).names == ("x",)


def test_a_kink_only_where_the_mass_is() -> None:
    """Random points about the prior miss it; draws of the answer do not."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1e7))
    net.add("y", lambda x: bmc.Normal(np.where(np.abs(x - 5e6) < 1e3, 5e6, x), 1.0))
    with pytest.raises(UnsupportedError, match="'y' is not linear"):
        linear_posterior(pose(net, {"y": 5e6}))


def test_observed_numbers_may_enter_in_any_way() -> None:
    net = bmc.BayesNet()
    net.add("u", bmc.Gamma(2.0, 1.0))
    net.add("x", lambda u: bmc.Normal(np.sin(u), np.sqrt(u)))
    net.add("y", lambda x, u: bmc.Normal(u * x, 1.0))
    found = exact(net, {"u": 1.7, "y": 0.4})
    precision = 1 / 1.7 + 1.7**2
    assert found.method == "linear-Gaussian"
    assert found.mean("x") == pytest.approx((np.sin(1.7) / 1.7 + 1.7 * 0.4) / precision, abs=1e-12)
    evidence = scipy.stats.gamma.logpdf(1.7, 2.0) + scipy.stats.norm.logpdf(
        0.4, 1.7 * np.sin(1.7), np.sqrt(1 + 1.7**3)
    )
    assert found.log_marginal_likelihood == pytest.approx(evidence, abs=1e-12)


def test_bad_parameters_count_where_they_are_possible() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical(np.append(np.full(8, 1 / 8), 0.0)))
    net.add("x", lambda a: bmc.Normal(0.0, np.where(a == 8, -1.0, 1.0)))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    assert exact(net, {"y": 1.0}).mean("x") == pytest.approx(0.5, abs=1e-12)
    net.add("b", bmc.Categorical(np.full(9, 1 / 9)))
    net.add(
        "x", lambda a, b: bmc.Normal(0.0, np.where((a == 7) & (b == 8), -1.0, 1.0)), replace=True
    )
    with pytest.raises(ParameterError, match="node 'x'.*scale"):
        exact(net, {"y": 1.0})


def test_refusals() -> None:
    net = bmc.BayesNet(plates={"i": 6})
    net.add("x", bmc.StudentT(4.0, 0.0, 1.0), plates="i")
    net.add("y", lambda x: bmc.Normal(x, 1.0), plates="i")
    with pytest.raises(UnsupportedError) as refusal:
        exact(net, {"y": np.zeros(6)})
    message = str(refusal.value)
    assert "enumeration: the hidden node 'x' is continuous" in message
    assert "linear-Gaussian: node 'x' is StudentT" in message
    assert "quadrature: quadrature_posterior: 6 continuous unknowns ('x')" in message
    assert message.endswith("(rank_test, geweke_test)")
    with pytest.raises(ModelError, match="expected a BayesNet or a DynamicBayesNet, not dict"):
        exact({})  # type: ignore[arg-type]
    net, evidence = mixture()
    found = exact(net, evidence)
    with pytest.raises(UnknownNodeError, match="'q' is no node.*ask a, x, w, y"):
        found.mean("q")
    with pytest.raises(ValueError, match="strictly between"):
        found.quantile("x", 0.0)
    net.add("v", bmc.MvNormal(np.zeros(4), np.eye(4)))
    with pytest.raises(UnsupportedError, match="a function of 4 numbers"):
        exact(net, evidence).expectation(lambda v: v[..., 0])
    impossible = bmc.BayesNet()
    impossible.add("a", bmc.Bernoulli(1.0))
    impossible.add("b", lambda a: bmc.Bernoulli(a))
    with pytest.raises(ZeroProbabilityError):
        exact(impossible, {"b": 0})
    assert isinstance(exact(impossible, {"b": 1}), ExactAnswer)


@pytest.mark.parametrize("seed", range(8))
def test_draws_of_an_answer_have_its_law(seed: int) -> None:
    """Against draws of the engine, jointly, at 1e-4; a wrong coupling with right marginals is seen."""
    net, _ = random_gaussian_net(seed, plates=True, vectors=True)
    evidence = gaussian_evidence(net, seed, chance=0.25)
    answer = exact(net, evidence)
    engine = bmc.infer(net, evidence, engine=bmc.Exact())
    assert compare(engine, answer, 1e-4, draws=200, rng=seed)


def test_draws_of_an_answer_are_coupled() -> None:
    net = bmc.BayesNet()
    net.table("a", probs=[0.4, 0.6], states=["no", "yes"])
    net.add("x", lambda a: bmc.Normal(4.0 * (a == "yes"), 1.0))
    answer = exact(net)
    assert answer.method == "linear-Gaussian"
    drawn = answer.sample(400, np.random.default_rng(0))
    again = answer.sample(400, np.random.default_rng(1))
    assert set(np.unique(drawn["a"])) == {0, 1}
    assert same_distribution(drawn, again, rng=0)
    shuffled = {**again, "a": np.random.default_rng(2).permutation(again["a"])}
    assert not same_distribution(drawn, shuffled, rng=0)
    curved = bmc.BayesNet()
    curved.add("x", bmc.Gamma(2.0, 1.0))
    with pytest.raises(UnsupportedError, match="quadrature has points and no draws"):
        exact(curved).sample(3, np.random.default_rng(0))


def test_answers_are_drawn_from_by_seed() -> None:
    coin = bmc.BayesNet()
    coin.add("a", bmc.Bernoulli(0.4))
    net, evidence = mixture()
    for answer in (
        exact(coin),
        exact(coin).answer,
        exact(net, evidence),
        exact(net, evidence).answer,
    ):
        once, again = answer.sample(50, 3), answer.sample(50, rng=3)
        assert all((once[n] == again[n]).all() for n in once)
        assert len(answer.sample(5)["a"]) == 5
        assert any((once[n] != answer.sample(50, 4)[n]).any() for n in once)


def test_the_error_of_an_integral_can_be_asked_for() -> None:
    net = bmc.BayesNet()
    net.add("r", bmc.Gamma(3.0, 2.0))
    net.add("n", lambda r: bmc.Poisson(r))
    rough, fine = exact(net, {"n": 4}, rtol=1e-2), exact(net, {"n": 4})
    assert fine.accuracy < rough.accuracy < 0.1
    assert rough.answer.evaluations < fine.answer.evaluations
    with pytest.raises(ValueError, match=r"exact\(rtol=0\): give a number from 1e-13"):
        exact(net, {"n": 4}, rtol=0)
    assert len(repr(fine.answer)) < 120
    assert repr(fine.answer).startswith("Quadrature(log_marginal_likelihood=-")


def test_what_cannot_be_known_finely_is_known_roughly() -> None:
    """Evaluations that are too few for the accuracy of two unknowns, and enough for 1e-4."""
    net = bmc.BayesNet()
    net.add("s", bmc.Gamma(2.0, 1.0))
    net.add("x", lambda s: bmc.Normal(0.0, s))
    net.add("y", lambda x: bmc.Normal(np.abs(x), 0.05))
    evidence = {"y": 0.1}
    fine = quadrature_posterior(net, evidence)
    assert fine.evaluations > 60_000
    rough = quadrature_posterior(net, evidence, max_evaluations=40_000)
    assert 1e-6 < rough.accuracy < 1e-3
    assert abs(rough.log_marginal_likelihood - fine.log_marginal_likelihood) < rough.accuracy
    with pytest.raises(BudgetError, match="is asked for"):
        quadrature_posterior(net, evidence, max_evaluations=40_000, rtol=1e-7)


def test_slices_that_are_not_there_and_functions_of_all_rows_are_told() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    answer = exact(dbn, {"y": [1.0, 2.0]})
    with pytest.raises(UnknownNodeError, match=r"'x\[7\]' is no node"):
        answer.mean("x[7]")
    with pytest.raises(ShapeError, match=r"returned shape \(\) for .* keep the leading axis"):
        answer.expectation(lambda x: 1.0, "x[0]")
    net = bmc.BayesNet()
    net.add("z", bmc.Bernoulli(0.3))
    with pytest.raises(ShapeError, match="keep the leading axis"):
        exact(net).expectation(lambda z: 1.0)
