"""bayesmc: declare a hybrid Bayes net in plain NumPy, and ask it.

A conditional density is a function whose argument names are its parents and which returns a
distribution. See ``bayesmc.BayesNet`` and ``bayesmc.infer``.
"""

import importlib
from typing import Any

from bayesmc import errors, io
from bayesmc.auto import Explanation, explain, infer
from bayesmc.distributions import (
    Bernoulli,
    Beta,
    Binomial,
    Categorical,
    Density,
    Dirichlet,
    DiscreteUniform,
    Distribution,
    Exponential,
    Gamma,
    Mixture,
    MvNormal,
    Normal,
    Poisson,
    StudentT,
    Uniform,
)
from bayesmc.engines.exact import Exact
from bayesmc.engines.weighting import LikelihoodWeighting
from bayesmc.network import BayesNet
from bayesmc.plates import PlateArray, stack
from bayesmc.results import Marginal, Posterior, Summary

__version__ = "0.1.0"

__all__ = [
    "BayesNet",
    "Bernoulli",
    "Beta",
    "Binomial",
    "Categorical",
    "Density",
    "Dirichlet",
    "DiscreteUniform",
    "Distribution",
    "Exact",
    "Explanation",
    "Exponential",
    "Gamma",
    "LikelihoodWeighting",
    "Marginal",
    "Mixture",
    "MvNormal",
    "Normal",
    "PlateArray",
    "Poisson",
    "Posterior",
    "StudentT",
    "Summary",
    "Uniform",
    "errors",
    "explain",
    "infer",
    "io",
    "stack",
]


def __getattr__(name: str) -> Any:
    """``bayesmc.plotting`` and ``bayesmc.testing`` load when first asked for."""
    if name in ("plotting", "testing"):
        return importlib.import_module(f"bayesmc.{name}")
    raise AttributeError(f"module 'bayesmc' has no attribute {name!r}")
