"""Correlation matrices: mass, marginals, maps, and posteriors against quadrature."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import ParameterError, ShapeError, UnsupportedError


def matrix(*below: float) -> np.ndarray:
    d = round((1 + np.sqrt(1 + 8 * len(below))) / 2)
    found = np.eye(d)
    found[np.tril_indices(d, -1)] = below
    return np.tril(found) + np.tril(found, -1).T


@pytest.mark.parametrize("concentration", [0.7, 1.0, 3.0])
def test_two_rows_are_one_beta_number(concentration: float) -> None:
    law = stats.beta(concentration, concentration, loc=-1, scale=2)
    for r in (-0.9, 0.0, 0.3):
        found = bmc.LKJ(2, concentration).log_prob(matrix(r))
        np.testing.assert_allclose(found, law.logpdf(r), rtol=1e-12)


def test_the_mass_of_three_rows_is_one() -> None:
    # r12 = sin(s), r13 = sin(t), and r23 anywhere between the bounds that these two leave it
    nodes, weights = np.polynomial.legendre.leggauss(24)
    s, t, v = np.meshgrid(*[0.5 * np.pi * nodes] * 3, indexing="ij")
    room = np.cos(s) * np.cos(t)
    c = np.sin(s) * np.sin(t) + room * np.sin(v)
    ones = np.ones_like(c)
    rows = [[ones, np.sin(s), np.sin(t)], [np.sin(s), ones, c], [np.sin(t), c, ones]]
    density = np.exp(bmc.LKJ(3, 2.0).log_prob(np.moveaxis(np.array(rows), (0, 1), (-2, -1))))
    change = np.cos(s) * np.cos(t) * room * np.cos(v) * (0.5 * np.pi) ** 3
    mass = np.einsum("ijk,i,j,k->", density * change, weights, weights, weights)
    assert abs(mass - 1) < 1e-8


def test_draws() -> None:
    # false-alarm rate 1e-3 for the Kolmogorov-Smirnov tests of six correlations together
    draws = bmc.LKJ(4, 1.5).sample(5, 4000)
    assert bmc.distributions.support.correlation.contains(draws).all()
    assert (draws == np.swapaxes(draws, -1, -2)).all()
    half = 1.5 + 0.5 * (4 - 2)
    for i, j in zip(*np.tril_indices(4, -1), strict=True):
        law = stats.beta(half, half, loc=-1, scale=2)
        assert stats.kstest(draws[:, i, j], law.cdf).pvalue > 1e-3 / 6
        assert stats.kstest(draws[:, i, j], stats.beta(2, 2, loc=-1, scale=2).cdf).pvalue < 1e-3
    np.testing.assert_allclose(bmc.LKJ(4, 1.5).var[0, 1], 1 / (2 * half + 1))


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: bmc.LKJ(0), ParameterError, "size must be at least 1; got 0"),
        (lambda: bmc.LKJ(1.5), ParameterError, "size must be a whole number; got 1.5"),
        (lambda: bmc.LKJ(2, -1.0), ParameterError, "concentration must be positive and finite"),
        (lambda: bmc.LKJ(3).log_prob(np.eye(2)), ShapeError, r"not \(..., 3, 3\)"),
        (lambda: bmc.Affine(bmc.LKJ(2)), UnsupportedError, "ones on its diagonal"),
    ],
)
def test_bad_input(make: Any, error: Any, words: str) -> None:
    with pytest.raises(error, match=words):
        make()


def test_what_is_no_correlation_matrix_has_no_density() -> None:
    law = bmc.LKJ(3)
    assert law.log_prob(2 * np.eye(3)) == -np.inf
    assert law.log_prob(matrix(0.9, -0.9, 0.9)) == -np.inf
    assert np.isnan(law.log_prob(np.full((3, 3), np.nan)))


# ---- posteriors --------------------------------------------------------------------------------------


def net() -> bmc.BayesNet:
    """Pairs of unknown spread and correlation."""
    found = bmc.BayesNet(plates={"row": None})
    found.add("sd", bmc.HalfNormal(2.0))
    found.add("R", bmc.LKJ(2, 2.0))
    found.add(
        "y",
        lambda sd, R: bmc.MvNormal(np.zeros(2), sd[..., None, None] ** 2 * R),  # noqa: N803
        plates="row",
    )
    return found


Y = np.random.default_rng(4).multivariate_normal([0, 0], [[1.0, 0.6], [0.6, 1.0]], 12)


def exact() -> tuple[float, float]:
    """Mean and standard deviation of the correlation, on a lattice."""
    r, sd = np.linspace(-0.9995, 0.9995, 2000)[:, None], np.linspace(0.01, 6, 1500)
    xx, xy, yy = (Y[:, 0] ** 2).sum(), (Y[:, 0] * Y[:, 1]).sum(), (Y[:, 1] ** 2).sum()
    square = (xx - 2 * r * xy + yy) / (sd**2 * (1 - r**2))
    logs = np.log(1 - r**2) - sd**2 / 8 - 0.5 * square
    logs = logs - len(Y) * (2 * np.log(sd) + 0.5 * np.log(1 - r**2))
    w = np.exp(logs - logs.max()).sum(axis=1)
    w, r = w / w.sum(), r[:, 0]
    mean = float(w @ r)
    return mean, float(np.sqrt(w @ (r - mean) ** 2))


ENGINES = [
    bmc.HamiltonianMonteCarlo(ess=2000),
    bmc.Gibbs(ess=2000),
    bmc.MetropolisHastings(2000),
    bmc.LikelihoodWeighting(100_000),
]


@pytest.mark.parametrize("engine", ENGINES, ids=lambda e: type(e).__name__)
def test_engines_find_the_posterior(engine: Any) -> None:
    # false-alarm rate 1e-3 for each engine, by its own error
    post = bmc.infer(net(), {"y": Y}, engine=engine, rng=3)
    mean, sd = exact()
    found, error = float(post.mean("R")[0, 1]), float(post.mcse("R")[0, 1])
    assert abs(found - mean) / error < stats.norm.isf(5e-4)
    assert error < sd / 10  # less than a standard deviation's third would be seen
    np.testing.assert_allclose(post.std("R")[0, 1], sd, rtol=0.1)


def test_messages_look_where_no_correlation_is() -> None:
    # EP asks for the density of numbers that make no matrix, too, and says that its answer is rough
    net = bmc.BayesNet()
    net.add("level", bmc.Normal(0.0, 1.0))
    net.add("R", bmc.LKJ(2, 2.0))
    net.add("y", lambda level, R: bmc.MvNormal(level[..., None] * np.ones(2), R))  # noqa: N803
    with pytest.warns(bmc.errors.ConvergenceWarning, match="Gibbs"):
        bmc.infer(net, {"y": [0.0, 0.5]}, engine=bmc.ExpectationPropagation())


def test_a_concentration_that_is_hidden() -> None:
    # R observed: the posterior of c by a lattice; false-alarm rate 1e-3 for each engine
    net = bmc.BayesNet()
    net.add("c", bmc.Gamma(2.0, 1.0))
    net.add("R", lambda c: bmc.LKJ(3, c))
    seen = matrix(0.6, 0.3, 0.5)
    c = np.linspace(0.001, 30.0, 30_001)
    logs = np.log(c) - c + bmc.LKJ(3, c).log_prob(np.broadcast_to(seen, (c.size, 3, 3)))
    weights = np.exp(logs - logs.max())
    exact = weights @ c / weights.sum()
    for engine in (None, bmc.HamiltonianMonteCarlo(ess=2000), bmc.Gibbs(ess=2000)):
        post = bmc.infer(net, {"R": seen}, engine=engine, rng=4)
        assert abs(post.mean("c") - exact) / post.mcse("c") < stats.norm.isf(5e-4)
