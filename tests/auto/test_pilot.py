"""``engine=None`` where Gibbs has no closed form: a short pilot weighs engines, always the same way."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.stats

import bayesmc as bmc
from bayesmc.auto.pilot import CountedModel, _counted
from bayesmc.lowering import machine
from bayesmc.network import pose


def arma() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """ARMA(1, 1): a sequential likelihood."""
    rng = np.random.default_rng(3)
    n = 40
    noise = rng.normal(size=n)
    y = np.zeros(n)
    for t in range(1, n):
        y[t] = 0.6 * y[t - 1] + noise[t] + 0.3 * noise[t - 1]
    net = bmc.BayesNet()
    net.add("mu", bmc.Normal(0.0, 10.0))
    net.add("phi", bmc.Normal(0.0, 2.0))
    net.add("theta", bmc.Normal(0.0, 2.0))
    net.add("sigma", bmc.HalfCauchy(2.5))

    def likelihood(mu: Any, phi: Any, theta: Any, sigma: Any) -> Any:
        error = y[0] - mu - phi * mu
        squares = error**2
        for t in range(1, n):
            error = y[t] - mu - phi * y[t - 1] - theta * error
            squares = squares + error**2
        return -0.5 * squares / sigma**2 - n * np.log(sigma)

    net.potential("likelihood", likelihood)
    return net, {}


def garch() -> tuple[bmc.BayesNet, dict[str, Any]]:
    rng = np.random.default_rng(4)
    r = rng.normal(size=150) * np.repeat([0.5, 2.0, 0.7], 50)
    net = bmc.BayesNet()
    net.add("a0", bmc.HalfNormal(1.0))
    net.add("a1", bmc.Uniform(0.0, 1.0))
    net.add("b1", bmc.Uniform(0.0, 1.0))

    def likelihood(a0: Any, a1: Any, b1: Any) -> Any:
        variance, total = 1.0 + 0.0 * a0, 0.0
        for t in range(len(r)):
            if t:
                variance = a0 + a1 * r[t - 1] ** 2 + b1 * (1 - a1) * variance
            total = total - 0.5 * np.log(variance) - 0.5 * r[t] ** 2 / variance
        return total

    net.potential("likelihood", likelihood)
    return net, {}


def with_scipy() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a: scipy.stats.gamma(np.exp(a) + 1.0))
    return net, {"y": 2.0}


def zero_inflated() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet(plates={"i": 12})
    net.add("p", bmc.Beta(1.0, 1.0))
    net.add("rate", bmc.Gamma(1.0, 1.0))

    @net.node(plates="i")
    def y(p: Any, rate: Any) -> Any:
        return bmc.Mixture(
            bmc.stack([p, 1 - p]), bmc.Poisson(bmc.stack([np.full_like(rate, 1e-9), rate]))
        )

    return net, {"y": np.array([0, 0, 0, 2, 0, 1, 3, 0, 0, 4, 0, 2])}


CASES: dict[str, tuple[Callable[[], Any], type]] = {
    "arma": (arma, bmc.MetropolisHastings),
    "garch": (garch, bmc.MetropolisHastings),
    "scipy": (with_scipy, bmc.LikelihoodWeighting),
    "zero-inflated": (zero_inflated, bmc.LikelihoodWeighting),
}


@pytest.mark.parametrize("name", CASES)
def test_the_cheaper_engine_is_taken(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    make, engine = CASES[name]
    machine.is_available.cache_clear()
    monkeypatch.setattr(machine.importlib.util, "find_spec", lambda name: None)
    try:
        chosen, again = bmc.explain(*make()), bmc.explain(*make())
    finally:
        machine.is_available.cache_clear()
    assert isinstance(chosen.engine, engine)
    assert "did best in a short pilot" in chosen.reasons[0] and "effective of" in chosen.reasons[0]
    assert "Gibbs" in chosen.refused
    assert again.reasons == chosen.reasons  # no clock decides


@pytest.mark.skipif(not machine.is_available(), reason="llvmlite is not installed")
@pytest.mark.parametrize("make", [arma, garch])
def test_in_machine_code_recursions_are_followed(make: Any) -> None:
    """A gradient costs less than the call of one density: no pilot is run."""
    chosen = bmc.explain(*make())
    assert isinstance(chosen.engine, bmc.Gibbs)
    assert "Hamiltonian" in chosen.reasons[0] and "pilot" not in str(chosen)


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")
def test_what_is_chosen_answers_as_gibbs_does() -> None:
    """The two differ by less than 5 of their errors: false alarm 6e-7 for each figure."""
    net, data = zero_inflated()
    chosen, gibbs = (
        bmc.infer(net, data, engine=engine, rng=0)
        for engine in (None, bmc.Gibbs(200, warmup=50, chains=4))
    )
    assert not isinstance(chosen.engine, bmc.Gibbs)
    for name in ("p", "rate"):
        error = np.hypot(chosen.mcse(name), gibbs.mcse(name))
        assert abs(chosen.mean(name) - gibbs.mean(name)) < 5 * error


def closed_form() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet(plates={"i": 5})
    net.add("mean", bmc.Normal(0.0, 10.0))
    net.add("precision", bmc.Gamma(1.0, 1.0))
    net.add("x", lambda mean, precision: bmc.Normal(mean, precision**-0.5), plates="i")
    return net, {"x": np.arange(5.0)}


def hierarchy() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Short chains of a block that misses the neck of a funnel look fast."""
    net = bmc.BayesNet(plates={"i": 8})
    net.add("sigma", bmc.HalfNormal(1.0))
    net.add("b", lambda sigma: bmc.Laplace(0.0, sigma), plates="i")
    net.add("y", lambda b: bmc.Poisson(np.exp(b)), plates="i")
    return net, {"y": np.arange(8)}


@pytest.mark.parametrize("make", [closed_form, hierarchy])
def test_other_nets_are_left_to_gibbs(make: Any) -> None:
    chosen = bmc.explain(*make())
    assert isinstance(chosen.engine, bmc.Gibbs) and "pilot" not in str(chosen)


def test_chains_are_taken_where_weights_are_uneven() -> None:
    """Many data make weights uneven: chains are compared."""
    net = bmc.BayesNet(plates={"i": 300})
    net.add("r", bmc.LogNormal(0.0, 2.0))
    net.add("y", lambda r: bmc.Weibull(r, 1.0), plates="i")
    y = np.random.default_rng(0).weibull(1.5, 300)
    chosen = bmc.explain(net, {"y": y})
    assert "LikelihoodWeighting" not in type(chosen.engine).__name__
    assert "effective of" in chosen.reasons[0]


def test_counting_changes_nothing() -> None:
    net, data = garch()
    problem = pose(net, data)
    engine = bmc.MetropolisHastings(20, warmup=10)
    counted = _counted(problem)
    assert isinstance(counted.model, CountedModel)
    seed = np.random.SeedSequence(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", bmc.errors.ConvergenceWarning)
        one, other = (engine.run(p, seed) for p in (problem, counted))
    np.testing.assert_array_equal(one["a0"], other["a0"])
    assert counted.model.work.units > 30
