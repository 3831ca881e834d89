"""Wishart and InverseWishart against SciPy, their known laws, and as nodes of a net.

Seeds are fixed; each goodness-of-fit test raises a false alarm with probability ``ALARM`` were the
seed fresh.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import linalg, special, stats

import bayesmc as bmc
import bayesmc.distributions as d
from bayesmc.errors import EvidenceError, ParameterError, ShapeError

ALARM = 1e-6
DRAWS = 20_000
FAMILIES = [(d.Wishart, stats.wishart), (d.InverseWishart, stats.invwishart)]
BOTH = [d.Wishart, d.InverseWishart]


def scale_of(size: int, seed: int, spread: float = 1.0) -> np.ndarray:
    """A positive definite matrix whose axes differ by orders of magnitude of about ``spread``."""
    rng = np.random.default_rng([size, seed])
    root = np.tril(rng.normal(size=(size, size))) + 2 * np.eye(size)
    root *= 10.0 ** (spread * rng.normal(size=(size, 1)))
    return root @ root.T


# ---- densities and moments -------------------------------------------------------------------


@pytest.mark.parametrize(("ours", "theirs"), FAMILIES, ids=["Wishart", "InverseWishart"])
@given(st.integers(1, 6), st.floats(0.05, 1e3), st.integers(0, 999))
def test_log_prob_equals_scipys(
    ours: Any, theirs: Any, size: int, excess: float, seed: int
) -> None:
    # scales of moderate condition: SciPy loses digits in proportion to it, see the next test
    scale, df = scale_of(size, seed, 0.1), size - 1 + excess
    # values in the bulk, and values of another distribution in the tails
    x = np.concatenate(
        [
            ours(size + 2.5, scale).sample(seed, 4),
            ours(df, scale).sample(seed, 4),
            stats.wishart(size + 1, np.eye(size)).rvs(4, seed).reshape(4, size, size),
        ]
    )
    x = x[[_has_a_root(value) for value in x]]
    expected = theirs(df, scale).logpdf(np.moveaxis(x, 0, -1))
    error = np.abs(ours(df, scale).log_prob(x) - expected)
    # what rounding may cost either of a determinant whose logarithm counts about df / 2 times
    lost = np.finfo(float).eps * (df + 4) * np.linalg.cond(x)
    assert (error <= 1e-10 * (1 + np.abs(expected)) + lost).all(), (error, lost)


def _has_a_root(value: np.ndarray) -> bool:
    """Whether SciPy finds a Cholesky factor; near d - 1 degrees of freedom it may not, by rounding."""
    try:
        linalg.cholesky(value, lower=True)
    except np.linalg.LinAlgError:
        return False
    return True


def extended_log_prob(family: Any, df: float, scale: Any, x: Any) -> float:
    """The log density in extended precision, from the textbook's formula."""
    size, half = len(scale), np.longdouble(df) / 2
    scale_root, root = extended_cholesky(scale), extended_cholesky(x)
    scale_det, det = (2 * np.log(np.diagonal(a)).sum() for a in (scale_root, root))
    constant = half * size * np.log(np.longdouble(2)) + special.multigammaln(df / 2, size)
    if family is d.Wishart:
        trace = extended_trace(scale_root, root)
        return float((half - 0.5 * (size + 1)) * det - trace / 2 - half * scale_det - constant)
    trace = extended_trace(root, scale_root)
    return float(half * scale_det - trace / 2 - (half + 0.5 * (size + 1)) * det - constant)


def extended_cholesky(matrix: Any) -> np.ndarray:
    a = np.array(matrix, dtype=np.longdouble)
    root = np.zeros_like(a)
    for j in range(len(a)):
        root[j, j] = np.sqrt(a[j, j] - (root[j, :j] ** 2).sum())
        root[j + 1 :, j] = (a[j + 1 :, j] - root[j + 1 :, :j] @ root[j, :j]) / root[j, j]
    return root


def extended_trace(root: np.ndarray, other: np.ndarray) -> np.longdouble:
    """``trace((root root')^-1 other other')`` by forward substitution."""
    z = np.array(other)
    for i in range(len(root)):
        z[i] = (z[i] - root[i, :i] @ z[:i]) / root[i, i]
    return (z**2).sum()


@pytest.mark.skipif(
    np.finfo(np.longdouble).eps > 1e-18, reason="no extended precision on this machine"
)
@pytest.mark.parametrize("family", BOTH)
@given(st.integers(1, 6), st.floats(0.5, 1e4), st.integers(0, 999))
def test_log_prob_keeps_its_digits_at_scales_of_bad_condition(
    family: Any, size: int, excess: float, seed: int
) -> None:
    # condition numbers up to 10^12 and terms of 10^5 that cancel; SciPy's error is 10^-8 here
    scale, df = scale_of(size, seed), size - 1 + excess
    dist = family(df, scale)
    for x in dist.sample(seed, 3):
        expected = extended_log_prob(family, df, scale, x)
        lost = 1e-17 * np.linalg.cond(x)  # a draw may be all but singular; a tenth of the bound
        assert dist.log_prob(x) == pytest.approx(expected, rel=1e-10, abs=max(1e-9, lost))


def test_golden_log_densities() -> None:
    # SciPy 1.17, scipy.stats.wishart and invwishart
    x, scale = [[2.0, 0.5], [0.5, 1.0]], [[1.0, 0.2], [0.2, 0.5]]
    assert d.Wishart(5.0, scale).log_prob(x) == pytest.approx(-3.7783676936448667, rel=1e-12)
    assert d.InverseWishart(5.0, scale).log_prob(x) == pytest.approx(-9.016854555972243, rel=1e-12)


@pytest.mark.parametrize("df", [0.3, 1.0, 7.5])
def test_one_dimension_is_gamma_and_inverse_gamma(df: float) -> None:
    x = np.geomspace(1e-3, 1e3, 25)
    square = x[:, None, None]
    wishart, inverse = d.Wishart(df, [[3.0]]), d.InverseWishart(df, [[3.0]])
    gamma, inverse_gamma = d.Gamma(df / 2, 1 / 6.0), stats.invgamma(df / 2, scale=1.5)
    np.testing.assert_allclose(wishart.log_prob(square), gamma.log_prob(x), rtol=1e-10)
    np.testing.assert_allclose(inverse.log_prob(square), inverse_gamma.logpdf(x), rtol=1e-10)
    assert wishart.mean.item() == pytest.approx(float(gamma.mean))
    assert wishart.var.item() == pytest.approx(float(gamma.var))


def test_moments_equal_scipys() -> None:
    scale = scale_of(3, 0)
    wishart, inverse = d.Wishart(7.5, scale), d.InverseWishart(7.5, scale)
    np.testing.assert_allclose(wishart.mean, stats.wishart(7.5, scale).mean(), rtol=1e-13)
    np.testing.assert_allclose(wishart.var, stats.wishart(7.5, scale).var(), rtol=1e-13)
    np.testing.assert_allclose(inverse.mean, stats.invwishart(7.5, scale).mean(), rtol=1e-13)
    np.testing.assert_allclose(inverse.var, stats.invwishart(7.5, scale).var(), rtol=1e-13)


def test_moments_that_diverge_say_so() -> None:
    dist = d.InverseWishart([2.5, 3.5, 5.5], np.eye(2))
    np.testing.assert_array_equal(dist.mean[0], [[np.inf, np.nan], [np.nan, np.inf]])
    np.testing.assert_array_equal(dist.mean[1], 2 * np.eye(2))
    assert np.isnan(dist.var[0]).all() and np.isposinf(dist.var[1]).all()
    assert np.isfinite(dist.var[2]).all()


def test_densities_of_inverse_matrices_are_linked() -> None:
    # X ~ Wishart(df, V^-1) makes X^-1 inverse Wishart; the inversion stretches by |X|^(d + 1)
    scale = scale_of(3, 1, 0.2)
    x = d.InverseWishart(6.0, scale).sample(0, 50)
    direct = d.InverseWishart(6.0, scale).log_prob(x)
    through = d.Wishart(6.0, np.linalg.inv(scale)).log_prob(np.linalg.inv(x))
    np.testing.assert_allclose(direct, through - 4 * np.linalg.slogdet(x)[1], rtol=1e-8)


@pytest.mark.parametrize("family", BOTH)
def test_other_matrices_have_density_zero(family: Any) -> None:
    dist = family(5.0, np.eye(2))
    outside = [
        -np.eye(2),
        np.ones((2, 2)),
        [[1.0, 2.0], [2.0, 1.0]],
        [[1.0, 0.5], [0.1, 1.0]],
        [[np.inf, 0.0], [0.0, 1.0]],
        np.zeros((2, 2)),
    ]
    for x in outside:
        assert dist.log_prob(x) == -np.inf
    both = dist.log_prob([np.eye(2), outside[0]])  # the one beside it keeps its density
    assert both.tolist() == [float(dist.log_prob(np.eye(2))), -np.inf]
    assert np.isnan(dist.log_prob(np.full((2, 2), np.nan)))
    assert dist.log_prob(np.eye(2, dtype=int)) == dist.log_prob(np.eye(2))


# ---- shapes and parameters -------------------------------------------------------------------


@pytest.mark.parametrize("family", BOTH)
def test_batches_equal_one_at_a_time(family: Any) -> None:
    df = np.array([4.5, 6.0, 9.0])
    scale = np.stack([scale_of(3, 1), scale_of(3, 2)])[:, None]
    dist = family(df, scale)
    assert dist.batch_shape == (2, 3) and dist.event_shape == (3, 3)
    x = dist.sample(0, (4, 5))
    assert x.shape == (4, 5, 2, 3, 3, 3)
    log_prob = dist.log_prob(x)
    assert log_prob.shape == (4, 5, 2, 3)
    assert dist.mean.shape == dist.var.shape == (2, 3, 3, 3)
    for i in range(2):
        for j in range(3):
            one = family(df[j], scale[i, 0])
            np.testing.assert_allclose(one.log_prob(x[:, :, i, j]), log_prob[:, :, i, j], 1e-12)
            np.testing.assert_allclose(one.mean, dist.mean[i, j], rtol=1e-14)
            np.testing.assert_allclose(one.var, dist.var[i, j], rtol=1e-14)
    assert family(df, np.eye(3)).sample(0).shape == (3, 3, 3)
    assert family(5.0, np.eye(3)).sample(0).shape == (3, 3)
    # axes that the parameters lack are drawn independently
    wide = family(5.0, np.eye(2)[None]).sample_to(np.random.default_rng(0), (3, 4))
    assert len(np.unique(wide[..., 0, 0])) == 12


@pytest.mark.parametrize("family", BOTH)
def test_bad_parameters_are_refused_with_their_index(family: Any) -> None:
    name = family.__name__
    for df in (1.0, np.nan, np.inf, -3.0):
        with pytest.raises(ParameterError, match=f"{name}: df must be finite and above 1"):
            family(df, np.eye(2))
    with pytest.raises(ParameterError, match="at index 2") as caught:
        family([3.0, 4.0, 0.5], np.eye(2))
    assert caught.value.index == (2,)
    with pytest.raises(ParameterError, match="scale must be symmetric positive definite") as caught:
        family(5.0, [np.eye(2), -np.eye(2)])
    assert caught.value.index == (1,)
    for scale in (3.0, [1.0, 2.0], np.ones((2, 3)), np.ones((0, 0))):
        with pytest.raises(ShapeError, match=rf"{name}: scale must have shape \(..., d, d\)"):
            family(5.0, scale)
    with pytest.raises(ShapeError, match="broadcast"):
        family([5.0, 6.0, 7.0], np.stack([np.eye(2)] * 2))
    with pytest.raises(ShapeError, match="one matrix"):
        family(5.0, np.eye(2)).log_prob(np.eye(3))


@pytest.mark.parametrize("family", BOTH)
def test_bad_parameters_are_marked_while_marking(family: Any) -> None:
    with d.marking_invalid():
        dist = family([5.0, 0.0, 5.0], np.stack([np.eye(2), np.eye(2), -np.eye(2)]))
    assert dist.invalid.tolist() == [False, True, True]
    good = family(5.0, np.eye(2))
    np.testing.assert_array_equal(dist.log_prob(np.eye(2))[0], good.log_prob(np.eye(2)))
    assert np.isfinite(dist.sample(0, 3)).all()


# ---- draws -----------------------------------------------------------------------------------


def fits(family: Any, df: float, scale: np.ndarray, draws: np.ndarray) -> list[float]:
    """p-values of the laws that draws must follow.

    With W = scale^-1/2 X scale^-1/2 (of the inverses for InverseWishart): the log determinant of W
    is a sum of log chi-squares of df, df - 1, ..., and c' X c / c' V c a chi-square of df for any
    c (Muirhead 1982, theorems 3.2.15 and 3.2.8); for InverseWishart c' V c / c' X c is one of
    df - d + 1.
    """
    size = len(scale)
    rng = np.random.default_rng(99)
    log_det = np.linalg.slogdet(draws)[1] - np.linalg.slogdet(scale)[1]
    if family is d.InverseWishart:
        log_det = -log_det
    # the sum has no closed cdf for most sizes: chi-squares are drawn, ten times as many
    chi_squares = rng.chisquare(df - np.arange(size), (10 * len(draws), size))
    p_values = [stats.ks_2samp(log_det, np.log(chi_squares).sum(axis=-1)).pvalue]
    for c in [*np.eye(size), rng.normal(size=size)]:
        ratio = np.einsum("i,nij,j->n", c, draws, c) / (c @ scale @ c)
        if family is d.Wishart:
            p_values.append(stats.kstest(ratio, stats.chi2(df).cdf).pvalue)
        else:
            p_values.append(stats.kstest(1 / ratio, stats.chi2(df - size + 1).cdf).pvalue)
    return p_values


@pytest.mark.parametrize("family", BOTH)
@pytest.mark.parametrize(("size", "df"), [(1, 0.7), (1, 4.0), (2, 1.5), (3, 3.0), (4, 11.5)])
def test_draws_follow_their_laws(family: Any, size: int, df: float) -> None:
    scale = scale_of(size, 5, 0.3)
    draws = family(df, scale).sample(size, DRAWS)
    np.testing.assert_array_equal(draws, np.matrix_transpose(draws))
    p_values = fits(family, df, scale, draws)
    assert min(p_values) * len(p_values) > ALARM


@pytest.mark.parametrize("family", BOTH)
def test_draws_of_another_distribution_are_seen(family: Any) -> None:
    # negative controls, at the same number of draws and alarm rate: other degrees of freedom, a
    # scale that differs in one correlation, Bartlett's chi-squares all of one df, a diagonal only
    scale = scale_of(3, 5, 0.3)
    claimed = (family, 6.0, scale)
    other = scale.copy()
    other[0, 1] = other[1, 0] = 0.5 * scale[0, 1]
    root = np.linalg.cholesky(scale)
    rng = np.random.default_rng(0)
    lower = np.tril(rng.normal(size=(DRAWS, 3, 3)), -1)
    lower[:, range(3), range(3)] = np.sqrt(rng.chisquare(6.0, (DRAWS, 3)))
    wrong = [
        family(6.4, scale).sample(0, DRAWS),
        family(6.0, other).sample(0, DRAWS),
        root @ lower @ np.matrix_transpose(lower) @ root.T,
        np.eye(3) * family(6.0, scale).sample(0, DRAWS),
    ]
    for draws in wrong:
        assert min(fits(*claimed, draws)) < ALARM


@pytest.mark.parametrize("family", BOTH)
def test_mean_and_variance_of_draws_agree(family: Any) -> None:
    # all six entries of both, 4.9 standard errors estimated from the draws: 12 * 10^-6. With df
    # 30 the inverse's fourth moments, which the variance's error needs, exist and are light.
    dist = family(30.0, scale_of(3, 7, 0.2))
    x = dist.sample(11, 100_000)
    for sample, expected in ((x, dist.mean), ((x - dist.mean) ** 2, dist.var)):
        error = sample.std(axis=0) / np.sqrt(len(x))
        assert (np.abs(sample.mean(axis=0) - expected) <= 4.9 * error).all()
    wrong = np.abs(x.mean(axis=0) - 1.02 * dist.mean) > 4.9 * x.std(axis=0) / np.sqrt(len(x))
    assert np.diagonal(wrong).all()  # negative control: 2 percent off is seen


@pytest.mark.parametrize("family", BOTH)
@pytest.mark.parametrize("excess", [1e-3, 0.1, 1.0])
def test_no_draw_has_density_zero_or_infinite(family: Any, excess: float) -> None:
    # close to d - 1 degrees of freedom nearly every draw is singular to rounding
    for size in (1, 2, 3, 6):
        for scale in (np.eye(size), scale_of(size, 3), 1e-12 * scale_of(size, 4, 2.0)):
            dist = family(size - 1 + excess, scale)
            draws = dist.sample(0, 2_000)
            assert dist.support.contains(draws).all()
            assert np.isfinite(dist.log_prob(draws)).all()


@pytest.mark.parametrize(("size", "excess", "seed"), [(3, 1e-3, 13), (6, 0.1, 6), (6, 0.1, 15)])
@pytest.mark.parametrize("family", BOTH)
def test_draws_have_a_factor_alone_and_in_a_batch(
    family: Any, size: int, excess: float, seed: int
) -> None:
    # the steps of a Cholesky factor are ordered differently: a pivot just above rounding in one
    # was below it in the other, at these seeds for one family or the other
    root = np.random.default_rng(3).normal(size=(size, size))
    dist = family(size - 1 + excess, root @ root.T + 0.2 * np.eye(size))
    draws = dist.sample(seed, 2_000)
    assert dist.support.contains(draws).all()
    assert np.isfinite(dist.log_prob(draws)).all()
    assert all(dist.support.contains(draw) for draw in draws[::10])


def test_the_same_seed_gives_the_same_draws() -> None:
    for family in BOTH:
        dist = family([5.0, 6.0], np.eye(2))
        np.testing.assert_array_equal(dist.sample(5, 100), dist.sample(5, 100))
        assert (dist.sample(5, 100) != dist.sample(6, 100)).any()


# ---- as nodes --------------------------------------------------------------------------------


def covariance_net(prior: d.Distribution) -> bmc.BayesNet:
    net = bmc.BayesNet("covariance", plates={"row": 3})
    net.add("S", prior)

    @net.node(plates="row")
    def x(S):
        return bmc.MvNormal(np.zeros(2), cov=S)

    return net


def test_a_net_with_a_random_covariance() -> None:
    prior = bmc.Wishart(5.0, np.eye(2))
    net = covariance_net(prior)
    net.validate()
    values = net.sample(200, rng=0)
    assert values["S"].shape == (200, 2, 2) and values["x"].shape == (200, 3, 2)
    expected = prior.log_prob(values["S"])
    for k in range(3):
        expected = expected + bmc.MvNormal(np.zeros(2), values["S"]).log_prob(values["x"][:, k])
    np.testing.assert_allclose(net.log_prob(values), expected, rtol=1e-12)
    assert net["S"].event_shape == (2, 2)


def test_evidence_on_a_matrix() -> None:
    net = covariance_net(bmc.Wishart(5.0, np.eye(2)))
    seen = np.array([[2.0, 0.3], [0.3, 1.0]])
    posterior = bmc.infer(net, {"S": seen}, engine=bmc.LikelihoodWeighting(4000), rng=0)
    expected = bmc.Wishart(5.0, np.eye(2)).log_prob(seen)
    assert posterior.log_marginal_likelihood == pytest.approx(float(expected), rel=1e-12)
    np.testing.assert_array_equal(posterior.mean("S"), seen)
    # each of the three variances of x by 4,000 draws: 5 standard errors of 2 v^2
    np.testing.assert_allclose(posterior.var("x")[:, 0], 2.0, atol=5 * np.sqrt(2 / 4000) * 2.0)
    for bad in (-np.eye(2), np.array([[1.0, 0.5], [0.1, 1.0]])):
        with pytest.raises(EvidenceError, match=r"'S'[\s\S]*positive definite matrices"):
            bmc.infer(net, {"S": bad}, engine=bmc.LikelihoodWeighting(100), rng=0)


def test_the_posterior_of_a_covariance_is_the_conjugate_one() -> None:
    # InverseWishart(df, V) and three normal vectors make InverseWishart(df + 3, V + sum x x')
    # (Gelman et al. 2013, section 3.6); the evidence is a ratio of normalising constants.
    df, scale = 8.0, np.array([[2.0, 0.5], [0.5, 1.0]])
    x = np.array([[0.5, 1.0], [-1.0, 0.3], [0.8, 0.2]])
    net = covariance_net(bmc.InverseWishart(df, scale))
    posterior = bmc.infer(net, {"x": x}, engine=bmc.LikelihoodWeighting(100_000), rng=0)
    after = bmc.InverseWishart(df + 3, scale + x.T @ x)
    at = np.eye(2)
    evidence = (
        bmc.InverseWishart(df, scale).log_prob(at)
        + bmc.MvNormal(np.zeros(2), at).log_prob(x).sum()
        - after.log_prob(at)
    )
    closed = (
        -3 * np.log(np.pi)
        + special.multigammaln((df + 3) / 2, 2)
        - special.multigammaln(df / 2, 2)
        + 0.5 * df * np.linalg.slogdet(scale)[1]
        - 0.5 * (df + 3) * np.linalg.slogdet(scale + x.T @ x)[1]
    )
    assert evidence == pytest.approx(closed, rel=1e-12)
    # five Monte Carlo standard errors, as the posterior reports them: 6 * 10^-7 each
    weights = posterior.weights / posterior.weights.sum()
    error = np.sqrt(np.sum(weights**2))
    assert posterior.log_marginal_likelihood == pytest.approx(float(evidence), abs=5 * error)
    np.testing.assert_array_less(
        np.abs(posterior.mean("S") - after.mean), 5 * np.asarray(posterior.mcse("S"))
    )
    # negative control: the prior's mean lies outside that band
    prior_mean = bmc.InverseWishart(df, scale).mean
    assert (np.abs(prior_mean - after.mean) > 5 * np.asarray(posterior.mcse("S"))).any()
