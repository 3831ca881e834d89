"""Distributions: batches of probability distributions in plain NumPy.

Families know their parameters, draws, log densities, moments and supports, and nothing of nodes or
engines. Frozen ``scipy.stats`` distributions come in through ``as_distribution``.
"""

from __future__ import annotations

from bayesmc.distributions.adapt import as_distribution
from bayesmc.distributions.affine import Affine
from bayesmc.distributions.base import Distribution, marking_invalid
from bayesmc.distributions.beta_binomial import BetaBinomial
from bayesmc.distributions.categorical import Categorical
from bayesmc.distributions.circular import VonMises, WrappedNormal
from bayesmc.distributions.continuous import Beta, Exponential, Gamma, StudentT, Uniform
from bayesmc.distributions.counts import Geometric, Multinomial, NegativeBinomial
from bayesmc.distributions.density import Density
from bayesmc.distributions.dirichlet import Dirichlet
from bayesmc.distributions.discrete import Bernoulli, Binomial, DiscreteUniform, Poisson
from bayesmc.distributions.inverse_cdf import InverseCdf
from bayesmc.distributions.joint import Joint
from bayesmc.distributions.kernel import KernelDensity
from bayesmc.distributions.lkj import LKJ
from bayesmc.distributions.location_scale import Cauchy, HalfCauchy, HalfNormal, Laplace
from bayesmc.distributions.mixture import Mixture
from bayesmc.distributions.mvnormal import MvNormal
from bayesmc.distributions.normal import Normal
from bayesmc.distributions.ordered import Ordered, OrderedLogistic
from bayesmc.distributions.positive import InverseGamma, LogNormal, Weibull
from bayesmc.distributions.support import Support
from bayesmc.distributions.truncated import Truncated
from bayesmc.distributions.wishart import InverseWishart, Wishart

__all__ = [
    "LKJ",
    "Affine",
    "Bernoulli",
    "Beta",
    "BetaBinomial",
    "Binomial",
    "Categorical",
    "Cauchy",
    "Density",
    "Dirichlet",
    "DiscreteUniform",
    "Distribution",
    "Exponential",
    "Gamma",
    "Geometric",
    "HalfCauchy",
    "HalfNormal",
    "InverseCdf",
    "InverseGamma",
    "InverseWishart",
    "Joint",
    "KernelDensity",
    "Laplace",
    "LogNormal",
    "Mixture",
    "Multinomial",
    "MvNormal",
    "NegativeBinomial",
    "Normal",
    "Ordered",
    "OrderedLogistic",
    "Poisson",
    "StudentT",
    "Support",
    "Truncated",
    "Uniform",
    "VonMises",
    "Weibull",
    "Wishart",
    "WrappedNormal",
    "as_distribution",
    "marking_invalid",
]
