"""Draws against the distributions they claim to come from, at stated false-alarm rates.

Seeds are those of the run, so a test that passes keeps passing; each comparison's false-alarm rate is
``ALARM``. Fewer than 1,000 are made here, 5,000 in a thorough run, which fails by chance at most once in 200.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

import bayesmc.distributions as d
from bayesmc.testing import session
from tests.distributions.families import FAMILIES, magnitudes, parameters_of

ALARM = 1e-6
DRAWS = 10_000
FEW = settings(max_examples=session.scaled(15, 5))


def uniforms(dist: d.Distribution, draws: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Probability integral transform: uniform if the draws are right; atoms spread at random."""
    upper = dist.cdf(draws)
    if isinstance(dist, d.Beta):
        # near one, numbers are too far apart for a steep cdf: that mass is spread at random
        edge = 1 - 1e-14
        spread = 1 - rng.random(draws.shape) * (1 - dist.cdf(edge))
        return np.where(draws > edge, spread, upper)
    if not dist.is_discrete:
        return upper
    return upper - rng.random(draws.shape) * np.exp(dist.log_prob(draws))


def p_value(dist: d.Distribution, draws: np.ndarray, rng: np.random.Generator) -> float:
    """Least Kolmogorov-Smirnov p-value over the batch, times its size (Bonferroni)."""
    u = np.sort(uniforms(dist, draws, rng).reshape(len(draws), -1), axis=0)
    steps = np.arange(len(draws) + 1)[:, None] / len(draws)
    farthest = max((steps[1:] - u).max(), (u - steps[:-1]).max())
    return float(stats.kstwo.sf(farthest, len(draws))) * u.shape[1]


@pytest.mark.parametrize("name", sorted(FAMILIES))
def test_draws_fit_over_parameters_and_batch_shapes(name: str) -> None:
    @FEW
    @given(parameters_of(name), st.integers(0, 2**32 - 1))
    def check(parameters: list[np.ndarray], seed: int) -> None:
        rng = np.random.default_rng(seed)
        dist = FAMILIES[name].make(*parameters)
        draws = dist.sample(rng, DRAWS)
        assert draws.shape == (DRAWS, *dist.batch_shape)
        assert not np.isnan(draws).any()
        assert p_value(dist, draws, rng) > ALARM

    check()


MODERATE = [(name, values) for name, family in FAMILIES.items() for values in family.moderate]


@pytest.mark.parametrize(("name", "values"), MODERATE)
def test_mean_and_variance_of_draws_agree(
    name: str, values: tuple[float, ...], rng: np.random.Generator
) -> None:
    # The two means are normal to a good approximation at 10^5 draws of light-tailed families; the
    # variance of (x - mean)^2 is estimated. 4.9 standard errors, two-sided: 10^-6 each.
    dist = FAMILIES[name].make(*values)
    x = dist.sample(rng, 100_000).astype(float)
    squares = (x - dist.mean) ** 2
    for sample, expected in ((x, dist.mean), (squares, dist.var)):
        error = sample.std() / np.sqrt(len(x))
        assert abs(sample.mean() - expected) <= 4.9 * error + 1e-12


@pytest.mark.parametrize(
    ("claimed", "drawn"),
    [
        (d.Normal(0.0, 1.0), d.Normal(0.0, 1.18)),
        (d.StudentT(3.0, 0.0, 1.0), d.Normal(0.0, 1.0)),
        (d.Gamma(2.0, 3.0), d.Gamma(2.0, 2.7)),
        (d.Beta(2.0, 3.0), d.Beta(2.2, 3.0)),
        (d.Bernoulli(0.30), d.Bernoulli(0.35)),
        (d.Poisson(3.5), d.Poisson(3.8)),
        (d.Binomial(12, 0.3), d.Poisson(3.6)),
        (d.Laplace(0.0, 1.0), d.Normal(0.0, np.sqrt(2.0))),
        (d.Cauchy(0.0, 1.0), d.Cauchy(0.15, 1.0)),
        (d.HalfNormal(1.0), d.HalfNormal(1.1)),
        (d.HalfCauchy(1.0), d.HalfNormal(1.5)),
        (d.LogNormal(0.0, 1.0), d.LogNormal(0.13, 1.0)),
        (d.InverseGamma(2.0, 3.0), d.InverseGamma(2.0, 2.7)),
        (d.Weibull(2.0, 3.0), d.Weibull(1.65, 3.0)),
        (d.VonMises(1.0, 2.0), d.WrappedNormal(1.0, 0.72)),
        (d.WrappedNormal(1.0, 1.0), d.WrappedNormal(1.15, 1.0)),
        (d.Geometric(0.3), d.Geometric(0.27)),
        (d.NegativeBinomial(3.0, 0.6), d.Poisson(4.5)),
        (d.Categorical([0.2, 0.3, 0.5]), d.Categorical([0.25, 0.3, 0.45])),
        (d.Mixture([0.5, 0.5], d.Normal([-2, 2], 1)), d.Normal(0.0, np.sqrt(5.0))),
    ],
    ids=repr,
)
def test_draws_of_another_distribution_are_seen(
    claimed: d.Distribution, drawn: d.Distribution, rng: np.random.Generator
) -> None:
    # negative control of the goodness-of-fit tests, at their own number of draws and alarm rate; the
    # distances are such that a draw of the p-value lies 4.9 standard deviations or more below the rate
    assert p_value(claimed, drawn.sample(rng, DRAWS), rng) < ALARM


@FEW
@given(
    st.lists(magnitudes(1e-6, 1.0), min_size=1, max_size=60),
    st.sampled_from([(), (1,), (3,), (2, 1)]),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
def test_categorical_draws_fit(
    weights: list[float], batch: tuple[int, ...], broadcast: bool, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    probs = np.array(weights) / np.sum(weights)
    rows = np.broadcast_to(probs, (*batch, len(probs)))
    dist = d.Categorical(rows if broadcast else rows.copy())
    draws = dist.sample(rng, DRAWS)
    assert draws.dtype == np.int64
    assert p_value(dist, draws, rng) > ALARM
    # states together, as Pearson's chi-square where its approximation holds
    counts = np.bincount(draws.reshape(-1), minlength=len(probs))
    expected = probs * draws.size
    if len(probs) > 1 and expected.min() >= 50:
        assert stats.chisquare(counts, expected * counts.sum() / expected.sum()).pvalue > ALARM


@FEW
@given(st.integers(1, 4), st.sampled_from(["cov", "scale_tril", "scale_diag"]), st.integers(0, 999))
def test_mvnormal_projections_fit(size: int, form: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = np.tril(rng.normal(size=(2, size, size))) + 3 * np.eye(size)
    loc = 10 * rng.normal(size=(2, size))
    if form == "scale_diag":
        dist = d.MvNormal(loc, scale_diag=np.linalg.diagonal(root))
    elif form == "scale_tril":
        dist = d.MvNormal(loc, scale_tril=root)
    else:
        dist = d.MvNormal(loc, root @ np.matrix_transpose(root))
    draws = dist.sample(rng, DRAWS)
    direction = rng.normal(size=size)
    variance = np.einsum("i,bij,j->b", direction, dist.cov, direction)
    z = (draws - loc) @ direction / np.sqrt(variance)
    distances = dist.squared_mahalanobis(draws)
    for k in range(2):
        assert stats.kstest(z[:, k], "norm").pvalue > ALARM
        assert stats.kstest(distances[:, k], stats.chi2(size).cdf).pvalue > ALARM


def test_mvnormal_with_a_wrong_correlation_is_seen(rng: np.random.Generator) -> None:
    # negative control of the projections
    draws = d.MvNormal([0.0, 0.0], [[1.0, 0.6], [0.6, 1.0]]).sample(rng, DRAWS)
    claimed = d.MvNormal([0.0, 0.0], [[1.0, 0.3], [0.3, 1.0]])
    assert stats.kstest(claimed.squared_mahalanobis(draws), stats.chi2(2).cdf).pvalue < ALARM


@FEW
@given(st.lists(magnitudes(0.02, 1e3), min_size=2, max_size=5), st.integers(0, 999))
def test_dirichlet_margins_fit(concentration: list[float], seed: int) -> None:
    # every component, and the sum of the first two, are Beta
    rng = np.random.default_rng(seed)
    a = np.array([concentration, concentration[::-1]])
    draws = d.Dirichlet(a).sample(rng, DRAWS)
    np.testing.assert_allclose(draws.sum(axis=-1), 1.0, rtol=1e-12)
    total = a.sum(axis=-1)
    margins = [(draws[..., k], a[:, k]) for k in range(a.shape[1])]
    if a.shape[1] > 2:
        margins.append((draws[..., 0] + draws[..., 1], a[:, 0] + a[:, 1]))
    for values, part in margins:
        for row in range(2):
            beta = d.Beta(part[row], total[row] - part[row])
            # nothing below the smallest normal number can be drawn: its mass is an atom there
            u = uniforms(beta, values[:, row], rng)
            u = np.where(values[:, row] < 1e-300, rng.random(DRAWS) * beta.cdf(1e-300), u)
            assert stats.kstest(u, "uniform").pvalue > ALARM


@FEW
@given(st.lists(magnitudes(1e-3, 1.0), min_size=1, max_size=4), st.integers(0, 999))
def test_mixture_draws_fit(weights: list[float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    probs = np.array(weights) / np.sum(weights)
    loc = 5 * rng.normal(size=(2, len(probs)))
    stacked = d.Mixture(probs, d.Normal(loc, 1.0))
    listed = d.Mixture(probs, [d.Normal(loc[:, k], 1.0) for k in range(len(probs))])
    for dist in (stacked, listed):
        assert p_value(dist, dist.sample(rng, DRAWS), rng) > ALARM
    counts = d.Mixture(probs, d.Poisson(np.abs(loc)))
    assert p_value(counts, counts.sample(rng, DRAWS), rng) > ALARM


@pytest.mark.parametrize(
    "dist", [d.InverseGamma(0.003, 1e-200), d.Weibull(0.002, 1e200), d.LogNormal(-500.0, 700.0)]
)
def test_draws_fit_to_the_ends_of_the_numbers(
    dist: d.Distribution, rng: np.random.Generator
) -> None:
    # what lies beyond the smallest and the largest number is an atom there, spread at random
    draws = dist.sample(rng, DRAWS)
    low, high = np.finfo(float).tiny, np.finfo(float).max
    random = rng.random(DRAWS)
    u = np.where(draws == low, random * dist.cdf(low), dist.cdf(draws))
    u = np.where(draws == high, 1 - random * (1 - dist.cdf(high)), u)
    assert 10 < (draws == high).sum() < 0.9 * DRAWS
    assert stats.kstest(u, "uniform").pvalue > ALARM


@pytest.mark.parametrize(
    "dist",
    [
        d.Gamma([0.005, 0.02], 1.0),
        d.Beta(0.01, [0.01, 5.0]),
        d.Beta(2.0, [0.05, 0.3]),
        d.Dirichlet([[0.01, 0.01, 0.01], [0.001, 0.5, 3.0]]),
        d.Dirichlet([0.001, 0.001, 0.001]),  # Gamma variates would all be zero in one of ten
        d.StudentT([0.05, 0.3], 0.0, 1.0),
        d.Exponential([1e-300, 1e300]),
        d.Uniform(0.1, 0.1 + 1e-16 * 3),
        d.LogNormal([0.0, 700.0, -740.0], [300.0, 10.0, 10.0]),
        d.InverseGamma([0.001, 0.02, 0.06], [[1e-200], [1.0], [1e200]]),
        d.Weibull([0.001, 0.05, 1e6], [[1e-300], [1.0], [1e300]]),
        d.Cauchy([0.0, 1e300], [1e-300, 1.0]),
        d.Geometric([1e-300, 1e-15, 1.0]),
        d.Geometric(logits=[-800.0, 800.0]),
        d.NegativeBinomial([1e-3, 1e8, 1.0], [0.999999, 0.5, 0.0]),
        d.NegativeBinomial([1.0, 1e-3], logits=[-800.0, 30.0]),
    ],
    ids=repr,
)
def test_no_draw_has_density_zero_or_infinite(
    dist: d.Distribution, rng: np.random.Generator
) -> None:
    draws = dist.sample(rng, 20_000)
    assert np.isfinite(dist.log_prob(draws)).all()
    assert dist.support.contains(draws).all()


def test_the_same_seed_gives_the_same_draws() -> None:
    dist = d.Mixture([0.3, 0.7], d.Gamma([0.5, 3.0], 1.0))
    np.testing.assert_array_equal(dist.sample(5, 100), dist.sample(5, 100))
    assert (dist.sample(5, 100) != dist.sample(6, 100)).any()
