"""Shapes: sample_shape + batch_shape + event_shape, and independence along axes of size one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import bayesmc.distributions as d
from bayesmc.errors import ShapeError

COLUMN = np.array([[0.3], [0.6]])


def _laplace(rng: np.random.Generator, sample_shape: tuple[int, ...]) -> np.ndarray:
    return rng.laplace(size=(*sample_shape, 2, 1))


#: every family with batch shape (2, 1)
COLUMNS = {
    "Normal": d.Normal(COLUMN, 1.0),
    "MvNormal cov": d.MvNormal(np.zeros((2, 1, 3)), np.eye(3) * COLUMN[..., None, None]),
    "MvNormal tril": d.MvNormal(np.zeros((2, 1, 3)), scale_tril=np.eye(3)),
    "MvNormal diag": d.MvNormal(np.zeros(3), scale_diag=np.ones((2, 1, 3))),
    "StudentT": d.StudentT(5.0, COLUMN, 1.0),
    "Uniform": d.Uniform(COLUMN, 2.0),
    "Beta": d.Beta(COLUMN, 1.0),
    "Gamma": d.Gamma(COLUMN, 1.0),
    "Exponential": d.Exponential(COLUMN),
    "Dirichlet": d.Dirichlet(np.ones((2, 1, 3))),
    "small Dirichlet": d.Dirichlet(np.full((2, 1, 3), 0.05)),
    "Bernoulli": d.Bernoulli(COLUMN),
    "Categorical few": d.Categorical(np.full((2, 1, 4), 0.25)),
    "Categorical many": d.Categorical(np.full((2, 1, 50), 0.02)),
    "Categorical broadcast": d.Categorical(np.broadcast_to([0.5, 0.5], (2, 1, 2))),
    "Categorical logits": d.Categorical(logits=np.zeros((2, 1, 4))),
    "Binomial": d.Binomial(5, COLUMN),
    "Poisson": d.Poisson(COLUMN),
    "DiscreteUniform": d.DiscreteUniform([[0], [1]], 6),
    "Mixture": d.Mixture([0.5, 0.5], d.Normal(COLUMN[..., None] + [0, 3], 1.0)),
    "Mixture of vectors": d.Mixture([0.5, 0.5], d.MvNormal(np.zeros((2, 1, 2, 3)), np.eye(3))),
    "Mixture list": d.Mixture([0.5, 0.5], [d.Normal(COLUMN, 1.0), d.Gamma(COLUMN, 1.0)]),
    "Density": d.Density(lambda x: -np.abs(x) - 0 * COLUMN, _laplace),
    "Laplace": d.Laplace(COLUMN, 1.0),
    "Cauchy": d.Cauchy(COLUMN, 1.0),
    "HalfNormal": d.HalfNormal(COLUMN),
    "HalfCauchy": d.HalfCauchy(COLUMN),
    "LogNormal": d.LogNormal(COLUMN, 0.5),
    "InverseGamma": d.InverseGamma(2.0, COLUMN),
    "Weibull": d.Weibull(1.5, COLUMN),
    "VonMises": d.VonMises(COLUMN, 2.0),
    "WrappedNormal": d.WrappedNormal(COLUMN, 0.5),
    "Wishart": d.Wishart(5.0 + COLUMN, np.eye(3)),
    "InverseWishart": d.InverseWishart(5.0, np.eye(3) * COLUMN[..., None, None]),
    "KernelDensity": d.KernelDensity(COLUMN[..., None] + [0.0, 1.0, 3.0]),
    "KernelDensity of vectors": d.KernelDensity(
        COLUMN[..., None, None] + [[0.0, 1.0], [1.0, 0.0], [3.0, 2.0]], vectors=True
    ),
    "Truncated": d.Truncated(d.Normal(COLUMN, 1.0), 0.5, 3.0),
    "Truncated integers": d.Truncated(d.Poisson(COLUMN), 1, 4),
    "Affine": d.Affine(d.Gamma(2.0, 1.0), COLUMN, -2.0),
    "Joint": d.Joint(d.Normal(COLUMN, 1.0), d.Gamma(COLUMN, 1.0)),
    "InverseCdf": d.InverseCdf(d.Density(lambda x: -np.abs(x) - 0 * COLUMN)),
    "BetaBinomial": d.BetaBinomial(7, COLUMN, 2.0),
    "LKJ": d.LKJ(3, COLUMN),
    "Ordered": d.Ordered(d.Normal(COLUMN, 1.0), 3),
    "OrderedLogistic": d.OrderedLogistic(COLUMN, [-1.0, 0.0, 2.0]),
    "Geometric": d.Geometric(COLUMN),
    "NegativeBinomial": d.NegativeBinomial(3.0, COLUMN),
    "Multinomial": d.Multinomial(4, np.full((2, 1, 3), 1 / 3)),
    "scipy continuous": d.as_distribution(stats.gumbel_r(COLUMN)),
    "scipy discrete": d.as_distribution(stats.nbinom(5, COLUMN)),
}


def test_every_family_is_here() -> None:
    families = {
        name
        for name in d.__all__
        if isinstance(getattr(d, name), type) and issubclass(getattr(d, name), d.Distribution)
    }
    assert families - {"Distribution"} <= {type(dist).__name__ for dist in COLUMNS.values()}


@pytest.mark.parametrize("name", COLUMNS)
@pytest.mark.parametrize("sample_shape", [(), (4,), (4, 5), 4], ids=str)
def test_draws_and_log_probs_have_the_promised_shapes(name: str, sample_shape: tuple) -> None:
    dist = COLUMNS[name]
    lead = (sample_shape,) if isinstance(sample_shape, int) else sample_shape
    draws = dist.sample(np.random.default_rng(0), sample_shape)
    assert dist.batch_shape == (2, 1)
    assert draws.shape == (*lead, 2, 1, *dist.event_shape)
    assert dist.log_prob(draws).shape == (*lead, 2, 1)
    assert draws.dtype == (np.int64 if dist.is_discrete else np.float64)
    draws += 0  # writable


@pytest.mark.parametrize("name", COLUMNS)
def test_values_broadcast_with_the_batch(name: str) -> None:
    dist = COLUMNS[name]
    draws = dist.sample_to(np.random.default_rng(0), (3, 2, 6))
    log_prob = dist.log_prob(draws)
    assert log_prob.shape == (3, 2, 6)
    one = dist.log_prob(draws[1, 0, 2])
    assert one.shape == (2, 1)
    np.testing.assert_allclose(one[0, 0], log_prob[1, 0, 2], rtol=1e-12)


@pytest.mark.parametrize("name", COLUMNS)
def test_inner_axes_of_size_one_get_independent_draws(name: str) -> None:
    # 700 x 200 elements along axes that the parameters do not have. Were an axis shared, the
    # variance of its means would not shrink; independent, the means of 200 have variance var / 200,
    # estimated to 1 +- 0.053 (light tails) over 700: 0.7..1.3 is over 5 standard errors.
    dist = COLUMNS[name]
    draws = dist.sample_to(np.random.default_rng(2), (700, 2, 200)).astype(float)
    if dist.event_shape:
        draws = draws.reshape((700, 2, 200, -1))[..., len(dist.event_shape) - 1]
    if not isinstance(dist, d.Density) and not np.isfinite(dist.var).all():
        draws = np.arctan(draws)  # Cauchy's have no variance
    for row in range(2):
        for axis in (0, 1):
            means = draws[:, row].mean(axis=axis)
            ratio = means.var() * draws.shape[0 if axis == 0 else 2] / draws[:, row].var()
            # along the other axis only 200 means are left: 1 +- 0.1
            low, high = (0.6, 1.45) if axis == 0 else (0.7, 1.3)
            assert low < ratio < high, (row, axis, ratio)


def test_shared_draws_would_be_seen() -> None:
    # negative control of the test above: one draw per row, repeated along the inner axis
    draws = np.broadcast_to(d.Normal(0, 1).sample(0, (700, 1)), (700, 200))
    assert draws.mean(axis=1).var() * 200 / draws.var() > 1.3


@pytest.mark.parametrize("name", COLUMNS)
def test_moments_have_batch_and_event_shape(name: str) -> None:
    dist = COLUMNS[name]
    if isinstance(dist, d.Density):
        pytest.skip("a Density has no moments")
    assert np.shape(dist.mean) == np.shape(dist.var) == (2, 1, *dist.event_shape)


@pytest.mark.parametrize("name", COLUMNS)
def test_parameters_tell_distributions_apart(name: str) -> None:
    dist = COLUMNS[name]
    for value, extra in dist.parameters():
        assert np.broadcast_shapes(value.shape[: value.ndim - extra], (2, 1)) in ((2, 1), (2, 2))
        assert not np.isnan(value).any()


@pytest.mark.parametrize("name", COLUMNS)
def test_a_batch_that_does_not_fit_is_refused(name: str) -> None:
    with pytest.raises(ShapeError, match=r"\(2, 1\) does not broadcast to \(3,\)"):
        COLUMNS[name].sample_to(np.random.default_rng(0), (3,))


def test_finite_tables_sum_to_one_and_equal_log_prob() -> None:
    tables = 0
    for dist in COLUMNS.values():
        table = dist.probs_table
        if table is None:
            assert not dist.is_discrete or dist.support.size is None
            continue
        tables += 1
        assert table.shape == (2, 1, dist.support.size)
        np.testing.assert_allclose(table.sum(axis=-1), 1.0, rtol=1e-12)
        for k, value in enumerate(dist.support.values):
            np.testing.assert_allclose(table[..., k], np.exp(dist.log_prob(value)), rtol=1e-12)
    assert tables == 9


def test_bounds_that_depend_on_the_batch_have_no_common_size() -> None:
    support = d.DiscreteUniform([0, 1], 6).support
    assert support.size is None
    assert support.contains([0, 0]).tolist() == [True, False]
    assert d.Binomial([3, 5], 0.5).support.contains(4).tolist() == [False, True]
    assert d.Uniform([0.0, 2.0], 3.0).support.contains(1.0).tolist() == [True, False]


ARRAYS = {
    "Normal": lambda a: d.Normal(a, a),
    "StudentT": lambda a: d.StudentT(a, a, a),
    "Uniform": lambda a: d.Uniform(a, a + 1),
    "Beta": lambda a: d.Beta(a, a),
    "Gamma": lambda a: d.Gamma(a, a),
    "Dirichlet": lambda a: d.Dirichlet(a),
    "Bernoulli": lambda a: d.Bernoulli(a),
    "Categorical": lambda a: d.Categorical(a),
    "Categorical row": lambda a: d.Categorical(a[:1]),
    "Categorical column": lambda a: d.Categorical(a[0]),
    "Categorical logits": lambda a: d.Categorical(logits=a),
    "MvNormal": lambda a: d.MvNormal(a[0], scale_diag=a),
    "Mixture": lambda a: d.Mixture(a, d.Normal(a, a)),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_arguments_are_never_written_to(name: str) -> None:
    argument = np.array([[0.25, 0.75], [0.5, 0.5], [0.125, 0.875]])
    before = argument.copy()
    dist = ARRAYS[name](argument)
    draws = dist.sample(0, 10)
    kept = draws.copy()
    dist.log_prob(draws)
    dist.sample(0, 10)[...] = 0
    np.testing.assert_array_equal(argument, before)
    np.testing.assert_array_equal(draws, kept)


def test_empty_batches_work() -> None:
    for dist in (
        d.Normal(np.zeros(0), 1.0),
        d.Gamma(np.ones(0), 1.0),
        d.Categorical(np.zeros((0, 3))),
        d.Categorical(np.zeros((0, 40))),
        d.Dirichlet(np.ones((0, 3))),
        d.MvNormal(np.zeros((0, 2)), np.eye(2)),
    ):
        draws = dist.sample(0, 5)
        assert draws.shape == (5, 0, *dist.event_shape)
        assert dist.log_prob(draws).shape == (5, 0)
