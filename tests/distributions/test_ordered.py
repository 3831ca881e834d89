"""Numbers in order and ordered categories, against what is known of them."""

from __future__ import annotations

import itertools
import warnings
from typing import Any

import numpy as np
import pytest
from scipy import integrate, special, stats

import bayesmc as bmc
from bayesmc.errors import BayesmcError, ParameterError, ShapeError, UnsupportedError


def test_the_density_is_that_of_all_arrangements() -> None:
    base = bmc.Normal([0.0, 2.0], 1.5)
    ordered = bmc.Ordered(base, 3)
    x = np.array([[-1.0, 0.5, 2.0], [0.0, 0.0, 4.0]])
    each = [base.log_prob(x[:, list(p)].T).sum(axis=0) for p in itertools.permutations(range(3))]
    np.testing.assert_allclose(ordered.log_prob(x), special.logsumexp(each, axis=0), rtol=1e-13)
    assert (ordered.log_prob(x[:, ::-1]) == -np.inf).all()


def test_its_mass_is_one() -> None:
    ordered = bmc.Ordered(bmc.Gamma(2.0, 1.0), 2)
    mass, _ = integrate.dblquad(
        lambda y, x: float(np.exp(ordered.log_prob([x, y]))), 0, 30, lambda x: x, 30
    )
    assert abs(mass - 1) < 1e-6


@pytest.mark.parametrize(
    ("base", "ppf"),
    [
        (bmc.Uniform(-1.0, 3.0), stats.uniform(-1, 4).ppf),
        (bmc.Exponential(0.5), stats.expon(scale=2).ppf),
        (bmc.StudentT(2.5), stats.t(2.5).ppf),
    ],
)
def test_moments(base: bmc.Distribution, ppf: Any) -> None:
    ordered = bmc.Ordered(base, 4)
    for k in range(4):
        law = stats.beta(k + 1, 4 - k)
        mean = law.expect(ppf)
        np.testing.assert_allclose(ordered.mean[k], mean, rtol=1e-6, atol=1e-8)
        if not isinstance(base, bmc.StudentT):  # SciPy's quadrature does not see so heavy a tail
            var = law.expect(lambda u, m=mean: (ppf(u) - m) ** 2)
            np.testing.assert_allclose(ordered.var[k], var, rtol=1e-6)


def test_draws_have_the_law_of_order_statistics() -> None:
    # false-alarm rate 1e-3 for the three Kolmogorov-Smirnov tests together
    draws = bmc.Ordered(bmc.Exponential(2.0), 3).sample(3, 4000)
    assert (np.diff(draws, axis=-1) > 0).all()
    for k in range(3):
        u = stats.expon(scale=0.5).cdf(draws[:, k])
        assert stats.kstest(u, stats.beta(k + 1, 3 - k).cdf).pvalue > 1e-3 / 3
        assert stats.kstest(u, stats.beta(k + 1, 4 - k).cdf).pvalue < 1e-6  # of four: seen


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: bmc.Ordered(3.0, 2), ParameterError, "base must be a distribution; got float"),
        (lambda: bmc.Ordered(bmc.Normal(0, 1), 0), ParameterError, "size must be at least 1; got 0"),
        (lambda: bmc.Ordered(bmc.Normal(0, 1), 2.5), ParameterError, "size must be a whole number; got 2.5"),
        (lambda: bmc.Ordered(bmc.Poisson(3.0), 2), UnsupportedError, "Poisson is discrete"),
        (lambda: bmc.Ordered(bmc.MvNormal([0, 0], np.eye(2)), 2), UnsupportedError, "vectors as values"),
        (lambda: bmc.Ordered(bmc.VonMises(0, 1), 2), UnsupportedError, "radians of VonMises have no"),
        (lambda: bmc.Ordered(bmc.Uniform(0, [1, 2]), 2), UnsupportedError, "bounds of its base differ"),
        (lambda: bmc.Ordered(bmc.Normal(0, 1), 2).log_prob([1.0, 2, 3]), ShapeError, r"not \(..., 2\)"),
        (lambda: bmc.Ordered(bmc.Cauchy(0, 1), 2).mean, UnsupportedError, "no finite variance"),
        (lambda: bmc.OrderedLogistic(0, 1.0), ShapeError, r"shape \(..., K\); got \(\)"),
        (lambda: bmc.OrderedLogistic(0, [1.0, 0.0]), ParameterError, "cutpoints must be finite and in order"),
        (lambda: bmc.OrderedLogistic(0, [0.0, np.inf]), ParameterError, "cutpoints must be finite"),
        (lambda: bmc.OrderedLogistic(np.nan, [0.0]), ParameterError, "loc must be finite"),
    ],
)  # fmt: skip
def test_bad_input(make: Any, error: Any, words: str) -> None:
    with pytest.raises(error, match=words):
        make()


# ---- categories --------------------------------------------------------------------------------------


def test_probabilities_are_differences_of_logistic_functions() -> None:
    loc, cut = np.array([-1.0, 0.0, 2.5]), np.array([-1.0, 0.5, 3.0])
    below = special.expit(cut - loc[:, None])
    wanted = np.diff(np.pad(below, ((0, 0), (1, 1)), constant_values=((0, 0), (0, 1))), axis=-1)
    answer = bmc.OrderedLogistic(loc, cut)
    np.testing.assert_allclose(answer.probs, wanted, rtol=1e-13)
    assert answer.log_prob([-1, 4, 1.5]).tolist() == [-np.inf] * 3
    np.testing.assert_allclose(answer.cdf([-0.5, 0.0, 2.9]), [0, below[1, 0], below[2, 2]])
    assert answer.ppf([0.0, 0.5, 1.0]).tolist() == [0, 1, 3]


def test_far_out_no_digits_are_lost() -> None:
    # log(expit(41) - expit(40)), where both are 1 in floating point
    answer = bmc.OrderedLogistic(0.0, [40.0, 41.0])
    np.testing.assert_allclose(answer.log_prob(1), -40 + np.log1p(-np.exp(-1)), rtol=1e-12)
    assert bmc.OrderedLogistic(0.0, [1.0, 1.0]).log_prob(1) == -np.inf


def ordinal(rows: int) -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"row": rows})
    net.input("x", plates="row")
    net.add("slope", bmc.Normal(0.0, 1.0))
    net.add("cut", bmc.Ordered(bmc.Normal(0.0, 1.5), 2))
    net.add("y", lambda slope, cut, x: bmc.OrderedLogistic(slope * x, cut), plates="row")
    return net


Y, X = np.array([0, 0, 1, 2, 1, 2, 2, 0]), np.linspace(-2.0, 2.0, 8)


def exact() -> dict[str, np.ndarray]:
    """Means and standard deviations of slope and cutpoints, on a fine lattice."""
    slope = np.linspace(-2.5, 5.0, 121)[:, None, None]
    cut = np.linspace(-6.0, 6.0, 121)
    low, high = cut[:, None], cut
    logs = -0.5 * slope**2 - (low**2 + high**2) / 4.5
    for x, y in zip(X, Y, strict=True):
        ends = [-np.inf, low - slope * x, high - slope * x, np.inf]
        with np.errstate(all="ignore"):
            logs = logs + np.log(special.expit(ends[y + 1]) - special.expit(ends[y]))
    weights = np.exp(np.where((low < high), logs, -np.inf) - np.nanmax(logs[:, low < high]))
    weights = np.nan_to_num(weights) / np.nansum(weights)
    found = [np.broadcast_to(v, weights.shape) for v in (slope, low, high)]
    means = np.array([(weights * v).sum() for v in found])
    sds = [np.sqrt((weights * (v - m) ** 2).sum()) for v, m in zip(found, means, strict=True)]
    return {"mean": means, "sd": np.array(sds)}


ENGINES = [
    bmc.HamiltonianMonteCarlo(ess=2000),
    bmc.Gibbs(ess=2000),
    bmc.MetropolisHastings(1_000),
    bmc.LikelihoodWeighting(200_000),
]  # fmt: skip


@pytest.mark.parametrize("engine", ENGINES, ids=lambda e: type(e).__name__)
def test_engines_find_the_posterior(engine: Any) -> None:
    # false-alarm rate 1e-3 for the three means of an engine, by its own errors
    post = bmc.infer(ordinal(8), {"y": Y}, inputs={"x": X}, engine=engine, rng=2)
    wanted = exact()
    means = np.array([post.mean("slope"), *post.mean("cut")])
    errors = np.array([post.mcse("slope"), *post.mcse("cut")])
    z = np.abs(means - wanted["mean"]) / errors
    assert z.max() < stats.norm.isf(1e-3 / 6), z
    assert (
        np.abs(means + 4 * errors - wanted["mean"]) / errors
    ).max() > 3.6  # a bias would be seen
    sds = np.array([post.std("slope"), *post.std("cut")])
    np.testing.assert_allclose(sds, wanted["sd"], rtol=0.1)


# ---- inside of others --------------------------------------------------------------------------------


def one(make: Any, read: Any, scale: float = 1.0) -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("x", make)
    net.add("y", lambda x: bmc.Normal(read(x), scale))
    return net


def first(x: Any) -> Any:
    return x[..., 0]


INSIDE = {
    "hidden parameters": lambda m: bmc.Ordered(bmc.Normal(m, 1.0), 2),
    "bounds of parts": lambda: bmc.Mixture(
        [0.3, 0.7], [bmc.Ordered(bmc.Exponential(1.0), 2), bmc.Ordered(bmc.Normal(-1.0, 1.0), 2)]
    ),
    "a batch of parts": lambda m: bmc.Mixture(
        [0.3, 0.7], bmc.Ordered(bmc.Normal(bmc.stack([m, m + 2]), 1.0), 2)
    ),
    "beside others": lambda: bmc.Joint(bmc.Ordered(bmc.Normal(0.0, 1.0), 2), bmc.Exponential(1.0)),
}


@pytest.mark.parametrize("name", INSIDE)
@pytest.mark.parametrize(
    "engine", [bmc.HamiltonianMonteCarlo(1500, 500), bmc.Gibbs(1500, 500)], ids=["H", "G"]
)
def test_inside_of_others(name: str, engine: Any) -> None:
    # false-alarm rate 1e-3 for all components together, against weighted draws of the prior
    net = one(INSIDE[name], first)
    wanted = bmc.infer(net, {"y": 0.3}, engine=bmc.LikelihoodWeighting(100_000), rng=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # 1500 draws of four chains: too few for some
        post = bmc.infer(net, {"y": 0.3}, engine=engine, rng=2)
    off = np.abs(post.mean("x") - wanted.mean("x"))
    error = np.hypot(post.mcse("x"), wanted.mcse("x"))
    assert (off / error).max() < stats.norm.isf(5e-4 / off.size), off / error
    assert error.max() < 0.15


def test_what_would_leave_the_order_is_refused() -> None:
    ordered = bmc.Ordered(bmc.Exponential(1.0), 2)
    with pytest.raises(UnsupportedError, match="move the base of Ordered"):
        bmc.Affine(ordered, -5.0, 2.0)
    net = bmc.BayesNet()
    net.add("top", bmc.Gamma(4.0, 1.0))
    with pytest.raises(BayesmcError, match="bounds of its base differ within a batch"):
        net.node(vectorize=True, name="t")(lambda top: bmc.Ordered(bmc.Uniform(0.0, top), 2))
        net.add("y", lambda t: bmc.Normal(t[..., 1] - t[..., 0], 0.3))
        bmc.infer(net, {"y": 1.0}, rng=0)


def test_cutpoints_as_a_list() -> None:
    net = bmc.BayesNet()
    net.add("b", bmc.Normal(0.0, 1.0))
    net.add("y", lambda b: bmc.OrderedLogistic(b, [-1.0, 1.0]))
    assert bmc.log_density(net, {"y": 2})(np.array([0.5]))[0] == pytest.approx(
        float(bmc.OrderedLogistic(0.5, [-1.0, 1.0]).log_prob(2) + stats.norm.logpdf(0.5))
    )


@pytest.mark.parametrize(
    "base",
    [
        bmc.Truncated(bmc.Normal(0.0, 1.0), 0.0, np.inf),
        bmc.Mixture([0.3, 0.7], bmc.Normal([0.0, 3.0], 1.0)),
    ],
)
def test_moments_are_numbers_or_refused(base: Any) -> None:
    ordered = bmc.Ordered(base, 2)
    try:
        mean = ordered.mean
    except UnsupportedError as error:
        assert "no quantiles" in str(error)
    else:
        draws = ordered.sample(0, 40_000)  # within five standard errors
        errors = draws.std(axis=0) / 200
        assert (np.abs(draws.mean(axis=0) - mean) < 5 * errors).all()
