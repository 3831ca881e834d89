"""Mixtures fitted to a density, and posteriors of a few numbers whose hills lie far apart."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import pytest
from scipy import special, stats

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning
from bayesmc.kernels.tempering import MixtureOfT, fitted_mixture

Density = Callable[[np.ndarray], np.ndarray]


def normal(u: np.ndarray) -> np.ndarray:
    return -0.5 * (u**2).sum(axis=1)


def banana(u: np.ndarray) -> np.ndarray:
    return -0.5 * u[:, 0] ** 2 - 0.5 * ((u[:, 1] - u[:, 0] ** 2) / 0.1) ** 2


def apart(u: np.ndarray) -> np.ndarray:
    """One in twenty on the left."""
    right = np.log(0.95) - 0.5 * (((u - 3) / 0.1) ** 2).sum(axis=1)
    return np.logaddexp(right, np.log(0.05) - 0.5 * (((u + 3) / 0.1) ** 2).sum(axis=1))


@pytest.mark.parametrize(
    ("density", "size", "spread", "left"),
    [(normal, 1, 100.0, 0.5), (normal, 6, 10.0, 0.5), (banana, 2, 5.0, 0.5), (apart, 3, 3.0, 0.05)],
)
def test_weighted_draws_of_the_mixture_are_the_density(
    density: Density, size: int, spread: float, left: float, rng: np.random.Generator
) -> None:
    """The share on the left within four of its errors: one false alarm in 4,000 runs of all."""
    found = fitted_mixture(density, rng.normal(0.0, spread, (1000, size)), rng)
    assert found is not None
    u = found.draw(rng, 4000)
    log = density(u) - found.log_prob(u)
    weights = np.exp(log - log.max())
    weights /= weights.sum()
    share = weights[u[:, 0] < 0].sum()
    error = np.sqrt((weights**2 * ((u[:, 0] < 0) - share) ** 2).sum())
    assert abs(share - left) < 4 * error < 0.1
    assert 1 / (weights @ weights) > 0.1 * 4000


def test_the_density_of_a_mixture_is_that_of_its_components(rng: np.random.Generator) -> None:
    roots = np.tril(rng.normal(size=(3, 2, 2))) + 2 * np.eye(2)
    mixture = MixtureOfT.of(np.array([0.2, 0.3, 0.5]), rng.normal(size=(3, 2)), roots)
    u = rng.normal(size=(5, 2))
    parts = [
        np.log(share) + stats.multivariate_t(centre, root @ root.T, df=4.0).logpdf(u)
        for share, centre, root in zip(*mixture[:3], strict=True)
    ]
    assert np.allclose(mixture.log_prob(u), special.logsumexp(parts, axis=0), rtol=1e-12)


def test_what_is_impossible_has_no_mixture(rng: np.random.Generator) -> None:
    nowhere = fitted_mixture(lambda u: np.full(len(u), -np.inf), rng.normal(size=(200, 1)), rng)
    assert nowhere is None


# ---- posteriors with several hills ----------------------------------------------------------------


def square() -> tuple[bmc.BayesNet, dict]:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(1.0, 3.0))
    net.add("y", lambda x: bmc.Normal(x**2, 0.5))
    return net, {"y": 9.0}


def mixed() -> tuple[bmc.BayesNet, dict]:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 10.0))

    @net.node
    def y(x):
        return bmc.Mixture([0.9, 0.1], bmc.Normal(np.stack([x - 20, x + 20], axis=-1), 0.5))

    return net, {"y": 0.0}


def two_numbers() -> tuple[bmc.BayesNet, dict]:
    """A product and a scale: the signs of both may change together."""
    net = bmc.BayesNet(plates={"row": 12})
    net.add("a", bmc.Normal(0.3, 2.0))
    net.add("s", bmc.HalfNormal(1.0))
    net.add("y", lambda a, s: bmc.Normal(a**2, s), plates="row")
    return net, {"y": 4.0 + np.linspace(-0.5, 0.5, 12)}


MODELS = [square, mixed, two_numbers]
ENGINES = [None, bmc.Gibbs(), bmc.MetropolisHastings()]


#: in an ordinary run two numbers, which take longest, are asked of one engine
ASKED = [
    pytest.param(
        e, m, marks=[pytest.mark.thorough] * (m is two_numbers and not isinstance(e, bmc.Gibbs))
    )
    for e in ENGINES
    for m in MODELS
]


@pytest.mark.parametrize(("engine", "model"), ASKED)
def test_hills_have_their_shares(model: Callable, engine: bmc.Engine | None) -> None:
    """Within four stated errors of a sum over a fine grid: one false alarm in 1,700 runs of all nine."""
    net, evidence = model()
    name = "a" if "a" in net else "x"
    line = np.linspace(-60, 60, 24_001)
    if name == "x":
        log = np.array(net.log_prob({"x": line, **evidence}))
    else:
        scales = np.linspace(0.05, 4.0, 200)
        whole = net.log_prob({"a": line[:, None], "s": scales, **evidence})
        log = special.logsumexp(whole, axis=1)
    truth = np.exp(log[line < 0] - special.logsumexp(log)).sum()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # what is stated must hold all the same
        found = bmc.infer(net, evidence, engine=engine, rng=3)
    on_left = (lambda a: a < 0) if name == "a" else (lambda x: x < 0)
    share, error = found.expectation(on_left), found.mcse(on_left)
    assert 0.01 < truth < 0.99
    assert abs(share - truth) < 4 * error < 0.15
