"""Normal observations: rats, line, dyes, equiv and stacks."""

from __future__ import annotations

from typing import Any

import numpy as np

import bayesmc as bmc
from references.bugs.common import (
    VAGUE,
    VAGUE_4,
    VAGUE_5,
    VAGUE_PRECISION,
    jags_case,
    openbugs_case,
)
from references.case import Question
from references.quadrature import dyes_cdfs, line_cdfs


def rats(data: Any) -> Question:
    """Growth of young rats: a line for every rat, whose intercepts and slopes are alike."""
    measured = np.array(data["Y"], dtype=float)
    x = np.array(data["x"], dtype=float)
    net = bmc.BayesNet("rats", plates={"rat": len(measured), "time": len(x)})
    net.add("alpha_c", VAGUE_4)
    net.add("beta_c", VAGUE_4)
    net.add("tau_c", VAGUE_PRECISION)
    net.add("tau_alpha", VAGUE_PRECISION)
    net.add("tau_beta", VAGUE_PRECISION)

    @net.node(plates="rat")
    def alpha(alpha_c, tau_alpha):
        return bmc.Normal(alpha_c, 1 / np.sqrt(tau_alpha))

    @net.node(plates="rat")
    def beta(beta_c, tau_beta):
        return bmc.Normal(beta_c, 1 / np.sqrt(tau_beta))

    @net.node(plates=("rat", "time"))
    def Y(alpha, beta, tau_c):
        return bmc.Normal(alpha + beta * (x - x.mean()), 1 / np.sqrt(tau_c))

    @net.node
    def alpha0(alpha_c, beta_c):
        return alpha_c - beta_c * x.mean()

    return Question(net, {"Y": measured})


def line(data: Any) -> Question:
    """A straight line through five points."""
    x = np.array(data["x"], dtype=float)
    net = bmc.BayesNet("line", plates={"point": len(x)})
    net.add("alpha", VAGUE_4)
    net.add("beta", VAGUE_4)
    net.add("tau", VAGUE_PRECISION)

    @net.node
    def sigma(tau):
        return 1 / np.sqrt(tau)

    @net.node(plates="point")
    def Y(alpha, beta, sigma):
        return bmc.Normal(alpha + beta * (x - x.mean()), sigma)

    return Question(net, {"Y": np.array(data["Y"], dtype=float)})


def dyes(data: Any) -> Question:
    """Yield of dyestuff: how much of its variance lies between batches."""
    measured = np.array(data["y"], dtype=float)
    batches, samples = measured.shape
    net = bmc.BayesNet("dyes", plates={"batch": batches, "sample": samples})
    net.add("theta", bmc.Normal(0.0, 1e5))
    net.add("tau_within", VAGUE_PRECISION)
    net.add("tau_between", VAGUE_PRECISION)

    @net.node(plates="batch")
    def mu(theta, tau_between):
        return bmc.Normal(theta, 1 / np.sqrt(tau_between))

    @net.node(plates=("batch", "sample"))
    def y(mu, tau_within):
        return bmc.Normal(mu, 1 / np.sqrt(tau_within))

    @net.node
    def sigma2_within(tau_within):
        return 1 / tau_within

    @net.node
    def sigma2_between(tau_between):
        return 1 / tau_between

    @net.node
    def f_between(sigma2_within, sigma2_between):
        return sigma2_between / (sigma2_between + sigma2_within)

    return Question(net, {"y": measured})


def equiv(data: Any) -> Question:
    """A cross-over trial: is one treatment equivalent to the other?"""
    measured = np.array(data["Y"], dtype=float)
    period = np.array([1.0, -1.0])
    treatment = np.outer(data["group"], period)
    net = bmc.BayesNet("equiv", plates={"patient": len(measured), "period": 2})
    for name in ("mu", "phi", "pi"):
        net.add(name, VAGUE)
    net.add("tau", VAGUE_PRECISION)
    net.add("tau_delta", VAGUE_PRECISION)

    @net.node(plates="patient")
    def delta(tau_delta):
        return bmc.Normal(0.0, 1 / np.sqrt(tau_delta))

    @net.node(plates=("patient", "period"))
    def Y(mu, phi, pi, delta, tau):
        return bmc.Normal(mu + treatment * phi / 2 + period * pi / 2 + delta, 1 / np.sqrt(tau))

    @net.node
    def theta(phi):
        return np.exp(phi)

    @net.node
    def equivalence(theta):
        return (theta >= 0.8) & (theta < 1.2)

    @net.node
    def sigma(tau, tau_delta):
        return 1 / np.sqrt(bmc.stack([tau, tau_delta]))

    return Question(net, {"Y": measured})


def stacks(data: Any) -> Question:
    """Stack loss: a regression on standardised covariates, and how far out each point lies."""
    measured = np.array(data["Y"], dtype=float)
    x = np.array(data["x"], dtype=float)
    centre, spread = x.mean(axis=0), x.std(axis=0, ddof=1)
    net = bmc.BayesNet("stacks", plates={"day": len(measured)})
    net.input("z", plates="day", event_shape=(3,))
    net.add("beta0", VAGUE_5)
    net.add("beta", bmc.MvNormal(np.zeros(3), scale_diag=np.full(3, VAGUE_5.scale)))
    net.add("tau", VAGUE_PRECISION)

    @net.node
    def sigma(tau):
        return 1 / np.sqrt(tau)

    @net.node(plates="day")
    def mean(z, beta0, beta):
        return beta0 + np.vecdot(z, beta)

    @net.node(plates="day")
    def Y(mean, sigma):
        return bmc.Normal(mean, sigma)

    @net.node(plates="day")
    def outlier(Y, mean, sigma):
        return np.abs(Y - mean) > 2.5 * sigma

    @net.node
    def b(beta):
        return beta / spread

    @net.node
    def b0(beta0, b):
        return beta0 - np.vecdot(b, centre)

    return Question(net, {"Y": measured}, {"z": (x - centre) / spread})


CASES = (
    jags_case("rats", "test1", rats),
    jags_case("rats", "test2", rats),
    jags_case("line", "test1", line, cdfs=lambda data: line_cdfs(data["x"], data["Y"])),
    jags_case(
        "dyes",
        "test1",
        dyes,
        cdfs=lambda data: dyes_cdfs(data["y"]),
    ),
    jags_case("equiv", "test1", equiv),
    jags_case("equiv", "test2", equiv),
    openbugs_case("stacks", "", "Stacks", stacks),
)
