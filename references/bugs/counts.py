"""Poisson counts: pump, salm and epil."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import gammaln

import bayesmc as bmc
from references.bugs.common import VAGUE_4, VAGUE_PRECISION, jags_case
from references.case import Question


def pump(data: Any) -> Question:
    """Failures of pumps in a power plant: Gamma rates with unknown shape and rate."""
    t = np.array(data["t"], dtype=float)
    net = bmc.BayesNet("pump", plates={"pump": len(t)})
    net.add("alpha", bmc.Exponential(1.0))
    net.add("beta", bmc.Gamma(0.1, 1.0))
    net.add("theta", lambda alpha, beta: bmc.Gamma(alpha, beta), plates="pump")
    net.add("x", lambda theta: bmc.Poisson(theta * t), plates="pump")
    return Question(net, {"x": data["x"]})


def salm(data: Any) -> Question:
    """Mutagenicity of quinoline on salmonella: counts with more spread than Poisson's."""
    net = _salm_net(data)
    net.add("tau", VAGUE_PRECISION)
    net.add("sigma", lambda tau: 1 / np.sqrt(tau))
    return Question(net, {"y": data["y"]})


def salm_pareto(data: Any) -> Question:
    """Salm, with a Pareto(1/2, 0.04) precision: that is a uniform scale on (0, 5)."""
    net = _salm_net(data)
    net.add("sigma", bmc.Uniform(0.0, 5.0))
    return Question(net, {"y": data["y"]})


def epil(data: Any) -> Question:
    """Seizures of epileptics under treatment, one random effect per patient."""
    net = _epil_net(data)
    V4 = np.array(data["V4"])

    @net.node(plates=("patient", "visit"))
    def y(patient_effect, alpha_V4):
        return bmc.Poisson(np.exp(patient_effect + alpha_V4 * V4))

    return Question(net, {"y": data["y"]}, {"covariates": _epil_covariates(data)})


def epil_visits(data: Any) -> Question:
    """Epil, with one more random effect per patient and visit."""
    net = _epil_net(data)
    V4 = np.array(data["V4"])
    net.add("tau_b", VAGUE_PRECISION)
    net.add("sigma_b", lambda tau_b: 1 / np.sqrt(tau_b))

    @net.node(plates=("patient", "visit"))
    def log_rate(patient_effect, alpha_V4, sigma_b):
        return bmc.Normal(patient_effect + alpha_V4 * V4, sigma_b)

    @net.node(plates=("patient", "visit"))
    def y(log_rate):
        return bmc.Poisson(np.exp(log_rate))

    return Question(net, {"y": data["y"]}, {"covariates": _epil_covariates(data)})


def _salm_net(data: Any) -> bmc.BayesNet:
    """Everything but the prior of ``sigma``."""
    counts = np.array(data["y"], dtype=float)
    x = np.array(data["x"], dtype=float)
    log_x = np.log(x + 10)
    dose, log_dose = (x - x.mean())[:, None], (log_x - log_x.mean())[:, None]
    doses, replicates = counts.shape
    net = bmc.BayesNet("salm", plates={"dose": doses, "replicate": replicates})
    net.add("alpha_star", VAGUE_4)
    net.add("beta", VAGUE_4)
    net.add("gamma", bmc.Normal(0.0, 1e5))

    @net.node
    def alpha(alpha_star, beta, gamma):
        return alpha_star - beta * log_x.mean() - gamma * x.mean()

    @net.node(plates=("dose", "replicate"))
    def log_rate(alpha_star, beta, gamma, sigma):
        return bmc.Normal(alpha_star + beta * log_dose + gamma * dose, sigma)

    @net.node(plates=("dose", "replicate"))
    def y(log_rate):
        return bmc.Poisson(np.exp(log_rate))

    @net.node(plates=("dose", "replicate"))
    def part_of_deviance(log_rate):
        return -2 * (counts * log_rate - np.exp(log_rate) - gammaln(counts + 1))

    @net.node
    def deviance(part_of_deviance):
        return part_of_deviance.sum("dose", "replicate")

    return net


def _epil_net(data: Any) -> bmc.BayesNet:
    """Coefficients and the effect of each patient; covariates are not centred, as published."""
    patients, visits = np.shape(data["y"])
    net = bmc.BayesNet("epil", plates={"patient": patients, "visit": visits})
    net.input("covariates", plates="patient", event_shape=(5,))
    net.add("coefficients", bmc.MvNormal(np.zeros(5), scale_diag=np.full(5, VAGUE_4.scale)))
    net.add("alpha_V4", VAGUE_4)
    net.add("tau_b1", VAGUE_PRECISION)
    net.add("sigma_b1", lambda tau_b1: 1 / np.sqrt(tau_b1))

    @net.node(plates="patient")
    def patient_effect(covariates, coefficients, sigma_b1):
        return bmc.Normal(np.vecdot(covariates, coefficients), sigma_b1)

    return net


def _epil_covariates(data: Any) -> np.ndarray:
    base, treated, age = (np.array(data[key], dtype=float) for key in ("Base", "Trt", "Age"))
    log_base = np.log(base / 4)
    return np.column_stack([np.ones(len(base)), log_base, treated, treated * log_base, np.log(age)])


_EPIL_MONITORS = {
    name: ("coefficients", (k,))
    for k, name in enumerate(("alpha0", "alpha.Base", "alpha.Trt", "alpha.BT", "alpha.Age"))
}

CASES = (
    jags_case("pump", "test1", pump),
    jags_case("salm", "test1", salm),
    jags_case("salm", "test2", salm_pareto),
    jags_case("epil", "test1", epil, monitors=_EPIL_MONITORS),
    jags_case("epil", "test2", epil_visits, monitors=_EPIL_MONITORS),
)
