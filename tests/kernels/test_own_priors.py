"""Priors of families that somebody wrote: closed forms keep to their supports.

Each mean is held against the oracle of brute force at five of its standard errors (6e-7 each).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.base import as_float
from bayesmc.distributions.support import Support, interval, real
from bayesmc.testing import exact, session

ENGINE = bmc.Gibbs(draws=600, warmup=100)


class Bell(bmc.Distribution):
    """Normal with scale 1."""

    parameter_ndim = {"loc": 0}

    def __init__(self, loc: Any) -> None:
        loc = as_float(loc)
        self._set_batch(loc.shape)
        self.loc = self._finite("loc", loc)

    @staticmethod
    def log_density(x: Any, loc: Any) -> Any:
        return -0.5 * (x - loc) ** 2 - 0.5 * np.log(2 * np.pi)

    def _sample(self, rng: np.random.Generator, shape: Any) -> np.ndarray:
        return self.loc + rng.standard_normal(shape)

    @property
    def support(self) -> Support:
        return real


class Pareto(bmc.Distribution):
    parameter_ndim = {"alpha": 0, "low": 0}

    def __init__(self, alpha: Any, low: Any) -> None:
        alpha, low = as_float(alpha), as_float(low)
        self._set_batch(alpha.shape, low.shape)
        self.alpha, self.low = self._positive("alpha", alpha), self._positive("low", low)

    @staticmethod
    def log_density(x: Any, alpha: Any, low: Any) -> Any:
        inside = np.log(alpha) + alpha * np.log(low) - (alpha + 1) * np.log(x)
        return np.where(x >= low, inside, -np.inf)

    def _sample(self, rng: np.random.Generator, shape: Any) -> np.ndarray:
        return self.low * np.exp(rng.exponential(1.0, shape) / self.alpha)

    @property
    def support(self) -> Support:
        return interval(self.low, np.inf)


class Slope(bmc.Distribution):
    """Density ``a x**(a - 1)`` on the unit interval."""

    parameter_ndim = {"a": 0}

    def __init__(self, a: Any) -> None:
        a = as_float(a)
        self._set_batch(a.shape)
        self.a = self._positive("a", a)

    @staticmethod
    def log_density(x: Any, a: Any) -> Any:
        inside = np.log(a) + (a - 1) * np.log(x)
        return np.where((x > 0) & (x < 1), inside, -np.inf)

    def _sample(self, rng: np.random.Generator, shape: Any) -> np.ndarray:
        return rng.random(shape) ** (1 / self.a)

    @property
    def support(self) -> Support:
        return interval(0.0, 1.0, open_low=True, open_high=True)


def bell() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet()
    net.add("x", Bell(0.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    return net, {"y": -2.0}


def pareto() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet(plates={"i": 6})
    net.add("x", Pareto(3.0, 2.0))
    net.add("y", lambda x: bmc.Poisson(x), plates="i")
    return net, {"y": [0, 2, 1, 4, 0, 1]}


def paretos() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Each element begins elsewhere."""
    net = bmc.BayesNet(plates={"i": 2})
    net.add("x", Pareto(3.0, np.array([0.5, 2.0])), plates="i")
    net.add("y", lambda x: bmc.Exponential(x), plates="i")
    return net, {"y": [1.0, 2.0]}


def below_another() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet()
    net.add("low", bmc.Gamma(2.0, 2.0))
    net.add("x", lambda low: Pareto(3.0, low))
    net.add("y", lambda x: bmc.Poisson(x))
    return net, {"y": 1}


def slope() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet()
    net.add("x", Slope(2.0))
    net.add("y", lambda x: bmc.Exponential(x))
    return net, {"y": 0.1}


@pytest.mark.parametrize("build", [bell, pareto, paretos, below_another, slope])
def test_closed_forms_keep_to_the_support(build: Any) -> None:
    net, evidence = build()
    found = bmc.infer(net, evidence, engine=ENGINE, rng=session.seed())
    answer = exact(net, evidence)
    for name in (n for n in net.nodes if n not in evidence):
        off = np.abs(found.mean(name) - answer.mean(name)) / found.mcse(name)
        assert (off < 5.0).all(), (name, off)


@pytest.mark.parametrize("build", [bell, pareto, slope])
def test_pairs_are_found_all_the_same(build: Any) -> None:
    net, evidence = build()
    assert "conjugate" in str(bmc.explain(net, evidence, engine=bmc.Gibbs()))
