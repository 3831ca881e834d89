"""Chains that never entered the neck of a funnel say so, and right samplers of funnels do not.

The identity is judged at 4 standard errors, at two ends and three widths. With a normal error a right sampler
is judged wrong with a probability of at most 6 * 3.2e-5 = 1.9e-4 per parameter (Bonferroni); a thousandth is
allowed for what is left of skewness and for estimated errors.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.mcmc.chains import ChainEngine
from bayesmc.errors import ConvergenceWarning
from bayesmc.network import Problem
from bayesmc.testing import session

Draw = Callable[[np.random.Generator, int], dict[str, np.ndarray]]


class Sampler:
    """Independent draws: chains that mix perfectly, wherever they go."""

    def __init__(self, draw: Draw) -> None:
        self.draw = draw

    def start(self, rng: np.random.Generator, chains: int) -> dict[str, Any]:
        return {"values": self.draw(rng, chains), "chains": chains}

    def step(self, state: Any, rng: np.random.Generator, warmup: bool) -> dict[str, Any]:
        return {**state, "values": self.draw(rng, state["chains"])}

    def end_warmup(self, state: Any) -> Any:
        return state

    def values(self, state: Any, rng: np.random.Generator) -> Mapping[str, np.ndarray]:
        return state["values"]

    def acceptance(self, state: Any) -> Mapping[str, np.ndarray]:
        return {}


@dataclass(frozen=True)
class Drawn(ChainEngine):
    """A stand-in for an engine: its draws are those of a function."""

    draws: int = 1000
    warmup: int = 0
    chains: int = 4
    thinning: int = 1
    draw: Draw | None = None
    label: ClassVar[str] = "stand-in"

    def refusal(self, problem: Problem) -> str | None:
        return None

    def sampler(self, problem: Problem) -> Sampler:
        assert self.draw is not None
        return Sampler(self.draw)


def beyond(rng: np.random.Generator, count: int, draw: Any, kept: Any) -> np.ndarray:
    """Draws of which only those are left that ``kept`` takes."""
    found = draw(rng, 4 * count)
    return found[kept(found)][:count]


def neal() -> bmc.BayesNet:
    """Neal's funnel."""
    net = bmc.BayesNet(plates={"i": 9})
    net.add("v", bmc.Normal(0.0, 3.0))
    net.add("x", lambda v: bmc.Normal(0.0, np.exp(0.5 * v)), plates="i")
    net.add("y", lambda x: bmc.Normal(0.0 * x, 1.0), plates="i")  # so that nothing is drawn forward
    return net


def draws_of_neal(low: float) -> Draw:
    def draw(rng: np.random.Generator, count: int) -> dict[str, np.ndarray]:
        v = beyond(rng, count, lambda r, n: r.normal(0, 3, n), lambda v: v > low)
        return {"v": v, "x": rng.normal(size=(count, 9)) * np.exp(0.5 * v)[:, None]}

    return draw


def precision() -> bmc.BayesNet:
    """The neck is at the upper end; effects go through a computed node; b is a sum."""
    net = bmc.BayesNet(plates={"i": 12})
    net.add("tau", bmc.Gamma(2.0, 1.0))
    net.add("scale", lambda tau: tau**-0.5)
    net.add("b", lambda scale: bmc.Normal(1.0, scale), plates="i")
    net.add("y", lambda b: bmc.Normal(0.0 * b, 1.0), plates="i")
    return net


def draws_of_precision(high: float) -> Draw:
    def draw(rng: np.random.Generator, count: int) -> dict[str, np.ndarray]:
        tau = beyond(rng, count, lambda r, n: r.gamma(2.0, 1.0, n), lambda t: t < high)
        scale = tau**-0.5
        b = 1.0 + rng.normal(size=(count, 12)) * scale[:, None]
        return {"tau": tau, "scale": scale, "b": b}

    return draw


def bounded() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"i": 5})
    net.add("s", bmc.Uniform(0.0, 2.0))
    net.add("b", lambda s: bmc.Laplace(0.0, s), plates="i")
    net.add("y", lambda b: bmc.Normal(0.0 * b, 1.0), plates="i")
    return net


def draws_of_bounded(low: float) -> Draw:
    def draw(rng: np.random.Generator, count: int) -> dict[str, np.ndarray]:
        s = rng.uniform(low, 2.0, count)
        return {"s": s, "b": rng.laplace(size=(count, 5)) * s[:, None]}

    return draw


CASES: dict[str, tuple[Callable[[], bmc.BayesNet], Callable[[float], Draw], float, float, str]] = {
    "neal": (neal, draws_of_neal, -np.inf, -4.0, "draws of 'v' turn back at its lower end"),
    "precision": (precision, draws_of_precision, np.inf, 4.0, "'tau' turn back at its upper end"),
    "bounded": (bounded, draws_of_bounded, 0.0, 0.15, "'s' turn back at its lower end"),
}


def warned(net: bmc.BayesNet, data: Any, engine: Any, seed: int) -> tuple[Any, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ConvergenceWarning)
        posterior = bmc.infer(net, data, engine=engine, rng=seed)
    return posterior, [str(w.message) for w in caught]


@pytest.mark.parametrize("name", CASES)
def test_a_missed_neck_is_an_alarm(name: str) -> None:
    make, draw, _, wall, words = CASES[name]
    net, size = make(), 12 if name == "precision" else 9 if name == "neal" else 5
    posterior, found = warned(net, {"y": np.zeros(size)}, Drawn(2000, draw=draw(wall)), 1)
    node = next(iter(posterior.names))
    assert posterior.rhat(node) < 1.01 and posterior.ess(node) > 5000  # nothing else shows it
    assert len(found) == 1 and words in found[0]


def fixed_edge(hard: bool = True) -> bmc.BayesNet:
    """A factor that ends the density of ``s`` at .4, where it is large, or lets it down there by two."""
    net = bmc.BayesNet(plates={"i": 5})
    net.add("s", bmc.Uniform(0.0, 2.0))
    net.add("b", lambda s: bmc.Laplace(0.0, s), plates="i")
    net.potential("edge", lambda s: np.where(s > 0.4, 0.0, -np.inf if hard else -2.0))
    net.add("y", lambda b: bmc.Normal(0.0 * b, 1.0), plates="i")
    return net


def draws_of_step(rng: np.random.Generator, count: int) -> dict[str, np.ndarray]:
    def kept(s: np.ndarray) -> np.ndarray:
        return rng.random(s.size) < np.where(s > 0.4, 1.0, np.exp(-2.0))

    s = beyond(rng, count, lambda r, n: r.uniform(0, 2.0, n), kept)
    return {"s": s, "b": rng.laplace(size=(count, 5)) * s[:, None]}


def tops() -> bmc.BayesNet:
    """Effects of which none may lie above the parameter."""
    net = bmc.BayesNet(plates={"i": 4})
    net.add("top", bmc.LogNormal(1.0, 0.5))
    net.add("z", lambda top: bmc.Uniform(0.0, top), plates="i")
    net.add("y", lambda z: bmc.Normal(0.0 * z, 0.5), plates="i")
    return net


def draws_of_tops(rng: np.random.Generator, count: int) -> dict[str, np.ndarray]:
    top = rng.lognormal(1.0, 0.5, count)
    return {"top": top, "z": rng.random((count, 4)) * top[:, None]}


RIGHT: dict[str, tuple[Callable[[], bmc.BayesNet], Draw, int]] = {
    "neal": (neal, draws_of_neal(-np.inf), 9),
    "precision": (precision, draws_of_precision(np.inf), 12),
    "bounded": (bounded, draws_of_bounded(0.0), 5),
    "a support that ends at the parameter": (tops, draws_of_tops, 4),
    "a factor that ends": (fixed_edge, draws_of_bounded(0.4), 5),
    "a factor with a step": (lambda: fixed_edge(False), draws_of_step, 5),
}


@pytest.mark.parametrize("name", RIGHT)
def test_a_right_sampler_is_no_alarm(name: str) -> None:
    """Ten runs each: a false alarm in any has a probability of 1 % at most, by normal errors of .2 %."""
    make, draw, size = RIGHT[name]
    net = make()
    for k in range(10):
        seed = session.seed() + k
        _, found = warned(net, {"y": np.zeros(size)}, Drawn(500, draw=draw), seed)
        assert not any("turn back" in words for words in found)


@pytest.mark.parametrize("bad", [1e200, np.nan])
def test_an_alarm_is_not_lost_for_one_bad_draw(bad: float) -> None:
    """One draw whose density overflows, or has none, leaves thousands to judge by."""
    calls = []

    def draw(rng: np.random.Generator, count: int) -> dict[str, np.ndarray]:
        calls.append(0)
        values = draws_of_neal(-4.0)(rng, count)
        if len(calls) == 700:
            values["x"][0, 0] = bad
        return values

    _, found = warned(neal(), {"y": np.zeros(9)}, Drawn(2000, draw=draw), 1)
    assert len(calls) >= 2000
    assert any("draws of 'v' turn back at its lower end" in words for words in found)


# ---- samplers of this library ---------------------------------------------------------------------

EFFECTS = np.array([28.0, 8.0, -3.0, 7.0, -1.0, 1.0, 18.0, 12.0])
ERRORS = np.array([15.0, 10.0, 16.0, 11.0, 9.0, 11.0, 10.0, 18.0])


def schools(centred: bool) -> bmc.BayesNet:
    """Eight schools (Rubin 1981)."""
    net = bmc.BayesNet(plates={"school": 8})
    net.add("mu", bmc.Normal(0.0, 5.0))
    net.add("tau", bmc.HalfCauchy(5.0))
    if centred:
        net.add("theta", lambda mu, tau: bmc.Normal(mu, tau), plates="school")
    else:
        net.add("z", bmc.Normal(0.0, 1.0), plates="school")
        net.add("theta", lambda mu, tau, z: mu + tau * z, plates="school")
    net.add("y", lambda theta: bmc.Normal(theta, ERRORS), plates="school")
    return net


@pytest.mark.parametrize("centred", [True, False])
def test_metropolis_on_eight_schools(centred: bool) -> None:
    """One of the two alarms is there where it must be; without centring there is none of a funnel."""
    walk, found = warned(
        schools(centred), {"y": EFFECTS}, bmc.MetropolisHastings(1500, 500), session.seed()
    )
    if centred:
        assert walk["tau"].min() > 0.1 and any("'tau'" in words for words in found)
    else:
        assert walk["tau"].min() < 0.1 and not any("turn back" in words for words in found)


def test_gibbs_on_eight_schools() -> None:
    posterior, found = warned(schools(True), {"y": EFFECTS}, bmc.Gibbs(500, 200), session.seed())
    assert posterior["tau"].min() < 0.1 and not any("turn back" in words for words in found)


def frailty(centred: bool) -> tuple[bmc.BayesNet, dict[str, Any]]:
    """A Weibull model with weak random effects."""
    rng = np.random.default_rng(0)
    effects, x = rng.normal(0, 0.5, 38), rng.normal(size=(38, 2))
    t = rng.weibull(1.2, (38, 2)) * np.exp(-(-4 + 0.5 * x + effects[:, None]) / 1.2)
    net = bmc.BayesNet(plates={"patient": 38, "rep": 2})
    net.add("alpha", bmc.Normal(0.0, 10.0))
    net.add("beta", bmc.Normal(0.0, 5.0))
    net.add("r", bmc.Gamma(1.0, 0.1))
    net.add("sigma", bmc.HalfCauchy(1.0))
    if centred:
        net.add("b", lambda sigma: bmc.Normal(0.0, sigma), plates="patient")
    else:
        net.add("z", bmc.Normal(0.0, 1.0), plates="patient")
        net.add("b", lambda sigma, z: sigma * z, plates="patient")
    net.add(
        "t",
        lambda r, alpha, beta, b: bmc.Weibull(r, np.exp(-(alpha + beta * x + b) / r)),
        plates=("patient", "rep"),
    )
    return net, {"t": t}


@pytest.mark.thorough
def test_metropolis_on_a_frailty_model() -> None:
    """Centred, sigma is some .42 at any length that anybody waits for; the mean without centring is .344."""
    walk, found = warned(*frailty(True), bmc.MetropolisHastings(5000, 1000), session.seed())
    assert walk.mean("sigma") > 0.38 and any("'sigma'" in words for words in found)
    free, found = warned(*frailty(False), bmc.MetropolisHastings(5000, 1000), session.seed())
    assert abs(free.mean("sigma") - 0.344) < 5 * free.mcse("sigma")
    assert not any("turn back" in words for words in found)


def test_draws_of_a_frailty_model_that_miss_the_neck() -> None:
    """Draws of sigma from .15 to 1, and of the effects given the data: a grid for each, as right as may be.

    Well mixed by all other figures, since they are independent.
    """
    net, data = frailty(True)
    grid = np.linspace(-6.0, 6.0, 401)
    fixed = {"alpha": -4.75, "beta": 0.73, "r": 1.34}
    x = np.random.default_rng(0)
    x.normal(0, 0.5, 38)
    x = x.normal(size=(38, 2))
    scale = np.exp(-(fixed["alpha"] + fixed["beta"] * x[:, :, None] + grid) / fixed["r"])
    log = bmc.Weibull(fixed["r"], scale).log_prob(data["t"][:, :, None]).sum(axis=1)  # (38, 401)
    sigmas = np.geomspace(0.005, 3.0, 500)
    step = grid[1] - grid[0]
    prior = bmc.Normal(0.0, sigmas[:, None]).log_prob(grid)
    joint = np.log(np.exp(log[None] + prior[:, None]).sum(axis=-1) * step).sum(axis=1)
    mass = np.exp(joint - joint.max()) / (1 + sigmas**2) * sigmas  # even in the log of sigma

    def draws(low: float) -> Draw:
        def draw(rng: np.random.Generator, count: int) -> dict[str, np.ndarray]:
            kept = np.where(sigmas > low, mass, 0.0)
            s = np.minimum(np.searchsorted(np.cumsum(kept) / kept.sum(), rng.random(count)), 499)
            p = np.exp(log + prior[s][:, None])
            p = np.cumsum(p, axis=-1)
            b = (p < rng.random((count, 38, 1)) * p[..., -1:]).sum(axis=-1)
            return {**seen, "sigma": sigmas[s], "b": grid[b]}

        seen = {n: np.asarray(v) for n, v in fixed.items()}
        return draw

    given = {**data, **fixed}
    posterior, found = warned(net, given, Drawn(800, draw=draws(0.15)), session.seed())
    assert posterior.rhat("sigma") < 1.01 and posterior.ess("sigma") > 2000
    assert any("draws of 'sigma' turn back at its lower end" in words for words in found)
