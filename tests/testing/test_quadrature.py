"""Adaptive quadrature against closed forms and enumeration, and what it refuses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.stats

import bayesmc as bmc
from bayesmc.errors import (
    BudgetError,
    DensityError,
    ParameterError,
    UnknownNodeError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.testing import enumerate_posterior
from bayesmc.testing.oracles.cells import clenshaw_curtis, integrate
from bayesmc.testing.oracles.quadrature import Quadrature, quadrature_posterior

LEVELS = np.array([0.01, 0.3, 0.5, 0.99])


def agrees(found: Quadrature, name: str, exact: Any, log_evidence: float) -> None:
    """Everything that a frozen SciPy distribution tells of one number."""
    spread = exact.std()
    tolerance = max(found.accuracy, 1e-9)
    assert tolerance < 1e-5
    assert found.log_marginal_likelihood == pytest.approx(log_evidence, abs=tolerance)
    assert found.mean(name) == pytest.approx(exact.mean(), abs=tolerance * spread)
    assert found.var(name) == pytest.approx(exact.var(), rel=1e-5)
    np.testing.assert_allclose(found.quantile(name, LEVELS), exact.ppf(LEVELS), atol=1e-5 * spread)
    points = exact.mean() + spread * np.array([-1.5, 0.0, 2.0])
    np.testing.assert_allclose(found.cdf(name, points), exact.cdf(points), atol=1e-6)


def test_a_normal_mean_with_ten_thousand_observations() -> None:
    """The peak is a thousandth of the prior wide."""
    n, rng = 10_000, np.random.default_rng(0)
    data = rng.normal(7.0, 1.0, n)
    net = bmc.BayesNet(plates={"i": n})
    net.add("m", bmc.Normal(0.0, 10.0))
    net.add("y", lambda m: bmc.Normal(m, 1.0), plates="i")
    found = quadrature_posterior(net, {"y": data})
    precision = 0.01 + n
    mean = data.sum() / precision
    evidence = (
        scipy.stats.norm.logpdf(data).sum()
        + scipy.stats.norm.logpdf(0.0, 0.0, 10.0)
        - scipy.stats.norm.logpdf(0.0, mean, precision**-0.5)
    )
    agrees(found, "m", scipy.stats.norm(mean, precision**-0.5), evidence)


def beta_binomial() -> tuple[bmc.BayesNet, dict[str, Any], Any, float]:
    net = bmc.BayesNet()
    net.add("x", bmc.Beta(0.5, 0.5))
    net.add("k", lambda x: bmc.Binomial(40, x))
    evidence = scipy.stats.betabinom.logpmf(2, 40, 0.5, 0.5)
    return net, {"k": 2}, scipy.stats.beta(2.5, 38.5), evidence


def singular_end() -> tuple[bmc.BayesNet, dict[str, Any], Any, float]:
    net, _, _, _ = beta_binomial()
    evidence = scipy.stats.betabinom.logpmf(0, 40, 0.5, 0.5)
    return net, {"k": 0}, scipy.stats.beta(0.5, 40.5), evidence


def gamma_poisson() -> tuple[bmc.BayesNet, dict[str, Any], Any, float]:
    net = bmc.BayesNet()
    net.add("x", bmc.Gamma(0.5, 0.1))
    net.add("n", lambda x: bmc.Poisson(x))
    evidence = scipy.stats.nbinom.logpmf(4, 0.5, 0.1 / 1.1)
    return net, {"n": 4}, scipy.stats.gamma(4.5, scale=1 / 1.1), evidence


def below_a_bound() -> tuple[bmc.BayesNet, dict[str, Any], Any, float]:
    """A support that grows downwards, so that free numbers run against the values."""
    net = bmc.BayesNet()
    net.add("x", bmc.Affine(bmc.Gamma(2.0, 1.0), 3.0, -1.0))
    net.add("n", lambda x: bmc.Poisson(3.0 - x))
    evidence = scipy.stats.nbinom.logpmf(1, 2.0, 0.5)
    posterior = scipy.stats.gamma(3.0, scale=0.5)

    class Mirrored:
        mean, std, var = lambda s: 3 - 1.5, posterior.std, posterior.var
        ppf, cdf = lambda s, q: 3 - posterior.isf(q), lambda s, x: posterior.sf(3 - x)

    return net, {"n": 1}, Mirrored(), evidence


def uniform_of_a_width() -> tuple[bmc.BayesNet, dict[str, Any], Any, float]:
    """A density that jumps: y uniform below x, x above its least value by a Pareto law."""
    net = bmc.BayesNet()
    net.add("x", bmc.Uniform(0.0, 1.0))
    net.add("y", lambda x: bmc.Uniform(0.0, x))
    posterior = scipy.stats.loguniform(0.3, 1.0)
    return net, {"y": 0.3}, posterior, float(np.log(-np.log(0.3)))


@pytest.mark.parametrize(
    "case", [beta_binomial, singular_end, gamma_poisson, below_a_bound, uniform_of_a_width]
)
def test_bounded_supports(case: Callable[[], Any]) -> None:
    net, evidence, exact, log_evidence = case()
    agrees(quadrature_posterior(net, evidence), "x", exact, log_evidence)


def test_two_far_modes() -> None:
    """Peaks 1e-5 of the prior wide, 1.8e5 of their widths apart."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1000.0))
    net.add("y", lambda x: bmc.Normal(np.abs(x), 0.01))
    found = quadrature_posterior(net, {"y": 900.0})
    one = scipy.stats.norm.logpdf(900.0, 0.0, np.hypot(1000.0, 0.01))
    assert found.log_marginal_likelihood == pytest.approx(one + np.log(2.0), abs=1e-8)
    assert found.mean("x") == pytest.approx(0.0, abs=1e-3)
    width = np.sqrt(found.expectation(lambda x: (np.abs(x) - 900.0) ** 2, "x"))
    assert width == pytest.approx(0.01, rel=1e-6)
    assert found.cdf("x", 0.0) == pytest.approx(0.5, abs=1e-7)
    # a negative control: a fixed rule of 32 points sees neither peak, and says so
    fixed = enumerate_posterior(net, {"y": 905.0})
    assert fixed.accuracy > 1.0


def test_far_modes_by_label() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical([0.3, 0.7]))
    net.add("x", lambda a: bmc.Normal(np.where(a == 1, 500.0, -500.0), 1.0))
    net.add("y", lambda x: bmc.StudentT(3.0, x, 1.0))
    found = quadrature_posterior(net, {"y": 0.0})
    # both labels are 500 away from what was seen, and equally far
    np.testing.assert_allclose(found.probabilities("a"), [0.3, 0.7], atol=1e-8)
    np.testing.assert_allclose(found.probabilities("a").sum(), 1.0)
    assert found.mean("x") == pytest.approx(0.4 * 500.0, abs=0.02)


def test_heavy_tails() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Cauchy(0.0, 1.0))
    net.add("y", lambda x: bmc.Cauchy(x, 1.0))
    found = quadrature_posterior(net, {"y": 20.0})
    assert found.log_marginal_likelihood == pytest.approx(
        scipy.stats.cauchy.logpdf(20.0, 0.0, 2.0), abs=1e-7
    )
    assert found.cdf("x", 10.0) == pytest.approx(0.5, abs=1e-7)
    assert found.quantile("x", 0.5) == pytest.approx(10.0, abs=1e-3)


def test_mean_and_scale() -> None:
    n, rng = 40, np.random.default_rng(1)
    data = rng.normal(0.7, 2.0, n)
    net = bmc.BayesNet(plates={"i": n})
    net.add("tau", bmc.Gamma(2.0, 3.0))
    net.add("m", lambda tau: bmc.Normal(1.0, 1 / np.sqrt(0.5 * tau)))
    net.add("y", lambda m, tau: bmc.Normal(m, 1 / np.sqrt(tau)), plates="i")
    found = quadrature_posterior(net, {"y": data})
    k, a = 0.5 + n, 2 + n / 2
    b = 3 + 0.5 * data.var() * n + 0.5 * n * (data.mean() - 1) ** 2 / (2 * k)
    evidence = scipy.special.gammaln(a) - scipy.special.gammaln(2) + 2 * np.log(3) - a * np.log(b)
    evidence += 0.5 * np.log(0.5 / k) - n / 2 * np.log(2 * np.pi)
    agrees(found, "tau", scipy.stats.gamma(a, scale=1 / b), evidence)
    centre = (0.5 + n * data.mean()) / k
    agrees(found, "m", scipy.stats.t(2 * a, centre, np.sqrt(b / a / k)), evidence)


def test_a_banana() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 3.0))
    net.add("b", lambda a: bmc.Normal(a**2, 0.3))
    net.add("y", lambda b: bmc.Normal(b, 1.0))
    found = quadrature_posterior(net, {"y": 4.0}, rtol=1e-5)

    def height(a: float) -> float:
        return float(
            scipy.stats.norm.pdf(a, 0.0, 3.0) * scipy.stats.norm.pdf(4.0, a * a, np.hypot(0.3, 1))
        )

    line = np.linspace(-6.0, 6.0, 4001)
    total = np.trapezoid([height(a) for a in line], line)
    assert found.log_marginal_likelihood == pytest.approx(np.log(total), abs=1e-5)
    assert found.mean("a") == pytest.approx(0.0, abs=1e-4)


def test_vectors() -> None:
    rng = np.random.default_rng(3)
    root = np.tril(rng.normal(size=(2, 2))) + np.eye(2)
    cov = root @ root.T
    net = bmc.BayesNet()
    net.add("x", bmc.MvNormal(np.zeros(2), cov))
    net.add("y", lambda x: bmc.Normal(x.sum(axis=-1), 0.05))
    found = quadrature_posterior(net, {"y": 1.3})
    ones = np.ones(2)
    gain = cov @ ones / (ones @ cov @ ones + 0.0025)
    left = cov - np.outer(gain, ones @ cov)
    np.testing.assert_allclose(found.mean("x"), gain * 1.3, atol=1e-8)
    np.testing.assert_allclose(found.var("x"), np.diag(left), rtol=1e-6)
    exact = scipy.stats.norm.ppf(0.9, gain * 1.3, np.sqrt(np.diag(left)))
    np.testing.assert_allclose(found.quantile("x", 0.9), exact, atol=1e-6)


def test_a_simplex() -> None:
    net = bmc.BayesNet()
    net.add("w", bmc.Dirichlet([0.5, 1.0, 2.0]))
    net.add("c", lambda w: bmc.Multinomial(30, w))
    found = quadrature_posterior(net, {"c": [3, 7, 20]}, rtol=1e-5)
    shape = np.array([3.5, 8.0, 22.0])
    evidence = scipy.stats.dirichlet_multinomial.logpmf([3, 7, 20], [0.5, 1, 2], 30)
    assert found.log_marginal_likelihood == pytest.approx(evidence, abs=1e-5)
    np.testing.assert_allclose(found.mean("w"), shape / 33.5, atol=1e-5)
    # components are no numbers of their own: their cdf comes from the points
    below = scipy.stats.beta.cdf(0.25, shape, 33.5 - shape)
    np.testing.assert_allclose(found.cdf("w", 0.25), below, atol=2e-2)


def test_angles() -> None:
    """A posterior across the cut at pi."""
    net = bmc.BayesNet()
    net.add("x", bmc.VonMises(3.0, 2.0))
    net.add("y", lambda x: bmc.VonMises(x, 4.0))
    found = quadrature_posterior(net, {"y": -3.0})
    turn = 2 * np.exp(3.0j) + 4 * np.exp(-3.0j)
    exact = scipy.stats.vonmises(abs(turn), np.angle(turn))
    first = found.expectation(lambda x: np.cos(x), "x")
    assert first == pytest.approx(exact.expect(np.cos), abs=1e-7)
    assert found.mean("x") == pytest.approx(np.angle(turn), abs=1e-7)
    length = scipy.special.i1e(abs(turn)) / scipy.special.i0e(abs(turn))
    assert found.var("x") == pytest.approx(-2 * np.log(length), abs=1e-7)


def test_plates_and_supports_that_depend_on_parents() -> None:
    """Two elements, one observed; a bound that is itself unknown."""
    net = bmc.BayesNet(plates={"i": 2})
    net.add("top", bmc.Uniform(1.0, 2.0))
    net.add("x", lambda top: bmc.Uniform(0.0, top), plates="i")
    net.add("y", lambda x: bmc.Normal(x, 0.5), plates="i")
    seen = {"x": np.array([0.9, np.nan]), "y": np.array([0.7, 1.1])}
    found = quadrature_posterior(net, seen, rtol=1e-4)
    coarse = enumerate_posterior(net, seen, points=400)
    assert found.mean("x")[0] == pytest.approx(0.9, abs=1e-12)
    np.testing.assert_allclose(found.mean("x"), coarse.mean("x"), atol=5e-4)
    assert found.mean("top") == pytest.approx(coarse.mean("top"), abs=5e-4)
    assert found.log_marginal_likelihood == pytest.approx(coarse.log_marginal_likelihood, abs=5e-4)


def test_leaves_are_put_back() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Gamma(2.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 0.2))
    net.add("next", lambda x: bmc.Normal(2.0 * x, 0.5))
    net.add("twice", lambda next: 2.0 * next)
    net.add("flag", lambda next: bmc.Bernoulli(1 / (1 + np.exp(-next))))
    net.add("count", lambda x: bmc.Poisson(x))
    net.add("more", lambda count: count + 1)
    found = quadrature_posterior(net, {"y": 1.5})
    assert found.left_out == ("count", "more")
    assert found.names == ("x", "y", "next", "twice", "flag")
    assert found.mean("next") == pytest.approx(2.0 * found.mean("x"), abs=1e-9)
    assert found.mean("twice") == pytest.approx(4.0 * found.mean("x"), abs=1e-9)
    spread = 4 * found.var("x") + 0.25
    assert found.var("next") == pytest.approx(spread, rel=1e-7)
    x, weights = found.values("x"), found.weights
    below = weights @ scipy.stats.norm.cdf(3.0, 2.0 * x, 0.5)
    assert found.cdf("next", 3.0) == pytest.approx(below, abs=1e-10)
    assert found.cdf("next", found.quantile("next", 0.2)) == pytest.approx(0.2, abs=1e-9)
    assert found.cdf("flag", [-1.0, 0.0, 1.0]) == pytest.approx([0.0, 1 - found.mean("flag"), 1.0])
    assert found.quantile("flag", [0.01, 0.9]).tolist() == [0.0, 1.0]
    assert found.quantile("y", 0.5) == 1.5
    with pytest.raises(UnknownNodeError, match="left out"):
        found.mean("more")


def test_everything_finite() -> None:
    net = bmc.BayesNet()
    net.add("n", bmc.DiscreteUniform(1, 6))
    net.add("k", lambda n: bmc.Binomial(n, 0.5))
    net.add("y", lambda k: bmc.Normal(k, 1.0))
    found, listed = quadrature_posterior(net, {"y": 2.2}), enumerate_posterior(net, {"y": 2.2})
    assert found.accuracy == 0.0
    np.testing.assert_allclose(found.probabilities("n"), listed.probabilities("n"), atol=1e-12)
    assert found.mean("k") == pytest.approx(float(listed.mean("k")), abs=1e-12)
    assert found.log_marginal_likelihood == pytest.approx(listed.log_marginal_likelihood, abs=1e-12)


def test_potentials_and_inputs() -> None:
    net = bmc.BayesNet()
    net.input("shift")
    net.add("x", lambda shift: bmc.Normal(shift, 1.0))
    net.potential("tilt", lambda x: 0.5 * x)
    found = quadrature_posterior(net, inputs={"shift": 2.0})
    assert found.mean("x") == pytest.approx(2.5, abs=1e-8)
    assert found.log_marginal_likelihood == pytest.approx(0.5 * 2.0 + 0.125, abs=1e-8)


def test_refusals() -> None:
    net = bmc.BayesNet(plates={"i": 5})
    net.add("x", bmc.Normal(0.0, 1.0), plates="i")
    net.add("y", lambda x: bmc.StudentT(3.0, x, 1.0), plates="i")
    with pytest.raises(
        UnsupportedError, match=r"5 continuous unknowns \('x'\), 4 at most; observe"
    ):
        quadrature_posterior(net, {"y": np.zeros(5)})
    net = bmc.BayesNet()
    net.add("n", bmc.Poisson(2.0))
    net.add("y", lambda n: bmc.Normal(n, 1.0))
    with pytest.raises(UnsupportedError, match="'n' has too many values to list"):
        quadrature_posterior(net, {"y": 0.0})
    net = bmc.BayesNet(plates={"i": 20})
    net.add("z", bmc.Bernoulli(0.5), plates="i")
    net.add("y", lambda z: bmc.Normal(z, 1.0), plates="i")
    with pytest.raises(BudgetError, match="1048576 joint states"):
        quadrature_posterior(net, {"y": np.zeros(20)})
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    with pytest.raises(BudgetError, match="larger rtol="):
        quadrature_posterior(net, {"y": 0.0}, rtol=1e-13, max_evaluations=20)
    with pytest.raises(ValueError, match="rtol=2"):
        quadrature_posterior(net, {"y": 0.0}, rtol=2.0)
    with pytest.raises(ValueError, match="strictly between"):
        quadrature_posterior(net, {"y": 0.0}).quantile("x", 1.0)


def test_mass_beyond_floating_point_is_refused() -> None:
    net = bmc.BayesNet()
    net.add("p", bmc.Beta(0.01, 0.02))
    net.add("k", lambda p: bmc.Binomial(5, p))
    with pytest.raises(UnsupportedError, match="closer to a bound of the hidden 'p'"):
        quadrature_posterior(net, {"k": 0})


def test_impossible_evidence_and_bad_parameters() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Uniform(0.0, np.where(x > 50.0, 10.0, 1.0)))
    with pytest.raises(ZeroProbabilityError):
        quadrature_posterior(net, {"y": 2.0})
    bad = bmc.BayesNet()
    bad.add("x", bmc.Normal(0.0, 1.0))
    bad.add("y", lambda x: bmc.Normal(0.0, np.where(x > 5.5, -1.0, 1.0)))
    # where the mass is, a bad scale is a fault; a thousand widths off it is not
    with pytest.raises(ParameterError, match="node 'y'.*scale"):
        quadrature_posterior(bad, {"y": 0.0})
    bad.add("y", lambda x: bmc.Normal(0.0, np.where(x > 1000.0, -1.0, 1.0)), replace=True)
    assert quadrature_posterior(bad, {"y": 0.0}).mean("x") == pytest.approx(0.0, abs=1e-8)
    with pytest.raises(DensityError, match="node 'x'.*nan"):
        odd = bmc.BayesNet()
        odd.add("x", bmc.Density(lambda x: np.where(np.abs(x) > 2.5, np.nan, -(x**2))))
        odd.add("y", lambda x: bmc.Normal(x, 1.0))
        quadrature_posterior(odd, {"y": 0.0})


def test_the_rule_and_the_cells() -> None:
    rule = clenshaw_curtis(6)
    for power in range(7):
        exact = (1 + (-1) ** power) / (power + 1)
        assert rule.weights @ rule.nodes**power == pytest.approx(exact, abs=1e-14)
        if power <= 3:
            assert rule.coarse @ rule.nodes**power == pytest.approx(exact, abs=1e-14)
    # a ridge across the axes, and a corner
    found = integrate(
        lambda w: -np.abs(w @ [1.0, 2.0])[None],
        (np.zeros((1, 2)) - 1.0, np.ones((1, 2))),
        rtol=1e-4,
        order=8,
        max_evaluations=1_000_000,
        max_batch=10_000,
    )
    side = np.linspace(-1, 1, 1001)
    grid = np.exp(-np.abs(side[:, None] + 2 * side))
    exact = np.trapezoid(np.trapezoid(grid, side, axis=0), side)
    assert found.log_integral == pytest.approx(np.log(exact), abs=1e-4)
    assert np.exp(found.log_weights()).sum() == pytest.approx(1.0, abs=1e-12)
    assert found.first_axis_cdf()(np.array([-1.0, 0.0, 1.0])) == pytest.approx(
        [0, 0.5, 1], abs=1e-4
    )
