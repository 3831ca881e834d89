"""Joint: independent parts laid side by side, against each part alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import bayesmc.distributions as d
from bayesmc.errors import ParameterError, ShapeError, UnsupportedError

COV = np.array([[2.0, 0.5], [0.5, 1.0]])


def test_parts_alone_and_together() -> None:
    parts = [d.Normal([0.0, 1.0], 1.0), d.MvNormal([1.0, 2.0], COV), stats.gumbel_r(0.0, 2.0)]
    dist = d.Joint(*parts)
    assert (dist.batch_shape, dist.event_shape) == ((2,), (4,))
    x = dist.sample(0, 7)
    assert x.shape == (7, 2, 4)
    expected = (
        parts[0].log_prob(x[..., 0]) + parts[1].log_prob(x[..., 1:3]) + parts[2].logpdf(x[..., 3])
    )
    np.testing.assert_allclose(dist.log_prob(x), expected)
    np.testing.assert_array_equal(d.Joint(parts).log_prob(x), dist.log_prob(x))
    gumbel = parts[2].stats("mv")
    np.testing.assert_allclose(dist.mean[1], [1.0, 1.0, 2.0, gumbel[0]])
    np.testing.assert_allclose(dist.var[0], [1.0, 2.0, 1.0, gumbel[1]])
    cov = d.Joint(parts[:2]).cov
    np.testing.assert_allclose(cov[0], [[1, 0, 0], [0, 2, 0.5], [0, 0.5, 1]])


def test_draws_are_independent_and_fit() -> None:
    # false alarm: 1e-6 per KS test; a correlation of 0 has standard error 1 / sqrt(n): 6 of them
    dist = d.Joint(d.Gamma(2.0, 1.0), d.Laplace(1.0, 2.0))
    x = dist.sample(0, 20_000)
    for k, part in enumerate(dist.parts):
        assert stats.kstest(part.cdf(x[:, k]), "uniform").pvalue > 1e-6
    assert abs(np.corrcoef(x.T)[0, 1]) < 6 / np.sqrt(20_000)
    wrong = d.Laplace(1.1, 2.0)
    assert stats.kstest(wrong.cdf(x[:, 1]), "uniform").pvalue < 1e-6
    wide = dist.sample_to(np.random.default_rng(1), (3, 5))
    assert len(np.unique(wide)) == wide.size


def test_the_support_is_the_product_and_maps_to_the_line() -> None:
    dist = d.Joint(d.Gamma(2.0, 1.0), d.Dirichlet([1.0, 2.0]), d.Normal())
    inside = [1.0, 0.25, 0.75, -3.0]
    assert dist.support.contains([inside, [-1.0, *inside[1:]]]).tolist() == [True, False]
    assert dist.log_prob([-1.0, *inside[1:]]) == -np.inf
    x = dist.sample(0, 4)
    np.testing.assert_allclose(dist.constrain(dist.unconstrain(x)), x, rtol=1e-10)
    assert d.Joint(d.Normal(), d.MvNormal([0, 0], COV)).support.kind == "real vector"
    nested = d.Joint(d.Joint(d.Gamma(2.0, 1.0), d.Normal()), d.Gamma(1.0, 1.0))
    assert nested.support.contains([[1, -1, 1], [1, 1, -1]]).tolist() == [True, False]


def test_an_impossible_part_beats_an_infinite_density() -> None:
    dist = d.Joint(d.Gamma(0.5, 1.0), d.Uniform(0.0, 1.0))
    assert dist.log_prob([0.0, 0.5]) == np.inf
    assert dist.log_prob([0.0, 2.0]) == -np.inf


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: d.Joint(), ParameterError, "give the parts"),
        (lambda: d.Joint(d.Normal(), 3.0), ParameterError, "must be a distribution; got float"),
        (lambda: d.Joint(d.Normal(), d.Poisson(1.0)), UnsupportedError, "Poisson is discrete"),
        (lambda: d.Joint(d.Wishart(3.0, np.eye(2))), UnsupportedError, "only numbers and vectors"),
        (lambda: d.Joint(d.VonMises()), UnsupportedError, "angle"),
        (lambda: d.Joint(d.Normal([1, 2]), d.Normal([1, 2, 3])), ShapeError, "do not broadcast"),
        (lambda: d.Joint(d.Normal(), d.Normal()).log_prob(np.zeros(3)), ShapeError, r"\*\(2,\)"),
        (lambda: d.Joint(d.Dirichlet([1, 1])).cov, UnsupportedError, "no closed covariance"),
    ],
)
def test_what_cannot_be_joined_is_refused(make: object, error: type, words: str) -> None:
    with pytest.raises(error, match=words):
        make()  # type: ignore[operator]
