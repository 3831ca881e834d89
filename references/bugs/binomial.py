"""Binomial counts: seeds, surgical, beetles and hearts."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.special import expit, ndtr, rel_entr

import bayesmc as bmc
from references.bugs.common import (
    VAGUE,
    VAGUE_4,
    VAGUE_PRECISION,
    jags_case,
    openbugs_case,
)
from references.case import Question


def seeds(data: Any) -> Question:
    """Germination of seeds: a factorial logistic regression with one random effect per plot."""
    net = _seeds_net(data)
    net.add("tau", VAGUE_PRECISION)
    net.add("sigma", lambda tau: 1 / np.sqrt(tau))
    _random_logits(net, data)
    return _seeds_question(net, data)


def seeds_zero(data: Any) -> Question:
    """Seeds, with random effects that sum to zero: ``c - mean(c)``."""
    net = _seeds_net(data)
    net.add("tau", VAGUE_PRECISION)
    net.add("sigma", lambda tau: 1 / np.sqrt(tau))
    net.add("c", lambda sigma: bmc.Normal(0.0, sigma), plates="plot")
    net.add("c_mean", lambda c: c.mean("plot"))
    net.add("b", lambda c, c_mean: c - c_mean, plates="plot")
    net.add("r", _germinated(data), plates="plot")
    return _seeds_question(net, data)


def seeds_scaled(sigma: bmc.Distribution, data: Any) -> Question:
    """Seeds, with random effects ``sigma * z`` of a standard Normal z."""
    net = _seeds_net(data)
    net.add("sigma", sigma)
    net.add("z", bmc.Normal(0.0, 1.0), plates="plot")
    net.add("b", lambda z, sigma: sigma * z, plates="plot")
    net.add("r", _germinated(data), plates="plot")
    return _seeds_question(net, data)


def seeds_pareto(data: Any) -> Question:
    """Seeds, with a Pareto(1/2, 0.01) precision: that is a uniform scale on (0, 10)."""
    net = _seeds_net(data)
    net.add("sigma", bmc.Uniform(0.0, 10.0))
    _random_logits(net, data)
    return _seeds_question(net, data)


def surgical_fixed(data: Any) -> Question:
    """Mortality of infants in twelve hospitals, each on its own."""
    n = np.array(data["n"])
    net = bmc.BayesNet("surgical, fixed", plates={"hospital": len(n)})
    net.add("p", bmc.Beta(1.0, 1.0), plates="hospital")
    net.add("r", lambda p: bmc.Binomial(n, p), plates="hospital")
    return Question(net, {"r": data["r"]})


def surgical_random(data: Any) -> Question:
    """Mortality in hospitals that are alike: a hierarchy on the logits."""
    n = np.array(data["n"])
    net = bmc.BayesNet("surgical, random", plates={"hospital": len(n)})
    net.add("mu", VAGUE)
    net.add("tau", VAGUE_PRECISION)
    net.add("sigma", lambda tau: 1 / np.sqrt(tau))
    net.add("b", lambda mu, sigma: bmc.Normal(mu, sigma), plates="hospital")
    net.add("p", lambda b: expit(b), plates="hospital")
    net.add("r", lambda p: bmc.Binomial(n, p), plates="hospital")
    net.add("pop_mean", lambda mu: expit(mu))
    return Question(net, {"r": data["r"]})


def beetles(inverse_link: Callable[[Any], Any], data: Any) -> Question:
    """Beetles killed by carbon disulphide: a dose-response curve."""
    x, n, killed = (np.array(data[key], dtype=float) for key in "xnr")
    prior = bmc.Normal(0.0, np.sqrt(1e3))
    net = bmc.BayesNet("beetles", plates={"dose": len(x)})
    net.add("alpha_star", prior)
    net.add("beta", prior)
    net.add("alpha", lambda alpha_star, beta: alpha_star - beta * x.mean())

    @net.node(plates="dose")
    def p(alpha_star, beta):
        return inverse_link(alpha_star + beta * (x - x.mean()))

    @net.node(plates="dose")
    def r(p):
        return bmc.Binomial(n.astype(int), p)

    @net.node(plates="dose")
    def r_hat(p):
        return n * p

    @net.node(plates="dose")
    def deviance(r_hat):
        return 2 * (rel_entr(killed, r_hat) + rel_entr(n - killed, n - r_hat))

    @net.node
    def D(deviance):
        return deviance.sum("dose")

    return Question(net, {"r": killed.astype(int)})


def hearts(data: Any) -> Question:
    """Premature heart beats: some patients are cured, the others have fewer than before."""
    t = np.array(data["t"])
    net = bmc.BayesNet("hearts", plates={"patient": len(t)})
    net.add("alpha", VAGUE_4)
    net.add("delta", VAGUE_4)
    net.add("p", lambda alpha: expit(alpha))
    net.add("theta", lambda delta: expit(delta))
    net.add("beta", lambda alpha: np.exp(alpha))
    net.add("state", lambda theta: bmc.Bernoulli(theta), plates="patient", states=("sick", "cured"))

    @net.node(plates="patient")
    def y(state, p):
        return bmc.Binomial(t, np.where(state == "cured", 0.0, p))

    return Question(net, {"y": data["y"]})


def _seeds_net(data: Any) -> bmc.BayesNet:
    """The plots and the four coefficients."""
    net = bmc.BayesNet("seeds", plates={"plot": len(data["r"])})
    for name in ("alpha0", "alpha1", "alpha2", "alpha12"):
        net.add(name, VAGUE)
    return net


def _random_logits(net: bmc.BayesNet, data: Any) -> None:
    """Logits that scatter by ``sigma`` about the regression, and the counts."""
    x1, x2, n = (np.array(data[key]) for key in ("x1", "x2", "n"))

    @net.node(plates="plot")
    def logit_p(alpha0, alpha1, alpha2, alpha12, sigma):
        return bmc.Normal(alpha0 + alpha1 * x1 + alpha2 * x2 + alpha12 * x1 * x2, sigma)

    @net.node(plates="plot")
    def r(logit_p):
        return bmc.Binomial(n, expit(logit_p))


def _germinated(data: Any) -> Callable[..., bmc.Distribution]:
    """The density of the counts given coefficients and random effects ``b``."""
    x1, x2, n = (np.array(data[key]) for key in ("x1", "x2", "n"))

    def r(alpha0, alpha1, alpha2, alpha12, b):
        return bmc.Binomial(n, expit(alpha0 + alpha1 * x1 + alpha2 * x2 + alpha12 * x1 * x2 + b))

    return r


def _seeds_question(net: bmc.BayesNet, data: Any) -> Question:
    return Question(net, {"r": data["r"]})


def _complementary_log_log(eta: Any) -> Any:
    return 1 - np.exp(-np.exp(eta))


CASES = (
    jags_case("seeds", "test1", seeds),
    jags_case("seeds", "test2", seeds_zero),
    jags_case(
        "seeds",
        "test3",
        functools.partial(seeds_scaled, bmc.Exponential(1.0)),
    ),
    jags_case(
        "seeds",
        "test4",
        functools.partial(seeds_scaled, bmc.Uniform(0.0, 10.0)),
    ),
    jags_case("seeds", "test5", seeds_pareto),
    openbugs_case("surgical", "fixed", "Surgical", surgical_fixed),
    openbugs_case("surgical", "random", "Surgicalrand", surgical_random, data="Surgical"),
    jags_case("beetles", "test1", functools.partial(beetles, expit)),
    jags_case("beetles", "test2", functools.partial(beetles, ndtr)),
    jags_case("beetles", "test3", functools.partial(beetles, _complementary_log_log)),
    jags_case("hearts", "test1", hearts),
)
