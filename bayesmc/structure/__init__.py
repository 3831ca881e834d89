"""Structure read off a net: tables of finite nodes, discrete factors, linear-Gaussian conditionals."""

from bayesmc.structure.affine import is_hidden, why_not_linear
from bayesmc.structure.discrete import (
    DiscreteNet,
    FactorSource,
    InvalidRows,
    Variable,
    core_size,
    discrete_net,
    known_values,
    why_not_discrete,
)
from bayesmc.structure.linear import LinearGaussian, linear_gaussian
from bayesmc.structure.tables import TABLE_ENTRIES, Table, configure, constants_of, tabulate

__all__ = [
    "TABLE_ENTRIES",
    "DiscreteNet",
    "FactorSource",
    "InvalidRows",
    "LinearGaussian",
    "Table",
    "Variable",
    "configure",
    "constants_of",
    "core_size",
    "discrete_net",
    "is_hidden",
    "known_values",
    "linear_gaussian",
    "tabulate",
    "why_not_discrete",
    "why_not_linear",
]
