"""Truncated against SciPy, sums and quadrature; draws against rejection from the base."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

import bayesmc.distributions as d
from bayesmc.errors import ParameterError, UnsupportedError

ALARM = 1e-6
INF = np.inf
Q = np.array([1e-9, 0.01, 0.3, 0.5, 0.9, 0.999])


@pytest.mark.parametrize(
    ("low", "high"),
    [(8, INF), (-40, -38), (30, INF), (-INF, -30), (-1, 2), (-INF, 3), (-0.1, 50), (2, 2.5)],
)
def test_a_normal_is_exact_in_any_tail(low: float, high: float) -> None:
    ours = d.Truncated(d.Normal(1.0, 2.0), 1 + 2 * low, 1 + 2 * high)
    theirs = stats.truncnorm(low, high, 1.0, 2.0)
    x = ours.ppf(Q)
    np.testing.assert_allclose(ours.log_prob(x), theirs.logpdf(x), rtol=1e-10)
    np.testing.assert_allclose(ours.cdf(x), Q, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ours.mean, theirs.mean(), rtol=1e-9)
    # SciPy's variance cancels far out; there it is checked by quadrature below
    if abs(ours.mean) < 15:
        np.testing.assert_allclose(ours.var, theirs.var(), rtol=1e-8)


@pytest.mark.parametrize(("low", "high"), [(30.0, 31.0), (8.0, 9.0), (-38.5, -38.0), (5, 5 + 1e-6)])
def test_normal_moments_by_quadrature(low: float, high: float) -> None:
    dist = d.Truncated(d.Normal(0.0, 1.0), low, high)
    t = integrate.quad_vec  # measured from the lower bound, so that nothing cancels

    def moment(k: int) -> float:
        return float(
            t(lambda u: u**k * np.exp(dist.log_prob(low + u)), 0, high - low, epsrel=1e-12)[0]
        )

    mean = moment(1)
    np.testing.assert_allclose(moment(0), 1.0, rtol=1e-7)
    np.testing.assert_allclose(dist.mean - low, mean, rtol=1e-6)
    np.testing.assert_allclose(dist.var, moment(2) - mean**2, rtol=1e-5)


def test_the_whole_line_changes_nothing() -> None:
    base = d.Normal([0.0, 3.0], 2.0)
    dist = d.Truncated(base)
    x = np.array([[-5.0], [0.3]])
    np.testing.assert_allclose(dist.log_prob(x), base.log_prob(x), rtol=1e-14)
    np.testing.assert_allclose([dist.mean, dist.var], [base.mean, base.var], atol=1e-12)
    assert dist.support.kind == "real"


BASES = {
    "StudentT": d.StudentT(5.0, 1.0, 2.0),
    "Cauchy": d.Cauchy(1.0, 2.0),
    "Laplace": d.Laplace(1.0, 2.0),
    "HalfNormal": d.HalfNormal(2.0),
    "HalfCauchy": d.HalfCauchy(2.0),
    "LogNormal": d.LogNormal(0.3, 0.5),
    "InverseGamma": d.InverseGamma(3.0, 2.0),
    "Weibull": d.Weibull(0.7, 2.0),
    "Exponential": d.Exponential(2.0),
    "Beta": d.Beta(2.0, 3.0),
    "singular Beta": d.Beta(0.5, 0.5),
    "Gamma": d.Gamma(0.5, 3.0),
    "Uniform": d.Uniform(-1.0, 2.0),
    "Mixture": d.Mixture([0.3, 0.7], d.Normal([-2.0, 1.0], [0.3, 1.0])),
    "scipy": d.as_distribution(stats.gumbel_r(1.0, 2.0)),
    "Affine": d.Affine(d.Gamma(2.0, 1.0), 1.0, -2.0),
    "KernelDensity": d.KernelDensity([0.0, 1.0, 4.0], 0.5),
}


@pytest.mark.filterwarnings("ignore::scipy.integrate.IntegrationWarning")  # at a singular end
@pytest.mark.parametrize("name", BASES)
@pytest.mark.parametrize(("start", "stop"), [(0.05, 0.4), (0.3, 0.9), (0.7, 0.999), (0.6, 1.0)])
def test_any_base_is_normalised_and_its_moments_are_integrals(
    name: str, start: float, stop: float
) -> None:
    base = BASES[name]
    low, high = float(base.ppf(start)), float(base.ppf(stop))
    dist = d.Truncated(base, low, high)
    np.testing.assert_allclose(dist.cdf(dist.ppf(Q)), Q, atol=1e-9)
    np.testing.assert_allclose(dist.log_mass, np.log(stop - start), rtol=1e-7)
    assert dist.log_prob(low - 1e-3) == -INF
    x = dist.ppf(0.37)
    np.testing.assert_allclose(dist.log_prob(x), base.log_prob(x) - np.log(stop - start), rtol=1e-6)
    if name in ("Cauchy", "HalfCauchy") and stop == 1.0:
        assert dist.mean == INF
        return
    top = float(dist.ppf(1 - 1e-13)) if high == INF else high
    cuts = [float(v) for v in np.unique(dist.ppf(np.linspace(0.01, 0.999, 20)))]

    def moment(k: int, about: float) -> float:
        def integrand(v: float) -> float:
            return (v - about) ** k * float(np.exp(dist.log_prob(v)))

        bounds = [low, *(c for c in cuts if low < c < top), top]
        pairs = zip(bounds[:-1], bounds[1:], strict=True)
        return sum(integrate.quad(integrand, a, b, epsabs=1e-11)[0] for a, b in pairs)

    heavy = stop == 1.0 and name in ("StudentT", "InverseGamma", "scipy")
    np.testing.assert_allclose(moment(0, 0.0), 1.0, rtol=1e-7)
    np.testing.assert_allclose(dist.mean, moment(1, 0.0), rtol=1e-6, atol=1e-8)
    if not heavy:  # what lies beyond the cut still counts for these
        np.testing.assert_allclose(dist.var, moment(2, float(dist.mean)), rtol=1e-6)


@pytest.mark.parametrize(
    ("base", "far"),
    [
        (d.Exponential(2.0), 400.0),
        (d.Gamma(3.0, 2.0), 200.0),
        (d.StudentT(3.0), 1e9),
        (d.Laplace(0.0, 1.0), 500.0),
        (d.HalfNormal(1.0), 35.0),
        (d.LogNormal(0.0, 1.0), 1e12),
        (d.Weibull(2.0, 1.0), 20.0),
    ],
    ids=lambda v: type(v).__name__,
)
def test_far_tails_keep_their_digits(base: d.Distribution, far: float) -> None:
    dist = d.Truncated(base, far)
    np.testing.assert_allclose(dist.cdf(dist.ppf(Q)), Q, rtol=1e-9, atol=1e-12)
    # the density is the slope of the cdf
    x, step = dist.ppf(0.5), 1e-4 * (dist.ppf(0.6) - dist.ppf(0.5))
    slope = (dist.cdf(x + step) - dist.cdf(x - step)) / (2 * step)
    np.testing.assert_allclose(np.exp(dist.log_prob(x)), slope, rtol=1e-4)


def test_an_exponential_forgets() -> None:
    dist = d.Truncated(d.Exponential([2.0, 0.1]), [400.0, 1.0])
    np.testing.assert_allclose(dist.mean, [400.5, 11.0], rtol=1e-10)
    np.testing.assert_allclose(dist.var, [0.25, 100.0], rtol=1e-8)


@pytest.mark.parametrize(
    ("base", "low", "high"),
    [
        (d.Poisson(4.0), 0.5, 3.2),
        (d.Poisson(4.0), 40, INF),
        (d.Geometric(0.3), 60, INF),
        (d.NegativeBinomial(3.5, 0.4), 2, 300),
        (d.Binomial(100, 0.1), 90, INF),
        (d.DiscreteUniform(-3, 9), -INF, 4),
        (d.as_distribution(stats.dlaplace(0.8)), -INF, 3),
    ],
    ids=str,
)
def test_integers_by_sums(base: d.Distribution, low: float, high: float) -> None:
    dist = d.Truncated(base, low, high)
    k = np.arange(-100, 500)
    inside = (k >= low) & (k <= high)
    terms = np.where(inside, base.log_prob(k), -INF)
    log_mass = np.logaddexp.reduce(terms)
    np.testing.assert_allclose(dist.log_prob(k), terms - log_mass, rtol=1e-9)
    p = np.exp(terms - log_mass)
    np.testing.assert_allclose(dist.mean, p @ k, rtol=1e-9)
    np.testing.assert_allclose(dist.var, p @ (k - p @ k) ** 2, rtol=1e-8)
    np.testing.assert_allclose(dist.cdf(k), p.cumsum(), atol=1e-12)
    draws = dist.sample(0, 2000)
    assert draws.dtype == np.int64
    assert dist.support.contains(draws).all()
    values = dist.ppf(Q)
    assert (dist.cdf(values) >= Q * (1 - 1e-12)).all() and (dist.cdf(values - 1) < Q).all()


@pytest.mark.parametrize(
    ("base", "low", "high"),
    [
        (d.Normal(0.0, 1.0), -0.5, 2.0),
        (d.Gamma(2.0, 1.0), 1.0, 3.0),
        (BASES["Mixture"], -2.0, 0.5),
        (d.StudentT(3.0), 0.5, INF),
    ],
    ids=lambda v: type(v).__name__ if isinstance(v, d.Distribution) else str(v),
)
def test_draws_are_those_that_rejection_keeps(
    base: d.Distribution, low: float, high: float
) -> None:
    # false alarm: 1e-6 each
    dist = d.Truncated(base, low, high)
    pool = base.sample(1, 60_000)
    kept = pool[(pool >= low) & (pool <= high)]
    draws = dist.sample(2, 20_000)
    assert stats.ks_2samp(draws, kept).pvalue > ALARM
    # negative control: the same bounds moved by a twentieth of the interval's interquartile range
    shift = 0.05 * float(dist.ppf(0.75) - dist.ppf(0.25))
    wrong = d.Truncated(base, low + shift, high + shift).sample(3, 20_000)
    assert stats.ks_2samp(wrong + 2 * shift, kept).pvalue < ALARM


def test_integers_of_a_batch_between_common_bounds() -> None:
    base = d.Poisson([[3.0], [20.0]])
    dist = d.Truncated(base, 4, [6, 6, 900])
    assert dist.sample_to(np.random.default_rng(0), (5, 2, 3)).shape == (5, 2, 3)
    k = np.arange(4, 7)[:, None, None]
    total = np.exp(d.Truncated(base, 4, 6).log_prob(k)).sum(axis=0)
    np.testing.assert_allclose(total, 1.0, rtol=1e-12)
    narrow = d.Truncated(d.Mixture([0.5, 0.5], d.Poisson([[1.0, 2.0]] * 3)), 60, 62)
    np.testing.assert_allclose(np.exp(narrow.log_prob(np.arange(60, 63)[:, None])).sum(0), 1.0)
    assert d.Truncated(d.Poisson(np.empty(0)), 0, 3).sample(0, 2).shape == (2, 0)


def test_bounds_may_depend_on_the_batch_and_nest() -> None:
    low = np.array([[-1.0], [0.0], [9.0]])
    dist = d.Truncated(d.Normal([0.0, 1.0], 1.0), low, low + 1)
    assert dist.batch_shape == (3, 2)
    for i in range(3):
        for j in range(2):
            alone = d.Truncated(d.Normal(float(j), 1.0), low[i, 0], low[i, 0] + 1)
            np.testing.assert_allclose(dist.ppf(0.3)[i, j], alone.ppf(0.3), rtol=1e-14)
            np.testing.assert_allclose(dist.mean[i, j], alone.mean, rtol=1e-13)
    nested = d.Truncated(d.Truncated(d.Normal(0.0, 1.0), -1.0, 3.0), 0.5, 9.0)
    np.testing.assert_allclose(nested.mean, d.Truncated(d.Normal(0.0, 1.0), 0.5, 3.0).mean)


def test_the_support_is_exact_and_maps_to_the_line() -> None:
    dist = d.Truncated(d.Gamma(2.0, 1.0), -1.0, 3.0)
    assert (dist.support.low, dist.support.high) == (0.0, 3.0)
    u = np.array([-3.0, 0.0, 2.0])
    np.testing.assert_allclose(dist.unconstrain(dist.constrain(u)), u)


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: d.Truncated(d.Normal(), [0, 3], [2, 1]), ParameterError, "low < high.*at index 1"),
        (lambda: d.Truncated(d.Normal(), np.nan), ParameterError, "low must be a number"),
        (lambda: d.Truncated(d.Uniform(0, 1), [0.5, 2], 3), ParameterError,
         r"where Uniform has mass \(numbers in \[0, 1\]\); got \[2. 3.\] at index 1"),
        (lambda: d.Truncated(d.Gamma(2.0, 1.0), -3.0, -1.0), ParameterError,
         r"where Gamma has mass \(numbers >= 0\); got \[-3. -1.\]"),
        (lambda: d.Truncated(d.Poisson(3.0), -5, -2), ParameterError, r"integers >= 0\); got \[-5. -2.\]"),
        (lambda: d.Truncated(d.Poisson(3.0), 1.2, 1.8), ParameterError, r"integer in it; got \[1.2 1.8\]"),
        (lambda: d.Truncated(BASES["Mixture"], 30.0), ParameterError, "told from rounding"),
        (lambda: d.Truncated(d.Poisson(3.0), 0.2, 0.3), ParameterError, "integer in it"),
        (lambda: d.Truncated(d.Dirichlet([1, 1])), UnsupportedError, "one number"),
        (lambda: d.Truncated(d.Density(lambda x: -(x**2)), 0.0), UnsupportedError,
         r"Truncated\(InverseCdf\(density\)"),
        (lambda: d.Truncated(d.VonMises(0.0, 1.0), 0.0), UnsupportedError, "circle.*InverseCdf"),
        (lambda: d.Truncated(3.0), ParameterError, "must be a distribution"),
    ],
)  # fmt: skip
def test_what_cannot_be_truncated_is_refused(make: object, error: type, words: str) -> None:
    with pytest.raises(error, match=words):
        make()  # type: ignore[operator]


def test_bad_bounds_are_marked_where_they_do_not_count() -> None:
    with d.marking_invalid():
        dist = d.Truncated(d.Normal(), [0.0, 3.0, 0.0], [2.0, 1.0, np.nan])
    assert dist.invalid.tolist() == [False, True, True]
    np.testing.assert_allclose(dist.mean[0], d.Truncated(d.Normal(), 0.0, 2.0).mean)
    assert np.isfinite(dist.sample(0, 5)).all()
