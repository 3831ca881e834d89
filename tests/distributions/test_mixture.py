"""Mixtures against sums over their components, of one family and of several."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special, stats

import bayesmc.distributions as d
from bayesmc.distributions import mixture as mixture_module
from bayesmc.errors import ShapeError, UnsupportedError
from tests.distributions.families import FEW, assert_close


@FEW
@given(st.integers(1, 5), st.sampled_from([(), (3,), (2, 1)]), st.integers(0, 999))
def test_log_prob_is_a_log_sum_over_components(count: int, batch: tuple, seed: int) -> None:
    rng = np.random.default_rng(seed)
    weights = rng.dirichlet(np.ones(count), size=batch)
    weights /= weights.sum(axis=-1, keepdims=True)
    loc = 30 * rng.normal(size=(*batch, count))
    stacked = d.Mixture(weights, d.Normal(loc, 0.7))
    listed = d.Mixture(weights, [d.Normal(loc[..., k], 0.7) for k in range(count)])
    x = 40 * rng.normal(size=(6, *batch))
    expected = special.logsumexp(stats.norm.logpdf(x[..., None], loc, 0.7), b=weights, axis=-1)
    for dist in (stacked, listed):
        assert dist.batch_shape == batch
        assert_close(dist.log_prob(x), expected)
        np.testing.assert_allclose(dist.mean, (weights * loc).sum(-1), rtol=1e-10, atol=1e-12)
        second = (weights * (loc**2 + 0.49)).sum(-1)
        np.testing.assert_allclose(dist.var + dist.mean**2, second, rtol=1e-10)
        np.testing.assert_allclose(
            dist.cdf(x), (weights * stats.norm.cdf(x[..., None], loc, 0.7)).sum(-1), rtol=1e-9
        )
        q = rng.uniform(0.001, 0.999, size=(4, *batch))
        np.testing.assert_allclose(dist.cdf(dist.ppf(q)), q, rtol=1e-9)


def test_a_mixture_of_vectors() -> None:
    rng = np.random.default_rng(0)
    loc, weights = rng.normal(size=(5, 3, 2)), np.array([0.2, 0.3, 0.5])
    dist = d.Mixture(weights, d.MvNormal(loc, np.diag([1.0, 2.0])))
    assert (dist.batch_shape, dist.event_shape) == ((5,), (2,))
    x = rng.normal(size=(4, 5, 2))
    terms = d.MvNormal(loc, np.diag([1.0, 2.0])).log_prob(x[..., None, :])
    assert_close(dist.log_prob(x), special.logsumexp(terms, b=weights, axis=-1))
    draws = dist.sample(1, 200_000)
    # 5 x 2 means of 200,000 draws: 6 standard errors
    error = np.sqrt(dist.var / len(draws))
    assert (np.abs(draws.mean(axis=0) - dist.mean) < 6 * error).all()
    # variances of 200,000 draws: a relative standard error of at most sqrt(2 / 200,000), 9 of them
    np.testing.assert_allclose(draws.var(axis=0), dist.var, rtol=0.03)


def test_components_of_different_families_and_supports() -> None:
    dist = d.Mixture([0.25, 0.75], [d.Normal(0.0, 1.0), d.Exponential(2.0)])
    assert dist.support.kind == "real"
    expected = np.log(0.25) + d.Normal(0.0, 1.0).log_prob(-1.0)
    np.testing.assert_allclose(dist.log_prob(-1.0), expected, rtol=1e-14)
    np.testing.assert_allclose(dist.mean, 0.375)
    np.testing.assert_allclose(dist.var, 0.25 + 0.75 * 0.5 - 0.375**2, rtol=1e-14)
    assert dist.ppf([0.0, 1.0]).tolist() == [-np.inf, np.inf]


def test_supports_are_joined() -> None:
    uniform = d.Mixture([0.5, 0.5], d.Uniform([0.0, 2.0], [1.0, 3.0]))
    assert (uniform.support.low, uniform.support.high) == (0.0, 3.0)
    assert uniform.log_prob(1.5) == -np.inf
    counts = d.Mixture([0.5, 0.5], [d.Binomial(3, 0.5), d.DiscreteUniform(-1, 1)])
    assert counts.is_discrete
    assert (counts.support.low, counts.support.high) == (-1, 3)
    np.testing.assert_allclose(counts.probs_table, np.exp(counts.log_prob(np.arange(-1, 4))))
    np.testing.assert_allclose(counts.probs_table.sum(), 1.0)


@FEW
@given(st.floats(0.01, 0.99), st.integers(0, 999))
def test_discrete_quantiles_are_the_least_that_reach_q(q: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    dist = d.Mixture(rng.dirichlet([1, 1, 1]).round(3) * 0 + 1 / 3, d.Poisson(20 * rng.random(3)))
    value = dist.ppf(q)
    assert dist.cdf(value) >= q > dist.cdf(value - 1)


def test_a_component_without_weight_counts_for_nothing() -> None:
    dist = d.Mixture([1.0, 0.0], [d.Normal(0.0, 1.0), d.Gamma(0.5, 1.0)])
    assert dist.log_prob(0.0) == d.Normal(0.0, 1.0).log_prob(
        0.0
    )  # Gamma's density there is infinite
    never = d.Mixture([1.0, 0.0], [d.Normal(0.0, 1.0), d.StudentT(0.5, 0.0, 1.0)])
    assert (never.mean, never.var) == (0.0, 1.0)
    assert d.Mixture([0.5, 0.5], [d.Normal(0.0, 1.0), d.Gamma(0.5, 1.0)]).log_prob(0.0) == np.inf


def test_draws_in_blocks_are_bounded_and_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mixture_module, "_AT_ONCE", 1000)
    dist = d.Mixture([0.5, 0.5], d.Normal([[-50.0, 50.0]] * 3, 1.0))
    drawn: list[int] = []
    sample = d.Normal._sample

    def counted(self: d.Normal, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        drawn.append(int(np.prod(shape)))
        return sample(self, rng, shape)

    monkeypatch.setattr(d.Normal, "_sample", counted)
    draws = dist.sample(0, 5000)
    assert draws.shape == (5000, 3)
    assert max(drawn) <= 1000
    assert sum(drawn) == 2 * draws.size
    assert abs((draws > 0).mean() - 0.5) < 6 * 0.5 / np.sqrt(draws.size)


@pytest.mark.parametrize(
    ("components", "error", "message"),
    [
        ([d.Normal(0, 1), d.Poisson(1.0)], UnsupportedError, "cannot be mixed"),
        ([d.Normal(0, 1), d.MvNormal([0.0], [[1.0]])], ShapeError, "different event shapes"),
        ([d.Dirichlet([1, 1]), d.MvNormal([0, 0], np.eye(2))], UnsupportedError, "cannot be mixed"),
    ],
)
def test_components_that_do_not_mix_are_refused(
    components: list, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        d.Mixture([0.5, 0.5], components)


def _over(components: object, weights: tuple[float, ...] = (0.3, 0.7)) -> d.Mixture:
    return d.Mixture(list(weights), components)


#: the same two components stacked, listed, and (for the truth) alone
ANY_FAMILY = {
    "Truncated": (
        lambda: d.Truncated(d.Normal([0.0, 1.0], 1.0), 0.0, [2.0, np.inf]),
        lambda: [d.Truncated(d.Normal(0.0, 1.0), 0.0, 2.0), d.Truncated(d.Normal(1.0, 1.0), 0.0)],
    ),
    "Truncated counts": (
        lambda: d.Truncated(d.Poisson([3.0, 4.0]), [1, 2], [7, np.inf]),
        lambda: [d.Truncated(d.Poisson(3.0), 1, 7), d.Truncated(d.Poisson(4.0), 2)],
    ),
    "KernelDensity": (
        lambda: d.KernelDensity([[0.0, 1.0, 2.0], [3.0, 4.0, 5.5]]),
        lambda: [d.KernelDensity([0.0, 1.0, 2.0]), d.KernelDensity([3.0, 4.0, 5.5])],
    ),
    "Affine": (
        lambda: d.Affine(d.Exponential(1.0), 0.0, [-1.0, 2.0]),
        lambda: [d.Affine(d.Exponential(1.0), 0.0, -1.0), d.Exponential(0.5)],
    ),
    "InverseCdf": (
        lambda: d.InverseCdf(d.Density(lambda x: -((x - np.array([0.0, 4.0])) ** 4))),
        lambda: [d.InverseCdf(lambda x: -(x**4)), d.InverseCdf(lambda x: -((x - 4.0) ** 4))],
    ),
    "VonMises": (
        lambda: d.VonMises([0.0, 2.0], [1.0, 3.0]),
        lambda: [d.VonMises(0.0, 1.0), d.VonMises(2.0, 3.0)],
    ),
    "Geometric": (
        lambda: d.Geometric([0.2, 0.4]),
        lambda: [d.Geometric(0.2), d.Geometric(0.4)],
    ),
    "NegativeBinomial": (
        lambda: d.NegativeBinomial([3.0, 2.5], 0.4),
        lambda: [d.NegativeBinomial(3.0, 0.4), d.NegativeBinomial(2.5, 0.4)],
    ),
    "Multinomial": (
        lambda: d.Multinomial(5, [[0.2, 0.8], [0.5, 0.5]]),
        lambda: [d.Multinomial(5, [0.2, 0.8]), d.Multinomial(5, [0.5, 0.5])],
    ),
    "Wishart": (
        lambda: d.Wishart([4.0, 5.0], np.eye(2)),
        lambda: [d.Wishart(4.0, np.eye(2)), d.Wishart(5.0, np.eye(2))],
    ),
    "Joint": (
        lambda: d.Joint(d.Uniform(0.0, [1.0, 3.0]), d.Gamma([2.0, 3.0], 1.0)),
        lambda: [
            d.Joint(d.Uniform(0.0, 1.0), d.Gamma(2.0, 1.0)),
            d.Joint(d.Uniform(0.0, 3.0), d.Gamma(3.0, 1.0)),
        ],
    ),
}


@pytest.mark.parametrize("name", ANY_FAMILY)
def test_a_mixture_over_any_family_stacked_or_listed(name: str) -> None:
    stacked, listed = (_over(make()) for make in ANY_FAMILY[name])
    alone = ANY_FAMILY[name][1]()
    for dist in (stacked, listed):
        x = dist.sample(0, 20_000)
        assert x.shape == (20_000, *dist.event_shape)
        assert x.dtype == (np.int64 if dist.is_discrete else float)
        inside = dist.support.contains(x)
        assert inside.all()
        expected = np.logaddexp(
            np.log(0.3) + alone[0].log_prob(x), np.log(0.7) + alone[1].log_prob(x)
        )
        np.testing.assert_allclose(dist.log_prob(x), expected, rtol=1e-9, atol=1e-12)
        if dist.support.kind == "circle":
            # direction and length of a mean of 20,000 unit vectors: over 4 standard errors each
            resultant = np.exp(1j * x).mean()
            assert abs(np.angle(resultant) - dist.mean) < 0.05
            assert abs(np.abs(resultant) - np.exp(-0.5 * dist.var)) < 0.03
            continue
        # 5.5 standard errors over at most four components and two forms
        error = x.std(axis=0) / np.sqrt(len(x))
        assert (np.abs(x.mean(axis=0) - dist.mean) < 5.5 * error).all()
        # 6 standard errors of a variance where the kurtosis is at most 13, as of the families here
        np.testing.assert_allclose(x.var(axis=0), dist.var, rtol=0.15)
    if not stacked.event_shape:
        q = np.array([0.01, 0.4, 0.9])
        np.testing.assert_allclose(stacked.ppf(q), listed.ppf(q), rtol=1e-8)


def test_supports_of_products_are_joined_part_by_part() -> None:
    stacked, listed = (_over(make()) for make in ANY_FAMILY["Joint"])
    for dist in (stacked, listed):
        assert dist.support.contains([[2.5, 1.0], [3.5, 1.0], [1.0, -1.0]]).tolist() == [1, 0, 0]
    equal = _over(d.Uniform([0.0, 0.0], [2.0, 2.0]))
    assert equal.support.contains([0.5, 1.0, 3.0]).tolist() == [True, True, False]
    free = _over([d.Joint(d.Normal(), d.Gamma(1.0, 1.0)), d.MvNormal([0, 1], np.eye(2))])
    assert free.support.kind == "real vector"
    both = _over([d.Affine(d.Exponential(1.0), 0.0, -1.0), d.Exponential(1.0)])
    assert both.support.kind == "real"
    frozen = _over([stats.gumbel_r(0, 1), d.Normal()])
    np.testing.assert_allclose(
        np.exp(frozen.log_prob(1.0)), 0.3 * stats.gumbel_r.pdf(1.0) + 0.7 * stats.norm.pdf(1.0)
    )


def test_angles_and_numbers_do_not_mix() -> None:
    with pytest.raises(UnsupportedError, match="angles in radians.*one kind of space"):
        _over([d.VonMises(), d.Normal()])
