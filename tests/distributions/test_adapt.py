"""Frozen SciPy distributions as distributions of the package."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy import stats

import bayesmc.distributions as d
from bayesmc.errors import ParameterError, UnsupportedError

ALARM = 1e-6

CONTINUOUS = {
    "norm": stats.norm(1.0, 2.0),
    "norm keywords": stats.norm(loc=[0.0, 1.0], scale=[[1.0], [2.0]]),
    "gumbel": stats.gumbel_r([0.0, 3.0], 2.0),
    "truncnorm": stats.truncnorm([-1.0, 0.0], 2.0),
    "pareto": stats.pareto(3.0, loc=-1.0),
    "skewnorm": stats.skewnorm(4.0),
    "histogram": stats.rv_histogram(np.histogram([1, 2, 2, 3, 3, 3], bins=3))(),
}
DISCRETE = {
    "nbinom": stats.nbinom(5, [0.3, 0.6]),
    "geom": stats.geom(0.3),
    "hypergeom": stats.hypergeom(20, 7, 12),
    "shifted poisson": stats.poisson(3.0, loc=2),
    "custom": stats.rv_discrete(values=([1, 2, 5], [0.2, 0.3, 0.5]))(),
}


@pytest.mark.parametrize("name", [*CONTINUOUS, *DISCRETE])
def test_a_wrapped_distribution_answers_like_scipy(name: str) -> None:
    frozen = CONTINUOUS.get(name) or DISCRETE[name]
    dist = d.as_distribution(frozen)
    assert dist.is_discrete == (name in DISCRETE)
    assert dist.batch_shape == np.shape(frozen.mean())
    x = frozen.ppf(np.array([0.1, 0.5, 0.9]).reshape(3, *(1,) * len(dist.batch_shape)))
    theirs = frozen.logpmf if dist.is_discrete else frozen.logpdf
    np.testing.assert_array_equal(dist.log_prob(x), theirs(x))
    np.testing.assert_array_equal(dist.cdf(x), frozen.cdf(x))
    np.testing.assert_array_equal(dist.ppf(0.3), frozen.ppf(0.3))
    np.testing.assert_array_equal(dist.mean, frozen.mean())
    np.testing.assert_array_equal(dist.var, frozen.var())
    low, high = frozen.support()
    assert (dist.log_prob(low - 1.5) == -np.inf).all()
    assert dist.support.contains(x).all()
    np.testing.assert_array_equal(dist.support.low, low)
    np.testing.assert_array_equal(dist.support.high, high)


@pytest.mark.parametrize("name", [*CONTINUOUS, *DISCRETE])
def test_draws_of_a_wrapped_distribution_fit(name: str) -> None:
    # 12 wrapped distributions, at most 4 batch elements: KS at 10^-6 each, fixed seed
    dist = d.as_distribution(CONTINUOUS.get(name) or DISCRETE[name])
    rng = np.random.default_rng(5)
    draws = dist.sample(rng, 4000)
    u = dist.cdf(draws)
    if dist.is_discrete:
        assert draws.dtype == np.int64
        u = u - rng.random(u.shape) * np.exp(dist.log_prob(draws))
    for column in u.reshape(4000, -1).T:
        assert stats.kstest(column, "uniform").pvalue > ALARM


def test_discrete_values_between_integers_have_no_mass() -> None:
    assert (d.as_distribution(stats.geom(0.3)).log_prob([1.5, np.nan]) == -np.inf).all()


def test_discrete_values_that_are_not_whole_are_refused() -> None:
    with pytest.raises(UnsupportedError, match="whole"):
        d.as_distribution(stats.poisson(3.0, loc=0.5))


def test_gaps_in_a_custom_distribution_have_no_mass() -> None:
    dist = d.as_distribution(DISCRETE["custom"])
    np.testing.assert_allclose(dist.probs_table, [0.2, 0.3, 0.0, 0.0, 0.5])


def test_gaussian_and_dirichlet_become_the_families() -> None:
    cov = np.array([[2.0, 0.3], [0.3, 1.0]])
    gaussian = d.as_distribution(stats.multivariate_normal([1.0, 2.0], cov))
    assert isinstance(gaussian, d.MvNormal)
    np.testing.assert_allclose(gaussian.cov, cov)
    assert isinstance(d.as_distribution(stats.dirichlet([1.0, 2.0, 3.0])), d.Dirichlet)


MULTIVARIATE = {
    "multivariate_t": stats.multivariate_t([1.0, 2.0], [[2.0, 0.3], [0.3, 1.0]], df=5),
    "multinomial": stats.multinomial(6, [0.2, 0.3, 0.5]),
    "wishart": stats.wishart(5, np.eye(2)),
    "invwishart": stats.invwishart(7, np.eye(2)),
    "matrix_normal": stats.matrix_normal(np.zeros((2, 3))),
    "singular normal": stats.multivariate_normal([0, 0], np.ones((2, 2)), allow_singular=True),
    "multivariate_hypergeom": stats.multivariate_hypergeom([6, 7, 8], 5),
}


@pytest.mark.parametrize("name", MULTIVARIATE)
def test_multivariate_distributions_are_wrapped(name: str) -> None:
    frozen = MULTIVARIATE[name]
    dist = d.as_distribution(frozen)
    one = np.asarray(frozen.rvs(size=2, random_state=0))[0]
    assert dist.event_shape == one.shape
    draws = dist.sample_to(np.random.default_rng(0), (4, 5))
    assert draws.shape == (4, 5, *one.shape)
    many = dist.sample_to(np.random.default_rng(1), (200,))
    assert len(np.unique(many.reshape(200, -1), axis=0)) > 10
    theirs = frozen.logpmf if dist.is_discrete else frozen.logpdf
    log_prob = dist.log_prob(draws)
    assert log_prob.shape == (4, 5)
    for index in np.ndindex(4, 5):
        np.testing.assert_allclose(log_prob[index], theirs(draws[index]), rtol=1e-12)
    assert np.isfinite(dist.parameters()[1][0]).all()
    assert dist.is_discrete == (name in ("multinomial", "multivariate_hypergeom"))


def test_multivariate_values_outside_have_no_mass() -> None:
    assert d.as_distribution(MULTIVARIATE["multinomial"]).log_prob([1.5, 1.5, 3.0]) == -np.inf
    assert d.as_distribution(MULTIVARIATE["wishart"]).log_prob(-np.eye(2)) == -np.inf


def test_a_batch_of_multivariate_distributions_is_refused() -> None:
    with pytest.raises(UnsupportedError, match="not a batch"):
        d.as_distribution(stats.multinomial([3, 4], [[0.5, 0.5], [0.2, 0.8]]))


def test_the_newer_interface_is_wrapped() -> None:
    dist = d.as_distribution(stats.Normal(mu=np.array([0.0, 1.0]), sigma=2.0))
    assert dist.batch_shape == (2,)
    np.testing.assert_allclose(dist.log_prob(0.5), d.Normal([0.0, 1.0], 2.0).log_prob(0.5))
    np.testing.assert_allclose(dist.ppf(0.3), d.Normal([0.0, 1.0], 2.0).ppf(0.3))
    np.testing.assert_array_equal(dist.var, [4.0, 4.0])
    draws = dist.sample(0, 4000)
    assert stats.kstest(draws[:, 1], stats.norm(1.0, 2.0).cdf).pvalue > ALARM
    assert dist.sample_to(np.random.default_rng(0), (3, 2)).shape == (3, 2)


def test_marked_scipy_parameters_leave_the_rest_usable() -> None:
    with d.marking_invalid():
        dist = d.as_distribution(stats.gamma([2.0, -1.0, 3.0], scale=[[1.0], [2.0]]))
    assert dist.invalid.tolist() == [[False, True, False]] * 2
    draws = dist.sample(0, 100)
    np.testing.assert_array_equal(
        dist.log_prob(draws)[..., 2], stats.gamma(3.0, scale=[1.0, 2.0]).logpdf(draws[..., 2])
    )


def test_a_scipy_distribution_without_one_valid_element_still_marks() -> None:
    with d.marking_invalid():
        dist = d.as_distribution(stats.norm(0.0, -1.0))
    assert dist.invalid.tolist() is True
    assert dist.sample(0, 5).shape == (5,)
    with pytest.raises(ParameterError, match="scipy.stats.norm"):
        d.as_distribution(stats.norm(0.0, -1.0))


@pytest.mark.parametrize("thing", [stats.norm, stats.gaussian_kde([1.0, 2.0, 4.0])])
def test_what_is_not_frozen_is_refused_with_the_remedy(thing: object) -> None:
    with pytest.raises(UnsupportedError, match=r"scipy.stats.norm\(0.0, 1.0\)"):
        d.as_distribution(thing)


@pytest.mark.parametrize("thing", [1.0, [1.0], np.zeros(3), None, "norm", lambda: 1])
def test_what_is_no_distribution_gives_none(thing: object) -> None:
    assert d.as_distribution(thing) is None


def test_a_distribution_is_returned_as_it_is() -> None:
    dist = d.Normal(0.0, 1.0)
    assert d.as_distribution(dist) is dist


def test_scipy_stats_is_not_imported() -> None:
    code = (
        "import sys, numpy; from bayesmc.distributions import *; as_distribution(numpy.zeros(2));"
        "Mixture([0.5, 0.5], Normal([0, 1], 1)).sample(0); Categorical([0.5, 0.5]).sample(0);"
        "sys.exit('scipy.stats' in sys.modules or 'scipy.linalg' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
