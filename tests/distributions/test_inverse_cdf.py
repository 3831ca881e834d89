"""InverseCdf against SciPy's cdfs: modes apart, singular ends, heavy tails, batches, refusals."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import special, stats

import bayesmc as bmc
import bayesmc.distributions as d
from bayesmc.distributions.panels import adapt
from bayesmc.errors import ParameterError, UnsupportedError

Q = np.array([1e-9, 1e-4, 0.01, 0.3, 0.5, 0.77, 0.99, 1 - 1e-6])


def _peak(width: float) -> d.Density:
    return d.Density(lambda x: -0.5 * ((x - 0.37) / width) ** 2, support="unit interval")


#: an unnormalised density, the same from SciPy, and the log of its integral
KNOWN: dict[str, tuple[d.Distribution, object, float]] = {
    "normal": (d.Density(lambda x: -(x**2) / 2), stats.norm(), 0.5 * np.log(2 * np.pi)),
    "Beta(0.5, 0.5)": (
        d.Density(lambda x: -0.5 * (np.log(x) + np.log1p(-x)), support="unit interval"),
        stats.beta(0.5, 0.5),
        np.log(np.pi),
    ),
    "Beta(0.1, 3)": (
        d.Density(lambda x: -0.9 * np.log(x) + 2 * np.log1p(-x), support="unit interval"),
        stats.beta(0.1, 3),
        special.betaln(0.1, 3),
    ),
    "Cauchy": (d.Density(lambda x: -np.log1p(x**2)), stats.cauchy(), np.log(np.pi)),
    "heavy StudentT": (d.StudentT(1.5), stats.t(1.5), 0.0),
    "light Gamma": (d.Gamma(0.3, 1e-5), stats.gamma(0.3, scale=1e5), 0.0),
    "Pareto": (
        d.Density(lambda x: -1.3 * np.log(x), support=(1, np.inf)),
        stats.pareto(0.3),
        -np.log(0.3),
    ),
    "left half line": (
        d.Density(lambda x: x, support=(-np.inf, 0)),
        stats.expon(scale=1.0),
        0.0,
    ),
    "a peak of 1e-3": (_peak(1e-3), stats.norm(0.37, 1e-3), np.log(1e-3 * np.sqrt(2 * np.pi))),
    "a peak of 1e-6": (_peak(1e-6), stats.norm(0.37, 1e-6), np.log(1e-6 * np.sqrt(2 * np.pi))),
    "far out": (
        d.Density(lambda x: -0.5 * ((x - 1e6) / 3) ** 2),
        stats.norm(1e6, 3),
        np.log(3 * np.sqrt(2 * np.pi)),
    ),
    "an angle": (d.VonMises(0.0, 2.0), stats.vonmises(2.0), 0.0),
}


@pytest.mark.parametrize("name", KNOWN)
def test_known_densities(name: str) -> None:
    density, scipy, log_normalizer = KNOWN[name]
    dist = d.InverseCdf(density)
    x = dist.ppf(Q)
    np.testing.assert_allclose(dist.cdf(x), Q, atol=1e-9)
    np.testing.assert_allclose(dist.log_normalizer, log_normalizer, atol=1e-9)
    if name == "left half line":
        np.testing.assert_allclose(scipy.sf(-x), Q, atol=1e-9)
        x, scipy = x, stats.gamma(1.0, scale=1.0)
        np.testing.assert_allclose(dist.log_prob(x), scipy.logpdf(-x), atol=1e-8)
        return
    np.testing.assert_allclose(scipy.cdf(x), Q, atol=1e-9)
    np.testing.assert_allclose(dist.log_prob(x), scipy.logpdf(x), rtol=1e-8, atol=1e-8)
    if name not in ("Cauchy", "heavy StudentT", "Pareto", "an angle"):
        np.testing.assert_allclose(dist.mean, scipy.mean(), rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(dist.var, scipy.var(), rtol=1e-7)


def test_divergent_moments_are_said() -> None:
    assert np.isnan(d.InverseCdf(KNOWN["Cauchy"][0]).mean)
    assert d.InverseCdf(KNOWN["Pareto"][0]).mean == np.inf
    heavy = d.InverseCdf(d.StudentT(1.5))
    assert abs(heavy.mean) < 1e-9 and heavy.var == np.inf


def test_a_quartic() -> None:
    dist = bmc.InverseCdf(bmc.Density(lambda x: -(x**4)))
    np.testing.assert_allclose(dist.log_normalizer, np.log(2 * special.gamma(1.25)), rtol=1e-12)
    np.testing.assert_allclose(dist.var, special.gamma(0.75) / special.gamma(0.25), rtol=1e-10)


@pytest.mark.parametrize(
    ("locs", "scales"),
    [
        ([-5.0, 3.0], [0.1, 2.0]),
        ([-50.0, 300.0], [0.1, 0.2]),
        ([0.0, 100.0, -1e4], [1.0, 0.1, 10.0]),
    ],
)
def test_modes_far_apart_are_all_found(locs: list[float], scales: list[float]) -> None:
    weights = np.full(len(locs), 1 / len(locs))
    mixture = d.Mixture(weights, d.Normal(locs, scales))
    dist = d.InverseCdf(d.Density(mixture.log_prob))
    np.testing.assert_allclose(dist.log_normalizer, 0.0, atol=1e-9)
    x = (np.array(locs)[:, None] + np.array(scales)[:, None] * np.linspace(-4, 4, 9)).ravel()
    np.testing.assert_allclose(dist.cdf(x), mixture.cdf(x), atol=1e-9)
    np.testing.assert_allclose(dist.mean, mixture.mean, rtol=1e-8)
    np.testing.assert_allclose(dist.var, mixture.var, rtol=1e-8)


@pytest.mark.parametrize("support", [(0.0, 1.0), (0.0, np.inf), "real"])
def test_narrow_modes_that_no_node_sees_are_climbed(support: object) -> None:
    mixture = d.Mixture([0.2, 0.5, 0.3], d.Normal([0.2, 0.6180339, 0.8123], [1e-6, 2e-5, 1e-5]))
    dist = d.InverseCdf(d.Density(mixture.log_prob, support=support))
    np.testing.assert_allclose(dist.log_normalizer, 0.0, atol=1e-8)
    np.testing.assert_allclose(dist.cdf([0.4, 0.7, 0.9]), [0.2, 0.7, 1.0], atol=1e-8)
    np.testing.assert_allclose(dist.mean, mixture.mean, rtol=1e-8)


def test_a_spike_on_wide_mass_is_found_at_1e_3_and_below_when_named() -> None:
    def spiked(width: float) -> d.Density:
        return d.Density(
            lambda x: np.log(0.9 + 0.1 * stats.norm.pdf(x, 0.37123, width)), support="unit interval"
        )

    np.testing.assert_allclose(d.InverseCdf(spiked(1e-3)).log_normalizer, 0.0, atol=1e-9)
    named = d.InverseCdf(spiked(1e-8), points=[0.37123])
    np.testing.assert_allclose(named.log_normalizer, 0.0, atol=1e-8)


def test_a_jump() -> None:
    step = d.Density(lambda x: np.log(np.where(x < 0.3, 1.0, 3.0)), support=(0, 1))
    dist = d.InverseCdf(step, points=[0.3])
    np.testing.assert_allclose(dist.log_normalizer, np.log(2.4), atol=1e-9)
    np.testing.assert_allclose(dist.cdf(0.3), 0.125, atol=1e-8)
    np.testing.assert_allclose(dist.mean, 0.5875, atol=1e-7)


def test_a_batch_is_its_elements() -> None:
    loc, scale = np.linspace(-100, 100, 5)[:, None], np.array([0.01, 3.0])
    dist = d.InverseCdf(d.Density(lambda x: -0.5 * ((x - loc) / scale) ** 2))
    theirs = stats.norm(loc, scale)
    assert dist.batch_shape == (5, 2)
    q = Q[:, None, None]
    np.testing.assert_allclose(theirs.cdf(dist.ppf(q)), np.broadcast_to(q, (8, 5, 2)), atol=1e-9)
    np.testing.assert_allclose(dist.mean, theirs.mean() + 0 * scale, atol=1e-8)
    np.testing.assert_allclose(dist.var, theirs.var() + 0 * loc, rtol=1e-8)
    np.testing.assert_allclose(dist.log_normalizer, np.log(scale * np.sqrt(2 * np.pi)) + 0 * loc)
    column = d.InverseCdf(d.Density(lambda x: -((x - loc) ** 4)))
    wide = column.sample_to(np.random.default_rng(0), (7, 5, 3))
    assert wide.shape == (7, 5, 3) and len(np.unique(wide)) == wide.size
    assert (np.abs(wide - loc) < 3).all()
    bounded = d.InverseCdf(lambda x: -x, low=[0.0, 1.0], high=[2.0, 1.5])
    np.testing.assert_allclose(bounded.cdf([1.0, 1.2]), [
        np.expm1(-1.0) / np.expm1(-2.0), np.expm1(-0.2) / np.expm1(-0.5)], atol=1e-10)  # fmt: skip
    assert (bounded.support.low.tolist(), bounded.support.high.tolist()) == ([0, 1], [2, 1.5])


def test_draws_fit() -> None:
    # false alarm 1e-6 each; draws of a quartic a tenth wider are told apart
    dist = d.InverseCdf(d.Density(lambda x: -((x / np.array([1.0, 2.0])) ** 4)))
    draws = dist.sample(0, 20_000)
    assert draws.shape == (20_000, 2)
    for k in range(2):
        assert stats.kstest(dist.cdf(draws)[:, k], "uniform").pvalue > 1e-6
    assert stats.kstest(dist.cdf(1.1 * draws)[:, 0], "uniform").pvalue < 1e-6


def test_it_is_a_cpd() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.InverseCdf(bmc.Density(lambda x: -((x - 1.0) ** 4))))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    draws = net.sample(20_000, rng=0)
    assert abs(draws["y"].mean() - 1.0) < 6 * np.sqrt((0.338 + 1.0) / 20_000)
    truncated = d.Truncated(d.InverseCdf(d.Density(lambda x: -(x**4))), 0.0, 1.0)
    np.testing.assert_allclose(truncated.cdf(truncated.ppf(Q)), Q, atol=1e-9)


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: d.InverseCdf(lambda x: 0 * x), ParameterError, "integral diverges"),
        (lambda: d.InverseCdf(d.Density(lambda x: -np.log(x), support="unit interval")),
         ParameterError, "integral diverges"),
        (lambda: d.InverseCdf(lambda x: np.where((x > 5) & (x < 5.001), 0.0, -np.inf)),
         ParameterError, "density zero; give low= and high="),
        (lambda: d.InverseCdf(lambda x: np.where(x > 3, np.nan, -(x**2))),
         ParameterError, "log_prob must be a number"),
        (lambda: d.InverseCdf(d.Density(lambda x: -0.5 * ((x - 1e9) / 0.01) ** 2,
         support="positive")), ParameterError, "too narrow.*give low=, high="),
        (lambda: d.InverseCdf(d.Normal(), [0, 1], [1.0, 0]), ParameterError, "at index 1"),
        (lambda: d.InverseCdf(d.Poisson(3.0)), UnsupportedError, "Poisson is discrete"),
        (lambda: d.InverseCdf(d.MvNormal([0, 0], np.eye(2))), UnsupportedError, "vectors"),
        (lambda: d.InverseCdf(d.Normal(), [0.0, -np.inf]), UnsupportedError, "finite for some"),
        (lambda: d.InverseCdf(3.0), ParameterError, "got float"),
    ],
)  # fmt: skip
def test_what_is_not_resolved_is_refused(make: Callable, error: type, words: str) -> None:
    with pytest.raises(error, match=words):
        make()


def test_a_bad_element_is_marked_where_it_does_not_count() -> None:
    rate = np.array([1.0, -1.0])
    with d.marking_invalid():
        dist = d.InverseCdf(d.Density(lambda x: -rate * x, support="positive"))
    assert dist.invalid.tolist() == [False, True]
    np.testing.assert_allclose(dist.mean[0], 1.0)


def test_panels_report_an_error_that_they_could_not_remove() -> None:
    edges = np.linspace(-1.0, 1.0, 5)[:, None]
    rough = adapt(lambda x: np.sin(1e17 * x), edges, 1e-10)
    assert rough.error[0] > 1e-8
    smooth = adapt(lambda x: -x, edges, 1e-10)
    assert smooth.error[0] <= 1e-10
    np.testing.assert_allclose(
        smooth.total * np.exp(smooth.log_scale), 2 * np.sinh(1.0), rtol=1e-13
    )
