"""Conjugacy is claimed of no child whose function hides its parents in a closure or in an object of SciPy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc

# few draws, of which the errors tell
pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")

TIMES = np.array([0.5, 1.0, 0.2, 2.0, 0.3])
POINTS = np.linspace(-4.0, 4.0, 161)


def effects(child: Callable[..., Any]) -> bmc.BayesNet:
    """Two effects that enter a child in a plate as their sum."""
    net = bmc.BayesNet(plates={"i": 5})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", bmc.Normal(0.0, 1.0))
    net.add("t", child, plates="i")
    return net


def on_a_grid(log: Callable[[np.ndarray], np.ndarray]) -> float:
    """The mean of an effect, where ``log`` is the likelihood of their sum, from a grid."""
    a, b = np.meshgrid(POINTS, POINTS, indexing="ij")
    total = log((a + b)[..., None]).sum(axis=-1) - 0.5 * (a * a + b * b)
    weights = np.exp(total - total.max())
    return float((weights * a).sum() / weights.sum())


def exponential(s: Any) -> Any:
    return s - np.exp(s) * TIMES


CHILDREN: dict[str, tuple[Callable[..., Any], Callable[[np.ndarray], np.ndarray]]] = {
    "density": (
        lambda a, b: bmc.Density(lambda t: a + b - np.exp(a + b) * t, support=(0, np.inf)),
        exponential,
    ),
    "scipy, not normal": (
        lambda a, b: stats.gumbel_r(a + b, 1.0),
        lambda s: stats.gumbel_r.logpdf(TIMES, s),
    ),
    "scipy, normal": (lambda a, b: stats.norm(a + b, 1.0), lambda s: stats.norm.logpdf(TIMES, s)),
    "density in another": (
        lambda a, b: bmc.Affine(bmc.Density(lambda t: -0.5 * (t - a - b) ** 2), 0.0, 1.0),
        lambda s: stats.norm.logpdf(TIMES, s),
    ),
}


@pytest.mark.parametrize(
    "name",
    ["density", "scipy, normal"]
    + [
        pytest.param(n, marks=pytest.mark.thorough)
        for n in ("scipy, not normal", "density in another")
    ],
)
def test_two_normal_parents(name: str) -> None:
    child, log = CHILDREN[name]
    net = effects(child)
    posterior = bmc.infer(net, {"t": TIMES}, engine=bmc.Gibbs(200, 200), rng=0)
    mean = on_a_grid(log)
    for node in ("a", "b"):  # 8 means: false alarm 5e-6
        assert abs(posterior.mean(node) - mean) < 5.0 * posterior.mcse(node)
    assert "jointly Normal" not in str(bmc.explain(net, {"t": TIMES}, engine=bmc.Gibbs()))


def seen_twice(child: Callable[..., Any]) -> bmc.BayesNet:
    """A mean with a reading that makes a conjugate pair, and one that does not say what it is."""
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("x", lambda a: bmc.Normal(a, 1.0))
    net.add("t", child)
    return net


@pytest.mark.parametrize(
    "child",
    [
        lambda a: bmc.Density(lambda t: -0.5 * ((t - a) / 0.1) ** 2),
        lambda a: bmc.Affine(bmc.Density(lambda t: -0.5 * (t - a) ** 2 * 100.0), 0.0, 1.0),
        lambda a: stats.norm(a, 0.1),
    ],
    ids=["density", "density in another", "scipy"],
)
def test_a_child_that_hides_its_parent_is_not_left_out(child: Callable[..., Any]) -> None:
    """It was taken for one that does not vary with the mean: .5 instead of 2.95."""
    net, evidence = seen_twice(child), {"x": 1.0, "t": 3.0}
    posterior = bmc.infer(net, evidence, engine=bmc.Gibbs(200, 200), rng=0)
    exact = (1.0 + 100.0 * 3.0) / 102.0
    error = 5.0 * posterior.mcse("a")  # false alarm 6e-7
    assert abs(posterior.mean("a") - exact) < error
    assert abs(0.5 - exact) > error  # what the other reading alone says would be seen
    assert "Normal with Normal" not in str(bmc.explain(net, evidence, engine=bmc.Gibbs()))


@pytest.mark.parametrize(
    ("child", "seen"),
    [(lambda a, b: bmc.Poisson(2.0), 3), (lambda a, b: bmc.Uniform(0.0, 1.0), 0.3)],
)
def test_a_child_that_does_nothing_with_its_parents(child: Callable[..., Any], seen: Any) -> None:
    """It has no mean that a block of Normal nodes could read."""
    net = effects(lambda a, b: bmc.Normal(a + b, 1.0))
    net.add("k", child)
    posterior = bmc.infer(net, {"t": TIMES, "k": seen}, engine=bmc.Gibbs(200, 50), rng=0)
    mean = on_a_grid(lambda s: stats.norm.logpdf(TIMES, s))
    assert abs(posterior.mean("a") - mean) < 5.0 * posterior.mcse("a")  # false alarm 6e-7


def test_a_child_that_is_followed_keeps_its_closed_form() -> None:
    net = effects(lambda a, b: bmc.Normal(a + b, 1.0))
    assert "jointly Normal" in str(bmc.explain(net, {"t": TIMES}, engine=bmc.Gibbs()))
    posterior = bmc.infer(net, {"t": TIMES}, engine=bmc.Gibbs(200, 50), rng=0)
    mean = on_a_grid(lambda s: stats.norm.logpdf(TIMES, s))
    assert abs(posterior.mean("a") - mean) < 5.0 * posterior.mcse("a")  # false alarm 6e-7
