"""Multinomial: log probabilities against SciPy's, moments, and draws by chi-square."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.special import gammaln

import bayesmc.distributions as d
from bayesmc.testing import session
from tests.distributions.families import magnitudes

#: rate of false alarms of each goodness-of-fit test, were its seed fresh
ALARM = 1e-6
DRAWS = 20_000


@settings(max_examples=session.scaled(100, 10))
@given(
    st.integers(0, 5000),
    st.lists(magnitudes(1e-6, 1.0), min_size=1, max_size=6),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
def test_log_prob_equals_scipys(n: int, weights: list[float], as_logits: bool, seed: int) -> None:
    probs = np.array(weights) / np.sum(weights)
    x = np.random.default_rng(seed).multinomial(n, [np.full(len(probs), 1 / len(probs)), probs])
    ours = d.Multinomial(n, logits=np.log(probs) + 5.0) if as_logits else d.Multinomial(n, probs)
    theirs = stats.multinomial(n, ours.probs)
    # SciPy subtracts logarithms of factorials as large as that of n, and rounds them
    relative = 1e-9 if as_logits else 1e-10
    rounding = 4 * np.finfo(float).eps * gammaln(n + 1)
    np.testing.assert_allclose(ours.log_prob(x), theirs.logpmf(x), rtol=relative, atol=rounding)
    np.testing.assert_allclose(ours.mean, theirs.mean(), rtol=1e-12)
    np.testing.assert_allclose(ours.cov, theirs.cov(), rtol=1e-12, atol=1e-12 * n)


def test_a_batch_is_the_elements_one_by_one() -> None:
    n = np.array([[4], [30_000]])
    probs = np.array([[0.2, 0.3, 0.5], [0.0, 1.0, 0.0], [1e-9, 0.5 - 1e-9, 0.5]])
    dist = d.Multinomial(n, probs)
    draws = dist.sample(3, 200)
    assert dist.batch_shape == (2, 3)
    assert dist.event_shape == (3,)
    assert draws.shape == (200, 2, 3, 3)
    assert draws.dtype == np.int64
    assert (draws.sum(axis=-1) == n).all()
    assert dist.support.contains(draws).all()
    assert dist.mean.shape == dist.var.shape == (2, 3, 3)
    assert dist.cov.shape == (2, 3, 3, 3)
    np.testing.assert_array_equal(np.diagonal(dist.cov, axis1=-2, axis2=-1), dist.var)
    for i, j in np.ndindex(2, 3):
        one = d.Multinomial(n[i, 0], probs[j])
        expected = one.log_prob(draws[:, i, j])
        np.testing.assert_allclose(dist.log_prob(draws)[:, i, j], expected, rtol=1e-12)
    counts = dist.sample_to(np.random.default_rng(0), (7, 2, 3))
    assert counts.shape == (7, 2, 3, 3)


@pytest.mark.parametrize("n", [3, 20_000])
def test_what_is_no_count_vector_has_no_mass(n: int) -> None:
    dist = d.Multinomial(n, [0.5, 0.25, 0.25])
    bad = [
        [n, 1, 0],  # too many
        [n - 1, 0, 0],  # too few
        [n + 1, -1, 0],
        [n - 1.5, 1.5, 0],
        [n, np.nan, 0],
        [np.inf, 0, 0],
        [np.inf, -np.inf, n],
    ]
    assert (dist.log_prob(bad) == -np.inf).all()
    assert np.isfinite(dist.log_prob([n - 1, 1, 0]))
    codes = np.array([1, 1, 1], np.uint8)
    assert d.Multinomial(3, [0.5, 0.25, 0.25]).log_prob(codes) == pytest.approx(np.log(6 / 32))


def test_certainties() -> None:
    sure = d.Multinomial([0, 5], [0.0, 1.0])
    assert sure.log_prob([[0, 0], [0, 5]]).tolist() == [0.0, 0.0]
    assert sure.log_prob([[0, 0], [1, 4]]).tolist() == [0.0, -np.inf]
    assert sure.sample(0).tolist() == [[0, 0], [0, 5]]
    large = d.Multinomial(100_000, [0.0, 1.0])
    assert large.log_prob([[0, 100_000], [1, 99_999]]).tolist() == [0.0, -np.inf]
    assert d.Multinomial(7, [1.0]).sample(0).tolist() == [7]


def test_logits_keep_tails_that_probabilities_lose() -> None:
    dist = d.Multinomial([3, 30_000], logits=[0.0, -800.0])
    assert dist.log_prob([[2, 1], [29_999, 1]]) == pytest.approx(
        [np.log(3) - 800, np.log(30_000) - 800], rel=1e-14
    )


#: values computed with 50 digits from the definition
LARGE = [
    (10**8, [0.25, 0.25, 0.5], [25_001_000, 24_999_000, 50_000_000], -18.565689865672514),
    (10**8, [0.25, 0.25, 0.5], [10**8, 0, 0], -138629436.11198905),
    (10**8, [2.0**-30, 0.5 - 2.0**-30, 0.5], [3, 49_999_997, 50_000_000], -18.442227526847297),
    (
        10**15,
        [0.5, 0.25, 0.25],
        [500000100000000, 250000000000000, 249999900000000],
        -64.64378740992072,
    ),
]


@pytest.mark.parametrize(("n", "probs", "x", "expected"), LARGE)
def test_large_counts_keep_their_digits(
    n: int, probs: list[float], x: list[int], expected: float
) -> None:
    np.testing.assert_allclose(d.Multinomial(n, probs).log_prob(x), expected, rtol=1e-11)


def p_value(claimed: d.Multinomial, draws: np.ndarray) -> float:
    """Pearson's chi-square over all count vectors; rare ones (under 20 expected) are pooled."""
    n, size = int(claimed.total_count), claimed.event_shape[0]
    vectors = [v for v in itertools.product(range(n + 1), repeat=size) if sum(v) == n]
    codes = (n + 1) ** np.arange(size)
    seen = dict(zip(*np.unique(draws @ codes, return_counts=True), strict=True))
    expected = np.exp(claimed.log_prob(np.array(vectors))) * len(draws)
    counts = np.array([seen.get(int(np.dot(v, codes)), 0) for v in vectors])
    rare = expected < 20
    if rare.any():
        expected = np.append(expected[~rare], expected[rare].sum())
        counts = np.append(counts[~rare], counts[rare].sum())
    assert counts.sum() == len(draws)
    keep = expected > 1e-9
    assert (counts[~keep] == 0).all()
    return float(
        stats.chisquare(counts[keep], expected[keep] * counts.sum() / expected.sum()).pvalue
    )


FITS = [
    (5, [0.2, 0.3, 0.5]),
    (4, [0.1, 0.2, 0.3, 0.4]),
    (8, [0.7, 0.3, 0.0]),  # a last category that must never come: the other way of drawing
    (8, [0.0, 0.6, 0.4]),
    (3, [0.45, 0.55, 1e-9]),
    (1, [0.25, 0.5, 0.25]),
]


@pytest.mark.parametrize(("n", "probs"), FITS)
def test_draws_fit(n: int, probs: list[float]) -> None:
    dist = d.Multinomial(n, probs)
    assert p_value(dist, dist.sample(5, DRAWS)) > ALARM
    logits = d.Multinomial(n, logits=np.log(np.maximum(probs, 1e-300)))
    assert p_value(logits, logits.sample(6, DRAWS)) > ALARM


def test_draws_of_another_distribution_are_seen() -> None:
    # negative controls: other probabilities, and the right margins without the correlation
    claimed = d.Multinomial(5, [0.2, 0.3, 0.5])
    assert p_value(claimed, d.Multinomial(5, [0.2, 0.33, 0.47]).sample(5, DRAWS)) < ALARM
    rng = np.random.default_rng(5)
    first = rng.binomial(5, 0.2, DRAWS)
    second = np.minimum(rng.binomial(5, 0.3, DRAWS), 5 - first)
    draws = np.stack([first, second, 5 - first - second], axis=-1)
    assert p_value(claimed, draws) < ALARM


def test_covariance_of_draws_agrees() -> None:
    # six entries; products of counts are normal to a good approximation in means of 10^5, and 4.9
    # standard errors two-sided are 10^-6 each
    dist = d.Multinomial(20, [0.2, 0.3, 0.5])
    centred = dist.sample(9, 100_000) - dist.mean
    products = centred[:, :, None] * centred[:, None, :]
    error = products.std(axis=0) / np.sqrt(len(products))
    assert (np.abs(products.mean(axis=0) - dist.cov) <= 4.9 * error).all()


@pytest.mark.parametrize("shares", [10, 3, 7])
def test_a_category_of_probability_zero_never_comes(shares: int) -> None:
    # ten tenths do not sum to one in floating point: of 2^50 trials rounding spares some
    probs = np.append(np.full(shares, 1 / shares), 0.0)
    dist = d.Multinomial(2**50, probs)
    draws = dist.sample(0, 2000)
    assert (draws[:, -1] == 0).all()
    assert (draws >= 0).all()
    assert np.isfinite(dist.log_prob(draws)).all()
    # negative control: a sampler that leaves the last category the rest does draw it
    assert np.random.default_rng(0).multinomial(2**50, probs, 2000)[:, -1].any()
