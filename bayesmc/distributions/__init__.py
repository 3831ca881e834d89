"""Distributions: batches of probability distributions in plain NumPy.

Families know their parameters, draws, log densities, moments and supports, and nothing of nodes or
engines. Frozen ``scipy.stats`` distributions come in through ``as_distribution``.
"""

from __future__ import annotations

from bayesmc.distributions.adapt import as_distribution
from bayesmc.distributions.base import Distribution, marking_invalid
from bayesmc.distributions.categorical import Categorical
from bayesmc.distributions.continuous import Beta, Exponential, Gamma, StudentT, Uniform
from bayesmc.distributions.density import Density
from bayesmc.distributions.dirichlet import Dirichlet
from bayesmc.distributions.discrete import Bernoulli, Binomial, DiscreteUniform, Poisson
from bayesmc.distributions.mixture import Mixture
from bayesmc.distributions.mvnormal import MvNormal
from bayesmc.distributions.normal import Normal
from bayesmc.distributions.support import Support

__all__ = [
    "Bernoulli",
    "Beta",
    "Binomial",
    "Categorical",
    "Density",
    "Dirichlet",
    "DiscreteUniform",
    "Distribution",
    "Exponential",
    "Gamma",
    "Mixture",
    "MvNormal",
    "Normal",
    "Poisson",
    "StudentT",
    "Support",
    "Uniform",
    "as_distribution",
    "marking_invalid",
]
