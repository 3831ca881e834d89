"""Affine images against SciPy's location and scale, and against the families that are closed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import bayesmc.distributions as d
from bayesmc.errors import ParameterError, ShapeError, UnsupportedError

Q = np.array([1e-9, 0.01, 0.5, 0.99])[:, None]


@pytest.mark.parametrize(
    ("base", "scipy"),
    [
        (d.Normal(1.0, 2.0), stats.norm(1.0, 2.0)),
        (d.StudentT(4.0), stats.t(4.0)),
        (d.Gamma(2.0, 3.0), stats.gamma(2.0, scale=1 / 3)),
        (d.Beta(2.0, 0.5), stats.beta(2.0, 0.5)),
    ],
    ids=lambda v: type(v).__name__,
)
def test_density_cdf_and_moments_are_those_of_the_image(
    base: d.Distribution, scipy: object
) -> None:
    loc, scale = np.array([3.0, -1.0]), np.array([-2.0, 0.5])
    dist = d.Affine(base, loc, scale)
    x = dist.ppf(Q)
    y = (x - loc) / scale
    np.testing.assert_allclose(dist.log_prob(x), scipy.logpdf(y) - np.log(np.abs(scale)), rtol=1e-8)
    np.testing.assert_allclose(dist.cdf(x), np.broadcast_to(Q, x.shape), atol=1e-9)
    np.testing.assert_allclose(dist.mean, loc + scale * scipy.mean())
    np.testing.assert_allclose(dist.var, scale**2 * scipy.var())
    draws = dist.sample(0, 20_000)
    # false alarm 1e-6; the image under the other sign is told apart
    for k in (0, 1):
        assert stats.kstest(dist.cdf(draws)[:, k], "uniform").pvalue > 1e-6
    mirrored = d.Affine(base, loc - 0.2, -scale)
    assert stats.kstest(mirrored.cdf(draws)[:, 0], "uniform").pvalue < 1e-6


def test_bounds_are_mapped_and_swapped() -> None:
    flipped = d.Affine(d.Gamma(2.0, 1.0), 3.0, -2.0)
    assert (flipped.support.low, flipped.support.high) == (-np.inf, 3.0)
    assert flipped.log_prob(3.5) == -np.inf
    uniform = d.Affine(d.Uniform(0.0, 1.0), [1.0, 1.0], [2.0, -2.0])
    assert (uniform.support.low.tolist(), uniform.support.high.tolist()) == ([1, -1], [3, 1])
    assert d.Affine(d.Normal(), 3.0, -2.0).support.kind == "real"


def test_rounding_does_not_lose_a_draw() -> None:
    dist = d.Affine(d.Uniform(0.0, 1.0), 1e6, 1e-3)
    assert np.isfinite(dist.log_prob(dist.sample(0, 50_000))).all()
    assert np.isfinite(dist.log_prob([dist.support.low, dist.support.high])).all()


def test_vectors_are_mapped_component_by_component() -> None:
    cov = np.array([[2.0, 0.5], [0.5, 1.0]])
    loc, scale = np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([2.0, -3.0])
    dist = d.Affine(d.MvNormal([1.0, -1.0], cov), loc, scale)
    assert (dist.batch_shape, dist.event_shape) == ((2,), (2,))
    same = d.MvNormal(loc + scale * [1.0, -1.0], scale[:, None] * cov * scale)
    x = dist.sample(0, 5)
    np.testing.assert_allclose(dist.log_prob(x), same.log_prob(x), rtol=1e-12)
    np.testing.assert_allclose(dist.mean, same.mean)
    np.testing.assert_allclose(dist.var, same.var)
    one = d.Affine(d.MvNormal([1.0, -1.0], cov), 1.0, 2.0)
    np.testing.assert_allclose(one.mean, [3.0, -1.0])
    joint = d.Affine(d.Joint(d.Gamma(2.0, 1.0), d.Normal()), [1.0, 2.0], [-2.0, 3.0])
    assert joint.support.contains([[0.0, 5.0], [2.0, 5.0]]).tolist() == [True, False]


def test_tails_are_handed_on() -> None:
    far = d.Truncated(d.Affine(d.Normal(0.0, 1.0), 1.0, -2.0), 61.0)
    np.testing.assert_allclose(far.mean, d.Truncated(d.Normal(1.0, 2.0), 61.0).mean, rtol=1e-12)


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (
            lambda: d.Affine(d.Normal(), 0.0, [2.0, 0.0]),
            ParameterError,
            "not zero; got 0. at index 1",
        ),
        (lambda: d.Affine(d.Normal(), np.inf), ParameterError, "loc must be finite"),
        (lambda: d.Affine(d.Poisson(3.0)), UnsupportedError, "discrete.*deterministic node"),
        (lambda: d.Affine(d.Dirichlet([1, 1])), UnsupportedError, "sum to 1"),
        (lambda: d.Affine(d.VonMises()), UnsupportedError, "period"),
        (lambda: d.Affine(d.Wishart(3.0, np.eye(2))), UnsupportedError, "positive definite"),
        (lambda: d.Affine(d.MvNormal([0, 0], np.eye(2)), [1, 2, 3]), ShapeError, "length 2 or 1"),
        (lambda: d.Affine(d.Normal(), [1, 2], [1, 2, 3]), ShapeError, "do not broadcast"),
        (lambda: d.Affine("normal"), ParameterError, "must be a distribution"),
    ],
)
def test_what_cannot_be_mapped_is_refused(make: object, error: type, words: str) -> None:
    with pytest.raises(error, match=words):
        make()  # type: ignore[operator]
