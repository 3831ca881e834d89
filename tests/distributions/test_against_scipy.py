"""Log densities, distribution functions and quantiles against SciPy's, over wide parameters."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special, stats

import bayesmc.distributions as d
from tests.distributions.families import (
    FAMILIES,
    FEW,
    assert_close,
    magnitudes,
    parameters_of,
    points_of,
)

NAMES = sorted(FAMILIES)


@pytest.mark.parametrize("name", NAMES)
def test_log_prob_equals_scipys(name: str) -> None:
    family = FAMILIES[name]

    @FEW
    @given(parameters_of(name), st.integers(0, 2**32 - 1))
    def check(parameters: list[np.ndarray], seed: int) -> None:
        ours, theirs = family.make(*parameters), family.scipy(*parameters)
        x = points_of(theirs, np.random.default_rng(seed), (4, 2, 3))
        log_density = theirs.logpmf if ours.is_discrete else theirs.logpdf
        with np.errstate(all="ignore"):
            expected = log_density(x)
        assert_close(ours.log_prob(x), expected)

    check()


@pytest.mark.parametrize("name", NAMES)
def test_cdf_and_ppf_equal_scipys(name: str) -> None:
    family = FAMILIES[name]

    @FEW
    @given(parameters_of(name), st.integers(0, 2**32 - 1))
    def check(parameters: list[np.ndarray], seed: int) -> None:
        ours, theirs = family.make(*parameters), family.scipy(*parameters)
        rng = np.random.default_rng(seed)
        x = points_of(theirs, rng, (4, 2, 3))
        np.testing.assert_allclose(ours.cdf(x), theirs.cdf(x), rtol=1e-9, atol=1e-14)
        q = rng.random((4, 2, 3))
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # SciPy's beta quantile gives up on some tails, aloud
            expected = theirs.ppf(q)
        if ours.is_discrete:
            # where q falls within rounding of a step, either side is right
            near = np.abs(theirs.cdf(expected) - q) < 1e-9
            near |= np.abs(theirs.cdf(expected - 1) - q) < 1e-9
            assert (near | (ours.ppf(q) == expected)).all()
        else:
            np.testing.assert_allclose(ours.ppf(q), expected, rtol=1e-8, atol=1e-300)

    check()


@pytest.mark.parametrize("name", NAMES)
def test_moments_equal_scipys(name: str) -> None:
    family = FAMILIES[name]

    @FEW
    @given(parameters_of(name))
    def check(parameters: list[np.ndarray]) -> None:
        ours, theirs = family.make(*parameters), family.scipy(*parameters)
        with np.errstate(all="ignore"):
            mean, var = theirs.mean(), theirs.var()
        assert ours.mean.shape == ours.var.shape == ours.batch_shape
        np.testing.assert_allclose(ours.mean, mean, rtol=1e-10)
        # SciPy's binomial variance is n p - n p^2, which cancels as p nears one
        spare = 1e-12 * np.abs(mean) if name.startswith(("Binomial", "Bernoulli")) else 0.0
        assert (np.isclose(ours.var, var, rtol=1e-8, atol=spare, equal_nan=True)).all()

    check()


@FEW
@given(st.lists(magnitudes(0.02, 1e4), min_size=1, max_size=6), st.integers(0, 2**32 - 1))
def test_dirichlet_log_prob_equals_scipys(concentration: list[float], seed: int) -> None:
    x = np.random.default_rng(seed).dirichlet(np.full(len(concentration), 2.0), size=4)
    expected = [stats.dirichlet.logpdf(row / row.sum(), concentration) for row in x]
    assert_close(d.Dirichlet(concentration).log_prob(x / x.sum(-1, keepdims=True)), expected)


@FEW
@given(st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_mvnormal_log_prob_equals_scipys(size: int, seed: int) -> None:
    # SciPy goes through eigenvalues, which lose digits as the condition grows; it is kept moderate
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(size, size)) + 3 * np.eye(size)
    cov, loc = root @ root.T, 100 * rng.normal(size=size)
    cov = (cov + cov.T) / 2
    x = loc + rng.normal(size=(7, size)) @ root.T
    expected = stats.multivariate_normal(loc, cov).logpdf(x).reshape(7)
    assert_close(d.MvNormal(loc, cov).log_prob(x), expected)
    assert_close(d.MvNormal(loc, scale_tril=np.linalg.cholesky(cov)).log_prob(x), expected)
    scales = np.sqrt(np.diagonal(cov))
    diagonal = stats.multivariate_normal(loc, np.diag(scales**2)).logpdf(x).reshape(7)
    assert_close(d.MvNormal(loc, scale_diag=scales).log_prob(x), diagonal)


@FEW
@given(
    st.lists(magnitudes(1e-9, 1.0), min_size=1, max_size=40),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
def test_categorical_log_prob_equals_scipys(
    weights: list[float], as_logits: bool, seed: int
) -> None:
    probs = np.array(weights) / np.sum(weights)
    if as_logits:  # any constant may be added
        ours = d.Categorical(logits=np.log(probs) + 37.0)
    else:
        ours = d.Categorical(probs)
    x = np.random.default_rng(seed).integers(-2, len(probs) + 2, size=(3, 20))
    theirs = stats.rv_discrete(values=(np.arange(len(probs)), probs))
    with np.errstate(divide="ignore"):
        expected = theirs.logpmf(x)
    # logits carry an absolute error of one rounding of the largest logit
    np.testing.assert_allclose(ours.log_prob(x), expected, rtol=1e-10, atol=1e-13 * as_logits)


BOUNDARIES = [
    (d.Beta(0.5, 2.0), stats.beta(0.5, 2.0), [0.0, 1.0, -0.1, 1.1, -np.inf, np.inf]),
    (d.Beta(1.0, 1.0), stats.beta(1.0, 1.0), [0.0, 1.0]),
    (d.Beta(2.0, 0.5), stats.beta(2.0, 0.5), [0.0, 1.0]),
    (d.Gamma(0.5, 1.0), stats.gamma(0.5), [0.0, -1.0, -np.inf]),
    (d.Gamma(1.0, 1.0), stats.gamma(1.0), [0.0, -1e-300]),
    (d.Gamma(2.0, 1.0), stats.gamma(2.0), [0.0]),
    (d.Exponential(2.0), stats.expon(scale=0.5), [0.0, -1.0, np.inf]),
    (d.Uniform(-1.0, 2.0), stats.uniform(-1, 3), [-1.0, 2.0, -1.0001, 2.0001, np.inf, -np.inf]),
    (d.Normal(0.0, 1.0), stats.norm(), [np.inf, -np.inf]),
    (d.StudentT(3.0, 0.0, 1.0), stats.t(3.0), [np.inf, -np.inf]),
    (d.Poisson(0.0), stats.poisson(0.0), [0, 1, -1]),
    (d.Binomial(5, 0.0), stats.binom(5, 0.0), [0, 1, 5, -1, 6]),
    (d.Binomial(5, 1.0), stats.binom(5, 1.0), [0, 5]),
    (d.Binomial(0, 0.5), stats.binom(0, 0.5), [0, 1]),
    (d.BetaBinomial(7, 0.5, 3.0), stats.betabinom(7, 0.5, 3.0), [0, 3, 7, -1, 8]),
    (d.BetaBinomial(0, 0.5, 3.0), stats.betabinom(0, 0.5, 3.0), [0, 1]),
    (d.Bernoulli(0.0), stats.bernoulli(0.0), [0, 1, 2, -1]),
    (d.Bernoulli(1.0), stats.bernoulli(1.0), [0, 1]),
    (d.Laplace(0.0, 1.0), stats.laplace(), [np.inf, -np.inf, 0.0, -700.0]),
    (d.Cauchy(1.0, 2.0), stats.cauchy(1.0, 2.0), [np.inf, -np.inf, 1e200, -1e308]),
    (d.HalfNormal(2.0), stats.halfnorm(scale=2.0), [0.0, -1e-300, -np.inf, np.inf]),
    (d.HalfCauchy(2.0), stats.halfcauchy(scale=2.0), [0.0, -1e-300, -np.inf, np.inf]),
    (d.LogNormal(0.0, 2.0), stats.lognorm(2.0), [0.0, -1.0, -np.inf, np.inf, 1e-300, 1e300]),
    (d.InverseGamma(2.0, 3.0), stats.invgamma(2.0, scale=3.0), [-1.0, -np.inf, np.inf, 1e-300]),
    (d.InverseGamma(1e-3, 3.0), stats.invgamma(1e-3, scale=3.0), [1e-300, 1e300]),
    (d.Weibull(0.5, 2.0), stats.weibull_min(0.5, scale=2.0), [0.0, -1.0, -np.inf, 1e-300]),
    (d.Weibull(1.0, 2.0), stats.weibull_min(1.0, scale=2.0), [0.0, -1.0]),
    (d.Weibull(2.0, 2.0), stats.weibull_min(2.0, scale=2.0), [0.0, 1e300]),
    (d.Geometric(0.25), stats.geom(0.25, loc=-1), [0, -1, 10_000]),
    (d.NegativeBinomial(2.5, 0.25), stats.nbinom(2.5, 0.75), [0, -1, 1000]),
]


@pytest.mark.parametrize(("ours", "theirs", "x"), BOUNDARIES, ids=lambda v: str(v)[:40])
def test_boundaries_equal_scipys(
    ours: d.Distribution, theirs: stats.rv_continuous, x: list
) -> None:
    log_density = theirs.logpmf if ours.is_discrete else theirs.logpdf
    with np.errstate(all="ignore"):
        expected = log_density(np.array(x))
    np.testing.assert_allclose(ours.log_prob(x), expected, rtol=1e-12)


def test_outside_is_minus_infinity_where_scipy_gives_nan() -> None:
    assert d.Gamma(3.0, 1.0).log_prob(np.inf) == -np.inf
    assert d.Gamma(2.0, 2.0).log_prob(1e308) == -np.inf  # twice that is no number
    assert d.Poisson(3.0).log_prob(np.inf) == -np.inf
    assert d.InverseGamma(3.0, 1.0).log_prob(0.0) == -np.inf
    assert d.InverseGamma(3.0, 1e100).log_prob(1e-300) == -np.inf
    assert d.Weibull(3.0, 1.0).log_prob(np.inf) == -np.inf
    assert (
        d.Dirichlet([2.0, 3.0]).log_prob([[0.5, 0.6], [-0.1, 1.1], [1.0, 0.0]]) == -np.inf
    ).all()


DISCRETE = [
    d.Bernoulli(0.4),
    d.Bernoulli(logits=0.4),
    d.Categorical([0.4, 0.6]),
    d.Categorical(logits=[0.4, 0.6]),
    d.Categorical([[0.4, 0.6]]),
    d.Binomial(5, 0.4),
    d.BetaBinomial(5, 0.4, 3.0),
    d.Poisson(2.0),
    d.DiscreteUniform(-1, 4),
    d.Geometric(0.4),
    d.Geometric(logits=0.4),
    d.NegativeBinomial(2.5, 0.4),
    d.NegativeBinomial(2.5, logits=0.4),
]


@pytest.mark.parametrize("dist", DISCRETE, ids=repr)
def test_what_is_not_a_whole_number_has_no_mass(dist: d.Distribution) -> None:
    x = np.array([0.5, 1 + 1e-9, np.nan, np.inf, -np.inf, -0.5])
    assert (dist.log_prob(x) == -np.inf).all()
    assert [dist.log_prob(v).item() for v in x] == [-np.inf] * len(x)


@pytest.mark.parametrize("code", [np.uint8, np.int8, np.int64, bool, float], ids=str)
@pytest.mark.parametrize("dist", DISCRETE, ids=repr)
def test_codes_of_any_type_read_alike(dist: d.Distribution, code: type) -> None:
    np.testing.assert_array_equal(dist.log_prob(np.array([0, 1], code)), dist.log_prob([0, 1]))


CONTINUOUS = [
    d.Normal(0, 1), d.StudentT(3, 0, 1), d.Uniform(0, 1), d.Beta(0.5, 2), d.Gamma(2, 1),
    d.Exponential(1), d.Laplace(0, 1), d.Cauchy(0, 1), d.HalfNormal(1), d.HalfCauchy(1),
    d.LogNormal(0, 1), d.InverseGamma(2, 1), d.Weibull(2, 1), d.VonMises(1, 2), d.VonMises(1, 99),
    d.WrappedNormal(1, 0.5), d.WrappedNormal(1, 2), d.Mixture([0.5, 0.5], [d.Normal(0, 1), d.Gamma(2, 1)]),
]  # fmt: skip


@pytest.mark.parametrize("dist", CONTINUOUS, ids=repr)
def test_nan_in_gives_nan_out(dist: d.Distribution) -> None:
    assert np.isnan(dist.log_prob(np.nan))
    assert np.isnan(dist.cdf(np.nan))
    assert np.isnan(dist.ppf([np.nan, -0.1, 1.1])).all()


@pytest.mark.parametrize("dist", [*CONTINUOUS, *DISCRETE], ids=repr)
def test_cdf_covers_the_whole_line(dist: d.Distribution) -> None:
    assert dist.cdf(np.array([-np.inf, -1e300, -5.0])).max() <= 1e-3 + 0.2 * (
        dist.support.low == -np.inf
    )
    np.testing.assert_array_equal(dist.cdf(np.array([-np.inf, np.inf])).reshape(-1)[:2], [0.0, 1.0])


@pytest.mark.parametrize("x", [1e155, -1e200, 1e300])
def test_students_tail_survives_overflow(x: float) -> None:
    # log1p(x^2 / df) = 2 log|x| - log(df) to the last digit here, and x^2 is infinite
    df = 0.1
    near = d.StudentT(df, 0.0, 1.0).log_prob(1e100)
    expected = near - (df + 1) * (np.log(abs(x)) - np.log(1e100))
    np.testing.assert_allclose(d.StudentT(df, 0.0, 1.0).log_prob(x), expected, rtol=1e-12)


#: values computed with 50 digits from the definitions
GOLDEN = [
    (d.Laplace(1.0, 2.0), -3.0, -3.386294361119891),
    (d.Laplace(0.0, 1.0), 1e4, -10000.69314718056),  # SciPy's density underflows
    (d.Cauchy(1.0, 2.0), 1e180, -829.3822161831459),
    (d.LogNormal(1.0, 0.5), 1e-300, -956416.212261159),
    (d.InverseGamma(2.5, 3.0), 0.01, -281.4200564978443),
    (d.InverseGamma(1e-3, 1e-200), 1e200, -468.3452315213906),  # x / scale overflows
    (d.Weibull(1e-3, 1e200), 1e-200, 452.2901221120759),  # and underflows
    (d.Geometric(1e-12), 1e13, -37.63102111593355),
    (d.Geometric(logits=-60.0), 1e26, -60.875651076269655),
    (d.NegativeBinomial(1e8, 0.5), 100_000_000, -10.475852496710829),
    (d.NegativeBinomial(1e8, 0.5), 100_020_000, -11.475902495877369),
    (d.NegativeBinomial(1e15, 1e-12), 3000, -1300.7590160951381),
    (d.NegativeBinomial(0.001, 0.999999), 12_345_678, -35.57916635285407),
    (d.NegativeBinomial(1e-10, 0.5), 1, -23.718998110569718),
    (d.NegativeBinomial(1e5, 1e-9), 0, -0.00010000000005000001),
    (d.NegativeBinomial(101, 0.99), 10_001, -7.827669972841719),  # Stirling's series at its start
    (d.NegativeBinomial(1e4, 0.2), 2600, -6.541078145452522),
    (d.NegativeBinomial(1e8, 1e-300), 100_000_000, -68938923364.18523),
    (d.NegativeBinomial(2.0, logits=50.0), 1e22, -51.27187780209491),
    (d.NegativeBinomial(2.0, logits=-800.0), 1, -799.3068528194401),
    (d.NegativeBinomial(1e5, logits=30.0), 1e18, -252.21780445028196),
]


@pytest.mark.parametrize(("dist", "x", "expected"), GOLDEN)
def test_golden_values(dist: d.Distribution, x: float, expected: float) -> None:
    # a count of 10^8 carries the rounding of its expectation, of relative size 10^-16, times the
    # distance from it in standard deviations: 10^-12 leaves a margin
    np.testing.assert_allclose(dist.log_prob(x), expected, rtol=1e-12)


def test_the_textbook_formula_would_miss_the_golden_value_of_a_large_count() -> None:
    # negative control: log factorials of 10^8 cancel to seven digits
    n, k = 1e8, 100_020_000
    direct = special.gammaln(n + k) - special.gammaln(k + 1) - special.gammaln(n)
    direct += (n + k) * np.log(0.5)
    assert abs(direct + 11.475902495877369) > 1e-9


def test_inverse_gamma_reaches_beyond_the_ratio_of_doubles() -> None:
    # scale / x is 1e-400: with 50 digits, the regularised incomplete gamma function of it
    dist = d.InverseGamma(0.003, 1e-200)
    assert dist.cdf(1e200) == pytest.approx(0.9367953785317273, rel=1e-13)
    assert dist.ppf(0.9367953785317273) == pytest.approx(1e200, rel=1e-9)
    assert dist.ppf([0.0, 1.0]).tolist() == [0.0, np.inf]
    assert dist.cdf([-1.0, 0.0, np.inf]).tolist() == [0.0, 0.0, 1.0]


def test_weibull_reaches_beyond_the_ratio_of_doubles() -> None:
    # (1e-200 / 1e200)**0.002 = 10**-0.8
    dist, mass = d.Weibull(0.002, 1e200), -np.expm1(-(10**-0.8))
    assert dist.cdf(1e-200) == pytest.approx(mass, rel=1e-12)
    assert dist.ppf(mass) == pytest.approx(1e-200, rel=1e-9)
    assert dist.ppf([0.0, 1.0]).tolist() == [0.0, np.inf]
    assert dist.cdf([-1.0, 0.0, np.inf]).tolist() == [0.0, 0.0, 1.0]


def test_certain_counts() -> None:
    sure = d.Geometric([1.0, 0.5])
    assert sure.log_prob([0, 0]).tolist() == [0.0, np.log(0.5)]
    assert sure.log_prob(3)[0] == -np.inf
    assert sure.cdf([-1, 0]).tolist() == [0.0, 0.5]
    assert sure.ppf([0.7, 0.5]).tolist() == [0.0, 0.0]
    assert d.Geometric(1.0).ppf([0.0, 0.5, 1.0]).tolist() == [-1.0, 0.0, np.inf]
    assert (d.Geometric(1.0).sample(0, 100) == 0).all()
    assert d.Geometric(1.0).mean == d.Geometric(1.0).var == 0.0
    assert d.Geometric(logits=np.inf).log_prob([0, 1]).tolist() == [0.0, -np.inf]
    for none in (d.NegativeBinomial(2.5, 0.0), d.NegativeBinomial(1e6, 0.0)):
        assert none.log_prob([0, 1]).tolist() == [0.0, -np.inf]
        assert none.cdf([-1, 0, 5]).tolist() == [0.0, 1.0, 1.0]
        assert (none.sample(0, 100) == 0).all()
        assert none.mean == none.var == 0.0


def test_means_of_rare_and_near_certain_trials_keep_their_digits() -> None:
    assert d.Geometric(logits=50.0).mean == pytest.approx(np.exp(-50.0), rel=1e-14)
    assert d.Geometric(1e-300).mean == pytest.approx(1e300, rel=1e-14)
    dist = d.NegativeBinomial(2.0, logits=50.0)  # whose probs rounds to one
    assert dist.mean == pytest.approx(2 * np.exp(50.0), rel=1e-14)
    assert dist.cdf(1e22) == pytest.approx(stats.gamma(2).cdf(1e22 * np.exp(-50.0)), rel=1e-9)
    far = d.NegativeBinomial(2.0, logits=35.0)  # 10^4 draws: the mean's standard error is 0.7 %
    assert far.sample(0, 10_000).mean() == pytest.approx(2 * np.exp(35.0), rel=0.05)
    assert d.Weibull(1e6, 1.0).var == pytest.approx(np.pi**2 / 6e12, rel=1e-5)


def test_logits_keep_tails_that_probabilities_lose() -> None:
    # log(1 - expit(50)) = -50 - log1p(exp(-50)); with probs the complement rounds to zero
    assert d.Bernoulli(logits=50.0).log_prob(0) == pytest.approx(-50.0, rel=1e-15)
    assert d.Bernoulli(logits=[-np.inf, np.inf]).log_prob([0, 1]).tolist() == [0.0, 0.0]
    assert d.Binomial(3, logits=[-np.inf, np.inf]).log_prob([0, 3]).tolist() == [0.0, 0.0]


def test_a_wrong_formula_would_be_seen() -> None:
    # negative control of assert_close: an error of one part in 10^9 fails
    value = stats.norm.logpdf(np.linspace(-3, 3, 7))
    with pytest.raises(AssertionError):
        assert_close(value * (1 + 1e-9), value)


@pytest.mark.parametrize("df", [0.05, 0.3, 1.0, 3.0, 40.0, 1e4])
def test_the_far_tails_of_student_t(df: float) -> None:
    """SciPy's own stop at 1e153, are off by a factor of 8 at 1e66, and have +inf as the quantile of 0."""
    dist = d.StudentT(df, 2.0, 3.0)
    q = np.array([1e-3, 1e-9, 1e-12, 1e-60, 1e-200, 1e-300])
    x = dist.ppf(q)
    held = np.isfinite(x)
    np.testing.assert_allclose(dist.cdf(x[held]), q[held], rtol=1e-8)
    assert ((x[held] < 0) & (x[held] > -1.7e308)).all()
    assert (x[~held] == -np.inf).all()
    assert (np.log(1 / q[~held]) / df > 600).all()
    np.testing.assert_allclose(dist.ppf(1.0 - 2.0**-40) - 2.0, 2.0 - dist.ppf(2.0**-40), rtol=1e-9)
    assert dist.ppf(0.0) == -np.inf
    assert dist.ppf(1.0) == np.inf
    if df < 10:
        slope = np.log(dist.cdf(-1e30) / dist.cdf(-1e20)) / (10 * np.log(10.0))
        assert slope == pytest.approx(-df, rel=1e-6)
