"""KernelDensity against scipy.stats.gaussian_kde, and its own draws, cdf and bounds of memory."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

import bayesmc.distributions as d
from bayesmc.distributions import kernel as kernel_module
from bayesmc.errors import ParameterError, ShapeError, UnsupportedError


@pytest.mark.parametrize("components", [1, 2, 4])
@pytest.mark.parametrize("rule", ["scott", "silverman"])
@pytest.mark.parametrize("weighted", [False, True])
def test_rules_agree_with_scipy(components: int, rule: str, weighted: bool) -> None:
    rng = np.random.default_rng(components)
    points = rng.normal(size=(60, components)) @ rng.normal(size=(components, components))
    weights = rng.random(60) if weighted else None
    theirs = stats.gaussian_kde(points.T, rule, weights=weights)
    vectors = components > 1
    ours = d.KernelDensity(points if vectors else points[:, 0], rule, weights, vectors=vectors)
    x = points[:9] + rng.normal(size=(9, components))
    np.testing.assert_allclose(
        ours.log_prob(x if vectors else x[:, 0]), theirs.logpdf(x.T), rtol=1e-10, atol=1e-10
    )
    np.testing.assert_allclose(
        np.squeeze(ours.kernel_cov), np.squeeze(theirs.covariance), rtol=1e-10
    )


def test_a_given_bandwidth_is_the_kernels_standard_deviation() -> None:
    points = np.array([[0.0, 1.0], [2.0, 5.0], [3.0, 3.0]])
    dist = d.KernelDensity(points, [0.5, 2.0], vectors=True)
    same = d.Mixture(np.full(3, 1 / 3), d.MvNormal(points, scale_diag=np.array([0.5, 2.0])))
    x = np.array([[1.0, 1.0], [30.0, -40.0]])
    np.testing.assert_allclose(dist.log_prob(x), same.log_prob(x), rtol=1e-12)
    np.testing.assert_allclose([dist.mean, dist.var], [same.mean, same.var], rtol=1e-12)
    scalar = d.KernelDensity(points[:, 0], 0.5, weights=[1, 2, 1])
    same = d.Mixture([0.25, 0.5, 0.25], d.Normal(points[:, 0], 0.5))
    np.testing.assert_allclose(scalar.log_prob(x), same.log_prob(x), rtol=1e-12)
    np.testing.assert_allclose([scalar.mean, scalar.var], [same.mean, same.var])
    np.testing.assert_allclose(scalar.cdf(x), same.cdf(x))
    np.testing.assert_allclose(integrate.quad(lambda v: np.exp(scalar.log_prob(v)), -5, 9)[0], 1)


def test_draws_fit() -> None:
    # two KS tests, false alarm 1e-6 each, and a window twice as wide is told apart
    rng = np.random.default_rng(0)
    points, weights = rng.normal(size=(2, 30)), rng.random(30)
    dist = d.KernelDensity(points, 0.2, weights)
    draws = dist.sample(1, 20_000)
    for k in range(2):
        assert stats.kstest(dist.cdf(draws)[:, k], "uniform").pvalue > 1e-6
    wide = d.KernelDensity(points, 0.6, weights)
    assert stats.kstest(wide.cdf(draws)[:, 0], "uniform").pvalue < 1e-6
    q = np.array([0.0, 1e-6, 0.3, 0.999, 1.0])[:, None]
    np.testing.assert_allclose(dist.cdf(dist.ppf(q)), np.broadcast_to(q, (5, 2)), atol=1e-12)
    vectors = d.KernelDensity(rng.normal(size=(50, 3)) @ rng.normal(size=(3, 3)), vectors=True)
    draws = vectors.sample(2, 50_000)
    # 6 standard errors of 3 means
    assert (np.abs(draws.mean(0) - vectors.mean) < 6 * np.sqrt(vectors.var / 50_000)).all()
    # nearly normal: 0.05 is 8 standard errors, sqrt(2 / 50,000) each
    np.testing.assert_allclose(draws.var(0), vectors.var, rtol=0.05)


def test_memory_is_bounded_and_far_points_keep_their_logs(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    points, x = rng.normal(size=500), np.append(rng.normal(size=40), [1e3, -1e6])
    whole = d.KernelDensity(points, 0.1).log_prob(x)
    monkeypatch.setattr(kernel_module, "_AT_ONCE", 300)
    sizes = []
    distances = kernel_module._squared_distances

    def counted(at: np.ndarray, centres: np.ndarray) -> np.ndarray:
        result = distances(at, centres)
        sizes.append(result.size)
        return result

    monkeypatch.setattr(kernel_module, "_squared_distances", counted)
    np.testing.assert_allclose(d.KernelDensity(points, 0.1).log_prob(x), whole, rtol=1e-13)
    assert max(sizes) <= 300 and sum(sizes) == 500 * len(x)
    assert np.isfinite(whole).all()


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: d.KernelDensity([1.0, 1.0, 1.0]), ParameterError, r"bandwidth=0\.1"),
        (lambda: d.KernelDensity([0.1, 0.1, 0.1]), ParameterError, "spread out"),
        (lambda: d.KernelDensity([1.0]), ParameterError, "spread out"),
        (lambda: d.KernelDensity([1.0, 2.0], weights=[1.0, 0.0]), ParameterError, "spread out"),
        (lambda: d.KernelDensity([[1.0, 2.0], [1.0, 1.0]]), ParameterError, "at index 1"),
        (lambda: d.KernelDensity([[1.0, 2], [2, 4], [3, 6]], vectors=True), ParameterError,
         "every direction"),
        (lambda: d.KernelDensity([1.0, 2.0], -1.0), ParameterError, "bandwidth must be positive"),
        (lambda: d.KernelDensity([1.0, 2.0], "scot"), ParameterError, "'scot' is not"),
        (lambda: d.KernelDensity([1.0, np.nan]), ParameterError, "points must be finite"),
        (lambda: d.KernelDensity([1.0, 2.0], weights=[1.0, -1.0]), ParameterError, "nonnegative"),
        (lambda: d.KernelDensity([1.0, 2.0], weights=[1.0]), ShapeError, "2 points"),
        (lambda: d.KernelDensity(1.0), ShapeError, r"\(\.\.\., n\)"),
        (lambda: d.KernelDensity([1.0, 2.0], vectors=True), ShapeError, r"\(\.\.\., n, d\)"),
        (lambda: d.KernelDensity(np.eye(2), 1.0, vectors=True).cdf(0.0), UnsupportedError, "no cdf"),
    ],
)  # fmt: skip
def test_bad_points_are_refused_with_the_fix(make: object, error: type, words: str) -> None:
    with pytest.raises(error, match=words):
        make()  # type: ignore[operator]


def test_one_point_with_a_width_is_a_normal() -> None:
    dist = d.KernelDensity([2.0], 0.5)
    assert (dist.mean, dist.var) == (2.0, 0.25)
